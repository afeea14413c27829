"""Open a session, check it, and hand out its sweeps and images."""

import math
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lrfcal_lib.session.faults import dark_images, faults_of_files
from lrfcal_lib.session.files import (
    SessionError,
    naming,
    read_bytes,
    read_json,
    reading,
    short,
)
from lrfcal_lib.session.images import check_image_size
from lrfcal_lib.session.scans import parts_of, read_npz, scanned
from lrfcal_lib.session.shown import printable
from lrfcal_lib.session.stated import SCHEMA, StatedRig, parse_session
from lrfcal_lib.session.tables import read_table, whole_number
from lrfcal_lib.session.telegrams import INDEX_COLUMNS, TelegramLog, read_telegrams

IMAGE_COLUMNS = ("t_s", "camera", "file", "placement", "pitch_deg", "purpose")
EDGE_COLUMNS = ("camera", "file", "edge", "u1", "v1", "u2", "v2")
PLATFORM_COLUMNS = ("t_s", "commanded_deg", "measured_deg")
PURPOSES = ("intrinsics", "board", "scene")
CLOSEST = 5  # pixels between the two of a pick
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


def read_scans(path):
    """The recording of the LRF, whichever kind of file holds it, the log of its telegrams (or
    None), and what of them is not used.
    """
    arrays = path / "lrf/scans.npz"
    telegrams = path / "lrf/telegrams.bin"
    if os.path.lexists(arrays):
        return read_npz(arrays, path), None, []
    if os.path.lexists(telegrams):
        return read_telegrams(telegrams, path)
    if os.path.lexists(path / "lrf") and parts_of(path):
        raise SessionError(
            f"{path}: the recording was interrupted; lrfcal_lib.session.write.finish('{path}') "
            "completes it"
        )
    raise SessionError(f"{arrays}: no such file; a session needs the scan lines")


# begin names that lead out of a folder, on any system: absolute ones, and those with ``..``
OUTSIDE = re.compile(r"[/\\]|\w:|(.*[/\\])?\.\.([/\\]|$)")


def missing_parts(placements, scans, records, cameras, unfinished):
    """What a session states and does not hold, as sentences; the rest can be used."""
    swept = scanned(scans)
    shot = {(record.camera, record.placement) for record in records}
    for placement in placements:
        if placement not in swept:
            yield f"placement {placement}: no scan line with a range"
        for camera in cameras:
            if (camera, placement) not in shot:
                yield f"placement {placement}: no image of camera '{camera}'"
    for placement in unfinished:
        yield (
            f"placement {placement}: its recording was not finished, ignored; 'record --resume' "
            "records it again"
        )
    for placement in sorted(swept - {*placements, *unfinished}):
        yield f"placement {placement}: in the scan lines but not in session.json, ignored"


def inside(path, name):
    """The file a session names; it must lie inside the session's folder (no ``..`` or absolute
    path): ValueError.
    """
    if OUTSIDE.match(name):
        raise ValueError(f"file must stay inside the session's folder, got '{name}'")
    if not name.isprintable():
        raise ValueError(f"file must be printable, got '{name}': rename it")
    return path / name


def known(value, values, what):
    """A value that must be one of some; ValueError in words otherwise."""
    if value not in values:
        raise ValueError(f"{what} must be one of {short(values)}, got '{value}'")
    return value


def once(lines, number, *values):
    """ValueError for values that stand in an earlier line of a table already."""
    first = lines.setdefault(values, number)
    if first < number:
        raise ValueError(
            f"{short(values)} stands in line {first} already; remove one of the two rows"
        )


def read_images(path, facts, unfinished):
    """The records of images.csv; every image must exist, be complete and have its camera's size.

    Images of unfinished placements and dropped ones are left out, and a last row that is cut off
    while recording.
    """
    file = path / "images.csv"
    cameras = facts["cameras"]
    out = []
    lines = {}  # in which each file stands
    rows = read_table(
        file, IMAGE_COLUMNS, path, torn=unfinished is not None, needed=bool(cameras)
    )
    for number, row in enumerate(rows, start=2):
        if row["purpose"] == DROPPED:
            continue
        with naming(f"{file} line {number}"):
            placement = whole_number(row["placement"], "placement")
            if placement in (unfinished or ()):
                continue
            record = ImageRecord(
                camera=known(row["camera"], cameras, "camera"),
                file=inside(path, row["file"]),
                placement=known(placement, (*facts["placements"], -1), "placement"),
                pitch=math.radians(float(row["pitch_deg"] or "nan")),
                time_s=float(row["t_s"] or "nan"),
                purpose=known(row["purpose"], PURPOSES, "purpose"),
            )
            once(lines, number, record.file)
            check_image_size(
                record.file, read_bytes(record.file, path), cameras[record.camera]
            )
        out.append(record)
    return tuple(out)


def read_edges(path, facts, records):
    """The picks of edges.csv, if there is one, for images and edges that the session knows."""
    file = path / "edges.csv"
    out = []
    lines = {}  # in which each edge of an image stands
    images = {(record.camera, record.file) for record in records}
    rows = read_table(file, EDGE_COLUMNS, path, needed=False)
    for number, row in enumerate(rows, start=2):
        with naming(f"{file} line {number}"):
            camera, name, edge, *pixels = row.values()
            target = inside(path, name)
            if (camera, target) not in images:
                raise ValueError(f"images.csv has no '{name}' of camera '{camera}'")
            known(edge, facts["board"].edges, "edge")
            once(lines, number, camera, target, edge)
            ends = np.array(pixels, float).reshape(2, 2)
            if not CLOSEST <= np.linalg.norm(ends[1] - ends[0]) < math.inf:
                raise ValueError(
                    f"the two pixels {ends.tolist()} give no direction: pick two that are "
                    f"{CLOSEST} or more pixels apart"
                )
            out.append(EdgePick(camera, target, edge, ends))
    return tuple(out)


