"""What normal equations do not determine, in words, and covariances clustered by placement."""

from __future__ import annotations

import numpy as np

RANK = 1e-13  # eigenvalues of scaled normal equations below this share of the largest are rounding errors


def null_space(hessian, scales, limit=1.0):
    """Directions that normal equations do not determine.

    Parameters
    ----------
    hessian : ndarray, shape (k, k)
        Of whitened residuals.
    scales : array_like, shape (k,)
        What counts as a change by one: 1 rad, 1 m, 1000 px, ...
    limit : float
        A direction is also unobservable when its standard deviation exceeds this many scales.

    Returns
    -------
    directions : ndarray, shape (m, k)
        Increments, largest component 1, the worst first; m = 0 when everything is observable.
    values : ndarray, shape (k,)
        Singular values of the scaled, whitened Jacobian, ascending: reciprocal standard deviations.
    """
    scales = np.asarray(scales, float)
    values, vectors = np.linalg.eigh(hessian * scales[:, None] * scales)
    bad = values < np.maximum(RANK * values[-1], limit**-2)
    directions = (_simplest_basis(vectors[:, bad]) * scales[:, None]).T
    peak = np.max(np.abs(directions), axis=1, keepdims=True) if len(directions) else 1.0
    return directions / peak, np.sqrt(np.maximum(values, 0.0))


def _simplest_basis(vectors):
    """The basis of a null space with most zeros (reduced echelon form, pivots at the largest entries)."""
    basis = vectors.T.copy()
    used = []
    for _ in range(len(basis)):
        rows = [i for i in range(len(basis)) if i not in used]
        row, column = np.unravel_index(np.argmax(np.abs(basis[rows])), (len(rows), basis.shape[1]))
        row = rows[row]
        used.append(row)
        basis[row] /= basis[row, column]
        for other in range(len(basis)):
            basis[other] -= (other != row) * basis[other, column] * basis[row]
    basis[np.abs(basis) < 1e-5] = 0.0
    return basis.T


def unobservable_motions(hessian, scales, words, limit):
    """Unobservable motions of a single problem in words."""
    if hessian.ndim > 2:
        return ()
    return tuple(words(direction) for direction in null_space(hessian, scales, limit)[0])


def pseudo_inverse(hessian):
    """Inverse of scaled normal equations on what they determine; eigenvalues below zero are rounding errors too."""
    values, vectors = np.linalg.eigh(hessian)
    inverse = np.divide(1.0, values, out=np.zeros_like(values), where=values > RANK * values[..., -1:])
    return (vectors * inverse[..., None, :]) @ np.swapaxes(vectors, -1, -2)


def with_infinities(covariance, hessian, scales):
    """Covariances in which unknowns that take part in an undetermined direction have an infinite variance.

    Parameters
    ----------
    covariance, hessian : ndarray, shape (..., k, k)
    scales : array_like, shape (k,)

    Returns
    -------
    ndarray, shape (..., k, k)
        A pseudo-inverse calls such unknowns perfectly known; their covariances with others are set to zero.
    """
    if hessian.ndim > 2:
        return covariance
    lost = null_space(hessian, scales, np.inf)[0]
    taking_part = np.any(np.abs(lost) > 0.05, axis=0)
    if not taking_part.any():
        return covariance
    covariance = np.where(taking_part[:, None] | taking_part, 0.0, covariance)
    return covariance + np.diag(np.where(taking_part, np.inf, 0.0))


def name_words(direction, names):
    large = [name for name, value in zip(names, direction, strict=True) if abs(value) > 0.05]
    return " with ".join(large)


def reduced_hessian(hessian, shared):
    """What each placement says about the shared unknowns once its own are eliminated, shape (p, c, c)."""
    c = shared
    inverse = np.linalg.pinv(hessian[:, c:, c:], rcond=1e-13, hermitian=True)
    return hessian[:, :c, :c] - hessian[:, :c, c:] @ inverse @ hessian[:, c:, :c]


def placement_covariance(hessians, scores):
    """First-order jackknife over placements (CR3), from what each placement adds to the normal equations.

    Parameters
    ----------
    hessians : ndarray, shape (..., g, k, k)
    scores : ndarray, shape (..., g, k)
        ``J^T r`` of each placement at the solution.

    Returns
    -------
    covariance : ndarray, shape (..., k, k), or None
        None with fewer than three placements, or where the others do not determine the estimate.
    shifts : ndarray, shape (..., g, k), or None
        Change of the estimate when that placement is left out.
    """
    groups = hessians.shape[-3]
    rest = np.sum(hessians, axis=-3, keepdims=True) - hessians
    diagonal = np.sqrt(np.maximum(np.diagonal(np.sum(hessians, axis=-3), axis1=-2, axis2=-1), 1e-300))[..., None, :]
    scaled = rest / (diagonal[..., :, None] * diagonal[..., None, :])
    if groups < 3 or np.min(np.linalg.eigvalsh(scaled)[..., 0]) < 1e-12:
        return None, None
    shifts = np.linalg.solve(scaled, (scores / diagonal)[..., None])[..., 0] / diagonal
    centred = np.swapaxes(shifts, -1, -2) @ shifts
    return (groups - 1) / groups * centred, shifts


def _placement_sums(r, J, weights, groups):
    """Normal equations of each placement, shapes (..., g, k, k) and (..., g, k)."""
    groups = np.asarray(groups)
    hessians, scores = [], []
    for group in np.unique(groups):
        rows = groups == group
        weighted = np.swapaxes(weights[..., rows, None] * J[..., rows, :], -1, -2)
        hessians.append(weighted @ J[..., rows, :])
        scores.append((weighted @ r[..., rows, None])[..., 0])
    return np.stack(hessians, axis=-3), np.stack(scores, axis=-2)


def by_placement(r, J, weights, groups, shared):
    """Normal equations of the reported unknowns by placement (one group where they are not told apart)."""
    if shared is None:
        return _placement_sums(r, J, weights, np.zeros(r.shape[-1], int) if groups is None else groups)
    weighted = np.swapaxes(weights[..., None] * J, -1, -2)
    return reduced_hessian(weighted @ J, shared), (weighted @ r[..., None])[:, :shared, 0]
