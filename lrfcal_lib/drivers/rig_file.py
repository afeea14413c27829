"""The rig file (JSON): what is stated about a rig, where its devices are, what to record."""

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    Field,
    StrictBool,
    StrictInt,
    StrictStr,
    model_validator,
)

from lrfcal_lib.drivers.lms2xx_link import RATES
from lrfcal_lib.drivers.pelco_d import FASTEST
from lrfcal_lib.session.files import SessionError, read_json, short
from lrfcal_lib.session.stated import (
    SessionStated,
    StatedRig,
    parse_session,
    refused,
    repeated,
)
from lrfcal_lib.session.write import ABOUT

MOST_STOPS = 5000
FINEST_DEG = 1e-3
MOST_PLACEMENTS = 1000
ROUNDING_DEG = 1e-6  # by which a pitch may exceed the limits of the head
OTHER_RATE = (
    "one of 9600, 19200, 38400, 500000 is needed, the rates of a SICK LMS2xx: no other range "
    "finder is driven here; record it by a program of your own that writes a session "
    "(lrfcal_lib.session.write.SessionWriter)"
)
STOPS = f"first, last, and a step of {FINEST_DEG:g} or more for 2 to {MOST_STOPS} stops are needed"


class RigFileError(ValueError):
    """A rig file that cannot be used: the message names the file, the key, the value and what to do
    about it.
    """


# ------------------------------------------------------------------------------ kinds of values


def number(least, most):
    """A number within limits; NaN is in none, and true is no number."""
    return Annotated[float, Field(ge=least, le=most, strict=True, allow_inf_nan=False)]


def whole(least, most):
    """A whole number within limits."""
    return Annotated[int, Field(ge=least, le=most, strict=True)]


def no_text(value):
    """Whether nothing is said, or something that cannot be printed."""
    return type(value) is not str or not value or not value.isprintable()


def no_source(value):
    """Whether a value names no camera."""
    return no_text(value) and not (type(value) is int and 0 <= value <= 255)


def stops_of(sweep: tuple[float, float, float]) -> np.ndarray:
    """Pitch angles of a sweep: its ends are met, its step is not exceeded.

    Parameters
    ----------
    sweep
        First, last, step, degrees.

    Returns
    -------
    ndarray, shape (n,)
        Radians; none where the step is too small.
    """
    first, last, step = sweep
    count = 0
    if step >= FINEST_DEG:
        count = math.ceil(round(abs(last - first) / step, 6)) + 1
    if count > MOST_STOPS:
        count = 0
    return np.radians(np.linspace(first, last, count))


Text = Annotated[StrictStr, refused(no_text, "a text is needed")]
Source = Annotated[
    Any, refused(no_source, "a text, or a whole number from 0 to 255 is needed")
]
Rate = Annotated[StrictInt, refused(lambda rate: rate not in RATES, OTHER_RATE)]
Perhaps = Literal["auto", True, False]
Angle = number(-180, 180)
Seconds = number(0, 60)
Limits = Annotated[
    tuple[Angle, Angle],
    refused(lambda ends: ends[0] >= ends[1], "the lower one comes first"),
]
Sweep = Annotated[
    tuple[Angle, Angle, Angle], refused(lambda sweep: len(stops_of(sweep)) < 2, STOPS)
]
Speed = number(0.01, 360)
Speeds = Annotated[
    tuple[Speed, Speed],
    BeforeValidator(lambda up: up if isinstance(up, tuple | list) else (up, up)),
]

# ------------------------------------------------------------------------------------- devices


def said(data):
    """What an object states: null is as good as left out."""
    return {key: value for key, value in data.items() if value is not None}


class Stated(BaseModel, frozen=True):
    """An object of a rig file: null is as good as left out, and other keys are refused."""

    @model_validator(mode="before")
    @classmethod
    def known(cls, data):
        """The values that are stated."""
        if not isinstance(data, dict):
            return data
        for key in data:
            if key not in cls.model_fields:
                raise ValueError(
                    f"{key} is not known; known are {', '.join(cls.model_fields)}"
                )
        return said(data)


class LrfDevice(Stated):
    """Where the laser range finder is, and how it is to be set."""

    port: Text
    baudrate: Rate = None
    address: whole(0, 127) = None
    variant: tuple[number(0.25, 180), number(0.25, 180)] = None
    unit: Literal["mm", "cm"] = None
    measuring_mode: whole(0, 6) = None
    realtime_indices: StrictBool = None
    interlaced: StrictBool = None


