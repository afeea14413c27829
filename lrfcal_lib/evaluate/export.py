"""Calibrations and clouds on disk: ``calibration.json``, PLY, PCD."""

import hashlib
import json
import os
from functools import partial
from pathlib import Path

import numpy as np

from lrfcal_lib import __version__
from lrfcal_lib.calibrate.cloud import write_ply
from lrfcal_lib.calibrate.clouds import cloud_blocks
from lrfcal_lib.calibrate.pipeline import calibrate, handed_over
from lrfcal_lib.evaluate.joint_tables import joint_fit
from lrfcal_lib.evaluate.scenes import with_sigma
from lrfcal_lib.evaluate.tables import plane_residuals_of, rms
from lrfcal_lib.fit.residuals import edge_residuals_px
from lrfcal_lib.judge.verdict import NO, judge
from lrfcal_lib.session.cache import spread
from lrfcal_lib.session.read import open_session
from lrfcal_lib.session.stated import FILES, opened
from lrfcal_lib.session.write import whole

SCHEMA = 1
AXIS_PARAMETERS = [
    "out_of_scan_plane_rad",
    "in_scan_plane_rad",
    "offset_in_scan_plane_m",
    "offset_across_scan_plane_m",
]
UNTRUSTED = 3  # exit status of a calibration whose verdict is 'no'
SCENES_ONLY = (
    "all placements show scenes, and a calibration needs the board: "
    "record three or more placements of the board with the same rig"
)
FRAMES = (
    "destination first: p_camera = T_camera_source p_source; metres, radians; "
    "covariances of [w, v]: R <- exp(w) R, t <- t + v"
)


def calibration_record(calibration, method, judged=None):
    """Everything that a Calibration says about the results of a method, ready for JSON.

    Schema, library version, verdict, session with the SHA-256 of its files, frames and units,
    platform, and for each camera its pose, intrinsics, covariance, and residual statistics. 'joint'
    brings its own platform, range offset and pitch terms, and what it says about the sensor.
    `judged` is the Verdict on these results, where ``judge`` was asked already.
    """
    session = calibration.prepared.session
    platform = calibration.platform
    axis = platform.axis_with(method)
    every = calibration.solutions.items()
    record = {
        "schema": SCHEMA,
        "lrfcal": __version__,
        "session": session.name,
        "inputs_sha256": file_hashes(session),
        "conventions": FRAMES,
        "method": method,
        "verdict": (judged or judge(calibration, method, suggest=False)).record(),
        "platform": {
            **_transform(platform.transform(axis)),
            "maps": "lrf to head",
            "axis_covariance": platform.axes[axis].covariance.tolist(),
            "axis_covariance_of": AXIS_PARAMETERS,
        },
        "cameras": {
            c: _camera(calibration, c, method, found)
            for (c, name), found in every
            if name == method
        },
    }
    # what it says about range finder and pitch, and what it left out in words
    if method == "joint":
        joint = calibration.joint.solution
        sigma = calibration.joint.solution.sigma
        sensor = {
            name: {"value": joint.sensor[name], "sigma": sigma[name]}
            for name in joint.sensor
            if name in sigma
        }
        record["sensor"] = sensor | {
            "noise": joint.noise,
            "excluded": [str(problem) for problem in joint.excluded],
        }
    return record


def _camera(calibration, camera, method, solution):
    """Pose, intrinsics and residuals of a camera.

    Of the joint estimate without the edge bias, from its own boards.
    """
    obs = calibration.observations[camera, "joint" if method == "joint" else "half_step"]
    edge = edge_residuals_px(obs, solution.transform, solution.model)
    model = calibration.prepared.models[camera]
    misfit = {
        "edge_rms_px": rms(edge),
        "plane_rms_mm": 1000 * rms(plane_residuals_of(obs, solution)),
    }
    if method == "joint":
        misfit = joint_fit(calibration.joint, [camera])
    model = solution.model or model
    lens = dict(
        zip(
            ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
            model.parameters.tolist(),
            strict=True,
        )
    )
    return {
        "maps": f"{obs.source} to {obs.camera}",
        **_transform(solution.transform),
        "sigma": dict(zip(solution.names[:6], solution.trusted_sigma[:6].tolist(), strict=True)),
        "covariance": solution.trusted[:6, :6].tolist(),
        "intrinsics": {"width": model.width, "height": model.height, **lens},
        "converged": bool(solution.converged),
        "unobservable": list(solution.unobservable),
        **misfit,
        "n_crossings": len(edge),
        "placements": obs.all_placements.tolist(),
    }


def _transform(transform):
    pose = {
        "rotvec_rad": transform.rotation.as_rotvec().tolist(),
        "translation_m": transform.translation.tolist(),
    }
    return {"matrix": transform.as_matrix().tolist(), **pose}


def file_hashes(session):
    """SHA-256 of every file that a session was read from, by its path within it.

    Of no other that lies there.
    """
    files = {session.path / name for name in FILES if os.path.lexists(session.path / name)}
    hashes = {}
    for file in sorted(files | {record.file for record in session.image_records}):
        with opened(file, session.path) as stream:
            hashes[file.relative_to(session.path).as_posix()] = hashlib.file_digest(
                stream, "sha256"
            ).hexdigest()
    return hashes


