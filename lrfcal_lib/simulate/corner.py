"""The corner of two plates that Wasielewski and Strauss, and Kwak, look at, as drawn shots.

As in the simulation of Gomez-Ojeda and others (ICRA 2015): three parallel edges, of which the
middle one is where the plates meet.
"""

import numpy as np

from lrfcal_lib.model.camera import pinhole
from lrfcal_lib.model.geometry import polar_to_points, pose_array

EDGE = np.array(
    [-0.5, -0.5, 0.70711]
)  # where the plates meet, through the origin of the target
PLATES = np.array(
    [[-0.36237, 0.86237, 0.35355], [0.86237, -0.36237, 0.35355]]
)  # from the edge
SIZE = 1.5  # metres, of a plate away from the edge and along it to either side
FEWEST_POINTS = 2  # on a plate
LEAST_LENGTH = 15.0  # of an image line, pixels


def corner_shots(setup, rng, T_camera_lrf):
    """Of shots, one for each of some rigs, which meet the conditions (named by what fails), and the
    shots: points (n, 3, 3) in the LRF frame where the scan line meets middle, left and right edge,
    and their image lines (n, 3, 3).

    Parameters
    ----------
    setup : lrfcal_lib.simulate.scenarios.Scenario
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
    """Points (n, 3, 3) at the edges, and whether there are enough beams on both plates."""
    bearings = setup.bearings()
    rays = polar_to_points(1.0, bearings)
    origin = T_lrf_target.translation
    R = T_lrf_target.rotation.as_matrix()
    fits = []
    ends = []
    enough = np.ones(len(R), bool)
    for plate in PLATES:
        ranges = (R @ np.cross(plate, EDGE))[:, None] @ origin[..., None]
        ranges = ranges[..., 0] / (rays @ R @ np.cross(plate, EDGE))
        on_plate = (ranges[..., None] * rays - origin[:, None]) @ R
        away = on_plate @ plate
        hit = (ranges > 0) & (away > 0) & (away < SIZE) & (np.abs(on_plate @ EDGE) < SIZE)
        enough &= hit.sum(axis=1) >= FEWEST_POINTS
        noisy = ranges + setup.range_errors(rng, ranges.shape)
        fits.append(_fitted(noisy[..., None] * rays[:, :2], hit))
        ends.append((hit.argmax(axis=1), len(bearings) - 1 - hit[:, ::-1].argmax(axis=1)))
    right, left = fits
    step = setup.step / 2
    at_left = _ray(bearings[ends[1][1]] + step)
    at_right = _ray(bearings[ends[0][0]] - step)
    points = np.stack(
        [np.cross(right, left), np.cross(left, at_left), np.cross(right, at_right)], axis=1
    )
    points[..., :2] /= points[..., 2:]
    points[..., 2] = 0.0
    return points, enough


def _fitted(points, used):
    """Total least-squares lines (n, 3) through the used ones of some points (n, B, 2)."""
    weight = used / np.maximum(used.sum(axis=1, keepdims=True), 1)
    middle = np.sum(weight[..., None] * points, axis=1)
    away = points - middle[:, None]
    scatter = (weight[..., None] * away).mT @ away
    normal = np.linalg.eigh(scatter)[1][..., 0]
    return np.column_stack([normal, -np.vecdot(normal, middle)])


def _ray(bearing):
    """The line of a beam."""
    return np.column_stack([-np.sin(bearing), np.cos(bearing), np.zeros(len(bearing))])


def _image_lines(setup, rng, T_camera_target):
    """Lines (n, 3, 3) through the noisy ends of the edges in the image, and whether all are
    there.
    """
    right, left = SIZE * PLATES
    middles = np.array([0 * left, left, right])
    ends = middles[:, None] + SIZE * EDGE * np.array([[-1.0], [1.0]])
    poses = pose_array(T_camera_target)[:, None, None]
    seen = np.matvec(poses[..., :3], ends) + poses[..., 3]
    whole = (seen[..., 2] > 0).all(axis=(1, 2))
    start, end = np.moveaxis(pinhole(seen, setup.model), 2, 0)

    # shares of the way at which the lines enter and leave the image
    corner = np.array([[0.5, 0.5], [setup.model.width + 0.5, setup.model.height + 0.5]])
    borders = (corner[:, None, None] - start) / (end - start)
    enter = borders.min(axis=0).max(axis=-1)
    leave = borders.max(axis=0).min(axis=-1)
    first = np.clip(0.0, enter, leave)[..., None]
    last = np.clip(1.0, enter, leave)[..., None]
    length = (last - first)[..., 0] * np.linalg.norm(end - start, axis=-1)
    whole &= ((enter < leave) & (length > LEAST_LENGTH)).all(axis=1)

    clipped = [start + share * (end - start) for share in (first, last)]
    noisy = [p + setup.sigma_px * rng.standard_normal(p.shape) for p in clipped]
    one = np.ones_like(first)
    lines = np.cross(*(np.concatenate([p, one], axis=-1) for p in noisy))
    return lines / np.linalg.norm(lines[..., :2], axis=-1, keepdims=True), whole
