"""Fixtures shared by all tests."""

import os
from pathlib import Path

import matplotlib
import pytest

matplotlib.use("Agg")
ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def real_data():
    """Folder of other people's recordings: LRFCAL_REAL_DATA, else ../shared/real beside the checkout."""
    folder = Path(os.environ.get("LRFCAL_REAL_DATA") or ROOT.parent / "shared" / "real")
    if not folder.is_dir():
        reason = f"no recordings in {folder}: set LRFCAL_REAL_DATA to the folder that holds lms400_zed"
        if os.environ.get("CI"):
            pytest.fail(reason + " (a CI server must have them)")
        pytest.skip(reason)
    return folder


@pytest.fixture(scope="session")
def lms400_session(real_data, tmp_path_factory):
    """Folder of the session imported from lms400_zed, made once a test run."""
    from lrfcal_lib.importers import import_lasersetero

    target = tmp_path_factory.mktemp("sessions") / "lms400_zed"
    import_lasersetero(real_data / "lms400_zed", target)
    return target


LONGEST = (
    "test_notebooks_recording",
    "test_notebooks",
    "test_panel_browser",
    "test_record_emulated",
    "test_real_lms400",
)


def pytest_collection_modifyitems(items):
    """The files that take longest come first, so that test runners side by side finish together."""
    items.sort(key=lambda item: LONGEST.index(item.path.stem) if item.path.stem in LONGEST else len(LONGEST))


REAL_TIME = (
    "test_emulat",
    "test_lms2xx_device",
    "test_lms2xx_faults",
    "test_lms2xx_streaming",
    "test_pan",
    "test_record_",
    "test_video",
)


@pytest.hookimpl(tryfirst=True)
def pytest_itemcollected(item):
    """Devices are emulated in real time: a machine that is busy for a second gets a second chance."""
    if item.path.stem.startswith(REAL_TIME):
        item.add_marker(pytest.mark.flaky(reruns=2))
