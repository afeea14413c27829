"""session.json and how files of a session are opened: within its folder, bounded, by one writer at a time."""

from __future__ import annotations

import csv
import fcntl
import html
import json
import math
import os
import re
import socket
import stat
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import Board, Chessboard
from lrfcal_lib.model.camera import CameraModel


def escape(text):
    """Anything as HTML that shows it as text; all that becomes HTML comes through here, see also the report's template.

    Parameters
    ----------
    text : object
        Names and remarks of a session may be somebody else's.

    Returns
    -------
    str
        Without tags and entities, and without formulas: MathJax, which searches pages for them, finds no pair of
        signs in one piece of text.
    """
    return re.sub(r"[$\\]", r"<span>\g<0></span>", html.escape(str(text)))


LARGEST_FILE = 64_000_000  # bytes of any file of a session
SPLIT = "split the recording into several sessions"
LOCK = "writer.lock"
FILES = (  # of any session, besides its images
    "session.json", "lrf/scans.npz", "lrf/telegrams.bin", "lrf/index.csv", "images.csv", "edges.csv", "platform.csv",
    "truth.json",
)  # fmt: skip
KINDS = {"l": "a link", "d": "a folder", "p": "a named pipe", "s": "a socket", "b": "a device", "c": "a device"}


class SessionError(ValueError):
    """A session on disk that cannot be used: the message names the file, the value and what to do about it."""

    def __init__(self, text):
        super().__init__(text if len(text) < 2000 else f"{text[:1000]} [...] {text[-500:]}")


@contextmanager
def folder(file, within, make=False):
    """Descriptor of the folder that holds a file of a session, reached without following a link."""
    where, handle = Path(within), os.open(within, os.O_RDONLY | os.O_DIRECTORY)
    try:
        for part in Path(file).relative_to(within).parts[:-1]:
            where /= part
            if make:
                with suppress(FileExistsError):
                    os.mkdir(part, dir_fd=handle)
            _refuse_other(where, os.stat(part, dir_fd=handle, follow_symlinks=False), "d", "a folder")
            outer, handle = handle, os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=handle)
            os.close(outer)
        yield handle
    finally:
        os.close(handle)


def listed(path, within):
    """Names in a folder of a session."""
    with folder(Path(path) / "any", within) as handle:
        return sorted(os.listdir(handle))


def opened(file, within=None, flags=os.O_RDONLY, most=LARGEST_FILE):
    """Binary stream of a file in a session.

    Parameters
    ----------
    file : path-like
    within : path-like, optional
        The session's folder; without, the file is somebody else's, who may have links to it.
    flags : int
        Of ``os.open``; any but O_RDONLY writes.
    most : int
        Bytes that are read.

    Returns
    -------
    file object

    Raises
    ------
    SessionError
        If the file, or a folder between it and the session's, is a link, or the file is none (a pipe, a device) or too
        large to be read.
    OSError
        If it cannot be opened.
    """
    file = Path(file).resolve() if within is None else Path(file)
    with folder(file, within or file.parent) as handle:
        with suppress(FileNotFoundError):  # a device is not even opened
            _refuse_other(file, os.stat(file.name, dir_fd=handle, follow_symlinks=False), "-", "a file")
        inner = os.open(file.name, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666, dir_fd=handle)
    stream = os.fdopen(inner, "rb" if flags == os.O_RDONLY else "r+b" if flags & os.O_RDWR else "wb")
    try:
        status = os.fstat(inner)
        _refuse_other(file, status, "-", "a file")
        if flags == os.O_RDONLY and status.st_size > most:
            raise SessionError(f"{file}: {status.st_size / 1e6:.0f} MB, more than {most / 1e6:.0f} MB; {SPLIT}")
    except BaseException:
        stream.close()
        raise
    return stream


