"""Where the board's edges cross the scan: edge points with covariance, sides, background."""

from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.fit.covariance import dyads
from lrfcal_lib.fit.padding import medians
from lrfcal_lib.fit.robust import rms
from lrfcal_lib.model.geometry import (
    fit_line,
    length_of,
    lrf_to_platform,
    plane_axes,
    polar_to_points,
    tilt,
    unit_vector,
)
from lrfcal_lib.preprocess.board_in_scan import BoardScan, median_step
from lrfcal_lib.preprocess.straight_runs import LEAST_TURN, straight_runs
from lrfcal_lib.preprocess.surfaces import SAME_PITCH, depth_jump, row_ends

VARIANTS = ("last_beam", "half_step")
# metres; an LMS2xx gives one reading for two surfaces nearer together along the beam (telegram
# listing)
MIXING = 1.0
# beams or lines at the border of the view, where the board's end cannot be told from the view's end
BORDER = 3
LEAST_ANGLE = np.radians(20)
SHORTEST_SIDE = 0.1  # of the board's size
UNIFORM = 1 / np.sqrt(12.0)  # standard deviation of a uniform distribution of width 1
# metres; about twice what the end points of a real board scatter about a straight edge
EDGE_SCATTER = 0.006
SAME_SIDE = 0.02  # metres; a side found by lines and by columns
# at most, at either end of a scan line, that tell how far the board lies from the fitted line
WARPED_BEAMS = 15
CELLS_BEHIND = 3  # cells beyond an end that tell the range behind it: a median
MEDIAN_CHI2 = 0.455  # the median of a squared normal variable


# where scan lines, or columns of the range image, cross the board's edges; see `with_edges`
CROSSING = np.dtype(
    [
        ("points", float, 3),
        ("covariance", float, (3, 3)),
        ("pitch", float),
        ("line", int),
        ("beam", int),
        ("step", int, 2),
        ("across", bool),
        ("side", int),
        ("background", float),
    ]
)


@dataclass(frozen=True)
class ScanSide:
    """A straight side of the board as a scan sees it.

    Attributes
    ----------
    across : bool
        Whether columns of the range image cross it, not scan lines.
    n_points : int
    length : float
        Of the stretch with points, metres.
    rms : float
        Distance of the points from the side within the board's plane, metres.
    angle : float
        Between the side and the scan lines (0 .. pi/2, radians). A side seen at a small angle is
        crossed by few scan lines and moves along with every error of the pitch.
    ends : ndarray, shape (2, 3)
        Of the stretch, nominal platform frame, metres.
    number : int
        Within the placement; the same where it is seen along and across the scan lines.
    """

    across: bool
    n_points: int
    length: float
    rms: float
    angle: float
    ends: np.ndarray
    number: int = -1

    @property
    def direction(self) -> np.ndarray:
        """From one end to the other, shape (3,), of unit length."""
        return (self.ends[1] - self.ends[0]) / self.length

    @property
    def seen(self) -> bool:
        """Whether what crosses it tells where it is: it does not run along."""
        return abs(self.angle - self.across * np.pi / 2) >= LEAST_ANGLE

    def is_same(self, other: "ScanSide") -> np.bool:
        """Whether two sides are one: the same direction, and less than two centimetres apart."""
        between = np.mean(other.ends - self.ends, axis=0)
        apart = np.linalg.norm(np.cross(between, self.direction))
        cosine = abs(self.direction @ other.direction)
        return cosine > np.cos(LEAST_TURN) and apart < SAME_SIDE


