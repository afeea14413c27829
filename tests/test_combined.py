"""How well combined lengths are known, from how they scatter over placements."""

import numpy as np
import pytest

from lrfcal_lib.calibrate.combined import as_scattered
from lrfcal_lib.calibrate.outline import MeasuredBoard

TRUE = {"ab": 0.315, "bc": 0.49, "ca": 0.38}
SIGMA = 0.0005


def boards(excess, count=40, size=1.0):
    """Lengths of some placements that scatter `excess` times as much as they say."""
    rng = np.random.default_rng(5)
    found = {}
    for placement in range(1, count + 1):
        lengths = {
            name: size * length + excess * SIGMA * rng.standard_normal()
            for name, length in TRUE.items()
        }
        found[placement] = (
            MeasuredBoard(
                np.eye(4),
                np.zeros((0, 3)),
                {},
                lengths,
                sigma=dict.fromkeys(lengths, SIGMA),
            ),
            frozenset(),
        )
    return found


@pytest.mark.parametrize(
    ("excess", "grown"), [(0.5, 1.0), (1.0, 1.0), (2.0, 2.0), (5.0, 5.0)]
)
@pytest.mark.parametrize("size", [1.0, 1.1])
def test_lengths_that_scatter_more_than_they_say_are_less_well_known(excess, grown, size):
    """Whatever the board's true size is; lengths stay as they are."""
    before = boards(excess, size=size)
    after = as_scattered(before)
    sigma = [value for board, _ in after.values() for value in board.sigma.values()]
    assert np.mean(sigma) / SIGMA == pytest.approx(grown, rel=0.12)
    assert all(
        after[placement][0].lengths == board.lengths
        for placement, (board, _) in before.items()
    )


def test_single_lengths_stay_as_they_are():
    assert as_scattered(boards(3.0, count=1))[1][0].sigma == dict.fromkeys(TRUE, SIGMA)
    assert as_scattered({}) == {}