def _refuse_other(file, status, kind, wanted):
    """Refuse what is no plain file (or folder), such as a link."""
    found = stat.filemode(status.st_mode)[0]
    if found != kind:
        what = KINDS.get(found, "a file")
        raise SessionError(f"{file}: is {what}, not {wanted}: a session holds plain files; put {wanted} in its place")


@contextmanager
def alone(path):
    """Keep other writers out of a session as long as this lasts; a process that is killed lets go of it as well."""
    with _locked(Path(path)) as stream:
        stream.truncate()
        stream.write(f"process {os.getpid()} on {socket.gethostname()} since {datetime.now():%Y-%m-%d %H:%M}".encode())
        stream.flush()
        try:
            yield
        finally:
            with suppress(OSError), folder(Path(path) / LOCK, path) as handle:  # gone with its session?
                os.unlink(LOCK, dir_fd=handle)


def _locked(path):
    """The lock file, locked; who removes one holds its lock, so one that was removed meanwhile is opened anew."""
    while True:
        stream = opened(path / LOCK, path, os.O_RDWR | os.O_CREAT)
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            with stream:
                holder = stream.read(200).decode(errors="replace") or "another process"
            raise SessionError(f"{path}: {holder} writes this session: end that first, or choose another one") from None
        except BaseException:
            stream.close()
            raise
        if os.fstat(stream.fileno()).st_nlink:
            return stream
        stream.close()


MOST_VALUES = 12_000_000  # of all scan lines, so that reading them takes less than 500 MB
LARGEST_TEXT, DEEPEST_JSON, MOST_ROWS = 8_000_000, 30, 200_000  # bytes of a JSON or CSV file, levels


@contextmanager
def reading(file, remedy):
    """Turn whatever other people's code says about the content of a file into a SessionError.

    Any exception is meant, so nothing but calls of other people's code belongs inside: ours has to show its mistakes.
    """
    try:
        yield
    except SessionError:
        raise
    except Exception as error:
        raise SessionError(f"{file}: {remedy.format(str(error) or type(error).__name__)}") from error


