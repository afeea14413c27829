"""A whole emulated rig: its devices in one world, rigs for practice, ``python -m lrfcal_lib
emulate``.
"""

import contextlib
import json
import math
import os
import signal
import tempfile
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np

from lrfcal_lib.drivers.port import REAL
from lrfcal_lib.emulators.head import EmulatedHead
from lrfcal_lib.emulators.lms2xx import EmulatedLms
from lrfcal_lib.emulators.world import CameraServer, EmulatedWorld, scaled
from lrfcal_lib.session import stated
from lrfcal_lib.simulate.rig import PLACES, load_setup, pairs, random

# that says nothing about an emulated camera: it sends no image while the head moves
SILENCE_S = 600.0
LOOK_S = 0.5
PRACTICE = "practice"
SMALL = 400  # pixels of an image's width of the practice rig: its chessboard is still found at 2 m
MARGIN = np.radians(1.0)  # of a sweep beyond the board


class EmulatedRig:
    """The devices of a simulated setup, as files and addresses that any program can open; a context
    manager.

    Parameters
    ----------
    setup : Setup
    seed : int
        Of noise; the world follows from the setup's own seed.
    placements : sequence of Placement, optional
        Where the board can be put, see :class:`EmulatedWorld`.
    head_options : dict
        Of :class:`EmulatedHead`.
    rest_s
        Of :class:`CameraServer`.
    host : Host
        Whose time the devices live in, and whose ``terminal(device)`` their ports are.

    Examples
    --------
    >>> with EmulatedRig(load_setup("sim_quick")) as rig:  # doctest: +SKIP
    ...     rig.world.put(1)
    """

    def __init__(
        self,
        setup,
        *,
        seed=0,
        placements=None,
        head_options=None,
        rest_s=0.5,
        host=REAL,
    ):
        self.setup = setup
        self.host = host
        self._closing = contextlib.ExitStack()
        folder = tempfile.TemporaryDirectory(prefix="lrfcal-", ignore_cleanup_errors=True)
        self.folder = Path(self._closing.enter_context(folder))
        self.world = EmulatedWorld(setup, host, seed, placements)
        shared = {"host": host, "seed": seed}
        self.lrf = EmulatedLms(self.world, path=self.folder / "lrf", **shared)
        self.pan_tilt = EmulatedHead(
            self.world.head, path=self.folder / "head", **shared, **(head_options or {})
        )
        self.scans = self.lrf.scans
        self.camera_server = CameraServer(self.world, seed=seed, rest_s=rest_s)
        self.camera_urls = {
            name: f"{self.camera_server.url}/{name}.mjpg" for name in self.camera_server.cameras
        }
        self._parts = self.lrf, self.pan_tilt, self.camera_server
        for part in self._parts:
            self._closing.callback(part.close)

    def start(self):
        """Let all devices appear."""
        for part in self._parts:
            part.start()
        return self

    def close(self, *_):
        """Remove all devices, and their folder."""
        self._closing.close()

    __enter__ = start
    __exit__ = close

    def error(self):
        """What ended a device by itself, None while all live."""
        return self.lrf.error or self.pan_tilt.error

    def plan(self):
        """What a recording of this rig can do: the sweep that holds all placements, and each of
        them.
        """
        setup = self.setup
        each = []
        for p in self.world.placements.values():
            board = p.T_platform_board is not None
            step = math.degrees(
                setup.step if board or not setup.room_sweep else setup.room_sweep[2]
            )
            sweep, images = (
                np.degrees(angles).round(4).tolist() for angles in (p.sweep, p.image_pitch)
            )
            each.append(
                {
                    "number": p.number,
                    "board": board,
                    "pitch_deg": [*sweep, step],
                    "image_pitch_deg": images,
                }
            )
        boards = [p for p in each if p["board"]] or each
        ends = np.array([p["pitch_deg"][:2] for p in boards])
        return {
            "mode": "stop-and-go",
            "scans_per_stop": 1,
            "intrinsics_images": setup.intrinsics_views,
            "pitch_deg": [math.floor(ends.min()), math.ceil(ends.max()), math.degrees(setup.step)],
            "image_pitch_deg": np.unique(
                np.round(np.concatenate([p["image_pitch_deg"] for p in boards]))
            ).tolist(),
            "placements": each,
        }

    def rig_file(self):
        """Statement of the rig for recording, as JSON: board and rig as in session.json, devices,
        plan.
        """
        rig = self.setup.rig
        setup = self.setup
        head = self.pan_tilt
        cameras = {c.name: c for c in rig.camera_infos()}
        return {
            "schema": stated.SCHEMA,
            "name": f"{setup.name}_emulated",
            "licence": "CC-BY-4.0",
            "simulated": True,
            "source": f"emulated rig of the setup '{setup.name}', seed {setup.seed}",
            "board": stated.board_to_json(rig.board),
            "rig": {
                "lrf": stated.lrf_to_json(rig.beam.info("emulated")),
                "platform": {"T_head_lrf": stated.transform_to_json(rig.T_head_lrf_stated)},
                "cameras": {name: stated.camera_to_json(c) for name, c in cameras.items()},
            },
            "devices": {
                "lrf": {
                    "port": self.lrf.path,
                    "baudrate": 500000,
                    "interlaced": False,
                    "unit": rig.beam.unit_name,
                    "variant": [rig.beam.field_of_view, rig.beam.resolution / 100],
                },
                "head": {
                    "port": head.path,
                    "address": head.address,
                    "baudrate": head.baudrate,
                    "feedback": head.feedback != "none",
                    "pitch_limits_deg": np.degrees(rig.platform.limits).round(6).tolist(),
                },
                "cameras": {
                    name: {
                        "source": self.camera_urls[name],
                        "silence_s": SILENCE_S,
                        "size": [c.width, c.height],
                    }
                    for name, c in cameras.items()
                },
                "control": self.camera_server.control,
            },
            "plan": self.plan(),
        }


