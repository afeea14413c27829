"""The line to an LMS2xx: telegrams with their instants, retries, the baud rate, and scans."""

import itertools
import math
import os
from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lrfcal_lib.drivers.port import REAL, Host, NoReply, PortError, Refused, WrongDevice, line_lost
from lrfcal_lib.model.kinematics import MIRROR_TURN
from lrfcal_lib.session import lms2xx_codec as codec

ACK = 0x06
NAK = 0x15
# codes of requests and replies
MODE = 0x20
VALUES = 0x30
STATUS = 0x31
TYPE = 0x3A
VARIANT = 0x3B
CONFIGURATION = 0x74
CONFIGURE = 0x77
POWER_ON = 0x90
NOT_UNDERSTOOD = 0x92
ON_REQUEST = b"\x25"  # data of MODE
RATES = {38400: 0x40, 9600: 0x42, 19200: 0x41, 500000: 0x48}  # and the data of MODE that sets them
FASTEST = 500000  # Bd
BURST = 508  # bytes that leave in a turn of the mirror at 500 kBd
PACE_S = 75e-6  # from byte to byte at 500 kBd: 20 us for the byte, then at least 55 us
READ_S = 0.02  # a read returns after this time at the latest
SILENCE_S = 0.02  # longer than any gap within a telegram (14 ms)
TRIES = 3
NAK_PAUSE_S = 0.035
NO_ACK_S = 0.35  # the manual allows 60 ms; a machine may be busy
# Seconds until a request that was acknowledged is sent again, and until it failed. A mode may take
# 3 s; what writes to flash is not sent again, its caller looks whether it was done.
PATIENCE = {MODE: (1.0, 4.0), VARIANT: (2.5, 2.5), CONFIGURE: (2.5, 2.5)}
USUAL = (0.6, 2.5)
WINDOWS_S = (0.25, 0.25, 0.6)  # to listen at a rate, in turn
ASK_AGAIN_S = 1.0  # while listening
STOPPING_S = 3.2  # that a device may take to stop its stream
VARIANTS = ((100, 1.0), (100, 0.5), (100, 0.25), (180, 1.0), (180, 0.5))  # of whole scans, deg
PARTIAL = 181  # values of the first of four interlaced scans; the others have one less
WINDOW_S = 2.0  # arrivals in the last so many seconds tell the host's clock from the device's
OFF_S = 1.2  # how far a scan may arrive off its expected instant
JITTER_S = 0.05  # larger corrections of the clock leave scans out, smaller ones are spread
LEAST_S = MIRROR_TURN / 100  # between two instants told; far less than between two scans
FORGET_S = 30.0  # after such a pause the number of turns in between is not known
STUBBORN = 5  # so many implausible scan indices in a row: the device counts anew


class Arrival(NamedTuple):
    """A telegram and when its last byte came in, by the host's clock."""

    raw: bytes
    time_s: float

    @property
    def code(self) -> int:
        """Of the reply."""
        return self.raw[4]


def transfer_s(size: int, baudrate: int) -> float:
    """Seconds from the first byte of a scan to its last (manual, 10.10.2).

    Parameters
    ----------
    size
        Bytes; at 500 kBd bursts of 508 leave in a turn of the mirror.
    baudrate
        Bits a second.
    """
    turns = 0
    if baudrate == FASTEST:
        turns = (size - 1) // BURST
    return turns * MIRROR_TURN + (size - turns * BURST) * 10 / baudrate


def interval_s(size: int, baudrate: int, scan_s: float) -> float:
    """Seconds between two scans of a stream: whole scans pass while one is sent (table 10-17).

    Parameters
    ----------
    size
        Bytes of a scan.
    baudrate
        Bits a second.
    scan_s
        Seconds in which one is measured.
    """
    return math.ceil(size * 10 / baudrate / scan_s - 1e-9) * scan_s


