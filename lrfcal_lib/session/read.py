"""Open a session, check it, and hand out its sweeps and images."""

import math
import os
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.board import Board
from lrfcal_lib.session import stated
from lrfcal_lib.session.faults import dark_image, faults_of_dark, faults_of_files
from lrfcal_lib.session.images import check_image_size
from lrfcal_lib.session.scans import read_scans
from lrfcal_lib.session.shown import printable
from lrfcal_lib.session.stated import (
    CameraInfo,
    LrfInfo,
    SessionError,
    naming,
    reading,
    short,
)
from lrfcal_lib.session.tables import read_table, whole_number
from lrfcal_lib.session.telegrams import (
    INDEX_COLUMNS,
    TelegramLog,
    other_than_stated,
)

IMAGE_COLUMNS = ("t_s", "camera", "file", "placement", "pitch_deg", "purpose")
EDGE_COLUMNS = ("camera", "file", "edge", "u1", "v1", "u2", "v2")
PLATFORM_COLUMNS = ("t_s", "commanded_deg", "measured_deg")
PURPOSES = ("intrinsics", "board", "scene")
DROPPED = "dropped"  # purpose of an image of a placement that was recorded again, or never finished


@dataclass(frozen=True)
class ImageRecord:
    """One row of images.csv.

    `file` is where the image is now; `placement` -1 where it belongs to none; `pitch` of the
    platform (radians) and `time_s` are NaN where unknown; `purpose` one of 'intrinsics', 'board',
    'scene'.
    """

    camera: str
    file: Path
    placement: int
    pitch: float
    time_s: float
    purpose: str


@dataclass(frozen=True)
class EdgePick:
    """An edge of the board picked by hand in an image; overrides the detector.

    `ends`, shape (2, 2), are two pixels on the edge as recorded (distorted), far apart.
    """

    camera: str
    file: Path
    edge: str
    ends: np.ndarray


def missing_parts(placements, scans, records, cameras, unfinished=None):
    """What a session states and does not hold, as sentences; the rest can be used."""
    scanned = set(scans["placement"][np.isfinite(scans["ranges"]).any(axis=1)].tolist())
    shot = {(record.camera, record.placement) for record in records}
    unfinished = unfinished or ()
    problems = []
    for placement in placements:
        if placement not in scanned:
            problems.append(f"placement {placement}: no scan line with a range")
    for placement in unfinished:
        again = (
            "its recording was not finished, ignored; 'record --resume' records it again"
        )
        problems.append(f"placement {placement}: {again}")
    for placement in sorted(scanned - {*placements, *unfinished}):
        unknown = "in the scan lines but not in session.json, ignored"
        problems.append(f"placement {placement}: {unknown}")
    for placement in placements:
        for camera in cameras:
            if (camera, placement) not in shot:
                problems.append(f"placement {placement}: no image of camera '{camera}'")
    return tuple(problems)


def inside(path, name, where):
    """The file a session names; it must lie inside the session's folder (no ``..`` or absolute
    path).
    """
    windows = PureWindowsPath(name)
    posix = PurePosixPath(name)
    if (
        windows.drive
        or windows.root
        or posix.is_absolute()
        or ".." in windows.parts
        or not posix.parts
    ):
        raise SessionError(
            f"{path}: {where} must stay inside the session's folder, got '{name}'"
        )
    if not name.isprintable():
        raise SessionError(f"{path}: {where} must be printable, got '{name}': rename it")
    return path / name


def read_images(path, facts, unfinished=None):
    """The records of images.csv; every image must exist, be complete and have its camera's size.

    Images of unfinished placements and dropped ones are left out, and a last row that is cut off
    while recording.
    """
    file = path / "images.csv"
    cameras = facts["cameras"]
    if not cameras and not os.path.lexists(file):
        return ()
    out = []
    lines = {}  # in which each file stands
    skipped = {str(placement) for placement in unfinished or ()}
    rows = read_table(file, IMAGE_COLUMNS, path, torn=unfinished is not None)[0]
    for number, row in enumerate(rows, start=2):
        if row["purpose"] == DROPPED or row["placement"] in skipped:
            continue
        with naming(f"{file} line {number}"):
            if row["camera"] not in cameras:
                raise ValueError(
                    f"no camera '{row['camera']}' in session.json, which has {short(cameras)}"
                )
            if row["purpose"] not in PURPOSES:
                raise ValueError(
                    f"purpose must be one of {short(PURPOSES)}, got '{row['purpose']}'"
                )
            placement = whole_number(row["placement"], "placement")
            if placement not in (*facts["placements"], -1):
                raise ValueError(f"placement {placement} is not in session.json")
            pitch, time = (float(row[k] or "nan") for k in ("pitch_deg", "t_s"))
            target = inside(path, row["file"], "images.csv: file")
            first = lines.setdefault(target, number)
            if first < number:
                already = f"stands in line {first} already; remove one of the two rows"
                raise ValueError(f"'{row['file']}' {already}")
            out.append(
                ImageRecord(
                    row["camera"],
                    target,
                    placement,
                    math.radians(pitch),
                    time,
                    row["purpose"],
                )
            )
            check_image_size(
                target, stated.read_bytes(target, path), cameras[row["camera"]]
            )
    return tuple(out)


