"""Do images of one surface agree where a sweep says that it is? Patches of it, seen by two cameras
or at two pitch angles: a camera that sits otherwise shifts one against the other.
"""

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from lrfcal_lib.calibrate.reconstruct import grid_normals
from lrfcal_lib.judge.uncertainty import carried
from lrfcal_lib.measure.pulls import Pull, View, directions, pull_of_groups
from lrfcal_lib.model.camera import pinhole, pinhole_jacobian, project
from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points
from lrfcal_lib.preprocess.edges_in_image import sample

EVERY = 3  # lines and beams between patches
HALF = 3  # samples from the middle of a patch to its side
SPACING = 2.0  # pixels between them, in the first image
LEAST_TEXTURE = 4.0  # grey levels of standard deviation
CLEAREST = 250  # patches of a pair
ROUGH = 2.0  # sigma of a range: of readings about the surface of a patch
NEAR_PITCH = np.radians(15.0)  # between images of a camera that are compared
BLURS = (6.0, 4.0, 2.5, 1.5, 1.0, 1.0)  # pixels, round by round
ALIKE = 0.7  # correlation below which patches do not show the same
CELL = np.radians(6.0)  # patches nearer together err together
STIFF = np.array([*np.radians([1.0] * 3), 0.02, 0.02, 0.02])  # a camera's likely changes
BORDER = 20  # pixels


@dataclass(frozen=True)
class Patches:
    """Flat pieces of a scanned surface, a row each.

    Attributes
    ----------
    bearing, pitch, range : ndarray, shape (n,)
        Of their middles, corrected.
    right, down : ndarray, shape (n, 3)
        Unit vectors in the surface, platform frame.
    cell : ndarray of int, shape (n,)
        Those of one cell err together.
    """

    bearing: np.ndarray
    pitch: np.ndarray
    range: np.ndarray
    right: np.ndarray
    down: np.ndarray
    cell: np.ndarray


def patches_of(sweep, rig, lrf, continuous=False) -> Patches:
    """Every few beams a patch where the surface about it is flat."""
    grid = directions(sweep, rig, lrf, continuous)
    ranges = sweep.ranges - rig.corrections.range_offset
    points = lrf_to_platform(
        polar_to_points(ranges, sweep.bearings), grid[..., 1], rig.T_head_lrf
    )
    origin = lrf_to_platform(np.zeros(3), grid[..., 1], rig.T_head_lrf)
    normals, scatter = grid_normals(points, origin)
    some = np.zeros(ranges.shape, bool)
    some[::EVERY, ::EVERY] = True
    with np.errstate(invalid="ignore"):
        flat = some & (scatter < ROUGH * lrf.sigma_range) & np.isfinite(ranges)
    normal = normals[flat]
    right = np.cross(normal, [0.0, 0.0, 1.0])
    right[np.linalg.norm(right, axis=1) < 0.1] = [1.0, 0.0, 0.0]
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    cells = np.floor(grid[flat] / CELL).astype(int)
    return Patches(
        bearing=grid[flat][:, 0],
        pitch=grid[flat][:, 1],
        range=ranges[flat],
        right=right,
        down=np.cross(normal, right),
        cell=np.unique(cells, axis=0, return_inverse=True)[1].ravel(),
    )


@dataclass(frozen=True)
class _Seen:
    """Patches in one image: samples (n, s, 2), derivatives (n, 2, c), and which are inside."""

    uv: np.ndarray
    by_unknown: np.ndarray
    inside: np.ndarray


def _seen(patches, view, spacing):
    """Where samples of patches, `spacing` (n,) metres apart, lie in an image."""
    beams = patches.bearing, patches.pitch, patches.range
    middle, by_link, by_pitch = carried(view.chain, *beams, view.pitch)
    turned = view.T_camera_platform.rotation
    steps = (np.arange(2 * HALF + 1) - HALF) * 1.0
    across = turned.apply(patches.right) * spacing[:, None]
    down = turned.apply(patches.down) * spacing[:, None]
    offsets = steps[:, None, None, None] * across + steps[:, None, None] * down
    points = middle[:, None] + np.moveaxis(offsets, 2, 0).reshape(len(middle), -1, 3)
    recorded = project(points, view.model)
    size = np.array([view.model.width, view.model.height])
    inside = ((recorded > BORDER) & (recorded < size - BORDER)).all(axis=(1, 2))
    links = view.links(by_link, by_pitch)
    by_pixel = pinhole_jacobian(middle, view.model) @ links
    return _Seen(pinhole(points, view.model), view.spread(by_pixel), inside)


