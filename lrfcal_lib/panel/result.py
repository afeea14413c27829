"""What a recording says at once: its calibration in numbers and words, and what to record next."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lrfcal_lib.evaluate import handed_over
from lrfcal_lib.export import calibration_record, write_calibration
from lrfcal_lib.geometry import DegenerateGeometry
from lrfcal_lib.joint_calibration import calibrate_jointly
from lrfcal_lib.pipeline import calibrate, prepare
from lrfcal_lib.session import open_session
from lrfcal_lib.verdict import YES, judge, sight_of, verdict

METHOD = "line"  # the paper's, beside the joint estimate


@dataclass(frozen=True)
class Result:
    """A calibration.

    Attributes
    ----------
    answer : {'yes', 'with care', 'no'}
        Whether to trust it.
    sentences : tuple of str
    method : str
        Whose poses are handed over; '' where none is.
    poses : dict of str to tuple
        By camera: rotation vector (deg), translation (mm), and their standard deviations, each of shape (3,).
    file : Path or None
        calibration.json.
    calibration : Calibration
    """

    answer: str
    sentences: tuple
    method: str
    poses: dict
    file: Path | None
    calibration: object


def calibrate_recording(path):
    """Calibrate a session that may still be growing, and write ``<session>_calibration/calibration.json`` beside it.

    Parameters
    ----------
    path : path-like
        Folder of the session.

    Returns
    -------
    Result

    Raises
    ------
    ValueError
        If the session cannot be used.
    """
    path = Path(path)
    found = calibrate(open_session(path), [METHOD])
    judged = judge(found)
    if not judged.errors:
        return Result(judged.answer, (*judged.sentences(), "Nothing is written."), "", {}, None, found)
    method = handed_over(found)
    file = path.with_name(f"{path.name}_calibration") / "calibration.json"
    write_calibration(file, calibration_record(found, method, judged))
    return Result(judged.answer, tuple(judged.sentences()), method, poses(found, method), file, found)


def poses(found, method):
    """Poses of the cameras as numbers, see :class:`Result`."""
    out = {}
    for (camera, name), solution in found.solutions.items():
        if name == method:
            sigma, scale = solution.trusted_sigma[:6], np.repeat([np.degrees(1), 1000.0], 3)
            values = scale * np.concatenate([solution.transform.rotation.as_rotvec(), solution.transform.translation])
            out[camera] = (values[:3], values[3:], *np.split(scale * sigma, 2))
    return out


def advise(session):
    """What the next placement should add, in a sentence; '' where all is known well enough.

    Parameters
    ----------
    session : Session

    Returns
    -------
    str
    """
    prepared = prepare(session)
    try:
        solution = calibrate_jointly(prepared).solution
    except DegenerateGeometry as error:
        return f"not determined yet: {error}"
    judged = verdict(solution, prepared.models, **sight_of(prepared))
    if judged.answer == YES:
        return ""
    return f"put the {judged.suggestion.words()}" if judged.suggestion else judged.no_suggestion
