"""A SICK LMS2xx: the commands that our driver, sicktoolbox and CARMEN send, and its streams.

The orders of commands of those two programs are in ``tests/test_lms2xx_clients.py``.
"""

import math
import os
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from lrfcal_lib.drivers.lms2xx_scans import BURST
from lrfcal_lib.drivers.port import REAL, Host
from lrfcal_lib.emulators.line import SENDING, SerialDevice
from lrfcal_lib.emulators.lms2xx_memory import (
    BAUD_COMMAND,
    ENCODED,
    INSTALLATION,
    INTERLACED,
    REFLECTIVITY,
    REQUEST,
    STREAMED,
    WRITTEN,
    Memory,
    Selection,
    selection_of,
)
from lrfcal_lib.model.kinematics import MIRROR_TURN
from lrfcal_lib.session import lms2xx_codec as codec
from lrfcal_lib.session.lms2xx_codec import SCAN, largest
from lrfcal_lib.session.lms2xx_frame import encode_telegram, split_stream

ACK = b"\x06"
NAK = b"\x15"
ACK_S = 0.003  # from the last byte of a request to ACK or NAK; the manual allows 60 ms
REPLY_S = 0.065  # to the first byte of a reply, as measured on a real device
WRITE_S = 0.107  # the same where flash is written (measured: 0x77)
RESET_S = 0.010
# most that a change of mode takes longer while streaming (measured: 71 to 588 ms)
STOP_S = 0.52
AHEAD_S = 0.035  # the head reacts more slowly, so the pitch until then is known
# A stream that lags so far leaves scans out, as no host can know how late they are.
LATE_S = 0.5
# values of the first of four interlaced scans; the others have one less
PARTIAL = 181
POWERED_S = 60.0  # how long ago it was switched on
WHITE = 100  # reflectivity of all that answers: the simulated world states none


class Scan(NamedTuple):
    """A scan that is to be sent."""

    turn: int  # of the mirror since power-on, the scan's first; modulo 256 it is the scan index
    partial: int  # 0 to 3 for the quarters of interlaced scans, -1 for whole ones
    words: np.ndarray  # (B,) of uint16, all values of the scan, as the device counts them
    times: np.ndarray  # (B,), instants of the beams


