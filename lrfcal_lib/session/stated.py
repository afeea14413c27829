"""What session.json states, as records and as JSON."""

import json
import math
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import cv2
import numpy as np
import pydantic
from numpy.typing import ArrayLike
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    PlainSerializer,
    model_validator,
)
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import Board, Chessboard
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.session.files import short

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
# degrees between beams of LMS and TiM: parts of a full turn that the sensor's own disc divides, so
# that their scale has no error
SICK_STEPS = (0.1, 1 / 6, 0.2, 0.25, 1 / 3, 0.5, 2 / 3, 1.0)
SAME_STEP = 0.001  # of a step; one that is rounded to three digits
# standard deviation of other steps, a fraction: anything within 1 %, which nobody notices
ASSUMED_STEP_ERROR = 0.0058
# metres; only the unit of the edge bias where nobody stated the spot
ASSUMED_SPOT_RADIUS = 0.005


def in_words(error):
    """The first mistake that pydantic found: where, value, what is needed."""
    first = error.errors()[0]
    where = ".".join(map(str, first["loc"])) or "it"
    kind = first["type"]
    if kind == "missing":
        return f"{where} is missing"
    value = ascii(first["input"])
    found = f"{where} is {value if len(value) < 100 else value[:80] + ' ...'}"
    if isinstance(first["input"], dict):
        found = where
    if kind == "value_error":
        return f"{found}: {first['ctx']['error']}"
    needed = first["msg"].removeprefix("Input should be ")
    if kind in ("model_type", "dataclass_type"):
        needed = "an object"
    words = f"{found}: {needed} is needed"
    if kind.startswith("less_than") and re.search(r"_m\b", where):  # the key tells the unit
        words += f"; {MILLIMETRES}"
    return words


adapter = lru_cache(pydantic.TypeAdapter)


def from_json(kind: Any, data: Any) -> Any:
    """What is stated in JSON as one of the types below.

    Parameters
    ----------
    kind
        The type.
    data
        As JSON has it.

    Raises
    ------
    ValueError
        In words for anything else.
    """
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


def repeated(values):
    """Whether some of the values are the same."""
    return len(set(values)) < len(values)


NOT_PLAIN = "this becomes a file name: letters, digits, '_', '-' and '.' only"
NOT_SHOWN = "names of edges stand in figures: no line ends, no '$' (a formula)"
Name = Annotated[
    str,
    refused(lambda name: not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name), NOT_PLAIN),
]
EdgeName = Annotated[
    str, refused(lambda name: "$" in name or not name.isprintable(), NOT_SHOWN)
]
Whole = Annotated[int, Field(ge=0, le=1_000_000)]
Numbers = Annotated[tuple[Whole, ...], Field(fail_fast=True)]
Inner = Annotated[int, Field(ge=3, le=MOST_CORNERS)]
Positive = Annotated[FiniteFloat, Field(gt=0)]
Length = Annotated[FiniteFloat, Field(gt=0, le=1)]
Angle = Annotated[
    FiniteFloat,
    AfterValidator(math.radians),
    PlainSerializer(lambda a: round(math.degrees(a), 9)),
]
Step = Annotated[Angle, Field(gt=0)]  # radians here, degrees in the file
AsArray = AfterValidator(np.array)
Pair, Triple, Lens, Row = (tuple[(FiniteFloat,) * n] for n in (2, 3, 5, 9))


class TransformStated(BaseModel):
    """A transform as it stands in a file; it becomes a RigidTransform."""

    rotation_vector_rad: Triple
    translation_m: tuple[(Annotated[FiniteFloat, Field(ge=-10, le=10)],) * 3]

    @model_validator(mode="after")
    def made(self):
        """As a RigidTransform."""
        return RigidTransform.from_components(
            self.translation_m, Rotation.from_rotvec(self.rotation_vector_rad)
        )


def transform_to_json(transform: RigidTransform) -> dict:
    """A transform as rotation vector and translation, as it stands in files.

    Parameters
    ----------
    transform
    """
    return {
        "rotation_vector_rad": transform.rotation.as_rotvec().tolist(),
        "translation_m": transform.translation.tolist(),
    }


Transform = Annotated[TransformStated, PlainSerializer(transform_to_json)] | None


def plain(values):
    """As JSON has them: lists for arrays and tuples."""
    return json.loads(json.dumps(values, default=lambda array: array.tolist()))


class LensStated(BaseModel):
    """Intrinsics as they stand in a file."""

    fx: Positive
    fy: Positive
    cx: FiniteFloat
    cy: FiniteFloat
    distortion: Annotated[Lens, AsArray]
    covariance: Annotated[tuple[(Row,) * 9], AsArray] | None = None
    rms_px: FiniteFloat | None = None


