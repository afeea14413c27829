"""Where the board's edges cross the scan: edge points with covariance, straight sides, beams about
them, background.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points, tilt
from lrfcal_lib.preprocess.board_in_scan import (
    DEPTH_NOISE,
    STILL,
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
FEWEST_POINTS = 5  # of a straight side
MOST_RUNS = 4  # straight sides on one hand of a board
LEAST_TURN = np.radians(8)  # between neighbouring sides that end scan lines on the same hand
LEAST_ANGLE = np.radians(20)
SHORTEST_SIDE = 0.1  # of the board's size
UNIFORM = 1 / np.sqrt(12.0)  # standard deviation of a uniform distribution of width 1
EDGE_SCATTER = (
    0.006  # metres; about twice what the end points of a real board scatter about a straight edge
)
SAME_SIDE = 0.02  # metres; a side found by lines and by columns
# at most, at either end of a scan line, that tell how far the board lies from the fitted line
WARPED_BEAMS = 15
REACH = 2  # beams (or scan lines) on either side of a boundary
CORNER = 1.0  # spot radii: a spot nearer than this to a second edge may reach over it
SURE = 5.0  # standard deviations of a range: what is nearer to the board's plane read the board
MEDIAN_CHI2 = 0.455  # of chi-square with one degree of freedom
WIDEST_SPOT = (
    30  # beams or lines that a spot reaches over, at most, in the search for surfaces beside it
)


def beyond(scan, line, beam, step, beams=3):
    """Median range behind ends of the board, (n,), metres; inf where there is no reading.

    `line`, `beam` (n,) are the last cells on the board, `step` (n, 2) leads to the next one.
    """
    ends = np.stack([line, beam], axis=1)[:, None]
    cells = ends + step[:, None] * np.arange(1, beams + 1)[:, None]
    rows, columns = np.moveaxis(np.clip(cells, 0, np.array(scan.mask.shape) - 1), -1, 0)
    ranges = np.nan_to_num(scan.sweep.ranges[rows, columns], nan=np.inf)
    return np.sort(ranges, axis=1)[:, beams // 2]


def background_odds(here, behind):
    """What the background adds to the log odds of the board's share of a spot at which readings
    flip.

    ``2 ln(here / behind)``, the inverse square law; 0 with nothing behind, or so close that both
    give one echo."""
    behind = np.asarray(behind, float)
    apart = np.isfinite(behind) & (behind - here >= MIXING)
    ratio = np.ones(np.broadcast_shapes(np.shape(here), behind.shape))
    np.divide(here, behind, out=ratio, where=apart)
    return 2 * np.log(ratio)


def straight_runs(points, order, tolerance, shortest):
    """Split a trace (n, 2) into straight runs: random sample consensus, the longest run first.

    `order` (n,) is the place along the trace (scan line or beam number). Returns the indices of the
    points of each run. Runs with fewer than five points, too short, or turned by less than 8 deg
    against a longer one (the same side, bent or frayed) are not returned."""
    rng = np.random.default_rng(0)
    remaining = np.arange(len(points))
    runs = []
    directions = []
    for _ in range(2 * MOST_RUNS):
        if len(remaining) < FEWEST_POINTS or len(runs) == MOST_RUNS:
            break
        inliers = remaining[_consensus(points[remaining], tolerance, shortest / 2, rng)]
        if len(inliers) == 0:
            break
        run = _without_gaps(inliers, order)
        if len(run) < FEWEST_POINTS:
            break
        remaining = np.setdiff1d(remaining, run)
        fitted = line_of(points[run])
        turned = all(abs(fitted.direction @ other) < np.cos(LEAST_TURN) for other in directions)
        if turned and np.ptp(fitted.along) >= shortest:
            runs.append(run)
            directions.append(fitted.direction)
    return runs


def _without_gaps(inliers, order):
    """The largest part of a run without a gap of more than a tenth of it (five steps at least)."""
    ordered = inliers[np.argsort(order[inliers], kind="stable")]
    gaps = np.diff(order[ordered]) > max(5, 0.1 * len(ordered))
    part = np.cumsum(np.r_[0, gaps])
    return np.sort(ordered[part == np.bincount(part).argmax()])


@dataclass(frozen=True)
class PlaneLine:
    """A line in a plane, and where points lie beside it.

    Attributes
    ----------
    centre, direction : ndarray, shape (2,)
        A point of it, metres, and its unit direction.
    along, across : ndarray, shape (n,)
        Places of the points along the line from the centre, and to its left, metres.
    """

    centre: np.ndarray
    direction: np.ndarray
    along: np.ndarray
    across: np.ndarray


def line_of(points: np.ndarray, among=slice(None)) -> PlaneLine:
    """Total least squares line of points (n, 2), metres; it is fitted to those `among` them, and
    places all.
    """
    centre = points[among].mean(axis=0)
    offset = points - centre
    _, axes = np.linalg.eigh(offset[among].T @ offset[among])
    direction = axes[:, 1]
    across = offset[:, 1] * direction[0] - offset[:, 0] * direction[1]
    return PlaneLine(centre, direction, offset @ direction, across)


def _consensus(points, tolerance, apart, rng, trials=300):
    """Which points lie near the line that most points agree with, after two least-squares
    refinements.
    """
    a = points[rng.integers(len(points), size=trials)]
    b = points[rng.integers(len(points), size=trials)]
    length = np.linalg.norm(b - a, axis=1)
    far = length > apart
    if not far.any():
        return np.zeros(len(points), bool)
    a = a[far]
    along = (b[far] - a) / length[far, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    distance = normal @ points.T - np.sum(normal * a, axis=1)[:, None]
    # The sum of truncated squares ranks lines through the middle of a trace above those along its
    # rim.
    best = np.minimum((distance / tolerance) ** 2, 1).sum(axis=1).argmin()
    on = np.abs(distance[best]) < tolerance
    for _ in range(2):
        if on.sum() >= 2:
            on = np.abs(line_of(points, on).across) < tolerance
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
        """Whether two sides are one: the same direction, and no farther apart than two
        centimetres.
        """
        apart = np.cross(other.ends.mean(axis=0) - self.ends.mean(axis=0), self.direction)
        parallel = abs(self.direction @ other.direction) > np.cos(LEAST_TURN)
        return parallel and np.linalg.norm(apart) < SAME_SIDE

    @property
    def direction(self):
        """Unit direction of the side in the nominal platform frame."""
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
    half_step : ndarray, shape (n, 3)
        From the point halfway between the last beam on the board and the first off it to the
        latter, metres.
    noise : ndarray, shape (n, 3, 3)
        The covariance without the beam spacing.
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
    half_step: np.ndarray
    noise: np.ndarray
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
    ends = _ends(scan, across)
    if across:
        shift = warp_sigma = 0.0
    else:
        shift, warp_sigma = _warp(scan, ends)
    here = scan.fitted[ends.line, ends.beam]
    behind = beyond(scan, ends.line, ends.beam, ends.step)
    halfway = _points_at(scan, ends, ends.middle, shift)
    side, every = _group(scan, halfway.points, ends, behind - here < MIXING, known)
    sigma = np.abs(ends.gap) * UNIFORM
    sigma = sigma * _inflation(_to_platform(scan, halfway.by_angle, ends.when), sigma, side, every)
    sides = tuple(s for s in every if _angle_across(s, across) >= LEAST_ANGLE)
    if every:  # scans at one pitch have no sides, and keep all points
        side = np.where(np.isin(side, [s.side for s in sides]), side, -1)

    edges = {}
    for variant, angle, pitch in (
        ("last_beam", ends.inner, ends.pitch),
        ("half_step", ends.middle, ends.when),
    ):
        at = _points_at(scan, ends, angle, shift)
        rays = at.points / np.linalg.norm(at.points, axis=1, keepdims=True)
        noise = _outer(rays * np.hypot(at.range_sigma, warp_sigma)[:, None])
        spacing = _outer(at.by_angle * sigma[:, None])
        edges[variant] = ScanEdges(
            variant=variant,
            points=at.points,
            covariance=spacing + noise,
            pitch=pitch,
            line=ends.line,
            beam=ends.beam,
            step=ends.step,
            end=ends.end,
            side=side,
            sides=sides,
            half_step=halfway.by_angle * (ends.gap / 2)[:, None],
            noise=noise,
            background=background_odds(here, behind),
        )
    return edges, every


def _angle_across(side, across):
    """Angle between a side and what crosses it: scan lines or, with `across`, columns."""
    if across:
        return np.pi / 2 - side.angle
    return side.angle


def _outer(v):
    """``v v^T`` of rows (n, 3), shape (n, 3, 3)."""
    return v[:, :, None] * v[:, None, :]


@dataclass(frozen=True)
class Ends:
    """Where scan lines or, with `across`, columns leave the board.

    Attributes
    ----------
    across : bool
    line, beam : ndarray of int, shape (n,)
        The last cell on the board.
    step : ndarray of int, shape (n, 2)
        From it to the first cell off the board.
    end : ndarray of int, shape (n,)
        -1 or +1, as in `ScanSide`.
    pitch : ndarray, shape (n,)
        Of the last cell, radians.
    inner, gap : ndarray, shape (n,)
        Bearing (of columns: pitch) of the last cell, and from it to the first one off the board,
        radians.
    middle : ndarray, shape (n,)
        Halfway between the two, radians.
    """

    across: bool
    line: np.ndarray
    beam: np.ndarray
    step: np.ndarray
    end: np.ndarray
    pitch: np.ndarray
    inner: np.ndarray
    gap: np.ndarray
    middle: np.ndarray

    @property
    def order(self):
        """Place of each end along the board's outline: its scan line, or its column."""
        return self.beam if self.across else self.line

    @property
    def when(self):
        """Pitch of the point halfway between the last cell on the board and the first off it,
        radians.
        """
        return self.middle if self.across else self.pitch


