"""Every notebook that takes a session runs on somebody else's recording, and gives the same tables."""

import pytest
from notebook_runs import WITH_SESSION, check_tables, run_plainly
from shared import campaign, stages


@pytest.mark.parametrize("drawn", [False, pytest.param(True, marks=campaign)], ids=["tables", "figures"])
@pytest.mark.parametrize("path", WITH_SESSION, ids=lambda p: p.stem)
def test_tables_of_the_recording(path, drawn, lms400_session, tmp_path):
    run_plainly(path, lms400_session, stages(), tmp_path, drawn=drawn)
    check_tables(tmp_path, "lms400_zed", path)
