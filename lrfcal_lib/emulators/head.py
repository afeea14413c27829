"""A Pelco-D pan-tilt head, as good or as bad as heads are; how it moves is known at every instant."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from lrfcal_lib.drivers import pelco_d
from lrfcal_lib.drivers.pelco_d import ANSWER, DOWN, LEFT, RIGHT, SYNC, UP, encode_extended
from lrfcal_lib.emulators.line import Clock, SerialDevice
from lrfcal_lib.simulate.rig import Platform

REACT_S = 0.04  # from a command to the motor
WOBBLE = 0.015  # amplitude after a stop, radians for each rad/s of speed
WOBBLE_HZ = 4.0
KEPT = 2000  # pieces of motion; ten times as many frames
TURN_AROUND_S = 0.010  # from the end of a frame to a reply
FRAGMENT_S = 0.1  # a frame begun is forgotten after so long
SLIP_S = 0.3  # of the fault
JUMP = 1000  # of the fault, hundredths of a degree
NAME = b"LRFCAL-EMULATED"
FEEDBACK = ("full", "partial", "none")
REPLIES = ("extended", "general", "five", "single", "none")


class History:
    """Rows that hold from an instant on; rows of the future are replaced by what is noted before they begin.

    One thread notes, any may look: a look sees the table of before or of after.

    Parameters
    ----------
    row : tuple of float
        Holds from the beginning.
    """

    def __init__(self, row):
        self.table = np.array([(-np.inf, *row)])

    def note(self, instant, *row):
        """Let a row hold from an instant on."""
        past = self.table[self.table[:, 0] <= instant]
        self.table = np.vstack([past[-KEPT:], (instant, *row)])

    def at(self, instant, back=0):
        """Columns of the rows that hold at instants, or of those before: when each began, and its values."""
        table = self.table
        row = np.searchsorted(table[:, 0], instant, side="right") - 1 - back
        return np.moveaxis(table[np.maximum(row, 0)], -1, 0)


class Axis:
    """A motor that runs at constant speed to where it is told, or until it is stopped.

    Parameters
    ----------
    start : float
        Radians.
    limits : tuple of float
        Radians.
    """

    def __init__(self, start, limits):
        self.limits, self._pieces = limits, History((start, start, 0.0))  # from, to, rad/s

    def run(self, instant, goal, speed):
        """Run to an angle, at most to a limit, from an instant on."""
        now, goal = float(self.motor(instant)), float(np.clip(goal, *self.limits))
        self._pieces.note(instant, now, goal, abs(speed) * np.sign(goal - now))

    def stop(self, instant):
        """Stop where it is; what rests already goes on resting."""
        if self.moving(instant):
            self.run(instant, float(self.motor(instant)), 0.0)

    def motor(self, instant):
        """Angle of the motor at one instant or many, radians."""
        instant = np.asarray(instant, float)
        begun, first, last, speed = self._pieces.at(instant)
        way = np.where(speed == 0, 0.0, speed * np.where(np.isfinite(begun), instant - begun, 0.0))
        return np.where(speed >= 0, np.minimum(first + way, np.maximum(first, last)), np.maximum(first + way, last))

    def resting(self, instant):
        """Seconds since the motor came to rest, negative while it runs; and the speed it had."""
        begun, first, last, speed = self._pieces.at(instant)
        if speed != 0:
            return float(instant - begun - abs((last - first) / speed)), float(speed)
        return float(instant - begun), float(self._pieces.at(instant, back=1)[-1])

    def moving(self, instant):
        """Whether the motor runs, or is about to."""
        return self.resting(instant)[0] < 0 or self._pieces.table[-1, 0] > instant


class Head:
    """Pan and tilt of a head, and the pitch that the sensors on it have.

    Parameters
    ----------
    platform : Platform, optional
        Backlash, stretch, noise, encoder step, settling and limits.
    seed : int
    pitch : float
        At the start, radians.
    """

    def __init__(self, platform=None, seed=0, pitch=0.0):
        self.platform, self.rng = platform or Platform(), np.random.default_rng([seed, 2])
        self.tilt, self.pan = Axis(pitch, self.platform.limits), Axis(0.0, (-1e9, 1e9))
        self._heads = History((self._stretched(pitch),))  # where the head was when each command came

    def move(self, instant, goal, speed):
        """Tilt towards an angle at a speed, radians; the motor reacts a little later."""
        self._mark(instant + REACT_S)
        self.tilt.run(instant + REACT_S, goal, speed)

    def go(self, instant, goal, speed):
        """Tilt to an angle, missed by the noise of the platform."""
        self.move(instant, goal + self.platform.noise * self.rng.standard_normal(), speed)

    def stop(self, instant):
        """Stop tilting."""
        self._mark(instant + REACT_S)
        self.tilt.stop(instant + REACT_S)

    def pitch(self, instant):
        """True pitch at one instant or many, radians.

        Notes
        -----
        The gear drags the head along only when it has run through its play: within a piece of motion, which goes one
        way, the head stays where it was until the motor is half the play ahead of it.
        """
        instant = np.asarray(instant, float)
        return self._dragged(instant) + self._wobble(instant)

    def measured(self, instant):
        """What the encoder says, radians; it sits on the motor and is late."""
        angle, step = self.tilt.motor(instant - self.platform.latency), self.platform.encoder_step
        return float(np.rint(angle / step) * step if step else angle)

    def settled(self, instant):
        """Whether the head is at rest, its wobble included."""
        return not self.tilt.moving(instant) and self.tilt.resting(instant)[0] >= self.platform.settle

    def _stretched(self, motor):
        return (1 + self.platform.stretch) * motor

    def _dragged(self, instant):
        half, motor = self.platform.backlash / 2, self._stretched(self.tilt.motor(instant))
        return np.clip(self._heads.at(instant)[1], motor - half, motor + half)

    def _mark(self, instant):
        """Remember where the head is within its play before the motor may turn back."""
        self._heads.note(instant, self._dragged(instant))

    def _wobble(self, instant):
        since, speed = self.tilt.resting(float(np.max(instant)))
        settle = self.platform.settle
        if not 0 < since < settle + np.ptp(instant) or not settle:
            return 0.0
        after = np.clip(since - (np.max(instant) - instant), 0, None)
        swing = WOBBLE * speed * np.exp(-5 * after / settle) * np.sin(2 * np.pi * WOBBLE_HZ * after)
        return np.where(after < settle, swing, 0.0)


class EmulatedHead(SerialDevice):
    """A pan-tilt head.

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
    frames : deque of (float, Frame)
        Host time and sound frames to this address.
    """

    def __init__(self, head=None, *, path, baudrate=2400, address=1, feedback="full", reply="extended", echo=False,
                 speeds=(0.5, 12.0), go_speed=8.0, watchdog_s=None, invert=False, seed=0, time_scale=1.0,
                 clock=None):  # fmt: skip
        if feedback not in FEEDBACK or reply not in REPLIES:
            raise ValueError(f"feedback is one of {FEEDBACK} and reply one of {REPLIES}, got {feedback!r}, {reply!r}")
        super().__init__("head", path, clock or Clock(time_scale), seed)
        self.head, self.baudrate, self.address = head or Head(seed=seed), baudrate, address
        self.feedback, self.reply_kind, self.echo = feedback, "none" if feedback == "none" else reply, echo
        self.speeds, self.go_speed = np.radians(speeds), math.radians(go_speed)
        self.watchdog_s, self.sign, self.frames = watchdog_s, -1 if invert else 1, deque(maxlen=10 * KEPT)
        self._buffer, self._absolute_until, self._presets = b"", -math.inf, {}

    def pitch(self, instant=None):
        """True pitch now, or at instants of the devices' clock, radians."""
        return self.head.pitch(self.clock.now() if instant is None else instant)

    # ------------------------------------------------------------------------------------------- frames

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
                self._obey(frame, at)
        if self._buffer:
            self.at(at + FRAGMENT_S, self._forget, "fragment")

    def _forget(self, _):
        self._buffer = b""

    def _obey(self, frame, at):
        self.frames.append((self.clock.machine.time(), frame))
        self.cancel("watchdog")
        if self.watchdog_s:
            self.at(at + self.watchdog_s, self._stop, "watchdog")
        opcode = frame.command2
        body = bytes([frame.address, frame.command1, opcode, frame.data1, frame.data2])
        if opcode in ANSWER:
            return self._tell(opcode, at)
        if opcode == pelco_d.PART_NUMBER and self.reply_kind != "none":
            text = bytes([self.address]) + NAME
            raw = bytes([SYNC]) + text + bytes([(sum(text) + sum(body)) % 256])
            return self.reply(opcode, raw, at + TURN_AROUND_S)
        self._extended(opcode, frame.value, at) if opcode & 1 else self._jog(frame, at)
        answers = {"general": bytes([SYNC, self.address, 0, sum(body) % 256]), "single": b"\x01"}
        if self.reply_kind in answers:
            self.reply("confirm", answers[self.reply_kind], at + TURN_AROUND_S)

    # ------------------------------------------------------------------------------------------- motion

    def _stop(self, at):
        at += SLIP_S * self.faults.hit("slip")
        self._absolute_until = -math.inf
        self.head.stop(at)
        self.head.pan.stop(at)

    def _jog(self, frame, at):
        """Up, down, left, right; without a direction it is a stop whatever the speeds say."""
        bits = frame.command2
        if not bits & (UP | DOWN | LEFT | RIGHT):
            return self._stop(at)
        if self.faults.hit("stall"):
            return
        self._absolute_until = -math.inf
        if bits & (UP | DOWN):
            self.head.move(at, (self.sign if bits & UP else -self.sign) * math.tau, self._speed(frame.data2))
        else:
            self.head.stop(at)
        if bits & (LEFT | RIGHT):
            self.head.pan.run(at, 1e9 if bits & RIGHT else -1e9, self._speed(frame.data1))
        else:
            self.head.pan.stop(at)

    def _speed(self, byte):
        return self.speeds[0] + (self.speeds[1] - self.speeds[0]) * min(byte, 0x3F) / 0x3F

    def _extended(self, opcode, value, at):
        angle = self.feedback == "full" and value < pelco_d.TURN
        if opcode == pelco_d.SET_PRESET:
            self._presets[value] = self.head.measured(at)
        elif opcode == pelco_d.GO_PRESET and value in self._presets:
            self._go(self._presets[value], at)
        elif opcode == pelco_d.SET_TILT and angle:
            self._go(self.sign * pelco_d.decode_tilt(value), at)
        elif opcode == pelco_d.SET_PAN and angle:
            now = float(self.head.pan.motor(at))
            way = (math.radians(value / 100) - now + math.pi) % math.tau - math.pi
            self._absolute_until = at + abs(way) / self.go_speed
            self.head.pan.run(at, now + way, self.go_speed)

    def _go(self, goal, at):
        if at < self._absolute_until or self.faults.hit("stall"):  # a second absolute move is lost
            return
        goal = float(np.clip(goal, *self.head.tilt.limits))
        self._absolute_until = at + abs(goal - float(self.head.tilt.motor(at))) / self.go_speed
        self.head.go(at, goal, self.go_speed)

    # ------------------------------------------------------------------------------------------- replies

    def prepare(self, raw):
        """A reply with the faults that keep its checksum sound."""
        hit = self.faults.hit
        if len(raw) == pelco_d.FRAME and raw[3] in (pelco_d.PAN, pelco_d.TILT) and hit("jump"):
            raw = encode_extended(self.address, raw[3], (int.from_bytes(raw[4:6], "big") + JUMP) % pelco_d.TURN)
        if len(raw) >= pelco_d.GENERAL and raw[0] == SYNC and hit("address"):
            other = raw[1] % 255 + 1
            raw = bytes([SYNC, other]) + raw[2:-1] + bytes([(raw[-1] + other - raw[1]) % 256])
        return encode_extended(self.address, pelco_d.ZOOM, 0x1234) + raw if hit("foreign") else raw

    def _tell(self, opcode, at):
        """Answer a query, unless the head is too busy or does not know how."""
        moving = self.head.tilt.moving(at) or self.head.pan.moving(at)
        busy = at < self._absolute_until or (self.feedback == "partial" and moving)
        if self.reply_kind == "none" or busy or self.faults.hit("mute"):
            return
        pan = round(math.degrees(float(self.head.pan.motor(at))) * 100) % pelco_d.TURN
        tilt = pelco_d.encode_tilt(self.sign * self.head.measured(at))
        value = {pelco_d.QUERY_TILT: tilt, pelco_d.QUERY_PAN: pan}.get(opcode, 0)
        raw = encode_extended(self.address, ANSWER[opcode], value)
        if self.reply_kind == "five":
            raw = bytes([0, *raw[3:6], sum(raw[3:6]) % 256])
        self.reply(opcode, raw, at + TURN_AROUND_S)
