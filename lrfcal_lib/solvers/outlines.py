"""One board in several sweeps: a sensor's edge model from a known outline, or an unknown outline from an edge model.

Every sweep brings the place of the board within its plane and, for each side, what the log odds differ there because
backgrounds are not equally bright. Most differ little and some much, so the deviations have heavy tails.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.board import corners_of_lines, outline_lines
from lrfcal_lib.geometry import DegenerateGeometry
from lrfcal_lib.solvers.edge_likelihood import beam_terms, edge_shift, flip_sigma
from lrfcal_lib.solvers.least_squares import Block, minimise
from lrfcal_lib.solvers.observability import reduced_hessian
from lrfcal_lib.solvers.outline_ml import FEWEST_CELLS, LAPSE, face_surface, find_rays, start_lines

SPREAD = 0.2  # of the log odds from side to side, scale of a Cauchy distribution
GAUGE = np.array([0.1, 0.3])  # metres, radians: how far an outline may be from its start
UNKNOWN = 2.0  # standard deviation of log odds that nothing is known about: edges anywhere within the spot
WEAK = 1.0  # standard deviation of log odds from which on sweeps say nothing about them
ROUNDS = 4


@dataclass(frozen=True)
class _Sweeps:
    """Cells of several sweeps, padded to one length: leading axis p."""

    at: np.ndarray
    direction: np.ndarray
    edge: np.ndarray
    hit: np.ndarray
    radius: np.ndarray
    background: np.ndarray
    step: np.ndarray
    used: np.ndarray


def fit_edge_model(sweeps, board, model):
    """The edge model of a sensor from sweeps over a board whose outline is known.

    Parameters
    ----------
    sweeps : list of tuple
        ``(cells, face, names)`` of each placement, see :func:`lrfcal_lib.solvers.outline_ml.measure_outline`.
    board : Board
        With its outline.
    model : EdgeModel
        Start values; its range offset and platform are taken as they are.

    Returns
    -------
    EdgeModel
        With `log_odds`, their sigma, `softness` and `spread`.

    Raises
    ------
    DegenerateGeometry
        If the sweeps say nothing about the log odds: none shows enough sides for the board's size to tell.
    """
    fit = _fit(sweeps, outline_lines(board.known_corners()), board.edges, model, free=False)
    if not fit["log_odds_sigma"] < WEAK:
        raise DegenerateGeometry(f"{len(sweeps)} sweeps cross too few sides of the board to tell how large edges look")
    deviation = np.median(np.abs(fit["deviations"])) * 1.4826
    found = {"log_odds": fit["log_odds"], "log_odds_sigma": fit["log_odds_sigma"], "softness": fit["softness"]}
    return replace(model, **found, spread=max(float(deviation), SPREAD))


def measure_outlines(sweeps, start, edges, model):
    """Measure a board of unknown size that was put down several times.

    Parameters
    ----------
    sweeps : list of tuple
        As for :func:`fit_edge_model`.
    start : ndarray, shape (n, 2)
        Corners of a rough outline, such as one sweep gives (metres, right way round seen from the front).
    edges : tuple of str
    model : EdgeModel
        From other sweeps; its log odds and their sigma are taken as they are.

    Returns
    -------
    lengths, sigma : dict of str to float
        Of all edges, metres.

    Raises
    ------
    DegenerateGeometry
        If an edge is seen in no sweep.
    """
    fit = _fit(sweeps, outline_lines(start), edges, model, free=True)
    missing = [name for i, name in enumerate(edges) if i not in fit["seen"]]
    if missing:
        raise DegenerateGeometry(f"no sweep crosses {', '.join(missing)}: the outline stays open")
    sizes, J = _lengths(fit["lines"]), np.zeros((len(edges), 2 * len(edges)))
    for k, step in enumerate(1e-6 * np.eye(2 * len(edges))):
        J[:, k] = (_lengths(_move_lines(fit["lines"], step)) - sizes) / 1e-6
    sigma = np.sqrt(np.einsum("ij,jk,ik->i", J, fit["covariance"], J))
    return dict(zip(edges, sizes, strict=True)), dict(zip(edges, sigma, strict=True))


def _lengths(lines):
    corners = corners_of_lines(lines)
    return np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)


def _move_lines(lines, step):
    """Board lines shifted outwards (metres) and turned about their foot points (radians); step (2 n,)."""
    shift, turn = step.reshape(-1, 2).T
    c, s = np.cos(turn), np.sin(turn)
    normal = np.stack([c * lines[:, 0] - s * lines[:, 1], s * lines[:, 0] + c * lines[:, 1]], axis=1)
    foot = -lines[:, 2:] * lines[:, :2]
    return np.column_stack([normal, -np.sum(normal * foot, axis=1) - shift])


def _gather(sweeps, edges, model):
    """Rays of all sweeps in their faces' planes, and the start lines of each."""
    rays, starts = [], []
    for cells, face, names in sweeps:
        pose, bend = face_surface(face, model)
        found, sides = find_rays(cells, pose, bend, names, model)
        if sides:
            edge = np.array([edges.index(name) for name in sides])
            starts.append((edge, start_lines(found, len(sides))[0]))
            rays.append((found, edge[found.side]))
    if not rays:
        raise DegenerateGeometry(f"no side has {FEWEST_CELLS} beams about it in any of {len(sweeps)} sweeps")
    width = max(len(edge) for _, edge in rays)

    def pad(values, fill=0.0):
        return np.stack([np.concatenate([v, np.full((width - len(v),) + v.shape[1:], fill, v.dtype)]) for v in values])

    names = ("at", "direction", "hit", "radius", "background", "step")
    whole = {name: pad([getattr(found, name) for found, _ in rays], name in ("radius", "step")) for name in names}
    used = pad([np.ones(len(edge), bool) for _, edge in rays], False)
    return _Sweeps(edge=pad([edge for _, edge in rays], 0), used=used, **whole), starts


