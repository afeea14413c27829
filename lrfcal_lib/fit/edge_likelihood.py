"""Where beams flip from a board to its background: the share of a spot inside an edge, as a
likelihood.
"""

from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import log_ndtr

ROOT_2PI = np.sqrt(2 * np.pi)
# of a beam step: least softness, so that an edge between two beams is put into their middle
LEAST_STEP = 0.15
LEAST_SHARE = 1e-12  # of a spot, so that odds stay finite


def disc_share(x: np.ndarray) -> np.ndarray:
    """Share of a unit disc inside a straight edge.

    Parameters
    ----------
    x : array_like
        How far inside of the disc's centre the edge lies, radii.

    Returns
    -------
    ndarray
        1 for x <= -1, 0 for x >= 1.
    """
    inside = np.clip(np.asarray(x, float), -1.0, 1.0)
    return (np.arccos(inside) - inside * np.sqrt(1 - inside**2)) / np.pi


def disc_edge(log_odds: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Where an edge cuts a unit disc, from its inner share; inverts :func:`disc_share`.

    Parameters
    ----------
    log_odds : array_like
        ``ln(share / (1 - share))``.

    Returns
    -------
    x : ndarray
        Distance of the disc's centre from the edge in radii, positive outside, -1 to 1.
    slope : ndarray
        ``dx / dlog_odds`` (negative).
    """
    log_odds = np.asarray(log_odds, float)
    table, odds = _table()
    x = np.interp(-log_odds, -odds, table)
    slope, here = _slope(x)
    # value and slope must agree for steps to converge
    refined = x + slope * np.clip(log_odds - here, -1e-4, 1e-4)
    return refined, _slope(refined)[0]


@cache
def _table():
    """Distances of an edge in radii, dense where the share changes least, and their log odds."""
    x = np.sin(np.linspace(-1, 1, 4001) * np.pi / 2)[1:-1]
    return x, np.log(disc_share(x)) - np.log(disc_share(-x))


def _slope(x):
    """``dx / dlog_odds`` and the log odds of the share inside, at a distance of the edge in
    radii.
    """
    inside, outside = (np.maximum(disc_share(v), LEAST_SHARE) for v in (x, -x))
    slope = -inside * outside * np.pi / (2 * np.sqrt(np.maximum(1 - x**2, 1e-12)))
    return slope, np.log(inside / outside)


def edge_shift(
    log_odds: ArrayLike, radius: np.ndarray, background: ArrayLike = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """By how far a spot's centre may lie outside an edge and still read the board.

    Parameters
    ----------
    log_odds : array_like
        The sensor's, for a background as far and as bright as the board.
    radius : array_like
        Of the spot, metres.
    background : array_like
        What the real one adds: ``-2 ln(d_background / d_board)``, 0 where it is not known.

    Returns
    -------
    shift : ndarray
        Metres, positive where boards look larger.
    slope : ndarray
        Its derivative by `log_odds`.
    """
    x, slope = disc_edge(np.add(log_odds, background))
    return np.multiply(radius, x), np.multiply(radius, slope)


def flip_sigma(
    softness: float, radius: np.ndarray, step: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviation of where readings flip.

    Parameters
    ----------
    softness : float
        Spot radii.
    radius : ndarray
        Of the spot, metres.
    step : ndarray
        To the next beam at the board, metres: it cannot show a sharper edge than a floor.

    Returns
    -------
    sigma : ndarray
        Metres.
    share : ndarray
        ``d ln sigma / d ln softness``, 0 (all floor) to 1.
    """
    soft = softness * np.asarray(radius, float)
    sigma = np.hypot(soft, LEAST_STEP * np.asarray(step, float))
    return sigma, (soft / sigma) ** 2


def beam_terms(
    margin: np.ndarray, sigma: np.ndarray, hit: np.ndarray, lapse: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Negative log likelihood of single beams near an edge, a probit: ``P(hit) = Phi(margin /
    sigma)``.

    Parameters
    ----------
    margin : ndarray
        How far inside the place where readings flip the beam's centre lies (shift - distance from
        the edge), metres.
    sigma : ndarray
        Standard deviation of that place, metres.
    hit : ndarray of bool
        Whether the board was read.
    lapse : float
        Share of beams that say nothing (something hid or bent the edge there): their pull fades
        with distance.

    Returns
    -------
    cost : ndarray
    score : ndarray
        Derivative of the cost by the margin.
    information : ndarray
        The observed one on the margin, never negative; with `lapse` that of the majorising function
        of an EM step.
    """
    sign = np.where(hit, 1.0, -1.0)
    z = sign * np.asarray(margin, float) / sigma
    log_p = log_ndtr(z)
    mills = np.exp(-0.5 * z**2 - log_p) / ROOT_2PI  # phi(z) / Phi(z) without overflow
    weight = 1.0
    cost = -log_p
    if lapse:
        cost = -np.logaddexp(np.log(lapse), np.log1p(-2 * lapse) + log_p)
        weight = np.exp(np.log1p(-2 * lapse) + log_p + cost)
    decline = np.maximum(z + mills, 0.0)  # far outside what is left of it is rounding
    return cost, -weight * sign * mills / sigma, weight * mills * decline / sigma**2
