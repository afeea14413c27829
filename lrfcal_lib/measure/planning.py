"""At which pitch angles images colour what the laser range finder sees."""

import numpy as np

from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.model.camera import pinhole, redistort
from lrfcal_lib.model.geometry import (
    apply_pose,
    lrf_to_platform,
    polar_to_points,
    pose_array,
)

DISTANCES = (1.0, 2.0, 4.0)  # metres, to the walls of a room
GRID = np.radians(
    2.0
)  # between the beams that stand for the cloud, and between pitch angles
WORTH = 0.01  # share of the cloud that one more pitch has to add
MOST = 12  # pitch angles
NEW = -1  # a placement of which no sweep was calibrated


def plan_images(
    rig: CalibratedRig, sweep: tuple[float, float], limits: tuple[float, float]
) -> tuple[np.ndarray, float]:
    """Choose pitch angles for images, the one that colours most of what is left first.

    Parameters
    ----------
    rig : CalibratedRig
    sweep : tuple of float
        First and last pitch of the scan lines, radians.
    limits : tuple of float
        Of the head, radians.

    Returns
    -------
    pitch : ndarray, shape (k,)
        Of the images, radians, ascending.
    share : float
        Of the cloud, that they colour.
    """
    candidates = _grid(*limits)
    visible = seen_at(rig, sweep, candidates)
    left = np.ones(visible.shape[1], bool)
    chosen: list[int] = []
    for _ in range(MOST):
        gains = np.mean(visible & left, axis=1)
        best = int(np.argmax(gains))
        if gains[best] < WORTH:
            break
        chosen.append(best)
        left &= ~visible[best]
    return np.sort(candidates[chosen]), 1 - left.mean()


def seen_at(
    rig: CalibratedRig, sweep: tuple[float, float], pitches: np.ndarray
) -> np.ndarray:
    """Which beams of a grid over a sweep end where a camera sees, if nothing hides anything.

    Parameters
    ----------
    rig, sweep
        As of :func:`plan_images`.
    pitches : ndarray, shape (p,)
        Of the head while images are taken, radians.

    Returns
    -------
    ndarray of bool, shape (p, n)
        By pitch; beams of all `DISTANCES`.
    """
    away = np.reshape(DISTANCES, (-1, 1))
    p_lrf = polar_to_points(away, _grid(*rig.lrf.field_of_view)).reshape(-1, 3)
    turns = rig.corrections.pitch(NEW, _grid(*np.sort(sweep)))
    points = lrf_to_platform(p_lrf, turns[:, None], rig.T_head_lrf).reshape(-1, 3)
    visible = np.zeros((len(pitches), len(points)), bool)
    for name, camera in rig.cameras.items():
        T_camera_platform = rig.camera_at(name, rig.corrections.pitch(NEW, pitches))
        p_camera = apply_pose(pose_array(T_camera_platform), points)
        uv = redistort(pinhole(p_camera, camera.model), camera.model)
        visible |= camera.model.shows(uv)
    return visible


def _grid(first, last):
    """Angles from one to another, about `GRID` apart."""
    return np.linspace(first, last, 1 + max(1, round((last - first) / GRID)))
