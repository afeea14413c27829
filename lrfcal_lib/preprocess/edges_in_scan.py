"""Where the board's edges cross the scan: edge points with covariance, sides, background."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lrfcal_lib.fit.covariance import dyads
from lrfcal_lib.fit.padding import medians
from lrfcal_lib.fit.robust import rms
from lrfcal_lib.model.geometry import (
    fit_line,
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


@dataclass(frozen=True)
class ScanSide:
    """A straight side of the board as a scan sees it.

    Attributes
    ----------
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
    """

    n_points: int
    length: float
    rms: float
    angle: float
    ends: np.ndarray

    @property
    def direction(self) -> np.ndarray:
        """From one end to the other, shape (3,), of unit length."""
        return (self.ends[1] - self.ends[0]) / self.length

    def is_same(self, other: "ScanSide") -> np.bool:
        """Whether two sides are one: the same direction, and less than two centimetres apart."""
        between = other.ends.mean(axis=0) - self.ends.mean(axis=0)
        apart = np.linalg.norm(np.cross(between, self.direction))
        cosine = abs(self.direction @ other.direction)
        return cosine > np.cos(LEAST_TURN) and apart < SAME_SIDE


@dataclass(frozen=True)
class ScanEdges:
    """Where the board's edges cross the scan lines, or the columns of the range image.

    Attributes
    ----------
    variant : {'half_step', 'last_beam'}
    points : ndarray, shape (n, 3)
        LRF frame at the pitch of the point, metres; on the fitted scan line.
    covariance : ndarray, shape (n, 3, 3)
    pitch : ndarray, shape (n,)
        Radians.
    cell : ndarray of int, shape (n, 2)
        Scan line and beam of the last cell that hit the board.
    step : ndarray of int, shape (n, 2)
        From it to the first cell off the board, likewise.
    end : ndarray of int, shape (n,)
        -1 where scan lines end at low bearings (right), +1 at high bearings (left); columns: -1 at
        low pitch, +1 at high pitch.
    side : ndarray of int, shape (n,)
        Number of the straight side; -1 for outliers.
    sides : dict of int to ScanSide
        By number within the placement; the same in all variants, along and across.
    background : ndarray, shape (n,)
        What the distance of the background adds to the log odds at which readings flip
        (:func:`background_of`).
    """

    variant: str
    points: np.ndarray
    covariance: np.ndarray
    pitch: np.ndarray
    cell: np.ndarray
    step: np.ndarray
    end: np.ndarray
    side: np.ndarray
    sides: dict[int, ScanSide]
    background: np.ndarray

    @property
    def line(self) -> np.ndarray:
        """Scan line of each point."""
        return self.cell[:, 0]


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


def crossings(
    scan: BoardScan, across: bool, known: Mapping[int, ScanSide]
) -> tuple[dict[str, ScanEdges], dict[int, ScanSide]]:
    """Where scan lines (with `across`, columns of the range image) cross the board's edges.

    A column is one beam over the pitch. One rule, step (iii) of the paper's preprocessing, in which
    bearing and pitch change places.

    Parameters
    ----------
    scan : BoardScan
    across : bool
        Edges nearly parallel to the scan lines are found here.
    known : dict of int to ScanSide
        Found the other way: a side that is one of them gets its number.

    Returns
    -------
    edges : dict of str to ScanEdges
        By variant. 'half_step': halfway between the last beam on the board and the first off it,
        unbiased for an edge anywhere between them; 'last_beam': the paper's rule, half a step
        inside on average. Ends at holes inside the board do not appear; neither do ends at the
        border of the view (of the sweep, which may have been cut), nor where something nearer hides
        the board. The points lie on the fitted straight line (the paper), moved along the ray by
        what the outermost beams say where the board turns out to be warped. The covariance holds
        the beam spacing (uniform over one step), the line fit and warp, and what a side scatters
        more than that. Sides at less than 20 deg to the scan lines (to the columns) are left out
        (side -1): there the pitch (the bearing) decides where a line ends.
    sides : dict of int to ScanSide
        All of them, with those left out.
    """
    cell, step, end = _ends(scan, across)
    inner = _place(scan, cell)
    outer = _place(scan, cell + step)
    places = np.stack([inner, (inner + outer) / 2], axis=1)
    points, noise, by_angle = _at(scan, cell, step, places, across)
    gap, odds = background_of(scan, scan.fitted, cell, step)
    pitch = places[0]
    order = cell[:, int(across)]
    side, every = _group(scan, points[1], pitch[1], order, end, gap < MIXING, known)
    # the pitch is read in steps, it may seem to stand still
    least = median_step(scan.sweep.pitch if across else scan.sweep.bearings)
    sigma = np.maximum(np.abs(outer - inner).sum(axis=0), least) * UNIFORM
    turned = _to_platform(scan, by_angle[1], pitch[1])
    sigma = sigma * _inflation(turned, sigma, side, every)
    covariance = noise + dyads(by_angle * sigma[:, None])
    # to the scan lines: of sides along the lines (the columns), whose ends tell nothing of them
    unseen = np.pi / 2 if across else 0.0
    sides = {n: s for n, s in every.items() if abs(s.angle - unseen) >= LEAST_ANGLE}
    if every:  # scans at one pitch have no sides, and keep all points
        side = np.where(np.isin(side, list(sides)), side, -1)
    edges = {}
    for row, variant in enumerate(VARIANTS):
        edges[variant] = ScanEdges(
            variant=variant,
            points=points[row],
            covariance=covariance[row],
            pitch=pitch[row],
            cell=cell,
            step=step,
            end=end,
            side=side,
            sides=sides,
            background=odds,
        )
    return edges, every


def background_of(scan, board, cell, step):
    """What stands behind ends of the board.

    Parameters
    ----------
    scan : BoardScan
    board : ndarray, shape (L, B)
        Ranges of the board, metres.
    cell, step : ndarray of int, shape (n, 2)
        As in `ScanEdges`.

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


