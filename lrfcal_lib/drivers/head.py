"""The pitch axis of a Pelco-D head: settings, moves, sweeps and readings, with whatever the head answers."""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import threading
from dataclasses import dataclass

from lrfcal_lib.drivers import pelco_d, port
from lrfcal_lib.drivers.host import REAL
from lrfcal_lib.drivers.pelco_d import FASTEST, HeadLine
from lrfcal_lib.drivers.port import DeviceError, LineLost, NoReply, OutOfRange, Refused, WrongDevice, guard
from lrfcal_lib.drivers.stated import FLAG, check, either, listed, number, one_of, whole

PERHAPS = one_of("auto", True, False)
ANGLE, SPEED, SECONDS = number(-180, 180, "deg"), number(0.01, 360, "deg/s"), number(0, 60, "s")
HEAD = {
    "address": whole(0, 255), "baudrate": whole(50, 4_000_000), "feedback": PERHAPS, "absolute": PERHAPS,
    "echo": PERHAPS, "pitch_limits_deg": listed(ANGLE, 2), "position_zero_deg": number(-360, 360, "deg"),
    "invert": FLAG, "tilt_speed": whole(0, FASTEST), "degrees_per_second": either(SPEED, listed(SPEED, 2)),
    "start_delay_s": number(-10, 10, "s"), "start_pitch_deg": ANGLE, "tolerance_deg": number(1e-4, 45, "deg"),
    "arrival_deg": number(1e-4, 45, "deg"), "settle_s": SECONDS, "stall_s": SECONDS, "poll_s": SECONDS,
    "reply_s": number(1e-3, 10, "s"), "gap_s": number(0, 10, "s"), "retries": whole(0, 20), "sends": whole(1, 20),
    "repeat_s": number(1e-3, 60, "s"), "reconnect_s": number(0, 3600, "s"),
}  # fmt: skip


@dataclass(frozen=True)
class HeadSettings:
    """Settings of a Pelco-D head. Nothing is published about the Ya An YA3050, so all defaults are assumptions.

    Attributes
    ----------
    address : int
        1, the usual factory setting of the DIP switches.
    baudrate : int
        2400, the most common default; 9600 is the next.
    feedback : "auto" or bool
        Whether it tells its tilt (query 53). "auto" asks; most cheap heads never answer. A rig file that does not
        state it means true: a silent head may as well be one with another address or rate.
    absolute : "auto" or bool
        Whether it obeys set-tilt (4D). "auto" tries where there is feedback; else up and down are used.
    echo : "auto" or bool
        Whether the adapter hands sent bytes back, as two-wire RS-485 may. Echoes are always removed; True makes a
        missing one an error (the adapter is dead), False makes one a warning.
    pitch_limits_deg : (float, float)
        Asking for more is an error. The protocol knows no limits; typical heads tilt by -90 to 90.
    position_zero_deg : float
        Elevation that the head tells at pitch 0.
    invert : bool
        The head hangs upside down, or counts its tilt the other way: its "up" lowers the view.
    tilt_speed : int
        Speed byte, 0 (very slow) to 0x3F; 0x20 is half of it.
    degrees_per_second : float, (float, float) or None
        Speed at `tilt_speed`, both ways or (up, down). None: 4 is assumed, as of constant-speed heads, until it was
        calibrated or learnt, and the log says so.
    start_delay_s : float
        From the motion frame to the movement, less what it runs on after the stop; calibrated together with the speed.
    start_pitch_deg : float
        Where a head without feedback stands when it is opened: 0, levelled by hand.
    tolerance_deg : float
        Readings that differ by less are the same: heads tell 0.01, cheap encoders jitter by more.
    arrival_deg : float
        A move that ends this near has arrived; its settled pitch is returned and counts.
    settle_s : float
        The head rests when its readings stay the same for this long.
    stall_s : float
        Rest away from where it was sent for this long means that it does not get there.
    poll_s : float
        Between queries while it moves.
    reply_s : float
        A reply begins within this time after the query was sent (0.35 in use elsewhere, 1 by slow heads).
    gap_s : float
        Silence kept between frames, and time left for an acknowledgement (0.05 in use elsewhere).
    retries : int
        Queries repeated when no reply came.
    sends : int
        Motion frames are sent this often in a row: 2 on weak lines. Stops are sent twice or more in any case.
    repeat_s : float or None
        Motion frames are repeated at this interval: below 1 for heads that stop by themselves without.
    reconnect_s : float
        A call waits this long for a vanished port to come back.

    Raises
    ------
    ValueError
        For values that no head can have.
    """

    address: int = 1
    baudrate: int = 2400
    feedback: str | bool = "auto"
    absolute: str | bool = "auto"
    echo: str | bool = "auto"
    pitch_limits_deg: tuple[float, float] = (-60.0, 60.0)
    position_zero_deg: float = 0.0
    invert: bool = False
    tilt_speed: int = 0x20
    degrees_per_second: float | tuple[float, float] | None = None
    start_delay_s: float = 0.0
    start_pitch_deg: float = 0.0
    tolerance_deg: float = 0.1
    arrival_deg: float = 0.5
    settle_s: float = 0.3
    stall_s: float = 1.5
    poll_s: float = 0.1
    reply_s: float = 0.35
    gap_s: float = 0.05
    retries: int = 3
    sends: int = 1
    repeat_s: float | None = None
    reconnect_s: float = 3.0

    def __post_init__(self):
        check(vars(self), HEAD, "head")
        low, high = self.pitch_limits_deg
        if low >= high:
            raise ValueError(f"head.pitch_limits_deg is {low:g} to {high:g}: the lower one comes first")

    @property
    def speeds_deg(self):
        """Degrees per second (up, down) at `tilt_speed`; 4 where none is stated."""
        speed = 4.0 if self.degrees_per_second is None else self.degrees_per_second
        return tuple(speed) if isinstance(speed, (tuple, list)) else (speed, speed)

    def elevation(self, pitch):
        """What the head calls a pitch, rad."""
        return math.radians(self.position_zero_deg) + (-pitch if self.invert else pitch)

    def pitch(self, elevation):
        """The pitch of an elevation that the head tells, rad, in [-pi, pi)."""
        turn = elevation - math.radians(self.position_zero_deg)
        turn = (turn + math.pi) % (2 * math.pi) - math.pi
        return -turn if self.invert else turn


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


