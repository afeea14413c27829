"""How the background moved between two images of a camera: a small turn and a change of the image scale.

Corners are followed by the pyramidal Lucas-Kanade method forwards and backwards; what does not agree with the others
(the board, people, a box that was pushed) is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from lrfcal_lib.camera import undistort

MOST_FEATURES, FEATURE_QUALITY, FEATURE_DISTANCE = 1500, 0.01, 8  # cv2.goodFeaturesToTrack; the distance in pixels
CONTRAST_WIDTH, CONTRAST_FLOOR = 8.0, 4.0  # pixels, grey levels: below the floor the contrast is sensor noise
TRACKING = {"winSize": (21, 21), "maxLevel": 3, "criteria": (3, 40, 0.003)}  # three levels reach about 80 pixels
THERE_AND_BACK = 0.1  # pixels; a feature that does not come back is hidden in the other image
FEWEST_FEATURES, FEWEST_CELLS = 40, 10  # for four unknowns with a covariance from the scatter over cells
CELLS = (8, 5)  # of the image; neighbouring features share their errors (parallax, a box that was pushed)
TUKEY = 3.0  # of the median residual of the features, whose lengths are Rayleigh: 3 medians are 3.5 sigma


@dataclass(frozen=True)
class Motion:
    """Motion of the background between two images.

    Attributes
    ----------
    rotvec : ndarray, shape (3,)
        Turn of the background in the camera frame (the camera's own turn is the opposite), radians.
    scale : float
    covariance : ndarray, shape (4, 4)
    residual_px : float
    n_features : int
    """

    rotvec: np.ndarray
    scale: float
    covariance: np.ndarray
    residual_px: float
    n_features: int


class BackgroundLost(ValueError):
    """Too little of the background can be followed from one image to another."""


def even_contrast(image):
    """Grey image with the same brightness and contrast everywhere, so that a change of the light moves nothing.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)

    Returns
    -------
    ndarray of uint8, shape (h, w)
    """
    grey = _grey(image).astype(np.float32)
    detail = grey - cv2.GaussianBlur(grey, (0, 0), CONTRAST_WIDTH)
    spread = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), CONTRAST_WIDTH)) + CONTRAST_FLOOR
    return np.clip(128 + 40 * detail / spread, 0, 255).astype(np.uint8)


def _grey(image):
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def outside(hull, shape):
    """Mask (uint8) of the image outside a hull (pixels), all of it without one."""
    mask = np.full(shape, 255, np.uint8)
    return mask if hull is None else cv2.fillConvexPoly(mask, np.round(hull).astype(np.int32), 0)


def find_features(image, mask=None):
    """Corners to follow, pixels, shape (n, 2); none where the mask (uint8) is zero."""
    found = cv2.goodFeaturesToTrack(_grey(image), MOST_FEATURES, FEATURE_QUALITY, FEATURE_DISTANCE, mask=mask)
    return np.zeros((0, 2), np.float32) if found is None else found[:, 0]


def follow(first, second, features, mask=None):
    """Find features of one image in another (pyramidal Lucas-Kanade), forwards and backwards.

    Parameters
    ----------
    first, second : ndarray of uint8, shape (h, w)
        Of :func:`even_contrast`.
    features : ndarray, shape (n, 2)
    mask : ndarray of uint8, shape (h, w), optional
        Zero where the second image shows no background.

    Returns
    -------
    start, end : ndarray, shape (m, 2)
        Only those that lead back to where they came from.
    """
    if len(features) == 0:
        return np.zeros((0, 2)), np.zeros((0, 2))
    start = features.astype(np.float32)[:, None]
    end, there, _ = cv2.calcOpticalFlowPyrLK(first, second, start, None, **TRACKING)
    back, here, _ = cv2.calcOpticalFlowPyrLK(second, first, end, None, **TRACKING)
    good = (there[:, 0] > 0) & (here[:, 0] > 0) & (np.linalg.norm(back - start, axis=2)[:, 0] < THERE_AND_BACK)
    column, row = np.clip(np.round(end[:, 0]), 0, np.array(second.shape[::-1]) - 1).astype(int).T
    good &= True if mask is None else mask[row, column] > 0
    return start[good, 0].astype(float), end[good, 0].astype(float)


def fit_motion(start, end, model):
    """Turn and scale that carry features of one image to where another shows them, robust.

    Parameters
    ----------
    start, end : ndarray, shape (n, 2)
        Recorded pixels.
    model : CameraModel

    Returns
    -------
    Motion
        The covariance comes from the scatter over cells of the image, whose features share their errors.

    Raises
    ------
    BackgroundLost
        With fewer than 40 features or 10 cells of the image (8 by 5) that agree.
    """
    cell = _cell_of(start, model)
    _check_enough(len(start), cell)
    focal = np.array([model.fx, model.fy])
    first, second = ((undistort(p, model) - [model.cx, model.cy]) / focal for p in (start, end))
    turn, scale, weight = Rotation.identity(), 1.0, np.ones(len(start))
    for robust in (False,) * 10 + (True,) * 20:
        miss, by_state = motion_misses(first, second, turn, scale)
        length = np.maximum(np.linalg.norm(miss * focal, axis=1), 1e-4)
        unit = np.median(length[weight > 0])
        weight = np.clip(1 - (length / (TUKEY * unit)) ** 2, 0, None) ** 2 if robust else 1 / np.maximum(length, 0.01)
        _check_enough((weight > 0).sum(), cell[weight > 0])
        step = _solve(by_state, miss, weight)
        turn, scale = Rotation.from_rotvec(step[:3]) * turn, scale + step[3]
    covariance = _covariance(by_state, miss, weight, cell)
    return Motion(turn.as_rotvec(), float(scale), covariance, float(unit), int((weight > 0).sum()))


def _check_enough(count, cell):
    cells = len(np.unique(cell))
    if count < FEWEST_FEATURES or cells < FEWEST_CELLS:
        raise BackgroundLost(
            f"{count} features of the background in {cells} parts of the image can be followed, "
            f"{FEWEST_FEATURES} in {FEWEST_CELLS} are needed: was the camera mounted anew, or is the scene too plain?"
        )


def _cell_of(pixels, model):
    column, row = (pixels * np.array(CELLS) / [model.width, model.height]).astype(int).T
    return np.clip(row, 0, CELLS[1] - 1) * CELLS[0] + np.clip(column, 0, CELLS[0] - 1)


def motion_misses(first, second, turn, scale):
    """Observed minus predicted normalised coordinates (n, 2), and the derivative of the prediction (n, 2, 4).

    Parameters
    ----------
    first, second : ndarray, shape (n, 2)
        Normalised image coordinates of the features in both images, without lens distortion.
    turn : Rotation
        Of the background in the camera frame; its derivative is that of a further small turn from the left.
    scale : float
    """
    rays = turn.apply(np.column_stack([first, np.ones(len(first))]))
    x, y = (rays[:, :2] / rays[:, 2:]).T
    by_turn = [np.stack([-x * y, 1 + x * x, -y, x], axis=1), np.stack([-(1 + y * y), x * y, x, y], axis=1)]
    by_state = np.stack(by_turn, axis=1)
    by_state[:, :, :3] *= scale
    return second - scale * np.stack([x, y], axis=1), by_state


def _solve(by_state, miss, weight):
    weighted = by_state * weight[:, None, None]
    return np.linalg.solve(np.einsum("nij,nik->jk", weighted, by_state), np.einsum("nij,ni->j", weighted, miss))


def _covariance(by_state, miss, weight, cell):
    """Sandwich covariance with cells of the image as its independent parts."""
    weighted = by_state * weight[:, None, None]
    score = np.zeros((cell.max() + 1, 4))
    np.add.at(score, cell, np.einsum("nij,ni->nj", weighted, miss))
    cells = len(np.unique(cell[weight > 0]))
    bread = np.linalg.inv(np.einsum("nij,nik->jk", weighted, by_state))
    return bread @ (score.T @ score) @ bread * cells / (cells - 4)
