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

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from lrfcal_lib.fit.covariance import (
    covariance_of,
    name_words,
    null_space,
    placement_covariance,
    pseudo_inverse,
    solve_each,
)
from lrfcal_lib.fit.padding import medians
from lrfcal_lib.fit.result import Solution
from lrfcal_lib.model.geometry import DegenerateGeometry

CAUCHY = 2.385  # 95 % efficiency for normal errors
FIRST_DAMPING = 1e-7  # of the normal equations' diagonal
LEAST_DAMPING = 1e-12
MOST_DAMPING = 1e14
# a step with more is short because it is held, not because it has arrived
SMALL_DAMPING = 10.0
# a step that had to be held leads nowhere if it began shorter than this, in standard deviations and
# in tolerances: gradients leave out what the state does to some weights (of the views at a stop)
LEADS_NOWHERE = 0.01
NOWHERE_TOLERANCES = 100.0
# chance alone exceeds chi-square so seldom where the stated noise is right
LARGE_CHI2 = 0.001


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
        consecutive residuals. A zero switches a residual off. One by default, for residuals in
        standard deviations.
    count : float or ndarray, shape (..., n / d), optional
        Number of measurements that each group of residuals stands for (d when left out): only
        losses use it.
    corrected : ndarray, shape (..., n, k), optional
        Jacobian that includes the change of the whitener: ``J - dS/2 S^-1 r`` for residuals with
        covariance S. The steps use it where it is given.
    cost : ndarray, shape (..., n), optional
        Negative log likelihood of each residual where it is not half a square; whitened residuals
        are then score over root information, the whitened Jacobian root information times the
        derivative. No loss applies.
    """

    residuals: np.ndarray
    jacobian: np.ndarray
    whitener: np.ndarray = field(default_factory=lambda: np.ones(()))
    count: float | np.ndarray | None = None
    corrected: np.ndarray | None = None
    cost: np.ndarray | None = None

    @classmethod
    def of_groups(cls, residuals, jacobian, whitener, corrected=None, **rest):
        """The Block of residuals (..., m, d) with their Jacobian (..., m, d, k); the rest is as
        above.
        """
        shape = residuals.shape[:-2] + (-1,)
        by_unknowns = shape + jacobian.shape[-1:]
        if corrected is not None:
            corrected = corrected.reshape(by_unknowns)
        jacobian = jacobian.reshape(by_unknowns)
        return cls(
            residuals.reshape(shape), jacobian, whitener, corrected=corrected, **rest
        )

    @property
    def size(self):
        """Number d of residuals that are judged together by a robust loss."""
        return self.whitener.shape[-1] if self.whitener.ndim > self.residuals.ndim else 1

    def whitened(self, rows):
        """Rows (..., n, k), such as a Jacobian, in independent standard deviations."""
        w = self.whitener
        if w.ndim <= self.residuals.ndim:
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


def _roots(block, axes, robust):
    """Roots of Cauchy's weights of residuals, or of groups of them, that are judged together, in
    their usual size: by the median of a trial. As factors of the whitener.
    """
    if block.cost is not None or not robust:
        return np.ones(())
    groups = block.white.reshape(*block.white.shape[:-1], -1, block.size)
    squares = np.vecdot(groups, groups)
    count = block.size if block.count is None else block.count
    sizes = np.sqrt(squares / chdtri(count, 0.5))
    trials = sizes.reshape(*sizes.shape[: -len(axes)], -1)
    level = np.expand_dims(medians(trials, trials > 0), axes)
    roots = (1 + squares / count / (CAUCHY * np.maximum(level, 1e-9)) ** 2) ** -0.5
    return roots[..., None, None] if block.size > 1 else roots


def _weighted(evaluate, robust, axes):
    """A problem whose blocks may have robust weights."""

    def problem(state, roots=()):
        """Blocks at a state, the roots of their weights (given ones, or those there), the cost."""
        blocks = _blocks(evaluate, state)
        roots = roots or [_roots(block, axes, robust) for block in blocks]
        weighted = [
            replace(block, whitener=block.whitener * root)
            for block, root in zip(blocks, roots, strict=True)
        ]
        return weighted, roots, _cost(weighted, axes)

    return problem


def _axes(shared):
    """What a cost is summed over: residuals of trials, or placements and residuals."""
    return (-2, -1) if shared else (-1,)


def _blocks(evaluate, state):
    """What a problem hands over, as a list."""
    blocks = evaluate(state)
    if isinstance(blocks, Block):
        return [blocks]
    return list(blocks)


class Linearised(NamedTuple):
    """Normal equations (..., k, k) and (..., k) of whitened blocks at a state."""

    hessian: np.ndarray
    gradient: np.ndarray


def linearise(blocks: Collection[Block]) -> Linearised:
    """Normal equations of blocks with the placement as leading axis, or of trials.

    Parameters
    ----------
    blocks : collection of Block
    """
    r, J = stacked(blocks)
    return Linearised(J.mT @ J, np.matvec(J.mT, r))


def stacked(blocks: Collection[Block]) -> tuple[np.ndarray, np.ndarray]:
    """White residuals (..., n) of all blocks, and their Jacobian (..., n, k)."""
    r = np.concatenate([block.white for block in blocks], axis=-1)
    return r, np.concatenate([block.white_jacobian for block in blocks], axis=-2)


def _cost(blocks, axes):
    """Halves of the sums of squares, or the negative log likelihoods, of all blocks."""
    costs = [0.5 * block.white**2 if block.cost is None else block.cost for block in blocks]
    return sum(cost.sum(axis=axes) for cost in costs)


def eliminate(
    hessian: np.ndarray, gradient: np.ndarray, shared: int, regular: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Schur complement: what each placement says about the shared unknowns once its own are
    eliminated.

    Parameters
    ----------
    hessian, gradient : ndarray, shapes (p, k, k), (p, k)
        Normal equations; the first `shared` = c unknowns are common to all placements.
    shared : int
    regular : bool
        The placements' own blocks can be solved as they are. Otherwise rounding errors among their
        eigenvalues are no information.

    Returns
    -------
    reduced : ndarray, shape (p, c, c)
    gradient : ndarray, shape (p, c)
    by_shared : ndarray, shape (p, k, c + 1)
        The best step of all unknowns by that of the shared ones and a 1.
    """
    c = shared
    known = np.concatenate([hessian[:, c:, :c], gradient[:, c:, None]], axis=-1)
    own = hessian[:, c:, c:]
    if regular:
        back = np.linalg.solve(own, known)
    else:
        back = pseudo_inverse(own) @ known
    taken = hessian[:, :c, c:] @ back
    reduced = hessian[:, :c, :c] - taken[..., :c]
    same = np.broadcast_to(np.eye(c, c + 1), reduced.shape[:1] + (c, c + 1))
    by_shared = np.concatenate([same, -back], axis=1)
    return reduced, gradient[:, :c] - taken[..., c], by_shared