class EmulatedLms(SerialDevice):
    """An LMS2xx, which looks at a source of scans.

    Parameters
    ----------
    source : object
        Has ``scan(turn, quarters, times)``, see :meth:`.world.EmulatedWorld.scan`.
    path
        Of the port to appear.
    seed
        Of its delays.
    host
        Whose time the device lives in.
    boot_s
        From a restart to the power-on string; a real device takes up to 60 s.
    **settings
        Of its `memory`, :class:`Memory`: model, variant, configuration, baudrate, address, ...

    Attributes
    ----------
    telegrams : int
        Scans counted since power-on.
    """

    gap_s = 0.006  # a host that pauses longer within a telegram is not heard

    def __init__(
        self,
        source,
        *,
        path: str | os.PathLike,
        seed: int = 0,
        host: Host = REAL,
        boot_s: float = 2.0,
        **settings,
    ):
        super().__init__(path, host, seed)
        self.memory = Memory(**settings)
        self.source = source
        self.boot_s = boot_s
        self.telegrams = 0
        self._rng = np.random.default_rng([seed, 1])
        self._booting = False
        self._effect: Callable | None = None  # of the command whose reply is on its way
        self._zero = host.now() - POWERED_S  # when turns of the mirror are counted from
        self._selection = Selection()

    @property
    def baudrate(self) -> int:
        """Of the device now."""
        return self.memory.baudrate

    @property
    def streaming(self) -> bool:
        """Whether scans come."""
        return self.memory.mode in STREAMED

    # --------------------------------------------------------------------- bytes from the host

    def take(self, raw: bytes, at: float) -> int:
        """Hear the telegrams of the host.

        Parameters
        ----------
        raw
            Of any number of telegrams, whole or not.
        at
            Instant of the last of its bytes, s.

        Returns
        -------
        int
            From where on bytes must be kept.
        """
        stream = split_stream(raw, replies=False)
        for offset, length in zip(stream.offset, stream.length, strict=True):
            self.heard(raw[offset : offset + length], at)
        if len(stream.rejected) and not len(stream.offset):
            self.heard(raw[stream.rejected[0] :], at, sound=False)
        return stream.pending

    def heard(self, raw: bytes, at: float, sound: bool = True) -> None:
        """Acknowledge a telegram and do what it says.

        It interrupts what is being sent, and undoes no command.

        Parameters
        ----------
        raw
            The telegram.
        at
            Instant of its last byte, s.
        sound
            Its checksum is right.
        """
        if raw[1] not in (0, self.memory.address) or self._booting:
            return
        self.abort()
        if not sound:
            self.write(NAK, at + ACK_S, self._finish)
            return
        self.write(ACK, at + ACK_S)
        self.obey(raw[4], raw[5:-2], at)

    def obey(self, code: int, data: bytes, at: float) -> None:
        """Do what a telegram says, and answer it.

        Parameters
        ----------
        code, data
            Of the telegram.
        at
            Instant of its last byte, s.
        """
        memory = self.memory
        match code, data:
            case 0x10, _:
                self.answer(
                    at,
                    0x91,
                    effect=lambda told: self.at(told + RESET_S, self.restart),
                    delay=ACK_S + 0.001,
                )
            case 0x20, _:
                self.set_mode(data, at)
            case 0x30, b"\x01" if not self._selection.head:
                # the scan that is being measured when the request is whole
                self._stream_from(at + ACK_S + 2 * self.byte_s)
                before = self._turn - memory.turns
                self._measure(before, -1, partial(self.emit, then=self._finish))
            case _ if (reply := memory.reply(code, data)) is not None:
                delay = WRITE_S if code in WRITTEN else REPLY_S
                self.answer(at, 0x80 | code, reply, delay=delay)
            case _:
                self.answer(at, 0x92)

    def set_mode(self, data: bytes, at: float) -> None:
        """Change the rate, when the reply has left, or the mode, which takes longer in a stream.

        Parameters
        ----------
        data
            Of command 0x20.
        at
            Instant of the last byte of the telegram, s.
        """
        memory = self.memory
        mode = int.from_bytes(data[:1])
        parameters = data[1:]
        selection = selection_of(mode, parameters)
        rate = BAUD_COMMAND.get(mode)

        def set_rate(_):
            memory.baudrate = rate

        if selection is None:
            self.answer(at, 0x92)
        elif rate in memory.baudrates:
            self.answer(at, 0xA0, b"\0", set_rate)
        elif rate:
            self.answer(at, 0xA0, b"\2")  # a fault
        elif mode == INSTALLATION and parameters != memory.password:
            self.answer(at, 0xA0, b"\1")  # wrong
        else:
            delay = REPLY_S + self._rng.uniform(0, 0.02)
            if self.streaming:
                delay += self._rng.uniform(0, STOP_S)
            memory.mode = mode
            self._selection = selection
            self.answer(at, 0xA0, b"\0", delay=delay)

    # ---------------------------------------------------------------------------------- replies

    def answer(
        self,
        at: float,
        code: int,
        data: bytes = b"",
        effect: Callable[[float], None] | None = None,
        delay: float = REPLY_S,
    ) -> None:
        """Send a reply after a delay; streaming goes on when it is out.

        Parameters
        ----------
        at
            Instant of the last byte of the request, s.
        code, data
            Of the reply.
        effect
            ``effect(instant)`` is called when the reply is out.
        delay
            Seconds.
        """
        if effect is not None:  # else that of the command whose reply this one interrupted
            self._effect = effect
        raw = encode_telegram(code, data, address=0x80 | self.memory.address)
        self.at(at + delay, partial(self.reply, raw, then=self._finish), SENDING)

    def _finish(self, at):
        """A reply is out: do what is left of the command, and stream from the next scan on."""
        if self._effect is not None:
            self._effect(at)
            self._effect = None
        if self.streaming:
            self._stream_from(at)
            self._plan()

    def reply(
        self, raw: bytes, at: float, then: Callable[[float], None] | None = None
    ) -> None:
        """Send a reply; at most 508 bytes leave in one turn of the mirror, as shows at 500000 Bd.

        Parameters
        ----------
        raw
            The telegram.
        at
            Instant from which it may leave, s.
        then
            ``then(instant)`` is called when the last byte is out.
        """
        for burst, first in enumerate(range(0, len(raw), BURST)):
            self.write(raw[first : first + BURST], at + burst * MIRROR_TURN)
        self.write(b"", at, then)

    def restart(self, at: float) -> None:
        """Fall silent, with variant and rate of the factory; tell at the end that it is ready.

        Parameters
        ----------
        at
            The present instant, s.
        """
        memory = self.memory
        self.abort()
        self._booting = True
        self._effect = None
        self._selection = Selection()
        memory.mode = REQUEST
        memory.baudrate = 9600
        memory.variant = (memory.widest, 50)
        self.at(at + self.boot_s, self._ready)

    def _ready(self, at):
        self._booting = False
        self._zero = at
        self.telegrams = 0
        self.answer(at, 0x90, self.memory.model.encode(), delay=0.0)

    # ------------------------------------------------------------------------------------ scans

    def _stream_from(self, instant):
        """The next scan of the stream is the one that begins after an instant."""
        turns = self._turns
        self._partial = 0
        self._turn = math.ceil((instant - self._zero) / MIRROR_TURN / turns) * turns

    @property
    def _turns(self):
        """Turns of the mirror for a telegram of the stream."""
        if self.memory.mode == INTERLACED:
            return 1
        return self._selection.scans * self.memory.turns

    def _measure(self, turn, part, send):
        """Send the scan that begins at a turn at its end.

        It is cast a little ahead, which may take a while.
        """
        memory = self.memory
        angle, step = memory.variant
        turns = memory.turns
        values = angle * 100 // step + 1
        if part >= 0:
            turns = 1
            values = PARTIAL - (part > 0)
        scans = self._selection.scans
        end = self._zero + (turn + turns * scans) * MIRROR_TURN

        def ahead(_):
            """Cast the scan, or those of a mean, and send it at its end."""
            quarters = codec.scan_quarters(values, part)
            # turns since the first began
            after = np.arange(values) % turns + quarters / 1440
            times = self._zero + (turn + after) * MIRROR_TURN
            cast = [
                self.source.scan(turn + later, quarters, times + later * MIRROR_TURN)
                for later in range(0, turns * scans, turns)
            ]
            ranges, reasons = map(np.array, zip(*cast, strict=True))
            words = codec.encode_values(
                ranges.mean(axis=0),
                unit=memory.configuration.unit,
                mode=ENCODED[memory.configuration.measuring_mode],
                # of a mean, too: one scan without a range leaves none
                reasons=reasons.max(axis=0),
            )
            self.at(end, partial(send, Scan(turn, part, words, times)), SENDING)

        self.at(end - AHEAD_S, ahead, SENDING)

    def emit(
        self, scan: Scan, at: float, then: Callable[[float], None] | None = None
    ) -> None:
        """Send a scan.

        Parameters
        ----------
        scan
        at
            Instant from which it may leave, s.
        then
            ``then(instant)`` is called when the last byte is out.
        """
        self.reply(self.telegram(scan), at, then)
        self.telegrams += 1

    def telegram(self, scan: Scan) -> bytes:
        """What the mode tells of a scan.

        Parameters
        ----------
        scan
        """
        memory = self.memory
        configuration = memory.configuration
        words = scan.words[self._selection.first - 1 : self._selection.last]
        if memory.mode == REFLECTIVITY:  # behind every range
            answered = words <= largest(ENCODED[configuration.measuring_mode])
            words = np.stack([words, WHITE * answered], axis=1)
        indices = (scan.turn, self.telegrams) if configuration.realtime_indices else None
        return codec.encode_words(
            words,
            unit=configuration.unit,
            partial=scan.partial,
            indices=indices,
            address=0x80 | memory.address,
            code=STREAMED.get(memory.mode, SCAN),
            head=self._selection.head,
        )

    def _plan(self):
        """Measure the next scan of the stream; of one that lags, some are left out.

        The indices show the gap.
        """
        late = self.host.now() - self._zero - (self._turn + self._turns) * MIRROR_TURN
        if late > LATE_S:
            self.telegrams += 1
            self._stream_from(self.host.now())
        part = -1
        if self.memory.mode == INTERLACED:
            # which there are depends on the resolution that is set
            part = self._partial * self.memory.variant[1] % 100 // 25
            self._partial += 1
        self._measure(self._turn, part, self._next)

    def _next(self, scan, at):
        """A scan of the stream is complete: send it unless the line is busy, and plan the next.

        As many whole scans pass as the transfer needs (manual, table 10-17).
        """
        if self.busy_until > at + 1e-9:
            self.telegrams += 1
        else:
            self.emit(scan, at)
        sending_s = len(self.telegram(scan)) * self.byte_s
        self._turn += math.ceil(sending_s / (self._turns * MIRROR_TURN)) * self._turns
        self._plan()
