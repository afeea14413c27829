"""The board in the range image of a sweep: pieces without a jump, planes, a median filter, lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.geometry import DegenerateGeometry, fit_plane, polar_covariance, polar_to_points, tilt
from lrfcal_lib.session.read import Sweep

STEEPEST = np.tan(np.radians(80))  # a face seen at a flatter angle than 10 deg is taken for a depth jump
DEPTH_NOISE = 0.03  # metres; what noise and dark print change between neighbouring beams of one face
PLANE_NOISE = 0.02  # metres; noise and warp of a board about its plane
LONGEST_HOLE = 0.15  # metres; a gap without returns that does not end a surface (print, gloss)
LARGEST_NOISE = 0.04  # metres; the farthest from its plane that a return of a noisy device still counts
FEWEST_POINTS = 12
LEAST_FILL = 0.5  # share of its convex hull that a board fills; what clutter leaves on a plane is patchy
FEWEST_LINES = 4  # that a surface of a sweep must span: points of one scan line lie in a plane whatever they hit
RIGID_SIZES = (0.02, 4.0, 4.0)  # m2, m2, m: what may be a board when nothing is known about it


class BoardNotFound(ValueError):
    """No board in a sweep; the message says what was seen instead."""


def depth_jump(ranges, step):
    """Change of range between neighbours that no face of a board makes, metres.

    Parameters
    ----------
    ranges : array_like
        Metres.
    step : array_like, broadcastable
        Angle between the neighbours, radians.
    """
    return DEPTH_NOISE + STEEPEST * np.asarray(ranges) * np.abs(step)


def segments(ranges, *, jump=DEPTH_NOISE, bridge=0):
    """Cut scan lines at depth discontinuities; step (i) of the paper's preprocessing.

    Parameters
    ----------
    ranges : ndarray, shape (L, B)
        Metres, NaN where nothing came back.
    jump : float or ndarray, shape (L, B)
        Metres: a change of range between neighbours (times the number of steps between them) above this ends a piece.
    bridge : int or ndarray, shape (L, B)
        Number of beams without a return that do not end a piece by themselves.

    Returns
    -------
    ndarray of int, shape (L, B)
        Number of the piece, ascending along the lines; -1 where there is no return.
    """
    ranges = np.asarray(ranges, float)
    seen = np.isfinite(ranges)
    line, beam = np.nonzero(seen)
    r, jump, bridge = (np.broadcast_to(v, ranges.shape)[seen] for v in (ranges, jump, bridge))
    gap = np.diff(beam)
    broken = (np.diff(line) != 0) | (gap - 1 > bridge[1:]) | (np.abs(np.diff(r)) > gap * jump[1:])
    labels = np.full(ranges.shape, -1)
    labels[seen] = np.cumsum(np.r_[True, broken])[: len(r)] - 1
    return labels


def surfaces(ranges, bearings, pitch):
    """Connected surfaces of a range image: pieces of scan lines joined across the lines.

    Parameters
    ----------
    ranges : ndarray, shape (L, B)
        Metres.
    bearings : ndarray, shape (B,)
        Radians.
    pitch : ndarray, shape (L,)
        Radians.

    Returns
    -------
    ndarray of int, shape (L, B)
        Number of the surface, -1 where there is no return.
    """
    step = np.median(np.diff(bearings)) if len(bearings) > 1 else 0.0
    near = np.where(np.isfinite(ranges), ranges, 1.0)
    bridge = (LONGEST_HOLE / np.maximum(near * step, 1e-9)).astype(int)
    pieces = segments(ranges, jump=depth_jump(near, step), bridge=bridge)
    close = np.abs(np.diff(ranges, axis=0)) < depth_jump(near[1:], np.diff(pitch)[:, None])
    pairs = np.unique(np.stack([pieces[:-1][close], pieces[1:][close]]), axis=1)
    n = pieces.max(initial=-1) + 1
    graph = coo_array((np.ones(pairs.shape[1]), (pairs[0], pairs[1])), shape=(n, n))
    joined = connected_components(graph, directed=False)[1] if n else np.zeros(0, int)
    return np.where(pieces >= 0, np.append(joined, -1)[pieces], -1)


def planar_surface(sweep, T_head_lrf, board=None, rng=None):
    """The nearest flat connected surface of a board's size.

    Parameters
    ----------
    sweep : Sweep
    T_head_lrf : RigidTransform
    board : Board, optional
        Tells the size: its outline, else its pattern, else anything from 0.02 to 4 m2.
    rng : numpy.random.Generator, optional

    Returns
    -------
    mask : ndarray of bool, shape (L, B)
    normal : ndarray, shape (3,)
        Of the plane in the nominal platform frame. With all scan lines at one pitch the plane is not determined by
        them; the one at right angles to the scan plane is returned.
    distance : float
        ``normal . p_platform = distance``, metres.

    Raises
    ------
    BoardNotFound
        With what was seen instead.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    if not np.isfinite(sweep.ranges).any():
        raise BoardNotFound(f"placement {sweep.placement}: no return in {len(sweep.pitch)} scan lines")
    labels = surfaces(sweep.ranges, sweep.bearings, sweep.pitch)
    points = platform_points(sweep, T_head_lrf)
    upright = upright_direction(sweep, T_head_lrf)
    seen, best = [], None
    for label in _by_distance(labels, sweep.ranges):
        surface = labels == label
        if best is not None and np.nanmin(sweep.ranges[surface]) > best[0]:
            break
        for mask, plane in _planes(sweep, points, surface, upright, rng):
            if best is not None and np.nanmin(sweep.ranges[mask]) > best[0]:
                continue
            reach = float(np.median(sweep.ranges[mask]))
            mask, size, fits = _judge(points, mask, plane, board, upright)
            fault = "" if upright is not None else _fault(sweep, T_head_lrf, points, mask, plane)
            seen.append(f"{size[0]:.2f} m2, {size[1]:.2f} m long at {reach:.2f} m{fault}")
            if fits and not fault and (best is None or reach < best[0]):
                best = (reach, mask, *plane)
    if best is None:
        found = "; ".join(seen[:4]) or "no flat surface"
        raise BoardNotFound(f"placement {sweep.placement}: no flat surface of the board's size; seen: {found}")
    return _with_noisy_returns(points, *best[1:])


