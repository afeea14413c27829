"""The tables of a small session, to the sixth digit; those of two others are compared where their notebooks run."""

from notebook_runs import WITH_SESSION, check_tables, run_plainly
from shared import QUICK


def test_tables_are_the_golden_ones(tmp_path):
    for path in WITH_SESSION:
        run_plainly(path, QUICK, tmp_path / "stages", tmp_path / "report")
    check_tables(tmp_path / "report", "sim_quick")
