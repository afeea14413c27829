"""A whole emulated rig: its devices, its control socket, rigs for practice, ``python -m lrfcal_lib emulate``.

A line to the socket is a command with its arguments, ``place 3``; in JSON ``{"command": "place", "arguments": [3]}``.
Every line is answered by one line of JSON, ``{"ok": true, ...}`` or ``{"ok": false, "error": "..."}``.
"""

import argparse
import contextlib
import json
import math
import signal
import socketserver
import tempfile
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np

from lrfcal_lib.drivers.port import REAL
from lrfcal_lib.drivers.rig import host_clock
from lrfcal_lib.emulators.head import FEEDBACK, REPLIES, EmulatedHead
from lrfcal_lib.emulators.line import FAULTS, Clock
from lrfcal_lib.emulators.lms2xx import EmulatedLms
from lrfcal_lib.emulators.world import CameraServer, EmulatedWorld, Serving, scaled
from lrfcal_lib.session import stated
from lrfcal_lib.simulate.rig import PLACES, SETUPS, pairs, random, sim_quick

SILENCE_S = 600.0  # that says nothing about an emulated camera: it sends no image while the head moves
LONGEST_LINE = 4096
LOOK_S = 0.5
PRACTICE = "practice"
SMALL = 400  # pixels of an image's width of the practice rig: its chessboard is still found at 2 m
FAST = 2.0  # times as fast as real devices
MARGIN = np.radians(1.0)  # of a sweep beyond the board


