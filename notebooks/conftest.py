"""``pytest --nbval notebooks/`` compares all outputs strictly, needs no options, and works out each stage once."""

import os
import shutil
from pathlib import Path
from tempfile import mkdtemp

ROOT = Path(__file__).resolve().parents[1]
STAGES = "LRFCAL_CACHE"  # see lrfcal_lib.session.cache


def pytest_configure(config):
    if not config.getoption("nbval", default=False):
        return
    config.option.nbval_current_env = True
    config.option.nbval_sanitize_with = config.option.nbval_sanitize_with or str(ROOT / "tests" / "nbval_sanitize.cfg")
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # sums in another order differ in the last digit
    if STAGES not in os.environ:
        os.environ[STAGES] = mkdtemp(prefix="lrfcal-stages-")
        config.add_cleanup(lambda: shutil.rmtree(os.environ.pop(STAGES), ignore_errors=True))