def _turns(starts, lines):
    """Complex turns from the sides of each sweep to those of the board: of length one where they agree."""
    normals = [(lines[edge, 0] + 1j * lines[edge, 1], found[:, 0] + 1j * found[:, 1]) for edge, found in starts]
    return np.array([np.mean(board * seen.conj()) for board, seen in normals])


def _seen_from_behind(data, starts, lines):
    """The sweeps turned over where the board's frame has its z axis away from the sensor."""
    over = [(edge, found * [1, -1, 1]) for edge, found in starts]
    if np.sum(np.abs(_turns(over, lines))) <= np.sum(np.abs(_turns(starts, lines))):
        return data, starts
    return replace(data, at=data.at * [1, -1], direction=data.direction * [1, -1, -1]), over


def _start_poses(starts, lines):
    """In-plane poses (p, 3): turn and shift from each sweep's plane to the board, from the lines of its sides."""
    poses = []
    for (edge, found), turn in zip(starts, np.angle(_turns(starts, lines)), strict=True):
        shift = np.linalg.lstsq(lines[edge, :2], found[:, 2] - lines[edge, 2], rcond=None)[0]
        poses.append(np.r_[turn, shift])
    return np.array(poses)


def _turned(pose, at):
    """Points (p, n, 2) turned by in-plane poses."""
    c, s = np.cos(pose[:, 0, None]), np.sin(pose[:, 0, None])
    return np.stack([c * at[..., 0] - s * at[..., 1], s * at[..., 0] + c * at[..., 1]], axis=-1)


def _factor(data, pose, lines):
    """Distance between ray and edge over that within the plane, shape (p, n)."""
    across = np.sum(lines[data.edge, :2] * _turned(pose, data.direction[..., :2]), axis=-1)
    return np.abs(data.direction[..., 2]) / np.maximum(np.hypot(data.direction[..., 2], across), 1e-12)


def _blocks(state, data, factor, softness, model, free):
    """Cells, deviations, and what is known beforehand, for one state (log odds, lines, poses, deviations)."""
    log_odds, lines, pose, deviation = state
    p, n, e = *data.edge.shape, len(lines)
    rows = np.arange(p)[:, None]
    turned, normal = _turned(pose, data.at), lines[data.edge, :2]
    outside = np.sum(normal * (turned + pose[:, None, 1:]), axis=-1) + lines[data.edge, 2]
    shift, slope = edge_shift(log_odds + deviation[rows, data.edge], data.radius, data.background)
    margin, sigma = shift - factor * outside, flip_sigma(softness, data.radius, data.step)[0]
    cost, score, information, _ = beam_terms(margin, sigma, data.hit, LAPSE)
    root = np.sqrt(np.maximum(information, 1e-4 / sigma**2)) * data.used
    quarter = np.stack([-turned[..., 1], turned[..., 0]], axis=-1)
    shared = 1 + 2 * e
    J = np.zeros((p, n, shared + 3 + e))
    J[..., 0] = slope
    if free:
        at = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
        k = 1 + 2 * data.edge[..., None]
        np.put_along_axis(J, k, factor[..., None], axis=-1)
        foot = -lines[data.edge, 2:] * normal
        lever = np.sum(at * (turned + pose[:, None, 1:] - foot), axis=-1)
        np.put_along_axis(J, k + 1, (-factor * lever)[..., None], axis=-1)
    J[..., shared] = -factor * np.sum(normal * quarter, axis=-1)
    J[..., shared + 1 : shared + 3] = -factor[..., None] * normal
    np.put_along_axis(J, shared + 3 + data.edge[..., None], slope[..., None], axis=-1)
    safe = np.where(root > 0, root, 1.0)
    cells = Block(score * data.used / safe, root[..., None] * J, np.ones((p, n)), cost=cost * data.used)
    return [cells, *_known(state, model, shared, free)]


