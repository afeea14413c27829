"""Do images of one surface agree where a sweep says that it is? Patches of it, seen by two cameras
or at two pitch angles: a camera that sits otherwise shifts one against the other.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from scipy.ndimage import maximum_filter

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.painting import View
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.measure.pulls import (
    PITCH_NOISE,
    SPREAD,
    Pull,
    poses_of,
    pull_of_groups,
    seen,
    without,
)
from lrfcal_lib.measure.surfaces import BENT
from lrfcal_lib.model.camera import pinhole, project
from lrfcal_lib.model.geometry import (
    length_of,
    unit_vector,
)
from lrfcal_lib.preprocess.edges_in_image import sample

EVERY = 9  # points of a surface between patches
HALF = 3  # samples from the middle of a patch to its side
SPACING = 2.0  # pixels between them, in the first image
LEAST_TEXTURE = 4.0  # grey levels of standard deviation
CLEAREST = 250  # patches of a pair
FEWEST = 20  # patches of a station
NEAR_PITCH = np.radians(15.0)  # between images of a camera that are compared
BLURS = (6.0, 4.0, 2.5, 1.5, 1.0, 1.0)  # pixels, round by round
ALIKE = 0.7  # correlation below which patches do not show the same
CELL = np.radians(6.0)  # patches nearer together err together
BORDER = 20  # pixels
STILL = 1e-12  # radians or metres, of what is not fitted
APART = 12.0  # pixels, side of cells: a patch is alone in its own and in those about it
REACH = 2**1.5 * APART  # pixels, to their farthest corner
# pixels, where gradients are taken: in the middle, to the right and to the left, below and above
ABOUT = np.array([[0.0, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
BEFORE = 4.0  # standard deviations of a range by which something else is nearer or farther


@dataclass(frozen=True)
class _Side:
    """Patches that an image shows, a row each: samples (n, s, 2), and by how much a change of the
    unknowns shifts each (n, 2, c).
    """

    view: View
    uv: np.ndarray
    by_unknown: np.ndarray


def pairs_pull(
    cloud: Cloud,
    of_point: np.ndarray,
    views: list[View],
    rig: CalibratedRig,
    start: np.ndarray,
) -> list[Pull]:
    """What pairs of images say about a rig, one Pull; none where they show too little.

    Every camera's pose is found by Gauss-Newton from blurred to sharp images.

    Parameters
    ----------
    cloud : Cloud
        Of n points that a station shows, those of flat surfaces moved onto them.
    of_point : ndarray of int, shape (n,)
        The number of the surface, -1 for none.
    views : list of View
        Images of the station.
    rig : CalibratedRig
        That knows its uncertainty.
    start : ndarray, shape (c,)
        Change of the unknowns that creases ask for: pairs leave open what moves both images alike.
    """
    patches = np.flatnonzero(of_point >= 0)[::EVERY]
    surfaces = of_point[patches, None] == np.unique(of_point[patches])
    clear = {view.number: clear_places(cloud, view, rig)[patches] for view in views}
    stops = np.unique([view.pitch for view in views])
    pairs = []
    for first, second in combinations(views, 2):
        near = NEAR_PITCH if first.camera == second.camera else 1e-3
        if abs(first.pitch - second.pitch) < near:
            both = clear[first.number] & clear[second.number]
            rows = cloud.rows(patches[both])
            pairs.append(_pair(rows, surfaces[both], (first, second), rig, stops))
    if sum(len(cell) for _, cell in pairs) < FEWEST:
        return []
    cameras = dict.fromkeys(view.camera for view in views)
    poses = np.array([poses_of(rig, camera) for camera in cameras])
    noise = np.repeat([BENT, PITCH_NOISE], [surfaces.shape[1], len(stops)])
    # what moves both images alike stays where creases have it, and all else that is no pose
    sigma = np.full(len(start), STILL)
    sigma[poses] = SPREAD / 4
    prior = np.r_[sigma, noise] ** -2.0
    begun = np.pad(start, (0, len(noise)))
    step = np.zeros_like(begun)
    for blur in BLURS:
        sharp = {view.number: cv2.GaussianBlur(view.grey, (0, 0), blur) for view in views}
        x = begun + step
        parts = [_compared(sides, cell, sharp, x) for sides, cell in pairs]
        H, b, D, cell = (np.concatenate(part) for part in zip(*parts, strict=True))
        information = np.einsum("nia,nij,njb->ab", D, H, D)
        by_row = np.vecmat(-b, D)
        left = by_row.sum(axis=0) - prior * step
        step += np.linalg.solve(information + np.diag(prior), left)
    pull = pull_of_groups(information, by_row, cell, x, poses.ravel())
    return [replace(without(pull, noise), alike=H.any(axis=(1, 2)).mean())]


def clear_places(cloud, view, rig):
    """Which points (n,) a view shows with nothing nearer or farther beside them: of a plane the
    inverse of the depth is linear in the pixels.
    """
    model = view.model
    p_camera = view.T_camera_platform.apply(cloud.points)
    uv = project(p_camera, model)
    clear = model.shows(uv)
    p_camera = p_camera[clear]
    cells = tuple((uv[clear] / APART).astype(int).T)
    nearness = 1 / p_camera[:, 2]
    normals = view.T_camera_platform.rotation.apply(cloud.normals[clear])
    slope = length_of(normals[:, :2]) / np.abs(np.vecdot(normals, p_camera))
    noise = BEFORE * rig.lrf.sigma_range * nearness**2
    off = REACH * slope / model.fx + noise
    alone = np.ones(len(nearness), bool)
    for side in (1, -1):  # what is nearer, then what is farther
        most = np.full((model.size / APART).astype(int) + 1, -np.inf)
        np.maximum.at(most, cells, side * nearness)
        alone &= maximum_filter(most, 3)[cells] < side * nearness + off
    clear[clear] = alone
    return clear


def _pair(patches, surfaces, views, rig, stops):
    """The clearest patches that two images show, each of one of some surfaces (n, s), as the Sides
    of both, and their cells (n,).
    """
    first = views[0]
    points = _samples(patches, first)
    inside = np.ones(len(points), bool)
    uv = []
    for view in views:
        p_camera = view.T_camera_platform.apply(points)
        inside &= view.model.shows(project(p_camera, view.model), BORDER).all(axis=1)
        uv.append(pinhole(p_camera, view.model))
    texture = inside * sample(first.grey, first.model, uv[0])[..., 0].std(axis=1)
    order = np.argsort(-texture)[:CLEAREST]
    rows = order[texture[order] > LEAST_TEXTURE]
    patches = patches.rows(rows)
    sides = [
        _Side(view, pixels[rows], _shifted(view, rig, patches, surfaces[rows], stops))
        for view, pixels in zip(views, uv, strict=True)
    ]
    return sides, np.floor(patches.bearing / CELL) + 1000 * np.floor(patches.pitch / CELL)


def _samples(patches, view):
    """Points (n, s, 3) of patches, `SPACING` pixels of an image apart; platform frame."""
    right = np.cross(patches.normals, [0.0, 0.0, 1.0])
    right[length_of(right) < 0.1] = [1.0, 0.0, 0.0]
    right = unit_vector(right)
    down = np.cross(patches.normals, right)
    depth = view.T_camera_platform.apply(patches.points)[:, 2]
    sides = np.stack([right, down], axis=1) * depth[:, None, None]
    steps = np.indices((2 * HALF + 1,) * 2).reshape(2, -1).T - HALF
    return patches.points[:, None] + SPACING / view.model.fx * steps @ sides


def _shifted(view, rig, patches, surfaces, stops):
    """Derivatives (n, 2, c) of the pixels of patches by the unknowns of a Pull, by the height of
    each surface, and by the pitch at which the head stopped.
    """
    raised = surfaces[..., None] * patches.normals[:, None]
    _, J = seen(patches.points, raised, view, rig)
    on_head = rig.cameras[view.camera].mount == "head"
    here = on_head & (stops == view.pitch)
    by_pitch = J[..., len(rig.uncertainty.names), None]
    # an image pitched more sees what a sweep pitched less shows
    return np.concatenate([J, -by_pitch * here], axis=-1)


def _compared(sides, cell, sharp, x):
    """Of each patch of a pair: tensor (2, 2), slope (2,), derivatives (2, c), and its cell."""
    shown = [_normalised(side, sharp[side.view.number], x) for side in sides]
    (first, of_first), (second, of_second) = shown
    alike = np.mean(first * second, axis=1)
    weight = np.clip((alike - ALIKE) / (1 - ALIKE), 0, None) ** 2
    gradient = (of_first + of_second) / 2
    weighted = gradient * weight[:, None, None]
    tensor = weighted.mT @ gradient
    slope = np.vecmat(second - first, weighted)
    moved = sides[1].by_unknown - sides[0].by_unknown
    return np.nan_to_num(tensor), np.nan_to_num(slope), moved, cell


def _normalised(side, image, x):
    """Patches (n, s) of mean 0 and standard deviation 1, and their gradients (n, s, 2)."""
    places = side.uv + (side.by_unknown @ x)[:, None] + ABOUT[:, None, None]
    values = sample(image, side.view.model, places)[..., 0]
    values -= values.mean(axis=-1, keepdims=True)
    middle, right, left, below, above = values
    spread = np.maximum(middle.std(axis=1), 1.0)[:, None]
    gradient = np.stack([right - left, below - above], axis=-1)
    return middle / spread, gradient / spread[..., None]
