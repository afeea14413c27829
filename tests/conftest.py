"""Fixtures shared by all tests."""

import os
import resource
import shutil
import signal
import sys
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import mkdtemp

import matplotlib
import pytest
from shared import FOLDER, QUICK, ROOT, chromium, shared_folder, stages

matplotlib.use("Agg")
# a grammar of internet addresses, which nbformat would load: 3 s a process
sys.modules["rfc3987_syntax"] = None


def pytest_configure(config):
    """A folder that all processes of this test run share; they inherit its name. And Ctrl-C.

    A shell starts what runs in the background with Ctrl-C ignored, which is inherited as well: the programs that tests
    interrupt would not notice.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if not hasattr(config, "workerinput"):
        os.environ[FOLDER] = mkdtemp(prefix="lrfcal-tests-")


def pytest_unconfigure(config):
    if not hasattr(config, "workerinput"):
        shutil.rmtree(os.environ.pop(FOLDER), ignore_errors=True)


@pytest.fixture
def little_space():
    """Lets files grow to so many bytes only, as a disk that is nearly full does; a context manager."""

    @contextmanager
    def little_space(most):
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return little_space


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


@pytest.fixture(scope="module")
def browser(request):
    program = chromium()
    from playwright.sync_api import sync_playwright

    options = ["--no-sandbox", "--disable-dev-shm-usage"]  # CI runs as root, in a container
    options += getattr(request, "param", ["--disable-gpu"])
    with sync_playwright() as playwright:
        yield (
            browser := playwright.chromium.launch(
                executable_path=program, args=options, timeout=120_000
            )
        )
        browser.close()


@pytest.fixture(scope="session")
def lms400_session(real_data):
    """Folder of the session imported from lms400_zed, the same for all processes of a test run."""
    from lrfcal_lib.session.importers import import_lasersetero

    target = shared_folder() / "lms400_zed"
    if not target.exists():
        own = Path(mkdtemp(dir=shared_folder())) / target.name
        import_lasersetero(real_data / "lms400_zed", own)
        with suppress(OSError):  # another process was faster
            own.rename(target)
    return target


@pytest.fixture(scope="session")
def lms400(lms400_session):
    """The calibrated recording."""
    return calibrated(lms400_session)


@pytest.fixture(scope="session")
def quick():
    """The calibrated small session."""
    return calibrated(QUICK)


def calibrated(path):
    """A Calibration; what the notebooks of this test run have worked out of a session is not done again."""
    from lrfcal_lib.calibrate import pipeline
    from lrfcal_lib.session import cache
    from lrfcal_lib.session.read import open_session

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(cache.VARIABLE, str(stages()))
        return pipeline.calibrate(open_session(path))


LONGEST = (
    "test_notebooks_scant", "test_report", "test_intrinsics", "test_survey", "test_joint_bad_input", "test_falsified",
    "test_golden", "test_alternatives", "test_joint", "test_record_emulated", "test_same_numbers", "test_solvers",
    "test_emulated_rig", "test_hostile_text", "test_joint_calibration", "test_record_bad_input",
)  # fmt: skip
ALONE = (
    "test_stored_outputs_and_golden_tables",
    "test_tables_of_the_recording",
    "test_buttons_record",
)
NOTEBOOKS = (
    "08",
    "07",
    "09",
    "[1",
    "05",
    "06",
    "04",
    "03",
    "02",
    "01",
    "00",
)  # who works out stages waits for nobody


def pytest_collection_modifyitems(items):
    """What takes longest comes first, so that runners side by side finish together; a file stays in one of them."""

    def rank(item):
        if item.name.startswith(ALONE):
            return next((k for k, name in enumerate(NOTEBOOKS) if name in item.name), 0)
        return len(NOTEBOOKS) + (
            LONGEST.index(item.path.stem) if item.path.stem in LONGEST else len(LONGEST)
        )

    items.sort(key=rank)
    for item in items:
        item.add_marker(
            pytest.mark.xdist_group(
                item.name if item.name.startswith(ALONE) else item.path.stem
            )
        )
