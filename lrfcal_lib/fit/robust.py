"""Outliers: the spread of errors that are normal but for them, and what is left of their weight.

One rule for every fit that does not go through :func:`lrfcal_lib.fit.least_squares.minimise`.
"""

import numpy as np

NORMAL = 1.4826  # standard deviation of a normal variable over the median of its absolute value
# standard deviations; a fit with these weights is 95 % as good as least squares for normal errors
TUKEY = 4.685


def robust_sigma(misses, least=0.0):
    """Standard deviation, at least `least`, of misses (n,) that are normal about zero but for
    outliers.
    """
    return max(NORMAL * float(np.median(np.abs(misses))), least)


def biweight(misses, sigma):
    """Tukey's weights (...): 1 for a miss of zero, 0 beyond TUKEY standard deviations.

    NaN stays.
    """
    return np.clip(1 - (misses / (TUKEY * sigma)) ** 2, 0, None) ** 2
