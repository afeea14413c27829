"""Noise levels of the joint estimate, the share of the intrinsics, misfits, and what is
suspicious, in words.
"""

from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.fit.least_squares import eliminate, linearise, medians, pad, whiten
from lrfcal_lib.model.camera import project_jacobians
from lrfcal_lib.solvers.joint_model import SWEEPS, JointData, Unknowns
from lrfcal_lib.solvers.joint_residuals import (
    SIDE_FREEDOM,
    edge_distance,
    named_blocks,
    rays,
    view_block,
)

LENS = 9  # intrinsics of a camera, see CameraModel.parameters
LEAST_CORNERS = 6
PARTS = 3  # of a board in x and y, and of an edge
PLANE = 3  # numbers of a plane, that a placement's own pose takes up
PITCH_LEVELS = np.radians(
    [0.0, 0.001, 0.002, 0.003, 0.005, 0.007, 0.01, 0.015, 0.02, 0.03, 0.05, 0.1]
)
SCALE_ROUNDS = 4
SCALE_LIMITS = (1e-4, 1e4)
SIDE_ROUNDS = 20
# of the curvature of the beams' cost over their information; below 0 where most contradict edges
LEAST_CURVATURE = 0.1
SETTLED = 0.02  # change of the logarithm of a noise level
# scatter of residuals in stated standard deviations that still agrees with the statement
NOISE_LIMITS = (0.5, 2.0)
ASKED = 20.0  # squared score in standard deviations: chance alone exceeds it once in 100 000 times
# standard deviations of an axis nobody should rely on
WEAK_DIRECTION = np.radians(1.0)
WEAK_OFFSET = 0.020
TERMS = {
    "pitch_scale": (0.001, "the scale of the pitch", 100.0, "%"),
    "pitch_by_direction": (
        np.radians(0.01),
        "a pitch offset by sweep direction",
        np.degrees(1.0),
        "deg",
    ),
}


def pose_by_intrinsics(T_camera_board, corners, model):
    """How the pose of a board that fits given pixels changes with the intrinsics, shape (6, 9).

    Derivative of the increments ``[w, v]`` of T_camera_board, from the pattern's corners (k, 3)
    that were seen (board frame, metres); zeros with fewer than six.
    """
    if len(corners) < LEAST_CORNERS:
        return np.zeros((6, LENS))
    turned = T_camera_board.rotation.apply(corners)
    by_point, by_lens = project_jacobians(turned + T_camera_board.translation, model)
    by_pose = np.concatenate([np.cross(turned[:, None, :], by_point), by_point], axis=-1)
    return -np.linalg.lstsq(by_pose.reshape(-1, 6), by_lens.reshape(-1, LENS), rcond=None)[0]


def lens_covariance(obs, found, data, unknowns):
    """Covariance (c, c) of the shared unknowns from those of the intrinsics, and the scatter of
    views that these cause.

    The latter in stated standard deviations, like the scale of views: what no unknown can take up
    of the error that all views of a camera share. Between them comes what this scatter has added to
    `found.covariance` through the scale of views, as far as that exceeds the stated noise: the
    intrinsics would count twice. Zeros where they are exact.
    """
    c = unknowns.shared
    total = np.zeros((c, c))
    square = 0.0
    if len(obs.view_camera) == 0 or not np.any(obs.lens_covariance):
        return total, total, square
    block = view_block(found.state, data, unknowns)
    J = whiten(block)[1]
    used = data.view["used"]
    lens = pad({"lens": obs.view_lens, "placement": obs.view_placement}, len(used))["lens"]
    hessian = np.swapaxes(found.jacobian, -1, -2) @ (found.weights[..., None] * found.jacobian)
    own = np.linalg.pinv(hessian[:, c:, c:], rcond=1e-13, hermitian=True)
    reduced = J[..., :c] - J[..., c:] @ own @ hessian[:, c:, :c]
    finite = np.where(np.isfinite(found.covariance), found.covariance, 0.0)
    for camera, spread in enumerate(obs.lens_covariance):
        mine = (used & (data.view["camera"] == camera))[..., None, None]
        shift = block.whitened((lens * mine).reshape(J.shape[:2] + (LENS,)))
        gain = finite @ np.sum(np.swapaxes(reduced, -1, -2) @ shift, axis=0)
        left = (
            shift - reduced @ gain - J[..., c:] @ (own @ (np.swapaxes(J[..., c:], -1, -2) @ shift))
        )
        total = total + gain @ spread @ gain.T
        square = square + np.sum(left @ spread * left)
    level = data.view_scale[0] ** 2
    taken = np.sum((J[..., c:] @ own) * J[..., c:]) + np.sum((reduced @ finite) * reduced)
    square *= level / max(6 * used.sum() - taken, 1.0)  # rows that are left to show it
    share = np.clip(level - 1, 0, square) / level
    return (
        total,
        share * finite @ np.tensordot(reduced, reduced, ((0, 1), (0, 1))) @ finite,
        float(np.sqrt(square)),
    )


