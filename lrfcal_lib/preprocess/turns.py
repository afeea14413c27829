"""Boards that look the same when turned: one turn for all images of a placement."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import Chessboard
from lrfcal_lib.model.geometry import carry

# weight of the turn between two cameras where few placements tell: most look the same way, head up
UPRIGHT = 0.05
# a board frame whose z points into the board is believed when the other explains less than this
# share
CLEARLY = 0.95


def turned_boards(pattern: Chessboard, orders: np.ndarray) -> RigidTransform:
    """Turns of a board about the middle of its pattern that exchange its corners.

    Parameters
    ----------
    pattern : Chessboard
    orders : ndarray of int, shape (n, k)
        See :func:`lrfcal_lib.preprocess.pattern_in_image.pattern_orders`.

    Returns
    -------
    RigidTransform
        A stack of n, board frame.
    """
    points = pattern.points()
    middle = points.mean(axis=0)
    offsets = points - middle
    turns = [Rotation.align_vectors(offsets[order], offsets)[0] for order in orders]
    return carry(Rotation.concatenate(turns), middle, middle)


def alike(rotations, views) -> tuple[list[int], list[np.ndarray]]:
    """Which orders of a pattern's corners belong together in the images of one placement.

    Between two images of one camera the head turns by less than any two orders differ. How a camera
    is turned against another is the same at all placements, which is true for one choice of the
    orders only.

    Parameters
    ----------
    rotations : sequence of Rotation
        From the board to the camera, by image (m) a stack for every order that the corners may have
        (n).
    views : sequence of BoardView
        By image; one of no placement stands alone.

    Returns
    -------
    leader : list of int
        By image (m), the first one of the same placement.
    order : list of ndarray of int, shape (n,)
        By image (m), the order in it that goes with each order in the leader.
    """
    placements = [view.placement for view in views]
    leader = [i if p < 0 else placements.index(p) for i, p in enumerate(placements)]
    # by camera and placement, of the first image
    first: dict[str, dict] = {view.camera: {} for view in views}
    for rotation, view in zip(rotations, views, strict=True):
        if view.placement >= 0:
            first[view.camera].setdefault(view.placement, rotation)
    turn_of_camera = {
        camera: _between(first[views[0].camera], of_camera)
        for camera, of_camera in first.items()
    }
    order = []
    for i, j in enumerate(leader):
        turn = turn_of_camera[views[i].camera] * turn_of_camera[views[j].camera].inv()
        off = [(rotations[i] * ahead.inv()).magnitude() for ahead in turn * rotations[j]]
        order.append(np.argmin(off, axis=1))
    return leader, order


def _between(base, other):
    """Rotation from the first camera to another on which most placements agree.

    `base` and `other` are the rotations of their first images by placement.
    """
    common = sorted(base.keys() & other.keys())
    if other is base or not common:
        return Rotation.identity()
    # every order in the one image that might go with the first order in the other
    possible = [other[p] * base[p][0].inv() for p in common]
    candidates = Rotation.concatenate(possible)
    cost = UPRIGHT * candidates.magnitude()
    for turns in possible:
        cost += [(turns * candidate.inv()).magnitude().min() for candidate in candidates]
    return candidates[np.argmin(cost)]


def decide(scores: np.ndarray, leader: np.ndarray) -> np.ndarray:
    """One order for all images of a placement.

    Parameters
    ----------
    scores : ndarray, shape (m, n)
        How well each order explains each image, those that belong together in one column; orders
        of a mirrored board frame are the second half.
    leader : sequence of int, length m
        See :func:`alike`.

    Returns
    -------
    ndarray of int, shape (m,)
        The columns chosen.
    """
    total = np.zeros(scores.shape)
    np.add.at(total, leader, scores)
    halves = total.reshape(len(total), 2, -1)
    usual, mirrored = halves.max(axis=2).sum(axis=0)
    half = int(mirrored >= CLEARLY * usual)
    best = half * halves.shape[2] + halves[:, half].argmax(axis=1)
    return best[leader]
