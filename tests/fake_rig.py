"""A rig without hardware and without threads: devices with the drivers' calls, their own clock, and known truth."""

import json
import math
from functools import reduce
from types import SimpleNamespace

import numpy as np

from lrfcal_lib.drivers.lms2xx_scans import Reading
from lrfcal_lib.drivers.port import Closed, DeviceError, LineLost, NoReply
from lrfcal_lib.drivers.rig import Rig
from lrfcal_lib.drivers.rig_file import rig_of
from lrfcal_lib.drivers.video import Frame
from lrfcal_lib.session.lms2xx_codec import Configuration, encode_words, scan_quarters

SIZE = (32, 24)
BEAMS = 101  # 100 deg in steps of 1 deg
BEARINGS = np.radians(scan_quarters(BEAMS) / 4)
SCAN_S = 0.02
LAZY_S = 0.013  # from the question to the first beam


class Clock:
    """Time that passes when the devices let it pass."""

    def __init__(self, now=1000.0):
        self.now = now

    def __call__(self):
        return self.now


def telegram(pitch):
    """What the fake device sends at a pitch: a wall that differs for every pitch."""
    words = 2000 + np.arange(BEAMS) + round(math.degrees(pitch) * 40) % 4000
    return encode_words(words.astype(np.uint16), unit="mm")


def picture(pitch, camera="left"):
    """What a fake camera sees at a pitch."""
    rng = np.random.default_rng([round(math.degrees(pitch) * 100) + 100000, len(camera)])
    return rng.integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)


class Head(Closed):
    """Moves at 20 deg/s; answers unless it is told not to."""

    def __init__(self, clock, feedback=True, silent_moving=False):
        self.clock, self.has_feedback, self.silent_moving = clock, feedback, silent_moving
        self.at, self.stops, self.track, self.sweep, self.fail = 0.0, 0, [], None, None
        self.speed = math.radians(20)

    def move_to(self, pitch):
        if self.fail is not None:
            raise self.fail
        self.clock.now += abs(pitch - self.at) / self.speed + 0.3
        self.at = pitch
        return pitch

    def start_sweep(self, stop_at, speed=None):
        self.sweep, self.track = (self.clock(), self.at, stop_at), []
        self.note()

    def true(self, instant):
        """Pitch at an instant of the sweep."""
        begun, first, last = self.sweep
        return float(
            first
            + np.sign(last - first)
            * np.clip(self.speed * (instant - begun), 0, abs(last - first))
        )

    def note(self):
        """Append to the track; a head that arrived meanwhile is noted when it did."""
        begun, first, last = self.sweep
        arrives = begun + abs(last - first) / self.speed
        before = self.track[-1][0] if self.track else -math.inf
        for instant in (
            [arrives, self.clock()] if before < arrives < self.clock() else [self.clock()]
        ):
            measured = self.has_feedback and (
                instant == begun or instant >= arrives or not self.silent_moving
            )
            # between readings a head that moves is only reckoned, badly: nobody may use that where readings exist
            wrong = 0.0 if measured or not self.has_feedback else math.radians(3)
            self.track = [*self.track, (instant, self.true(instant) + wrong, measured)]

    def moving(self):
        if self.fail is not None:
            raise self.fail
        if self.sweep is not None:
            self.note()
        return (
            self.sweep is not None and abs(self.true(self.clock()) - self.sweep[2]) > 1e-9
        )

    def finish_sweep(self):
        self.clock.now += 0.05
        self.note()
        self.at, self.sweep_done, self.sweep = self.sweep[2], self.sweep, None
        return self.track

    def stop(self):
        self.stops += 1

    close = stop


