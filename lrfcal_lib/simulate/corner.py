"""The corner of two plates that Wasielewski and Strauss look at, as drawn shots.

As in the simulation of Gomez-Ojeda and others (ICRA 2015), who use the edge where the plates meet,
and the outer edges only to tell which shots show the whole corner.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import UNIT_SQUARE, Board
from lrfcal_lib.model.camera import line_through, pinhole
from lrfcal_lib.model.geometry import (
    apply_pose,
    length_of,
    polar_to_points,
    pose_array,
)

# where the plates meet, through the origin of the target, and the plates' ways from there
EDGE = np.array([-0.5, -0.5, 0.70711])
PLATES = np.array([[-0.36237, 0.86237, 0.35355], [0.86237, -0.36237, 0.35355]])
T_TARGET_PLATES = RigidTransform.from_rotation(
    Rotation.from_matrix([np.transpose([x, EDGE, np.cross(x, EDGE)]) for x in PLATES])
)
SIZE = 1.5  # metres, of a plate away from the edge and along it to either side
# with the edge on y, and x from there
PLATE = Board("plate", (), SIZE * (UNIT_SQUARE * [1, 2] - [0, 1]))
FEWEST_POINTS = 2  # on a plate
LEAST_LENGTH = 15.0  # of an image line, pixels
SAMPLES = 601  # of an edge, where it is in the image


def corner_shots(setup, rng, T_camera_lrf):
    """Of shots, one for each of some rigs, which meet the conditions (named by what fails), and the
    shots: points (n, 3) in the LRF frame where the scan line meets the middle edge, and image lines
    (n, 3) of that.

    Parameters
    ----------
    setup : lrfcal_lib.simulate.shots.Scenario
    rng : numpy.random.Generator
    T_camera_lrf : RigidTransform
    """
    T_lrf_target = setup.boards(rng, T_camera_lrf)
    points, enough = _scanned(setup, rng, T_lrf_target)
    lines, whole = _image_lines(setup, rng, T_camera_lrf * T_lrf_target)
    conditions = {
        f"have fewer than {FEWEST_POINTS} beams on a plate": enough,
        "are not in the image": whole,
    }
    return conditions, {"points": points, "lines": lines}


def _scanned(setup, rng, T_lrf_target):
    """Where lines through the points on both plates meet, and whether there are enough points."""
    rays = polar_to_points(1.0, setup.bearings())
    # what follows is of both plates, (2, n, B)
    poses = [pose_array(T_lrf_target * plate) for plate in T_TARGET_PLATES]
    radii, ranges = replace(setup, board=PLATE).beside(np.array(poses), rays)
    hit = (radii < 0).all(axis=-1) & (ranges > 0)
    enough = (hit.sum(axis=-1) >= FEWEST_POINTS).all(axis=0)
    noisy = setup.noisy(rng, ranges)
    meeting = np.cross(*_fitted(noisy[..., None] * rays[:, :2], hit))
    return meeting / meeting[:, 2:] * [1.0, 1.0, 0.0], enough


def _fitted(points, used):
    """Total least-squares lines (..., 3) through the used ones of some points (..., B, 2)."""
    weight = (used / np.maximum(used.sum(axis=-1, keepdims=True), 1))[..., None]
    middle = np.sum(weight * points, axis=-2, keepdims=True)
    away = points - middle
    normal = np.linalg.eigh((weight * away).mT @ away)[1][..., 0]
    return np.concatenate([normal, -np.matvec(middle, normal)], axis=-1)


def _image_lines(setup, rng, T_camera_target):
    """Lines (n, 3) through the noisy ends of the middle edge in the image, and whether all three
    edges are there.
    """
    along = np.linspace(-SIZE, SIZE, SAMPLES)[:, None] * EDGE
    edges = SIZE * np.array([0 * EDGE, *PLATES])[:, None] + along
    seen = apply_pose(pose_array(T_camera_target)[:, None], edges)
    uv = pinhole(seen, setup.model)  # (n, 3, s, 2), NaN behind the camera
    inside = setup.model.shows(uv)
    first = inside.argmax(axis=-1)
    last = SAMPLES - 1 - inside[..., ::-1].argmax(axis=-1)
    ends = np.take_along_axis(uv, np.stack([first, last], axis=-1)[..., None], axis=2)
    long = length_of(np.diff(ends, axis=2)) > LEAST_LENGTH
    whole = (inside.any(axis=-1, keepdims=True) & long).all(axis=(1, 2))

    noisy = rng.normal(ends[:, 0], setup.sigma_px)
    return line_through(*noisy.swapaxes(0, 1)), whole
