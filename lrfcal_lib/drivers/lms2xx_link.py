"""The line to an LMS2xx: telegrams with their instants, retries, the baud rate, scans on request
and as a stream.
"""

import itertools
import math
from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lrfcal_lib.drivers.port import REAL, NoReply, PortError, Refused, WrongDevice, line_lost
from lrfcal_lib.session import lms2xx_codec as codec

ACK = 0x06
NAK = 0x15
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
TURN_S = 0.01332  # of the mirror
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


class Arrival(NamedTuple):
    """A telegram and when its last byte came in, by the host's clock."""

    raw: bytes
    time_s: float

    @property
    def code(self):
        """Of the reply."""
        return self.raw[4]


def transfer_s(size, baudrate):
    """Seconds from the first byte of a scan to its last (manual, 10.10.2: bursts of 508 bytes a
    turn at 500 kBd).
    """
    turns = (size - 1) // BURST if baudrate == 500000 else 0
    return turns * TURN_S + (size - turns * BURST) * 10 / baudrate


def interval_s(size, baudrate, scan_s):
    """Seconds between two scans of a stream: whole scans pass while one is sent (manual, table
    10-17).
    """
    return math.ceil(size * 10 / baudrate / scan_s - 1e-9) * scan_s


class Link:
    """An open port with an LMS2xx at its other end.

    Address 0 reaches any device; once the event `interrupted` is set, whoever waits here gets
    NoReply. Replies count whose address byte is among `senders` (None: any), no request lasts
    beyond `deadline` (by ``host.now()``), `asked_s` is the instant by the clock at which the last
    one was sent for the first time, and `heard` counts bytes of any kind.
    """

    def __init__(self, path, baudrate, *, address=0, interrupted=None, host=REAL):
        self.path = path
        self.address = address
        self.host = host
        self.interrupted = interrupted or host.event()
        self.senders = None
        self.deadline = math.inf
        self.asked_s = 0.0
        self.heard = 0
        self._port = host.port(path, baudrate, timeout=READ_S)
        self._forget()

    @property
    def baudrate(self):
        """Of this end of the line."""
        return self._port.baudrate

    @property
    def silent_s(self):
        """Seconds since the last byte, or request."""
        return self.host.now() - self._last

    @property
    def acknowledged(self):
        """Whether the last stray byte is ACK."""
        return self._stray == ACK

    @property
    def declined(self):
        """Whether the last byte is NAK and nothing followed; amid other bytes 0x15 means
        nothing.
        """
        return self._stray == NAK and not self._rest and self.silent_s > SILENCE_S

    def set_rate(self, baudrate):
        """Change this end's rate; raises PortError where the line cannot."""
        self.host.set_rate(self._port, baudrate)
        self._forget()

    def close(self):
        """Give the port back."""
        self._port.close()

    def _forget(self):
        self._rest = b""
        self._stray = None
        self._last = self.host.now()
        self._kept = []

    def send(self, code, data=b""):
        """Send a request; what arrived before it is thrown away."""
        raw = codec.encode_telegram(code, data, address=self.address)
        step, pause = (1, PACE_S) if self.baudrate == 500000 else (len(raw), 0)
        with line_lost(self.path):
            self._port.reset_input_buffer()
            self._forget()
            for at in range(0, len(raw), step):
                self._port.write(raw[at : at + step])
                self.host.sleep(pause)

    def receive(self):
        """The device's telegrams, often none; waits 20 ms at most, longer only while more bytes
        keep coming.

        The bytes after a telegram tell how much earlier it came. Raises LineLost if the port
        vanished, NoReply if somebody set `interrupted`.
        """
        if self.interrupted.is_set():
            raise NoReply(f"{self.path}: waiting was interrupted")
        if self._kept:
            kept = self._kept
            self._kept = []
            return kept
        whole = 0  # bytes of the telegram that has begun
        if len(self._rest) >= 4:
            whole = int.from_bytes(self._rest[2:4], "little") + codec.OVERHEAD
        with line_lost(self.path):
            data = self._port.read(max(1, whole - len(self._rest)))
            data += self._port.read(self._port.in_waiting)
        if not data:
            return []
        now = self.host.time()
        self._last = self.host.now()
        self.heard += len(data)
        data = self._rest + data
        stream = codec.split_stream(data)
        ends = (stream.offset + stream.length).tolist()
        stray = data[ends[-1] if ends else 0 : stream.pending]
        self._stray = stray[-1] if stray else None if ends else self._stray
        self._rest = data[stream.pending :]
        spans = zip(stream.offset.tolist(), ends, strict=True)
        found = [
            Arrival(data[begin:end], now - (len(data) - end) * 10 / self.baudrate)
            for begin, end in spans
        ]
        return [one for one in found if self.senders is None or one.raw[1] in self.senders]

    # ----------------------------------------------------------------------------------------------
    # requests

    def ask(self, code, data=b"", *, limit_s=math.inf, sign=None):
        """Send a request until its reply comes, within `limit_s` and what the manual allows this
        request.

        A reply of the code `sign`, too, shows that the request was obeyed; it stays to be received.
        Raises NoReply, Refused or LineLost.
        """
        again_s, longest_s = PATIENCE.get(code, USUAL)
        end = min(self.host.now() + min(longest_s, limit_s), self.deadline)
        said = None
        self.asked_s = self.host.time()
        for _ in range(TRIES):
            self.send(code, data)
            reply, said = self._await(code | 0x80, sign, again_s, end)
            if reply is not None:
                return reply
            if self.host.now() > end - NAK_PAUSE_S:
                break
            if said:
                self.host.sleep(NAK_PAUSE_S)
        if said:
            raise Refused(f"{self.path}: the device refuses command {code:02X}: {said}")
        raise NoReply(
            f"{self.path}: no reply to command {code:02X} at {self.baudrate} Bd; is the device on?"
        )

    def _await(self, code, sign, again_s, end):
        """The reply, or None and why the device declined (None if it said nothing until it is time
        to ask again).
        """
        begin = self.host.now()
        acknowledged = False
        while (now := self.host.now()) < end:
            found = self.receive()
            for at, one in enumerate(found):
                if one.code in (code, sign):
                    self._kept = found[at + (one.code == code) :]
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

    # ------------------------------------------------------------------------------------------
    # finding the rate

    def find(self, rates, limit_s):
        """Set the rate, of those to try in their order, at which the device answers, and stop
        whatever it does.

        Raises NoReply if nothing was heard at any rate, WrongDevice if only bytes that make no
        telegram.
        """
        end = self.host.now() + limit_s
        heard = self.heard
        windows = itertools.cycle(WINDOWS_S)
        while self.host.now() < end:
            window = next(windows)
            if any(self._answers(rate, window, end) for rate in rates):
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
        """Whether the device confirms at a rate that it stops streaming; once it acknowledges it
        gets 3 s for that.
        """
        try:
            self.set_rate(rate)
        except PortError:  # most RS-232 ports lack 500000 Bd
            return False
        begin = self.host.now()
        sent = -math.inf
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

    def hush(self):
        """See that nothing comes in, else ask again to stop streaming; raises NoReply, Refused or
        LineLost.
        """
        for _ in range(TRIES):
            begin = self.host.now()
            heard = self.heard
            while self.host.now() < begin + 5 * SILENCE_S and self.heard == heard:
                self.receive()
            if self.heard == heard:
                return
            self.ask(MODE, ON_REQUEST)
        raise Refused(
            f"{self.path}: the device confirms to stop streaming and goes on; switch it off and on"
        )


