"""The board in the range image of a sweep: pieces without a jump, planes, a median filter,
lines.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist, pdist
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.robust import NORMAL, biweight, robust_sigma
from lrfcal_lib.model.geometry import (
    fit_plane,
    lrf_to_platform,
    polar_covariance,
    polar_to_points,
    tilt,
)
from lrfcal_lib.session.read import Sweep

# a face seen at a flatter angle than 10 deg is taken for a depth jump
STEEPEST = np.tan(np.radians(80))
# metres; what noise and dark print change between neighbouring beams of one face
DEPTH_NOISE = 0.03
PLANE_NOISE = 0.02  # metres; noise and warp of a board about its plane
LONGEST_HOLE = 0.15  # metres; a gap without returns that does not end a surface (print, gloss)
# metres; the farthest from its plane that a return of a noisy device still counts
LARGEST_NOISE = 0.04
FEWEST_POINTS = 12
# share of its convex hull that a board fills; what clutter leaves on a plane is patchy
LEAST_FILL = 0.5
# that a surface of a sweep must span: points of one scan line lie in a plane whatever they hit
FEWEST_LINES = 4
# spot radii from the last beam on the board that see its face alone; share of a row
CLEAR = 2.0
MOST_MARGIN = 1 / 3
RIGID_SIZES = (0.02, 4.0, 4.0)  # m2, m2, m: what may be a board when nothing is known about it


class BoardNotFound(ValueError):
    """No board in a sweep; the message says what was seen instead."""


def depth_jump(ranges, step):
    """Change of range (metres) between beams a `step` apart that no face of a board makes."""
    return DEPTH_NOISE + STEEPEST * np.asarray(ranges) * np.abs(step)


def segments(ranges, *, jump=DEPTH_NOISE, bridge=0):
    """Cut scan lines at depth discontinuities; step (i) of the paper's preprocessing.

    A change of range above `jump` a beam ends a piece, and a gap of more than `bridge` beams.
    Returns the number by beam, ascending along the lines, -1 where there is no return.
    """
    seen = np.isfinite(ranges)
    line, beam = np.nonzero(seen)
    jump = np.broadcast_to(jump, ranges.shape)[seen]
    bridge = np.broadcast_to(bridge, ranges.shape)[seen]
    gap = np.diff(beam)
    change = np.abs(np.diff(ranges[seen]))
    broken = np.diff(line) != 0
    broken |= gap - 1 > bridge[1:]
    broken |= change > gap * jump[1:]
    labels = np.full(ranges.shape, -1)
    labels[seen] = np.cumsum(np.r_[True, broken])[: len(line)] - 1
    return labels


def surfaces(ranges, bearings, pitch):
    """Connected surfaces of a range image: numbers (L, B) of pieces joined across the lines.

    -1 without a return.
    """
    step = np.median(np.diff(bearings)) if len(bearings) > 1 else 0.0
    near = np.where(np.isfinite(ranges), ranges, 1.0)
    bridge = (LONGEST_HOLE / np.maximum(near * step, 1e-9)).astype(int)
    pieces = segments(ranges, jump=depth_jump(near, step), bridge=bridge)
    turned = np.diff(pitch)[:, None]
    close = np.abs(np.diff(ranges, axis=0)) < depth_jump(near[1:], turned)
    n = pieces.max(initial=-1) + 1
    if n == 0:
        return pieces
    above = pieces[:-1][close]
    below = pieces[1:][close]
    graph = coo_array((np.ones(len(above)), (above, below)), shape=(n, n))
    joined = connected_components(graph, directed=False)[1]
    return np.where(pieces >= 0, joined[pieces], -1)


def planar_surface(sweep, T_head_lrf, board, rng, lrf=None):
    """The nearest flat connected surface of a board's size: mask (L, B), normal and distance.

    In the platform frame. A spot (of an LrfInfo) that reads the board while it only touches it
    makes it larger by its radius all around.

    With all scan lines at one pitch they do not determine the plane; the one at right angles to the
    scan plane is taken then. BoardNotFound says what was seen instead.
    """
    if not np.isfinite(sweep.ranges).any():
        raise BoardNotFound(f"no return in {len(sweep.pitch)} scan lines")
    p_lrf = polar_to_points(sweep.ranges, sweep.bearings)
    points = lrf_to_platform(p_lrf, sweep.pitch[:, None], T_head_lrf)
    single = len(sweep.pitch) == 1 or np.ptp(sweep.pitch) <= 1e-4
    upright = None
    if single:
        across_scan = T_head_lrf.rotation.apply([0.0, 0.0, 1.0])
        upright = tilt(across_scan, float(sweep.pitch[0]))
    labels = surfaces(sweep.ranges, sweep.bearings, sweep.pitch)
    seen = []
    best = (np.inf,)
    numbers, counts = np.unique(labels[labels >= 0], return_counts=True)
    nearest = ndimage.minimum(sweep.ranges, labels, numbers)
    enough = np.flatnonzero(counts >= FEWEST_POINTS)
    for k in enough[np.argsort(nearest[enough])]:
        if nearest[k] > best[0]:
            break
        for mask, plane in _planes(sweep, points, labels == numbers[k], upright, rng):
            if sweep.ranges[mask].min() > best[0]:
                continue
            reach = float(np.median(sweep.ranges[mask]))
            grown = 0.0 if lrf is None else float(lrf.spot_radius(reach))
            limits = _size_limits(board, grown)
            mask, (area, length), fits = _trimmed(points, mask, plane[0], limits, upright)
            fault = "" if single else _fault(sweep, T_head_lrf, points, mask, plane[0])
            seen.append(f"{area:.2f} m2, {length:.2f} m long at {reach:.2f} m{fault}")
            if fits and not fault and reach < best[0]:
                best = (reach, mask, *plane)
    if len(best) == 1:
        sizes = "; ".join(seen[:4]) or "no flat surface"
        raise BoardNotFound(f"no flat surface of the board's size; seen: {sizes}")
    _, mask, normal, distance = best
    # with the returns in and beside it that only the noise of its own points takes off its plane
    miss = np.abs(points @ normal - distance)
    reach = np.clip(3 * robust_sigma(miss[mask]), PLANE_NOISE, LARGEST_NOISE)
    about = ndimage.binary_dilation(mask, np.ones((3, 3)))
    return mask | (about & (miss < reach)), normal, distance


def _planes(sweep, points, surface, upright, rng, most=25):
    """Flat connected parts of a surface: the largest plane first, then what is left."""
    left = surface.copy()
    known = np.nan_to_num(points, nan=1e9)
    for _ in range(most):
        if left.sum() < FEWEST_POINTS:
            return
        plane = best_plane(points[left], upright, rng)
        if plane is None:
            return
        normal, distance = plane
        on = left & (np.abs(known @ normal - distance) < PLANE_NOISE)
        labels = surfaces(np.where(on, sweep.ranges, np.nan), sweep.bearings, sweep.pitch)
        count = np.bincount(labels[labels >= 0])
        for label in np.flatnonzero(count >= max(FEWEST_POINTS, 0.2 * count.max())):
            yield labels == label, plane
        left &= ~on


def best_plane(points, upright, rng, trials=200, sample=1500):
    """Random sample consensus over neighbours, then least squares over all that agree, or None."""
    few = points[rng.permutation(len(points))[:sample]]
    seeds = few[rng.integers(len(few), size=trials)]
    near = cdist(seeds, few)
    neighbours = (near < 0.3) & (near > 1e-6)  # metres
    lots = np.where(neighbours, rng.random(near.shape), -1.0)
    others = few[np.argpartition(-lots, 1, axis=1)[:, :2]]
    second = upright
    if upright is None:
        second = others[:, 1] - seeds
    normals = np.cross(others[:, 0] - seeds, second)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    good = length[:, 0] > 1e-9
    normals = normals[good] / length[good]
    offsets = np.sum(normals * seeds[good], axis=1)
    if len(normals) == 0:
        return None
    misses = np.abs(normals @ few.T - offsets[:, None])
    best = np.sum(misses < PLANE_NOISE, axis=1).argmax()
    plane = normals[best], offsets[best]
    for _ in range(3):
        normal, distance = plane
        on = points[np.abs(points @ normal - distance) < PLANE_NOISE]
        if upright is not None:
            on = np.concatenate([on + 0.1 * upright, on - 0.1 * upright])
        try:
            plane = fit_plane(on)[:2]
        except ValueError:  # too few points, or all on one line
            return None
    return plane


def _trimmed(points, mask, normal, limits, upright):
    """A flat surface, if need be without thin strips of floor or wall.

    Its size, and whether it may be the board.
    """
    least, most, longest = limits
    size = plane_size(points[mask], normal, upright)
    area, length = size
    if upright is not None:
        return mask, size, 0.3 * np.sqrt(least) < length < longest
    if not (least < area < most and length < longest):
        whole = ndimage.binary_closing(mask, iterations=2)
        core = ndimage.binary_opening(whole, np.ones((5, 5)))
        labels, count = ndimage.label(core)
        if count == 0:
            return mask, size, False
        core = labels == np.bincount(labels[labels > 0]).argmax()
        mask = mask & ndimage.binary_dilation(core, np.ones((3, 3)))
        area, length = plane_size(points[mask], normal)
    return mask, size, least < area < most and length < longest


def _size_limits(board, grown):
    """Least and largest area (m2), greatest length (m) of a board with its outline grown (m)."""
    if board is not None and board.corners is not None:
        hull = ConvexHull(board.corners)
        area = hull.volume
        rim = hull.area  # of a plane figure: its circumference
        length = pdist(board.corners).max()
        return 0.25 * area, 1.35 * area + grown * rim, 1.2 * length + 2 * grown
    if board is not None and board.pattern is not None:
        pattern = board.pattern
        sides = pattern.square * np.array([pattern.columns + 1, pattern.rows + 1])
        area = np.prod(sides)
        return 0.3 * area, 4 * area, 2.5 * np.linalg.norm(sides)
    return RIGID_SIZES


def _fault(sweep, T_head_lrf, points, mask, normal):
    """Why a surface is no face of a board: few scan lines, seen along itself, patchy; or ''."""
    lines = int(mask.any(axis=1).sum())
    if lines < min(FEWEST_LINES, len(sweep.pitch)):
        return f" on {lines} of {len(sweep.pitch)} scan lines"
    cells = np.argwhere(mask)
    rays = points[mask] - tilt(T_head_lrf.translation, sweep.pitch[cells[:, 0]])
    cosine = np.abs(rays @ normal) / np.linalg.norm(rays, axis=1)
    if np.median(cosine) * STEEPEST < 1:
        return " seen along itself"
    try:
        hull = ConvexHull(cells)
    except QhullError:
        return ""
    corners = cells[hull.vertices]
    sides = np.abs(np.roll(corners, -1, axis=0) - corners)
    rim = np.gcd(*sides.T).sum()
    within = hull.volume + rim / 2 + 1  # cells of the hull, by Pick's theorem
    fill = len(cells) / within
    if fill < LEAST_FILL:
        return f" filled to {100 * fill:.0f} %"
    return ""


def plane_axes(normal):
    """Two unit vectors in a plane, shape (2, 3): the first as level as the second is steep."""
    other = [1.0, 0.0, 0.0] if abs(normal[0]) < 0.9 else [0.0, 1.0, 0.0]
    across = np.cross(normal, other)
    across /= np.linalg.norm(across)
    return np.stack([np.cross(across, normal), across])


def plane_size(points, normal, upright=None):
    """Area (m2; 0 for a single line) and greatest length (m) of points in a plane."""
    if upright is not None:
        return 0.0, float(np.ptp(points @ np.cross(normal, upright)))
    flat = points @ plane_axes(normal).T
    try:
        hull = ConvexHull(flat)
    except QhullError:
        return 0.0, float(np.linalg.norm(np.ptp(flat, axis=0)))
    return float(hull.volume), float(pdist(flat[hull.vertices]).max())


MEDIAN_WIDTH = 5  # beams
FEWEST_BEAMS = 4  # on a scan line, for a straight line with a covariance


@dataclass(frozen=True)
class BoardScan:
    """The board in one sweep.

    Attributes
    ----------
    placement : int
    sweep : Sweep
    T_head_lrf : RigidTransform
        The platform used to join scan lines; only nominal.
    mask : ndarray of bool, shape (L, B)
        Beams that hit the board; False in holes.
    filtered : ndarray, shape (L, B)
        Median-filtered ranges on the board, metres; NaN elsewhere.
    fitted : ndarray, shape (L, B)
        Ranges of the straight line fitted to each scan line, for every beam from the first to the
        last on the board (holes included), metres; NaN elsewhere.
    lines : ndarray, shape (L, 2)
        The fitted lines ``u . p = 1`` in the scan plane, 1/metre; NaN for a line with too few
        beams.
    lines_covariance : ndarray, shape (L, 2, 2)
    normal : ndarray, shape (3,)
        Of the board's plane in the nominal platform frame.
    distance : float
        ``normal . p_platform = distance``, metres.
    sigma_range : float
        Standard deviation of a range about the fitted lines, metres (noise, print and warp
        together).
    n_jump_points : int
        Returns within or next to the board that were rejected: mixed pixels and outliers.
    spot : float
        Angle that the radius of the spot takes up at the board, radians; 0 where nothing states it.
    """

    placement: int
    sweep: Sweep
    T_head_lrf: RigidTransform
    mask: np.ndarray
    filtered: np.ndarray
    fitted: np.ndarray
    lines: np.ndarray
    lines_covariance: np.ndarray
    normal: np.ndarray
    distance: float
    sigma_range: float
    n_jump_points: int
    spot: float = 0.0


def find_board(sweep, board=None, T_head_lrf=None, lrf=None, *, rng=None):
    """Find the board in a sweep, filter its ranges and fit a straight line to each scan line.

    Parameters
    ----------
    sweep : Sweep
    board : Board, optional
        Tells the size by its outline, else by its pattern; anything from 0.02 to 4 m2 without it.
    T_head_lrf : RigidTransform, optional
        Roughly known platform; without it the tilt axis is taken to be the x axis of the LRF.
    lrf : LrfInfo, optional
        States the spot.
    rng : numpy.random.Generator, optional
        For the random sampling; by default always the same.

    Returns
    -------
    BoardScan

    Raises
    ------
    BoardNotFound
        If no flat surface has the board's size.
    """
    if T_head_lrf is None:
        T_head_lrf = RigidTransform.identity()
    if rng is None:
        rng = np.random.default_rng(0)
    mask, normal, distance = planar_surface(sweep, T_head_lrf, board, rng, lrf)
    filtered = median_filter(sweep.ranges, mask)
    lines, information = fit_lines(filtered, sweep.bearings)
    fitted = np.where(_span(mask), _line_ranges(lines, sweep.bearings), np.nan)
    residuals = np.where(mask, sweep.ranges - fitted, np.nan)
    residuals[np.abs(residuals) > PLANE_NOISE * 2] = np.nan
    if not np.isfinite(residuals).any():
        raise BoardNotFound(f"no scan line has {FEWEST_BEAMS} beams on the board")
    sigma = float(np.sqrt(np.nanmean(residuals**2)))
    covariance = np.linalg.inv(information) * sigma**2
    spot = 0.0
    if lrf is not None and lrf.spot_exit is not None:
        reach = float(np.nanmedian(fitted))
        spot = float(lrf.spot_radius(reach)) / reach
    return BoardScan(
        placement=sweep.placement,
        sweep=sweep,
        T_head_lrf=T_head_lrf,
        mask=mask,
        filtered=filtered,
        fitted=fitted,
        lines=lines,
        lines_covariance=covariance,
        normal=normal,
        distance=distance,
        sigma_range=sigma,
        n_jump_points=int(jump_points(sweep.ranges, fitted, sigma).sum()),
        spot=spot,
    )


def median_filter(ranges, mask, width=MEDIAN_WIDTH):
    """Running median along the scan lines; step (ii) of the paper's preprocessing.

    `mask` (L, B) tells which returns take part, `width` is an odd number of beams; near an end or a
    hole only the beams that exist count. NaN outside the mask and where there is no return.
    """
    if width < 1 or width % 2 == 0:
        raise ValueError(f"the width of a median filter is odd and positive, got {width}")
    taken = np.where(np.isfinite(ranges) & mask, ranges, np.nan)
    out = np.full(taken.shape, np.nan)
    line, beam = np.nonzero(np.isfinite(taken))
    half = width // 2
    padded = np.pad(taken, ((0, 0), (half, half)), constant_values=np.nan)
    window = beam[:, None] + np.arange(width)
    out[line, beam] = row_median(padded[line[:, None], window])
    return out


def fit_lines(ranges, bearings, rounds=4):
    """A straight line to every scan line at once, robust against outliers (Tukey's weights).

    Parameters
    ----------
    ranges : ndarray, shape (L, B)
        Metres; NaN does not take part.
    bearings : ndarray, shape (B,)
        Radians.

    Returns
    -------
    lines : ndarray, shape (L, 2)
        ``u`` with ``u . (x, y) = 1``; NaN with fewer than four beams. In polar form ``1 / r = u .
        (cos b, sin b)`` is linear in u, with weights r^4 because of 1 / r.
    information : ndarray, shape (L, 2, 2)
        Inverse covariance for ranges with a standard deviation of 1 m; NaN with fewer than four
        beams.
    """
    rays = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    products = rays[:, :, None] * rays[:, None, :]
    seen = np.isfinite(ranges)
    r = np.where(seen, ranges, 1.0)
    enough = seen.sum(axis=1) >= FEWEST_BEAMS
    base = weights = np.where(seen & enough[:, None], r**4, 0.0)
    for _ in range(rounds):
        information = np.einsum("lb,bij->lij", weights, products)
        right = (weights / r) @ rays
        information[~enough] = np.eye(2)
        right[~enough] = np.nan
        lines = np.linalg.solve(information, right[..., None])[..., 0]
        misses = np.where(seen, np.abs(r - _line_ranges(lines, bearings)), np.nan)
        with np.errstate(invalid="ignore"):
            sigma = np.maximum(NORMAL * row_median(misses), 1e-4)[:, None]
            weights = np.nan_to_num(base * biweight(misses, sigma))
    information[~enough] = np.nan
    return lines, information


def row_median(values):
    """Median of each row without its NaN; NaN for an empty row."""
    ordered = np.sort(values, axis=1)
    count = np.isfinite(ordered).sum(axis=1)
    low = np.maximum(count - 1, 0) // 2
    high = np.minimum(count // 2, values.shape[1] - 1)
    rows = np.arange(len(values))
    return (ordered[rows, low] + ordered[rows, high]) / 2


def _line_ranges(lines, bearings):
    """Ranges of the fitted lines: every line in every direction (lines (L, 2), bearings (B,)),
    shape (L, B).
    """
    along = lines @ np.stack([np.cos(bearings), np.sin(bearings)])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(along > 0, 1 / along, np.nan)


def row_ends(mask):
    """First and last True of each row.

    Rows without one are left out. Returns (rows, first, last).
    """
    rows = np.flatnonzero(mask.any(axis=1))
    first = mask[rows].argmax(axis=1)
    from_end = mask[rows, ::-1].argmax(axis=1)
    return rows, first, mask.shape[1] - 1 - from_end


def _span(mask, trim=0):
    """True from the first to the last True of each row, without `trim` beams at both ends.

    A number, or one a row.
    """
    rows, first, last = row_ends(mask)
    beam = np.arange(mask.shape[1])
    out = np.zeros(mask.shape, bool)
    after = beam >= (first + trim)[:, None]
    before = beam <= (last - trim)[:, None]
    out[rows] = after & before
    return out


def jump_points(ranges, fitted, sigma_range):
    """Mixed pixels and outliers (L, B): neither of the board nor of a surface behind it.

    Returns on the board's span of a scan line that miss it by more than four sigma (two centimetres
    at least), and pieces of at most two beams (cut at jumps of that size) directly beside it.
    """
    on = np.isfinite(fitted)
    threshold = max(4 * sigma_range, PLANE_NOISE)
    with np.errstate(invalid="ignore"):
        inside = on & (np.abs(ranges - fitted) > threshold)
    pieces = segments(ranges, jump=threshold)
    size = np.bincount(pieces[pieces >= 0], minlength=1)
    single = (pieces >= 0) & (size[pieces] <= 2)
    return inside | (single & _span(on, -2) & ~on)


def count_jump_points(scan):
    """Number of jump points of a BoardScan as recorded and after a median filter (figure 5).

    The filter runs over the board's returns and the jump points among and beside them, without the
    background: what step (i) of the paper leaves.
    """
    jumps = jump_points(scan.sweep.ranges, scan.fitted, scan.sigma_range)
    filtered = median_filter(scan.sweep.ranges, scan.mask | jumps)
    return scan.n_jump_points, int(jump_points(filtered, scan.fitted, scan.sigma_range).sum())


def face_points(scan, count=1000, margin=0.06):
    """Points on the face of the board, away from its edges, evenly thinned.

    Parameters
    ----------
    scan : BoardScan
    count : int
        At most.
    margin : float
        What is left out at either end of a scan line and of a column, as a fraction of it; never
        less than two beams, nor than a spot that reaches over the edge: it reads the mean of its
        part on the board, and a slanted board would seem less so.

    Returns
    -------
    points : ndarray, shape (m, 3)
        LRF frame at the pitch of the point, metres, at the recorded range. Without outliers: mixed
        pixels inside the board, four standard deviations off the fitted scan line.
    pitch : ndarray, shape (m,)
        Radians.
    covariance : ndarray, shape (m, 3, 3)
    """
    with np.errstate(invalid="ignore"):
        miss = np.abs(scan.sweep.ranges - scan.fitted)
        good = scan.mask & (miss < 4 * scan.sigma_range)
    along = CLEAR * scan.spot / max(median_step(scan.sweep.bearings), 1e-6)
    down = CLEAR * scan.spot / max(median_step(scan.sweep.pitch), 1e-6)
    good &= _interior(scan.mask, margin, along)
    good &= _interior(scan.mask.T, margin, down).T
    line, beam = np.nonzero(good)
    if len(line) > count:
        keep = np.linspace(0, len(line) - 1, count).round().astype(int)
        line = line[keep]
        beam = beam[keep]
    ranges = scan.sweep.ranges[line, beam]
    bearings = scan.sweep.bearings[beam]
    # keeps the covariance regular; bearings are all but exact
    spread = 0.1 * np.median(np.diff(scan.sweep.bearings))
    covariance = polar_covariance(ranges, bearings, scan.sigma_range, spread)
    return polar_to_points(ranges, bearings), scan.sweep.pitch[line], covariance


def median_step(angles):
    """Median step between neighbouring angles; infinite for a single one."""
    if len(angles) < 2:
        return np.inf
    return np.median(np.abs(np.diff(angles)))


def _interior(mask, margin, spot):
    """Without the outer part of each row: a fraction `margin`, and `spot` cells.

    The latter where that leaves half of the row. A row too short for that (a sweep of one line,
    seen by columns) stays.
    """
    _, first, last = row_ends(mask)
    size = last - first
    least = np.maximum(2, np.minimum(spot, MOST_MARGIN * size))
    trim = np.maximum(least, margin * size).astype(int)
    return _span(mask, np.where(size < 6, 0, trim))