def reduced_hessian(hessian: np.ndarray, shared: int) -> np.ndarray:
    """What each placement says about the shared unknowns once its own are eliminated.

    Parameters
    ----------
    hessian : ndarray, shape (p, k, k)
    shared : int
        The first c unknowns.

    Returns
    -------
    ndarray, shape (p, c, c)
    """
    return eliminate(hessian, np.zeros(hessian.shape[:2]), shared)[0]


def likeliest(
    hessian: np.ndarray, gradient: np.ndarray, shared: int
) -> tuple[np.ndarray, np.ndarray]:
    """Steps (p, k) of all unknowns of every placement to the minimum, and their covariances (p, k,
    k), from normal equations as of :func:`eliminate`.
    """
    reduced, right, by_shared = eliminate(hessian, gradient, shared)
    inverse = pseudo_inverse(np.sum(reduced, axis=0))
    steps = by_shared @ np.append(-inverse @ np.sum(right, axis=0), 1.0)
    derivatives = by_shared[..., :-1]
    covariance = derivatives @ inverse @ derivatives.mT
    covariance[:, shared:, shared:] += pseudo_inverse(hessian[:, shared:, shared:])
    return steps, covariance


def _step(hessian, gradient, damping, shared):
    """A damped step, its squared length in standard deviations, and the fall of the cost it
    promises: of each trial, or of all placements.
    """
    diagonal = np.linalg.diagonal(hessian)
    # what nobody sees stays where it is
    least = 1e-14 * diagonal.max(axis=-1, keepdims=True) + 1e-300
    extra = damping[..., None] * diagonal + least
    damped = hessian + extra[..., None] * np.eye(hessian.shape[-1])
    if shared:
        reduced, right, by_shared = eliminate(damped, gradient, shared, regular=True)
        common = -np.linalg.solve(np.sum(reduced, axis=0), np.sum(right, axis=0))
        step = by_shared @ np.append(common, 1.0)
    else:
        step = -solve_each(damped, gradient)
    length = np.vecdot(step, np.matvec(hessian, step))
    promised = -np.vecdot(step, gradient) - 0.5 * length
    each = _axes(shared)[1:]  # placements
    return step, np.sum(length, axis=each), np.sum(promised, axis=each)