POINTS = {(100, 1.0): 101, (100, 0.5): 201, (100, 0.25): 401, (180, 1.0): 181, (180, 0.5): 361}
WINDOW_S = 2.0  # arrivals in the last so many seconds tell the host's clock from the device's
OFF_S = 1.2  # how far a scan may arrive off its expected instant
# corrections of the clock up to this are spread over scans; at larger ones scans are left out
JITTER_S = 0.05
LEAST_S = TURN_S / 100  # between two instants told; far less than between two scans
FORGET_S = 30.0  # after such a pause the number of turns in between is not known
STUBBORN = 5  # so many implausible scan indices in a row: the device counts anew


@dataclass(frozen=True)
class Reading:
    """A scan with the instants of its beams; neighbours of fine scans are 13.32 ms apart."""

    telegrams: tuple[bytes, ...]  # as sent: one, or the four of a set of interlaced scans
    ranges: np.ndarray  # (B,), metres, NaN where there is no range
    reasons: np.ndarray  # (B,) of uint8, index into `lms2xx_codec.REASONS`, 0 for a range
    bearings: np.ndarray  # (B,), radians in the LRF frame, ascending
    time_s: float  # clock of the host at the first beam
    beam_times_s: np.ndarray  # (B,), the same for every beam
    # of the (first) telegram, modulo 256; None where the device does not send them
    scan_index: int | None
    telegram_index: int | None


