"""Motions of a Pelco-D head: by set-tilt, by up and down or by time, and dead reckoning."""

import itertools
import logging
import math

from lrfcal_lib.drivers import pelco_d
from lrfcal_lib.drivers.pelco_d import (
    DOWN,
    SET_TILT,
    UP,
    encode_extended,
    encode_frame,
)
from lrfcal_lib.drivers.port import (
    DeviceError,
    LineLost,
    NoReply,
    Refused,
)

LOG = logging.getLogger(__name__)
ASSUMED = 4.0, 4.0  # deg/s
BURSTS = 25  # of up and down, to reach one pitch
FIRST_BURST_S = 0.1  # of a head whose speed is unknown
GROWTH = 4  # of bursts while the speed is being learnt
SURPRISE = math.radians(3)  # from dead reckoning: then a reading is not believed at once
# part of the way that a burst is meant to make, so that the last ones come from one side
SHORT_OF = 0.9
LEAST_S = 1e-4  # of a wait worth its while
MISSES = 3  # queries without a reply, after which a head that is swept is not asked any more
OTHER_WAY = "the head moves the other way: set invert to the contrary"
STOPPED = "the head was stopped before it arrived"
INTERRUPTED = (
    "the head's line was lost, and the head stopped when it came back: move or sweep again; where "
    "it tells nothing look where it stands, and call set_pitch"
)


class Stopped(DeviceError):
    """The motion was ended by a stop."""


