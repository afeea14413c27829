"""Figures of what was recorded: scans, range images, pictures, edges; a colour for each sensor."""

import numpy as np
from matplotlib.patches import Rectangle

from lrfcal_lib.model.board import outline_lines
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
BESIDE = 14  # beams shown on either side of the end of a board
ABOUT = 6.0  # degrees shown on either side of a board
# a picture whose brightest hundredth is darker is brightened, by this factor at most
BRIGHT = 150
GAIN = 5.0


def range_image(ax, sweep, mask=None, limits=None):
    """A sweep as the rig sees it: range over bearing (to the left as in the scene) and pitch.

    Returns what was drawn. With a pitch that stands still, scan lines are numbered instead. `mask`
    (L, B) is what was found to be the board; it is outlined, and bearings far from it are cut off.
    With `limits` (two ranges, metres) several sweeps share their colours, and the colour bar is
    left to the caller.
    """
    bearing = np.degrees(sweep.bearings)
    order = np.argsort(sweep.pitch, kind="stable")
    height = np.arange(len(sweep.pitch))
    ax.set(xlabel="bearing [deg]", ylabel="scan line", aspect="auto")
    if np.ptp(sweep.pitch) > 0:
        height = np.degrees(sweep.pitch)
        ax.set(ylabel="pitch [deg]", aspect="equal")
    low, high = limits or (None, None)
    looks = {"shading": "nearest", "rasterized": True, "vmin": low, "vmax": high}
    drawn = ax.pcolormesh(bearing, height[order], sweep.ranges[order], **looks)
    if limits is None:
        ax.figure.colorbar(drawn, ax=ax, label="range [m]", shrink=0.9)
    shown = np.isfinite(sweep.ranges).any(axis=0)
    if mask is not None and mask.any():
        _outlined(ax, bearing, height[order], mask[order])
        board = bearing[mask.any(axis=0)]
        shown &= np.abs(bearing - board.mean()) < np.ptp(board) / 2 + ABOUT
    if shown.any():
        step = np.ptp(bearing) / max(len(bearing) - 1, 1)
        ax.set_xlim(bearing[shown].max() + step, bearing[shown].min() - step)
    ax.grid(False)
    return drawn


def _outlined(ax, bearing, height, mask):
    """Draw the border of a mask (L, B) over bearing and height in white; of one line its beams."""
    if len(mask) == 1:
        ax.plot(bearing[mask[0]], np.repeat(height, mask.sum()), ".", color="white", markersize=2)
    else:
        looks = {"levels": [0.5], "colors": "white", "linewidths": 1}
        ax.contour(bearing, height, mask.astype(float), **looks)


def scan_line(ax, sweep, line, mask, fitted=None):
    """One scan line, a row of ``sweep.ranges``, in the scan plane.

    `mask` (L, B) has the beams on the board, `fitted` (L, B) the ranges of a fitted line, see
    BoardScan.
    """
    points = polar_to_points(sweep.ranges[line], sweep.bearings)[:, :2]
    on = mask[line]
    ax.plot(*points[~on].T, ".", color=COLORS["raw"], label="scene" if on.any() else "returns")
    ax.plot(*points[on].T, ".", color=COLORS["lrf"], label="board")
    if fitted is not None:
        on_line = polar_to_points(fitted[line], sweep.bearings)[on, :2]
        ax.plot(*on_line.T, color=COLORS["fit"], label="fitted line")
    ax.plot(0, 0, marker="^", color=COLORS["lrf"], markersize=8, linestyle="none", label="LRF")
    to_scale(ax, "x [m]", "y [m]")
    ax.legend()


def to_scale(ax, x, y):
    """Equal scales and labels."""
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel=x, ylabel=y)


def edge_of_line(ax, scan, line, end=1, edges=()):
    """Where a scan line of a BoardScan leaves the board: ranges raw, filtered, fitted (figure 5).

    `end` is +1 for the end at the larger bearings, -1 for the other one. Crossings of this line and
    end in `edges` (a sequence of ScanEdges) are drawn as upright lines.
    """
    on = np.flatnonzero(scan.mask[line])
    if on.size == 0:
        where = f"scan line {line} is on the board of placement {scan.placement}"
        raise ValueError(f"no beam of {where}")
    last = on[-1] if end > 0 else on[0]
    beams = np.arange(scan.mask.shape[1])
    near = np.abs(beams - last) <= BESIDE
    board = near & scan.mask[line]
    bearing = np.degrees(scan.sweep.bearings)
    raw = {"color": COLORS["raw"], "markersize": 5, "label": "raw"}
    filtered = {"color": COLORS["filtered"], "markersize": 3, "label": "filtered"}
    fitted = {"color": COLORS["fit"], "label": "line fitted to the board"}
    ax.plot(bearing[near], scan.sweep.ranges[line, near], "o", **raw)
    ax.plot(bearing[board], scan.filtered[line, board], "o", **filtered)
    ax.plot(bearing[board], scan.fitted[line, board], "-", **fitted)
    for index, found in enumerate(edges):
        for x, y, _ in found.points[(found.line == line) & (found.end == end)]:
            style = ("--", "-", ":")[index % 3]
            at = np.degrees(np.arctan2(y, x))
            label = found.variant.replace("_", " ")
            ax.axvline(at, color=COLORS["lrf"], linestyle=style, label=label)
    ax.invert_xaxis()
    ax.set(xlabel="bearing [deg]", ylabel="range [m]")
    ax.legend()


