"""A SICK LMS200, LMS211, LMS221 or LMS291 on a serial port: found, set up, asked, streaming."""

import logging
import math
import os
import struct
from functools import partial
from threading import Thread

from lrfcal_lib.drivers import lms2xx_link as wire
from lrfcal_lib.drivers.lms2xx_link import POWER_ON, RATES, Link
from lrfcal_lib.drivers.lms2xx_scans import Assembler, Reading, ScanClock
from lrfcal_lib.drivers.port import (
    REAL,
    Closed,
    DeviceError,
    Host,
    LineLost,
    NoReply,
    PortError,
    Refused,
    WrongDevice,
)
from lrfcal_lib.session import lms2xx_codec as codec
from lrfcal_lib.session.files import short
from lrfcal_lib.session.lms2xx_codec import TOP, VARIANTS
from lrfcal_lib.session.lms2xx_frame import TelegramError

LOG = logging.getLogger(__name__)
# data of MODE
INSTALLATION = b"\x00SICK_LMS"  # with the password of the factory
STREAMS = {False: b"\x24", True: b"\x2a"}  # by whether scans are interlaced
ALL_VALUES = b"\x01"  # data of VALUES
FINE = (100, 0.25)  # variant that interlaced scans need, deg
USUAL_RATE = 38400  # Bd; where a device is looked for first
AGAIN_S = 0.1  # between looks for a port that vanished
FIND_S = 6.0
KEPT = 256  # scans that can be asked for by their instant
LEAST_QUIET_S = 0.6  # of a stream, before it is taken for silent
# one attempt to find a lost device; there are more until the stream is stopped
RECOVERY_S = 8.0
# the manual allows 60 ms until a scan begins to be sent; a machine may be busy
REPLY_S = 0.4


