"""Calibrations and clouds on disk: ``calibration.json``, PLY, PCD."""

import hashlib
import json
import os
from pathlib import Path

import numpy as np

from lrfcal_lib import __version__
from lrfcal_lib.calibrate.pipeline import calibrate, cloud_blocks
from lrfcal_lib.calibrate.reconstruct import write_ply
from lrfcal_lib.evaluate.joint_tables import joint_fit
from lrfcal_lib.evaluate.scenes import with_sigma
from lrfcal_lib.evaluate.tables import handed_over, plane_residuals_of, rms
from lrfcal_lib.evaluate.verdict import NO, judge
from lrfcal_lib.fit.residuals import edge_residuals_px
from lrfcal_lib.session.cache import spread
from lrfcal_lib.session.read import open_session
from lrfcal_lib.session.stated import FILES, opened

SCHEMA = 1
AXIS_PARAMETERS = ["out_of_scan_plane_rad", "in_scan_plane_rad", "offset_in_scan_plane_m", "offset_across_scan_plane_m"]
UNTRUSTED = 3  # exit status of a calibration whose verdict is 'no'
FRAMES = (
    "destination first: p_camera = T_camera_source p_source; metres, radians; "
    "covariances of [w, v]: R <- exp(w) R, t <- t + v"
)


def calibration_record(calibration, method, judged=None):
    """Everything that a Calibration says about the results of a method, ready for JSON.

    Schema, library version, verdict, session with the SHA-256 of its files, frames and units, platform, and for each
    camera its pose, intrinsics, covariance, and residual statistics. 'joint' brings its own platform, range offset and
    pitch terms, and what it says about the sensor. `judged` is the Verdict on these results, where ``judge`` was asked
    already.
    """
    session, platform = calibration.prepared.session, calibration.platform
    axis, every = platform.axis_with(method), calibration.solutions.items()
    record = {
        "schema": SCHEMA,
        "lrfcal": __version__,
        "session": session.name,
        "inputs_sha256": file_hashes(session),
        "conventions": FRAMES,
        "method": method,
        "verdict": (judged or judge(calibration, method, suggest=False)).record(),
        "platform": {
            **_transform(platform.transform(axis)), "maps": "lrf to head",
            "axis_covariance": platform.parameters()[axis][1].tolist(), "axis_covariance_of": AXIS_PARAMETERS,
        },  # fmt: skip
        "cameras": {c: _camera(calibration, c, method, found) for (c, name), found in every if name == method},
    }
    if method == "joint":  # what it says about range finder and pitch, and what it left out in words
        joint, sigma = calibration.joint.solution, calibration.joint.solution.sigma
        sensor = {name: {"value": joint.sensor[name], "sigma": sigma[name]} for name in joint.sensor if name in sigma}
        record["sensor"] = sensor | {"noise": joint.noise, "excluded": list(joint.excluded.values())}
    return record


