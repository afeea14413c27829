"""A SICK LMS200, LMS211, LMS221 or LMS291 on a serial port: scans on request and as a stream, with their instants."""

from __future__ import annotations

from lrfcal_lib.drivers.errors import DeviceError, LineLost, NoReply
from lrfcal_lib.drivers.lms2xx import SCAN
from lrfcal_lib.drivers.lms2xx_link import TRIES, VALUES
from lrfcal_lib.drivers.lms2xx_scans import Reading
from lrfcal_lib.drivers.lms2xx_setup import LMS2xxSetup
from lrfcal_lib.drivers.lms2xx_stream import ScanReader

__all__ = ["LMS2xx", "Reading"]

REPLY_S = 0.4  # the manual allows 60 ms until a scan begins to be sent; a machine may be busy
STREAM, INTERLACED, ALL_VALUES = b"\x24", b"\x2a", b"\x01"


class LMS2xx(LMS2xxSetup):
    """An LMS2xx; made by :meth:`open`, a context manager.

    Every call returns or raises a DeviceError within its deadline. While the device streams, only `newest`, `take`,
    `counts`, `stop` and `close` may be called.

    Attributes
    ----------
    port : str
    type : str
        Model and order number.
    firmware : str
    status : DeviceStatus
        As read last.
    configuration : Configuration
        As read last.
    variant : tuple of float
        Field of view and resolution, degrees.
    """

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self._reader, self._interlaced = None, False

    def _idle(self):
        if self._reader is not None:
            raise DeviceError(f"{self.port}: the device streams; call stop() first")

    def close(self):
        """Stop streaming, close the port; never raises for a device that is gone."""
        try:
            self.stop()
        except DeviceError as error:
            self._log.warning("%s: closed without the device's consent: %s", self.port, error)
        finally:
            self._release()

    def request(self, timeout=None):
        """One scan.

        Parameters
        ----------
        timeout : float, optional
            Seconds; what three tries need by default.

        Returns
        -------
        Reading
        """
        self._idle()
        end = self._host.now() + (self._patience() if timeout is None else timeout)
        for _ in range(TRIES):
            left = max(0.0, end - self._host.now())
            arrival = self._ask(VALUES, ALL_VALUES, limit_s=left)
            late = arrival.time_s - self._link.asked_s > REPLY_S + self._assembler.duration_s
            reading = None if late else self._scan(arrival)  # nobody knows the instant of a scan that came late
            if reading is not None:
                return reading
        raise NoReply(f"{self.port}: scans arrive, but too late, not new, or not of the variant {self.variant}")

    def _patience(self):
        return TRIES * (0.5 + 2 * self._assembler.interval_s)

    def _scan(self, arrival):
        return self._assembler.feed(arrival.raw, arrival.time_s) if arrival.code == SCAN else None

    def start(self, interlaced=False):
        """Stream: a thread reads every scan from now on.

        Parameters
        ----------
        interlaced : bool
            Merge partial scans to 180 deg in steps of 0.25 deg; the variant becomes 100/0.25, which such scans need.
        """
        self._idle()
        self._interlaced = interlaced
        if interlaced:
            self.set_variant(100, 0.25)
        self._stream()
        interval_s = (4 if interlaced else 1) * self._assembler.interval_s
        self._reader = ScanReader(self._receive, self._resume, self._clock, interval_s, self._log, self._host)
        self._reader.start()

    def _stream(self):
        self._prepare(self._interlaced)
        self._mode(INTERLACED if self._interlaced else STREAM, "to stream", sign=SCAN)

    def _receive(self):
        return [(one.code, self._scan(one)) for one in self._opened().receive()]

    def _resume(self, seconds):
        self._mend(seconds)
        self._stream()

    def newest(self, after=None, timeout=2.0):
        """The newest scan of the stream.

        Parameters
        ----------
        after : float, optional
            Only a scan whose first beam is later, by the host's clock. By default one that was not handed out
            before and is not older than the stream needs.
        timeout : float

        Returns
        -------
        Reading

        Raises
        ------
        NoReply
            If there is none in time; the message tells what is wrong with the stream.
        """
        return self._streaming().newest(after, timeout)

    def take(self, count, after=None, timeout=None):
        """Consecutive scans of the stream.

        Parameters
        ----------
        count : int
        after : float, optional
            Instant that all must be later than; the call by default. The last 256 scans are kept, so that with the
            instant of the last scan of one call the next call goes on without a gap.
        timeout : float, optional
            For all of them; what the line needs and 2 s by default.

        Returns
        -------
        list of Reading
        """
        reader, after = self._streaming(), self._clock() if after is None else after
        limit = 2 + 2 * (count + 2) * reader.interval_s if timeout is None else timeout
        end, found = self._host.now() + limit, []
        while len(found) < count:
            found.append(reader.next(after, max(0.0, end - self._host.now())))
            after = found[-1].time_s
        return found

    def _streaming(self):
        if self._reader is None:
            raise DeviceError(f"{self.port}: the device does not stream; call start() first")
        return self._reader

    def stop(self):
        """Stop streaming; nothing happens where the device does not."""
        if self._reader is None:
            return
        self._interrupted.set()
        self._reader.quit()
        self._reader = None
        self._interrupted.clear()
        if self._link is None:
            raise LineLost(f"{self.port}: the line is lost; the device may still stream")
        self._link.stop()
        self._prepare()