def read_edges(path, facts, records):
    """The picks of edges.csv, if there is one, for images and edges that the session knows."""
    file = path / "edges.csv"
    if not os.path.lexists(file):
        return ()
    out = []
    known = {(record.camera, record.file) for record in records}
    edges = facts["board"].edges
    rows = read_table(file, EDGE_COLUMNS, path)[0]
    for number, row in enumerate(rows, start=2):
        with naming(f"{file} line {number}"):
            target = inside(path, row["file"], "edges.csv: file")
            if (row["camera"], target) not in known:
                raise ValueError(
                    f"images.csv has no '{row['file']}' of camera '{row['camera']}'"
                )
            if row["edge"] not in edges:
                raise ValueError(f"edge must be one of {short(edges)}, got '{row['edge']}'")
            ends = np.array([float(row[k]) for k in EDGE_COLUMNS[3:]]).reshape(2, 2)
            if not np.isfinite(ends).all():
                raise ValueError(
                    f"u1, v1, u2, v2 must be 4 finite numbers, got {ends.ravel().tolist()}"
                )
            if np.linalg.norm(ends[1] - ends[0]) < 5:
                raise ValueError(
                    f"the two pixels {ends.tolist()} are too close for a direction: pick them "
                    "far apart"
                )
            out.append(EdgePick(row["camera"], target, row["edge"], ends))
    return tuple(out)


