"""What can go wrong with a device on a serial line, switched on by tests; all that is random follows from a seed."""

from collections import Counter
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from telegrams import parse_telegram

from lrfcal_lib.drivers import pelco_d
from lrfcal_lib.drivers.pelco_d import SYNC, encode_extended
from lrfcal_lib.emulators.head import ANSWERS, TURN_AROUND_S, EmulatedHead
from lrfcal_lib.emulators.lms2xx import ACK, RESET_S, EmulatedLms
from lrfcal_lib.emulators.lms2xx_memory import BAUD_WORD
from lrfcal_lib.session import lms2xx_frame as frame

DELAY_S = 0.7
AWAY_S = 0.5
SLIP_S = 0.3
JUMP = 1000  # JUMP in hundredths of a degree
BYTES = {  # what some do to the bytes of a reply, about a place in it
    "drop": lambda data, i, _: data[:i] + data[i + 1 :],
    "flip": lambda data, i, rng: (
        data[:i] + bytes([data[i] ^ 1 << int(rng.integers(8))]) + data[i + 1 :]
    ),
    "insert": lambda data, i, rng: data[: i + 1] + rng.bytes(1) + data[i + 1 :],
    "cut": lambda data, i, _: data[:i],
    "noise": lambda data, _, rng: rng.bytes(int(rng.integers(1, 21))) + data,
    "checksum": lambda data, _, rng: (
        data[:-1] + bytes([data[-1] ^ int(rng.integers(1, 256))])
    ),
}
REQUEST = {
    "request_drop": BYTES["drop"],
    "request_flip": BYTES["flip"],
    "deaf": lambda *_: b"",
}
LINE = (
    *BYTES,
    *REQUEST,
    "address",
    "foreign",
    "silence",
    "delay",
    "twice",
    "stale",
    "echo",
    "unplug",
)
LMS = (*LINE, "nak", "no_ack", "refused", "reboot", "rate", "skip", "status")
HEAD = (*LINE, "mute", "stall", "slip", "jump")


class Faults:
    """Switches of one device; `counts` tells how often each happened, ``changed()`` is called when one was armed."""

    def __init__(self, known, seed, now, changed):
        self.known, self.changed, self.counts, self._now = known, changed, Counter(), now
        self.rng, self.away_s = np.random.default_rng([seed, len(known)]), AWAY_S
        self._times, self._until = Counter(), {}

    def inject(self, name, count=1, *, seconds=None):
        """Arm a fault for so many opportunities (replies, requests, ...) from now on, or at every one for a while."""
        assert name in self.known
        if name == "unplug":  # how long the port is away
            self.away_s, seconds = AWAY_S if seconds is None else seconds, None
        if seconds is None:
            self._times[name] += count
        else:
            self._until[name] = self._now() + seconds
        self.changed()

    def clear(self, name=None):
        """Disarm one fault, or all."""
        for switches in (self._times, self._until):
            switches.clear() if name is None else switches.pop(name, None)

    def hit(self, name):
        """Whether the fault happens at this opportunity, which is then counted."""
        hit = bool(self._times[name] > 0 or self._now() < self._until.get(name, 0))
        self._times[name] -= self._times[name] > 0
        self.counts.update([name] * hit)
        return hit

    def mangle(self, data, changes):
        """Bytes as they are after those of the faults that hit them; each changes something where it can."""
        for name, change in changes.items():
            if data and self.hit(name):
                tries = (
                    change(data, int(self.rng.integers(len(data))), self.rng)
                    for _ in range(100)
                )
                data = next((changed for changed in tries if changed != data), data)
        return data


class FaultyLine:
    """Faults of any device on a line."""

    def __init__(self, *args, seed=0, **options):
        super().__init__(*args, seed=seed, **options)
        self.faults = Faults(self.known, seed, self.host.now, lambda: self.port.wake())
        self.hit, self._last = self.faults.hit, {}

    def advance(self):
        if self.port.there and self.hit("unplug"):
            self.port.unplug()
            self.at(self.host.now() + self.faults.away_s, lambda _: self.port.plug())
        super().advance()

    def hear(self, data):
        if self.hit("echo"):
            self.port.put(data)
        super().hear(data)

    def receive(self, data, at):
        if data := self.faults.mangle(data, REQUEST):
            super().receive(data, at)

    def reply(self, raw, at, then=None):
        kind = raw[4:5] if raw[:1] == b"\x02" else raw[-4:-3]
        old, self._last[kind] = self._last.get(kind), raw
        data = self.faults.mangle(
            self.prepare(old if old is not None and self.hit("stale") else raw), BYTES
        )
        at += DELAY_S * self.hit("delay")
        data = b"" if self.hit("silence") else data
        for _ in range(self.hit("twice")):
            super().reply(data, at)
        super().reply(data, at, then)


@dataclass(frozen=True)
class ScanRecord:
    """A scan that was sent: its running number, the mirror's turn, dates of its beams, all its values, the telegram."""

    number: int
    turn: int
    telegram_index: int
    beam_times_s: np.ndarray
    partial: int
    words: np.ndarray
    telegram: bytes

    time_s = property(lambda self: float(self.beam_times_s[0]))


