"""Gauss-Newton as the notebooks use it, beside scipy."""

import numpy as np
from scipy.optimize import least_squares

from lrfcal_lib.fit.gauss_newton import gauss_newton

TIMES = np.linspace(0, 2, 30)


def residuals(x):
    return (
        x[0] * np.exp(-x[1] * TIMES) - 3 * np.exp(-0.7 * TIMES) - 0.05 * np.sin(9 * TIMES)
    )


def test_the_minimum_is_scipys_and_the_cost_never_grows():
    x, path = gauss_newton(residuals, np.add, np.array([1.0, 3.0]), 2)
    np.testing.assert_allclose(
        x, least_squares(residuals, [1.0, 3.0], xtol=1e-12).x, atol=1e-7
    )
    assert len(path) > 3 and np.all(np.diff(path[:, 0]) <= 0)
    np.testing.assert_allclose(x, [1.0, 3.0] + path[:, 1:].sum(axis=0))


def test_a_state_may_be_anything_that_can_be_moved():
    angle, _ = gauss_newton(
        lambda z: np.array([z.real - 0.6, z.imag - 0.8]),
        lambda z, d: z * np.exp(1j * d[0]),
        1 + 0j,
        1,
    )
    assert np.isclose(angle, 0.6 + 0.8j)
