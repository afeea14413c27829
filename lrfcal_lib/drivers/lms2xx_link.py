"""The line to an LMS2xx: telegrams with their instants, retries, and the baud rate."""

import itertools
import math
import os
from collections.abc import Collection
from threading import Event
from typing import NamedTuple

from lrfcal_lib.drivers.port import (
    REAL,
    Host,
    NoReply,
    PortError,
    Refused,
    WrongDevice,
    line_lost,
)
from lrfcal_lib.session.files import short
from lrfcal_lib.session.lms2xx_frame import OVERHEAD, encode_telegram, split_stream

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
RATES = {
    38400: 0x40,
    9600: 0x42,
    19200: 0x41,
    500000: 0x48,
}  # and the data of MODE that sets them
FASTEST = 500000  # Bd
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


class Arrival(NamedTuple):
    """A telegram and when its last byte came in, by the host's clock."""

    raw: bytes
    time_s: float

    @property
    def code(self) -> int:
        """Of the reply."""
        return self.raw[4]


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
    interrupted
        Once it is set whoever waits here gets NoReply.
    host
        Machine that the driver runs on.

    Attributes
    ----------
    senders : collection of int
        Address bytes of the replies that count; at first any.
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
        interrupted: Event,
        host: Host = REAL,
    ):
        self.path = path
        self.address = address
        self.host = host
        self._now = host.now
        self.interrupted = interrupted
        self.senders: Collection[int] = range(256)
        self.deadline = math.inf
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
        return self._now() - self._last

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
        self._last = self._now()

    def send(self, code: int, data: bytes = b"") -> None:
        """Send a request; what arrived before it is thrown away.

        Parameters
        ----------
        code, data
            Of the request.
        """
        raw = encode_telegram(code, data, address=self.address)
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
        # bytes 2 and 3 of a telegram that has begun state its length
        size = int.from_bytes(self._rest[2:4], "little") + OVERHEAD
        with line_lost(self.path):
            data = self._port.read(max(1, size - len(self._rest)))
            data += self._port.read(self._port.in_waiting)
        if not data:
            return []
        now = self.host.time()
        self._last = self._now()
        self.heard += len(data)
        data = self._rest + data
        stream = split_stream(data)
        self._rest = data[stream.pending :]
        arrivals = []
        end = 0
        for begin, length in zip(stream.offset, stream.length, strict=True):
            self._stray = None
            end = begin + length
            arrived = now - (len(data) - end) * 10 / self.baudrate
            if data[begin + 1] in self.senders:
                arrivals.append(Arrival(data[begin:end], arrived))
        if stream.pending > end:
            self._stray = data[stream.pending - 1]
        return arrivals

    # ----------------------------------------------------------------------------------------------
    # requests

    def ask(self, code: int, data: bytes = b"", *, limit_s: float = math.inf) -> Arrival:
        """Send a request until its reply comes; what arrives together with it is left out.

        Parameters
        ----------
        code, data
            Of the request.
        limit_s
            Seconds that it may take, beside what the manual allows this request.

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
        end = min(self._now() + min(longest_s, limit_s), self.deadline)
        self.asked_s = self.host.time()
        refusal = None
        for _ in range(TRIES):
            self.send(code, data)
            reply, refusal = self._await(code | 0x80, again_s, end)
            if reply is not None:
                return reply
            if self._now() > end - NAK_PAUSE_S:
                break
            if refusal:
                self.host.sleep(NAK_PAUSE_S)
        if refusal:
            raise Refused(f"{self.path}: the device refuses command {code:02X}: {refusal}")
        raise NoReply(
            f"{self.path}: no reply to command {code:02X} at {self.baudrate} Bd; is the device on?"
        )

    def _await(self, code, again_s, end):
        """The reply, or None and why the device declined (None: it is time to ask again)."""
        begin = self._now()
        patience = NO_ACK_S
        while (now := self._now()) < end:
            for arrival in self.receive():
                if arrival.code == code:
                    return arrival, None
                if arrival.code == NOT_UNDERSTOOD:
                    return None, "not allowed in its present mode, or unknown (92)"
            if self._stray == ACK:
                patience = again_s
            if self.declined:
                return (
                    None,
                    "it finds the checksum wrong (NAK); the line damages what is sent",
                )
            waited = now - begin
            if waited > patience and (self.silent_s > SILENCE_S or waited > 2 * again_s):
                break
        return None, None

    # ------------------------------------------------------------------------------------------
    # finding the rate

    def find(self, first: int, limit_s: float) -> None:
        """Set the rate at which the device answers, and stop whatever it does.

        Parameters
        ----------
        first
            Rate to try before the others, bits a second.
        limit_s
            Seconds that it may take, beside the deadline.

        Raises
        ------
        NoReply
            If nothing was heard at any rate.
        WrongDevice
            If only bytes came that make no telegram.
        """
        end = min(self._now() + limit_s, self.deadline)
        heard = self.heard
        rates = dict.fromkeys([first, *RATES])
        for window in itertools.cycle(WINDOWS_S):
            if self._now() >= end:
                break
            for rate in rates:
                if self._answers(rate, window, end):
                    return
        tried = f"{short(rates)} Bd, address {self.address}"
        if not self.address:
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
        begin = self._now()
        until = begin + window
        asked = -math.inf
        while (now := self._now()) < min(until, end):
            pause = NAK_PAUSE_S if self.declined else ASK_AGAIN_S
            if now - asked > pause:
                asked = now
                self.send(MODE, ON_REQUEST)
            codes = [arrival.code for arrival in self.receive()]
            if MODE | 0x80 in codes:
                return True
            if (
                codes
                or self.declined
                or (self._stray == ACK and self.silent_s > 3 * SILENCE_S)
            ):
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
            end = self._now() + 5 * SILENCE_S
            heard = self.heard
            while self.heard == heard:
                if self._now() >= end:
                    return
                self.receive()
            self.ask(MODE, ON_REQUEST)
        raise Refused(
            f"{self.path}: the device confirms to stop streaming and goes on; switch it off and on"
        )