def model_to_json(model: CameraModel) -> dict:
    """Intrinsics as they stand in session.json.

    Parameters
    ----------
    model
    """
    return plain({name: getattr(model, name) for name in LensStated.model_fields})


class PatternStated(BaseModel):
    """A chessboard as it stands in a file; it becomes a Chessboard."""

    kind: Literal["chessboard"]
    columns: Inner
    rows: Inner
    square_m: Length
    origin_m: Pair = (0.0, 0.0)

    @model_validator(mode="after")
    def made(self):
        """As a Chessboard."""
        if self.columns * self.rows > MOST_CORNERS:
            raise ValueError(f"a chessboard has up to {MOST_CORNERS} inner corners in all")
        return Chessboard(self.columns, self.rows, self.square_m, self.origin_m)


class BoardStated(BaseModel):
    """A board as it stands in a file; it becomes a Board."""

    name: str
    edges: tuple[EdgeName, ...] = Field(
        fail_fast=True, min_length=3, max_length=MOST_CORNERS
    )
    features: tuple[str, str]
    corners: Annotated[tuple[Pair, ...], Field(fail_fast=True), AsArray] | None = Field(
        alias="corners_m"
    )
    pattern: PatternStated | None

    @model_validator(mode="after")
    def made(self):
        """As a Board."""
        if repeated(self.edges):
            raise ValueError("the edges need different names")
        if len(set(self.features) & set(self.edges)) != 2:
            raise ValueError(
                f"features must be two different edges of {short(self.edges)}, at a right angle; "
                f"got {short(map(repr, filter(None, self.features)))}"
            )
        if self.corners is not None:
            if len(self.corners) != len(self.edges):
                raise ValueError(
                    f"corners_m must be one corner for each of {len(self.edges)} edges, got "
                    f"{len(self.corners)}"
                )
            size = np.ptp(self.corners, axis=0).max()
            if size > LONGEST_BOARD:
                raise ValueError(f"the board is {size:g} m large: {MILLIMETRES}")
            if self.pattern is not None:
                self._hold_pattern()
        return Board(**dict(self))

    def _hold_pattern(self):
        """Refuse a pattern that does not fit on the board, farther than outlines are wrong."""
        outline = self.corners.astype(np.float32)
        for x, y, _ in self.pattern.points():
            beyond = -cv2.pointPolygonTest(outline, (x, y), True)
            if beyond > self.pattern.square / 4:
                raise ValueError(
                    f"the pattern's inner corner at ({x:.3f}, {y:.3f}) m lies {1e3 * beyond:.0f} "
                    "mm outside the outline: check columns, rows, square_m and origin_m of the "
                    "pattern, and corners_m"
                )


def board_to_json(board: Board) -> dict:
    """A board as it stands in session.json.

    Parameters
    ----------
    board
    """
    return plain(
        {
            "name": board.name,
            "edges": board.edges,
            "features": board.features,
            "corners_m": board.corners,
            "pattern": board.pattern
            and {
                "kind": "chessboard",
                "columns": board.pattern.columns,
                "rows": board.pattern.rows,
                "square_m": board.pattern.square,
                "origin_m": board.pattern.origin,
            },
        }
    )


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


LRF_KEYS = {  # in the file, by field
    "model": "model",
    "field_of_view": "field_of_view_deg",
    "bearing_step": "bearing_step_deg",
    "sigma_range": "sigma_range_m",
    "sigma_bearing": "sigma_bearing_deg",
    "range_resolution": "range_resolution_m",
    "max_range": "max_range_m",
    "systematic_error": "systematic_error_m",
    "step_error": "angular_step_relative",
    "spot_exit": "spot_exit_m",
    "spot_divergence": "spot_divergence_rad",
}


def plainly_typed(kind: type) -> type:
    """A record whose help shows plain types, without the limits that pydantic reads."""
    kind.__init__.__annotations__ = get_type_hints(kind) | {"return": None}
    return kind


