"""The beams about every boundary of the board in a scan: who read it, and what stands behind."""

import numpy as np
from scipy import ndimage

from lrfcal_lib.model.geometry import (
    cross,
    length_of,
    lrf_to_platform,
    polar_to_points,
)
from lrfcal_lib.preprocess.board_in_scan import BoardScan, median_step
from lrfcal_lib.preprocess.edges_in_scan import (
    MIXING,
    background_of,
    plane_range,
    within,
)
from lrfcal_lib.preprocess.surfaces import DEPTH_NOISE
from lrfcal_lib.session.stated import LrfInfo

# from the last cell on the board: two on either side of the boundary, the nearest first
STEPS = (0, 1, -1, 2)
CORNER = 1.0  # spot radii: a spot nearer than this to a second edge may reach over it
SURE = 5.0  # standard deviations of a range: what is nearer to the board's plane read the board


def edge_cells(scan: BoardScan, lrf: LrfInfo) -> np.recarray:
    """The beams about every boundary of the board, along and across the scan lines.

    Parameters
    ----------
    scan : BoardScan
        With its edges.
    lrf : LrfInfo
        Knows the spot.

    Returns
    -------
    recarray
        ``line`` and ``beam`` (every pair appears once); ``bearing`` and ``pitch``, radians;
        ``hit``, whether the beam read the board; ``side``, its number; ``range_m``, distance of the
        board's plane along the beam, and ``radius`` of the spot there, metres; ``background``, what
        it adds to the log odds at which the reading flips, as far as distances and incidence tell
        it; ``across``, whether the boundary was found across the scan lines (the neighbour is a
        scan line, not a beam); ``step``, angle between neighbours in that direction, radians. Of
        all straight sides, without cells in holes, at the border of the view, where something
        nearer hides the board, with two edges in one spot, and beside a background less than a
        pulse length (1 m) behind, whose echo melts into the board's. Where most of the outline has
        such a background they stay, with `background` 0; so do all cells where most boundaries have
        no return behind them (clouds cut to the board).
    """
    sweep = scan.sweep
    edges = scan.edges["half_step"]
    edges = edges[edges.side >= 0]
    cell = np.column_stack([edges.line, edges.beam])
    rays = polar_to_points(1.0, sweep.bearings)
    board, cosine = plane_range(scan, rays, sweep.pitch[:, None])
    board[~(board > 0)] = np.nan
    radius = lrf.spot_radius(board)
    gap, odds = background_of(scan, board, cell, edges.step)
    few = 2 * np.isfinite(gap).sum() < len(gap)
    close = few or 2 * np.sum(gap < MIXING) >= len(gap)
    usable = np.flatnonzero(close | (odds < 0))

    row, k, line, beam = _neighbours(usable, cell, edges.step, scan.mask.shape)
    cells = line, beam
    gaps = median_step(sweep.pitch), median_step(sweep.bearings)
    hit, keep = _readings(scan, cells, k, board, radius, gaps, close)
    side = edges.side[row]
    reach = (CORNER * radius / np.abs(cosine))[cells]
    keep &= _on_one_side(scan, cells, board, reach, side)
    across = edges.across[row]
    columns = {
        "line": line,
        "beam": beam,
        "bearing": sweep.bearings[beam],
        "pitch": sweep.pitch[line],
        "hit": hit,
        "side": side,
        "range_m": board[cells],
        "radius": radius[cells],
        "background": np.where(close, 0.0, odds[row]),
        "across": across,
        "step": np.where(across, *gaps),
    }
    arrays = list(columns.values())
    return np.rec.fromarrays(arrays, names=list(columns))[keep]  # type: ignore[call-overload]


def _readings(scan, cells, k, board, radius, gaps, close):
    """Which cells, k steps from a boundary, read the board, and which can be told.

    `board` and `radius` (L, B) are the range of the board's plane and of the spot there, `gaps` the
    angles between lines and beams; `close` where most of the outline has a background that melts
    into the board's echo.
    """
    sweep = scan.sweep
    near = max(SURE * scan.sigma_range, DEPTH_NOISE)
    miss = sweep.ranges - board
    excess = miss[cells]
    hit = scan.mask[cells]
    if not close:  # also beams that noise takes off the plane read the board
        hit = hit | (np.abs(excess) < near)
    # without what hides the board, and without holes: nothing, or something near, read inside
    # the boundary
    hides = excess < -near
    keep = hit | (~hides & ((excess > MIXING) | (k > 0)))
    if not close:
        mixing = (np.abs(miss) > near) & (miss < MIXING)
        size = np.nanmedian((radius / board)[scan.mask])
        keep &= ~_within_a_spot(mixing, size, gaps)[cells]
    return hit, keep


def _within_a_spot(mixing, size, gaps):
    """Cells (L, B) whose spot may reach a surface (not the odd reading) that mixes with the board.

    `size` is the radius of the spot as an angle, `gaps` are those between lines and beams, radians.
    """
    surface = ndimage.binary_opening(mixing, np.ones((2, 2)))
    reach = np.ceil(size / np.maximum(gaps, 1e-6))
    spot = 2 * np.minimum(reach, 30).astype(int) + 1
    return ndimage.binary_dilation(surface, np.ones(spot))


def _neighbours(usable, cell, step, shape):
    """Cells about boundaries, each once: number of the nearest, step k from it, line and beam."""
    k = np.repeat(STEPS, len(usable))
    row = np.tile(usable, len(STEPS))
    near = cell[row] + k[:, None] * step[row]
    rows = np.column_stack([row, k, near])[within(near, step[row], shape)]
    _, first = np.unique(rows[:, 2:], axis=0, return_index=True)
    return rows[first].T


def _on_one_side(scan, cells, board, reach, side):
    """Cells on the stretch of their own side whose spot reaches no other one.

    All of them where sides are not known.
    """
    line, beam = cells
    p_lrf = polar_to_points(board[cells], scan.sweep.bearings[beam])
    points = lrf_to_platform(p_lrf, scan.sweep.pitch[line], scan.T_head_lrf)
    keep = ~np.isin(side, [s.number for s in scan.sides])
    alone = np.ones(len(side), bool)
    for s in scan.sides:
        away = points - s.ends[0]
        along = away @ s.direction
        apart = length_of(cross(away, s.direction))
        mine = side == s.number
        keep |= mine & (along > 0) & (along < s.length)
        alone &= mine | ~(apart < reach)
    return keep & alone
