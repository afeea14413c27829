"""Loops that several workers share: an executor that the caller names, or forked processes."""

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import partial

_executor: ContextVar[Executor | None] = ContextVar("executor", default=None)
_cores: ContextVar[int] = ContextVar("cores", default=1)  # for processes of our own
_loop: tuple = ()  # of a forked process: what is to be done, and with what


@contextmanager
def side_by_side(executor: Executor | None = None) -> Iterator[None]:
    """Let :func:`spread` share its loops while this lasts.

    Parameters
    ----------
    executor
        Whose workers take part; it is not shut down. By default processes of this machine's
        cores: forked for every loop, so that they have what was read before it, or kept for all
        loops where this process has threads, which must not be forked.
    """
    if executor is not None:
        with _setting(_executor, executor):
            yield
        return
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    if cores > 1 and threading.active_count() > 1:
        context = multiprocessing.get_context("forkserver")
        with _pool(cores, context) as pool, _setting(_executor, pool):
            yield
        return
    with _setting(_cores, cores):
        yield


def spread(work: Callable, items: Iterable) -> list:
    """``[work(item) for item in items]``, shared by workers within :func:`side_by_side`.

    Parameters
    ----------
    work
        Can be pickled, as the items, unless the processes are forked: a function of a module, or
        ``functools.partial`` of one.
    items
        What is done with one does not depend on the others.

    Returns
    -------
    list
        Every result is a copy, as a pickle makes it: sums over arrays of another layout in memory
        differ in the last digit. What a worker could not do because it died is done here.
    """
    items = list(items)
    results = []
    with suppress(BrokenExecutor):
        for result in _results(partial(_packed, work), items):
            results.append(pickle.loads(result))
    for item in items[len(results) :]:
        results.append(pickle.loads(_packed(work, item)))
    return results


def _results(work, items):
    """What work gives of each item, in order, by whoever is to do it."""
    executor = _executor.get()
    cores = min(_cores.get(), len(items))
    if executor is not None and len(items) > 1:
        yield from executor.map(work, items)
    elif cores > 1:
        fork = multiprocessing.get_context("fork")
        with _pool(cores, fork, work, items) as pool:
            yield from pool.map(_numbered, range(len(items)))
    else:
        yield from map(work, items)


def _packed(work, item):
    return pickle.dumps(work(item))


@contextmanager
def _setting(variable, value):
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


@contextmanager
def _pool(count, context, *loop):
    """Processes that end with this one, however it ends, and at once where anything is raised.

    Processes that are forked find the `loop` in their memory.
    """
    ours, theirs = context.Pipe()
    with ours, theirs, ProcessPoolExecutor(count, context, _begin, (ours, theirs, loop)) as pool:
        try:
            yield pool
        except BaseException:
            ours.close()
            raise


def _begin(ours, theirs, loop):
    """In a worker: it shares no loop itself, and its end is not the user's."""
    global _loop
    ours.close()  # here; that of the other process tells that it is there
    _executor.set(None)
    _cores.set(1)
    _loop = loop
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(theirs,), daemon=True).start()


def _end_with(pipe):
    """End this process as soon as the other end of a pipe is closed, or its process is dead."""
    pipe.poll(None)
    os._exit(1)


def _numbered(number):
    """One round of the loop that this process was forked for."""
    work, items = _loop
    return work(items[number])
