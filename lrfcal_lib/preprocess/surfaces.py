"""Flat surfaces in a range image: pieces without a jump, planes, what may be a board."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist, pdist
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.robust import robust_sigma
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    fit_plane,
    length_of,
    lrf_to_platform,
    plane_axes,
    polar_to_points,
    tilt,
    unit_vector,
)
from lrfcal_lib.session.read import Sweep
from lrfcal_lib.session.stated import StatedRig

# a face seen at a flatter angle than 10 deg is taken for a depth jump
STEEPEST = np.tan(np.radians(80))
# metres; what noise and dark print change between neighbouring beams of one face
DEPTH_NOISE = 0.03
PLANE_NOISE = 0.02  # metres; noise and warp of a board about its plane
# metres; a gap without returns that does not end a surface (print, gloss)
LONGEST_HOLE = 0.15
# metres; the farthest from its plane that a return of a noisy device still counts
LARGEST_NOISE = 0.04
SAME_PITCH = 1e-4  # radians: scan lines at one pitch
FEWEST_POINTS = 12
MOST_PLANES = 25  # of a surface
SMALL_PART = 0.2  # of the largest connected part of a plane
NEIGHBOURS = 0.3  # metres; points that may span a plane together
TRIALS = 200  # of random sample consensus
SAMPLE = 1500  # points that it looks at
REFINE_ROUNDS = 3
# that a surface of a sweep must span: points of one scan line lie in a plane whatever they hit
FEWEST_LINES = 4
LEAST_FILL = 0.5  # of a board's cells in their hull
LEAST_LENGTH = 0.3  # of a scan line on a board, in units of the root of its least area


class BoardNotFound(ValueError):
    """No board in a sweep; the message says what was seen instead."""


@dataclass(frozen=True)
class Surface:
    """A flat surface: its cells (L, B), unit normal (3,) and distance (metres), platform frame."""

    mask: np.ndarray
    normal: np.ndarray
    distance: float

    def size(self, points):
        """See :func:`plane_size`, of the points (L, B, 3) in its cells."""
        return plane_size(points[self.mask] @ plane_axes(self.normal).T)


@dataclass(frozen=True)
class Limits:
    """Least and largest area (m2) and greatest length (m) of what may be the board."""

    least: float
    most: float
    longest: float

    def hold(self, area, length):
        """Whether something has the board's size."""
        return self.least < area < self.most and length < self.longest


def depth_jump(ranges, step):
    """Change of range (metres) between beams a `step` apart that no face of a board makes."""
    return DEPTH_NOISE + STEEPEST * ranges * np.abs(step)


def segments(ranges, *, jump=DEPTH_NOISE, bridge=0) -> np.ndarray:
    """Cut scan lines at depth discontinuities; step (i) of the paper's preprocessing.

    A change of range above `jump` (metres) a beam ends a piece, and a gap of more than `bridge`
    beams. Returns the number by beam (L, B), ascending along the lines, -1 without a return.
    """
    valid = np.isfinite(ranges)
    line, beam = np.nonzero(valid)
    _, jump, bridge = np.broadcast_arrays(ranges, jump, bridge)
    gap = np.diff(beam, prepend=0)
    change = np.abs(np.diff(ranges[valid], prepend=0.0))
    broken = np.diff(line, prepend=-1) != 0  # as the first return
    broken |= (gap - 1 > bridge[valid]) | (change > gap * jump[valid])
    labels = np.full(ranges.shape, -1)
    labels[valid] = np.cumsum(broken) - 1
    return labels


def surfaces(sweep, ranges) -> tuple[np.ndarray, np.ndarray]:
    """Connected surfaces of some ranges (L, B) of a sweep: numbers (L, B) of pieces joined across
    the lines, -1 without a return; and how many cells each has.
    """
    step = np.median(np.diff(sweep.bearings))
    near = np.where(np.isfinite(ranges), ranges, 1.0)
    bridge = (LONGEST_HOLE / (near * step)).astype(int)
    pieces = segments(ranges, jump=depth_jump(near, step), bridge=bridge)
    turned = np.diff(sweep.pitch)[:, None]
    close = np.abs(np.diff(ranges, axis=0)) < depth_jump(near[1:], turned)
    above = pieces[:-1][close]
    below = pieces[1:][close]
    n = pieces.max() + 1
    graph = coo_array((np.ones(len(above)), (above, below)), shape=(n, n))
    joined = connected_components(graph, directed=False)[1]
    labels = np.where(pieces >= 0, joined[pieces], -1)
    return labels, np.bincount(labels[labels >= 0])


