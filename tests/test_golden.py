"""The tables of a small session, to the sixth digit; those of two others are compared where their notebooks run."""

import pytest
from notebook_runs import (
    GOLDEN,
    NOTEBOOKS,
    WITH_SESSION,
    check_tables,
    run_plainly,
    tables_of,
)
from shared import QUICK, campaign, stages


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(p, marks=campaign if p.stem > "05" else (), id=p.stem)
        for p in WITH_SESSION
    ],
)
def test_tables_of_the_small_session(path, tmp_path):
    run_plainly(
        path, QUICK, stages(), tmp_path, drawn=False
    )  # figures are looked at on both larger sessions
    check_tables(tmp_path, "sim_quick", path)


@pytest.mark.parametrize("session", ["sim_lms221", "sim_quick", "lms400_zed"])
def test_no_table_is_left_over(session):
    written = [name for path in NOTEBOOKS for name in tables_of(path)]
    assert len(written) == len(set(written))
    assert {file.stem for file in (GOLDEN / session).glob("*.csv")} <= set(written)
