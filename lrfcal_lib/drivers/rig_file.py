"""The rig file: what is stated about a rig, where its devices are, and what is to be recorded
(JSON).
"""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    Field,
    StrictBool,
    StrictStr,
    model_validator,
)
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.drivers.lms2xx_link import RATES
from lrfcal_lib.drivers.pelco_d import FASTEST
from lrfcal_lib.model.board import Board
from lrfcal_lib.session.stated import CameraInfo, LrfInfo, SessionStated, parse_session, refused

MOST_STOPS = 5000
FINEST_DEG = 1e-3
MOST_BYTES = 10_000_000
MOST_PLACEMENTS = 1000
STOPS = f"first, last, and a step of {FINEST_DEG:g} or more for 2 to {MOST_STOPS} stops are needed"


class RigFileError(ValueError):
    """A rig file that cannot be used: the message names the file, the key, the value and what to do
    about it.
    """


class Stated(BaseModel, frozen=True):
    """An object of a rig file: null is as good as left out, and keys that it does not have are
    refused.
    """

    @model_validator(mode="before")
    @classmethod
    def known(cls, data):
        """The values that are stated."""
        for key in data if isinstance(data, dict) else ():
            if key not in cls.model_fields:
                raise ValueError(f"{key} is not known; known are {', '.join(cls.model_fields)}")
        return {k: v for k, v in data.items() if v is not None} if isinstance(data, dict) else data


def number(least, most, unit="", kinds=(int, float), what="a number"):
    """A number within limits; NaN is in none, and true is no number."""
    words = f"{what} from {least} to {most} {unit}".rstrip() + " is needed"
    return Annotated[
        Any, refused(lambda value: type(value) not in kinds or not least <= value <= most, words)
    ]


def whole(least, most):
    """A whole number within limits."""
    return number(least, most, kinds=(int,), what="a whole number")


def several(kind, count):
    """So many values of a kind."""
    return Annotated[
        tuple[kind, ...],
        refused(lambda values: len(values) != count, f"a list of {count} is needed"),
    ]


Text = Annotated[
    StrictStr, refused(lambda text: not text.isprintable() or not text, "a text is needed")
]
Angle = number(-180, 180, "deg")
Perhaps = Literal["auto", True, False]
Near = number(1e-4, 45, "deg")
Seconds = number(0, 60, "s")
Speed = number(0.01, 360, "deg/s")
ORDER = "the lower one comes first"


OTHER_RATE = (
    "one of 9600, 19200, 38400, 500000 is needed, the rates of a SICK LMS2xx: no other range "
    "finder is driven here; record it by a program of your own that writes a session "
    "(lrfcal_lib.session.write.SessionWriter)"
)


class LrfDevice(Stated):
    """Where the laser range finder is, and how it is to be set."""

    port: Text
    baudrate: Annotated[
        Any, refused(lambda rate: type(rate) is not int or rate not in RATES, OTHER_RATE)
    ] = None
    address: whole(0, 127) = None
    password: Annotated[
        Text,
        AfterValidator(str.encode),
        refused(lambda raw: len(raw) != 8, "8 ASCII characters are needed"),
    ] = None
    variant: several(number(0.25, 180, "deg"), 2) = None
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
    # Whether the adapter hands sent bytes back, as two-wire RS-485 may. Echoes are always removed;
    # true makes a missing one an error (the adapter is dead), false makes one a warning.
    echo: Perhaps = "auto"
    # Asking for more is an error. The protocol knows no limits; typical heads tilt by -90 to 90.
    pitch_limits_deg: Annotated[
        several(Angle, 2), refused(lambda ends: ends[0] >= ends[1], ORDER)
    ] = (-60.0, 60.0)
    position_zero_deg: number(-360, 360, "deg") = 0.0  # elevation that the head tells at pitch 0
    invert: StrictBool = (
        False  # it hangs upside down or counts the other way: its "up" lowers the view
    )
    tilt_speed: whole(0, FASTEST) = 0x20  # speed byte, 0 is very slow
    # At `tilt_speed`, both ways or (up, down). Not stated: 4 is assumed, as of constant-speed
    # heads, until it was learnt, and the log says so.
    degrees_per_second: Annotated[
        several(Speed, 2), BeforeValidator(lambda v: v if isinstance(v, tuple | list) else (v, v))
    ] = None
    start_pitch_deg: Angle = 0.0  # where a head without feedback stands at first: levelled by hand
    tolerance_deg: Near = 0.1  # readings that differ by less are the same: cheap encoders jitter
    settle_s: Seconds = 0.3  # the head rests when its readings stay the same for this long
    poll_s: Seconds = 0.1  # between queries while it moves
    reply_s: number(1e-3, 10, "s") = 0.35  # until a reply begins; 1 is needed by slow heads
    gap_s: number(0, 10, "s") = 0.05  # silence between frames, and time for an acknowledgement
    retries: whole(0, 20) = 3  # queries repeated when no reply came
    repeat_s: number(1e-3, 60, "s") = None  # below 1 for heads that stop by themselves without
    # a call waits this long for a vanished port to come back
    reconnect_s: number(0, 3600, "s") = 3.0

    def elevation(self, pitch):
        """What the head calls a pitch, rad."""
        return math.radians(self.position_zero_deg) + (-pitch if self.invert else pitch)

    def pitch(self, elevation):
        """The pitch of an elevation that the head tells, rad, in [-pi, pi)."""
        turn = (elevation - math.radians(self.position_zero_deg) + math.pi) % math.tau - math.pi
        return -turn if self.invert else turn


