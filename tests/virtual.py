"""Devices in virtual time: no time passes but what a test waits for, so that every run is the same and instant."""

import contextlib
import math
import threading
from functools import partial

import numpy as np
from faults import FaultyHead, FaultyLms

from lrfcal_lib.drivers.port import PortError
from lrfcal_lib.session.lms2xx_codec import Configuration

LEAST_S = 1e-9  # that a wait takes, so that rounding errors of what is left do not make it endless
ROOM = 4095  # bytes that a port keeps until they are read
INDEXED = Configuration().changed(unit="mm", realtime_indices=True)


class VirtualHost:
    """A machine whose time passes only while all of its threads wait; what it has is named as in `port.Host`.

    The thread that makes it is one of them; further ones come from ``thread(target, name)``. Devices on it are advanced
    while they wait, one thread runs at a time, and every run is the same.

    Attributes
    ----------
    devices : list
        Have ``due()``, the instant of what comes next, and ``advance()``, to do all that is due by now.
    ports : dict of str to callable
        Path of a port to (baudrate, timeout) -> what is used of serial.Serial; raises PortError.
    """

    def __init__(self):
        self.devices, self.ports, self._now, self._waiting = [], {}, 0.0, []
        self.event, self.lock, self.thread = (
            partial(_Event, self),
            partial(_Lock, self),
            partial(_Thread, self),
        )
        self.terminal = Memory

    def now(self):
        """Seconds since the host was made."""
        return self._now

    def time(self):
        """The same as a date, s."""
        return 1.2e9 + self._now

    def sleep(self, seconds):
        """Wait."""
        self.wait(lambda: False, seconds)

    def wait(self, holds, seconds=None):
        """Wait until ``holds()`` is true, at most for so long (None: for ever); returns what it is then."""
        if (found := holds()) or seconds is not None and seconds <= 0:
            return found
        end = math.inf if seconds is None else self._now + max(seconds, LEAST_S)
        return self._pass_on(_Waiting(holds, end))

    def port(self, path, baudrate, *, timeout):
        """As :func:`port.open_port`."""
        if str(path) not in self.ports:
            present = ", ".join(sorted(self.ports)) or "none"
            raise PortError(
                f"there is no port {path}: check cable and power; present are {present}"
            )
        return self.ports[str(path)](baudrate, timeout)

    @staticmethod
    def set_rate(port, baudrate):
        """As :func:`port.set_rate`."""
        port.baudrate = baudrate

    def _pass_on(self, me=None):
        """Let time pass until a thread can go on, and let it; returns when `me` can, at once without one."""
        self._waiting += [] if me is None else [me]
        if not self._waiting:
            return None
        while (
            next_one := next((one for one in self._waiting if one.over(self._now)), None)
        ) is None:
            due = min(
                [one.end for one in self._waiting]
                + [device.due() for device in self.devices],
                default=math.inf,
            )
            if math.isinf(due):
                raise RuntimeError("all threads wait for what will never happen")
            self._now = max(self._now, due)
            for device in list(self.devices):
                device.advance()
        self._waiting.remove(next_one)
        if next_one is not me:
            next_one.turn.release()
            if me is not None:
                me.turn.acquire()
        return None if me is None else me.found


class _Waiting:
    """A thread that waits for a condition or the end of its time."""

    def __init__(self, holds, end):
        self.holds, self.end, self.found, self.turn = (
            holds,
            end,
            None,
            threading.Semaphore(0),
        )

    def over(self, now):
        self.found = self.holds()
        return self.found or now >= self.end


class _Event(threading.Event):
    def __init__(self, host):
        super().__init__()
        self._host = host

    def wait(self, timeout=None):
        return self._host.wait(self.is_set, timeout)


class _Lock:
    def __init__(self, host):
        self._host, self._owner, self._depth = host, None, 0

    def acquire(self, timeout=-1):
        me = threading.get_ident()
        if not self._host.wait(
            lambda: self._owner in (None, me), None if timeout < 0 else timeout
        ):
            return False
        self._owner, self._depth = me, self._depth + 1
        return True

    def release(self):
        self._depth -= 1
        self._owner = self._owner if self._depth else None

    __enter__ = acquire

    def __exit__(self, *_):
        self.release()


