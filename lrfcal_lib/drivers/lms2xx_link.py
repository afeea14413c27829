"""The line to an LMS2xx: telegrams with their instants, retries, the baud rate, scans on request and as a stream."""

from __future__ import annotations

import itertools
import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.drivers.host import REAL
from lrfcal_lib.drivers.port import DeviceError, NoReply, PortError, Refused, WrongDevice, line_lost
from lrfcal_lib.session.lms2xx_codec import (
    OVERHEAD,
    UNITS,
    TelegramError,
    decode_scan,
    encode_telegram,
    scan_quarters,
    split_stream,
)

ACK, NAK = 0x06, 0x15
MODE, VALUES, STATUS, ERRORS, TYPE, VARIANT, CONFIGURATION, CONFIGURE = 0x20, 0x30, 0x31, 0x32, 0x3A, 0x3B, 0x74, 0x77
POWER_ON, NOT_UNDERSTOOD = 0x90, 0x92
ON_REQUEST = b"\x25"  # data of MODE
RATES = {38400: 0x40, 9600: 0x42, 19200: 0x41, 500000: 0x48}  # and the data of MODE that sets them
TURN_S = 0.01332  # of the mirror
BURST = 508  # bytes that leave in a turn of the mirror at 500 kBd
PACE_S = 75e-6  # from byte to byte at 500 kBd: 20 us for the byte, then at least 55 us
READ_S = 0.02  # a read returns after this time at the latest
SILENCE_S = 0.02  # longer than any gap within a telegram (14 ms)
TRIES = 3
NAK_PAUSE_S = 0.035
NO_ACK_S = 0.35  # the manual allows 60 ms; a machine may be busy
# Seconds until a request that was acknowledged is sent again, and until it failed. A mode may take 3 s; what writes
# to flash is not sent again, its caller looks whether it was done.
PATIENCE = {MODE: (1.0, 4.0), VARIANT: (2.5, 2.5), CONFIGURE: (2.5, 2.5)}
USUAL = (0.6, 2.5)
WINDOWS_S = (0.25, 0.25, 0.6)  # to listen at a rate, in turn


@dataclass(frozen=True)
class Arrival:
    """A telegram and when its last byte came in, by the clock of the link."""

    raw: bytes
    time_s: float

    @property
    def code(self):
        """Of the reply."""
        return self.raw[4]


def transfer_s(size, baudrate):
    """Seconds from the first byte of a scan to its last (manual, 10.10.2: bursts of 508 bytes a turn at 500 kBd)."""
    turns = (size - 1) // BURST if baudrate == 500000 else 0
    return turns * TURN_S + (size - turns * BURST) * 10 / baudrate


def interval_s(size, baudrate, scan_s):
    """Seconds between two scans of a stream: whole scans pass while one is sent (manual, table 10-17)."""
    return math.ceil(size * 10 / baudrate / scan_s - 1e-9) * scan_s


