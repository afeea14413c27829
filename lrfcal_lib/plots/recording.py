"""Figures of what was recorded: scans, range images, pictures, edges; a colour for each sensor."""

from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from lrfcal_lib.model.board import Board, Chessboard, side_ends
from lrfcal_lib.model.camera import CameraModel, redistort
from lrfcal_lib.model.geometry import bearings_of, polar_to_points
from lrfcal_lib.plots.colors import COLORS as COLORS
from lrfcal_lib.plots.colors import (
    FILTERED,
    FIT,
    LRF,
    OUTLIER,
    RAW,
    TRUTH,
    closed,
    color_of,
    series,
)
from lrfcal_lib.plots.colors import SERIES as SERIES

PLANES = ("xz", "yz", "xy")
BESIDE = 14  # beams shown on either side of the end of a board
HEADROOM = 0.12  # metres shown behind the end of a board
ABOUT = 3.0  # degrees shown around a board
BEYOND = "#d9d9d9"  # ranges outside the limits of several sweeps
BRIGHT = 150  # grey level: a picture whose brightest hundredth is darker is brightened
GAIN = 5.0  # by this factor at most
EXAGGERATED = 20  # times, the spread of an edge
STRETCH = 61  # points of an edge as the lens bends it
CENTRED: dict[str, Any] = {"ha": "center", "va": "center"}  # text about its place
PRINT = ListedColormap(["#333333", "white"])  # of a board
DARK = {"facecolor": "#333333", "edgecolor": "none"}  # behind white text in a picture


def range_image(
    ax: Axes,
    sweep,
    mask: np.ndarray | None = None,
    limits: tuple[float, float] | None = None,
) -> QuadMesh:
    """A sweep as the rig sees it: range over bearing (to the left as in the scene) and pitch.

    With a pitch that stands still, scan lines are numbered instead.

    Parameters
    ----------
    ax
    sweep : Sweep
    mask
        Beams (L, B) on the board: it is outlined, and bearings far from it are cut off.
    limits
        Two ranges, metres, by which several sweeps share their colours; the colour bar is then
        left to the caller.
    """
    bearing = np.degrees(sweep.bearings)
    order = np.argsort(sweep.pitch, kind="stable")
    ranges = sweep.ranges[order]
    height = np.degrees(sweep.pitch[order])
    ax.set(xlabel="bearing [deg]", ylabel="pitch [deg]", aspect="equal")
    if np.ptp(height) == 0:
        height = np.arange(len(height))
        ax.set(ylabel="scan line", aspect="auto")
    drawn = ax.pcolormesh(bearing, height, ranges, shading="nearest", rasterized=True)
    if limits is None:
        ax.figure.colorbar(drawn, ax=ax, label="range [m]", shrink=0.9)
    else:
        drawn.set(clim=limits, cmap=drawn.cmap.with_extremes(over=BEYOND, under=BEYOND))
    shown = np.isfinite(ranges)
    about = bearing[1] - bearing[0]
    if mask is not None and mask.any():
        shown = mask[order]
        about = ABOUT
        if len(height) > 1:
            ax.contour(bearing, height, shown, [0.5], colors=OUTLIER, linewidths=1.5)
            rim = height[shown.any(axis=1)][[0, -1]] + [-about, about]
            ax.set_ylim(np.clip(rim, height[0], height[-1]))
    seen = bearing[shown.any(axis=0)]
    if len(seen):
        ax.set_xlim(seen[-1] + about, seen[0] - about)
    ax.grid(False)
    return drawn


