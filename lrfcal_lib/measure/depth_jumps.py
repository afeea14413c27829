"""Where the depth of a sweep jumps: places on the rims of what stands before something else."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from lrfcal_lib.calibrate.reconstruct import grid_normals
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.measure.pulls import directions
from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points
from lrfcal_lib.session.read import Sweep
from lrfcal_lib.session.stated import LrfInfo

LEAST_JUMP = 0.15  # metres; 15 times the noise of a range of an outdoor LMS
BESIDE = 4  # readings on either side that must lie on one surface
ROUGH = 3.0  # sigma, of these about a line
STEEPEST = 0.1  # of a jump from one reading to the next: a rim, no slanted surface
REACH = 5.0  # steps about a place, in which its rim is straight
FEWEST = 6  # places of a straight rim
STRAIGHT = 0.6  # steps: standard deviation of places across a rim
LEAST_COSINE = 0.05  # of incidence
LEAST_STEP = np.radians(0.01)  # of a head that rests nearly
SAME_SURFACE = 0.05  # of the range: neighbours along a rim


@dataclass(frozen=True)
class DepthJumps:
    """Places on the rims of nearer surfaces, a row each.

    Attributes
    ----------
    bearing, pitch, range : ndarray, shape (n,)
        Of the rim as beams have it, corrected: radians, radians, metres.
    along, outward : ndarray, shape (n, 2)
        Unit vectors of bearing and pitch along the rim, and away from the nearer surface.
    slope : ndarray, shape (n,)
        By which the range of the nearer surface grows outwards, metres a radian.
    behind : ndarray, shape (n,)
        Range of the farther surface, metres.
    returns : ndarray, shape (n,)
        Log of what the farther surface sends back over what the nearer one does, as distance and
        incidence tell it: the reflectivity is not in it.
    radius : ndarray, shape (n,)
        Of the spot at the rim, metres.
    rim : ndarray of int, shape (n,)
        Number of the rim. Places of one rim err together.
    """

    bearing: np.ndarray
    pitch: np.ndarray
    range: np.ndarray
    along: np.ndarray
    outward: np.ndarray
    slope: np.ndarray
    behind: np.ndarray
    returns: np.ndarray
    radius: np.ndarray
    rim: np.ndarray


def depth_jumps(
    sweep: Sweep, rig: CalibratedRig, lrf: LrfInfo, continuous: bool = False
) -> DepthJumps:
    """Find straight rims in a sweep, along and across its scan lines.

    Parameters
    ----------
    sweep : Sweep
    rig : CalibratedRig
        Its corrections count but for those of single sweeps, which are of other recordings.
    lrf : LrfInfo
        Knows spot and noise.
    continuous : bool
        The head moved on within a scan line.

    Returns
    -------
    DepthJumps
        None, of zero rows, where nothing stands before anything else.
    """
    grid = directions(sweep, rig, lrf, continuous)
    ranges = sweep.ranges - rig.corrections.range_offset
    energy = _energy(ranges, grid, rig)
    found = [_crossings(ranges, grid, energy, lrf)]
    if len(sweep.pitch) > 1:
        found.append(_crossings(ranges.T, np.swapaxes(grid, 0, 1), energy.T, lrf))
    place, outward, *surfaces = (np.concatenate(part) for part in zip(*found, strict=True))
    return _straight(place, outward, np.stack(surfaces), lrf)


def _energy(ranges, grid, rig):
    """Log (l, b) of what a matt surface sends back: by its distance and incidence."""
    bearing, pitch = np.moveaxis(grid, -1, 0)
    p_lrf = polar_to_points(ranges, bearing)
    points = lrf_to_platform(p_lrf, pitch, rig.T_head_lrf)
    origin = lrf_to_platform(np.zeros(3), pitch, rig.T_head_lrf)
    normals, _ = grid_normals(points, origin)
    cosine = np.vecdot(normals, origin - points) / ranges
    return np.log(np.nan_to_num(cosine, nan=1.0).clip(LEAST_COSINE)) - 2 * np.log(ranges)


def _crossings(ranges, grid, energy, lrf):
    """Jumps along the second axis of ranges (l, b) at directions (l, b, 2).

    Directions (n, 2) of the jump and outwards, range and slope of the nearer side, range of the
    farther one and what it returns.
    """
    steps = np.linalg.norm(np.diff(grid, axis=1), axis=-1)
    step = max(float(np.median(steps)), LEAST_STEP)
    typical = float(np.nanmedian(ranges))
    gap = int(np.ceil(lrf.spot_radius(typical) / typical / step))
    side = gap + BESIDE
    if ranges.shape[1] < 2 * side:
        return (np.zeros(shape) for shape in ((0, 2), (0, 2), 0, 0, 0, 0))
    windows = np.lib.stride_tricks.sliding_window_view(ranges, 2 * side, axis=1)
    first, first_slope, first_rough = _rim(windows[..., :BESIDE], side)
    last, last_slope, last_rough = _rim(windows[..., ::-1][..., :BESIDE], side)
    jump = last - first
    middle = (first + last)[..., None] / 2
    with np.errstate(invalid="ignore"):
        beyond = (windows - middle) * np.sign(jump)[..., None] > 0
        clear = np.abs(jump) > LEAST_JUMP
        clear &= np.maximum(first_rough, last_rough) < ROUGH * lrf.sigma_range
        clear &= np.maximum(np.abs(first_slope), np.abs(last_slope)) < STEEPEST * np.abs(
            jump
        )
    clear &= np.isfinite(windows).all(axis=-1)
    clear &= ~beyond[..., :side].any(axis=-1) & beyond[..., side:].all(axis=-1)
    line, start = np.nonzero(clear)
    low = ranges[line, start + side - 1]
    high = ranges[line, start + side]
    share = ((middle[line, start, 0] - low) / (high - low))[:, None]
    before = grid[line, start + side - 1]
    way = grid[line, start + side] - before
    sign = np.sign(jump[line, start])
    near = np.minimum(first, last)[line, start]
    far = np.maximum(first, last)[line, start]
    outward = sign[:, None] * way / np.linalg.norm(way, axis=1, keepdims=True)
    more = energy[line, start + 2 * side - BESIDE // 2] - energy[line, start + BESIDE // 2]
    slope = np.where(sign > 0, first_slope[line, start], last_slope[line, start]) / step
    return before + share * way, outward, near, slope, far, sign * more


def _rim(readings, side):
    """Readings (..., BESIDE) drawn on to the middle of 2 `side` of them: range, slope, and
    scatter about the line.
    """
    at = np.arange(BESIDE) - (BESIDE - 1) / 2
    mean = readings.mean(axis=-1)
    slope = readings @ at / (at @ at)
    rough = np.sqrt(
        np.mean((readings - mean[..., None] - slope[..., None] * at) ** 2, axis=-1)
    )
    return mean + slope * (side - BESIDE / 2), slope, rough


def _straight(place, outward, surfaces, lrf):
    """The DepthJumps among places (n, 2) that lie on straight rims, moved onto them."""
    step = lrf.bearing_step
    near = surfaces[0]
    tree = cKDTree(place)
    rows = []
    links = []
    for i, others in enumerate(tree.query_ball_point(tree.data, REACH * step)):
        others = np.array(others)
        others = others[np.abs(near[others] - near[i]) < SAME_SURFACE * near[i]]
        if len(others) < FEWEST:
            continue
        mean = place[others].mean(axis=0)
        size, axes = np.linalg.eigh(np.cov(place[others].T))
        along = axes[:, 1]
        across = axes[:, 0] * np.sign(axes[:, 0] @ outward[i])
        # a jump along beams tells little of a rim that runs along them
        if np.sqrt(size[0]) > STRAIGHT * step or across @ outward[i] < np.sqrt(0.5):
            continue
        on_rim = mean + along * (along @ (place[i] - mean))
        about = np.median(surfaces[:, others], axis=1)
        rows.append((i, *on_rim, *about, *along, *across))
        links += [(i, other) for other in others]
    table = np.array(rows).reshape(-1, 11)
    index = table[:, 0].astype(int)
    links = np.array(links, int).reshape(-1, 2)
    graph = coo_array((np.ones(len(links)), tuple(links.T)), shape=(len(place),) * 2)
    return DepthJumps(
        bearing=table[:, 1],
        pitch=table[:, 2],
        range=table[:, 3],
        slope=table[:, 4],
        behind=table[:, 5],
        returns=table[:, 6],
        along=table[:, 7:9],
        outward=table[:, 9:],
        radius=lrf.spot_radius(table[:, 3]),
        rim=connected_components(graph, directed=False)[1][index],
    )
