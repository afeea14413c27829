"""The rule for outliers: the spread of normal errors, how much of them it keeps, how little outliers move a fit."""

import numpy as np
import pytest

from lrfcal_lib.fit import robust

ERRORS = np.random.default_rng(0).normal(0.0, 0.02, 100_000)


def test_the_spread_of_normal_errors_is_their_standard_deviation_whatever_outliers_do():
    assert robust.robust_sigma(ERRORS) == pytest.approx(0.02, rel=0.01)
    outliers = np.where(np.arange(len(ERRORS)) % 20 == 0, 5.0, ERRORS)
    assert robust.robust_sigma(outliers) == pytest.approx(0.02, rel=0.1)
    assert robust.robust_sigma(ERRORS, least=0.5) == 0.5


def test_a_mean_with_these_weights_is_nearly_as_good_as_the_plain_one():
    """95 % as good in variance, as the constant promises."""
    draws = ERRORS.reshape(-1, 100)
    means = draws.mean(axis=1)
    for _ in range(20):
        weights = robust.biweight(draws - means[:, None], 0.02)
        means = np.sum(weights * draws, axis=1) / weights.sum(axis=1)
    assert np.var(draws.mean(axis=1)) / np.var(means) == pytest.approx(0.95, abs=0.02)


def test_what_lies_far_off_counts_nothing():
    misses = np.array([0.0, 1.0, robust.TUKEY, 100.0, np.nan])
    np.testing.assert_allclose(
        robust.biweight(misses, 1.0), [1.0, 0.911, 0.0, 0.0, np.nan], atol=1e-3
    )
