"""One Gauss-Newton / Levenberg-Marquardt core for all calibrations.

A problem is a function ``evaluate(state) -> Block`` (or a list of blocks): raw residuals, their analytic Jacobian and
the whitening that the noise asks for. Leading axes are independent trials, solved at once. With ``shared=c`` the one
leading axis runs over placements instead, which share the first ``c`` unknowns and own the others (eliminated by a
Schur complement).

The whitening may depend on the state: a point's noise is propagated through the geometry that is being estimated, and
the same noise sits in the Jacobian. ``J^T W r = 0`` would then be biased (errors in variables); the derivative of the
whitening takes the bias out. To first order it is the Jacobian at the point moved onto its constraint, which a block
hands over as `corrected`. Robust weights are frozen while a step is judged and renewed for the next one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from lrfcal_lib.fit.result import Solution
from lrfcal_lib.model.geometry import DegenerateGeometry

HUBER, CAUCHY = 1.345, 2.385  # 95 % efficiency for normal errors


@dataclass(frozen=True)
class Block:
    """Residuals of one kind.

    Attributes
    ----------
    residuals : ndarray, shape (..., n)
    jacobian : ndarray, shape (..., n, k)
        Derivative of the residuals.
    whitener : ndarray, shape (..., n) or (..., n / d, d, d)
        Reciprocal standard deviations, or inverse Cholesky factors of the covariance of d consecutive residuals. A zero
        switches a residual off.
    count : float or ndarray, shape (..., n / d), optional
        Number of measurements that each group of residuals stands for (d when left out): only losses use it.
    corrected : ndarray, shape (..., n, k), optional
        Jacobian that includes the change of the whitener: ``J - dS/2 S^-1 r`` for residuals with covariance S. The
        steps use it where it is given.
    cost : ndarray, shape (..., n), optional
        Negative log likelihood of each residual where it is not half a square; the residuals are then score over root
        information, the Jacobian root information times the derivative, the whitener one or zero. No loss applies.
    """

    residuals: np.ndarray
    jacobian: np.ndarray
    whitener: np.ndarray
    count: float | np.ndarray | None = None
    corrected: np.ndarray | None = None
    cost: np.ndarray | None = None

    @property
    def size(self):
        """Number d of residuals that are judged together by a robust loss."""
        return self.whitener.shape[-1] if self.whitener.ndim > self.residuals.ndim else 1


@dataclass(frozen=True)
class Linear:
    """Normal equations at one state."""

    hessian: np.ndarray
    gradient: np.ndarray
    cost: np.ndarray
    roots: list


def whiten(block, jacobian=True):
    """Whitened residuals and (corrected) Jacobian of a block."""
    w, r = block.whitener, block.residuals
    J = block.jacobian if block.corrected is None else block.corrected
    if w.ndim == r.ndim:
        return w * r, (w[..., None] * J if jacobian else None)
    d = w.shape[-1]
    groups = r.shape[-1] // d
    r = (w @ r.reshape(r.shape[:-1] + (groups, d, 1))).reshape(r.shape)
    if jacobian:
        J = (w @ J.reshape(J.shape[:-2] + (groups, d, J.shape[-1]))).reshape(J.shape)
    return r, (J if jacobian else None)


def robust_weights(z, loss):
    """Weights of the robust losses at residuals in units of the scale: ``huber``, ``cauchy`` or None (all 1)."""
    z = np.abs(z)
    if loss is None:
        return np.ones_like(z)
    if loss == "huber":
        return np.where(z <= HUBER, 1.0, HUBER / np.maximum(z, HUBER))
    if loss == "cauchy":
        return 1.0 / (1.0 + (z / CAUCHY) ** 2)
    raise ValueError(f"unknown loss {loss!r}: use None, 'huber' or 'cauchy'")


def robust_rho(z, loss):
    """Value of the losses, ``z^2`` near zero; see :func:`robust_weights`."""
    z = np.abs(z)
    if loss == "huber":
        return np.where(z <= HUBER, z**2, HUBER * (2 * z - HUBER))
    return CAUCHY**2 * np.log1p((z / CAUCHY) ** 2) if loss == "cauchy" else z**2


def _group_sizes(block, r):
    """Norm of each group of whitened residuals per root of its count, shape (..., n / d), and the counts."""
    d = block.size
    squares = r**2 if d == 1 else np.sum(r.reshape(r.shape[:-1] + (-1, d)) ** 2, axis=-1)
    count = np.broadcast_to(np.asarray(d if block.count is None else block.count, float), squares.shape)
    return np.sqrt(squares / count), count


@lru_cache(maxsize=4096)
def usual_size(count):
    """Median root mean square of `count` normal numbers."""
    return float(np.sqrt(chi2_distribution.ppf(0.5, count) / count))


def _scale(block, z, count, scale, axes):
    """Scale of a block's group sizes: given, or ('auto') from their median, per trial."""
    if scale != "auto":
        return float(scale)
    inside = np.broadcast_to(
        block.whitener != 0 if block.size == 1 else np.any(block.whitener != 0, axis=(-1, -2)), z.shape
    )
    sizes, index = np.unique(count, return_inverse=True)
    expected = np.array([usual_size(float(size)) for size in sizes])[index].reshape(np.shape(count))
    return np.maximum(np.nanmedian(np.where(inside, z / expected, np.nan), axis=axes, keepdims=True), 1e-9)


