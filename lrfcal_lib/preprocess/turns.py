"""Which way round a chessboard is: decided once a placement, by all its images.

A chessboard looks the same when it is turned by half a turn, and on a board that does so too no image can tell. What
matters then is that all images of a placement say the same.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

UPRIGHT = 0.05  # weight of the turn between two cameras where few placements tell: most look the same way, head up
CLEARLY = 0.95  # a board frame whose z points into the board is believed when the other explains less than this share


def alike(rotations, placements, cameras):
    """Which orders of a pattern's corners belong together in the images of one placement.

    Parameters
    ----------
    rotations : sequence of m Rotation, n in each
        From the board to the camera, for every order that the corners may have; the same orders in all images.
    placements : sequence of m int
        Negative for an image of none, which stands alone.
    cameras : sequence of m str

    Returns
    -------
    first : ndarray of int, shape (m,)
        The first image of the same placement.
    partner : ndarray of int, shape (m, n)
        The order in the image that goes with each order in the first one.

    Notes
    -----
    Between two images of one camera the head turns by less than any two orders differ. How a camera is turned against
    another is the same at all placements, which is true for one choice of the orders only.
    """
    leader = {}
    first = np.array([leader.setdefault(p if p >= 0 else (i,), i) for i, p in enumerate(placements)], int)
    names = list(dict.fromkeys(cameras))
    turn = {c: _between(rotations, placements, cameras, names[0], c) for c in names}
    expected = [turn[cameras[i]] * turn[cameras[j]].inv() * rotations[j] for i, j in enumerate(first)]
    off = [[(r * e.inv()).magnitude() for e in ahead] for r, ahead in zip(rotations, expected, strict=True)]
    return first, np.argmin(off, axis=2) if off else np.zeros((0, 0), int)


def _between(rotations, placements, cameras, base, camera):
    """Rotation from one camera to another on which most placements agree."""
    seen = [{p: rotations[i] for i, p in reversed(list(enumerate(placements))) if cameras[i] == c and p >= 0} for c in
            (base, camera)]  # fmt: skip
    found = [seen[1][p] * seen[0][p][0].inv() for p in seen[0] if p in seen[1]]
    if base == camera or not found:
        return Rotation.identity()
    every = Rotation.concatenate(found)
    cost = [sum((f * q.inv()).magnitude().min() for f in found) + UPRIGHT * q.magnitude() for q in every]
    return every[int(np.argmin(cost))]


def decide(scores, first):
    """One order for all images of a placement.

    Parameters
    ----------
    scores : array_like, shape (m, n)
        How well each order explains each image, those that belong together in one column; orders of a mirrored board
        frame are the second half.
    first : ndarray of int, shape (m,)
        Of :func:`alike`.

    Returns
    -------
    ndarray of int, shape (m,)
    """
    if not len(scores):
        return np.zeros(0, int)
    total = np.zeros(np.shape(scores))
    np.add.at(total, first, scores)
    half = total.shape[1] // 2
    usual, mirrored = (part.max(axis=1).sum() for part in (total[:, :half], total[:, half:]))
    side = slice(0, half) if mirrored < CLEARLY * usual else slice(half, None)
    return (total[:, side].argmax(axis=1) + side.start)[first]
