"""Figures of what was recorded: scans, range images, pictures, edges; and one colour for each sensor."""

from __future__ import annotations

import numpy as np

from lrfcal_lib.model.board import corners_of_lines
from lrfcal_lib.model.camera import distort
from lrfcal_lib.model.geometry import polar_to_points

COLORS = {
    "lrf": "#d55e00",
    "left": "#0072b2",
    "right": "#009e73",
    "fit": "#b5378a",
    "truth": "#222222",
    "raw": "#a3a3a3",
    "filtered": "#e69f00",
    "outlier": "#cc2222",
    "platform": "#666666",
}
SERIES = ("#0072b2", "#d55e00", "#009e73", "#b5378a", "#e69f00", "#56b4e9", "#7a5c3e", "#222222")
AXES_RGB = ("#d62728", "#2ca02c", "#1f5fd6")  # x, y, z of every frame


def color_of(name, index=0):
    """The colour of a sensor or role, or the `index`-th colour of a series for any other name."""
    return COLORS.get(name, SERIES[index % len(SERIES)])


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


def picture(ax, image):
    """An image as cameras and OpenCV give it (blue first), without axes.

    Parameters
    ----------
    ax : Axes
    image : ndarray of uint8, shape (h, w, 3) or (h, w)
    """
    color = image[..., ::-1] if image.ndim == 3 else image
    ax.imshow(color, cmap=None if image.ndim == 3 else "gray", interpolation="antialiased")
    ax.set_axis_off()


def board_view(ax, image, view, model, margin=60):
    """An image with the corners and edges found in it, cut to the board.

    Parameters
    ----------
    ax : Axes
    image : ndarray of uint8, shape (h, w, 3)
        As recorded.
    view : BoardView
        The title names the edges that were not used.
    model : CameraModel
        Puts edges, which are kept in undistorted pixels, back through the lens.
    margin : float
        Pixels around the board.
    """
    picture(ax, image)
    color = color_of(view.camera)
    drawn = []
    if view.pixels is not None:
        ax.plot(*view.pixels.T, "+", color=COLORS["filtered"], markersize=4, markeredgewidth=0.8)
        drawn.append(view.pixels)
    for edge in view.edges:
        drawn.append(stretch_in_image(edge, model))
        ax.plot(*drawn[-1].T, "-", color=color, linewidth=1.6)
        _label(ax, drawn[-1].mean(axis=0), edge.name, color)
    title = f"{view.camera}, placement {view.placement}"
    lost = ", ".join(name for name, _ in view.rejected)
    ax.set_title(f"{title}; not used: {lost}" if lost else title)
    _cut(ax, drawn, image, margin)


