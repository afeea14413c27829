"""Open a session, check it, and hand out its sweeps and images."""

import math
import os
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path, PurePosixPath, PureWindowsPath
from zipfile import ZipFile

import cv2
import numpy as np
from PIL import Image
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.board import Board
from lrfcal_lib.session import stated
from lrfcal_lib.session.faults import dark_image, faults_of_dark, faults_of_files
from lrfcal_lib.session.stated import CameraInfo, LrfInfo, SessionError, naming, opened, reading, short
from lrfcal_lib.session.telegrams import INDEX_COLUMNS, TelegramLog, other_than_stated, read_telegrams

IMAGE_COLUMNS = ("t_s", "camera", "file", "placement", "pitch_deg", "purpose")
EDGE_COLUMNS = ("camera", "file", "edge", "u1", "v1", "u2", "v2")
PLATFORM_COLUMNS = ("t_s", "commanded_deg", "measured_deg")
PURPOSES = ("intrinsics", "board", "scene")
DROPPED = "dropped"  # purpose of an image of a placement that was recorded again, or never finished
ARRAYS = ("ranges", "bearings", "placement", "pitch", "time_s", "intensities")
LONGEST_MEDIAN_RANGE = 200.0  # metres; no pitching 2D scanner sees half of its scene farther away than that


@dataclass(frozen=True)
class ImageRecord:
    """One row of images.csv.

    `file` is where the image is now; `placement` -1 where it belongs to none; `pitch` of the platform (radians) and
    `time_s` are NaN where unknown; `purpose` one of 'intrinsics', 'board', 'scene'.
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


SOURCES = ("lrf/scans.npz", "lrf/telegrams.bin")


def read_scans(path):
    """The recording of the LRF, whichever kind of file holds it, and the log of its telegrams (or None)."""
    file = next((path / name for name in SOURCES if os.path.lexists(path / name)), path / SOURCES[0])
    if file.suffix == ".npz":
        if not os.path.lexists(file) and os.path.lexists(path / "lrf") and parts_of(path):
            remedy = f"lrfcal_lib.session.write.finish('{path}') completes it"
            raise SessionError(f"{path}: the recording was interrupted; {remedy}")
        return read_npz(file, path), None
    scans, log = read_telegrams(file, path)
    with naming(file):
        return check_scans(scans), log


def parts_of(path):
    """Files of a session's sweeps in their order, until it is finished."""
    return sorted(stated.checked(path / "lrf" / "any", path).parent.glob("part_*.npz"))


def read_npz(file, within):
    """The arrays of a scans.npz (or of one part of it), checked by :func:`check_scans`; no other is unpacked."""
    if not os.path.lexists(file):
        raise SessionError(f"{file}: no such file; a session needs the scan lines")
    scans, values = {}, 0
    with reading(file, "cannot be read ({}); truncated?"), opened(file, within) as stream, ZipFile(stream) as archive:
        for key in (key for key in ARRAYS if f"{key}.npy" in archive.namelist()):
            with archive.open(f"{key}.npy") as member:
                old = np.lib.format.read_magic(member) == (1, 0)
                header = np.lib.format.read_array_header_1_0 if old else np.lib.format.read_array_header_2_0
                shape, _, kind = header(member)
            values += abs(math.prod(shape))
            with naming(file):
                if kind.kind not in "fiub" or kind.itemsize > 8:
                    raise ValueError(f"{key} cannot be read: it holds {kind}, not numbers; write it without pickles")
                stated.check_amount(values)
            with archive.open(f"{key}.npy") as member:
                scans[key] = np.lib.format.read_array(member, allow_pickle=False)
    with naming(file):
        return check_scans(scans)


