"""A Pelco-D pan-tilt head, as good or as bad as heads are; how it moves is always known."""

import math
from collections import deque

import numpy as np

from lrfcal_lib.drivers import pelco_d
from lrfcal_lib.drivers.pelco_d import DOWN, FASTEST, QUERY_TILT, SYNC, TILT, UP, encode_extended
from lrfcal_lib.drivers.port import REAL
from lrfcal_lib.emulators.line import SerialDevice
from lrfcal_lib.simulate.rig import Platform

REACT_S = 0.04  # from a command to the motor
WOBBLE = 0.015  # amplitude after a stop, radians for each rad/s of speed
WOBBLE_HZ = 4.0
KEPT = 2000  # pieces of motion; ten times as many frames
TURN_AROUND_S = 0.010  # from the end of a frame to a reply
# to queries of pan, tilt, zoom, magnification
ANSWERS = {0x51: 0x59, QUERY_TILT: TILT, 0x55: 0x5D, 0x61: 0x63}
FRAGMENT_S = 0.1  # a frame begun is forgotten after so long


class Head:
    """Tilt of a head and the pitch that the sensors on it have.

    Its motor runs at constant speed to where it is told, or until it is stopped. A Platform tells
    how well it is made; the pitch at the start is in radians.
    """

    def __init__(self, platform=None, seed=0, pitch=0.0):
        self.platform = platform or Platform()
        self.limits = self.platform.limits
        self.rng = np.random.default_rng([seed, 2])
        # rows: instant from which it holds, motor from, to, rad/s, and where the head was within
        # its play when the command came. One thread writes them, any may look: a look sees the
        # table of before or of after.
        dragged = (1 + self.platform.stretch) * pitch
        self._pieces = np.array([(-np.inf, pitch, pitch, 0.0, dragged)])

    def move(self, instant, goal, speed):
        """Tilt towards an angle, at most to a limit, at a speed, radians.

        The motor reacts a little later.
        """
        self._run(instant + REACT_S, goal, speed)

    def _run(self, instant, goal, speed):
        now = float(self.motor(instant))
        goal = float(np.clip(goal, *self.limits))
        velocity = abs(speed) * np.sign(goal - now)
        piece = instant, now, goal, velocity, float(self._dragged(instant))
        before = self._pieces[self._pieces[:, 0] <= instant]
        self._pieces = np.vstack([before[-KEPT:], piece])

    def go(self, instant, goal, speed):
        """Tilt to an angle, missed by the noise of the platform."""
        self.move(instant, goal + self.platform.noise * self.rng.standard_normal(), speed)

    def stop(self, instant):
        """Stop tilting; what rests already goes on resting."""
        reacts = instant + REACT_S
        if self.moving(reacts):
            self._run(reacts, self.motor(reacts), 0.0)

    def motor(self, instant):
        """Angle of the motor at one instant or many."""
        begun, first, last, speed, _ = self._held(instant)
        elapsed = np.where(np.isfinite(begun), instant - begun, 0.0)
        way = np.where(speed == 0, 0.0, speed * elapsed)
        return np.clip(first + way, np.minimum(first, last), np.maximum(first, last))

    def resting(self, instant):
        """Seconds since the motor came to rest, negative while it runs; and the speed it had."""
        begun, first, last, speed, _ = self._held(instant)
        if speed != 0:
            runs = abs((last - first) / speed)
            return float(instant - begun - runs), float(speed)
        speed_before = self._held(instant, back=1)[3]
        return float(instant - begun), float(speed_before)

    def moving(self, instant):
        """Whether the motor runs, or is about to."""
        return self.resting(instant)[0] < 0 or self._pieces[-1, 0] > instant

    def settled(self, instant):
        """Whether the head is at rest, its wobble included."""
        return not self.moving(instant) and self.resting(instant)[0] >= self.platform.settle

    def pitch(self, instant):
        """True pitch at one instant or many, radians; after a stop it wobbles until it settled."""
        instant = np.asarray(instant, float)
        settle = self.platform.settle
        latest = np.max(instant)
        since, speed = self.resting(float(latest))
        if not 0 < since < settle + np.ptp(instant) or not settle:
            return self._dragged(instant) + 0.0
        after = np.clip(since - (latest - instant), 0, None)
        amplitude = WOBBLE * speed * np.exp(-5 * after / settle)
        swing = amplitude * np.sin(2 * np.pi * WOBBLE_HZ * after)
        return self._dragged(instant) + np.where(after < settle, swing, 0.0)

    def measured(self, instant):
        """What the encoder says, radians; it sits on the motor and is late."""
        angle = self.motor(instant - self.platform.latency)
        step = self.platform.encoder_step
        return float(np.rint(angle / step) * step if step else angle)

    def _held(self, instant, back=0):
        """Columns of the pieces of motion that hold at instants, or of those before."""
        pieces = self._pieces
        row = np.searchsorted(pieces[:, 0], instant, side="right") - 1 - back
        return np.moveaxis(pieces[np.maximum(row, 0)], -1, 0)

    def _dragged(self, instant):
        """Where the gear, which has some play, has dragged the head.

        Within a piece of motion, which goes one way, the head stays where it was until the motor is
        half the play ahead of it.
        """
        half = self.platform.backlash / 2
        motor = (1 + self.platform.stretch) * self.motor(instant)
        return np.clip(self._held(instant)[4], motor - half, motor + half)


