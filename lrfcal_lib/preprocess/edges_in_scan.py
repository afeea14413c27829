"""Where the board's edges cross the scan: edge points with covariance, sides, background."""

from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points, tilt
from lrfcal_lib.preprocess.board_in_scan import (
    depth_jump,
    median_step,
    plane_axes,
    row_ends,
    row_median,
)

VARIANTS = ("last_beam", "half_step")
# metres; an LMS2xx gives one reading for two surfaces nearer together along the beam (telegram
# listing)
MIXING = 1.0
# beams or lines at the border of the view, where the board's end cannot be told from the view's end
BORDER = 3
# of a straight side; on one hand of a board
FEWEST_POINTS = 5
MOST_RUNS = 4
LEAST_TURN = np.radians(8)  # between neighbouring sides that end scan lines on the same hand
LEAST_ANGLE = np.radians(20)
SHORTEST_SIDE = 0.1  # of the board's size
UNIFORM = 1 / np.sqrt(12.0)  # standard deviation of a uniform distribution of width 1
# metres; about twice what the end points of a real board scatter about a straight edge
EDGE_SCATTER = 0.006
SAME_SIDE = 0.02  # metres; a side found by lines and by columns
# at most, at either end of a scan line, that tell how far the board lies from the fitted line
WARPED_BEAMS = 15