def edge_detail(ax, image, edge, model, half_width=12):
    """The pixels around the middle of an edge, with the line fitted to it.

    Parameters
    ----------
    ax : Axes
    image : ndarray of uint8, shape (h, w, 3)
    edge : ImageEdge
    model : CameraModel
    half_width : float
        Pixels.
    """
    color = image[..., ::-1] if image.ndim == 3 else image
    ax.imshow(color, cmap=None if image.ndim == 3 else "gray")
    stretch = stretch_in_image(edge, model)
    u, v = stretch[len(stretch) // 2]
    ax.plot(*stretch.T, "-", color=COLORS["fit"], linewidth=1.6)
    ax.set(xlim=(u - half_width, u + half_width), ylim=(v + half_width, v - half_width))
    ax.set(xlabel="u [px]", ylabel="v [px]")
    ax.set_title(f"{edge.name}: {edge.rms_px:.2f} px rms")
    ax.grid(False)


def projected_points(ax, image, points, lines=None, margin=60):
    """LRF edge points in an image by calibration method, figure 7.

    Parameters
    ----------
    ax : Axes
    image : ndarray of uint8, shape (h, w, 3)
    points : dict of str to ndarray, shape (n, 2)
        Recorded pixels by method; NaN rows are left out.
    lines : sequence of ndarray, shape (m, 2)
        Stretches of image edges, recorded pixels.
    margin : float
        Pixels around all that is drawn; NaN shows the whole image.
    """
    picture(ax, image)
    for index, stretch in enumerate(lines or ()):
        ax.plot(*np.asarray(stretch).T, "-", color="white", linewidth=1.0, label=None if index else "edge in the image")
    for index, (method, uv) in enumerate(points.items()):
        marker = ("o", "x", "s", "+", "d", "^")[index % 6]
        face = {"markerfacecolor": "none"} if marker not in "x+" else {}
        color = SERIES[(index + 1) % len(SERIES)]
        ax.plot(*np.asarray(uv).T, marker, color=color, markersize=4.5, label=method, **face)
    ax.legend(facecolor="#333333", labelcolor="white", frameon=True, framealpha=0.8, edgecolor="none")
    _cut(ax, [*points.values(), *(lines or ())], image, margin)


def seen_points(ax, view, image, model, points):
    """LRF edge points beside the edges of the board in the image of a view: :func:`projected_points`, figure 7.

    Parameters
    ----------
    ax : Axes
    view : BoardView
    image : ndarray of uint8, shape (h, w, 3)
        In which the view was found, see :meth:`lrfcal_lib.preprocess.prepared.Prepared.seen`.
    model : CameraModel
    points : dict of str to ndarray, shape (n, 2)
        Recorded pixels by method.
    """
    projected_points(ax, image, points, [stretch_in_image(edge, model) for edge in view.edges])
    ax.set_title(f"{view.camera}, placement {view.placement}")


def stretch_in_image(edge, model, count=61):
    """An image edge as recorded: its stretch of undistorted pixels seen through the lens, shape (count, 2)."""
    ends = np.asarray(edge.ends, float)
    uv = ends[0] + np.linspace(0, 1, count)[:, None] * (ends[1] - ends[0])
    focal, centre = np.array([model.fx, model.fy]), np.array([model.cx, model.cy])
    return distort((uv - centre) / focal, model.distortion) * focal + centre


def _label(ax, at, text, color):
    box = {"facecolor": color, "edgecolor": "none", "boxstyle": "round,pad=0.2", "alpha": 0.85}
    ax.text(*at, text, color="white", fontsize=7, ha="center", va="center", bbox=box, clip_on=True)


def _cut(ax, drawn, image, margin):
    """Limit the axes to what is drawn in them, and to the image."""
    points = np.concatenate([np.asarray(p, float).reshape(-1, 2) for p in drawn]) if drawn else np.empty((0, 2))
    points = points[np.isfinite(points).all(axis=1)]
    height, width = image.shape[:2]
    if len(points) == 0 or np.isnan(margin):
        ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
        return
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    ax.set_xlim(max(low[0], -0.5), min(high[0], width - 0.5))
    ax.set_ylim(min(high[1], height - 0.5), max(low[1], -0.5))


def outline(ax, measured, exaggerate=20):
    """The measured outline of the board with the spread of each edge over the images.

    Parameters
    ----------
    ax : Axes
    measured : Outline
    exaggerate : float
        Spread is drawn this many times larger than it is.
    """
    corners = corners_of_lines(measured.lines)
    closed = np.vstack([corners, corners[:1]])
    ax.plot(*closed.T, "-", color=COLORS["truth"])
    for index, name in enumerate(measured.board.edges):
        ends = closed[index : index + 2]
        normal, sd = measured.lines[index, :2], float(measured.line_sd[index])
        if np.isfinite(sd):
            band = [ends + sign * exaggerate * sd * normal for sign in (-1, 1)]
            ax.fill(*np.vstack([band[0], band[1][::-1]]).T, color=COLORS["fit"], alpha=0.25, linewidth=0)
        length = measured.lengths.get(name)
        text = name if length is None else f"{name}\n{1000 * length:.1f} mm"
        ax.text(*(ends.mean(axis=0) - 0.09 * normal), text, ha="center", va="center", fontsize=8)
    if measured.board.pattern is not None:
        ax.plot(*measured.board.pattern.points()[:, :2].T, "+", color=COLORS["raw"], markersize=4)
    ax.invert_yaxis()
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x [m]", ylabel="y [m]")
    ax.set_title(f"bands: spread over the images, {exaggerate:g} times")