class EmulatedRig:
    """The devices of a simulated setup, as files and addresses that any program can open; a context manager.

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
        of scans need a host clock that runs as fast (`clock` of `LMS2xx` and `Rig.open`): by another one they are off
        by tenths of a second.
    model : str, optional
        Type string of the laser range finder.
    head_options, platform : dict, optional
        Of :class:`EmulatedHead`; what differs from the setup's Platform.
    cameras : bool
        Whether there are cameras.
    image_width : int, optional
        Pixels; the field of view stays.
    rest_s
        Of :class:`CameraServer`.
    machine : Host
        Whose time the devices live in, and whose ``terminal(device)`` their ports are.

    Examples
    --------
    >>> with EmulatedRig("sim_quick", cameras=False) as rig:  # doctest: +SKIP
    ...     rig.world.put(1)
    """

    def __init__(self, setup="sim_quick", *, folder=None, seed=0, placements=None, time_scale=1.0, model=None,
                 head_options=None, platform=None, cameras=True, image_width=None, rest_s=0.5,
                 machine=REAL):  # fmt: skip
        if isinstance(setup, str) and setup not in SETUPS:
            raise ValueError(f"no set-up '{setup}'; there are {', '.join(SETUPS)}")
        setup = SETUPS[setup]() if isinstance(setup, str) else setup
        rig = replace(setup.rig, platform=replace(setup.rig.platform, **(platform or {})))
        setup, self.clock = replace(setup, rig=rig), Clock(time_scale, machine)
        self.setup = setup if image_width is None else replace(setup, rig=scaled(rig, image_width))
        self._closing = contextlib.ExitStack()
        own = None if folder else tempfile.TemporaryDirectory(prefix="lrfcal-", ignore_cleanup_errors=True)
        self.folder = Path(folder or self._closing.enter_context(own))
        self.folder.mkdir(parents=True, exist_ok=True)
        self.world, shared = EmulatedWorld(setup, self.clock, seed, placements), {"clock": self.clock, "seed": seed}
        self.lrf = EmulatedLms(self.world, path=self.folder / "lrf", **shared, **({"model": model} if model else {}))
        self.pan_tilt = EmulatedHead(self.world.head, path=self.folder / "head", **shared, **(head_options or {}))
        self.faults, self.scans = {"lrf": self.lrf.faults, "head": self.pan_tilt.faults}, self.lrf.scans
        self.control = str(self.folder / "control")
        control = _ControlServer(self.control, type("Handler", (_Obedient,), {"rig": self}))
        self.camera_server = CameraServer(self.world, self.setup, seed=seed, rest_s=rest_s) if cameras else None
        self.camera_urls = self.camera_server.urls if cameras else {}
        self._closing.callback(Path(self.control).unlink, missing_ok=True)
        self._parts = [self.lrf, self.pan_tilt, *([self.camera_server] if cameras else []), Serving(control)]
        for part in self._parts:
            self._closing.callback(part.close)

    def start(self):
        """Let all devices appear."""
        for part in self._parts:
            part.start()
        return self

    def close(self, *_):
        """Remove all devices, and the folder where it was made here."""
        self._closing.close()

    __enter__, __exit__ = start, close

    def pitch(self, time_s=None):
        """True pitch now, or at instants of the host's clock (time.time()), radians."""
        return self.world.head.pitch(self.clock.now() if time_s is None else self.clock.device(time_s))

    def error(self):
        """What ended a device by itself, None while all live."""
        return self.lrf.error or self.pan_tilt.error or (self.camera_server and self.camera_server.error)

    def status(self):
        """The devices now, as JSON."""
        memory, head = self.lrf.memory, self.pan_tilt
        return {
            "place": list(self.world.place.key),
            "pitch_deg": round(math.degrees(float(self.pitch())), 4),
            "lrf": {"baudrate": memory.baudrate, "mode": memory.mode, "variant": list(memory.variant),
                    "unit": memory.configuration.unit, "scans": len(self.scans), "line": self.lrf.counts},
            "head": {"baudrate": head.baudrate, "frames": len(head.frames), "line": head.counts},
        }  # fmt: skip

    def plan(self):
        """What a recording of this rig can do: the sweep that holds all placements, and each of them."""
        setup, each = self.setup, []
        for p in self.world.placements.values():
            board = p.T_platform_board is not None
            step = math.degrees(setup.step if board or not setup.room_sweep else setup.room_sweep[2])
            sweep, images = (np.degrees(angles).round(4).tolist() for angles in (p.sweep, p.image_pitch))
            each.append({"number": p.number, "board": board, "pitch_deg": [*sweep, step], "image_pitch_deg": images})
        boards = [p for p in each if p["board"]] or each
        ends = np.array([p["pitch_deg"][:2] for p in boards])
        return {
            "mode": "stop-and-go",
            "scans_per_stop": 1,
            "intrinsics_images": setup.intrinsics_views if self.camera_urls else 0,
            "pitch_deg": [math.floor(ends.min()), math.ceil(ends.max()), math.degrees(setup.step)],
            "image_pitch_deg": np.unique(np.round(np.concatenate([p["image_pitch_deg"] for p in boards]))).tolist(),
            "placements": each,
        }

    def rig_file(self):
        """Statement of the rig for recording, as JSON: board and rig as in session.json, devices, plan."""
        rig, setup, head = self.setup.rig, self.setup, self.pan_tilt
        cameras = {c.name: c for c in rig.camera_infos()} if self.camera_urls else {}
        return {
            "schema": stated.SCHEMA, "name": f"{setup.name}_emulated", "licence": "CC-BY-4.0", "simulated": True,
            "source": f"emulated rig of the setup '{setup.name}', seed {setup.seed}",
            "board": stated.board_to_json(rig.board),
            "rig": {"lrf": stated.lrf_to_json(rig.beam.info("emulated")),
                    "platform": {"T_head_lrf": stated.transform_to_json(rig.T_head_lrf_stated)},
                    "cameras": {name: stated.camera_to_json(c) for name, c in cameras.items()}},
            "devices": {
                "lrf": {"port": self.lrf.path, "baudrate": 500000, "interlaced": False, "unit": rig.beam.unit_name,
                        "variant": [rig.beam.field_of_view, rig.beam.resolution / 100]},
                "head": {"port": head.path, "address": head.address, "baudrate": head.baudrate,
                         "feedback": head.reply_kind != "none",
                         "pitch_limits_deg": np.degrees(rig.platform.limits).round(6).tolist()},
                "cameras": {name: {"source": self.camera_urls[name], "silence_s": SILENCE_S,
                                   "size": [c.width, c.height]} for name, c in cameras.items()},
                "control": self.control,
            },
            "plan": self.plan(),
        }  # fmt: skip


