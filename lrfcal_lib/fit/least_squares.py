"""One Gauss-Newton / Levenberg-Marquardt core for all calibrations.

A problem is a function ``evaluate(state) -> Block`` (or a list of blocks): raw residuals, their
analytic Jacobian and the whitening that the noise asks for. Leading axes are independent trials,
solved at once. With ``shared=c`` the one leading axis runs over placements instead, which share the
first ``c`` unknowns and own the others (eliminated by a Schur complement).

The whitening may depend on the state: a point's noise is propagated through the geometry that is
being estimated, and the same noise sits in the Jacobian. ``J^T W r = 0`` would then be biased
(errors in variables); the derivative of the whitening takes the bias out. To first order it is the
Jacobian at the point moved onto its constraint, which a block hands over as `corrected`. Robust
weights are frozen while a step is judged and renewed for the next one.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtri

from lrfcal_lib.fit.result import Solution
from lrfcal_lib.model.geometry import DegenerateGeometry

CAUCHY = 2.385  # 95 % efficiency for normal errors
# eigenvalues of scaled normal equations below this share of the largest are rounding errors
RANK = 1e-13


@dataclass(frozen=True)
class Block:
    """Residuals of one kind.

    Attributes
    ----------
    residuals : ndarray, shape (..., n)
    jacobian : ndarray, shape (..., n, k)
        Derivative of the residuals.
    whitener : ndarray, shape (..., n) or (..., n / d, d, d)
        Reciprocal standard deviations, or inverse Cholesky factors of the covariance of d
        consecutive residuals. A zero switches a residual off.
    count : float or ndarray, shape (..., n / d), optional
        Number of measurements that each group of residuals stands for (d when left out): only
        losses use it.
    corrected : ndarray, shape (..., n, k), optional
        Jacobian that includes the change of the whitener: ``J - dS/2 S^-1 r`` for residuals with
        covariance S. The steps use it where it is given.
    cost : ndarray, shape (..., n), optional
        Negative log likelihood of each residual where it is not half a square; the residuals are
        then score over root information, the Jacobian root information times the derivative, the
        whitener one or zero. No loss applies.
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

    def whitened(self, rows):
        """Rows (..., n, k), such as a Jacobian, in independent standard deviations."""
        w = self.whitener
        if w.ndim == self.residuals.ndim:
            return w[..., None] * rows
        groups = rows.reshape(rows.shape[:-2] + (-1, w.shape[-1], rows.shape[-1]))
        return (w @ groups).reshape(rows.shape)

    @cached_property
    def white(self):
        """Whitened residuals."""
        return self.whitened(self.residuals[..., None])[..., 0]

    @cached_property
    def white_jacobian(self):
        """Whitened Jacobian, the corrected one where there is one."""
        return self.whitened(self.jacobian if self.corrected is None else self.corrected)


def whiten(block, jacobian=True):
    """Whitened residuals and (corrected) Jacobian of a block."""
    return block.white, (block.white_jacobian if jacobian else None)


def robust(z, loss):
    """Value (``z^2`` near zero) and weight of a loss at residuals in units of the scale."""
    if loss != "cauchy":
        raise ValueError(f"unknown loss {loss!r}: use None or 'cauchy'")
    square = (z / CAUCHY) ** 2
    return CAUCHY**2 * np.log1p(square), 1.0 / (1.0 + square)


