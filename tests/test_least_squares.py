"""The least-squares core: convergence, batches, losses, covariances, what is unobservable."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.special

from lrfcal_lib.fit.covariance import motion_words, placement_covariance, pseudo_inverse
from lrfcal_lib.fit.least_squares import (
    Block,
    minimise,
    solve,
)
from lrfcal_lib.model.geometry import DegenerateGeometry


def line_problem(x, y, sigma=1.0):
    """Straight line y = a x + b for one or many trials, unknowns (a, b)."""

    def evaluate(state):
        r = state[..., :1] * x + state[..., 1:] - y
        J = np.broadcast_to(np.stack([x, np.ones_like(x)], -1), r.shape + (2,))
        return Block(r, J, np.full(r.shape, 1.0 / sigma))

    return evaluate


def fit(evaluate, start, **options):
    settings = dict(
        names=("slope", "offset"),
        method="straight line",
        read=lambda s: (None, s),
        required=False,
    )
    return solve(evaluate, start, np.add, **(settings | options))


@pytest.fixture
def data():
    rng = np.random.default_rng(1)
    x = np.linspace(-1, 1, 40)
    return x, 2 * x + 0.5 + rng.normal(0, 0.1, 40)


def test_linear_problem_matches_the_normal_equations(data):
    x, y = data
    found = fit(line_problem(x, y, 0.1), np.zeros(2))
    A = np.stack([x, np.ones_like(x)], 1)
    np.testing.assert_allclose(
        found.parameters, np.linalg.lstsq(A, y, rcond=None)[0], atol=1e-12
    )
    np.testing.assert_allclose(
        found.covariance, 0.01 * np.linalg.inv(A.T @ A), rtol=1e-9, atol=1e-15
    )
    assert found.converged and found.inflation == 1.0
    assert len(found.cost_history) == found.iterations + 1
    assert np.all(np.diff(found.cost_history) <= 1e-9)


def test_too_small_stated_noise_inflates_the_covariance_and_too_large_never_shrinks_it(
    data,
):
    honest, boastful, modest = (
        fit(line_problem(*data, sigma), np.zeros(2)) for sigma in (0.1, 0.01, 1.0)
    )
    assert boastful.inflation > 50 and modest.inflation == 1.0
    np.testing.assert_allclose(boastful.sigma, honest.sigma, rtol=0.3)


def test_robust_result_matches_scipy(data):
    x, y = data
    y = y + 3.0 * (np.arange(40) % 9 == 0)
    ours = fit(line_problem(x, y, 0.1), np.zeros(2), robust=True)
    level = np.median(np.abs(ours.residuals)) / np.sqrt(scipy.special.chdtri(1, 0.5))
    options = {"loss": "cauchy", "f_scale": 2.385 * level, "xtol": 1e-15, "gtol": 1e-15}
    theirs = scipy.optimize.least_squares(
        lambda p: (p[0] * x + p[1] - y) / 0.1, [0, 0], **options
    )
    np.testing.assert_allclose(ours.parameters, theirs.x, atol=1e-6)


def test_a_start_value_that_is_not_finite_is_refused(data):
    with pytest.raises(ValueError, match="not finite"):
        fit(line_problem(*data), np.array([np.nan, 0.0]))


def test_schur_complement_equals_the_dense_solution():
    rng = np.random.default_rng(4)
    shared = rng.normal(size=(5, 9, 2))
    own = rng.normal(size=(5, 9, 3))
    y = rng.normal(size=(5, 9))
    J = np.concatenate([shared, own], axis=-1)

    def evaluate(state):
        common, local = state
        r = shared @ common + (own @ local[..., None])[..., 0] - y
        return Block(r, J, np.ones_like(r))

    start = (np.zeros(2), np.zeros((5, 3)))
    options = dict(shared=2, read=lambda s: (None, s[0]))
    found = solve(
        evaluate,
        start,
        lambda s, d: (s[0] + d[0, :2], s[1] + d[:, 2:]),
        names="ab",
        method="arrow",
        freedom=45 - 17,
        **options,
    )
    dense = np.zeros((45, 17))
    dense[:, :2] = shared.reshape(45, 2)
    for i in range(5):
        dense[9 * i : 9 * i + 9, 2 + 3 * i : 5 + 3 * i] = own[i]
    np.testing.assert_allclose(
        found.parameters, np.linalg.lstsq(dense, y.ravel(), rcond=None)[0][:2], atol=1e-11
    )
    np.testing.assert_allclose(
        found.covariance,
        np.linalg.inv(dense.T @ dense)[:2, :2] * found.inflation,
        rtol=1e-9,
    )


def test_placement_covariance_is_the_jackknife():
    rng = np.random.default_rng(5)
    A = rng.normal(size=(60, 3))
    y = rng.normal(size=60)
    groups = np.repeat(np.arange(12), 5)
    estimate = np.linalg.lstsq(A, y, rcond=None)[0]
    r = A @ estimate - y
    parts = [
        (A[groups == g].T @ A[groups == g], A[groups == g].T @ r[groups == g])
        for g in range(12)
    ]
    covariance = placement_covariance(*(np.array(x) for x in zip(*parts, strict=True)))
    left_out = [
        np.linalg.lstsq(A[groups != g], y[groups != g], rcond=None)[0] - estimate
        for g in range(12)
    ]
    plain = 11 / 12 * sum(np.outer(d, d) for d in left_out)
    factor = np.sqrt(np.diag(covariance) / np.diag(plain))
    np.testing.assert_allclose(covariance, plain * np.outer(factor, factor), atol=1e-12)
    assert (factor < 1).all()  # see below


@pytest.mark.parametrize("placements", [6, 14])
def test_noise_alone_scatters_over_placements_as_it_is_stated(placements):
    """In the mean, also of placements of unequal weight (the plain jackknife: 1.07 to 1.27 times as much)."""
    rng = np.random.default_rng(8)
    A = rng.normal(size=(placements, 5, 3)) * rng.uniform(0.3, 3.0, (placements, 1, 1))
    H = A.swapaxes(1, 2) @ A
    whole = np.linalg.inv(H.sum(axis=0))
    noise = rng.normal(size=(20000, placements, 5))
    scores = np.einsum("gnj,tgn->tgj", A, noise)
    steps = scores.sum(axis=1) @ whole
    at_solution = scores - np.einsum("gij,tj->tgi", H, steps)
    scatter = placement_covariance(np.broadcast_to(H, (20000, *H.shape)), at_solution)
    mean = np.diagonal(scatter, axis1=-2, axis2=-1).mean(axis=0)
    np.testing.assert_allclose(mean, np.diag(whole), rtol=0.03)


@pytest.mark.parametrize("groups", [np.zeros(40, int), np.arange(40) // 20])
def test_no_placement_covariance_from_too_few_placements(data, groups):
    found = fit(line_problem(*data), np.zeros(2), groups=groups)
    assert np.isnan(found.covariance_placements).all()


NOISE = np.array([[4.0, 1.8], [1.8, 1.0]])


@pytest.mark.parametrize(("noise", "scatter", "sigma"), [
    (NOISE, np.full((2, 2), np.nan), [2, 1]),
    (NOISE, np.diag([1.0, 9.0]), [2, 3]),  # one by one: neither matrix as a whole
    (NOISE, np.diag([16.0, 0.25]), [4, 1]),
    (np.diag([np.inf, 1.0]), np.diag([1.0, 9.0]), [np.inf, 3]),
    (np.diag([0.0, 1.0]), np.diag([0.0, np.nan]), [0, 1]),
])  # fmt: skip
def test_scatter_over_many_placements_is_trusted_where_noise_is_smaller(
    data, noise, scatter, sigma
):
    found = fit(line_problem(*data), np.zeros(2))
    found = replace(
        found, covariance=noise, covariance_placements=scatter, n_placements=10**6
    )
    np.testing.assert_allclose(found.trusted_sigma, sigma, rtol=1e-5)
    assert (
        np.linalg.eigvalsh(np.where(np.isfinite(found.trusted), found.trusted, 0.0)).min()
        >= 0
    )


@pytest.mark.parametrize(
    "scatter", [np.diag([9.0, 1.0]), np.diag([1.0, 25.0]), np.diag([9.0, 25.0])]
)
def test_no_combination_is_better_known_than_its_noise(data, scatter):
    """Two cameras lean on one axis: that one of them scatters makes their difference no better known."""
    noise = np.array([[1.0, 0.9995], [0.9995, 1.0]])
    found = fit(line_problem(*data), np.zeros(2))
    found = replace(
        found, covariance=noise, covariance_placements=scatter, n_placements=10**6
    )
    added = found.trusted - noise
    np.testing.assert_allclose(np.diag(found.trusted), np.diag(scatter), rtol=1e-5)
    assert np.linalg.eigvalsh(added).min() > -1e-9
    errors = np.random.default_rng(4).multivariate_normal(np.zeros(2), noise, 1000)
    assert np.mean(np.vecdot(errors @ np.linalg.inv(found.trusted), errors)) / 2 < 1


@pytest.mark.parametrize("placements", [4, 12, 40])
@pytest.mark.parametrize("true", [1.0, 4.0, 25.0])
def test_chance_grows_no_sigma(data, placements, true):
    """Scatter drawn about a true ratio of variances: far ones come through, and chance adds little to none."""
    free = placements - 1
    scatter = true * np.random.default_rng(3).chisquare(free, 20000) / free
    found = replace(
        fit(line_problem(*data), np.zeros(2)), covariance=np.ones((20000, 1, 1)),
        covariance_placements=scatter[:, None, None], n_placements=placements,
    )  # fmt: skip
    square = found.trusted[:, 0, 0]
    larger = np.maximum(scatter, 1.0)
    assert (square >= 1).all() and (square <= larger + 1e-9).all()
    if true == 1:  # less than half of what the larger one adds
        assert 1 < square.mean() < 1 + (larger.mean() - 1) / 2
    elif placements > 4:
        assert np.exp(np.log(square).mean()) == pytest.approx(
            true, rel=0.25 if true < 10 else 0.15
        )


def test_rounding_errors_below_zero_are_no_information():
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0]
    hessian = (turn * [-3e-13, 1e-6, 0.5, 1.0]) @ turn.T
    np.testing.assert_allclose(
        pseudo_inverse(hessian), (turn * [0, 1e6, 2, 1]) @ turn.T, rtol=1e-6
    )


def test_required_observability_raises_in_words():
    def evaluate(state):
        r = np.array([state[0] - 1.0, 2 * state[0]])
        return Block(r, np.array([[1.0, 0.0], [2.0, 0.0]]), np.ones(2))

    with pytest.raises(DegenerateGeometry, match="do not determine offset"):
        fit(evaluate, np.zeros(2), required=True)
    assert fit(evaluate, np.zeros(2)).unobservable == ("offset",)


def test_large_residual_problem_converges_where_gauss_newton_diverges():
    """Dennis and Schnabel's example: at its minimum 0 the curvature is four times what Gauss-Newton sees."""

    def evaluate(state):
        x = state[0]
        return Block(
            np.array([x + 1, -3 * x**2 + x - 1]),
            np.array([[1.0], [-6 * x + 1]]),
            np.ones(2),
        )

    state, converged, history, _ = minimise(
        evaluate, np.array([0.1]), np.add, max_iterations=200
    )
    assert converged and np.all(np.diff(history) <= 1e-12)
    assert state[0] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("change", [0.0, 0.01])
