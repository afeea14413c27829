"""A whole emulated rig: laser range finder, head and cameras that look at one simulated world."""

from __future__ import annotations

import math
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from lrfcal_lib.drivers.emulators.camera import CameraServer, scaled
from lrfcal_lib.drivers.emulators.control import ControlSocket
from lrfcal_lib.drivers.emulators.line import Clock
from lrfcal_lib.drivers.emulators.lms2xx import EmulatedLms
from lrfcal_lib.drivers.emulators.pelco_d import EmulatedHead
from lrfcal_lib.drivers.emulators.world import EmulatedWorld
from lrfcal_lib.session import CameraInfo, LrfInfo, board_to_json, transform_to_json
from lrfcal_lib.session.stated import SCHEMA, camera_to_json, lrf_to_json
from lrfcal_lib.simulate.beam import LARGEST_WORD
from lrfcal_lib.simulate.rig import SETUPS

SILENCE_S = 600.0  # that says nothing about an emulated camera: it sends no image while the head moves
FIRMWARE = {"LMS200": "V02.19 ", "LMS211": "X01.27 ", "LMS221": "X01.27 "}


class EmulatedRig:
    """The devices of a simulated setup, as files and addresses that any program can open.

    Parameters
    ----------
    setup : str or Setup
    folder : path-like, optional
        Where the ports `lrf` and `head` and the socket `control` appear; a new temporary folder by default.
    seed : int
        Of noise and faults; the world follows from the setup's own seed.
    placements : sequence of Placement, optional
        Where the board can be put, see :class:`EmulatedWorld`.
    time_scale : float
        Seconds of the devices in a second of the host; 1 is safe. Up to 8 does for stop-and-go. A stream of scans
        leaves some out, with a warning, where this machine is too slow for it, as with a head that moves. The instants
        of scans need a host clock that runs as fast (`clock` of `LMS2xx.open` and `Rig.open`): by another one they
        are off by tenths of a second.
    lrf_options : dict, optional
        Of :class:`EmulatedLms`.
    head_options : dict, optional
        Of :class:`EmulatedHead`: feedback, reply, echo, speeds, ...
    platform : dict, optional
        What differs from the setup's Platform: backlash, settle, noise, ...
    cameras : bool
        Whether there are cameras.
    image_width : int, optional
        Pixels; the field of view stays.
    quality, fps, rest_s
        Of :class:`CameraServer`.

    Attributes
    ----------
    lrf : EmulatedLms
    pan_tilt : EmulatedHead
    world : EmulatedWorld
    lrf_port, head_port, control : str
        Paths.
    camera_urls : dict of str to str
    faults : dict of str to Faults
        'lrf' and 'head'.
    scans : deque of ScanRecord

    Examples
    --------
    >>> with EmulatedRig("sim_quick", cameras=False) as rig:  # doctest: +SKIP
    ...     rig.place(1)
    """

    def __init__(self, setup="sim_quick", *, folder=None, seed=0, placements=None, time_scale=1.0, lrf_options=None,
                 head_options=None, platform=None, cameras=True, image_width=None, quality=97, fps=8.0,
                 rest_s=0.5):  # fmt: skip
        setup = _setup(setup)
        rig = replace(setup.rig, platform=replace(setup.rig.platform, **(platform or {})))
        setup, self.clock = replace(setup, rig=rig), Clock(time_scale)
        self.setup = setup if image_width is None else replace(setup, rig=scaled(rig, image_width))
        self._own = None if folder else tempfile.mkdtemp(prefix="lrfcal-")
        self.folder = Path(folder or self._own)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.world = EmulatedWorld(setup, self.clock, seed, placements)
        shared = {"clock": self.clock, "seed": seed}
        model = rig.beam.name.split("-")[0]
        options = {"model": f"{model};302063;{FIRMWARE[model]}", **(lrf_options or {})}
        self.lrf = EmulatedLms(self.world, path=self.folder / "lrf", **shared, **options)
        self.pan_tilt = EmulatedHead(self.world.head, path=self.folder / "head", **shared, **(head_options or {}))
        self.faults, self.scans = {"lrf": self.lrf.faults, "head": self.pan_tilt.faults}, self.lrf.scans
        self.lrf_port, self.head_port = self.lrf.path, self.pan_tilt.path
        shown = {"quality": quality, "fps": fps, "seed": seed, "rest_s": rest_s}
        self._cameras = CameraServer(self.world, self.setup, **shown) if cameras else None
        self.camera_urls = self._cameras.urls if cameras else {}
        self.control = str(self.folder / "control")
        self._socket = ControlSocket(self.control, self)

    def start(self):
        """Let all devices appear."""
        for part in self._parts():
            part.start()
        return self

    def close(self):
        """Remove all devices, and the folder where it was made here."""
        for part in reversed(self._parts()):
            part.close()
        if self._own:
            shutil.rmtree(self._own, ignore_errors=True)

    def _parts(self):
        return [p for p in (self.lrf, self.pan_tilt, self._cameras, self._socket) if p is not None]

    __enter__ = start

    def __exit__(self, *_):
        self.close()

    # ------------------------------------------------------------------------------------------- what can be done

    def place(self, number):
        """Put the board at a placement of the setup, or take it away (None)."""
        self.world.put(number)

    def hold_close(self, camera, view):
        """Hold the board close to a camera, for its intrinsics; at pitch 0 the whole pattern is in the image."""
        self.world.hold_close(camera, view)

    def pitch(self, time_s=None):
        """True pitch now, or at instants of the host's clock (time.time()), radians."""
        instant = self.clock.now() if time_s is None else self.clock.device(time_s)
        return self.world.head.pitch(instant)

    def truth(self):
        """What only the simulator knows, as JSON."""
        return self.world.truth()

    def error(self):
        """What ended a device by itself, None while all live."""
        return self.lrf.line.error or self.pan_tilt.line.error or (self._cameras and self._cameras.error)

    def status(self):
        """The devices now, as JSON."""
        memory = self.lrf.memory
        return {
            "place": list(self.world.place.key),
            "pitch_deg": round(math.degrees(float(self.pitch())), 4),
            "lrf": {"baudrate": memory.baudrate, "mode": memory.mode, "variant": list(memory.variant),
                    "unit": memory.configuration.unit, "scans": len(self.scans), "line": self.lrf.line.counts},
            "head": {"baudrate": self.pan_tilt.baudrate, "frames": len(self.pan_tilt.frames),
                     "line": self.pan_tilt.line.counts},
        }  # fmt: skip

    # ------------------------------------------------------------------------------------------- the rig file

    def plan(self):
        """What a recording of this rig can do: the sweep that holds all placements, and each of them."""
        step = math.degrees(self.setup.step)
        each = [_planned(p, self.setup) for p in self.world.placements.values()]
        boards = [p for p in each if p["board"]] or each
        ends = np.array([p["pitch_deg"][:2] for p in boards])
        images = np.unique(np.round(np.concatenate([p["image_pitch_deg"] for p in boards])))
        return {
            "mode": "stop-and-go",
            "scans_per_stop": 1,
            "intrinsics_images": self.setup.intrinsics_views if self.camera_urls else 0,
            "pitch_deg": [math.floor(ends.min()), math.ceil(ends.max()), step],
            "image_pitch_deg": images.tolist(),
            "placements": each,
        }

    def rig_file(self):
        """Statement of the rig for recording, as JSON: board and rig as in session.json, devices, plan."""
        rig, beam = self.setup.rig, self.setup.rig.beam
        cameras = {c.name: camera_to_json(_camera_info(c)) for c in rig.cameras} if self.camera_urls else {}
        named = {"schema": SCHEMA, "name": f"{self.setup.name}_emulated", "licence": "CC-BY-4.0", "simulated": True}
        platform = {"T_head_lrf": transform_to_json(rig.T_head_lrf_stated)}
        return {
            **named,
            "source": f"emulated rig of the setup '{self.setup.name}', seed {self.setup.seed}",
            "board": board_to_json(rig.board),
            "rig": {"lrf": lrf_to_json(_lrf_info(beam)), "platform": platform, "cameras": cameras},
            "devices": self._devices(),
            "plan": self.plan(),
        }

    def _devices(self):
        beam, low_high = self.setup.rig.beam, np.degrees(self.setup.rig.platform.limits)
        size = {c.name: [c.model.width, c.model.height] for c in self.setup.rig.cameras}
        return {
            "lrf": {"port": self.lrf_port, "baudrate": 500000, "variant": [beam.field_of_view, beam.resolution / 100],
                    "unit": "mm" if beam.unit < 0.005 else "cm", "interlaced": False},
            "head": {"port": self.head_port, "address": self.pan_tilt.address, "baudrate": self.pan_tilt.baudrate,
                     "feedback": self.pan_tilt.reply_kind != "none", "pitch_limits_deg": low_high.round(6).tolist()},
            "cameras": {name: {"source": url, "size": size[name], "silence_s": SILENCE_S}
                        for name, url in self.camera_urls.items()},
            "control": self.control,
        }  # fmt: skip


def _setup(setup):
    if not isinstance(setup, str):
        return setup
    if setup not in SETUPS:
        raise ValueError(f"no set-up '{setup}'; there are {', '.join(SETUPS)}")
    return SETUPS[setup]()


def _planned(placement, setup):
    board = placement.T_platform_board is not None
    step = math.degrees(setup.step if board or not setup.room_sweep else setup.room_sweep[2])
    first, last = np.degrees(placement.sweep).round(4).tolist()
    images = np.degrees(placement.image_pitch).round(4).tolist()
    return {"number": placement.number, "board": board, "pitch_deg": [first, last, step], "image_pitch_deg": images}


def _camera_info(camera):
    return CameraInfo(camera.name, camera.mount, camera.model.width, camera.model.height, None, camera.guess)


def _lrf_info(beam):
    bearings = beam.bearings()
    view, step = (float(bearings[0]), float(bearings[-1])), math.radians(beam.resolution / 100)
    return LrfInfo(
        f"{beam.name} (emulated)", view, step, beam.sigma_range, range_resolution=beam.unit,
        max_range=LARGEST_WORD * beam.unit, spot=(beam.spot_exit, beam.divergence),
    )  # fmt: skip
