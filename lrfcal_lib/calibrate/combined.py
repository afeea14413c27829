"""One answer for the outline of a board: all that is known of a placement, each weighted by
what it is worth.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.linalg import block_diag

from lrfcal_lib.calibrate.joint_observations import observe_joint
from lrfcal_lib.calibrate.observe import sides_in_cloud
from lrfcal_lib.calibrate.outline import (
    MeasuredBoard,
    bounded,
    measure_board,
    moved_lines,
    plane_frame,
)
from lrfcal_lib.calibrate.pipeline import JointCalibration
from lrfcal_lib.fit.covariance import inverse_root
from lrfcal_lib.fit.least_squares import Block, linearise, minimise
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.geometry import DegenerateGeometry, move_pose
from lrfcal_lib.preprocess.edges_in_image import ImageEdge
from lrfcal_lib.preprocess.pose_from_lines import line_misses
from lrfcal_lib.solvers.joint_model import (
    JointData,
    JointState,
    Unknowns,
    gather,
    undisturbed,
)
from lrfcal_lib.solvers.joint_residuals import named_blocks, view_block

FEWEST_CELLS = 8  # beams about a side that no image shows
# information roots of a side of which nothing is known: ten metres and a radian are far
FAR = (10.0, 1.0)
# information roots of what moves board and sides together, which changes no length
STILL = 1e5
# metres along a side about its middle; any two places are worth the same, because their errors
# are those of one line
PLACES = np.array([-0.1, 0.1])
SCALE_ROUNDS = 4  # of weighing image edges by how well they fit
# of their stated errors, which hold a systematic one of a tenth of a pixel: sharp images of a
# straight rim have next to none
LEAST_SCALE = 0.02
UNKNOWN = 1e6  # variance of what nothing determines
KNOWN = 1e-18  # variance of what is held
# share of its length by which an edge may be uncertain and still count as measured
WIDEST = 0.1
NO_SIDE = np.array(-1)  # number of the side of what is about none
ITERATIONS = 30
TOLERANCE = 0.02  # sigma


class ImageSides(NamedTuple):
    """Sides of the board in an image: the row of the image's view, numbers (n,) of the sides, their
    edges and the lens.
    """

    row: int
    numbers: np.ndarray
    edges: tuple[ImageEdge, ...]
    model: CameraModel


class State(NamedTuple):
    """What moves: the joint state, the lines (E, 3) of all sides, the change of the
    calibration (c,).
    """

    joint: JointState
    lines: np.ndarray
    change: np.ndarray


@dataclass(frozen=True)
class Case:
    """What one placement says, and a start.

    Attributes
    ----------
    data, unknowns : JointData, Unknowns
        Of this placement alone.
    whitener : ndarray, shape (c, c)
        Of the calibration that has not seen the placement.
    images : list of ImageSides
    middle : ndarray, shape (E, 2)
        Points of the sides about which they turn, metres.
    edges : tuple of str
        All of the board.
    start : State
    """

    data: JointData
    unknowns: Unknowns
    whitener: np.ndarray
    images: list[ImageSides]
    middle: np.ndarray
    edges: tuple[str, ...]
    start: State


def combined_outlines(
    joint: JointCalibration,
) -> dict[int, tuple[MeasuredBoard, frozenset[str]]]:
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
        span no plane are missing.
    """
    prepared = joint.prepared
    views = {
        camera: list(of_camera.values()) for camera, of_camera in prepared.views.items()
    }
    observations = observe_joint(prepared, views)
    cases = {}
    for placement in observations.placements.tolist():
        with suppress(DegenerateGeometry, np.linalg.LinAlgError):
            cases[placement] = case_of(joint, observations, placement)
    scale = 1.0
    for _ in range(SCALE_ROUNDS + 1):
        measured: dict = {}
        square = 0.0
        freedom = 0.0
        for placement, case in list(cases.items()):
            try:
                state, covariance = fitted(case, scale)
                measured[placement] = _measured(case, state, covariance)
            except (DegenerateGeometry, np.linalg.LinAlgError):
                # what is left open, as by single scans, has no answer
                del cases[placement]
                continue
            cases[placement] = replace(case, start=state)
            for block in image_blocks(state, case, scale):
                J = block.jacobian
                square += np.sum(block.residuals**2)
                freedom += np.sum(1 - np.vecdot(J @ covariance, J))
        if freedom > 0:
            scale = max(scale * np.sqrt(square / freedom), LEAST_SCALE)
    return as_scattered(measured)


