"""Noise levels of the joint estimate, taken from its residuals (no equations of the paper)."""

from dataclasses import replace

import numpy as np

from lrfcal_lib.fit.covariance import pseudo_inverse
from lrfcal_lib.fit.least_squares import likeliest, linearise
from lrfcal_lib.fit.result import beyond_chance
from lrfcal_lib.model.geometry import length_of
from lrfcal_lib.solvers.joint_model import SWEEPS, JointData, JointState, Levels, Unknowns
from lrfcal_lib.solvers.joint_residuals import (
    SIDE_FREEDOM,
    edge_distance,
    meeting,
    named_blocks,
    rays,
    sides_of_beams,
)

PARTS = 3  # of a board in x and in y
# radians, errors of the pitch at a stop that are tried
PITCH_LEVELS = np.radians(
    [0.0, 0.001, 0.002, 0.003, 0.005, 0.007, 0.01, 0.015, 0.02, 0.03, 0.05, 0.1]
)
SCALE_ROUNDS = 4
SCALE_LIMITS = (1e-4, 1e4)
SIDE_ROUNDS = 20
SIDE_LIMITS = (0.01, 2.0)  # log odds
SWEEP_ROUNDS = 20
# radians and fraction: what heads with a gear are off by, as one sweep more is believed to be
USUAL_SWEEP = np.array([np.radians(0.02), 0.002])
# curvature of the beams' cost, relative to their information: below 0 where most contradict their
# edges
LEAST_CURVATURE = 0.1
SETTLED = 0.02  # change of the logarithm of a noise level


def estimate_noise(state: JointState, data: JointData, unknowns: Unknowns) -> JointData:
    """Padded observations with noise levels from the residuals at a solution."""
    blocks = named_blocks(state, data, unknowns)
    hessian, gradient = linearise(blocks.values())
    c = unknowns.shared
    own = hessian[:, c:, c:]
    spread = pseudo_inverse(own)  # shared ones held
    if "face" in blocks:
        data = with_face_levels(state, data, blocks["face"], c, spread)
    if "beam" in blocks:
        data = with_beam_share(state, data, blocks["beam"], c, spread)
    if "view" in blocks:
        data = with_view_levels(data, blocks["view"], hessian, gradient, c)
    if "side" in blocks:
        data = with_side_levels(state.sides, data, own, gradient[:, c:])
    if "sweep" in blocks:
        sweeps = state.sweeps[:, : SWEEPS[unknowns.sweep]]
        data = with_sweep_levels(sweeps, data, hessian, gradient, c)
    return data


def settled(before: Levels, after: Levels) -> bool:
    """Whether noise levels have settled within a few per cent."""
    compared = [
        [at.face_scale, at.face_share, at.beam_share, at.view_scale, *at.sweep_sigma]
        for at in (before, after)
    ]
    return bool(np.ptp(np.log(compared), axis=0).max() < SETTLED)


def with_face_levels(state, data, block, shared, spread):
    """The JointData with the scale of the ranges' noise, and the share of independent errors, from
    what ranges have in common over a board and over parts of it.

    What board poses take up of the residuals is told by `spread` (p, k, k), the covariance of a
    placement's own unknowns, which follow the `shared` ones: three numbers of a plane where only
    the scan shows it, next to nothing where images do. These three carry all that ranges say, so
    that errors in them count, however small a part of the scatter they are.
    """
    before = data.levels.face_share
    used = data.face["used"]
    z = data.face["weight"] * block.residuals
    by_own = block.white_jacobian[..., shared:]
    taken = np.sum(by_own * (by_own @ spread))
    scale = np.sqrt(np.sum(z**2) / max(used.sum() - taken, 1))
    # where the ranges should end: noise must not decide which part a point lies in
    exact = meeting(state, rays(state, data, data.face)).point
    flat = (exact @ state.boards[:, :, :3])[..., :2]
    counted = used[..., None]
    there = np.where(counted | ~counted.any(axis=1, keepdims=True), flat, np.nan)
    limits = np.nanquantile(there, np.arange(1, PARTS) / PARTS, axis=1)
    part = np.sum(flat > limits[:, :, None], axis=0) @ [PARTS, 1]
    parts = np.eye(PARTS**2)[part] * counted
    planes = np.linalg.qr(np.insert(flat, 0, 1.0, axis=-1) * counted)[0]
    planes *= counted  # of a placement without ranges it makes something else
    shares = [
        independent_share(modes, z / scale, by_own, before, spread)
        for modes in (parts, planes)
    ]
    share = np.nan_to_num(np.fmin(*shares), nan=before)
    return data.with_levels(face_scale=scale, face_share=share)


