"""The command ``calibrate``: verdict and poses, ``calibration.json`` and clouds of a session."""

import operator
from functools import partial
from itertools import chain
from pathlib import Path

from lrfcal_lib.calibrate.pipeline import Calibration, calibrate, handed_over
from lrfcal_lib.evaluate.export import calibration_record, write_calibration
from lrfcal_lib.judge.verdict import NO, judge
from lrfcal_lib.measure.cloud_files import cloud_tasks
from lrfcal_lib.session.read import open_session
from lrfcal_lib.session.workers import spread

UNTRUSTED = 3  # exit status of a calibration whose verdict is 'no'


def calibrate_session(path: str | Path, out: str | Path | None = None) -> int:
    """Calibrate a session from the command line: print verdict and poses, write
    ``calibration.json`` and clouds.

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
        print(
            f"{path}: all placements show scenes, and a calibration needs the board: "
            "record three or more placements of the board with the same rig"
        )
        return UNTRUSTED
    calibration = calibrate(session)
    print(*poses_in_words(calibration), sep="\n")
    method = handed_over(calibration)
    if method is None:
        print(*judge(calibration).sentences(), sep="\n")
        return UNTRUSTED
    folder = Path(out or Path("reports", session.path.resolve().name))
    judging = partial(_judged, calibration, method)
    clouds = cloud_tasks(folder, calibration, method)
    *written, (judged, record) = spread(operator.call, [*clouds, judging])
    file = folder / "calibration.json"
    write_calibration(file, record)  # last: where it stands, the clouds do
    print(*judged.sentences(), sep="\n")
    names = [*chain(*reversed(written)), file]
    print("written:", ", ".join(map(str, names)))
    if judged.answer == NO:
        return UNTRUSTED
    return 0


def _judged(calibration, method):
    """The Verdict on a calibration, and its record."""
    judged = judge(calibration, method)
    return judged, calibration_record(calibration, method, judged)


def poses_in_words(calibration: Calibration) -> list[str]:
    """The pose of every camera by every method, and what could not be used, a line each."""
    lines = []
    for (camera, method), solution in calibration.solutions.items():
        values, sigma = solution.shown.round(2)
        lines.append(
            f"{camera:>8} {method:<20} rotation vector {values[:3]} +- {sigma[:3]} deg, "
            f"translation {values[3:]} +- {sigma[3:]} mm"
        )
    return [*lines, *map(str, calibration.prepared.problems + calibration.problems)]
