"""A serial line to an emulated device: a pseudo-terminal with a baud rate, byte times, limits and faults.

The slave is what other programs open. Its rate is read at the master, so a wrong rate garbles bytes as on a real line.
One thread serves a device; it sleeps until bytes come or something is due.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import os
import select
import termios
import threading
import time
import tty
from pathlib import Path

import numpy as np

from lrfcal_lib.drivers.emulators.faults import REQUEST, mangle

RATES = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}
CHUNK_S = 0.005  # bytes that are due within this time are written at once
LONGEST_WAIT_S = 0.25
CLOSED_LOOK_S = 0.02  # how often to see whether somebody opened the port
FASTEST = 8.0  # at 16 times, threads of a program get the processor too seldom to read a line at 500000 Bd
DELAY_S, PAUSE_S, AWAY_S = 0.7, 0.08, 0.5  # of the faults 'delay', 'pause' and 'unplug'


class Clock:
    """Time of the emulated devices.

    Parameters
    ----------
    scale : float
        Seconds of the devices in a second of the host, 8 at most.

    Raises
    ------
    ValueError
        For a scale that no rig can be run at.
    """

    def __init__(self, scale=1.0):
        if not 0 < scale <= FASTEST:
            raise ValueError(f"time_scale is {scale}: it must be positive, 1 for real time, and at most {FASTEST:g}")
        self.scale, self._zero, self._host_zero = scale, time.monotonic(), time.time()

    def now(self):
        """Seconds of the devices since the clock was made."""
        return (time.monotonic() - self._zero) * self.scale

    def host(self, instant):
        """Instant of the devices as time.time() of the host."""
        return self._host_zero + np.asarray(instant) / self.scale

    def device(self, time_s):
        """Inverse of :meth:`host`."""
        return (np.asarray(time_s) - self._host_zero) * self.scale


def resample(data, sent, read):
    """What a receiver set to one rate makes of bytes sent at another.

    Parameters
    ----------
    data : bytes
        Sent without pauses, 8N1.
    sent, read : int
        Baud rates; 0 reads nothing.

    Returns
    -------
    bytes
        Frames without a stop bit read as zero, as Linux hands them over.
    """
    if sent == read or not data:
        return data
    if not sent or not read:
        return b""
    frames = np.ones((len(data), 10), np.uint8)
    frames[:, 0] = 0
    frames[:, 1:9] = np.unpackbits(np.frombuffer(data, np.uint8)[:, None], axis=1, bitorder="little")
    return _receive(frames.tobytes(), sent / read)


def _receive(level, ratio):
    """Bytes out of the level of a line; `ratio` is how many of its bits pass in one of the receiver's."""
    out, at, end = bytearray(), 0.0, len(level)

    def sample(bits):
        place = int(start + bits * ratio)
        return level[place] if place < end else 1

    while (low := level.find(0, int(at))) >= 0:
        start = max(low, at)
        at = start + 9.5 * ratio
        if sample(0.5):  # too short for a start bit
            at = start + max(0.5 * ratio, 1)
        elif sample(9.5):
            out.append(sum(sample(k + 1.5) << k for k in range(8)))
        else:
            out.append(0)
            at = max(level.find(1, min(int(at), end)), 0) or end
    return bytes(out)


class _Part:
    """Bytes on their way out: not before `start`; `then` is called with the time at which the last is out."""

    def __init__(self, start, data, then=None):
        self.start, self.data, self.then, self.begun, self.sent = start, data, then, None, 0