def estimate_noise(state, data, unknowns):
    """Padded observations with noise levels from the residuals at a solution."""
    blocks = named_blocks(state, data, unknowns)
    hessian, gradient, *_ = linearise(blocks.values(), None, 1.0, (-2, -1))
    own = hessian[:, unknowns.shared :, unknowns.shared :]
    spread = np.linalg.pinv(own, rcond=1e-13, hermitian=True)  # shared ones held
    if "face" in blocks:
        data = replace(data, **face_levels(state, data, blocks["face"]))
    if "beam" in blocks:
        data = replace(data, beam_share=beam_share(state, data, blocks["beam"], unknowns, spread))
    if "view" in blocks:
        data = view_levels(data, blocks["view"], hessian, gradient, unknowns.shared)
    count = SWEEPS[unknowns.sweep]
    if unknowns.sides and "beam" in blocks:
        level = side_level(state.sides, data, own, gradient[:, unknowns.shared :])
        data = replace(data, side_sigma=level)
    if count:
        variance = np.diagonal(spread, axis1=1, axis2=2)[:, 6 : 6 + count]
        found = np.sqrt(np.mean(state.sweeps[:, :count] ** 2 + variance, axis=0))
        data = replace(data, sweep_sigma=(*np.maximum(found, 1e-6), *data.sweep_sigma[count:]))
    return data


def face_levels(state, data, block):
    """Scale of the ranges' noise, and the share of independent errors, from means over parts of
    the boards.
    """
    used = data.face["used"]
    z = np.where(used, block.residuals / np.where(used, data.face["sigma"], 1.0), 0.0)
    number = used.sum(axis=1)
    scale = np.sqrt(np.sum(z**2) / max(np.sum(np.maximum(number - PLANE, 1)), 1))
    x = on_board(state, data)
    part = _part(x[..., 0], used) * PARTS + _part(x[..., 1], used)
    rows = np.arange(len(used))[:, None] * PARTS**2 + part
    total = np.bincount(rows[used], z[used])
    count = np.bincount(rows[used])
    full = count > 1
    free = full.sum() - PLANE * np.sum(number > 0)
    ratio = np.sum(total[full] ** 2 / count[full]) / scale**2 / max(free, 1)
    return {"face_scale": float(scale), "face_share": float(1 / max(ratio, 1.0))}


def face_points(state, data):
    """Measured face points in the platform frame, shape (p, n, 3)."""
    o, d = rays(state, data, data.face)[:2]
    return o + (data.face["range"] - state.sensor[0])[..., None] * d


def on_board(state, data):
    """Measured face points in the boards' frames, shape (p, n, 3)."""
    return (face_points(state, data) - state.boards[:, None, :, 3]) @ state.boards[:, :, :3]