def check_scans(scans):
    """Scan lines with consistent shapes and credible units.

    Takes a dict of ranges (N, B) metres, bearings (B,) and pitch (N,) radians, placement (N,), time_s (N,), and
    intensities (N, B) where there are any; gives the same as floats (placement: integers), zero or infinite ranges NaN.
    KeyError or ValueError for a missing array, wrong shapes or units, bearings that do not ascend, no range at all.
    """
    ranges = np.asarray(scans["ranges"], float)
    if ranges.ndim != 2:
        raise ValueError(f"ranges must be scan lines x beams, got shape {ranges.shape}")
    lines, beams = ranges.shape
    shapes = {"bearings": (beams,), "placement": (lines,), "pitch": (lines,), "time_s": (lines,)}
    shapes |= {"intensities": (lines, beams)} if "intensities" in scans else {}
    for key, shape in shapes.items():
        if scans[key].shape != shape:
            raise ValueError(f"{key} has shape {scans[key].shape}, the ranges {ranges.shape} ask for {shape}")
    scans = {key: np.asarray(scans[key], int if key == "placement" else float) for key in shapes}
    seen = ranges[np.isfinite(ranges)]
    if seen.size == 0:
        raise ValueError(f"no range in {lines} scan lines (all NaN): nothing was recorded")
    if np.median(seen) > LONGEST_MEDIAN_RANGE:
        units = "millimetres? Divide by 1000; inches? Multiply by 0.0254"
        raise ValueError(f"the median range is {np.median(seen):g} m: {units}")
    if seen.min() < 0:
        raise ValueError(f"a range is {seen.min():g} m: negative ranges are no measurements, use NaN")
    for name, angles, limit in (("bearing", scans["bearings"], 2 * np.pi), ("pitch", scans["pitch"], np.pi)):
        if not np.isfinite(angles).all():
            raise ValueError(f"{np.sum(~np.isfinite(angles))} values of {name} are not finite")
        if np.abs(angles).max(initial=0) > limit + 1e-6:
            raise ValueError(f"a {name} is {np.abs(angles).max():g} rad: degrees? Convert to radians")
    if np.any(np.diff(scans["bearings"]) <= 0):
        raise ValueError("bearings must ascend (0 right, pi/2 ahead): turn the columns of the ranges round")
    ranges[~(ranges > 0) | np.isinf(ranges)] = np.nan
    return {**scans, "ranges": ranges}


def missing_parts(placements, scans, records, cameras, unfinished=None):
    """What a session states and does not hold, as sentences; the rest can be used."""
    seen = set(scans["placement"][np.isfinite(scans["ranges"]).any(axis=1)].tolist())
    shot, unfinished = {(r.camera, r.placement) for r in records}, unfinished or ()
    again = "its recording was not finished, ignored; 'record --resume' records it again"
    extra = sorted(seen - {*placements, *unfinished})
    return (
        *(f"placement {p}: no scan line with a range" for p in placements if p not in seen),
        *(f"placement {p}: {again}" for p in unfinished),
        *(f"placement {p}: in the scan lines but not in session.json, ignored" for p in extra),
        *(f"placement {p}: no image of camera '{c}'" for p in placements for c in cameras if (c, p) not in shot),
    )


def inside(path, name, where):
    """The file a session names; it must lie inside the session's folder (no ``..`` or absolute path)."""
    windows, posix = PureWindowsPath(name), PurePosixPath(name)
    if windows.drive or windows.root or posix.is_absolute() or ".." in windows.parts or not posix.parts:
        raise SessionError(f"{path}: {where} must stay inside the session's folder, got '{name}'")
    return path / name


