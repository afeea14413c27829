"""The command ``reconstruct``: coloured clouds of a scene, from its stations and a calibration."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib import __version__
from lrfcal_lib.calibrate.calibration_file import (
    load_calibration,
    refuse_untrusted,
    require_same_rig,
)
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.measure.scene import stations_of, write_scene
from lrfcal_lib.session.progress import Progress
from lrfcal_lib.session.read import Session, open_session
from lrfcal_lib.session.shown import printable


def reconstruct_session(
    path: str | Path,
    calibration: str | Path,
    out: str | Path | None = None,
    untrusted: bool = False,
) -> int:
    """Write the coloured clouds of a scene, each station in its own frame.

    Parameters
    ----------
    path : path-like
        Of the session.
    calibration : path-like
        ``calibration.json`` of the same rig.
    out : path-like, optional
        Folder of ``scene.ply``, ``.pcd``, ``.e57`` and ``.html``; ``reports/<name>`` under the
        current folder by default. Of several stations each has its own in there.
    untrusted : bool
        Also with a calibration whose verdict is 'no', which every file then says.

    Returns
    -------
    int
        0.

    Raises
    ------
    ValueError
        For a calibration or a session that cannot be used, or a file that cannot be written.
    """
    rig = load_calibration(calibration)
    refuse_untrusted(rig, untrusted)
    session = open_session(path)
    require_same_rig(rig, session)
    numbers = stations_of(session)
    folder = Path(out or Path("reports") / Path(path).resolve().name)
    counts = [np.isfinite(session.sweep(number).ranges).sum() for number in numbers]
    told = _told(sum(counts))
    about = about_scene(session, rig)
    for number in numbers:
        place = folder
        if len(numbers) > 1:
            place = folder / f"station_{number}"
        still = {number: RigidTransform.identity()}
        files = write_scene(place, session, rig, still, about, told)
        print(f"station {number}: {', '.join(map(str, files))}", flush=True)
    if len(numbers) > 1:
        print(f"{len(numbers)} stations, each in its own frame; 'merge' joins them")
    return 0


def about_scene(session: Session, rig: CalibratedRig) -> str:
    """Where a cloud is from, and whether to trust it, in a sentence for its files."""
    about = (
        f"session {session.name}, calibration of {rig.session} {rig.date} "
        f"(method {rig.method}), lrfcal {__version__}"
    )
    if rig.answer == "no":
        about = f"UNTRUSTED, the verdict on its calibration is no; {about}"
    return printable(about)


def _told(total) -> Callable[[int], None]:
    """What says now and then how many of so many points are done."""
    progress = Progress()
    done = 0

    def told(count):
        """So many more are."""
        nonlocal done
        done += count
        if progress.due():
            left = progress.left(done / total)
            print(f"  {done} of {total} points, {left}", flush=True)

    return told
