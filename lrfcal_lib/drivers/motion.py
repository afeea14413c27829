"""Motions of a Pelco-D head: by set-tilt, by up and down or by time, and dead reckoning."""

import itertools
import logging
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lrfcal_lib.drivers import pelco_d
from lrfcal_lib.drivers.pelco_d import (
    DOWN,
    SET_TILT,
    UP,
    HeadLine,
    encode_extended,
    encode_frame,
)
from lrfcal_lib.drivers.port import DeviceError, LineLost, NoReply, Refused

LOG = logging.getLogger(__name__)
ASSUMED = 4.0, 4.0  # deg/s up and down, as of heads of constant speed
EXTRA_S = 10  # that a move may take beside twice the time of its way
# a move that ends this near has arrived; its settled pitch counts
ARRIVAL = math.radians(0.5)
STALLED = 5  # settle times at rest elsewhere: the head does not get to where it was sent
BURSTS = 25  # of up and down, to reach one pitch
FIRST_BURST_S = 0.1  # of a head whose speed is unknown
GROWTH = 4  # of bursts while the speed is being learnt
# part of the way that a burst is to make, so that the last come from one side
SHORT_OF = 0.9
SURPRISE = math.radians(3)  # from dead reckoning: then a reading is not believed at once
LEAST_S = 1e-4  # of a wait worth its while
# queries without a reply, after which a head that is swept is not asked any more
MISSES = 3
WRONG_WAY = math.radians(2)  # that a sweep may seem to go
OTHER_WAY = "the head moves in the opposite direction: change invert"
DISOBEYS = "the head does not obey set-tilt (4D)"
STOPPED = "the head was stopped before it arrived"
UNKNOWN = (
    "where the head stands is unknown since its line was lost: look, and call set_pitch"
)


class Stopped(DeviceError):
    """The motion was ended by a stop."""


class TrackPoint(NamedTuple):
    """Where the head was."""

    instant: float  # of the host
    pitch: float  # radians
    reckoned: float  # dead reckoning before that was known, radians
    measured: bool = True  # the head told it


