"""A SICK LMS200, LMS211, LMS221 or LMS291 on a serial port: found, set up, asked, streaming."""

import logging
import math

from lrfcal_lib.drivers import lms2xx_link as wire
from lrfcal_lib.drivers.lms2xx_link import POINTS, POWER_ON, RATES, Assembler, Link, ScanClock
from lrfcal_lib.drivers.port import (
    REAL,
    Closed,
    DeviceError,
    LineLost,
    NoReply,
    PortError,
    Refused,
    WrongDevice,
)
from lrfcal_lib.session import lms2xx_codec as codec
from lrfcal_lib.session.lms2xx_codec import MODES, SCAN, UNITS

LOG = logging.getLogger(__name__)
# data of MODE
INSTALLATION = b"\x00"
STREAM = b"\x24"
INTERLACED = b"\x2a"
ALL_VALUES = b"\x01"  # data of VALUES
AGAIN_S = 0.1  # between looks for a port that vanished
FIND_S = 6.0
KEPT = 256  # scans that can be asked for by their instant
LEAST_QUIET_S = 0.6  # of a stream, before it is taken for silent
RECOVERY_S = 8.0  # one attempt to find a lost device; there are more until the stream is stopped
REPLY_S = 0.4  # the manual allows 60 ms until a scan begins to be sent; a machine may be busy
COUNTS = ("dropped", "stale", "reconnects")


