"""A SICK LMS2xx: the commands that our driver, sicktoolbox and CARMEN send, their times, its mirror and its streams."""

from __future__ import annotations

import logging
import math
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from lrfcal_lib.emulators.line import Clock, SerialDevice
from lrfcal_lib.session.lms2xx_codec import (
    BAUD,
    CONFIGURATION_BYTES,
    MODES,
    UNITS,
    Configuration,
    TelegramError,
    crc16,
    encode_telegram,
    encode_values,
    encode_words,
    parse_telegram,
    scan_quarters,
    split_stream,
)

LOG = logging.getLogger(__name__)
ACK, NAK = b"\x06", b"\x15"
ACK_S = 0.003  # from the last byte of a request to ACK or NAK; the manual allows 60 ms
REPLY_S = 0.065  # to the first byte of a reply, as measured on a real device
WRITE_S = 0.107  # the same where flash is written (measured: 0x77)
RESET_S = 0.010
SLOW_MODE_S = 2.8
STOP_S = 0.52  # a change of mode while streaming takes up to so much longer (measured: 71 to 588 ms)
GAP_S = 0.006  # a host that pauses longer within a telegram is not heard
BURST = 508  # bytes that leave in one turn of the mirror at 500000 Bd
AHEAD_S = 0.035  # the head reacts more slowly, so the pitch until then is known
LATE_S = 1.0, 0.1  # a stream that lags so far leaves scans out: no host can know how late they are; once it did
TURN_S = 1 / 75.08  # of the mirror, as 148 us for a ninetieth tells
KEPT = 20000  # scans and requests on record
VARIANTS = ((100, 100), (100, 50), (100, 25), (180, 100), (180, 50))  # degrees, 1/100 degree
BAUD_WORD = {rate: word for word, rate in BAUD.items()}
BAUD_COMMAND = {0x40: 38400, 0x41: 19200, 0x42: 9600, 0x48: 500000}
INSTALLATION, DIAGNOSIS, REQUEST = 0x00, 0x10, 0x25  # operating modes
STREAMS = {0x24: 0, 0x26: 1, 0x27: 4, 0x28: 5, 0x2A: 0}  # that stream (all, mean, part, mean of a part, interlaced)
INTERLACED = 0x2A
DONE, WRONG, FAULT = b"\0", b"\1", b"\2"  # results of command 0x20
SPREAD = 4000  # counts: scans that differ by more hold a special value, of which no mean is taken
# offsets within the status reply, its code being 0, of words in a row: pollution, reference values, ...
_WORDS = {19: (95, 97, 96, 94, 96, 95, 97, 95, 90, 91, 90, 92, *(100,) * 8, *(95,) * 4), 67: (148,), 71: (17,),
          75: (18, 16), 81: (17, 71, 120, 33, 140, 60, *(921,) * 4), 103: (20, 20)}  # fmt: skip


@dataclass(frozen=True)
class ScanRecord:
    """A scan that was sent, or that a fault kept from being sent.

    Attributes
    ----------
    number : int
        Running.
    turn : int
        Of the mirror since power-on, the first of the scan; modulo 256 it is the scan index.
    telegram_index : int
    time_s : float
        Clock of the host at the first beam.
    beam_times_s : ndarray, shape (B,)
        The same at every beam.
    pitch_rad : ndarray, shape (2,)
        True pitch of the head at the earliest and the latest beam; NaN without a head.
    partial : int
        0 to 3 for the quarters of interlaced scans, -1 for whole ones.
    words : ndarray of uint16, shape (B,)
        All values of the scan, as the device counts them.
    telegram : bytes
        Before any fault.
    """

    number: int
    turn: int
    telegram_index: int
    time_s: float
    beam_times_s: np.ndarray
    pitch_rad: np.ndarray
    partial: int
    words: np.ndarray
    telegram: bytes


