"""Likelihood of beams near an edge: the disc, numeric derivatives, tails, statistics of the estimates."""

import numpy as np
import pytest

from lrfcal_lib.fit.residuals import beam_terms, disc_edge, disc_share, edge_shift, interval_terms

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
    np.testing.assert_allclose(slope, numeric(lambda v: disc_edge(v)[0], log_odds, 1e-5), rtol=1e-5)
    assert (slope < 0).all() and (np.abs(x) < 1).all()


def test_a_weaker_background_makes_the_board_larger():
    near, slope = edge_shift(0.3, 0.02, background=0.0)
    far, _ = edge_shift(0.3, 0.02, background=-2 * np.log(3.0))
    assert near < far < 0.02
    assert slope == pytest.approx(numeric(lambda v: edge_shift(v, 0.02)[0], 0.3, 1e-5), rel=1e-5)


@pytest.mark.parametrize("hit", [True, False])
@pytest.mark.parametrize("lapse", [0.0, 0.01])
def test_derivatives_of_single_beams(hit, lapse):
    sigma = 0.004

    def cost(margin):
        return beam_terms(margin, sigma, hit, lapse)[0]

    _, score, information = beam_terms(MARGINS, sigma, hit, lapse)
    np.testing.assert_allclose(score, numeric(cost, MARGINS), rtol=1e-5, atol=1e-4)
    assert (information >= 0).all()
    if not lapse:
        second = numeric(lambda m: beam_terms(m, sigma, hit)[1], MARGINS)
        np.testing.assert_allclose(information, second, rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("half", [0.001, 0.005])
@pytest.mark.parametrize("sigma", [0.0004, 0.003])
def test_derivatives_of_intervals(half, sigma):
    def terms(margin):
        return interval_terms(margin + half, margin - half, sigma)

    _, score, information = terms(MARGINS)
    np.testing.assert_allclose(score, numeric(lambda m: terms(m)[0], MARGINS, 1e-7), rtol=1e-4, atol=1e-3)
    second = numeric(lambda m: terms(m)[1], MARGINS, 1e-7)
    np.testing.assert_allclose(information, np.maximum(second, 0), rtol=1e-3, atol=1.0)


def test_beams_that_flip_one_after_the_other_make_an_interval():
    inner, outer, sigma = 0.003, -0.005, 0.002
    whole = interval_terms(np.array([inner]), np.array([outer]), sigma)[0]
    wide = interval_terms(np.array([5.0]), np.array([outer]), sigma)[0]  # only the beam off the board
    assert wide == pytest.approx(beam_terms(np.array([outer]), sigma, False)[0][0])
    assert whole > wide


@pytest.mark.parametrize("margin", [-50.0, -1.0, 1.0, 50.0])
def test_tails_are_finite(margin):
    for hit in (True, False):
        assert all(np.isfinite(v).all() for v in beam_terms(np.array([margin]), 1e-3, hit, 1e-3))
    assert all(np.isfinite(v).all() for v in interval_terms(np.array([margin + 0.01]), np.array([margin]), 1e-3))


def test_a_lapse_bounds_what_one_beam_costs():
    far = beam_terms(np.array([-0.5]), 0.002, True, 0.01)
    assert far[0] == pytest.approx(-np.log(0.01), rel=1e-3) and abs(far[1]) < 1e-6