def _ends(scan, across):
    """Ends of scan lines (of columns) on the board that may be edges."""
    pitch = scan.sweep.pitch
    mask = scan.mask
    if across:
        mask = mask.T
    rows, first, last = row_ends(mask)
    row = np.r_[rows, rows]
    cell = np.r_[first, last]
    way = np.repeat([-1, 1], len(rows))
    line, beam = row, cell
    if across:
        line, beam = cell, row
    keep = (cell >= BORDER) & (cell < mask.shape[1] - BORDER) & np.isfinite(scan.lines[line, 0])
    line, beam, way = line[keep], beam[keep], way[keep]

    if across:
        step = np.stack([way, 0 * way], axis=1)
        turned = pitch[line + way] - pitch[line]
    else:
        step = np.stack([0 * way, way], axis=1)
        turned = np.median(np.diff(scan.sweep.bearings))
    here = scan.fitted[line, beam]
    after = scan.sweep.ranges[line + step[:, 0], beam + step[:, 1]]
    visible = ~(after < here - depth_jump(here, turned))  # nothing nearer hides the board
    return _ends_at(scan, across, line[visible], beam[visible], step[visible], way[visible])


def _ends_at(scan, across, line, beam, step, way):
    """Ends at some cells, with their angles."""
    pitch = scan.sweep.pitch
    angles, cell = scan.sweep.bearings, beam
    end = way
    if across:
        angles, cell = pitch, line
        if len(pitch) > 1 and np.polyfit(np.arange(len(pitch)), pitch, 1)[0] <= 0:
            end = -way  # the sweep goes downwards
    inner = angles[cell]
    outer = angles[cell + way]
    gap = outer - inner
    if across and len(angles) > 1:  # the pitch is read in steps, it may seem to stand still
        least = np.median(np.abs(np.diff(angles)))
        gap = np.copysign(np.maximum(np.abs(gap), least), gap)
    return Ends(across, line, beam, step, end, pitch[line], inner, gap, (inner + outer) / 2)


