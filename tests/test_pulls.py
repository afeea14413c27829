"""What observations say about a rig: without unknowns of their own, and where they say nothing."""

import numpy as np

from lrfcal_lib.measure.pulls import Pull, pull_of_groups, without


def random_pull(rng, count):
    """Of so many unknowns, and what it makes of them with a sigma of the last two."""
    root = rng.normal(size=(count, count))
    return Pull(root @ root.T, rng.normal(size=count), 9.0)


def test_unknowns_are_left_out_as_if_they_were_estimated_too():
    rng = np.random.default_rng(1)
    pull = random_pull(rng, 7)
    sigma = np.array([0.3, 2.0])
    whole = pull.information + np.diag(np.r_[np.zeros(5), sigma**-2.0])
    short = without(pull, sigma)
    covariance = np.linalg.inv(whole)
    np.testing.assert_allclose(np.linalg.inv(short.information), covariance[:5, :5])
    estimate = np.linalg.solve(short.information, short.slope)
    np.testing.assert_allclose(estimate, (covariance @ pull.slope)[:5])
    assert short.groups == pull.groups


def test_the_less_is_known_of_what_is_left_out_the_less_is_said():
    pull = random_pull(np.random.default_rng(2), 6)
    said = [np.diag(without(pull, np.full(2, s)).information) for s in (1e-6, 1.0, 1e6)]
    assert (said[0] > said[1]).all() and (said[1] > said[2]).all()
    np.testing.assert_allclose(
        without(pull, np.full(2, 1e-6)).information, pull.information[:4, :4], rtol=1e-6
    )
    assert without(pull, np.zeros(0)).information.shape == (6, 6)


def test_observations_of_no_weight_say_nothing():
    """No patch of two images is alike: no crash, and no opinion."""
    nothing = np.zeros((4, 5))
    pull = pull_of_groups(
        np.zeros((5, 5)), nothing, np.arange(4), np.zeros(5), np.arange(2)
    )
    assert not pull.information.any() and not pull.slope.any() and pull.groups == 0


def test_groups_that_disagree_are_worth_less():
    rng = np.random.default_rng(3)
    J = rng.normal(size=(200, 3))
    group = np.repeat(np.arange(20), 10)
    said = []
    for common in (0.0, 3.0):
        errors = rng.normal(size=200) + common * rng.normal(size=20)[group]
        x = np.linalg.lstsq(J, errors)[0]
        by_row = J * (errors - J @ x)[:, None]
        pull = pull_of_groups(J.T @ J, by_row, group, x, np.arange(3))
        said.append(pull.information[0, 0])
    assert said[1] < said[0] / 4