class Motion:
    """Motions of one axis, its speeds, and where it must be by now; rad, rad/s, instants of the
    host.

    While the event `abort` is set nothing moves the head. `feedback`: it tells its tilt, if maybe
    not while it moves; `calibrated`: its speed was stated or measured, not assumed; `rows` are of a
    sweep: host time, pitch, whether it was measured, and dead reckoning before that was known.
    """

    def __init__(self, line, settings):
        self.line = line
        self.settings = settings
        self._now = line.host.now
        self.abort = line.host.event()
        self.feedback = False
        self.rows = []
        self._misses = 0
        self.calibrated = settings.degrees_per_second is not None
        up, down = map(math.radians, settings.degrees_per_second or ASSUMED)
        self._speeds = {settings.tilt_speed: {1: up, -1: down}}
        self._longest = math.inf if self.calibrated else FIRST_BURST_S / GROWTH
        # set-tilt; None until it was tried
        self._obeys = False if settings.absolute is False else None
        self._dead = set()
        self._going = None
        self._frame = b""
        self._repeated = 0.0
        self._pitch = None
        self._seen = 0.0
        self._tolerance = math.radians(settings.tolerance_deg)
        self._arrival = math.radians(settings.arrival_deg)
        self._shortest_s = 2 * line.wire_s() + settings.gap_s  # of a motion and its stop

    # -------------------------------------------------------------------------------------------
    # what is known

    def speed(self, way, step):
        """Speed upwards (`way` > 0) or downwards; of other speed bytes in proportion, until they
        were used.
        """
        nearest = min(self._speeds, key=lambda other: abs(other - step))
        return self._speeds[nearest][1 if way > 0 else -1] * max(step, 1) / max(nearest, 1)

    def learn(self, way, step, speed):
        """Remember a speed that was measured."""
        self._speeds.setdefault(step, {1: speed, -1: speed})[1 if way > 0 else -1] = speed
        self.calibrated = True

    def know(self, pitch, instant=None):
        """The head was at a pitch (None: nobody knows where it is) at an instant, by
        default now.
        """
        self._pitch, self._seen = pitch, self._now() if instant is None else instant

    def estimate(self, instant=None):
        """Dead reckoning at an instant, by default now; DeviceError if nothing is known."""
        if self._pitch is None:
            raise DeviceError(
                "where the head stands is unknown since its line was lost: look, and call set_pitch"
            )
        if self._going is None:
            return self._pitch
        way, step, begun = self._going
        seconds = (self._now() if instant is None else instant) - max(
            self._seen, begun + self.settings.start_delay_s
        )
        return self._pitch + way * self.speed(way, step) * max(0.0, seconds)

    def read(self, retries=0):
        """Instant, pitch that the head tells, and dead reckoning for it; None without a reply.

        A reading far from dead reckoning is asked for twice more, and the one in the middle counts.
        """
        told = self.line.pitch(retries)
        if told is None:
            return None
        if self._pitch is not None and abs(told[1] - self.estimate(told[0])) > SURPRISE:
            told = [told, self.line.pitch(retries), self.line.pitch(retries)]
            if None in told:
                return None
            told = sorted(told, key=lambda one: one[1])[1]
        reckoned = told[1] if self._pitch is None else self.estimate(told[0])
        self.know(told[1], told[0])
        return *told, reckoned

    def note(self, brief=False):
        """Append where the head is now to the rows."""
        reading = None
        if self.feedback and not (brief and self._misses >= MISSES):
            reading = self.read(0 if brief else self.settings.retries)
            self._misses = 0 if reading else self._misses + 1
        now = self._now()
        instant, pitch, reckoned = reading or (now, self.estimate(now), self.estimate(now))
        self.rows.append(
            (self.line.host.time() - (now - instant), pitch, reading is not None, reckoned)
        )

    # ------------------------------------------------------------------------------------------
    # start and stop

    def _send(self, frame):
        """Send what moves the head, but never after the last stop; its instant."""
        with self.line.lock:
            if self.abort.is_set():
                raise Stopped(STOPPED)
            return self.line.command(frame)

    def stop(self):
        """Stop; its instant."""
        ended = self.line.stop()
        if self._going is not None and self._pitch is not None:
            self.know(self.estimate(ended), ended)
        self._going = None
        return ended

    def pause(self, seconds):
        """Wait, repeating the motion for heads that want it; raises Stopped if it was ended
        meanwhile.
        """
        end = self._now() + seconds
        every = self.settings.repeat_s
        while True:
            due = math.inf if every is None or self._going is None else self._repeated + every
            if self._now() >= due:
                self._repeated = self._send(self._frame)
            elif self.abort.wait(max(0.0, min(end, due) - self._now())):
                raise Stopped(STOPPED)
            elif self._now() >= end:
                return

    def run(self, goal, step, longest_s=math.inf, look=None):
        """Move towards a pitch until the head must be there, at most for so long; the seconds it
        took.

        ``look()`` is called again and again; by default the head is asked where it is if there is
        time for that.
        """
        way = 1 if goal > self.estimate() else -1
        reconnects = self.line.counts["reconnects"]
        bit = UP if (way > 0) != self.settings.invert else DOWN
        self._frame = encode_frame(self.settings.address, command2=bit, data2=step)

        def left():
            """Seconds; after a reading the stop has to be on its way in time."""
            late = self.line.wire_s() if self._seen > begun else 0.0
            there = (goal - self.estimate()) * way / self.speed(way, step) - late
            return min(there, begun + longest_s - self._now())

        try:
            begun = self._repeated = self._send(self._frame)
            self._going = (way, step, begun)
            try:
                while left() > LEAST_S and self.line.counts["reconnects"] == reconnects:
                    if look is not None:
                        look()
                    elif (
                        self.feedback
                        and left() > self._shortest_s + self.settings.reply_s + pelco_d.READ_S
                    ):
                        self.read()
                    self.pause(min(left(), self.settings.poll_s))
            finally:
                ended = self.stop()
            if self.line.counts["reconnects"] != reconnects:
                raise LineLost(INTERRUPTED)
        except LineLost:
            self._pitch = self._pitch if self.feedback else None
            raise
        return ended - begun

    def settle(self, deadline, target=None):
        """Wait until the head rests; its pitch.

        Rest elsewhere than at the target of a set-tilt counts after `stall_s` only, because it may
        not have begun. Raises NoReply if it stays silent, Refused if it does not come to rest.
        """
        first = None
        since = 0.0
        while True:
            reading = self.read()
            now = self._now()
            if reading is None:
                first = None
            elif first is None or abs(reading[1] - first) > self._tolerance:
                if first is not None and target is None:
                    self.stop()  # the one before was lost
                first = reading[1]
                since = now
            else:
                on_the_way = target is not None and abs(first - target) > self._arrival
                if now - since >= max(self.settings.settle_s, self.settings.stall_s * on_the_way):
                    return reading[1]
            if now >= deadline:
                break
            self.pause(self.settings.poll_s)
        if first is None:
            raise NoReply(
                f"the head at {self.line.path} stopped telling its tilt: check its power and the "
                "wires"
            )
        raise Refused(
            f"the head does not come to rest, {math.degrees(first):.2f} deg by now: give it more "
            "time, a higher tolerance_deg, or look whether it can get there"
        )

    # ---------------------------------------------------------------------------------------------
    # moves

    def move(self, target, deadline):
        """Reach a pitch by set-tilt where the head obeys, else by up and down.

        Raises Refused if it obeys, but does not get there.
        """
        value = pelco_d.encode_tilt(self.settings.elevation(target))
        # the first may be lost, or come while it was still busy
        for _ in range(2 if self._obeys is not False else 0):
            self._send(encode_extended(self.settings.address, SET_TILT, value))
            pitch = self.settle(deadline, target)
            if abs(pitch - target) <= self._arrival:
                self._obeys = True
                return pitch
        if self._obeys:
            raise self._short_of(pitch, target)
        if self._obeys is None:
            self._obeys = False
            if self.settings.absolute is True:
                raise Refused(
                    "the head does not obey set-tilt (4D): state absolute false to use up and down"
                )
            LOG.warning("the head does not obey set-tilt (4D): it is moved by up and down")
        return self.steer(target, deadline)

    @staticmethod
    def _short_of(pitch, target):
        return Refused(
            f"the head stays at {math.degrees(pitch):.2f} deg on its way to "
            f"{math.degrees(target):.2f}: look for an end stop, or narrow pitch_limits_deg"
        )

    def steer(self, target, deadline):
        """Reach a pitch by up and down, each time as long as the way that is left takes.

        Raises Refused if the head does not move, moves the other way, or gets no nearer.
        """
        pitch = self.settle(deadline)
        full = self.settings.tilt_speed
        for _ in range(BURSTS):
            error = target - pitch
            steps = sorted({full, full // 4, full // 16} - self._dead, reverse=True)
            # of the shortest bursts
            ways = {step: self._shortest_s * self.speed(error, step) for step in steps}
            if abs(error) <= max(self._arrival, ways[steps[-1]]):
                return pitch
            step = next((step for step in steps if abs(error) >= 2 * ways[step]), steps[-1])
            took = self.run(pitch + SHORT_OF * error, step, GROWTH * self._longest)
            before = pitch
            pitch = self.settle(deadline)
            moved = (pitch - before) * math.copysign(1, error)
            if moved < -max(5 * self._tolerance, math.radians(1)):
                raise Refused(OTHER_WAY)
            if moved > 2 * self._tolerance:
                self.learn(error, step, moved / took)
            elif self._longest >= FIRST_BURST_S:
                self._dead.add(step)
                if step == full:
                    self._dead.clear()
                    raise Refused(
                        "the head does not move: look for an end stop, its power, and whether "
                        "tilt_speed suffices"
                    )
                continue
            self._longest = max(self._longest, took)
        raise self._short_of(pitch, target)

    def timed(self, target, seconds):
        """Move by time, unless the shortest motion would lead further away; the pitch that results
        is dead reckoning.

        Raises LineLost if the port vanished: the pitch is unknown then.
        """
        if seconds >= self._shortest_s / 2:
            self.run(target, self.settings.tilt_speed)
            self.pause(self.settings.settle_s)
        return self.estimate()

    def sweep(self, goal, step):
        """Move to a pitch at a speed byte and note where the head is on the way, and where it
        rests.
        """
        self._misses = 0
        self.note()
        first = self.estimate()
        way = math.copysign(1, goal - first)
        deadline = self._now() + 3 * abs(goal - first) / self.speed(way, step) + 10

        def look():
            """Note where the head is; what goes wrong in a sweep ends it."""
            self.note(brief=True)
            if self._now() > deadline:
                raise Refused(
                    "the sweep does not get to its end: look for an end stop, or state "
                    "degrees_per_second"
                )
            if (self.rows[-1][1] - first) * way < -math.radians(2):
                raise Refused(OTHER_WAY)
            if self.feedback and self._misses >= MISSES and not self.calibrated:
                raise NoReply(
                    "the head is silent while it moves and its speed is unknown: state "
                    "degrees_per_second"
                )
            told = [row for row in self.rows[1:] if row[2]]
            if told and abs(told[-1][1] - told[0][1]) >= 10 * self._tolerance:
                self.learn(way, step, abs(told[-1][1] - told[0][1]) / (told[-1][0] - told[0][0]))

        try:
            self.run(goal, step, look=look)
        finally:
            if self._pitch is not None:
                self.note()
        self.settle(self._now() + 5) if self.feedback else self.pause(0)
        self.note()


def drawn_to_readings(rows):
    """Track of a sweep out of its rows: what lies between two readings is stretched to both, what
    is outside is not.
    """
    track = [row[:3] for row in rows]
    told = [i for i, row in enumerate(rows) if row[2]]
    for first, last in itertools.pairwise(told):
        start = rows[first][1]
        way = rows[last][3] - rows[first][1]
        stretch = (rows[last][1] - start) / way if way else 1.0
        for i in range(first + 1, last):
            track[i] = (rows[i][0], start + stretch * (rows[i][1] - start), False)
    return track
