"""Where the board's edges cross the scan: edge points with covariance, straight sides, beams
about them, background.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points, tilt
from lrfcal_lib.preprocess.board_in_scan import (
    DEPTH_NOISE,
    depth_jump,
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
REACH = 2  # beams (or scan lines) on either side of a boundary
CORNER = 1.0  # spot radii: a spot nearer than this to a second edge may reach over it
SURE = 5.0  # standard deviations of a range: what is nearer to the board's plane read the board


def beyond(scan, line, beam, step, beams=3):
    """Range behind ends of the board (a cell and the step to the next one): median reading, inf
    where there is none.
    """
    cells = (
        np.stack([line, beam], axis=1)[:, None] + step[:, None] * np.arange(1, beams + 1)[:, None]
    )
    rows, columns = np.moveaxis(np.clip(cells, 0, np.array(scan.mask.shape) - 1), -1, 0)
    return np.sort(np.nan_to_num(scan.sweep.ranges[rows, columns], nan=np.inf), axis=1)[
        :, beams // 2
    ]


def background_odds(here, behind):
    """What the background adds to the log odds of the board's share of a spot at which readings
    flip.

    ``2 ln(here / behind)``, the inverse square law; 0 with nothing behind, or so close that both
    give one echo.
    """
    behind = np.asarray(behind, float)
    apart = np.isfinite(behind) & (behind - here >= MIXING)
    return 2 * np.log(np.where(apart, here / np.where(apart, behind, 1.0), 1.0))


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
        part = np.cumsum(np.r_[0, np.diff(order[found]) > max(5, 0.1 * len(found))])
        found = np.sort(found[part == np.bincount(part).argmax()])
        if len(found) < FEWEST_POINTS:
            break
        left = np.setdiff1d(left, found)
        _, direction, along, _ = line_of(points[found])
        if np.ptp(along) >= shortest and all(
            abs(direction @ d) < np.cos(LEAST_TURN) for d in directions
        ):
            runs.append(found)
            directions.append(direction)
    return runs


def line_of(points, among=slice(None)):
    """Total least squares line of some points (n, 2): centre, direction, places of all along
    and across it, metres.
    """
    centre = points[among].mean(axis=0)
    offset = points - centre
    direction = np.linalg.eigh(offset[among].T @ offset[among])[1][:, 1]
    return (
        centre,
        direction,
        offset @ direction,
        offset[:, 1] * direction[0] - offset[:, 0] * direction[1],
    )


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
    a, along = a[far], (b - a)[far] / length[far, None]
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
        """Whether two sides are one: the same direction, and no farther apart than two
        centimetres.
        """
        along, its = ((s.ends[1] - s.ends[0]) / s.length for s in (self, other))
        apart = np.cross(other.ends.mean(axis=0) - self.ends.mean(axis=0), along)
        return abs(along @ its) > np.cos(LEAST_TURN) and np.linalg.norm(apart) < SAME_SIDE


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
    line, beam, step, end = _ends(scan, across)
    angles, cell = (scan.sweep.pitch, line) if across else (scan.sweep.bearings, beam)
    inner = angles[cell]
    outer = angles[cell + step.sum(axis=1)]
    gap = outer - inner
    middle = (inner + outer) / 2
    pitch = scan.sweep.pitch[line]
    if across and len(angles) > 1:  # the pitch is read in steps, it may seem to stand still
        gap = np.copysign(np.maximum(np.abs(gap), np.median(np.abs(np.diff(angles)))), gap)
    shift, warp_sigma = (0.0, 0.0) if across else _warp(scan, line, beam, end)
    points, by_angle, _ = _points_at(scan, line, beam, middle, shift, across)
    here = scan.fitted[line, beam]
    behind = beyond(scan, line, beam, step)
    order, when = (beam, middle) if across else (line, pitch)
    side, every = _group(scan, points, when, order, end, behind - here < MIXING, known)
    sigma = np.abs(gap) * UNIFORM
    sigma = sigma * _inflation(_to_platform(scan, by_angle, when), sigma, side, every)
    # scans at one pitch have no sides, and keep all points
    sides = tuple(s for s in every if (np.pi / 2 - s.angle if across else s.angle) >= LEAST_ANGLE)
    side = np.where(np.isin(side, [s.side for s in sides]), side, -1) if every else side
    about = line, beam, step, end, side, sides, by_angle * (gap / 2)[:, None]
    odds = background_odds(here, behind)
    found = {}
    for variant, angle, there in (("last_beam", inner, pitch), ("half_step", middle, when)):
        points, by_angle, range_sigma = _points_at(scan, line, beam, angle, shift, across)
        noise = (
            points
            / np.linalg.norm(points, axis=1, keepdims=True)
            * np.hypot(range_sigma, warp_sigma)[:, None]
        )
        noise, spacing = (np.einsum("ni,nj->nij", v, v) for v in (noise, by_angle * sigma[:, None]))
        found[variant] = ScanEdges(variant, points, spacing + noise, there, *about, noise, odds)
    return found, every


def _ends(scan, across):
    """Ends of scan lines (of columns) on the board that may be edges: line, beam, step off the
    board, -1 / +1.
    """
    mask = scan.mask.T if across else scan.mask
    pitch = scan.sweep.pitch
    rows, first, last = row_ends(mask)
    row = np.r_[rows, rows]
    cell = np.r_[first, last]
    way = np.repeat([-1, 1], len(rows))
    line, beam = (cell, row) if across else (row, cell)
    keep = (cell >= BORDER) & (cell < mask.shape[1] - BORDER) & np.isfinite(scan.lines[line, 0])
    line = line[keep]
    beam = beam[keep]
    way = way[keep]
    step = np.stack([way, 0 * way] if across else [0 * way, way], axis=1)
    after = line + step[:, 0]
    here = scan.fitted[line, beam]
    turned = pitch[after] - pitch[line] if across else np.median(np.diff(scan.sweep.bearings))
    seen = ~(scan.sweep.ranges[after, beam + step[:, 1]] < here - depth_jump(here, turned))
    downwards = across and len(pitch) > 1 and np.polyfit(np.arange(len(pitch)), pitch, 1)[0] <= 0
    return line[seen], beam[seen], step[seen], -way[seen] if downwards else way[seen]


def _points_at(scan, line, beam, angle, shift, across):
    """Points of the board where lines (at bearings) or columns (at pitch angles) end, metres, LRF
    frame.

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
    range_sigma = r**2 * np.sqrt(np.einsum("ni,nij,nj->n", ray, scan.lines_covariance[line], ray))
    if not across:
        slope = -(r**2) * np.sum(u * turned[:, :2], axis=1)
        return (r + shift)[:, None] * rays, slope[:, None] * rays + r[:, None] * turned, range_sigma
    there, here = (_plane_range(scan, rays, pitch)[0] for pitch in (angle, scan.sweep.pitch[line]))
    points = (scan.fitted[line, beam] + (there - here))[:, None] * rays
    rotation = scan.T_head_lrf.rotation.as_matrix()
    # d p / d pitch, in the LRF frame
    turned = np.cross([1.0, 0.0, 0.0], scan.T_head_lrf.apply(points)) @ rotation
    normal = tilt(scan.normal, -angle) @ rotation
    slide = np.sum(normal * turned, axis=1) / np.sum(normal * rays, axis=1)
    return points, turned - slide[:, None] * rays, range_sigma


