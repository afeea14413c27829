"""Placements and images that contradict all others: found, named and left out."""

from dataclasses import replace

import numpy as np

from lrfcal_lib.fit.least_squares import Block
from lrfcal_lib.fit.padding import medians
from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.model.problem import Problem, ProblemKind, Stage
from lrfcal_lib.solvers.joint_model import JointData, JointState, Unknowns
from lrfcal_lib.solvers.joint_noise import face_points
from lrfcal_lib.solvers.joint_residuals import minimum, named_blocks, view_block
from lrfcal_lib.solvers.joint_start import FEWEST_ANGLE_POINTS, boards_in_images

CONTRADICTS = ProblemKind.CONTRADICTS
CONTRADICTION = 16.0  # mean squared residual, relative to the median placement's
LEAST_MISFIT = 1e-6  # of images: below, they agree exactly
LARGEST_SHARE = 0.3  # of the placements that may contradict the others
LAST_MISS = 0.025  # metres, of a board from where images of it put it
MOST_SIGMA = 4.0  # by which images may put a board elsewhere, of what is stated of them
FAR_MISS = 5.0  # times the usual miss: an image puts the board elsewhere
FEW_STEPS = 8  # of a minimisation that only has to show where it leads
BOARD = 6  # numbers of a pose


def of_placement(obs, row, kind, why):
    """The Problem of a placement (index)."""
    return Problem(
        Stage.JOINT, kind, f"{why}; left out", placement=int(obs.placements[row])
    )


def of_image(obs, row, why):
    """The Problem of a view (index)."""
    number = int(obs.placements[obs.view_placement[row]])
    camera = obs.cameras[obs.view_camera[row]]
    pitch = np.degrees(obs.view_pitch[row])
    words = f"image of '{camera}' at {pitch:.1f} deg: {why}; the image is left out"
    return Problem(Stage.JOINT, CONTRADICTS, words, placement=number, camera=camera)


def left_out_share(obs: JointObservations, left_out: list[Problem]) -> float:
    """The larger share of the placements, and of the images of the others, that are left out."""
    placements = sum(one.camera is None for one in left_out)
    images = len(left_out) - placements
    return max(placements / len(obs.placements), images / max(len(obs.view_camera), 1))


def without_blind_cameras(obs, required):
    """Leave out cameras that never see a board; refuse them where everything is required."""
    blind = [name for i, name in enumerate(obs.cameras) if not (obs.view_camera == i).any()]
    if not blind:
        return obs, []
    left_out = []
    for name in blind:
        words = "it never sees the board, its pose stays open"
        left_out.append(Problem(Stage.JOINT, ProblemKind.NO_IMAGES, words, camera=name))
    if required:
        words = "; ".join(map(str, left_out))
        raise DegenerateGeometry(f"{words}; leave it out with obs.with_cameras")
    return obs.with_cameras([name for name in obs.cameras if name not in blind]), left_out


def without_lost_placements(obs):
    """Leave out placements that no image shows and whose scans cross fewer than two edges."""
    count = np.zeros((len(obs.placements), len(obs.edges)), int)
    np.add.at(count, (obs.beam_placement[obs.beam_hit], obs.beam_edge[obs.beam_hit]), 1)
    crossed = np.sum(count >= FEWEST_ANGLE_POINTS, axis=1)
    lost = crossed < 2
    lost[obs.view_placement] = False
    left_out = []
    for row in np.flatnonzero(lost):
        why = f"no image shows the board and scans cross {crossed[row]} edges, two needed"
        left_out.append(of_placement(obs, row, ProblemKind.TOO_LITTLE, why))
    if lost.all():
        raise DegenerateGeometry("; ".join(map(str, left_out)))
    return obs.select(obs.placements[~lost]), left_out


def refuse_contradiction(
    state: JointState, data: JointData, most: float, left_out: list[Problem] | None = None
) -> None:
    """Raise DegenerateGeometry where a third of the placements contradict: images put their boards
    more than `most` metres (and `MOST_SIGMA` of what is stated of the images) off where they are,
    or they are left out already for that.
    """
    used = data.view["used"]
    shown = used.any(axis=1)
    if not shown.any():
        return
    lone = Unknowns(len(state.cameras), len(data.lines), axis=False, poses=False, sensor=())
    shift = view_block(state, data, lone).residuals.reshape(used.shape + (6,))[..., 3:]
    misses = medians(np.linalg.norm(shift, axis=-1), used)
    variance = np.trace(data.view["covariance"][..., 3:, 3:], axis1=-2, axis2=-1)
    stated = medians(np.sqrt(variance), used)
    gone = sum(one.kind is CONTRADICTS and one.camera is None for one in left_out or ())
    wrong = gone + np.sum(misses[shown] > np.maximum(most, MOST_SIGMA * stated[shown]))
    count = gone + np.sum(shown)
    if 3 * wrong > count:
        raise DegenerateGeometry(
            f"images and scans contradict each other: for {wrong} of {count} placements the board "
            f"lies more than {1000 * most:.0f} mm off where the images put it; check that images "
            "and scans carry the right numbers"
        )


def face_misses(state, data, boards, placement):
    """Median distance of face points from boards (n, 3, 4) of some placements (n,), metres,
    (n,).
    """
    x = face_points(state, data)[placement] - boards[:, None, :, 3]
    return medians(
        np.abs(np.vecdot(x, boards[:, None, :, 2])), data.face["used"][placement]
    )


