"""Open a session, check it, and hand out its sweeps and images."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.board import Board
from lrfcal_lib.session.common import SessionError, naming, read_bytes, read_json, read_table, reading, short
from lrfcal_lib.session.files import (
    DROPPED,
    EDGE_COLUMNS,
    IMAGE_COLUMNS,
    EdgePick,
    ImageRecord,
    check_image_size,
    missing_parts,
    read_edges,
    read_images,
    read_scans,
    size_in_header,
    unfinished_of,
)
from lrfcal_lib.session.stated import SCHEMA, CameraInfo, LrfInfo, parse_session
from lrfcal_lib.session.telegrams import INDEX_COLUMNS, TelegramLog, other_than_stated

# tables of a session: columns, rows of the same ... follow each other in time, ... stands there once
ORDERED = {
    "lrf/index.csv": (INDEX_COLUMNS, ("placement",), ("offset",)),
    "images.csv": (IMAGE_COLUMNS, ("camera", "placement", "purpose"), ("file",)),
    "edges.csv": (EDGE_COLUMNS, (), ("camera", "file", "edge")),
}


@dataclass(frozen=True)
class Sweep:
    """The scan lines of one placement of the board.

    Attributes
    ----------
    placement : int
    ranges : ndarray, shape (L, B)
        Metres, in the order of acquisition; NaN where nothing came back or nothing was recorded.
    bearings : ndarray, shape (B,)
        Radians, ascending; 0 right, pi/2 ahead.
    pitch : ndarray, shape (L,)
        Radians; positive lifts the view.
    time_s : ndarray, shape (L,)
        NaN where unknown.
    intensities : ndarray, shape (L, B), or None
    """

    placement: int
    ranges: np.ndarray
    bearings: np.ndarray
    pitch: np.ndarray
    time_s: np.ndarray
    intensities: np.ndarray | None = None


@dataclass(frozen=True)
class Session:
    """A recorded session; the arrays are read when it is opened, the images when they are asked for.

    Attributes
    ----------
    path : Path
    name, licence, source : str
        `source` says where the recording came from.
    simulated : bool
    board : Board
    lrf : LrfInfo
    T_head_lrf : RigidTransform or None
        The platform as its maker or a tape measure states it.
    platform_sigma : tuple of float
        How well: standard deviations of the axis' direction (radians) and offset (metres). Where nobody states them,
        0.5 deg and 10 mm are assumed: what a set square and a ruler give.
    cameras : dict of str to CameraInfo
    placements : tuple of int
        All that the session states, also those without data.
    image_records : tuple of ImageRecord
    picks : tuple of EdgePick
    reference : dict
        Results other people published about this recording; free form, never used in an estimate.
    problems : tuple of str
        What is missing without making the rest useless, such as a placement without scan lines.
    telegrams : TelegramLog or None
        What became of the recorded telegrams; None for a session of scan lines.
    """

    path: Path
    name: str
    licence: str
    source: str
    simulated: bool
    board: Board
    lrf: LrfInfo
    T_head_lrf: RigidTransform | None
    platform_sigma: tuple[float, float]
    cameras: dict[str, CameraInfo]
    placements: tuple[int, ...]
    image_records: tuple[ImageRecord, ...]
    picks: tuple[EdgePick, ...]
    reference: dict
    problems: tuple[str, ...]
    scans: dict[str, np.ndarray] = field(repr=False)
    telegrams: TelegramLog | None = field(default=None, repr=False)

    def sweep(self, placement):
        """The scan lines of a placement.

        Parameters
        ----------
        placement : int

        Returns
        -------
        Sweep

        Raises
        ------
        SessionError
            If the placement is not in the session, or has no scan line with a range.
        """
        if placement not in self.placements:
            raise SessionError(f"{self.path}: no placement {placement}; the session has {short(self.placements)}")
        rows = self.scans["placement"] == placement
        picked = {k: v[rows] for k, v in self.scans.items() if k in ("ranges", "pitch", "time_s", "intensities")}
        if not np.isfinite(picked["ranges"]).any():
            raise SessionError(f"{self.path}: placement {placement} has {rows.sum()} scan lines and no range in them")
        return Sweep(int(placement), bearings=self.scans["bearings"], **picked)

    def images(self, camera=None, placement=None, purpose=None):
        """The records of images that match all that is given, in the order of images.csv.

        Parameters
        ----------
        camera : str, optional
        placement : int, optional
        purpose : str, optional

        Returns
        -------
        tuple of ImageRecord
        """
        wanted = {"camera": camera, "placement": placement, "purpose": purpose}
        wanted = {k: v for k, v in wanted.items() if v is not None}
        return tuple(r for r in self.image_records if all(getattr(r, k) == v for k, v in wanted.items()))

    def read_image(self, record):
        """The pixels of an image.

        Parameters
        ----------
        record : ImageRecord

        Returns
        -------
        ndarray of uint8, shape (height, width, 3)
            Blue, green, red.

        Raises
        ------
        SessionError
            If the file cannot be decoded or has another size than the camera.
        """
        camera, data = self.cameras[record.camera], read_bytes(record.file, self.path)
        check_image_size(record.file, size_in_header(record.file, data), camera)
        with reading(record.file, "cannot be decoded; remove its row from images.csv or restore the file"):
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            shape = image.shape  # there is none of an image that is None
        check_image_size(record.file, shape[1::-1], camera)
        return image

    @property
    def scene_placements(self):
        """Placements that show a scene to be rebuilt, not the board: their images have the purpose 'scene'."""
        scenes = {record.placement for record in self.images(purpose="scene")}
        return tuple(p for p in self.placements if p in scenes)

    @property
    def board_placements(self):
        """All other placements."""
        scenes = self.scene_placements
        return tuple(p for p in self.placements if p not in scenes)

    def telegram_report(self, placement=None):
        """What became of the recorded telegrams: counts, CRC failures, special values by reason.

        Parameters
        ----------
        placement : int, optional
            All by default.

        Returns
        -------
        dict
            See :meth:`lrfcal_lib.session.telegrams.TelegramLog.report`.

        Raises
        ------
        SessionError
            If the session holds scan lines instead of telegrams, or has no such placement.
        """
        if self.telegrams is None:
            raise SessionError(f"{self.path}: recorded as lrf/scans.npz; only lrf/telegrams.bin tells about telegrams")
        if placement is not None and placement not in self.placements:
            raise SessionError(f"{self.path}: no placement {placement}; the session has {short(self.placements)}")
        return self.telegrams.report(placement)

    def sweep_direction(self, placement):
        """Sign of the pitch motion over a sweep: +1 upwards, -1 downwards, 0 for scans at one pitch."""
        pitch = self.sweep(placement).pitch
        moved = np.nanmedian(pitch[-(len(pitch) // 4 + 1) :]) - np.nanmedian(pitch[: len(pitch) // 4 + 1])
        return int(np.sign(moved)) if abs(moved) > 1e-4 else 0


def open_session(path):
    """Open a session and check all of it.

    Parameters
    ----------
    path : path-like
        The session's folder.

    Returns
    -------
    Session

    Raises
    ------
    SessionError
        With the file, the value and the remedy, for anything that makes the session unusable. What only takes a part
        away (a placement without scan lines) is in `Session.problems`.
    """
    path = Path(path)
    data = read_json(path / "session.json", path)
    if data.get("schema") != SCHEMA:
        raise SessionError(f"{path / 'session.json'}: schema is {data.get('schema')!r}, this version reads '{SCHEMA}'")
    with naming(path / "session.json"):
        stated = parse_session(data)
        unfinished = unfinished_of(data)
        scans, log = read_scans(path, data["rig"]["lrf"].get("file"))
    records = read_images(path, stated, unfinished)
    picks = read_edges(path, stated, records)
    problems = missing_parts(stated["placements"], scans, records, stated["cameras"], unfinished)
    problems += () if log is None else (*log.problems, *other_than_stated(scans, stated["lrf"]))
    found = {"image_records": records, "picks": picks, "problems": problems, "scans": scans, "telegrams": log}
    return Session(path=path, **found, **stated)


def validate(path):
    """Everything that is wrong with a session, as sentences.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    list of str
        Empty for a sound session. The first entry is what keeps the session from being opened, if anything does.
    """
    try:
        session = open_session(path)
    except SessionError as error:
        return [str(error)]
    found = [*session.problems, *_disorder(session)]
    for record in session.image_records:
        try:
            session.read_image(record)
        except SessionError as error:
            found.append(str(error))
    return found


def _disorder(session):
    """What two writers, or hands, do to tables: time that runs back within a placement, rows that stand there twice."""
    for name, (columns, group, once) in ORDERED.items():
        file, last, seen = session.path / name, {}, {}
        rows = read_table(file, columns, session.path, torn=True)[0] if os.path.lexists(file) else ()
        for line, row in enumerate(rows, start=2):
            where, what = f"{file} line {line}", tuple(row[key] for key in once)
            if what in seen:
                yield f"{where}: {', '.join(what)} stands in line {seen[what]} already; remove one of them"
            seen.setdefault(what, line)
            key = tuple(row[key] for key in group)
            if row.get("t_s") and row["placement"] and row.get("purpose") != DROPPED:
                time = float(row["t_s"])
                if time < last.get(key, -math.inf):
                    back = f"t_s runs back from {last[key]:.9g} to {time:.9g}"
                    yield f"{where}: {back}: two writers at once? Record the placement again"
                last[key] = time
