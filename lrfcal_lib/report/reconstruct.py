"""The command ``reconstruct``: coloured clouds of a scene, from its stations and a calibration."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lrfcal_lib import __version__
from lrfcal_lib.calibrate.calibration_file import (
    load_calibration,
    refuse_untrusted,
    require_same_rig,
)
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.measure.scene import stations_of, write_scene
from lrfcal_lib.measure.stations import alone
from lrfcal_lib.session.read import Session, open_session
from lrfcal_lib.session.shown import printable


@dataclass(frozen=True)
class SceneAsked:
    """A recorded scene, the rig that recorded it, its stations and the folder for its files."""

    session: Session
    rig: CalibratedRig
    stations: tuple[int, ...]
    folder: Path

    @property
    def about(self) -> str:
        """Where a cloud is from, and whether to trust it, in a sentence for its files."""
        rig = self.rig
        about = (
            f"session {self.session.name}, calibration of {rig.session} {rig.date} "
            f"(method {rig.method}), lrfcal {__version__}"
        )
        if rig.answer == "no":
            about = f"UNTRUSTED, the verdict on its calibration is no; {about}"
        return printable(about)


def open_scene(
    path: str | Path, calibration: str | Path, out: str | Path | None, untrusted: bool
) -> SceneAsked:
    """Read a scene and the calibration that it is to be used with.

    Parameters
    ----------
    path : path-like
        Of the session.
    calibration : path-like
        ``calibration.json`` of the same rig.
    out : path-like or None
        Folder of the files; ``reports/<name>`` under the current folder by default.
    untrusted : bool
        Also with a calibration whose verdict is 'no', which every file then says.

    Returns
    -------
    SceneAsked

    Raises
    ------
    ValueError
        For a calibration or a session that cannot be used.
    """
    rig = load_calibration(calibration)
    refuse_untrusted(rig, untrusted)
    session = open_session(path)
    require_same_rig(rig, session)
    folder = Path(out or Path("reports", session.path.resolve().name))
    return SceneAsked(session, rig, stations_of(session), folder)


def reconstruct_session(
    path: str | Path,
    calibration: str | Path,
    out: str | Path | None = None,
    untrusted: bool = False,
) -> int:
    """Write the coloured clouds of a scene, each station in its own frame.

    Parameters
    ----------
    path, calibration, out, untrusted
        See :func:`open_scene`. Of several stations each has its own folder in `out`.

    Returns
    -------
    int
        0.

    Raises
    ------
    ValueError
        For a calibration or a session that cannot be used, or a file that cannot be written.
    """
    scene = open_scene(path, calibration, out, untrusted)
    total = sum(np.isfinite(scene.session.sweep(n).ranges).sum() for n in scene.stations)
    several = len(scene.stations) > 1
    with tqdm(total=total, unit=" points", unit_scale=True, disable=None) as bar:
        for number in scene.stations:
            place = scene.folder
            if several:
                place = scene.folder / f"station_{number}"
            files = write_scene(
                place, scene.session, scene.rig, alone(number), scene.about, bar.update
            )
            bar.clear()
            print(f"station {number}: {', '.join(map(str, files))}", flush=True)
    if several:
        print(f"{len(scene.stations)} stations, each in its own frame; 'merge' joins them")
    return 0