class SyntheticSource:
    """Scans that are a cheap function of the mirror's turn: no two in a row alike, every range within 8 m."""

    def scan(self, turn, quarters, times):
        """Readings of a scan.

        Parameters
        ----------
        turn : int
            Of the mirror, the first of the scan.
        quarters : ndarray of int, shape (B,)
            Bearings, quarters of a degree.
        times : ndarray, shape (B,)
            Of every beam, seconds of the devices.

        Returns
        -------
        ranges : ndarray, shape (B,)
            Metres.
        reasons : ndarray of int, shape (B,)
            Index into `lms2xx.REASONS`; 0 for a range.
        pitch : ndarray, shape (2,)
            Of the head at the earliest and the latest beam; NaN here.
        """
        ranges = 1.0 + (quarters * 13 + turn * 37) % 6000 / 1000
        reasons = np.where((quarters + turn) % 97 == 0, 1 + turn % 2 * 3, 0)
        return ranges, reasons, np.full(2, np.nan)


@dataclass
class Memory:
    """Settings of the device.

    Attributes
    ----------
    model : str
        21 characters, the answer to the type request.
    variant : tuple of int
        Degrees and 1/100 degree.
    configuration : Configuration
    baudrate : int
    mode : int
        Operating mode, the sub-command of 0x20.
    address : int
    password : bytes
    serial : str
    flash_writes : int
        Since the device was made; the flash endures a few thousand.
    """

    model: str = "LMS221;302063;X01.27 "
    variant: tuple[int, int] = (180, 50)
    configuration: Configuration = field(default_factory=Configuration)
    baudrate: int = 9600
    mode: int = REQUEST
    address: int = 0
    password: bytes = b"SICK_LMS"
    serial: str = "05270497"
    flash_writes: int = 0

    def __post_init__(self):
        if len(self.model) != 21 or not self.model.isascii():
            raise ValueError(f"a type has 21 ASCII characters, got {self.model!r}")
        if not self.takes_variant(self.variant):
            raise ValueError(f"{self.model[:6]} has no variant {self.variant}; variants are {VARIANTS}")
        if self.baudrate not in BAUD_WORD or len(self.password) != 8:
            raise ValueError(f"rate {self.baudrate} Bd, password {self.password!r}: no LMS2xx has that")

    def takes_variant(self, variant):
        """Whether the device offers a variant; the LMS211 sees 100 deg only."""
        return variant in VARIANTS and not (self.model.startswith("LMS211") and variant[0] == 180)

    def write_configuration(self, block):
        """Take a configuration of 32 to 34 bytes; whether its values are possible."""
        block = bytes(block) + self.configuration.block[len(block) : CONFIGURATION_BYTES]
        if block[5] not in MODES or block[6] >= len(UNITS):
            return False
        self.configuration, self.flash_writes = Configuration(block), self.flash_writes + 1
        return True

    def status_data(self):
        """Data of the status reply 0xB1."""
        c, data = self.configuration, bytearray(153)
        words = {**_WORDS, 107: self.variant, 112: (c.block[11],), 116: (BAUD_WORD[self.baudrate],)}
        for at, row in words.items():
            data[at : at + 2 * len(row)] = b"".join(value.to_bytes(2, "little") for value in row)
        for at, text in {1: self.model[14:21], 10: f"{self.serial:8.8}", 124: "V02.02 "}.items():
            data[at : at + len(text)] = text.encode()
        single = {8: self.mode, 102: c.measuring_mode, 111: c.block[10], 118: c.block[9], 120: self.address, 121: 1,
                  122: UNITS.index(c.unit), 123: 1}  # fmt: skip
        for at, value in single.items():
            data[at] = value
        return bytes(data[1:])


