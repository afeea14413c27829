"""Sessions of rigs that nothing was tuned on: what is claimed of errors is what the truth shows."""

import numpy as np
import varied_sessions
from shared import campaign


@campaign
def test_claims_hold_on_varied_sessions(tmp_path):
    """All shared unknowns together with their full covariance, one by one, and the lengths of the boards' edges."""
    outcomes = []
    for seed in range(24):
        outcomes.append(varied_sessions.judged(varied_sessions.record(tmp_path / str(seed), seed)))
        print(seed, outcomes[-1].square, len(outcomes[-1].names), outcomes[-1].answer)
    solved = [outcome for outcome in outcomes if len(outcome.names)]
    square = sum(outcome.square for outcome in solved) / sum(len(outcome.names) for outcome in solved)
    scores = np.concatenate([outcome.scores for outcome in solved])
    lengths = np.concatenate([outcome.lengths for outcome in solved])
    assert len(solved) >= 22
    assert 0.85 < square < 1.2
    assert 0.87 < varied_sessions.inside(scores) < 0.93
    assert 0.86 < varied_sessions.inside(lengths) < 0.94
    wrong = [outcome for outcome in solved if outcome.answer == "yes" and np.abs(outcome.scores).max() > 3]
    assert len(wrong) <= 1
