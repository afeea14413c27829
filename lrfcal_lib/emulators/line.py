"""A device at the end of a serial line: the times of its bytes, and the port it is at.

The port is a pseudo-terminal served by a thread, whose rate is read at the master so that a wrong
one garbles bytes as on a real line.
"""

import bisect
import math
import os
import select
import termios
import threading
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from operator import itemgetter
from pathlib import Path

import numpy as np
from serial import Serial

from lrfcal_lib.drivers.port import REAL, Host

# code in termios -> baud
RATES = {getattr(termios, f"B{rate}", None): rate for rate in Serial.BAUDRATES}
CHUNK_S = 0.005  # bytes that leave within this time are written at once
LOOK_S = 0.02  # how often to see whether somebody opened the port
END_S = 5  # longest wait for the end of the thread
SOON = 1e-9  # s; so far ahead counts as now, whatever the rounding
SENDING = "sending"  # tag of what is planned until the last byte is out


class SerialDevice(ABC):
    """What all devices on a line have in common; a context manager, or `start` and `close`.

    Instants are ``now()`` of the host that it lives on, s. A telegram that was begun is forgotten
    when nothing more of it comes for `gap_s`.

    Parameters
    ----------
    path
        Where the port appears, a symbolic link.
    host
        Whose time the device lives in.
    seed
        Of noise on the line.

    Attributes
    ----------
    error : Exception or None
        What ended the device by itself.
    """

    gap_s: float

    def __init__(self, path: str | os.PathLike, host: Host, seed: int = 0):
        self.path = str(path)
        self.host = host
        self.error: Exception | None = None
        self.port = getattr(host, "terminal", Terminal)(self)  # a test's is in memory
        self.busy_until = 0.0  # of the line to the host
        self._heard = 0.0  # the last byte from the host
        self._noise = np.random.default_rng([seed, 4])
        self._buffer = b""  # bytes of a telegram that is not whole
        self._agenda: list = []  # instant, action, tag, in order

    @property
    @abstractmethod
    def baudrate(self) -> int:
        """Of the device."""

    @abstractmethod
    def take(self, raw: bytes, at: float) -> int:
        """Do what bytes of the host say.

        Parameters
        ----------
        raw
            Of any number of telegrams, whole or not.
        at
            Instant of the last of them, s.

        Returns
        -------
        int
            From where on they must be kept: a telegram may begin there whose end has not come yet.
        """

    @property
    def byte_s(self) -> float:
        """Seconds a byte takes."""
        return 10 / self.baudrate

    def start(self):
        """Let the port appear; the device."""
        self.port.plug()
        self.port.start()
        return self

    def close(self, *_) -> None:
        """Remove the port."""
        self.port.end()

    __enter__ = start
    __exit__ = close

    def at(
        self, instant: float, action: Callable[[float], None], tag: str | None = None
    ) -> None:
        """Plan something.

        Parameters
        ----------
        instant
            When, s.
        action
            ``action(instant)`` is called then.
        tag
            To cancel it by.
        """
        bisect.insort(self._agenda, (instant, action, tag), key=itemgetter(0))

    def cancel(self, tag: str) -> None:
        """Forget what was planned.

        Parameters
        ----------
        tag
            Of the plans.
        """
        self._agenda = [item for item in self._agenda if item[2] != tag]

    def abort(self) -> None:
        """Stop sending at once, in the middle of a reply if need be."""
        self.cancel(SENDING)
        self.busy_until = 0.0

    def write(
        self, data: bytes, at: float, then: Callable[[float], None] | None = None
    ) -> None:
        """Send bytes after those given before.

        Parameters
        ----------
        data
            To be sent.
        at
            Instant from which they may leave, s.
        then
            ``then(instant)`` is called when the last is out.
        """
        self.busy_until = max(at, self.busy_until)
        at_once = max(1, int(CHUNK_S / self.byte_s))
        for first in range(0, len(data), at_once):
            chunk = data[first : first + at_once]
            self.busy_until += len(chunk) * self.byte_s
            self.at(self.busy_until, partial(self._put, chunk), SENDING)
        if then is not None:
            self.at(self.busy_until, then, SENDING)

    def _put(self, data, _):
        if self.port.open:
            self.port.put(self._through(data, self.baudrate, self.port.rate))

    reply = write

    # ------------------------------------------------------------------------------- for the port

    def due(self) -> float:
        """When something is to be done, s."""
        if not self._agenda:
            return math.inf
        return self._agenda[0][0]

    def advance(self) -> None:
        """Do all that is due by now."""
        while self.due() <= self.host.now() + SOON:
            instant, action, _ = self._agenda.pop(0)
            action(instant)

    def hear(self, data: bytes) -> None:
        """Take bytes that the host sends.

        Parameters
        ----------
        data
            As they left it.
        """
        data = self._through(data, self.port.rate, self.baudrate)
        self._heard = max(self._heard, self.host.now()) + len(data) * self.byte_s
        if data:
            self.receive(data, self._heard)

    def receive(self, data: bytes, at: float) -> None:
        """Take bytes of the host.

        Parameters
        ----------
        data
            As they arrived.
        at
            Instant of the last of them, s.
        """
        self.cancel("gap")
        raw = self._buffer + data
        self._buffer = raw[self.take(raw, at) :]
        if self._buffer:
            self.at(at + self.gap_s, self._forget, "gap")

    def _forget(self, _):
        self._buffer = b""

    def _through(self, data, sent, read):
        """Bytes at the other end of the line; where its ends are set to different rates as much
        noise as fits into their time.
        """
        if sent == read:
            return data
        if not sent:
            return b""
        return self._noise.bytes(math.ceil(len(data) * read / sent))