class HeadSettings(Stated):
    """Settings of a Pelco-D head; ValueError for values that no head can have.

    Nothing is published about the Ya An YA3050, so all defaults are assumptions.
    """

    address: whole(0, 255) = 1  # the usual factory setting of the DIP switches
    baudrate: whole(50, 4_000_000) = 2400  # the most common default; 9600 is the next
    # Whether it tells its tilt (query 53). "auto" asks; most cheap heads never answer. A rig file
    # that does not state it means true: a silent head may as well be one with another address or
    # rate.
    feedback: Perhaps = "auto"
    # Whether it obeys set-tilt (4D). "auto" tries where there is feedback; else up and down are
    # used.
    absolute: Perhaps = "auto"
    # Asking for more is an error. The protocol knows no limits; typical heads tilt by -90 to 90.
    pitch_limits_deg: Limits = (-60.0, 60.0)
    # elevation that the head tells at pitch 0
    position_zero_deg: number(-360, 360) = 0.0
    # It hangs upside down or counts the other way: its "up" lowers the view.
    invert: StrictBool = False
    tilt_speed: whole(0, FASTEST) = 0x20  # speed byte, 0 is very slow
    # At `tilt_speed`, both ways or (up, down). Not stated: 4 is assumed, as of constant-speed
    # heads, until it was learnt, and the log says so.
    degrees_per_second: Speeds = None
    # where a head without feedback stands at first: levelled by hand
    start_pitch_deg: Angle = 0.0
    # Readings that differ by less are the same: cheap encoders jitter.
    tolerance_deg: number(1e-4, 45) = 0.1
    settle_s: Seconds = 0.3  # the head rests when its readings stay the same for this long
    poll_s: Seconds = 0.1  # between queries while it moves
    reply_s: number(1e-3, 10) = 0.35  # until a reply begins; 1 is needed by slow heads
    # silence between frames, and time for an acknowledgement
    gap_s: number(0, 10) = 0.05
    retries: whole(0, 20) = 3  # queries repeated when no reply came
    # below 1 for heads that stop by themselves without
    repeat_s: number(1e-3, 60) = None

    def elevation(self, pitch: float) -> float:
        """What the head calls a pitch.

        Parameters
        ----------
        pitch
            Radians, up positive.

        Returns
        -------
        float
            Radians.
        """
        if self.invert:
            pitch = -pitch
        return math.radians(self.position_zero_deg) + pitch

    def pitch(self, elevation: float) -> float:
        """The pitch of an elevation that the head tells.

        Parameters
        ----------
        elevation
            Radians.

        Returns
        -------
        float
            Radians, half a turn at most, up positive.
        """
        pitch = elevation - math.radians(self.position_zero_deg)
        if self.invert:
            pitch = -pitch
        return math.remainder(pitch, math.tau)


class HeadDevice(HeadSettings):
    """Where the head is, and its settings."""

    port: Text
    feedback: Perhaps = True


class CameraDevice(Stated):
    """Where a camera is, and how it is to be set."""

    source: Source
    size: tuple[whole(1, 100_000), whole(1, 100_000)] = None
    exposure: number(1e-6, 60) = None
    silence_s: number(0.1, 3600) = None


class Devices(Stated):
    """The devices of a rig, and the address of an emulated one, which places its board."""

    lrf: LrfDevice
    head: HeadDevice
    cameras: dict[str, CameraDevice] = {}
    control: Text = None

    @model_validator(mode="after")
    def ports(self):
        """Each device has a port of its own."""
        if self.lrf.port == self.head.port:
            raise ValueError(
                f"lrf.port and head.port are both {self.lrf.port}: each device has its own"
            )
        return self


# ---------------------------------------------------------------------------------------- plan


class ListedPlacement(Stated):
    """A placement of the plan; a board of false is a scene without one, one that is closing ends
    with a scan back in its first half, what is left out is as in the plan.
    """

    number: whole(0, 999_999) = None
    pitch_deg: Sweep = None
    image_pitch_deg: tuple[Angle, ...] = None
    board: StrictBool = True
    closing: StrictBool = False


@dataclass(frozen=True)
class Placement:
    """What is recorded while the board stays where it is."""

    number: int
    # where scans are taken, radians, in the order of motion; of a continuous sweep its ends
    pitch: np.ndarray
    image_pitch: tuple[float, ...]  # where images are taken, radians
    purpose: str = "board"  # of the images, or "scene"
    # back in its first half a last scan shows whether all stood still
    closing: bool = False

    @property
    def descends(self) -> bool:
        """Whether it is swept downwards."""
        return bool(self.pitch[-1] < self.pitch[0])


