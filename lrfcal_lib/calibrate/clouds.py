"""Coloured clouds of a session: its sweeps and images, seen by a calibrated rig."""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.ndimage import find_objects, maximum_filter

from lrfcal_lib.calibrate.cloud import Cloud, join
from lrfcal_lib.calibrate.painting import View
from lrfcal_lib.calibrate.pipeline import Calibration, handed_over
from lrfcal_lib.calibrate.reconstruct import reconstruct
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.preprocess.closing_scan import without_closing
from lrfcal_lib.session.files import short
from lrfcal_lib.session.read import Session, Sweep

MARGIN = 20  # scan lines and beams about a board that are worked on with it


def color_cloud(
    calibration: Calibration, method: str | None = None, scene: bool = False
) -> Cloud:
    """Sweeps of a session as one coloured cloud in the platform frame.

    Parameters
    ----------
    calibration, method, scene
        See :func:`cloud_blocks`.

    Returns
    -------
    Cloud
    """
    return join(cloud_blocks(calibration, method, scene))


def cloud_blocks(
    calibration: Calibration, method: str | None = None, scene: bool = False
) -> Iterator[Cloud]:
    """Coloured points of a session, block by block.

    Parameters
    ----------
    calibration : Calibration
    method : str, optional
        Whose camera poses and axis make the cloud; what is handed over by default.
    scene : bool
        The sweeps of scenes, with all their returns, instead of the boards.

    Yields
    ------
    Cloud
        Each sweep takes its colours from the images of its own placement, of all cameras that see
        the point.

    Raises
    ------
    ValueError
        If there is no such sweep, or no method.
    """
    method = method or handed_over(calibration)
    if method is None:
        raise ValueError(
            "no camera was calibrated that could colour a cloud: see `problems` of the calibration"
        )
    session = calibration.prepared.session
    if scene:
        what = "a scene"
        masks = dict.fromkeys(session.scene_placements)
    else:
        what = "the board"
        masks = {p: scan.mask for p, scan in calibration.prepared.scans.items()}
    if not masks:
        raise ValueError(f"{session.name}: no sweep of {what} to colour")
    rig = calibration.rig(method)
    for placement, mask in masks.items():
        sweep = session.sweep(placement)
        if mask is None:
            sweep, _ = without_closing(sweep)
        else:
            about = maximum_filter(mask.astype(int), 2 * MARGIN + 1)
            ((lines, beams),) = find_objects(about)
            sweep = sweep.part(lines, beams)
            mask = mask[lines, beams]
        yield from sweep_blocks(
            session, rig, sweep, views_of(session, rig, placement), mask
        )


def sweep_blocks(
    session: Session,
    rig: CalibratedRig,
    sweep: Sweep,
    views: Sequence[View],
    mask: np.ndarray | None = None,
) -> Iterator[Cloud]:
    """A sweep of a session as a rig sees it: :func:`reconstruct` with all that both know."""
    return reconstruct(
        sweep,
        views,
        rig.T_head_lrf,
        rig.corrections,
        lrf=session.lrf,
        continuous=session.continuous,
        mask=mask,
    )


def station_of(
    session: Session, rig: CalibratedRig, number: int
) -> tuple[Sweep, list[View]]:
    """A place where the rig stood and recorded a scene, with its images posed.

    Parameters
    ----------
    session : Session
    rig : CalibratedRig
        That recorded it.
    number : int
        Placement.

    Returns
    -------
    sweep : Sweep
        Without the scan that closed it.
    views : list of View

    Raises
    ------
    ValueError
        For images that the rig cannot pose or that have another size.
    """
    sweep, _ = without_closing(session.sweep(number))
    return sweep, views_of(session, rig.for_scenes, number)


def views_of(session: Session, rig: CalibratedRig, placement: int) -> list[View]:
    """The images of a placement as a rig poses them; without those of which no pitch is known.

    Parameters
    ----------
    session : Session
    rig : CalibratedRig
    placement : int

    Returns
    -------
    list of View

    Raises
    ------
    ValueError
        Where there are images and none of them can be posed.
    """
    records = session.images(placement=placement)
    of_rig = [record for record in records if record.camera in rig.cameras]
    views = []
    for record in of_rig:
        camera = rig.cameras[record.camera]
        pitch = 0.0
        if camera.mount == "head":
            pitch = float(rig.corrections.pitch(placement, record.pitch))
        if np.isfinite(pitch):
            views.append(
                View(
                    number=session.image_records.index(record),
                    camera=record.camera,
                    T_camera_platform=rig.camera_at(record.camera, pitch),
                    model=camera.model,
                    image=session.read_image(record),
                    pitch=pitch,
                )
            )
    if records and not views:
        why = "the pitch of none is known: state pitch_deg in images.csv"
        if not of_rig:
            cameras = short(sorted({record.camera for record in records}))
            why = (
                f"they are of {cameras}, the calibration by '{rig.method}' poses "
                f"{', '.join(rig.cameras) or 'no camera'}: take that of the same rig"
            )
        raise ValueError(
            f"{session.name}, placement {placement}: its {len(records)} images cannot colour it; "
            f"{why}"
        )
    return views
