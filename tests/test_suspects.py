"""What may have moved, by creases alone: the suspect is named, by how much, and how sure that is."""

from dataclasses import replace

import numpy as np
import pytest
from holds_draws import ROOM, on_base, true_rig
from scipy.special import chdtrc

from lrfcal_lib.measure.creases import EDGE, PLACES, Sights
from lrfcal_lib.measure.pulls import poses_of
from lrfcal_lib.measure.suspects import SURE, most_likely, suspects
from lrfcal_lib.session.read import open_session

CREASES = 40
MOVES = {
    "left": np.r_[np.radians([0.3, -0.2, 0.2]), 0.0, 0.0, 0.0],
    "right": np.r_[0.0, 0.0, 0.0, 0.006, -0.005, 0.004],
    "head": np.radians([0.3]),
}


@pytest.fixture(scope="module")
def rig():
    return true_rig(open_session(ROOM))


def columns_of(rig, suspect):
    """Of the unknowns that it has moved by."""
    if suspect == "head":
        return np.array([len(rig.uncertainty.names)])
    return poses_of(rig, suspect)


def seen_by(rig, suspect, rng, clutter=3):
    """What images show of creases after a suspect has moved: an edge each, and others at random.

    Of a rig that errs as it says; a crease is off as a whole.
    """
    count = len(rig.uncertainty.names)
    change = np.zeros(count + 1)
    change[:count] = rng.multivariate_normal(
        np.zeros(count), rig.uncertainty.covariance, method="cholesky"
    )
    moved = change.copy()
    if suspect:
        moved[columns_of(rig, suspect)] += MOVES[suspect]
    seen = []
    for camera in rig.cameras:
        by_unknown = np.zeros((CREASES, count + 1))
        by_unknown[:, poses_of(rig, camera)] = rng.normal(
            0, [35.0] * 3 + [12.0] * 3, (CREASES, 6)
        )
        by_unknown[:, -1] = rng.normal(0, 35.0, CREASES)
        edge = by_unknown @ moved + rng.normal(0, EDGE, CREASES)
        others = rng.uniform(-1, 1, (CREASES, clutter))
        across = np.column_stack([edge, others])
        rows = np.repeat(np.arange(CREASES), PLACES)
        place = np.repeat(np.arange(len(rows)), 1 + clutter)
        clear = np.full(len(place), 0.8)
        sigma = np.full(len(place), EDGE)
        crease = rows[place]
        seen.append(Sights(place, by_unknown[crease], across[rows].ravel(), clear, sigma))
    return seen


@pytest.mark.parametrize("suspect", ["left", "right", "head"])
def test_who_moved_is_named_and_by_how_much(rig, suspect):
    """Its change errs as it says, pooled over all parameters with their correlations."""
    if suspect == "head":
        rig = on_base(rig, 0.0)
    pooled = 0.0
    parameters = 0
    for seed in range(8):
        seen = seen_by(rig, suspect, np.random.default_rng(seed))
        (named,) = most_likely(suspects(seen, rig))
        assert (named.camera or "head") == suspect
        miss = named.change - MOVES[suspect]
        pooled += miss @ np.linalg.solve(named.covariance, miss)
        parameters += len(miss)
    assert chdtrc(parameters, pooled) > 1e-3


@pytest.mark.parametrize("mount", ["head", "platform"])
def test_where_nothing_has_moved_nothing_is_named(rig, mount):
    if mount == "platform":
        rig = on_base(rig, 0.0)
    for seed in range(6):
        seen = seen_by(rig, None, np.random.default_rng(seed))
        shifts = suspects(seen, rig)
        assert len(shifts) == 2 + (mount == "platform")
        assert not most_likely(shifts)


def test_what_shows_needs_less_of_a_change_the_more_is_seen(rig):
    seen = seen_by(rig, None, np.random.default_rng(1))
    few = suspects([replace(part, clear=part.clear / 50) for part in seen], rig)
    for less, more in zip(few, suspects(seen, rig), strict=True):
        assert less.shows[0] > more.shows[0] and less.shows[1] > more.shows[1]


def test_where_nothing_was_observed_nobody_is_suspected(rig):
    assert suspects([], rig) == []


def test_of_suspects_those_that_are_nearly_as_likely_are_said_too(rig):
    """The most likely first; odds of 20 to 1 are enough to name it alone."""
    seen = seen_by(rig, "left", np.random.default_rng(2))
    left, right = suspects(seen, rig)
    head = replace(left, camera=None, evidence=70.0)
    left = replace(left, evidence=80.0)
    near = replace(right, evidence=80.0 + 0.9 * SURE)
    assert most_likely([head, near, left]) == [near, left]
    assert most_likely([replace(right, evidence=80.0 - 1.1 * SURE), left, head]) == [left]
    assert most_likely([]) == []
    assert most_likely([replace(left, evidence=0.9 * SURE)]) == []


def test_a_slip_of_no_account_raises_no_alarm(rig):
    """However sure it is."""
    rig = on_base(rig, 0.0)
    seen = seen_by(rig, "head", np.random.default_rng(3))
    head = replace(suspects(seen, rig)[-1], evidence=1e6)
    assert head.odds == 1e6 and not most_likely([replace(head, change=head.change / 10)])