def crossings(ax, edges):
    """Edge crossings (ScanEdges) of a sweep, one colour a straight side; side -1 crossed out."""
    x, y, _ = edges.points.T
    points = np.degrees(np.column_stack([np.arctan2(y, x), edges.pitch]))
    for index, side in enumerate(np.unique(edges.side[edges.side >= 0])):
        color = SERIES[index % len(SERIES)]
        ax.plot(*points[edges.side == side].T, ".", color=color, label=f"side {side}")
    if (edges.side < 0).any():
        ax.plot(*points[edges.side < 0].T, "x", color=COLORS["outlier"], label="not used")
    ax.legend()
    ax.invert_xaxis()
    to_scale(ax, "bearing [deg]", "pitch [deg]")


def projection(ax, edges, plane, lines=None):
    """Edge points in one coordinate plane of the platform, figure 4 (b) to (d).

    Parameters
    ----------
    ax : Axes
    edges : dict of str to ndarray, shape (n, 3)
        Points by edge, metres.
    plane : str
        'xz', 'yz' or 'xy'; a ValueError for another one.
    lines : dict of str to (point, direction), optional
        Fitted lines in space, drawn over the extent of their points.
    """
    if plane not in PLANES:
        raise ValueError(f"plane must be one of {', '.join(PLANES)}, got '{plane}'")
    pick = list(PLANES[plane])
    for index, (name, points) in enumerate(edges.items()):
        color = color_of(name, index)
        ax.plot(*points[:, pick].T, ".", color=color, label=name)
        if lines and name in lines:
            point, direction = lines[name]
            along = (points - point) @ direction
            ends = point + np.outer([along.min(), along.max()], direction)
            ax.plot(*ends[:, pick].T, "-", color=color)
    to_scale(ax, f"{plane[0]} [m]", f"{plane[1]} [m]")
    ax.legend()


def picture(ax, image):
    """An image (h, w, 3) or (h, w), blue first, without axes; a dark one brightened."""
    brightest = max(np.quantile(image[::4, ::4], 0.99), 1.0)
    gain = np.clip(BRIGHT / brightest, 1.0, GAIN)
    looks = {"interpolation": "antialiased", "vmin": 0, "vmax": 255}
    if image.ndim == 3:
        color = np.clip(gain * image[..., ::-1], 0, 255)
        ax.imshow(color.astype(np.uint8), **looks)
    else:
        ax.imshow(gain * image, cmap="gray", **looks)
    if gain > 1:
        box = {"facecolor": "#333333", "edgecolor": "none", "pad": 2}
        looks = {"color": "white", "va": "bottom", "bbox": box, "transform": ax.transAxes}
        ax.text(0.01, 0.015, f"brightened {gain:.1f} times", **looks)
    ax.set_axis_off()


def board_view(ax, image, view, model, margin=60):
    """An image with what a BoardView found in it, cut to `margin` pixels around the board.

    The title names edges that were not used. `model` puts edges, which are kept in undistorted
    pixels, back through the lens.
    """
    picture(ax, image)
    color = color_of(view.camera)
    drawn = []
    if view.pixels is not None:
        ax.plot(*view.pixels.T, "+", color=COLORS["filtered"], markersize=4, markeredgewidth=0.8)
        drawn.append(view.pixels)
    box = {"facecolor": color, "edgecolor": "none", "boxstyle": "round,pad=0.2", "alpha": 0.85}
    looks = {"color": "white", "fontsize": 8, "ha": "center", "va": "center"}
    for edge in view.edges:
        stretch = stretch_in_image(edge, model)
        ax.plot(*stretch.T, "-", color=color, linewidth=1.6)
        ax.text(*stretch.mean(axis=0), edge.name, bbox=box, clip_on=True, **looks)
        drawn.append(stretch)
    title = f"{view.camera}, placement {view.placement}"
    if view.rejected:
        lost = ", ".join(name for name, _ in view.rejected)
        title = f"{title}; not used: {lost}"
    ax.set_title(title)
    _cut(ax, drawn, image, margin)