def without(obs, state, views, placements):
    """Observations and state without some views and placements (by index)."""
    kept = np.delete(np.arange(len(obs.placements)), placements)
    rest = obs.keep(view=~np.isin(np.arange(len(obs.view_camera)), views))
    return rest.select(obs.placements[kept]), state.of_placements(kept)


def without_contradictions(obs, state, data):
    """Leave out images that put the board far off where it was scanned, and placements of which
    none is left.
    """
    place = obs.view_placement
    if len(place) == 0:
        return obs, state, []
    boards = boards_in_images(obs, state.head, state.cameras, np.arange(len(place)))
    misses = face_misses(state, data, boards, place)
    wrong = misses > max(LAST_MISS, FAR_MISS * np.median(misses))
    if not wrong.any():
        return obs, state, []
    good, first = np.unique(place[~wrong], return_index=True)
    out = np.setdiff1d(place, good)
    single = np.flatnonzero(wrong & np.isin(place, good))
    moved = state.boards.copy()
    moved[good] = boards[~wrong][first]
    left_out = []
    for row in out:
        miss = 1000 * misses[place == row].min()
        why = f"the scan is {miss:.0f} mm off where its image puts the board"
        left_out.append(of_placement(obs, row, CONTRADICTS, why))
    for view in single:
        why = f"it puts the board {1000 * misses[view]:.0f} mm off the scan"
        left_out.append(of_image(obs, view, why))
    return *without(obs, replace(state, boards=moved), single, out), left_out


def misfits(
    blocks: dict[str, Block], data: JointData, groups=("face", "view")
) -> np.ndarray:
    """Normalised mean squared residual of ranges and views of each placement.

    1 is what the noise explains, (p,).
    """
    total = np.zeros(len(data.middle))
    count = np.zeros(len(data.middle))
    if "face" in blocks and "face" in groups:
        total += np.sum(blocks["face"].white ** 2, axis=1) / data.levels.face_share
        count += data.face["used"].sum(axis=1)
    if "view" in blocks:
        total += np.sum(blocks["view"].white ** 2, axis=1)
        count += BOARD * data.view["used"].sum(axis=1)
    return total / np.maximum(count - BOARD, 1)


def contradictions(state, data, unknowns):
    """Misfits of placements, and of their images alone, shape (p, 2), and what is usual of both,
    shape (2,).

    A wrong image raises the noise level of all images until ranges outvote it: images are compared
    with images.
    """
    blocks = named_blocks(state, data, unknowns)
    several = data.view["used"].sum(axis=1) > 1
    of_all = misfits(blocks, data)
    of_images = misfits(blocks, data, ("view",))
    usual = np.median(of_images[several]) if several.any() else np.inf
    usual = np.array([max(np.median(of_all), 1.0), max(usual, LEAST_MISFIT)])
    return np.stack([of_all, of_images], axis=1), usual


def without_misfits(obs, state, data, unknowns):
    """Leave out placements whose residuals are far larger than the others', or the one image
    that makes them so.

    Returned are observations and state, and what was left out.
    """
    squares, usual = contradictions(state, data, unknowns)
    limits = CONTRADICTION * usual
    boards = state.boards.copy()
    views = []
    rows = []
    left_out = []
    for row in np.flatnonzero((squares > limits).any(axis=1)):
        view, board = wrong_image(obs, state, data, unknowns, row, limits)
        times = np.sqrt(np.max(squares[row] / usual))
        why = f"residuals are {times:.0f} times those of the others"
        if view is not None:
            boards[row] = board
            views.append(view)
            left_out.append(of_image(obs, view, f"with it {why}"))
        elif squares[row, 0] > limits[0]:
            rows.append(row)
            left_out.append(of_placement(obs, row, CONTRADICTS, f"its {why}"))
    if not left_out:
        return obs, state, []
    return *without(obs, replace(state, boards=boards), views, rows), left_out


def wrong_image(obs, state, data, unknowns, row, limits):
    """The view without which a placement (index) agrees with the others (None where there is
    none), and its board then.

    Every view is left out once, in copies of the placement, with all that the placements share
    held.
    """
    views = np.flatnonzero(obs.view_placement == row)
    if len(views) < 2:
        return None, None
    copies = np.full(len(views), row)
    boards = boards_in_images(obs, state.head, state.cameras, np.roll(views, -1))
    state = replace(state.of_placements(copies), boards=boards)
    view = {key: values[copies] for key, values in data.view.items()}
    each = np.arange(len(views))
    view["used"][each, each] = False
    view["whitener"][each, each] = 0.0
    data = replace(
        data,
        face={key: values[copies] for key, values in data.face.items()},
        beam={key: values[copies] for key, values in data.beam.items()},
        view=view,
        middle=data.middle[copies],
        direction=data.direction[copies],
    )
    lone = replace(unknowns, axis=False, sensor=(), poses=False)
    state = minimum(state, data, lone, steps=FEW_STEPS).state
    worst = np.max(contradictions(state, data, lone)[0] / limits, axis=1)
    best = int(np.argmin(worst))
    if worst[best] > 1:
        return None, None
    return views[best], state.boards[best]
