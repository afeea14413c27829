"""The rig file: what is stated about a rig, where its devices are, and what is to be recorded (JSON)."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.board import Board
from lrfcal_lib.drivers.head_settings import HeadSettings
from lrfcal_lib.session import CameraInfo, LrfInfo
from lrfcal_lib.session.stated import parse_session

MODES = ("stop-and-go", "continuous")
PURPOSES = ("board", "scene")
LRF_KEYS = ("port", "baudrate", "address", "password", "variant", "unit", "measuring_mode", "realtime_indices",
            "interlaced")  # fmt: skip
CAMERA_KEYS = ("source", "size", "exposure", "fps", "silence_s")
DEVICE_KEYS = ("lrf", "head", "cameras", "control")
MOST_STOPS = 5000


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
        if self.mode not in MODES:
            raise ValueError(f"plan.mode is {self.mode!r}: it is {' or '.join(MODES)}")
        for name, least in (("scans_per_stop", 1), ("count", 1), ("intrinsics_images", 0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"plan.{name} is {value!r}: a whole number of {least} or more is needed")
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
        stops, images = _stops(self.pitch_deg, "plan.pitch_deg"), _angles(self.image_pitch_deg, "plan.image_pitch_deg")
        way = {0: slice(None, None, -1), 1: slice(None)}
        return [Placement(n, stops[way[n % 2]], images) for n in range(1, 1 + (count or self.count))]

    def _listed(self, one, i):
        where = f"plan.placements[{i}]"
        _known(one, ("number", "pitch_deg", "image_pitch_deg", "board"), where)
        number = one.get("number", i + 1)
        if isinstance(number, bool) or not isinstance(number, int) or number < 0:
            raise ValueError(f"{where}.number is {number!r}: a whole number of 0 or more is needed")
        stops = _stops(one.get("pitch_deg", self.pitch_deg), f"{where}.pitch_deg")
        images = _angles(one.get("image_pitch_deg", self.image_pitch_deg), f"{where}.image_pitch_deg")
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
        Keys of `LRF_KEYS`.
    head_device : str
        Its port.
    head_settings : HeadSettings
    camera_devices : dict of str to dict
        Keys of `CAMERA_KEYS`, by camera.
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
        data = json.loads(path.read_text())
    except OSError as error:
        hint = "'python -m lrfcal_lib emulate --rig-file' writes an example"
        raise RigFileError(f"{path}: {error.strerror}; {hint}") from error
    except ValueError as error:
        raise RigFileError(f"{path}: not JSON ({error})") from error
    try:
        return checked(rig_of(data, path))
    except KeyError as error:
        raise RigFileError(f"{path}: key {error} is missing") from error
    except (TypeError, AttributeError, ValueError) as error:
        raise RigFileError(f"{path}: {error}") from error


def rig_of(data, path=Path("rig.json")):
    """A RigFile of parsed JSON; KeyError, TypeError or ValueError for a wrong one.

    Parameters
    ----------
    data : dict
    path : Path
        For messages.

    Returns
    -------
    RigFile
    """
    _object(data, "the file")
    about = {"name": "rig", "licence": "", "source": "", "simulated": False, "placements": ()}
    stated = parse_session({**about, **data})
    devices = _known(_member(data, "devices", "the file"), DEVICE_KEYS, "devices")
    lrf = _known(_member(devices, "lrf", "devices"), LRF_KEYS, "devices.lrf")
    head = dict(_object(_member(devices, "head", "devices"), "devices.head"))
    if lrf.get("port") is not None and lrf["port"] == head.get("port"):
        raise ValueError(f"devices.lrf.port and devices.head.port are both {lrf['port']}: each device has its own")
    cameras = _object(devices.get("cameras", {}), "devices.cameras")
    for name, one in cameras.items():
        _member(_known(one, CAMERA_KEYS, f"devices.cameras.{name}"), "source", f"devices.cameras.{name}")
    _same_cameras(cameras, stated["cameras"])
    return RigFile(
        path=Path(path),
        about={key: stated[key] for key in ("licence", "source", "simulated")},
        **{key: stated[key] for key in ("board", "lrf", "T_head_lrf", "platform_sigma", "cameras")},
        lrf_device=_lrf_device(lrf),
        head_device=_member(head, "port", "devices.head"),
        head_settings=_head_settings(head),
        camera_devices=cameras,
        control=devices.get("control"),
        plan=_plan(data.get("plan", {})),
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


def _lrf_device(lrf):
    _member(lrf, "port", "devices.lrf")
    if lrf.get("unit", "mm") not in ("mm", "cm"):
        raise ValueError(f"devices.lrf.unit is {lrf['unit']!r}: it is 'mm' or 'cm'")
    variant = lrf.get("variant")
    if variant is not None and (not isinstance(variant, list) or len(variant) != 2):
        raise ValueError(f"devices.lrf.variant is {variant!r}: field of view and resolution, such as [180, 0.5]")
    return lrf


def _head_settings(head):
    names = [f.name for f in fields(HeadSettings)]
    _known(head, ("port", *names), "devices.head")
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in head.items() if k != "port"}
    try:
        return HeadSettings(**values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"devices.head: {error}") from error


def _plan(plan):
    _known(plan, [f.name for f in fields(Plan)], "plan")
    return Plan(**{k: tuple(v) if isinstance(v, list) else v for k, v in plan.items()})


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
    first, last, step = _numbers(values, where, 3)
    count = math.ceil(round(abs(last - first) / step, 6)) + 1 if step > 0 else 0
    if not 1 < count <= MOST_STOPS:
        raise ValueError(f"{where} is {list(values)}: first, last, and a positive step for 2 to {MOST_STOPS} stops")
    return np.radians(np.linspace(first, last, count))


def _angles(values, where):
    return tuple(math.radians(v) for v in _numbers(values, where))


def _numbers(values, where, count=None):
    good = isinstance(values, list | tuple) and all(
        isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) and abs(v) <= 180 for v in values
    )
    if not good or len(values) != (len(values) if count is None else count):
        raise ValueError(f"{where} is {values!r}: a list of {count or 'finite'} numbers in degrees is needed")
    return values


def _object(value, where):
    if not isinstance(value, dict):
        raise ValueError(f"{where} is {value!r}: an object with keys is needed")
    return value


def _known(value, keys, where):
    for key in _object(value, where):
        if key not in keys:
            raise ValueError(f"{where}.{key} is not known; known are {', '.join(keys)}")
    return value


def _member(value, key, where):
    if key not in _object(value, where):
        raise ValueError(f"{where}.{key} is missing")
    return value[key]