def _weigh(block, loss, scale, axes):
    """Robust weights (..., n) of a block at its own state and the loss value summed over the trial."""
    r, _ = whiten(block, jacobian=False)
    if block.cost is not None:
        return np.ones_like(r), 2 * np.sum(block.cost, axis=axes)
    if loss is None:
        return np.ones_like(r), np.sum(r**2, axis=axes)
    z, count = _group_sizes(block, r)
    unit = _scale(block, z, count, scale, axes)
    weights = np.repeat(robust_weights(z / unit, loss), block.size, axis=-1)
    return weights, np.sum(count * unit**2 * robust_rho(z / unit, loss), axis=axes)


def _blocks(evaluate, state):
    found = evaluate(state)
    return [found] if isinstance(found, Block) else list(found)


def _linearise(blocks, loss, scale, axes):
    """Normal equations of whitened, robustly weighted blocks, and the roots of the robust weights."""
    hessian = gradient = cost = 0.0
    roots = []
    for block in blocks:
        weights, value = _weigh(block, loss, scale, axes)
        root = np.sqrt(weights)
        r, J = whiten(block)
        r, J = root * r, root[..., None] * J
        transposed = np.swapaxes(J, -1, -2)
        hessian, gradient = hessian + transposed @ J, gradient + (transposed @ r[..., None])[..., 0]
        cost = cost + 0.5 * value
        roots.append(root)
    return Linear(hessian, gradient, cost, roots)


def _frozen_cost(blocks, roots, axes):
    """Half the sum of squares with the robust weights of an earlier state."""
    total = 0.0
    for block, root in zip(blocks, roots, strict=True):
        if block.cost is not None:
            total = total + np.sum(block.cost, axis=axes)
            continue
        r, _ = whiten(block, jacobian=False)
        total = total + 0.5 * np.sum((root * r) ** 2, axis=axes)
    return total


def _damped(hessian, damping):
    """``H + damping diag(H)`` with a floor, so that an unobservable unknown stays where it is."""
    diagonal = np.diagonal(hessian, axis1=-2, axis2=-1)
    floor = 1e-14 * np.max(diagonal, axis=-1, keepdims=True) + 1e-300
    extra = np.asarray(damping)[..., None] * diagonal + floor
    return hessian + extra[..., None] * np.eye(hessian.shape[-1])


def dense_step(linear, damping):
    """Damped step of independent trials, shape (..., k)."""
    return -np.linalg.solve(_damped(linear.hessian, damping), linear.gradient[..., None])[..., 0]


def schur_step(linear, damping, shared):
    """Damped step of an arrow-shaped problem: of the shared unknowns (c,) and of each placement's own (p, l)."""
    H = _damped(linear.hessian, np.full(len(linear.hessian), damping))
    g, c = linear.gradient, shared
    back = np.linalg.solve(H[:, c:, c:], np.concatenate([H[:, c:, :c], g[:, c:, None]], axis=-1))
    reduced = np.sum(H[:, :c, :c] - H[:, :c, c:] @ back[..., :c], axis=0)
    right = np.sum(g[:, :c] - (H[:, :c, c:] @ back[..., c:])[..., 0], axis=0)
    common = -np.linalg.solve(reduced, right)
    return common, -(back[..., c] + back[..., :c] @ common)


