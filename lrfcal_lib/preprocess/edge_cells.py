"""The beams about the board's edges, each with whether it read the board: what an edge's likelihood is made of.

Edge points say where readings flip; the cells say the same without choosing a point: a beam on this side of the edge
read the board, its neighbour on the other side did not.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy import ndimage

from lrfcal_lib.geometry import lrf_to_platform, polar_to_points, tilt
from lrfcal_lib.preprocess.background import MIXING, background_odds, beyond
from lrfcal_lib.preprocess.scan import BORDER
from lrfcal_lib.preprocess.segment import DEPTH_NOISE, plane_axes
from lrfcal_lib.session.stated import ASSUMED_SPOT_RADIUS

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
        Of :func:`lrfcal_lib.preprocess.scan.edge_points`.
    swept : ScanEdges, optional
        Of :func:`lrfcal_lib.preprocess.scan.sweep_edges`; None for a single shot.
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
