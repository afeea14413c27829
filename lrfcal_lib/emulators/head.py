"""A Pelco-D pan-tilt head, as good or as bad as heads are; how it moves is always known."""

import math
import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lrfcal_lib.drivers import pelco_d
from lrfcal_lib.drivers.pelco_d import DOWN, FASTEST, QUERY_TILT, TILT, UP, encode_extended
from lrfcal_lib.drivers.port import REAL, Host
from lrfcal_lib.emulators.line import SerialDevice
from lrfcal_lib.simulate.rig import Platform

REACT_S = 0.04  # from a command to the motor
KEPT = 2000  # knots of the motion
TURN_AROUND_S = 0.010  # from the end of a frame to a reply
# to queries of pan, tilt, zoom, magnification
ANSWERS = {0x51: 0x59, QUERY_TILT: TILT, 0x55: 0x5D, 0x61: 0x63}


class Head:
    """Tilt of a head and the pitch that the sensors on it have.

    Its motor runs at constant speed to where it is told, or until it is stopped.

    Parameters
    ----------
    platform
        How well it is made.
    seed
        Of its noise.
    pitch
        At the start, radians.
    """

    def __init__(self, platform: Platform | None = None, seed: int = 0, pitch: float = 0.0):
        self.platform = platform or Platform()
        self._rng = np.random.default_rng([seed, 2])
        # rows: instant, motor, and where its play leaves the head. One thread writes them, any may
        # look: a look sees the table of before or of after.
        self._knots = np.array([(0.0, pitch, (1 + self.platform.stretch) * pitch)])

    def move(self, instant: float, goal: ArrayLike, speed: float) -> None:
        """Tilt towards an angle, at most to a limit; the motor reacts a little later.

        Parameters
        ----------
        instant
            Of the command, s.
        goal
            Radians.
        speed
            Radians a second.
        """
        reacts = instant + REACT_S
        now = self.motor(reacts)
        goal = np.clip(goal, *self.platform.limits)
        dragged = self.pitch(reacts)
        knots: list = [(reacts, now, dragged)]
        if speed:
            arrives = reacts + abs((goal - now) / speed)
            knots.append((arrives, goal, self._with_play(dragged, goal)))
        before = self._knots[self._knots[:, 0] < reacts]
        self._knots = np.vstack([before[-KEPT:], *knots])

    def go(self, instant: float, goal: float, speed: float) -> None:
        """Tilt to an angle, missed by the noise of the platform.

        Parameters
        ----------
        instant, goal, speed
            As of :meth:`move`.
        """
        self.move(instant, goal + self.platform.noise * self._rng.standard_normal(), speed)

    def stop(self, instant: float) -> None:
        """Stop tilting; what rests already goes on resting.

        Parameters
        ----------
        instant
            Of the command, s.
        """
        reacts = instant + REACT_S
        if self.moving(reacts):
            self.move(instant, self.motor(reacts), 0.0)

    def motor(self, instant: float | np.ndarray) -> np.ndarray:
        """Angle of the motor.

        Parameters
        ----------
        instant
            One or many, s.

        Returns
        -------
        ndarray
            Radians.
        """
        return np.interp(instant, self._knots[:, 0], self._knots[:, 1])

    def moving(self, instant: float) -> bool:
        """Whether the motor runs, or is about to.

        Parameters
        ----------
        instant
            Seconds.
        """
        return instant < self._knots[-1, 0]

    def settled(self, instant: float, rest_s: float) -> bool:
        """Whether the head has been at rest for the time in which it settles.

        Parameters
        ----------
        instant
            Seconds.
        rest_s
            For so long, seconds.
        """
        return instant >= self._knots[-1, 0] + self.platform.settle + rest_s

    def pitch(self, instant: float | np.ndarray) -> np.ndarray:
        """True pitch: where the gear, which has some play, has dragged the head.

        Parameters
        ----------
        instant
            One or many, s.

        Returns
        -------
        ndarray
            Radians.
        """
        # between two knots the motor goes one way
        row = np.searchsorted(self._knots[:, 0], instant, side="right") - 1
        return self._with_play(self._knots[np.maximum(row, 0), 2], self.motor(instant))

    def measured(self, instant: float) -> float:
        """What the encoder says; it sits on the motor and is late.

        Parameters
        ----------
        instant
            Seconds.

        Returns
        -------
        float
            Radians.
        """
        return float(self.platform.encoded(self.motor(instant - self.platform.latency)))

    def _with_play(self, dragged, motor):
        """The head stays where it was until the motor is half the play ahead of it."""
        half = self.platform.backlash / 2
        driven = (1 + self.platform.stretch) * motor
        return np.clip(dragged, driven - half, driven + half)


