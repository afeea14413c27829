"""A SICK LMS2xx: the commands that our driver, sicktoolbox and CARMEN send, and its streams.

The orders of commands of those two programs are in ``tests/test_lms2xx_clients.py``.
"""

import logging
import math
from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from lrfcal_lib.drivers.lms2xx_link import BURST
from lrfcal_lib.drivers.port import REAL
from lrfcal_lib.emulators.line import SerialDevice
from lrfcal_lib.model.kinematics import MIRROR_TURN
from lrfcal_lib.session import lms2xx_codec as codec
from lrfcal_lib.session.lms2xx_codec import (
    MODES,
    UNITS,
    Configuration,
    encode_telegram,
)
from lrfcal_lib.simulate.beam import VARIANTS

LOG = logging.getLogger(__name__)
ACK = b"\x06"
NAK = b"\x15"
ACK_S = 0.003  # from the last byte of a request to ACK or NAK; the manual allows 60 ms
REPLY_S = 0.065  # to the first byte of a reply, as measured on a real device
WRITE_S = 0.107  # the same where flash is written (measured: 0x77)
RESET_S = 0.010
STOP_S = 0.52  # most that a change of mode takes longer while streaming (measured: 71 to 588 ms)
GAP_S = 0.006  # a host that pauses longer within a telegram is not heard
AHEAD_S = 0.035  # the head reacts more slowly, so the pitch until then is known
# A stream that lags so far leaves scans out, as no host can know how late they are.
LATE_S = 1.0
LATE_AGAIN_S = 0.1  # once it did
POWERED_S = 60.0  # how long ago it was switched on
KEPT = 20000  # scans and requests on record
BAUD_WORD = {9600: 0x8067, 19200: 0x8033, 38400: 0x8019, 500000: 0x8001}
BAUD_COMMAND = {0x40: 38400, 0x41: 19200, 0x42: 9600, 0x48: 500000}
# operating modes
INSTALLATION = 0x00
DIAGNOSIS = 0x10
STREAM = 0x24
REQUEST = 0x25
MEAN = 0x26
PART = 0x27
INTERLACED = 0x2A
REFLECTIVITY = 0x2B
# bytes of their parameters (manual, 7.2): password; scans; first and last value; parts and these
PARAMETERS = {
    INSTALLATION: 8,
    DIAGNOSIS: 0,
    STREAM: 0,
    REQUEST: 0,
    MEAN: 1,
    PART: 4,
    INTERLACED: 0,
    REFLECTIVITY: 6,
}
# code of the telegrams that they send
STREAMED = {STREAM: 0xB0, MEAN: 0xB6, PART: 0xB7, INTERLACED: 0xB0, REFLECTIVITY: 0xF5}
SCANS = range(2, 251)  # of a mean
LAST = 401  # value that can be asked for; there may be fewer
# as which mode a measuring mode encodes ranges; 13 and 14, remission, are those that CARMEN sets
ENCODED = dict(zip(MODES, MODES, strict=True)) | {13: 0, 14: 0}
WHITE = 100  # reflectivity of all that answers: the simulated world states none
# results of command 0x20
DONE = b"\0"
WRONG = b"\1"
FAULT = b"\2"


@dataclass(frozen=True)
class Told:
    """What a mode tells of the scans; by default all."""

    head: bytes = b""  # of its telegrams: the parameters of the mode
    first: int = 1  # value that is told, counted from 1
    last: int = LAST
    scans: int = 1  # whose mean is told


@dataclass(frozen=True)
class ScanRecord:
    """A scan that was sent."""

    number: int  # running
    turn: int  # of the mirror since power-on, the scan's first; modulo 256 it is the scan index
    telegram_index: int
    time_s: float  # clock of the host at the first beam
    beam_times_s: np.ndarray  # (B,), the same at every beam
    pitch_rad: np.ndarray  # (2,), true, at the earliest and the latest beam; NaN without a head
    partial: int  # 0 to 3 for the quarters of interlaced scans, -1 for whole ones
    words: np.ndarray  # (B,) of uint16, all values of the scan, as the device counts them
    telegram: bytes