# radians from the first to the last quarter of a sweep; 0.006 deg, below the step of any head
SMALLEST_MOVE = 1e-4
# tables of a session: columns, rows of the same ... follow each other in time, ... stands there
# once
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
    ranges : ndarray, shape (L, B)
        Metres, in the order of acquisition; NaN where nothing came back or nothing was recorded.
    bearings : ndarray, shape (B,)
        Radians, ascending; 0 right, pi/2 ahead.
    pitch, time_s : ndarray, shape (L,)
        Radians, positive lifts the view; seconds, NaN where unknown.
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
    """A recorded session; the arrays are read when it is opened, the images when they are asked
    for.

    Attributes
    ----------
    name, licence, source : str
        `source` says where the recording came from.
    board : Board
    lrf : LrfInfo
    T_head_lrf : RigidTransform or None
        The platform as its maker or a tape measure states it.
    platform_sigma : tuple of float
        How well: standard deviations of the axis' direction (radians) and offset (metres). Where
        nobody states them, 0.5 deg and 10 mm are assumed: what a set square and a ruler give.
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
    continuous : bool
        The head moved on within a scan line: its pitch is that of the middle beam.
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
    continuous: bool = False

    def __repr__(self):
        cameras = ", ".join(self.cameras) or "none"
        boards = f"{len(self.board_placements)} placements of {self.board.name}"
        return f"Session({self.name}: {boards}, LRF {self.lrf.model}, cameras {cameras})"

    def sweep(self, placement: int) -> Sweep:
        """The scan lines of a placement.

        Parameters
        ----------
        placement

        Raises
        ------
        SessionError
            If it is not in the session, or has no scan line with a range.
        """
        if placement not in self.placements:
            raise SessionError(
                f"{self.path}: no placement {placement}; the session has {short(self.placements)}"
            )
        rows = self.scans["placement"] == placement
        ranges = self.scans["ranges"][rows]
        if not np.isfinite(ranges).any():
            raise SessionError(
                f"{self.path}: placement {placement} has {rows.sum()} scan lines and no range in "
                "them"
            )
        intensities = self.scans.get("intensities")
        if intensities is not None:
            intensities = intensities[rows]
        return Sweep(
            placement=int(placement),
            ranges=ranges,
            bearings=self.scans["bearings"],
            pitch=self.scans["pitch"][rows],
            time_s=self.scans["time_s"][rows],
            intensities=intensities,
        )

    def images(
        self,
        camera: str | None = None,
        placement: int | None = None,
        purpose: str | None = None,
    ) -> tuple[ImageRecord, ...]:
        """The records of images that match all that is given, in the order of images.csv.

        Parameters
        ----------
        camera, placement
            -1 are the images of no placement.
        purpose
            'board', 'intrinsics' or 'scene'.
        """
        records = []
        for record in self.image_records:
            if camera not in (None, record.camera) or placement not in (
                None,
                record.placement,
            ):
                continue
            if purpose in (None, record.purpose):
                records.append(record)
        return tuple(records)

    def read_image(self, record: ImageRecord) -> np.ndarray:
        """The pixels of an image.

        Parameters
        ----------
        record

        Returns
        -------
        ndarray of uint8, shape (height, width, 3)
            Blue, green, red.

        Raises
        ------
        SessionError
            If the file cannot be decoded or has another size than the camera.
        """
        camera = self.cameras[record.camera]
        data = stated.read_bytes(record.file, self.path)
        check_image_size(record.file, data, camera)
        with reading(
            record.file,
            "cannot be decoded; remove its row from images.csv or restore the file",
        ):
            image: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            height, width = image.shape[:2]  # there is none of an image that is None
        check_image_size(record.file, data, camera, (width, height))
        return image

    @property
    def scene_placements(self) -> tuple[int, ...]:
        """Placements that show a scene to be rebuilt, by the purpose of their images."""
        return tuple(
            p for p in self.placements if self.images(placement=p, purpose="scene")
        )

    @property
    def board_placements(self) -> tuple[int, ...]:
        """All other placements."""
        scenes = self.scene_placements
        return tuple(p for p in self.placements if p not in scenes)

    def sweep_direction(self, placement: int) -> int:
        """Sign of the pitch motion over a sweep.

        Parameters
        ----------
        placement

        Returns
        -------
        int
            +1 upwards, -1 downwards, 0 for scans at one pitch.
        """
        pitch = self.sweep(placement).pitch
        quarter = len(pitch) // 4 + 1
        moved = np.nanmedian(pitch[-quarter:]) - np.nanmedian(pitch[:quarter])
        if not abs(moved) > SMALLEST_MOVE:
            return 0
        return int(np.sign(moved))


def open_session(path: str | os.PathLike) -> Session:
    """Open a session and check all of it.

    Parameters
    ----------
    path
        Its folder.

    Raises
    ------
    SessionError
        With the file, the value and the remedy, for anything that makes the session unusable. What
        only takes a part away (a placement without scan lines) is in `Session.problems`.
    """
    path = Path(path)
    data = stated.read_json(path / "session.json", path)
    with naming(path / "session.json"):
        if data.get("schema") != stated.SCHEMA:
            raise ValueError(
                f"schema is {data.get('schema')!r}, this version reads '{stated.SCHEMA}'"
            )
        facts = stated.parse_session(data)
        unfinished = facts.pop("unfinished")
    scans, log = read_scans(path)
    records = read_images(path, facts, unfinished)
    picks = read_edges(path, facts, records)
    problems = missing_parts(
        facts["placements"], scans, records, facts["cameras"], unfinished
    )
    problems += (
        () if log is None else (*log.problems, *other_than_stated(scans, facts["lrf"]))
    )
    found = {
        "image_records": records,
        "picks": picks,
        "problems": problems,
        "scans": scans,
        "telegrams": log,
    }
    return Session(path=path, **found, **facts)


def validate(path: str | os.PathLike) -> list[str]:
    """Everything that is wrong with a session, as sentences; none for a sound one.

    Parameters
    ----------
    path
        Its folder.

    Returns
    -------
    list of str
        The first is what keeps the session from being opened, if anything does.
    """
    try:
        session = open_session(path)
    except SessionError as error:
        return [str(error)]
    found = [*session.problems, *_disorder(session)]
    found += [fault.words for fault in faults_of_files(session) if fault.words not in found]
    dark = []
    for record in session.image_records:
        try:
            if dark_image(session.read_image(record)):
                dark.append(record)
        except SessionError as error:
            found.append(str(error))
    found += [fault.words for fault in faults_of_dark(session, dark)]
    return [printable(problem) for problem in found]


def _disorder(session):
    """What two writers, or hands, do to tables."""
    for name, (columns, group, once) in ORDERED.items():
        file = session.path / name
        if os.path.lexists(file):
            rows = read_table(file, columns, session.path, torn=True)[0]
            yield from _rows_twice(file, rows, once)
            yield from _times_back(file, rows, group)


def _rows_twice(file, rows, once):
    """Sentences about rows whose values of the columns `once` stand in a table already."""
    first = {}
    for line, row in enumerate(rows, start=2):
        values = tuple(row[key] for key in once)
        if values in first:
            already = f"stands in line {first[values]} already; remove one of them"
            yield f"{file} line {line}: {', '.join(values)} {already}"
        first.setdefault(values, line)


def _times_back(file, rows, group):
    """Sentences about times that run back between rows of one `group`, by these columns."""
    last = {}
    for line, row in enumerate(rows, start=2):
        if not row.get("t_s") or not row["placement"] or row.get("purpose") == DROPPED:
            continue
        try:
            time = float(row["t_s"])
        except (
            ValueError
        ):  # of a placement that was not finished: no other reader looks at it
            yield f"{file} line {line}: t_s is {row['t_s']!r}: a number of seconds is needed"
            continue
        values = tuple(row[key] for key in group)
        if time < last.get(values, -math.inf):
            back = f"t_s runs back from {last[values]:.9g} to {time:.9g}"
            yield f"{file} line {line}: {back}: two writers at once? Record the placement again"
        last[values] = time