def _part(values, used):
    """Third of the spread of values that each one lies in, row by row."""
    ordered = np.where(used | ~used.any(axis=1, keepdims=True), values, np.nan)
    limits = np.nanquantile(ordered, np.arange(1, PARTS) / PARTS, axis=1)
    return np.sum(values[None] > limits[..., None], axis=0)


def beam_share(state, data, block, unknowns, spread):
    """Share of independent errors among neighbouring beams, from the scores of parts of every edge.

    What board and sides take up of the scores is told by `spread` (p, k, k), the covariance of a
    placement's own unknowns. The steps count a little more information than there is where beams
    may say nothing (`lapse`, see :func:`beam_terms`); the share brings that down to the true
    curvature of the cost.

    Never above that: where readings flip more sharply than the floor of the softness, crossings lie
    so regularly between the beams that scores hardly scatter, but edges are no better known than
    the spacing of the beams says.
    """
    ray = rays(state, data, data.beam)
    a, t = edge_distance(state, data, data.beam, ray)[4:6]
    o, d = ray[:2]
    normal = state.boards[:, None, :, 2]
    origin = state.boards[:, None, :, 3]
    r = np.sum(normal * (origin - o), axis=-1) / np.sum(normal * d, axis=-1)
    along = np.sum((o + r[..., None] * d - origin - a) * t, axis=-1)
    own = block.jacobian[..., unknowns.shared :]
    root = np.linalg.norm(own[..., 3:6], axis=-1)  # root information
    lapsed = data.lapse * np.exp(np.where(data.beam["used"], block.cost, 0.0) / data.beam_share)
    curvature = root**2 * (1 - block.residuals**2 * lapsed / (1 - lapsed))
    parts = []
    for edge in range(len(data.lines)):
        mine = data.beam["used"] & (data.beam["edge"] == edge)
        for part in range(PARTS):
            weight = np.where(mine & (_part(along, mine) == part), root, 0.0)
            counted = np.sum(weight**2, axis=-1)
            true = np.sum(np.where(weight > 0, curvature, 0.0), axis=-1)
            score = np.sum(weight * block.residuals, axis=-1)
            by_own = (weight[:, None] @ own)[:, 0]
            taken = data.beam_share * np.vecdot(by_own, (spread @ by_own[..., None])[..., 0])
            parts.append(np.stack([counted, true, score, taken], axis=1)[counted > 0])
    counted, true, score, taken = np.concatenate(parts).T
    left = np.sum(1 - taken / counted)
    if left < 1:
        return data.beam_share
    gain = max(np.sum(true) / np.sum(counted), LEAST_CURVATURE)
    ratio = np.sum(score**2 / counted) / left / gain
    return float(gain / max(ratio, 1.0))


def view_levels(data, block, hessian, gradient, shared):
    """Scale of the pose errors in images and error of the pitch at a stop: the most likely pair.

    The likelihood is the restricted one: what the unknowns take up of the residuals is no sign of
    small errors. A board that moves with its images hides what all of them share, so that stops of
    one placement tell the error of the pitch by their differences alone. `hessian` (p, k, k) and
    `gradient` (p, k) are of all blocks, `shared` unknowns first.

    One scale serves all cameras: with one view each, a camera could buy itself perfection at the
    other's cost.
    """
    views = ViewEvidence.of(block, hessian, gradient, shared)
    trials = []
    factor = 1.0
    for sigma in PITCH_LEVELS if data.on_head.any() else PITCH_LEVELS[:1]:
        for _ in range(SCALE_ROUNDS):
            cost, factor = views.judged(sigma**2, factor)
        trials.append((cost, factor))
    costs, factors = np.array(trials).T
    best = int(np.argmin(costs))
    sigma = PITCH_LEVELS[best]
    if 1 < best < len(costs) - 1:  # between the levels: a parabola through three of them
        x = np.log(PITCH_LEVELS[best - 1 : best + 2])
        y = costs[best - 1 : best + 2]
        bend, slope, _ = np.polyfit(x - x[1], y, 2)
        sigma *= np.exp(-slope / (2 * bend)) if bend > 0 else 1.0
    scale = np.clip(data.view_scale * factors[best], *SCALE_LIMITS)
    return replace(data, view_scale=scale, sigma_pitch=float(sigma * factors[best]))