@contextmanager
def naming(file):
    """Turn whatever goes wrong with values of a file into a SessionError that begins with the file's name."""
    try:
        yield
    except SessionError:
        raise
    except KeyError as error:
        raise SessionError(f"{file}: key {error} is missing") from error
    except (TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise SessionError(f"{file}: {error}") from error


def read_bytes(file, within=None, most=LARGEST_FILE):
    """Content of a file of a session (see :func:`opened`); a SessionError where it cannot be read."""
    try:
        with opened(file, within, most=most) as stream:
            return stream.read()
    except OSError as error:
        raise SessionError(f"{file}: {error.strerror}; the session needs this file") from error


def read_json(file, within):
    """The object in a JSON file."""
    text = read_bytes(file, within, LARGEST_TEXT)
    with reading(file, "not JSON ({}); truncated, or edited by hand?"):
        data = json.loads(text.decode())
    if not isinstance(data, dict):
        raise SessionError(f"{file}: holds a {type(data).__name__}, expected an object with the key 'schema'")
    inner = [data]
    for _ in range(DEEPEST_JSON):
        inner = [v for x in inner if isinstance(x, dict | list) for v in (x.values() if isinstance(x, dict) else x)]
    if inner:
        raise SessionError(f"{file}: nested deeper than {DEEPEST_JSON} levels; was this written by a program?")
    return data


def read_table(file, columns, within, torn=False):
    """Rows of a CSV file as dicts, and whether one was left out; the columns must be exactly `columns`.

    With `torn`, a last row without its line end (cut off by a crash) is left out.
    """
    data = read_bytes(file, within, LARGEST_TEXT)
    with reading(file, "not a CSV file in UTF-8 ({})"):
        text = data.decode()
        cut = torn and not text.endswith("\n")
        lines = (text.rpartition("\n")[0] if cut else text).splitlines()
        if len(lines) > MOST_ROWS:
            raise SessionError(f"{file}: {len(lines)} lines, more than {MOST_ROWS}; {SPLIT}")
        rows = list(csv.reader(lines))
    if not rows or tuple(rows[0]) != columns:
        got = ", ".join(rows[0]) if rows else "an empty file"
        raise SessionError(f"{file}: columns must be {', '.join(columns)}; got {got}")
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(columns):
            raise SessionError(f"{file} line {number}: {len(row)} values for {len(columns)} columns; truncated?")
    return [dict(zip(columns, row, strict=True)) for row in rows[1:]], cut


def check_amount(values):
    """Refuse more ranges and other values of scan lines than reading has memory for."""
    if values > MOST_VALUES:
        raise ValueError(f"{values} values of scan lines, more than {MOST_VALUES}; {SPLIT}")


def short(values):
    """Values as text for a message, the middle of long lists left out."""
    values = [str(v) for v in values]
    return ", ".join(values if len(values) < 13 else [*values[:6], "...", *values[-3:]]) or "none"


SCHEMA = "lrfcal-session/1"
MOUNTS = ("head", "platform")
LARGEST_WHOLE = 1_000_000  # placements and the like
LARGEST_IMAGE = 30_000_000  # pixels
MOST_CORNERS = 1000  # of a pattern, or of a board's outline
LONGEST_BOARD = 20.0  # metres
LONGEST_LEVER = 10.0  # metres between the parts of a rig
# metres, by part of the model's name: systematic error of a range up to 10 m according to SICK (technical description
# of LMS200, 211 and 221 in millimetre mode; support page "Measurement Errors LMSxxx"; data sheet of TiM55x and TiM56x)
SYSTEMATIC_ERROR = {"LMS1": 0.040, "LMS200": 0.015, "LMS211": 0.035, "LMS221": 0.035, "LMS5": 0.025, "TiM5": 0.060}
# of other models (no sheet of the LMS291 and LMS400 was at hand), and of those that count centimetres: so many standard
# deviations or steps of a range; the sheets above admit 2 to 4.2, and 4 to 5 steps of a centimetre
ASSUMED_SYSTEMATIC_ERROR = 5.0
ASSUMED_SPOT_RADIUS = 0.005  # metres; only the unit of the edge bias where nobody stated the spot


@dataclass(frozen=True)
class LrfInfo:
    """What is known about the laser range finder, read from the device or its data, never from the model's name.

    Attributes
    ----------
    model : str
    field_of_view : tuple of float
        First and last bearing it can measure, radians (0 right, pi/2 ahead).
    bearing_step : float
        Radians between neighbouring beams.
    sigma_range : float
        Standard deviation of a range, metres.
    sigma_bearing : float
        Standard deviation of a bearing, radians; 0 where unknown.
    range_resolution : float
        Step of the recorded ranges, metres.
    max_range : float
        Metres.
    spot : tuple of float, or None
        Diameter of the spot at the window (metres) and its growth with distance (radians), from the maker's data sheet;
        None where unknown.
    systematic_error : float or None
        Largest offset of all ranges that the maker admits, metres; None where not stated: then the one of the model, or
        five standard deviations of a range.
    """

    model: str
    field_of_view: tuple[float, float]
    bearing_step: float
    sigma_range: float
    sigma_bearing: float = 0.0
    range_resolution: float = 0.001
    max_range: float = math.inf
    spot: tuple[float, float] | None = None
    systematic_error: float | None = None

    @property
    def admitted_offset(self):
        """The largest range offset that the maker admits, metres: stated, or known of the model, or assumed."""
        known = [value for name, value in SYSTEMATIC_ERROR.items() if name in self.model]
        if not known or self.range_resolution > 0.005:
            known = [ASSUMED_SYSTEMATIC_ERROR * max(self.sigma_range, self.range_resolution)]
        return self.systematic_error or known[0]

    def spot_radius(self, distance):
        """Radius of the spot at a distance, metres; 5 mm everywhere where the spot is not stated."""
        exit_diameter, divergence = self.spot or (2 * ASSUMED_SPOT_RADIUS, 0.0)
        return (exit_diameter + divergence * np.asarray(distance, float)) / 2


@dataclass(frozen=True)
class CameraInfo:
    """A camera of the rig.

    Attributes
    ----------
    name : str
    mount : {'head', 'platform'}
        What it is fixed to: it turns with the LRF, or it stands on the base.
    width, height : int
        Image size, pixels.
    model : CameraModel or None
        None where the intrinsics have to be estimated from the session's own images.
    guess : RigidTransform or None
        Roughly measured ``T_camera_lrf`` (mount 'head') or ``T_camera_platform`` (mount 'platform').
    """

    name: str
    mount: str
    width: int
    height: int
    model: CameraModel | None = None
    guess: RigidTransform | None = None


def parse_session(data):
    """The statements of session.json as fields of a Session; KeyError, TypeError or ValueError for a wrong one."""
    rig = data["rig"]
    placements = tuple(whole(p, "a placement") for p in data["placements"])
    if len(set(placements)) != len(placements) or min(placements, default=0) < 0:
        raise ValueError(f"placements are different numbers from 0 on, got {short(placements)}")
    return {
        "name": plain_name(data["name"], "name of the session"),
        "licence": str(data["licence"]),
        "source": str(data["source"]),
        "simulated": bool(data["simulated"]),
        "board": board_from_json(data["board"]),
        "lrf": lrf_from_json(rig["lrf"]),
        "T_head_lrf": transform_from_json(rig["platform"]["T_head_lrf"]),
        "platform_sigma": platform_sigma_from_json(rig["platform"]),
        "cameras": {name: camera_from_json(name, c) for name, c in rig["cameras"].items()},
        "placements": placements,
        "reference": dict(data.get("reference", {})),
    }


def platform_sigma_from_json(data):
    """How well the stated platform is known: standard deviations of direction (radians) and offset (metres)."""
    direction = math.radians(_positive(data.get("sigma_direction_deg", 0.5), "sigma_direction_deg"))
    offset = _positive(data.get("sigma_offset_m", 0.010), "sigma_offset_m")
    if offset > 1:
        raise ValueError(f"sigma_offset_m is {offset:g}: millimetres? Divide by 1000")
    return direction, offset


def platform_to_json(T_head_lrf, sigma=None):
    """The stated platform as it stands in session.json; `sigma` as in :func:`platform_sigma_from_json`."""
    stated = {"T_head_lrf": transform_to_json(T_head_lrf)}
    if sigma is None:
        return stated
    return stated | {"sigma_direction_deg": round(math.degrees(sigma[0]), 9), "sigma_offset_m": sigma[1]}


def plain_name(name, what):
    """A name that is safe as a file name."""
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name):
        raise ValueError(f"the {what} becomes a file name: letters, digits, '_', '-' and '.' only, got {name!r}")
    return name