class Link:
    """An open port with an LMS2xx at its other end.

    Parameters
    ----------
    path : str
    baudrate : int
    counts : dict
        Numbers of 'telegrams', 'crc_errors' and 'resyncs', counted up.
    address : int
        Of the device; 0 reaches any.
    clock : callable, optional
        ``host.time`` by default.
    interrupted : threading.Event, optional
        Once set, whoever waits here gets NoReply.
    host : Host

    Attributes
    ----------
    senders : set of int or None
        Address bytes that replies may have; None for any.
    deadline : float
        By ``host.now()``; no request lasts longer.
    asked_s : float
        By the clock, when the last request was sent for the first time.
    heard : int
        Bytes of any kind.

    Raises
    ------
    PortError
        See :func:`serial_port.open_port`.
    """

    def __init__(self, path, baudrate, counts, *, address=0, clock=None, interrupted=None, host=REAL):
        self.path, self.counts, self.address, self.host = path, counts, address, host
        self.clock, self.interrupted = clock or host.time, interrupted or host.event()
        self.senders, self.deadline, self.asked_s, self.heard = None, math.inf, 0.0, 0
        self._port = host.port(path, baudrate, timeout=READ_S)
        self._forget()

    @property
    def baudrate(self):
        """Of this end of the line."""
        return self._port.baudrate

    def set_rate(self, baudrate):
        """Change this end's rate; raises PortError where the line cannot."""
        self.host.set_rate(self._port, baudrate)
        self._forget()

    def close(self):
        """Give the port back."""
        self._port.close()

    def _forget(self):
        self._rest, self._stray, self._last, self._kept = b"", None, self.host.now(), []

    def send(self, code, data=b""):
        """Send a request; what arrived before it is thrown away."""
        raw = encode_telegram(code, data, address=self.address)
        with line_lost(self.path):
            self._port.reset_input_buffer()
            self._forget()
            if self.baudrate < 500000:
                self._port.write(raw)
                return
            for at in range(len(raw)):
                self._port.write(raw[at : at + 1])
                self.host.sleep(PACE_S)

    def receive(self):
        """Telegrams that came in; waits 20 ms at most, longer only while more bytes keep coming.

        Returns
        -------
        list of Arrival
            Those of the device, whatever their code; often none.

        Raises
        ------
        LineLost
            If the port vanished.
        NoReply
            If somebody set `interrupted`.
        """
        if self.interrupted.is_set():
            raise NoReply(f"{self.path}: waiting was interrupted")
        if self._kept:
            kept, self._kept = self._kept, []
            return kept
        with line_lost(self.path):
            data = self._port.read(self._missing())
            data += self._port.read(self._port.in_waiting)
        return self._cut(data, self.clock()) if data else []

    def _missing(self):
        """Bytes until the telegram that has begun is whole."""
        if len(self._rest) < 4:
            return 1
        return max(1, int.from_bytes(self._rest[2:4], "little") + OVERHEAD - len(self._rest))

    def _cut(self, data, now):
        """Take the telegrams out of what is there; the bytes after a telegram tell how much earlier it came."""
        self._last = self.host.now()
        self.heard += len(data)
        data = self._rest + data
        stream = split_stream(data)
        ends = (stream.offset + stream.length).tolist()
        stray = data[ends[-1] if ends else 0 : stream.pending]
        self._stray = stray[-1] if stray else None if ends else self._stray
        self._rest = data[stream.pending :]
        self.counts["telegrams"] += len(ends)
        self.counts["crc_errors"] += int((stream.rejected < stream.pending).sum())
        self.counts["resyncs"] += stream.skipped > 1  # one byte is an acknowledgement
        byte_s = 10 / self.baudrate
        spans = zip(stream.offset.tolist(), ends, strict=True)
        found = [Arrival(data[begin:end], now - (len(data) - end) * byte_s) for begin, end in spans]
        return [one for one in found if self.senders is None or one.raw[1] in self.senders]

    @property
    def silent_s(self):
        """Seconds since the last byte, or since the last request."""
        return self.host.now() - self._last

    @property
    def acknowledged(self):
        """Whether the last stray byte is ACK."""
        return self._stray == ACK

    @property
    def declined(self):
        """Whether the last byte is NAK and nothing followed; amid other bytes 0x15 means nothing."""
        return self._stray == NAK and not self._rest and self.silent_s > SILENCE_S

    # ---------------------------------------------------------------------------------------------- requests

    def ask(self, code, data=b"", *, limit_s=math.inf, sign=None):
        """Send a request until its reply comes.

        Parameters
        ----------
        code : int
        data : bytes
        limit_s : float
            The call returns or raises within this time, and within what the manual allows this request.
        sign : int, optional
            A reply of this code, too, shows that the request was obeyed; it stays to be received.

        Returns
        -------
        Arrival

        Raises
        ------
        NoReply, Refused, LineLost
        """
        again_s, longest_s = PATIENCE.get(code, USUAL)
        end = min(self.host.now() + min(longest_s, limit_s), self.deadline)
        said, self.asked_s = None, self.clock()
        for _ in range(TRIES):
            self.send(code, data)
            reply, said = self._await({code | 0x80, sign}, again_s, end)
            if reply is not None and reply.code == sign:
                self._kept.insert(0, reply)
            if reply is not None:
                return reply
            if self.host.now() > end - NAK_PAUSE_S:
                break
            if said:
                self.host.sleep(NAK_PAUSE_S)
        if said:
            raise Refused(f"{self.path}: the device refuses command {code:02X}: {said}")
        raise NoReply(f"{self.path}: no reply to command {code:02X} at {self.baudrate} Bd; is the device on?")

    def _await(self, codes, again_s, end):
        """The reply, or None and why the device declined (None if it said nothing until it is time to ask again)."""
        begin, acknowledged = self.host.now(), False
        while (now := self.host.now()) < end:
            found = self.receive()
            for at, one in enumerate(found):
                if one.code in codes:
                    self._kept = found[at + 1 :]
                    return one, None
                if one.code == NOT_UNDERSTOOD:
                    return None, "not allowed in its present mode, or unknown (92)"
            acknowledged |= self.acknowledged
            if self.declined:
                return None, "it finds the checksum wrong (NAK); the line damages what is sent"
            patience = again_s if acknowledged else NO_ACK_S
            if now - begin > patience and (self.silent_s > SILENCE_S or now - begin > 2 * again_s):
                break
        return None, None

    # ------------------------------------------------------------------------------------------ finding the rate

    def find(self, rates, limit_s):
        """Set the rate at which the device answers, and stop whatever it does.

        Parameters
        ----------
        rates : iterable of int
            In the order to try.
        limit_s : float

        Raises
        ------
        NoReply
            If nothing was heard at any rate.
        WrongDevice
            If only bytes that make no telegram were heard.
        """
        end, heard, windows = self.host.now() + limit_s, self.heard, itertools.cycle(WINDOWS_S)
        while self.host.now() < end:
            window = next(windows)
            if any(self._answers(rate, window, end) for rate in rates):
                return
        tried = f"{', '.join(map(str, rates))} Bd, address {self.address}" + " (any)" * (self.address == 0)
        if self.heard > heard:
            raise WrongDevice(
                f"{self.path}: bytes arrive, but no telegram of an LMS2xx at {tried}: "
                "another device, wires that echo, or a line that damages everything"
            )
        raise NoReply(
            f"{self.path}: no reply at {tried}: check power (ready up to 60 s after switching on), "
            "the address, whether RX and TX are crossed, and the jumper for RS-422 in the plug"
        )

    def _answers(self, rate, window, end):
        """Whether the device confirms at a rate that it stops streaming; once it acknowledges it gets 3 s for that."""
        try:
            self.set_rate(rate)
        except PortError:  # most RS-232 ports lack 500000 Bd
            return False
        begin, sent = self.host.now(), -math.inf
        until = begin + window
        while (now := self.host.now()) < min(until, end):
            if now - sent > (NAK_PAUSE_S if self.declined else 1.0):
                sent = now
                self.send(MODE, ON_REQUEST)
            codes = [one.code for one in self.receive()]
            if MODE | 0x80 in codes:
                return True
            if codes or self.declined or (self.acknowledged and self.silent_s > 3 * SILENCE_S):
                until = begin + 3.2
        return False

    def stop(self):
        """Stop streaming and see that it stopped; raises as `ask` and `hush`."""
        self.ask(MODE, ON_REQUEST)
        self.hush()

    def hush(self):
        """See that nothing comes in; ask again to stop streaming where something does.

        Raises
        ------
        NoReply, Refused, LineLost
        """
        for _ in range(TRIES):
            begin, heard = self.host.now(), self.heard
            while self.host.now() < begin + 5 * SILENCE_S and self.heard == heard:
                self.receive()
            if self.heard == heard:
                return
            self.ask(MODE, ON_REQUEST)
        raise Refused(f"{self.path}: the device confirms to stop streaming and goes on; switch it off and on")


