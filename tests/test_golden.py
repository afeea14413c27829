"""The tables of a small session and of a recording, to the sixth digit; those of a third where its notebooks run."""

import pytest
from notebook_runs import GOLDEN, NOTEBOOKS, WITH_SESSION, check_tables, run_plainly, tables_of
from shared import QUICK, stages

each_notebook = pytest.mark.parametrize("path", WITH_SESSION, ids=lambda p: p.stem)


@each_notebook
def test_tables_of_the_recording(path, lms400_session, tmp_path):
    run_plainly(path, lms400_session, stages(), tmp_path)
    check_tables(tmp_path, "lms400_zed", path)


@each_notebook
def test_tables_of_the_small_session(path, tmp_path):
    run_plainly(path, QUICK, stages(), tmp_path)
    check_tables(tmp_path, "sim_quick", path)


@pytest.mark.parametrize("session", ["sim_lms221", "sim_quick", "lms400_zed"])
def test_no_table_is_left_over(session):
    written = [name for path in NOTEBOOKS for name in tables_of(path)]
    assert len(written) == len(set(written))
    assert {file.stem for file in (GOLDEN / session).glob("*.csv")} <= set(written)