def numbers(values, shape, what):
    """Finite numbers of a given shape."""
    out = np.asarray(values, float)
    if out.shape != shape or not np.isfinite(out).all():
        raise ValueError(f"{what} must be {' x '.join(map(str, shape)) or 'one'} finite numbers, got {values!r}")
    return out


def whole(value, what):
    """A whole number, as an int."""
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > LARGEST_WHOLE or value % 1:
        raise ValueError(f"{what} is a whole number up to {LARGEST_WHOLE}, got {value!r}")
    return int(value)


def _positive(value, what):
    value = float(numbers(value, (), what))
    if value <= 0:
        raise ValueError(f"{what} must be positive, got {value}")
    return value


def transform_to_json(transform):
    """A RigidTransform (or None) as rotation vector and translation."""
    if transform is None:
        return None
    return {
        "rotation_vector_rad": transform.rotation.as_rotvec().tolist(),
        "translation_m": transform.translation.tolist(),
    }


def transform_from_json(data):
    """Inverse of :func:`transform_to_json`."""
    if data is None:
        return None
    shift = numbers(data["translation_m"], (3,), "translation_m")
    if np.abs(shift).max() > LONGEST_LEVER:
        raise ValueError(f"translation_m is {shift.tolist()}: millimetres? Divide by 1000")
    rotation = Rotation.from_rotvec(numbers(data["rotation_vector_rad"], (3,), "rotation_vector_rad"))
    return RigidTransform.from_components(shift, rotation)