def scan_line(
    ax: Axes, sweep, line: int, mask: np.ndarray, fitted: np.ndarray | None = None
) -> None:
    """One scan line in the scan plane.

    Parameters
    ----------
    ax
    sweep : Sweep
    line
        Row of its ranges.
    mask
        Beams (L, B) on the board.
    fitted
        Ranges (L, B) of a fitted line, metres; see BoardScan.
    """
    points = polar_to_points(sweep.ranges[line], sweep.bearings)[:, :2]
    on = mask[line]
    ax.plot(*points[~on].T, ".", color=RAW, label="scene" if on.any() else "returns")
    ax.plot(*points[on].T, ".", color=LRF, label="board")
    if fitted is not None:
        on_line = polar_to_points(fitted[line], sweep.bearings)[on, :2]
        ax.plot(*on_line.T, color=FIT, label="fitted line")
    ax.plot(0, 0, "^", color=LRF, markersize=8, label="LRF")
    to_scale(ax, "x [m]", "y [m]")
    ax.legend()


def png(figure: Figure, **looks: Any) -> bytes:
    """Content of a PNG file of a figure, with options of `savefig`."""
    content = BytesIO()
    figure.savefig(content, format="png", **looks)
    return content.getvalue()


def to_scale(ax: Axes, x: str, y: str) -> None:
    """Equal scales, and the labels `x` and `y`."""
    ax.set(xlabel=x, ylabel=y, aspect="equal", adjustable="datalim")


def edge_of_line(
    ax: Axes, scan, line: int, end: int = 1, edges: Mapping | tuple = ()
) -> None:
    """Where a scan line leaves the board: ranges raw, filtered and fitted, figure 5.

    Parameters
    ----------
    ax
    scan : BoardScan
    line
        Row of its ranges.
    end
        +1 for the end at the larger bearings, -1 for the other one.
    edges : dict of str to recarray
        One or two variants of :class:`lrfcal_lib.preprocess.board_in_scan.BoardScan`, whose
        crossings of this line and end are drawn as upright lines.

    Raises
    ------
    ValueError
        If no beam of the line is on the board.
    """
    on = np.flatnonzero(scan.mask[line])
    if not on.size:
        raise ValueError(
            f"no beam of scan line {line} is on the board of placement {scan.placement}"
        )
    last = on[::end][-1]
    near = slice(max(last - BESIDE, 0), last + BESIDE + 1)
    bearing = np.degrees(scan.sweep.bearings[near])
    raw = scan.sweep.ranges[line, near]
    fitted = scan.fitted[line, near]
    top = np.nanmax(fitted) + HEADROOM
    far = raw >= top
    ax.plot(bearing[~far], raw[~far], "o", color=RAW, markersize=6, label="raw")
    if far.any():
        words = f"raw, farther: {raw[far].min():.2f} to {raw[far].max():.2f} m"
        at_top = np.where(far, top, np.nan)
        ax.plot(bearing, at_top, "^", color=RAW, clip_on=False, label=words)
    ax.plot(bearing, scan.filtered[line, near], "x", color=TRUTH, label="filtered")
    ax.plot(bearing, fitted, color=FIT, label="line fitted to the board")
    for (variant, crossed), style in zip(dict(edges).items(), ("--", "-"), strict=False):
        here = (crossed.line == line) & (crossed.step[:, 1] == end)
        for crossing in np.degrees(bearings_of(crossed.points[here])):
            ax.axvline(
                crossing,
                color=LRF,
                linestyle=style,
                label=variant.replace("_", " "),
            )
    ax.invert_xaxis()
    ax.set(
        xlabel="bearing [deg]",
        ylabel="range [m]",
        ylim=(np.nanmin(raw) - HEADROOM / 4, top),
    )
    ax.legend()


def crossings(ax: Axes, edges) -> None:
    """Edge crossings of a sweep, one colour a straight side; those of no side crossed out.

    Parameters
    ----------
    ax
    edges : recarray
        Of :class:`lrfcal_lib.preprocess.board_in_scan.BoardScan`.
    """
    points = np.degrees([bearings_of(edges.points), edges.pitch])
    unused = edges.side < 0
    for index, side in enumerate(np.unique(edges.side[~unused])):
        at = edges.side == side
        ax.plot(*points[:, at], ".", color=series(index), label=f"side {side}")
    if unused.any():
        ax.plot(*points[:, unused], "x", color=OUTLIER, label="not used")
    ax.legend()
    ax.invert_xaxis()
    to_scale(ax, "bearing [deg]", "pitch [deg]")