@dataclass(frozen=True)
class EndPoints:
    """Points of the board where scan lines or columns end.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        LRF frame, metres.
    by_angle : ndarray, shape (n, 3)
        Their derivative by the angle at which they end, metres a radian.
    range_sigma : ndarray, shape (n,)
        Standard deviation of the fitted range, metres.
    """

    points: np.ndarray
    by_angle: np.ndarray
    range_sigma: np.ndarray


def _points_at(scan, ends, angle, shift):
    """EndPoints where scan lines end at bearings, or columns at pitch angles."""
    if not ends.across:
        return _points_on_lines(scan, ends.line, angle, shift)
    rays = polar_to_points(1.0, scan.sweep.bearings[ends.beam])
    there = _plane_range(scan, rays, angle)[0]
    here = _plane_range(scan, rays, ends.pitch)[0]
    ranges = scan.fitted[ends.line, ends.beam] + (there - here)  # as the board's plane predicts
    points = ranges[:, None] * rays
    R_head_lrf = scan.T_head_lrf.rotation.as_matrix()
    by_pitch = np.cross([1.0, 0.0, 0.0], scan.T_head_lrf.apply(points)) @ R_head_lrf
    normal = tilt(scan.normal, -angle) @ R_head_lrf
    slide = np.vecdot(normal, by_pitch) / np.vecdot(normal, rays)  # the point stays on the plane
    return EndPoints(
        points, by_pitch - slide[:, None] * rays, _fitted_range(scan, ends.line, rays)[1]
    )


