"""Clouds on disk: PLY and PCD."""

import operator
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from lrfcal_lib import __version__
from lrfcal_lib.calibrate.cloud import COLUMNS, point_type, write_ply
from lrfcal_lib.calibrate.clouds import cloud_blocks
from lrfcal_lib.calibrate.pipeline import Calibration
from lrfcal_lib.measure.features import with_sigma
from lrfcal_lib.session.workers import spread
from lrfcal_lib.session.write import whole

# of a PCD file, as its readers call them
PCD_COLUMNS = COLUMNS | {
    "normals": ("<f4", "normal_x normal_y normal_z"),
    "colors": ("<u4", "rgb"),
}
RGB = np.array([[1 << 16], [1 << 8], [1]], "<u4")  # red, green and blue in one number
POINTS_AT_ONCE = 1_000_000  # that are copied, 60 MB


def write_clouds(folder: str | Path, calibration: Calibration, method: str) -> list[Path]:
    """Write ``cloud.ply`` (the boards) and, where there are scenes, ``scene.ply`` and
    ``scene.pcd``.

    A sigma is what a joint estimate predicts, otherwise the stated noise of ranges.

    Parameters
    ----------
    folder : path-like
    calibration : Calibration
        Its session may be another one of the same rig (``replace`` it in `prepared`), whose scenes
        are then coloured.
    method : str
        Whose camera poses and axis make the clouds.

    Returns
    -------
    list of Path

    Raises
    ------
    ValueError
        For a session that the calibration cannot colour, or a file that cannot be written. Every
        file is whole, or as it was before.
    """
    written = spread(operator.call, cloud_tasks(folder, calibration, method))
    return sum(reversed(written), [])


def cloud_tasks(
    folder: str | Path, calibration: Calibration, method: str
) -> list[Callable[[], list[Path]]]:
    """The clouds that can be had, as work that may be shared.

    Parameters
    ----------
    folder, calibration, method
        See :func:`write_clouds`.

    Returns
    -------
    list of callable
        Each writes one cloud and returns its files; the longest work first.
    """
    prepared = calibration.prepared
    session = prepared.session
    write = partial(_write_cloud, Path(folder), calibration, method)
    tasks: list[Callable[[], list[Path]]] = []
    if session.scene_placements:
        tasks.append(partial(write, scene=True))
    of_another_session = not prepared.scans.keys() <= set(session.placements)
    if prepared.scans and not (tasks and of_another_session):
        tasks.append(partial(write, scene=False))
    return tasks


def _write_cloud(folder, calibration, method, scene):
    """Write the cloud of the scenes or of the boards; its files."""
    blocks = cloud_blocks(calibration, method, scene)
    if method == "joint":
        rig = calibration.rig(method)
        blocks = (with_sigma(block, rig) for block in blocks)
    about = f"session {calibration.prepared.session.name}, method {method}, lrfcal {__version__}"
    ply = folder / ("scene.ply" if scene else "cloud.ply")
    write_ply(ply, blocks, [about])
    if not scene:
        return [ply]
    pcd = folder / "scene.pcd"
    write_pcd(pcd, ply)
    return [ply, pcd]


def write_pcd(path, ply, comments=()):
    """Write what a PLY of :func:`write_ply` holds as binary PCD, with comments in its head.

    ValueError if the file cannot be written.
    """
    stored = point_type(COLUMNS)
    with open(ply, "rb") as source, whole(path) as draft, open(draft, "wb") as file:
        while source.readline() != b"end_header\n":
            pass
        count = (os.path.getsize(ply) - source.tell()) // stored.itemsize
        file.write(_pcd_header(count, comments).encode())
        for start in range(0, count, POINTS_AT_ONCE):
            points = np.fromfile(source, stored, min(POINTS_AT_ONCE, count - start))
            packed = np.empty(len(points), point_type(PCD_COLUMNS))
            for field in COLUMNS:
                packed[field] = points[field] @ RGB if field == "colors" else points[field]
            file.write(packed.tobytes())


def _pcd_header(count, comments):
    """The lines before the points of a PCD file."""
    types = [np.dtype(k) for k, names in PCD_COLUMNS.values() for _ in names.split()]
    told = "".join(f"# {words}\n" for words in comments)
    return (
        f"{told}VERSION 0.7\n"
        f"FIELDS {' '.join(names for _, names in PCD_COLUMNS.values())}\n"
        f"SIZE {' '.join(str(kind.itemsize) for kind in types)}\n"
        f"TYPE {' '.join(kind.kind.upper() for kind in types)}\n"
        f"COUNT{' 1' * len(types)}\n"
        f"WIDTH {count}\n"
        "HEIGHT 1\n"
        "VIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {count}\n"
        "DATA binary\n"
    )
