"""The thread that reads the stream of an LMS2xx and keeps its newest scans; it finds the device again by itself."""

from __future__ import annotations

from collections import deque

from lrfcal_lib.drivers.errors import DeviceError, NoReply
from lrfcal_lib.drivers.lms2xx_link import POWER_ON

KEPT = 256  # scans that can be asked for by their instant
LEAST_QUIET_S = 0.6
RECOVERY_S = 8.0  # one attempt; there are more until the stream is stopped


class ScanReader:
    """Reads scans until `quit`.

    Parameters
    ----------
    receive : callable
        () -> list of (code, Reading or None); waits a moment for the next telegrams.
    recover : callable
        (seconds) finds the device and starts the stream again, or raises DeviceError.
    clock : callable
    interval_s : float
        Between two readings.
    log : logging.Logger
    host : Host
    """

    def __init__(self, receive, recover, clock, interval_s, log, host):
        self._host, self._thread = host, host.thread(self._run, "LMS2xx reader")
        self._receive, self._recover, self._clock, self.interval_s, self._log = receive, recover, clock, interval_s, log
        self._readings, self._handed_s, self._news = deque(maxlen=KEPT), -float("inf"), host.condition()
        self._leave, self._trouble = host.event(), None

    # ---------------------------------------------------------------------------------------------- for the caller

    def start(self):
        """Begin to read."""
        self._thread.start()

    def newest(self, after, timeout):
        """See :meth:`LMS2xx.newest`."""
        return self._wait(lambda: self._fresh(after), timeout)

    def next(self, after, timeout):
        """The first scan later than `after`."""
        return self._wait(lambda: next((r for r in self._readings if r.time_s > after), None), timeout)

    def _wait(self, find, timeout):
        end = self._host.now() + timeout
        with self._news:
            while (found := find()) is None:
                left = end - self._host.now()
                if left <= 0 or not self._thread.is_alive():
                    state = "the reader thread ended" if not self._thread.is_alive() else "the stream is silent"
                    raise NoReply(f"no new scan within {timeout:g} s: {self._trouble or state}")
                self._news.wait(min(left, 0.2))
            self._handed_s = max(self._handed_s, found.time_s)
            return found

    def _fresh(self, after):
        """The newest scan if it is later than `after`; without that, if it was not handed out and is not old."""
        if not self._readings:
            return None
        newest = self._readings[-1]
        oldest_s = max(self._handed_s, self._clock() - 3 * self.interval_s - LEAST_QUIET_S)
        return newest if newest.time_s > (oldest_s if after is None else after) else None

    def quit(self):
        """End the thread."""
        self._leave.set()
        if self._thread.is_alive():
            self._thread.join()

    # ---------------------------------------------------------------------------------------------- the thread

    def _run(self):
        """Read; whatever goes wrong with the line, find the device again."""
        while not self._leave.is_set():
            try:
                self._read()
            except DeviceError as error:
                self._mend(error)
            except Exception as error:  # told to whoever waits, who would wait for nothing
                self._trouble = f"the reader thread failed: {error!r}"
                self._log.exception("LMS2xx reader thread")
                raise

    def _read(self):
        """Post readings until the stream falls silent, or until `quit`."""
        last = self._host.now()
        while not self._leave.is_set():
            found = self._receive()
            if any(code == POWER_ON for code, _ in found):
                raise NoReply("the device started anew")
            fresh = [reading for _, reading in found if reading is not None]
            if fresh:
                with self._news:
                    self._readings.extend(fresh)
                    self._trouble = None
                    self._news.notify_all()
                last = self._host.now()
            if self._host.now() - last > max(LEAST_QUIET_S, 2.2 * self.interval_s + 0.15):
                raise NoReply("the stream fell silent")

    def _mend(self, error):
        while not self._leave.is_set():
            self._trouble = str(error)
            self._log.warning("LMS2xx: %s; looking for the device", error)
            try:
                return self._recover(RECOVERY_S)
            except DeviceError as again:
                error = again
                self._leave.wait(0.1)