def _fault(sweep, T_head_lrf, points, mask, plane):
    """Why a surface of a sweep is no face of a board: few scan lines, seen along itself, patchy. '' if it may be."""
    lines = int(mask.any(axis=1).sum())
    if lines < min(FEWEST_LINES, len(sweep.pitch)):
        return f" on {lines} of {len(sweep.pitch)} scan lines"
    row, beam = np.nonzero(mask)
    rays = points[mask] - tilt(T_head_lrf.translation, sweep.pitch[row])
    slope = np.abs(rays @ plane[0]) / np.linalg.norm(rays, axis=1)
    if np.median(slope) * STEEPEST < 1:
        return " seen along itself"
    fill = _fill(row, beam)
    return f" filled to {100 * fill:.0f} %" if fill < LEAST_FILL else ""


def _fill(row, beam):
    """Share of the cells of the range image within the convex hull of some of them that these are (Pick's theorem)."""
    try:
        hull = ConvexHull(np.column_stack([row, beam]))
    except QhullError:
        return 1.0
    corners = hull.points[hull.vertices].astype(int)
    rim = np.gcd(*np.abs(np.roll(corners, -1, axis=0) - corners).T).sum()
    return len(row) / (hull.volume + rim / 2 + 1)


def _with_noisy_returns(points, mask, normal, distance):
    """A surface with the returns in and beside it that only the noise of its own points takes off its plane."""
    miss = np.abs(points @ normal - distance)
    reach = np.clip(3 * 1.4826 * np.median(miss[mask]), PLANE_NOISE, LARGEST_NOISE)
    return mask | (ndimage.binary_dilation(mask, np.ones((3, 3))) & (miss < reach)), normal, distance


def _judge(points, mask, plane, board, upright):
    """Whether a flat surface may be the board, if need be without the thin strips of floor or wall it touches."""
    size = plane_size(points[mask], plane[0], upright)
    if _plausible(size, board, upright is not None) or upright is not None:
        return mask, size, _plausible(size, board, upright is not None)
    core = ndimage.binary_opening(ndimage.binary_closing(mask, iterations=2), np.ones((5, 5)))
    labels, count = ndimage.label(core)
    if count == 0:
        return mask, size, False
    core = labels == np.bincount(labels[labels > 0]).argmax()
    trimmed = mask & ndimage.binary_dilation(core, np.ones((3, 3)))
    smaller = plane_size(points[trimmed], plane[0])
    return trimmed, size, _plausible(smaller, board, False)