class Minimum(NamedTuple):
    """Where a minimisation ended, trial by trial, the cost before each iteration and at the end,
    and the blocks there, with their weights.
    """

    state: Any
    converged: bool | np.ndarray
    cost_history: np.ndarray
    blocks: list[Block]


def minimise(
    evaluate: Callable,
    state: Any,
    retract: Callable,
    *,
    shared: int = 0,
    robust: bool = False,
    max_iterations: int = 60,
    tolerance: float = 1e-8,
) -> Minimum:
    """Run the damped Gauss-Newton iteration.

    Parameters
    ----------
    evaluate : callable
        ``state -> Block`` or list of blocks.
    state : ndarray (leading trial axes) or, with `shared`, any object
    retract : callable
        ``(state, step) -> state``; with `shared` the step is (p, k), of which the first c are those
        common to all placements, in every row.
    shared : int
        Number of unknowns common to all entries of the leading axis; 0 for trials.
    robust : bool
        Cauchy's loss, in units of the median of the residuals in every iteration.
    max_iterations : int
    tolerance : float
        A trial has converged when a step is shorter than this many standard deviations of the
        estimate.
    """
    axes = _axes(shared)
    problem = _weighted(evaluate, robust, axes)
    blocks, roots, cost = problem(state)
    history = [cost]
    converged = np.zeros_like(cost, bool)
    damping = np.full_like(cost, FIRST_DAMPING)
    nowhere = min(LEADS_NOWHERE, NOWHERE_TOLERANCES * tolerance)
    while len(history) <= max_iterations and not converged.all():
        hessian, gradient = linearise(blocks)
        step, length, promised = _step(hessian, gradient, damping, shared)
        trial = retract(state, step)
        tried, _, after = problem(trial, roots)
        accepted = after <= cost * (1 + 1e-12) + 1e-26
        small = (length < tolerance**2) | (length < 1e-14 * cost)
        held = damping >= SMALL_DAMPING
        began = (1 + damping) ** 2 * length  # so long the step was before it was held
        arrived = np.where(held, began < nowhere**2, small)
        converged = converged | (arrived & np.isfinite(after))
        gain = np.ones_like(cost)
        np.divide(cost - after, promised, out=gain, where=promised > 3e-15 * cost)
        damping = _next_damping(damping, gain, accepted)
        if accepted.all():
            state = trial
            blocks = tried
            cost = after
        elif accepted.any():  # transposed, trials come last
            state = np.where(accepted.T, trial.T, state.T).T
        if robust or not accepted.all():
            blocks, roots, cost = problem(state)
        history.append(cost)
    return Minimum(state, converged[()], np.array(history), blocks)


def _next_damping(damping, gain, accepted):
    """Less where the linear model keeps its promise, more where it overshoots (large residuals).

    `gain` is the fall of the cost beside the promised one.
    """
    kept = np.where(gain > 0.8, 0.1, 1.0) * damping
    worse = np.maximum(np.where(accepted, 4.0, 10.0) * damping, 1e-4)
    return np.clip(
        np.where(accepted & (gain > 0.5), kept, worse), LEAST_DAMPING, MOST_DAMPING
    )


def minimise_in_rounds(
    freeze: Callable, state: Any, retract: Callable, rounds: int, **options
) -> tuple[Callable, Any]:
    """Minimise a few times with what depends on the state frozen anew (weights, say).

    Parameters
    ----------
    freeze : callable
        Makes a problem, ``(state, round) -> evaluate``.
    state, retract
        See :func:`minimise`.
    rounds : int
    **options
        Those of :func:`minimise`.

    Returns
    -------
    evaluate : callable
        The problem that is left to solve.
    state
        Where to begin.
    """
    for number in range(rounds):
        state = minimise(freeze(state, number), state, retract, **options).state
    return freeze(state, rounds), state