def planar_surface(
    sweep: Sweep,
    T_head_lrf: RigidTransform,
    rig: StatedRig,
    rng: np.random.Generator,
) -> Surface:
    """The nearest flat connected surface of a board's size.

    With all scan lines at one pitch they do not determine the plane; the one at right angles to the
    scan plane is taken then.

    Parameters
    ----------
    sweep : Sweep
    T_head_lrf : RigidTransform
        Only nominal.
    rig : StatedRig
        Its board tells the size; a spot of its LRF that reads the board while it only touches it
        makes it larger by its radius.
    rng : numpy.random.Generator
        For the random sampling.

    Returns
    -------
    Surface

    Raises
    ------
    BoardNotFound
        Says what was seen instead.
    """
    ranges = sweep.ranges
    if not np.isfinite(ranges).any():
        raise BoardNotFound(f"no return in {len(sweep.pitch)} scan lines")
    p_lrf = polar_to_points(ranges, sweep.bearings)
    points = lrf_to_platform(p_lrf, sweep.pitch[:, None], T_head_lrf)  # (L, B, 3), metres
    upright = None  # of a plane at right angles to the scan plane
    if np.ptp(sweep.pitch) <= SAME_PITCH:
        upright = tilt(T_head_lrf.rotation.apply([0.0, 0.0, 1.0]), sweep.pitch[0])
    rejected = []
    best = None
    best_reach = np.inf
    for nearest, mask in _by_distance(sweep):
        if nearest > best_reach:
            break
        for part in _planes(sweep, points, mask, upright, rng):
            reach = np.median(ranges[part.mask])
            limits = _size_limits(rig.board, rig.lrf.spot_radius(reach))
            if upright is None:
                part = _trimmed(part, points, limits)
            area, length = part.size(points)
            lines = part.mask.any(axis=1).sum()
            fault = f" on {lines} of {len(ranges)} scan lines"
            if upright is None:
                if limits.hold(area, length) and lines >= min(FEWEST_LINES, len(ranges)):
                    fault = _fault(part, points, sweep.pitch, T_head_lrf)
            elif LEAST_LENGTH * np.sqrt(limits.least) < length < limits.longest:
                fault = ""
            if fault:
                rejected.append(
                    f"{area:.2f} m2, {length:.2f} m long at {reach:.2f} m{fault}"
                )
            elif reach < best_reach:
                best = part
                best_reach = reach
    if best is None:
        words = "; ".join(rejected[:4]) or "no flat surface"
        raise BoardNotFound(f"no flat surface of the board's size; seen: {words}")
    return _grown(best, points)


def best_plane(points, upright, rng) -> tuple[np.ndarray, float]:
    """Random sample consensus over neighbours, then least squares over all that agree.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Metres.
    upright : ndarray, shape (3,), or None
        A direction that the plane contains.
    rng : numpy.random.Generator

    Returns
    -------
    normal : ndarray, shape (3,)
    distance : float

    Raises
    ------
    DegenerateGeometry
        Where too few points agree, or all on one line.
    """
    sample = points[rng.permutation(len(points))[:SAMPLE]]
    seeds = sample[rng.integers(len(sample), size=TRIALS)]
    apart = cdist(seeds, sample)
    neighbours = (apart < NEIGHBOURS) & (apart > 1e-6)
    lots = np.where(neighbours, rng.random(apart.shape), -1.0)
    others = sample[np.argpartition(-lots, 1, axis=1)[:, :2]]
    second = others[:, 1] - seeds if upright is None else upright
    normals = np.cross(others[:, 0] - seeds, second)
    normals[length_of(normals) <= 1e-9] = np.nan
    normals = unit_vector(normals)
    offsets = np.vecdot(normals, seeds)
    misses = np.abs(normals @ sample.T - offsets[:, None])
    best = np.sum(misses < PLANE_NOISE, axis=1).argmax()
    normal = normals[best]
    distance = offsets[best]
    for _ in range(REFINE_ROUNDS):
        on = points[np.abs(points @ normal - distance) < PLANE_NOISE]
        if upright is not None:
            on = np.concatenate([on + 0.1 * upright, on - 0.1 * upright])
        normal, distance = fit_plane(on)[:2]
    return normal, distance


