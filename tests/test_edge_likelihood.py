"""Likelihood of beams near an edge: the disc, numeric derivatives, tails, statistics of the estimates."""

import numpy as np
import pytest

from lrfcal_lib.fit.edge_likelihood import beam_terms, disc_edge, disc_share

MARGINS = np.array([-0.03, -0.011, -0.004, -0.001, 0.0, 0.002, 0.006, 0.02])


def numeric(function, x, step=1e-6):
    return (function(x + step) - function(x - step)) / (2 * step)


def test_share_of_a_disc_by_counting():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (200_000, 2))
    inside = points[np.linalg.norm(points, axis=1) < 1]
    for x in (-0.8, -0.3, 0.0, 0.5, 0.9):
        assert np.mean(inside[:, 0] + x < 0) == pytest.approx(disc_share(x), abs=0.004)
    np.testing.assert_array_equal(disc_share([-3.0, -1.0, 1.0, 7.0]), [1, 1, 0, 0])


def test_edge_of_a_disc_inverts_its_share():
    log_odds = np.linspace(-7, 7, 401)
    x, slope = disc_edge(log_odds)
    share = disc_share(x)
    np.testing.assert_allclose(np.log(share / (1 - share)), log_odds, atol=1e-8)
    np.testing.assert_allclose(
        slope, numeric(lambda v: disc_edge(v)[0], log_odds, 1e-5), rtol=1e-5
    )
    assert (slope < 0).all() and (np.abs(x) < 1).all()


@pytest.mark.parametrize("margin", [-50.0, -1.0, 1.0, 50.0])
def test_tails_are_finite(margin):
    for hit in (True, False):
        assert all(
            np.isfinite(v).all() for v in beam_terms(np.array([margin]), 1e-3, hit, 1e-3)
        )


def test_a_lapse_bounds_what_one_beam_costs():
    far = beam_terms(np.array([-0.5]), 0.002, True, 0.01)
    assert far[0] == pytest.approx(-np.log(0.01), rel=1e-3) and abs(far[1]) < 1e-6


def test_information_far_outside_is_not_negative():
    margins = -np.logspace(-3, 2, 10_001)
    information = beam_terms(margins, 1e-4, np.ones(len(margins), bool))[2]
    assert (information >= 0).all()
