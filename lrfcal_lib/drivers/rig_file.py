"""The rig file: what is stated about a rig, where its devices are, and what is to be recorded (JSON)."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from functools import reduce
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.drivers.head import ANGLE, HeadSettings
from lrfcal_lib.drivers.stated import (
    FLAG,
    OBJECT,
    TEXT,
    Kind,
    check,
    either,
    kinds,
    listed,
    need,
    number,
    one_of,
    whole,
)
from lrfcal_lib.model.board import Board
from lrfcal_lib.session.stated import CameraInfo, LrfInfo, parse_session

MODES = ("stop-and-go", "continuous")
PURPOSES = ("board", "scene")
MOST_STOPS, FINEST_DEG, MOST_BYTES = 5000, 1e-3, 10_000_000
HEAD = kinds(HeadSettings)
DEVICES = {"lrf": OBJECT, "head": OBJECT, "cameras": OBJECT, "control": TEXT}
LRF = {
    "port": TEXT, "baudrate": one_of(9600, 19200, 38400, 500000), "address": whole(0, 127),
    "password": Kind("a text of 8 ASCII characters", lambda v: TEXT.fits(v) and v.isascii() and len(v) == 8),
    "variant": listed(number(0.25, 180, "deg"), 2), "unit": one_of("mm", "cm"), "measuring_mode": whole(0, 6),
    "realtime_indices": FLAG, "interlaced": FLAG,
}  # fmt: skip
CAMERA = {
    "source": either(TEXT, whole(0, 255)), "size": listed(whole(1, 100_000), 2), "exposure": number(1e-6, 60, "s"),
    "fps": number(0.01, 10_000, "Hz"), "silence_s": number(0.1, 3600, "s"),
}  # fmt: skip
SWEEP, IMAGES, NUMBER = listed(ANGLE, 3), listed(ANGLE), whole(0, 999_999)
PLACEMENT = {"number": NUMBER, "pitch_deg": SWEEP, "image_pitch_deg": IMAGES, "board": FLAG}
PLAN = {
    "pitch_deg": SWEEP, "image_pitch_deg": IMAGES, "mode": one_of(*MODES), "scans_per_stop": whole(1, 1000),
    "sweep_speed": HEAD["tilt_speed"], "count": whole(1, 1000), "intrinsics_images": whole(0, 1000),
    "placements": Kind("a list of at most 1000 objects", lambda v: isinstance(v, list | tuple) and len(v) <= 1000),
}  # fmt: skip


class RigFileError(ValueError):
    """A rig file that cannot be used: the message names the file, the key, the value and what to do about it."""


@dataclass(frozen=True)
class Placement:
    """What is recorded while the board stays where it is.

    Attributes
    ----------
    number : int
    pitch : ndarray, shape (n,)
        Where scans are taken, radians, in the order of motion; of a continuous sweep its ends.
    image_pitch : tuple of float
        Where images are taken, radians.
    purpose : {'board', 'scene'}
        Of the images.
    """

    number: int
    pitch: np.ndarray
    image_pitch: tuple[float, ...]
    purpose: str = "board"

    @property
    def direction(self):
        """+1 for a sweep upwards, -1 downwards."""
        return 1 if self.pitch[-1] >= self.pitch[0] else -1


@dataclass(frozen=True)
class Plan:
    """What is to be recorded.

    Attributes
    ----------
    pitch_deg : (float, float, float)
        First and last pitch and the step between the stops of a sweep.
    image_pitch_deg : tuple of float
    mode : {'stop-and-go', 'continuous'}
    scans_per_stop : int
    sweep_speed : int or None
        Speed byte of the head in continuous sweeps; None for the head's `tilt_speed`.
    count : int
        Of placements, where none are listed; every other one is swept the other way, which shows the play of the gear.
    intrinsics_images : int
        Of the board held close to each camera, before the placements.
    placements : tuple of dict
        Listed placements: number, pitch_deg, image_pitch_deg, board (false: a scene without a board).
    """

    pitch_deg: tuple[float, float, float] = (-30.0, 10.0, 0.5)
    image_pitch_deg: tuple[float, ...] = (0.0,)
    mode: str = "stop-and-go"
    scans_per_stop: int = 1
    sweep_speed: int | None = None
    count: int = 12
    intrinsics_images: int = 0
    placements: tuple[dict, ...] = ()

    def __post_init__(self):
        check(vars(self), PLAN, "plan")
        self.to_do()

    def to_do(self, count=None):
        """The placements to record, in order.

        Parameters
        ----------
        count : int, optional
            Only so many of them.

        Returns
        -------
        list of Placement
        """
        if self.placements:
            listed = [self._listed(one, i) for i, one in enumerate(self.placements)]
            if len({one.number for one in listed}) < len(listed):
                raise ValueError(f"plan.placements: numbers must differ, got {[one.number for one in listed]}")
            return listed[:count]
        stops, images = _stops(self.pitch_deg, "plan.pitch_deg"), _angles(self.image_pitch_deg)
        way = {0: slice(None, None, -1), 1: slice(None)}
        return [Placement(n, stops[way[n % 2]], images) for n in range(1, 1 + (count or self.count))]

    def _listed(self, one, i):
        where = f"plan.placements[{i}]"
        one = check(one, PLACEMENT, where)
        stops = _stops(one.get("pitch_deg", self.pitch_deg), f"{where}.pitch_deg")
        images = _angles(one.get("image_pitch_deg", self.image_pitch_deg))
        number = one.get("number", i + 1)
        return Placement(number, stops, images, PURPOSES[not one.get("board", True)])


@dataclass(frozen=True)
class RigFile:
    """A rig file.

    Attributes
    ----------
    path : Path
    about : dict
        licence, source, simulated.
    board : Board
    lrf : LrfInfo
    T_head_lrf : RigidTransform or None
    platform_sigma : (float, float)
        How well it is known: direction (radians) and offset (metres).
    cameras : dict of str to CameraInfo
    lrf_device : dict
        Keys of `LRF`.
    head_device : str
        Its port.
    head_settings : HeadSettings
    camera_devices : dict of str to dict
        Keys of `CAMERA`, by camera.
    control : str or None
        Control socket of an emulated rig.
    plan : Plan
    """

    path: Path
    about: dict
    board: Board
    lrf: LrfInfo
    T_head_lrf: RigidTransform | None
    platform_sigma: tuple[float, float]
    cameras: dict[str, CameraInfo]
    lrf_device: dict
    head_device: str
    head_settings: HeadSettings
    camera_devices: dict[str, dict]
    control: str | None = None
    plan: Plan = field(default_factory=Plan)

    def with_mode(self, mode):
        """The same with another mode of the plan (None: its own)."""
        return self if mode is None else checked(replace(self, plan=replace(self.plan, mode=mode)))


def read_rig_file(path):
    """Read and check a rig file.

    Parameters
    ----------
    path : path-like

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
            raise RigFileError(f"{path}: no file, or one of more than {MOST_BYTES} bytes: name a rig file")
        data = json.loads(path.read_bytes())
    except OSError as error:
        hint = "'python -m lrfcal_lib emulate --rig-file' writes an example"
        raise RigFileError(f"{path}: {error.strerror}; {hint}") from error
    except (ValueError, RecursionError) as error:
        raise RigFileError(f"{path}: not JSON ({error})") from error
    try:
        return checked(rig_of(data, path))
    except (TypeError, AttributeError, ValueError, ArithmeticError, LookupError, RecursionError) as error:
        raise RigFileError(f"{path}: {error}") from error