def _points_on_lines(scan, line, bearing, shift):
    """EndPoints on the fitted scan lines, moved by `shift` along the ray."""
    rays = polar_to_points(1.0, bearing)
    by_bearing = np.stack([-rays[:, 1], rays[:, 0], 0 * bearing], axis=1)
    r, sigma = _fitted_range(scan, line, rays)
    slope = -(r**2) * np.sum(scan.lines[line] * by_bearing[:, :2], axis=1)
    by_angle = slope[:, None] * rays + r[:, None] * by_bearing
    return EndPoints((r + shift)[:, None] * rays, by_angle, sigma)


def _fitted_range(scan, line, rays):
    """Range along rays to the fitted scan lines ``u . p = 1``, and its standard
    deviation, metres.
    """
    flat = rays[:, :2]
    r = 1 / np.sum(scan.lines[line] * flat, axis=1)
    variance = np.einsum("ni,nij,nj->n", flat, scan.lines_covariance[line], flat)
    return r, r**2 * np.sqrt(variance)


def _plane_range(scan, rays, pitch):
    """Range along rays (LRF frame) to the board's plane, and the cosine of their incidence."""
    cosine = _to_platform(scan, rays, pitch) @ scan.normal
    height = scan.distance - tilt(scan.T_head_lrf.translation, pitch) @ scan.normal
    with np.errstate(divide="ignore", invalid="ignore"):
        return height / cosine, cosine


def _to_platform(scan, vectors, pitch):
    """Directions (not points) from the LRF at a pitch to the nominal platform frame."""
    return tilt(vectors @ scan.T_head_lrf.rotation.as_matrix().T, pitch)


