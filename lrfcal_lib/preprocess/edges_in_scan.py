"""Where the board's edges cross the scan: edge points with covariance, straight sides, beams about them, background."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy import ndimage

from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points, tilt
from lrfcal_lib.preprocess.board_in_scan import DEPTH_NOISE, depth_jump, plane_axes, row_ends, row_median
from lrfcal_lib.session.stated import ASSUMED_SPOT_RADIUS

MIXING = 1.0  # metres; an LMS2xx gives one reading for two surfaces nearer together along the beam (telegram listing)


def beyond(scan, line, beam, down, right, beams=3):
    """Range of what stands behind ends of the board: the median of the next readings, inf where there is none.

    Parameters
    ----------
    scan : BoardScan
    line, beam : ndarray of int, shape (n,)
        The last cell on the board.
    down, right : ndarray of int, shape (n,)
        Step to the first cell off it, in scan lines and beams.
    beams : int
        Readings that count.

    Returns
    -------
    ndarray, shape (n,)
        Metres.
    """
    step, shape = np.arange(1, beams + 1), scan.mask.shape
    rows = np.clip(line[:, None] + down[:, None] * step, 0, shape[0] - 1)
    columns = np.clip(beam[:, None] + right[:, None] * step, 0, shape[1] - 1)
    return np.sort(np.nan_to_num(scan.sweep.ranges[rows, columns], nan=np.inf), axis=1)[:, beams // 2]


def background_odds(here, behind):
    """What the background adds to the log odds of the board's share of a spot at which readings flip.

    Parameters
    ----------
    here, behind : array_like
        Ranges of the board and of what stands behind it, metres.

    Returns
    -------
    ndarray
        ``2 ln(here / behind)``, the inverse square law; 0 where nothing is seen behind, or so close behind that both
        give one echo.
    """
    behind = np.asarray(behind, float)
    apart = np.isfinite(behind) & (behind - here >= MIXING)
    return 2 * np.log(np.where(apart, here / np.where(apart, behind, 1.0), 1.0))


FEWEST_POINTS = 5
LEAST_TURN = np.radians(8)  # between neighbouring sides that end scan lines on the same hand


def straight_runs(points, order, tolerance, shortest, rng=None, most=4):
    """Split a trace into straight runs: random sample consensus, the longest run first.

    Parameters
    ----------
    points : ndarray, shape (n, 2)
        Metres.
    order : ndarray, shape (n,)
        Position along the trace (scan line or beam number).
    tolerance : float
        Distance from a line up to which a point belongs to it, metres.
    shortest : float
        Shortest length of a run, metres.
    rng : numpy.random.Generator, optional
    most : int
        Number of runs at most.

    Returns
    -------
    list of ndarray of int
        Indices of the points of each run. Runs with fewer than five points, too short, or turned by less
        than 8 deg against a longer one (the same side, bent or frayed) are not returned.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    left, runs, directions = np.arange(len(points)), [], []
    for _ in range(2 * most):
        if len(left) < FEWEST_POINTS or len(runs) == most:
            break
        found = left[_consensus(points[left], tolerance, shortest / 2, rng)]
        found = _contiguous(found, order)
        if len(found) < FEWEST_POINTS:
            break
        left = np.setdiff1d(left, found)
        _, direction, along, _ = line_of(points[found])
        turned = [abs(direction @ d) < np.cos(LEAST_TURN) for d in directions]
        if np.ptp(along) >= shortest and all(turned):
            runs.append(found)
            directions.append(direction)
    return runs


def line_of(points):
    """Total least squares line in a plane.

    Parameters
    ----------
    points : ndarray, shape (n, 2)

    Returns
    -------
    centre, direction : ndarray, shape (2,)
    along, across : ndarray, shape (n,)
        Coordinates of the points along the line and their signed distances from it.
    """
    centre = points.mean(axis=0)
    direction = np.linalg.eigh((points - centre).T @ (points - centre))[1][:, 1]
    offset = points - centre
    return centre, direction, offset @ direction, offset[:, 1] * direction[0] - offset[:, 0] * direction[1]


