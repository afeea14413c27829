"""How large errors are; and outliers: the spread of errors that are normal but for them, and what
is left of their weight.

One rule for every fit that does not go through :func:`lrfcal_lib.fit.least_squares.minimise`.
"""

import numpy as np
from scipy.sparse import csr_array

from lrfcal_lib.model.geometry import rms as rms

# standard deviation of a normal variable over the median of its absolute value
NORMAL = 1.4826
# standard deviations; a fit with these weights is 95 % as good as least squares for normal errors
TUKEY = 4.685


def robust_sigma(misses: np.ndarray, least: float = 0.0) -> float:
    """Standard deviation of misses that are normal about zero but for outliers.

    Parameters
    ----------
    misses : ndarray, shape (n,)
    least : float
        Never smaller than this.
    """
    return max(NORMAL * float(np.median(np.abs(misses))), least)


def biweight(misses: np.ndarray, sigma: float | np.ndarray) -> np.ndarray:
    """Tukey's weights: 1 for a miss of zero, 0 beyond TUKEY standard deviations.

    Parameters
    ----------
    misses : ndarray, shape (...)
        NaN stays.
    sigma : float or ndarray

    Returns
    -------
    ndarray, shape (...)
    """
    return np.clip(1 - (misses / (TUKEY * sigma)) ** 2, 0, None) ** 2


def sums_by(group: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Sums of the rows of each group.

    Parameters
    ----------
    group : ndarray, shape (n,)
        The same number for those of one group.
    rows : ndarray, shape (n, m)

    Returns
    -------
    ndarray, shape (g, m)
    """
    groups, place = np.unique(group, return_inverse=True)
    one_each = np.ones(len(place)), place, np.arange(len(place) + 1)
    return csr_array(one_each, (len(place), len(groups))).T @ rows
