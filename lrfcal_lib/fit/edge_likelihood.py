"""Where beams flip from a board to its background: the share of a spot inside an edge, as a
likelihood.
"""

from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.special import log_ndtr

ROOT_2PI = np.sqrt(2 * np.pi)
# of a beam step: least softness, so that an edge between two beams is put into their middle
LEAST_STEP = 0.15


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
    inside = np.clip(x, -1.0, 1.0)
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
    spline = _spline()
    odds = np.clip(log_odds, *spline.x[[0, -1]])
    return spline(odds), spline(odds, 1)


@cache
def _spline():
    """Distance of an edge in radii by the log odds, from points dense where the share changes
    least.
    """
    x = np.sin(np.linspace(1, -1, 4001) * np.pi / 2)[1:-1]
    return CubicSpline(np.log(disc_share(x) / disc_share(-x)), x)


def edge_shift(
    log_odds: float | np.ndarray, radius: np.ndarray, background: float | np.ndarray = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """By how far a spot's centre may lie outside an edge and still read the board.

    Parameters
    ----------
    log_odds : float or ndarray
        The sensor's, for a background as far and as bright as the board.
    radius : ndarray
        Of the spot, metres.
    background : float or ndarray
        What the real one adds: ``-2 ln(d_background / d_board)``, 0 where it is not known.

    Returns
    -------
    shift : ndarray
        Metres, positive where boards look larger.
    slope : ndarray
        Its derivative by `log_odds`.
    """
    x, slope = disc_edge(log_odds + background)
    return radius * x, radius * slope


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
    soft = softness * radius
    sigma = np.hypot(soft, LEAST_STEP * step)
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
    z = sign * margin / sigma
    log_p = log_ndtr(z)
    mills = np.exp(-0.5 * z**2 - log_p) / ROOT_2PI  # phi(z) / Phi(z) without overflow
    likely = np.log1p(-2 * lapse) + log_p
    cost = -likely
    if lapse:
        cost = -np.logaddexp(np.log(lapse), likely)
    weight = np.exp(likely + cost)
    decline = np.maximum(z + mills, 0.0)  # far outside what is left of it is rounding
    return cost, -weight * sign * mills / sigma, weight * mills * decline / sigma**2
