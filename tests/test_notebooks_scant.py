"""Notebooks on sessions that leave questions open: they run to the end, and say what cannot be asked."""

import pytest
from notebook_runs import WITH_SESSION, run_plainly
from tiny_sessions import record, rectangle

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
    told = run_plainly(path, session, stages)
    assert SAYS.get((kind, path.stem[:2]), "") in told
    assert "sigma nan" not in told