def _consensus(points, tolerance, apart, rng, trials=300):
    """Indices of the points near the line that most points agree with, after two least-squares refinements."""
    a, b = points[rng.integers(len(points), size=trials)], points[rng.integers(len(points), size=trials)]
    length = np.linalg.norm(b - a, axis=1)
    far = length > apart
    if not far.any():
        return np.zeros(0, int)
    a, along = a[far], (b - a)[far] / length[far, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    distance = normal @ points.T - np.sum(normal * a, axis=1)[:, None]
    # The sum of truncated squares ranks lines through the middle of a trace above those along its rim.
    best = np.minimum((distance / tolerance) ** 2, 1).sum(axis=1).argmin()
    on = np.abs(distance[best]) < tolerance
    for _ in range(2):
        if on.sum() < 2:
            break
        centre, direction, _, _ = line_of(points[on])
        offset = points - centre
        on = np.abs(offset[:, 1] * direction[0] - offset[:, 0] * direction[1]) < tolerance
    return np.flatnonzero(on)


def _contiguous(found, order):
    """The largest part of a run without a gap of more than a tenth of it (five steps at least)."""
    if len(found) == 0:
        return found
    found = found[np.argsort(order[found], kind="stable")]
    gap = max(5, 0.1 * len(found))
    part = np.cumsum(np.r_[0, np.diff(order[found]) > gap])
    return np.sort(found[part == np.bincount(part).argmax()])


VARIANTS = ("half_step", "last_beam")
BORDER = 3  # beams or lines at the border of the view, where the board's end cannot be told from the view's end
LEAST_ANGLE = np.radians(20)
SHORTEST_SIDE = 0.1  # of the board's size
UNIFORM = 1 / np.sqrt(12.0)  # standard deviation of a uniform distribution of width 1
EDGE_SCATTER = 0.006  # metres; about twice what the end points of a real board scatter about a straight edge
EDGE_BEND = 0.001  # metres; error of edge points that no number of them averages out
SAME_SIDE = 0.02  # metres; a side found by lines and by columns


@dataclass(frozen=True)
class ScanSide:
    """A straight side of the board as a scan sees it.

    Attributes
    ----------
    side : int
        Number within the placement; the same in all variants and in :func:`sweep_edges`.
    end : int
        -1 where it ends scan lines at low bearings (right), +1 at high bearings (left); of :func:`sweep_edges`: -1
        where it ends columns at low pitch, +1 at high pitch.
    n_points : int
    length : float
        Of the stretch with points, metres.
    rms : float
        Distance of the points from the side within the board's plane, metres.
    angle : float
        Between the side and the scan lines (0 .. pi/2, radians). A side seen at a small angle is crossed by few
        scan lines and moves along with every error of the pitch.
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

    @property
    def angle_sigma(self):
        """Standard deviation of the side's direction within the board's plane, radians.

        That of a line through n points spread evenly over the length, ``sqrt(12 / n) rms / length``, where neighbours
        share their errors in pairs, and with a millimetre that never averages out: what stands behind an edge changes
        along it, and with it where a wide spot takes the edge to be.
        """
        return float(np.sqrt(12 * (2 * self.rms**2 / self.n_points + EDGE_BEND**2)) / self.length)


@dataclass(frozen=True)
class ScanEdges:
    """Where the board's edges cross the scan.

    Attributes
    ----------
    placement : int
    variant : {'half_step', 'last_beam'}
    points : ndarray, shape (n, 3)
        LRF frame at the pitch of the point, metres; on the fitted scan line.
    covariance : ndarray, shape (n, 3, 3)
    pitch : ndarray, shape (n,)
        Radians.
    line : ndarray of int, shape (n,)
        Scan line (of :func:`sweep_edges`: the last one that hit the board).
    end : ndarray of int, shape (n,)
        As in `ScanSide`.
    side : ndarray of int, shape (n,)
        Number of the straight side; -1 for outliers.
    sides : tuple of ScanSide
    half_step : ndarray, shape (n, 3)
        From the point halfway between the last beam on the board and the first off it to the latter, metres.
    noise : ndarray, shape (n, 3, 3)
        The covariance without the beam spacing.
    background : ndarray, shape (n,)
        What the distance of the background adds to the log odds at which readings flip (:func:`background_odds`).
    """

    placement: int
    variant: str
    points: np.ndarray
    covariance: np.ndarray
    pitch: np.ndarray
    line: np.ndarray
    end: np.ndarray
    side: np.ndarray
    sides: tuple[ScanSide, ...]
    half_step: np.ndarray
    noise: np.ndarray
    background: np.ndarray


def edge_points(scan, variant="half_step", *, min_angle=LEAST_ANGLE):
    """Where scan lines cross the board's edges; step (iii) of the paper's preprocessing.

    Parameters
    ----------
    scan : BoardScan
    variant : {'half_step', 'last_beam'}
        'half_step': halfway between the last beam on the board and the first off it, unbiased for an edge anywhere
        between them. 'last_beam': the paper's rule, half a step inside on average.
    min_angle : float
        Sides that meet the scan lines at a smaller angle are left out (their points get side -1), radians: there the
        pitch decides where a line ends, and :func:`sweep_edges` sees the side better.

    Returns
    -------
    ScanEdges
        Ends of scan lines at holes inside the board do not appear; neither do ends at the border of the field of
        view, nor where something nearer hides the board. The points lie on the fitted straight line (the paper), moved
        along the ray by what the outermost beams say where the board turns out to be warped. The covariance holds the
        beam spacing (uniform over one step), the line fit and warp, and what a side scatters more than that.

    Raises
    ------
    ValueError
        For another variant.
    """
    _check_variant(variant)
    row, beam, end = _line_ends(scan)
    bearings, pitch = scan.sweep.bearings, scan.sweep.pitch[row]
    shift, warp_sigma = _warp(scan, row, beam, end)
    points, along, line_sigma = _crossings(scan, row, (bearings[beam] + bearings[beam + end]) / 2, shift)
    here, behind = scan.fitted[row, beam], beyond(scan, row, beam, 0 * end, end)
    side, sides = _group(scan, points, pitch, row, end, behind - here < MIXING)
    half = along * ((bearings[beam + end] - bearings[beam]) / 2)[:, None]
    sigma = np.abs(bearings[beam + end] - bearings[beam]) * UNIFORM
    sigma = sigma * _inflation(_to_platform(scan, along, pitch), sigma, side, sides)
    if variant == "last_beam":
        points, along, line_sigma = _crossings(scan, row, bearings[beam], shift)
    noise = _outer(_rays(points) * np.hypot(line_sigma, warp_sigma)[:, None])
    covariance = _outer(along * sigma[:, None]) + noise
    side, sides = _keep(side, sides, [s for s in sides if s.angle >= min_angle])
    more = half, noise, background_odds(here, behind)
    return ScanEdges(scan.placement, variant, points, covariance, pitch, row, end, side, sides, *more)


def _keep(side, sides, kept):
    """Forget all sides but some; without sides (scans at one pitch) nothing changes."""
    if not sides:
        return side, sides
    return np.where(np.isin(side, [s.side for s in kept]), side, -1), tuple(kept)


def _rays(points):
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def _check_variant(variant):
    if variant not in VARIANTS:
        raise ValueError(f"variant is one of {', '.join(VARIANTS)}, got '{variant}'")


def _line_ends(scan):
    """Ends of scan lines on the board that may be edges: rows, beams, -1 / +1 for low and high bearings."""
    rows, first, last = row_ends(scan.mask)
    row, beam = np.r_[rows, rows], np.r_[first, last]
    end = np.repeat([-1, 1], len(rows))
    keep = (beam >= BORDER) & (beam < scan.mask.shape[1] - BORDER) & np.isfinite(scan.lines[row, 0])
    row, beam, end = row[keep], beam[keep], end[keep]
    here, step = scan.fitted[row, beam], np.median(np.diff(scan.sweep.bearings))
    visible = ~(scan.sweep.ranges[row, beam + end] < here - depth_jump(here, step))
    return row[visible], beam[visible], end[visible]


def _crossings(scan, row, bearing, shift=0.0):
    """Points of fitted lines (plus a shift of the range) at bearings, derivative by the bearing, sigma of the range."""
    u, ray = scan.lines[row], np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    turned = np.stack([-ray[:, 1], ray[:, 0]], axis=1)
    r = 1 / np.sum(u * ray, axis=1)
    slope = -(r**2) * np.sum(u * turned, axis=1)
    along = np.column_stack([slope[:, None] * ray + r[:, None] * turned, np.zeros(len(r))])
    variance = r**4 * np.einsum("ni,nij,nj->n", ray, scan.lines_covariance[row], ray)
    return polar_to_points(r + shift, bearing), along, np.sqrt(variance)


def _warp(scan, row, beam, end, most=15):
    """How far the board lies from the fitted lines at their ends, and the standard deviation of that, metres.

    A board bends, and cardboard reads farther than paper. The outermost eighth of a line (15 beams at most) says how
    far each end is off; how much these medians vary beyond their noise over all lines says how far to believe them.
    On a flat board that is nothing, and the ends stay on the fitted lines.
    """
    hits = scan.mask[row].sum(axis=1)
    count = np.clip(hits // 8, 1, most)
    at = beam[:, None] - end[:, None] * np.arange(most)
    use = (np.arange(most) < count[:, None]) & (at >= 0) & (at < scan.mask.shape[1])
    at = np.where(use, at, 0)
    use &= scan.mask[row[:, None], at]
    miss = np.where(use, scan.sweep.ranges[row[:, None], at] - scan.fitted[row[:, None], at], np.nan)
    middle, noise = row_median(miss), np.pi / 2 * scan.sigma_range**2 / np.maximum(use.sum(axis=1), 1)
    shift, sigma = np.zeros(len(row)), np.zeros(len(row))
    for mine in (end == -1, end == 1):
        if mine.any():
            excess = max(np.median(middle[mine] ** 2) / 0.455 - np.median(noise[mine]), 0.0)  # 0.455: median of chi2(1)
            shift[mine] = middle[mine] * excess / (excess + noise[mine])
            sigma[mine] = np.sqrt(excess * noise[mine] / (excess + noise[mine]))
    return shift, sigma


def _outer(v):
    return v[:, :, None] * v[:, None, :]


def _to_platform(scan, vectors, pitch):
    """Directions (not points) from the LRF at a pitch to the nominal platform frame."""
    return tilt(vectors @ scan.T_head_lrf.rotation.as_matrix().T, pitch)


def _inflation(along, sigma, side, sides):
    """How much more the points of a side scatter about it than their spacing explains, at least 1, for each point.

    `along` is the derivative of the points by the angle that `sigma` belongs to, nominal platform frame.
    """
    out = np.ones(len(side))
    for s in sides:
        mine = side == s.side
        direction = (s.ends[1] - s.ends[0]) / np.linalg.norm(s.ends[1] - s.ends[0])
        across = along[mine] - (along[mine] @ direction)[:, None] * direction
        expected = np.sqrt(np.mean(sigma[mine] ** 2 * np.sum(across**2, axis=1)))
        out[mine] = max(1.0, s.rms / expected) if expected > 0 else 1.0
    return out


def _group(scan, p_lrf, pitch, order, end, mixed, known=()):
    """Assign points to straight sides in the board's plane; returns side numbers and the sides."""
    side, sides = np.full(len(p_lrf), -1), []
    if len(scan.sweep.pitch) == 1 or np.ptp(scan.sweep.pitch) < 1e-4:
        return (end + 1) // 2, ()  # scans at one pitch show one point a side
    axes = plane_axes(scan.normal)
    flat = lrf_to_platform(p_lrf, pitch, scan.T_head_lrf) @ axes.T
    for rows in _straight_sides(flat, order, end, mixed, max(_spacing(scan), EDGE_SCATTER)):
        new = _describe(scan, flat[rows], axes, int(end[rows[0]]), float(np.mean(pitch[rows])))
        number = next((s.side for s in known if _is_same(s, new)), len(known) + len(sides))
        side[rows] = number
        sides.append(replace(new, side=number))
    return side, tuple(sides)


def _straight_sides(flat, order, end, mixed, tolerance):
    """Indices of the points of each straight side: the straight runs of either end.

    Where a post or an easel stands close behind a board, its edge is bent: such points are left out, unless most of
    the board's outline lies before something close (a wall), which moves all of it alike.
    """
    shortest = SHORTEST_SIDE * np.linalg.norm(np.ptp(flat, axis=0)) if len(flat) else 0.0
    usable, found = ~mixed if 2 * mixed.sum() < len(flat) else np.ones(len(flat), bool), []
    for e in (-1, 1):
        mine = np.flatnonzero((end == e) & usable)
        left_out = np.unique(order[(end == e) & ~usable])  # makes no gap
        place = order[mine] - np.searchsorted(left_out, order[mine])
        found += [mine[run] for run in straight_runs(flat[mine], place, tolerance, shortest)]
    return found


def _describe(scan, flat, axes, end, pitch):
    """A ScanSide (number still open) from its points in the plane."""
    centre, direction, along, across = line_of(flat)
    ends = (centre + np.outer([along.min(), along.max()], direction)) @ axes + scan.distance * scan.normal
    scan_plane = _to_platform(scan, np.array([0.0, 0.0, 1.0]), pitch)
    level = np.cross(scan_plane, scan.normal)
    cosine = abs(level @ (direction @ axes)) / np.linalg.norm(level)
    rms = float(np.sqrt(np.mean(across**2) * len(flat) / max(len(flat) - 2, 1)))
    return ScanSide(-1, end, len(flat), float(np.ptp(along)), rms, float(np.arccos(min(cosine, 1.0))), ends)


def _is_same(a, b):
    """Whether two sides are one: the same direction, and no farther apart than two centimetres."""
    along = (a.ends[1] - a.ends[0]) / a.length
    other = (b.ends[1] - b.ends[0]) / b.length
    apart = np.cross(b.ends.mean(axis=0) - a.ends.mean(axis=0), along)
    return abs(along @ other) > np.cos(LEAST_TURN) and np.linalg.norm(apart) < SAME_SIDE


def _spacing(scan):
    """Typical distance of neighbouring beams on the board, metres."""
    row = np.flatnonzero(np.isfinite(scan.lines[:, 0]))
    first, last = row_ends(scan.mask[row])[1:]
    ends = [_crossings(scan, row, scan.sweep.bearings[beam])[1] for beam in (first, last)]
    return float(np.median(np.linalg.norm(np.concatenate(ends), axis=1)) * np.median(np.diff(scan.sweep.bearings)))


def sweep_edges(scan, variant="half_step", *, min_angle=LEAST_ANGLE):
    """Where columns of the range image (one beam over the pitch) cross the board's edges.

    Edges nearly parallel to the scan lines, which :func:`edge_points` cannot see, are found here.

    Parameters
    ----------
    scan : BoardScan
    variant : {'half_step', 'last_beam'}
        As in :func:`edge_points`, with scan lines for beams.
    min_angle : float
        Sides that meet the columns at a smaller angle are left out, radians.

    Returns
    -------
    ScanEdges
        Nothing ends at the first or last scan lines of the sweep, which may have been cut. The points lie on the
        board at the pitch given with them; `end` is -1 at low and +1 at high pitch; a side that :func:`edge_points`
        sees too has the same number.
        The covariance is that of the pitch step (as a displacement on the board) and of the line fit.

    Raises
    ------
    ValueError
        For another variant.
    """
    _check_variant(variant)
    line, beam, after, end = _column_ends(scan)
    pitch = scan.sweep.pitch
    middle, step = (pitch[line] + pitch[after]) / 2, np.abs(np.diff(pitch))
    points, by_pitch = _at_pitch(scan, line, beam, middle)
    here, behind = scan.fitted[line, beam], beyond(scan, line, beam, after - line, 0 * end)
    known = edge_points(scan, min_angle=0.0).sides
    side, sides = _group(scan, points, middle, beam, end, behind - here < MIXING, known)
    sigma = np.maximum(np.abs(pitch[after] - pitch[line]), np.median(step) if len(step) else 0.0)
    half = by_pitch * (np.copysign(sigma, pitch[after] - pitch[line]) / 2)[:, None]
    sigma = UNIFORM * sigma
    sigma = sigma * _inflation(_to_platform(scan, by_pitch, middle), sigma, side, sides)
    chosen = middle if variant == "half_step" else pitch[line]
    points, by_pitch = _at_pitch(scan, line, beam, chosen)
    range_sigma = _crossings(scan, line, scan.sweep.bearings[beam])[2]
    noise = _outer(_rays(points) * range_sigma[:, None])
    covariance = _outer(by_pitch * sigma[:, None]) + noise
    side, sides = _keep(side, sides, [s for s in sides if s.angle <= np.pi / 2 - min_angle])
    more = half, noise, background_odds(here, behind)
    return ScanEdges(scan.placement, variant, points, covariance, chosen, line, end, side, sides, *more)


def _column_ends(scan):
    """Ends of columns: last line on the board, beam, the next line off it, and -1 / +1 for low and high pitch."""
    beams, first, last = row_ends(scan.mask.T)
    line, after, beam = np.r_[first, last], np.r_[first - 1, last + 1], np.r_[beams, beams]
    keep = (line >= BORDER) & (line < len(scan.mask) - BORDER) & np.isfinite(scan.lines[line, 0])
    line, after, beam = line[keep], after[keep], beam[keep]
    here, step = scan.fitted[line, beam], scan.sweep.pitch[after] - scan.sweep.pitch[line]
    visible = ~(scan.sweep.ranges[after, beam] < here - depth_jump(here, step))
    line, after, beam = line[visible], after[visible], beam[visible]
    upwards = np.polyfit(np.arange(len(scan.sweep.pitch)), scan.sweep.pitch, 1)[0] > 0 if len(scan.mask) > 1 else True
    return line, beam, after, np.where((after > line) == upwards, 1, -1)


def _at_pitch(scan, line, beam, pitch):
    """The board along a beam at a pitch near that of a scan line, and how the point moves on the board with it.

    The range comes from the scan line's fit, plus the change that the board's plane predicts up to `pitch`.
    """
    rays = polar_to_points(np.ones(len(beam)), scan.sweep.bearings[beam])
    change = _plane_range(scan, rays, pitch) - _plane_range(scan, rays, scan.sweep.pitch[line])
    points = (scan.fitted[line, beam] + change)[:, None] * rays
    rotation = scan.T_head_lrf.rotation.as_matrix()
    turned = np.cross([1.0, 0.0, 0.0], scan.T_head_lrf.apply(points)) @ rotation  # d p / d pitch, in the LRF frame
    normal = tilt(scan.normal, -pitch) @ rotation
    slide = np.sum(normal * turned, axis=1) / np.sum(normal * rays, axis=1)
    return points, turned - slide[:, None] * rays


def _plane_range(scan, rays, pitch):
    """Range along rays (LRF frame) to the board's plane."""
    origin = lrf_to_platform(np.zeros((len(rays), 3)), pitch, scan.T_head_lrf)
    return (scan.distance - origin @ scan.normal) / (_to_platform(scan, rays, pitch) @ scan.normal)


REACH = 2
CORNER = 1.0  # spot radii: a spot nearer than this to a second edge may reach over it
SURE = 5.0  # standard deviations of a range: what is nearer to the board's plane read the board


@dataclass(frozen=True)
class EdgeCells:
    """Beams about the edges of the board in one placement.

    Attributes
    ----------
    placement : int
    line, beam : ndarray of int, shape (n,)
        Scan line and beam; every pair appears once.
    bearing, pitch : ndarray, shape (n,)
        Radians.
    hit : ndarray of bool, shape (n,)
        Whether the beam read the board.
    side : ndarray of int, shape (n,)
        Number of the side, as in ScanEdges.
    range_m : ndarray, shape (n,)
        Distance of the board's plane along the beam, metres.
    radius : ndarray, shape (n,)
        Of the spot there, across the beam, metres.
    background : ndarray, shape (n,)
        What the background adds to the log odds at which the reading flips, as far as distances and incidence tell it.
    across : ndarray of bool, shape (n,)
        Whether the boundary was found across the scan lines (the neighbour is a scan line, not a beam).
    step : ndarray, shape (n,)
        Angle between neighbours in that direction, radians.
    """

    placement: int
    line: np.ndarray
    beam: np.ndarray
    bearing: np.ndarray
    pitch: np.ndarray
    hit: np.ndarray
    side: np.ndarray
    range_m: np.ndarray
    radius: np.ndarray
    background: np.ndarray
    across: np.ndarray
    step: np.ndarray

    def __len__(self):
        return len(self.line)

    def select(self, keep):
        """Some of the cells: a mask or indices."""
        names = [f.name for f in fields(self) if f.name != "placement"]
        return replace(self, **{name: getattr(self, name)[keep] for name in names})


@dataclass(frozen=True)
class _Boundaries:
    """Where readings flip: the last cell on the board, the step to the next one off it, and the side; shape (m,)."""

    line: np.ndarray
    beam: np.ndarray
    down: np.ndarray
    right: np.ndarray
    side: np.ndarray


def edge_cells(scan, along, swept=None, lrf=None, reach=REACH):
    """The beams about every boundary of the board, along and across the scan lines.

    Parameters
    ----------
    scan : BoardScan
    along : ScanEdges
        Of :func:`lrfcal_lib.preprocess.edges_in_scan.edge_points`.
    swept : ScanEdges, optional
        Of :func:`lrfcal_lib.preprocess.edges_in_scan.sweep_edges`; None for a single shot.
    lrf : LrfInfo, optional
        States the spot; a radius of 5 mm everywhere where it does not.
    reach : int
        Beams (or scan lines) on either side of a boundary.

    Returns
    -------
    EdgeCells
        Of all straight sides, no cell twice. Without cells in holes, at the border of the view, where something nearer
        hides the board, with two edges in one spot, and beside a background less than a pulse length (1 m) behind,
        whose echo melts into the board's. Where most of the outline has such a background they stay, with `background`
        0; so do all cells where most boundaries have no return behind them (clouds cut to the board).

    Raises
    ------
    ValueError
        For a reach below 1.
    """
    if reach < 1:
        raise ValueError(f"reach is a number of beams on either side of an edge, at least 1, got {reach}")
    plane = _on_plane(scan)
    radius = np.full(plane[0].shape, ASSUMED_SPOT_RADIUS) if lrf is None else lrf.spot_radius(plane[0])
    found = _join([_boundaries(scan, along, False)] + ([] if swept is None else [_boundaries(scan, swept, True)]))
    odds, usable, close = _background(scan, plane, found)
    row, k, line, beam = _neighbours(found, usable, scan.mask.shape, reach)
    hit = _hits(scan, plane[0], close)[line, beam]
    keep = _is_read(scan, plane[0], line, beam, hit, k) & (close | ~_blended(scan, plane[0], radius)[line, beam])
    sides = along.sides + (() if swept is None else swept.sides)
    keep &= _on_one_side(scan, plane, radius, sides, found.side[row], line, beam)
    whole = {"bearing": scan.sweep.bearings[beam], "pitch": scan.sweep.pitch[line], "hit": hit}
    whole |= {"side": found.side[row], "range_m": plane[0][line, beam], "radius": radius[line, beam]}
    across = found.down[row] != 0
    whole |= {"background": odds[row], "across": across, "step": np.where(across, *_steps(scan))}
    return EdgeCells(scan.placement, line, beam, **whole).select(keep)


def _on_plane(scan):
    """Range of the board's plane and cosine of incidence of every beam, shape (L, B); NaN where a beam misses it."""
    rays = tilt(
        polar_to_points(np.ones_like(scan.sweep.bearings), scan.sweep.bearings)
        @ scan.T_head_lrf.rotation.as_matrix().T,
        scan.sweep.pitch[:, None],
    )
    origin = tilt(scan.T_head_lrf.translation, scan.sweep.pitch)
    cosine = rays @ scan.normal
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = (scan.distance - origin @ scan.normal)[:, None] / cosine
    return np.where(ranges > 0, ranges, np.nan), np.abs(cosine)


def _boundaries(scan, edges, swept):
    """The boundaries that edge points of straight sides were made from."""
    mine = edges.side >= 0
    bearing = np.arctan2(edges.points[mine, 1], edges.points[mine, 0])
    line, end = edges.line[mine], edges.end[mine]
    if not swept:
        first, last = scan.mask[line].argmax(axis=1), scan.mask.shape[1] - 1 - scan.mask[line, ::-1].argmax(axis=1)
        beam = np.where(end > 0, last, first)
        return _Boundaries(line, beam, 0 * end, end, edges.side[mine])
    beam = np.abs(scan.sweep.bearings - bearing[:, None]).argmin(axis=1)
    first = line == scan.mask.argmax(axis=0)[beam]
    return _Boundaries(line, beam, np.where(first, -1, 1), 0 * end, edges.side[mine])


def _steps(scan):
    """Angles between scan lines and between beams, radians."""
    return [np.median(np.abs(np.diff(v))) if len(v) > 1 else np.inf for v in (scan.sweep.pitch, scan.sweep.bearings)]


def _join(parts):
    return _Boundaries(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(_Boundaries)))