class Plan(Stated):
    """What is to be recorded.

    Of `count` placements, where none are listed, every other one is swept the other way, which
    shows the play of the gear; `sweep_speed` is the speed byte of the head in continuous sweeps, by
    default its `tilt_speed`; `intrinsics_images` are those of the board held close to each camera,
    before the placements.
    """

    pitch_deg: Sweep = (-30.0, 10.0, 0.5)
    image_pitch_deg: tuple[Angle, ...] = (0.0,)
    mode: Literal["stop-and-go", "continuous"] = "stop-and-go"
    scans_per_stop: whole(1, 1000) = 1
    sweep_speed: whole(0, 63) = None
    count: whole(1, 1000) = 12
    intrinsics_images: whole(0, 1000) = 0
    placements: tuple[ListedPlacement, ...] = Field(
        default=(), fail_fast=True, max_length=MOST_PLACEMENTS
    )

    @model_validator(mode="after")
    def numbered(self):
        """Placements have different numbers."""
        numbers = [placement.number for placement in self.to_do()]
        if repeated(numbers):
            raise ValueError(f"placements: numbers must differ, got {numbers}")
        return self

    def to_do(self, count: int | None = None) -> list[Placement]:
        """The placements to record, in order.

        Parameters
        ----------
        count
            Only so many of them; where none are listed also more than the plan has.
        """
        listed = self.placements or [ListedPlacement()] * (count or self.count)
        placements = []
        for i, entry in enumerate(listed[:count], 1):
            stops = stops_of(entry.pitch_deg or self.pitch_deg)
            if not self.placements and i % 2 == 0:
                stops = stops[::-1]
            images = self.image_pitch_deg
            if entry.image_pitch_deg is not None:
                images = entry.image_pitch_deg
            placements.append(
                Placement(
                    number=i if entry.number is None else entry.number,
                    pitch=stops,
                    image_pitch=tuple(map(math.radians, images)),
                    purpose="board" if entry.board else "scene",
                    closing=entry.closing,
                )
            )
        return placements


# ------------------------------------------------------------------------------------ rig file


@dataclass(frozen=True)
class RigFile(StatedRig):
    """A rig file; RigFileError if its head or its laser range finder cannot do the plan."""

    path: Path
    about: dict  # licence, source, simulated
    devices: Devices
    plan: Plan

    def __post_init__(self):
        low, high = self.devices.head.pitch_limits_deg
        for placement in self.plan.to_do():
            angles = np.degrees([*placement.pitch, *placement.image_pitch])
            if angles.min() < low - ROUNDING_DEG or angles.max() > high + ROUNDING_DEG:
                raise RigFileError(
                    f"{self.path}: plan: placement {placement.number} asks for a pitch of "
                    f"{angles.min():g} to {angles.max():g} deg, devices.head.pitch_limits_deg are "
                    f"{low:g} to {high:g}: ask for less"
                )
        if self.plan.mode == "continuous" and self.devices.lrf.interlaced:
            raise RigFileError(
                f"{self.path}: devices.lrf.interlaced is true: the four scans of a set need the "
                "head at rest, use the mode stop-and-go, or a variant of 0.5 or 1 deg"
            )


class RigFileStated(SessionStated):
    """All of a rig file: what session.json states, and more."""

    devices: Devices
    plan: Plan = Plan()


def read_rig_file(path: str | os.PathLike) -> RigFile:
    """Read and check a rig file.

    Parameters
    ----------
    path
        Of the file.

    Raises
    ------
    RigFileError
        With the file, the key and the value, for anything that cannot be used.
    """
    try:
        return rig_of(read_json(path, None), Path(path))
    except SessionError as error:
        raise RigFileError(
            f"{error}; 'python -m lrfcal_lib emulate --rig-file' writes an example"
        ) from error


def rig_of(data: dict, path: Path = Path("rig.json")) -> RigFile:
    """The rig file that parsed JSON makes.

    Parameters
    ----------
    data
        As of ``json.loads``.
    path
        For messages.

    Raises
    ------
    RigFileError
        With the path, the key and the value, for anything that cannot be used.
    """
    try:
        stated = parse_session(
            {
                **ABOUT,
                "name": "rig",
                "source": f"recorded with {path.name}",
                **said(data),
                "placements": (),
            },
            RigFileStated,
        )
        _check_cameras(stated["devices"].cameras, stated["cameras"])
    except ValueError as error:
        raise RigFileError(f"{path}: {error}") from error
    about = {key: stated[key] for key in ("licence", "source", "simulated")}
    rest = ("board", "lrf", "T_head_lrf", "platform_sigma", "cameras", "devices", "plan")
    return RigFile(path=path, about=about, **{key: stated[key] for key in rest})


def _check_cameras(devices, cameras):
    """Refuse cameras of the devices that are not those of the rig."""
    if set(devices) != set(cameras):
        raise ValueError(
            f"devices.cameras are {short(devices)}, rig.cameras "
            f"{short(cameras)}: every camera stands in both"
        )
    for name, info in cameras.items():
        size = devices[name].size
        if size not in (None, (info.width, info.height)):
            raise ValueError(
                f"devices.cameras.{name}.size is {list(size)}, rig.cameras.{name} states "
                f"{[info.width, info.height]}: leave it out"
            )