def _warp(scan, ends):
    """How far the board lies from the fitted lines at their ends, and the standard deviation of
    that, metres.

    A board bends, and cardboard reads farther than paper. The outermost eighth of a line (15 beams
    at most) says how far each end is off; how much these medians vary beyond their noise over all
    lines says how far to believe them. On a flat board that is nothing, and the ends stay on the
    fitted lines."""
    count = np.clip(scan.mask[ends.line].sum(axis=1) // 8, 1, WARPED_BEAMS)
    inwards = np.arange(WARPED_BEAMS)
    beams = ends.beam[:, None] - ends.end[:, None] * inwards
    use = (inwards < count[:, None]) & (beams >= 0) & (beams < scan.mask.shape[1])
    cells = ends.line[:, None], np.where(use, beams, 0)
    use &= scan.mask[cells]
    off = np.where(use, (scan.sweep.ranges - scan.fitted)[cells], np.nan)
    median = row_median(off)
    noise = np.pi / 2 * scan.sigma_range**2 / np.maximum(use.sum(axis=1), 1)  # variance of a median
    shift = np.zeros(len(median))
    sigma = np.zeros(len(median))
    for hand in (ends.end == -1, ends.end == 1):
        if hand.any():
            scatter = np.median(median[hand] ** 2) / MEDIAN_CHI2
            excess = max(scatter - np.median(noise[hand]), 0.0)
            believed = excess / (excess + noise[hand])
            shift[hand] = median[hand] * believed
            sigma[hand] = np.sqrt(noise[hand] * believed)
    return shift, sigma


def _inflation(by_angle, sigma, side, sides):
    """How much more the points of a side scatter than their spacing (along `by_angle`) explains, at
    least 1, (n,).
    """
    inflation = np.ones(len(side))
    for s in sides:
        rows = side == s.side
        direction = s.direction
        across = by_angle[rows] - (by_angle[rows] @ direction)[:, None] * direction
        expected = np.sqrt(np.mean(sigma[rows] ** 2 * np.sum(across**2, axis=1)))
        if expected > 0:
            inflation[rows] = max(1.0, s.rms / expected)
    return inflation


def _group(scan, p_lrf, ends, mixed, known):
    """The straight sides in the board's plane: the side of each point (-1 for none), and the sides.

    Where a post or an easel stands close behind a board, its edge is bent: such (`mixed`) points
    are left out, unless most of the board's outline lies before something close (a wall), which
    moves all of it alike."""
    if len(scan.sweep.pitch) == 1 or np.ptp(scan.sweep.pitch) < STILL:
        return (ends.end + 1) // 2, ()  # scans at one pitch show one point a side
    axes = plane_axes(scan.normal)
    flat = lrf_to_platform(p_lrf, ends.when, scan.T_head_lrf) @ axes.T
    tolerance = max(_beam_spacing(scan), EDGE_SCATTER)
    shortest = 0.0
    if len(flat):
        shortest = SHORTEST_SIDE * np.linalg.norm(np.ptp(flat, axis=0))
    usable = ~mixed | (2 * mixed.sum() >= len(flat))
    side = np.full(len(flat), -1)
    sides = []
    for hand in (-1, 1):
        points = np.flatnonzero((ends.end == hand) & usable)
        left_out = np.unique(ends.order[(ends.end == hand) & ~usable])  # makes no gap
        place = ends.order[points] - np.searchsorted(left_out, ends.order[points])
        for run in straight_runs(flat[points], place, tolerance, shortest):
            rows = points[run]
            new = _side(scan, flat[rows], np.mean(ends.when[rows]), hand)
            number = next((s.side for s in known if s.is_same(new)), len(known) + len(sides))
            side[rows] = number
            sides.append(replace(new, side=int(number)))
    return side, tuple(sides)


def _beam_spacing(scan):
    """Median distance between neighbouring points of a scan line at the board's ends, metres."""
    row, first, last = row_ends(scan.mask & np.isfinite(scan.lines[:, :1]))
    bearings = scan.sweep.bearings
    ends = [_points_on_lines(scan, row, bearings[beam], 0.0) for beam in (first, last)]
    by_bearing = np.concatenate([at.by_angle for at in ends])
    return float(np.median(np.linalg.norm(by_bearing, axis=1)) * np.median(np.diff(bearings)))


def _side(scan, flat, pitch, hand):
    """The ScanSide (without a number) through points (n, 2) of the board's plane, about
    some pitch.
    """
    axes = plane_axes(scan.normal)
    fitted = line_of(flat)
    reach = np.array([fitted.along.min(), fitted.along.max()])
    ends = (fitted.centre + np.outer(reach, fitted.direction)) @ axes + scan.distance * scan.normal
    level = np.cross(_to_platform(scan, np.array([0.0, 0.0, 1.0]), pitch), scan.normal)
    cosine = min(abs(level @ (fitted.direction @ axes)) / np.linalg.norm(level), 1.0)
    freedom = max(len(flat) - 2, 1)
    return ScanSide(
        side=-1,
        end=hand,
        n_points=len(flat),
        length=float(np.ptp(fitted.along)),
        rms=float(np.sqrt(np.mean(fitted.across**2) * len(flat) / freedom)),
        angle=float(np.arccos(cosine)),
        ends=ends,
    )


def edge_cells(scan, along, swept, lrf):
    """The beams about every boundary of the board, along and across the scan lines.

    Parameters
    ----------
    scan : BoardScan
    along, swept : ScanEdges
        Of :func:`crossings`, along and across the scan lines; None instead of `swept` for a single
        shot.
    lrf : LrfInfo
        Knows the spot.

    Returns
    -------
    recarray
        ``line`` and ``beam`` (every pair appears once); ``bearing`` and ``pitch``, radians;
        ``hit``, whether the beam read the board; ``side``, its number as in ScanEdges; ``range_m``,
        distance of the board's plane along the beam, and ``radius`` of the spot there, metres;
        ``background``, what it adds to the log odds at which the reading flips, as far as distances
        and incidence tell it; ``across``, whether the boundary was found across the scan lines (the
        neighbour is a scan line, not a beam); ``step``, angle between neighbours in that direction,
        radians. Of all straight sides, without cells in holes, at the border of the view, where
        something nearer hides the board, with two edges in one spot, and beside a background less
        than a pulse length (1 m) behind, whose echo melts into the board's. Where most of the
        outline has such a background they stay, with `background` 0; so do all cells where most
        boundaries have no return behind them (clouds cut to the board).
    """
    found = [edges for edges in (along, swept) if edges is not None]
    border = _Border.of(scan, found, lrf)
    row, k, line, beam = _neighbours(border, scan.mask.shape)
    sides = [s for edges in found for s in edges.sides]
    side = border.side[row]
    hit, keep = _read_the_board(scan, border, line, beam, k)
    reach = (CORNER * border.radius / np.abs(border.cosine))[line, beam]
    keep &= _on_one_side(scan, (line, beam), border.board, reach, sides, side)
    across = border.step[row, 0] != 0
    cells = {
        "line": line,
        "beam": beam,
        "bearing": scan.sweep.bearings[beam],
        "pitch": scan.sweep.pitch[line],
        "hit": hit,
        "side": side,
        "range_m": border.board[line, beam],
        "radius": border.radius[line, beam],
        "background": border.background[row],
        "across": across,
        "step": np.where(across, *border.gaps),
    }
    return np.rec.fromarrays([*cells.values()], names=[*cells])[keep]


@dataclass(frozen=True)
class _Border:
    """All boundaries of a board on straight sides, and the board's plane as the beams meet it.

    `board` and `radius` (l, b) are the range to the plane and the spot's radius there, metres;
    `cosine` that of the incidence; `close` tells that most boundaries have nothing, or something
    close, behind them; `gaps` are the angles between scan lines and between beams."""

    line: np.ndarray
    beam: np.ndarray
    step: np.ndarray
    side: np.ndarray
    board: np.ndarray
    cosine: np.ndarray
    radius: np.ndarray
    background: np.ndarray
    usable: np.ndarray
    close: bool
    gaps: tuple[float, float]

    @classmethod
    def of(cls, scan, found, lrf):
        """Those of some ScanEdges."""
        line, beam, step, side = (
            np.concatenate([getattr(edges, name)[edges.side >= 0] for edges in found])
            for name in ("line", "beam", "step", "side")
        )
        rays = polar_to_points(1.0, scan.sweep.bearings)
        board, cosine = _plane_range(scan, rays, scan.sweep.pitch[:, None])
        board[~(board > 0)] = np.nan
        here = board[line, beam]
        behind = beyond(scan, line, beam, step)
        measured = np.isfinite(behind)
        mixed = behind - here < MIXING
        close = len(measured) == 0 or np.mean(measured) < 0.5 or np.mean(mixed) >= 0.5
        if close:
            background = np.zeros(len(here))
            usable = np.arange(len(here))
        else:
            background = background_odds(here, behind)
            usable = np.flatnonzero(measured & ~mixed)
        gaps = median_step(scan.sweep.pitch), median_step(scan.sweep.bearings)
        radius = lrf.spot_radius(board)
        return cls(line, beam, step, side, board, cosine, radius, background, usable, close, gaps)


def _read_the_board(scan, border, line, beam, k):
    """Which cells read the board, and which can tell: none that something hides or whose spot meets
    something close.

    `k` counts the steps from the boundary, positive outside.
    """
    # before a far background also beams that noise takes off the plane read the board
    near = max(SURE * scan.sigma_range, DEPTH_NOISE)
    with np.errstate(invalid="ignore"):
        miss = scan.sweep.ranges - border.board
        excess = miss[line, beam]
        hit = scan.mask[line, beam] | ((np.abs(excess) < near) & (not border.close))
        # without what hides the board, and without holes: nothing, or something near, read inside
        # the boundary
        keep = hit | (~(excess < -near) & ((excess > MIXING) | (k > 0)))
        if border.close:
            return hit, keep
        # without cells whose spot may reach a surface (not the odd reading) less than a pulse
        # length away
        beside = ndimage.binary_opening((np.abs(miss) > near) & (miss < MIXING), np.ones((2, 2)))
    size = np.nanmedian((border.radius / border.board)[scan.mask])
    steps = [min(int(np.ceil(size / gap)), WIDEST_SPOT) for gap in border.gaps]
    spot = np.ones([2 * count + 1 for count in steps])
    keep &= ~ndimage.binary_dilation(beside, spot)[line, beam]
    return hit, keep


def _neighbours(border, shape):
    """Cells about boundaries, each once, with the nearest boundary: its number, the step k from it,
    line and beam.
    """
    k, row = np.meshgrid(np.arange(1 - REACH, REACH + 1), border.usable, indexing="ij")
    k = k.ravel()
    row = row.ravel()
    order = np.argsort(np.abs(k - 0.5), kind="stable")
    k = k[order]
    row = row[order]
    step = border.step[row]
    cell = np.stack([border.line, border.beam], axis=1)[row] + k[:, None] * step
    margin = np.where(step != 0, BORDER, 0)
    inside = np.all((cell >= margin) & (cell < shape - margin), axis=1)
    line, beam = cell[inside].T
    _, first = np.unique(line * shape[1] + beam, return_index=True)
    return row[inside][first], k[inside][first], line[first], beam[first]


def _on_one_side(scan, cells, board, reach, sides, side):
    """Cells on the stretch of their own side whose spot reaches no other one; all of them where
    sides are not known.
    """
    line, beam = cells
    p_lrf = polar_to_points(board[cells], scan.sweep.bearings[beam])
    axes = plane_axes(scan.normal)
    flat = lrf_to_platform(p_lrf, scan.sweep.pitch[line], scan.T_head_lrf) @ axes.T
    on_stretch = ~np.isin(side, [s.side for s in sides])
    alone = np.ones(len(side), bool)
    for s in sides:
        first, last = s.ends @ axes.T
        direction = (last - first) / np.linalg.norm(last - first)
        along = (flat - first) @ direction
        apart = np.abs((flat - first) @ [-direction[1], direction[0]])
        of_side = side == s.side
        on_stretch |= of_side & (along > 0) & (along < s.length)
        alone &= of_side | ~(apart < reach)
    return on_stretch & alone