class Motion:
    """Motions of one axis, its speeds, and where it must be by now.

    Angles are in rad, speeds in rad/s, instants those of the host. While the event `abort` is set
    nothing moves the head.

    Parameters
    ----------
    line
        To the head.
    settings : rig_file.HeadSettings

    Attributes
    ----------
    has_feedback : bool
        The head tells its tilt, if maybe not while it moves.
    calibrated : bool
        Its speed was stated or measured, not assumed.
    rows : list of TrackPoint
        Of the sweep that runs or ran last.
    """

    has_feedback: bool

    def __init__(self, line: HeadLine, settings):
        self.line = line
        self.settings = settings
        self.abort = line.host.event()
        self.rows: list[TrackPoint] = []
        self.calibrated = settings.degrees_per_second is not None
        self._now = line.host.now
        self._zero = line.host.time() - line.host.now()  # date of the instant 0
        up, down = map(math.radians, settings.degrees_per_second or ASSUMED)
        # by whether it goes up, and speed byte
        self._speeds = {
            True: {settings.tilt_speed: up},
            False: {settings.tilt_speed: down},
        }
        self._longest = math.inf if self.calibrated else FIRST_BURST_S / GROWTH
        # whether set-tilt moves the head; None until it was tried
        self._obeys = None if settings.absolute else False
        self._dead: set[int] = set()  # speed bytes at which the head does not move
        # way (1 up, -1 down) and speed byte of the motion
        self._going: tuple | None = None
        self._repeated = math.inf  # when it was last sent, if the head goes
        self._pitch: float | None = None
        self._tolerance = math.radians(settings.tolerance_deg)
        self._shortest_s = 2 * line.frame_s + settings.gap_s  # of a motion and its stop

    # -------------------------------------------------------------------------------------------
    # what is known

    def speed(self, way, step):
        """Speed upwards (`way` > 0) or downwards; of other speed bytes in proportion, until they
        were used.
        """
        speeds = self._speeds[way > 0]
        nearest = min(speeds, key=lambda other: abs(other - step))
        return speeds[nearest] * max(step, 1) / max(nearest, 1)

    def learn(self, way, step, speed):
        """Remember a speed that was measured."""
        self._speeds[way > 0][step] = speed
        self._speeds[way <= 0].setdefault(step, speed)
        self.calibrated = True

    def know(self, pitch, instant):
        """The head was at a pitch at an instant."""
        self._pitch = pitch
        self._known_at = instant

    def estimate(self, instant=None):
        """Dead reckoning at an instant, by default now; DeviceError if nothing is known."""
        if self._pitch is None:
            raise DeviceError(UNKNOWN)
        if self._going is None:
            return self._pitch
        way, step = self._going
        seconds = max(0.0, (instant or self._now()) - self._known_at)
        return self._pitch + way * self.speed(way, step) * seconds

    def read(self, patient=False):
        """What the head tells, as TrackPoint; None without a reply.

        A reading far from dead reckoning is asked for twice more, and the one in the middle counts.
        """
        answer = self.line.pitch(patient)
        if answer is None:
            return None
        pitch, instant = answer
        reckoned = pitch
        if self._pitch is not None:
            reckoned = self.estimate(instant)
        if abs(pitch - reckoned) > SURPRISE:
            answers = [answer, self.line.pitch(patient), self.line.pitch(patient)]
            if None in answers:
                return None
            pitch, instant = sorted(answers)[1]
            reckoned = self.estimate(instant)
        self.know(pitch, instant)
        return TrackPoint(instant, pitch, reckoned)

    def note(self, patient=False):
        """Append where the head is now to the rows."""
        point = None
        if self.has_feedback and self._misses < MISSES:
            self._misses += 1
            point = self.read(patient)
        if point is None:
            now = self._now()
            pitch = self.estimate(now)
            point = TrackPoint(now, pitch, pitch, measured=False)
        else:
            self._misses = 0
        self.rows.append(point)

    @property
    def track(self) -> list[tuple[float, float, bool]]:
        """Host time (s), pitch (rad) and whether it was measured, of the sweep that runs or ran
        last.

        Between readings the pitch is dead reckoning, which is stretched to the readings.
        """
        rows = list(self.rows)
        pitches = np.array([row.pitch for row in rows])
        measured = [i for i, row in enumerate(rows) if row.measured]
        for first, last in itertools.pairwise(measured):
            start = pitches[first]
            reckoned = rows[last].reckoned - start
            if reckoned:
                stretch = (pitches[last] - start) / reckoned
                between = pitches[first + 1 : last]
                between[:] = start + stretch * (between - start)
        return [
            (self._zero + row.instant, pitch, row.measured)
            for row, pitch in zip(rows, pitches.tolist(), strict=True)
        ]

    # ------------------------------------------------------------------------------------------
    # start and stop

    def _send(self, frame):
        """Send what moves the head, but never after the last stop; its instant."""
        with self.line.lock:
            if self.abort.is_set():
                raise Stopped(STOPPED)
            return self.line.exchange(frame).sent

    def halt(self):
        """Stop; its instant."""
        ended = self.line.stop()
        if self._pitch is not None:
            self.know(self.estimate(ended), ended)
        self._going = None
        self._repeated = math.inf
        return ended

    def pause(self, seconds):
        """Wait, repeating the motion for heads that want it.

        Raises Stopped if it was ended meanwhile.
        """
        end = self._now() + seconds
        while True:
            due = self._repeated + (self.settings.repeat_s or math.inf)
            if self._now() >= due:
                self._repeated = self._send(self._frame)
            elif self.abort.wait(max(0.0, min(end, due) - self._now())):
                raise Stopped(STOPPED)
            elif self._now() >= end:
                return

    def run(
        self,
        goal: float,
        step: int,
        longest_s: float = math.inf,
        look: Callable[[], None] | None = None,
    ) -> float:
        """Move towards a pitch until the head must be there.

        Parameters
        ----------
        goal
            Pitch, rad.
        step
            Speed byte.
        longest_s
            Of the motion, seconds.
        look
            Is called again and again; by default the head is asked where it is if there is time.

        Returns
        -------
        float
            The seconds that it took.

        Raises
        ------
        LineLost
            If the port vanished; the head is stopped if it comes back.
        """
        settings = self.settings
        way = math.copysign(1, goal - self.estimate())
        bit = UP if (way > 0) != settings.invert else DOWN
        asking_s = self._shortest_s + settings.reply_s + pelco_d.READ_S

        def left():
            """Seconds; after a reading the stop has to be on its way in time."""
            rest_s = (goal - self.estimate()) * way / self.speed(way, step)
            if self._known_at > begun:
                rest_s -= self.line.frame_s
            return min(rest_s, begun + longest_s - self._now())

        try:
            self._frame = encode_frame(settings.address, command2=bit, data2=step)
            begun = self._repeated = self._known_at = self._send(self._frame)
            self._going = way, step
            try:
                while left() > LEAST_S:
                    if look is not None:
                        look()
                    elif self.has_feedback and left() > asking_s:
                        self.read()
                    self.pause(min(left(), settings.poll_s))
            finally:
                ended = self.halt()
        except LineLost:
            if not self.has_feedback:
                self._pitch = None
            raise
        return ended - begun

    def settle(self, deadline: float, target: float | None = None) -> float:
        """Wait until the head rests; its pitch.

        Parameters
        ----------
        deadline
            Instant of the host.
        target
            Of a set-tilt, rad. Rest elsewhere counts after a while only, as the motion may not have
            begun.

        Raises
        ------
        NoReply
            If the head stays silent.
        Refused
            If it does not come to rest.
        """
        resting = None  # the first of readings that are the same
        while True:
            reading = self.read()
            if reading is None:
                resting = None
            elif resting is None or abs(reading.pitch - resting.pitch) > self._tolerance:
                if resting is not None and target is None:
                    self.halt()  # the one before was lost
                resting = reading
            else:
                enough_s = self.settings.settle_s
                if target is not None and abs(resting.pitch - target) > ARRIVAL:
                    enough_s *= STALLED
                if reading.instant - resting.instant >= enough_s:
                    return reading.pitch
            if self._now() >= deadline:
                break
            self.pause(self.settings.poll_s)
        if resting is None:
            raise NoReply(
                f"the head at {self.line.path} stopped telling its tilt: check its power and the "
                "wires"
            )
        raise Refused(
            f"the head does not come to rest, {math.degrees(resting.pitch):.2f} deg by now: give "
            "it more time, a higher tolerance_deg, or look whether it can get there"
        )

    # ---------------------------------------------------------------------------------------------
    # moves

    def move(self, target: float) -> float:
        """Reach a pitch by set-tilt where the head obeys, else by up and down; without feedback by
        time, unless the shortest motion would lead further away.

        Parameters
        ----------
        target
            Pitch, rad.

        Returns
        -------
        float
            Settled pitch, rad; without feedback by dead reckoning.

        Raises
        ------
        Refused
            If the head does not get there, or does not obey where that is stated.
        """
        settings = self.settings
        way = target - self.estimate()
        seconds = abs(way) / self.speed(way, settings.tilt_speed)
        if not self.has_feedback:
            if seconds >= self._shortest_s / 2:
                self.run(target, settings.tilt_speed)
                self.pause(settings.settle_s)
            return self.estimate()
        deadline = self._now() + 2 * seconds + EXTRA_S
        if self._obeys is not False:
            value = pelco_d.encode_tilt(settings.elevation(target))
            # the first may be lost, or come while the head was still busy
            for _ in range(2):
                self._send(encode_extended(settings.address, SET_TILT, value))
                pitch = self.settle(deadline, target)
                if abs(pitch - target) <= ARRIVAL:
                    self._obeys = True
                    return pitch
            if self._obeys:
                raise _short_of(pitch, target)
            if settings.absolute is True:
                raise Refused(f"{DISOBEYS}: state absolute false to use up and down")
            self._obeys = False
            LOG.warning("%s: it is moved by up and down", DISOBEYS)
        return self.steer(target, deadline)

    def steer(self, target, deadline):
        """Reach a pitch by up and down, each time as long as the way that is left takes.

        Raises Refused if the head does not move, moves the other way, or gets no nearer.
        """
        pitch = self.settle(deadline)
        full = self.settings.tilt_speed
        for _ in range(BURSTS):
            error = target - pitch
            steps = {full, full // 4, full // 16} - self._dead
            # speed at which the shortest motion is all of the way
            enough = abs(error) / self._shortest_s
            slowest = min(steps)
            if abs(error) <= ARRIVAL or enough <= self.speed(error, slowest):
                return pitch
            short = [step for step in steps if enough >= 2 * self.speed(error, step)]
            step = max(short, default=slowest)
            took = self.run(pitch + SHORT_OF * error, step, GROWTH * self._longest)
            before = pitch
            pitch = self.settle(deadline)
            moved = (pitch - before) * math.copysign(1, error)
            if moved < -max(5 * self._tolerance, math.radians(1)):
                raise Refused(OTHER_WAY)
            if moved > 2 * self._tolerance:
                self.learn(error, step, moved / took)
            elif self._longest >= FIRST_BURST_S:
                if step == full:
                    self._dead.clear()
                    raise Refused(
                        "the head does not move: look for an end stop, its power, and whether "
                        "tilt_speed suffices"
                    )
                self._dead.add(step)
                continue
            self._longest = max(self._longest, took)
        raise _short_of(pitch, target)

    def sweep(self, goal, step):
        """Move to a pitch at a speed byte; note where the head is on the way and where it rests."""
        self._misses = 0
        self.note(patient=True)
        first = self.estimate()
        way = math.copysign(1, goal - first)
        deadline = self._now() + 3 * abs(goal - first) / self.speed(way, step) + 10

        def look():
            """Note where the head is; what goes wrong in a sweep ends it."""
            self.note()
            if self._now() > deadline:
                raise Refused(
                    "the sweep does not get to its end: look for an end stop, or state "
                    "degrees_per_second"
                )
            if (self.rows[-1].pitch - first) * way < -WRONG_WAY:
                raise Refused(OTHER_WAY)
            if self.has_feedback and self._misses >= MISSES and not self.calibrated:
                raise NoReply(
                    "the head is silent while it moves and its speed is unknown: state "
                    "degrees_per_second"
                )
            measured = [row for row in self.rows[1:] if row.measured] or self.rows[:1]
            swept = abs(measured[-1].pitch - measured[0].pitch)
            if swept >= 10 * self._tolerance:
                self.learn(way, step, swept / (measured[-1].instant - measured[0].instant))

        try:
            self.run(goal, step, look=look)
        finally:
            self._misses = 0
            if self._pitch is not None:
                self.note(patient=True)
        if self.has_feedback:
            self.settle(self._now() + 5)
        self.note(patient=True)


def _short_of(pitch, target):
    return Refused(
        f"the head stays at {math.degrees(pitch):.2f} deg on its way to "
        f"{math.degrees(target):.2f}: look for an end stop, or narrow pitch_limits_deg"
    )