def platform_points(sweep, T_head_lrf):
    """All returns in the nominal platform frame, shape (L, B, 3), NaN where there is none; equation (6)."""
    p_lrf = polar_to_points(sweep.ranges, sweep.bearings)
    p_head = p_lrf @ T_head_lrf.rotation.as_matrix().T + T_head_lrf.translation
    return tilt(p_head, sweep.pitch[:, None])


def upright_direction(sweep, T_head_lrf):
    """Normal of the scan plane in the platform frame where all lines share one pitch, else None."""
    if len(sweep.pitch) > 1 and np.ptp(sweep.pitch) > 1e-4:
        return None
    return tilt(T_head_lrf.rotation.apply([0.0, 0.0, 1.0]), float(sweep.pitch[0]))


def _by_distance(labels, ranges):
    """Surfaces with enough points, the nearest first."""
    seen = labels >= 0
    count = np.bincount(labels[seen])
    nearest = np.full(len(count), np.inf)
    np.minimum.at(nearest, labels[seen], ranges[seen])
    enough = np.flatnonzero(count >= FEWEST_POINTS)
    return enough[np.argsort(nearest[enough])]


def _planes(sweep, points, surface, upright, rng, most=25):
    """Flat connected parts of a surface: the largest plane first, then what is left."""
    left = surface.copy()
    for _ in range(most):
        if left.sum() < FEWEST_POINTS:
            return
        plane = _best_plane(points[left], upright, rng)
        if plane is None:
            return
        on = left & (np.abs(np.nan_to_num(points, nan=1e9) @ plane[0] - plane[1]) < PLANE_NOISE)
        labels = surfaces(np.where(on, sweep.ranges, np.nan), sweep.bearings, sweep.pitch)
        count = np.bincount(labels[labels >= 0])
        for label in np.flatnonzero(count >= max(FEWEST_POINTS, 0.2 * count.max())):
            yield labels == label, plane
        left &= ~on


def _best_plane(points, upright, rng, trials=200, sample=1500):
    """Random sample consensus over neighbouring points, then total least squares over all that agree."""
    few = points[rng.permutation(len(points))[:sample]]
    seeds = few[rng.integers(len(few), size=trials)]
    near = np.linalg.norm(seeds[:, None] - few, axis=2)
    near = np.where((near < 0.3) & (near > 1e-6), rng.random(near.shape), -1.0)
    others = few[np.argpartition(-near, 1, axis=1)[:, :2]]
    second = others[:, 1] - seeds if upright is None else np.broadcast_to(upright, seeds.shape)
    normals = np.cross(others[:, 0] - seeds, second)
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 1e-9] / length[length > 1e-9, None]
    offsets = np.sum(normals * seeds[length > 1e-9], axis=1)
    if len(normals) == 0:
        return None
    votes = np.sum(np.abs(normals @ few.T - offsets[:, None]) < PLANE_NOISE, axis=1)
    plane = normals[votes.argmax()], offsets[votes.argmax()]
    for _ in range(3):
        on = np.abs(points @ plane[0] - plane[1]) < PLANE_NOISE
        try:
            plane = _fit(points[on], upright)
        except DegenerateGeometry:
            return None
    return plane


def _fit(points, upright):
    if upright is not None:
        points = np.concatenate([points + 0.1 * upright, points - 0.1 * upright])
    return fit_plane(points)[:2]


