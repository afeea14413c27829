"""The pitch axis of a Pelco-D head: moves, sweeps and readings, with whatever the head answers."""

import logging
import math
import threading

from lrfcal_lib.drivers import pelco_d, port
from lrfcal_lib.drivers.motion import ASSUMED, Motion, Stopped, drawn_to_readings
from lrfcal_lib.drivers.pelco_d import (
    FASTEST,
    HeadLine,
)
from lrfcal_lib.drivers.port import (
    REAL,
    DeviceError,
    LineLost,
    NoReply,
    OutOfRange,
    WrongDevice,
)

LOG = logging.getLogger(__name__)


class PanTilt(port.Closed):
    """A head on a serial line; a context manager. It is stopped on every way out, Ctrl-C and
    SIGTERM included.

    Parameters
    ----------
    path : str or Path
        Of the port.
    settings : rig_file.HeadSettings

    Attributes
    ----------
    has_feedback : bool
        It tells its tilt.

    Raises
    ------
    PortError
        If the port cannot be opened.
    NoReply
        If a head with stated feedback tells nothing, or a stated echo does not come.
    WrongDevice
        If something else answers.
    """

    def __init__(self, path, settings, *, host=REAL):
        self.settings = settings
        self._lock = threading.Lock()
        self._line = HeadLine(path, settings, host)
        self._thread = None
        self._error = None
        self.motion = Motion(self._line, settings)
        try:
            self._probe()
        except BaseException:
            self._line.close()
            raise
        port.guard(self)

    def _probe(self):
        """Stop the head, ask whether it tells its tilt, and see who answers."""
        settings = self.settings
        line = self._line
        start = math.radians(self.settings.start_pitch_deg)
        line.stop()
        reading = self.motion.read(settings.retries) if settings.feedback is not False else None
        if reading is None and line.counts["skipped"] > pelco_d.FRAME * line.counts["frames"]:
            raise WrongDevice(
                f"{line.path} sends {line.counts['skipped']} bytes that are no Pelco-D at "
                f"{settings.baudrate} Bd: another device, another rate, or Pelco-P"
            )
        if settings.echo is True and not line.counts["echoed"]:
            raise NoReply(
                f"{line.path} does not echo what is sent: check the adapter and its power"
            )
        if settings.echo is False and line.counts["echoed"]:
            LOG.warning(
                "%s echoes what is sent, which was not expected: echoes are removed", line.path
            )
        if reading is None and settings.feedback is True:
            raise NoReply(self._silence())
        self.has_feedback = self.motion.feedback = reading is not None
        if not self.has_feedback:
            self.motion.know(start)
            how = "stated" if self.motion.calibrated else "assumed, state degrees_per_second"
            LOG.warning(
                "the head does not tell its tilt: timed moves at %g/%g deg/s (%s), from %.2f deg; "
                "its pitch is not measured",
                *(settings.degrees_per_second or ASSUMED),
                how,
                settings.start_pitch_deg,
            )

    def _silence(self):
        echo = (
            "what was sent came back, so the adapter works: " if self._line.counts["echoed"] else ""
        )
        return (
            f"the head at {self._line.path} does not tell its tilt: {echo}check its power, the "
            f"wires A and B, address {self.settings.address} and {self.settings.baudrate} Bd; "
            "state a longer reply_s than "
            f'{self.settings.reply_s:g} s if it answers late, or feedback "auto" to go on '
            "without its tilt"
        )

    def close(self):
        """Stop the head and close the port; a second call does nothing."""
        if self._line is None:
            return
        try:
            self.stop()
        except DeviceError as error:
            LOG.error("the head could not be stopped (%s): cut its power if it moves", error)
        finally:
            port.release(self)
            line = self._line
            self._line = None
            line.close()

    def emergency_stop(self):
        """Stop at once, from a signal or at exit; errors are logged."""
        self.motion.abort.set()
        if self._line is not None:
            self._line.blurt_stop()

    def _need_open(self):
        if self._line is None:
            raise DeviceError("the head is closed: open it again")

    # ---------------------------------------------------------------------------------------------
    # pitch

    def pitch(self):
        """Where the head points now, rad, up positive, and whether it was measured (else it is dead
        reckoning).

        NoReply if it rests and does not answer, LineLost if the port did not come back, DeviceError
        if the head was closed, or the pitch of one without feedback is unknown after its line was
        lost.
        """
        self._need_open()
        if self.has_feedback:
            moving = self.moving()
            reading = self.motion.read(0 if moving else self.settings.retries)
            if reading is not None:
                return reading[1], True
            if not moving:
                raise NoReply(self._silence())
        return self.motion.estimate(), False

    def set_pitch(self, pitch):
        """Say where a head without feedback stands, rad."""
        self.motion.know(pitch)

    def moving(self):
        """Whether a move or sweep of this object is under way."""
        return self._lock.locked()

    # ---------------------------------------------------------------------------------------------
    # moves

    def stop(self):
        """End every motion; the move that another thread waits for raises. LineLost if the port
        stays away.
        """
        self._need_open()
        self.motion.abort.set()
        self.motion.stop()
        if self._thread is not None:
            self._thread.join()

    def _begin(self, pitch):
        """Begin a motion to a pitch, one at a time."""
        self._need_open()
        low, high = self.settings.pitch_limits_deg
        if not low - 1e-6 <= math.degrees(pitch) <= high + 1e-6:
            raise OutOfRange(
                f"pitch {math.degrees(pitch):.2f} deg is beyond the head's limits of {low:g} to "
                f"{high:g} deg: ask for less, or widen pitch_limits_deg if the head can do it"
            )
        if not self._lock.acquire(blocking=False):
            raise DeviceError("the head is moving already: stop it, or wait for it")
        self.motion.abort.clear()

    def move_to(self, pitch):
        """Move and wait until the head rests.

        It may take twice the time that the way takes, and 10 s; a lost line adds `reconnect_s`.

        Returns
        -------
        float
            Settled pitch, rad, up positive: read from the head, or dead reckoning without feedback.

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
        self._begin(pitch)
        motion = self.motion
        now = self._line.host.now
        try:
            if self.has_feedback and motion.read(self.settings.retries) is None:
                raise NoReply(self._silence())
            way = pitch - motion.estimate()
            seconds = abs(way) / motion.speed(way, self.settings.tilt_speed)
            deadline = now() + 2 * seconds + 10
            while self.has_feedback:
                try:
                    return motion.move(pitch, deadline)
                except LineLost:
                    if now() >= deadline:
                        raise
                    self._line.opened()
            return motion.timed(pitch, seconds)
        except BaseException:
            self.emergency_stop()
            raise
        finally:
            self._lock.release()

    def start_sweep(self, stop_at, speed=None):
        """Start a thread that moves the head to a pitch, rad, notes where it is, and stops it
        there.

        The speed byte is 0 (very slow) to 0x3F, by default ``settings.tilt_speed``; one that was
        not calibrated is taken to be in proportion. Raises OutOfRange beyond the limits, ValueError
        for a speed that does not exist; what goes wrong later is raised by :meth:`finish_sweep`.
        """
        step = self.settings.tilt_speed if speed is None else speed
        if step not in range(FASTEST + 1):
            raise ValueError(f"speed is {speed!r}: it is a byte from 0, very slow, to {FASTEST}")
        self._begin(stop_at)

        def run():
            """The sweep, in its own thread."""
            try:
                self.motion.sweep(stop_at, step)
            except Stopped:
                pass
            except DeviceError as error:
                self._error = error
            finally:
                self._lock.release()

        self.motion.rows = []
        self._error = None
        self._thread = self._line.host.thread(run, "sweep")
        self._thread.start()

    def finish_sweep(self):
        """Wait for the end of the sweep; its :attr:`track`. DeviceError if it ended too early."""
        if self._thread is None:
            raise DeviceError("there was no sweep: start one")
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self.track

    @property
    def track(self):
        """List of host time, pitch in rad and whether it was measured, of the sweep that runs or
        ran last.

        Between readings the pitch is dead reckoning, which is drawn to the readings.
        """
        return drawn_to_readings(list(self.motion.rows))