def _background(scan, plane, found):
    """Covariate of each boundary, which boundaries can be used, and whether most have a background within 1 m."""
    board = plane[0][found.line, found.beam]
    behind = beyond(scan, found.line, found.beam, found.down, found.right)
    seen, mixed = np.isfinite(behind), behind - board < MIXING
    close = len(seen) == 0 or np.mean(seen) < 0.5 or np.mean(mixed) >= 0.5
    if close:
        return np.zeros(len(board)), np.ones(len(board), bool), True
    return background_odds(board, behind), seen & ~mixed, False


def _neighbours(found, usable, shape, reach):
    """Cells about boundaries, the nearest boundary first: its number, the step k from it, line and beam."""
    k, row = np.meshgrid(np.arange(1 - reach, reach + 1), np.flatnonzero(usable), indexing="ij")
    k, row = k.ravel(), row.ravel()
    order = np.argsort(np.abs(k - 0.5), kind="stable")
    k, row = k[order], row[order]
    line, beam = found.line[row] + k * found.down[row], found.beam[row] + k * found.right[row]
    down, right = found.down[row] != 0, found.right[row] != 0
    inside = np.where(down, (line >= BORDER) & (line < shape[0] - BORDER), (line >= 0) & (line < shape[0]))
    inside &= np.where(right, (beam >= BORDER) & (beam < shape[1] - BORDER), (beam >= 0) & (beam < shape[1]))
    k, row, line, beam = (v[inside] for v in (k, row, line, beam))
    _, first = np.unique(line * shape[1] + beam, return_index=True)
    return tuple(v[first] for v in (row, k, line, beam))


