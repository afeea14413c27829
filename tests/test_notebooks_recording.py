"""Every notebook that takes a session runs on somebody else's recording."""

import pytest
from notebook_runs import WITH_SESSION, check_tables, run_plainly
from shared import stages


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Folder that takes the tables of all notebooks."""
    return tmp_path_factory.mktemp("report")


@pytest.mark.parametrize("path", WITH_SESSION, ids=lambda p: p.stem)
def test_runs_on_the_recording(path, lms400_session, report):
    run_plainly(path, lms400_session, stages(), report)


def test_tables_are_the_golden_ones(report):
    check_tables(report, "lms400_zed")
