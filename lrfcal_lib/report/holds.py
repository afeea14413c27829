"""The command ``check --calibration``: does a calibration still hold, in words."""

from pathlib import Path

from lrfcal_lib.calibrate.calibration_file import load_calibration
from lrfcal_lib.measure.holds import Answer, holds
from lrfcal_lib.session.read import Session
from lrfcal_lib.session.shown import printable

EXIT = {Answer.HOLDS: 0, Answer.UNKNOWN: 2, Answer.MOVED: 3}


def check_calibration(session: Session, calibration: str | Path) -> int:
    """Print whether a calibration still holds for the rig that recorded a session.

    Parameters
    ----------
    session : Session
    calibration : path-like
        ``calibration.json`` of the same rig.

    Returns
    -------
    int
        0 where it holds, 3 where something has moved, 2 where that cannot be told.

    Raises
    ------
    ValueError
        For a calibration or a session that cannot be used.
    """
    held = holds(session, load_calibration(calibration))
    print(*held.sentences(printable(str(calibration))), sep="\n")
    return EXIT[held.answer]
