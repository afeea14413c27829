"""Figures of scans: sweeps, scan lines, edge points."""

from __future__ import annotations

import numpy as np

from lrfcal_lib.geometry import polar_to_points
from lrfcal_lib.plots.colors import COLORS, SERIES, color_of

PLANES = {"xz": (0, 2), "yz": (1, 2), "xy": (0, 1)}


def range_image(ax, sweep, mask=None):
    """A sweep as the rig sees it: range over bearing (to the left as in the scene) and pitch.

    Parameters
    ----------
    ax : Axes
    sweep : Sweep
        With a pitch that stands still, scan lines are numbered instead.
    mask : ndarray of bool, shape (L, B), optional
        What was found to be the board; outlined.
    """
    moves = np.ptp(sweep.pitch) > 0
    height = np.degrees(sweep.pitch) if moves else np.arange(len(sweep.pitch))
    order = np.argsort(height, kind="stable")
    bearing = np.degrees(sweep.bearings)
    drawn = ax.pcolormesh(bearing, height[order], sweep.ranges[order], shading="nearest", rasterized=True)
    ax.figure.colorbar(drawn, ax=ax, label="range [m]", shrink=0.9)
    if mask is not None and mask.any() and len(mask) == 1:
        ax.plot(bearing[mask[0]], np.repeat(height, mask.sum()), ".", color="white", markersize=2)
    elif mask is not None and mask.any():
        ax.contour(bearing, height[order], mask[order].astype(float), levels=[0.5], colors="white", linewidths=1)
    seen = bearing[np.isfinite(sweep.ranges).any(axis=0)]
    step = np.ptp(bearing) / max(len(bearing) - 1, 1)
    if seen.size:
        ax.set_xlim(seen.max() + step, seen.min() - step)
    ax.grid(False)
    if moves:
        ax.set_aspect("equal")
    ax.set(xlabel="bearing [deg]", ylabel="pitch [deg]" if moves else "scan line")


def scan_line(ax, sweep, line, mask=None):
    """One scan line in the scan plane; x to the right, y ahead.

    Parameters
    ----------
    ax : Axes
    sweep : Sweep
    line : int
        Row of `sweep.ranges`.
    mask : ndarray of bool, shape (L, B), optional
        Beams on the board.
    """
    points = polar_to_points(sweep.ranges[line], sweep.bearings)
    on = np.zeros(len(points), bool) if mask is None else mask[line]
    ax.plot(*points[~on, :2].T, ".", color=COLORS["raw"], label="scene" if on.any() else "returns")
    ax.plot(*points[on, :2].T, ".", color=COLORS["lrf"], label="board")
    ax.plot(0, 0, marker="^", color=COLORS["lrf"], markersize=8, linestyle="none", label="LRF")
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x [m]", ylabel="y [m]")
    ax.legend()


def edge_of_line(ax, scan, line, end=1, beams=14, edges=()):
    """Where a scan line leaves the board: raw, filtered and fitted ranges, after figure 5.

    Parameters
    ----------
    ax : Axes
    scan : BoardScan
    line : int
        Scan line.
    end : int
        +1 for the end at the larger bearings, -1 for the other one.
    beams : int
        Beams shown on either side of the end.
    edges : sequence of ScanEdges
        Their crossings of this line and end are drawn as upright lines.
    """
    on = np.flatnonzero(scan.mask[line])
    if on.size == 0:
        raise ValueError(f"no beam of scan line {line} is on the board of placement {scan.placement}")
    last = on[-1] if end > 0 else on[0]
    near = np.arange(max(last - beams, 0), min(last + beams + 1, scan.mask.shape[1]))
    bearing, kept = np.degrees(scan.sweep.bearings[near]), scan.mask[line, near]
    ax.plot(bearing, scan.sweep.ranges[line, near], "o", color=COLORS["raw"], markersize=5, label="raw")
    bearing, near = bearing[kept], near[kept]
    ax.plot(bearing, scan.filtered[line, near], "o", color=COLORS["filtered"], markersize=3, label="filtered")
    ax.plot(bearing, scan.fitted[line, near], "-", color=COLORS["fit"], label="line fitted to the board")
    for index, found in enumerate(edges):
        for point in found.points[(found.line == line) & (found.end == end)]:
            at = np.degrees(np.arctan2(point[1], point[0]))
            style = ("--", "-", ":")[index % 3]
            ax.axvline(at, color=COLORS["lrf"], linestyle=style, label=found.variant.replace("_", " "))
    ax.invert_xaxis()
    ax.set(xlabel="bearing [deg]", ylabel="range [m]")
    ax.legend()


def crossings(ax, edges):
    """Edge crossings of a sweep over bearing and pitch, one colour a straight side.

    Parameters
    ----------
    ax : Axes
    edges : ScanEdges
        Side -1 is drawn as an outlier.
    """
    bearing = np.degrees(np.arctan2(edges.points[:, 1], edges.points[:, 0]))
    _by_side(ax, np.column_stack([bearing, np.degrees(edges.pitch)]), edges.side, None)
    ax.invert_xaxis()
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="bearing [deg]", ylabel="pitch [deg]")


def sides(ax, points, side, names=None, face=None):
    """Edge points in the plane of the board, one colour a straight side.

    Parameters
    ----------
    ax : Axes
    points : ndarray, shape (n, 2)
        In the plane, metres.
    side : ndarray of int, shape (n,)
        -1 marks outliers.
    names : dict of int to str, optional
        Which edge of the board a side is.
    face : ndarray, shape (m, 2), optional
        Points on the face of the board, drawn beneath.
    """
    if face is not None:
        ax.plot(*face.T, ",", color=COLORS["raw"], zorder=0)
    _by_side(ax, points, side, names)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x [m]", ylabel="y [m]")


def _by_side(ax, points, side, names):
    for index, label in enumerate(value for value in np.unique(side) if value >= 0):
        name = (names or {}).get(int(label), f"side {label}")
        ax.plot(*points[side == label].T, ".", color=SERIES[index % len(SERIES)], label=name)
    lost = side < 0
    if lost.any():
        ax.plot(*points[lost].T, "x", color=COLORS["outlier"], label="not used")
    ax.legend()


def projection(ax, edges, plane, lines=None):
    """Edge points in one coordinate plane of the platform, figure 4 (b) to (d).

    Parameters
    ----------
    ax : Axes
    edges : dict of str to ndarray, shape (n, 3)
        Points by edge, metres.
    plane : str
        'xz', 'yz' or 'xy'.
    lines : dict of str to (point, direction), optional
        Fitted lines in space, drawn over the extent of their points.

    Raises
    ------
    ValueError
        For another plane.
    """
    if plane not in PLANES:
        raise ValueError(f"plane must be one of {', '.join(PLANES)}, got '{plane}'")
    pick = list(PLANES[plane])
    for index, (name, points) in enumerate(edges.items()):
        color = color_of(name, index)
        ax.plot(*np.asarray(points)[:, pick].T, ".", color=color, label=name)
        if lines and name in lines:
            point, direction = (np.asarray(v, float) for v in lines[name])
            along = (points - point) @ direction
            ends = point + np.outer([along.min(), along.max()], direction)
            ax.plot(*ends[:, pick].T, "-", color=color)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel=f"{plane[0]} [m]", ylabel=f"{plane[1]} [m]")
    ax.legend()