class Link:
    """An open port with an LMS2xx at its other end.

    Parameters
    ----------
    path
        Of the port.
    baudrate
        Bits a second.
    address
        Of the device; 0 reaches any.
    interrupted : threading.Event, optional
        Once it is set whoever waits here gets NoReply.
    host
        Machine that the driver runs on.

    Attributes
    ----------
    senders : set of int or None
        Address bytes of the replies that count; None: any.
    deadline : float
        By ``host.now()``, beyond which no request lasts.
    asked_s : float
        Date at which the last request was sent for the first time, s.
    heard : int
        Bytes of any kind.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        baudrate: int,
        *,
        address: int = 0,
        interrupted=None,
        host: Host = REAL,
    ):
        self.path = path
        self.address = address
        self.host = host
        self.interrupted = interrupted or host.event()
        self.senders: set[int] | None = None
        self.deadline = math.inf
        self.asked_s = 0.0
        self.heard = 0
        self._port = host.port(path, baudrate, timeout=READ_S)
        self._forget()

    @property
    def baudrate(self) -> int:
        """Of this end of the line."""
        return self._port.baudrate

    @property
    def silent_s(self) -> float:
        """Seconds since the last byte, or request."""
        return self.host.now() - self._last

    @property
    def acknowledged(self) -> bool:
        """Whether the last stray byte is ACK."""
        return self._stray == ACK

    @property
    def declined(self) -> bool:
        """Whether the last byte is NAK and nothing followed: amid other bytes it means nothing."""
        return self._stray == NAK and not self._rest and self.silent_s > SILENCE_S

    def set_rate(self, baudrate: int) -> None:
        """Change this end's rate.

        Parameters
        ----------
        baudrate
            Bits a second.

        Raises
        ------
        PortError
            Where the line cannot.
        """
        self.host.set_rate(self._port, baudrate)
        self._forget()

    def close(self) -> None:
        """Give the port back."""
        self._port.close()

    def _forget(self):
        self._rest = b""  # bytes of a telegram that is not whole
        self._stray = None  # the last byte outside of telegrams
        self._last = self.host.now()
        self._kept = []  # arrivals that came with a reply

    def send(self, code: int, data: bytes = b"") -> None:
        """Send a request; what arrived before it is thrown away.

        Parameters
        ----------
        code, data
            Of the request.
        """
        raw = codec.encode_telegram(code, data, address=self.address)
        with line_lost(self.path):
            self._port.reset_input_buffer()
            self._forget()
            if self.baudrate < FASTEST:
                self._port.write(raw)
                return
            for byte in raw:
                self._port.write(bytes([byte]))
                self.host.sleep(PACE_S)

    def receive(self) -> list[Arrival]:
        """The device's telegrams, often none.

        It waits 20 ms at most, longer only while more bytes keep coming. The bytes after a telegram
        tell how much earlier it came.

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
            kept = self._kept
            self._kept = []
            return kept
        missing = 1
        if len(self._rest) >= 4:  # a telegram has begun that states its length
            whole = int.from_bytes(self._rest[2:4], "little") + codec.OVERHEAD
            missing = max(1, whole - len(self._rest))
        with line_lost(self.path):
            data = self._port.read(missing)
            data += self._port.read(self._port.in_waiting)
        if not data:
            return []
        now = self.host.time()
        self._last = self.host.now()
        self.heard += len(data)
        data = self._rest + data
        stream = codec.split_stream(data)
        self._rest = data[stream.pending :]
        arrivals = []
        end = 0
        for begin, length in zip(stream.offset.tolist(), stream.length.tolist(), strict=True):
            self._stray = None
            end = begin + length
            arrived = now - (len(data) - end) * 10 / self.baudrate
            if self.senders is None or data[begin + 1] in self.senders:
                arrivals.append(Arrival(data[begin:end], arrived))
        if stream.pending > end:
            self._stray = data[stream.pending - 1]
        return arrivals

    # ----------------------------------------------------------------------------------------------
    # requests

    def ask(
        self, code: int, data: bytes = b"", *, limit_s: float = math.inf, sign: int | None = None
    ) -> Arrival:
        """Send a request until its reply comes.

        Parameters
        ----------
        code, data
            Of the request.
        limit_s
            Seconds that it may take, beside what the manual allows this request.
        sign
            A reply of this code, too, shows that the request was obeyed; it stays to be received.

        Raises
        ------
        NoReply
            If nothing came in time.
        Refused
            If the device declines.
        LineLost
            If the port vanished.
        """
        again_s, longest_s = PATIENCE.get(code, USUAL)
        end = min(self.host.now() + min(longest_s, limit_s), self.deadline)
        self.asked_s = self.host.time()
        refusal = None
        for _ in range(TRIES):
            self.send(code, data)
            reply, refusal = self._await(code | 0x80, sign, again_s, end)
            if reply is not None:
                return reply
            if self.host.now() > end - NAK_PAUSE_S:
                break
            if refusal:
                self.host.sleep(NAK_PAUSE_S)
        if refusal:
            raise Refused(f"{self.path}: the device refuses command {code:02X}: {refusal}")
        raise NoReply(
            f"{self.path}: no reply to command {code:02X} at {self.baudrate} Bd; is the device on?"
        )

    def _await(self, code, sign, again_s, end):
        """The reply, or None and why the device declined (None: it is time to ask again)."""
        begin = self.host.now()
        patience = NO_ACK_S
        while (now := self.host.now()) < end:
            arrivals = self.receive()
            for at, arrival in enumerate(arrivals):
                if arrival.code == code:
                    self._kept = arrivals[at + 1 :]
                    return arrival, None
                if arrival.code == sign:
                    self._kept = arrivals[at:]
                    return arrival, None
                if arrival.code == NOT_UNDERSTOOD:
                    return None, "not allowed in its present mode, or unknown (92)"
            if self.acknowledged:
                patience = again_s
            if self.declined:
                return None, "it finds the checksum wrong (NAK); the line damages what is sent"
            waited = now - begin
            if waited > patience and (self.silent_s > SILENCE_S or waited > 2 * again_s):
                break
        return None, None

    # ------------------------------------------------------------------------------------------
    # finding the rate

    def find(self, rates: list[int], limit_s: float) -> None:
        """Set the rate at which the device answers, and stop whatever it does.

        Parameters
        ----------
        rates
            To try, in their order, bits a second.
        limit_s
            Seconds that it may take.

        Raises
        ------
        NoReply
            If nothing was heard at any rate.
        WrongDevice
            If only bytes came that make no telegram.
        """
        end = self.host.now() + limit_s
        heard = self.heard
        windows = itertools.cycle(WINDOWS_S)
        while self.host.now() < end:
            window = next(windows)
            for rate in rates:
                if self._answers(rate, window, end):
                    return
        tried = f"{', '.join(map(str, rates))} Bd, address {self.address}"
        if self.address == 0:
            tried += " (any)"
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
        """Whether the device confirms at a rate that it stops streaming.

        Once it acknowledges it gets the time that this may take.
        """
        try:
            self.set_rate(rate)
        except PortError:  # most RS-232 ports lack 500000 Bd
            return False
        begin = self.host.now()
        until = begin + window
        asked = -math.inf
        while (now := self.host.now()) < min(until, end):
            pause = ASK_AGAIN_S
            if self.declined:
                pause = NAK_PAUSE_S
            if now - asked > pause:
                asked = now
                self.send(MODE, ON_REQUEST)
            codes = [arrival.code for arrival in self.receive()]
            if MODE | 0x80 in codes:
                return True
            if codes or self.declined or (self.acknowledged and self.silent_s > 3 * SILENCE_S):
                until = begin + STOPPING_S
        return False

    def hush(self) -> None:
        """See that nothing comes in, else ask again to stop streaming.

        Raises
        ------
        NoReply, LineLost
            If the device does not answer, or the port vanished.
        Refused
            If the stream goes on.
        """
        for _ in range(TRIES):
            end = self.host.now() + 5 * SILENCE_S
            heard = self.heard
            while self.host.now() < end and self.heard == heard:
                self.receive()
            if self.heard == heard:
                return
            self.ask(MODE, ON_REQUEST)
        raise Refused(
            f"{self.path}: the device confirms to stop streaming and goes on; switch it off and on"
        )