def practice_setup():
    """A rig and placements that are recorded in a minute: coarse sweeps, small images, intrinsics
    stated.

    Returns
    -------
    setup : Setup
    placements : list of Placement
    """
    quick = load_setup("sim_quick")
    rig = scaled(quick.rig, SMALL)
    rig = replace(
        rig,
        cameras=tuple(replace(c, exposure=replace(c.exposure, samples=2)) for c in rig.cameras),
        platform=replace(rig.platform, settle=0.0),
    )
    setup = replace(
        quick,
        name=PRACTICE,
        rig=rig,
        pairs=3,
        distances=(1.3, 1.7),
        step=np.radians(1.0),
        intrinsics_views=0,
        room_sweep=(),
        room_images=(),
    )
    found = pairs(setup.rig, setup.pairs, setup.distances, random(setup, PLACES), MARGIN)
    return setup, [replace(p, image_pitch=(p.image_pitch[0], p.image_pitch[-1])) for p in found]


def emulated(name):
    """An emulated rig ('practice', or a set-up), not started yet, and what makes its rig file
    (parsed) once it is.

    ValueError for another name.
    """
    if name != PRACTICE:
        rig = EmulatedRig(load_setup(name))
        return rig, rig.rig_file
    setup, placements = practice_setup()
    rig = EmulatedRig(
        setup, placements=placements, head_options={"baudrate": 38400, "go_speed": 60.0}
    )
    return rig, lambda: quick_file(rig)


def quick_file(rig):
    """The rig file of a rig whose head is quick and told to be, and whose cameras are known."""
    data = rig.rig_file()
    data["devices"]["head"] |= {"settle_s": 0.05, "poll_s": 0.01, "gap_s": 0.005}
    for camera in rig.setup.rig.cameras:
        data["rig"]["cameras"][camera.name]["intrinsics"] = stated.model_to_json(camera.model)
    return data


def main(name, rig_file=None, *, seed=0, feedback="full"):
    """Emulate a set-up until Ctrl-C, SIGTERM or SIGHUP; 0, or 1 when a device ended by itself.

    Its rig file is written where it is asked for, see :func:`written_rig_file`. ValueError for a
    set-up that there is not, and for a rig file that cannot be written.
    """
    quit_ = threading.Event()
    with contextlib.ExitStack() as stack:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            # as nohup leaves it
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                stack.callback(signal.signal, number, signal.signal(number, lambda *_: quit_.set()))
        rig = stack.enter_context(
            EmulatedRig(load_setup(name), seed=seed, head_options={"feedback": feedback})
        )
        if rig_file is not None:
            stack.enter_context(written_rig_file(rig, Path(rig_file)))
        print(summary(rig, rig_file), flush=True)
        while not quit_.wait(LOOK_S) and rig.error() is None:
            pass
        error = rig.error()
    print(f"a device ended: {error!r}" if error else "the emulated rig is gone", flush=True)
    return 1 if error else 0


@contextlib.contextmanager
def written_rig_file(rig, file):
    """The rig file of a running rig, for as long as the rig lives; a file that was there before is
    never touched.

    It is removed at the end, unless somebody changed or replaced it. ValueError where it cannot be
    written.
    """
    text = json.dumps(rig.rig_file(), indent=1) + "\n"
    try:
        stream = file.open("x")
    except FileExistsError:
        remedy = "name another file with --rig-file, or remove this one first"
        raise ValueError(f"{file}: exists already, and is not written over: {remedy}") from None
    except OSError as error:
        remedy = "name a file in a folder that exists and can be written with --rig-file"
        raise ValueError(f"{file}: cannot be written ({error.strerror}): {remedy}") from error
    try:
        with stream:
            stream.write(text)
        ours = file.stat()
    except OSError as error:
        file.unlink()
        raise ValueError(
            f"{file}: cannot be written ({error.strerror}): name another file with --rig-file"
        ) from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # somebody removed it
            if os.path.samestat(file.lstat(), ours) and file.read_bytes() == text.encode():
                file.unlink()
            else:
                print(f"{file}: was changed, so it stays; its devices are gone", flush=True)


def summary(rig, file):
    """What other programs need to know of an emulated rig, as text."""
    head = rig.pan_tilt
    control = rig.camera_server.control
    places = ", ".join(map(str, rig.world.placements))
    lines = [
        f"emulated rig '{rig.setup.name}' ({rig.setup.rig.beam.name}); Ctrl-C ends it",
        f"  lrf      {rig.lrf.path}   {rig.lrf.baudrate} Bd, SICK LMS2xx",
        f"  head     {head.path}   {head.baudrate} Bd, Pelco-D, address {head.address}",
        *(f"  {name:8s} {url}" for name, url in rig.camera_urls.items()),
        f"  board    curl -X POST {control}/place/NUMBER puts it at {places}, or none",
    ]
    if file is not None:
        lines.append(f"  rig file {file}   python -m lrfcal_lib record --help")
    return "\n".join(lines)
