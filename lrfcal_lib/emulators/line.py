"""A device at the end of a serial line: the times of its bytes, and the port it is at.

The port is a pseudo-terminal served by a thread, whose rate is read at the master so that a wrong
one garbles bytes as on a real line.
"""

import contextlib
import heapq
import itertools
import math
import os
import select
import termios
import threading
import tty
from pathlib import Path

import numpy as np

from lrfcal_lib.drivers.port import REAL

# code of a rate in termios -> baud
NAMES = [name for name in dir(termios) if name[0] == "B" and name[1:].isdigit()]
RATES = {getattr(termios, name): int(name[1:]) for name in NAMES}
CHUNK_S = 0.005  # bytes that leave within this time are written at once
LOOK_S = 0.02  # how often to see whether somebody opened the port
SOON = 1e-9  # s; so far ahead counts as now, whatever the rounding
SENDING = "sending"  # tag of what is planned for the bytes on their way out


class SerialDevice:
    """What all devices on a line have in common; a context manager, or `start` and `close`.

    A subclass has ``baudrate`` and ``receive(data, at)``. Instants are ``now()`` of the host that
    it lives on.

    Parameters
    ----------
    path : path-like
        Where the port appears, a symbolic link that stays the same when the port comes back.
    host : Host
    seed : int

    Attributes
    ----------
    error : Exception or None
        What ended the device by itself.
    """

    def __init__(self, path, host, seed=0):
        self.path = str(path)
        self.host = host
        self.error = None
        self.port = getattr(host, "terminal", Terminal)(self)  # a test's is in memory
        self.busy_until = 0.0  # of the line to the host
        self._heard = 0.0  # the last byte from the host
        self._noise = np.random.default_rng([seed, 4])
        self._agenda = []  # heap of instant, order, action, tag
        self._order = itertools.count()

    @property
    def byte_s(self):
        """Seconds a byte takes."""
        return 10 / self.baudrate

    def start(self):
        """Let the port appear."""
        self.port.plug()
        self.port.start()
        return self

    def close(self, *_):
        """Remove the port."""
        self.port.end()

    __enter__ = start
    __exit__ = close

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
        """Send bytes after those given before; ``then(instant)`` is called when the last is out."""
        byte_s = self.byte_s
        begin = max(at, self.busy_until)
        self.busy_until = begin + len(data) * byte_s
        at_once = max(1, int(CHUNK_S / byte_s))
        for first in range(0, len(data), at_once):
            chunk = data[first : first + at_once]
            out = begin + (first + len(chunk)) * byte_s
            self.at(out, lambda _, chunk=chunk: self._put(chunk), SENDING)
        if then is not None:
            self.at(self.busy_until, then, SENDING)

    reply = write

    # ------------------------------------------------------------------------------- for the port

    def due(self):
        """When something is to be done."""
        return max(self.host.now(), self._agenda[0][0]) if self._agenda else math.inf

    def advance(self):
        """Do all that is due by now."""
        while self._agenda and self._agenda[0][0] <= self.host.now() + SOON:
            instant, _, action, _ = heapq.heappop(self._agenda)
            action(instant)

    def hear(self, data):
        """Bytes that the host sends."""
        data = self.through(data, self.port.rate, self.baudrate)
        self._heard = max(self._heard, self.host.now()) + len(data) * self.byte_s
        if data:
            self.receive(data, self._heard)

    def through(self, data, sent, read):
        """Bytes after the line.

        As much noise as fits into their time where its ends are set to different rates.
        """
        if sent == read:
            return data
        return self._noise.bytes(math.ceil(len(data) * read / sent) if sent else 0)

    def _put(self, data):
        if self.port.open:
            self.port.put(self.through(data, self.baudrate, self.port.rate))


class Terminal(threading.Thread):
    """A pseudo-terminal, and the thread that serves it.

    It sleeps until bytes come, something is due, or LOOK_S.
    """

    def __init__(self, device):
        super().__init__(name=f"emulated {Path(device.path).name}", daemon=True)
        self.open = False
        self._device = device
        self._quit = False
        self._master = None

    @property
    def there(self):
        return self._master is not None

    @property
    def rate(self):
        return RATES.get(termios.tcgetattr(self._master)[5], 0)

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
        except Exception as error:  # a device that dies must say so: a look at `error` shows it
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
        # a port forgets what nobody read when it is closed
        if self.open and event & select.POLLHUP:
            with contextlib.suppress(OSError, termios.error):
                slave = os.open(
                    os.readlink(self._device.path), os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK
                )
                termios.tcflush(slave, termios.TCIFLUSH)
                os.close(slave)
        self.open = not event & select.POLLHUP

    def put(self, data):
        """Send bytes; what the buffer cannot hold is lost."""
        try:
            os.write(self._master, data)
        except BlockingIOError:
            pass
        except OSError:  # closed at this moment
            self.open = False

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
            self._master = None
            self.open = False
