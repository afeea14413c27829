"""The printed chessboard in an image: its inner corners at sub-pixel level, and their orders."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates, spline_filter
from scipy.spatial.distance import cdist

from lrfcal_lib.fit.robust import rms
from lrfcal_lib.model.board import Chessboard
from lrfcal_lib.model.geometry import length_of

# larger images are searched at a reduced size: the detectors' time grows with it
SEARCH_PIXELS = 1.5e6
# half window around a corner, squares; the outermost squares of some boards are cut to 0.65
REACH = 0.5
WIDEST_WINDOW_PX = 15.0  # half window where squares are large, but for
LEAST_REACH = 0.25  # of a square: large images are soft
MARGIN = 2.0  # half windows around the corners: what a turned window and its blur reach
REFINE_ROUNDS = 20
CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
# looks at a picture of twice the size, for small squares, at four times the time
TWICE_AS_LARGE = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
FARTHEST_MOVE = 0.25  # of a square, in each look
# around rough corners where sectors are looked for near by: share of their extent, pixels
AROUND = 0.22
AROUND_PX = 4
SMOOTH_ENOUGH_PX = 0.07  # corners that fit a smooth grid this well need no second start
BEYOND = 0.3  # where to look outside the outermost corners, squares
LEAST_BEYOND = 0.25  # contrast there, a share of that inside
SMALL_SQUARE_PX = 9.0  # below it the blur of a corner reaches into the squares behind
# Scale common to all images of rendered boards with cut outermost squares. Blurred by 0.5 to 1 px
# it is right within 0.02 % from 5 px a square on; blurred by 1.5 px it is 0.09 % too large at 6 px
# (along the shorter side), 0.02 % at 8 px, below 0.003 % at 10 px. Nobody states the blur of an
# image.
SCALE_ERROR = 0.001
SCALE_ERROR_AT_PX = 6.0
SCALE_ERROR_POWER = 6
LARGEST_SCALE_ERROR = 0.01


@dataclass(frozen=True)
class Look:
    """How windows around corners are compared with themselves."""

    blur: float  # of the half window
    samples: int  # across a window
    order: int  # of the splines between pixels
    settled_px: float  # no corner moves by more: done


# rough corners need the wide blur; the narrow one then has less noise (0.20 px in lms400_zed, not
# 0.25)
ROUGHLY = Look(blur=0.3, samples=9, order=1, settled_px=0.05)
FINELY = Look(blur=0.1, samples=17, order=3, settled_px=1e-3)


class PatternNotFound(ValueError):
    """The image does not show the whole printed pattern."""


def grey(image) -> np.ndarray:
    """8-bit grey image of a grey or BGR image.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)

    Returns
    -------
    ndarray of uint8, shape (h, w)
    """
    if image.ndim == 2:
        return image
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


class PatternFinder:
    """Finds the inner corners of a chessboard in images; remembers whether its squares are dark on
    light.

    Parameters
    ----------
    pattern : Chessboard

    Notes
    -----
    OpenCV's detectors only tell where the corners roughly are: the classic one (it wants dark
    squares on a light ground, so it looks into the negative as well), then the sector-based one
    (Duda and Frese 2018), whose own corners are off by up to 0.6 % in scale below 30 px a square.
    Both look at a reduced picture where the image is large; :func:`refine_corners` looks at the
    image itself.
    """

    def __init__(self, pattern: Chessboard):
        self.size = pattern.columns, pattern.rows
        self.negative = False

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """The corners in an image, x right, y down on the printed side.

        A chessboard looks the same when it is turned by 180 deg:
        :mod:`lrfcal_lib.preprocess.survey` resolves that.

        Parameters
        ----------
        image : ndarray of uint8, shape (h, w) or (h, w, 3)

        Returns
        -------
        ndarray, shape (columns * rows, 2)
            Recorded pixels.

        Raises
        ------
        PatternNotFound
            Where no detector finds all corners.
        """
        grid = self._in_reduced(grey(image))
        if grid is None:
            columns, rows = self.size
            raise PatternNotFound(
                f"no chessboard with {columns} x {rows} inner corners in the image: it must be "
                "whole, and not glare"
            )
        if np.linalg.det(square_axes(grid)).mean() <= 0:
            grid = grid[::-1]  # of a mirrored image
        return grid.reshape(-1, 2)

    def _in_reduced(self, picture):
        """Grid of corners of a large picture by way of a reduced one, or without it where that
        shows none.
        """
        times = int(np.ceil(np.sqrt(picture.size / SEARCH_PIXELS)))
        if times <= 1:
            return self._search(picture)
        share = 1 / times
        reduced = cv2.resize(
            picture, None, fx=share, fy=share, interpolation=cv2.INTER_AREA
        )
        grid = self._search(reduced)
        if grid is None:
            return self._search(picture, thorough=False)
        # pixel (0, 0) is the centre of a pixel, of the reduced one as well
        return refine_corners(picture, (grid + 0.5) * times - 0.5)

    def _search(self, picture, thorough=True):
        """Grid of refined corners, None where there are none; `thorough` costs most.

        From sectors near by where rough corners were too far off for their windows.
        """
        rough = self._rough(picture, thorough)
        if rough is None:
            return None
        grid = refine_corners(picture, rough)
        if grid_noise(grid) > SMOOTH_ENOUGH_PX:
            low, place = around(rough, AROUND * np.ptp(rough, axis=(0, 1)) + AROUND_PX)
            part = picture[place].copy()
            start = _detected(cv2.findChessboardCornersSB, part, self.size, 0)
            if start is not None:
                grid = min(grid, refine_corners(picture, start + low), key=grid_noise)
        return grid if _ends_in_squares(picture, grid) else None

    def _rough(self, picture, thorough):
        """Grid of rough corners by the first of OpenCV's detectors that finds them, or None: the
        last successful of picture and negative first.
        """
        # the quick check overlooks white squares on a dark board, and saves little time there
        ways = [
            (cv2.findChessboardCorners, picture, CLASSIC | cv2.CALIB_CB_FAST_CHECK),
            (cv2.findChessboardCorners, 255 - picture, CLASSIC),
        ]
        if self.negative:
            ways.reverse()
        ways.append((cv2.findChessboardCornersSB, picture, 0))
        if thorough:
            ways.append((cv2.findChessboardCornersSB, picture, TWICE_AS_LARGE))
        for detector, shown, flags in ways:
            grid = _detected(detector, shown, self.size, flags)
            if grid is not None:
                self.negative = shown is not picture
                return grid
        return None


def _detected(detector, picture, size, flags):
    """Corners of a detector as (rows, columns, 2), None where it finds none."""
    try:
        found, corners = detector(picture, size, flags=flags)
    except cv2.error:  # some images a few pixels wide are too narrow for its thresholds
        return None
    return corners.reshape(*size[::-1], 2).astype(float) if found else None


def around(corners, margin):
    """The part of an image about corners (rows, columns, 2) with a margin in pixels: its first
    pixel (2,), and its rows and columns.
    """
    low = np.maximum(corners.min(axis=(0, 1)) - margin, 0).astype(int)
    high = (corners.max(axis=(0, 1)) + margin).astype(int)
    columns, rows = map(slice, low, high)
    return low, (rows, columns)


def grid_noise(grid):
    """Root mean square distance of a chessboard's corners from a smooth grid, pixels.

    Smooth are a homography and polynomials of third order (second below 16 corners): lens
    distortion, a bent sheet.
    """
    rows, columns, _ = grid.shape
    flat = np.mgrid[:columns, :rows].T.reshape(-1, 2).astype(float)
    corners = grid.reshape(-1, 2)
    homography = cv2.findHomography(flat, corners)[0]
    left = corners - cv2.perspectiveTransform(flat[None], homography)[0]
    order = 3 if len(flat) >= 16 else 2
    x, y = flat.T
    design = [x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)]
    design = np.stack(design, axis=1)
    noise = left - design @ np.linalg.lstsq(design, left)[0]
    return rms(length_of(noise))


def refine_corners(picture, start):
    """Corners of a chessboard: the points about which the picture is symmetric.

    A window turned by 180 deg about a corner looks the same, however blurred. The least squares of
    what differs need no edges, which `cv2.cornerSubPix` does: small squares have none. The window
    is that of the printed squares, not of the pixels, and falls to zero half a square away: it
    never reaches the rim of the pattern, however the outermost squares are cut.

    Parameters
    ----------
    picture : ndarray of uint8, shape (h, w)
    start : ndarray, shape (rows, columns, 2)
        Pixels; good to a quarter of a square.

    Returns
    -------
    ndarray, shape (rows, columns, 2)
        A corner that would move farther stays where it started.
    """
    side = np.linalg.norm(square_axes(start), axis=-2)  # (rows, columns, 2), pixels
    longest = side.max(axis=-1, keepdims=True)
    reach = np.clip(WIDEST_WINDOW_PX / longest, LEAST_REACH, REACH)  # squares
    low, place = around(start, int(MARGIN * np.max(reach * longest)) + 3)
    part = picture[place].astype(np.float32)
    half_window = np.median(reach * side)
    kept = start - low
    for look in (ROUGHLY, FINELY):
        smooth = cv2.GaussianBlur(part, (0, 0), look.blur * half_window)
        refined = symmetric_points(smooth, kept, reach, look)
        moved = np.linalg.norm(refined - kept, axis=-1, keepdims=True)
        kept = np.where(moved < FARTHEST_MOVE * longest, refined, kept)
    return kept + low


def symmetric_points(picture, points, reach, look):
    """Points of a grid (rows, columns, 2) about which windows of `reach` squares are symmetric."""
    place = np.linspace(-1, 1, look.samples)
    half = place[look.samples // 2 + 1 :]  # the other half is what it is compared with
    offsets = np.stack(np.meshgrid(half, place)).reshape(2, -1)
    weight = np.prod((1 - offsets**2) ** 2, axis=0)
    spline = spline_filter(picture, look.order, np.float32) if look.order > 1 else picture
    slopes = np.gradient(picture, axis=(1, 0))
    for _ in range(REFINE_ROUNDS):
        axes = square_axes(points) * reach[..., None]
        arms = (axes @ offsets).mT  # (rows, columns, m, 2)
        middle = points[..., None, :]
        pairs = np.stack([middle + arms, middle - arms])
        differs = np.subtract(*interpolated(spline, pairs, look.order))
        by_place = [np.subtract(*interpolated(slope, pairs)) for slope in slopes]
        jacobian = np.stack(by_place, axis=-1)
        weighted = (weight[:, None] * jacobian).mT
        inverse = np.linalg.pinv(weighted @ jacobian, hermitian=True)
        step = -np.matvec(inverse, np.matvec(weighted, differs))
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        # a third of the window at most: farther away other corners begin
        most = np.linalg.norm(axes, axis=-2).min(axis=-1, keepdims=True) / 3
        points = points + step * np.minimum(1, most / np.maximum(length, most))
        if length.max() < look.settled_px:
            break
    return points


def interpolated(picture, places, order=1):
    """A picture, or its splines of an order, at places (..., 2), pixels."""
    rows_first = np.moveaxis(places, -1, 0)[::-1]
    return map_coordinates(
        picture, rows_first, order=order, prefilter=False, mode="nearest"
    )


def square_axes(grid):
    """Sides of the squares around every corner of a grid (rows, columns, 2): along a row, along a
    column, as columns (rows, columns, 2, 2).
    """
    return np.stack(np.gradient(grid, axis=(1, 0)), axis=-1)


def square_px(grid):
    """Mean side of a chessboard's squares in an image along the shorter of its two axes, pixels.

    Corners (rows, columns, 2) that are NaN do not count.
    """
    sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=2) for axis in (0, 1)]
    return min(np.nanmean(side) for side in sides)


def scale_error(side_px):
    """Standard deviation, a share, of the scale of corners whose squares have a side in pixels."""
    error = SCALE_ERROR * (SCALE_ERROR_AT_PX / side_px) ** SCALE_ERROR_POWER
    return min(LARGEST_SCALE_ERROR, error)


def _ends_in_squares(picture, grid):
    """Whether squares alternate outside the outermost corners: not where a pattern that is cut
    is taken a row off.
    """
    last = np.array(picture.shape[::-1]) - 1
    picture = picture.astype(float)
    for turns in range(4):
        outermost = np.rot90(grid, turns)[:2]
        edge, inner = (outermost[:, 1:] + outermost[:, :-1]) / 2
        away = BEYOND * (inner - edge)
        places = np.array([edge - away, edge + away])
        visible = np.all((places >= 0) & (places <= last), axis=(0, 2))
        # from square to square
        outside, inside = np.diff(interpolated(picture, places[:, visible]))
        if outside @ inside > -LEAST_BEYOND * (inside @ inside):
            return False
    return True


def pattern_orders(pattern: Chessboard, mirrored: bool = True) -> np.ndarray:
    """Orders of the corners that a chessboard allows.

    Parameters
    ----------
    pattern : Chessboard
    mirrored : bool
        Add a second half that counts from the last row: x to y turns the other way (frames whose z
        points out).

    Returns
    -------
    ndarray of int, shape (n, k)
        Indices into the corners of an image. The first order is the given one, the second the
        pattern turned by 180 deg; square patterns may also stand on their side.
    """
    grid = np.arange(pattern.rows * pattern.columns).reshape(pattern.rows, pattern.columns)
    orders = [grid, np.rot90(grid, 2)]
    if pattern.rows == pattern.columns and mirrored:
        orders += [np.rot90(grid, 3), np.rot90(grid)]
    if mirrored:
        orders += [order[::-1] for order in orders]
    return np.stack([order.ravel() for order in orders])


def spread_views(pixels, count: int) -> list:
    """The views of a pattern that differ most: all, or the largest and then so many others.

    Each of those is the one whose corners lie farthest from those of all views before it.

    Parameters
    ----------
    pixels : list of ndarray, shape (k, 2)
        Corners by view.
    count : int
        At most.

    Returns
    -------
    list of ndarray, shape (k, 2)
    """
    if len(pixels) <= count:
        return pixels
    pixels = np.asarray(pixels, float)
    flat = pixels.reshape(len(pixels), -1)
    apart = cdist(flat, flat)
    size = np.ptp(pixels, axis=1).prod(axis=1)
    chosen = [np.argmax(size)]
    while len(chosen) < count:
        chosen.append(apart[:, chosen].min(axis=1).argmax())
    return [pixels[i] for i in chosen[:count]]
