"""Sessions of rigs that nothing was tuned on: what is claimed of errors is what the truth shows."""

import numpy as np
import pytest
import varied_sessions
from scipy.stats import chi2
from shared import campaign

from lrfcal_lib.evaluate.monte_carlo import state_errors
from lrfcal_lib.solvers.joint import solve_joint

SENSOR = ("range_offset", "edge_log_odds", "edge_log_softness", "pitch_scale")


def is_plate(outcome):
    """Whether its board is a rectangle."""
    return outcome.calibration.prepared.board.name == "plate"


@pytest.mark.parametrize("count", [12, pytest.param(100, marks=campaign)])
def test_claims_hold_on_varied_draws(count):
    """All shared unknowns that have a truth, together with their full covariance and one by one."""
    square = 0.0
    size = 0
    inside = []
    for seed in range(count):
        obs, truth = varied_sessions.drawn(seed)
        found = solve_joint(
            obs, sensor=SENSOR, sides=True, lapse=0.01, noise="estimate", required=False
        )
        known = [
            i
            for i, name in enumerate(found.solution.names)
            if name not in varied_sessions.NOT_SHOWN
        ]
        errors = state_errors(found.state, truth, found.unknowns)[known]
        covariance = found.solution.trusted[np.ix_(known, known)]
        square += errors @ np.linalg.solve(covariance, errors)
        size += len(errors)
        inside.append(varied_sessions.inside(errors / np.sqrt(np.diag(covariance))))
        print(
            seed,
            obs.mounts[0],
            round(float(errors @ np.linalg.solve(covariance, errors)) / len(errors), 2),
        )
    print(square / size, np.mean(inside))
    low, high = chi2.ppf([0.001, 0.999], size) / size
    assert low * 0.85 < square / size < high * 1.15
    assert 0.82 < np.mean(inside) < 0.97


@campaign
def test_claims_hold_on_varied_sessions(tmp_path):
    """All shared unknowns together with their full covariance, one by one, and the lengths of the boards' edges."""
    outcomes = []
    for seed in range(24):
        outcomes.append(
            varied_sessions.judged(varied_sessions.record(tmp_path / str(seed), seed))
        )
        print(seed, outcomes[-1].square, len(outcomes[-1].names), outcomes[-1].answer)
    solved = [outcome for outcome in outcomes if len(outcome.names)]
    square = sum(outcome.square for outcome in solved) / sum(
        len(outcome.names) for outcome in solved
    )
    scores = np.concatenate([outcome.scores for outcome in solved])
    lengths = np.concatenate([outcome.lengths for outcome in solved])
    assert len(solved) >= 22
    assert 0.85 < square < 1.2
    # cameras and axis lean on each other: some five independent numbers a session, 0.90 +- 0.03
    assert 0.84 < varied_sessions.inside(scores) < 0.96
    assert 0.86 < varied_sessions.inside(lengths) < 0.94
    plates = [outcome.lengths for outcome in solved if is_plate(outcome)]
    assert varied_sessions.inside(np.concatenate(plates)) < 0.96
    wrong = [
        outcome
        for outcome in solved
        if outcome.answer == "yes" and np.abs(outcome.scores).max() > 3
    ]
    assert len(wrong) <= 1
