"""A device at the end of a serial line: its clock, the times of its bytes, what can go wrong, and the port it is at.

The port is a pseudo-terminal served by a thread, whose rate is read at the master so that a wrong one garbles bytes as
on a real line.
"""

import contextlib
import heapq
import itertools
import json
import math
import os
import select
import termios
import threading
import tty
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lrfcal_lib.drivers.port import REAL

RATES = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}
CHUNK_S = 0.005  # bytes that leave within this time are written at once
LOOK_S = 0.02  # how often to see whether somebody opened the port, or switched a fault on
FASTEST = 8.0  # at 16 times, threads of a program get the processor too seldom to read a line at 500000 Bd
DELAY_S, PAUSE_S, AWAY_S = 0.7, 0.08, 0.5  # of the faults 'delay', 'pause' and 'unplug'
SOON = 1e-9  # s; so far ahead counts as now, whatever the rounding
SENDING = "sending"  # tag of what is planned for the bytes on their way out


class Clock:
    """Time of the emulated devices, which runs `scale` times (8 at most) as fast as that of a machine (a Host)."""

    def __init__(self, scale=1.0, machine=REAL):
        if not 0 < scale <= FASTEST:
            raise ValueError(f"time_scale is {scale}: it must be positive, 1 for real time, and at most {FASTEST:g}")
        self.scale, self.machine, self._zero, self._host_zero = scale, machine, machine.now(), machine.time()

    def now(self):
        """Seconds of the devices since the clock was made."""
        return (self.machine.now() - self._zero) * self.scale

    def host(self, instant):
        """Instant of the devices as time() of the host."""
        return self._host_zero + np.asarray(instant) / self.scale

    def device(self, time_s):
        """Inverse of :meth:`host`."""
        return (np.asarray(time_s) - self._host_zero) * self.scale


class Fault(NamedTuple):
    """What can go wrong: with which devices ('lrf', 'head'), and what happens."""

    devices: list
    text: str


FAULTS = {name: Fault(**row) for name, row in json.loads(Path(__file__).with_name("faults.json").read_text()).items()}
REPLY = {  # what some do to the bytes of a reply, about a place in it
    "drop": lambda data, i, _: data[:i] + data[i + 1 :],
    "flip": lambda data, i, rng: data[:i] + bytes([data[i] ^ 1 << int(rng.integers(8))]) + data[i + 1 :],
    "duplicate": lambda data, i, _: data[: i + 1] + data[i:],
    "insert": lambda data, i, rng: data[: i + 1] + rng.bytes(1) + data[i + 1 :],
    "swap": lambda data, i, _: data[:i] + data[i : i + 2][::-1] + data[i + 2 :],
    "blank": lambda data, i, _: data[:i] + bytes(len(data[i : i + 4])) + data[i + 4 :],
    "cut": lambda data, i, _: data[:i],
    "headless": lambda data, i, _: data[i + 1 :],
    "noise": lambda data, _, rng: rng.bytes(int(rng.integers(1, 21))) + data,
    "checksum": lambda data, _, rng: data[:-1] + bytes([data[-1] ^ int(rng.integers(1, 256))]),
}
REQUEST = {"request_drop": REPLY["drop"], "request_flip": REPLY["flip"], "deaf": lambda *_: b""}


class Faults:
    """Switches of one device ('lrf' or 'head'); all that is random follows from the seed.

    `counts`, a Counter, tells how often each was injected; `changed` is called when one was armed.
    """

    def __init__(self, device, seed=0, machine=REAL, changed=lambda: None):
        self.device, self.counts, self.changed, self._now = device, Counter(), changed, machine.now
        self.rng, self.away_s = np.random.default_rng([seed, *device.encode()]), AWAY_S
        self._lock, self._times, self._until = threading.Lock(), Counter(), {}

    def inject(self, name, count=1, *, seconds=None):
        """Arm a fault of `FAULTS` for so many opportunities (replies, requests, ...) from now on.

        With `seconds` at every opportunity for so long instead; for 'unplug' how long the port is away. ValueError for
        a fault that this device does not know.
        """
        if name not in FAULTS or self.device not in FAULTS[name].devices:
            known = ", ".join(n for n, f in FAULTS.items() if self.device in f.devices)
            raise ValueError(f"no fault '{name}' of device '{self.device}'; there are {known}")
        with self._lock:
            if name == "unplug":
                self.away_s, seconds = AWAY_S if seconds is None else seconds, None
            if seconds is None:
                self._times[name] += count
            else:
                self._until[name] = self._now() + seconds
        self.changed()

    def clear(self, name=None):
        """Disarm one fault, or all."""
        with self._lock:
            for switches in (self._times, self._until):
                switches.clear() if name is None else switches.pop(name, None)

    @property
    def armed(self):
        """Names of the faults that can still happen, a set."""
        with self._lock:
            return {*+self._times, *(name for name, end in self._until.items() if end > self._now())}

    def hit(self, name):
        """Whether the fault happens at this opportunity, which is then counted."""
        with self._lock:
            hit = self._times[name] > 0 or self._now() < self._until.get(name, 0)
            self._times[name] -= self._times[name] > 0
            self.counts.update([name] * bool(hit))
            return hit

    def mangle(self, data, changes=REPLY):
        """Bytes as they are after those of the faults that hit them; each changes something where it can."""
        for name, change in changes.items():
            if data and self.hit(name):
                tries = (change(data, int(self.rng.integers(len(data))), self.rng) for _ in range(100))
                data = next((changed for changed in tries if changed != data), data)
        return data