def _step(linear, damping, shared):
    """A damped step, its squared length in standard deviations, and the fall of the cost it promises."""
    if shared is None:
        step = whole = dense_step(linear, damping)
    else:
        step = schur_step(linear, damping, shared)
        whole = np.concatenate([np.broadcast_to(step[0], (len(step[1]), shared)), step[1]], axis=-1)
    length = np.sum(whole * (linear.hessian @ whole[..., None])[..., 0], axis=-1)
    promised = -np.sum(whole * linear.gradient, axis=-1) - 0.5 * length
    return (step, length, promised) if shared is None else (step, np.sum(length), np.sum(promised))


def _next_damping(damping, accepted, gain):
    """Less damping where the linear model keeps its promise, more where it overshoots (large residuals)."""
    worse = np.maximum(np.where(accepted, 4.0, 10.0) * damping, 1e-4)
    kept = np.where(gain > 0.8, 0.1 * damping, damping)
    return np.clip(np.where(accepted & (gain > 0.5), kept, worse), 1e-12, 1e14)


def _choose(accepted, new, old):
    """New states where accepted; a state is an array with leading trial axes or, in arrow problems, a tuple."""
    if np.ndim(accepted) == 0:
        return new if accepted else old
    return np.where(accepted.reshape(accepted.shape + (1,) * (new.ndim - accepted.ndim)), new, old)


def minimise(evaluate, state, retract, *, shared=None, loss=None, scale=1.0, max_iterations=60, tolerance=1e-8):
    """Run the damped Gauss-Newton iteration.

    Parameters
    ----------
    evaluate : callable
        ``state -> Block`` or list of blocks.
    state : ndarray (leading trial axes) or, with `shared`, any object
    retract : callable
        ``(state, step) -> state``; with `shared` the step is the pair (common (c,), own (p, l)).
    shared : int, optional
        Number of unknowns common to all entries of the leading axis.
    loss : {None, 'huber', 'cauchy'}
    scale : float or 'auto'
        Unit of the loss in standard deviations; 'auto' takes it from the median of the residuals in every iteration.
    max_iterations : int
    tolerance : float
        A trial has converged when a step is shorter than this many standard deviations of the estimate.

    Returns
    -------
    state, converged, iterations, cost_history
    """
    axes = -1 if shared is None else (-2, -1)
    blocks = _blocks(evaluate, state)
    linear = _linearise(blocks, loss, scale, axes)
    history, converged = [linear.cost], np.zeros(np.shape(linear.cost), bool)
    damping, iteration = np.full(np.shape(linear.cost), 1e-7), 0
    while iteration < max_iterations and not np.all(converged):
        iteration += 1
        step, length, promised = _step(linear, damping if shared is None else float(damping), shared)
        trial = retract(state, step)
        tried = _blocks(evaluate, trial)
        before, after = _frozen_cost(blocks, linear.roots, axes), _frozen_cost(tried, linear.roots, axes)
        accepted = after <= before * (1 + 1e-12) + 1e-26
        small = (length < tolerance**2) | (length < 1e-14 * before)
        gain = np.where(promised > 3e-15 * before, (before - after) / np.maximum(promised, 1e-300), 1.0)
        converged = converged | (small & np.isfinite(after) & (damping < 10.0))
        state = _choose(accepted, trial, state)
        blocks = tried if np.all(accepted) else _blocks(evaluate, state)
        damping = _next_damping(damping, accepted, gain)
        linear = _linearise(blocks, loss, scale, axes)
        history.append(linear.cost)
    return state, (bool(converged) if converged.ndim == 0 else converged), iteration, np.array(history)


def _whole(blocks, loss, scale, axes):
    """Whitened residuals, Jacobian and robust weights of all blocks side by side."""
    parts = [(*whiten(b), _weigh(b, loss, scale, axes)[0]) for b in blocks]
    return (np.concatenate([p[i] for p in parts], axis=-1 if i != 1 else -2) for i in range(3))


def _inflation(chi2, freedom):
    """Chi-square per degree of freedom where it is above the 99.9 % limit of the stated noise, otherwise 1."""
    if freedom <= 0:
        return np.ones_like(chi2)
    return np.where(chi2 > chi2_distribution.ppf(0.999, freedom), chi2 / freedom, 1.0)