class LMS2xx(Closed):
    """An LMS2xx, found at a port whatever it is doing, its stream stopped; a context manager.

    Every call returns or raises a DeviceError within its deadline. While the device streams, only
    `take`, `stop` and `close` may be called.

    Parameters
    ----------
    port
        Its path.
    baudrate
        To switch to afterwards; the one found stays by default.
    address
        Of the device; 0 reaches any.
    variant
        To be set, see :meth:`set_variant`.
    find_s
        Longest time to find the rate.
    host
        Machine that the driver runs on; tests have one of their own.
    **configuration
        Of :meth:`configure`.

    Attributes
    ----------
    type : str
        Model and order number.
    status, configuration : DeviceStatus, Configuration
        As read last.

    Raises
    ------
    PortError
        If the port is missing, forbidden, busy, or no serial line.
    NoReply, WrongDevice
        If nothing, or something else answers, or a device in a measuring mode without ranges.
    ValueError
        For a rate that no LMS2xx has.
    """

    def __init__(
        self,
        port: str | os.PathLike,
        *,
        baudrate: int | None = None,
        address: int = 0,
        variant: tuple[float, float] | None = None,
        find_s: float = FIND_S,
        host: Host = REAL,
        **configuration,
    ):
        if baudrate not in (None, *RATES):
            raise ValueError(f"an LMS2xx has {short(sorted(RATES))} Bd, got {baudrate}")
        self.port = str(port)
        self._host = host
        self._now = host.now
        self._address = address
        self._interrupted = host.event()
        self._link = None
        self._thread: Thread | None = None
        self._news = host.event()
        try:
            self._connect(baudrate or USUAL_RATE, find_s)
            self._set_rate(baudrate or self.baudrate)
            self.configure(**configuration)
            if variant is not None:
                self.set_variant(*variant)
        except BaseException:
            self._release()
            raise

    def close(self) -> None:
        """Stop streaming, close the port; never raises for a device that is gone."""
        try:
            self.stop()
        except DeviceError as error:
            LOG.warning("%s: closed without the device's consent: %s", self.port, error)
        finally:
            self._release()

    def _release(self):
        """Close the port."""
        if self._link is not None:
            self._link.close()
            self._link = None

    @property
    def baudrate(self) -> int:
        """Of both ends of the line."""
        return self._line.baudrate

    def _connect(self, first, find_s, deadline=math.inf):
        """Open the port and leave the device quiet, with everything read but its configuration.

        The rate is found in `find_s` seconds, and no request lasts beyond the deadline.
        """
        self._link = Link(
            self.port,
            first,
            address=self._address,
            interrupted=self._interrupted,
            host=self._host,
        )
        self._clock = ScanClock()
        self._link.deadline = deadline
        self._link.find(first, find_s)
        self._link.hush()
        self._read_status()
        self._link.senders = {0x80, 0x80 | self.status.address}
        model, *rest = self._read(wire.TYPE, codec.parse_type)
        if not model.startswith("LMS2"):
            raise WrongDevice(
                f"{self.port}: '{model}' answers, not an LMS2xx: name the port of the LMS2xx"
            )
        self.type = "-".join([model, *rest[:1]])

    def _prepare(self, interlaced=False):
        """Expect scans as the device is set now; these settings are those to come back to."""
        if self.variant not in VARIANTS:
            raise WrongDevice(
                f"{self.port}: the {self.type} scans {self.variant} deg, which no LMS2xx does"
            )
        mode = self.configuration.measuring_mode
        if mode not in TOP:
            raise WrongDevice(
                f"{self.port}: the {self.type} is in measuring mode {mode:02X}, whose values are "
                "no ranges that can be told from errors: state measuring_mode, 0 to 6, to have it "
                "set"
            )
        self._settled = self.variant, self.configuration, self.baudrate
        self._assembler = Assembler(*self._settled, interlaced, self._clock)

    @property
    def _line(self):
        """The link, while it is open."""
        if self._link is None:
            raise LineLost(f"{self.port} is closed: open it, or call reconnect()")
        return self._link

    def _read(self, code, parse):
        """What a reply says."""
        try:
            return parse(self._line.ask(code).raw)
        except TelegramError as error:
            raise WrongDevice(
                f"{self.port}: the reply to command {code:02X} is not that of an LMS2xx: {error}"
            ) from error

    def _read_status(self):
        self.status = self._read(wire.STATUS, codec.parse_status)

    def _read_configuration(self):
        self.configuration = self._read(wire.CONFIGURATION, codec.parse_configuration)

    def _need_quiet(self):
        if self._thread is not None:
            raise DeviceError(f"{self.port}: the device streams; call stop() first")

    def reconnect(self, deadline: float = 10.0) -> None:
        """Find the device again after the line was lost or it restarted, and set it as it was.

        Parameters
        ----------
        deadline
            Seconds that it may take.

        Raises
        ------
        LineLost
            If the port did not come back.
        NoReply, WrongDevice, Refused
            If it did, but the device does not work as before.
        """
        self._need_quiet()
        self._mend(deadline)

    def _mend(self, deadline):
        end = self._now() + deadline
        variant, configuration, rate = self._settled
        self._release()
        while self._link is None:
            try:
                self._connect(rate, FIND_S, end)
            except (PortError, LineLost) as error:
                self._release()
                if self._interrupted.wait(AGAIN_S) or self._now() > end - AGAIN_S:
                    raise LineLost(f"the line did not come back: {error}") from error
        self._set_variant(variant)
        self._read_configuration()
        self._write(configuration)
        self._set_rate(rate)
        self._prepare()
        self._link.deadline = math.inf
        LOG.warning("%s: the device is back at %d Bd", self.port, rate)

    @property
    def variant(self) -> tuple[float, float]:
        """Field of view and resolution, degrees."""
        return self.status.variant

    def _set_rate(self, rate):
        """Set the rate of both ends; flash is not written.

        Where it does not come through the old one holds.
        """
        link = self._line
        before = link.baudrate
        if rate == before:
            return
        link.set_rate(rate)  # before the device is told: raises where this end cannot
        link.set_rate(before)
        self._mode(bytes([RATES[rate]]), f"{rate} Bd")
        link.set_rate(rate)
        try:
            link.ask(wire.TYPE)
        except (NoReply, Refused) as error:
            link.find(before, FIND_S)
            raise NoReply(
                f"{self.port}: nothing comes through at {rate} Bd: 500000 needs RS-422 (a jumper "
                "in the plug of the device), others a shorter cable; "
                f"{self.baudrate} Bd now"
            ) from error

    def _mode(self, data, what):
        """Change the operating mode; replies A0 other than 00 are refusals."""
        result = self._line.ask(wire.MODE, data).raw[5]
        if result:
            raise Refused(f"{self.port}: the device declines {what} (A0 {result:02X})")

    def set_variant(self, fov_deg: float, resolution_deg: float) -> None:
        """Set field of view and resolution, if they differ.

        Parameters
        ----------
        fov_deg, resolution_deg
            180 with 1 or 0.5, or 100 with 1, 0.5 or 0.25 deg.

        Raises
        ------
        ValueError
            For a variant that no LMS2xx has.
        Refused
            If this one does not have it.
        """
        self._need_quiet()
        wanted = (fov_deg, resolution_deg)
        if wanted not in VARIANTS:
            known = short(f"{fov:g}/{step:g}" for fov, step in VARIANTS)
            raise ValueError(
                f"variants are {known} deg, got {fov_deg:g}/{resolution_deg:g}"
            )
        self._read_status()
        self._set_variant(wanted)
        self._prepare()

    def _set_variant(self, wanted):
        """Set the variant where it was read to be another one."""
        if self.variant == wanted:
            return
        view, step = wanted
        try:
            self._line.ask(wire.VARIANT, struct.pack("<HH", round(view), round(100 * step)))
        except NoReply as error:  # the reply may be lost and the variant set
            LOG.warning("%s; reading the variant", error)
        self._read_status()
        if self.variant != wanted:
            raise Refused(
                f"{self.port}: the {self.type} has no variant {view:g}/{step:g}; it keeps "
                "{:g} deg in steps of {:g} deg".format(*self.variant)
            )

    def configure(self, **changes) -> None:
        """Change settings that are kept in flash (some thousand writes), only if they differ.

        Parameters
        ----------
        **changes
            Of :meth:`lms2xx_codec.Configuration.changed`: `unit` of a reading, `measuring_mode`,
            which tells the largest range, too, and `realtime_indices`, without which dropped and
            repeated scans cannot be seen.

        Raises
        ------
        Refused
            For a wrong password, or values that the device declines.
        """
        self._need_quiet()
        self._read_configuration()
        self._write(self.configuration.changed(**changes))
        self._prepare()

    def _write(self, wanted):
        """Write a configuration that differs from the one read, in installation mode, and read it
        back.
        """
        if self.configuration == wanted:
            return
        try:
            self._mode(INSTALLATION, "the password of the installation mode")
            self._line.ask(wire.CONFIGURE, wanted.block)
        except NoReply as error:
            # the reply may be lost and the flash written: read it, do not write again
            LOG.warning("%s; reading the configuration", error)
        finally:
            self._mode(wire.ON_REQUEST, "to leave the installation mode")
        self._read_configuration()
        if self.configuration != wanted:
            raise Refused(
                f"{self.port}: the device does not take the configuration {wanted.block.hex(' ')}"
            )

    def request(self, after: float = -math.inf, timeout: float = 4.0) -> Reading:
        """One scan.

        Parameters
        ----------
        after
            Date of the host, s, later than which it is.
        timeout
            Seconds.

        Raises
        ------
        NoReply
            If none comes in time.
        LineLost
            If the port vanished.
        """
        self._need_quiet()
        link = self._line
        end = self._now() + timeout
        usual_s = REPLY_S + self._assembler.duration_s
        while True:
            arrival = link.ask(wire.VALUES, ALL_VALUES, limit_s=end - self._now())
            # nobody knows the instant of a scan that came late
            if arrival.time_s - link.asked_s <= usual_s:
                reading = self._assembler.feed(*arrival)
                if reading is not None and reading.time_s > after:
                    return reading
            if self._now() > end - usual_s:
                raise NoReply(
                    f"{self.port}: scans arrive, but too late, not new, or not of the variant "
                    f"{self.variant}"
                )

    def start(self, interlaced: bool = False) -> None:
        """Stream: a thread reads every scan from now on.

        Parameters
        ----------
        interlaced
            Partial scans are merged to 180 deg in steps of 0.25 deg; the variant becomes 100/0.25,
            which such scans need.

        Raises
        ------
        Refused, NoReply, LineLost
            If the device does not stream.
        """
        self._need_quiet()
        if interlaced:
            self.set_variant(*FINE)
        self._stream(interlaced)
        self._readings: list[Reading] = []
        self._trouble = ""  # why no reading came
        self._thread = self._host.thread(partial(self._run, interlaced), "LMS2xx reader")
        self._thread.start()

    def _stream(self, interlaced):
        self._prepare(interlaced)
        self._mode(STREAMS[interlaced], "to stream")

    def _run(self, interlaced):
        """Read until the stream is to stop; whatever goes wrong with the line, find the device
        again.
        """
        lost = False
        while not self._interrupted.is_set():
            try:
                if lost:
                    self._mend(RECOVERY_S)
                    self._stream(interlaced)
                    lost = False
                self._post()
            except DeviceError as error:
                if lost:
                    self._interrupted.wait(AGAIN_S)
                self._trouble = str(error)
                lost = True
                LOG.warning("LMS2xx: %s; looking for the device", error)

    def _post(self):
        """Post readings until the stream falls silent, or until the end.

        The list is replaced, never changed.
        """
        last = self._now()
        quiet_s = max(LEAST_QUIET_S, 2.2 * self._assembler.interval_s + 0.15)
        while not self._interrupted.is_set():
            for arrival in self._line.receive():
                if arrival.code == POWER_ON:
                    raise NoReply("the device started anew")
                reading = self._assembler.feed(*arrival)
                if reading is not None:
                    self._readings = [*self._readings, reading][-KEPT:]
                    self._trouble = ""
                    self._news.set()
                    last = self._now()
            if self._now() - last > quiet_s:
                raise NoReply("the stream stopped")

    def take(
        self, count: int, after: float | None = None, timeout: float = 10.0
    ) -> list[Reading]:
        """Consecutive scans of the stream.

        The last 256 scans are kept, so that with the instant of the last scan of one call the next
        call goes on without a gap.

        Parameters
        ----------
        count
            Of the scans.
        after
            Date of the host, s, later than which they are; by default that of the call.
        timeout
            Seconds.

        Raises
        ------
        NoReply
            If they do not come in time.
        DeviceError
            If the device does not stream.
        """
        if self._thread is None:
            raise DeviceError(
                f"{self.port}: the device does not stream; call start() first"
            )
        if after is None:
            after = self._host.time()
        end = self._now() + timeout
        readings: list[Reading] = []
        while True:
            self._news.clear()
            readings += [reading for reading in self._readings if reading.time_s > after]
            if len(readings) >= count:
                return readings[:count]
            if readings:
                after = readings[-1].time_s
            left = end - self._now()
            if left <= 0:
                raise NoReply(
                    f"no new scan within {timeout:g} s: "
                    f"{self._trouble or 'the stream is silent, check its line'}"
                )
            self._news.wait(left)

    def stop(self) -> None:
        """Stop streaming; nothing happens where the device does not.

        Raises
        ------
        LineLost
            If the line is lost.
        NoReply, Refused
            If the device does not stop.
        """
        if self._thread is None:
            return
        self._interrupted.set()
        self._thread.join()
        self._thread = None
        self._interrupted.clear()
        if self._link is None:
            raise LineLost(f"{self.port}: the line is lost; the device may still stream")
        self._link.ask(wire.MODE, wire.ON_REQUEST)
        self._link.hush()
        self._prepare()