def board_to_json(board):
    """A board as it stands in session.json."""
    pattern = None
    if board.pattern is not None:
        p = board.pattern
        pattern = {"kind": "chessboard", "columns": p.columns, "rows": p.rows, "square_m": p.square}
        pattern["origin_m"] = list(p.origin)
    corners = None if board.corners is None else np.asarray(board.corners).tolist()
    named = {"name": board.name, "edges": list(board.edges), "features": list(board.features)}
    return {**named, "corners_m": corners, "pattern": pattern}


def board_from_json(data):
    """Inverse of :func:`board_to_json`; refuses a board larger than 20 m."""
    edges = tuple(str(e) for e in data["edges"])
    features = tuple(str(f) for f in data["features"])
    if not 3 <= len(edges) <= MOST_CORNERS or len(set(edges)) != len(edges):
        raise ValueError(f"a board needs three or more edges with different names, got {short(edges)}")
    odd = [repr(e) for e in edges if "$" in e or not e.isprintable()]
    if odd:
        raise ValueError(f"names of edges stand in figures: no line ends, no '$' (a formula), got {short(odd)}")
    if len(features) != 2 or not set(features) <= set(edges):
        raise ValueError(f"features are two of the edges {short(edges)}, got {short(features)}")
    corners = data["corners_m"]
    if corners is not None:
        corners = numbers(corners, (len(edges), 2), "corners_m")
        if np.ptp(corners, axis=0).max() > LONGEST_BOARD:
            raise ValueError(f"the board is {np.ptp(corners, axis=0).max():g} m large: millimetres? Divide by 1000")
    return Board(str(data["name"]), edges, corners, _pattern_from_json(data["pattern"]), features)


def _pattern_from_json(data):
    if data is None:
        return None
    if data["kind"] != "chessboard":
        raise ValueError(f"pattern kind is 'chessboard', got {data['kind']!r}")
    square = _positive(data["square_m"], "square_m")
    if square > 1:
        raise ValueError(f"square_m is {square:g}: millimetres? Divide by 1000")
    columns, rows = whole(data["columns"], "columns"), whole(data["rows"], "rows")
    if min(columns, rows) < 3 or columns * rows > MOST_CORNERS:
        corners = f"three or more inner corners each way, up to {MOST_CORNERS} in all"
        raise ValueError(f"a chessboard needs {corners}, got {columns} x {rows}")
    return Chessboard(columns, rows, square, tuple(numbers(data.get("origin_m", (0, 0)), (2,), "origin_m").tolist()))


def lrf_to_json(lrf):
    """An LrfInfo as it stands in session.json (degrees there)."""
    return {
        "model": lrf.model,
        "field_of_view_deg": np.round(np.degrees(lrf.field_of_view), 9).tolist(),
        "bearing_step_deg": round(math.degrees(lrf.bearing_step), 9),
        "sigma_range_m": lrf.sigma_range,
        "sigma_bearing_deg": round(math.degrees(lrf.sigma_bearing), 9),
        "range_resolution_m": lrf.range_resolution,
        "max_range_m": lrf.max_range if math.isfinite(lrf.max_range) else None,
        **({} if lrf.systematic_error is None else {"systematic_error_m": lrf.systematic_error}),
        **({} if lrf.spot is None else {"spot_exit_m": lrf.spot[0], "spot_divergence_rad": lrf.spot[1]}),
    }