def projection(ax: Axes, edges: dict, plane: str, lines: dict | None = None) -> None:
    """Edge points in one coordinate plane of the platform, figure 4 (b) to (d).

    Parameters
    ----------
    ax
    edges
        Points (n, 3) by edge, metres.
    plane
        'xz', 'yz' or 'xy'.
    lines
        Fitted lines in space by edge, (point, direction), drawn over the extent of their points.

    Raises
    ------
    ValueError
        For another plane.
    """
    if plane not in PLANES:
        raise ValueError(f"plane must be one of {', '.join(PLANES)}, got '{plane}'")
    pick = ["xyz".index(axis) for axis in plane]
    for index, (name, points) in enumerate(edges.items()):
        color = color_of(name, index)
        ax.plot(*points[:, pick].T, ".", color=color, label=name)
        if name in (lines or {}):
            point, direction = lines[name]
            along = (points - point) @ direction
            ends = point + np.outer([along.min(), along.max()], direction)
            ax.plot(*ends[:, pick].T, "-", color=color)
    to_scale(ax, f"{plane[0]} [m]", f"{plane[1]} [m]")
    ax.legend()


def picture(ax: Axes, image: np.ndarray) -> None:
    """An image without axes, a dark one brightened.

    Parameters
    ----------
    ax
    image
        Shape (h, w, 3), blue first.
    """
    brightest = np.quantile(image[::4, ::4], 0.99)
    gain = BRIGHT / np.clip(brightest, BRIGHT / GAIN, BRIGHT)
    shown = np.clip(gain * image[..., ::-1], 0, 255).astype(np.uint8)
    ax.imshow(shown, interpolation="antialiased")
    if gain > 1:
        ax.text(
            0.01,
            0.015,
            f"brightened {gain:.1f} times",
            color="white",
            bbox=DARK | {"pad": 2},
            transform=ax.transAxes,
        )
    ax.set_axis_off()


def board_view(
    ax: Axes, image: np.ndarray, view, model: CameraModel, margin: float = 60
) -> None:
    """An image with what was found of the board in it, cut to the board.

    The title names edges that were not used.

    Parameters
    ----------
    ax
    image
        Shape (h, w, 3), blue first.
    view : BoardView
    model
        Puts edges, which are kept in undistorted pixels, back through the lens.
    margin
        Pixels around the board.
    """
    color = color_of(view.camera)
    if view.pixels is not None:
        ax.plot(*view.pixels.T, "+", color=FILTERED, markersize=4, mew=0.8)
    box = {"facecolor": color, "edgecolor": "none", "boxstyle": "round,pad=0.2"}
    for edge in view.edges:
        stretch = stretch_in_image(edge, model)
        ax.plot(*stretch.T, color=color, linewidth=1.6)
        ax.text(
            *stretch.mean(axis=0),
            edge.name,
            color="white",
            fontsize=8,
            bbox=box,
            clip_on=True,
            **CENTRED,
        )
    unused = ""
    if view.rejected:
        unused = f"; not used: {', '.join(name for name, _ in view.rejected)}"
    _picture_about_lines(ax, view, image, margin, unused)