class HeadDevice(HeadSettings):
    """Where the head is, and its settings."""

    port: Text
    feedback: Literal["auto", True, False] = True


class CameraDevice(Stated):
    """Where a camera is, and how it is to be set."""

    source: Annotated[
        Any,
        refused(
            lambda v: (
                not (type(v) is int and 0 <= v <= 255 or type(v) is str and v and v.isprintable())
            ),
            "a text, or a whole number from 0 to 255 is needed",
        ),
    ]
    size: several(whole(1, 100_000), 2) = None
    exposure: number(1e-6, 60, "s") = None
    silence_s: number(0.1, 3600, "s") = None


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


def stops_of(sweep):
    """Pitch angles of a sweep (first, last, step; deg), radians: its ends are met, its step is not
    exceeded.
    """
    first, last, step = sweep
    count = math.ceil(round(abs(last - first) / step, 6)) + 1 if step >= FINEST_DEG else 0
    return np.radians(np.linspace(first, last, count if count <= MOST_STOPS else 0))


Sweep = Annotated[several(Angle, 3), refused(lambda sweep: len(stops_of(sweep)) < 2, STOPS)]


class ListedPlacement(Stated):
    """A placement of the plan; a board of false is a scene without one, what is left out is as in
    the plan.
    """

    number: whole(0, 999_999) = None
    pitch_deg: Sweep = None
    image_pitch_deg: tuple[Angle, ...] = None
    board: StrictBool = True


@dataclass(frozen=True)
class Placement:
    """What is recorded while the board stays where it is."""

    number: int
    # where scans are taken, radians, in the order of motion; of a continuous sweep its ends
    pitch: np.ndarray
    image_pitch: tuple[float, ...]  # where images are taken, radians
    purpose: str = "board"  # of the images, or "scene"

    @property
    def direction(self):
        """+1 for a sweep upwards, -1 downwards."""
        return 1 if self.pitch[-1] >= self.pitch[0] else -1


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
    placements: Annotated[
        tuple[ListedPlacement, ...], Field(fail_fast=True, max_length=MOST_PLACEMENTS)
    ] = ()

    @model_validator(mode="after")
    def numbered(self):
        """Placements have different numbers."""
        numbers = [one.number for one in self.to_do()]
        if len(set(numbers)) < len(numbers):
            raise ValueError(f"placements: numbers must differ, got {numbers}")
        return self

    def to_do(self, count=None):
        """The placements to record, in order, a list of Placement; only so many of them if that is
        given.
        """
        listed = self.placements or [ListedPlacement()] * (count or self.count)
        found = []
        for i, one in enumerate(listed[:count], 1):
            stops = stops_of(one.pitch_deg or self.pitch_deg)
            images = self.image_pitch_deg if one.image_pitch_deg is None else one.image_pitch_deg
            stops = stops if self.placements or i % 2 else stops[::-1]
            number = i if one.number is None else one.number
            purpose = "board" if one.board else "scene"
            found.append(Placement(number, stops, tuple(map(math.radians, images)), purpose))
        return found