def medians(values, used):
    """Medians of the used values (..., n) of every row, 0 where there are none.

    Many times as fast as np.nanmedian.
    """
    count = used.sum(axis=-1, keepdims=True)
    ordered = np.sort(np.where(used, values, np.inf), axis=-1)
    low, high = (
        np.take_along_axis(ordered, np.maximum(n // 2, 0), axis=-1) for n in (count - 1, count)
    )
    return np.where(count > 0, 0.5 * low + 0.5 * high, 0.0)[..., 0]


def _weigh(block, loss, scale, axes):
    """Robust weights (..., n) of a block at its own state, None without, and the loss value
    summed over the trial.
    """
    r = block.white
    d = block.size
    if block.cost is not None or loss is None:
        return None, (r * r if block.cost is None else 2 * block.cost).sum(axis=axes)
    squares = np.sum(r.reshape(r.shape[:-1] + (-1, d)) ** 2, axis=-1)
    count = np.broadcast_to(
        np.asarray(d if block.count is None else block.count, float), squares.shape
    )
    z = np.sqrt(squares / count)  # sizes of groups of residuals that are judged together
    if scale == "auto":
        inside = block.whitener != 0 if d == 1 else np.any(block.whitener != 0, axis=(-1, -2))
        sizes, index = np.unique(count, return_inverse=True)
        usual = np.sqrt(chdtri(sizes, 0.5) / sizes)[index].reshape(count.shape)
        wide = z.shape[: z.ndim + min(np.atleast_1d(axes))]
        level = medians((z / usual).reshape(*wide, -1), (inside & (z == z)).reshape(*wide, -1))
        scale = np.maximum(np.expand_dims(level, axes), 1e-9)
    value, weights = robust(z / scale, loss)
    return np.repeat(weights, d, axis=-1), np.sum(count * scale**2 * value, axis=axes)


def _blocks(evaluate, state):
    found = evaluate(state)
    return [found] if isinstance(found, Block) else list(found)


def linearise(blocks, loss, scale, axes):
    """Normal equations and cost of whitened, robustly weighted blocks, and the roots of the
    weights (None without).
    """
    hessian = 0.0
    gradient = 0.0
    cost = 0.0
    roots = []
    for block in blocks:
        weights, value = _weigh(block, loss, scale, axes)
        r, J = whiten(block)
        roots.append(None if weights is None else np.sqrt(weights))
        if weights is not None:
            r = roots[-1] * r
            J = roots[-1][..., None] * J
        transposed = J.swapaxes(-1, -2)
        hessian = hessian + transposed @ J
        gradient = gradient + (transposed @ r[..., None])[..., 0]
        cost = cost + 0.5 * value
    return hessian, gradient, cost, roots


def _frozen_cost(blocks, roots, axes):
    """Half the sum of squares with the robust weights of an earlier state."""
    total = 0.0
    for block, root in zip(blocks, roots, strict=True):
        r = block.white if root is None else root * block.white
        total = total + (
            0.5 * (r * r).sum(axis=axes) if block.cost is None else block.cost.sum(axis=axes)
        )
    return total


def eliminate(hessian, gradient, shared, rcond=1e-13):
    """Schur complement: what each placement says about the shared unknowns once its own are
    eliminated.

    The first `shared` = c unknowns of the normal equations (p, k, k), (p, k) are common to all
    placements; eigenvalues of the placements' own blocks below `rcond` are no information (None:
    the blocks are regular). Returned are the reduced equations (p, c, c), (p, c) and ``back`` (p, k
    - c, c + 1): a step x of the shared unknowns goes with ``-(back[..., c] + back[..., :c] x)`` of
    a placement's own.
    """
    c = shared
    known = np.concatenate([hessian[:, c:, :c], gradient[:, c:, None]], axis=-1)
    own = hessian[:, c:, c:]
    back = (
        np.linalg.solve(own, known)
        if rcond is None
        else np.linalg.pinv(own, rcond=rcond, hermitian=True) @ known
    )
    across = hessian[:, :c, c:]
    return (
        hessian[:, :c, :c] - across @ back[..., :c],
        gradient[:, :c] - (across @ back[..., c:])[..., 0],
        back,
    )


def reduced_hessian(hessian, shared):
    """What each placement says about the shared unknowns once its own are eliminated, shape (p,
    c, c).
    """
    return eliminate(hessian, np.zeros(hessian.shape[:2]), shared)[0]


def _step(hessian, gradient, damping, shared):
    """A damped step, its squared length in standard deviations, and the fall of the cost it
    promises.
    """
    diagonal = hessian.diagonal(axis1=-2, axis2=-1)
    extra = damping[..., None] * diagonal
    # what nobody sees stays where it is
    extra = extra + (1e-14 * diagonal.max(axis=-1, keepdims=True) + 1e-300)
    damped = hessian + extra[..., None] * np.eye(hessian.shape[-1])
    if shared is None:
        step = whole = -np.linalg.solve(damped, gradient[..., None])[..., 0]
    else:
        reduced, right, back = eliminate(damped, gradient, shared, rcond=None)
        common = -np.linalg.solve(np.sum(reduced, axis=0), np.sum(right, axis=0))
        step = common, -(back[..., shared] + back[..., :shared] @ common)
        whole = np.concatenate([np.broadcast_to(common, (len(back), shared)), step[1]], axis=-1)
    length = np.vecdot(whole, (hessian @ whole[..., None])[..., 0])
    promised = -np.vecdot(whole, gradient) - 0.5 * length
    return (step, length, promised) if shared is None else (step, np.sum(length), np.sum(promised))


def minimise(
    evaluate,
    state,
    retract,
    *,
    shared=None,
    loss=None,
    scale=1.0,
    max_iterations=60,
    tolerance=1e-8,
):
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
    loss : {None, 'cauchy'}
    scale : float or 'auto'
        Unit of the loss in standard deviations; 'auto' takes it from the median of the residuals in
        every iteration.
    max_iterations : int
    tolerance : float
        A trial has converged when a step is shorter than this many standard deviations of the
        estimate.

    Returns
    -------
    state, converged, iterations, cost_history
    """
    axes = -1 if shared is None else (-2, -1)
    blocks = _blocks(evaluate, state)
    hessian, gradient, cost, roots = linearise(blocks, loss, scale, axes)
    history = [cost]
    converged = np.zeros(np.shape(cost), bool)
    damping = np.full(np.shape(cost), 1e-7)
    iteration = 0
    while iteration < max_iterations and not converged.all():
        iteration += 1
        step, length, promised = _step(hessian, gradient, damping, shared)
        trial = retract(state, step)
        tried = _blocks(evaluate, trial)
        before = cost if loss is None else _frozen_cost(blocks, roots, axes)
        after = _frozen_cost(tried, roots, axes)
        accepted = after <= before * (1 + 1e-12) + 1e-26
        small = (length < tolerance**2) | (length < 1e-14 * before)
        converged = converged | (small & np.isfinite(after) & (damping < 10.0))
        if accepted.all():
            state = trial
            blocks = tried
        elif accepted.any():
            state = np.where(
                accepted.reshape(accepted.shape + (1,) * (state.ndim - accepted.ndim)), trial, state
            )
            blocks = _blocks(evaluate, state)
        hessian, gradient, cost, roots = linearise(blocks, loss, scale, axes)
        history.append(cost)
        # less damping where the linear model keeps its promise, more where it overshoots (large
        # residuals)
        gain = np.where(
            promised > 3e-15 * before, (before - after) / np.maximum(promised, 1e-300), 1.0
        )
        kept = np.where(gain > 0.8, 0.1, 1.0) * damping
        worse = np.maximum(np.where(accepted, 4.0, 10.0) * damping, 1e-4)
        damping = np.minimum(
            np.maximum(np.where(accepted & (gain > 0.5), kept, worse), 1e-12), 1e14
        )
    return (
        state,
        (bool(converged) if converged.ndim == 0 else converged),
        iteration,
        np.array(history),
    )


def minimise_in_rounds(freeze, state, retract, rounds, **options):
    """Minimise a few times with what depends on the state frozen anew (weights, say).

    `freeze` makes a problem, ``(state, round) -> evaluate``; `options` are those of
    :func:`minimise`. Returns the problem that is left to solve, the state there, and the cost
    histories so far.
    """
    earlier = []
    for number in range(rounds):
        state, _, _, history = minimise(freeze(state, number), state, retract, **options)
        earlier.append(history)
    return freeze(state, rounds), state, earlier


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
    required=True,
    n_observations=None,
    limit=1.0,
    chi2_rest=0.0,
    earlier=(),
    **options,
):
    """Minimise (see :func:`minimise` and its options), then report covariances and what was not
    observed: a Solution.

    `names` are those of the unknowns reported (with `shared`, the shared ones), `read` makes
    ``(transform or None, parameters)`` of a state, `scales` and `limit` are those of
    :func:`null_space`, `words` puts a direction (k,) into words (the names with its largest
    components by default). `groups` tell the placement of every residual, or of every few in a row,
    for `covariance_placements`; with `shared` the leading axis is the placement. `freedom` and
    `n_observations` are by default those of the residuals; `chi2_rest` is chi-square that no
    unknown can change (compressed away), `earlier` are cost histories of earlier rounds.

    Raises DegenerateGeometry naming unobservable motions when `required` (single problems only),
    and ValueError when residuals at the start are not finite.
    """
    axes = -1 if shared is None else (-2, -1)
    last = [None, None]

    def once(state):
        """Blocks at a state; those of the last state are kept."""
        if last[0] is not state:
            last[:] = state, _blocks(evaluate, state)
        return last[1]

    if not all(np.isfinite(block.residuals).all() for block in once(start)):
        raise ValueError(
            f"{method}: residuals at the start value are not finite: check the observations and T0"
        )
    options |= {"shared": shared, "loss": loss, "scale": scale}
    state, converged, iterations, history = minimise(once, start, retract, **options)
    parts = [(*whiten(block), _weigh(block, loss, scale, axes)[0]) for block in once(state)]
    parts = [(r, J, np.ones_like(r) if weights is None else weights) for r, J, weights in parts]
    r, J, weights = (
        np.concatenate([p[i] for p in parts], axis=-1 if i != 1 else -2) for i in range(3)
    )
    hessians, scores = _by_placement(r, J, weights, groups, shared)
    hessian = np.sum(hessians, axis=-3)
    scales = np.ones(hessian.shape[-1]) if scales is None else np.asarray(scales)
    lost = null_space(hessian, scales, limit)[0] if hessian.ndim == 2 else ()
    lost = tuple(
        (words or (lambda direction: name_words(direction, names)))(direction) for direction in lost
    )
    if required and lost:
        raise DegenerateGeometry(f"{method}: the data do not determine " + "; ".join(lost))
    chi2 = np.sum(weights * r**2, axis=axes) + chi2_rest
    if freedom is None:
        own = J.shape[-1] if shared is None else shared + len(r) * (J.shape[-1] - shared)
        freedom = r.size // chi2.size - own
    too_large = (freedom > 0) & (chi2 > chdtri(max(freedom, 1), 0.001))
    inflation = np.where(too_large, chi2 / max(freedom, 1), 1.0)
    transform, parameters = read(state)
    return Solution(
        transform,
        parameters,
        tuple(names),
        converged,
        iterations=iterations + sum(len(costs) - 1 for costs in earlier),
        cost_history=np.concatenate([*(costs[:-1] for costs in earlier), history]),
        residuals=r,
        jacobian=J,
        weights=weights,
        covariance=_covariance(hessian, scales, lost) * inflation[..., None, None],
        covariance_placements=None
        if groups is None and shared is None
        else placement_covariance(hessians, scores)[0],
        unobservable=lost,
        method=method,
        n_observations=n_observations or r.shape[-1],
        chi2=chi2,
        inflation=inflation,
        state=state,
        n_placements=hessians.shape[-3],
    )


def _by_placement(r, J, weights, groups, shared):
    """Normal equations of the reported unknowns by placement (one group where they are not told
    apart).
    """
    weighted = weights[..., None] * J
    if groups is not None:  # rows of a placement together, padded with what counts nothing
        groups = np.repeat(groups, r.shape[-1] // len(groups))
        number = np.bincount(groups)
        used = np.arange(number.max()) < number[number > 0, None]
        index = np.zeros(used.shape, int)
        index[used] = np.argsort(groups, kind="stable")
        r = r[..., index]
        J = J[..., index, :]
        weighted = weighted[..., index, :] * used[..., None]
    weighted = weighted.swapaxes(-1, -2)
    hessians = weighted @ J
    scores = (weighted @ r[..., None])[..., 0]
    if shared is not None:
        return reduced_hessian(hessians, shared), scores[:, :shared]
    return (
        (hessians, scores)
        if groups is not None
        else (hessians[..., None, :, :], scores[..., None, :])
    )


def null_space(hessian, scales, limit=1.0):
    """Directions that normal equations (k, k) of whitened residuals do not determine.

    `scales` (k,) are what counts as a change by one: 1 rad, 1 m, 1000 px; a direction is also
    unobservable when its standard deviation exceeds `limit` scales. Returned are increments (m, k),
    largest component 1, the worst first, and the singular values (k,) of the scaled, whitened
    Jacobian, ascending: reciprocal standard deviations.
    """
    scales = np.asarray(scales, float)
    values, vectors = np.linalg.eigh(hessian * scales[:, None] * scales)
    basis = vectors[:, values < np.maximum(RANK * values[-1], limit**-2)].T
    open_rows = list(range(len(basis)))
    # reduced echelon form with pivots at the largest entries: the basis with most zeros
    while open_rows:
        row, column = np.unravel_index(
            np.argmax(np.abs(basis[open_rows])), (len(open_rows), basis.shape[1])
        )
        pivot = open_rows.pop(row)
        basis[pivot] /= basis[pivot, column]
        others = np.arange(len(basis)) != pivot
        basis[others] -= basis[others, column, None] * basis[pivot]
    directions = np.where(np.abs(basis) < 1e-5, 0.0, basis) * scales
    return directions / np.max(np.abs(directions), axis=1, keepdims=True), np.sqrt(
        np.maximum(values, 0.0)
    )


def pseudo_inverse(hessian):
    """Inverse of scaled normal equations on what they determine.

    Eigenvalues below zero are rounding errors too.
    """
    values, vectors = np.linalg.eigh(hessian)
    inverse = np.divide(
        1.0, values, out=np.zeros_like(values), where=values > RANK * values[..., -1:]
    )
    return (vectors * inverse[..., None, :]) @ np.swapaxes(vectors, -1, -2)


def _covariance(hessian, scales, lost):
    """Inverse of normal equations. Unknowns that take part in an undetermined direction have an
    infinite variance.

    A pseudo-inverse calls such unknowns perfectly known; their covariances with others are set to
    zero.
    """
    unit = scales[:, None] * scales
    covariance = pseudo_inverse(hessian * unit) * unit
    if not lost:  # or many trials
        return covariance
    lost = np.any(np.abs(null_space(hessian, scales, np.inf)[0]) > 0.05, axis=0)
    covariance = np.where(lost[:, None] | lost, 0.0, covariance)
    return covariance + np.diag(np.where(lost, np.inf, 0.0))


def name_words(direction, names, share=0.05):
    """Names (or words) of the unknowns with the largest components of a direction."""
    large = np.abs(direction) > share * np.max(np.abs(direction))
    return " with ".join(np.asarray(names)[large])


def placement_covariance(hessians, scores):
    """First-order jackknife over g placements, from what each adds to the normal equations.

    `scores` are ``J^T r`` of each placement at the solution. Returned are the covariance and the
    changes (..., g, k) of the estimate when that placement is left out; None with fewer than three
    placements, or where the others do not determine the estimate.

    Notes
    -----
    The sum of squared changes (CR3) is too large in the mean where placements carry unequal weight:
    noise alone gives ``(g - 1) / g sum_g (inv(H - H_g) - inv(H))`` instead of ``inv(H)``. That
    factor is taken off every unknown, so that scatter and noise can be compared.
    """
    groups = hessians.shape[-3]
    total = np.sum(hessians, axis=-3, keepdims=True)
    diagonal = np.sqrt(np.maximum(np.diagonal(total, axis1=-2, axis2=-1), 1e-300))
    outer = diagonal[..., :, None] * diagonal[..., None, :]
    scaled = (total - hessians) / outer
    try:  # squared pivots: what the others say about one unknown more
        pivots = np.linalg.cholesky(scaled).diagonal(axis1=-2, axis2=-1)
    except np.linalg.LinAlgError:
        return None, None
    if groups < 3 or pivots.min() < 1e-6:
        return None, None
    without = np.linalg.inv(scaled)
    shifts = (without @ (scores / diagonal)[..., None])[..., 0] / diagonal
    share = (groups - 1) / groups
    squares = share * np.swapaxes(shifts, -1, -2) @ shifts
    whole = np.diagonal(np.linalg.inv(total / outer), axis1=-2, axis2=-1)
    gained = np.diagonal(without, axis1=-2, axis2=-1) - whole
    factor = np.sqrt(whole[..., 0, :] / (share * gained.sum(axis=-2)))
    return factor[..., :, None] * squares * factor[..., None, :], shifts


def pad(group, count, width=1):
    """Arrays of a group (with `placement`, an index below `count`) sorted into rectangles (count,
    n, ...).

    Rows of a placement keep their order; zeros stand behind them, and `used` marks what is no
    padding. n is `width` at least.
    """
    order = np.argsort(group["placement"], kind="stable")
    number = np.bincount(group["placement"], minlength=count)
    used = np.arange(number.max(initial=width)) < number[:, None]
    out = {"used": used}
    for key, value in group.items():
        if key != "placement":
            out[key] = np.zeros(used.shape + value.shape[1:], value.dtype)
            out[key][used] = value[order]
    return out
