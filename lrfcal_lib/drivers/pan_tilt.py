"""The pitch axis of a Pelco-D head: moves, sweeps and readings, with whatever the head answers.

A head that tells its tilt is moved by set-tilt (4D), or by up and down in bursts between readings. One that tells
nothing is moved by time with a calibrated speed; its pitch is dead reckoning, and marked ``measured=False``.
"""

from __future__ import annotations

import contextlib
import logging
import math
import threading

from lrfcal_lib.drivers import emergency, pelco_d
from lrfcal_lib.drivers.errors import DeviceError, LineLost, NoReply, OutOfRange, Refused, WrongDevice
from lrfcal_lib.drivers.head_line import HeadLine
from lrfcal_lib.drivers.head_motion import Motion
from lrfcal_lib.drivers.head_settings import HeadSettings
from lrfcal_lib.drivers.head_sweep import Sweep
from lrfcal_lib.drivers.host import REAL

LOG = logging.getLogger(__name__)

__all__ = ["HeadSettings", "PanTilt"]


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
        emergency.guard(head)
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
            emergency.release(self)
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