def lrf_from_json(data):
    """Inverse of :func:`lrf_to_json`."""
    first, last = np.radians(numbers(data["field_of_view_deg"], (2,), "field_of_view_deg"))
    if not first < last <= first + 2 * np.pi + 1e-9:
        raise ValueError(f"field_of_view_deg is two ascending bearings, got {data['field_of_view_deg']}")
    sigma = _positive(data["sigma_range_m"], "sigma_range_m")
    if sigma > 1:
        raise ValueError(f"sigma_range_m is {sigma:g}: millimetres? Divide by 1000")
    longest, admitted = data.get("max_range_m"), data.get("systematic_error_m")
    return LrfInfo(
        model=str(data["model"]),
        field_of_view=(float(first), float(last)),
        bearing_step=math.radians(_positive(data["bearing_step_deg"], "bearing_step_deg")),
        sigma_range=sigma,
        sigma_bearing=math.radians(float(numbers(data.get("sigma_bearing_deg", 0.0), (), "sigma_bearing_deg"))),
        range_resolution=float(numbers(data.get("range_resolution_m", 0.001), (), "range_resolution_m")),
        max_range=math.inf if longest is None else _positive(longest, "max_range_m"),
        spot=_spot(data),
        systematic_error=None if admitted is None else _positive(admitted, "systematic_error_m"),
    )


def _spot(data):
    """Stated size of the spot, None where it is left out."""
    if "spot_exit_m" not in data:
        return None
    exit_diameter = _positive(data["spot_exit_m"], "spot_exit_m")
    divergence = float(numbers(data.get("spot_divergence_rad", 0.0), (), "spot_divergence_rad"))
    if exit_diameter > 0.2 or not 0 <= divergence < 0.2:
        raise ValueError(f"a spot of {exit_diameter:g} m growing by {divergence:g} rad: millimetres? Divide by 1000")
    return exit_diameter, divergence


def model_to_json(model):
    """Intrinsics (or None) as they stand in session.json."""
    if model is None:
        return None
    out = {k: float(getattr(model, k)) for k in ("fx", "fy", "cx", "cy")}
    out["distortion"] = np.asarray(model.distortion, float).tolist()
    out["covariance"] = None if model.covariance is None else np.asarray(model.covariance).tolist()
    return {**out, "rms_px": model.rms_px}


def model_from_json(data, width, height):
    """Inverse of :func:`model_to_json`."""
    if data is None:
        return None
    focal = [_positive(data[k], k) for k in ("fx", "fy")]
    centre = [float(numbers(data[k], (), k)) for k in ("cx", "cy")]
    covariance = data.get("covariance")
    if covariance is not None:
        covariance = numbers(covariance, (9, 9), "covariance")
    rms = data.get("rms_px")
    distortion = numbers(data["distortion"], (5,), "distortion")
    return CameraModel(width, height, *focal, *centre, distortion, covariance, None if rms is None else float(rms))


def camera_to_json(camera):
    """A CameraInfo as it stands in session.json."""
    out = {"mount": camera.mount, "width": camera.width, "height": camera.height}
    return {**out, "intrinsics": model_to_json(camera.model), "guess": transform_to_json(camera.guess)}


def camera_from_json(name, data):
    """Inverse of :func:`camera_to_json`."""
    plain_name(name, "name of a camera")
    if data["mount"] not in MOUNTS:
        raise ValueError(f"camera '{name}': mount is one of {short(MOUNTS)}, got {data['mount']!r}")
    width, height = whole(data["width"], "width"), whole(data["height"], "height")
    if min(width, height) < 1 or width * height > LARGEST_IMAGE:
        limit = f"at most {LARGEST_IMAGE} pixels in all"
        raise ValueError(f"camera '{name}': width and height must be positive, {limit}, got {width} x {height}")
    model = model_from_json(data["intrinsics"], width, height)
    return CameraInfo(name, data["mount"], width, height, model, transform_from_json(data.get("guess")))
