"""A Pelco-D pan-tilt head at the end of a pseudo-terminal, as good or as bad as heads are."""

from __future__ import annotations

import math
import time
from collections import deque

import numpy as np

from lrfcal_lib.drivers.emulators.faults import Faults
from lrfcal_lib.drivers.emulators.line import Clock, Line
from lrfcal_lib.drivers.emulators.motion import Head

SYNC, FRAME = 0xFF, 7
RIGHT, LEFT, UP, DOWN = 0x02, 0x04, 0x08, 0x10
QUERIES = {0x51: 0x59, 0x53: 0x5B, 0x55: 0x5D, 0x61: 0x63}
SET_PAN, SET_TILT, PART_NUMBER = 0x4B, 0x4D, 0x45
TURN_AROUND_S = 0.010  # from the end of a frame to a reply
FRAGMENT_S = 0.1  # a frame begun is forgotten after so long
SLIP_S = 0.3  # of the fault
JUMP = 1000  # of the fault, hundredths of a degree
NAME = b"LRFCAL-EMULATED"
FEEDBACK = ("full", "partial", "none")
REPLIES = ("extended", "general", "five", "single", "none")
KEPT = 20000


def checksum(data):
    """Sum of bytes modulo 256."""
    return sum(data) % 256


def tilt_raw(elevation):
    """Wire value of an elevation: hundredths of a degree, downwards from the horizon, 0 to 35999."""
    return round(-math.degrees(elevation) * 100) % 36000


def tilt_elevation(raw):
    """Elevation of a wire value, radians."""
    return math.radians(-(raw if raw <= 18000 else raw - 36000) / 100)