@dataclass
class Memory:
    """Settings of the device."""

    model: str = "LMS221;302063;X01.27 "  # 21 characters, the answer to the type request
    variant: tuple[int, int] = (180, 50)  # degrees and 1/100 degree
    configuration: Configuration = field(default_factory=Configuration)
    baudrate: int = 9600
    mode: int = REQUEST  # operating mode, the sub-command of 0x20
    address: int = 0
    password: bytes = b"SICK_LMS"
    flash_writes: int = 0  # since the device was made; the flash endures a few thousand

    def takes_variant(self, variant):
        """Whether the device offers a variant."""
        return variant in VARIANTS and not (self.narrow and variant[0] == 180)

    @property
    def narrow(self):
        """Whether it sees 100 deg only."""
        return self.model.startswith("LMS211")

    def write_configuration(self, block):
        """Take a configuration of 32 to 34 bytes; whether its values are possible."""
        block = bytes(block) + self.configuration.block[len(block) : codec.CONFIGURATION_BYTES]
        if block[5] not in ENCODED or block[6] >= len(UNITS):
            return False
        self.configuration = Configuration(block)
        self.flash_writes += 1
        return True

    def status_data(self):
        """Data of the status reply 0xB1; offsets count from its code. What no driver reads is 0."""
        c = self.configuration
        parts = {
            1: self.model[14:21].encode(),
            8: bytes([self.mode]),
            102: bytes([c.measuring_mode]),
            107: words_of(self.variant),
            116: words_of([BAUD_WORD[self.baudrate]]),
            120: bytes([self.address, 1]),
            122: bytes([UNITS.index(c.unit), 1]),
        }
        data = bytearray(153)
        for at, part in parts.items():
            data[at : at + len(part)] = part
        return bytes(data[1:])


def words_of(numbers):
    """16-bit numbers as bytes."""
    return np.array(numbers, "<u2").tobytes()