class LMS2xx(Closed):
    """An LMS2xx, found at a port whatever it is doing, its stream stopped; a context manager.

    Every call returns or raises a DeviceError within its deadline. While the device streams, only
    `take`, `counts`, `stop` and `close` may be called.

    Parameters
    ----------
    port : str or Path
    baudrate : int, optional
        To switch to afterwards; the one found stays by default.
    address : int
        Of the device; 0 reaches any.
    password : bytes
        Eight characters, of the installation mode; the factory's by default.
    variant : tuple of float, optional
        To be set, see :meth:`set_variant`.
    find_s : float
        Longest time to find the rate.
    host : Host
        Machine that the driver runs on; tests have one of their own.
    **configuration
        Of :meth:`configure`.

    Attributes
    ----------
    type, firmware : str
        Model and order number; version.
    status : DeviceStatus
        As read last.
    configuration : Configuration
        As read last.

    Raises
    ------
    PortError
        If the port is missing, forbidden, busy, or no serial line.
    NoReply, WrongDevice
        If nothing, or something else answers, or a device in a measuring mode without ranges.
    ValueError
        For a rate or an address that no LMS2xx has, or a password of another length.
    """

    def __init__(
        self,
        port,
        *,
        baudrate=None,
        address=0,
        password=b"SICK_LMS",
        variant=None,
        find_s=FIND_S,
        host=REAL,
        **configuration,
    ):
        if baudrate not in (None, *RATES):
            raise ValueError(
                f"an LMS2xx has {', '.join(map(str, sorted(RATES)))} Bd, got {baudrate}"
            )
        if not 0 <= address < 0x80 or len(password) != 8:
            raise ValueError(
                f"an address is 0 to 127, got {address}; a password has 8 bytes, got "
                f"{len(password)}"
            )
        self.port = str(port)
        self._password = bytes(password)
        self._host = host
        self._counts = dict.fromkeys(COUNTS, 0)
        self._interrupted = host.event()
        self._options = {"address": address, "interrupted": self._interrupted, "host": host}
        self._link = self._assembler = self._settled = self._scan_clock = self._thread = None
        self._interlaced = False
        self._readings = []
        self._trouble = None
        self._news = host.event()
        try:
            self._connect(baudrate or 38400, host.now() + find_s)
            if baudrate is not None and baudrate != self.baudrate:
                self._set_rate(baudrate)
            self.configure(**configuration) if configuration else self._prepare()
            if variant is not None:
                self.set_variant(*variant)
        except BaseException:
            self._release()
            raise

    def close(self):
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
    def baudrate(self):
        """Of both ends of the line."""
        return self._opened().baudrate

    @property
    def counts(self):
        """How often what happened since the device was opened, a dict.

        'dropped': scans that the mirror made between two that came (needs real-time indices), most
        of them because the line is slow; 'stale': scans that were not newer than the one before;
        'reconnects'.
        """
        return dict(self._counts)

    # ---------------------------------------------------------------------------------------------
    # connecting

    def _connect(self, first, end, deadline=math.inf):
        """Open the port and leave the device quiet, with everything about it read; the rate is
        found by `end`.
        """
        self._link = Link(self.port, first, **self._options)
        self._scan_clock = ScanClock()
        self._link.deadline = deadline
        self._link.find([first, *(rate for rate in RATES if rate != first)], end - self._host.now())
        self._link.hush()
        self.status = self._told(wire.STATUS, codec.parse_status)
        self._link.senders = {0x80, 0x80 | self.status.address}
        model, *rest = self._told(wire.TYPE, codec.parse_type)
        if not model.startswith("LMS2"):
            raise WrongDevice(
                f"{self.port}: '{model}' answers, not an LMS2xx: name the port of the LMS2xx"
            )
        self.type = "-".join([model, *rest[:1]])
        self.firmware = self.status.firmware
        self._read_configuration()
        told = (self.port, self.type, self.firmware, self.baudrate, *self.variant)
        LOG.info("%s: %s %s at %d Bd, %g deg in steps of %g deg", *told)

    def _prepare(self, interlaced=False):
        """Expect scans as the device is set now; these settings are those to come back to."""
        if self.variant not in POINTS:
            raise WrongDevice(
                f"{self.port}: the {self.type} scans {self.variant} deg, which no LMS2xx does"
            )
        if (mode := self.configuration.measuring_mode) not in MODES:
            text = (
                f"{self.port}: the {self.type} is in measuring mode {mode:02X}, whose values are "
                "no ranges"
            )
            raise WrongDevice(
                f"{text} that can be told from errors: state measuring_mode, 0 to 6, to have it set"
            )
        self._settled = self.variant, self.configuration, self.baudrate
        self._assembler = Assembler(*self._settled, interlaced, self._counts, self._scan_clock)

    def _opened(self):
        if self._link is None:
            raise LineLost(f"{self.port} is closed: open it, or call reconnect()")
        return self._link

    def _told(self, code, parse):
        """What a reply says."""
        raw = self._opened().ask(code).raw
        try:
            return parse(raw)
        except codec.TelegramError as error:
            text = f"{self.port}: the reply to command {code:02X} is not that of an LMS2xx: {error}"
            raise WrongDevice(text) from error

    def _idle(self):
        if self._thread is not None:
            raise DeviceError(f"{self.port}: the device streams; call stop() first")

    def reconnect(self, deadline=10.0):
        """Find the device again after the line was lost or it restarted, within seconds, and set it
        as it was.

        LineLost if the port did not come back; NoReply, WrongDevice or Refused if it did, but the
        device does not work as before.
        """
        self._idle()
        self._mend(deadline)

    def _mend(self, deadline):
        end = self._host.now() + deadline
        variant, configuration, rate = self._settled
        self._release()
        while self._link is None:
            try:
                self._connect(rate, min(end, self._host.now() + FIND_S), end)
            except (PortError, LineLost) as error:
                self._release()
                if self._interrupted.wait(AGAIN_S) or self._host.now() > end - AGAIN_S:
                    raise LineLost(f"the line did not come back: {error}") from error
        if self.variant != variant:
            self._set_variant(variant)
        if self.configuration.block != configuration.block:
            self._write(configuration)
        if self.baudrate != rate:
            self._set_rate(rate)
        self._prepare()
        self._link.deadline = math.inf
        self._counts["reconnects"] += 1
        LOG.warning("%s: the device is back at %d Bd", self.port, rate)

    # ---------------------------------------------------------------------------------------------
    # settings

    @property
    def variant(self):
        """Field of view and resolution, degrees."""
        return self.status.scan_angle_deg, self.status.resolution_deg

    def _read_configuration(self):
        def parse(raw):
            found = codec.parse_configuration(raw)
            return found.unit and found  # a unit that no manual lists is seen here

        self.configuration = self._told(wire.CONFIGURATION, parse)

    def _set_rate(self, rate):
        """Change the rate of both ends; flash is not written. Where it does not come through the
        old one holds.
        """
        old = self.baudrate
        self._link.set_rate(rate)  # before the device is told: raises where this end cannot
        self._link.set_rate(old)
        self._mode(bytes([RATES[rate]]), f"{rate} Bd")
        self._link.set_rate(rate)
        try:
            self._link.ask(wire.TYPE)
        except (NoReply, Refused) as error:
            self._link.find([old, *(r for r in RATES if r not in (old, rate)), rate], FIND_S)
            need = "a shorter cable"
            if rate == 500000:
                need = "RS-422 (a jumper in the plug of the device)"
            text = (
                f"{self.port}: nothing comes through at {rate} Bd, which needs {need}; "
                f"{self.baudrate} Bd now"
            )
            raise NoReply(text) from error

    def _mode(self, data, what, sign=None):
        """Change the operating mode; replies A0 other than 00 are refusals."""
        reply = self._opened().ask(wire.MODE, data, sign=sign)
        if reply.code != sign and reply.raw[5]:
            raise Refused(f"{self.port}: the device declines {what} (A0 {reply.raw[5]:02X})")

    def set_variant(self, fov_deg, resolution_deg):
        """Set field of view and resolution, 180 with 1 or 0.5 or 100 with 1, 0.5 or 0.25 deg;
        whether they differed.
        """
        self._idle()
        wanted = (float(fov_deg), float(resolution_deg))
        if wanted not in POINTS:
            known = ", ".join(f"{fov:g}/{step:g}" for fov, step in POINTS)
            raise ValueError(f"variants are {known} deg, got {fov_deg:g}/{resolution_deg:g}")
        self.status = self._told(wire.STATUS, codec.parse_status)
        differs = self.variant != wanted
        if differs:
            self._set_variant(wanted)
            self._prepare()
        return differs

    def _set_variant(self, wanted):
        words = b"".join(round(v).to_bytes(2, "little") for v in (wanted[0], 100 * wanted[1]))
        try:
            self._opened().ask(wire.VARIANT, words)
        except NoReply as error:  # the reply may be lost and the variant set
            LOG.warning("%s; reading the variant", error)
        self.status = self._told(wire.STATUS, codec.parse_status)
        if self.variant != wanted:
            have = "{:g} deg in steps of {:g} deg".format(*self.variant)
            raise Refused(
                f"{self.port}: the {self.type} has no variant {wanted[0]:g}/{wanted[1]:g}; it "
                f"keeps {have}"
            )

    def configure(self, *, unit=None, measuring_mode=None, realtime_indices=None):
        """Change settings that are kept in flash (some thousand writes), only if they differ;
        whether they did.

        The unit is 'cm' or 'mm', the measuring mode a key of `lms2xx_codec.MODES` (it tells the
        largest range, too). Without real-time indices dropped and repeated scans cannot be seen.
        Refused for a wrong password, or values that the device declines; ValueError for those that
        no LMS2xx has.
        """
        self._idle()
        if unit not in (None, *UNITS) or measuring_mode not in (None, *MODES):
            raise ValueError(
                f"unit is one of {UNITS}, measuring mode 0 to 6; got {unit!r}, {measuring_mode!r}"
            )
        self._read_configuration()
        options = {
            "unit": unit,
            "measuring_mode": measuring_mode,
            "realtime_indices": realtime_indices,
        }
        wanted = self.configuration.changed(**options)
        differs = wanted.block != self.configuration.block
        if differs:
            self._write(wanted)
        self._prepare()
        return differs

    def _write(self, wanted):
        """Write a configuration in installation mode, and read it back."""
        try:
            self._mode(INSTALLATION + self._password, "the password of the installation mode")
            self._link.ask(wire.CONFIGURE, wanted.block)
        except NoReply as error:
            # the reply may be lost and the flash written: read it, do not write again
            LOG.warning("%s; reading the configuration", error)
        finally:
            self._mode(wire.ON_REQUEST, "to leave the installation mode")
        self._read_configuration()
        if self.configuration.block != wanted.block:
            raise Refused(
                f"{self.port}: the device does not take the configuration {wanted.block.hex(' ')}"
            )

    # ---------------------------------------------------------------------------------------------
    # scans

    def request(self, timeout=None):
        """One scan, a Reading, within so many seconds; by default what three tries need."""
        self._idle()
        patience = wire.TRIES * (0.5 + 2 * self._assembler.interval_s)
        end = self._host.now() + (patience if timeout is None else timeout)
        for _ in range(wire.TRIES):
            left = max(0.0, end - self._host.now())
            arrival = self._opened().ask(wire.VALUES, ALL_VALUES, limit_s=left)
            late = arrival.time_s - self._link.asked_s > REPLY_S + self._assembler.duration_s
            # nobody knows the instant of a scan that came late
            reading = None if late else self._scan(arrival)
            if reading is not None:
                return reading
        raise NoReply(
            f"{self.port}: scans arrive, but too late, not new, or not of the variant "
            f"{self.variant}"
        )

    def _scan(self, arrival):
        return self._assembler.feed(arrival.raw, arrival.time_s) if arrival.code == SCAN else None

    def start(self, interlaced=False):
        """Stream: a thread reads every scan from now on.

        With `interlaced` partial scans are merged to 180 deg in steps of 0.25 deg; the variant
        becomes 100/0.25, which such scans need.
        """
        self._idle()
        self._interlaced = interlaced
        if interlaced:
            self.set_variant(100, 0.25)
        self._stream()
        self._readings = []
        self._trouble = None
        self._thread = self._host.thread(self._run, "LMS2xx reader")
        self._thread.start()

    @property
    def interval_s(self):
        """Seconds between two scans of the stream."""
        return (4 if self._interlaced else 1) * self._assembler.interval_s

    def _stream(self):
        self._prepare(self._interlaced)
        self._mode(INTERLACED if self._interlaced else STREAM, "to stream", sign=SCAN)

    def _run(self):
        """Read until the stream is to stop; whatever goes wrong with the line, find the device
        again.
        """
        lost = False
        while not self._interrupted.is_set():
            try:
                if lost:
                    self._mend(RECOVERY_S)
                    self._stream()
                    lost = False
                self._read()
            except DeviceError as error:
                if lost:
                    self._interrupted.wait(AGAIN_S)
                self._trouble = str(error)
                lost = True
                LOG.warning("LMS2xx: %s; looking for the device", error)
            except Exception as error:  # told to whoever waits, who would wait for nothing
                self._trouble = f"the reader thread failed: {error!r}"
                LOG.exception("LMS2xx reader thread")
                raise

    def _read(self):
        """Post readings until the stream falls silent, or until the end; the list is replaced,
        never changed.
        """
        last = self._host.now()
        while not self._interrupted.is_set():
            found = self._opened().receive()
            if any(one.code == POWER_ON for one in found):
                raise NoReply("the device started anew")
            if fresh := [reading for one in found if (reading := self._scan(one)) is not None]:
                self._readings = [*self._readings, *fresh][-KEPT:]
                self._trouble = None
                self._news.set()
                last = self._host.now()
            if self._host.now() - last > max(LEAST_QUIET_S, 2.2 * self.interval_s + 0.15):
                raise NoReply("the stream fell silent")

    def take(self, count, after=None, timeout=None):
        """Consecutive scans of the stream, a list of Reading, later than an instant, by default
        that of the call.

        The last 256 scans are kept, so that with the instant of the last scan of one call the next
        call goes on without a gap. By default it lasts as long as the line needs and 2 s.
        """
        if self._thread is None:
            raise DeviceError(f"{self.port}: the device does not stream; call start() first")
        limit = 2 + 2 * (count + 2) * self.interval_s if timeout is None else timeout
        found = []
        last_s = self._host.time() if after is None else after
        end = self._host.now() + limit
        while True:
            self._news.clear()
            alive = self._thread.is_alive()
            found += [one for one in self._readings if one.time_s > last_s]
            if len(found) >= count:
                return found[:count]
            last_s = found[-1].time_s if found else last_s
            left = end - self._host.now()
            if left <= 0 or not alive:
                state = "the stream is silent" if alive else "the reader thread ended"
                raise NoReply(f"no new scan within {limit:g} s: {self._trouble or state}")
            self._news.wait(min(left, 0.2))

    def stop(self):
        """Stop streaming; nothing happens where the device does not."""
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