def read_images(path, facts, unfinished=None):
    """The records of images.csv; every image must exist, be complete and have its camera's size.

    Images of unfinished placements and dropped ones are left out, and a last row that is cut off while recording.
    """
    file, cameras = path / "images.csv", facts["cameras"]
    if not cameras and not os.path.lexists(file):
        return ()
    out, skipped = [], {str(p) for p in unfinished or ()}
    rows = stated.read_table(file, IMAGE_COLUMNS, path, torn=unfinished is not None)[0]
    for number, row in enumerate(rows, start=2):
        if row["purpose"] == DROPPED or row["placement"] in skipped:
            continue
        with naming(f"{file} line {number}"):
            if row["camera"] not in cameras:
                raise ValueError(f"no camera '{row['camera']}' in session.json, which has {short(cameras)}")
            if row["purpose"] not in PURPOSES:
                raise ValueError(f"purpose is one of {short(PURPOSES)}, got '{row['purpose']}'")
            placement = int(row["placement"] or -1)
            if placement not in (*facts["placements"], -1):
                raise ValueError(f"placement {placement} is not in session.json")
            pitch, time = (float(row[k] or "nan") for k in ("pitch_deg", "t_s"))
            target = inside(path, row["file"], "images.csv: file")
            out.append(ImageRecord(row["camera"], target, placement, math.radians(pitch), time, row["purpose"]))
            check_image_size(target, stated.read_bytes(target, path), cameras[row["camera"]])
    return tuple(out)


def read_edges(path, facts, records):
    """The picks of edges.csv, if there is one, for images and edges that the session knows."""
    file, out = path / "edges.csv", []
    known, edges = {(r.camera, r.file) for r in records}, facts["board"].edges
    rows = stated.read_table(file, EDGE_COLUMNS, path)[0] if os.path.lexists(file) else ()
    for number, row in enumerate(rows, start=2):
        with naming(f"{file} line {number}"):
            target = inside(path, row["file"], "edges.csv: file")
            if (row["camera"], target) not in known:
                raise ValueError(f"images.csv has no '{row['file']}' of camera '{row['camera']}'")
            if row["edge"] not in edges:
                raise ValueError(f"edge is one of {short(edges)}, got '{row['edge']}'")
            ends = np.array([float(row[k]) for k in EDGE_COLUMNS[3:]]).reshape(2, 2)
            if not np.isfinite(ends).all():
                raise ValueError(f"u1, v1, u2, v2 must be 4 finite numbers, got {ends.ravel().tolist()}")
            if np.linalg.norm(ends[1] - ends[0]) < 5:
                raise ValueError(f"the two pixels {ends.tolist()} are too close for a direction: pick them far apart")
            out.append(EdgePick(row["camera"], target, row["edge"], ends))
    return tuple(out)


def image_size(file, data):
    """Width and height of a PNG or JPEG image from its header; SessionError if it is cut off, or neither."""
    ends = {b"\x89PNG\r\n\x1a\n": b"IEND", b"\xff\xd8": b"\xff\xd9"}
    end = next((end for begin, end in ends.items() if data.startswith(begin)), None)
    if end is None:
        raise SessionError(f"{file}: neither PNG nor JPEG; convert the image")
    try:
        with Image.open(BytesIO(data), formats=("PNG", "JPEG")) as image:
            size = image.size
    except Exception:  # whatever Pillow makes of a header
        size = None
    if size is None or end not in data[-64:]:
        raise SessionError(f"{file}: the image is truncated after {len(data)} bytes; restore it or remove its row")
    return size


