"""Every notebook that takes a session runs on somebody else's recording."""

from concurrent.futures import ThreadPoolExecutor

import pytest
from notebook_runs import WITH_SESSION, check, run_nbval


@pytest.fixture(scope="module")
def runs_on_the_recording(lms400_session):
    """All notebooks on the imported recording, two at a time; results as futures by path."""
    with ThreadPoolExecutor(max_workers=2) as pool:
        # later notebooks take longer, so they start first
        yield {path: pool.submit(run_nbval, path, lms400_session) for path in reversed(WITH_SESSION)}


@pytest.mark.parametrize("path", WITH_SESSION, ids=lambda p: p.stem)
def test_runs_on_the_recording(path, runs_on_the_recording):
    check(runs_on_the_recording[path].result())
