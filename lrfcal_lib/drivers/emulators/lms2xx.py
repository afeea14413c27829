"""A SICK LMS2xx at the end of a pseudo-terminal: its commands and their times, and streaming."""

from __future__ import annotations

import logging
import time
from collections import deque
from contextlib import suppress

import numpy as np

from lrfcal_lib.drivers.emulators.faults import Faults
from lrfcal_lib.drivers.emulators.line import Clock, Line
from lrfcal_lib.drivers.emulators.lms2xx_memory import BAUD_WORD, SECOND_BYTES, Memory
from lrfcal_lib.drivers.emulators.lms2xx_scans import (
    KEPT,
    STREAMS,
    TURN_S,
    Scanner,
    ScanStream,
    SyntheticSource,
    sub_range,
)
from lrfcal_lib.drivers.lms2xx import TelegramError, crc16, encode_telegram, parse_telegram

LOG = logging.getLogger(__name__)
ACK, NAK, STX = 0x06, 0x15, 0x02
ACK_S = 0.003  # from the last byte of a request to ACK or NAK; the manual allows 60 ms
REPLY_S = 0.065  # to the first byte of a reply, as measured on a real device
WRITE_S = 0.107  # the same where flash is written (measured: 0x77)
RESET_S = 0.010
SLOW_MODE_S = 2.8
STOP_S = 0.52  # a change of mode while streaming takes up to so much longer (measured: 71 to 588 ms)
GAP_S = 0.006  # a host that pauses longer within a telegram is not heard
BURST = 508  # bytes that leave in one turn of the mirror at 500000 Bd
LONGEST_REQUEST = 1024
AHEAD_S = 0.035  # the head reacts more slowly, so the pitch until then is known
LATE_S = 1.0, 0.1  # a stream that lags so far leaves scans out: no host can know how late they are; once it did
BAUD_COMMAND = {0x40: 38400, 0x41: 19200, 0x42: 9600, 0x48: 500000}
INSTALLATION, DIAGNOSIS, REQUEST, TEST_PASSWORD = 0x00, 0x10, 0x25, 0x30
DONE, WRONG, FAULT = 0, 1, 2  # results of command 0x20