def rig_of(data, path=Path("rig.json")):
    """A RigFile of parsed JSON; TypeError, ValueError or ArithmeticError for a wrong one.

    Parameters
    ----------
    data : dict
    path : Path
        For messages.

    Returns
    -------
    RigFile
    """
    need(OBJECT, data, "the file")
    about = {"name": "rig", "licence": "", "source": "", "simulated": False, "placements": ()}
    data = _named({**about, **data})
    for where in ("board", "rig", "rig.lrf", "rig.platform", "rig.cameras"):
        need(OBJECT, reduce(lambda at, key: at[key], where.split("."), data), where)
    stated = parse_session(data)
    devices = check(data["devices"], DEVICES, "devices", ("lrf", "head"))
    lrf = check(devices["lrf"], LRF, "devices.lrf", ("port",))
    head = check(devices["head"], {"port": TEXT, **HEAD}, "devices.head", ("port",))
    if lrf["port"] == head["port"]:
        raise ValueError(f"devices.lrf.port and devices.head.port are both {lrf['port']}: each device has its own")
    cameras = {name: check(one, CAMERA, f"devices.cameras.{name}", ("source",))
               for name, one in devices.get("cameras", {}).items()}  # fmt: skip
    _same_cameras(cameras, stated["cameras"])
    return RigFile(
        path=Path(path),
        about={key: stated[key] for key in ("licence", "source", "simulated")},
        **{key: stated[key] for key in ("board", "lrf", "T_head_lrf", "platform_sigma", "cameras")},
        lrf_device=lrf,
        head_device=head.pop("port"),
        head_settings=HeadSettings(**_tuples({"feedback": True, **head})),
        camera_devices=cameras,
        control=devices.get("control"),
        plan=Plan(**_tuples(check(data.get("plan") or {}, PLAN, "plan"))),
    )


