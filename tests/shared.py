"""What the processes of a test run share, and where things are."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
QUICK = ROOT / "data" / "sim_quick"
FOLDER = "LRFCAL_TESTS"  # environment variable, set by conftest.py
STRINGS = int(os.environ.get("LRFCAL_FUZZ", 20_000))  # random byte strings for each parser; a million in make fuzz


def shared_folder():
    """Folder of this test run, removed at its end."""
    return Path(os.environ[FOLDER])


def stages():
    """Folder for the stages that notebooks and fixtures begin with (see lrfcal_lib.session.cache)."""
    return shared_folder() / "stages"