class Line(threading.Thread):
    """A device at the end of a pseudo-terminal.

    Parameters
    ----------
    path : path-like
        Where the port appears, a symbolic link that stays the same when the port comes back.
    device
        Has ``baudrate``, ``receive(data, at)`` and ``prepare(data)`` (a reply with the faults of this device).
    clock : Clock
    faults : Faults

    Attributes
    ----------
    counts : dict
        Bytes 'received', 'sent', 'lost' (buffer full), 'unheard' (port not open), 'garbled' (rates differ).
    """

    def __init__(self, path, device, clock, faults):
        super().__init__(name=f"emulated {Path(path).name}", daemon=True)
        self.path, self.device, self.clock, self.faults = Path(path), device, clock, faults
        self.counts = dict.fromkeys(("received", "sent", "lost", "unheard", "garbled"), 0)
        self.error = None
        self._agenda, self._order, self._parts = [], itertools.count(), []
        self._free, self._heard, self._back, self._quit = 0.0, 0.0, None, False
        self._last = {}
        self._master, self._open = None, False
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_write, False)
        faults.changed = self.wake

    # ------------------------------------------------------------------------------------------- for the device

    def at(self, instant, action, tag=None):
        """Call ``action(instant)`` when its time has come."""
        heapq.heappush(self._agenda, (instant, next(self._order), action, tag))

    def cancel(self, tag):
        """Forget what was planned under a tag."""
        self._agenda = [item for item in self._agenda if item[3] != tag]
        heapq.heapify(self._agenda)

    def abort(self):
        """Stop sending at once, in the middle of a reply if need be."""
        self._parts, self._free = [], 0.0

    @property
    def busy_until(self):
        """When everything given so far has left."""
        end = self._free
        for part in self._parts:
            begun = part.begun if part.begun is not None else max(part.start, end)
            end = begun + len(part.data) * self.byte_s
        return end

    @property
    def byte_s(self):
        """Seconds a byte takes."""
        return 10 / self.device.baudrate

    def write(self, data, at, then=None):
        """Send bytes as they are, after those given before."""
        self._parts.append(_Part(at, data, then))

    def reply(self, kind, data, at, then=None, burst=None, gap=0.0):
        """Send a reply, subject to faults.

        Parameters
        ----------
        kind : hashable
            Replies of one kind replace each other for the fault 'stale'.
        data : bytes
        at : float
            When the first byte leaves.
        then : callable, optional
            Called with the instant at which the last byte is out, also when a fault swallowed the reply.
        burst : int, optional
            At most so many bytes leave at once; the next follow `gap` seconds after the first of them.
        """
        hit = self.faults.hit
        old, self._last[kind] = self._last.get(kind), data
        data = old if old is not None and hit("stale") else data
        data = mangle(self.device.prepare(data), self.faults)
        at += DELAY_S * hit("delay")
        if hit("silence"):
            data = b""
        for _ in range(1 + hit("twice")):
            self._write_bursts(data, at, burst, gap)
        self._parts[-1].then = then

    def _write_bursts(self, data, at, burst, gap):
        if burst is None and len(data) > 1 and self.faults.hit("pause"):
            burst, gap = max(1, len(data) // 2), len(data) // 2 * self.byte_s + PAUSE_S
        size = burst or max(1, len(data))
        for first in range(0, max(1, len(data)), size):
            self.write(data[first : first + size], at + first // size * gap)

    # ------------------------------------------------------------------------------------------- for everybody else

    def wake(self):
        """Let the thread look at its agenda and its faults now."""
        with contextlib.suppress(OSError):
            os.write(self._wake_write, b"x")

    def start(self):
        """Make the port and serve it."""
        self._plug()
        super().start()

    def close(self):
        """Remove the port and end the thread."""
        self._quit = True
        self.wake()
        if self.is_alive():
            self.join(5)
        for fd in (self._wake_read, self._wake_write):
            with contextlib.suppress(OSError):
                os.close(fd)

    @property
    def plugged(self):
        """Whether the port is there."""
        return self._master is not None

    # ------------------------------------------------------------------------------------------- the thread

    def run(self):
        """Move bytes both ways until the line is closed; what goes wrong is kept in `error`."""
        try:
            while not self._quit:
                self._listen(self._wait())
                if self._master is not None and self.faults.hit("unplug"):
                    self._unplug(self.faults.seconds("unplug", AWAY_S))
                if self._back is not None and time.monotonic() >= self._back:
                    self._plug()
                self._act(self.clock.now())
                self._send(self.clock.now())
        except Exception as error:  # a device that dies must say so: the next look at `error` shows it
            self.error = error
            raise
        finally:
            self._unplug(None)

    def _wait(self):
        """Seconds of the host until something is due."""
        now = self.clock.now()
        due = [self._agenda[0][0]] if self._agenda else []
        if self._parts:
            part = self._parts[0]
            begun = part.begun if part.begun is not None else max(part.start, self._free)
            end = begun + len(part.data) * self.byte_s
            due.append(min(end, max(begun, now) + max(CHUNK_S * self.clock.scale, self.byte_s)))
        wait = (min(due, default=np.inf) - now) / self.clock.scale
        if self._back is not None:
            wait = min(wait, self._back - time.monotonic())
        return min(max(wait, 0.0), LONGEST_WAIT_S)

    def _listen(self, wait):
        """Wait for bytes of the host, a wake-up, or the time."""
        watch = select.poll()
        watch.register(self._wake_read, select.POLLIN)
        if self._open:
            watch.register(self._master, select.POLLIN)
        elif self._master is not None:  # a port that nobody holds reports so at once: look now and then
            wait = min(wait, CLOSED_LOOK_S)
        found = dict(watch.poll(wait * 1000))
        if self._wake_read in found:
            os.read(self._wake_read, 4096)
        if self._master is not None and (self._master in found or not self._open):
            self._look()

    def _look(self):
        """Read what the host sent, and see whether it holds the port open."""
        watch = select.poll()
        watch.register(self._master, select.POLLIN)
        event = dict(watch.poll(0)).get(self._master, 0)
        if event & select.POLLIN:
            with contextlib.suppress(OSError):
                self._hear(os.read(self._master, 4096))
        held = not event & select.POLLHUP
        if self._open and not held:
            self._flush()
        self._open = held

    def _flush(self):
        """A port forgets what nobody read when it is closed."""
        with contextlib.suppress(OSError, termios.error):
            slave = os.open(os.readlink(self.path), os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            termios.tcflush(slave, termios.TCIFLUSH)
            os.close(slave)

    def _hear(self, data):
        self.counts["received"] += len(data)
        if self.faults.hit("echo"):
            self._put(data)
        data = mangle(self._through(data, to_device=True), self.faults, REQUEST)
        self._heard = max(self._heard, self.clock.now()) + len(data) * self.byte_s
        if data:
            self.device.receive(data, self._heard)

    def _through(self, data, to_device):
        """Bytes after the line, garbled where the two ends are set to different rates."""
        host = RATES.get(termios.tcgetattr(self._master)[5], 0)
        rates = (host, self.device.baudrate) if to_device else (self.device.baudrate, host)
        if rates[0] != rates[1]:
            self.counts["garbled"] += len(data)
        return resample(data, *rates)

    def _act(self, now):
        while self._agenda and self._agenda[0][0] <= now:
            instant, _, action, _ = heapq.heappop(self._agenda)
            action(instant)

    def _send(self, now):
        """Write the bytes that have left the device by now."""
        while self._parts:
            part = self._parts[0]
            if part.begun is None:
                part.begun = max(part.start, self._free)
            end = part.begun + len(part.data) * self.byte_s
            due = len(part.data) if now >= end else max(0, int((now - part.begun) / self.byte_s))
            self._put(part.data[part.sent : due])
            part.sent = max(due, part.sent)
            if now < end:
                return
            self._free = end
            self._parts.pop(0)
            if part.then is not None:
                part.then(end)

    def _put(self, data):
        if not data:
            return
        if not self._open:
            self.counts["unheard"] += len(data)
            return
        try:
            data = self._through(data, to_device=False)
            done = os.write(self._master, data)
        except BlockingIOError:
            done = 0
        except (OSError, termios.error):  # closed at this moment
            self._open, done = False, len(data)
        self.counts["sent"] += done
        self.counts["lost"] += len(data) - done

    # ------------------------------------------------------------------------------------------- the port

    def _plug(self):
        """Make the pseudo-terminal and let its path point to it."""
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        beside = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        beside.unlink(missing_ok=True)
        beside.symlink_to(os.ttyname(slave))
        beside.replace(self.path)
        os.close(slave)
        self._back, self._open = None, False

    def _unplug(self, seconds):
        """Take the pseudo-terminal away; whoever holds it gets an error."""
        if self._master is None:
            return
        self.path.unlink(missing_ok=True)
        os.close(self._master)
        self._master, self._open = None, False
        self._back = None if seconds is None else time.monotonic() + seconds