def _fault(rig, device, name=None, count=1, seconds=None):
    """Let a fault of a device happen; without a name none any more."""
    if device not in rig.faults:
        raise ValueError(f"no device '{device}'; there are {', '.join(rig.faults)}")
    if name is None:
        rig.faults[device].clear()
    else:
        rig.faults[device].inject(name, int(count), seconds=None if seconds is None else float(seconds))
    return {"armed": sorted(rig.faults[device].armed)}


COMMANDS = {
    "place": (lambda rig, number="none": rig.world.put(None if number in (None, "none", "") else int(number)),
              "place NUMBER|none: put the board there"),
    "close": (lambda rig, camera, view: rig.world.hold_close(camera, int(view)), "close CAMERA VIEW: hold it close"),
    "placements": (lambda rig: {"placements": rig.plan()["placements"]}, "placements: where the board can be put"),
    "fault": (lambda rig, device, name, *more: _fault(rig, device, name, *more),
              "fault lrf|head NAME [COUNT] [SECONDS]: let something go wrong"),
    "faults": (lambda rig: {"faults": {n: f.text for n, f in FAULTS.items()},
                            "counts": {d: dict(f.counts) for d, f in rig.faults.items()}},
               "faults: what can go wrong, and how often it did"),
    "clear": (lambda rig, *devices: [_fault(rig, one) for one in devices or rig.faults] and {},
              "clear [lrf|head]: no more faults"),
    "status": (EmulatedRig.status, "status: the devices now"),
    "truth": (lambda rig: {"truth": rig.world.truth()}, "truth: what only the simulator knows"),
    "help": (lambda _: {"commands": [text for _, text in COMMANDS.values()]}, "help: this"),
}  # fmt: skip


def obey(rig, line):
    """Do one command of the control socket, str; never raises: an error is an answer, too (dict)."""
    try:
        if line.lstrip().startswith("{"):
            asked = json.loads(line)
            name, arguments = asked["command"], asked.get("arguments", [])
        else:
            name, *arguments = line.split() or ["help"]
        if name not in COMMANDS:
            raise ValueError(f"no command '{name}'; there are {', '.join(COMMANDS)}")
        return {"ok": True, **(COMMANDS[name][0](rig, *arguments) or {})}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        return {"ok": False, "error": f"{error}"}


class _ControlServer(socketserver.ThreadingUnixStreamServer):
    daemon_threads, block_on_close = True, False


class _Obedient(socketserver.StreamRequestHandler):
    """Serves the commands to a program."""

    def handle(self):
        with contextlib.suppress(ConnectionError):
            while line := self.rfile.readline(LONGEST_LINE):
                self.wfile.write(json.dumps(obey(self.rig, line.decode(errors="replace"))).encode() + b"\n")


def practice_setup():
    """A rig and placements that are recorded in a minute: coarse sweeps, small images, intrinsics stated.

    Returns
    -------
    setup : Setup
    placements : list of Placement
    """
    rig = scaled(sim_quick().rig, SMALL)
    rig = replace(rig, cameras=tuple(replace(c, exposure=replace(c.exposure, samples=2)) for c in rig.cameras))
    setup = replace(sim_quick(), name=PRACTICE, rig=rig, pairs=3, distances=(1.3, 1.7), step=np.radians(1.0),
                    intrinsics_views=0, room_sweep=(), room_images=())  # fmt: skip
    found = pairs(setup.rig, setup.pairs, setup.distances, random(setup, PLACES), MARGIN)
    return setup, [replace(p, image_pitch=(p.image_pitch[0], p.image_pitch[-1])) for p in found]


def emulated(name):
    """An emulated rig ('practice', or a set-up), not started yet, its rig file, and the host clock of its devices.

    'practice' runs twice as fast as real devices, the others as slow. The file (parsed) is given by a callable once the
    rig is started; the clock is for :meth:`lrfcal_lib.drivers.rig.Rig.open`. ValueError for another name.
    """
    clock = host_clock()
    if name != PRACTICE:
        rig = EmulatedRig(name)
        return rig, rig.rig_file, clock
    begun, (setup, placements) = clock(), practice_setup()
    rig = EmulatedRig(setup, placements=placements, time_scale=FAST, platform={"settle": 0.0},
                      head_options={"baudrate": 38400, "go_speed": 60.0})  # fmt: skip
    return rig, lambda: quick_file(rig), lambda: begun + FAST * (clock() - begun)


