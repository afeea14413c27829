"""What the processes of a test run share, and where things are."""

import errno
import os
import shutil
import time
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "data"
QUICK = DATA / "sim_quick"
campaign = pytest.mark.campaign  # see pyproject.toml
FOLDER = "LRFCAL_TESTS"  # environment variable, set by conftest.py
STRINGS = int(
    os.environ.get("LRFCAL_FUZZ", 20_000)
)  # random byte strings for each parser; a million in make fuzz


def shared_folder():
    """Folder of this test run, removed at its end."""
    return Path(os.environ[FOLDER])


def stages():
    """Folder for the stages that notebooks and fixtures begin with (see lrfcal_lib.session.cache)."""
    return shared_folder() / "stages"


def until(holds, longest_s=120.0):
    """Wait for a state, not for a time; the limit guards against hanging only."""
    end = time.monotonic() + longest_s
    while not holds():
        assert time.monotonic() < end, "it does not happen"
        time.sleep(0.01)


@contextmanager
def at_write(monkeypatch, number, action):
    """Let something happen instead of the n-th write (from 0) that is to be safe on the disk, and of all after it."""
    fsync = os.fsync
    left = iter(range(number))
    with monkeypatch.context() as patch:
        patch.setattr(
            os,
            "fsync",
            lambda handle: action() if next(left, None) is None else fsync(handle),
        )
        yield


def disk_full():
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def chromium():
    """The program; skips where no browser can be had, which CI must have."""
    found = next(
        filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))),
        None,
    )
    reasons = (
        [] if found else ["there is no Chromium: run 'sudo apt-get install -y chromium'"]
    )
    if find_spec("playwright") is None:
        reasons.append("there is no playwright: run 'pip install -r environment.txt'")
    if reasons:
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)("; ".join(reasons))
    return found