def write_calibration(path, record):
    """Write a :func:`calibration_record` as JSON, NaN as null.

    ValueError if it cannot be written.
    """
    plain = json.loads(json.dumps(record), parse_constant=lambda name: None)
    with whole(path) as draft:
        draft.write_text(json.dumps(plain, indent=1) + "\n")


def write_clouds(folder, calibration, method):
    """Write ``cloud.ply`` (the boards) and, where there are scenes, ``scene.ply`` and
    ``scene.pcd``.

    A sigma is what a joint estimate predicts, otherwise the stated noise of ranges.

    Parameters
    ----------
    folder : path-like
    calibration : Calibration
        Its session may be another one of the same rig (``replace`` it in `prepared`), whose scenes
        are then coloured.
    method : str
        Whose camera poses and axis make the clouds.

    Returns
    -------
    list of Path

    Raises
    ------
    ValueError
        For a session that the calibration cannot colour, or a file that cannot be written. Every
        file is whole, or as it was before.
    """
    write = partial(_write_cloud, Path(folder), calibration, method)
    written = spread(write, _kinds_of_clouds(calibration.prepared))
    return [file for files in reversed(written) for file in files]


def _kinds_of_clouds(prepared):
    """The clouds that can be had, the longest work first: True of the scenes, False of the
    boards.
    """
    kinds = []
    session = prepared.session
    if session.scene_placements:
        kinds.append(True)
    of_another_session = not prepared.scans.keys() <= set(session.placements)
    if prepared.scans and not (kinds and of_another_session):
        kinds.append(False)
    return kinds


def _write_cloud(folder, calibration, method, scene):
    """Write the cloud of the scenes or of the boards; its files."""
    blocks = cloud_blocks(calibration, method, scene)
    if method == "joint":
        blocks = (with_sigma(block, calibration.joint.solution) for block in blocks)
    about = f"session {calibration.prepared.session.name}, method {method}, lrfcal {__version__}"
    ply = folder / ("scene.ply" if scene else "cloud.ply")
    write_ply(ply, blocks, [about])
    if not scene:
        return [ply]
    pcd = folder / "scene.pcd"
    write_pcd(pcd, ply)
    return [ply, pcd]


def write_pcd(path, ply):
    """Write what a PLY of :func:`write_ply` holds as PCD.

    ValueError if the file cannot be written.
    """
    import open3d as o3d

    cloud = o3d.t.io.read_point_cloud(str(ply))
    with whole(path) as draft:
        if not o3d.t.io.write_point_cloud(str(draft), cloud):
            raise OSError("is the disk full?")


def calibrate_session(path, out=None):
    """Calibrate a session from the command line: verdict and poses, ``calibration.json`` and
    clouds.

    Parameters
    ----------
    path : path-like
        Of the session.
    out : path-like, optional
        Folder of the files; ``reports/<name>`` under the current folder by default.

    Returns
    -------
    int
        0, or 3 where the verdict is 'no' (also when nothing could be calibrated, nor is written).

    Raises
    ------
    ValueError
        For a session that cannot be opened, or a file that cannot be written, which stays as it
        was.
    """
    session = open_session(path)
    if not session.board_placements:
        print(f"{path}: {SCENES_ONLY}")
        return UNTRUSTED
    calibration = calibrate(session)
    _print_poses(calibration)
    method = handed_over(calibration)
    if method is None:
        judged = judge(calibration)
        print(*judged.sentences(), sep="\n")
        return UNTRUSTED
    folder = Path(out or Path("reports") / Path(path).resolve().name)
    kinds = _kinds_of_clouds(calibration.prepared)
    clouds = [partial(_write_cloud, folder, calibration, method, kind) for kind in kinds]
    tasks = [*clouds, partial(_judged, calibration, method)]
    *written, (judged, record) = spread(lambda task: task(), tasks)
    file = folder / "calibration.json"
    write_calibration(file, record)  # last: where it stands, the clouds do
    print(*judged.sentences(), sep="\n")
    names = [str(name) for files in reversed(written) for name in files]
    print("written:", ", ".join([*names, str(file)]))
    return UNTRUSTED if judged.answer == NO else 0


def _judged(calibration, method):
    """The Verdict on a calibration, and its record."""
    judged = judge(calibration, method)
    return judged, calibration_record(calibration, method, judged)


def _print_poses(calibration):
    """Print the pose of every camera by every method, and what could not be used."""
    scale = np.repeat([np.rad2deg(1.0), 1000.0], 3)
    for (camera, method), solution in calibration.solutions.items():
        values = (scale * solution.parameters[:6]).round(2)
        sigma = (scale * solution.trusted_sigma[:6]).round(2)
        turn = f"rotation vector {values[:3]} +- {sigma[:3]} deg"
        shift = f"translation {values[3:]} +- {sigma[3:]} mm"
        print(f"{camera:>8} {method:<20} {turn}, {shift}")
    for problem in (*calibration.prepared.problems, *calibration.problems):
        print(problem)
