"""A continuous sweep of a head, with a time-stamped log of its pitch."""

from __future__ import annotations

import itertools
import math

from lrfcal_lib.drivers.errors import DeviceError, LineLost, NoReply, Refused
from lrfcal_lib.drivers.head_motion import Stopped

MISSES = 3  # queries without a reply, after which a moving head is not asked any more


class Sweep:
    """One sweep from where the head is to a pitch.

    Parameters
    ----------
    motion : Motion
    stop_at : float
        rad.
    step : int
        Speed byte.
    feedback : bool
        The head tells its tilt, if maybe not while it moves.
    clock : callable
        Host clock, s.

    Attributes
    ----------
    track : list of (float, float, bool)
        Host time, pitch in rad, measured.
    error : DeviceError or None
        Why it ended too early.
    thread : threading.Thread
    """

    def __init__(self, motion, stop_at, step, feedback, clock):
        self.motion, self.stop_at, self.step, self.feedback = motion, stop_at, step, feedback
        self.track, self.error = [], None
        self._clock, self._misses, self._reckoned = clock, 0, []
        self._now, self.thread = motion.line.host.now, motion.line.host.thread(self._run, "sweep")

    def begin(self):
        """Note where the head is, set it in motion and start the thread."""
        pitch = self._note()
        self._way = math.copysign(1, self.stop_at - pitch)
        seconds = abs(self.stop_at - pitch) / self.motion.speed(self._way, self.step)
        self._first, self._deadline = pitch, self._now() + 3 * seconds + 10
        self._reconnects = self.motion.line.counts["reconnects"]
        self.motion.start(self._way, self.step)
        self.thread.start()

    def _run(self):
        """Follow the head until it is there, stop it, and note where it rests."""
        try:
            try:
                self._follow()
            finally:
                self.motion.stop()
                self._note()
            self.motion.settle(self._now() + 5) if self.feedback else self.motion.pause(0)
            self._note()
        except Stopped:
            pass
        except DeviceError as error:
            self.error = error
            if not self.feedback and isinstance(error, LineLost):
                self.motion.forget()
        finally:
            self.track = drawn_to_readings(self.track, self._reckoned)

    def _follow(self):
        speed = self.motion.speed(self._way, self.step)
        while True:
            left = (self.stop_at - self._note(brief=True)) * self._way / speed - self.motion.line.wire_s()
            if left <= 0:
                return
            self._check()
            self.motion.pause(min(left, self.motion.settings.poll_s))
            speed = self._speed(speed)

    def _check(self):
        if self.motion.line.counts["reconnects"] != self._reconnects:
            raise LineLost("the line was lost in the sweep, and the head stopped when it came back: sweep again")
        if self._now() > self._deadline:
            raise Refused("the sweep does not get to its end: look for an end stop, or calibrate the speed")
        if (self.track[-1][1] - self._first) * self._way < -math.radians(2):
            raise Refused("the head moves the other way: set invert to the contrary")
        if self.feedback and self._misses >= MISSES and not self.motion.calibrated:
            raise NoReply("the head is silent while it moves and its speed is unknown: call calibrate_speed first")

    def _speed(self, speed):
        """What the readings say about the speed, once they are some degrees apart."""
        told = [one for one in self.track[1:] if one[2]]
        if len(told) < 2 or abs(told[-1][1] - told[0][1]) < 10 * self.motion.tolerance:
            return speed
        speed = abs(told[-1][1] - told[0][1]) / (told[-1][0] - told[0][0])
        self.motion.learn(self._way, self.step, speed)
        return speed

    def _note(self, brief=False):
        """Append the pitch of now to the track; returns it as it is by now, rad."""
        asked = self.feedback and not (brief and self._misses >= MISSES)
        before = self.motion.reckoning() if asked and self.track else None
        reading = self.motion.read(0 if brief else self.motion.settings.retries) if asked else None
        if asked:
            self._misses = 0 if reading else self._misses + 1
        now = self._now()
        instant, pitch = reading or (now, self.motion.estimate(now))
        self.track.append((self._clock() - (now - instant), pitch, reading is not None))
        self._reckoned.append(before(instant) if before else pitch)
        return self.motion.estimate(now)


def drawn_to_readings(track, reckoned):
    """Track whose dead reckoning agrees with the readings: what lies between two of them is stretched to both.

    Parameters
    ----------
    track : list of (float, float, bool)
        Time, pitch, measured.
    reckoned : list of float
        Dead reckoning at the same times; in the rows that were measured, before the reading was known.

    Returns
    -------
    list of (float, float, bool)
        Before the first reading and after the last one nothing is changed.
    """
    told, out = [row for row, point in enumerate(track) if point[2]], list(track)
    for first, last in itertools.pairwise(told):
        start, way = track[first][1], reckoned[last] - track[first][1]
        stretch = (track[last][1] - start) / way if way else 1.0
        for row in range(first + 1, last):
            out[row] = (track[row][0], start + stretch * (track[row][1] - start), False)
    return out