@dataclass(frozen=True)
class Habits:
    """How a head behaves at its line.

    Attributes
    ----------
    feedback : {'full', 'partial', 'none'}
        'full': tells its position except during an absolute move, and makes absolute moves.
        'partial': tells its position at rest only, and ignores absolute moves. 'none': neither;
        nothing is ever answered.
    speeds : tuple of float
        Tilt speed at speed byte 0 and at 0x3F, between which it grows evenly; degrees a second.
    go_speed : float
        Of absolute moves, degrees a second.
    """

    baudrate: int = 2400
    address: int = 1
    feedback: str = "full"
    speeds: tuple = (0.5, 12.0)
    go_speed: float = 8.0


class EmulatedHead(SerialDevice):
    """A pan-tilt head; its pan does not turn.

    Parameters
    ----------
    head
        Its motion; the pitch is the elevation, up positive.
    path
        Of the port to appear.
    seed, host
        As for :class:`EmulatedLms`.
    **habits
        Of :class:`Habits`.
    """

    gap_s = 0.1  # a frame begun is forgotten after so long

    def __init__(
        self,
        head: Head | None = None,
        *,
        path: str | os.PathLike,
        seed: int = 0,
        host: Host = REAL,
        **habits,
    ):
        super().__init__(path, host, seed)
        self.head = head or Head(seed=seed)
        self.habits = Habits(**habits)
        self.absolute = False  # its last move

    @property
    def baudrate(self) -> int:
        """Of its line."""
        return self.habits.baudrate

    def take(self, raw: bytes, at: float) -> int:
        """Obey what frames of the host say.

        Parameters
        ----------
        raw
            Of any number of frames, whole or not.
        at
            Instant of the last of its bytes, s.

        Returns
        -------
        int
            From where on bytes must be kept.
        """
        frames, pending = pelco_d.split_frames(raw)
        for frame in frames:
            if frame.address == self.habits.address:
                self.obey(frame, at)
        return pending

    def obey(self, frame: pelco_d.Frame, at: float) -> None:
        """Do what a frame says.

        Parameters
        ----------
        frame
            To this address.
        at
            Instant of its last byte, s.
        """
        if frame.command2 in ANSWERS:
            self.tell(frame.command2, at)
        elif frame.command2 == pelco_d.SET_TILT:
            self._set_tilt(frame.value, at)
        elif not frame.command2 & 1:
            self._turn(frame, at)

    def _turn(self, frame, at):
        """Move up or down; without a direction it is a stop, whatever the speeds say."""
        goal = {UP: math.tau, DOWN: -math.tau}.get(frame.command2 & (UP | DOWN))
        if goal is None:
            self.stop(at)
            return
        self.absolute = False
        speed = np.interp(frame.data2, (0, FASTEST), self.habits.speeds)
        self.head.move(at, goal, math.radians(speed))

    def _set_tilt(self, value, at):
        """Move to an elevation; a second such move is lost while the first is under way."""
        busy = self.absolute and self.head.moving(at)
        if busy or self.habits.feedback != "full" or value >= pelco_d.TURN:
            return
        self.absolute = True
        self.head.go(at, pelco_d.decode_tilt(value), math.radians(self.habits.go_speed))

    def stop(self, at: float) -> None:
        """Stop the motor.

        Parameters
        ----------
        at
            Instant of the command, s.
        """
        self.absolute = False
        self.head.stop(at)

    def tell(self, opcode: int, at: float) -> None:
        """Answer a query, unless the head is too busy or does not know how.

        Parameters
        ----------
        opcode
            Of the query.
        at
            Instant of its last byte, s.
        """
        feedback = self.habits.feedback
        busy = self.head.moving(at) and (self.absolute or feedback == "partial")
        if feedback == "none" or busy:
            return
        value = 0
        if opcode == QUERY_TILT:
            value = pelco_d.encode_tilt(self.head.measured(at))
        self.reply(
            encode_extended(self.habits.address, ANSWERS[opcode], value),
            at + TURN_AROUND_S,
        )
