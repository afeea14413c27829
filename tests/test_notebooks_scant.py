"""Notebooks on sessions that leave questions open: they run to the end, and say what cannot be asked."""

import json

import numpy as np
import pytest
from notebook_runs import WITH_SESSION, run_plainly
from tiny_sessions import record, rectangle

from lrfcal_lib.evaluate.export import calibrate_session
from lrfcal_lib.session import cache

SCANT = {
    "lines": {"pitch_deg": [0.0]},  # single scan lines: no sweep, no axis, no cloud
    "wall": {"on_wall": True},  # a chessboard on a wall: faces, no edges
}
SAYS = {
    ("lines", "01"): "a single scan line",
    ("lines", "03"): "no sweeps with a straight side",
    ("lines", "07"): "whether it bends",
    ("wall", "04"): "the images do not agree on the top edge",
    ("wall", "05"): "no placement has sides",
}


@pytest.fixture(scope="module", params=SCANT)
def scant(request, tmp_path_factory):
    """A session with too little in it for some questions: its kind, folder, and a folder for its stages."""
    folder = tmp_path_factory.mktemp(request.param)
    record(folder / "session", rectangle(0.02), placements=6, **SCANT[request.param])
    return request.param, folder / "session", folder / "stages"


@pytest.mark.parametrize("path", WITH_SESSION, ids=lambda p: p.stem)
def test_runs_to_the_end_and_says_what_is_not_asked(path, scant):
    kind, session, stages = scant
    told = run_plainly(path, session, stages, stages / "report")
    assert SAYS.get((kind, path.stem[:2]), "") in told
    assert " nan " not in told


def test_calibrate_writes_what_is_handed_over_with_its_axis(scant, tmp_path, monkeypatch):
    _, session, stages = scant
    monkeypatch.setenv(cache.VARIABLE, str(stages))
    status = calibrate_session(session, tmp_path)
    written = json.loads((tmp_path / "calibration.json").read_text())
    assert (status == 3) == (written["verdict"]["answer"] == "no")
    assert (np.diag(written["platform"]["axis_covariance"]) > 0).all(), "an axis that no data show is as stated"
