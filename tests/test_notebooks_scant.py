"""Notebooks on sessions that leave questions open: they run to the end, and say what cannot be asked."""

import json
from dataclasses import replace

import numpy as np
import pytest
from notebook_runs import WITH_SESSION, run_plainly
from shared import campaign
from tiny_sessions import record, rectangle

from lrfcal_lib.calibrate.pipeline import calibrate
from lrfcal_lib.judge import statements, verdict
from lrfcal_lib.report.calibrate import calibrate_session
from lrfcal_lib.session import cache
from lrfcal_lib.session.read import open_session

SCANT = {  # besides, none has images at several pitches
    "lines": {
        "pitch_deg": [0.0],
        "platform": None,
    },  # single scan lines, no platform: no sweep, no axis, no cloud
    "wall": {"on_wall": True},  # a chessboard on a wall: faces, no edges
    "edges": {
        "pattern": False,
        "cameras": ["left"],
        "placements": 4,
        "platform": None,
    },  # a plain board, one camera
    "blind": {"cameras": [], "placements": 4},  # no camera
    "parallel": {"still": ("turn",), "placements": 3},  # nothing to answer from
    "scenes": {"purpose": "scene", "placements": 2},  # no board at all
}
FEW = (
    "as recorded",
    "all sizes 5 % too large",
)  # the whole table is made of three other sessions
SAYS = {
    ("scenes", "01"): "no sweep shows a board, so none is drawn below",
    ("scenes", "02"): "no sweep shows a board",
    ("lines", "01"): "a single scan line",
    ("lines", "03"): "no sweeps with a straight side",
    ("lines", "07"): "half of them do not determine the rig",
    ("wall", "04"): "the images do not agree on the top edge",
    ("wall", "05"): "no placement has sides",
    ("edges", "07"): "placements, 6 or more are needed",
    ("blind", "01"): "this session has no images",
    ("blind", "04"): "no camera could be calibrated",
    (
        "blind",
        "07",
    ): "cannot be trusted: nothing can be handed over: the session has no camera",
    ("parallel", "06"): "no camera could be calibrated",
    ("parallel", "07"): "all 3 boards are parallel: the rotation about their normal",
}


@pytest.fixture(scope="module")
def scant(request, tmp_path_factory):
    """A session with too little in it for some questions: its kind, folder, and a folder for its stages."""
    folder = tmp_path_factory.mktemp(request.param)
    settings = {"placements": 6} | SCANT[request.param]
    plain = settings.pop("pattern", True)
    board = (
        rectangle(0.02)
        if plain
        else replace(rectangle(0.0, size=(0.34, 0.25)), pattern=None)
    )
    record(folder / "session", board, **settings)
    return request.param, folder / "session", folder / "stages"


# say something of their own, and take long
LATER = ("lines", "03"), ("lines", "07"), ("wall", "04"), ("wall", "05"), ("edges", "07")


@pytest.mark.parametrize(
    ("scant", "path"),
    [pytest.param(kind, path, id=f"{kind}-{path.stem}",
                  marks=[] if (kind, path.stem[:2]) in SAYS.keys() - LATER else campaign)
     for kind in SCANT for path in WITH_SESSION if kind != "parallel" or path.stem > "04"],  # its scans are as others
    indirect=["scant"],
)  # fmt: skip
def test_runs_to_the_end_and_says_what_is_not_asked(path, scant, monkeypatch, request):
    """Live what says something of its own; all other notebooks, and the looks of all figures, in make campaign."""
    kind, session, stages = scant
    monkeypatch.setattr(statements, "LIES", {name: statements.LIES[name] for name in FEW})
    told = run_plainly(
        path,
        session,
        stages,
        stages / "report",
        drawn="campaign" in request.config.option.markexpr,
    )
    assert SAYS.get((kind, path.stem[:2]), "") in told
    assert " nan " not in told


@pytest.mark.parametrize(
    "scant",
    [
        pytest.param(kind, marks=campaign if kind in ("lines", "wall") else ())
        for kind in SCANT
    ],
    indirect=True,
)
def test_calibrate_writes_what_is_handed_over_with_its_axis(scant, tmp_path, monkeypatch):
    _, session, stages = scant
    monkeypatch.setenv(cache.VARIABLE, str(stages))
    status = calibrate_session(session, tmp_path)
    if not (tmp_path / "calibration.json").exists():
        assert status == 3
        return
    written = json.loads((tmp_path / "calibration.json").read_text())
    assert (status == 3) == (written["verdict"]["answer"] == "no")
    assert (np.diag(written["platform"]["axis_covariance"]) > 0).all(), (
        "an axis that no data show is as stated"
    )


@campaign
def test_half_of_the_scans_without_ranges_is_a_verdict(tmp_path):
    path = record(
        tmp_path / "session", rectangle(0.02), pitch_deg=np.arange(-14.0, 15.0, 2.0)
    )
    scans = dict(np.load(path / "lrf/scans.npz"))
    scans["ranges"] = np.where((scans["placement"] > 2)[:, None], np.nan, scans["ranges"])
    np.savez(path / "lrf/scans.npz", **scans)
    judged = verdict.judge(calibrate(open_session(path), ["zhang_pless"]))
    told = " ".join(judged.sentences())
    assert (
        judged.answer == "no"
        and "1 of the 3 placements with a board pose and points on the board" in told
    )
    assert "placement 3: no range in any scan line" in told
    assert told.count("camera 'left': camera 'left'") == 0
    assert "Record next: 6 or more placements" in told