def checked(rig):
    """A RigFile whose plan its head and its laser range finder can do; RigFileError otherwise."""
    low, high = rig.head_settings.pitch_limits_deg
    for placement in rig.plan.to_do():
        asked = np.degrees([*placement.pitch, *placement.image_pitch])
        if asked.min() < low - 1e-6 or asked.max() > high + 1e-6:
            raise RigFileError(
                f"{rig.path}: plan: placement {placement.number} asks for a pitch of {asked.min():g} to "
                f"{asked.max():g} deg, devices.head.pitch_limits_deg are {low:g} to {high:g}: ask for less"
            )
    if rig.plan.mode == "continuous" and rig.lrf_device.get("interlaced"):
        raise RigFileError(
            f"{rig.path}: devices.lrf.interlaced is true: the four scans of a set need the head at rest, "
            "use the mode stop-and-go, or a variant of 0.5 or 1 deg"
        )
    return rig


class _Named(dict):
    """An object of a file that says where it stands when a key is missing."""

    def __missing__(self, key):
        raise ValueError(f"{self.where}{key} is missing")


def _named(value, where=""):
    """Parsed JSON whose objects know where they stand."""
    if isinstance(value, list):
        return [_named(one, f"{where[:-1]}[{i}].") for i, one in enumerate(value)]
    if not isinstance(value, dict):
        return value
    named = _Named((key, _named(one, f"{where}{key}.")) for key, one in value.items())
    named.where = where
    return named


def _tuples(values):
    return {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}


def _same_cameras(devices, stated):
    if set(devices) != set(stated):
        raise ValueError(
            f"devices.cameras are {', '.join(devices) or 'none'}, rig.cameras {', '.join(stated) or 'none'}: "
            "every camera stands in both"
        )
    for name, info in stated.items():
        size, known = devices[name].get("size"), [info.width, info.height]
        if size is not None and size != known:
            raise ValueError(f"devices.cameras.{name}.size is {size}, rig.cameras.{name} states {known}: leave it out")


def _stops(values, where):
    """Pitch angles of a sweep, radians: its ends are met, its step is not exceeded."""
    first, last, step = values
    count = math.ceil(round(abs(last - first) / step, 6)) + 1 if step >= FINEST_DEG else 0
    if not 1 < count <= MOST_STOPS:
        raise ValueError(
            f"{where} is {list(values)}: first, last, and a step of {FINEST_DEG:g} or more for 2 to {MOST_STOPS} stops"
        )
    return np.radians(np.linspace(first, last, count))


def _angles(values):
    return tuple(math.radians(v) for v in values)