class Terminal(threading.Thread):
    """A pseudo-terminal, and the thread that serves it.

    It sleeps until bytes come, something is due, or LOOK_S.

    Parameters
    ----------
    device : SerialDevice
    """

    def __init__(self, device: SerialDevice):
        super().__init__(name=f"emulated {Path(device.path).name}", daemon=True)
        self.open = False
        self._device = device
        self._quit = False

    @property
    def rate(self) -> int:
        """Of the host's end, bits a second."""
        return RATES.get(termios.tcgetattr(self._master)[5], 0)

    def end(self) -> None:
        """Take the port away and end the thread."""
        self._quit = True
        if self.is_alive():
            self.join(END_S)

    def run(self) -> None:
        """Serve the port until it is closed."""
        try:
            while not self._quit:
                wait = min(self._device.due() - REAL.now(), LOOK_S)
                listened = [self._master] if self.open else []
                select.select(listened, [], [], max(0.0, wait))
                self._listen()
                self._device.advance()
        # a device that dies must say so: a look at `error` shows it
        except Exception as error:
            self._device.error = error
            raise
        finally:
            self.unplug()

    def _listen(self):
        """Take the bytes of the host; see whether it holds the port open."""
        self.open = True
        try:
            data = os.read(self._master, 4096)
        except BlockingIOError:  # it says nothing
            pass
        except OSError:
            self.open = False
        else:
            self._device.hear(data)

    def put(self, data: bytes) -> None:
        """Send bytes; what the buffer cannot hold is lost.

        Parameters
        ----------
        data
            For the host.
        """
        try:
            os.write(self._master, data)
        except BlockingIOError:
            pass
        except OSError:  # closed at this moment
            self.open = False

    def plug(self) -> None:
        """Make the pseudo-terminal and let its path point to it."""
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        path = Path(self._device.path)
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(slave))
        os.close(slave)

    def unplug(self) -> None:
        """Take the pseudo-terminal away; whoever holds it gets an error."""
        Path(self._device.path).unlink(missing_ok=True)
        os.close(self._master)