def quick_file(rig):
    """The rig file of a rig whose head is quick and told to be, and whose cameras are known."""
    data = rig.rig_file()
    data["devices"]["head"] |= {"settle_s": 0.05, "poll_s": 0.01, "gap_s": 0.005}
    for camera in rig.setup.rig.cameras:
        data["rig"]["cameras"][camera.name]["intrinsics"] = stated.model_to_json(camera.model)
    return data


def parser():
    """The command line, an ArgumentParser; its options are those of :class:`EmulatedRig`, `head_*` of its head."""
    top = argparse.ArgumentParser(prog="python -m lrfcal_lib emulate", description="Emulate the devices of a rig.")
    top.add_argument("setup", nargs="?", default="sim_quick", help="sim_quick (default) or sim_lms221")
    top.add_argument("--folder", help="where the ports appear (default: a new temporary folder)")
    top.add_argument("--rig-file", type=Path, help="write a file for 'record' (it is removed at the end)")
    top.add_argument("--seed", type=int, default=0, help="of noise and faults")
    top.add_argument("--feedback", choices=FEEDBACK, default="full", help="what the head tells of its position")
    top.add_argument("--reply", choices=REPLIES, default="extended", help="how the head answers")
    top.add_argument("--echo", action="store_true", help="the head's line hands back what is sent")
    top.add_argument("--head-baudrate", type=int, default=2400, dest="baudrate")
    top.add_argument("--model", help="type string of the laser range finder, 21 characters")
    top.add_argument("--image-width", type=int, help="pixels")
    rest = "s the head rests before an image is drawn (0.5)"
    top.add_argument("--image-rest", type=float, default=0.5, dest="rest_s", help=rest)
    top.add_argument("--no-cameras", action="store_false", dest="cameras")
    scale = "2 runs all devices twice as fast, 8 at most; stop-and-go only, as sweeps need scans in real time (1)"
    top.add_argument("--time-scale", type=float, default=1.0, help=scale)
    return top


def main(argv=None):
    """Emulate a rig until Ctrl-C, SIGTERM or SIGHUP; 0, or 1 when a device ended by itself.

    ValueError for options that no rig has.
    """
    options, quit_ = vars(parser().parse_args(argv)), threading.Event()
    file, head = options.pop("rig_file"), {key: options.pop(key) for key in ("feedback", "reply", "echo", "baudrate")}
    with contextlib.ExitStack() as stack:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # as nohup leaves it
                stack.callback(signal.signal, number, signal.signal(number, lambda *_: quit_.set()))
        rig = stack.enter_context(EmulatedRig(**options, head_options=head))
        if file is not None:
            stack.callback(file.unlink, missing_ok=True)
            file.write_text(json.dumps(rig.rig_file(), indent=1) + "\n")
        print(summary(rig, file), flush=True)
        while not quit_.wait(LOOK_S) and rig.error() is None:
            pass
        error = rig.error()
    print(f"a device ended: {error!r}" if error else "the emulated rig is gone", flush=True)
    return 1 if error else 0


def summary(rig, file=None):
    """What other programs need to know of an emulated rig, as text."""
    head = rig.pan_tilt
    lines = [
        f"emulated rig '{rig.setup.name}' ({rig.setup.rig.beam.name}); Ctrl-C ends it",
        f"  lrf      {rig.lrf.path}   {rig.lrf.baudrate} Bd, SICK LMS2xx",
        f"  head     {head.path}   {head.baudrate} Bd, Pelco-D, address {head.address}",
        *(f"  {name:8s} {url}" for name, url in rig.camera_urls.items()),
        f"  control  {rig.control}   one command a line, such as: place 1",
        f"  boards   placements {', '.join(map(str, rig.world.placements))}, or none",
    ]
    if rig.clock.scale != 1:
        lines.append(f"  clocks   {rig.clock.scale:g} times as fast: for stop-and-go, not for continuous sweeps")
    if file is not None:
        lines.append(f"  rig file {file}   python -m lrfcal_lib record --help")
    return "\n".join(lines)