def seen_points(
    ax: Axes,
    view,
    image: np.ndarray,
    model: CameraModel,
    points: dict[str, np.ndarray],
    margin: float = 60,
    styles: Sequence[str] = ("o", "x", "s"),
) -> None:
    """LRF points by method beside the edges of the board in the image of a view, figure 7.

    Parameters
    ----------
    ax
    view : BoardView
    image
        Shape (h, w, 3), in which the view was found, see
        :meth:`lrfcal_lib.preprocess.prepared.Prepared.seen`.
    model
    points
        Recorded pixels (n, 2) by method; NaN rows are left out.
    margin
        Pixels around all that is drawn.
    styles
        Markers or line styles, one a method.
    """
    for edge in view.edges:
        ax.plot(*stretch_in_image(edge, model).T, color="white", linewidth=1.0)
    if view.edges:
        ax.lines[-1].set_label("edge in the image")
    for index, (method, uv) in enumerate(points.items()):
        ax.plot(
            *uv.T,
            styles[index],
            color=series(index + 1),
            label=method,
            markersize=4.5,
            markerfacecolor="none",
        )
    ax.legend(frameon=True, framealpha=0.8, labelcolor="white", **DARK)
    _picture_about_lines(ax, view, image, margin)


def stretch_in_image(edge, model: CameraModel) -> np.ndarray:
    """Recorded pixels (STRETCH, 2) of an ImageEdge, which is a straight line without the lens."""
    first, last = edge.ends
    return redistort(np.linspace(first, last, STRETCH), model)


def _picture_about_lines(ax, view, image, margin, more=""):
    """An image of the board behind the lines drawn so far, cut to them; the title says which."""
    rim = ax.dataLim.get_points() + [[-margin], [margin]]  # not finite without a line
    picture(ax, image)
    ax.set_title(f"{view.camera}, placement {view.placement}{more}")
    if np.isfinite(rim).all():
        columns, rows = np.clip(rim, -0.5, np.array(image.shape[1::-1]) - 0.5).T
        ax.set(xlim=columns, ylim=rows[::-1])


def _lengths(ax, board, away):
    """The lengths of a board's edges, written so many metres outside of them."""
    middles = side_ends(board.known_corners()).mean(axis=1) + away * board.lines()[:, :2]
    for (name, length), at in zip(board.lengths().items(), middles, strict=True):
        ax.text(*at, f"{name.upper()}\n{1000 * length:.1f} mm", **CENTRED)


def squares(ax: Axes, pattern: Chessboard, colors: ListedColormap) -> None:
    """The squares of a chessboard in the frame of its board, in a dark and a white colour."""
    y, x = np.mgrid[-1 : pattern.rows + 1, -1 : pattern.columns + 1]
    left, low = pattern.origin
    white = (x + y)[:-1, :-1] % 2
    ax.pcolormesh(left + pattern.square * x, low + pattern.square * y, white, cmap=colors)


def board_plan(ax: Axes, board: Board) -> None:
    """A board with its sizes, corners A, B, ... and printed squares, in its own frame.

    Parameters
    ----------
    ax
    board
        With known corners.
    """
    corners = board.known_corners()
    ax.fill(*corners.T, color=PRINT.colors[0], linewidth=0)
    if board.pattern is not None:
        squares(ax, board.pattern, PRINT)
    _lengths(ax, board, 0.065)
    ax.update_datalim(np.vstack([corners - 0.09, corners + 0.09]))
    to_scale(ax, "x [m]", "y [m]")


def outline(ax: Axes, measured) -> None:
    """The measured outline of the board.

    Parameters
    ----------
    ax
    measured : Outline
    """
    board = measured.board
    corners = board.known_corners()
    ax.plot(*closed(corners).T, color=TRUTH)
    spreads = EXAGGERATED * np.nan_to_num(measured.line_sd)[:, None] * board.lines()[:, :2]
    for ends, away in zip(side_ends(corners), spreads, strict=True):
        band = np.vstack([ends - away, ends[::-1] + away])
        ax.fill(*band.T, color=FIT, alpha=0.25, linewidth=0)
    _lengths(ax, board, -0.09)
    if board.pattern is not None:
        ax.plot(*board.pattern.points()[:, :2].T, "+", color=RAW, markersize=4)
    ax.invert_yaxis()
    to_scale(ax, "x [m]", "y [m]")
    ax.set_title(f"bands: spread over the images, {EXAGGERATED} times")