def solve(
    evaluate,
    start,
    retract,
    *,
    names,
    method,
    read,
    scales=None,
    words=None,
    groups=None,
    freedom=None,
    shared=None,
    loss=None,
    scale=1.0,
    max_iterations=60,
    tolerance=1e-8,
    required=True,
    n_observations=None,
    limit=1.0,
    chi2_rest=0.0,
    earlier=(),
):
    """Minimise, then report covariances and what was not observed.

    Parameters
    ----------
    evaluate, start, retract, shared, loss, scale, max_iterations, tolerance
        See :func:`minimise`.
    names : sequence of str
        Of the unknowns reported (with `shared`, the shared ones).
    method : str
    read : callable
        ``state -> (transform or None, parameters)``.
    scales : array_like, optional
        See :func:`lrfcal_lib.fit.least_squares.null_space`; ones by default.
    words : callable, optional
        ``direction (k,) -> str``; the names with the largest components by default.
    groups : array_like, shape (n,), optional
        Placement of every residual, for `covariance_placements` (with `shared` the leading axis is the placement).
    freedom : float, optional
        Degrees of freedom of chi-square; number of residuals minus unknowns by default.
    required : bool
        Raise when something stays unobservable (single problems only).
    n_observations : int, optional
    limit : float
        See :func:`lrfcal_lib.fit.least_squares.null_space`.
    chi2_rest : float or ndarray
        Chi-square that no unknown can change (compressed away), added for the inflation.
    earlier : sequence of ndarray
        Cost histories of earlier rounds, put before this one's.

    Returns
    -------
    Solution

    Raises
    ------
    DegenerateGeometry
        Naming the unobservable motions, when `required`.
    ValueError
        When residuals at the start are not finite.
    """
    axes = -1 if shared is None else (-2, -1)
    if not all(np.isfinite(block.residuals).all() for block in _blocks(evaluate, start)):
        raise ValueError(f"{method}: residuals at the start value are not finite: check the observations and T0")
    about = {"shared": shared, "loss": loss, "scale": scale, "max_iterations": max_iterations, "tolerance": tolerance}
    state, converged, iterations, history = minimise(evaluate, start, retract, **about)
    r, J, weights = _whole(_blocks(evaluate, state), loss, scale, axes)
    hessians, scores = by_placement(r, J, weights, groups, shared)
    hessian = np.sum(hessians, axis=-3)
    k = hessian.shape[-1]
    scales = np.ones(k) if scales is None else scales
    lost = unobservable_motions(hessian, scales, words or (lambda d: name_words(d, names)), limit)
    if required and lost:
        raise DegenerateGeometry(f"{method}: the data do not determine " + "; ".join(lost))
    chi2 = np.sum(weights * r**2, axis=axes) + chi2_rest
    freedom = freedom if freedom is not None else _freedom(r, J, shared)
    inflation = _inflation(chi2, freedom)
    unit = np.asarray(scales)[:, None] * np.asarray(scales)
    covariance = pseudo_inverse(hessian * unit) * unit * inflation[..., None, None]
    covariance = with_infinities(covariance, hessian, scales)
    clustered, _ = placement_covariance(hessians, scores) if (groups is not None or shared) else (None, None)
    transform, parameters = read(state)
    iterations, history = _with_earlier(iterations, history, earlier)
    fitted = {"residuals": r, "jacobian": J, "weights": weights, "chi2": chi2, "inflation": inflation, "state": state}
    run = {"converged": converged, "iterations": iterations, "cost_history": history, "unobservable": lost}
    spread = {"covariance": covariance, "covariance_placements": clustered}
    titles = {"names": tuple(names), "method": method, "n_observations": n_observations or r.shape[-1]}
    return Solution(transform, parameters, **titles, **run, **fitted, **spread)


def _with_earlier(iterations, history, earlier):
    """Iterations and cost history, with those of earlier rounds before them."""
    return iterations + sum(len(h) - 1 for h in earlier), np.concatenate([*(h[:-1] for h in earlier), history])


def _freedom(r, J, shared):
    if shared is None:
        return r.shape[-1] - J.shape[-1]
    return r.size - shared - r.shape[0] * (J.shape[-1] - shared)


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
