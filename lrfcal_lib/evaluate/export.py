"""Calibrations on disk: ``calibration.json``."""

import hashlib
import json
import os
import re
from datetime import UTC, datetime
from pathlib import Path

from lrfcal_lib import __version__
from lrfcal_lib.calibrate.calibration_file import FORMULAS, KIND, SCHEMA, rig_record
from lrfcal_lib.calibrate.pipeline import Calibration
from lrfcal_lib.evaluate.joint_tables import joint_fit
from lrfcal_lib.fit.robust import rms
from lrfcal_lib.judge.verdict import Verdict, judge
from lrfcal_lib.model.geometry import POSE_NAMES
from lrfcal_lib.session.files import read_bytes
from lrfcal_lib.session.read import Session
from lrfcal_lib.session.stated import FILES
from lrfcal_lib.session.write import whole
from lrfcal_lib.solvers import left_out_residuals

# numbers one below the other; no text of JSON has a line end
ROW = re.compile(r"\[\n\s+(?:-?[\d.]\S*|null)(?:\n\s+(?:-?[\d.]\S*|null))*\n\s+\]")


def calibration_record(
    calibration: Calibration, method: str, judged: Verdict | None = None
) -> dict:
    """Everything that a calibration says about the results of a method, ready for JSON.

    What :func:`lrfcal_lib.calibrate.calibration_file.load_calibration` reads, and for people: the
    formulas, residual statistics of each camera, what 'joint' says about the sensor, library
    version, and SHA-256 of the session's files. Results come first.

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
    judged = judged or judge(calibration, method, suggest=False)
    record = {
        "schema": SCHEMA,
        "kind": KIND,
        "session": session.name,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "method": method,
        "verdict": judged.record(),
        **rig_record(calibration.rig(method)),
    }
    for camera, solution in calibration.cameras(method).items():
        record["cameras"][camera] |= _camera(calibration, camera, method, solution)
    if method == "joint":
        record["sensor"] = _sensor(calibration.joint.solution)
    # numbers of this recording stand behind those of the rig, hashes last
    uncertainty = record.pop("uncertainty")
    return record | {
        "uncertainty": uncertainty,
        "formulas": FORMULAS,
        "lrfcal": __version__,
        "inputs_sha256": file_hashes(session),
    }


def _sensor(solution):
    """What a JointSolution says about range finder and pitch, and what it left out in words."""
    sigma = solution.sigma
    return {
        name: {"value": value, "sigma": sigma[name]}
        for name, value in solution.sensor.items()
        if name in sigma
    } | {"noise": solution.noise, "excluded": [*map(str, solution.excluded)]}


def _camera(calibration, camera, method, solution):
    """How well a camera is known, and its residuals.

    Of the joint estimate without the edge bias, from its own boards.
    """
    obs = calibration.observations[camera, "joint" if method == "joint" else "half_step"]
    edge, plane = left_out_residuals([(obs, solution)])
    misfit = {"edge_rms_px": rms(edge), "plane_rms_mm": 1000 * rms(plane)}
    if method == "joint":
        misfit = joint_fit(calibration.joint, [camera])
    return {
        "maps": f"{obs.source} to {obs.camera}",
        "sigma": dict(zip(POSE_NAMES, solution.trusted_sigma.tolist(), strict=False)),
        "covariance": solution.trusted[:6, :6].tolist(),
        "converged": bool(solution.converged),
        "unobservable": solution.unobservable,
        **misfit,
        "n_crossings": len(edge),
        "placements": obs.all_placements.tolist(),
    }


def file_hashes(session: Session) -> dict[str, str]:
    """SHA-256 of every file that a session was read from, by its path within it.

    Of no other that lies there.
    """
    stated = filter(os.path.lexists, [session.path / name for name in FILES])
    images = {record.file for record in session.image_records}
    return {
        file.relative_to(session.path).as_posix(): hashlib.sha256(
            read_bytes(file, session.path)
        ).hexdigest()
        for file in sorted(images.union(stated))
    }


def write_calibration(path: str | Path, record: dict) -> None:
    """Write a calibration as JSON, a row of numbers a line, NaN as null.

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
    text = ROW.sub(lambda row: " ".join(row[0].split()), json.dumps(plain, indent=1))
    with whole(path) as draft:
        draft.write_text(text + "\n")
