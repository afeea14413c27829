"""Stages that several notebooks begin with, worked out once; loops that several processes share.

Where the environment variable ``LRFCAL_CACHE`` names a folder, what a stage makes of a session is
kept there for whoever asks for the same again. A report and a test run use a fresh folder each,
``make lab`` one for the time it runs. Results are pickles: they hold nested dataclasses with arrays
and transforms of SciPy, for which no plain format is as short. A pickle can run code when it is
read, so a folder is refused that others may write to, or own (but for root), or may put another one
in the place of; so is a file in it, and a link.
"""

import fcntl
import hashlib
import multiprocessing
import os
import pickle
import stat
import sys
import threading
from contextlib import contextmanager, suppress
from functools import lru_cache, wraps
from pathlib import Path
from tempfile import NamedTemporaryFile

import cv2
import numpy as np
import scipy

from lrfcal_lib.session.stated import opened

VARIABLE = "LRFCAL_CACHE"
REMEDY = "and what lies there is run; chmod go-w, or name a folder of your own"
LARGEST_RESULT = 4_000_000_000  # bytes that are read; the largest are clouds of some 100 MB
_processes = 1  # that share a loop


def cached(stage):
    """Keep the results of a function whose first argument is a session, or what was made of one.

    Parameters
    ----------
    stage : callable
        ``stage(session, ...)``, or of what has a `session` or is `prepared`; the same arguments
        always give the same result, and nobody changes it in place.

    Returns
    -------
    callable
        Looks in the folder first. The same session are the same statements, scans and images;
        results of another version of this library or of numpy, scipy or OpenCV do not count. It
        raises ValueError for a folder that others may write to.
    """

    @wraps(stage)
    def look_first(of, *args, **options):
        """The kept result of the same call, or else what the stage makes now."""
        if not os.environ.get(VARIABLE):
            return stage(of, *args, **options)
        folder = Path(os.environ[VARIABLE])
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _refuse_shared(folder)
        session = getattr(getattr(of, "prepared", of), "session", of)
        key = hashlib.sha256(pickle.dumps((stage.__qualname__, of, args, sorted(options.items()))))
        for file in (Path(record.file) for record in session.image_records):
            key.update(file.read_bytes() if file.is_file() else b"missing")
        key.update(library())
        file = folder / f"{stage.__name__}-{key.hexdigest()}.pickle"
        if not file.is_file():
            with opened(file.with_suffix(".lock"), folder, os.O_WRONLY | os.O_CREAT) as lock:
                # of two notebooks at the same time the second waits
                fcntl.flock(lock, fcntl.LOCK_EX)
                if not file.is_file():
                    result = pickle.dumps(stage(of, *args, **options))
                    with NamedTemporaryFile(dir=folder, delete=False) as part:
                        part.write(result)
                    os.replace(part.name, file)  # whole or not at all
        with opened(file, folder, most=LARGEST_RESULT) as stream:
            # of what is open: the name may be another's file by now
            _refuse_others(file, os.fstat(stream.fileno()))
            return pickle.load(stream)

    return look_first


def _refuse_shared(folder):
    """Refuse a folder that others may write to, or put another one in the place of."""
    _refuse_others(folder, folder.stat())
    for above in folder.resolve().parents:
        mode = above.stat().st_mode
        if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
            may = f"others may rename what is in '{above}' (mode {mode & 0o7777:o})"
            raise ValueError(f"{VARIABLE}: {may}, {REMEDY}")


def _refuse_others(place, status):
    """Refuse what is somebody else's, but for root's, or what somebody else may write to."""
    if status.st_uid not in (os.geteuid(), 0) or status.st_mode & 0o022:
        mode = f"{status.st_mode & 0o7777:o}"
        may = f"others may write to '{place}' (owner {status.st_uid}, mode {mode})"
        raise ValueError(f"{VARIABLE}: {may}, {REMEDY}")


@lru_cache
def library():
    """What stands for this library and those it works out its results with."""
    digest = hashlib.sha256("".join(module.__version__ for module in (np, scipy, cv2)).encode())
    for file in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.digest()


@contextmanager
def all_processors():
    """Let :func:`spread` use every processor; a process with threads, as that of a notebook, stays
    alone.
    """
    global _processes
    alone = not hasattr(os, "sched_getaffinity") or threading.active_count() > 1
    before = _processes
    if alone:
        _processes = 1
    else:
        _processes = len(os.sched_getaffinity(0))
    try:
        yield
    finally:
        _processes = before


def spread(work, items):
    """``[work(item) for item in items]``, shared with forked processes within
    :func:`all_processors`.

    Whoever is free takes the next item; what another process could not do (it died, or `work`
    raised) is done here. Every result is a copy, as a pickle makes it: sums over arrays of another
    layout in memory differ in the last digit. Pickles are read from the pipes of our own children
    only. No executor does this: one whose parent is killed leaves processes behind that wait for
    ever, and here they end with the items.
    """
    global _processes
    items = list(items)
    count = min(_processes, len(items))
    if count < 2:
        return [pickle.loads(pickle.dumps(work(item))) for item in items]
    before = _processes
    _processes = 1  # of loops within
    queue, end = os.pipe()  # of the numbers of items
    os.write(end, np.arange(len(items), dtype=np.uint16).tobytes())
    os.close(end)

    def take(send):
        """Work on what nobody works on, and send pickles of the results by number."""
        done = {}
        with suppress(Exception):
            while number := os.read(queue, 2):
                number = int.from_bytes(number, sys.byteorder)
                done[number] = pickle.dumps(work(items[number]))
        send(done)

    def quietly(send):
        """The same in a process of its own, which tells nobody that it was interrupted."""
        with suppress(BaseException):
            take(send)

    results = {}
    others = []  # processes, and the pipes that their results come from
    fork = multiprocessing.get_context("fork")
    try:
        for _ in range(count - 1):
            receiver, sender = fork.Pipe(duplex=False)
            process = fork.Process(target=quietly, args=(sender.send,), daemon=True)
            process.start()
            sender.close()
            others.append((process, receiver))
        take(results.update)
        for _, receiver in others:
            with suppress(EOFError):
                results |= receiver.recv()
    finally:
        _processes = before
        os.close(queue)
        for process, _ in others:
            process.kill()
            process.join()
    for number, item in enumerate(items):
        if number not in results:
            results[number] = pickle.dumps(work(item))
    return [pickle.loads(results[number]) for number in range(len(items))]
