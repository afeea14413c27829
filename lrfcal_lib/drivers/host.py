"""What drivers have of the machine they run on: time, waiting, threads, ports. One that is real, one for tests.

On a :class:`VirtualHost` no time passes but what its threads wait for: devices on it (`emulators.line`) are advanced
while they wait, one thread runs at a time, and every run is the same.
"""

import math
import threading
import time
from functools import partial

from lrfcal_lib.drivers.port import PortError, open_port, set_rate

MOMENT_S = 1e-3
LEAST_S = 1e-9  # that a wait takes, so that rounding errors of what is left do not make it endless


class Host:
    """This machine; names and meanings are those of `time` and `threading`."""

    now, time = staticmethod(time.monotonic), staticmethod(time.time)
    event, lock = threading.Event, staticmethod(threading.RLock)
    port, set_rate = staticmethod(open_port), staticmethod(set_rate)

    @staticmethod
    def sleep(seconds):
        """Wait; moments are spent awake, since a busy machine gives the processor back late to those who sleep."""
        end = time.monotonic() + seconds
        if seconds > MOMENT_S:
            time.sleep(seconds)
        while time.monotonic() < end:
            pass

    @staticmethod
    def thread(target, name):
        """A daemon thread that is not started yet."""
        return threading.Thread(target=target, name=name, daemon=True)


REAL = Host()


class VirtualHost:
    """A machine whose time passes only while all of its threads wait; what it has is named as in :class:`Host`.

    The thread that makes it is one of them; further ones come from ``thread(target, name)``.

    Attributes
    ----------
    devices : list
        Have ``due()``, the instant of what comes next, and ``advance()``, to do all that is due by now.
    ports : dict of str to callable
        Path of a port to (baudrate, timeout) -> what is used of serial.Serial; raises PortError.
    """

    def __init__(self):
        self.devices, self.ports, self._now, self._waiting = [], {}, 0.0, []
        self.event, self.lock, self.thread = partial(_Event, self), partial(_Lock, self), partial(_Thread, self)

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
            raise PortError(f"there is no port {path}: check cable and power; present are {present}")
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
        while (next_one := next((one for one in self._waiting if one.over(self._now)), None)) is None:
            due = min([one.end for one in self._waiting] + [device.due() for device in self.devices], default=math.inf)
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
        self.holds, self.end, self.found, self.turn = holds, end, None, threading.Semaphore(0)

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
        if not self._host.wait(lambda: self._owner in (None, me), None if timeout < 0 else timeout):
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