def crossings_of(
    lines: np.ndarray, covariance: np.ndarray, bearings: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where rays meet the straight lines fitted to scan lines.

    Parameters
    ----------
    lines, covariance : ndarray, shapes (n, 2), (n, 2, 2)
        As :func:`lrfcal_lib.preprocess.board_in_scan.fit_lines` has them.
    bearings : ndarray, shape (..., n)
        Of the rays, radians.

    Returns
    -------
    points, noise, by_bearing : ndarray, shape (..., n, 3)
        LRF frame, metres; along the rays by one standard deviation of the fitted range; and the
        derivatives by the bearing.
    """
    rays = polar_to_points(1.0, bearings)
    flat = rays[..., :2]
    fitted = 1 / np.vecdot(lines, flat)[..., None]
    variance = np.vecdot(flat, np.matvec(covariance, flat))
    points = fitted * rays
    noise = np.sqrt(variance)[..., None] * fitted * points
    normal = np.insert(lines, 2, 0.0, axis=1)
    return points, noise, _slid(np.cross([0.0, 0.0, 1.0], points), normal, rays)


def with_edges(scan: BoardScan) -> BoardScan:
    """A scan with the places where lines, and columns of the range image, cross the board's edges.

    A column is one beam over the pitch: edges nearly parallel to the scan lines are found there,
    unless it is a single shot. One rule, step (iii) of the paper's preprocessing, in which bearing
    and pitch change places.

    Parameters
    ----------
    scan : BoardScan

    Returns
    -------
    BoardScan
        With `edges` and `sides`. Of the variants 'half_step' is halfway between the last beam on
        the board and the first off it, unbiased for an edge anywhere between them; 'last_beam' is
        the paper's rule, half a step inside on average. Ends at holes inside the board do not
        appear; neither do ends at the border of the view (of the sweep, which may have been cut),
        nor where something nearer hides the board. The points lie on the fitted straight line (the
        paper), moved along the ray by what the outermost beams say where the board turns out to be
        warped. The covariance holds the beam spacing (uniform over one step), the line fit and
        warp, and what a side scatters more than that. Sides at less than 20 deg to the scan lines
        (to the columns) are left out (side -1): there the pitch (the bearing) decides where a line
        ends.
    """
    cell, step = _ends(scan)
    across = step[:, 0] != 0
    inner = _place(scan, cell)
    outer = _place(scan, cell + step)
    places = np.stack([inner, (inner + outer) / 2], axis=1)
    points, noise, by_angle = _at(scan, cell, step, places)
    gap, odds = background_of(scan, scan.fitted, cell, step)
    pitch = places[0]
    # the pitch is read in steps, it may seem to stand still
    beam = median_step(scan.sweep.bearings)
    least = np.where(across, median_step(scan.sweep.pitch), beam)
    sigma = np.maximum(np.abs(outer - inner).sum(axis=0), least) * UNIFORM
    spread = by_angle * sigma[:, None]
    # neighbouring beams are so far apart where scan lines end
    apart = beam * medians(length_of(by_angle[0]), ~across)
    tolerance = max(apart, EDGE_SCATTER)
    side, more, sides = _group(
        scan, points[1], pitch[1], spread[1], cell, step, gap < MIXING, tolerance
    )
    covariance = noise + dyads(spread * more[:, None])
    edges = {}
    for variant, *own in zip(VARIANTS, points, covariance, pitch, strict=True):
        columns = [*own, *cell.T, step, across, side, odds]
        edges[variant] = np.rec.fromarrays(columns, CROSSING)
    return replace(scan, edges=edges, sides=sides)


def background_of(scan, board, cell, step):
    """What stands behind ends of the board.

    Parameters
    ----------
    scan : BoardScan
    board : ndarray, shape (L, B)
        Ranges of the board, metres.
    cell, step : ndarray of int, shape (n, 2)
        The last cells on the board, line and beam, and the steps to the first cells off it.

    Returns
    -------
    gap, odds : ndarray, shape (n,)
        How far behind the board it is, metres, by a median of three cells; inf without anything.
        What it adds to the log odds of the board's share at which readings flip:
        ``2 ln(here / behind)``, the inverse square law; 0 with nothing behind, or so close that
        both give one echo.
    """
    away = np.arange(1, CELLS_BEHIND + 1)
    ranges = _read_along(scan.sweep.ranges, cell, step, away)
    behind = np.median(np.nan_to_num(ranges, nan=np.inf), axis=1)
    here = board[tuple(cell.T)]
    gap = behind - here
    apart = np.isfinite(gap) & (gap >= MIXING)
    return gap, 2 * np.log(np.where(apart, here / behind, 1.0))


def plane_range(scan, rays, pitch) -> tuple[np.ndarray, np.ndarray]:
    """Where rays meet the board's plane.

    Parameters
    ----------
    scan : BoardScan
    rays : ndarray, shape (..., 3)
        Unit vectors, LRF frame.
    pitch : ndarray, shape (...)
        Radians.

    Returns
    -------
    range, cosine : ndarray
        Metres, and the cosine of the incidence.
    """
    cosine = _to_platform(scan, rays, pitch) @ scan.normal
    height = scan.distance - tilt(scan.T_head_lrf.translation, pitch) @ scan.normal
    with np.errstate(divide="ignore", invalid="ignore"):
        return height / cosine, cosine


def _ends(scan):
    """Ends of lines, then of columns, that may be edges: cells on the board and steps off it."""
    ways = {1: scan.mask}
    if scan.swept:
        ways[-1] = scan.mask.T  # beams and lines change places
    cells = []
    steps = []
    for turn, mask in ways.items():
        rows, ends = row_ends(mask)
        cells.append(np.column_stack([np.tile(rows, 2), ends.T.ravel()])[:, ::turn])
        steps.append(np.repeat([[0, -1], [0, 1]], len(rows), axis=0)[:, ::turn])
    cell = np.concatenate(cells)
    step = np.concatenate(steps)
    inside = within(cell, step, scan.mask.shape) & np.isfinite(scan.lines[cell[:, 0], 0])
    cell = cell[inside]
    step = step[inside]
    here = scan.fitted[tuple(cell.T)]
    after = scan.sweep.ranges[tuple((cell + step).T)]
    gap = np.sum(_place(scan, cell + step) - _place(scan, cell), axis=0)
    # nothing nearer hides the board
    visible = ~(after < here - depth_jump(here, gap))
    return cell[visible], step[visible]


def _place(scan, cell):
    """Pitch and bearing of cells (n, 2), radians, (2, n)."""
    line, beam = cell.T
    return np.stack([scan.sweep.pitch[line], scan.sweep.bearings[beam]])


def _at(scan, cell, step, places):
    """Crossings of fitted lines with the rays of places (2, v, n): points, their covariance by the
    range, and their derivatives by the bearing (of columns by the pitch), (v, n, ...).

    At another pitch than that of the line changed as the board's plane predicts; of lines moved by
    what the warp of the board asks for.
    """
    pitch, bearing = places
    line = cell[:, 0]
    lines = scan.lines[line]
    points, noise, by_bearing = crossings_of(lines, scan.lines_covariance[line], bearing)
    rays = polar_to_points(1.0, bearing)
    there, _ = plane_range(scan, rays, pitch)
    here, _ = plane_range(scan, rays, scan.sweep.pitch[line])
    shift, sigma = _warp(scan, cell, step)
    points = points + (there - here + shift)[..., None] * rays
    rotation = scan.T_head_lrf.rotation.as_matrix()
    turned = np.cross([1.0, 0.0, 0.0], scan.T_head_lrf.apply(points)) @ rotation
    normal = tilt(scan.normal, -pitch) @ rotation
    by_angle = np.where(step[:, :1], _slid(turned, normal, rays), by_bearing)
    return points, dyads(noise) + dyads(sigma[:, None] * rays), by_angle


def _read_along(values, cell, step, count):
    """Values (L, B) at cells so many steps (m,) from others (n, 2); those at the border of the
    view stand for what is beyond it, (n, m).
    """
    cells = cell[:, None] + step[:, None] * count[:, None]
    line, beam = np.clip(cells, 0, np.array(values.shape) - 1).T
    return values[line, beam].T


def within(cell, step, shape):
    """Which cells (n, 2) are inside the view (of so many lines and beams) by more than its border,
    in the direction of their steps.
    """
    margin = np.where(step != 0, BORDER, 0)
    return np.all((cell >= margin) & (cell < shape - margin), axis=1)


def _slid(turned, normal, rays):
    """How points on a surface with these normals move when their rays turn, all (..., n, 3)."""
    slide = np.vecdot(normal, turned) / np.vecdot(normal, rays)
    return turned - slide[..., None] * rays


def _to_platform(scan, vectors, pitch):
    """Directions (not points) from the LRF at a pitch to the nominal platform frame."""
    return tilt(scan.T_head_lrf.rotation.apply(vectors), pitch)


def _warp(scan, cell, step):
    """How far the board lies from the fitted lines at their ends, and the sigma of that, metres.

    A board bends, and cardboard reads farther than paper. The outermost eighth of a line (15 beams
    at most) says how far each end is off; how much these medians vary beyond their noise over all
    lines says how far to believe them. On a flat board that is nothing, and the ends stay on the
    fitted lines. Nor is it for columns, of which the lines tell nothing.
    """
    inwards = np.arange(WARPED_BEAMS)
    count = np.clip(scan.mask[cell[:, 0]].sum(axis=1) // 8, 1, WARPED_BEAMS)
    misses = np.where(scan.mask, scan.sweep.ranges - scan.fitted, np.nan)
    misses = _read_along(misses, cell, step, -inwards)
    misses[inwards >= count[:, None]] = np.nan  # an eighth of a line never leaves the view
    known = np.isfinite(misses)
    middle = medians(misses, known)
    # of a median: pi / 2 times that of a mean
    noise = np.pi / 2 * scan.sigma_range**2 / known.sum(axis=1)
    on_hand = step[:, 1] == np.array([[-1], [1]])
    variance = medians(middle**2, on_hand) / MEDIAN_CHI2
    excess = np.maximum(variance - medians(noise, on_hand), 0.0) @ on_hand
    share = excess / (excess + noise)
    return middle * share, np.sqrt(noise * share)


def _group(scan, points, pitch, spread, cell, step, mixed, tolerance):
    """The straight sides in the board's plane: the side of each point, -1 for none; how much more
    the points of a side scatter than their spacing `spread` (n, 3) explains, at least 1; and the
    ScanSides.

    Where a post or an easel stands close behind a board, its edge is bent: such (`mixed`) points
    are left out, unless most of the board's outline lies before something close (a wall), which
    moves all of it alike.
    """
    more = np.ones(len(cell))
    if not len(cell) or np.ptp(scan.sweep.pitch) < SAME_PITCH:
        return (step[:, 1] + 1) // 2, more, ()  # scans at one pitch show one point a side
    side = np.full(len(cell), -1)
    every: list[ScanSide] = []
    axes = plane_axes(scan.normal)
    flat = lrf_to_platform(points, pitch, scan.T_head_lrf) @ axes.T
    spread = _to_platform(scan, spread, pitch)
    usable = ~mixed | (2 * mixed.sum() >= len(mixed))
    shortest = SHORTEST_SIDE * length_of(np.ptp(flat, axis=0))
    for direction in ((0, -1), (0, 1), (-1, 0), (1, 0)):
        across = direction[1] == 0
        end = np.all(step == direction, axis=1)
        candidates = np.flatnonzero(end & usable)
        order = cell[:, int(across)]
        left_out = np.unique(order[end & ~usable])  # makes no gap
        place = order[candidates] - np.searchsorted(left_out, order[candidates])
        for run in straight_runs(flat[candidates], place, tolerance, shortest):
            rows = candidates[run]
            new = _side_through(scan, flat[rows], axes, np.mean(pitch[rows]), across)
            same = (s.number for s in every if s.across != across and s.is_same(new))
            new = replace(new, number=next(same, len(every)))
            every.append(new)
            expected = rms(length_of(np.cross(spread[rows], new.direction)))
            if expected > 0:
                more[rows] = max(1.0, new.rms / expected)
            if new.seen:
                side[rows] = new.number
    return side, more, tuple(s for s in every if s.seen)


def _side_through(scan, flat, axes, pitch, across):
    """The ScanSide through points (n, 2) of the board's plane."""
    centre, direction, miss = fit_line(flat)
    along = (flat - centre) @ direction
    ends = centre + np.outer([along.min(), along.max()], direction)
    scan_normal = _to_platform(scan, [0.0, 0.0, 1.0], pitch)
    level = np.cross(scan_normal, scan.normal)  # of the scan line on the board
    cosine = abs(unit_vector(level) @ (direction @ axes))
    return ScanSide(
        across=across,
        n_points=len(flat),
        length=np.ptp(along),
        rms=miss * np.sqrt(len(flat) / (len(flat) - 2)),
        angle=np.arccos(min(cosine, 1.0)),
        ends=ends @ axes + scan.distance * scan.normal,
    )
