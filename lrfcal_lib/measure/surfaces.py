"""Flat surfaces of a scanned cloud: planes that grow cell by cell as long as they stay flat."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_erosion, label
from scipy.spatial import KDTree

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.fit.robust import TUKEY, robust_sigma
from lrfcal_lib.measure.features import ALIKE, Feature, fit_feature
from lrfcal_lib.model.geometry import DegenerateGeometry, fit_plane

SEED = 0.15  # metres about a point, where a plane begins
CELL = 0.1  # metres, side of the cells by which it grows
BENT = (
    0.003  # metres by which a cell may be off, beside its noise: a picture stands 10 mm out
)
LIMIT = 3.0  # standard deviations of the mean of a cell
FEWEST = 60  # points of a surface
IN_CELL = 3  # points that make a cell
ROUNDS = 8  # of growing and fitting again
# metres by which a surface without a middle may be off: its readings are mixed with what is beside
ALL_RIM = 0.006
SEEDS = 1500  # places at which a plane may begin


def planes_of(cloud: Cloud, rig: CalibratedRig) -> tuple[list[Feature], np.ndarray]:
    """The flat surfaces of a cloud.

    Parameters
    ----------
    cloud : Cloud
        Of one station, of n points.
    rig : CalibratedRig

    Returns
    -------
    planes : list of Feature
    of_point : ndarray of int, shape (n,)
        The number of the plane that a point lies on, -1 for none.
    """
    of_point = np.full(len(cloud.points), -1)
    tree = KDTree(cloud.points)
    planes: list[Feature] = []
    for seed in range(0, len(cloud.points), max(1, len(cloud.points) // SEEDS)):
        if of_point[seed] >= 0 or not np.isfinite(cloud.normals[seed]).all():
            continue
        try:
            surface = _grown(cloud, tree, seed, of_point < 0)
        except DegenerateGeometry:
            continue
        if len(surface) >= FEWEST:
            of_point[surface] = len(planes)
            planes.append(_fitted(cloud, surface, rig))
    return planes, of_point


def _grown(cloud, tree, seed, free):
    """Rows of the free points of the flat surface about a point."""
    start = np.array(tree.query_ball_point(cloud.points[seed], SEED))
    alike = cloud.normals[start] @ cloud.normals[seed] > np.cos(ALIKE)
    surface = start[alike & free[start]]
    for _ in range(ROUNDS):
        if len(surface) < FEWEST / 2:
            return surface
        inner = cloud.points[_inner(cloud, surface)]
        normal, offset, _ = fit_plane(inner)
        miss = cloud.points @ normal - offset
        sigma = robust_sigma(inner @ normal - offset)
        facing = np.abs(cloud.normals @ normal) > np.cos(ALIKE)
        near = np.flatnonzero(free & facing & (np.abs(miss) < TUKEY * sigma))
        before = surface
        points = np.vstack([cloud.points[near], cloud.points[seed]])
        surface = near[_connected(points, normal, miss[near], sigma)]
        if len(surface) == len(before):
            break
    return surface


def _connected(points, normal, miss, sigma):
    """Which points (n, 3) near a plane, the last of them the seed, are in the cells about the seed
    that lie on the plane; `miss` is (n - 1,).
    """
    place, count = _cells(points, normal)
    seed = tuple(place[-1])
    place = tuple(place[:-1].T)
    count[seed] -= 1
    total = np.zeros(count.shape)
    np.add.at(total, place, miss)
    mean = total / np.maximum(count, 1)
    allowed = BENT + LIMIT * sigma / np.sqrt(np.maximum(count, 1))
    numbers, _ = label((count >= IN_CELL) & (np.abs(mean) < allowed))
    return (numbers[place] == numbers[seed]) & (numbers[seed] > 0)


def _fitted(cloud, surface, rig):
    """The plane of a surface, less certain where it is all rim."""
    inner = _inner(cloud, surface)
    plane = fit_feature(cloud, inner, rig)
    if len(inner) < len(surface):
        return plane
    noise = plane.noise.copy()
    noise[:3, :3] += ALL_RIM**2 * np.outer(plane.axis, plane.axis)
    return replace(plane, noise=noise)


def _inner(cloud, surface):
    """Rows of a surface without the cells at its rim, where the spot meets what is beside it; all
    where little would be left.
    """
    points = cloud.points[surface]
    place, count = _cells(points, fit_plane(points)[0])
    inside = binary_erosion(np.pad(count, 1) >= IN_CELL, np.ones((3, 3)))[1:-1, 1:-1]
    inner = surface[inside[tuple(place.T)]]
    return inner if len(inner) >= FEWEST else surface


def _cells(points, normal):
    """Cells (n, 2) of points (n, 3) along a plane, and how many points are in each."""
    across = np.linalg.svd(normal[None])[2][1:]
    cell = np.rint(points @ across.T / CELL).astype(int)
    cell -= cell.min(axis=0)
    count = np.zeros(cell.max(axis=0) + 1, int)
    np.add.at(count, tuple(cell.T), 1)
    return cell, count