@dataclass(frozen=True, kw_only=True)
class Question:
    """What is asked about the unknowns of a problem: names, units, words, placements.

    Attributes
    ----------
    names : sequence of str
        Of the unknowns reported (with `shared`, the shared ones).
    method : str
        For messages.
    read : callable
        Makes ``(transform or None, parameters)`` of a state.
    scales, limit
        See :func:`null_space`.
    words : callable, optional
        Puts a direction (k,) into words; by default the names with its largest components.
    groups : array_like
        The placement of every residual, or of every few in a row, for `covariance_placements`; one
        by default. With `shared` the leading axis is the placement.
    freedom, n_observations : int, optional
        By default those of the residuals of a trial.
    chi2_rest : float
        Chi-square that no unknown can change (compressed away).
    required : bool
        Refuse what leaves a motion open (single problems only).
    """

    names: Sequence[str]
    method: str
    read: Callable
    scales: ArrayLike = 1.0
    limit: float = 1.0
    words: Callable | None = None
    groups: ArrayLike = (0,)
    freedom: int | None = None
    n_observations: int | None = None
    chi2_rest: float | np.ndarray = 0.0
    required: bool = True

    def open_motions(self, hessian, scales):
        """Motions that normal equations (k, k) of one problem leave open, in words."""
        if hessian.ndim > 2:
            return ()
        directions = null_space(hessian, scales, self.limit)
        words = self.words or (lambda direction: name_words(direction, self.names))
        motions = tuple(words(direction) for direction in directions)
        if self.required and motions:
            open_motions = "; ".join(motions)
            raise DegenerateGeometry(
                f"{self.method}: the data do not determine {open_motions}"
            )
        return motions


def solve(
    evaluate: Callable,
    start: Any,
    retract: Callable,
    *,
    shared: int = 0,
    robust: bool = False,
    max_iterations: int = 60,
    tolerance: float = 1e-8,
    **asked,
) -> Solution:
    """Minimise, then report covariances and what was not observed.

    Parameters
    ----------
    evaluate, start, retract, shared, robust, max_iterations, tolerance
        See :func:`minimise`.
    **asked
        Fields of :class:`Question`.

    Raises
    ------
    DegenerateGeometry
        Naming unobservable motions, when `required`.
    ValueError
        When residuals at the start are not finite.
    """
    question = Question(**asked)
    minimum = minimise(
        evaluate,
        start,
        retract,
        shared=shared,
        robust=robust,
        max_iterations=max_iterations,
        tolerance=tolerance,
    )
    if not np.isfinite(minimum.cost_history[0]).all():
        raise ValueError(
            f"{question.method}: residuals at the start value are not finite: check the "
            "observations and T0"
        )
    blocks = minimum.blocks
    if robust:
        blocks = _blocks(evaluate, minimum.state)
    return _solution(question, minimum, blocks, shared)


def _by_placement(r, J, groups, shared):
    """Normal equations of the reported unknowns by placement (one group where they are not told
    apart).
    """
    transposed = J.mT
    if shared:
        scores = np.matvec(transposed, r)
        return reduced_hessian(transposed @ J, shared), scores[:, :shared]
    member = np.unique(groups)[:, None] == groups
    member = np.repeat(member, r.shape[-1] // len(groups), axis=1)
    transposed = transposed[..., None, :, :] * member[:, None]
    return transposed @ J[..., None, :, :], np.matvec(transposed, r[..., None, :])


def _solution(question, minimum, blocks, shared):
    """The Solution at a minimum, with the blocks there without their robust weights."""
    r, J = stacked(blocks)
    weighted_r, weighted_J = stacked(minimum.blocks)
    hessians, scores = _by_placement(weighted_r, weighted_J, question.groups, shared)
    hessian = np.sum(hessians, axis=-3)
    scales = np.broadcast_to(question.scales, hessian.shape[-1:])
    motions = question.open_motions(hessian, scales)
    chi2 = np.sum(weighted_r**2, axis=_axes(shared)) + question.chi2_rest
    freedom = question.freedom
    if freedom is None:
        freedom = r.shape[-1] - J.shape[-1]
    too_large = chi2 > chdtri(freedom, LARGE_CHI2)  # without any freedom never
    inflation = np.where(too_large, chi2 / max(freedom, 1), 1.0)
    transform, parameters = question.read(minimum.state)
    return Solution(
        transform,
        parameters,
        tuple(question.names),
        converged=minimum.converged,
        cost_history=minimum.cost_history,
        state=minimum.state,
        residuals=r,
        jacobian=J,
        covariance=covariance_of(hessian, scales, motions) * inflation[..., None, None],
        covariance_placements=placement_covariance(hessians, scores),
        unobservable=motions,
        method=question.method,
        n_observations=question.n_observations or r.shape[-1],
        chi2=chi2,
        inflation=inflation,
        n_placements=hessians.shape[-3],
    )