LOG = logging.getLogger(__name__)


class PanTilt:
    """A head on a serial line; a context manager. It is stopped on every way out, Ctrl-C and SIGTERM included.

    Attributes
    ----------
    has_feedback : bool
        It tells its tilt.
    settings : HeadSettings
    """

    def __init__(self, line, settings, log, clock):
        self.settings, self.has_feedback = settings, False
        self._line, self._log, self._clock = line, log, clock
        self._motion = Motion(line, settings)
        self._lock, self._busy, self._sweep = threading.Lock(), False, None

    # --------------------------------------------------------------------------------------------- open and close

    @classmethod
    def open(cls, port, settings=None, *, log=LOG, clock=None, host=REAL):
        """Open the port, stop the head, and ask whether it tells its tilt.

        Parameters
        ----------
        port : str or Path
        settings : HeadSettings, optional
        log : logging.Logger
        clock : callable, optional
            Host clock, s; time.time() of the host by default.
        host : Host
            Machine that the driver runs on; tests have a VirtualHost.

        Returns
        -------
        PanTilt

        Raises
        ------
        PortError
            If the port cannot be opened.
        NoReply
            If a head with stated feedback tells nothing, or a stated echo does not come.
        WrongDevice
            If something else answers.
        """
        settings = settings or HeadSettings()
        line = HeadLine(port, settings, log, host)
        head = cls(line, settings, log, clock or host.time)
        try:
            head._probe()
        except BaseException:
            line.close()
            raise
        guard(head)
        return head

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def close(self):
        """Stop the head and close the port; a second call does nothing."""
        if self._line is None:
            return
        try:
            self.stop()
        except DeviceError as error:
            self._log.error("the head could not be stopped (%s): cut its power if it moves", error)
        finally:
            port.release(self)
            line, self._line = self._line, None
            line.close()

    def emergency_stop(self):
        """Stop at once, from a signal or at exit; errors are logged."""
        self._motion.abort.set()
        if self._line is not None:
            self._line.blurt_stop()

    def _probe(self):
        counts = self._line.counts
        self._line.stop()
        reading = self._line.tilt() if self.settings.feedback is not False else None
        asked = counts["frames"]
        if reading is None and counts["skipped"] > pelco_d.FRAME * asked:
            raise WrongDevice(f"{self._line.path} sends {counts['skipped']} bytes that are no Pelco-D at "
                              f"{self.settings.baudrate} Bd: another device, another rate, or Pelco-P")  # fmt: skip
        self._check_echo(counts["echoed"])
        if reading is None and self.settings.feedback is True:
            raise NoReply(self._silence())
        self.has_feedback = reading is not None
        start = math.radians(self.settings.start_pitch_deg)
        self._motion.know(self.settings.pitch(reading[1]) if reading else start)
        if not self.has_feedback:
            self._log.warning("the head does not tell its tilt: timed moves at %s deg/s (%s), from %.2f deg; "
                              "its pitch is not measured", "/".join(f"{v:g}" for v in self.settings.speeds_deg),
                              "stated" if self._motion.calibrated else "assumed, calibrate it",
                              self.settings.start_pitch_deg)  # fmt: skip

    def _check_echo(self, echoed):
        if self.settings.echo is True and not echoed:
            raise NoReply(f"{self._line.path} does not echo what is sent: check the adapter and its power")
        if self.settings.echo is False and echoed:
            self._log.warning("%s echoes what is sent, which was not expected: echoes are removed", self._line.path)

    def _silence(self):
        echo = "what was sent came back, so the adapter works: " if self._line.counts["echoed"] else ""
        return (
            f"the head at {self._line.path} does not tell its tilt: {echo}check its power, the wires A and B, "
            f"address {self.settings.address} and {self.settings.baudrate} Bd, or state feedback false"
        )

    # ---------------------------------------------------------------------------------------------------- pitch

    def pitch(self):
        """Where the head points now.

        Returns
        -------
        pitch : float
            rad, up positive.
        measured : bool
            False: dead reckoning.

        Raises
        ------
        NoReply
            If a head with feedback rests and does not answer.
        LineLost
            If the port vanished and did not come back.
        DeviceError
            If the head was closed, or the pitch of one without feedback is unknown after its line was lost.
        """
        self._need_open()
        if not self.has_feedback:
            return self._motion.estimate(), False
        reading = self._motion.read(0 if self.moving() else self.settings.retries)
        if reading is not None:
            return reading[1], True
        if not self.moving():
            raise NoReply(self._silence())
        return self._motion.estimate(), False

    def set_pitch(self, pitch):
        """Say where a head without feedback stands, rad."""
        self._motion.know(pitch)

    def moving(self):
        """Whether a move or sweep of this object is under way."""
        return self._busy or self._sweep is not None and self._sweep.thread.is_alive()

    def _need_open(self):
        if self._line is None:
            raise DeviceError("the head is closed: open it again")

    def _check_range(self, pitch):
        low, high = self.settings.pitch_limits_deg
        if not low - 1e-6 <= math.degrees(pitch) <= high + 1e-6:
            raise OutOfRange(f"pitch {math.degrees(pitch):.2f} deg is beyond the head's limits of {low:g} to {high:g} "
                             "deg: ask for less, or widen pitch_limits_deg if the head can do it")  # fmt: skip

    # ---------------------------------------------------------------------------------------------------- moves

    def stop(self):
        """End every motion; the move that another thread waits for raises.

        Raises
        ------
        LineLost
            If the port vanished and did not come back.
        """
        self._need_open()
        self._motion.abort.set()
        self._motion.stop()
        if self._sweep is not None and self._sweep.thread is not threading.current_thread():
            self._sweep.thread.join()

    @contextlib.contextmanager
    def _motion_of_its_own(self):
        """One motion at a time; whatever goes wrong, the head is stopped."""
        self._need_open()
        if self.moving() or not self._lock.acquire(blocking=False):
            raise DeviceError("the head is moving already: stop it, or wait for it")
        self._busy = True
        try:
            self._motion.abort.clear()
            yield self._motion
        except BaseException:
            self.emergency_stop()
            raise
        finally:
            self._busy = False
            self._lock.release()

    def move_to(self, pitch, timeout=None):
        """Move and wait until the head rests.

        Parameters
        ----------
        pitch : float
            rad, up positive.
        timeout : float, optional
            s; by default twice the time that the way takes, and 10 s. A lost line adds `reconnect_s`.

        Returns
        -------
        float
            Settled pitch, rad: read from the head, or dead reckoning without feedback.

        Raises
        ------
        OutOfRange
            Beyond the limits; nothing moves.
        Refused
            If the head does not get there, or moves the other way.
        NoReply
            If a head with feedback stays silent.
        LineLost
            If the port vanished and did not come back, or the head has no feedback.
        DeviceError
            If it was stopped meanwhile.
        """
        self._need_open()
        self._check_range(pitch)
        start, _ = self.pitch()
        with self._motion_of_its_own() as motion:
            seconds = abs(pitch - start) / motion.speed(pitch - start)
            deadline = self._line.host.now() + (2 * seconds + 10 if timeout is None else timeout)
            if not self.has_feedback:
                return motion.timed(pitch, deadline)
            while True:
                try:
                    return self._measured_move(pitch, deadline)
                except LineLost:
                    if self._line.host.now() >= deadline:
                        raise
                    self._line.reopen()

    def _measured_move(self, target, deadline):
        motion = self._motion
        if self.settings.absolute is not False and motion.absolute is not False:
            arrived = motion.set_tilt(target, deadline)
            if arrived is not None:
                return arrived
            if self.settings.absolute is True:
                raise Refused("the head does not obey set-tilt (4D): state absolute false to use up and down")
            self._log.warning("the head does not obey set-tilt (4D): it is moved by up and down")
        return motion.steer(target, deadline)

    # --------------------------------------------------------------------------------------------------- sweeps

    def start_sweep(self, stop_at, speed=None):
        """Set the head in motion to a pitch and return; a thread logs the pitch and stops it there.

        Parameters
        ----------
        stop_at : float
            rad.
        speed : int, optional
            Speed byte, 0 (very slow) to 0x3F; by default ``settings.tilt_speed``. The speed of a byte that was not
            calibrated is taken to be in proportion.

        Raises
        ------
        OutOfRange
            Beyond the limits; nothing moves.
        ValueError
            For a speed that does not exist.
        DeviceError
            As :meth:`move_to`. What goes wrong later is raised by :meth:`finish_sweep`.
        """
        self._need_open()
        self._check_range(stop_at)
        step = self.settings.tilt_speed if speed is None else speed
        if step not in range(pelco_d.FASTEST + 1):
            raise ValueError(f"speed is {speed!r}: it is a byte from 0, very slow, to {pelco_d.FASTEST}")
        with self._motion_of_its_own() as motion:
            sweep = Sweep(motion, stop_at, step, self.has_feedback, self._clock)
            sweep.begin()
            self._sweep = sweep

    def finish_sweep(self, timeout=None):
        """Wait for the end of the sweep.

        Returns
        -------
        list of (float, float, bool)
            The :attr:`track`.

        Raises
        ------
        NoReply
            If it goes on after `timeout` s; the head is stopped.
        DeviceError
            Why it ended too early.
        """
        if self._sweep is None:
            raise DeviceError("there was no sweep: start one")
        try:
            self._sweep.thread.join(timeout)
        except BaseException:
            self.emergency_stop()
            raise
        if self._sweep.thread.is_alive():
            self.stop()
            raise NoReply(f"the sweep was not over after {timeout:g} s: the head was stopped")
        if self._sweep.error is not None:
            raise self._sweep.error
        return self.track

    @property
    def track(self):
        """Host time, pitch in rad and whether it was measured, of the sweep that runs or ran last.

        list of (float, float, bool)
            Between readings the pitch is dead reckoning, which is drawn to the readings when the sweep has ended.
        """
        return list(self._sweep.track) if self._sweep is not None else []

    # -------------------------------------------------------------------------------------------------- calibrate

    def calibrate_speed(self, reading=None, *, travel_deg=10.0):
        """Measure the speed at ``settings.tilt_speed`` both ways, and the delay, for timed moves and sweeps.

        Parameters
        ----------
        reading : callable, optional
            Returns the pitch of the resting head, rad, measured otherwise (inclinometer, scan of the floor); heads
            without feedback need it.
        travel_deg : float
            Length of the longer ones of the test moves.

        Returns
        -------
        up, down : float
            deg/s, to be stated as ``degrees_per_second``.
        delay_s : float
            To be stated as ``start_delay_s``.

        Raises
        ------
        DeviceError
            If nothing tells the pitch, or the head does not move.
        """
        if reading is None and not self.has_feedback:
            raise DeviceError("the head does not tell its tilt: pass reading, which measures it otherwise, or state "
                              "degrees_per_second")  # fmt: skip
        with self._motion_of_its_own() as motion:
            room = [math.radians(limit) for limit in self.settings.pitch_limits_deg]
            speeds = motion.calibrate(reading, math.radians(travel_deg), room)
        self._log.info("speed of the head: %.2f deg/s up, %.2f down, %.3f s delay", *speeds)
        return speeds
