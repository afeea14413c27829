"""Stages that several notebooks begin with, worked out once.

Every notebook runs alone, from the recording on, so most of them begin with the same work. Where the environment
variable ``LRFCAL_CACHE`` names a folder, what a stage makes of a session is kept there, and whoever asks for the same
again reads it. A report and a test run use a fresh folder each, ``make lab`` one for the time it runs; without the
variable nothing is kept. Results are pickles, which can run code when they are read: a folder that others may write to
is refused.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from functools import lru_cache, wraps
from pathlib import Path
from tempfile import NamedTemporaryFile

import cv2
import numpy as np
import scipy

VARIABLE = "LRFCAL_CACHE"


def cached(stage):
    """Keep the results of a function whose first argument is a session.

    Parameters
    ----------
    stage : callable
        ``stage(session, ...)``; the same arguments always give the same result, and nobody changes it in place.

    Returns
    -------
    callable
        Looks in the folder first. The same session are the same statements, scans and images; results of another
        version of this library or of numpy, scipy or OpenCV do not count. It raises ValueError for a folder that others
        may write to.
    """

    @wraps(stage)
    def look_first(session, *args, **options):
        folder = os.environ.get(VARIABLE)
        if not folder:
            return stage(session, *args, **options)
        _check_private(Path(folder))
        file = Path(folder) / f"{stage.__name__}-{_key(stage, session, args, options)}.pickle"
        if file.is_file():
            return pickle.loads(file.read_bytes())
        result = stage(session, *args, **options)
        _write(file, pickle.dumps(result))
        return result

    return look_first


def _check_private(folder):
    """Whoever may write to the folder could have what they put there run."""
    found = folder.stat() if folder.exists() else None
    if found and (found.st_uid not in (os.geteuid(), 0) or found.st_mode & 0o022):
        may = f"others may write to '{folder}' (owner {found.st_uid}, mode {found.st_mode & 0o7777:o})"
        raise ValueError(f"{VARIABLE}: {may}, and what lies there is run; chmod go-w, or name a folder of your own")


def _key(stage, session, args, options):
    """Everything that the result depends on, as a number of 256 bits."""
    key = hashlib.sha256(pickle.dumps((stage.__qualname__, session, args, sorted(options.items()))))
    for file in (Path(record.file) for record in session.image_records):
        key.update(file.read_bytes() if file.is_file() else b"missing")
    key.update(_library())
    return key.hexdigest()


@lru_cache
def _library():
    """What stands for this library and those it works out its results with."""
    digest = hashlib.sha256("".join(module.__version__ for module in (np, scipy, cv2)).encode())
    for file in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.digest()


def _write(file, data):
    """Whole or not at all: other notebooks read at the same time."""
    file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with NamedTemporaryFile(dir=file.parent, delete=False) as part:
        part.write(data)
    os.replace(part.name, file)