@dataclass(frozen=True)
class ViewEvidence:
    """What views say about their own noise levels, at the scale that they are whitened with.

    Attributes
    ----------
    other_hessian, other_gradient : ndarray, shapes (p, k, k), (p, k)
        Normal equations of all that is no view.
    hessian, gradient, square : ndarray, shapes (p, k, k), (p, k), (p,)
        Those of the views without an error of the pitch, and the sum of their squared residuals.
    by_stop, along, strength : ndarray, shapes (p, v, k), (p, v), (p, v)
        Of every stop (zeros where there are fewer stops than images): products of the whitened
        derivative g by its pitch with the Jacobian, with the residuals, with itself.
    rows, shared : int
    """

    other_hessian: np.ndarray
    other_gradient: np.ndarray
    hessian: np.ndarray
    gradient: np.ndarray
    square: np.ndarray
    by_stop: np.ndarray
    along: np.ndarray
    strength: np.ndarray
    rows: int
    shared: int

    @classmethod
    def of(cls, block, hessian, gradient, shared):
        """From the views' block and the normal equations of all blocks."""
        z, J = whiten(block)
        transposed = np.swapaxes(J, -1, -2)
        other = hessian - transposed @ J, gradient - (transposed @ z[..., None])[..., 0]
        single = replace(block, sigma_pitch=0.0)
        z, J = whiten(single)
        transposed = np.swapaxes(J, -1, -2)
        g = block.white_by_pitch[0]
        # (p, stop, view): one at the views of a stop, in the row of the first of them
        first = np.argmax(block.same, axis=1)[:, None] == np.arange(g.shape[1])[None, :, None]
        stop = (block.same & first).astype(float)
        rows = g.shape[:2] + (6, -1)
        return cls(
            *other,
            hessian=transposed @ J,
            gradient=(transposed @ z[..., None])[..., 0],
            square=np.sum(z**2, axis=-1),
            by_stop=stop @ np.sum(g[..., None] * J.reshape(rows), axis=2),
            along=(stop @ np.sum(g[..., None] * z.reshape(rows), axis=2))[..., 0],
            strength=(stop @ np.vecdot(g, g)[..., None])[..., 0],
            rows=6 * int(np.trace(block.same, axis1=1, axis2=2).sum()),
            shared=shared,
        )

    def judged(self, variance, factor):
        """Negative log likelihood of an error of the pitch and a factor on the scale; a better
        factor.

        `variance` is that of the pitch at the scale that the views are whitened with (a factor
        serves both). One row more is believed to be as large as the factor says: where nothing else
        shows the scale, it stays as it is.
        """
        f2 = factor**2
        c = self.shared
        less = variance / (1 + variance * self.strength)
        weighted = np.swapaxes(self.by_stop * less[..., None], -1, -2)
        hessian = self.hessian - weighted @ self.by_stop
        gradient = self.gradient - (weighted @ self.along[..., None])[..., 0]
        square = self.square - np.sum(less * self.along**2, axis=-1)
        whole = self.other_hessian + hessian / f2
        right = self.other_gradient + gradient / f2
        size = np.trace(whole, axis1=1, axis2=2)[:, None, None]
        whole = whole + 1e-12 * size * np.eye(whole.shape[-1])
        reduced, score, back = eliminate(whole, right, c, rcond=None)
        total = np.sum(reduced, axis=0)
        inverse = np.linalg.inv(total)
        step = -inverse @ np.sum(score, axis=0)
        own = -(back[..., c] + back[..., :c] @ step)
        moved = np.concatenate([np.broadcast_to(step, (len(own), c)), own], axis=-1)
        bent = (hessian @ moved[..., None])[..., 0]
        left = square + 2 * np.vecdot(moved, gradient) + np.vecdot(moved, bent)
        # share of the views in what is known of the unknowns: rows that these take up
        inner = np.linalg.inv(whole[:, c:, c:])
        every = np.broadcast_to(np.eye(c), (len(own), c, c))
        spread = np.concatenate([every, -back[..., :c]], axis=1)
        taken = np.sum(inner * hessian[:, c:, c:]) + np.sum((spread @ inverse) * (hessian @ spread))
        weight = np.linalg.slogdet(whole[:, c:, c:])[1].sum() + np.linalg.slogdet(total)[1]
        cost = 0.5 * (
            np.sum(square) / f2
            + np.vecdot(moved, right).sum()
            + self.rows * np.log(f2)
            + np.log1p(variance * self.strength).sum()
            + weight
        )
        better = (np.sum(left) + f2) / (max(self.rows - taken / f2, 0.0) + 1)
        return cost, float(np.sqrt(better))