@dataclass(frozen=True)
class Reading:
    """A scan with the instants of its beams; neighbours of fine scans are 13.32 ms apart."""

    telegrams: tuple[bytes, ...]  # as sent: one, or the four of a set of interlaced scans
    ranges: np.ndarray  # (B,), metres, NaN where there is no range
    reasons: np.ndarray  # (B,) of uint8, index into `lms2xx_codec.REASONS`, 0 for a range
    bearings: np.ndarray  # (B,), radians in the LRF frame, ascending
    time_s: float  # clock of the host at the first beam
    beam_times_s: np.ndarray  # (B,), the same for every beam
    # of the (first) telegram, modulo 256; -1 where the device does not send them
    scan_index: int
    telegram_index: int


class ScanClock:
    """Instants of scans: arrivals jitter late, the device's index of turns does not.

    Without indices an arrival counts as it is. With them, the earliest of the arrivals of the last
    two seconds ties the count of turns to the host's clock, so that a busy host or a late telegram
    does not shift a scan. A mirror that is off its nominal speed by a part e shifts it by up to 2 e
    seconds.
    """

    def __init__(self):
        self._arrivals = deque()  # turn, counted on, and instant
        self._refused = 0
        self._told = -np.inf

    def place(self, index: int, time_s: float) -> tuple[float | None, int]:
        """Instant of a scan, and turns since the last one.

        Parameters
        ----------
        index
            Counts the turns of the mirror modulo 256; -1 where the device does not send it.
        time_s
            Instant as of its arrival, s.

        Returns
        -------
        instant : float or None
            Seconds; rises from scan to scan. None for a scan that is not newer.
        turns : int
            0 where they are not known.
        """
        if index < 0:
            return time_s, 0
        turn = index
        step = 0
        if self._arrivals:
            elapsed_s = time_s - self._instant()
            if elapsed_s > FORGET_S or self._refused >= STUBBORN:
                self._arrivals.clear()
            else:
                last, _ = self._arrivals[-1]
                step = (index - last) % 256
                step += 256 * round((elapsed_s / MIRROR_TURN - step) / 256)
                if step <= 0 or abs(elapsed_s - step * MIRROR_TURN) >= OFF_S:
                    self._refused += 1
                    return None, 0
                turn = last + step
        self._refused = 0
        self._arrivals.append((turn, time_s))
        while self._arrivals[0][1] < time_s - WINDOW_S:  # never the one that came just now
            self._arrivals.popleft()
        instant = self._instant()
        if instant < self._told - JITTER_S:  # the clock was found to be far ahead
            return None, step
        self._told = max(instant, self._told + LEAST_S)
        return self._told, step

    def _instant(self):
        """Of the last scan, by the earliest arrival of the window."""
        earliest = min(time_s - turn * MIRROR_TURN for turn, time_s in self._arrivals)
        return self._arrivals[-1][0] * MIRROR_TURN + earliest


