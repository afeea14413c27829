"""Pictures of the data collection panel: a scan from above, a sweep as it grows, camera images."""

import cv2
import numpy as np
from numpy.typing import ArrayLike

from lrfcal_lib.model.geometry import polar_to_points
from lrfcal_lib.plots.colors import COLORS

WIDTH = 400  # of a picture, pixels
HEIGHT = 300
REACHES = (2.0, 4.0, 8.0, 12.0, 20.0, 40.0, 80.0, 120.0)  # of the top view, metres
RINGS = 4  # of the top view
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
DOT = tuple(reversed(bytes.fromhex(COLORS["lrf"][1:])))


def scan_picture(
    ranges: ArrayLike, bearings: ArrayLike, field_of_view: tuple[float, float]
) -> np.ndarray:
    """A scan from above, the laser range finder below.

    Parameters
    ----------
    ranges
        (B,), metres, NaN for none.
    bearings
        (B,), radians.
    field_of_view
        First and last bearing, radians.

    Returns
    -------
    ndarray of uint8, shape (300, 400, 3)
        Blue, green, red.
    """
    points = polar_to_points(np.asarray(ranges, float), bearings)[:, :2]
    points = points[np.isfinite(points).all(axis=1)]
    far = 0.0  # of nine of ten points
    if len(points):
        far = np.percentile(np.linalg.norm(points, axis=1), 90)
    reach = next((reach for reach in REACHES if reach >= far), REACHES[-1])
    border = polar_to_points(np.full(91, reach), np.linspace(*field_of_view, 91))[:, :2]

    low = min(0.0, border[:, 1].min())
    high = border[:, 1].max()
    across = 2 * np.abs(border[:, 0]).max()
    scale = min(HEIGHT / (high - low), WIDTH / across) / MARGIN  # pixels a metre
    origin = np.array([WIDTH, HEIGHT + scale * (low + high)]) / 2 - 0.5

    def pixels(points):
        """Fixed-point pixels of points in metres."""
        return np.rint((origin + [scale, -scale] * points) * 2**SHIFT).astype(int)

    image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    cv2.fillPoly(
        image, [pixels(np.vstack([np.zeros(2), border]))], SECTOR, cv2.LINE_AA, SHIFT
    )
    for share in np.linspace(0, 1, RINGS + 1)[1:]:
        ring = pixels(share * border)
        cv2.polylines(image, [ring], False, CIRCLE, 1, cv2.LINE_AA, SHIFT)
        if share < 1:
            u, v = ring[0] / 2**SHIFT
            write(image, f"{share * reach:g} m", u + 14, v + 8)
    arrow = pixels(np.array([(-6, -5), (6, -5), (0, 7)]) / scale)
    cv2.fillPoly(image, [arrow], DARK, cv2.LINE_AA, SHIFT)
    for pixel in pixels(points).tolist():
        cv2.circle(image, pixel, 2 << SHIFT, DOT, -1, cv2.LINE_AA, SHIFT)
    return image


def sweep_picture(
    rows: dict[float, np.ndarray],
    bearings: np.ndarray,
    field_of_view: tuple[float, float],
    pitch: tuple[float, float],
    step: float,
) -> np.ndarray:
    """A sweep as it grows: ranges as colours, near is bright, grey where there is none.

    Bearing grows to the left as in the scene, pitch upwards.

    Parameters
    ----------
    rows
        Ranges (B,), metres, by pitch, radians.
    bearings
        (B,), radians; not used without rows.
    field_of_view, pitch
        Their ends, radians.
    step
        Radians between scan lines, of a continuous sweep the most between two.

    Returns
    -------
    ndarray of uint8, shape (300, 400, 3)
        Blue, green, red.
    """
    half = np.degrees(step) / 2
    right, left = np.sort(np.degrees(field_of_view))
    low, high = np.sort(np.degrees(pitch)) + [-half, half]
    across = (left, right)
    down = (high, low)
    image = _axes(across, down)
    if not rows:
        return image

    shades = _shades(np.array(list(rows.values())))
    bearing = np.linspace(*across, RIGHT - LEFT)
    beam = np.rint(
        np.interp(bearing, np.degrees(bearings), np.arange(len(bearings)))
    ).astype(int)
    at = np.linspace(*down, BOTTOM - TOP)
    away = np.abs(at[:, None] - np.degrees(list(rows)))
    covered = away.min(axis=1) <= half + (high - low) / len(at)
    nearest = away.argmin(axis=1)[covered]
    image[TOP:BOTTOM, LEFT:RIGHT][covered] = shades[nearest][:, beam]
    return image


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
    inside = np.all((pixels >= 0) & (pixels < (width, height)), axis=1)
    colours = _shades(ranges[None])[0]
    for pixel, colour in zip(
        pixels[inside].round().astype(int), colours[inside], strict=True
    ):
        cv2.circle(drawn, pixel.tolist(), radius, colour.tolist(), -1, cv2.LINE_AA)
    return drawn


def write(image: np.ndarray, text: str, u: float, v: float) -> None:
    """Write small and grey.

    Parameters
    ----------
    image
        To be written to.
    text
        In plain letters.
    u, v
        Middle of the text, pixels.
    """
    font = cv2.FONT_HERSHEY_SIMPLEX
    scale = 0.36
    (width, height), _ = cv2.getTextSize(text, font, scale, 1)
    corner = round(u - width / 2), round(v + height / 2)
    cv2.putText(image, text, corner, font, scale, GREY, 1, cv2.LINE_AA)


def _axes(across, down):
    """The empty picture of a sweep, with the bearings and pitches (degrees) of its ends."""
    image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    image[TOP:BOTTOM, LEFT:RIGHT] = EMPTY
    bearings = np.linspace(*across, 3)
    for bearing, u in zip(bearings, np.linspace(LEFT, RIGHT, 3), strict=True):
        write(image, f"{bearing:.0f}", u, BOTTOM + 12)
    pitches = np.linspace(*down, 3)
    for pitch, v in zip(pitches, np.linspace(TOP, BOTTOM, 3), strict=True):
        write(image, f"{pitch:.0f}", LEFT - 18, v)
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


def png(image: np.ndarray) -> bytes:
    """Content of a PNG file.

    Parameters
    ----------
    image
        (height, width, 3), BGR.
    """
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes()


def jpeg(image: np.ndarray, width: int) -> bytes:
    """Content of a JPEG file.

    Parameters
    ----------
    image
        (height, width, 3), BGR.
    width
        Of the file at most, pixels.
    """
    scale = width / image.shape[1]
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