class EmulatedHead(SerialDevice):
    """A pan-tilt head; its pan does not turn.

    Parameters
    ----------
    head : Head, optional
        Its motion; the pitch is the elevation, up positive.
    path : path-like
        Of the port to appear.
    baudrate, address : int
    feedback : {'full', 'partial', 'none'}
        'full': tells its position except during an absolute move, and makes absolute moves.
        'partial': tells its position at rest only, and ignores absolute moves. 'none': neither;
        nothing is ever answered.
    confirms : bool
        Answers commands by 4 bytes.
    echo : bool
        The two-wire line hands back what the host sends.
    speeds, go_speed : tuple of float, float
        Tilt speed at speed byte 0 and at 0x3F, between which it grows evenly; of absolute moves;
        degrees a second.
    watchdog_s : float, optional
        Stops when no frame came for so long.
    invert : bool
        'Up' and positive elevation lower the view.
    seed, host
        As for :class:`EmulatedLms`. `frames` holds host time and sound frames to this address.
    """

    def __init__(
        self,
        head=None,
        *,
        path,
        baudrate=2400,
        address=1,
        feedback="full",
        confirms=False,
        echo=False,
        speeds=(0.5, 12.0),
        go_speed=8.0,
        watchdog_s=None,
        invert=False,
        seed=0,
        host=REAL,
    ):
        super().__init__(path, host, seed)
        self.head = head or Head(seed=seed)
        self.baudrate = baudrate
        self.address = address
        self.feedback = feedback
        self.confirms = confirms and feedback != "none"
        self.echo = echo
        self.speeds = np.radians(speeds)
        self.go_speed = math.radians(go_speed)
        self.watchdog_s = watchdog_s
        self.sign = -1 if invert else 1
        self.frames = deque(maxlen=10 * KEPT)
        self.absolute_until = -math.inf  # an absolute move is under way
        self._buffer = b""  # bytes of a frame that is not whole

    def pitch(self, instant=None):
        """True pitch now, or at instants, radians."""
        return self.head.pitch(self.host.now() if instant is None else instant)

    def receive(self, data, at):
        """Bytes of the host; the last of them arrived at an instant."""
        if self.echo:
            self.write(data, at)
        self.cancel("fragment")
        data = self._buffer + data
        frames, pending = pelco_d.split_frames(data)
        self._buffer = data[pending:]
        for frame in frames:
            if frame.address == self.address:
                self.obey(frame, at)
        if self._buffer:
            self.at(at + FRAGMENT_S, lambda _: setattr(self, "_buffer", b""), "fragment")

    def obey(self, frame, at):
        """Do what a frame says, and confirm it."""
        self.frames.append((self.host.time(), frame))
        self.cancel("watchdog")
        if self.watchdog_s:
            self.at(at + self.watchdog_s, self.stop, "watchdog")
        if frame.command2 in ANSWERS:
            return self.tell(frame.command2, at)
        if not frame.command2 & 1:
            self._turn(frame, at)
        elif frame.command2 == pelco_d.SET_TILT:
            self._set_tilt(frame.value, at)
        if self.confirms:
            checksum = sum(vars(frame).values()) % 256
            self.reply(bytes([SYNC, self.address, 0, checksum]), at + TURN_AROUND_S)
        return None

    def _turn(self, frame, at):
        """Move up or down; without a direction it is a stop, whatever the speeds say."""
        way = {UP: self.sign, DOWN: -self.sign}.get(frame.command2 & (UP | DOWN))
        if way is None:
            return self.stop(at)
        self.absolute_until = -math.inf
        share = min(frame.data2, FASTEST) / FASTEST
        return self.head.move(at, way * math.tau, self.speeds[0] + np.ptp(self.speeds) * share)

    def _set_tilt(self, value, at):
        """Move to an elevation; a second such move is lost while the first is under way."""
        if self.feedback != "full" or value >= pelco_d.TURN or at < self.absolute_until:
            return
        head = self.head
        goal = float(np.clip(self.sign * pelco_d.decode_tilt(value), *head.limits))
        self.absolute_until = at + abs(goal - float(head.motor(at))) / self.go_speed
        head.go(at, goal, self.go_speed)

    def stop(self, at):
        """Stop the motor."""
        self.absolute_until = -math.inf
        self.head.stop(at)

    def tell(self, opcode, at):
        """Answer a query, unless the head is too busy or does not know how."""
        busy = at < self.absolute_until or (self.feedback == "partial" and self.head.moving(at))
        if self.feedback == "none" or busy:
            return
        value = 0
        if opcode == QUERY_TILT:
            value = pelco_d.encode_tilt(self.sign * self.head.measured(at))
        self.reply(encode_extended(self.address, ANSWERS[opcode], value), at + TURN_AROUND_S)