class _Thread(threading.Thread):
    def __init__(self, host, target, name):
        super().__init__(target=target, name=name, daemon=True)
        self._host, self._alive, self._begin = host, False, _Waiting(lambda: True, 0.0)

    def start(self):
        self._alive = True
        self._host._waiting.append(self._begin)
        super().start()

    def run(self):
        """Wait for its turn, then do it."""
        self._begin.turn.acquire()
        try:
            super().run()
        finally:
            self._alive = False
            self._host._pass_on()

    def join(self, timeout=None):
        self._host.wait(lambda: not self._alive, timeout)

    def is_alive(self):
        return self._alive


class Memory:
    """A port in memory, of a device on a VirtualHost: both ends, the program's as far as a serial.Serial is used.

    What was unplugged stays lost for the program that holds it; the device gets a new one.
    """

    def __init__(self, device):
        self.port, self.device, self.machine, self.wake = (
            device.path,
            device,
            device.host,
            device.advance,
        )
        self.open, self.lost, self.data = False, False, b""

    there = property(lambda self: self.port in self.machine.ports)
    rate = property(lambda self: self.baudrate if self.open else 0)

    def start(self):
        self.machine.devices.append(self.device)

    def end(self):
        with contextlib.suppress(ValueError):
            self.machine.devices.remove(self.device)
        self.unplug()

    def plug(self):
        self.machine.ports[self.port] = self._opened

    def unplug(self):
        self.machine.ports.pop(self.port, None)
        self.lost, self.open, self.device.port = True, False, Memory(self.device)

    def put(self, data):
        self.data += data[: ROOM - len(self.data)]

    # the end of the program

    def _opened(self, baudrate, timeout):
        if self.open:
            raise PortError(
                f"the port {self.port} is busy, held by another program: close that program"
            )
        self.baudrate, self.timeout, self.open, self.data = baudrate, timeout, True, b""
        return self

    def _here(self):
        if self.lost:
            raise OSError(f"{self.port} was unplugged")

    @property
    def in_waiting(self):
        self._here()
        return len(self.data)

    def read(self, size=1):
        self.machine.wait(lambda: self.lost or len(self.data) >= size, self.timeout)
        self._here()
        found, self.data = self.data[:size], self.data[size:]
        return found

    def write(self, data):
        self._here()
        self.device.hear(bytes(data))

    def reset_input_buffer(self):
        self._here()
        self.data = b""

    def close(self):
        self.open = False


class Source:
    """Scans that are a cheap function of the mirror's turn: no two in a row alike, every range within 8 m."""

    def scan(self, turn, quarters, times):
        reasons = np.where((quarters + turn) % 97 == 0, 1 + turn % 2 * 3, 0)
        return 1.0 + (quarters * 13 + turn * 37) % 6000 / 1000, reasons


def lms(source=None, host=None, **options):
    """An emulated LMS2xx on a virtual host of its own, with its port."""
    return FaultyLms(
        source or Source(), path="lrf", host=host or VirtualHost(), **options
    ).start()


def head(host=None, **options):
    """An emulated head on a virtual host of its own, with its port."""
    return FaultyHead(path="head", host=host or VirtualHost(), **options).start()


class Bench:
    """A program at the other end of a device's line; its rate is the device's unless one is given."""

    def __init__(self, device, rate=None):
        self.device, self.rate, self.machine, self.out = device, rate, device.host, []
        self.port, put = (
            self.machine.port(device.path, rate or device.baudrate, timeout=0),
            device.port.put,
        )

        def noted(data):
            self.out += [(self.now, byte) for byte in data]
            put(data)

        device.port.put = noted

    now = property(lambda self: self.machine.now())
    heard = property(lambda self: bytes(byte for _, byte in self.out))

    def ask(self, raw):
        """Send a request (bytes, or hexadecimal digits); what came before is forgotten."""
        self.port.baudrate = self.rate or self.device.baudrate
        self.port.reset_input_buffer()
        self.out.clear()
        self.port.write(bytes.fromhex(raw) if isinstance(raw, str) else raw)

    def send(self, raw, wait=1.0):
        """What comes back within a while."""
        self.ask(raw)
        return self.run(wait)

    def run(self, wait):
        """Let time pass; all that came back so far."""
        self.machine.sleep(wait)
        self.port.reset_input_buffer()
        return self.heard