def plane_size(flat: np.ndarray) -> tuple[float, float]:
    """Area (m2; 0 for a single line) and greatest length (m) of points (n, 2) in a plane."""
    hull = cv2.convexHull(flat.astype(np.float32))[:, 0]
    return cv2.contourArea(hull), pdist(hull).max()


def row_ends(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and last True of each row.

    Parameters
    ----------
    mask : ndarray of bool, shape (n, m)

    Returns
    -------
    rows : ndarray of int, shape (k,)
        Without those that have none.
    ends : ndarray of int, shape (k, 2)
    """
    rows = np.flatnonzero(mask.any(axis=1))
    first = mask[rows].argmax(axis=1)
    from_end = mask[rows, ::-1].argmax(axis=1)
    return rows, np.stack([first, mask.shape[1] - 1 - from_end], axis=1)


def _by_distance(sweep):
    """Smallest range and cells (L, B) of the connected surfaces of a sweep, the nearest first."""
    labels, count = surfaces(sweep, sweep.ranges)
    numbers = np.flatnonzero(count >= FEWEST_POINTS)
    nearest = ndimage.minimum(sweep.ranges, labels, numbers)
    for k in np.argsort(nearest):
        yield nearest[k], labels == numbers[k]


def _planes(sweep, points, mask, upright, rng):
    """Flat connected parts of a surface: the largest plane first, then what is left."""
    left = mask.copy()
    for _ in range(MOST_PLANES):
        if left.sum() < FEWEST_POINTS:
            return
        try:
            normal, distance = best_plane(points[left], upright, rng)
        except DegenerateGeometry:
            return
        on = left & (np.abs(points @ normal - distance) < PLANE_NOISE)
        labels, count = surfaces(sweep, np.where(on, sweep.ranges, np.nan))
        for label in np.flatnonzero(count >= max(FEWEST_POINTS, SMALL_PART * count.max())):
            yield Surface(labels == label, normal, distance)
        left &= ~on


def _trimmed(part, points, limits):
    """A flat surface, where it has not the board's size without thin strips of floor or wall."""
    if limits.hold(*part.size(points)):
        return part
    whole = ndimage.binary_closing(part.mask, iterations=2)
    labels, count = ndimage.label(ndimage.binary_opening(whole, np.ones((5, 5))))
    if count == 0:
        return part
    core = labels == np.bincount(labels[labels > 0]).argmax()
    about = ndimage.binary_dilation(core, np.ones((3, 3)))
    return replace(part, mask=part.mask & about)


def _grown(surface, points):
    """With the returns in and beside it that noise takes off its plane, but no farther."""
    miss = np.abs(points @ surface.normal - surface.distance)
    reach = np.clip(3 * robust_sigma(miss[surface.mask]), PLANE_NOISE, LARGEST_NOISE)
    about = ndimage.binary_dilation(surface.mask, np.ones((3, 3)))
    return replace(surface, mask=surface.mask | (about & (miss < reach)))


def _size_limits(board, grown):
    """Limits of a board with its outline grown (m)."""
    corners = board.outline()
    area, length = plane_size(corners)
    if board.corners is None:
        return Limits(0.3 * area, 4 * area, 2.5 * length)
    rim = cv2.arcLength(corners.astype(np.float32), True)
    return Limits(0.25 * area, 1.35 * area + grown * rim, 1.2 * length + 2 * grown)


def _fault(surface, points, pitch, T_head_lrf):
    """Why a surface of the board's size is no board: seen along itself, patchy; or ''.

    A pitch in radians where degrees are expected flattens boards into such surfaces.
    """
    cells = np.argwhere(surface.mask)
    rays = points[surface.mask] - tilt(T_head_lrf.translation, pitch[cells[:, 0]])
    cosine = np.abs(unit_vector(rays) @ surface.normal)
    if np.median(cosine) * STEEPEST < 1:
        return " seen along itself"
    hull = cv2.convexHull(cells[:, ::-1].astype(np.int32))
    whole = cv2.fillConvexPoly(np.zeros(surface.mask.shape, np.uint8), hull, 1)
    fill = len(cells) / whole.sum()
    if fill < LEAST_FILL:
        return f" filled to {100 * fill:.0f} %"
    return ""
