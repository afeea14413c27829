"""How well normal equations determine their unknowns: by the noise, and by placements left out.

No equations of the paper, which states no accuracy of its own.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import qr

from lrfcal_lib.model.geometry import length_of, unit_vector

# eigenvalues of scaled normal equations below this share of the largest are rounding errors
RANK = 1e-13
# share of a direction's largest component from which an unknown takes part in it
PARTAKES = 0.05
ZERO = 1e-5  # a component of a direction below is a rounding error
FEWEST = 3  # placements whose scatter tells anything


def dyads(vectors: np.ndarray) -> np.ndarray:
    """Products ``v v^T`` of vectors with themselves.

    Parameters
    ----------
    vectors : ndarray, shape (..., k)

    Returns
    -------
    ndarray, shape (..., k, k)
    """
    return vectors[..., None] * vectors[..., None, :]


def sigma_of(covariance: np.ndarray) -> np.ndarray:
    """Standard deviations.

    Parameters
    ----------
    covariance : ndarray, shape (..., k, k)

    Returns
    -------
    ndarray, shape (..., k)
    """
    return np.sqrt(np.linalg.diagonal(covariance))


def sigma_turn_shift(covariance: np.ndarray) -> np.ndarray:
    """Standard deviations of a turn and of a shift in all directions, radians and metres.

    Parameters
    ----------
    covariance : ndarray, shape (2 k, 2 k)
        Of k turns, then k shifts.

    Returns
    -------
    ndarray, shape (2,)
    """
    return length_of(sigma_of(covariance).reshape(2, -1))


def solve_each(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """The vectors x for which ``matrices @ x`` are some vectors.

    Parameters
    ----------
    matrices : ndarray, shape (..., k, k)
    vectors : ndarray, shape (..., k)

    Returns
    -------
    ndarray, shape (..., k)
    """
    return np.linalg.solve(matrices, vectors[..., None])[..., 0]


def inverse_root(covariance: np.ndarray) -> np.ndarray:
    """Inverse Cholesky factors, which make what has these covariances white.

    Parameters
    ----------
    covariance : ndarray, shape (..., k, k)

    Returns
    -------
    ndarray, shape (..., k, k)
    """
    return np.linalg.inv(np.linalg.cholesky(covariance))


def null_space(hessian: np.ndarray, scales: np.ndarray, limit: float) -> np.ndarray:
    """Directions that normal equations of whitened residuals do not determine.

    Parameters
    ----------
    hessian : ndarray, shape (k, k)
    scales : ndarray, shape (k,)
        What counts as a change by one: 1 rad, 1 m, 1000 px.
    limit : float
        A direction is also unobservable when its standard deviation exceeds so many scales.

    Returns
    -------
    ndarray, shape (m, k)
        Increments, largest component 1, the worst first.
    """
    values, vectors = np.linalg.eigh(hessian * dyads(scales))
    basis = vectors[:, values < max(RANK * values[-1], limit**-2)].T
    # reduced echelon form with pivots at large entries: a basis with many zeros
    pivots = qr(basis, mode="r", pivoting=True)[1][: len(basis)]
    basis = np.linalg.solve(basis[:, pivots], basis)
    directions = np.where(np.abs(basis) < ZERO, 0.0, basis) * scales
    return directions / np.max(np.abs(directions), axis=1, keepdims=True)


def pseudo_inverse(hessian: np.ndarray) -> np.ndarray:
    """Inverse of scaled normal equations on what they determine.

    Parameters
    ----------
    hessian : ndarray, shape (..., k, k)
        Eigenvalues below zero are rounding errors too.

    Returns
    -------
    ndarray, shape (..., k, k)
    """
    values, vectors = np.linalg.eigh(hessian)
    inverse = np.divide(
        1.0, values, out=np.zeros_like(values), where=values > RANK * values[..., -1:]
    )
    return (vectors * inverse[..., None, :]) @ vectors.mT


def covariance_of(hessian, scales, lost):
    """Inverse of normal equations. Unknowns that take part in an undetermined direction have an
    infinite variance.

    A pseudo-inverse calls such unknowns perfectly known; their covariances with others are set to
    zero.
    """
    unit = dyads(scales)
    covariance = pseudo_inverse(hessian * unit) * unit
    if not lost:  # or many trials
        return covariance
    lost = np.any(np.abs(null_space(hessian, scales, np.inf)) > PARTAKES, axis=0)
    covariance *= dyads(~lost)
    covariance[lost, lost] = np.inf
    return covariance


def name_words(direction: np.ndarray, names: Sequence[str], share: float = PARTAKES) -> str:
    """Names (or words) of the unknowns with the largest components of a direction.

    Parameters
    ----------
    direction : ndarray, shape (k,)
    names : sequence of str, length k
    share : float
        Of the largest component, below which an unknown is not named.
    """
    large = np.abs(direction) > share * np.max(np.abs(direction))
    return " with ".join(np.asarray(names)[large])


def placement_covariance(hessians: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """First-order jackknife over g placements, from what each adds to the normal equations.

    Parameters
    ----------
    hessians : ndarray, shape (..., g, k, k)
    scores : ndarray, shape (..., g, k)
        ``J^T r`` of each placement at the solution.

    Returns
    -------
    ndarray, shape (..., k, k)
        NaN with fewer than three placements, or where all but one do not determine the estimate.

    Notes
    -----
    The sum of squared changes of the estimate when a placement is left out (CR3) is too large in
    the mean where placements carry unequal weight: noise alone gives ``(g - 1) / g sum_g (inv(H -
    H_g) - inv(H))`` instead of ``inv(H)``. That factor is taken off every unknown, so that scatter
    and noise can be compared; ``(g - 1) / g`` cancels.
    """
    total = np.sum(hessians, axis=-3, keepdims=True)
    diagonal = np.sqrt(np.maximum(np.linalg.diagonal(total), 1e-300))
    outer = dyads(diagonal)
    scaled = (total - hessians) / outer
    if hessians.shape[-3] < FEWEST or np.linalg.eigvalsh(scaled).min() < RANK:
        return np.full_like(hessians[..., 0, :, :], np.nan)
    without = np.linalg.inv(scaled)
    changes = np.matvec(without, scores / diagonal) / diagonal
    whole = np.linalg.diagonal(np.linalg.inv(total / outer))
    gained = np.linalg.diagonal(without) - whole
    factor = np.sqrt(whole[..., 0, :] / gained.sum(axis=-2))
    return changes.mT @ changes * dyads(factor)


def axis_words(direction):
    """A direction in words: the name of an axis within 8 degrees, otherwise its components."""
    direction = unit_vector(direction)
    largest = np.argmax(np.abs(direction))
    direction = direction * np.sign(direction[largest])
    if direction[largest] > np.cos(np.radians(8)):
        return "xyz"[largest]
    return "({:.2f}, {:.2f}, {:.2f})".format(*(direction + 0.0))


def motion_words(delta: np.ndarray, frame: str) -> str:
    """Name a small motion by its direction, e.g. ``translation along x of the left frame``.

    Parameters
    ----------
    delta : ndarray, shape (6,)
        ``[w, v]``.
    frame : str
    """
    w, v = np.reshape(delta, (2, 3))
    turn = length_of(w)
    shift = length_of(v)
    if turn < 0.02 * shift:
        return f"translation along {axis_words(v)} of the {frame} frame"
    words = f"rotation about {axis_words(w)} of the {frame} frame"
    if shift < 0.02 * turn:
        return words
    return f"{words} with translation along {axis_words(v)}"