@plainly_typed
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
    step_error : float or None
        Standard deviation of the stated angular step, a fraction of it.
    """

    __pydantic_config__ = ConfigDict(alias_generator=LRF_KEYS.__getitem__)

    model: str
    field_of_view: View
    bearing_step: Step
    sigma_range: Length
    sigma_bearing: Angle = 0.0
    range_resolution: FiniteFloat = 0.001
    max_range: Endless = math.inf
    systematic_error: Positive | None = None
    step_error: Annotated[FiniteFloat | None, Field(ge=0, le=0.1)] = None
    spot_exit: Annotated[FiniteFloat | None, Field(gt=0, le=0.2)] = None
    spot_divergence: Annotated[FiniteFloat | None, Field(ge=0, lt=0.2)] = None

    @property
    def admitted_offset(self) -> float:
        """The largest range offset that the maker admits, metres: stated, or known, or assumed."""
        assumed = ASSUMED_SYSTEMATIC_ERROR * max(self.sigma_range, self.range_resolution)
        if self.range_resolution <= 0.005:
            for name, value in SYSTEMATIC_ERROR.items():
                if name in self.model:
                    assumed = value
        return self.systematic_error or assumed

    @property
    def step_sigma(self) -> float:
        """Standard deviation of the angular step, a fraction: stated, or none where the model has
        such a step, or assumed.
        """
        if self.step_error is not None:
            return self.step_error
        step = np.degrees(self.bearing_step)
        same = np.isclose(step, SICK_STEPS, rtol=SAME_STEP, atol=0)
        if same.any() and re.search("LMS|TiM", self.model):
            return 0.0
        return ASSUMED_STEP_ERROR

    def spot_radius(self, distance: ArrayLike) -> np.ndarray:
        """Radius of the spot, metres; ASSUMED_SPOT_RADIUS everywhere where the spot is not stated.

        Parameters
        ----------
        distance
            From the window, metres.
        """
        if self.spot_exit is None:
            return np.full(np.shape(distance), ASSUMED_SPOT_RADIUS)
        return (
            self.spot_exit + (self.spot_divergence or 0.0) * np.asarray(distance, float)
        ) / 2


def lrf_to_json(lrf: LrfInfo) -> dict:
    """A range finder as it stands in session.json (degrees there).

    Parameters
    ----------
    lrf
    """
    return adapter(LrfInfo).dump_python(lrf, by_alias=True, exclude_none=True)


def _few_pixels(height, info):
    if height * info.data.get("width", 0) > LARGEST_IMAGE:
        raise ValueError(f"at most {LARGEST_IMAGE} pixels are needed in all")
    return height


def _lens(lens, info):
    return CameraModel(info.data.get("width"), info.data.get("height"), **dict(lens))


if TYPE_CHECKING:
    Lens = CameraModel | None
else:  # stated without the size of the image, which stands beside it
    Lens = (
        Annotated[LensStated, AfterValidator(_lens), PlainSerializer(model_to_json)] | None
    )


@plainly_typed
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
    model: Annotated[Lens, Field(alias="intrinsics")] = None
    guess: Transform = None


@dataclass(frozen=True)
class StatedRig:
    """A rig and its board, as sessions and rig files state them.

    Attributes
    ----------
    board : Board
    lrf : LrfInfo
    T_head_lrf : RigidTransform or None
        The platform as its maker or a tape measure states it.
    platform_sigma : tuple of float
        How well: standard deviations of the axis' direction (radians) and offset (metres). Where
        nobody states them, 0.5 deg and 10 mm are assumed: what a set square and a ruler give.
    cameras : dict of str to CameraInfo
    """

    board: Board
    lrf: LrfInfo
    T_head_lrf: RigidTransform | None
    platform_sigma: tuple[float, float]
    cameras: dict[str, CameraInfo]


def rig_to_json(
    lrf: LrfInfo,
    T_head_lrf: RigidTransform | None,
    cameras: dict[str, CameraInfo],
    sigma: tuple[float, float] | None = None,
    continuous: bool = False,
) -> dict:
    """A rig as it stands in session.json.

    Parameters
    ----------
    lrf, T_head_lrf, cameras, sigma, continuous
        Fields of a Session; sigma is `platform_sigma`, radians and metres.
    """
    platform: dict[str, Any] = {"T_head_lrf": T_head_lrf}
    if sigma is not None:
        direction, offset = sigma
        platform |= {"sigma_direction": direction, "sigma_offset": offset}
    if continuous:
        platform["continuous"] = True
    return {
        "lrf": lrf_to_json(lrf),
        "platform": PlatformStated.model_construct(**platform).model_dump(
            by_alias=True, exclude_unset=True
        ),
        "cameras": adapter(dict[str, CameraInfo]).dump_python(cameras, by_alias=True),
    }


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
    sigma_direction: Step = Field(default=math.radians(0.5), alias="sigma_direction_deg")
    sigma_offset: Length = Field(default=0.010, alias="sigma_offset_m")
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
    board: BoardStated
    rig: RigStated
    placements: Annotated[Numbers, refused(repeated, "placements are different numbers")]
    reference: dict = {}
    unfinished: Numbers | None = None


def parse_session(data: dict, kind: type = SessionStated) -> dict:
    """The statements of session.json as fields of a Session.

    Parameters
    ----------
    data
        As JSON has it.
    kind
        SessionStated, or what states more.

    Raises
    ------
    ValueError
        For a wrong one.
    """
    facts = dict(from_json(kind, data))
    facts.update(facts.pop("rig"))
    platform = facts.pop("platform")
    return facts | {
        "T_head_lrf": platform.T_head_lrf,
        "platform_sigma": (platform.sigma_direction, platform.sigma_offset),
        "continuous": platform.continuous,
    }