def resample(data, sent, read):
    """What a receiver set to one rate makes of bytes sent at another, without pauses, 8N1; 0 Bd reads nothing.

    Frames without a stop bit read as zero, as Linux hands them over.
    """
    if sent == read or not data or not read:
        return data if read else b""
    frames = np.ones((len(data), 10), np.uint8)
    frames[:, 0] = 0
    frames[:, 1:9] = np.unpackbits(np.frombuffer(data, np.uint8)[:, None], axis=1, bitorder="little")
    level, ratio, out, at = frames.ravel(), sent / read, bytearray(), 0.0
    lows, places = np.flatnonzero(level == 0), (np.arange(10) + 0.5) * ratio
    level = np.append(level, np.ones(math.ceil(10 * ratio) + 1, np.uint8))  # the line rests at 1
    while (row := np.searchsorted(lows, int(at))) < len(lows):
        start = max(lows[row], at)
        bits = level[(start + places).astype(int)]
        at = start + 9.5 * ratio
        if bits[0]:  # too short for a start bit
            at = start + max(0.5 * ratio, 1)
        elif bits[9]:
            out += np.packbits(bits[1:9], bitorder="little").tobytes()
        else:  # no stop bit: on with the next rise of the line
            out.append(0)
            at = int(at) + int(np.argmax(level[int(at) :]))
    return bytes(out)


class SerialDevice:
    """What all devices on a line have in common; a context manager, or `start` and `close`.

    A subclass has ``baudrate``, ``receive(data, at)`` and ``prepare(data)`` (a reply with faults of its own).

    Parameters
    ----------
    kind : {'lrf', 'head'}
    path : path-like
        Where the port appears, a symbolic link that stays the same when the port comes back.
    clock : Clock
    seed : int

    Attributes
    ----------
    faults : Faults
    counts : dict
        Bytes 'received', 'sent', 'lost' (buffer full), 'unheard' (port not open), 'garbled' (rates differ).
    error : Exception or None
        What ended the device by itself.
    """

    def __init__(self, kind, path, clock, seed=0):
        self.path, self.clock, self.error = str(path), clock, None
        self.port = getattr(clock.machine, "terminal", Terminal)(self)  # a test's is in memory
        self.faults = Faults(kind, seed, clock.machine, self.port.wake)
        self.counts = dict.fromkeys(("received", "sent", "lost", "unheard", "garbled"), 0)
        self._agenda, self._order, self._last, self.busy_until, self._heard = [], itertools.count(), {}, 0.0, 0.0

    byte_s = property(lambda self: 10 / self.baudrate, doc="Seconds a byte takes.")

    def start(self):
        """Let the port appear."""
        self.port.plug()
        self.port.start()
        return self

    def close(self, *_):
        """Remove the port."""
        self.port.end()

    __enter__, __exit__ = start, close

    def at(self, instant, action, tag=None):
        """Call ``action(instant)`` when its time has come."""
        heapq.heappush(self._agenda, (instant, next(self._order), action, tag))

    def cancel(self, *tags):
        """Forget what was planned under tags."""
        self._agenda = [item for item in self._agenda if item[3] not in tags]
        heapq.heapify(self._agenda)

    def abort(self):
        """Stop sending at once, in the middle of a reply if need be."""
        self.cancel(SENDING)
        self.busy_until = 0.0

    def write(self, data, at, then=None):
        """Send bytes as they are, after those given before; ``then(instant)`` is called when the last one is out."""
        begin, byte_s = max(at, self.busy_until), self.byte_s
        self.busy_until, some = begin + len(data) * byte_s, max(1, int(CHUNK_S * self.clock.scale / byte_s))
        for first in range(0, len(data), some):
            chunk = data[first : first + some]
            self.at(begin + (first + len(chunk)) * byte_s, lambda _, chunk=chunk: self._put(chunk), SENDING)
        if then is not None:
            self.at(self.busy_until, then, SENDING)

    def reply(self, kind, data, at, then=None, burst=None, gap=0.0):
        """Send a reply as :meth:`write` does, but subject to faults; `then` is called even if one swallowed it.

        Replies of one kind replace each other for the fault 'stale'. At most `burst` bytes leave at once; the next
        follow `gap` seconds after the first of them.
        """
        hit = self.faults.hit
        old, self._last[kind] = self._last.get(kind), data
        data = self.faults.mangle(self.prepare(old if old is not None and hit("stale") else data))
        at += DELAY_S * hit("delay")
        if hit("silence"):
            data = b""
        for _ in range(1 + hit("twice")):
            if burst is None and len(data) > 1 and hit("pause"):
                burst, gap = len(data) // 2, len(data) // 2 * self.byte_s + PAUSE_S
            step = burst or len(data) or 1
            for k, first in enumerate(range(0, len(data), step)):
                self.write(data[first : first + step], at + k * gap)
        self.write(b"", at, then)

    # -------------------------------------------------------------------------------------------- for the port

    def due(self):
        """When something is to be done, as now() of the machine."""
        due = self._agenda[0][0] if self._agenda else math.inf
        return self.clock.machine.now() + max(0.0, (due - self.clock.now()) / self.clock.scale)

    def advance(self):
        """Do all that is due by now."""
        if self.port.there and self.faults.hit("unplug"):
            self.port.unplug()
            self.at(self.clock.now() + self.faults.away_s * self.clock.scale, lambda _: self.port.plug())
        while self._agenda and self._agenda[0][0] <= self.clock.now() + SOON:
            instant, _, action, _ = heapq.heappop(self._agenda)
            action(instant)

    def hear(self, data):
        """Bytes that the host sends."""
        self.counts["received"] += len(data)
        if self.faults.hit("echo"):
            self._put(data)
        data = self.faults.mangle(self._through(data, self.port.rate, self.baudrate), REQUEST)
        self._heard = max(self._heard, self.clock.now()) + len(data) * self.byte_s
        if data:
            self.receive(data, self._heard)

    def _through(self, data, sent, read):
        """Bytes after the line, garbled where the two ends are set to different rates."""
        self.counts["garbled"] += len(data) * (sent != read)
        return resample(data, sent, read)

    def _put(self, data):
        if not self.port.open:
            self.counts["unheard"] += len(data)
            return
        data = self._through(data, self.baudrate, self.port.rate)
        done = self.port.put(data)
        self.counts["sent"] += done
        self.counts["lost"] += len(data) - done