def _known(state, model, shared, free):
    """Deviations are small as a rule; the log odds where a model tells them; the outline near its start."""
    log_odds, _, pose, deviation = state
    p, e = deviation.shape
    J = np.zeros((p, e, shared + 3 + e))
    J[..., shared + 3 :] = np.eye(e)
    blocks = [Block(deviation, J, np.full((p, e), 1 / SPREAD))]
    spread = max(model.log_odds_sigma, 1e-3) if free else UNKNOWN
    J = np.zeros((p, 1, shared + 3 + e))
    J[..., 0] = 1.0
    blocks.append(Block(np.full((p, 1), log_odds - model.log_odds), J, np.full((p, 1), 1 / spread / np.sqrt(p))))
    J = np.zeros((p, 2 * e, shared + 3 + e))
    J[..., 1:shared] = np.eye(2 * e)
    width = np.tile(GAUGE, e) if free else np.full(2 * e, 1e-6)
    weight = np.broadcast_to(1 / width / np.sqrt(p), (p, 2 * e))
    return [*blocks, Block(np.zeros((p, 2 * e)), J, weight)]


def _move(state, step, free):
    log_odds, lines, pose, deviation = state
    common, own = step
    lines = _move_lines(lines, common[1:]) if free else lines
    return (log_odds + common[0], lines, pose + own[:, :3], deviation + own[:, 3:])


def _fit(sweeps, lines, edges, model, free):
    """Alternate between the softness and all else."""
    data, starts = _seen_from_behind(*_gather(sweeps, tuple(edges), model), lines)
    pose = _start_poses(starts, lines)
    state = (model.log_odds, lines, pose, np.zeros((len(pose), len(edges))))
    softness = model.softness
    for k in range(ROUNDS):
        factor = _factor(data, state[2], state[1])
        softness = _softness(state, data, factor, model, free) if k and not free else softness

        def evaluate(s, factor=factor, softness=softness):
            return _blocks(s, data, factor, softness, model, free)

        state, *_ = minimise(evaluate, state, lambda s, d: _move(s, d, free), shared=1 + 2 * len(edges), loss="cauchy")
    hessian = np.sum([np.swapaxes(w, -1, -2) @ w for w in _weighted(evaluate(state))], axis=0)
    covariance = np.linalg.inv(np.sum(reduced_hessian(hessian, 1 + 2 * len(edges)), axis=0))
    seen = [set(edge) for edge, _ in starts]
    there = np.array([[e in found for e in range(len(edges))] for found in seen])
    return {
        "log_odds": float(state[0]), "log_odds_sigma": float(np.sqrt(covariance[0, 0])), "softness": float(softness),
        "lines": state[1], "covariance": covariance[1:, 1:], "deviations": state[3][there],
        "seen": set().union(*seen),
    }  # fmt: skip


def _weighted(blocks):
    """Whitened Jacobians; those of the deviations with the weights of their tails."""
    out = []
    for number, block in enumerate(blocks):
        z = block.whitener * block.residuals / 2.385
        root = block.whitener / np.sqrt(1 + z**2) if number == 1 else block.whitener
        out.append(root[..., None] * block.jacobian)
    return out


def _softness(state, data, factor, model, free):
    """The most likely softness at a state, spot radii."""
    grid = np.geomspace(0.02, 1.5, 24)
    return grid[np.argmin([np.sum(_blocks(state, data, factor, s, model, free)[0].cost) for s in grid])]
