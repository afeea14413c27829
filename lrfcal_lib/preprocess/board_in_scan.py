"""The board in a sweep: the nearest flat surface of its size, with a straight line a scan line."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.covariance import dyads, solve_each
from lrfcal_lib.fit.robust import NORMAL, biweight, rms
from lrfcal_lib.model.geometry import polar_covariance, polar_to_points
from lrfcal_lib.model.observations import thin
from lrfcal_lib.preprocess.surfaces import (
    PLANE_NOISE,
    BoardNotFound,
    planar_surface,
    row_ends,
    segments,
)
from lrfcal_lib.session.read import Sweep
from lrfcal_lib.session.stated import StatedRig

LEAST_SWEEP = np.deg2rad(1.0)  # a placement whose pitch spans less is a single shot
MEDIAN_WIDTH = 5  # beams
FEWEST_BEAMS = 4  # on a scan line, for a straight line with a covariance
LINE_ROUNDS = 4  # of Tukey's weights
LEAST_SIGMA = 1e-4  # metres; of a scan line, where all beams lie on it
OUTLYING = 4  # standard deviations of a range about its line
# spot radii from the last beam on the board that see its face alone; share of a row
CLEAR = 2.0
MOST_MARGIN = 1 / 3
MARGIN = 0.06  # of a row, left out at either end
SHORTEST_ROW = 6  # beams, of which an outer part is left out
SMALLEST_PIECE = 2  # beams; a smaller piece beside the board is a mixed pixel


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
    edges : dict of str to recarray
        Where the scan lines cross the board's sides, and, unless it is a single shot, the columns
        (where the sweep enters and leaves the board), by edge-point variant; empty before
        :func:`lrfcal_lib.preprocess.edges_in_scan.with_edges`. ``points``, LRF frame at the pitch
        of the point, metres, on the fitted scan line, with their ``covariance`` and ``pitch``
        (radians); ``line`` and ``beam`` of the last cell that hit the board, and the ``step``
        from there to the first cell off it, likewise; ``across`` where a column crosses; ``side``,
        the number of the straight side, -1 for outliers; ``background``, what its distance adds to
        the log odds at which readings flip.
    sides : tuple of ScanSide
        The straight sides, first those that scan lines cross.
    names : dict of int to str
        Board edge of each side, by its number; empty before
        :func:`lrfcal_lib.calibrate.naming.name_sides`.
    dropped : dict of int to DroppedSide
        Sides that got no name because the board has no edge there, likewise.
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
    spot: float
    edges: dict = field(default_factory=dict)
    sides: tuple = ()
    names: dict = field(default_factory=dict)
    dropped: dict = field(default_factory=dict)

    @property
    def side_of(self) -> dict:
        """The ScanSide of each number, as scan lines see it where they do."""
        return {side.number: side for side in self.sides[::-1]}

    @property
    def swept(self) -> np.bool:
        """Whether it is no single shot."""
        return np.ptp(self.sweep.pitch) > LEAST_SWEEP


def find_board(sweep: Sweep, rig: StatedRig) -> BoardScan:
    """Find the board in a sweep, filter its ranges and fit a straight line to each scan line.

    Parameters
    ----------
    sweep : Sweep
    rig : StatedRig
        Its board tells the size by its outline, else by its pattern, its LRF the spot; the platform
        may be roughly known, without one the tilt axis is taken to be the x axis of the LRF.

    Returns
    -------
    BoardScan

    Raises
    ------
    BoardNotFound
        If no flat surface has the board's size.
    """
    T_head_lrf = rig.T_head_lrf
    if T_head_lrf is None:
        T_head_lrf = RigidTransform.identity()
    surface = planar_surface(sweep, T_head_lrf, rig, np.random.default_rng(0))
    mask = surface.mask
    filtered = median_filter(sweep.ranges, mask)
    lines, covariance = fit_lines(filtered, sweep.bearings)
    rays = polar_to_points(1.0, sweep.bearings)[:, :2]
    fitted = np.where(_span(mask), _line_ranges(lines, rays), np.nan)
    residuals = (sweep.ranges - fitted)[mask]
    sigma = rms(residuals[np.abs(residuals) <= PLANE_NOISE * 2])
    if np.isnan(sigma):
        raise BoardNotFound(f"no scan line has {FEWEST_BEAMS} beams on the board")
    spot = 0.0
    if rig.lrf.spot_exit is not None:
        reach = np.nanmedian(fitted)
        spot = rig.lrf.spot_radius(reach) / reach
    return BoardScan(
        placement=sweep.placement,
        sweep=sweep,
        T_head_lrf=T_head_lrf,
        mask=mask,
        filtered=filtered,
        fitted=fitted,
        lines=lines,
        lines_covariance=covariance * sigma**2,
        normal=surface.normal,
        distance=surface.distance,
        sigma_range=sigma,
        n_jump_points=jump_points(sweep.ranges, fitted, sigma).sum(),
        spot=spot,
    )


def median_filter(
    ranges: np.ndarray, mask: np.ndarray, width: int = MEDIAN_WIDTH
) -> np.ndarray:
    """Running median along the scan lines; step (ii) of the paper's preprocessing.

    Near an end or a hole only the beams that exist count.

    Parameters
    ----------
    ranges : ndarray, shape (L, B)
        Metres; NaN where there is no return.
    mask : ndarray of bool, shape (L, B)
        Which returns take part.
    width : int
        Beams, an odd number.

    Returns
    -------
    ndarray, shape (L, B)
        Metres; NaN outside the mask and where there is no return.
    """
    if width < 1 or width % 2 == 0:
        raise ValueError(
            f"the width of a median filter must be odd and positive, got {width}"
        )
    half = width // 2
    filtered = np.where(mask, ranges, np.nan)
    padded = np.pad(filtered, ((0, 0), (half, half)), constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, width, axis=1)
    valid = np.isfinite(filtered)
    filtered[valid] = np.nanmedian(windows[valid], axis=1)
    return filtered


def fit_lines(ranges: np.ndarray, bearings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A straight line to every scan line at once, robust against outliers (Tukey's weights).

    In polar form ``1 / r = u . (cos b, sin b)`` is linear in u, with weights r^4 because of 1 / r.

    Parameters
    ----------
    ranges : ndarray, shape (L, B)
        Metres; NaN does not take part.
    bearings : ndarray, shape (B,)
        Radians.

    Returns
    -------
    lines : ndarray, shape (L, 2)
        ``u`` with ``u . (x, y) = 1``; NaN with fewer than four beams.
    covariance : ndarray, shape (L, 2, 2)
        For ranges with a standard deviation of 1 m; NaN with fewer than four beams.
    """
    rays = polar_to_points(1.0, bearings)[:, :2]
    products = dyads(rays)
    few = np.isfinite(ranges).sum(axis=1) < FEWEST_BEAMS
    r = np.where(few[:, None], 1.0, ranges)  # something to fit all the same
    valid = np.isfinite(r)
    r[~valid] = 1.0
    base = np.where(valid, r**4, 0.0)
    weights = base
    for _ in range(LINE_ROUNDS):
        information = np.einsum("lb,bij->lij", weights, products)
        lines = solve_each(information, (weights / r) @ rays)
        misses = np.where(valid, np.abs(r - _line_ranges(lines, rays)), np.nan)
        sigma = np.maximum(NORMAL * np.nanmedian(misses, axis=1), LEAST_SIGMA)[:, None]
        weights = np.nan_to_num(base * biweight(misses, sigma))
    covariance = np.linalg.inv(information)
    lines[few] = np.nan
    covariance[few] = np.nan
    return lines, covariance


