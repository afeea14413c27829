"""The board in a sweep: detection, median filter and line fit, steps (i) to (iii) of the paper's preprocessing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.geometry import polar_covariance, polar_to_points
from lrfcal_lib.preprocess.segment import PLANE_NOISE, BoardNotFound, planar_surface, segments
from lrfcal_lib.session import Sweep

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
        Tells the size (see :func:`lrfcal_lib.preprocess.segment.planar_surface`).
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