POINTS = {(100, 1.0): 101, (100, 0.5): 201, (100, 0.25): 401, (180, 1.0): 181, (180, 0.5): 361}
WINDOW_S = 2.0  # arrivals in the last so many seconds tell the host's clock from the device's
OFF_S = 1.2  # how far a scan may arrive off its expected instant
JITTER_S = 0.05  # corrections of the clock up to this are spread over scans; at larger ones scans are left out
LEAST_S = TURN_S / 100  # between two instants told; far less than between two scans, emulated ones sped up included
FORGET_S = 30.0  # after such a pause the number of turns in between is not known
STUBBORN = 5  # so many implausible scan indices in a row: the device counts anew


@dataclass(frozen=True)
class Reading:
    """A scan with the instants of its beams.

    Attributes
    ----------
    telegrams : tuple of bytes
        As sent: one, or the four of a set of interlaced scans.
    ranges : ndarray, shape (B,)
        Metres, NaN where there is no range.
    reasons : ndarray of uint8, shape (B,)
        Index into `lms2xx.REASONS`, 0 for a range.
    bearings : ndarray, shape (B,)
        Radians in the LRF frame, ascending.
    time_s : float
        Clock of the host at the first beam.
    beam_times_s : ndarray, shape (B,)
        The same for every beam; neighbours of fine scans are 13.32 ms apart.
    scan_index, telegram_index : int or None
        Of the (first) telegram, modulo 256; None where the device does not send them.
    """

    telegrams: tuple[bytes, ...]
    ranges: np.ndarray
    reasons: np.ndarray
    bearings: np.ndarray
    time_s: float
    beam_times_s: np.ndarray
    scan_index: int | None
    telegram_index: int | None


