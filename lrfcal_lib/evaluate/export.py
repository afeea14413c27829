"""Calibrations on disk: the native ``calibration.json``."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

import numpy as np

from lrfcal_lib import __version__
from lrfcal_lib.calibrate.pipeline import calibrate, color_cloud
from lrfcal_lib.calibrate.reconstruct import write_ply
from lrfcal_lib.evaluate.jointly import edge_misses_px, joint_fit
from lrfcal_lib.evaluate.tables import handed_over, plane_residuals_of, rms
from lrfcal_lib.evaluate.verdict import NO, judge
from lrfcal_lib.fit.residuals import edge_residuals_px
from lrfcal_lib.session.read import open_session
from lrfcal_lib.session.stated import FILES, opened

SCHEMA = 1
UNTRUSTED = 3  # exit status of a calibration whose verdict is 'no'
FRAMES = (
    "destination first: p_camera = T_camera_source p_source; metres, radians; "
    "covariances of [w, v]: R <- exp(w) R, t <- t + v"
)


def calibration_record(calibration, method, judged=None):
    """Everything a calibration says, ready for JSON.

    Parameters
    ----------
    calibration : Calibration
    method : str
        The method whose results are handed over; 'joint' brings its own platform, range offset and pitch terms.
    judged : Verdict, optional
        On these results, where :func:`lrfcal_lib.evaluate.verdict.judge` was asked already.

    Returns
    -------
    dict
        Schema, library version, verdict, session with the SHA-256 of its files, frames and units, platform, and for
        each camera its pose, intrinsics, covariance, and residual statistics; with the joint estimate also what it says
        about the sensor.
    """
    prepared, session = calibration.prepared, calibration.prepared.session
    variant = "joint" if method == "joint" else "half_step"
    cameras = {
        camera: _camera(prepared.models[camera], calibration.observations[camera, variant], solution)
        | (_joint_fit(calibration.joint, camera) if method == "joint" else {})
        for (camera, name), solution in calibration.solutions.items()
        if name == method
    }
    axis = calibration.platform.axis_with(method)
    record = {
        "schema": SCHEMA,
        "lrfcal": __version__,
        "session": session.name,
        "inputs_sha256": file_hashes(session),
        "conventions": FRAMES,
        "method": method,
        "verdict": (judged or judge(calibration, method, suggest=False)).record(),
        "platform": _transform(calibration.platform.transform(axis))
        | {
            "maps": "lrf to head",
            "axis_covariance": calibration.platform.parameters()[axis][1].tolist(),
            "axis_covariance_of": AXIS_PARAMETERS,
        },
        "cameras": cameras,
    }
    return record | ({"sensor": _sensor(calibration.joint.solution)} if method == "joint" else {})


def _sensor(solution):
    """What the joint estimate says about range finder and pitch, and what it left out in words."""
    sigma = dict(zip(solution.solution.names, solution.solution.trusted_sigma.tolist(), strict=True))
    named = {name: {"value": solution.sensor[name], "sigma": sigma[name]} for name in solution.sensor if name in sigma}
    return named | {"noise": solution.noise, "excluded": list(solution.excluded.values())}


AXIS_PARAMETERS = ["out_of_scan_plane_rad", "in_scan_plane_rad", "offset_in_scan_plane_m", "offset_across_scan_plane_m"]


def _joint_fit(joint, camera):
    """Residuals as the joint estimate has them: without the edge bias, from the boards where it puts them."""
    return {"edge_rms_px": rms(edge_misses_px(joint, camera)), "plane_rms_mm": joint_fit(joint)["plane_rms_mm"]}


def _camera(model, obs, solution):
    edge = edge_residuals_px(obs, solution.transform, solution.model)
    return {
        "maps": f"{obs.source} to {obs.camera}",
        **_transform(solution.transform),
        "sigma": dict(zip(solution.names[:6], solution.trusted_sigma[:6].tolist(), strict=True)),
        "covariance": solution.trusted[:6, :6].tolist(),
        "intrinsics": _intrinsics(solution.model or model),
        "converged": bool(solution.converged),
        "unobservable": list(solution.unobservable),
        "edge_rms_px": rms(edge),
        "plane_rms_mm": 1000 * rms(plane_residuals_of(obs, solution)),
        "n_crossings": len(edge),
        "placements": obs.all_placements.tolist(),
    }


def _transform(transform):
    return {
        "matrix": transform.as_matrix().tolist(),
        "rotvec_rad": transform.rotation.as_rotvec().tolist(),
        "translation_m": transform.translation.tolist(),
    }


def _intrinsics(model):
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    return {"width": model.width, "height": model.height} | dict(zip(names, model.parameters.tolist(), strict=True))


def file_hashes(session):
    """SHA-256 of every file that a session was read from, by its path within it; of no other that lies there."""
    files = {session.path / name for name in FILES if os.path.lexists(session.path / name)}
    hashes = {}
    for file in sorted(files | {record.file for record in session.image_records}):
        with opened(file, session.path) as stream:
            hashes[file.relative_to(session.path).as_posix()] = hashlib.file_digest(stream, "sha256").hexdigest()
    return hashes


def write_calibration(path, record):
    """Write a calibration as JSON; NaN becomes null.

    Parameters
    ----------
    path : path-like
    record : dict
        Of :func:`calibration_record`.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(_plain(record), indent=1, allow_nan=False) + "\n")


def _plain(value):
    if isinstance(value, dict):
        return {key: _plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def calibrate_session(path, out=None):
    """Calibrate a session from the command line: verdict and poses, ``calibration.json`` and ``cloud.ply``.

    Parameters
    ----------
    path : path-like
        Folder of the session.
    out : path-like, optional
        ``reports/<name>`` under the current folder when left out.

    Returns
    -------
    int
        0, or 3 where the verdict is 'no' (also when no camera could be calibrated and nothing is written).
    """
    found = calibrate(open_session(path))
    folder = Path(out or Path("reports") / Path(path).resolve().name)
    for (camera, method), solution in found.solutions.items():
        scale = np.repeat([np.rad2deg(1.0), 1000.0], 3)
        values, sigma = scale * solution.parameters[:6], scale * solution.trusted_sigma[:6]
        turn, shift = (f"{values[i].round(2)} +- {sigma[i].round(2)}" for i in (slice(0, 3), slice(3, 6)))
        print(f"{camera:>8} {method:<20} rotation vector {turn} deg, translation {shift} mm")
    for key, why in (found.prepared.problems | found.problems).items():
        print(f"{key}: {why}")
    judged = judge(found)
    print(*judged.sentences(), sep="\n")
    if judged.errors:  # otherwise nothing can be handed over
        method = handed_over(found)
        write_calibration(folder / "calibration.json", calibration_record(found, method, judged))
        write_ply(folder / "cloud.ply", color_cloud(found, method))
        print(f"written: {folder / 'calibration.json'}, {folder / 'cloud.ply'}")
    return UNTRUSTED if judged.answer == NO else 0