class EmulatedHead:
    """A pan-tilt head; a context manager, or `start` and `close`.

    Parameters
    ----------
    head : Head, optional
        Its motion; the pitch is the elevation, up positive.
    path : path-like
        Of the port to appear.
    baudrate, address : int
    feedback : {'full', 'partial', 'none'}
        'full': tells its position except during an absolute move, and makes absolute moves. 'partial': tells its
        position at rest only, and ignores absolute moves. 'none': neither; nothing is ever answered.
    reply : {'extended', 'general', 'five', 'single', 'none'}
        Form of the answers. 'extended': 7 bytes to queries, none to commands. 'general': besides, 4 bytes to commands.
        'single': besides, one byte 0x01 to commands. 'five': 5 bytes without sync and address to queries.
    echo : bool
        The two-wire line hands back what the host sends.
    speeds : tuple of float
        Tilt speed at speed byte 0 and at 0x3F, degrees a second; in between it grows evenly.
    go_speed : float
        Of absolute moves, degrees a second.
    watchdog_s : float, optional
        Stops when no frame came for so long.
    invert : bool
        'Up' and positive elevation lower the view.
    seed, time_scale, clock
        As for :class:`EmulatedLms`.

    Attributes
    ----------
    faults : Faults
    frames : deque of (float, bytes)
        Host time and sound frames to this address.
    """

    def __init__(self, head=None, *, path, baudrate=2400, address=1, feedback="full", reply="extended", echo=False,
                 speeds=(0.5, 12.0), go_speed=8.0, watchdog_s=None, invert=False, seed=0, time_scale=1.0,
                 clock=None):  # fmt: skip
        if feedback not in FEEDBACK or reply not in REPLIES:
            raise ValueError(f"feedback is one of {FEEDBACK} and reply one of {REPLIES}, got {feedback!r}, {reply!r}")
        self.head, self.baudrate, self.address = head or Head(seed=seed), baudrate, address
        self.feedback, self.reply_kind, self.echo = feedback, "none" if feedback == "none" else reply, echo
        self.speeds, self.go_speed = np.radians(speeds), math.radians(go_speed)
        self.watchdog_s, self.sign = watchdog_s, -1 if invert else 1
        self.clock, self.faults, self.frames = clock or Clock(time_scale), Faults("head", seed), deque(maxlen=KEPT)
        self.line = Line(path, self, self.clock, self.faults)
        self._buffer, self._absolute_until, self._presets = b"", -math.inf, {}

    @property
    def path(self):
        """Of the port, str."""
        return str(self.line.path)

    def start(self):
        """Make the port and serve it."""
        self.line.start()
        return self

    def close(self):
        """Remove the port."""
        self.line.close()

    __enter__ = start

    def __exit__(self, *_):
        self.close()

    def pitch(self, instant=None):
        """True pitch now, or at instants of the devices' clock, radians."""
        return self.head.pitch(self.clock.now() if instant is None else instant)

    # ------------------------------------------------------------------------------------------- frames

    def receive(self, data, at):
        """Bytes of the host; the last of them arrived at an instant."""
        if self.echo:
            self.line.write(data, at)
        self._buffer += data
        self.line.cancel("fragment")
        while (frame := self._cut()) is not None:
            self._hear(frame, at)
        if self._buffer:
            self.line.at(at + FRAGMENT_S, self._forget, "fragment")

    def _forget(self, _):
        self._buffer = b""

    def _cut(self):
        """The next sound frame of the buffer; None until there is one."""
        while (start := self._buffer.find(SYNC)) >= 0:
            self._buffer = self._buffer[start:]
            if len(self._buffer) < FRAME:
                return None
            frame = self._buffer[:FRAME]
            if frame[6] == checksum(frame[1:6]):
                self._buffer = self._buffer[FRAME:]
                return frame
            self._buffer = self._buffer[1:]
        self._buffer = b""
        return None

    def _hear(self, frame, at):
        if frame[1] != self.address:
            return
        self.frames.append((time.time(), frame))
        self.line.cancel("watchdog")
        if self.watchdog_s:
            self.line.at(at + self.watchdog_s, self._stop, "watchdog")
        opcode, value = frame[3], frame[4] << 8 | frame[5]
        if opcode in QUERIES:
            return self._tell(opcode, at)
        if opcode == PART_NUMBER:
            return self._part_number(frame, at)
        if opcode & 1:
            self._extended(opcode, value, at)
        else:
            self._jog(opcode, frame[4], frame[5], at)
        self._confirm(frame, at)

    # ------------------------------------------------------------------------------------------- motion

    def _stop(self, at):
        if self.faults.hit("slip"):
            at += SLIP_S
        self._absolute_until = -math.inf
        self.head.stop(at)
        self.head.pan.stop(at)

    def _jog(self, bits, pan_speed, tilt_speed, at):
        """Up, down, left, right; without a direction it is a stop whatever the speeds say."""
        if not bits & (UP | DOWN | LEFT | RIGHT):
            return self._stop(at)
        if self.faults.hit("stall"):
            return
        self._absolute_until = -math.inf
        if bits & (UP | DOWN):
            way = self.sign if bits & UP else -self.sign
            self.head.move(at, way * math.tau, self._speed(tilt_speed))
        else:
            self.head.stop(at)
        if bits & (LEFT | RIGHT):
            self.head.pan.run(at, (1 if bits & RIGHT else -1) * 1e9, self._speed(pan_speed))
        else:
            self.head.pan.stop(at)

    def _speed(self, byte):
        slow, fast = self.speeds
        return slow + (fast - slow) * min(byte, 0x3F) / 0x3F

    def _extended(self, opcode, value, at):
        if opcode == 0x03:
            self._presets[value] = self.head.measured(at)
        elif opcode == 0x07 and value in self._presets:
            self._go(self._presets[value], at)
        elif opcode == SET_TILT and self.feedback == "full" and value < 36000:
            self._go(self.sign * tilt_elevation(value), at)
        elif opcode == SET_PAN and self.feedback == "full" and value < 36000:
            now = float(self.head.pan.motor(at))
            way = (math.radians(value / 100) - now + math.pi) % math.tau - math.pi
            self._absolute(at, way)
            self.head.pan.run(at, now + way, self.go_speed)

    def _go(self, goal, at):
        if at < self._absolute_until or self.faults.hit("stall"):  # a second absolute move is lost
            return
        goal = float(np.clip(goal, *self.head.tilt.limits))
        self._absolute(at, goal - float(self.head.tilt.motor(at)))
        self.head.go(at, goal, self.go_speed)

    def _absolute(self, at, way):
        self._absolute_until = at + abs(way) / self.go_speed

    # ------------------------------------------------------------------------------------------- replies

    def prepare(self, raw):
        """A reply with the faults that keep its checksum sound."""
        hit, whole = self.faults.hit, len(raw) == FRAME
        if whole and raw[3] in (0x59, 0x5B) and hit("jump"):
            value = ((raw[4] << 8 | raw[5]) + JUMP) % 36000
            raw = self._frame(raw[3], value)
        if len(raw) >= 4 and raw[0] == SYNC and hit("address"):
            other = raw[1] % 255 + 1
            raw = bytes([SYNC, other]) + raw[2:-1] + bytes([(raw[-1] + other - raw[1]) % 256])
        if hit("foreign"):
            raw = self._frame(0x5D, 0x1234) + raw
        return raw

    def _frame(self, opcode, value):
        body = bytes([self.address, 0, opcode, value >> 8, value & 0xFF])
        return bytes([SYNC, *body, checksum(body)])

    def _confirm(self, frame, at):
        answer = {"general": bytes([SYNC, self.address, 0, frame[6]]), "single": b"\x01"}.get(self.reply_kind)
        if answer:
            self.line.reply("confirm", answer, at + TURN_AROUND_S)

    def _tell(self, opcode, at):
        """Answer a query, unless the head is too busy or does not know how."""
        moving = self.head.tilt.moving(at) or self.head.pan.moving(at)
        deaf = at < self._absolute_until or (self.feedback == "partial" and moving)
        if self.reply_kind == "none" or deaf or self.faults.hit("mute"):
            return
        value = {0x51: self._pan_raw, 0x53: self._tilt_raw}.get(opcode, lambda _: 0)(at)
        frame = self._frame(QUERIES[opcode], value)
        if self.reply_kind == "five":
            frame = bytes([0, *frame[3:6], checksum(frame[3:6])])
        self.line.reply(opcode, frame, at + TURN_AROUND_S)

    def _tilt_raw(self, at):
        return tilt_raw(self.sign * self.head.measured(at))

    def _pan_raw(self, at):
        return round(math.degrees(float(self.head.pan.motor(at))) * 100) % 36000

    def _part_number(self, frame, at):
        if self.reply_kind != "none":
            text = bytes([self.address]) + NAME
            self.line.reply(PART_NUMBER, bytes([SYNC]) + text + bytes([checksum(text + frame[6:])]), at + TURN_AROUND_S)