def check_image_size(file, data, camera, size=None):
    """Refuse an image of another size than its camera's; `size` is that of the decoded image."""
    width, height = size or image_size(file, data)
    if (width, height) != (camera.width, camera.height):
        found = f"{width} x {height} pixels, but camera '{camera.name}' has {camera.width} x {camera.height}"
        raise SessionError(f"{file}: {found}; intrinsics hold for one image size only")


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
    """A recorded session; the arrays are read when it is opened, the images when they are asked for.

    Attributes
    ----------
    name, licence, source : str
        `source` says where the recording came from.
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
        """The Sweep of a placement; SessionError if it is not in the session, or has no scan line with a range."""
        if placement not in self.placements:
            raise SessionError(f"{self.path}: no placement {placement}; the session has {short(self.placements)}")
        rows = self.scans["placement"] == placement
        picked = {k: v[rows] for k, v in self.scans.items() if k in ("ranges", "pitch", "time_s", "intensities")}
        if not np.isfinite(picked["ranges"]).any():
            raise SessionError(f"{self.path}: placement {placement} has {rows.sum()} scan lines and no range in them")
        return Sweep(int(placement), bearings=self.scans["bearings"], **picked)

    def images(self, camera=None, placement=None, purpose=None):
        """The records of images that match all that is given, in the order of images.csv."""
        wanted = {"camera": camera, "placement": placement, "purpose": purpose}
        wanted = {k: v for k, v in wanted.items() if v is not None}
        return tuple(r for r in self.image_records if all(getattr(r, k) == v for k, v in wanted.items()))

    def read_image(self, record):
        """The pixels of an ImageRecord: blue, green, red, ndarray of uint8, shape (height, width, 3).

        SessionError if the file cannot be decoded or has another size than the camera.
        """
        camera, data = self.cameras[record.camera], stated.read_bytes(record.file, self.path)
        check_image_size(record.file, data, camera)
        with reading(record.file, "cannot be decoded; remove its row from images.csv or restore the file"):
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            shape = image.shape  # there is none of an image that is None
        check_image_size(record.file, data, camera, shape[1::-1])
        return image

    @property
    def scene_placements(self):
        """Placements that show a scene to be rebuilt, not the board: their images have the purpose 'scene'."""
        return tuple(p for p in self.placements if self.images(placement=p, purpose="scene"))

    @property
    def board_placements(self):
        """All other placements."""
        scenes = self.scene_placements
        return tuple(p for p in self.placements if p not in scenes)

    def sweep_direction(self, placement):
        """Sign of the pitch motion over a sweep: +1 upwards, -1 downwards, 0 for scans at one pitch."""
        pitch = self.sweep(placement).pitch
        moved = np.nanmedian(pitch[-(len(pitch) // 4 + 1) :]) - np.nanmedian(pitch[: len(pitch) // 4 + 1])
        return int(np.sign(moved)) if abs(moved) > 1e-4 else 0


def open_session(path):
    """Open a session (its folder) and check all of it.

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
    data = stated.read_json(path / "session.json", path)
    with naming(path / "session.json"):
        if data.get("schema") != stated.SCHEMA:
            raise ValueError(f"schema is {data.get('schema')!r}, this version reads '{stated.SCHEMA}'")
        facts = stated.parse_session(data)
        unfinished = facts.pop("unfinished")
    scans, log = read_scans(path)
    records = read_images(path, facts, unfinished)
    picks = read_edges(path, facts, records)
    problems = missing_parts(facts["placements"], scans, records, facts["cameras"], unfinished)
    problems += () if log is None else (*log.problems, *other_than_stated(scans, facts["lrf"]))
    found = {"image_records": records, "picks": picks, "problems": problems, "scans": scans, "telegrams": log}
    return Session(path=path, **found, **facts)


def validate(path):
    """Everything that is wrong with a session, as sentences; none for a sound one.

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
    return found + [fault.words for fault in faults_of_dark(session, dark)]


def _disorder(session):
    """What two writers, or hands, do to tables: time that runs back within a placement, rows that stand there twice."""
    for name, (columns, group, once) in ORDERED.items():
        file, last, seen = session.path / name, {}, {}
        rows = stated.read_table(file, columns, session.path, torn=True)[0] if os.path.lexists(file) else ()
        for line, row in enumerate(rows, start=2):
            where, what = f"{file} line {line}", tuple(row[key] for key in once)
            if what in seen:
                yield f"{where}: {', '.join(what)} stands in line {seen[what]} already; remove one of them"
            seen.setdefault(what, line)
            key = tuple(row[key] for key in group)
            if row.get("t_s") and row["placement"] and row.get("purpose") != DROPPED:
                try:
                    time = float(row["t_s"])
                except ValueError:  # of a placement that was not finished: no other reader looks at it
                    yield f"{where}: t_s is {row['t_s']!r}: a number of seconds is needed"
                    continue
                if time < last.get(key, -math.inf):
                    back = f"t_s runs back from {last[key]:.9g} to {time:.9g}"
                    yield f"{where}: {back}: two writers at once? Record the placement again"
                last[key] = time