def _ends(scan, across):
    """Ends of lines (columns) that may be edges: cell, step and end, as in `ScanEdges`."""
    sweep = scan.sweep
    rows, ends = row_ends(scan.mask.T if across else scan.mask)
    row = np.tile(rows, 2)
    place = ends.T.ravel()
    cell = np.column_stack([place, row] if across else [row, place])
    end = np.repeat([-1, 1], len(rows))
    step = np.outer(end, [across, not across])
    if across and sweep.direction < 0:  # a sweep downwards
        end = -end
    inside = within(cell, step, scan.mask.shape) & np.isfinite(scan.lines[cell[:, 0], 0])
    cell, step, end = cell[inside], step[inside], end[inside]
    here = scan.fitted[tuple(cell.T)]
    after = sweep.ranges[tuple((cell + step).T)]
    gap = np.sum(_place(scan, cell + step) - _place(scan, cell), axis=0)
    # nothing nearer hides the board
    visible = ~(after < here - depth_jump(here, gap))
    return cell[visible], step[visible], end[visible]


def _place(scan, cell):
    """Pitch and bearing of cells (n, 2), radians, (2, n)."""
    line, beam = cell.T
    return np.stack([scan.sweep.pitch[line], scan.sweep.bearings[beam]])


def _at(scan, cell, step, places, across):
    """Crossings of fitted lines with the rays of places (2, v, n): points, their covariance by the
    range, and their derivatives by the bearing (the pitch), (v, n, ...).

    At another pitch than that of the line changed as the board's plane predicts; at its own moved
    by what the warp of the board asks for.
    """
    pitch, bearing = places
    line = cell[:, 0]
    lines = scan.lines[line]
    points, noise, by_angle = crossings_of(lines, scan.lines_covariance[line], bearing)
    rays = polar_to_points(1.0, bearing)
    if not across:
        shift, sigma = _warp(scan, cell, step)
        warp = sigma[:, None] * rays
        return points + shift[:, None] * rays, dyads(noise) + dyads(warp), by_angle
    there, _ = plane_range(scan, rays, pitch)
    here, _ = plane_range(scan, rays, scan.sweep.pitch[line])
    points = points + (there - here)[..., None] * rays
    rotation = scan.T_head_lrf.rotation.as_matrix()
    turned = np.cross([1.0, 0.0, 0.0], scan.T_head_lrf.apply(points)) @ rotation
    normal = tilt(scan.normal, -pitch) @ rotation
    return points, dyads(noise), _slid(turned, normal, rays)


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
    fitted lines.
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


