"""Loops that several workers share: an executor that the caller names, or forked processes."""

import copyreg
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

from scipy.spatial.transform import RigidTransform

_executor: ContextVar[Executor | None] = ContextVar("executor", default=None)
_cores: ContextVar[int] = ContextVar("cores", default=1)  # for processes of our own
FORK = multiprocessing.get_context("fork")
_loop: tuple = ()  # of a forked process, which finds it in its memory


def _exactly(transform):
    """How a pose travels: scipy makes it rigid anew on arrival, which moves its last digit."""
    return partial(RigidTransform, normalize=False), (transform.as_matrix(),)


copyreg.pickle(RigidTransform, _exactly)


@contextmanager
def side_by_side(executor: Executor | None = None) -> Iterator[None]:
    """Let :func:`spread` share its loops while this lasts.

    Parameters
    ----------
    executor
        Whose workers take part; it is not shut down. By default processes of this machine's
        cores, forked for every loop, so that they have what was read before it; none where this
        process has threads, which must not be forked.
    """
    cores = 1
    if executor is None and threading.active_count() == 1:
        cores = len(os.sched_getaffinity(0))
    with _setting(_executor, executor), _setting(_cores, cores):
        yield


def spread(work: Callable, items: Iterable) -> list:
    """``[work(item) for item in items]``, shared by workers within :func:`side_by_side`.

    Parameters
    ----------
    work
        A function of a module, or ``functools.partial`` of one, which can be pickled, as the items.
        Any other is shared by forked processes only, and done here where an executor is to do it.
    items
        What is done with one does not depend on the others.

    Returns
    -------
    list
        Every result is a copy, as a pickle makes it: sums over arrays of another layout in memory
        differ in the last digit. What a worker could not do is done here.
    """
    items = list(items)
    executor = _executor.get()
    cores = min(_cores.get(), len(items))
    results = {}
    if executor is not None and len(items) > 1 and _can_travel(work):
        with suppress(BrokenExecutor):
            results.update(enumerate(executor.map(partial(_packed, work), items)))
    elif cores > 1:
        results = _forked(work, items, cores)
    # of each result what it was packed as goes as it is unpacked
    return [
        pickle.loads(results.pop(number, None) or _packed(work, item))
        for number, item in enumerate(items)
    ]


def _can_travel(work):
    """Whether another process can be told what to do."""
    try:
        pickle.dumps(work)
    except (pickle.PicklingError, AttributeError, TypeError):
        return False
    return True


def _packed(work, item):
    return pickle.dumps(work(item))


def _forked(work, items, cores):
    """Results by number, of forked processes and of this one, which keeps what it has read.

    The others end with this one, however it ends, and at once after Ctrl-C.
    """
    loop = (work, items, FORK.Value("i"))
    ours, theirs = FORK.Pipe()
    with (
        ours,
        theirs,
        ProcessPoolExecutor(cores - 1, FORK, _begin, (ours, theirs, loop)) as pool,
        _setting(_cores, 1),
    ):
        try:
            others = [pool.submit(_take_part) for _ in range(cores - 1)]
            results = _rounds(*loop)
            for other in others:
                with suppress(BrokenExecutor):
                    results |= other.result()
        except (KeyboardInterrupt, SystemExit):
            ours.close()
            raise
    return results


def _rounds(work, items, begun):
    """Whoever is free takes the next item, until none is left or one fails: results by number."""
    results = {}
    with suppress(Exception):
        while True:
            with begun.get_lock():
                number = begun.value
                begun.value += 1
            results[number] = _packed(work, items[number])
    return results


@contextmanager
def _setting(variable, value):
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


def _begin(ours, theirs, loop):
    """In a worker: it shares no loop itself, and its end is not the user's."""
    global _loop
    ours.close()  # here; that of the other process tells that it is there
    _cores.set(1)
    _loop = loop
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(theirs,), daemon=True).start()


def _end_with(pipe):
    """End this process as soon as the other end of a pipe is closed, or its process is dead."""
    pipe.poll(None)
    os._exit(1)


def _take_part():
    """In a forked worker."""
    return _rounds(*_loop)
