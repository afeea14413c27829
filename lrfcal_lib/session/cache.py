"""Stages that several notebooks begin with, worked out once.

Where the environment variable ``LRFCAL_CACHE`` names a folder, what a stage makes of a session is
kept there for whoever asks for the same again. A report and a test run use a fresh folder each,
``make lab`` one for the time it runs. Results are pickles: they hold nested dataclasses with arrays
and transforms of SciPy, for which no plain format is as short. A pickle can run code when it is
read, so a folder is refused that others may write to, or own (but for root), or may put another one
in the place of; so is a file in it, and a link.
"""

import fcntl
import hashlib
import os
import pickle
from functools import wraps
from pathlib import Path
from tempfile import NamedTemporaryFile

import cv2
import numpy as np
import scipy

from lrfcal_lib.session.cluster import source_digest
from lrfcal_lib.session.files import opened

VARIABLE = "LRFCAL_CACHE"
REMEDY = "and files in it are executed; use chmod go-w, or name a folder of your own"
LARGEST_RESULT = 4_000_000_000  # bytes that are read; the largest are clouds of some 100 MB


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
        call = (
            stage.__qualname__,
            of,
            args,
            sorted(options.items()),
            source_digest(),
            np.__version__,
            scipy.__version__,
            cv2.__version__,
        )
        key = hashlib.sha256(pickle.dumps(call))
        for record in session.image_records:
            key.update(record.file.read_bytes() if record.file.is_file() else b"missing")
        file = folder / f"{stage.__name__}-{key.hexdigest()}.pickle"
        if not file.is_file():  # else the folder may be one to read only
            with opened(
                file.with_suffix(".lock"), folder, os.O_WRONLY | os.O_CREAT
            ) as lock:
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
        if mode & 0o1002 == 0o0002:  # all may write, and not only to what is theirs
            raise ValueError(
                f"{VARIABLE}: others may rename what is in '{above}' (mode {mode & 0o7777:o}), "
                f"{REMEDY}"
            )


def _refuse_others(place, status):
    """Refuse what is somebody else's, but for root's, or what somebody else may write to."""
    if status.st_uid not in (os.geteuid(), 0) or status.st_mode & 0o022:
        raise ValueError(
            f"{VARIABLE}: others may write to '{place}' (owner {status.st_uid}, mode "
            f"{status.st_mode & 0o7777:o}), {REMEDY}"
        )