def as_scattered(
    measured: dict[int, tuple[MeasuredBoard, frozenset[str]]],
) -> dict[int, tuple[MeasuredBoard, frozenset[str]]]:
    """Boards (see :func:`combined_outlines`), as well known as their lengths agree over placements.

    Errors that all images of a side share (paint, a rim, a pattern close by), or all beams about
    it, show in no residual of its placement. But it is one board everywhere, whatever its size.
    """
    lengths = pd.DataFrame([board.lengths for board, _ in measured.values()])
    weights = pd.DataFrame([board.sigma for board, _ in measured.values()]) ** -2
    off = lengths - (weights * lengths).sum() / weights.sum()
    square = (weights * off**2).sum().sum()
    freedom = (lengths.count() - 1).sum()
    grow = np.sqrt(max(square / max(freedom, 1), 1.0))
    grown = {}
    for placement, (board, scanned) in measured.items():
        sigma = {name: grow * value for name, value in board.sigma.items()}
        grown[placement] = (replace(board, sigma=sigma), scanned)
    return grown


def case_of(joint, observations, placement):
    """A placement as a Case.

    DegenerateGeometry if its face spans no plane.
    """
    prepared = joint.prepared
    solution = joint.without.get(placement, joint.solution)
    edges = prepared.board.edges
    # where a sweep begins and ends may be where a cloud was cut
    face, along, _ = sides_in_cloud(
        prepared, placement, "half_step", solution.T_head_lrf, solution.corrections
    )
    obs = observations.with_cameras(solution.observations.cameras).select([placement])
    images, in_images = sides_in_images(prepared, solution, obs, plane_frame(face))
    sides = along | in_images
    rough = measure_board(face, sides, edges)
    board = rough.T_platform_plane
    lines = np.where(np.isnan(rough.lines), [1.0, 0.0, -1.0], rough.lines)
    lines *= -np.copysign(1.0, lines[:, 2:])  # outwards: the face is in the middle
    obs = obs.keep(beam=np.isin(obs.beam_edge, [edges.index(name) for name in sides]))
    moving = solution.state
    state = undisturbed(obs, moving.head, moving.cameras, moving.sensor, board[None])
    covariance = solution.solution.trusted
    known = np.isfinite(covariance)
    spread = np.where(np.diag(known), KNOWN, UNKNOWN)
    whitener = inverse_root(np.where(known, covariance, 0.0) + np.diag(spread))
    return Case(
        data=gather(obs, replace(solution.data.levels, prior=None)),
        unknowns=solution.unknowns,
        whitener=whitener,
        images=images,
        middle=-lines[:, 2:] * lines[:, :2],
        edges=edges,
        start=State(state, lines, np.zeros(len(whitener))),
    )


def sides_in_images(prepared, solution, obs, plane):
    """The ImageSides of a placement, and where lines of sight of their edges meet a plane (3, 4),
    under a JointSolution: points (k, 3) by edge, platform frame, metres.
    """
    (placement,) = obs.placements.tolist()
    names = prepared.board.edges
    normal = plane[:, 2]
    images = []
    sides: dict = {}
    for row, number in enumerate(obs.view_camera):
        camera = obs.cameras[number]
        edges = prepared.views[camera][placement].edges
        if not edges:
            continue
        model = prepared.models[camera]
        numbers = np.array([names.index(edge.name) for edge in edges])
        images.append(ImageSides(row, numbers, edges, model))
        pitch = solution.corrections.pitch(placement, obs.view_pitch[row])
        T_platform_camera = solution.camera_at(camera, pitch).inv()
        centre = T_platform_camera.translation
        for edge in edges:
            sight = T_platform_camera.rotation.apply(model.sights(edge.ends))
            reach = (plane[:, 3] - centre) @ normal / (sight @ normal)
            points = centre + reach[:, None] * sight
            sides.setdefault(edge.name, []).append(points)
    return images, {name: np.concatenate(points) for name, points in sides.items()}


def moved(case, state, step):
    """Everything a step on; the last two numbers of each side are its own."""
    joint, lines = np.split(step, [case.unknowns.size], axis=1)
    return State(
        case.unknowns.move(state.joint, joint),
        moved_lines(state.lines, case.middle, lines.reshape(-1, 2)),
        state.change + joint[0, : case.unknowns.shared],
    )


def fitted(case, scale):
    """The most likely State and the covariance of all unknowns."""
    evaluate = partial(blocks_of, case=case, scale=scale)
    state = minimise(
        evaluate,
        case.start,
        partial(moved, case),
        shared=case.unknowns.shared,
        max_iterations=ITERATIONS,
        tolerance=TOLERANCE,
    ).state
    return state, np.linalg.inv(linearise(list(evaluate(state))).hessian[0])