def side_level(sides, data, hessian, gradient):
    """Scale of the sides' deviations, Student's t, by expectation and maximisation.

    Student's t is a normal distribution whose precision varies from side to side; what is expected
    of it hangs on the whole expected square of a deviation. A side that the beams hardly show is as
    uncertain as the scale says, and must not pull it down. One side more is believed to deviate as
    is usual: where nothing shows the scale, that is it. `hessian` (p, k, k) and `gradient` (p, k)
    are of a placement's own unknowns, the sides last; shared ones are held.
    """
    edges = sides.shape[1]
    sigma2 = data.side_sigma**2
    shown = np.zeros(sides.shape, bool)
    place, beam = np.nonzero(data.beam["used"])
    shown[place, data.beam["edge"][place, beam]] = True
    prior = (SIDE_FREEDOM + 1) / (SIDE_FREEDOM * sigma2 + sides**2)  # as in `side_block`
    last = np.arange(hessian.shape[-1])[-edges:]
    weight = prior * sigma2
    for _ in range(SIDE_ROUNDS):
        whole = hessian.copy()
        right = gradient.copy()
        whole[:, last, last] += weight / sigma2 - prior
        right[:, last] += (weight / sigma2 - prior) * sides
        spread = np.linalg.pinv(whole, rcond=1e-13, hermitian=True)
        step = -(spread @ right[..., None])[..., 0]
        square = (sides + step[:, last]) ** 2 + spread[:, last, last]
        weight = (SIDE_FREEDOM + 1) / (SIDE_FREEDOM + square / sigma2)
        total = np.sum((weight * square)[shown]) + JointData.side_sigma**2
        sigma2 = np.clip(total / (shown.sum() + 1), 1e-4, 4.0)
    return float(np.sqrt(sigma2))


def same_levels(before, after):
    """Whether noise levels have settled within a few per cent."""
    ratios = [
        getattr(after, name) / getattr(before, name)
        for name in ("face_scale", "face_share", "beam_share")
    ]
    return bool(
        np.all(np.abs(np.log([*ratios, *(after.view_scale / before.view_scale)])) < SETTLED)
    )


def misfits(blocks, data, groups=("face", "view")):
    """Normalised mean squared residual of ranges and views of each placement.

    1 is what the noise explains, (p,).
    """
    total = np.zeros(len(data.middle))
    count = np.zeros(len(data.middle))
    for name in set(groups) & set(blocks):
        share, numbers = (data.face_share, 1) if name == "face" else (1.0, 6)
        total += np.sum(whiten(blocks[name], False)[0] ** 2, axis=1) / share
        count += numbers * getattr(data, name)["used"].sum(axis=1)
    return total / np.maximum(count - 6, 1)


