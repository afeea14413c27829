"""Placements and images that contradict all others: found, named and left out.

By equations (4) to (6) and (16); a board lies where the images and where the scans put it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from lrfcal_lib.fit.least_squares import Block
from lrfcal_lib.fit.padding import medians
from lrfcal_lib.model.geometry import POSE, DegenerateGeometry
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.model.problem import Problem, ProblemKind, Stage
from lrfcal_lib.solvers.joint_model import JointData, JointState
from lrfcal_lib.solvers.joint_residuals import face_heights
from lrfcal_lib.solvers.joint_start import boards_in_images

CONTRADICTS = ProblemKind.CONTRADICTS
LARGEST_SHARE = 0.3  # of the placements that may contradict the others
LAST_MISS = 0.025  # metres, of a board from where images of it put it
MOST_SIGMA = 4.0  # by which images may put a board elsewhere, of what is stated of them
FAR_MISS = 5.0  # times the usual miss: an image puts the board elsewhere


def of_placement(number, kind, why):
    """The Problem of a placement."""
    return Problem(Stage.JOINT, kind, f"{why}; left out", placement=int(number))


def left_out_share(obs: JointObservations, left_out: list[Problem]) -> float:
    """The larger share of the placements, and of the images of the others, that are left out."""
    placements = sum(one.camera is None for one in left_out)
    images = len(left_out) - placements
    return max(placements / len(obs.placements), images / max(len(obs.view_camera), 1))


def without_blind_cameras(obs, required):
    """Leave out cameras that never see a board; refuse them where everything is required."""
    why = "it never sees the board, its pose stays open"
    blind = np.delete(obs.cameras, obs.view_camera).tolist()
    left_out = [
        Problem(Stage.JOINT, ProblemKind.NO_IMAGES, why, camera=camera) for camera in blind
    ]
    if required and left_out:
        words = "; ".join(map(str, left_out))
        raise DegenerateGeometry(f"{words}; leave it out with obs.with_cameras")
    return obs.with_cameras(np.setdiff1d(obs.cameras, blind)), left_out


def without_lost_placements(obs):
    """Leave out placements that no image shows: nothing says where their board is at the start."""
    lost = np.delete(obs.placements, obs.view_placement)
    why = "no image shows the board"
    left_out = [of_placement(number, ProblemKind.TOO_LITTLE, why) for number in lost]
    if not len(obs.view_placement):
        raise DegenerateGeometry("; ".join(map(str, left_out)))
    return obs.select(np.setdiff1d(obs.placements, lost)), left_out


def refuse_contradiction(
    obs: JointObservations, state: JointState, most: float, left_out: Sequence[Problem] = ()
) -> None:
    """Raise DegenerateGeometry where images put the boards of a third of the placements more than
    `most` metres (and `MOST_SIGMA` of what is stated of the images) off where they are.

    Placements that were left out for that already count with them.
    """
    place = obs.view_placement
    if not len(place):
        return
    boards = boards_in_images(obs, state.head, state.cameras)
    misses = np.linalg.norm(boards[..., 3] - state.boards[place, :, 3], axis=1)
    stated = np.sqrt(np.linalg.trace(obs.view_covariance[:, 3:, 3:]))
    before = sum(p.kind == CONTRADICTS and p.camera is None for p in left_out)
    shown = np.unique(place)
    limit = np.maximum(most, MOST_SIGMA * ndimage.median(stated, place, shown))
    wrong = np.sum(ndimage.median(misses, place, shown) > limit)
    every = len(shown) + before
    if wrong and 3 * (wrong + before) > every:
        raise DegenerateGeometry(
            f"images and scans contradict each other: for {wrong + before} of {every} placements "
            f"the board lies more than {1000 * most:.0f} mm off where the images put it; check "
            "that images and scans carry the right numbers"
        )


def face_miss(state: JointState, data: JointData) -> float:
    """By how much a state puts the scanned points off their boards, metres (median)."""
    heights = face_heights(state, data, state.boards)
    return float(np.median(medians(np.abs(heights), data.face["used"])))


def without_contradictions(obs, state, data):
    """Leave out images that put the board far off where it was scanned, and placements of which
    none is left. Every placement has one.
    """
    place = obs.view_placement
    boards = boards_in_images(obs, state.head, state.cameras)
    heights = face_heights(state, data, boards, place)
    misses = medians(np.abs(heights), data.face["used"][place])
    wrong = misses > max(LAST_MISS, FAR_MISS * np.median(misses))
    good, first = np.unique(place[~wrong], return_index=True)
    out = np.setdiff1d(place, good)
    single = wrong & np.isin(place, good)
    left_out = []
    for row in out:
        miss = 1000 * misses[place == row].min()
        why = f"the scan is {miss:.0f} mm off where its image puts the board"
        left_out.append(of_placement(obs.placements[row], CONTRADICTS, why))
    for view in np.flatnonzero(single):
        number = int(obs.placements[place[view]])
        camera = obs.cameras[obs.view_camera[view]]
        words = (
            f"image of '{camera}' at {np.degrees(obs.view_pitch[view]):.1f} deg: it puts the board "
            f"{1000 * misses[view]:.0f} mm off the scan; the image is left out"
        )
        left_out.append(Problem(Stage.JOINT, CONTRADICTS, words, number, camera))
    rest = obs.keep(view=~single).select(obs.placements[good])
    return rest, replace(state.of_placements(good), boards=boards[~wrong][first]), left_out


def misfits(blocks: dict[str, Block], data: JointData) -> np.ndarray:
    """Normalised mean squared residual of ranges and views of each placement.

    1 is what the noise explains, (p,).
    """
    count = data.face["used"].sum(axis=1) + POSE * data.view["used"].sum(axis=1)
    shares = {"face": data.levels.face_share, "view": 1.0}
    squares = [
        np.sum(blocks[name].white ** 2, axis=1) / share
        for name, share in shares.items()
        if name in blocks
    ]
    return sum(squares) / np.maximum(count - POSE, 1)