class ScanClock:
    """Instants of scans: arrivals jitter late, the device's index of turns does not.

    Without indices an arrival counts as it is. With them, the earliest of the arrivals of the last two seconds ties
    the count of turns to the host's clock, so that a busy host or a late telegram does not shift a scan. A mirror that
    is off its nominal speed by a part e shifts it by up to 2 e seconds.
    """

    def __init__(self):
        self._seen, self._refused, self._told = deque(), 0, -np.inf

    def place(self, index, time_s):
        """Instant of a scan.

        Parameters
        ----------
        index : int
            Turns of the mirror modulo 256; -1 where the device does not send it.
        time_s : float
            Instant as of its arrival.

        Returns
        -------
        instant : float or None
            Rising from scan to scan; None for a telegram that is not newer than the last one.
        step : int
            Turns since the last one; 0 where that is not known.
        """
        if index < 0:
            return time_s, 0
        step = 0
        if self._seen:
            turn, last_s = self._seen[-1][0], self._instant()
            step = self._step(index - turn, time_s - last_s)
            if step is None:
                return None, 0
        turn = self._seen[-1][0] + step if step else index
        self._refused = 0
        self._seen.append((turn, time_s))
        while self._seen[0][1] < time_s - WINDOW_S and len(self._seen) > 1:
            self._seen.popleft()
        return self._rising(self._instant()), step

    def _rising(self, instant):
        """An instant after the last one told, or None where the clock was found to be far ahead."""
        if instant < self._told - JITTER_S:
            return None
        self._told = max(instant, self._told + LEAST_S)
        return self._told

    def _step(self, ahead, elapsed_s):
        """Turns since the last scan; None where the index does not fit the time that passed, 0 after a new start."""
        if elapsed_s > FORGET_S or self._refused >= STUBBORN:
            self._seen.clear()
            return 0
        step = ahead % 256
        step += 256 * round((elapsed_s / TURN_S - step) / 256)
        late = elapsed_s - step * TURN_S
        if step > 0 and abs(late) < OFF_S:
            return step
        self._refused += 1
        return None

    def _instant(self):
        """Of the last scan, by the earliest arrival of the window."""
        return self._seen[-1][0] * TURN_S + min(time_s - turn * TURN_S for turn, time_s in self._seen)