class RecordingLms(EmulatedLms):
    """An LMS2xx that notes the sound requests it hears, with their dates, and the scans it sends."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.scans, self.requests = [], []

    def heard(self, raw, at, sound=True):
        if sound and raw[1] in (0, self.memory.address) and not self._booting:
            self.requests.append((self.host.time(), raw))
        super().heard(raw, at, sound)

    def emit(self, scan, at, then=None):
        dates = scan.times + (self.host.time() - self.host.now())
        told = (dates, scan.partial, scan.words, self.telegram(scan))
        self.scans.append(
            ScanRecord(len(self.scans), scan.turn, self.telegrams % 256, *told)
        )
        super().emit(scan, at, then)


class FaultyLms(FaultyLine, RecordingLms):
    """An LMS2xx with faults."""

    known = LMS

    def heard(self, raw, at, sound=True):
        return super().heard(raw, at, sound and not self.hit("nak"))

    def write(self, data, at, then=None):
        if data != ACK or not self.hit("no_ack"):
            super().write(data, at, then)

    def obey(self, code, data, at):
        memory = self.memory
        if self.hit("reboot"):
            return self.at(at + RESET_S, self.restart)
        if self.hit("rate"):
            memory.baudrate = int(
                self.faults.rng.choice(
                    [rate for rate in BAUD_WORD if rate != memory.baudrate]
                )
            )
        return (
            self.answer(at, 0x92) if self.hit("refused") else super().obey(code, data, at)
        )

    def emit(self, scan, at, then=None):
        if then is None and self.hit("skip"):
            self.telegrams += 1
        else:
            super().emit(scan, at, then)

    def prepare(self, raw):
        """A reply with the faults that keep its checksum sound."""
        with suppress(frame.TelegramError):
            told = parse_telegram(raw)
            status = 0xD3 if self.hit("status") else raw[-3]
            address = 0x80 | (raw[1] + 5) % 0x80 if self.hit("address") else raw[1]
            raw = frame.encode_telegram(
                told.code, told.data, status=status, address=address
            )
        return (
            frame.encode_telegram(0xB2, address=0x80) + raw if self.hit("foreign") else raw
        )


class FaultyHead(FaultyLine, EmulatedHead):
    """A head with faults, and with habits of other heads.

    It confirms commands by 4 bytes, its two-wire line hands back what the host sends, it stops when no frame came for
    `watchdog_s`, or its 'up' and positive elevation lower the view.
    """

    known = HEAD

    def __init__(
        self, *args, confirms=False, echo=False, watchdog_s=None, invert=False, **options
    ):
        super().__init__(*args, **options)
        self.heard = b""
        self.confirms, self.echo, self.watchdog_s, self.inverted = (
            confirms,
            echo,
            watchdog_s,
            invert,
        )

    def receive(self, data, at):
        self.heard += data
        if self.echo:
            self.write(data, at)
        super().receive(data, at)

    def pitch(self):
        """True pitch now, radians."""
        return float(self.head.pitch(self.host.now()))

    def turned(self, frame):
        """A frame as a head that hangs upside down understands it."""
        ways = frame.command2 & (pelco_d.UP | pelco_d.DOWN)
        if frame.command2 == pelco_d.SET_TILT:
            return replace(
                frame,
                **dict(
                    zip(
                        ("data1", "data2"),
                        divmod(-frame.value % pelco_d.TURN, 256),
                        strict=True,
                    )
                ),
            )
        if frame.command2 & 1 or not ways:
            return frame
        return replace(frame, command2=frame.command2 ^ (pelco_d.UP | pelco_d.DOWN))

    def obey(self, frame, at):
        self.cancel("watchdog")
        if self.watchdog_s:
            self.at(at + self.watchdog_s, self.stop, "watchdog")
        self.moved(self.turned(frame) if self.inverted else frame, at)
        if self.confirms and frame.command2 not in ANSWERS:
            checksum = sum(vars(frame).values()) % 256
            self.reply(bytes([SYNC, self.habits.address, 0, checksum]), at + TURN_AROUND_S)

    def moved(self, frame, at):
        moves = frame.command2 & (pelco_d.UP | pelco_d.DOWN) and not frame.command2 & 1
        head = self.head
        absolute = self.absolute
        stalls = (moves or frame.command2 == pelco_d.SET_TILT) and self.hit("stall")
        self.head = copy(head) if stalls else head  # another one moves
        super().obey(frame, at)
        self.head, self.absolute = head, absolute if stalls else self.absolute

    def stop(self, at):
        super().stop(at + SLIP_S * self.hit("slip"))

    def tell(self, opcode, at):
        if not self.hit("mute"):
            super().tell(opcode, at)

    def prepare(self, raw):
        """A reply with the faults that keep its checksum sound."""
        if len(raw) == pelco_d.FRAME and raw[3] == pelco_d.TILT and self.inverted:
            raw = encode_extended(
                raw[1], raw[3], -int.from_bytes(raw[4:6], "big") % pelco_d.TURN
            )
        if len(raw) == pelco_d.FRAME and raw[3] == pelco_d.TILT and self.hit("jump"):
            raw = encode_extended(
                raw[1], raw[3], (int.from_bytes(raw[4:6], "big") + JUMP) % pelco_d.TURN
            )
        if len(raw) >= pelco_d.GENERAL and raw[0] == SYNC and self.hit("address"):
            other = raw[1] % 255 + 1
            raw = (
                bytes([SYNC, other]) + raw[2:-1] + bytes([(raw[-1] + other - raw[1]) % 256])
            )
        return (
            encode_extended(self.habits.address, 0x5D, 0x1234) + raw
            if self.hit("foreign")
            else raw
        )
