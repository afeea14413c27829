"""Serial ports whose errors say what to do, and heads that stop on every exit."""

import atexit
import errno
import logging
import os
import signal
import termios
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import serial
from serial.tools.list_ports import comports

from lrfcal_lib.session.files import short

LOG = logging.getLogger(__name__)
WRITE_S = 1.0  # longest time that a write may block
MOMENT_S = 1e-3  # shorter waits are spent awake


class DeviceError(RuntimeError):
    """Any failure of a device or of the line to it."""


class PortError(DeviceError):
    """The port cannot be opened or set: missing, forbidden, busy, no serial line, wrong rate."""


class NoReply(DeviceError):
    """Nothing sensible arrived before the deadline."""


class WrongDevice(DeviceError):
    """Something answers, but it is not the device that was expected."""


class Refused(DeviceError):
    """The device understood and declined."""


class LineLost(DeviceError):
    """The port vanished; it can come back."""


class OutOfRange(DeviceError, ValueError):
    """A device was asked for more than it can do, such as a pitch beyond the limits of its head."""


@contextmanager
def stopping(name: str, errors: type[Exception] = DeviceError) -> Iterator[None]:
    """Log what keeps a device from being stopped, with what to do.

    Parameters
    ----------
    name
        Of the device.
    errors
        That are logged, and go no further.
    """
    try:
        yield
    except errors as error:
        LOG.error(
            "the %s could not be stopped (%s): cut its power if it moves", name, error
        )


class Closed(AbstractContextManager):
    """Something that is closed at the end of a with statement."""

    def __exit__(self, *_):
        self.close()


# ------------------------------------------------------------------------------------------ ports


def open_port(path: str | os.PathLike, baudrate: int, *, timeout: float) -> serial.Serial:
    """Open a serial port for this process alone: 8 data bits, no parity, 1 stop bit.

    Parameters
    ----------
    path
        Of the port.
    baudrate
        Bits a second.
    timeout
        Longest time that a read waits, seconds.

    Returns
    -------
    serial.Serial

    Raises
    ------
    PortError
        If the port is missing, forbidden, busy, no serial line, or cannot do this rate.
    """
    path = os.fspath(path)
    try:
        port = serial.Serial(
            path, 9600, timeout=timeout, write_timeout=WRITE_S, exclusive=True
        )
    except (OSError, ValueError, termios.error) as error:
        present = short(sorted(port.device for port in comports()))
        match getattr(error, "errno", None):
            case errno.ENOENT | errno.ENODEV | errno.ENXIO:
                reason = (
                    f"there is no port {path}: check cable and power; present are {present}"
                )
            case errno.EACCES | errno.EPERM:
                reason = (
                    f"no permission for {path}: run 'sudo usermod -aG dialout $USER', then log in "
                    "again"
                )
            case errno.EBUSY | errno.EAGAIN:
                reason = f"the port {path} is busy: close the program that 'fuser -v {path}' names"
            case _:
                reason = f"{path} is no serial line ({error}): name the port of the device"
        raise PortError(reason) from error
    try:
        set_rate(port, baudrate)
    except BaseException:
        port.close()
        raise
    return port


def set_rate(port: serial.Serial, baudrate: int) -> None:
    """Change the rate of an open port, and read it back.

    Parameters
    ----------
    port
        Open.
    baudrate
        Bits a second.

    Raises
    ------
    PortError
        If the port cannot do this rate; the old one holds.
    LineLost
        If the port vanished.
    """
    before = port.baudrate
    try:
        with line_lost(port.port):
            port.baudrate = baudrate
            rates = set(termios.tcgetattr(port.fd)[4:6])  # of input and output
        if rates == {getattr(termios, f"B{baudrate}", None)}:
            return
        reason = (
            f"does not take {baudrate} Bd: its driver set another rate; 500000 Bd needs an RS-422 "
            "interface whose clock divides to it, else use 38400"
        )
    except ValueError as error:
        reason = f"cannot do {baudrate} Bd: {error}"
    port.baudrate = before
    raise PortError(f"{port.port} {reason}")


@contextmanager
def line_lost(path: str | os.PathLike) -> Iterator[None]:
    """Turn what pyserial raises when a port vanishes into LineLost.

    Parameters
    ----------
    path
        Of the port, for the message.
    """
    try:
        yield
    except (OSError, termios.error) as error:
        raise LineLost(
            f"the line {path} is lost ({error}): check plug and power"
        ) from error


class Host:
    """What drivers have of this machine, named as in `time` and `threading`; tests have another."""

    now = staticmethod(time.monotonic)
    event = threading.Event
    lock = staticmethod(threading.RLock)
    port = staticmethod(open_port)
    set_rate = staticmethod(set_rate)
    _zero = time.time() - time.monotonic()

    def time(self) -> float:
        """A date, s, that nobody sets while this program runs.

        A step would tear scans and pitch apart.
        """
        return self._zero + time.monotonic()

    @staticmethod
    def sleep(seconds: float) -> None:
        """Wait; a busy machine gives the processor back late to those who sleep for a moment.

        Parameters
        ----------
        seconds
            How long; none or less does not wait.
        """
        end = time.monotonic() + seconds
        if seconds > MOMENT_S:
            time.sleep(seconds)
        while time.monotonic() < end:
            pass

    @staticmethod
    def thread(target: Callable[[], None], name: str) -> threading.Thread:
        """A daemon thread that is not started yet.

        Parameters
        ----------
        target
            What it does.
        name
            Of the thread.
        """
        return threading.Thread(target=target, name=name, daemon=True)


REAL = Host()

# ----------------------------------------------------------------------------- stop on every exit

_moving_things: weakref.WeakSet = weakref.WeakSet()
_before: dict = {}  # handlers of signals that were there before ours


def guard(device) -> None:
    """Let a device be stopped at exit, and in the main thread on SIGTERM and SIGHUP.

    Parameters
    ----------
    device
        Its ``emergency_stop()`` is called until `release`.
    """
    _moving_things.add(device)
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, signal.SIGHUP):
            # nohup ignores SIGHUP: go on
            if signal.getsignal(number) not in (_on_signal, signal.SIG_IGN):
                _before[number] = signal.signal(number, _on_signal)


def release(device) -> None:
    """Forget a device that was closed.

    Parameters
    ----------
    device
        As given to `guard`.
    """
    _moving_things.discard(device)
    if not _moving_things and threading.current_thread() is threading.main_thread():
        while _before:
            number, handler = _before.popitem()
            if signal.getsignal(number) is _on_signal:
                signal.signal(number, handler or signal.SIG_DFL)


def _stop_all():
    for device in list(_moving_things):
        device.emergency_stop()


def _on_signal(number, frame):
    """Stop, then do what the signal did before; what would kill becomes an exit."""
    _stop_all()
    before = _before.get(number)
    if callable(before):
        before(number, frame)
    elif before != signal.SIG_IGN:
        raise SystemExit(128 + number)


atexit.register(_stop_all)
os.register_at_fork(after_in_child=_moving_things.clear)