@dataclass(frozen=True)
class RigFile:
    """A rig file; RigFileError if its head or its laser range finder cannot do the plan."""

    path: Path
    about: dict  # licence, source, simulated
    board: Board
    lrf: LrfInfo
    T_head_lrf: RigidTransform | None
    # how well the platform is known: direction (radians) and offset (metres)
    platform_sigma: tuple[float, float]
    cameras: dict[str, CameraInfo]
    devices: Devices
    plan: Plan

    def __post_init__(self):
        low, high = self.devices.head.pitch_limits_deg
        for placement in self.plan.to_do():
            asked = np.degrees([*placement.pitch, *placement.image_pitch])
            if asked.min() < low - 1e-6 or asked.max() > high + 1e-6:
                raise RigFileError(
                    f"{self.path}: plan: placement {placement.number} asks for a pitch of "
                    f"{asked.min():g} to {asked.max():g} deg, devices.head.pitch_limits_deg are "
                    f"{low:g} to {high:g}: ask for less"
                )
        if self.plan.mode == "continuous" and self.devices.lrf.interlaced:
            raise RigFileError(
                f"{self.path}: devices.lrf.interlaced is true: the four scans of a set need the "
                "head at rest, use the mode stop-and-go, or a variant of 0.5 or 1 deg"
            )

    def with_mode(self, mode):
        """The same with another mode of the plan (None: its own)."""
        return (
            self
            if mode is None
            else replace(self, plan=self.plan.model_copy(update={"mode": mode}))
        )


def read_rig_file(path):
    """Read and check a rig file.

    Returns
    -------
    RigFile

    Raises
    ------
    RigFileError
        With the file, the key and the value, for anything that cannot be used.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MOST_BYTES or not path.is_file():
            raise RigFileError(
                f"{path}: no file, or one of more than {MOST_BYTES} bytes: name a rig file"
            )
        data = json.loads(path.read_bytes())
    except OSError as error:
        hint = "'python -m lrfcal_lib emulate --rig-file' writes an example"
        raise RigFileError(f"{path}: {error.strerror}; {hint}") from error
    except (ValueError, RecursionError) as error:
        raise RigFileError(f"{path}: not JSON ({error})") from error
    return rig_of(data, path)


class RigFileStated(SessionStated):
    """All of a rig file: what session.json states, and more."""

    devices: Devices
    plan: Plan = Plan()


def rig_of(data, path=Path("rig.json")):
    """A RigFile of parsed JSON, with a path for messages; RigFileError for a wrong one."""
    try:
        if not isinstance(data, dict):
            raise ValueError(f"the file is {ascii(data)[:80]}: an object is needed")
        given = (
            {"name": "rig", "licence": "", "source": "", "simulated": False}
            | data
            | {"placements": ()}
        )
        stated = parse_session({k: v for k, v in given.items() if v is not None}, RigFileStated)
        devices = stated["devices"].cameras
        cameras = stated["cameras"]
        if set(devices) != set(cameras):
            raise ValueError(
                f"devices.cameras are {', '.join(devices) or 'none'}, rig.cameras "
                f"{', '.join(cameras) or 'none'}: every camera stands in both"
            )
        for name, info in cameras.items():
            if devices[name].size not in (None, (info.width, info.height)):
                raise ValueError(
                    f"devices.cameras.{name}.size is {list(devices[name].size)}, "
                    f"rig.cameras.{name} states {[info.width, info.height]}: leave it out"
                )
    except (ValueError, RecursionError) as error:
        raise RigFileError(f"{path}: {error}") from error
    about = {key: stated[key] for key in ("licence", "source", "simulated")}
    rest = ("board", "lrf", "T_head_lrf", "platform_sigma", "cameras", "devices", "plan")
    return RigFile(Path(path), about, **{key: stated[key] for key in rest})
