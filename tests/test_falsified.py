"""No wrong answer passes: whatever is falsified is named in the verdict, or changes nothing beyond chance."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from falsified import FALSIFIED
from joint_draws import draw, rng
from shared import campaign

from lrfcal_lib.evaluate.monte_carlo import state_errors
from lrfcal_lib.evaluate.verdict import contradicts_stated, verdict
from lrfcal_lib.fit.result import PlatformPrior
from lrfcal_lib.session.stated import LrfInfo
from lrfcal_lib.solvers.joint import solve_joint

STATED = np.radians(3.0), 0.03
SENSOR = ("range_offset", "edge_log_odds", "edge_log_softness", "pitch_scale")


def judged(change, seed, mount="head", stated=True):
    """Reasons of the verdict on falsified observations, and errors of axis and cameras in standard deviations."""
    obs, truth, rig = draw(rng(seed), 16, mount=mount, pitch_step=np.radians(2.0))
    prior = PlatformPrior(rig.T_head_lrf, *STATED)
    settings = {"sensor": SENSOR, "noise": "estimate", "lapse": 0.01, "sides": True, "axis": True, "prior": prior}
    T_head_lrf, settings["prior"] = (rig.T_head_lrf, prior) if stated else (None, None)
    solution = solve_joint(change(replace(obs, T_head_lrf=T_head_lrf)), required=False, **settings)
    cameras = {name: SimpleNamespace(guess=pose if stated else None) for name, pose in rig.cameras.items()}
    lrf = LrfInfo("home-made", (0.9, 2.2), 0.002, 0.005)
    session = SimpleNamespace(lrf=lrf, T_head_lrf=T_head_lrf, platform_sigma=STATED, cameras=cameras)
    prepared = SimpleNamespace(session=session, board=SimpleNamespace(pattern="a chessboard"))
    joint = SimpleNamespace(prepared=prepared, solution=solution, settings=settings)
    reasons, doubt = contradicts_stated(joint)
    reasons += verdict(solution, dict.fromkeys(rig.cameras, rig.model), suggest=False, doubt=doubt).reasons
    whole = len(solution.boards) == len(truth.boards)
    return reasons, state_errors(solution.state, truth, solution.unknowns)[:16] if whole else None, solution


LIVE = (  # what test_alternatives does not falsify; the others in make campaign
    "pitch reversed", "ranges 60 mm too long", "pitch 3 % too small", "noise of images stated a tenth",
    "scans of two placements exchanged", "spot stated 0.4 times too narrow", "three placements",
)  # fmt: skip


@pytest.mark.parametrize("name", [pytest.param(n, marks=[] if n in LIVE else campaign) for n in FALSIFIED])
def test_what_is_falsified_is_named(name):
    change, kinds = FALSIFIED[name]
    reasons, errors, solution = judged(change, 7)
    named = {reason.kind for reason in reasons} & set(kinds)
    harmless = errors is not None and np.abs(errors / solution.solution.trusted_sigma[:16]).max() < 3.5
    assert named or (harmless and not kinds), [reason.words for reason in reasons]


@pytest.mark.parametrize(
    ("name", "words"),
    [pytest.param("bearings mirrored", "other sense", marks=campaign),
     pytest.param("pitch reversed", "other sense", marks=campaign), ("cameras exchanged", "folders?")],
)  # fmt: skip
def test_what_is_named_where_no_platform_and_no_guess_is_stated(name, words):
    reasons, *_ = judged(FALSIFIED[name][0], 7, "platform", stated=False)
    assert words in "".join(reason.words for reason in reasons)


@pytest.mark.parametrize(
    ("seed", "mount"),
    [(11, "head"), (12, "platform"), *(pytest.param(*one, marks=campaign) for one in ((11, "platform"), (12, "head")))],
)
def test_an_honest_recording_gives_no_alarm(seed, mount):
    reasons, errors, solution = judged(lambda obs: obs, seed, mount)
    assert [reason.kind for reason in reasons if reason.kind not in ("error", "distance")] == []
    assert np.abs(errors / solution.solution.trusted_sigma[:16]).max() < 4.0
