"""Pictures of the data collection panel: a scan from above, a sweep as it grows, camera images."""

import cv2
import numpy as np
from matplotlib.figure import Figure

from lrfcal_lib.drivers.lms2xx_scans import Reading
from lrfcal_lib.plots.colors import LRF
from lrfcal_lib.plots.recording import png, range_image
from lrfcal_lib.session.images import encode_jpeg
from lrfcal_lib.session.read import Sweep

WIDTH = 400  # of a picture, pixels
REACHES = np.array([2.0, 4.0, 8.0, 12.0, 20.0, 40.0, 80.0])  # of the top view, metres
# whatever layout a notebook has set for its own figures
PLAIN = {"figsize": (4, 3), "dpi": 100, "layout": "none"}
NEAR_IS_BRIGHT = "viridis_r"


def scan_picture(reading: Reading) -> bytes:
    """A scan from above, the laser range finder below, as a PNG file."""
    figure = Figure(**PLAIN)
    ax = figure.add_axes((0.1, 0.1, 0.8, 0.85), projection="polar")
    ax.plot(reading.bearings, reading.ranges, ".", color=LRF, markersize=3)
    known = reading.ranges[np.isfinite(reading.ranges)]
    far = np.percentile(known, 90) if len(known) else 0.0
    ax.set_rlim(0, REACHES[np.searchsorted(REACHES[:-1], far)])
    ax.set_thetalim(*reading.bearings[[0, -1]])
    ax.set_rorigin(0)
    figure.text(0.5, 0.03, "range [m]", ha="center")
    return png(figure)


def sweep_picture(rows: dict[float, Reading], pitch: np.ndarray) -> bytes:
    """A sweep as it grows: ranges as colours, near is bright; a PNG file.

    Parameters
    ----------
    rows
        By pitch, radians.
    pitch
        Of all of it, radians.
    """
    figure = Figure(**PLAIN)
    ax = figure.add_axes((0.17, 0.17, 0.81, 0.79))
    if len(rows) > 1:
        known = np.array(list(rows))
        readings = list(rows.values())
        ranges = np.array([reading.ranges for reading in readings])
        sweep = Sweep(0, ranges, readings[0].bearings, known, np.nan * known)
        range_image(ax, sweep, limits=(None, None)).set_cmap(NEAR_IS_BRIGHT)
    ax.set(ylim=np.degrees([pitch.min(), pitch.max()]), aspect="auto")
    return png(figure)


def with_scan(image: np.ndarray, pixels: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """A scan line over an image, coloured by range: near is bright.

    Parameters
    ----------
    image
        (height, width, 3), BGR.
    pixels
        Of its beams, (B, 2); NaN where there is none.
    ranges
        (B,), metres.

    Returns
    -------
    ndarray of uint8
        A copy.
    """
    drawn = image.copy()
    height, width = image.shape[:2]
    radius = max(2, round(width / WIDTH * 2))
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    low, high = np.nanpercentile(ranges, [2, 90])
    near = np.clip((high - ranges[inside]) / max(high - low, 0.1), 0, 1)
    colours = cv2.applyColorMap((255 * near).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    middles = pixels[inside].round().astype(int).tolist()
    for pixel, colour in zip(middles, colours.reshape(-1, 3).tolist(), strict=True):
        cv2.circle(drawn, pixel, radius, colour, -1, cv2.LINE_AA)
    return drawn


def jpeg(image: np.ndarray) -> bytes:
    """Content of a JPEG file, at most `WIDTH` pixels wide.

    Parameters
    ----------
    image
        (height, width, 3), BGR.
    """
    scale = WIDTH / image.shape[1]
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return encode_jpeg(image, 85)