class Assembler:
    """Readings out of telegrams, one by one.

    Parameters
    ----------
    variant : tuple
        Field of view and resolution, degrees.
    configuration : Configuration
    baudrate : int
    interlaced : bool
        Merge four partial scans of 180 deg into one of 721 values.
    counts : dict
        'dropped' (scans between two telegrams that were not sent or got lost) and 'stale' are counted up.
    clock : ScanClock, optional
        Of the scans before, where the mirror went on turning: an old telegram that comes first is then known as such.
    """

    def __init__(self, variant, configuration, baudrate, interlaced, counts, clock=None):
        self.variant, self.configuration, self.baudrate, self.interlaced = variant, configuration, baudrate, interlaced
        self.counts, self._clock, self._parts, self._first = counts, clock or ScanClock(), [], True

    @property
    def turns(self):
        """Turns of the mirror for one telegram."""
        return 1 if self.interlaced else round(1 / self.variant[1])

    @property
    def size(self):
        """Bytes of a telegram."""
        values = 181 if self.interlaced else POINTS[self.variant]
        return 10 + 2 * values + 2 * self.configuration.realtime_indices

    @property
    def duration_s(self):
        """Seconds from the start of a scan to its last byte."""
        return self.turns * TURN_S + transfer_s(self.size, self.baudrate)

    @property
    def interval_s(self):
        """Seconds between two telegrams of a stream."""
        return interval_s(self.size, self.baudrate, self.turns * TURN_S)

    def feed(self, raw, arrival_s):
        """A telegram that came in.

        Parameters
        ----------
        raw : bytes
            With a sound checksum.
        arrival_s : float
            Instant of its last byte.

        Returns
        -------
        Reading or None
            None for a part of a set, and for what is no scan of this variant, unit and kind or is not new.
        """
        try:
            scan = decode_scan(raw, self.configuration.measuring_mode)
        except TelegramError:
            return None
        if not self._fits(scan):
            return None
        start_s = arrival_s - transfer_s(len(raw), self.baudrate) - self.turns * TURN_S
        start_s, step = self._clock.place(int(scan.scan_index[0]), start_s)
        if start_s is None:
            self.counts["stale"] += 1
            return None
        self.counts["dropped"] += 0 if self._first else max(0, step // self.turns - 1)
        self._first = False
        reading = self._reading(raw, scan, start_s)
        return self._merge(int(scan.partial[0]), reading) if self.interlaced else reading

    def _fits(self, scan):
        """Whether a scan is one of those that were asked for."""
        partial, indexed = int(scan.partial[0]), scan.scan_index[0] >= 0
        values = 181 - (partial > 0) if self.interlaced else POINTS[self.variant]
        kind = (scan.words.shape[1], UNITS.index(scan.unit), indexed, partial >= 0)
        own = self.configuration
        return kind == (values, UNITS.index(own.unit), own.realtime_indices, self.interlaced)

    def _reading(self, raw, scan, start_s):
        """A telegram alone; `start_s` is the begin of its first turn at bearing 0."""
        partial = int(scan.partial[0])
        quarters = scan_quarters(scan.words.shape[1], partial)
        turn = np.arange(len(quarters)) % self.turns
        times = start_s + (turn + quarters / 1440) * TURN_S
        ranges = np.where(np.isfinite(scan.ranges[0]), scan.ranges[0], np.nan)
        indices = [None if i < 0 else int(i) for i in (scan.scan_index[0], scan.telegram_index[0])]
        return Reading((raw,), ranges, scan.reasons[0], np.radians(quarters / 4), float(times[0]), times, *indices)

    def _merge(self, partial, part):
        """The set of four that a part completes, or None."""
        if partial != len(self._parts) or not self._follows(part):
            self._parts = []
        if partial == len(self._parts):
            self._parts.append(part)
        if len(self._parts) < 4:
            return None
        parts, self._parts = self._parts, []
        columns = {}
        for name in ("ranges", "reasons", "bearings", "beam_times_s"):
            columns[name] = np.empty(721, getattr(parts[0], name).dtype)
            for first, one in enumerate(parts):
                columns[name][first::4] = getattr(one, name)
        return replace(parts[0], telegrams=tuple(t for one in parts for t in one.telegrams), **columns)

    def _follows(self, part):
        """Whether no telegram is missing between a part and the one before."""
        if not self._parts:
            return True
        last = self._parts[-1]
        if part.telegram_index is not None:
            return (part.telegram_index - last.telegram_index) % 256 == 1
        return part.time_s - last.time_s < 1.5 * self.interval_s


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