def independent_share(modes, residuals, by_own, share, spread, usual=1.0):
    """Share of independent errors, from how much more than by these modes of boards or edges
    scatter, as far as chance does not explain it; NaN where nothing tells it.

    Placements' own unknowns take a part t of a mode. What is left of its score has the part
    ``(1 - t)^2`` of the variance asked for and, from all else that the estimate weighs against it,
    ``t (1 - t) / share``.

    Parameters
    ----------
    modes : ndarray, shape (p, n, m)
        What measurements of a placement have in common, such as those of a part; orthogonal.
    residuals : ndarray, shape (p, n)
        In standard deviations.
    by_own : ndarray, shape (p, n, k)
        Their derivatives, times the root of `share`.
    share : float
        Of the information that the estimate counts.
    spread : ndarray, shape (p, k, k)
        Covariance of own unknowns.
    usual : float
        Variance of independent errors, and the largest share.
    """
    counted = np.sum(modes**2, axis=1)
    score = np.vecmat(residuals, modes)
    pull = modes.mT @ by_own
    there = counted > 0
    taken = np.vecdot(pull, pull @ spread)[there] / counted[there]
    told = np.sum((1 - taken) ** 2)
    if told < 1:
        return np.nan
    square = np.sum(score[there] ** 2 / counted[there])
    variance = (square - np.sum(taken * (1 - taken)) / share) / told
    return usual * np.exp(-beyond_chance(np.log(max(variance / usual, 1.0)), told))


def with_beam_share(state, data, block, shared, spread):
    """The JointData with the share of independent errors among neighbouring beams, from the scores
    of every edge's slope.

    Slopes carry most of what beams say, and a background that changes along a side turns it. What
    board and sides take up of the scores is told by `spread` (p, k, k), the covariance of a
    placement's own unknowns, which follow the `shared` ones. The steps count a little more
    information than there is where beams may say nothing (`lapse`, see
    :func:`lrfcal_lib.fit.edge_likelihood.beam_terms`); the share brings that down to the true
    curvature of the cost.

    Never above that: where readings flip more sharply than the floor of the softness, crossings lie
    so regularly between the beams that scores hardly scatter, but edges are no better known than
    the spacing of the beams says.
    """
    before = data.levels.beam_share
    by_own = block.white_jacobian[..., shared:]
    root = length_of(by_own[..., 3:6])  # root information
    lapsed = data.levels.lapse * np.exp(block.cost / before)
    bent = (root * block.residuals) ** 2 * lapsed / (1 - lapsed)
    gain = max(1 - np.sum(bent) / np.sum(root**2), LEAST_CURVATURE)
    ray = rays(state, data, data.beam)
    sides = edge_distance(state, data, data.beam, ray)
    along = np.vecdot(meeting(state, ray).point, sides.along)[..., None]  # metres
    edges = np.eye(len(data.lines))[data.beam["edge"]] * root[..., None]
    information = np.maximum(np.sum(edges**2, axis=1, keepdims=True), 1e-300)
    middle = np.sum(edges**2 * along, axis=1, keepdims=True) / information
    slopes = edges * (along - middle)
    share = independent_share(slopes, block.residuals, by_own, before, spread, gain)
    return data.with_levels(beam_share=np.nan_to_num(share, nan=before))


def with_view_levels(data, block, hessian, gradient, shared):
    """The JointData with the scale of the pose errors in images and the error of the pitch at a
    stop: the most likely pair.

    The likelihood is the restricted one: what the unknowns take up of the residuals is no sign of
    small errors. A board that moves with its images hides what all of them share, so that stops of
    one placement tell the error of the pitch by their differences alone. `hessian` (p, k, k) and
    `gradient` (p, k) are of all blocks, `shared` unknowns first.

    One scale serves all cameras: with one view each, a camera could buy itself perfection at the
    other's cost.
    """
    views, view_gradient = linearise([block])
    others = hessian - views
    other_gradient = gradient - view_gradient
    rows = 6 * data.view["used"].sum()
    levels = PITCH_LEVELS if data.on_head.any() else PITCH_LEVELS[:1]
    costs = []
    factors = []
    factor = 1.0
    for sigma in levels:
        trial = replace(block, sigma_pitch=sigma)
        cost, factor = judged(trial, factor, others, other_gradient, rows, shared)
        costs.append(cost)
        factors.append(factor)
    best = np.argmin(costs)
    sigma = levels[best]
    if 1 < best < len(costs) - 1:  # between the levels: a parabola through three of them
        near = slice(best - 1, best + 2)
        bend, slope, _ = np.polyfit(np.log(levels[near] / sigma), costs[near], 2)
        if bend > 0:  # not where the likelihood overflows
            sigma *= np.exp(-slope / (2 * bend))
    factor = factors[best]
    scale = np.clip(data.levels.view_scale * factor, *SCALE_LIMITS)
    return data.with_levels(view_scale=scale, sigma_pitch=sigma * factor)