class EmulatedLms:
    """An LMS2xx; a context manager, or `start` and `close`.

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
        Of :class:`Memory`: model, variant, configuration, baudrate, address, permanent_baud, password, ...

    Attributes
    ----------
    memory : Memory
    faults : Faults
    scans : deque of ScanRecord
        The newest 20000.
    requests : deque of (float, bytes)
        Host time and sound telegrams from the host.
    left_out : int
        Times that a stream left scans out, as this machine is too slow to cast them in time: a moving head needs
        some 20 ms of its processor for a scan, and `time_scale` shortens the time between two.
    """

    def __init__(self, source=None, *, path, seed=0, time_scale=1.0, clock=None, boot_s=2.0, powered_s=60.0,
                 baudrates=tuple(BAUD_WORD), **settings):  # fmt: skip
        self.memory, self.clock, self.faults = Memory(**settings), clock or Clock(time_scale), Faults("lrf", seed)
        self.boot_s, self.baudrates, self.rng = boot_s, baudrates, np.random.default_rng([seed, 1])
        self.line, self.requests = Line(path, self, self.clock, self.faults), deque(maxlen=KEPT)
        now = self.clock.now()
        self.scanner = Scanner(source or SyntheticSource(), self.memory, self.clock, now - powered_s)
        self.scans = self.scanner.records
        self._buffer, self._stream, self._booting, self.left_out = b"", None, powered_s < boot_s, 0
        self._after = None  # what the last command still does once a reply is out
        if self._booting:
            self.line.at(now + boot_s - powered_s, self._ready, "boot")

    @property
    def path(self):
        """Of the port, str."""
        return str(self.line.path)

    @property
    def baudrate(self):
        """Of the device now."""
        return self.memory.baudrate

    @property
    def streaming(self):
        """Whether scans are sent by themselves."""
        return self._stream is not None

    def start(self):
        """Make the port and serve it."""
        self.line.start()
        return self

    def close(self):
        """Remove the port."""
        self.line.close()

    __enter__ = start

    def __exit__(self, *_):
        self.close()

    # ------------------------------------------------------------------------------------------- bytes from the host

    def receive(self, data, at):
        """Bytes of the host; the last of them arrived at an instant."""
        self._buffer += data
        self.line.cancel("gap")
        while (found := self._cut()) is not None:
            self._hear(found, at)
        if self._buffer:
            self.line.at(at + GAP_S * self.clock.scale, self._forget, "gap")

    def _forget(self, _):
        self._buffer = b""

    def _cut(self):
        """The next telegram of the buffer; None until there is a whole one."""
        while (start := self._buffer.find(STX)) >= 0:
            self._buffer = self._buffer[start:]
            if len(self._buffer) < 4:
                return None
            length = int.from_bytes(self._buffer[2:4], "little")
            if 0 < length <= LONGEST_REQUEST and self._buffer[1] < 0x80:
                end = length + 6
                raw, rest = self._buffer[:end], self._buffer[end:]
                if len(raw) < end:
                    return None
                self._buffer = rest
                return raw
            self._buffer = self._buffer[1:]
        self._buffer = b""
        return None

    def _hear(self, raw, at):
        """Acknowledge a telegram and do what it says; it interrupts whatever is being sent, and undoes nothing."""
        if raw[1] not in (0, self.memory.address) or self._booting:
            return
        self.line.cancel("reply")
        self.line.cancel("stream")
        self.line.abort()
        sound = crc16(raw[:-2]) == int.from_bytes(raw[-2:], "little")
        if not sound or self.faults.hit("nak"):
            return self.line.write(bytes([NAK]), at + ACK_S, self._finish)
        if not self.faults.hit("no_ack"):
            self.line.write(bytes([ACK]), at + ACK_S)
        self.requests.append((time.time(), raw))
        if self.faults.hit("reboot"):
            return self._restart(at + RESET_S)
        if self.faults.hit("rate"):
            self.line.at(at, self._lose_rate)
        self._do(parse_telegram(raw), at)

    def _lose_rate(self, _):
        rates = [rate for rate in BAUD_WORD if rate != self.memory.baudrate]
        self.memory.baudrate = int(self.faults.rng.choice(rates))

    def _do(self, telegram, at):
        action = self._COMMANDS.get(telegram.code)
        if action is None or self.faults.hit("refused"):
            return self._refuse(at)
        action(self, telegram.data, at)

    # ------------------------------------------------------------------------------------------- replies

    def _answer(self, at, code, data=b"", then=None, delay=REPLY_S):
        """Send a reply after a delay, then do what `then` says; streaming goes on after it."""
        self._after = then or self._after  # of the command before, where this one interrupted its reply

        def send(instant):
            self.line.reply(code, self.memory.reply(code, data), instant, self._finish)

        self.line.at(at + delay, send, "reply")

    def _finish(self, at):
        """A reply is out: do what is left of the command, and go on streaming."""
        after, self._after = self._after, None
        if after is not None:
            after(at)
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
            raw += int(crc16(raw)).to_bytes(2, "little")
        return self.memory.reply(0xB2, b"") + raw if hit("foreign") else raw

    # ------------------------------------------------------------------------------------------- commands

    def _reset(self, _, at):
        self._answer(at, 0x91, then=lambda end: self._restart(end + RESET_S), delay=ACK_S + 0.001)

    def _restart(self, at):
        self.line.cancel("reply")
        self.line.cancel("stream")
        self._booting, self._stream, self._after = True, None, None
        self.line.at(at, self._off, "boot")
        self.line.at(at + self.boot_s, self._ready, "boot")

    def _off(self, _):
        self.line.abort()
        self.memory.restart()

    def _ready(self, at):
        """Power-on string, sent by itself."""
        self._booting, self._buffer, self.scanner.zero, self.scanner.telegrams = False, b"", at, 0
        self.line.reply(0x90, self.memory.reply(0x90, self.memory.model.encode()), at)

    def _type(self, _, at):
        self._answer(at, 0xBA, self.memory.model.encode())

    def _status(self, _, at):
        self._answer(at, 0xB1, self.memory.status_data())

    def _errors(self, _, at):
        self._answer(at, 0xB2, bytes(v for pair in self.memory.errors for v in pair))

    def _read_first(self, _, at):
        self._answer(at, 0xF4, self.memory.configuration.block)

    def _read_second(self, _, at):
        self._answer(at, 0xFB, bytes(SECOND_BYTES))

    def _write_first(self, data, at):
        if self.memory.mode != INSTALLATION or not 32 <= len(data) <= 34:
            return self._refuse(at)
        taken = self.memory.write_configuration(data)
        self._answer(at, 0xF7, bytes([taken]) + self.memory.configuration.block, delay=WRITE_S)

    def _permanent_baud(self, data, at):
        if self.memory.mode != INSTALLATION or len(data) != 1 or data[0] > 2:
            return self._refuse(at)
        self.memory.permanent_baud = data[0] == 1
        self.memory.flash_writes += 1
        self._answer(at, 0xE6, bytes([1, data[0]]), delay=WRITE_S)

    def _variant(self, data, at):
        """Nothing is streamed while it changes."""
        if len(data) != 4:
            return self._refuse(at)
        asked = tuple(int.from_bytes(data[i : i + 2], "little") for i in (0, 2))
        taken = self.memory.takes_variant(asked)
        self.memory.variant = asked if taken else self.memory.variant
        if self._stream is not None and not ScanStream.possible(self._stream.mode, self._stream.data, self.memory):
            self._stream, self.memory.mode = None, REQUEST
        active = b"".join(v.to_bytes(2, "little") for v in self.memory.variant)
        self._answer(at, 0xBB, bytes([taken]) + active, delay=WRITE_S)

    # ------------------------------------------------------------------------------------------- operating modes

    def _mode(self, data, at):
        sub, rest = (data[0], data[1:]) if data else (None, b"")
        if sub in BAUD_COMMAND and not rest:
            return self._change_baud(BAUD_COMMAND[sub], at)
        if sub in (INSTALLATION, TEST_PASSWORD) and len(rest) == 8:
            return self._check_password(sub, rest, at)
        if sub in (DIAGNOSIS, REQUEST) and not rest or ScanStream.possible(sub, rest, self.memory):
            return self._set_mode(sub, rest, at)
        self._refuse(at)

    def _result(self, code, at, then=None, delay=REPLY_S):
        self._answer(at, 0xA0, bytes([code]), then, delay)

    def _check_password(self, sub, password, at):
        if password != self.memory.password:
            return self._result(WRONG, at)
        self._set_mode(INSTALLATION, b"", at) if sub == INSTALLATION else self._result(DONE, at)

    def _change_baud(self, rate, at):
        """The reply leaves at the old rate."""
        if rate not in self.baudrates:
            return self._result(FAULT, at)

        self._result(DONE, at, lambda _: setattr(self.memory, "baudrate", rate))

    def _set_mode(self, mode, data, at):
        delay = REPLY_S + self.rng.uniform(0, 0.02)
        if self._stream is not None:
            delay += self.rng.uniform(0, STOP_S)
            if self.faults.hit("stuck"):
                return self._result(DONE, at)
        self.memory.mode = mode
        self._stream = ScanStream(mode, data, self.scanner) if mode in STREAMS else None
        self._result(DONE, at, delay=SLOW_MODE_S if self.faults.hit("slow_mode") else delay)

    # ------------------------------------------------------------------------------------------- scans

    def _measure(self, data, at):
        """Scans on request: whole, every second or twentieth value, the next partial scan."""
        if data == b"\x08":
            return self._send_scan(at, self.scanner.interlaced, 1, 1)
        step = {b"\x01": 1, b"\x06": 2, b"\x07": 20}.get(data)
        if step is None:
            return self._refuse(at)
        self._send_scan(at, lambda turn: self.scanner.whole(turn, step))

    def _measure_mean(self, data, at):
        if len(data) != 1 or not 2 <= data[0] <= 250:
            return self._refuse(at)
        self._send_scan(at, lambda turn: self.scanner.mean(turn, data[0]), data[0])

    def _measure_part(self, data, at):
        limits = sub_range(data, self.memory)
        if limits is None:
            return self._refuse(at)
        self._send_scan(at, lambda turn: self.scanner.part(turn, limits))

    def _send_scan(self, at, measure, count=1, turns=None):
        """Send a scan when the mirror has finished it: the one that is being measured when the ACK is out."""
        turns = turns or self.memory.turns
        first = self.scanner.turn_at(at + ACK_S + 2 * self.line.byte_s, turns)
        end = self.scanner.turn_time(first + turns * count)
        self._when_complete(end, lambda: measure(first), lambda scan, t: self._emit(scan, t, self._finish), "reply")

    def _when_complete(self, end, measure, send, tag):
        """Send a scan at its end; it is measured a little ahead, which may take the processor a while."""

        def ahead(_):
            scan = measure()
            self.line.at(end, lambda instant: send(scan, instant), tag)

        self.line.at(end - AHEAD_S, ahead, tag)

    def _emit(self, scan, at, then=None):
        burst = BURST if self.memory.baudrate == 500000 else None
        self.line.reply(scan.code, self.scanner.telegram(scan), at, then, burst, TURN_S)

    def _resume(self, at):
        """Go on streaming, if so, with the next scan that begins after an instant."""
        self.line.cancel("stream")
        if self._stream is not None:
            self._stream.begin(at)
            self._plan()

    def _plan(self):
        late = self.clock.now() - self._stream.complete_at
        if late > LATE_S[self.left_out > 0]:
            self._leave_out(late)
        self._when_complete(self._stream.complete_at, self._stream.measure, self._next, "stream")

    def _next(self, scan, at):
        """A scan of the stream is complete: send it unless the line is still busy, and plan the next."""
        if self.line.busy_until > at + 1e-9 or self.faults.hit("skip"):
            self.scanner.telegrams += 1
        else:
            self._emit(scan, at)
        self._stream.advance()
        self._plan()

    def _leave_out(self, late):
        """Go on with the scan of the present; the host sees the gap in the indices."""
        if not self.left_out:
            LOG.warning("%s: this machine casts scans too slowly for time_scale %g: %.1f s of them are left out; "
                        "choose a smaller one, or stop-and-go", self.path, self.clock.scale, late)  # fmt: skip
        self.left_out += 1
        self.scanner.telegrams += 1
        self._stream.begin(self.clock.now())

    _COMMANDS = {
        0x10: _reset, 0x20: _mode, 0x30: _measure, 0x31: _status, 0x32: _errors, 0x36: _measure_mean,
        0x37: _measure_part, 0x3A: _type, 0x3B: _variant, 0x66: _permanent_baud, 0x74: _read_first,
        0x77: _write_first, 0x7B: _read_second,
    }  # fmt: skip
