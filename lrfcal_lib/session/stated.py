"""session.json, and how files of a session are opened: within its folder, and bounded."""

import json
import math
import os
import re
import stat
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import pydantic
from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, FiniteFloat, PlainSerializer
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import Board, Chessboard
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.session.shown import printable

LARGEST_FILE = 64_000_000  # bytes of any file of a session
SPLIT = "split the recording into several sessions"
FILES = (  # of any session, besides its images
    "session.json",
    "lrf/scans.npz",
    "lrf/telegrams.bin",
    "lrf/index.csv",
    "images.csv",
    "edges.csv",
    "platform.csv",
    "truth.json",
)
KINDS = {
    "l": "a link",
    "d": "a folder",
    "p": "a named pipe",
    "s": "a socket",
    "b": "a device",
    "c": "a device",
}


class SessionError(ValueError):
    """A session on disk that cannot be used: the message names the file, the value and what to do
    about it.
    """

    def __init__(self, text):
        text = printable(text)
        super().__init__(text if len(text) < 2000 else f"{text[:1000]} [...] {text[-500:]}")


def checked(file, within, make=False):
    """A file of a session; SessionError where a folder on the way to it is none, such as a link."""
    where = Path(within)
    for part in Path(file).relative_to(within).parts[:-1]:
        where /= part
        if make:
            where.mkdir(exist_ok=True)
        _refuse_other(where, where.lstat(), "d", "a folder")
    return Path(file)


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

    Raises
    ------
    SessionError
        If the file, or a folder between it and the session's, is a link, or the file is none (a
        pipe, a device), too large to be read, or to be written and known by another name as well
        (a hard link, maybe outside).
    OSError
        If it cannot be opened.
    """
    file = Path(file)
    writes = flags != os.O_RDONLY
    if within is not None:
        checked(file, within)
        flags |= os.O_NOFOLLOW
    with suppress(FileNotFoundError):  # a device is not even opened
        found = os.stat(file, follow_symlinks=within is None)
        _refuse_other(file, found, "-", "a file")
        if not writes and found.st_size > most:
            raise SessionError(
                f"{file}: {found.st_size / 1e6:.0f} MB, more than {most / 1e6:.0f} MB; {SPLIT}"
            )
    inner = os.open(file, flags | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    mode = "rb"
    if writes:
        mode = "r+b" if flags & os.O_RDWR else "wb"
    stream = os.fdopen(inner, mode)
    if writes and os.fstat(inner).st_nlink > 1:
        stream.close()
        remedy = "copy the session's folder and write to the copy"
        raise SessionError(f"{file}: has another name elsewhere (a hard link); {remedy}")
    return stream


def _refuse_other(file, status, kind, wanted):
    """Refuse what is no plain file (or folder), such as a link."""
    if (found := stat.filemode(status.st_mode)[0]) != kind:
        what = KINDS.get(found, "a file")
        raise SessionError(
            f"{file}: is {what}, not {wanted}: a session holds plain files; put {wanted} in its "
            "place"
        )


MOST_VALUES = 12_000_000  # of all scan lines, so that reading them takes less than 500 MB
LARGEST_TEXT = 8_000_000  # bytes of a JSON or CSV file
DEEPEST_JSON = 30  # levels


@contextmanager
def reading(file, remedy):
    """Turn whatever other people's code says about the content of a file into a SessionError.

    Any exception is meant, so nothing but calls of other people's code belongs inside: ours has to
    show its mistakes.
    """
    try:
        yield
    except SessionError:
        raise
    except Exception as error:
        raise SessionError(
            f"{file}: {remedy.format(str(error) or type(error).__name__)}"
        ) from error


@contextmanager
def naming(file):
    """Turn whatever goes wrong with values of a file into a SessionError that begins with the
    file's name.
    """
    try:
        yield
    except SessionError:
        raise
    except KeyError as error:
        raise SessionError(f"{file}: key {error} is missing") from error
    except (TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise SessionError(f"{file}: {error}") from error


def read_bytes(file, within=None, most=LARGEST_FILE):
    """Content of a file of a session (see :func:`opened`); a SessionError where it cannot
    be read.
    """
    try:
        with opened(file, within, most=most) as stream:
            data = stream.read(most + 1)
    except OSError as error:
        raise SessionError(f"{file}: {error.strerror}; the session needs this file") from error
    if len(data) > most:  # files of the system do not tell their size
        raise SessionError(f"{file}: more than {most / 1e6:.0f} MB; {SPLIT}")
    return data


def read_json(file, within):
    """The object in a JSON file."""
    text = read_bytes(file, within, LARGEST_TEXT)
    with reading(file, "not JSON ({}); truncated, or edited by hand?"):
        data = json.loads(text.decode())
    if not isinstance(data, dict):
        raise SessionError(
            f"{file}: holds a {type(data).__name__}, expected an object with the key 'schema'"
        )
    inner = [data]
    for _ in range(DEEPEST_JSON):
        inner = [
            v
            for x in inner
            if isinstance(x, dict | list)
            for v in (x.values() if isinstance(x, dict) else x)
        ]
    if inner:
        raise SessionError(
            f"{file}: nested deeper than {DEEPEST_JSON} levels; was this written by a program?"
        )
    return data


def check_amount(values):
    """Refuse more ranges and other values of scan lines than reading has memory for."""
    if values > MOST_VALUES:
        raise ValueError(f"{values} values of scan lines, more than {MOST_VALUES}; {SPLIT}")


def short(values):
    """Values as text for a message, the middle of long lists left out."""
    values = [str(v) for v in values]
    return ", ".join(values if len(values) < 13 else [*values[:6], "...", *values[-3:]]) or "none"


SCHEMA = "lrfcal-session/1"
LARGEST_IMAGE = 30_000_000  # pixels
MOST_CORNERS = 1000  # of a pattern, or of a board's outline
LONGEST_BOARD = 20.0  # metres
MOST_CAMERAS = 100
MILLIMETRES = "millimetres? Divide by 1000; inches? Multiply by 0.0254"
# metres, by part of the model's name: systematic error of a range up to 10 m according to SICK
# (technical description of LMS200, 211 and 221 in millimetre mode; support page "Measurement Errors
# LMSxxx"; data sheet of TiM55x and TiM56x)
SYSTEMATIC_ERROR = {
    "LMS1": 0.040,
    "LMS200": 0.015,
    "LMS211": 0.035,
    "LMS221": 0.035,
    "LMS5": 0.025,
    "TiM5": 0.060,
}
# of other models (no sheet of the LMS291 and LMS400 was at hand), and of those that count
# centimetres: so many standard deviations or steps of a range; the sheets above admit 2 to 4.2, and
# 4 to 5 steps of a centimetre
ASSUMED_SYSTEMATIC_ERROR = 5.0
ASSUMED_SPOT_RADIUS = 0.005  # metres; only the unit of the edge bias where nobody stated the spot


def in_words(error):
    """The first mistake that pydantic found: where, value, what is needed."""
    first = error.errors(include_url=False)[0]
    where = ".".join(map(str, first["loc"])) or "it"
    kind = first["type"]
    value = ascii(first["input"])
    if kind == "missing":
        return f"{where} is missing"
    found = f"{where} is {value if len(value) < 100 else value[:80] + ' ...'}"
    found = where if isinstance(first["input"], dict) else found
    if kind == "value_error":
        return f"{found}: {first['ctx']['error']}"
    needed = (
        "an object"
        if kind in ("model_type", "dataclass_type")
        else first["msg"].removeprefix("Input should be ")
    )
    large = kind.startswith("less_than") and re.search(r"_m\b", where)  # the key tells the unit
    return f"{found}: {needed} is needed" + f"; {MILLIMETRES}" * bool(large)


adapter = lru_cache(pydantic.TypeAdapter)


def from_json(kind, data):
    """What is stated in JSON as one of the types below; ValueError in words for anything else."""
    try:
        return adapter(kind).validate_python(data)
    except pydantic.ValidationError as error:
        raise ValueError(in_words(error)) from None


def refused(wrong, words):
    """A check that raises ValueError with these words where a value is wrong."""

    def check(value):
        if wrong(value):
            raise ValueError(words)
        return value

    return AfterValidator(check)


NOT_PLAIN = "this becomes a file name: letters, digits, '_', '-' and '.' only"
TWICE = "placements are different numbers"
NOT_SHOWN = "names of edges stand in figures: no line ends, no '$' (a formula)"
Name = Annotated[
    str, refused(lambda name: not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name), NOT_PLAIN)
]
EdgeName = Annotated[str, refused(lambda name: "$" in name or not name.isprintable(), NOT_SHOWN)]
Whole = Annotated[int, Field(ge=0, le=1_000_000)]
Inner = Annotated[int, Field(ge=3, le=MOST_CORNERS)]
Positive = Annotated[FiniteFloat, Field(gt=0)]
Length = Annotated[FiniteFloat, Field(gt=0, le=1)]
Angle = Annotated[
    FiniteFloat, AfterValidator(math.radians), PlainSerializer(lambda a: round(math.degrees(a), 9))
]
Step = Annotated[Angle, Field(gt=0)]  # radians here, degrees in the file
Pair, Triple, Lens, Row = (tuple[(FiniteFloat,) * n] for n in (2, 3, 5, 9))


class TransformStated(BaseModel):
    """A transform as it stands in a file."""

    rotation_vector_rad: Triple
    translation_m: tuple[(Annotated[FiniteFloat, Field(ge=-10, le=10)],) * 3]

    def made(self):
        """As a RigidTransform."""
        return RigidTransform.from_components(
            self.translation_m, Rotation.from_rotvec(self.rotation_vector_rad)
        )


def transform_to_json(transform):
    """A RigidTransform (or None) as rotation vector and translation."""
    if transform is None:
        return None
    turn = transform.rotation.as_rotvec().tolist()
    shift = transform.translation.tolist()
    return {"rotation_vector_rad": turn, "translation_m": shift}


Transform = Annotated[TransformStated, AfterValidator(TransformStated.made)] | None


def plain(values):
    """As JSON has them: lists for arrays and tuples."""
    return json.loads(json.dumps(values, default=lambda array: array.tolist()))


class LensStated(BaseModel):
    """Intrinsics as they stand in a file."""

    fx: Positive
    fy: Positive
    cx: FiniteFloat
    cy: FiniteFloat
    distortion: Lens
    covariance: tuple[(Row,) * 9] | None = None
    rms_px: FiniteFloat | None = None

    def made(self, width, height):
        """As a CameraModel."""
        covariance = None if self.covariance is None else np.array(self.covariance)
        pinhole = self.fx, self.fy, self.cx, self.cy
        return CameraModel(
            width, height, *pinhole, np.array(self.distortion), covariance, self.rms_px
        )


def model_to_json(model):
    """Intrinsics (or None) as they stand in session.json."""
    return model and plain({name: getattr(model, name) for name in LensStated.model_fields})


class PatternStated(BaseModel):
    """A chessboard as it stands in a file."""

    kind: Literal["chessboard"]
    columns: Inner
    rows: Inner
    square_m: Length
    origin_m: Pair = (0.0, 0.0)

    def made(self):
        """As a Chessboard."""
        if self.columns * self.rows > MOST_CORNERS:
            raise ValueError(f"a chessboard has up to {MOST_CORNERS} inner corners in all")
        return Chessboard(self.columns, self.rows, self.square_m, self.origin_m)


class BoardStated(BaseModel):
    """A board as it stands in a file."""

    name: str
    edges: Annotated[
        tuple[EdgeName, ...], Field(fail_fast=True, min_length=3, max_length=MOST_CORNERS)
    ]
    features: tuple[str, str]
    corners_m: Annotated[tuple[Pair, ...], Field(fail_fast=True)] | None
    pattern: Annotated[PatternStated, AfterValidator(PatternStated.made)] | None

    def made(self):
        """As a Board."""
        corners = None if self.corners_m is None else np.array(self.corners_m)
        if len(set(self.edges)) < len(self.edges):
            raise ValueError("the edges need different names")
        if len(set(self.features) & set(self.edges)) != 2:
            given = "none" if not any(self.features) else short(map(repr, self.features))
            needed = (
                f"features must be two different edges of {short(self.edges)}, at a right angle"
            )
            raise ValueError(f"{needed}; got {given}")
        if corners is not None and len(corners) != len(self.edges):
            raise ValueError(
                f"corners_m must be one corner for each of {len(self.edges)} edges, got "
                f"{len(corners)}"
            )
        if corners is not None and np.ptp(corners, axis=0).max() > LONGEST_BOARD:
            raise ValueError(
                f"the board is {np.ptp(corners, axis=0).max():g} m large: {MILLIMETRES}"
            )
        return Board(self.name, self.edges, corners, self.pattern, self.features)


def board_to_json(board):
    """A board as it stands in session.json."""
    p = board.pattern
    grid = p and {"kind": "chessboard", "columns": p.columns, "rows": p.rows}
    named = {
        "name": board.name,
        "edges": board.edges,
        "features": board.features,
        "corners_m": board.corners,
    }
    return plain(named | {"pattern": p and grid | {"square_m": p.square, "origin_m": p.origin}})


def board_from_json(data):
    """Inverse of :func:`board_to_json`; ValueError for a wrong one."""
    return from_json(BoardStated, data).made()


StatedBoard = Annotated[BoardStated, AfterValidator(BoardStated.made)]


View = Annotated[
    tuple[Angle, Angle],
    refused(
        lambda v: not v[0] < v[1] <= v[0] + 2 * math.pi + 1e-9,
        "two ascending bearings within a turn are needed",
    ),
]
Endless = Annotated[
    float,  # null in the file where there is no limit
    BeforeValidator(lambda metres: math.inf if metres is None else metres),
    Field(gt=0),
    PlainSerializer(lambda metres: metres if math.isfinite(metres) else None),
]


@dataclass(frozen=True)
class LrfInfo:
    """What is known about the laser range finder, read from the device or its data, never from the
    model's name.

    Attributes
    ----------
    model : str
    field_of_view : tuple of float
        First and last bearing it can measure, radians (0 right, pi/2 ahead).
    bearing_step : float
        Radians between neighbouring beams.
    sigma_range, sigma_bearing : float
        Standard deviations of a range, metres, and of a bearing, radians (0 where unknown).
    range_resolution : float
        Step of the recorded ranges, metres.
    max_range : float
        Metres.
    spot_exit, spot_divergence : float or None
        Diameter of the spot at the window (metres) and its growth with distance (radians), from the
        maker's data sheet.
    systematic_error : float or None
        Largest offset of all ranges that the maker admits, metres.
    """

    model: str
    field_of_view: Annotated[View, Field(alias="field_of_view_deg")]
    bearing_step: Annotated[Step, Field(alias="bearing_step_deg")]
    sigma_range: Annotated[Length, Field(alias="sigma_range_m")]
    sigma_bearing: Annotated[Angle, Field(alias="sigma_bearing_deg")] = 0.0
    range_resolution: Annotated[FiniteFloat, Field(alias="range_resolution_m")] = 0.001
    max_range: Annotated[Endless, Field(alias="max_range_m")] = math.inf
    systematic_error: Annotated[Positive | None, Field(alias="systematic_error_m")] = None
    spot_exit: Annotated[FiniteFloat | None, Field(alias="spot_exit_m", gt=0, le=0.2)] = None
    spot_divergence: Annotated[
        FiniteFloat | None, Field(alias="spot_divergence_rad", ge=0, lt=0.2)
    ] = None

    @property
    def admitted_offset(self):
        """The largest range offset that the maker admits, metres: stated, or known of the model, or
        assumed.
        """
        known = [value for name, value in SYSTEMATIC_ERROR.items() if name in self.model]
        if not known or self.range_resolution > 0.005:
            known = [ASSUMED_SYSTEMATIC_ERROR * max(self.sigma_range, self.range_resolution)]
        return self.systematic_error or known[0]

    def spot_radius(self, distance):
        """Radius of the spot at a distance, metres; 5 mm everywhere where the spot is not
        stated.
        """
        if self.spot_exit is None:
            return np.full(np.shape(distance), ASSUMED_SPOT_RADIUS)
        return (self.spot_exit + (self.spot_divergence or 0.0) * np.asarray(distance, float)) / 2


def lrf_to_json(lrf):
    """An LrfInfo as it stands in session.json (degrees there)."""
    return adapter(LrfInfo).dump_python(lrf, by_alias=True, exclude_none=True)


def _few_pixels(height, info):
    if height * info.data.get("width", 0) > LARGEST_IMAGE:
        raise ValueError(f"at most {LARGEST_IMAGE} pixels are needed in all")
    return height


def _lens(lens, info):
    return lens and lens.made(info.data.get("width"), info.data.get("height"))


if TYPE_CHECKING:
    Lens = CameraModel | None
else:  # stated without the size of the image, which stands beside it
    Lens = Annotated[
        LensStated | None,
        AfterValidator(_lens),
        PlainSerializer(model_to_json),
        Field(alias="intrinsics"),
    ]


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
        Roughly measured ``T_camera_lrf`` (mount 'head') or ``T_camera_platform`` (mount
        'platform').
    """

    name: Annotated[Name, Field(exclude=True)]  # the key of the object in the file
    mount: Literal["head", "platform"]
    width: Annotated[int, Field(ge=1)]
    height: Annotated[int, Field(ge=1), AfterValidator(_few_pixels)]
    model: Lens = None
    guess: Annotated[Transform, PlainSerializer(transform_to_json)] = None