def beyond(scan, line, beam, step, beams=3):
    """Range behind ends of the board (a cell and the step to the next one): a median, or inf."""
    ends = np.stack([line, beam], axis=1)
    away = np.arange(1, beams + 1)[:, None]
    cells = ends[:, None] + step[:, None] * away
    cells = np.clip(cells, 0, np.array(scan.mask.shape) - 1)
    ranges = scan.sweep.ranges[cells[..., 0], cells[..., 1]]
    ordered = np.sort(np.nan_to_num(ranges, nan=np.inf), axis=1)
    return ordered[:, beams // 2]


def background_odds(here, behind):
    """What the background adds to the log odds of the board's share at which readings flip.

    ``2 ln(here / behind)``, the inverse square law; 0 with nothing behind, or so close that both
    give one echo.
    """
    behind = np.asarray(behind, float)
    apart = np.isfinite(behind) & (behind - here >= MIXING)
    ratio = here / np.where(apart, behind, 1.0)
    return 2 * np.log(np.where(apart, ratio, 1.0))


def straight_runs(points, order, tolerance, shortest):
    """Split a trace (n, 2) into straight runs: random sample consensus, the longest run first.

    `order` (n,) is the place along the trace (scan line or beam number). Returns the indices of the
    points of each run. Runs with fewer than five points, too short, or turned by less than 8 deg
    against a longer one (the same side, bent or frayed) are not returned.
    """
    rng = np.random.default_rng(0)
    left = np.arange(len(points))
    runs = []
    directions = []
    for _ in range(2 * MOST_RUNS):
        if len(left) < FEWEST_POINTS or len(runs) == MOST_RUNS:
            break
        found = left[_consensus(points[left], tolerance, shortest / 2, rng)]
        if len(found) == 0:
            break
        # the largest part without a gap of more than a tenth of the run (five steps at least)
        found = found[np.argsort(order[found], kind="stable")]
        gaps = np.diff(order[found]) > max(5, 0.1 * len(found))
        part = np.cumsum(np.r_[0, gaps])
        largest = np.bincount(part).argmax()
        found = np.sort(found[part == largest])
        if len(found) < FEWEST_POINTS:
            break
        left = np.setdiff1d(left, found)
        _, direction, along, _ = line_of(points[found])
        turned = all(abs(direction @ other) < np.cos(LEAST_TURN) for other in directions)
        if turned and np.ptp(along) >= shortest:
            runs.append(found)
            directions.append(direction)
    return runs


def line_of(points, among=slice(None)):
    """Least squares line of some points (n, 2): centre, direction, places along and across it.

    Total least squares; the places are of all points, metres.
    """
    centre = points[among].mean(axis=0)
    offset = points - centre
    spread = offset[among].T @ offset[among]
    direction = np.linalg.eigh(spread)[1][:, 1]
    across = offset[:, 1] * direction[0] - offset[:, 0] * direction[1]
    return centre, direction, offset @ direction, across


def _consensus(points, tolerance, apart, rng, trials=300):
    """Which points lie near the line that most agree with, after two least-squares refinements."""
    a = points[rng.integers(len(points), size=trials)]
    b = points[rng.integers(len(points), size=trials)]
    length = np.linalg.norm(b - a, axis=1)
    far = length > apart
    if not far.any():
        return np.zeros(len(points), bool)
    along = (b - a)[far] / length[far, None]
    a = a[far]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    distance = normal @ points.T - np.sum(normal * a, axis=1)[:, None]
    # The sum of truncated squares ranks lines through the middle of a trace above those along its
    # rim.
    best = np.minimum((distance / tolerance) ** 2, 1).sum(axis=1).argmin()
    on = np.abs(distance[best]) < tolerance
    for _ in range(2):
        if on.sum() >= 2:
            on = np.abs(line_of(points, on)[3]) < tolerance
    return on


@dataclass(frozen=True)
class ScanSide:
    """A straight side of the board as a scan sees it.

    Attributes
    ----------
    side : int
        Number within the placement; the same in all variants, along and across.
    end : int
        -1 where it ends scan lines at low bearings (right), +1 at high bearings (left); of columns:
        -1 at low pitch, +1 at high pitch.
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

    side: int
    end: int
    n_points: int
    length: float
    rms: float
    angle: float
    ends: np.ndarray

    def is_same(self, other):
        """Whether two sides are one: the same direction, and less than two centimetres apart."""
        between = other.ends.mean(axis=0) - self.ends.mean(axis=0)
        apart = np.linalg.norm(np.cross(between, self.direction))
        cosine = abs(self.direction @ other.direction)
        return cosine > np.cos(LEAST_TURN) and apart < SAME_SIDE

    @property
    def direction(self):
        """From one end to the other, shape (3,), of unit length."""
        return (self.ends[1] - self.ends[0]) / self.length


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
    line, beam : ndarray of int, shape (n,)
        The last cell that hit the board.
    step : ndarray of int, shape (n, 2)
        From it to the first cell off the board, in scan lines and beams.
    end : ndarray of int, shape (n,)
        As in `ScanSide`.
    side : ndarray of int, shape (n,)
        Number of the straight side; -1 for outliers.
    sides : tuple of ScanSide
    background : ndarray, shape (n,)
        What the distance of the background adds to the log odds at which readings flip
        (:func:`background_odds`).
    """

    variant: str
    points: np.ndarray
    covariance: np.ndarray
    pitch: np.ndarray
    line: np.ndarray
    beam: np.ndarray
    step: np.ndarray
    end: np.ndarray
    side: np.ndarray
    sides: tuple[ScanSide, ...]
    background: np.ndarray


def crossings(scan, across=False, known=()):
    """Where scan lines cross the board's edges or, with `across`, columns of the range image (one
    beam over the pitch).

    One rule, step (iii) of the paper's preprocessing, in which bearing and pitch change places.

    Parameters
    ----------
    scan : BoardScan
    across : bool
        Edges nearly parallel to the scan lines are found here.
    known : sequence of ScanSide
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
    sides : tuple of ScanSide
        All of them, with those left out.
    """
    line, beam, step, end = _ends(scan, across)
    pitch = scan.sweep.pitch[line]
    if across:
        angles = scan.sweep.pitch
        cell = line
    else:
        angles = scan.sweep.bearings
        cell = beam
    inner = angles[cell]
    outer = angles[cell + step.sum(axis=1)]
    gap = outer - inner
    middle = (inner + outer) / 2
    if across:
        order = beam
        when = middle
        shift = 0.0
        warp_sigma = 0.0
        if len(angles) > 1:  # the pitch is read in steps, it may seem to stand still
            gap = np.copysign(np.maximum(np.abs(gap), median_step(angles)), gap)
    else:
        order = line
        when = pitch
        shift, warp_sigma = _warp(scan, line, beam, end)
    points, by_angle, _ = _points_at(scan, line, beam, middle, shift, across)
    here = scan.fitted[line, beam]
    behind = beyond(scan, line, beam, step)
    side, every = _group(scan, points, when, order, end, behind - here < MIXING, known)
    sigma = np.abs(gap) * UNIFORM
    sigma = sigma * _inflation(_to_platform(scan, by_angle, when), sigma, side, every)
    sides = every
    if every:  # scans at one pitch have no sides, and keep all points
        lean = [np.pi / 2 - s.angle if across else s.angle for s in every]
        sides = tuple(s for s, angle in zip(every, lean, strict=True) if angle >= LEAST_ANGLE)
        side = np.where(np.isin(side, [s.side for s in sides]), side, -1)
    about = line, beam, step, end, side, sides
    odds = background_odds(here, behind)
    found = {}
    for variant, angle, there in (("last_beam", inner, pitch), ("half_step", middle, when)):
        points, by_angle, range_sigma = _points_at(scan, line, beam, angle, shift, across)
        rays = points / np.linalg.norm(points, axis=1, keepdims=True)
        noise = _outer(rays * np.hypot(range_sigma, warp_sigma)[:, None])
        spacing = _outer(by_angle * sigma[:, None])
        found[variant] = ScanEdges(variant, points, spacing + noise, there, *about, odds)
    return found, every


def _outer(vectors):
    """Products (n, 3, 3) of vectors (n, 3) with themselves."""
    return np.einsum("ni,nj->nij", vectors, vectors)


def _ends(scan, across):
    """Ends of lines (columns) that may be edges: line, beam, step off the board, -1 or +1."""
    mask = scan.mask.T if across else scan.mask
    pitch = scan.sweep.pitch
    rows, first, last = row_ends(mask)
    row = np.r_[rows, rows]
    cell = np.r_[first, last]
    way = np.repeat([-1, 1], len(rows))
    line, beam = (cell, row) if across else (row, cell)
    keep = (cell >= BORDER) & (cell < mask.shape[1] - BORDER)
    keep &= np.isfinite(scan.lines[line, 0])
    line = line[keep]
    beam = beam[keep]
    way = way[keep]
    step = np.zeros((len(way), 2), int)
    if across:
        step[:, 0] = way
        turned = pitch[line + way] - pitch[line]
    else:
        step[:, 1] = way
        turned = np.median(np.diff(scan.sweep.bearings))
    here = scan.fitted[line, beam]
    after = scan.sweep.ranges[line + step[:, 0], beam + step[:, 1]]
    seen = ~(after < here - depth_jump(here, turned))
    if across and len(pitch) > 1 and np.polyfit(np.arange(len(pitch)), pitch, 1)[0] <= 0:
        way = -way  # a sweep downwards
    return line[seen], beam[seen], step[seen], way[seen]


def _points_at(scan, line, beam, angle, shift, across):
    """Points (LRF frame) of the board where lines end at bearings, or columns at pitch angles.

    Returns them with their derivative by that angle and the standard deviation of the fitted range.
    They lie on the fitted lines, moved by `shift` along the ray, and along a column by the change
    that the board's plane predicts.
    """
    bearing = scan.sweep.bearings[beam] if across else angle
    rays = polar_to_points(np.ones(len(line)), bearing)
    turned = np.stack([-rays[:, 1], rays[:, 0], 0 * bearing], axis=1)
    u = scan.lines[line]
    ray = rays[:, :2]
    r = 1 / np.sum(u * ray, axis=1)
    variance = np.einsum("ni,nij,nj->n", ray, scan.lines_covariance[line], ray)
    range_sigma = r**2 * np.sqrt(variance)
    if not across:
        slope = -(r**2) * np.sum(u * turned[:, :2], axis=1)
        by_bearing = slope[:, None] * rays + r[:, None] * turned
        return (r + shift)[:, None] * rays, by_bearing, range_sigma
    there, _ = plane_range(scan, rays, angle)
    here, _ = plane_range(scan, rays, scan.sweep.pitch[line])
    points = (scan.fitted[line, beam] + (there - here))[:, None] * rays
    rotation = scan.T_head_lrf.rotation.as_matrix()
    # d p / d pitch, in the LRF frame
    turned = np.cross([1.0, 0.0, 0.0], scan.T_head_lrf.apply(points)) @ rotation
    normal = tilt(scan.normal, -angle) @ rotation
    slide = np.sum(normal * turned, axis=1) / np.sum(normal * rays, axis=1)
    return points, turned - slide[:, None] * rays, range_sigma


def plane_range(scan, rays, pitch):
    """Range along rays (LRF frame) to the board's plane, and the cosine of their incidence."""
    cosine = _to_platform(scan, rays, pitch) @ scan.normal
    with np.errstate(divide="ignore", invalid="ignore"):
        return (
            scan.distance - tilt(scan.T_head_lrf.translation, pitch) @ scan.normal
        ) / cosine, cosine


def _to_platform(scan, vectors, pitch):
    """Directions (not points) from the LRF at a pitch to the nominal platform frame."""
    return tilt(vectors @ scan.T_head_lrf.rotation.as_matrix().T, pitch)


def _warp(scan, line, beam, end):
    """How far the board lies from the fitted lines at their ends, and the sigma of that, metres.

    A board bends, and cardboard reads farther than paper. The outermost eighth of a line (15 beams
    at most) says how far each end is off; how much these medians vary beyond their noise over all
    lines says how far to believe them. On a flat board that is nothing, and the ends stay on the
    fitted lines.
    """
    inwards = np.arange(WARPED_BEAMS)
    count = np.clip(scan.mask[line].sum(axis=1) // 8, 1, WARPED_BEAMS)
    at = beam[:, None] - end[:, None] * inwards
    use = inwards < count[:, None]
    use &= (at >= 0) & (at < scan.mask.shape[1])
    cells = line[:, None], np.where(use, at, 0)
    use &= scan.mask[cells]
    misses = (scan.sweep.ranges - scan.fitted)[cells]
    middle = row_median(np.where(use, misses, np.nan))
    # of a median: pi / 2 times that of a mean
    noise = np.pi / 2 * scan.sigma_range**2 / np.maximum(use.sum(axis=1), 1)
    shift = np.zeros(len(line))
    sigma = np.zeros(len(line))
    for mine in (end == -1, end == 1):
        if mine.any():
            variance = np.median(middle[mine] ** 2) / 0.455  # the median of chi2(1)
            excess = max(variance - np.median(noise[mine]), 0.0)
            whole = excess + noise[mine]
            shift[mine] = middle[mine] * excess / whole
            sigma[mine] = np.sqrt(excess * noise[mine] / whole)
    return shift, sigma


def _inflation(by_angle, sigma, side, sides):
    """How much more the points of a side scatter than their spacing explains, at least 1, (n,).

    The spacing is along `by_angle`.
    """
    out = np.ones(len(side))
    for s in sides:
        mine = side == s.side
        way = s.ends[1] - s.ends[0]
        direction = way / np.linalg.norm(way)
        along = by_angle[mine] @ direction
        across = by_angle[mine] - along[:, None] * direction
        expected = np.sqrt(np.mean(sigma[mine] ** 2 * np.sum(across**2, axis=1)))
        if expected > 0:
            out[mine] = max(1.0, s.rms / expected)
    return out


def _group(scan, p_lrf, pitch, order, end, mixed, known):
    """The straight sides in the board's plane: the side of each point (-1 for none), and the sides.

    Where a post or an easel stands close behind a board, its edge is bent: such (`mixed`) points
    are left out, unless most of the board's outline lies before something close (a wall), which
    moves all of it alike.
    """
    if len(scan.sweep.pitch) == 1 or np.ptp(scan.sweep.pitch) < 1e-4:
        return (end + 1) // 2, ()  # scans at one pitch show one point a side
    axes = plane_axes(scan.normal)
    flat = lrf_to_platform(p_lrf, pitch, scan.T_head_lrf) @ axes.T
    tolerance = max(_spacing(scan), EDGE_SCATTER)
    shortest = 0.0
    if len(flat):
        shortest = SHORTEST_SIDE * np.linalg.norm(np.ptp(flat, axis=0))
    usable = ~mixed | (2 * mixed.sum() >= len(flat))
    side = np.full(len(flat), -1)
    sides = []
    for e in (-1, 1):
        mine = np.flatnonzero((end == e) & usable)
        left_out = np.unique(order[(end == e) & ~usable])  # makes no gap
        place = order[mine] - np.searchsorted(left_out, order[mine])
        for run in straight_runs(flat[mine], place, tolerance, shortest):
            rows = mine[run]
            new = _side_through(scan, flat[rows], axes, np.mean(pitch[rows]), e)
            same = [s.side for s in known if s.is_same(new)]
            number = same[0] if same else len(known) + len(sides)
            side[rows] = number
            sides.append(replace(new, side=number))
    return side, tuple(sides)


def _spacing(scan):
    """Median distance of neighbouring beams at the ends of the board's scan lines, metres."""
    row, first, last = row_ends(scan.mask & np.isfinite(scan.lines[:, :1]))
    steps = []
    for beam in (first, last):
        bearing = scan.sweep.bearings[beam]
        steps.append(_points_at(scan, row, beam, bearing, 0.0, False)[1])
    by_bearing = np.median(np.linalg.norm(np.concatenate(steps), axis=1))
    return float(by_bearing * np.median(np.diff(scan.sweep.bearings)))


def _side_through(scan, flat, axes, pitch, end):
    """The ScanSide, without its number, through points (n, 2) of the board's plane."""
    centre, direction, along, across = line_of(flat)
    ends = centre + np.outer([along.min(), along.max()], direction)
    scan_normal = _to_platform(scan, np.array([0.0, 0.0, 1.0]), pitch)
    level = np.cross(scan_normal, scan.normal)  # of the scan line on the board
    cosine = abs(level @ (direction @ axes)) / np.linalg.norm(level)
    variance = np.mean(across**2) * len(flat) / max(len(flat) - 2, 1)
    return ScanSide(
        side=-1,
        end=end,
        n_points=len(flat),
        length=float(np.ptp(along)),
        rms=float(np.sqrt(variance)),
        angle=float(np.arccos(min(cosine, 1.0))),
        ends=ends @ axes + scan.distance * scan.normal,
    )