class EmulatedLms(SerialDevice):
    """An LMS2xx, which looks at a source of scans.

    Parameters
    ----------
    source : object
        Has ``scan(turn, quarters, times)``, see :meth:`.world.EmulatedWorld.scan`.
    path : path-like
        Of the port to appear.
    seed : int
    host : Host
        Whose time the device lives in.
    boot_s : float
        From a restart to the power-on string; a real device takes up to 60 s.
    baudrates : tuple of int
        That the line allows; RS-232 ends at 38400.
    **settings
        Of its `memory`, :class:`Memory`: model, variant, configuration, baudrate, address, ...

    Attributes
    ----------
    scans : deque of ScanRecord
        The newest 20000.
    requests : deque of (float, bytes)
        Host time and sound telegrams from the host.
    telegrams : int
        Scans counted since power-on.
    left_out : int
        Times that a stream left scans out, as this machine is too slow to cast them in time: a
        moving head needs some 20 ms of its processor for a scan.
    """

    @property
    def baudrate(self):
        """Of the device now."""
        return self.memory.baudrate

    @property
    def streaming(self):
        """Whether scans come."""
        return self.memory.mode in STREAMED

    def __init__(
        self,
        source,
        *,
        path,
        seed=0,
        host=REAL,
        boot_s=2.0,
        baudrates=(*BAUD_WORD,),
        **settings,
    ):
        super().__init__(path, host, seed)
        self.memory = Memory(**settings)
        self.source = source
        self.boot_s = boot_s
        self.baudrates = baudrates
        self.rng = np.random.default_rng([seed, 1])
        self.scans = deque(maxlen=KEPT)
        self.requests = deque(maxlen=KEPT)
        self.telegrams = 0
        self.left_out = 0
        self._buffer = b""  # bytes of a request that is not whole
        self._booting = False
        self._effect = None  # of the command whose reply is on its way
        self._zero = host.now() - POWERED_S  # when turns of the mirror are counted from
        self._number = 0  # of the next scan
        self._told = Told()
        # of the next scan of the stream
        self._turn = 0
        self._partial = 0

    # --------------------------------------------------------------------- bytes from the host

    def receive(self, data, at):
        """Bytes of the host; the last of them arrived at an instant."""
        self.cancel("gap")
        raw = self._buffer + data
        stream = codec.split_stream(raw, replies=False)
        self._buffer = raw[stream.pending :]
        for offset, length in zip(stream.offset.tolist(), stream.length.tolist(), strict=True):
            self.heard(raw[offset : offset + length], at)
        if len(stream.rejected) and not len(stream.offset):
            self.heard(raw[stream.rejected[0] :], at, sound=False)
        if self._buffer:
            self.at(at + GAP_S, lambda _: setattr(self, "_buffer", b""), "gap")

    def heard(self, raw, at, sound=True):
        """Acknowledge a telegram and do what it says.

        It interrupts what is being sent, and undoes no command.
        """
        if raw[1] not in (0, self.memory.address) or self._booting:
            return None
        self.cancel("reply", "stream")
        self.abort()
        if not sound:
            return self.write(NAK, at + ACK_S, self._finish)
        self.write(ACK, at + ACK_S)
        self.requests.append((self.host.time(), raw))
        return self.obey(codec.parse_telegram(raw), at)

    def obey(self, telegram, at):
        """Do what a telegram says, and answer it."""
        memory = self.memory
        match telegram.code, telegram.data:
            case 0x10, _:
                self.answer(at, 0x91, effect=self._begin_restart, delay=ACK_S + 0.001)
            case 0x20, data:
                self.set_mode(data, at)
            case 0x30, b"\x01" if not self._told.head:
                self._request(at + ACK_S + 2 * self.byte_s)
            case 0x31, _:
                self.answer(at, 0xB1, memory.status_data())
            case 0x32, _:
                self.answer(at, 0xB2)
            case 0x3A, _:
                self.answer(at, 0xBA, memory.model.encode())
            case 0x3B, data if len(data) == 4:  # nothing is streamed while the variant changes
                asked = tuple(np.frombuffer(data, "<u2").tolist())
                taken = memory.takes_variant(asked)
                if taken:
                    memory.variant = asked
                self.answer(at, 0xBB, bytes([taken]) + words_of(memory.variant), delay=WRITE_S)
            case 0x74, _:
                self.answer(at, 0xF4, memory.configuration.block)
            case 0x77, data if 32 <= len(data) <= 34 and memory.mode == INSTALLATION:
                taken = memory.write_configuration(data)
                block = memory.configuration.block
                self.answer(at, 0xF7, bytes([taken]) + block, delay=WRITE_S)
            case _:
                self.answer(at, 0x92)

    def set_mode(self, data, at):
        """Change the rate, when the reply has left, or the mode, which takes longer in a stream."""
        memory = self.memory
        mode = int.from_bytes(data[:1])
        if mode in BAUD_COMMAND and len(data) == 1:
            rate = BAUD_COMMAND[mode]
            if rate not in self.baudrates:
                return self.answer(at, 0xA0, FAULT)
            return self.answer(at, 0xA0, DONE, lambda _: setattr(memory, "baudrate", rate))
        parameters = data[1:]
        if len(parameters) != PARAMETERS.get(mode):
            return self.answer(at, 0x92)
        if mode == INSTALLATION and parameters != memory.password:
            return self.answer(at, 0xA0, WRONG)
        told = Told()
        if mode == MEAN:
            told = Told(parameters, scans=parameters[0])
        elif mode in (PART, REFLECTIVITY):
            first, last = np.frombuffer(parameters, "<u2")[-2:].tolist()
            told = Told(parameters, first, last)
        if not 1 <= told.first <= told.last <= LAST or mode == MEAN and told.scans not in SCANS:
            return self.answer(at, 0x92)
        delay = REPLY_S + self.rng.uniform(0, 0.02)
        if self.streaming:
            delay += self.rng.uniform(0, STOP_S)
        memory.mode = mode
        self._told = told
        return self.answer(at, 0xA0, DONE, delay=delay)

    # ---------------------------------------------------------------------------------- replies

    def _encode(self, code, data=b""):
        return encode_telegram(code, data, status=0x10, address=0x80 | self.memory.address)

    def answer(self, at, code, data=b"", effect=None, delay=REPLY_S):
        """Send a reply after a delay; its effect comes when it is out, and streaming goes on."""
        if effect is not None:  # else that of the command whose reply this one interrupted
            self._effect = effect
        raw = self._encode(code, data)
        self.at(at + delay, lambda instant: self.reply(raw, instant, self._finish), "reply")

    def _finish(self, at):
        """A reply is out: do what is left of the command, and stream from the next scan on."""
        effect = self._effect
        self._effect = None
        if effect is not None:
            effect(at)
        self.cancel("stream")
        if self.streaming:
            self._partial = 0
            self._turn = self._turn_of(at, self._turns, math.ceil)
            self._plan()

    def reply(self, raw, at, then=None):
        """Send a reply; at 500000 Bd at most 508 bytes leave in one turn of the mirror."""
        step = BURST if self.memory.baudrate == 500000 else len(raw) or 1
        for burst, first in enumerate(range(0, len(raw), step)):
            self.write(raw[first : first + step], at + burst * MIRROR_TURN)
        self.write(b"", at, then)

    def _begin_restart(self, at):
        self.at(at + RESET_S, self.restart)

    def restart(self, at):
        """Fall silent, with variant and rate of the factory; tell at the end that it is ready."""
        self.cancel("reply", "stream")
        self.abort()
        self._booting = True
        self._effect = None
        self._told = Told()
        self.memory.mode = REQUEST
        self.memory.baudrate = 9600
        self.memory.variant = (100, 50) if self.memory.narrow else (180, 50)
        self.at(at + self.boot_s, self._ready)

    def _ready(self, at):
        self._booting = False
        self._buffer = b""
        self._zero = at
        self.telegrams = 0
        self.reply(self._encode(0x90, self.memory.model.encode()), at)

    # ------------------------------------------------------------------------------------ scans

    def _turn_of(self, instant, turns, rounded):
        """First turn of the scan that is measured then (math.floor), or of the next (math.ceil)."""
        return rounded((instant - self._zero) / MIRROR_TURN / turns) * turns

    def _request(self, at):
        """Send one scan: the one that is being measured at an instant."""
        turn = self._turn_of(at, 100 // self.memory.variant[1], math.floor)
        self._measure(turn, -1, lambda scan, end: self.emit(scan, end, self._finish), "reply")

    def _measure(self, turn, partial, send, tag):
        """Send the scan that begins at a turn at its end.

        It is cast a little ahead, which may take a while.
        """
        memory = self.memory
        angle, step = memory.variant
        turns = 1 if partial >= 0 else 100 // step
        values = 181 - (partial > 0) if partial >= 0 else angle * 100 // step + 1
        end = self._zero + (turn + turns * self._told.scans) * MIRROR_TURN

        def ahead(_):
            """Cast the scan, or those of a mean, and send it at its end."""
            quarters = codec.scan_quarters(values, partial)
            after = np.arange(values) % turns + quarters / 1440  # turns since the first began
            times = self._zero + (turn + after) * MIRROR_TURN
            later = range(0, turns * self._told.scans, turns)
            cast = [self.source.scan(turn + n, quarters, times + n * MIRROR_TURN) for n in later]
            ranges, reasons, pitch = map(np.array, zip(*cast, strict=True))
            configuration = memory.configuration
            words = codec.encode_values(
                ranges.mean(axis=0),
                unit=configuration.unit,
                mode=ENCODED[configuration.measuring_mode],
                reasons=reasons.max(axis=0),  # of a mean, too: one scan without a range leaves none
            )
            times += self.host.time() - self.host.now()
            ends = pitch[[0, -1], [0, 1]]
            scan = ScanRecord(-1, turn, -1, float(times[0]), times, ends, partial, words, b"")
            self.at(end, lambda instant: send(scan, instant), tag)

        self.at(end - AHEAD_S, ahead, tag)

    def emit(self, scan, at, then=None):
        """Send a scan, which is then on record."""
        raw = self._telegram(scan)
        index = self.telegrams % 256
        self.scans.append(replace(scan, number=self._number, telegram_index=index, telegram=raw))
        self.telegrams += 1
        self._number += 1
        self.reply(raw, at, then)

    def _telegram(self, scan):
        """What the mode tells of a scan."""
        memory = self.memory
        c = memory.configuration
        words = scan.words[self._told.first - 1 : self._told.last]
        if memory.mode == REFLECTIVITY:  # behind every range
            answered = words <= MODES[ENCODED[c.measuring_mode]].largest
            words = np.stack([words, WHITE * answered], axis=1)
        return codec.encode_words(
            words,
            unit=c.unit,
            partial=scan.partial,
            indices=(scan.turn, self.telegrams) if c.realtime_indices else None,
            address=0x80 | memory.address,
            code=STREAMED.get(memory.mode, codec.SCAN),
            head=self._told.head,
        )

    @property
    def _turns(self):
        """Turns of the mirror for a telegram of the stream."""
        if self.memory.mode == INTERLACED:
            return 1
        return self._told.scans * (100 // self.memory.variant[1])

    def _plan(self):
        """Measure the next scan of the stream; of one that lags, some are left out.

        The indices show the gap.
        """
        turns = self._turns
        late = self.host.now() - self._zero - (self._turn + turns) * MIRROR_TURN
        if late > (LATE_AGAIN_S if self.left_out else LATE_S):
            if not self.left_out:
                LOG.warning(
                    "%s: this machine casts scans too slowly: %.1f s of them are left out; "
                    "choose stop-and-go",
                    self.path,
                    late,
                )
            self.left_out += 1
            self.telegrams += 1
            self._partial = 0
            self._turn = self._turn_of(self.host.now(), turns, math.ceil)
        partial = -1
        if self.memory.mode == INTERLACED:  # which there are depends on the resolution that is set
            partial = self._partial * self.memory.variant[1] % 100 // 25
            self._partial += 1
        self._measure(self._turn, partial, self._next, "stream")

    def _next(self, scan, at):
        """A scan of the stream is complete: send it unless the line is busy, and plan the next.

        As many whole scans pass as the transfer needs (manual, table 10-17).
        """
        if self.busy_until > at + 1e-9:
            self.telegrams += 1
        else:
            self.emit(scan, at)
        size = len(self._telegram(scan))
        self._turn += math.ceil(size * self.byte_s / (self._turns * MIRROR_TURN)) * self._turns
        self._plan()