class Terminal(threading.Thread):
    """A pseudo-terminal, and the thread that serves it; it sleeps until bytes come, something is due, or LOOK_S."""

    def __init__(self, device):
        super().__init__(name=f"emulated {Path(device.path).name}", daemon=True)
        self._device, self._quit, self._master, self.open, self.wake = device, False, None, False, lambda: None

    there = property(lambda self: self._master is not None)
    rate = property(lambda self: RATES.get(termios.tcgetattr(self._master)[5], 0))

    def end(self):
        """Take the port away and end the thread."""
        self._quit = True
        if self.is_alive():
            self.join(5)

    def run(self):
        """Serve the port until it is closed."""
        try:
            while not self._quit:
                wait = max(0.0, min(self._device.due() - REAL.now(), LOOK_S))
                select.select([self._master] if self.open else [], [], [], wait)
                if self.there:
                    self._listen()
                self._device.advance()
        except Exception as error:  # a device that dies must say so: the next look at `error` shows it
            self._device.error = error
            raise
        finally:
            self.unplug()

    def _listen(self):
        """Take the bytes of the host; see whether it holds the port open."""
        state = select.poll()
        state.register(self._master, select.POLLIN)
        event = dict(state.poll(0)).get(self._master, 0)
        if event & select.POLLIN:
            with contextlib.suppress(OSError):
                self._device.hear(os.read(self._master, 4096))
        if self.open and event & select.POLLHUP:  # a port forgets what nobody read when it is closed
            with contextlib.suppress(OSError, termios.error):
                slave = os.open(os.readlink(self._device.path), os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
                termios.tcflush(slave, termios.TCIFLUSH)
                os.close(slave)
        self.open = not event & select.POLLHUP

    def put(self, data):
        """Send bytes; how many went into the buffer."""
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0
        except OSError:  # closed at this moment
            self.open = False
            return len(data)

    def plug(self):
        """Make the pseudo-terminal and let its path point to it."""
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        path = Path(self._device.path)
        beside = path.with_name(f".{path.name}.{os.getpid()}")
        beside.unlink(missing_ok=True)
        beside.symlink_to(os.ttyname(slave))
        beside.replace(path)
        os.close(slave)
        self.open = False

    def unplug(self):
        """Take the pseudo-terminal away; whoever holds it gets an error."""
        if self.there:
            Path(self._device.path).unlink(missing_ok=True)
            os.close(self._master)
            self._master, self.open = None, False
