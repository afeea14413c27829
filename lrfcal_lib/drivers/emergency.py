"""Stop the heads on the way out: at the end of the interpreter and when the process is told to end."""

from __future__ import annotations

import atexit
import os
import signal
import threading
import weakref

_moving_things = weakref.WeakSet()
_before = {}


def guard(device):
    """Call ``device.emergency_stop()`` at exit, and on SIGTERM and SIGHUP if this is the main thread.

    Parameters
    ----------
    device
        Kept by a weak reference, until :func:`release`.
    """
    _moving_things.add(device)
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) not in (_on_signal, signal.SIG_IGN):  # nohup ignores SIGHUP: go on
                _before[number] = signal.signal(number, _on_signal)


def release(device):
    """Forget a device that was closed."""
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
    """Stop, then do what would have been done; what would kill becomes an exit that closes files."""
    _stop_all()
    before = _before.get(number)
    if callable(before):
        before(number, frame)
    elif before != signal.SIG_IGN:
        raise SystemExit(128 + number)


atexit.register(_stop_all)
os.register_at_fork(after_in_child=_moving_things.clear)