# radians from the first to the last quarter of a sweep; 0.006 deg, below the step of any head
SMALLEST_MOVE = 1e-4
TIMED = {"lrf/index.csv": INDEX_COLUMNS, "images.csv": IMAGE_COLUMNS}  # tables with times


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

    @property
    def direction(self) -> int:
        """Sign of the pitch motion: +1 upwards, -1 downwards, 0 for scans at one pitch."""
        quarter = len(self.pitch) // 4 + 1
        moved = np.median(self.pitch[-quarter:]) - np.median(self.pitch[:quarter])
        if abs(moved) <= SMALLEST_MOVE:
            return 0
        return int(np.sign(moved))

    @property
    def pitch_step(self) -> float:
        """Between scan lines, radians; 0 where nothing moves."""
        turns = np.abs(np.diff(self.pitch))
        if not turns.any():
            return 0.0
        return np.median(turns[turns > 0])

    def part(self, lines, beams=slice(None)) -> "Sweep":
        """Some of the scan lines, and of their beams.

        Parameters
        ----------
        lines, beams : slice or ndarray
        """
        intensities = self.intensities
        if intensities is not None:
            intensities = intensities[lines, beams]
        return replace(
            self,
            ranges=self.ranges[lines, beams],
            bearings=self.bearings[beams],
            pitch=self.pitch[lines],
            time_s=self.time_s[lines],
            intensities=intensities,
        )


@dataclass(frozen=True)
class Session(StatedRig):
    """A recorded session with its rig; the arrays are read when it is opened, the images when they
    are asked for.

    Attributes
    ----------
    name, licence, source : str
        `source` says where the recording came from.
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
    placements: tuple[int, ...]
    image_records: tuple[ImageRecord, ...]
    picks: tuple[EdgePick, ...]
    reference: dict
    problems: tuple[str, ...]
    scans: dict[str, np.ndarray]
    telegrams: TelegramLog | None = None
    continuous: bool = False

    def __repr__(self):
        return (
            f"Session({self.name}: {len(self.board_placements)} placements of {self.board.name}, "
            f"LRF {self.lrf.model}, cameras {short(self.cameras)})"
        )

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
        arrays: dict[str, Any] = {**self.scans, "placement": int(placement)}
        sweep = Sweep(**arrays).part(rows)
        if not np.isfinite(sweep.ranges).any():
            raise SessionError(
                f"{self.path}: placement {placement} has {rows.sum()} scan lines and no range in "
                "them"
            )
        return sweep

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
        return tuple(
            record
            for record in self.image_records
            if camera in (None, record.camera)
            and placement in (None, record.placement)
            and purpose in (None, record.purpose)
        )

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
        data = read_bytes(record.file, self.path)
        with reading(
            record.file,
            "cannot be decoded; remove its row from images.csv or restore the file",
        ):
            image: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            height, width = image.shape[:2]  # there is none of an image that is None
        check_image_size(record.file, data, self.cameras[record.camera], (width, height))
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
    data = read_json(path / "session.json", path)
    with naming(path / "session.json"):
        if data.get("schema") != SCHEMA:
            raise ValueError(
                f"schema is {data.get('schema')!r}, this version reads '{SCHEMA}'"
            )
        facts = parse_session(data)
        unfinished = facts.pop("unfinished")
    scans, log, unused = read_scans(path)
    records = read_images(path, facts, unfinished)
    problems = (
        *missing_parts(
            facts["placements"], scans, records, facts["cameras"], unfinished or ()
        ),
        *unused,
    )
    return Session(
        path=path,
        image_records=records,
        picks=read_edges(path, facts, records),
        problems=problems,
        scans=scans,
        telegrams=log,
        **facts,
    )


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
    faults = faults_of_files(session)
    broken = []
    for record in session.image_records:
        try:
            session.read_image(record)
        except SessionError as error:
            broken.append(str(error))
    if not broken:
        faults += dark_images(session)
    found = [
        *session.problems,
        *_times_back(session),
        *[fault.words for fault in faults],
        *broken,
    ]
    return [printable(problem) for problem in found]


def _times_back(session):
    """Sentences about times that run back between rows, as where two write at once."""
    for name, columns in TIMED.items():
        file = session.path / name
        last = {}
        rows = read_table(file, columns, session.path, torn=True, needed=False)
        for line, row in enumerate(rows, start=2):
            if not row["t_s"] or not row["placement"] or row.get("purpose") == DROPPED:
                continue
            try:
                time = float(row["t_s"])
            # of a placement that was not finished: nobody else looks at it
            except ValueError:
                yield f"{file} line {line}: t_s is {row['t_s']!r}: a number of seconds is needed"
                continue
            # rows that share these follow each other in time
            group = tuple(map(row.get, ("camera", "placement", "purpose")))
            if time < last.get(group, -math.inf):
                yield (
                    f"{file} line {line}: t_s runs back from {last[group]:.9g} to {time:.9g}: two "
                    "writers at once? Record the placement again"
                )
            last[group] = time
