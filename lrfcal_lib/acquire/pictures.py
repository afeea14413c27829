"""Pictures of the data collection panel: a scan from above, a sweep as it grows, camera images."""

import cv2
import numpy as np

from lrfcal_lib.model.geometry import polar_to_points
from lrfcal_lib.plots.recording import COLORS

PICTURE = (400, 300)  # width and height of a picture, pixels
REACHES = (2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 20.0, 30.0, 50.0, 82.0)  # of the top view, metres
# metres between rings, up to a reach
RING_STEPS = ((6.0, 1.0), (12.0, 2.0), (30.0, 5.0), (82.0, 20.0))
SHIFT = 4  # binary digits of a pixel's fraction, as OpenCV counts them
MARGIN = 1.1  # a picture is so many times larger than what it shows
# of a sweep in its picture, pixels
LEFT = 44
TOP = 12
RIGHT = 388
BOTTOM = 255

# greys and colours, blue first
SECTOR = (246, 246, 246)
CIRCLE = (217, 217, 217)
GREY = (138, 138, 138)
DARK = (51, 51, 51)
EMPTY = (238, 238, 238)  # where there is no range
DOT = tuple(int(COLORS["lrf"][i : i + 2], 16) for i in (5, 3, 1))


def write(image, text, u, v):
    """Small grey text about a pixel."""
    font = cv2.FONT_HERSHEY_SIMPLEX
    scale = 0.36
    (width, height), _ = cv2.getTextSize(text, font, scale, 1)
    corner = round(u - width / 2), round(v + height / 2)
    cv2.putText(image, text, corner, font, scale, GREY, 1, cv2.LINE_AA)


def scan_picture(ranges, bearings, field_of_view):
    """A scan from above, the laser range finder below.

    Parameters
    ----------
    ranges, bearings : array_like, shape (B,)
        Metres, NaN for none; radians.
    field_of_view : tuple of float
        First and last bearing, radians.

    Returns
    -------
    ndarray of uint8, shape (300, 400, 3)
        Blue, green, red.
    """
    points = polar_to_points(np.asarray(ranges, float), bearings)[:, :2]
    points = points[np.isfinite(points).all(axis=1)]
    reach = _reach(points)
    angle = np.linspace(*field_of_view, 91)
    border = reach * np.column_stack([np.cos(angle), np.sin(angle)])

    low = min(0.0, border[:, 1].min())
    high = border[:, 1].max()
    wide = PICTURE[0] / 2 / np.abs(border[:, 0]).max()
    scale = min(PICTURE[1] / (high - low), wide) / MARGIN  # pixels a metre
    origin = np.array(PICTURE) / 2 - 0.5 + [0, scale * (low + high) / 2]

    def pixels(points):
        """Fixed-point pixels of points in metres."""
        return np.rint((origin + [scale, -scale] * np.asarray(points)) * 2**SHIFT).astype(int)

    image = np.full((PICTURE[1], PICTURE[0], 3), 255, np.uint8)
    cv2.fillPoly(image, [pixels([(0, 0), *border])], SECTOR, cv2.LINE_AA, SHIFT)
    step = next(step for most, step in RING_STEPS if reach <= most)
    for radius in np.arange(step, reach + 1e-6, step):
        ring = pixels(border * radius / reach)
        cv2.polylines(image, [ring], False, CIRCLE, 1, cv2.LINE_AA, SHIFT)
        if radius < reach:
            u, v = ring[0] / 2**SHIFT
            write(image, f"{radius:g} m", u + 14, v + 8)
    arrow = pixels(np.array([(-6, -5), (6, -5), (0, 7)]) / scale)
    cv2.fillPoly(image, [arrow], DARK, cv2.LINE_AA, SHIFT)
    for pixel in pixels(points).tolist():
        cv2.circle(image, pixel, 2 << SHIFT, DOT, -1, cv2.LINE_AA, SHIFT)
    return image


def _reach(points):
    """How far a top view reaches: nine of ten points (n, 2) are nearer; metres."""
    far = 0.0
    if len(points):
        far = np.percentile(np.linalg.norm(points, axis=1), 90)
    return next((reach for reach in REACHES if reach >= far), REACHES[-1])


def sweep_picture(rows, bearings, field_of_view, pitch, step):
    """A sweep as it grows: ranges as colours, near is bright, grey where there is none.

    Bearing grows to the left as in the scene, pitch upwards.

    Parameters
    ----------
    rows : dict of float to ndarray, shape (B,)
        Ranges (metres) by pitch (radians).
    bearings : ndarray, shape (B,)
        Radians.
    field_of_view, pitch : tuple of float
        Their ends, radians.
    step : float
        Radians between scan lines, of a continuous sweep the most between two.

    Returns
    -------
    ndarray of uint8, shape (300, 400, 3)
        Blue, green, red.
    """
    half = np.degrees(step) / 2
    across = np.degrees([max(field_of_view), min(field_of_view)])
    down = np.array([np.degrees(max(pitch)) + half, np.degrees(min(pitch)) - half])
    image = _axes(across, down)
    if not rows:
        return image

    shades = _shades(np.array(list(rows.values())))
    width = RIGHT - LEFT
    height = BOTTOM - TOP
    u = (np.arange(width) + 0.5) / width
    v = (np.arange(height) + 0.5) / height
    bearing = np.interp(u, (0, 1), across)
    beam = np.rint(np.interp(bearing, np.degrees(bearings), np.arange(len(bearings)))).astype(int)
    away = np.abs(np.interp(v, (0, 1), down)[:, None] - np.degrees(list(rows)))
    covered = away.min(axis=1) <= half + np.ptp(down) / height
    nearest = away.argmin(axis=1)[covered]
    image[TOP:BOTTOM, LEFT:RIGHT][covered] = shades[nearest][:, beam]
    return image


def _axes(across, down):
    """The empty picture of a sweep, with the bearings and pitches (degrees) of its ends."""
    image = np.full((PICTURE[1], PICTURE[0], 3), 255, np.uint8)
    image[TOP:BOTTOM, LEFT:RIGHT] = EMPTY
    for share in (0, 0.5, 1):
        bearing = np.interp(share, (0, 1), across)
        pitch = np.interp(share, (0, 1), down)
        write(image, f"{bearing:.0f}", LEFT + share * (RIGHT - LEFT), BOTTOM + 12)
        write(image, f"{pitch:.0f}", LEFT - 18, TOP + share * (BOTTOM - TOP))
    write(image, "bearing [deg]", (LEFT + RIGHT) / 2, BOTTOM + 30)
    write(image, "pitch [deg]", 32, BOTTOM + 30)
    return image


def _shades(ranges):
    """Colours (L, B, 3) of ranges (L, B): near is bright, none is grey."""
    known = np.isfinite(ranges)
    low = 0.0
    high = 1.0
    if known.any():
        low, high = np.percentile(ranges[known], [2, 90])
    scaled = (np.nan_to_num(ranges, nan=high) - low) / max(high - low, 0.1)
    brightness = (255 * (1 - np.clip(scaled, 0, 1))).astype(np.uint8)
    colours = cv2.applyColorMap(brightness, cv2.COLORMAP_VIRIDIS).reshape(*ranges.shape, 3)
    return np.where(known[..., None], colours, np.uint8(EMPTY))


def png(image):
    """Bytes of a PNG file."""
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes()


def jpeg(image, width):
    """Bytes of a JPEG file of an image (BGR), not wider than so many pixels."""
    scale = width / image.shape[1]
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
