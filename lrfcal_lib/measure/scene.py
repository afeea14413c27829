"""A scene recorded with a calibrated rig: a coloured cloud of every station, and its files.

A station is one place where the rig stood: a sweep and the images taken there.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from lrfcal_lib.calibrate.cloud import Cloud, join, write_ply
from lrfcal_lib.calibrate.clouds import station_of, sweep_blocks
from lrfcal_lib.calibrate.painting import View
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.measure.cloud_files import write_pcd
from lrfcal_lib.measure.e57 import E57Writer, new_guid
from lrfcal_lib.measure.features import with_sigma
from lrfcal_lib.measure.lengths import SceneFeatures, features_of, for_page
from lrfcal_lib.measure.stations import Joined, joined_cloud, placed
from lrfcal_lib.plots.interactive import MOST_POINTS, rig_lines, scene_page
from lrfcal_lib.preprocess.closing_scan import closing_of
from lrfcal_lib.session.faults import repeated_scans
from lrfcal_lib.session.read import Session, Sweep
from lrfcal_lib.session.write import whole

DARKEST = 48  # grey of the weakest echo among points that no image saw
BRIGHTEST = 208
COMPARED = 100_000  # echoes that tell which are weak and strong
AT_REST_S = 0.1  # no head moves on, settles and is scanned again in less


def stations_of(session: Session) -> tuple[int, ...]:
    """The stations of a session.

    Parameters
    ----------
    session : Session

    Returns
    -------
    tuple of int
        Placements, in order.

    Raises
    ------
    ValueError
        If there is none, if two are copies, or the rig moved during one of them.
    """
    numbers = session.scene_placements
    if not numbers:
        raise ValueError(
            f"{session.path}: no placement has an image of purpose 'scene' in images.csv, and "
            "without images nothing can be coloured: record one with 'record --scene'"
        )
    for fault in repeated_scans(session):
        if set(fault.placements) & set(numbers):
            raise ValueError(f"{session.path}: a station stands there twice: {fault.words}")
    for number in numbers:
        _refuse_moved(session, number)
    return numbers


def _refuse_moved(session, number):
    """ValueError for a station during which the rig, or the head within a scan, moved."""
    sweep = session.sweep(number)
    again = "record it again"
    closing = closing_of(sweep)
    if closing is not None and closing.moved:
        raise ValueError(
            f"{session.path}: station {number} moved while it was recorded: {closing}: {again}"
        )
    steps = np.abs(np.diff(sweep.time_s))[np.diff(sweep.pitch) != 0]
    if not session.continuous and len(steps) and np.nanmedian(steps) < AT_REST_S:
        raise ValueError(
            f"{session.path}: station {number} was recorded while the head moved: its scan lines "
            f"follow each other within {1000 * np.nanmedian(steps):.0f} ms, each at another "
            f"pitch, and rig.continuous of session.json is not true: state it, or {again}"
        )


def colored_blocks(
    session: Session, rig: CalibratedRig, sweep: Sweep, views: list[View]
) -> Iterator[Cloud]:
    """The coloured points of a station in its platform frame, block by block.

    Parameters
    ----------
    session : Session
    rig : CalibratedRig
    sweep, views
        Of :func:`lrfcal_lib.calibrate.clouds.station_of`.

    Returns
    -------
    iterator of Cloud
        Points that no image saw are grey, by intensity where the sensor has it.
    """
    blocks = sweep_blocks(session, rig.for_scenes, sweep, views)
    intensities = sweep.intensities
    if intensities is None:
        return blocks
    subset = intensities.ravel()[:: 1 + intensities.size // COMPARED]
    levels = np.nanpercentile(subset, [2, 98])
    return (_shaded(cloud, levels) for cloud in blocks)


def _shaded(cloud, levels):
    """A Cloud whose points that no image saw are as bright as their echoes."""
    grey = np.interp(cloud.intensity, levels, [DARKEST, BRIGHTEST])
    shades = np.nan_to_num(grey, nan=DARKEST)[:, None].astype(np.uint8)
    return replace(cloud, colors=np.where(cloud.seen[:, None], cloud.colors, shades))


def station_cloud(session: Session, rig: CalibratedRig, number: int) -> Cloud:
    """A station as one cloud, with the sigma of every point.

    Parameters
    ----------
    session : Session
    rig : CalibratedRig
    number : int

    Returns
    -------
    Cloud
    """
    blocks = colored_blocks(session, rig, *station_of(session, rig, number))
    return join(with_sigma(cloud, rig) for cloud in blocks)


def write_scene(
    folder: Path,
    session: Session,
    rig: CalibratedRig,
    joined: Joined,
    about: str,
    told: Callable[[int], object] = lambda count: None,
    clouds: Mapping[int, Cloud] | None = None,
) -> list[Path]:
    """Write stations as ``scene.ply``, ``scene.pcd``, ``scene.e57`` and ``scene.html``.

    Parameters
    ----------
    folder : Path
    session : Session
    rig : CalibratedRig
    joined : Joined
        The stations, and how they stand in the scene.
    about : str
        Where it is from and whether to trust it, for every file.
    told : callable
        ``told(count)`` is called after every block with the number of its points.
    clouds : dict of int to Cloud, optional
        What :func:`station_cloud` gives for each, where it is there already.

    Returns
    -------
    list of Path

    Raises
    ------
    ValueError
        For a station that cannot be coloured, or a file that cannot be written; every file is
        whole, or as it was before.
    """
    ply, pcd, e57, page = (
        folder / f"scene.{kind}" for kind in ("ply", "pcd", "e57", "html")
    )
    scenes: dict[int, SceneFeatures] = {}
    poses = joined.T_world_station
    with whole(page) as page_draft, whole(e57) as e57_draft:
        with E57Writer(e57_draft, about) as writer:
            blocks = _written(writer, session, rig, joined, told, clouds or {}, scenes)
            write_ply(ply, blocks, [about])
        write_pcd(pcd, ply, [about])
        cameras = {
            name: (rig.camera_at(name, 0.0), camera.model)
            for name, camera in rig.cameras.items()
        }
        shown = joined_cloud({n: scene.cloud for n, scene in scenes.items()}, joined)
        scene_page(
            page_draft,
            shown.points,
            shown.colors,
            shown.seen,
            rig_lines(rig.T_head_lrf, cameras),
            note=about,
            title=f"{session.name}, station {', '.join(map(str, poses))}",
            measuring=for_page(scenes, poses),
        )
    return [ply, pcd, e57, page]


def _written(writer, session, rig, joined, told, clouds, scenes):
    """Blocks of all stations in the frame of the scene; they are in the E57 file already.

    `scenes` take what can be measured in so many points as a page shows.
    """
    poses = joined.T_world_station
    count = sum(np.isfinite(session.sweep(number).ranges).sum() for number in poses)
    every = math.ceil(count / MOST_POINTS)
    for number, pose in poses.items():
        sweep, views = station_of(session, rig, number)
        blocks = (with_sigma(b, rig) for b in colored_blocks(session, rig, sweep, views))
        if number in clouds:
            blocks = [clouds[number]]
        guid = new_guid()
        intensity = sweep.intensities is not None
        thinned = []
        for cloud in writer.scan(f"station {number}", guid, pose, intensity, blocks):
            thinned.append(cloud.rows(slice(None, None, every)))
            told(len(cloud.points))
            yield placed(cloud, pose, joined.covariance[number])
        scenes[number] = features_of(join(thinned), rig, views)
        for view in views:
            name = f"station {number}, {view.camera}, image {view.number}"
            writer.image(name, guid, pose * view.T_camera_platform.inv(), view)
