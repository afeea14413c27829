"""The verdict on what is handed over: wrong sizes are named, thin sessions fail, commands and files say the same."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from shared import DATA
from tiny_sessions import record, rectangle

from lrfcal_lib import __main__
from lrfcal_lib.calibrate.pipeline import calibrate
from lrfcal_lib.evaluate import verdict
from lrfcal_lib.evaluate.export import UNTRUSTED, calibrate_session
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
    monkeypatch.setattr(verdict, "doubtful", lambda *arguments: [])
    monkeypatch.setattr(verdict, "not_an_offset", lambda *arguments: None)
    seen, sensor = SimpleNamespace(face_range=np.array([2.0])), {"range_offset": offset / 1000, "pitch_scale": 0.0}
    level = {"converged": True, "noise": {"face_scale": 1.0}, "sigma": {"range_offset": sigma / 1000}}
    solution = SimpleNamespace(
        sensor=sensor, observations=seen, transforms={}, boards={}, edge_bias=0.0, **level
    )
    prepared = SimpleNamespace(
        session=SimpleNamespace(lrf=lrf(systematic_error=0.004), T_head_lrf=None, cameras={}),
        board=SimpleNamespace(pattern=None),
    )
    found, doubt = verdict.contradicts_stated(SimpleNamespace(solution=solution, prepared=prepared))
    assert [reason.answer for reason in found] == answers
    assert doubt == (abs(offset) / 1000 if found else 0.0)
    assert all("board" in r.words and "squares" in r.words and f"{offset} mm" in r.words for r in found)


@pytest.fixture(scope="module")
def plate(tmp_path_factory):
    """Six placements of a board with a chessboard, and what the session states of it."""
    folder = tmp_path_factory.mktemp("plate") / "plate"
    record(folder, rectangle(0.03), seed=3, placements=6)
    return folder, json.loads((folder / "session.json").read_text())


def judged_as(plate, size):
    """The verdict on the plate with all its stated sizes times a factor."""
    folder, stated = plate
    board = json.loads(json.dumps(stated["board"]))
    board["corners_m"] = [[size * x for x in corner] for corner in board["corners_m"]]
    board["pattern"]["square_m"] *= size
    board["pattern"]["origin_m"] = [size * x for x in board["pattern"]["origin_m"]]
    (folder / "session.json").write_text(json.dumps(stated | {"board": board}))
    return verdict.judge(calibrate(open_session(folder), ["zhang_pless"]), suggest=False)


def test_a_board_stated_too_large_is_no_better_and_named(plate):
    honest, wrong = judged_as(plate, 1.0), judged_as(plate, 1.05)
    named = [reason.words for reason in wrong.reasons if reason.kind in ("range offset", "squares", "ranges")]
    assert named and all("board" in words and "squares" in words for words in named)
    assert not [reason for reason in honest.reasons if reason.kind in ("range offset", "squares", "ranges")]
    assert wrong.answer != "yes" != honest.answer
    for distance, errors in honest.errors.items():
        assert all(wrong.errors[distance][name] >= error for name, error in errors.items())


@pytest.fixture(scope="module")
def thin(tmp_path_factory):
    """Two of the four placements of the quick session."""
    folder = tmp_path_factory.mktemp("thin") / "thin"
    shutil.copytree(DATA / "sim_quick", folder)
    stated = json.loads((folder / "session.json").read_text())
    stated["placements"] = stated["placements"][:2]
    (folder / "session.json").write_text(json.dumps(stated))
    for table in (folder / "images.csv", folder / "lrf" / "index.csv"):
        head, *rows = table.read_text().splitlines()
        column, known = head.split(",").index("placement"), {"", "-1", *map(str, stated["placements"])}
        kept = [row for row in rows if row.split(",")[column] in known]
        table.write_text("\n".join([head, *kept]) + "\n")
    return folder


def test_a_thin_session_fails_and_says_so(thin, tmp_path, capsys):
    status, said = calibrate_session(thin, tmp_path), capsys.readouterr().out
    assert status == UNTRUSTED == 3
    assert "This calibration cannot be trusted: nothing can be handed over" in said
    assert not (tmp_path / "calibration.json").exists()


@pytest.mark.parametrize(("session", "warned"), [("sim_quick", True), ("sim_lms221", False)])
def test_check_warns_of_few_placements(session, warned, capsys):
    assert __main__.main(["check", str(DATA / session)]) == 0
    count = len(open_session(DATA / session).board_placements)
    assert (f"warning: {count} placements" in capsys.readouterr().out) == warned
