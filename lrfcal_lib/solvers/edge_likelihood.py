"""What a beam near a board's edge says about the edge: the likelihood of reading the board or what is behind it.

A beam lights a spot, a disc about its ray. The reading flips from the board to the background where the board's share
of the returned energy falls below some odds that only the device knows: a constant of the sensor, the same on all
edges. The background weakens with its distance squared, which is known wherever the scan shows it. So one number a
sensor (the log odds) tells by how much boards look larger or smaller, and it is estimated with everything else. Device
noise makes the flip soft.
"""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr

ROOT_2PI = np.sqrt(2 * np.pi)
LEAST_STEP = 0.15  # of a beam step: least softness, so that an edge between two beams is put into their middle
_X = np.sin(np.linspace(-1, 1, 4001) * np.pi / 2)[1:-1]  # dense where the share of a disc changes least


def disc_share(x):
    """Share of a unit disc that lies inside a straight edge.

    Parameters
    ----------
    x : array_like
        Signed distance of the disc's centre from the edge in radii, positive outside.

    Returns
    -------
    ndarray
        1 for x <= -1, 0 for x >= 1.
    """
    x = np.clip(np.asarray(x, float), -1.0, 1.0)
    return (np.arccos(x) - x * np.sqrt(1 - x**2)) / np.pi


_LOG_ODDS = np.log(disc_share(_X)) - np.log(disc_share(-_X))


def disc_edge(log_odds):
    """Where an edge cuts a unit disc so that its inner share has given log odds; inverts :func:`disc_share`.

    Parameters
    ----------
    log_odds : array_like
        ``ln(share / (1 - share))``.

    Returns
    -------
    x : ndarray
        Distance of the disc's centre from the edge in radii, positive outside; between -1 and 1.
    slope : ndarray
        ``dx / dlog_odds`` (negative).
    """
    log_odds = np.asarray(log_odds, float)
    x = np.interp(-log_odds, -_LOG_ODDS, _X)
    slope, here = _slope(x)
    refined = x + slope * np.clip(log_odds - here, -1e-4, 1e-4)  # value and slope must agree for steps to converge
    return refined, _slope(refined)[0]


def _slope(x):
    """``dx / dlog_odds`` and the log odds of the share inside, at a distance of the edge in radii."""
    inside, outside = (np.maximum(disc_share(v), 1e-12) for v in (x, -x))
    slope = -inside * outside * np.pi / (2 * np.sqrt(np.maximum(1 - x**2, 1e-12)))
    return slope, np.log(inside / outside)


def edge_shift(log_odds, radius, background=0.0):
    """By how much a spot's centre may lie outside an edge and still read the board.

    Parameters
    ----------
    log_odds : float
        Of the sensor, for a background as far and as bright as the board.
    radius : array_like
        Of the spot, metres.
    background : array_like
        What the background adds to the log odds: ``-2 ln(d_background / d_board)``, 0 where it is not known.

    Returns
    -------
    shift : ndarray
        Metres; positive where boards look larger.
    slope : ndarray
        Its derivative by `log_odds`.
    """
    x, slope = disc_edge(log_odds + np.asarray(background, float))
    return radius * x, radius * slope


def flip_sigma(softness, radius, step):
    """Standard deviation of where readings flip, with a floor: beams a step apart cannot show a sharper edge.

    Parameters
    ----------
    softness : array_like
        Standard deviation in spot radii.
    radius, step : array_like
        Of the spot, and between neighbouring beams at the board, metres.

    Returns
    -------
    sigma : ndarray
        Metres.
    share : ndarray
        ``d ln sigma / d ln softness``, between 0 (all floor) and 1.
    """
    soft = softness * np.asarray(radius, float)
    sigma = np.hypot(soft, LEAST_STEP * np.asarray(step, float))
    return sigma, (soft / sigma) ** 2


def _mills(z):
    """``phi(z) / Phi(z)`` without overflow."""
    return np.exp(-0.5 * z**2 - log_ndtr(z)) / ROOT_2PI


def beam_terms(margin, sigma, hit, lapse=0.0):
    """Negative log likelihood of single beams near an edge.

    Parameters
    ----------
    margin : ndarray
        How far inside the place where readings flip the beam's centre lies, metres (shift - distance from the edge).
    sigma : array_like
        Standard deviation of where a reading flips, metres.
    hit : ndarray of bool
        Whether the board was read.
    lapse : float
        Share of beams that say nothing (something hid or bent the edge there); their pull fades with distance.

    Returns
    -------
    cost, score, information : ndarray
        Negative log likelihood, its derivative by the margin, and the observed information on the margin (never
        negative; with `lapse` that of the majorising function of an EM step).
    by_log_sigma : ndarray
        Derivative of the cost by ``ln sigma``.

    Notes
    -----
    ``P(hit) = Phi(margin / sigma)``, a probit.
    """
    sign = np.where(hit, 1.0, -1.0)
    z = sign * np.asarray(margin, float) / sigma
    log_p = log_ndtr(z)
    mills = _mills(z)
    weight = 1.0
    cost = -log_p
    if lapse:
        cost = -np.logaddexp(np.log(lapse), np.log1p(-2 * lapse) + log_p)
        weight = np.exp(np.log1p(-2 * lapse) + log_p + cost)
    return cost, -weight * sign * mills / sigma, weight * mills * (z + mills) / sigma**2, weight * mills * z


def interval_terms(inner, outer, sigma):
    """Negative log likelihood that readings flip between two neighbouring beams.

    Parameters
    ----------
    inner, outer : ndarray
        Margins (see :func:`beam_terms`) of the last beam on the board and the first beam off it, metres;
        ``inner > outer``.
    sigma : array_like
        Standard deviation of what both have in common (where the edge is), metres.

    Returns
    -------
    cost, score, information : ndarray
        Negative log likelihood, and its derivatives by a shift of both margins; the information is the observed one.
    by_log_sigma : ndarray
        Derivative of the cost by ``ln sigma``.

    Notes
    -----
    ``P = Phi(inner / sigma) - Phi(outer / sigma)``: a uniform distribution over the interval, blurred.
    """
    a, b = np.asarray(outer, float) / sigma, np.asarray(inner, float) / sigma
    flip = a + b > 0  # mirrored, so that both tails stay on the side where log_ndtr is exact
    a, b = np.where(flip, -b, a), np.where(flip, -a, b)
    upper, lower = log_ndtr(b), log_ndtr(a)
    log_p = upper + np.log1p(-np.exp(np.minimum(lower - upper, -1e-15)))
    pb, pa = (np.exp(-0.5 * z**2 - log_p) / ROOT_2PI for z in (b, a))
    ratio = pb - pa
    curvature = ratio**2 + (b * pb - a * pa)
    score = np.where(flip, 1.0, -1.0) * ratio / sigma
    return -log_p, score, np.maximum(curvature, 0.0) / sigma**2, b * pb - a * pa