def _hits(scan, board, close):
    """Which beams read the board; before a far background also those that noise takes off its plane."""
    if close:
        return scan.mask
    with np.errstate(invalid="ignore"):
        return scan.mask | (np.abs(scan.sweep.ranges - board) < max(SURE * scan.sigma_range, DEPTH_NOISE))


def _is_read(scan, board, line, beam, hit, k):
    """Without what hides the board, and without holes: nothing, or something near, read inside the boundary."""
    excess = scan.sweep.ranges[line, beam] - board[line, beam]
    with np.errstate(invalid="ignore"):
        hidden, far = excess < -max(SURE * scan.sigma_range, DEPTH_NOISE), excess > MIXING
    return hit | (~hidden & (far | (k > 0)))


def _blended(scan, board, radius):
    """Cells whose spot may reach a surface less than a pulse length behind the board, or before it."""
    with np.errstate(invalid="ignore"):
        miss = scan.sweep.ranges - board
        near = (np.abs(miss) > max(SURE * scan.sigma_range, DEPTH_NOISE)) & (miss < MIXING)
    near = ndimage.binary_opening(near, np.ones((2, 2)))  # a surface, not the odd reading
    size = np.nanmedian((radius / board)[scan.mask])
    reach = [int(np.ceil(size / max(step, 1e-6))) for step in _steps(scan)]
    return ndimage.binary_dilation(near, np.ones([2 * min(r, 30) + 1 for r in reach]))


def _on_one_side(scan, plane, radius, sides, side, line, beam):
    """Cells on the stretch of their own side whose spot reaches no other one; all of them where sides are not known."""
    if not sides:
        return np.ones(len(line), bool)
    axes = plane_axes(scan.normal)
    p_lrf = polar_to_points(plane[0][line, beam], scan.sweep.bearings[beam])
    flat = lrf_to_platform(p_lrf, scan.sweep.pitch[line], scan.T_head_lrf) @ axes.T
    reach = CORNER * radius[line, beam] / plane[1][line, beam]
    keep = np.zeros(len(line), bool)
    for s in sides:
        first, last = s.ends @ axes.T
        direction = (last - first) / np.linalg.norm(last - first)
        along = (flat - first) @ direction
        apart = np.abs((flat - first) @ [-direction[1], direction[0]])
        mine = side == s.side
        keep |= mine & (along > 0) & (along < s.length)
        side = np.where(~mine & (apart < reach), -1, side)
    return keep & (side >= 0)