def blocks_of(state, case, scale):
    """All that is known of a placement, each a Block (1, n, width)."""
    unknowns = case.unknowns
    data = replace(case.data, lines=state.lines)
    named = named_blocks(state.joint, data, unknowns)
    # no view and nothing that is usual: image edges and the calibration say it
    about = {"face": NO_SIDE, "beam": data.beam["edge"], "sweep": NO_SIDE, "side": NO_SIDE}
    for name, edge in about.items():
        if name in named:
            block = named[name]
            yield replace(block, jacobian=with_sides(block.jacobian, edge, state, case))
    yield from image_blocks(state, case, scale)
    board = state.joint.boards[0]
    known = block_diag(
        case.whitener,
        STILL * board[None, :, 2],  # turn of board and sides together
        STILL * board[:, :2].T,  # their shift
        np.zeros((0, unknowns.size - unknowns.columns["board"].stop)),
        np.diag(np.tile(FAR, len(case.middle))),
    )
    off = np.zeros(len(known))
    off[: unknowns.shared] = case.whitener @ state.change
    yield _rows(off, known)


def _rows(residuals, jacobian):
    """White residuals (n,) and their Jacobian (n, c), a Block of one placement."""
    return Block(residuals[None], jacobian[None])


def with_sides(J, edge, state, case):
    """Derivatives (..., k), and by shifts outwards and turns of the sides (..., k + 2 E), from
    those by the board that holds them.

    `J` are rows about the side numbers `edge` (...).
    """
    R = state.joint.boards[0, :, :3]
    outward = state.lines[:, :2] @ R[:, :2].T
    arm = case.middle @ R[:, :2].T
    turn, shift = np.split(J[..., case.unknowns.columns["board"]], 2, axis=-1)
    # by motions of the board that take a side along
    by_turn = turn @ R[:, 2:] + shift @ np.cross(arm, R[:, 2]).T
    by_side = np.stack([shift @ outward.T, by_turn], axis=-1)
    mine = edge[..., None] == np.arange(len(arm))
    of_sides = (by_side * mine[..., None]).reshape(*J.shape[:-1], -1)
    return np.concatenate([J, of_sides], axis=-1)


def image_blocks(state, case, scale):
    """Distances (undistorted pixels) of two points of each side from the line in which an image
    shows it, whitened: a Block for each image.
    """
    view = case.data.view
    off = view_block(state.joint, case.data, case.unknowns).residuals
    poses = move_pose(view["pose"][..., :3, :], off.reshape(1, -1, 6))
    # with the poses as they are predicted: derivatives of [w, v] of every T_camera_board
    data = replace(case.data, view=view | {"pose": poses})
    J = view_block(state.joint, data, case.unknowns).jacobian
    by_all = J.reshape(-1, 6, J.shape[-1])
    for image in case.images:
        a, b, c = state.lines[image.numbers].T[..., None]
        x = -c * a - b * PLACES
        y = -c * b + a * PLACES
        places = np.stack([x, y, np.zeros_like(x)], axis=-1)
        misses, by_pose = line_misses(image.edges, places, image.model, poses[0, image.row])
        J = by_pose @ by_all[image.row]
        jacobian = with_sides(J, image.numbers[:, None], state, case)
        yield _rows(misses.ravel() / scale, np.concatenate(jacobian) / scale)


def _measured(case, state, covariance):
    """A state in words of :func:`combined_outlines`: sides with image edges or beams enough,
    lengths known somehow.
    """
    edges = case.edges
    beam = case.data.beam
    beams = np.bincount(beam["edge"][beam["used"]], minlength=len(edges))
    shown = np.isin(
        np.arange(len(edges)), [n for image in case.images for n in image.numbers]
    )
    scanned = (beams >= FEWEST_CELLS) & ~shown
    good = scanned | shown
    lines = np.where(good[:, None], state.lines, np.nan)
    of_sides = covariance[-2 * len(edges) :, -2 * len(edges) :]
    board = bounded(state.joint.boards[0], edges, lines, case.middle, of_sides)
    sizes = board.lengths
    sigma = {name: s for name, s in board.sigma.items() if s < WIDEST * sizes[name]}
    lengths = {name: sizes[name] for name in sigma}
    board = replace(board, lengths=lengths, sigma=sigma)
    return board, frozenset(compress(edges, scanned))