def pairs_pull(patches: Patches, views: list[View]) -> Pull | None:
    """What pairs of images say about a rig; None where no pair does.

    Every camera's pose is found by Gauss-Newton from blurred to sharp images.

    Parameters
    ----------
    patches : Patches
    views : list of View
        Images of one station.
    """
    pairs = []
    for first, second in combinations(views, 2):
        turned = abs(first.pitch - second.pitch)
        same = first.camera == second.camera
        if turned < (NEAR_PITCH if same else 1e-3) and not (same and first.fixed):
            pairs += _pair(patches, first, second)
    if not pairs:
        return None
    poses = np.unique(np.concatenate([view.pose_columns for view in views]))
    stiff = np.tile(STIFF**-2.0, len(poses) // 6)
    x = np.zeros(views[0].count)
    for blur in BLURS:
        sharp = {id(view): cv2.GaussianBlur(view.grey, (0, 0), blur) for view in views}
        parts = [_compared(pair, sharp, x) for pair in pairs]
        H, b, D, cell = (np.concatenate(part) for part in zip(*parts, strict=True))
        normal = np.einsum("nia,nij,njb->ab", D[..., poses], H, D[..., poses])
        slope = np.einsum("nia,ni->a", D[..., poses], b)
        x[poses] -= np.linalg.solve(normal + np.diag(stiff), slope + stiff * x[poses])
    information = np.einsum("nia,nij,njb->ab", D, H, D)
    by_group = np.einsum("nia,ni->na", D, b)
    return pull_of_groups(information, by_group, cell, x, poses)


def _pair(patches, first, second):
    """The clearest patches that two images show, as a list of one tuple or none."""
    points = carried(
        first.chain, patches.bearing, patches.pitch, patches.range, first.pitch
    )[0]
    spacing = SPACING * points[:, 2] / first.model.fx
    a = _seen(patches, first, spacing)
    b = _seen(patches, second, spacing)
    rows = np.flatnonzero(a.inside & b.inside)
    if not len(rows):
        return []
    shown = sample(first.grey, first.model, a.uv[rows])[..., 0]
    texture = np.nan_to_num(shown.std(axis=1))
    order = np.argsort(-texture)[:CLEAREST]
    rows = rows[order[texture[order] > LEAST_TEXTURE]]
    if not len(rows):
        return []
    return [
        (
            first,
            second,
            a.uv[rows],
            b.uv[rows],
            a.by_unknown[rows],
            b.by_unknown[rows],
            patches.cell[rows],
        )
    ]


def _compared(pair, sharp, x):
    """Of each patch of a pair: tensor (2, 2), slope (2,), derivatives (2, c), cell."""
    first, second, uv_a, uv_b, J_a, J_b, cell = pair
    A, grad_a = _sampled(sharp[id(first)], first.model, uv_a + (J_a @ x)[:, None])
    B, grad_b = _sampled(sharp[id(second)], second.model, uv_b + (J_b @ x)[:, None])
    alike = np.mean(A * B, axis=1)
    weight = np.clip((alike - ALIKE) / (1 - ALIKE), 0, None) ** 2
    gradient = (grad_a + grad_b) / 2
    weighted = gradient * weight[:, None, None]
    tensor = np.einsum("nsi,nsj->nij", weighted, gradient)
    slope = np.einsum("nsi,ns->ni", weighted, B - A)
    return np.nan_to_num(tensor), np.nan_to_num(slope), J_b - J_a, cell


def _sampled(image, model, uv):
    """Patches (n, s) of mean 0 and standard deviation 1, and their gradients (n, s, 2)."""
    values = sample(image, model, uv)[..., 0]
    spread = np.maximum(values.std(axis=1), 1.0)[:, None]
    gradient = []
    for step in np.eye(2) / 2:
        change = sample(image, model, uv + step) - sample(image, model, uv - step)
        gradient.append(change[..., 0] - change[..., 0].mean(axis=1, keepdims=True))
    normal = (values - values.mean(axis=1, keepdims=True)) / spread
    return normal, np.stack(gradient, axis=-1) / spread[..., None]