class Assembler:
    """Readings out of the telegrams of a device, one by one.

    Parameters
    ----------
    variant
        Field of view and resolution, degrees.
    configuration : lms2xx_codec.Configuration
    baudrate
        Bits a second.
    interlaced
        Four partial scans of 180 deg are merged into one of 721 values.
    counts
        'dropped' (scans between two telegrams that were not sent or got lost) and 'stale' are
        counted up.
    clock
        Of the scans before, where the mirror went on turning: an old telegram that comes first is
        then known as such.

    Attributes
    ----------
    turns : int
        Of the mirror, of which one begins a telegram.
    duration_s, interval_s : float
        From the beginning of a telegram to its last byte, and between two of a stream.
    """

    def __init__(
        self,
        variant: tuple[float, float],
        configuration: codec.Configuration,
        baudrate: int,
        interlaced: bool,
        counts: dict[str, int],
        clock: ScanClock,
    ):
        self.configuration = configuration
        self.baudrate = baudrate
        self.interlaced = interlaced
        self.counts = counts
        self._clock = clock
        self._parts: list[Reading] = []
        self._first = True
        view, resolution = variant
        self.values = round(view / resolution) + 1
        self.turns = round(1 / resolution)
        if interlaced:
            self.values = PARTIAL
            self.turns = 1
        size = 10 + 2 * self.values + 2 * configuration.realtime_indices
        scan_s = self.turns * MIRROR_TURN
        self.duration_s = scan_s + transfer_s(size, baudrate)
        self.interval_s = interval_s(size, baudrate, scan_s)

    def feed(self, raw: bytes, arrival_s: float) -> Reading | None:
        """The Reading that a telegram completes.

        Parameters
        ----------
        raw
            With a sound checksum.
        arrival_s
            Instant of its last byte, s.

        Returns
        -------
        Reading or None
            None for a part of a set, and for what is no scan of this variant, unit and kind or is
            not new.
        """
        configuration = self.configuration
        try:
            scan = codec.decode_scan(raw, configuration.measuring_mode)
        except codec.TelegramError:
            return None
        count = scan.words.shape[1]
        index = int(scan.scan_index[0])
        partial = int(scan.partial[0])
        kind = (count + (partial > 0), scan.unit, index >= 0, partial >= 0)
        indexed = configuration.realtime_indices
        if kind != (self.values, configuration.unit, indexed, self.interlaced):
            return None
        begun = arrival_s - transfer_s(len(raw), self.baudrate) - self.turns * MIRROR_TURN
        start_s, step = self._clock.place(index, begun)
        if start_s is None:
            self.counts["stale"] += 1
            return None
        if not self._first:
            self.counts["dropped"] += max(0, step // self.turns - 1)
        self._first = False
        quarters = codec.scan_quarters(count, partial)
        # the first turn begins at 0 deg
        times = start_s + (np.arange(count) % self.turns + quarters / 1440) * MIRROR_TURN
        reading = Reading(
            telegrams=(raw,),
            ranges=np.where(np.isfinite(scan.ranges[0]), scan.ranges[0], np.nan),
            reasons=scan.reasons[0],
            bearings=np.radians(quarters / 4),
            time_s=float(times[0]),
            beam_times_s=times,
            scan_index=index,
            telegram_index=int(scan.telegram_index[0]),
        )
        if self.interlaced:
            return self._merged(partial, reading)
        return reading

    def _merged(self, partial, part):
        """The set of four that a part completes, or None; a missing telegram ends a set.

        The device's own counting tells which parts belong together: the number of the partial scan,
        and the telegram index where it is sent (without it, four that are missing in a row are not
        seen). The instant of arrival tells nothing: a busy machine reads late.
        """
        missing = partial != len(self._parts)
        if self._parts and part.telegram_index >= 0:
            missing |= (part.telegram_index - self._parts[-1].telegram_index) % 256 != 1
        if missing:
            self._parts = []
        if partial == len(self._parts):
            self._parts.append(part)
        if len(self._parts) < 4:
            return None
        parts = self._parts
        self._parts = []
        order = np.argsort(np.concatenate([part.bearings for part in parts]))
        merged = {"telegrams": sum((part.telegrams for part in parts), ())}
        for name in ("ranges", "reasons", "bearings", "beam_times_s"):
            merged[name] = np.concatenate([getattr(part, name) for part in parts])[order]
        return replace(parts[0], **merged)