def jump_points(ranges: np.ndarray, fitted: np.ndarray, sigma_range: float) -> np.ndarray:
    """Mixed pixels and outliers: neither of the board nor of a surface behind it.

    Returns on the board's span of a scan line that miss it by more than four sigma (two centimetres
    at least), and pieces of at most two beams (cut at jumps of that size) directly beside it.

    Parameters
    ----------
    ranges : ndarray, shape (L, B)
        Metres.
    fitted : ndarray, shape (L, B)
        Ranges of the board, metres; NaN beside it.
    sigma_range : float
        Metres.

    Returns
    -------
    ndarray of bool, shape (L, B)
    """
    on = np.isfinite(fitted)
    threshold = max(OUTLYING * sigma_range, PLANE_NOISE)
    inside = on & (np.abs(ranges - fitted) > threshold)
    pieces = segments(ranges, jump=threshold)
    size = np.bincount(pieces[pieces >= 0], minlength=1)
    small = (pieces >= 0) & (size[pieces] <= SMALLEST_PIECE)
    beside = _span(on, -SMALLEST_PIECE) & ~on
    return inside | (small & beside)


def face_points(
    scan: BoardScan, count: int = 1000
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on the face of the board, away from its edges, evenly thinned.

    At either end of a scan line and of a column 6 % of it are left out; never less than two beams,
    nor than a spot that reaches over the edge: it reads the mean of its part on the board, and a
    slanted board would seem less so.

    Parameters
    ----------
    scan : BoardScan
    count : int
        At most.

    Returns
    -------
    points : ndarray, shape (m, 3)
        LRF frame at the pitch of the point, metres, at the recorded range. Without outliers: mixed
        pixels inside the board, four standard deviations off the fitted scan line.
    pitch : ndarray, shape (m,)
        Radians.
    covariance : ndarray, shape (m, 3, 3)
    """
    sweep = scan.sweep
    miss = np.abs(sweep.ranges - scan.fitted)
    good = scan.mask & (miss < OUTLYING * scan.sigma_range)
    good &= _interior(scan.mask, sweep.bearings, scan.spot)
    good &= _interior(scan.mask.T, sweep.pitch, scan.spot).T
    line, beam = thin(np.argwhere(good), count).T
    ranges = sweep.ranges[line, beam]
    bearings = sweep.bearings[beam]
    # keeps the covariance regular; bearings are all but exact
    spread = 0.1 * median_step(sweep.bearings)
    covariance = polar_covariance(ranges, bearings, scan.sigma_range, spread)
    return polar_to_points(ranges, bearings), sweep.pitch[line], covariance


def median_step(angles: np.ndarray) -> float:
    """Median step between neighbouring angles; infinite for a single one."""
    return np.median(np.abs(np.diff(angles))) if len(angles) > 1 else np.inf


def _line_ranges(lines, rays):
    """Ranges (L, B) of the fitted lines (L, 2) along rays (B, 2): every line in every direction."""
    along = lines @ rays.T
    with np.errstate(divide="ignore"):
        return np.where(along > 0, 1 / along, np.nan)


def _span(mask, trim=0):
    """True from the first to the last True of each row, without `trim` beams at both ends.

    A number, or one a row.
    """
    rows, ends = row_ends(mask)
    inside = ends + np.multiply.outer(trim, [1, -1])
    beam = np.arange(mask.shape[1])
    span = np.zeros(mask.shape, bool)
    span[rows] = (beam >= inside[:, :1]) & (beam <= inside[:, 1:])
    return span


def _interior(mask, angles, spot):
    """Without the outer part of each row: a share of it, and what a spot reads over the edge.

    The latter where that leaves half of the row. A row too short for that (a sweep of one line,
    seen by columns) stays. `angles` of the cells of a row, and `spot`, in radians.
    """
    size = np.ptp(row_ends(mask)[1], axis=1)
    clear = CLEAR * spot / max(median_step(angles), 1e-6)
    trim = np.clip(clear, np.maximum(2, MARGIN * size), MOST_MARGIN * size).astype(int)
    return _span(mask, np.where(size < SHORTEST_ROW, 0, trim))