class Lrf(Closed):
    """Scans the wall at the head's pitch."""

    type = "LMS221"
    firmware = "X01.27"
    variant = (100.0, 1.0)
    port = "/dev/fake"
    configuration = Configuration().changed(unit="mm")

    def __init__(self, head, clock):
        self.head, self.clock, self.streaming, self.silent = head, clock, False, False
        self.readings, self.wait, self.lost, self.reconnects = [], lambda: None, 0, 0

    def start(self, interlaced=False):
        self.streaming = True

    def stop(self):
        self.streaming = False

    close = stop

    def _scan(self, instant):
        pitch = self.head.at
        if self.head.sweep is not None:
            pitch = self.head.true(instant)
            self.head.note()
        times = instant + (np.arange(BEAMS) / 360) * 0.0133
        ranges = np.full(BEAMS, 2.0 + pitch)
        self.readings.append(
            Reading((telegram(pitch),), ranges, BEARINGS, instant, times, -1)
        )
        return self.readings[-1]

    def request(self, after=-math.inf):
        if self.streaming:
            raise DeviceError("the device streams; call stop() first")
        if self.lost:
            raise LineLost("the line is lost")
        self.streaming = True
        try:
            return self.take(1, after)[0]
        finally:
            self.streaming = False

    def reconnect(self, deadline=10.0):
        self.reconnects, self.lost = self.reconnects + 1, self.lost - 1

    def take(self, count, after=-math.inf, timeout=2.0):
        if not self.streaming:
            raise DeviceError("the device does not stream; call start() first")
        out = []
        for _ in range(count):
            self.wait()
            if self.silent:
                self.clock.now += timeout
                raise NoReply("no new scan: the stream is silent")
            instant = max(after or -math.inf, self.clock()) + LAZY_S
            out.append(self._scan(instant))
            self.clock.now = max(self.clock.now, instant) + SCAN_S
        return out


class Camera(Closed):
    """Sees noise that depends on the pitch."""

    def __init__(self, name, head, clock):
        self.name, self.head, self.clock, self.count = name, head, clock, 0
        self.show = picture

    def newest(self, after=None, timeout=5.0):
        self.clock.now += 0.04
        self.count += 1
        return Frame(self.show(self.head.at, self.name), self.clock(), self.count)

    def close(self):
        pass


def rig_data(cameras=("left",), **plan):
    """A rig file as parsed JSON; keyword arguments go to the plan."""
    edges = ["a", "b", "c"]
    board = {"name": "triangle", "edges": edges, "features": edges[:2], "corners_m": [[0, 0], [0.4, 0], [0, 0.3]],
             "pattern": {"kind": "chessboard", "columns": 4, "rows": 5, "square_m": 0.03}}  # fmt: skip
    lrf = {
        "model": "LMS221",
        "field_of_view_deg": [40, 140],
        "bearing_step_deg": 1.0,
        "sigma_range_m": 0.01,
    }
    named = {
        c: {"mount": "head", "width": SIZE[0], "height": SIZE[1], "intrinsics": None}
        for c in cameras
    }
    return {
        "board": board,
        "rig": {"lrf": lrf, "platform": {"T_head_lrf": None}, "cameras": named},
        "devices": {
            "lrf": {"port": "/dev/fake_lrf", "variant": [100, 1], "unit": "mm"},
            "head": {"port": "/dev/fake_head"},
            "cameras": {c: {"source": 0} for c in cameras},
        },
        "plan": {"pitch_deg": [-4, 4, 1], "image_pitch_deg": [0], "count": 3, **plan},
    }


def changed(path, value, **plan):
    """A rig file with one key changed (or removed, where the value is None)."""
    data = rig_data(**plan)
    *way, last = path.split(".")
    at = reduce(dict.__getitem__, way, data)
    at[last] = value
    if value is None:
        del at[last]
    return data


def make_rig(data=None, *, feedback=True, silent_moving=False):
    """An open rig of fakes."""
    clock = Clock()
    stated = rig_of(json.loads(json.dumps(data or rig_data())))
    head = Head(clock, feedback, silent_moving)
    cameras = {name: Camera(name, head, clock) for name in stated.cameras}
    rig = Rig(
        stated, Lrf(head, clock), head, cameras, host=SimpleNamespace(now=clock, time=clock)
    )
    rig._closing.callback(head.close)
    return rig


def opened(rig):
    """Stands in for the class Rig where a program opens one."""
    return SimpleNamespace(open=lambda stated, **options: rig)


def raising(error):
    """A call that fails."""

    def call(*_, **__):
        raise error

    return call