class ScanClock:
    """Instants of scans: arrivals jitter late, the device's index of turns does not.

    Without indices an arrival counts as it is. With them, the earliest of the arrivals of the last
    two seconds ties the count of turns to the host's clock, so that a busy host or a late telegram
    does not shift a scan. A mirror that is off its nominal speed by a part e shifts it by up to 2 e
    seconds.
    """

    def __init__(self):
        self._seen = deque()
        self._refused = 0
        self._told = -np.inf

    def place(self, index, time_s):
        """Instant of a scan, and turns since the last one.

        `index` counts the turns of the mirror modulo 256 and is -1 where the device does not send
        it, `time_s` is the instant as of its arrival. Instants rise from scan to scan; that of a
        scan that is not newer is None. The turns are 0 where they are not known.
        """
        if index < 0:
            return time_s, 0
        turn = index
        step = 0
        if self._seen:
            elapsed_s = time_s - self._instant()
            if elapsed_s > FORGET_S or self._refused >= STUBBORN:
                self._seen.clear()
            else:
                step = (index - self._seen[-1][0]) % 256
                step += 256 * round((elapsed_s / TURN_S - step) / 256)
                if step <= 0 or abs(elapsed_s - step * TURN_S) >= OFF_S:
                    self._refused += 1
                    return None, 0
                turn = self._seen[-1][0] + step
        self._refused = 0
        self._seen.append((turn, time_s))
        while self._seen[0][1] < time_s - WINDOW_S and len(self._seen) > 1:
            self._seen.popleft()
        instant = self._instant()
        if instant < self._told - JITTER_S:  # the clock was found to be far ahead
            return None, step
        self._told = max(instant, self._told + LEAST_S)
        return self._told, step

    def _instant(self):
        """Of the last scan, by the earliest arrival of the window."""
        earliest = min(time_s - turn * TURN_S for turn, time_s in self._seen)
        return self._seen[-1][0] * TURN_S + earliest


class Assembler:
    """Readings out of the telegrams of a variant (field of view and resolution, degrees), one by
    one.

    With `interlaced` four partial scans of 180 deg are merged into one of 721 values. 'dropped'
    (scans between two telegrams that were not sent or got lost) and 'stale' are counted up. The
    clock is that of the scans before, where the mirror went on turning: an old telegram that comes
    first is then known as such. One turn in `turns` begins a telegram, which takes `duration_s`
    from its beginning to its last byte; `interval_s` is that of a stream.
    """

    def __init__(self, variant, configuration, baudrate, interlaced, counts, clock=None):
        self.variant = variant
        self.configuration = configuration
        self.baudrate = baudrate
        self.interlaced = interlaced
        self.counts = counts
        self._clock = clock or ScanClock()
        self._parts = []
        self._first = True
        self.turns = 1 if interlaced else round(1 / variant[1])
        values = 181 if interlaced else POINTS[variant]
        size = 10 + 2 * values + 2 * configuration.realtime_indices
        self.duration_s = self.turns * TURN_S + transfer_s(size, baudrate)
        self.interval_s = interval_s(size, baudrate, self.turns * TURN_S)

    def feed(self, raw, arrival_s):
        """The Reading that a telegram with a sound checksum completes, whose last byte came at an
        instant.

        None for a part of a set, and for what is no scan of this variant, unit and kind or is not
        new.
        """
        own = self.configuration
        try:
            scan = codec.decode_scan(raw, own.measuring_mode)
        except codec.TelegramError:
            return None
        count = scan.words.shape[1]
        index = int(scan.scan_index[0])
        partial = int(scan.partial[0])
        wanted = 181 - (partial > 0) if self.interlaced else POINTS[self.variant]
        kind = (count, scan.unit, index >= 0, partial >= 0)
        if kind != (wanted, own.unit, own.realtime_indices, self.interlaced):
            return None
        start_s = arrival_s - transfer_s(len(raw), self.baudrate) - self.turns * TURN_S
        start_s, step = self._clock.place(index, start_s)
        if start_s is None:
            self.counts["stale"] += 1
            return None
        self.counts["dropped"] += 0 if self._first else max(0, step // self.turns - 1)
        self._first = False
        quarters = codec.scan_quarters(count, partial)
        # the first turn begins at 0 deg
        times = start_s + (np.arange(count) % self.turns + quarters / 1440) * TURN_S
        ranges = np.where(np.isfinite(scan.ranges[0]), scan.ranges[0], np.nan)
        indices = [None if i < 0 else int(i) for i in (index, scan.telegram_index[0])]
        one = Reading(
            (raw,),
            ranges,
            scan.reasons[0],
            np.radians(quarters / 4),
            float(times[0]),
            times,
            *indices,
        )
        return self._merged(partial, one) if self.interlaced else one

    def _merged(self, partial, part):
        """The set of four that a part completes, or None; a missing telegram ends a set.

        The device's own counting tells which parts belong together: the number of the partial scan,
        and the telegram index where it is sent (without it, four that are missing in a row are not
        seen). The instant of arrival tells nothing: a busy machine reads late.
        """
        missing = partial != len(self._parts)
        if self._parts and part.telegram_index is not None:
            missing |= (part.telegram_index - self._parts[-1].telegram_index) % 256 != 1
        if missing:
            self._parts = []
        if partial == len(self._parts):
            self._parts.append(part)
        if len(self._parts) < 4:
            return None
        parts = self._parts
        self._parts = []
        order = np.argsort(np.concatenate([one.bearings for one in parts]))
        columns = {
            name: np.concatenate([getattr(one, name) for one in parts])[order]
            for name in ("ranges", "reasons", "bearings", "beam_times_s")
        }
        return replace(
            parts[0], telegrams=tuple(t for one in parts for t in one.telegrams), **columns
        )
