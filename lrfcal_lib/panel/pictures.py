"""Pictures of what a rig sees now, as PNG and JPEG; quick enough for several a second.

Axes are drawn by matplotlib once; what changes is painted on top of them by OpenCV.
"""

from __future__ import annotations

import cv2
import numpy as np

from lrfcal_lib.geometry import polar_to_points
from lrfcal_lib.plots.colors import COLORS

DPI = 100
REACHES = (2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 20.0, 30.0, 50.0, 82.0)  # of the top view, metres
SHIFT = 4  # binary digits of a pixel's fraction
GREY = "#8a8a8a"
EMPTY = (238, 238, 238)  # of a sweep's picture, where no range is


class Canvas:
    """Axes drawn once.

    Parameters
    ----------
    draw : callable
        ``draw(ax)``.
    size : (int, int)
        Width and height, pixels.
    place : tuple of float
        Of the axes in the figure: left, bottom, width, height as fractions.
    """

    def __init__(self, draw, size, place=(0, 0, 1, 1)):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(size[0] / DPI, size[1] / DPI), dpi=DPI, layout="none")
        canvas = FigureCanvasAgg(figure)
        ax = figure.add_axes(place)
        draw(ax)
        canvas.draw()
        self.background = np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., 2::-1])
        self._to_pixels = ax.transData.frozen()

    def pixels(self, points):
        """Pixels of points in the axes' own units, shape (n, 2); v goes down."""
        found = self._to_pixels.transform(np.asarray(points, float).reshape(-1, 2))
        return np.column_stack([found[:, 0], len(self.background) - found[:, 1]])


def png(image):
    """Bytes of a PNG file."""
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes()


def jpeg(image, width):
    """Bytes of a JPEG file of an image, not wider than `width` pixels.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w, 3)
        BGR.
    width : int
    """
    scale = width / image.shape[1]
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()


class TopView:
    """Scans in their own plane: the laser range finder below, the scene ahead; circles every metre or more.

    Parameters
    ----------
    field_of_view : (float, float)
        First and last bearing, radians.
    size : (int, int)
        Pixels.
    """

    def __init__(self, field_of_view, size=(420, 330)):
        self.field_of_view, self.size = field_of_view, size
        self._canvases = {}

    def draw(self, ranges, bearings):
        """A scan.

        Parameters
        ----------
        ranges, bearings : ndarray, shape (B,)
            Metres (NaN: none) and radians.

        Returns
        -------
        ndarray of uint8, shape (h, w, 3)
        """
        points = polar_to_points(np.asarray(ranges, float), bearings)[:, :2]
        points = points[np.isfinite(points).all(axis=1)]
        canvas = self._canvas(reach_of(points))
        image = canvas.background.copy()
        for pixel in np.rint(canvas.pixels(points) * 2**SHIFT).astype(int):
            cv2.circle(image, tuple(map(int, pixel)), 2 << SHIFT, _bgr(COLORS["lrf"]), -1, cv2.LINE_AA, SHIFT)
        return image

    def _canvas(self, reach):
        if reach not in self._canvases:
            self._canvases[reach] = Canvas(lambda ax: self._axes(ax, reach), self.size)
        return self._canvases[reach]

    def _axes(self, ax, reach):
        angle = np.linspace(*self.field_of_view, 91)
        edge = reach * np.column_stack([np.cos(angle), np.sin(angle)])
        shape = self.size[0] / self.size[1]
        low, high, side = min(0.0, edge[:, 1].min()), edge[:, 1].max(), np.abs(edge[:, 0]).max()
        middle, half = (low + high) / 2, 1.1 * max((high - low) / 2, side / shape)
        ax.set(xlim=(-half * shape, half * shape), ylim=(middle - half, middle + half), aspect="equal")
        ax.set_axis_off()
        ax.fill(*np.vstack([[0, 0], edge]).T, color="#f4f6f8", zorder=0)
        step = 1.0 if reach <= 6 else 2.0 if reach <= 12 else 5.0 if reach <= 30 else 20.0
        for radius in np.arange(step, reach + 1e-6, step):
            ax.plot(radius * np.cos(angle), radius * np.sin(angle), color="#d5d9dd", linewidth=0.8, zorder=1)
            if radius < reach:
                ax.text(*edge[0] * radius / reach, f" {radius:g} m", color=GREY, fontsize=8, va="top", ha="left")
        ax.plot(0, 0, marker="^", color="#333333", markersize=9)


def reach_of(points):
    """Radius of a top view that shows nearly all points, metres."""
    far = float(np.percentile(np.linalg.norm(points, axis=1), 90)) if len(points) else 0.0
    return next((reach for reach in REACHES if reach >= far), REACHES[-1])


class SweepPicture:
    """A sweep as it grows: ranges as colours, bearing to the left as in the scene, pitch upwards.

    Parameters
    ----------
    field_of_view : (float, float)
        Radians.
    pitch : (float, float)
        Lowest and highest of the sweep, radians.
    step : float
        Between scan lines, radians; of a continuous sweep the most between two.
    size : (int, int)
        Pixels.
    """

    def __init__(self, field_of_view, pitch, step, size=(420, 330)):
        self.bearing, self.step = np.degrees(field_of_view), np.degrees(step)
        self.pitch = np.degrees([min(pitch), max(pitch)]) + np.array([-0.5, 0.5]) * self.step
        self._canvas = Canvas(self._axes, size, (0.11, 0.15, 0.86, 0.81))

    def _axes(self, ax):
        ax.set(xlim=(max(self.bearing), min(self.bearing)), ylim=tuple(self.pitch))
        ax.set_facecolor("#eeeeee")
        ax.tick_params(labelsize=7, colors=GREY)
        ax.set_xlabel("bearing [deg]", fontsize=8, color=GREY)
        ax.set_ylabel("pitch [deg]", fontsize=8, color=GREY, labelpad=1)
        for side in ax.spines.values():
            side.set_color("#cccccc")

    def draw(self, rows, bearings):
        """The sweep so far.

        Parameters
        ----------
        rows : dict of float to ndarray, shape (B,)
            Ranges by pitch.
        bearings : ndarray, shape (B,)

        Returns
        -------
        ndarray of uint8, shape (h, w, 3)
        """
        image = self._canvas.background.copy()
        if not rows:
            return image
        shades = _shades(np.array(list(rows.values())))
        edges = np.degrees([bearings[-1], bearings[0]])
        for pitch, row in zip(np.degrees(list(rows)), shades, strict=True):
            ends = [(edges[0], pitch + self.step / 2), (edges[1], pitch - self.step / 2)]
            (left, top), (right, bottom) = np.rint(self._canvas.pixels(ends)).astype(int) + [[0, 0], [0, 1]]
            if right > left and bottom > top:
                line = cv2.resize(row[None, ::-1], (right - left, 1), interpolation=cv2.INTER_NEAREST)
                image[top:bottom, left:right] = line
        return image


def _shades(ranges):
    """Colours of ranges, shape (L, B, 3): near is bright; grey where there is none."""
    known = np.isfinite(ranges)
    low, high = np.percentile(ranges[known], [2, 90]) if known.any() else (0, 1)
    scaled = (np.nan_to_num(ranges, nan=high) - low) / max(high - low, 0.1)
    grey = (255 * (1 - np.clip(scaled, 0, 1))).astype(np.uint8)
    shades = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS).reshape(*ranges.shape, 3)
    shades[~known] = EMPTY
    return shades


def _bgr(text):
    return tuple(int(text[i : i + 2], 16) for i in (5, 3, 1))