def judged(block, factor, others, other_gradient, rows, shared):
    """Negative log likelihood of views with an error of the pitch and a factor on both their
    scales, and a factor that is better than the one it begins with.

    `others` and `other_gradient` are the normal equations of all that is no view, `rows` the number
    of residuals. One row more is believed to be as large as the factor says: where nothing else
    shows the scale, it stays as it is.
    """
    hessian, gradient = linearise([block])
    square = np.sum(block.white**2)
    for _ in range(SCALE_ROUNDS):
        f2 = factor**2
        whole = others + hessian / f2
        right = other_gradient + gradient / f2
        size = np.linalg.trace(whole)[:, None, None]
        whole = whole + 1e-12 * size * np.eye(whole.shape[-1])
        moved, covariance = likeliest(whole, right, shared)
        left = np.sum((block.white + np.matvec(block.white_jacobian, moved)) ** 2)
        # share of the views in what is known of the unknowns: rows that these take up
        taken = np.sum(covariance * hessian)
        own = np.linalg.slogdet(whole[:, shared:, shared:])[1].sum()
        freedom = own - np.linalg.slogdet(covariance[0, :shared, :shared])[1]
        cost = 0.5 * (
            square / f2
            + np.vecdot(moved, right).sum()
            + rows * np.log(f2)
            + block.log_determinant
            + freedom
        )
        factor = np.sqrt((left + f2) / (max(rows - taken / f2, 0.0) + 1))
    return cost, factor


def with_sweep_levels(sweeps, data, hessian, gradient, shared):
    """The JointData with the standard deviations of the sweeps' own errors (p, n) of the pitch, by
    restricted likelihood.

    Each variance is the sum of the squared errors over the number of errors that the data tell
    (MacKay's rule): what they do not tell has no say, or a first guess would stay for ever. One
    sweep more is believed to err as `USUAL_SWEEP`. `hessian` (p, k, k) and `gradient` (p, k) are
    of all blocks, `shared` unknowns first.
    """
    number = sweeps.shape[1]
    places = shared + 6 + np.arange(number)  # behind the board's pose
    usual = USUAL_SWEEP[:number] ** 2
    before = np.square(data.levels.sweep_sigma)
    variance = before
    for _ in range(SWEEP_ROUNDS):
        more = 1 / variance - 1 / before
        square, unknown = expecting(more, sweeps, places, hessian, gradient, shared)
        told = np.maximum(1 - unknown / variance, 0.0)
        variance = (np.sum(square, axis=0) + usual) / (np.sum(told, axis=0) + 1)
    return data.with_levels(sweep_sigma=np.sqrt(variance).tolist())


def expecting(more, values, places, hessian, gradient, shared):
    """Squares and variances (p, n) of unknowns in some places, now `values`, if there were `more`
    information that they are zero than normal equations hold.
    """
    whole = hessian.copy()
    right = gradient.copy()
    whole[:, places, places] += more
    right[:, places] += more * values
    steps, covariance = likeliest(whole, right, shared)
    return (values + steps[:, places]) ** 2, covariance[:, places, places]


def with_side_levels(sides, data, hessian, gradient):
    """The JointData with the scales of the sides' deviations and of what those of a placement have
    in common, Student's t, by expectation and maximisation.

    Student's t is a normal distribution whose precision varies from side to side; what is expected
    of it hangs on the whole expected square of a deviation. A side that the beams hardly show is as
    uncertain as the scale says, and must not pull it down. One side, and one placement, more is
    believed to deviate as is usual: where nothing shows the scale, that is it. `hessian` (p, k, k)
    and `gradient` (p, k) are of a placement's own unknowns, the deviations (p, e + 1) last; shared
    ones are held.
    """
    edges = sides.shape[1] - 1
    sigma2 = data.levels.of_sides(edges) ** 2
    shown = np.any(data.beam["used"][..., None] & sides_of_beams(data, edges), axis=1)
    kinds = [0, edges]  # where the deviations of sides begin, and what they have in common
    counted = np.add.reduceat(np.sum(shown, axis=0), kinds)
    usual = np.square([Levels.side_sigma, Levels.background_sigma])
    prior = (SIDE_FREEDOM + 1) / (SIDE_FREEDOM * sigma2 + sides**2)  # as in `side_block`
    last = np.arange(-edges - 1, 0)
    weight = prior * sigma2
    for _ in range(SIDE_ROUNDS):
        more = weight / sigma2 - prior
        square = sum(expecting(more, sides, last, hessian, gradient, 0))
        weight = (SIDE_FREEDOM + 1) / (SIDE_FREEDOM + square / sigma2)
        total = np.add.reduceat(np.sum(weight * square * shown, axis=0), kinds)
        both = np.clip((total + usual) / (counted + 1), *np.square(SIDE_LIMITS))
        sigma2 = np.repeat(both, [edges, 1])
    side, background = np.sqrt(both).tolist()
    return data.with_levels(side_sigma=side, background_sigma=background)
