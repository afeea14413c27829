"""The verdict on what is handed over: wrong sizes are named, thin sessions fail, commands and files say the same."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from shared import DATA, campaign

from lrfcal_lib import __main__
from lrfcal_lib.calibrate import pipeline
from lrfcal_lib.judge import statements, verdict, weaknesses
from lrfcal_lib.model.board import triangle_board
from lrfcal_lib.preprocess.prepared import DroppedSide
from lrfcal_lib.session.read import open_session
from lrfcal_lib.session.stated import LrfInfo, from_json, lrf_to_json


def lrf(model="SICK LMS400", **options):
    return LrfInfo(model, (0.9, 2.2), 0.002, 0.005, **options)


@pytest.mark.parametrize(("stated", "admitted"), [
    ({"model": "LMS221-30206 (simulated)"}, 0.035),
    ({"model": "LMS221-30206", "range_resolution": 0.01}, 0.05),
    ({"model": "home-made"}, 0.025),
    ({"model": "SICK LMS400", "systematic_error": 0.012}, 0.012),
])  # fmt: skip
def test_what_the_maker_admits_is_stated_or_known_of_the_model(stated, admitted):
    assert lrf(**stated).admitted_offset == admitted
    assert from_json(LrfInfo, json.loads(json.dumps(lrf_to_json(lrf(**stated))))).admitted_offset == admitted


@pytest.mark.parametrize(
    ("offset", "sigma", "answers"),
    [(-5.2, 2.2, []), (9, 2, []), (11, 2, ["with care"]), (-87, 3.9, ["no"]), (68, 14, ["no"]), (30, 14, [])],
)
def test_a_range_offset_that_no_maker_admits(monkeypatch, offset, sigma, answers):
    """Millimetres; of as much of a joint calibration as tells it. By as much all ranges may be wrong."""
    monkeypatch.setattr(statements, "doubtful", lambda *arguments, **options: [])
    monkeypatch.setattr(statements, "not_an_offset", lambda *arguments: None)
    seen, sensor = SimpleNamespace(face_range=np.array([2.0])), {"range_offset": offset / 1000, "pitch_scale": 0.0}
    level = {"converged": True, "noise": {"face_scale": 1.0}, "sigma": {"range_offset": sigma / 1000}}
    solution = SimpleNamespace(
        sensor=sensor, observations=seen, transforms={}, boards={}, edge_bias=0.0, **level
    )
    prepared = SimpleNamespace(
        session=SimpleNamespace(lrf=lrf(systematic_error=0.004), T_head_lrf=None, cameras={}, board=triangle_board()),
        board=triangle_board(),
    )
    found, doubt = statements.contradicts_stated(SimpleNamespace(solution=solution, prepared=prepared))
    assert [reason.answer for reason in found] == answers
    assert doubt == (abs(offset) / 1000 if found else 0.0)
    assert all("board" in r.words and "squares" in r.words and f"{offset} mm" in r.words for r in found)


@pytest.mark.parametrize(
    ("dropped", "named", "words"),
    [(16, 0, "16 of 16 scans (12 mm off, turned by 8.0 deg)"), (9, 7, "9 of 16"), (8, 8, None), (2, 0, None)],
)
def test_an_edge_that_lies_elsewhere_in_most_scans_is_a_reason(dropped, named, words):
    turned = DroppedSide("bc", 0.012, np.radians(8.0))
    prepared = SimpleNamespace(
        board=triangle_board(),
        names={p: {0: "ab", 1: "bc"} for p in range(named)} | {p: {0: "ab"} for p in range(100, 100 + dropped)},
        dropped={p: {1: turned} for p in range(100, 100 + dropped)},
    )
    reasons = list(weaknesses.sides_elsewhere(prepared))
    assert [reason.kind for reason in reasons] == ["outline"] * (words is not None)
    assert all("edge 'bc'" in reason.words and words in reason.words for reason in reasons)


@campaign
@pytest.mark.parametrize("length", [0.375, 0.415])
def test_an_edge_stated_wrong_is_named_by_a_whole_session(length, tmp_path):
    folder = shutil.copytree(DATA / "sim_quick", tmp_path / "session")
    stated = json.loads((folder / "session.json").read_text())
    stated["board"]["corners_m"][1][0] = length
    (folder / "session.json").write_text(json.dumps(stated))
    reasons = verdict.judge(pipeline.calibrate(open_session(folder)), suggest=False).reasons
    assert any(reason.kind == "outline" and "edge 'bc'" in reason.words for reason in reasons)


def test_errors_beyond_all_bounds_are_not_numbers():
    assert verdict.bounded(1.7e30) == np.inf
    assert verdict.bounded(12.0) == 12.0


@pytest.mark.parametrize(("session", "warned"), [("sim_quick", True), ("sim_lms221", False)])
def test_check_warns_of_few_placements(session, warned, capsys):
    assert __main__.main(["check", str(DATA / session)]) == 0
    count = len(open_session(DATA / session).board_placements)
    assert (f"warning: {count} placements" in capsys.readouterr().out) == warned
