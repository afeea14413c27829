"""The pitch axis of a Pelco-D head: moves, sweeps and readings, with whatever the head answers."""

import logging
import math
import os
import threading

from lrfcal_lib.drivers import port
from lrfcal_lib.drivers.motion import ASSUMED, Motion, Stopped
from lrfcal_lib.drivers.pelco_d import FRAME, HeadLine
from lrfcal_lib.drivers.port import (
    REAL,
    DeviceError,
    Host,
    NoReply,
    OutOfRange,
    WrongDevice,
)
from lrfcal_lib.drivers.rig_file import ROUNDING_DEG

LOG = logging.getLogger(__name__)


class PanTilt(Motion, port.Closed):
    """A head on a serial line, stopped on every way out, Ctrl-C and SIGTERM included.

    Parameters
    ----------
    path
        Of the port.
    settings : rig_file.HeadSettings
    host
        Machine that the driver runs on.

    Attributes
    ----------
    has_feedback : bool
        It tells its tilt.

    Raises
    ------
    PortError
        If the port cannot be opened.
    NoReply
        If a head with stated feedback tells nothing.
    WrongDevice
        If something else answers.
    """

    def __init__(self, path: str | os.PathLike, settings, *, host: Host = REAL):
        super().__init__(HeadLine(path, settings, host), settings)
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._closed = False
        try:
            self._probe()
        except BaseException:
            self.line.close()
            raise
        port.guard(self)

    def _probe(self):
        """Stop the head, ask whether it tells its tilt, and see who answers."""
        settings = self.settings
        line = self.line
        line.stop()
        self.has_feedback = (
            settings.feedback is not False and self.read(patient=True) is not None
        )
        if self.has_feedback:
            return
        if line.received.skipped > FRAME:
            raise WrongDevice(
                f"{line.path} sends {line.received.skipped} bytes that are no Pelco-D at "
                f"{settings.baudrate} Bd: another device, another rate, or Pelco-P"
            )
        if settings.feedback is True:
            raise self._silence()
        self.set_pitch(math.radians(settings.start_pitch_deg))
        LOG.warning(
            "the head does not tell its tilt: timed moves at %g/%g deg/s (state "
            "degrees_per_second if that is not so), from %.2f deg; its pitch is not measured",
            *(settings.degrees_per_second or ASSUMED),
            settings.start_pitch_deg,
        )

    def _silence(self):
        settings = self.settings
        line = self.line
        echo = ""
        if line.received.echoed:
            echo = "what was sent came back, so the adapter works: "
        return NoReply(
            f"the head at {line.path} does not tell its tilt: {echo}check its power, the wires A "
            f"and B, address {settings.address} and {settings.baudrate} Bd; state a longer reply_s "
            f'than {settings.reply_s:g} s if it answers late, or feedback "auto" to go on without '
            "its tilt"
        )

    def close(self) -> None:
        """Stop the head and close the port; a second call does nothing."""
        if self._closed:
            return
        try:
            with port.stopping("head"):
                self.stop()
        finally:
            port.release(self)
            self._closed = True
            self.line.close()

    def emergency_stop(self) -> None:
        """Stop at once, from a signal or at exit; errors are logged."""
        self.abort.set()
        if not self._closed:
            self.line.blurt_stop()

    def _need_open(self):
        if self._closed:
            raise DeviceError("the head is closed: open it again")

    # ---------------------------------------------------------------------------------------------
    # pitch

    def pitch(self) -> tuple[float, bool]:
        """Where the head points now.

        Returns
        -------
        pitch : float
            Radians, up positive.
        measured : bool
            The head told it; else it is dead reckoning.

        Raises
        ------
        NoReply
            If a head with feedback rests and does not answer.
        LineLost
            If the port did not come back.
        DeviceError
            If the head was closed, or the pitch of one without feedback is unknown after its line
            was lost.
        """
        self._need_open()
        if self.has_feedback:
            moving = self.moving()
            reading = self.read(patient=not moving)
            if reading is not None:
                return reading.pitch, True
            if not moving:
                raise self._silence()
        return self.estimate(), False

    def set_pitch(self, pitch: float) -> None:
        """Say where a head without feedback stands.

        Parameters
        ----------
        pitch
            Radians, up positive.
        """
        self.know(pitch, self._now())

    def moving(self) -> bool:
        """Whether a move or sweep of this object is under way."""
        return self._lock.locked()

    # ---------------------------------------------------------------------------------------------
    # moves

    def stop(self) -> None:
        """End every motion; the move that another thread waits for raises.

        Raises
        ------
        LineLost
            If the port stays away.
        """
        self._need_open()
        self.abort.set()
        self.halt()
        if self._thread is not None:
            self._thread.join()

    def _begin(self, pitch):
        """Begin a motion to a pitch, one at a time."""
        self._need_open()
        low, high = self.settings.pitch_limits_deg
        degrees = math.degrees(pitch)
        if not low - ROUNDING_DEG <= degrees <= high + ROUNDING_DEG:
            raise OutOfRange(
                f"pitch {degrees:.2f} deg is beyond the head's limits of {low:g} to {high:g} deg: "
                "ask for less, or widen pitch_limits_deg if the head can do it"
            )
        if not self._lock.acquire(blocking=False):
            raise DeviceError("the head is moving already: stop it, or wait for it")
        self.abort.clear()

    def move_to(self, pitch: float) -> float:
        """Move and wait until the head rests.

        It may take twice the time that the way takes, and 10 s.

        Parameters
        ----------
        pitch
            Radians, up positive.

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
            If the port vanished.
        DeviceError
            If it was stopped meanwhile.
        """
        self._begin(pitch)
        try:
            if self.has_feedback and self.read(patient=True) is None:
                raise self._silence()
            return self.move(pitch)
        except BaseException:
            self.emergency_stop()
            raise
        finally:
            self._lock.release()

    def start_sweep(self, stop_at: float, speed: int | None = None) -> None:
        """Start a thread that moves the head, notes where it is, and stops it.

        What goes wrong later is raised by :meth:`finish_sweep`.

        Parameters
        ----------
        stop_at
            Pitch, rad.
        speed
            Byte from 0 (very slow) to 0x3F, by default ``settings.tilt_speed``; one that was not
            calibrated is taken to be in proportion.

        Raises
        ------
        OutOfRange
            Beyond the limits; nothing moves.
        """
        step = self.settings.tilt_speed if speed is None else speed
        self._begin(stop_at)
        self.rows = []
        self._error: DeviceError | None = None

        def run():
            """The sweep, in its own thread."""
            try:
                self.sweep(stop_at, step)
            except Stopped:
                pass
            except DeviceError as error:
                self._error = error
            finally:
                self._lock.release()

        self._thread = self.line.host.thread(run, "sweep")
        self._thread.start()

    def finish_sweep(self) -> list[tuple[float, float, bool]]:
        """Wait for the end of the sweep; its :attr:`track`. DeviceError if it ended too early."""
        if self._thread is None:
            raise DeviceError("there was no sweep: start one")
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self.track
