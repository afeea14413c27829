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
from lrfcal_lib.verdict import YES, verdict

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
    answer, sentences = _judged(found)
    try:
        method = handed_over(found)
    except ValueError as error:
        return Result("no", (*sentences, f"Nothing is written: {error}."), "", {}, None, found)
    file = path.with_name(f"{path.name}_calibration") / "calibration.json"
    write_calibration(file, calibration_record(found, method))
    return Result(answer, sentences, method, poses(found, method), file, found)


def _judged(found):
    """Answer and sentences; without a joint estimate why there is none."""
    if found.joint is None:
        why = [f"{' '.join(key)}: {text}" for key, text in found.problems.items()] or ["no image shows the board"]
        return "no", ("This calibration cannot be trusted: " + "; ".join(why) + ".",)
    judged = verdict(found.joint.solution, found.prepared.models, **_limits(found.prepared))
    return judged.answer, tuple(judged.sentences())


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
    judged = verdict(solution, prepared.models, **_limits(prepared))
    if judged.answer == YES:
        return ""
    return f"put the {judged.suggestion.words()}" if judged.suggestion else judged.no_suggestion


def _limits(prepared):
    """What the rig can see, for suggestions."""
    pattern = prepared.board.pattern
    features = None if pattern is None else pattern.points()
    return {"field_of_view": prepared.session.lrf.field_of_view, "features": features}