def _inflation(by_angle, sigma, side, sides):
    """How much more the points of a side scatter than their spacing explains, at least 1, (n,).

    The spacing is along `by_angle`.
    """
    factor = np.ones(len(side))
    for number, s in sides.items():
        rows = side == number
        away = np.cross(by_angle[rows], s.direction)
        expected = rms(sigma[rows] * np.linalg.norm(away, axis=1))
        if expected > 0:
            factor[rows] = max(1.0, s.rms / expected)
    return factor


def _group(scan, points, pitch, order, end, mixed, known):
    """The straight sides in the board's plane: the side of each point (-1 for none), and the sides
    by number.

    Where a post or an easel stands close behind a board, its edge is bent: such (`mixed`) points
    are left out, unless most of the board's outline lies before something close (a wall), which
    moves all of it alike.
    """
    if not len(end) or np.ptp(scan.sweep.pitch) < SAME_PITCH:
        return (end + 1) // 2, {}  # scans at one pitch show one point a side
    axes = plane_axes(scan.normal)
    flat = lrf_to_platform(points, pitch, scan.T_head_lrf) @ axes.T
    side = np.full(len(flat), -1)
    sides: dict = {}
    tolerance = max(_spacing(scan), EDGE_SCATTER)
    shortest = SHORTEST_SIDE * np.linalg.norm(np.ptp(flat, axis=0))
    usable = ~mixed | (2 * mixed.sum() >= len(flat))
    for hand in (-1, 1):
        candidates = np.flatnonzero((end == hand) & usable)
        left_out = np.unique(order[(end == hand) & ~usable])  # makes no gap
        place = order[candidates] - np.searchsorted(left_out, order[candidates])
        for run in straight_runs(flat[candidates], place, tolerance, shortest):
            rows = candidates[run]
            new = _side_through(scan, flat[rows], axes, np.mean(pitch[rows]))
            same = (number for number, s in known.items() if s.is_same(new))
            number = next(same, len(known) + len(sides))
            side[rows] = number
            sides[number] = new
    return side, sides


def _spacing(scan):
    """Median distance of neighbouring beams at the ends of the board's scan lines, metres."""
    row, ends = row_ends(scan.mask & np.isfinite(scan.lines[:, :1]))
    line = np.repeat(row, 2)
    bearing = scan.sweep.bearings[ends.ravel()]
    _, _, apart = crossings_of(scan.lines[line], scan.lines_covariance[line], bearing)
    spacing = np.median(np.linalg.norm(apart, axis=1))
    return spacing * median_step(scan.sweep.bearings)


def _side_through(scan, flat, axes, pitch):
    """The ScanSide through points (n, 2) of the board's plane."""
    centre, direction, miss = fit_line(flat)
    along = (flat - centre) @ direction
    ends = centre + np.outer([along.min(), along.max()], direction)
    scan_normal = _to_platform(scan, np.array([0.0, 0.0, 1.0]), pitch)
    level = np.cross(scan_normal, scan.normal)  # of the scan line on the board
    cosine = abs(unit_vector(level) @ (direction @ axes))
    return ScanSide(
        n_points=len(flat),
        length=np.ptp(along),
        rms=miss * np.sqrt(len(flat) / (len(flat) - 2)),
        angle=np.arccos(min(cosine, 1.0)),
        ends=ends @ axes + scan.distance * scan.normal,
    )
