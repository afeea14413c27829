"""Figures of images, and of the board measured in them."""

from __future__ import annotations

import numpy as np

from lrfcal_lib.board import corners_of_lines
from lrfcal_lib.camera import distort
from lrfcal_lib.plots.colors import COLORS, SERIES, color_of


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
        In which the view was found, see :meth:`lrfcal_lib.prepared.Prepared.seen`.
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
