"""The verdict on what is handed over: wrong sizes are named, thin sessions fail, commands and files say the same."""

import json
import shutil

import numpy as np
import pytest
from shared import DATA, campaign

from lrfcal_lib import __main__
from lrfcal_lib.calibrate import pipeline
from lrfcal_lib.judge import verdict
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
    assert (
        from_json(
            LrfInfo, json.loads(json.dumps(lrf_to_json(lrf(**stated))))
        ).admitted_offset
        == admitted
    )


@pytest.mark.parametrize(("model", "step_deg", "stated", "sigma"), [
    ("LMS221-30206 (simulated)", 0.5, None, 0.0), ("LMS221-30206", 0.505, None, 0.0058),
    ("SICK LMS400", 0.1, None, 0.0), ("TiM561", 0.3333, None, 0.0), ("home-made", 0.5, None, 0.0058),
    ("home-made", 0.5, 0.0, 0.0), ("LMS221-30206", 0.5, 0.001, 0.001),
])  # fmt: skip
def test_the_angular_step_is_known_as_stated_or_as_of_the_model(
    model, step_deg, stated, sigma
):
    lrf = LrfInfo(model, (0.9, 2.2), np.radians(step_deg), 0.005, step_error=stated)
    assert lrf.step_sigma == sigma
    assert from_json(LrfInfo, lrf_to_json(lrf)).step_sigma == sigma


@campaign
@pytest.mark.parametrize("length", [0.375, 0.415])
def test_an_edge_stated_wrong_is_named_by_a_whole_session(length, tmp_path):
    folder = shutil.copytree(DATA / "sim_quick", tmp_path / "session")
    stated = json.loads((folder / "session.json").read_text())
    stated["board"]["corners_m"][1][0] = length
    (folder / "session.json").write_text(json.dumps(stated))
    reasons = verdict.judge(pipeline.calibrate(open_session(folder)), suggest=False).reasons
    assert any(
        reason.kind == "outline" and "edge 'bc'" in reason.words for reason in reasons
    )


def test_errors_beyond_all_bounds_are_not_numbers():
    assert verdict.bounded(1.7e30) == np.inf
    assert verdict.bounded(12.0) == 12.0


@pytest.mark.parametrize(
    ("session", "warned"), [("sim_quick", True), ("sim_lms221", False)]
)
def test_check_warns_of_few_placements(session, warned, capsys):
    assert __main__.main(["check", str(DATA / session)]) == 0
    count = len(open_session(DATA / session).board_placements)
    assert (f"warning: {count} placements" in capsys.readouterr().out) == warned