def _plane_range(scan, rays, pitch):
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
    """How far the board lies from the fitted lines at their ends, and the standard deviation of
    that, metres.

    A board bends, and cardboard reads farther than paper. The outermost eighth of a line (15 beams
    at most) says how far each end is off; how much these medians vary beyond their noise over all
    lines says how far to believe them. On a flat board that is nothing, and the ends stay on the
    fitted lines.
    """
    count = np.clip(scan.mask[line].sum(axis=1) // 8, 1, WARPED_BEAMS)
    at = beam[:, None] - end[:, None] * np.arange(WARPED_BEAMS)
    use = (np.arange(WARPED_BEAMS) < count[:, None]) & (at >= 0) & (at < scan.mask.shape[1])
    at = line[:, None], np.where(use, at, 0)
    use &= scan.mask[at]
    middle = row_median(np.where(use, (scan.sweep.ranges - scan.fitted)[at], np.nan))
    noise = np.pi / 2 * scan.sigma_range**2 / np.maximum(use.sum(axis=1), 1)
    shift = np.zeros(len(line))
    sigma = np.zeros(len(line))
    for mine in (end == -1, end == 1):
        if mine.any():
            # 0.455: median of chi2(1)
            excess = max(np.median(middle[mine] ** 2) / 0.455 - np.median(noise[mine]), 0.0)
            shift[mine] = middle[mine] * excess / (excess + noise[mine])
            sigma[mine] = np.sqrt(excess * noise[mine] / (excess + noise[mine]))
    return shift, sigma


def _inflation(by_angle, sigma, side, sides):
    """How much more the points of a side scatter than their spacing (along `by_angle`)
    explains, at least 1, (n,).
    """
    out = np.ones(len(side))
    for s in sides:
        mine = side == s.side
        direction = (s.ends[1] - s.ends[0]) / np.linalg.norm(s.ends[1] - s.ends[0])
        across = by_angle[mine] - (by_angle[mine] @ direction)[:, None] * direction
        expected = np.sqrt(np.mean(sigma[mine] ** 2 * np.sum(across**2, axis=1)))
        out[mine] = max(1.0, s.rms / expected) if expected > 0 else 1.0
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
    row, first, last = row_ends(scan.mask & np.isfinite(scan.lines[:, :1]))
    steps = [
        _points_at(scan, row, beam, scan.sweep.bearings[beam], 0.0, False)[1]
        for beam in (first, last)
    ]
    spacing = np.median(np.linalg.norm(np.concatenate(steps), axis=1)) * np.median(
        np.diff(scan.sweep.bearings)
    )
    shortest = SHORTEST_SIDE * np.linalg.norm(np.ptp(flat, axis=0)) if len(flat) else 0.0
    usable = ~mixed | (2 * mixed.sum() >= len(flat))
    side = np.full(len(flat), -1)
    sides = []
    for e in (-1, 1):
        mine = np.flatnonzero((end == e) & usable)
        left_out = np.unique(order[(end == e) & ~usable])  # makes no gap
        place = order[mine] - np.searchsorted(left_out, order[mine])
        for run in straight_runs(flat[mine], place, max(float(spacing), EDGE_SCATTER), shortest):
            rows = mine[run]
            centre, direction, along, across = line_of(flat[rows])
            ends = (
                centre + np.outer([along.min(), along.max()], direction)
            ) @ axes + scan.distance * scan.normal
            level = np.cross(
                _to_platform(scan, np.array([0.0, 0.0, 1.0]), np.mean(pitch[rows])), scan.normal
            )
            cosine = min(abs(level @ (direction @ axes)) / np.linalg.norm(level), 1.0)
            rms = float(np.sqrt(np.mean(across**2) * len(rows) / max(len(rows) - 2, 1)))
            new = ScanSide(
                -1, e, len(rows), float(np.ptp(along)), rms, float(np.arccos(cosine)), ends
            )
            side[rows] = next((s.side for s in known if s.is_same(new)), len(known) + len(sides))
            sides.append(replace(new, side=int(side[rows[0]])))
    return side, tuple(sides)


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
    sweep = scan.sweep
    line, beam, step, side = (
        np.concatenate([getattr(edges, name)[edges.side >= 0] for edges in found])
        for name in ("line", "beam", "step", "side")
    )
    board, cosine = _plane_range(scan, polar_to_points(1.0, sweep.bearings), sweep.pitch[:, None])
    board[~(board > 0)] = np.nan
    radius = lrf.spot_radius(board)
    here = board[line, beam]
    behind = beyond(scan, line, beam, step)
    seen = np.isfinite(behind)
    mixed = behind - here < MIXING
    close = len(seen) == 0 or np.mean(seen) < 0.5 or np.mean(mixed) >= 0.5
    odds = np.zeros(len(here)) if close else background_odds(here, behind)
    usable = np.flatnonzero(seen & ~mixed) if not close else np.arange(len(here))
    row, k, line, beam = _neighbours(usable, line, beam, step, scan.mask.shape)
    # before a far background also beams that noise takes off the plane read the board
    near = max(SURE * scan.sigma_range, DEPTH_NOISE)
    gaps = [
        np.median(np.abs(np.diff(v))) if len(v) > 1 else np.inf
        for v in (sweep.pitch, sweep.bearings)
    ]
    with np.errstate(invalid="ignore"):
        miss = sweep.ranges - board
        excess = miss[line, beam]
        hit = scan.mask[line, beam] | ((np.abs(excess) < near) & (not close))
        # without what hides the board, and without holes: nothing, or something near, read inside
        # the boundary
        keep = hit | (~(excess < -near) & ((excess > MIXING) | (k > 0)))
        if not close:
            # without cells whose spot may reach a surface (not the odd reading) less than a pulse
            # length away
            beside = ndimage.binary_opening(
                (np.abs(miss) > near) & (miss < MIXING), np.ones((2, 2))
            )
            size = np.nanmedian((radius / board)[scan.mask])
            spot = [2 * min(int(np.ceil(size / max(gap, 1e-6))), 30) + 1 for gap in gaps]
            keep &= ~ndimage.binary_dilation(beside, np.ones(spot))[line, beam]
    sides = [s for edges in found for s in edges.sides]
    keep &= _on_one_side(
        scan, (line, beam), board, (CORNER * radius / np.abs(cosine))[line, beam], sides, side[row]
    )
    across = step[row, 0] != 0
    cells = {
        "line": line,
        "beam": beam,
        "bearing": sweep.bearings[beam],
        "pitch": sweep.pitch[line],
        "hit": hit,
        "side": side[row],
        "range_m": board[line, beam],
        "radius": radius[line, beam],
        "background": odds[row],
        "across": across,
        "step": np.where(across, *gaps),
    }
    return np.rec.fromarrays([*cells.values()], names=[*cells])[keep]


def _neighbours(usable, line, beam, step, shape):
    """Cells about boundaries, each once, with the nearest boundary: its number, the step k from
    it, line and beam.
    """
    k, row = np.meshgrid(np.arange(1 - REACH, REACH + 1), usable, indexing="ij")
    k = k.ravel()
    row = row.ravel()
    order = np.argsort(np.abs(k - 0.5), kind="stable")
    k = k[order]
    row = row[order]
    cell = np.stack([line, beam], axis=1)[row] + k[:, None] * step[row]
    margin = np.where(step[row] != 0, BORDER, 0)
    inside = np.all((cell >= margin) & (cell < shape - margin), axis=1)
    k = k[inside]
    row = row[inside]
    (line, beam) = cell[inside].T
    _, first = np.unique(line * shape[1] + beam, return_index=True)
    return row[first], k[first], line[first], beam[first]


def _on_one_side(scan, cells, board, reach, sides, side):
    """Cells on the stretch of their own side whose spot reaches no other one.

    All of them where sides are not known.
    """
    axes = plane_axes(scan.normal)
    (line, beam) = cells
    p_lrf = polar_to_points(board[cells], scan.sweep.bearings[beam])
    flat = lrf_to_platform(p_lrf, scan.sweep.pitch[line], scan.T_head_lrf) @ axes.T
    keep = ~np.isin(side, [s.side for s in sides])
    alone = np.ones(len(side), bool)
    for s in sides:
        first, last = s.ends @ axes.T
        direction = (last - first) / np.linalg.norm(last - first)
        along = (flat - first) @ direction
        apart = np.abs((flat - first) @ [-direction[1], direction[0]])
        mine = side == s.side
        keep |= mine & (along > 0) & (along < s.length)
        alone &= mine | ~(apart < reach)
    return keep & alone