def _camera(calibration, camera, method, solution):
    """Pose, intrinsics and residuals of a camera; of the joint estimate without the edge bias, from its own boards."""
    obs = calibration.observations[camera, "joint" if method == "joint" else "half_step"]
    edge, model = edge_residuals_px(obs, solution.transform, solution.model), calibration.prepared.models[camera]
    misfit = {"edge_rms_px": rms(edge), "plane_rms_mm": 1000 * rms(plane_residuals_of(obs, solution))}
    if method == "joint":
        misfit = joint_fit(calibration.joint, [camera])
    model = solution.model or model
    lens = dict(zip(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"), model.parameters.tolist(), strict=True))
    return {
        "maps": f"{obs.source} to {obs.camera}", **_transform(solution.transform),
        "sigma": dict(zip(solution.names[:6], solution.trusted_sigma[:6].tolist(), strict=True)),
        "covariance": solution.trusted[:6, :6].tolist(),
        "intrinsics": {"width": model.width, "height": model.height, **lens}, "converged": bool(solution.converged),
        "unobservable": list(solution.unobservable), **misfit, "n_crossings": len(edge),
        "placements": obs.all_placements.tolist(),
    }  # fmt: skip


def _transform(transform):
    pose = {"rotvec_rad": transform.rotation.as_rotvec().tolist(), "translation_m": transform.translation.tolist()}
    return {"matrix": transform.as_matrix().tolist(), **pose}


def file_hashes(session):
    """SHA-256 of every file that a session was read from, by its path within it; of no other that lies there."""
    files = {session.path / name for name in FILES if os.path.lexists(session.path / name)}
    hashes = {}
    for file in sorted(files | {record.file for record in session.image_records}):
        with opened(file, session.path) as stream:
            hashes[file.relative_to(session.path).as_posix()] = hashlib.file_digest(stream, "sha256").hexdigest()
    return hashes


def write_calibration(path, record):
    """Write a :func:`calibration_record` as JSON; NaN becomes null."""
    path, plain = Path(path), json.loads(json.dumps(record), parse_constant=lambda name: None)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(plain, indent=1) + "\n")


def write_clouds(folder, calibration, method):
    """Write ``cloud.ply`` (the boards) and, of a session with scenes, ``scene.ply`` and ``scene.pcd``: their paths.

    A sigma is what a joint estimate predicts, otherwise the stated noise of ranges.
    """
    return sum(spread(_write_cloud, _clouds(folder, calibration, method))[::-1], [])


def _clouds(folder, calibration, method):
    """What :func:`_write_cloud` takes, of each cloud of a session."""
    scenes = [True] * bool(calibration.prepared.session.scene_placements)
    return [(Path(folder), calibration, method, s) for s in scenes + [False] * bool(calibration.prepared.scans)]


def _write_cloud(of):
    """The files of a cloud."""
    folder, calibration, method, scene = of
    blocks, files = cloud_blocks(calibration, method, scene), [folder / f"{'scene' if scene else 'cloud'}.ply"]
    if method == "joint":
        blocks = (with_sigma(block, calibration.joint.solution) for block in blocks)
    write_ply(files[0], blocks, [f"session {calibration.prepared.session.name}, method {method}, lrfcal {__version__}"])
    if scene:
        files.append(folder / "scene.pcd")
        write_pcd(files[1], files[0])
    return files


def write_pcd(path, ply):
    """Write what a PLY of :func:`write_ply` holds as PCD. Raises OSError if the file cannot be written."""
    import open3d as o3d

    if not o3d.t.io.write_point_cloud(str(path), o3d.t.io.read_point_cloud(str(ply))):
        raise OSError(f"{path}: the cloud could not be written; is the disk full?")


def write_mesh(path, ply, step=0.02):
    """Write a surface mesh of a PLY of :func:`write_ply` as PLY: Poisson's, cut where there are no points.

    Parameters
    ----------
    path, ply : path
    step : float
        Metres; points are thinned to cubes of this size first, and details are about as fine.

    Returns
    -------
    int
        Triangles; ValueError if no point has a normal, OSError if the file cannot be written.
    """
    import open3d as o3d

    cloud = o3d.io.read_point_cloud(str(ply), remove_nan_points=True)
    normals = np.isfinite(np.asarray(cloud.normals)).all(axis=1)
    cloud = cloud.select_by_index(np.flatnonzero(normals)).voxel_down_sample(step)
    if not len(cloud.points):
        raise ValueError(f"{ply}: no point has a normal, a surface needs neighbouring scan lines")
    depth = int(np.ceil(np.log2(np.ptp(np.asarray(cloud.points), axis=0).max() / step))) + 1
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=min(depth, 11), n_threads=1)
    corners = o3d.geometry.PointCloud(mesh.vertices)
    mesh.remove_vertices_by_mask(np.asarray(corners.compute_point_cloud_distance(cloud)) > 2 * step)
    mesh.vertex_colors = o3d.utility.Vector3dVector(np.clip(np.asarray(mesh.vertex_colors), 0, 1))
    if not o3d.io.write_triangle_mesh(str(path), mesh):
        raise OSError(f"{path}: the mesh could not be written; is the disk full?")
    return len(mesh.triangles)


def calibrate_session(path, out=None):
    """Calibrate a session from the command line: verdict and poses, ``calibration.json`` and clouds.

    They go to `out`, ``reports/<name>`` under the current folder when left out. Returns 0, or 3 where the verdict is
    'no' (also when no camera could be calibrated and nothing is written).
    """
    found, scale = calibrate(open_session(path)), np.repeat([np.rad2deg(1.0), 1000.0], 3)
    folder = Path(out or Path("reports") / Path(path).resolve().name)
    for (camera, method), solution in found.solutions.items():
        values, sigma = scale * solution.parameters[:6], scale * solution.trusted_sigma[:6]
        turn, shift = (f"{values[i].round(2)} +- {sigma[i].round(2)}" for i in (slice(0, 3), slice(3, 6)))
        print(f"{camera:>8} {method:<20} rotation vector {turn} deg, translation {shift} mm")
    for key, why in (found.prepared.problems | found.problems).items():
        print(f"{key}: {why}")
    method, file = handed_over(found), folder / "calibration.json"

    def work(cloud):
        """Write a cloud, or else judge the calibration and write it."""
        if cloud:
            return _write_cloud(cloud)
        judged = judge(found, method)
        if method:  # otherwise nothing can be handed over
            write_calibration(file, calibration_record(found, method, judged))
        return judged

    *files, judged = spread(work, [*(_clouds(folder, found, method) if method else ()), None])
    print(*judged.sentences(), sep="\n")
    if method:
        print("written:", *(f"{path}," for path in sum(files[::-1], [])), file)
    return UNTRUSTED if judged.answer == NO else 0
