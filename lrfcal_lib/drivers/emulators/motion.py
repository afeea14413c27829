"""How a pan-tilt head really moves: speeds, limits, play of the gear, wobble after a stop; known at every instant."""

from __future__ import annotations

import numpy as np

from lrfcal_lib.simulate.rig import Platform

REACT_S = 0.04  # from a command to the motor
WOBBLE = 0.015  # amplitude after a stop, radians for each rad/s of speed
WOBBLE_HZ = 4.0
KEPT = 2000  # pieces of motion


class History:
    """Rows that hold from an instant on; rows of the future are replaced by what is noted before they begin.

    One thread notes, any may look: a look sees the table of before or of after.

    Parameters
    ----------
    row : tuple of float
        Holds from the beginning.
    """

    def __init__(self, row):
        self._table = np.array([(-np.inf, *row)])

    def note(self, instant, *row):
        """Let a row hold from an instant on."""
        past = self._table[self._table[:, 0] <= instant]
        self._table = np.vstack([past[-KEPT:], (instant, *row)])

    def at(self, instant):
        """Columns of the rows that hold at instants: when each began, and its values."""
        table = self._table
        return np.moveaxis(table[np.searchsorted(table[:, 0], instant, side="right") - 1], -1, 0)

    def before(self, instant):
        """The row before the one that holds."""
        table = self._table
        return table[max(0, np.searchsorted(table[:, 0], instant, side="right") - 2)]

    @property
    def newest(self):
        """When the newest row begins."""
        return self._table[-1, 0]


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
        return float(instant - begun), float(self._pieces.before(instant)[-1])

    def moving(self, instant):
        """Whether the motor runs, or is about to."""
        return self.resting(instant)[0] < 0 or self._pieces.newest > instant


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
        self.tilt = Axis(pitch, self.platform.limits)
        self.pan = Axis(0.0, (-1e9, 1e9))
        self._heads = History((self._stretched(pitch),))  # where the head was when each command came

    def move(self, instant, goal, speed):
        """Tilt towards an angle at a speed, radians; the motor reacts a little later."""
        instant += REACT_S
        self._mark(instant)
        self.tilt.run(instant, goal, speed)

    def go(self, instant, goal, speed):
        """Tilt to an angle, missed by the noise of the platform."""
        self.move(instant, goal + self.platform.noise * self.rng.standard_normal(), speed)

    def stop(self, instant):
        """Stop tilting."""
        instant += REACT_S
        self._mark(instant)
        self.tilt.stop(instant)

    def pitch(self, instant):
        """True pitch at one instant or many, radians.

        Notes
        -----
        The gear drags the head along only when it has run through its play: within a piece of motion, which goes one
        way, the head stays where it was until the motor is half the play ahead of it.
        """
        instant, half = np.asarray(instant, float), self.platform.backlash / 2
        _, before = self._heads.at(instant)
        motor = self._stretched(self.tilt.motor(instant))
        return np.clip(before, motor - half, motor + half) + self._wobble(instant)

    def measured(self, instant):
        """What the encoder says, radians; it sits on the motor and is late."""
        angle, step = self.tilt.motor(instant - self.platform.latency), self.platform.encoder_step
        return float(np.rint(angle / step) * step if step else angle)

    def settled(self, instant):
        """Whether the head is at rest, its wobble included."""
        return not self.tilt.moving(instant) and self.tilt.resting(instant)[0] >= self.platform.settle

    def _stretched(self, motor):
        return (1 + self.platform.stretch) * motor

    def _mark(self, instant):
        """Remember where the head is within its play before the motor may turn back."""
        half, motor = self.platform.backlash / 2, self._stretched(float(self.tilt.motor(instant)))
        _, before = self._heads.at(instant)
        self._heads.note(instant, np.clip(before, motor - half, motor + half))

    def _wobble(self, instant):
        since, speed = self.tilt.resting(float(np.max(instant)))
        settle = self.platform.settle
        if not 0 < since < settle + np.ptp(instant) or not settle:
            return 0.0
        after = np.clip(since - (np.max(instant) - instant), 0, None)
        swing = WOBBLE * speed * np.exp(-5 * after / settle) * np.sin(2 * np.pi * WOBBLE_HZ * after)
        return np.where(after < settle, swing, 0.0)
