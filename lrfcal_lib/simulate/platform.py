"""A pitching platform that lies a little about its pitch: backlash, stretch, latency, noise, encoder steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Platform:
    """Settings of the pitching platform.

    Attributes
    ----------
    backlash : float
        Play of the gear, radians: the head hangs back by half of it against the direction of motion.
    stretch : float
        The head turns ``1 + stretch`` times as far as the platform says.
    latency : float
        Seconds by which the measured pitch is older than its time stamp.
    noise : float
        Standard deviation of where the head comes to rest about where it should, radians.
    encoder_step : float
        Of the measured pitch, radians; 0 for none.
    speed : float
        Of continuous motion, radians a second.
    settle : float
        Seconds from a command to rest in stop-and-go.
    limits : tuple of float
        Least and greatest pitch, radians.

    Raises
    ------
    ValueError
        For impossible settings.
    """

    backlash: float = 0.0
    stretch: float = 0.0
    latency: float = 0.0
    noise: float = 0.0
    encoder_step: float = 0.0
    speed: float = math.radians(5.0)
    settle: float = 0.4
    limits: tuple[float, float] = (-math.radians(60), math.radians(60))

    def __post_init__(self):
        for name in ("backlash", "latency", "noise", "encoder_step", "settle"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"platform: {name} is {getattr(self, name)}, it must be zero or positive")
        if not 0 < self.speed < math.inf:
            raise ValueError(f"platform: speed is {self.speed} rad/s, it must be positive")
        if not abs(self.stretch) < 0.5:
            raise ValueError(f"platform: stretch is {self.stretch}, a share of the angle (0.01 is one per cent)")

    def stop(self, commanded, direction, rng):
        """Come to rest at commanded angles.

        Parameters
        ----------
        commanded : ndarray, shape (n,)
            Radians.
        direction : int or ndarray, shape (n,)
            +1 where the head arrives from below, -1 from above.
        rng : numpy.random.Generator

        Returns
        -------
        true, measured : ndarray, shape (n,)
            Radians. The encoder sits on the motor: it sees neither backlash nor stretch.

        Raises
        ------
        ValueError
            Beyond the limits.
        """
        commanded = np.asarray(commanded, float)
        self.check(commanded)
        rest = commanded + self.noise * rng.standard_normal(commanded.shape)
        return self._head(rest, direction), self._encoder(rest)

    def sweep(self, start, stop, time_s):
        """Move at constant speed.

        Parameters
        ----------
        start, stop : float
            Radians.
        time_s : ndarray
            Seconds after the start.

        Returns
        -------
        true, measured : ndarray, shape of `time_s`
            Radians; the measured pitch lags by the latency.
        """
        self.check(np.array([start, stop]))
        way, time_s = stop - start, np.asarray(time_s, float)

        def motor(t):
            return start + np.sign(way) * np.clip(self.speed * t, 0, abs(way))

        return self._head(motor(time_s), np.sign(way)), self._encoder(motor(time_s - self.latency))

    def check(self, pitch):
        """Refuse angles beyond the limits."""
        low, high = self.limits
        if pitch.size and (pitch.min() < low or pitch.max() > high):
            asked, has = (np.round(np.degrees([a, b]), 2) for a, b in ((pitch.min(), pitch.max()), self.limits))
            wanted = f"pitch {asked[0]} to {asked[1]} deg is asked for"
            raise ValueError(f"platform: {wanted}, it turns {has[0]} to {has[1]} deg")

    def _head(self, motor, direction):
        return (1 + self.stretch) * motor - np.asarray(direction) * self.backlash / 2

    def _encoder(self, motor):
        return np.rint(motor / self.encoder_step) * self.encoder_step if self.encoder_step else motor


def step_angles(first, last, step):
    """Pitch commands of a stop-and-go sweep: multiples of `step` from about `first` to about `last`, radians."""
    if step <= 0:
        raise ValueError(f"a pitch step must be positive, got {step} rad")
    low, high = sorted((first, last))
    angles = np.arange(math.floor(low / step), math.ceil(high / step) + 1) * step
    return angles if last >= first else angles[::-1]