def plane_axes(normal):
    """Two unit vectors in a plane, shape (2, 3): the first as level as the second is steep."""
    across = np.cross(normal, [1.0, 0.0, 0.0] if abs(normal[0]) < 0.9 else [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    return np.stack([np.cross(across, normal), across])


def plane_size(points, normal, upright=None):
    """Area (m2; 0 for a single line) and greatest length (m) of points in a plane."""
    flat = points @ plane_axes(normal).T
    if upright is None:
        try:
            hull = ConvexHull(flat)
        except QhullError:
            return 0.0, float(np.linalg.norm(np.ptp(flat, axis=0)))
        corners = flat[hull.vertices]
        return float(hull.volume), float(np.linalg.norm(corners[:, None] - corners, axis=2).max())
    return 0.0, float(np.ptp(points @ np.cross(normal, upright)))


def expected_size(board):
    """Least area, greatest area (m2) and greatest length (m) of what is seen of a board."""
    if board is not None and board.corners is not None:
        corners = np.asarray(board.corners, float)
        length = np.linalg.norm(corners[:, None] - corners, axis=2).max()
        return 0.25 * ConvexHull(corners).volume, 1.35 * ConvexHull(corners).volume, 1.2 * length
    if board is not None and board.pattern is not None:
        size = board.pattern.square * np.array([board.pattern.columns + 1, board.pattern.rows + 1])
        return 0.3 * np.prod(size), 4 * np.prod(size), 2.5 * np.linalg.norm(size)
    return RIGID_SIZES


def _plausible(size, board, single_line):
    least, most, longest = expected_size(board)
    if single_line:
        return 0.3 * np.sqrt(least) < size[1] < longest
    return least < size[0] < most and size[1] < longest


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
        Ranges of the straight line fitted to each scan line, for every beam from the first to the last on the board
        (holes included), metres; NaN elsewhere.
    lines : ndarray, shape (L, 2)
        The fitted lines ``u . p = 1`` in the scan plane, 1/metre; NaN for a line with too few beams.
    lines_covariance : ndarray, shape (L, 2, 2)
    normal : ndarray, shape (3,)
        Of the board's plane in the nominal platform frame.
    distance : float
        ``normal . p_platform = distance``, metres.
    sigma_range : float
        Standard deviation of a range about the fitted lines, metres (noise, print and warp together).
    n_jump_points : int
        Returns within or next to the board that were rejected: mixed pixels and outliers.
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

    def __repr__(self):
        rows = self.mask.any(axis=1).sum()
        return (
            f"BoardScan(placement {self.placement}: {self.mask.sum()} points on {rows} scan lines, "
            f"sigma {1000 * self.sigma_range:.1f} mm, {self.n_jump_points} jump points)"
        )


@dataclass(frozen=True)
class EdgeProfile:
    """The beams about one end of one scan line, for figure 5 of the paper.

    Attributes
    ----------
    bearings : ndarray, shape (n,)
        Radians.
    original, filtered, fitted : ndarray, shape (n,)
        Ranges as recorded, after the median filter, and on the fitted line (to its end), metres.
    """

    bearings: np.ndarray
    original: np.ndarray
    filtered: np.ndarray
    fitted: np.ndarray


def find_board(sweep, board=None, T_head_lrf=None, *, width=MEDIAN_WIDTH, rng=None):
    """Find the board in a sweep, filter its ranges and fit a straight line to each scan line.

    Parameters
    ----------
    sweep : Sweep
    board : Board, optional
        Tells the size (see :func:`lrfcal_lib.preprocess.board_in_scan.planar_surface`).
    T_head_lrf : RigidTransform, optional
        Roughly known platform; without it the tilt axis is taken to be the x axis of the LRF.
    width : int
        Of the median filter, beams, odd.
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
    T_head_lrf = RigidTransform.identity() if T_head_lrf is None else T_head_lrf
    mask, normal, distance = planar_surface(sweep, T_head_lrf, board, rng)
    filtered = median_filter(sweep.ranges, mask, width)
    lines, information = fit_lines(filtered, sweep.bearings)
    span = _span(mask)
    fitted = np.where(span, _line_ranges(lines, sweep.bearings), np.nan)
    residuals = np.where(mask, sweep.ranges - fitted, np.nan)
    off = np.abs(residuals) > PLANE_NOISE * 2
    sigma = float(np.sqrt(np.nanmean(np.where(off, np.nan, residuals) ** 2)))
    if not np.isfinite(sigma):
        raise BoardNotFound(f"placement {sweep.placement}: no scan line has {FEWEST_BEAMS} beams on the board")
    covariance = np.linalg.inv(information) * sigma**2
    jumps = int(jump_points(sweep.ranges, fitted, jump_threshold(sigma)).sum())
    plane = {"normal": normal, "distance": distance, "sigma_range": sigma, "n_jump_points": jumps}
    return BoardScan(sweep.placement, sweep, T_head_lrf, mask, filtered, fitted, lines, covariance, **plane)


def median_filter(ranges, mask=None, width=MEDIAN_WIDTH):
    """Running median along the scan lines; step (ii) of the paper's preprocessing.

    Parameters
    ----------
    ranges : ndarray, shape (L, B)
        Metres.
    mask : ndarray of bool, shape (L, B), optional
        Which returns take part; all by default.
    width : int
        Beams, odd. Near an end or a hole only the beams that exist count.

    Returns
    -------
    ndarray, shape (L, B)
        NaN outside the mask and where there is no return.

    Raises
    ------
    ValueError
        For an even or non-positive width.
    """
    if width < 1 or width % 2 == 0:
        raise ValueError(f"the width of a median filter is odd and positive, got {width}")
    taken = np.where(np.isfinite(ranges) & (True if mask is None else mask), ranges, np.nan)
    out = np.full(taken.shape, np.nan)
    line, beam = np.nonzero(np.isfinite(taken))
    if len(line) == 0:
        return out
    padded = np.pad(taken, ((0, 0), (width // 2, width // 2)), constant_values=np.nan)
    windows = np.sort(padded[line[:, None], beam[:, None] + np.arange(width)], axis=1)  # NaN last
    count = np.isfinite(windows).sum(axis=1)
    rows = np.arange(len(line))
    out[line, beam] = (windows[rows, (count - 1) // 2] + windows[rows, count // 2]) / 2
    return out


def fit_lines(ranges, bearings, rounds=4):
    """A straight line to every scan line at once, robust against outliers.

    Parameters
    ----------
    ranges : ndarray, shape (L, B)
        Metres; NaN does not take part.
    bearings : ndarray, shape (B,)
        Radians.
    rounds : int
        Of re-weighting (Tukey's weights, 4.7 robust standard deviations).

    Returns
    -------
    lines : ndarray, shape (L, 2)
        ``u`` with ``u . (x, y) = 1``; NaN with fewer than four beams.
    information : ndarray, shape (L, 2, 2)
        Inverse covariance for ranges with a standard deviation of 1 m; NaN with fewer than four beams.

    Notes
    -----
    In polar form the line is ``1 / r = u . (cos b, sin b)``: linear in u, with weights r^4 because of 1 / r.
    """
    rays = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    products = rays[:, :, None] * rays[:, None, :]
    seen = np.isfinite(ranges)
    r = np.where(seen, ranges, 1.0)
    enough = seen.sum(axis=1) >= FEWEST_BEAMS
    base = np.where(seen & enough[:, None], r**4, 0.0)
    weights = base
    for _ in range(rounds):
        information = np.einsum("lb,bij->lij", weights, products)
        right = (weights / r) @ rays
        information[~enough], right[~enough] = np.eye(2), np.nan
        lines = np.linalg.solve(information, right[..., None])[..., 0]
        misses = np.where(seen, np.abs(r - _line_ranges(lines, bearings)), np.nan)
        with np.errstate(invalid="ignore"):
            scale = np.maximum(1.4826 * row_median(misses), 1e-4)[:, None]
            weights = base * np.where(seen, np.clip(1 - (misses / (4.7 * scale)) ** 2, 0, None) ** 2, 0.0)
        weights = np.nan_to_num(weights)
    information[~enough] = np.nan
    return lines, information


def row_median(values):
    """Median of each row without its NaN; NaN for an empty row."""
    ordered = np.sort(values, axis=1)
    count = np.isfinite(ordered).sum(axis=1)
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, values.shape[1] - 1)
    rows = np.arange(len(values))
    return (ordered[rows, low] + ordered[rows, high]) / 2


def _line_ranges(lines, bearings):
    """Ranges of the fitted lines: every line in every direction (lines (L, 2), bearings (B,)), shape (L, B)."""
    along = lines @ np.stack([np.cos(bearings), np.sin(bearings)])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(along > 0, 1 / along, np.nan)


def row_ends(mask):
    """First and last True of each row; rows without one are left out. Returns (rows, first, last)."""
    rows = np.flatnonzero(mask.any(axis=1))
    return rows, mask[rows].argmax(axis=1), mask.shape[1] - 1 - mask[rows, ::-1].argmax(axis=1)


def _span(mask, margin=0):
    """True from the first to the last True of each row, and `margin` beams beyond."""
    rows, first, last = row_ends(mask)
    out = np.zeros(mask.shape, bool)
    beam = np.arange(mask.shape[1])
    out[rows] = (beam >= first[:, None] - margin) & (beam <= last[:, None] + margin)
    return out


def jump_threshold(sigma_range):
    """Distance from the board beyond which a return is a jump point, metres."""
    return max(4 * sigma_range, PLANE_NOISE)


def jump_points(ranges, fitted, threshold):
    """Returns that belong neither to the board nor to a surface behind it: mixed pixels and outliers.

    Parameters
    ----------
    ranges : ndarray, shape (L, B)
        Metres, as recorded or filtered.
    fitted : ndarray, shape (L, B)
        Ranges on the board, NaN off the board.
    threshold : float
        Distance from the board, metres.

    Returns
    -------
    ndarray of bool, shape (L, B)
        True for returns on the board's span of a scan line that miss it by more than the threshold, and for pieces
        of at most two beams (cut at jumps of the threshold) directly beside it.
    """
    on = np.isfinite(fitted)
    with np.errstate(invalid="ignore"):
        inside = on & (np.abs(ranges - fitted) > threshold)
    pieces = segments(ranges, jump=threshold)
    size = np.bincount(pieces[pieces >= 0], minlength=1)
    single = (pieces >= 0) & (size[pieces] <= 2)
    return inside | (single & _span(on, 2) & ~on)


def edge_profile(scan, line, end=1, beams=20, width=MEDIAN_WIDTH):
    """Original, median-filtered and fitted points about one end of a scan line; figure 5 of the paper.

    Parameters
    ----------
    scan : BoardScan
    line : int
        Scan line that hits the board.
    end : {-1, +1}
        Low or high bearings.
    beams : int
        How many on either side of the last beam on the board.
    width : int
        Of the median filter, which runs over the board's returns and the jump points among and beside them, without
        the background: what step (i) of the paper leaves.

    Returns
    -------
    EdgeProfile

    Raises
    ------
    ValueError
        If no beam of the line hits the board.
    """
    hit = np.flatnonzero(scan.mask[line])
    if len(hit) == 0:
        raise ValueError(f"scan line {line} of placement {scan.placement} does not hit the board")
    last = hit[-1] if end > 0 else hit[0]
    cut = slice(max(last - beams, 0), last + beams + 1)
    filtered = _filtered_with_jumps(scan, width)[line]
    return EdgeProfile(scan.sweep.bearings[cut], scan.sweep.ranges[line, cut], filtered[cut], scan.fitted[line, cut])


def count_jump_points(scan, width=MEDIAN_WIDTH):
    """Number of jump points as recorded and after a median filter, for figure 5 of the paper.

    Parameters
    ----------
    scan : BoardScan
    width : int
        Beams, odd.

    Returns
    -------
    before, after : int
    """
    filtered = _filtered_with_jumps(scan, width)
    return scan.n_jump_points, int(jump_points(filtered, scan.fitted, jump_threshold(scan.sigma_range)).sum())


def _filtered_with_jumps(scan, width):
    jumps = jump_points(scan.sweep.ranges, scan.fitted, jump_threshold(scan.sigma_range))
    return median_filter(scan.sweep.ranges, scan.mask | jumps, width)


def face_points(scan, count=1000, margin=0.06):
    """Points on the face of the board, away from its edges, evenly thinned.

    Parameters
    ----------
    scan : BoardScan
    count : int
        At most.
    margin : float
        What is left out at either end of a scan line and of a column, as a fraction of it; never less than two beams.

    Returns
    -------
    points : ndarray, shape (m, 3)
        LRF frame at the pitch of the point, metres, at the recorded range.
    pitch : ndarray, shape (m,)
        Radians.
    covariance : ndarray, shape (m, 3, 3)

    Notes
    -----
    Outliers (four standard deviations off the fitted scan line) are left out: mixed pixels inside the board.
    """
    with np.errstate(invalid="ignore"):
        good = scan.mask & (np.abs(scan.sweep.ranges - scan.fitted) < 4 * scan.sigma_range)
    line, beam = np.nonzero(good & _interior(scan.mask, margin) & _interior(scan.mask.T, margin).T)
    if len(line) > count:
        keep = np.linspace(0, len(line) - 1, count).round().astype(int)
        line, beam = line[keep], beam[keep]
    ranges, bearings = scan.sweep.ranges[line, beam], scan.sweep.bearings[beam]
    spread = 0.1 * np.median(np.diff(scan.sweep.bearings))  # keeps the covariance regular; bearings are all but exact
    covariance = polar_covariance(ranges, bearings, scan.sigma_range, spread)
    return polar_to_points(ranges, bearings), scan.sweep.pitch[line], covariance


def _interior(mask, margin):
    """Without the outer part of each row; a row too short for that (a sweep of one line, seen by columns) stays."""
    rows, first, last = row_ends(mask)
    trim = np.where(last - first < 6, 0, np.maximum(2, (margin * (last - first)).astype(int)))[:, None]
    beam = np.arange(mask.shape[1])
    out = np.zeros(mask.shape, bool)
    out[rows] = (beam >= first[:, None] + trim) & (beam <= last[:, None] - trim)
    return out