class EmulatedLms(SerialDevice):
    """An LMS2xx.

    Parameters
    ----------
    source : object, optional
        Has the method of :class:`SyntheticSource`, which is the default.
    path : path-like
        Of the port to appear.
    seed : int
    time_scale : float
        Seconds of the device in a second of the host; ignored where a clock is given.
    clock : Clock, optional
    boot_s : float
        From a restart to the power-on string; a real device takes up to 60 s.
    powered_s : float
        How long ago it was switched on; below `boot_s` it sends its power-on string first.
    baudrates : tuple of int
        That the line allows; RS-232 ends at 38400.
    **settings
        Of :class:`Memory`: model, variant, configuration, baudrate, address, password, ...

    Attributes
    ----------
    memory : Memory
    faults : Faults
    scans : deque of ScanRecord
        The newest 20000.
    requests : deque of (float, bytes)
        Host time and sound telegrams from the host.
    telegrams : int
        Scans counted since power-on.
    left_out : int
        Times that a stream left scans out, as this machine is too slow to cast them in time: a moving head needs
        some 20 ms of its processor for a scan, and `time_scale` shortens the time between two.
    """

    baudrate = property(lambda self: self.memory.baudrate, doc="Of the device now.")
    streaming = property(lambda self: self._stream is not None, doc="Whether scans are sent by themselves.")

    def __init__(self, source=None, *, path, seed=0, time_scale=1.0, clock=None, boot_s=2.0, powered_s=60.0,
                 baudrates=tuple(BAUD_WORD), **settings):  # fmt: skip
        super().__init__("lrf", path, clock or Clock(time_scale), seed)
        self.memory, self.source = Memory(**settings), source or SyntheticSource()
        self.boot_s, self.baudrates, self.rng = boot_s, baudrates, np.random.default_rng([seed, 1])
        self.scans, self.requests, self.telegrams, self.left_out = deque(maxlen=KEPT), deque(maxlen=KEPT), 0, 0
        self._buffer, self._stream, self._turn, self._partial, self._number = b"", None, 0, 0, 0
        self._zero, self._booting, self._effect = self.clock.now() - powered_s, powered_s < boot_s, None
        if self._booting:
            self.at(self._zero + boot_s, self._ready, "boot")

    # ------------------------------------------------------------------------------------------- bytes from the host

    def receive(self, data, at):
        """Bytes of the host; the last of them arrived at an instant."""
        self._buffer += data
        self.cancel("gap")
        raw, found = self._buffer, split_stream(self._buffer, replies=False)
        self._buffer = raw[found.pending :]
        for offset, length in zip(found.offset.tolist(), found.length.tolist(), strict=True):
            self._hear(raw[offset : offset + length], at)
        if len(found.rejected) and not len(found.offset):
            self._hear(raw[found.rejected[0] :], at, sound=False)
        if self._buffer:
            self.at(at + GAP_S * self.clock.scale, self._forget, "gap")

    def _forget(self, _):
        self._buffer = b""

    def _hear(self, raw, at, sound=True):
        """Acknowledge a telegram and do what it says; it interrupts what is being sent, and undoes no command."""
        if raw[1] not in (0, self.memory.address) or self._booting:
            return
        self.cancel("reply", "stream")
        self.abort()
        if not sound or self.faults.hit("nak"):
            return self.write(NAK, at + ACK_S, self._finish)
        if not self.faults.hit("no_ack"):
            self.write(ACK, at + ACK_S)
        self.requests.append((self.clock.machine.time(), raw))
        if self.faults.hit("reboot"):
            return self._restart(at + RESET_S)
        if self.faults.hit("rate"):
            self.at(at, self._lose_rate)
        telegram = parse_telegram(raw)
        action = self._COMMANDS.get(telegram.code)
        if action is None or self.faults.hit("refused"):
            return self._refuse(at)
        action(self, telegram.data, at)

    def _lose_rate(self, _):
        rates = [rate for rate in BAUD_WORD if rate != self.memory.baudrate]
        self.memory.baudrate = int(self.faults.rng.choice(rates))

    # ------------------------------------------------------------------------------------------- replies

    def _encode(self, code, data=b""):
        return encode_telegram(code, data, status=0x10, address=0x80 | self.memory.address)

    def _answer(self, at, code, data=b"", effect=None, delay=REPLY_S):
        """Send a reply after a delay; its effect comes when it is out, and streaming goes on."""
        self._effect = effect or self._effect  # of the command before, where this one interrupted its reply
        raw = self._encode(code, data)
        self.at(at + delay, lambda instant: self.reply(code, raw, instant, self._finish), "reply")

    def _finish(self, at):
        """A reply is out: do what is left of the command, and go on streaming."""
        effect, self._effect = self._effect, None
        if effect is not None:
            effect(at)
        self._resume(at)

    def _refuse(self, at):
        self._answer(at, 0x92)

    def prepare(self, raw):
        """A reply with the faults that keep its checksum sound."""
        hit = self.faults.hit
        with suppress(TelegramError):
            told = parse_telegram(raw)
            status = 0xD3 if hit("status") else told.status
            address = 0x80 | (told.address + 5) % 0x80 if hit("address") else told.address
            raw = encode_telegram(told.code, told.data, status=status, address=address)
        if hit("length"):
            length = (len(raw) - 5 + int(self.faults.rng.integers(40))) % 800
            raw = raw[:2] + length.to_bytes(2, "little") + raw[4:-2]
            raw += crc16(raw).to_bytes(2, "little")
        return self._encode(0xB2) + raw if hit("foreign") else raw

    # ------------------------------------------------------------------------------------------- commands

    def _restart(self, at):
        self.cancel("reply", "stream")
        self._booting, self._stream, self._effect = True, None, None
        self.at(at, self._off, "boot")
        self.at(at + self.boot_s, self._ready, "boot")

    def _off(self, _):
        """Variant and rate become those of the factory."""
        self.abort()
        self.memory.mode, self.memory.baudrate = REQUEST, 9600
        self.memory.variant = (100, 50) if self.memory.model.startswith("LMS211") else (180, 50)

    def _ready(self, at):
        """Power-on string, sent by itself."""
        self._booting, self._buffer, self._zero, self.telegrams = False, b"", at, 0
        self.reply(0x90, self._encode(0x90, self.memory.model.encode()), at)

    def _write_configuration(self, data, at):
        if self.memory.mode != INSTALLATION or not 32 <= len(data) <= 34:
            return self._refuse(at)
        taken = self.memory.write_configuration(data)
        self._answer(at, 0xF7, bytes([taken]) + self.memory.configuration.block, delay=WRITE_S)

    def _variant(self, data, at):
        """Nothing is streamed while it changes."""
        if len(data) != 4:
            return self._refuse(at)
        asked = tuple(int.from_bytes(data[i : i + 2], "little") for i in (0, 2))
        taken = self.memory.takes_variant(asked)
        self.memory.variant = asked if taken else self.memory.variant
        if self._stream is not None and not self._possible(*self._stream):
            self._stream, self.memory.mode = None, REQUEST
        active = b"".join(v.to_bytes(2, "little") for v in self.memory.variant)
        self._answer(at, 0xBB, bytes([taken]) + active, delay=WRITE_S)

    def _mode(self, data, at):
        """The rate changes when the reply has left; a change of the mode takes its time, more so in a stream."""
        sub, rest = data[:1], data[1:]
        mode, memory, rng = int.from_bytes(sub), self.memory, self.rng
        if mode in BAUD_COMMAND and len(data) == 1:
            if BAUD_COMMAND[mode] not in self.baudrates:
                return self._result(FAULT, at)
            return self._result(DONE, at, lambda _: setattr(memory, "baudrate", BAUD_COMMAND[mode]))
        if not sub or not (self._possible(mode, rest) or mode == INSTALLATION and len(rest) == 8):
            return self._refuse(at)
        if mode == INSTALLATION and rest != memory.password:
            return self._result(WRONG, at)
        delay = REPLY_S + rng.uniform(0, 0.02) + (rng.uniform(0, STOP_S) if self.streaming else 0)
        if not (self.streaming and self.faults.hit("stuck")):
            memory.mode, self._stream = mode, (mode, rest) if mode in STREAMS else None
            delay = SLOW_MODE_S if self.faults.hit("slow_mode") else delay
        self._result(DONE, at, delay=delay)

    def _result(self, result, at, effect=None, delay=REPLY_S):
        self._answer(at, 0xA0, result, effect, delay)

    def _possible(self, mode, data):
        """Whether there is such a mode with such parameters."""
        if len(data) != STREAMS.get(mode, 0) or mode not in (DIAGNOSIS, REQUEST, *STREAMS):
            return False
        first, last = self._limits(data) or (1, 1)
        return 1 <= first <= last <= len(self._quarters()) and (len(data) % 4 == 0 or 2 <= data[0] <= 250)

    @staticmethod
    def _limits(data):
        """First and last value of a part, counted from 1, None for all; the last four bytes of parameters."""
        at = len(data) - 4
        return None if at < 0 else tuple(int.from_bytes(data[i : i + 2], "little") & 0x7FFF for i in (at, at + 2))

    # ------------------------------------------------------------------------------------------- scans

    def _quarters(self, partial=-1):
        angle, step = self.memory.variant
        return scan_quarters(181 - (partial > 0) if partial >= 0 else angle * 100 // step + 1, partial)

    def _turns(self, interlaced=False):
        """Turns of the mirror for a whole scan."""
        return 1 if interlaced else 100 // self.memory.variant[1]

    def _turn_of(self, instant, turns, rounded):
        """First turn of the scan that is being measured (math.floor), or of the next one (math.ceil)."""
        return rounded((instant - self._zero) / TURN_S / turns) * turns

    def _measure(self, turn, mode=0x24, data=b""):
        """The scan of a mode that begins at a turn, as a record whose telegram is yet to come."""
        partial, count = -1, data[0] if len(data) % 4 else 1
        if mode == INTERLACED:  # the next of the partial scans; which there are depends on the resolution set
            partial, self._partial = self._partial * self.memory.variant[1] % 100 // 25, self._partial + 1
        turns, quarters, words, c = self._turns(partial >= 0), self._quarters(partial), [], self.memory.configuration
        for first in range(turn, turn + count * turns, turns):
            times = self._zero + (first + np.arange(len(quarters)) % turns + quarters / 1440) * TURN_S
            ranges, reasons, pitch = self.source.scan(first, quarters, times)
            words.append(encode_values(ranges, unit=c.unit, mode=c.measuring_mode, reasons=reasons))
        words = np.array(words)  # of a mean: a special value in one of them stays
        words = np.where(np.ptp(words, axis=0) < SPREAD, words.mean(axis=0), words.max(axis=0)).astype(np.uint16)
        times = self.clock.host(times)
        return ScanRecord(-1, turn, -1, float(times[0]), times, pitch, partial, words, b"")

    def _emit(self, scan, at, then=None, mode=0x24, data=b""):
        """Send a scan, which is then on record."""
        c, indices, limits = self.memory.configuration, (scan.turn, self.telegrams), self._limits(data)
        options = {"unit": c.unit, "partial": scan.partial, "address": 0x80 | self.memory.address}
        words = scan.words[limits[0] - 1 : limits[1]] if limits else scan.words
        raw = encode_words(words, **options, indices=indices if c.realtime_indices else None)
        if data:  # the reply states what is told of the scan
            code = {1: 0xB6, 4: 0xB7, 5: 0xBF}[len(data)]
            raw = self._encode(code, data + parse_telegram(raw).data)
        told = {**vars(scan), "number": self._number, "telegram_index": self.telegrams % 256, "telegram": raw}
        self.scans.append(ScanRecord(**told))
        self.telegrams, self._number = self.telegrams + 1, self._number + 1
        self.reply(raw[4], raw, at, then, BURST if self.memory.baudrate == 500000 else None, TURN_S)

    def _request(self, data, at):
        """One scan: the one that is being measured when the ACK is out."""
        if data != b"\x01":
            return self._refuse(at)
        first = self._turn_of(at + ACK_S + 2 * self.byte_s, self._turns(), math.floor)
        self._when_complete(first + self._turns(), lambda: self._measure(first),
                            lambda scan, instant: self._emit(scan, instant, self._finish), "reply")  # fmt: skip

    def _when_complete(self, turn, measure, send, tag):
        """Send a scan at its end; it is measured a little ahead, which may take the processor a while."""
        end = self._zero + turn * TURN_S

        def ahead(_):
            scan = measure()
            self.at(end, lambda instant: send(scan, instant), tag)

        self.at(end - AHEAD_S, ahead, tag)

    # ------------------------------------------------------------------------------------------- streams

    def _resume(self, at):
        """Go on streaming, if so, with the next scan that begins after an instant, of interlaced ones the first."""
        self.cancel("stream")
        if self.streaming:
            self._partial = 0
            self._turn = self._turn_of(at, self._turns(self._stream[0] == INTERLACED), math.ceil)
            self._plan()

    def _stream_turns(self):
        """Turns of the mirror that one telegram takes to measure."""
        mode, data = self._stream
        return self._turns(mode == INTERLACED) * (data[0] if len(data) % 4 else 1)

    def _plan(self):
        late = self.clock.now() - self._zero - (self._turn + self._stream_turns()) * TURN_S
        if late > LATE_S[self.left_out > 0]:
            self._leave_out(late)
        turn, stream = self._turn, self._stream
        self._when_complete(turn + self._stream_turns(), lambda: self._measure(turn, *stream), self._next, "stream")

    def _next(self, scan, at):
        """A scan of the stream is complete: send it unless the line is still busy, and plan the next.

        As many whole scans pass as the transfer needs (manual, table 10-17).
        """
        if self.busy_until > at + 1e-9 or self.faults.hit("skip"):
            self.telegrams += 1
        else:
            self._emit(scan, at, None, *self._stream)
        (mode, data), turns = self._stream, self._stream_turns()
        first, last = self._limits(data) or (1, 181 if mode == INTERLACED else len(self._quarters()))
        size = 2 * (last - first + 1) + 10 + 2 * self.memory.configuration.realtime_indices
        self._turn += math.ceil(size * 10 / self.memory.baudrate / (turns * TURN_S)) * turns
        self._plan()

    def _leave_out(self, late):
        """Go on with the scan of the present; the host sees the gap in the indices."""
        if not self.left_out:
            LOG.warning("%s: this machine casts scans too slowly for time_scale %g: %.1f s of them are left out; "
                        "choose a smaller one, or stop-and-go", self.path, self.clock.scale, late)  # fmt: skip
        self.left_out, self.telegrams, self._partial = self.left_out + 1, self.telegrams + 1, 0
        self._turn = self._turn_of(self.clock.now(), self._turns(self._stream[0] == INTERLACED), math.ceil)

    _COMMANDS = {
        0x10: lambda self, _, at: self._answer(at, 0x91, effect=lambda end: self._restart(end + RESET_S),
                                               delay=ACK_S + 0.001),
        0x20: _mode,
        0x30: _request,
        0x31: lambda self, _, at: self._answer(at, 0xB1, self.memory.status_data()),
        0x32: lambda self, _, at: self._answer(at, 0xB2),
        0x3A: lambda self, _, at: self._answer(at, 0xBA, self.memory.model.encode()),
        0x3B: _variant,
        0x74: lambda self, _, at: self._answer(at, 0xF4, self.memory.configuration.block),
        0x77: _write_configuration,
    }  # fmt: skip