def camera_to_json(camera):
    """A CameraInfo as it stands in session.json."""
    return adapter(CameraInfo).dump_python(camera, by_alias=True)


def _with_names(cameras):
    if not isinstance(cameras, dict) or len(cameras) > MOST_CAMERAS:
        raise ValueError(f"an object of at most {MOST_CAMERAS} cameras is needed")
    return {
        name: camera | {"name": name} if isinstance(camera, dict) else camera
        for name, camera in cameras.items()
    }


class PlatformStated(BaseModel):
    """The platform and how well it is known as they stand in a file."""

    T_head_lrf: Transform
    sigma_direction: Annotated[Step, Field(alias="sigma_direction_deg")] = math.radians(0.5)
    sigma_offset: Annotated[Length, Field(alias="sigma_offset_m")] = 0.010
    continuous: bool = False


class RigStated(BaseModel):
    """The devices as they stand in a file."""

    lrf: LrfInfo
    platform: PlatformStated
    cameras: Annotated[dict[str, CameraInfo], BeforeValidator(_with_names)]


class SessionStated(BaseModel):
    """All of session.json."""

    name: Name
    licence: str
    source: str
    simulated: bool
    board: StatedBoard
    rig: RigStated
    placements: Annotated[
        tuple[Whole, ...], Field(fail_fast=True), refused(lambda p: len(set(p)) < len(p), TWICE)
    ]
    reference: dict = {}
    unfinished: Annotated[tuple[Whole, ...], Field(fail_fast=True)] | None = None


def parse_session(data, kind=SessionStated):
    """The statements of session.json (or more of its `kind`) as fields of a Session; ValueError for
    a wrong one.
    """
    found = dict(from_json(kind, data))
    rig = dict(found.pop("rig"))
    platform = rig.pop("platform")
    sigma = platform.sigma_direction, platform.sigma_offset
    of_platform = {
        "T_head_lrf": platform.T_head_lrf,
        "platform_sigma": sigma,
        "continuous": platform.continuous,
    }
    return found | rig | of_platform
