"""How a head is brought to a pitch: by set-tilt, by bursts of up and down between readings, or by time."""

from __future__ import annotations

import math

from lrfcal_lib.drivers import pelco_d
from lrfcal_lib.drivers.errors import DeviceError, LineLost, NoReply, Refused

BURSTS = 25  # of up and down, to reach one pitch
FIRST_BURST_S = 0.1  # of a head whose speed is unknown
GROWTH = 4  # of bursts while the speed is being learnt
SURPRISE = math.radians(3)  # from dead reckoning: then a reading is not believed at once
SHORT_OF = 0.9  # part of the way that a burst is meant to make, so that the last ones come from one side


class Stopped(DeviceError):
    """The motion was ended by a stop."""


class Motion:
    """Motions of one axis, its speeds, and where it must be by now.

    Parameters
    ----------
    line : HeadLine
    settings : HeadSettings

    Attributes
    ----------
    abort : threading.Event
        Set to end what runs.
    calibrated : bool
        The speed was stated or measured, not assumed.
    absolute : bool or None
        Whether the head obeys set-tilt; None until it was tried.
    delay : float
        s from the motion frame to the movement, less what the head runs on after the stop.
    """

    def __init__(self, line, settings):
        self.line, self.settings = line, settings
        self.abort, self.absolute, self._now = line.host.event(), None, line.host.now
        self.calibrated, self.delay = settings.degrees_per_second is not None, settings.start_delay_s
        self._speeds = {settings.tilt_speed: dict(zip((1, -1), map(math.radians, settings.speeds_deg), strict=True))}
        self._longest = math.inf if self.calibrated else FIRST_BURST_S / GROWTH
        self._dead, self._going, self._frame, self._repeated = set(), None, b"", 0.0
        self._pitch, self._seen = None, 0.0
        self.tolerance = math.radians(settings.tolerance_deg)
        self.arrival = math.radians(settings.arrival_deg)

    # ------------------------------------------------------------------------------------------- what is known

    def speed(self, way, step=None):
        """Speed upwards (`way` > 0) or downwards, rad/s; of other speed bytes in proportion, until they were used."""
        step, way = self.settings.tilt_speed if step is None else step, 1 if way > 0 else -1
        nearest = min(self._speeds, key=lambda other: abs(other - step))
        return self._speeds[nearest][way] * max(step, 1) / max(nearest, 1)

    def learn(self, way, step, speed):
        """Remember a speed that was measured, rad/s."""
        both = self._speeds.setdefault(step, {1: speed, -1: speed})
        both[1 if way > 0 else -1] = speed
        self.calibrated = True

    def know(self, pitch, instant=None):
        """The head was at a pitch, rad, at an instant of the host."""
        self._pitch, self._seen = pitch, self._now() if instant is None else instant

    def forget(self):
        """Where a head without feedback stands is not known any more."""
        self._pitch = None

    def estimate(self, instant=None):
        """Dead reckoning at an instant of the host, by default now, rad.

        Raises
        ------
        DeviceError
            If nothing is known.
        """
        return self.reckoning()(self._now() if instant is None else instant)

    def reckoning(self):
        """Dead reckoning from what is known now: a function of the instant."""
        if self._pitch is None:
            raise DeviceError("where the head stands is unknown since its line was lost: look, and call set_pitch")
        pitch, seen, going = self._pitch, self._seen, self._going
        if going is None:
            return lambda instant: pitch
        way, step, begun = going
        rate, since = way * self.speed(way, step), max(seen, begun + self.delay)
        return lambda instant: pitch + rate * max(0.0, instant - since)

    def read(self, retries=0):
        """Pitch that the head tells, rad, with its instant of the host; None without a reply.

        Notes
        -----
        A reading far from dead reckoning is asked for twice more, and the one in the middle counts.
        """
        told = self._told(retries)
        if told is not None and self._pitch is not None and abs(told[1] - self.estimate(told[0])) > SURPRISE:
            more = sorted((one for one in (told, self._told(), self._told()) if one), key=lambda one: one[1])
            told = more[len(more) // 2] if len(more) != 2 else min(more, key=lambda one: abs(one[1] - self.estimate()))
        if told is not None:
            self.know(told[1], told[0])
        return told

    def _told(self, retries=0):
        reading = self.line.tilt(retries)
        return None if reading is None else (reading[0], self.settings.pitch(reading[1]))

    # ------------------------------------------------------------------------------------------ start and stop

    def start(self, way, step):
        """Begin to move up (`way` > 0) or down; returns the host's instant at which it was sent."""
        up = way if not self.settings.invert else -way
        self._frame = pelco_d.encode_motion(self.settings.address, tilt=up, tilt_speed=step)
        begun, _ = self.line.command(self._frame)
        self._going, self._repeated = (1 if way > 0 else -1, step, begun), begun
        return begun

    def stop(self):
        """Stop; returns the host's instant at which it was sent."""
        ended = self.line.stop()
        if self._going is not None and self._pitch is not None:
            self.know(self.estimate(ended), ended)
        self._going = None
        return ended

    def pause(self, seconds):
        """Wait, repeating the motion for heads that want it.

        Raises
        ------
        Stopped
            If the motion was ended meanwhile.
        """
        end, every = self._now() + seconds, self.settings.repeat_s
        while True:
            now = self._now()
            repeat = every is not None and self._going is not None
            if repeat and now >= self._repeated + every:
                self._repeated, _ = self.line.command(self._frame)
                continue
            if self.abort.wait(max(0.0, min(end, self._repeated + every if repeat else end) - now)):
                raise Stopped("the head was stopped before it arrived")
            if self._now() >= end:
                return

    def run(self, way, step, seconds, until=None):
        """Move for a time, or past a pitch if the head tells it meanwhile; returns the seconds it took."""
        begun = self.start(way, step)
        try:
            while (left := begun + seconds - self._now()) > 0:
                if until is not None and left > self.line.round_trip_s:
                    reading = self.read()
                    if reading and (until - reading[1]) * way <= 0:
                        break
                    left = min(self.settings.poll_s, max(0.0, begun + seconds - self._now()))
                self.pause(left)
        finally:
            ended = self.stop()
        return ended - begun

    def settle(self, deadline, target=None):
        """Wait until the head rests.

        Parameters
        ----------
        deadline : float
            Instant of the host.
        target : float, optional
            Where set-tilt sent it: rest elsewhere counts after `stall_s` only, because it may not have begun.

        Returns
        -------
        float
            Pitch, rad.

        Raises
        ------
        NoReply
            If it stays silent.
        Refused
            If it does not come to rest.
        """
        first, since = None, 0.0
        while True:
            reading, now = self.read(), self._now()
            if reading is None:
                first = None
            elif first is None or abs(reading[1] - first) > self.tolerance:
                if first is not None and target is None:
                    self.stop()  # the one before was lost
                first, since = reading[1], now
            elif now - since >= self._rest_s(target, first):
                return reading[1]
            if now >= deadline:
                break
            self.pause(self.settings.poll_s)
        if first is None:
            raise NoReply(f"the head at {self.line.path} stopped telling its tilt: check its power and the wires")
        raise Refused(f"the head does not come to rest, {math.degrees(first):.2f} deg by now: give it more time, a "
                      "higher tolerance_deg, or look whether it can get there")  # fmt: skip

    def _rest_s(self, target, pitch):
        on_the_way = target is not None and abs(pitch - target) > self.arrival
        return max(self.settings.stall_s, self.settings.settle_s) if on_the_way else self.settings.settle_s

    # --------------------------------------------------------------------------------------------------- moves

    def set_tilt(self, target, deadline):
        """Send the head to a pitch; None if it has never obeyed and does not now.

        Raises
        ------
        Refused
            If it obeys, but does not get there.
        """
        value = pelco_d.encode_tilt(self.settings.elevation(target))
        for _ in range(2):  # the first may be lost, or come while the head was still busy
            self.line.command(pelco_d.encode_extended(self.settings.address, pelco_d.SET_TILT, value))
            pitch = self.settle(deadline, target)
            if abs(pitch - target) <= self.arrival:
                self.absolute = True
                return pitch
        if self.absolute:
            raise Refused(_short_of(pitch, target))
        self.absolute = False
        return None

    def steer(self, target, deadline):
        """Reach a pitch by up and down, each time as long as the way that is left takes.

        Raises
        ------
        Refused
            If the head does not move, moves the other way, or gets no nearer.
        """
        pitch = self.settle(deadline)
        for _ in range(BURSTS):
            error = target - pitch
            step = self._step(error)
            if abs(error) <= self.arrival or step is None:
                return pitch
            seconds = self.delay + SHORT_OF * abs(error) / self.speed(error, step)
            took = self.run(error, step, min(seconds, GROWTH * self._longest), until=target)
            before, pitch = pitch, self.settle(deadline)
            self._judge(pitch - before, math.copysign(1, error), step, took)
        raise Refused(_short_of(pitch, target))

    def _step(self, error):
        """The fastest speed byte that allows a burst for this error; None if the shortest would go too far."""
        shortest = 2 * self.line.wire_s() + self.settings.gap_s
        steps = [step for step in self._steps() if step not in self._dead]
        for step in steps:
            if abs(error) >= 2 * shortest * self.speed(error, step):
                return step
        return steps[-1] if abs(error) > shortest * self.speed(error, steps[-1]) else None

    def _steps(self):
        full = self.settings.tilt_speed
        return sorted({full, full // 4, full // 16}, reverse=True)

    def _judge(self, moved, way, step, took):
        """Learn the speed from a burst, or why there is none to learn."""
        if moved * way < -max(5 * self.tolerance, math.radians(1)):
            raise Refused("the head moves the other way: set invert to the contrary")
        if moved * way > 2 * self.tolerance:
            self.learn(way, step, moved * way / took)
            self._longest = max(self._longest, took)
        elif self._longest >= FIRST_BURST_S:
            self._dead.add(step)
        else:
            self._longest = max(self._longest, took)
        if step in self._dead and step == self.settings.tilt_speed:
            self._dead.clear()
            raise Refused("the head does not move: look for an end stop, its power, and whether tilt_speed suffices")

    def timed(self, target, deadline):
        """Move by time; the pitch that results is dead reckoning.

        Raises
        ------
        LineLost
            If the port vanished: the pitch is unknown then.
        Refused
            If there is not enough time.
        """
        start, reconnects = self.estimate(), self.line.counts["reconnects"]
        seconds = abs(target - start) / self.speed(target - start) + self.delay
        if seconds - self.delay < (2 * self.line.wire_s() + self.settings.gap_s) / 2:
            return start  # the shortest motion would lead further away
        if self._now() + seconds > deadline:
            raise Refused(f"the move takes {seconds:.1f} s: give it a longer timeout")
        try:
            self.run(target - start, self.settings.tilt_speed, seconds)
        except LineLost:
            self.forget()
            raise
        if self.line.counts["reconnects"] != reconnects:
            self.forget()
            raise LineLost("the line was lost in a timed move: look where the head stands, and call set_pitch")
        self.pause(self.settings.settle_s)
        return self.estimate()

    # ----------------------------------------------------------------------------------------------- calibration

    def calibrate(self, reading, travel, limits):
        """Speeds up and down, deg/s, and the delay, s, from a long and a short move each way.

        Parameters
        ----------
        reading : callable or None
            Pitch of the resting head, rad; None asks the head.
        travel : float
            Length of the long moves, rad, if the limits allow it.
        limits : (float, float)
            rad.

        Raises
        ------
        Refused
            If the head does not move, or the other way.
        """
        pitch, step = self._at_rest(reading), self.settings.tilt_speed
        first = 1 if limits[1] - pitch > pitch - limits[0] else -1
        travel = min(travel, 0.4 * max(limits[1] - pitch, pitch - limits[0]))
        seconds, moved = FIRST_BURST_S, 0.0
        while (moved := self._test_move(first, seconds, reading)[1]) < travel / 5:
            seconds *= 2
            if seconds > (4 if abs(moved) > self.tolerance else 1):
                raise Refused("the head does not move the way it was told: look for an end stop, its power, invert")
        long, delays = seconds * travel / moved, []
        for way in (-first, first):
            (t_long, far), (t_short, near) = (self._test_move(way, t, reading) for t in (long, long / 3))
            self.learn(way, step, max(far - near, self.tolerance) / (t_long - t_short))
            delays.append(t_long - far / self.speed(way))
        self.delay, self._longest = sum(delays) / 2, math.inf
        return math.degrees(self.speed(1)), math.degrees(self.speed(-1)), self.delay

    def _test_move(self, way, seconds, reading):
        """Seconds and rad of a move by time, between two rests."""
        before = self._at_rest(reading)
        took = self.run(way, self.settings.tilt_speed, seconds)
        return took, (self._at_rest(reading) - before) * way

    def _at_rest(self, reading):
        if reading is None:
            return self.settle(self._now() + 10)
        self.pause(self.settings.settle_s)
        self.know(float(reading()))
        return self.estimate()


def _short_of(pitch, target):
    return (f"the head stays at {math.degrees(pitch):.2f} deg on its way to {math.degrees(target):.2f}: "
            "look for an end stop, or narrow pitch_limits_deg")  # fmt: skip