def test_weights_that_depend_on_the_state_do_not_keep_a_minimum_from_being_reached(change):
    """Gradients leave their change out: the cost rises on the last thousandths of the way."""

    def evaluate(state):
        x = state[..., :1]
        r = np.concatenate([x, x - 1], axis=-1)
        whitener = np.concatenate([np.ones_like(x), 1 + change * x], axis=-1)
        return Block(r, np.ones(r.shape + (1,)), whitener)

    for start in (np.array([0.5013]), np.array([[3.0], [0.5013]])):
        state, converged, *_ = minimise(evaluate, start, np.add, tolerance=1e-4)
        assert np.all(converged)
        assert state == pytest.approx(0.5, abs=0.005)


@pytest.mark.parametrize("delta, words", [
    ([0, 0, 0, 0, 0, -1], "translation along z of the right frame"),
    ([0, 1, 0, 0, 0, 0], "rotation about y of the right frame"),
    ([0, 0, 0, 1, 1, 0], "translation along (0.71, 0.71, 0.00) of the right frame"),
    ([1, 0, 0, 0, 1, 0], "rotation about x of the right frame with translation along y"),
])  # fmt: skip
def test_motions_in_words(delta, words):
    assert motion_words(delta, "right") == words


def test_correlated_residuals_are_weighted_as_generalised_least_squares_does():
    rng = np.random.default_rng(9)
    A = rng.normal(size=(30, 3))
    y = rng.normal(size=30)
    roots = rng.normal(size=(10, 3, 3)) + 2 * np.eye(3)
    whole = scipy.linalg.block_diag(*(roots @ np.swapaxes(roots, 1, 2)))
    covariance = np.linalg.inv(A.T @ np.linalg.solve(whole, A))
    block = Block(-y, A, np.linalg.inv(roots))
    found = fit(lambda x: replace(block, residuals=A @ x - y), np.zeros(3), names="abc")
    np.testing.assert_allclose(
        found.parameters, covariance @ A.T @ np.linalg.solve(whole, y), atol=1e-12
    )
    np.testing.assert_allclose(found.covariance / found.inflation, covariance, rtol=1e-9)
    r = A @ found.parameters - y
    assert found.chi2 == pytest.approx(r @ np.linalg.solve(whole, r))