def face_misses(state, data, boards, placement):
    """Median distance of face points from boards (n, 3, 4) of some placements (n,), metres,
    (n,).
    """
    x = face_points(state, data)[placement] - boards[:, None, :, 3]
    return medians(np.abs(np.sum(x * boards[:, None, :, 2], axis=-1)), data.face["used"][placement])


def view_misses(state, data):
    """Median distance of every board from where its images put it, metres, (p,).

    0 without images.
    """
    used = data.view["used"]
    if not used.any():
        return np.zeros(len(used))
    lone = Unknowns(len(state.cameras), len(data.lines), axis=False, poses=False, sensor=())
    shift = view_block(state, data, lone).residuals.reshape(used.shape + (6,))[..., 3:]
    return medians(np.linalg.norm(shift, axis=-1), used)


def joint_warnings(blocks, data, unknowns, found, names):
    """What is suspicious about a joint estimate with cameras of these names, in words.

    `blocks` hold derivatives by `TERMS` too, which `unknowns` name, whether they were estimated or
    not.
    """
    words = noise_words(blocks, data, names)
    turn, shift = (
        np.linalg.norm(found.sigma[:4].reshape(2, 2), axis=1) if unknowns.axis else (0.0, 0.0)
    )
    if turn >= WEAK_DIRECTION or shift >= WEAK_OFFSET:
        words.append(
            f"the tilt axis is weakly known ({np.degrees(turn):.2f} deg, {1000 * shift:.0f} mm): "
            "sweep over a larger "
            "pitch range, take images at more pitch angles, or state the platform with its accuracy"
        )
    held = [name for name in TERMS if name not in found.names]
    for name, square, value in score_tests(blocks, unknowns, held):
        least, what, factor, unit = TERMS[name]
        if square > ASKED and abs(value) > least:
            words.append(
                f"the data ask for {what}, about {factor * value:+.2f} {unit}, which was held at "
                "zero"
            )
    return tuple(words)


def noise_words(blocks, data, names):
    """Groups of observations that scatter more or less than stated."""
    groups = []
    if "face" in blocks:
        z = whiten(blocks["face"], False)[0][data.face["used"]] / np.sqrt(data.face_share)
        groups.append(("ranges", "face_sigma", z))
    for number, name in enumerate(names if "view" in blocks else ()):
        mine = data.view["used"] & (data.view["camera"] == number)
        # more views than placements: what a board's own pose takes up is minor
        if mine.sum() > len(data.middle):
            z = whiten(blocks["view"], False)[0].reshape(mine.shape + (6,))[mine]
            groups.append((f"poses of the board in camera '{name}'", "view_covariance", z))
    levels = [(what, field, np.sqrt(np.mean(z**2))) for what, field, z in groups]
    return [
        f"the {what} scatter {level:.2g} times what is stated ({field}): standard deviations of "
        "the result are off "
        "alike; noise='estimate' takes the level from the residuals"
        for what, field, level in levels
        if not NOISE_LIMITS[0] < level < NOISE_LIMITS[1]
    ]


def score_tests(blocks, unknowns, held):
    """Names, squared scores (standard deviations) of shared unknowns held at zero, and the values
    they would take.

    Each one is tested by itself, with all that was estimated free.
    """
    hessian, gradient, *_ = linearise(blocks.values(), None, 1.0, (-2, -1))
    whole, score = (
        np.sum(part, axis=0) for part in eliminate(hessian, gradient, unknowns.shared)[:2]
    )
    names = unknowns.names(range(unknowns.cameras))
    others = [i for i, name in enumerate(names) if name not in held]
    for name in held:
        free = [*others, names.index(name)]
        covariance = np.linalg.pinv(whole[np.ix_(free, free)], rcond=1e-14, hermitian=True)
        step = -(covariance @ score[free])[-1]
        yield name, float(step**2 / max(covariance[-1, -1], 1e-300)), float(step)
