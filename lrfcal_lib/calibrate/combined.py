"""One answer for the outline of a board: all that is known of a placement, each weighted by
what it is worth.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lrfcal_lib.calibrate import outline
from lrfcal_lib.calibrate.observe import observe_joint
from lrfcal_lib.fit.least_squares import Block, linearise, minimise, whiten
from lrfcal_lib.model import geometry
from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.preprocess.board_in_image import line_misses
from lrfcal_lib.solvers import joint_model, joint_residuals

STILL = 1e5  # information roots of what moves board and sides together, which changes no length
SCALE_ROUNDS = 4  # of weighing image edges by how well they fit
LEAST_SCALE = 0.1
UNKNOWN = 1e6  # variance of what nothing determines
WIDEST = 0.1  # share of its length by which an edge may be uncertain and still count as measured


@dataclass(frozen=True)
class Case:
    """What one placement says: padded observations, image edges as pairs (row of the view, edge,
    model), and a start.

    `whitener` (c, c) is of the calibration that has not seen the placement; `middle` (E, 2) are
    points of the sides about which they turn, `reach` (m, 2) where along its side each image edge
    begins and ends, metres.
    """

    data: joint_model.JointData
    unknowns: joint_model.Unknowns
    whitener: np.ndarray
    images: list
    reach: np.ndarray
    middle: np.ndarray
    start: tuple


def combined_outlines(joint):
    """Measure the boards of all placements by face, beams about the edges and image edges, none
    knowing their size.

    Plane, sides, errors of the sweep's pitch and a correction of the calibration are estimated
    together for each placement; the calibration that has not seen it counts as an observation with
    its own covariance. What image edges are worth is taken from their residuals over all
    placements; what residuals cannot show, from the scatter of the lengths.

    Parameters
    ----------
    joint : JointCalibration
        With its estimates without each placement.

    Returns
    -------
    dict of int to (MeasuredBoard, frozenset of str)
        By placement, with standard deviations, and the sides that no image shows; placements that
        span no plane or show no edge are missing.
    """
    views = {camera: list(found.values()) for camera, found in joint.prepared.views.items()}
    observations = observe_joint(joint.prepared, views)
    cases = {}
    scale = 1.0
    for placement in observations.placements.tolist():
        try:
            cases[placement] = case_of(joint, observations, placement)
        except DegenerateGeometry:
            continue
    found = {placement: case.start for placement, case in cases.items()}
    measured = {}
    for last in [False] * SCALE_ROUNDS + [True]:
        total = np.zeros(2)
        for placement, case in list(cases.items()):
            try:
                found[placement], covariance = fitted(case, found[placement], scale)
                if last:
                    measured[placement] = _measured(
                        case, found[placement], covariance, joint.prepared.board.edges
                    )
            # what is left open, as by single scans, has no answer
            except (DegenerateGeometry, np.linalg.LinAlgError):
                del cases[placement]
                continue
            if case.images:
                r, J = whiten(sight_block(found[placement], case, scale))
                total += np.sum(r**2), np.sum(1 - np.sum((J @ covariance) * J, axis=-1))
        scale = max(scale * np.sqrt(total[0] / total[1]) if total[1] > 0 else 1.0, LEAST_SCALE)
    return as_scattered(measured)


def as_scattered(measured):
    """Boards (see :func:`combined_outlines`), as well known as their lengths agree over placements.

    Errors that all images of a side share (paint, a rim, a pattern close by), or all beams about
    it, show in no residual of its placement. But it is one board everywhere, whatever its size.
    """
    square = 0.0
    freedom = 0
    for name in {name for board, _ in measured.values() for name in board.lengths}:
        showing = [board for board, _ in measured.values() if name in board.lengths]
        length = np.array([board.lengths[name] for board in showing])
        sigma = np.array([board.sigma[name] for board in showing])
        mean = np.average(length, weights=sigma**-2)
        square += np.sum(((length - mean) / sigma) ** 2)
        freedom += len(showing) - 1
    grow = np.sqrt(max(square / freedom, 1.0)) if freedom > 0 else 1.0
    out = {}
    for placement, (board, scanned) in measured.items():
        sigma = {name: float(grow * value) for name, value in board.sigma.items()}
        out[placement] = replace(board, sigma=sigma), scanned
    return out


def case_of(joint, observations, placement):
    """A placement as a Case.

    DegenerateGeometry if its face spans no plane or nothing shows a side of it.
    """
    solution = joint.without.get(placement, joint.solution)
    prepared = joint.prepared
    obs = observations.with_cameras(solution.observations.cameras).select([placement])
    edges = prepared.board.edges
    face, sides = outline.edges_in_cloud(solution, prepared, placement)
    shown = set(sides)
    told = [edges.index(name) for name in sides]
    for side in outline.named_sides(prepared, placement, stretch=outline.LEAST_STRETCH):
        # where a sweep begins and ends may be where a cloud was cut
        if side.name not in shown and not side.across:
            told.append(edges.index(side.name))
            points = solution.corrections.points(side.edges.points[side.rows])
            pitch = solution.corrections.pitch(placement, side.edges.pitch[side.rows])
            sides[side.name] = geometry.lrf_to_platform(points, pitch, solution.T_head_lrf)
    rough = outline.measure_board(face, sides, edges)
    lines = np.array([rough.lines.get(name, [1.0, 0.0, -1.0]) for name in edges])
    lines *= -np.where(lines[:, 2:] > 0, 1.0, -1.0)  # outwards: the face is in the middle
    obs = obs.keep(beam=np.isin(obs.beam_edge, told))
    data = joint_model.gather(obs, replace(solution.data.levels, prior=None))
    own = {
        "boards": rough.T_platform_plane[None, :3],
        "sweeps": np.zeros((1, 2)),
        "sides": np.zeros((1, len(edges))),
    }
    state = replace(solution.state, **own)
    images = []
    seen = (prepared.views[c].get(placement) for c in obs.cameras)
    for row, view in enumerate(
        view for view in seen if view is not None and view.T_camera_board is not None
    ):
        model = prepared.models[view.camera]
        images += [(row, edges.index(edge.name), edge, model) for edge in view.edges]
    along = np.stack([-lines[:, 1], lines[:, 0]], axis=1)
    middle = -lines[:, 2:] * lines[:, :2]
    reach = np.zeros((len(images), 2))
    at = {
        name: (points - state.boards[0, :, 3]) @ state.boards[0, :, :2]
        for name, points in sides.items()
    }
    for k, (_, number, edge, _) in enumerate(images):
        reach[k] = np.quantile(at[edge.name] @ along[number], [0.0, 1.0])
    covariance = solution.solution.trusted
    known = np.isfinite(covariance)
    covariance = np.where(known, covariance, 0.0) + np.diag(
        np.where(np.diag(known), 1e-18, UNKNOWN)
    )
    variances, axes = np.linalg.eigh(covariance)
    whitener = axes.T / np.sqrt(np.maximum(variances, 1e-18))[:, None]
    return Case(
        data,
        solution.unknowns,
        whitener,
        images,
        reach,
        middle,
        (state, lines, np.zeros(len(covariance))),
    )


def moved(case, state, step):
    """Everything a step on; the last two numbers of each side are its own."""
    (found, lines, change) = state
    own = case.unknowns.own
    found = joint_model.move_state(found, (step[0], step[1][:, :own]), case.unknowns)
    return (
        found,
        outline.moved_lines(lines, case.middle, step[1][0, own:].reshape(-1, 2)),
        change + step[0],
    )


def fitted(case, start, scale):
    """The most likely state (joint state, lines, change of the calibration) and the covariance
    of all unknowns.
    """

    def evaluate(state):
        return blocks_of(state, case, scale)

    shared = case.unknowns.shared
    retract = partial(moved, case)
    state = minimise(evaluate, start, retract, shared=shared, max_iterations=30, tolerance=0.02)[0]
    return state, np.linalg.inv(linearise(evaluate(state), None, 1.0, (-2, -1))[0][0])


def blocks_of(state, case, scale):
    """All that is known of a placement, a list of Block (1, n, width)."""
    (found, lines, change) = state
    unknowns = case.unknowns
    count = len(case.middle)
    data = replace(case.data, lines=lines)
    width = unknowns.shared + unknowns.own + 2 * count
    blocks = [joint_residuals.face_block(found, data, unknowns)]
    if data.beam["used"].any():
        beams = joint_residuals.beam_block(found, data, unknowns)
        own = side_columns(beams.jacobian, data.beam["edge"], state, case)
        blocks.append(replace(beams, jacobian=np.concatenate([beams.jacobian, own], axis=-1)))
    if joint_model.SWEEPS[unknowns.sweep]:
        blocks.append(joint_residuals.sweep_block(found, data, unknowns))
    if unknowns.sides:
        blocks.append(joint_residuals.side_block(found, data, unknowns))
    if case.images:
        blocks.append(sight_block(state, case, scale))
    # board and sides together; sides of which nothing is known
    fixed = np.zeros((3 + 2 * count, width))
    board = found.boards[0]
    start = unknowns.columns["board"].start
    fixed[0, start : start + 3] = STILL * board[:, 2]
    fixed[1:3, start + 3 : start + 6] = STILL * board[:, :2].T
    fixed[3:, -2 * count :] = np.kron(np.eye(count), np.sqrt(outline.FAR))
    known = np.pad(case.whitener, [(0, 0), (0, width - len(change))])
    rows = ((case.whitener @ change, known), (np.zeros(len(fixed)), fixed))
    blocks += [Block(r[None], J[None], np.ones((1, len(r)))) for r, J in rows]
    full = (np.pad(b.jacobian, [(0, 0), (0, 0), (0, width - b.jacobian.shape[-1])]) for b in blocks)
    return [replace(block, jacobian=J) for block, J in zip(blocks, full, strict=True)]


def side_columns(J, edge, state, case):
    """Derivatives by shifts outwards and turns of the sides (..., 2 E), from those by the board
    that holds them.

    `J` (..., k) are rows about the side numbers `edge` (...).
    """
    board = state[0].boards[0]
    start = case.unknowns.columns["board"].start
    turn = J[..., start : start + 3]
    shift = J[..., start + 3 : start + 6]
    z = board[:, 2]
    outward, arm = (flat @ board[:, :2].T for flat in (state[1][:, :2], case.middle))
    spin = np.sum(turn * z - shift * geometry.cross(z, arm)[edge], axis=-1)
    both = np.stack([np.sum(shift * outward[edge], axis=-1), spin], axis=-1)
    mine = edge[..., None] == np.arange(len(arm))
    return (mine[..., None] * both[..., None, :]).reshape(*edge.shape, -1)


def sight_block(state, case, scale):
    """Distances (undistorted pixels) of two points of a side from the line in which an image
    shows it, whitened.
    """
    found, lines, _ = state
    view = case.data.view
    unknowns = case.unknowns
    off = joint_residuals.view_block(found, case.data, unknowns).residuals.reshape(1, -1, 6)
    here = np.concatenate(
        [geometry.move_pose(view["pose"][..., :3, :], off), view["pose"][..., 3:, :]], axis=-2
    )
    by_all = joint_residuals.view_block(
        found, replace(case.data, view=view | {"pose": here}), unknowns
    ).jacobian
    # of [w, v] of every T_camera_board
    by_all = by_all.reshape(-1, 6, by_all.shape[-1])
    out = []
    for (row, number, edge, model), reach in zip(case.images, case.reach, strict=True):
        line = lines[number]
        flat = -line[2] * line[:2] + reach[:, None] * np.array([-line[1], line[0]])
        off, by_pose = line_misses(
            [edge], np.pad(flat, ((0, 0), (0, 1)))[None], model, here[0, row, :3]
        )
        J = by_pose[0] @ by_all[row]
        out.append(
            (
                off[0] / scale,
                np.hstack([J, side_columns(J, np.full(2, number), state, case)]) / scale,
            )
        )
    r, J = (np.concatenate(part)[None] for part in zip(*out, strict=True))
    return Block(r, J, np.ones(r.shape))


def _measured(case, state, covariance, edges):
    """A state in words of :func:`combined_outlines`: sides with image edges or beams enough,
    lengths known somehow.
    """
    found, lines, _ = state
    beams = np.bincount(case.data.beam["edge"][case.data.beam["used"]], minlength=len(edges))
    shown = [number for _, number, _, _ in case.images]
    good = np.union1d(np.flatnonzero(beams >= outline.FEWEST_CELLS), shown).astype(int)
    if not len(good):
        raise DegenerateGeometry("nothing shows a side")
    index = (len(covariance) - 2 * len(edges) + 2 * good[:, None] + [0, 1]).ravel()
    names = [edges[i] for i in good]
    shape, sigma = outline.sized(
        lines[good], case.middle[good], covariance[np.ix_(index, index)], names, edges
    )
    known = {name for name, size in shape[2].items() if sigma[name] < WIDEST * size}
    lengths, sigma = (
        {name: v for name, v in part.items() if name in known} for part in (shape[2], sigma)
    )
    board = outline.MeasuredBoard(
        np.vstack([found.boards[0], [0, 0, 0, 1]]), *shape[:2], lengths, sigma=sigma
    )
    return board, frozenset(edges[i] for i in np.setdiff1d(good, shown))
