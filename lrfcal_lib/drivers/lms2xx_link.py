"""The line to an LMS2xx: telegrams out and in with the times at which they arrived, retries, finding the baud rate.

Only sound telegrams come through; everything else on the line (acknowledgements, garbage, echo) is skipped and counted.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

from lrfcal_lib.drivers.errors import NoReply, PortError, Refused, WrongDevice
from lrfcal_lib.drivers.host import REAL
from lrfcal_lib.drivers.lms2xx import OVERHEAD, encode_telegram, split_stream
from lrfcal_lib.drivers.serial_port import line_lost

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
