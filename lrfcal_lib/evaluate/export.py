"""Calibrations on disk: ``calibration.json``."""

import hashlib
import json
import os
from pathlib import Path

from lrfcal_lib import __version__
from lrfcal_lib.calibrate.pipeline import Calibration
from lrfcal_lib.evaluate.joint_tables import joint_fit
from lrfcal_lib.evaluate.tables import plane_residuals_of, rms
from lrfcal_lib.fit.residuals import edge_residuals_px
from lrfcal_lib.judge.verdict import Verdict, judge
from lrfcal_lib.session.read import Session
from lrfcal_lib.session.stated import FILES, opened
from lrfcal_lib.session.write import whole

SCHEMA = 1
AXIS_PARAMETERS = [
    "out_of_scan_plane_rad",
    "in_scan_plane_rad",
    "offset_in_scan_plane_m",
    "offset_across_scan_plane_m",
]
LENS_PARAMETERS = (
    "fx",
    "fy",
    "cx",
    "cy",
    "k1",
    "k2",
    "p1",
    "p2",
    "k3",
)  # as OpenCV calls them
FRAMES = (
    "destination first: p_camera = T_camera_source p_source; metres, radians; "
    "covariances of [w, v]: R <- exp(w) R, t <- t + v"
)


def calibration_record(
    calibration: Calibration, method: str, judged: Verdict | None = None
) -> dict:
    """Everything that a calibration says about the results of a method, ready for JSON.

    Schema, library version, verdict, session with the SHA-256 of its files, frames and units,
    platform, and for each camera its pose, intrinsics, covariance, and residual statistics. 'joint'
    brings its own platform, range offset and pitch terms, and what it says about the sensor.

    Parameters
    ----------
    calibration : Calibration
    method : str
    judged : Verdict, optional
        On these results, where ``judge`` was asked already.

    Returns
    -------
    dict
    """
    session = calibration.prepared.session
    axis = calibration.rig(method).axis
    judged = judged or judge(calibration, method, suggest=False)
    cameras = {}
    for (camera, name), solution in calibration.solutions.items():
        if name == method:
            cameras[camera] = _camera(calibration, camera, method, solution)
    record = {
        "schema": SCHEMA,
        "lrfcal": __version__,
        "session": session.name,
        "inputs_sha256": file_hashes(session),
        "conventions": FRAMES,
        "method": method,
        "verdict": judged.record(),
        "platform": {
            **_transform(axis.T_head_lrf),
            "maps": "lrf to head",
            "axis_covariance": axis.covariance.tolist(),
            "axis_covariance_of": AXIS_PARAMETERS,
        },
        "cameras": cameras,
    }
    if calibration.joint is not None and method == "joint":
        record["sensor"] = _sensor(calibration.joint.solution)
    return record


def _sensor(solution):
    """What a JointSolution says about range finder and pitch, and what it left out in words."""
    sensor = {}
    sigma = solution.sigma
    for name, value in solution.sensor.items():
        if name in sigma:
            sensor[name] = {"value": value, "sigma": sigma[name]}
    sensor["noise"] = solution.noise
    sensor["excluded"] = [str(problem) for problem in solution.excluded]
    return sensor


def _camera(calibration, camera, method, solution):
    """Pose, intrinsics and residuals of a camera.

    Of the joint estimate without the edge bias, from its own boards.
    """
    variant = "joint" if method == "joint" else "half_step"
    obs = calibration.observations[camera, variant]
    edge = edge_residuals_px(obs, solution.transform, solution.model)
    if method == "joint":
        misfit = joint_fit(calibration.joint, [camera])
    else:
        plane = plane_residuals_of(obs, solution)
        misfit = {"edge_rms_px": rms(edge), "plane_rms_mm": 1000 * rms(plane)}
    model = solution.model or calibration.prepared.models[camera]
    lens = dict(zip(LENS_PARAMETERS, model.parameters.tolist(), strict=True))
    return {
        "maps": f"{obs.source} to {obs.camera}",
        **_transform(solution.transform),
        "sigma": dict(
            zip(solution.names[:6], solution.trusted_sigma[:6].tolist(), strict=True)
        ),
        "covariance": solution.trusted[:6, :6].tolist(),
        "intrinsics": {"width": model.width, "height": model.height, **lens},
        "converged": bool(solution.converged),
        "unobservable": list(solution.unobservable),
        **misfit,
        "n_crossings": len(edge),
        "placements": obs.all_placements.tolist(),
    }


def _transform(transform):
    return {
        "matrix": transform.as_matrix().tolist(),
        "rotvec_rad": transform.rotation.as_rotvec().tolist(),
        "translation_m": transform.translation.tolist(),
    }


def file_hashes(session: Session) -> dict[str, str]:
    """SHA-256 of every file that a session was read from, by its path within it.

    Of no other that lies there.
    """
    stated = {session.path / name for name in FILES if os.path.lexists(session.path / name)}
    images = {record.file for record in session.image_records}
    hashes = {}
    for file in sorted(stated | images):
        with opened(file, session.path) as stream:
            digest = hashlib.sha256(stream.read())
        hashes[file.relative_to(session.path).as_posix()] = digest.hexdigest()
    return hashes


def write_calibration(path: str | Path, record: dict) -> None:
    """Write a calibration as JSON, NaN as null.

    Parameters
    ----------
    path : path-like
    record : dict
        Of :func:`calibration_record`.

    Raises
    ------
    ValueError
        If it cannot be written.
    """
    plain = json.loads(json.dumps(record), parse_constant=lambda name: None)
    with whole(path) as draft:
        draft.write_text(json.dumps(plain, indent=1) + "\n")
