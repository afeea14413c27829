"""Every notebook that takes a session runs on somebody else's recording."""

from concurrent.futures import ThreadPoolExecutor

import pytest
from notebook_runs import WITH_SESSION, check, check_tables, run_nbval


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Folder that takes the tables of all notebooks."""
    return tmp_path_factory.mktemp("report")


@pytest.fixture(scope="module")
def runs_on_the_recording(lms400_session, tables):
    """All notebooks on the imported recording, two at a time; results as futures by path."""
    with ThreadPoolExecutor(max_workers=2) as pool:
        # the last one goes through most stages, which others then find done
        order = WITH_SESSION[-1:] + WITH_SESSION[:-1]
        yield {path: pool.submit(run_nbval, path, lms400_session, tables) for path in order}


@pytest.mark.parametrize("path", WITH_SESSION, ids=lambda p: p.stem)
def test_runs_on_the_recording(path, runs_on_the_recording):
    check(runs_on_the_recording[path].result())


def test_tables_are_the_golden_ones(runs_on_the_recording, tables):
    check_tables(tables, "lms400_zed")