def seen_points(ax, view, image, model, points, margin=60, styles=("o", "x", "s", "+", "d", "^")):
    """LRF points by method beside the edges of the board in the image of a view, figure 7.

    Parameters
    ----------
    ax : Axes
    view : BoardView
    image : ndarray of uint8, shape (h, w, 3)
        In which the view was found, see :meth:`lrfcal_lib.preprocess.prepared.Prepared.seen`.
    model : CameraModel
    points : dict of str to ndarray, shape (n, 2)
        Recorded pixels by method; NaN rows are left out.
    margin : float
        Pixels around all that is drawn.
    styles : sequence of str
        Markers or line styles, one a method.
    """
    picture(ax, image)
    lines = [stretch_in_image(edge, model) for edge in view.edges]
    for index, stretch in enumerate(lines):
        label = None if index else "edge in the image"
        ax.plot(*stretch.T, "-", color="white", linewidth=1.0, label=label)
    for index, (method, uv) in enumerate(points.items()):
        color = SERIES[(index + 1) % len(SERIES)]
        looks = {"color": color, "markersize": 4.5, "markerfacecolor": "none"}
        ax.plot(*uv.T, styles[index % len(styles)], label=method, **looks)
    dark = {"facecolor": "#333333", "labelcolor": "white", "edgecolor": "none"}
    ax.legend(frameon=True, framealpha=0.8, **dark)
    _cut(ax, [*points.values(), *lines], image, margin)
    ax.set_title(f"{view.camera}, placement {view.placement}")


def stretch_in_image(edge, model, count=61):
    """An image edge as recorded: its stretch of pixels seen through the lens, shape (count, 2)."""
    uv = np.linspace(*edge.ends, count)
    focal = np.array([model.fx, model.fy])
    centre = np.array([model.cx, model.cy])
    return distort((uv - centre) / focal, model.distortion) * focal + centre


def _cut(ax, drawn, image, margin):
    """Limit the axes to what is drawn in them, and to the image."""
    points = np.concatenate([*drawn, np.zeros((0, 2))])
    size = np.array(image.shape[1::-1])
    points = points[np.isfinite(points).all(axis=1)]
    first = np.array([-0.5, -0.5])
    last = size - 0.5
    if len(points):
        first = np.maximum(points.min(axis=0) - margin, first)
        last = np.minimum(points.max(axis=0) + margin, last)
    left, top = np.minimum(first, size - 0.5)
    right, bottom = np.maximum(last, -0.5)
    ax.set(xlim=(left, right), ylim=(bottom, top))


def board_plan(ax, board):
    """A Board with its sizes, corners A, B, ... and printed squares, in its own frame."""
    corners = board.known_corners()
    turn = outline_lines(board.known_corners())[:, :2]
    ax.fill(*corners.T, color="#333333", linewidth=0)
    if board.pattern is not None:
        size = board.pattern.square
        start = np.subtract(board.pattern.origin, board.pattern.square)
        for row, column in np.ndindex(board.pattern.rows + 1, board.pattern.columns + 1):
            if (row + column) % 2:
                corner = start + size * np.array([column, row])
                ax.add_patch(Rectangle(corner, size, size, color="white", linewidth=0))
    for index, (name, length) in enumerate(board.lengths().items()):
        ends = corners[[index, (index + 1) % len(corners)]]
        at = ends.mean(axis=0) + 0.03 * turn[index]
        x, y = ends[1] - ends[0]
        upright = (np.degrees(np.arctan2(y, x)) + 90) % 180 - 90
        turned = {"rotation": upright, "rotation_mode": "anchor"}
        text = f"{name.upper()} {1000 * length:.1f} mm"
        ax.text(*at, text, ha="center", va="center", **turned)
    ax.update_datalim(np.vstack([corners - 0.06, corners + 0.06]))
    to_scale(ax, "x [m]", "y [m]")


def outline(ax, measured, exaggerate=20):
    """The measured Outline of the board, the spread of each edge `exaggerate` times larger."""
    corners = measured.board.known_corners()
    closed = np.vstack([corners, corners[:1]])
    ax.plot(*closed.T, "-", color=COLORS["truth"])
    for index, (name, length) in enumerate(measured.board.lengths().items()):
        ends = closed[index : index + 2]
        normal = measured.lines[index, :2]
        if np.isfinite(measured.line_sd[index]):
            away = exaggerate * measured.line_sd[index] * normal
            band = np.vstack([ends - away, ends[::-1] + away])
            ax.fill(*band.T, color=COLORS["fit"], alpha=0.25, linewidth=0)
        text = f"{name}\n{1000 * length:.1f} mm"
        at = ends.mean(axis=0) - 0.09 * normal
        ax.text(*at, text, ha="center", va="center", fontsize=8)
    if measured.board.pattern is not None:
        corners = measured.board.pattern.points()[:, :2]
        ax.plot(*corners.T, "+", color=COLORS["raw"], markersize=4)
    ax.invert_yaxis()
    to_scale(ax, "x [m]", "y [m]")
    ax.set_title(f"bands: spread over the images, {exaggerate:g} times")
