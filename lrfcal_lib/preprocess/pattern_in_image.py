"""The printed chessboard in an image: its inner corners at sub-pixel level, and the orders that they may have."""

import cv2
import numpy as np

WINDOW_SHARE, WIDEST_WINDOW = 0.4, 15  # half window around a corner: of the shortest side of a square; pixels
SMOOTH_ENOUGH_PX = 0.07  # corners that fit a smooth grid this well need no second detector
BEYOND, LEAST_BEYOND = 0.3, 0.25  # where to look outside the outermost corners, squares; contrast there, of that inside


class PatternNotFound(ValueError):
    """The image does not show the whole printed pattern."""


def grey(image):
    """8-bit grey image of a grey or BGR image; ValueError for anything else."""
    image = np.asarray(image)
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.size == 0:
        raise ValueError(f"an image must be uint8 of shape (h, w) or (h, w, 3), got {image.dtype} {image.shape}")
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


class PatternFinder:
    """Finds the inner corners of a chessboard in images; remembers whether its squares are dark on light.

    Parameters
    ----------
    pattern : Chessboard

    Notes
    -----
    The classic detector tells where to look (it wants dark squares on a light ground: boards with white squares on a
    dark ground are looked for in the negative). Two detectors then compete on that part of the image: the sector-based
    one (Duda and Frese 2018; 0.14 px on real prints where `cornerSubPix` has 0.18 px, but 0.1 to 0.6 px on simulated
    images where the other has 0.05 px) and `cornerSubPix` with a wide window. The smoother grid is taken; the
    sector-based detector, which is slow, is not asked where the other's grid is as smooth as a print can be.
    """

    def __init__(self, pattern):
        self.size = pattern.columns, pattern.rows
        self.negatives = (False, True)

    def __call__(self, image):
        """Recorded pixels of the corners, shape (columns * rows, 2), x right and y down as seen from the printed side.

        A chessboard looks the same when it is turned by 180 deg: :mod:`lrfcal_lib.preprocess.survey` resolves that.
        PatternNotFound where no detector finds all corners; ValueError for what is no 8-bit image.
        """
        picture, size = grey(image), self.size
        for negative in self.negatives:
            rough = classic(picture, size, negative)
            if rough is not None:
                self.negatives = (negative, not negative)
                break
        corners = sectors(picture, size) if rough is None else _smoothest(picture, size, rough)
        if corners is None or not _ends_in_squares(picture, corners, size):
            looks_for = f"no chessboard with {size[0]} x {size[1]} inner corners"
            raise PatternNotFound(f"{looks_for} in the image: it must be whole, and not glare")
        grid = corners.reshape(size[1], size[0], 2)
        x, y = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
        clockwise = x[0] * y[1] - x[1] * y[0] > 0
        return (grid if clockwise else grid[::-1]).reshape(-1, 2)


def classic(picture, size, negative):
    """Rough corners (n, 2) by OpenCV's classic detector, also in the negative; None if there are none."""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    # the quick check for a chessboard overlooks white squares on a dark board, and saves little time there
    picture, flags = (255 - picture, flags) if negative else (picture, flags | cv2.CALIB_CB_FAST_CHECK)
    try:
        found, corners = cv2.findChessboardCorners(picture, size, flags=flags)
    except cv2.error:  # some images a few pixels wide are too narrow for its thresholds
        return None
    return corners.reshape(-1, 2) if found else None


def sectors(picture, size, flags=cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE):
    """Corners (n, 2) by OpenCV's sector-based detector; None if there are none."""
    found, corners = cv2.findChessboardCornersSB(picture, size, flags=flags)
    return corners.reshape(-1, 2).astype(float) if found else None


def _smoothest(picture, size, rough):
    """Of the corners of several sub-pixel detectors those whose grid has the least noise."""
    refined = _refined(picture, rough, size)
    noise = grid_noise(refined, size)
    if noise < SMOOTH_ENOUGH_PX:
        return refined
    low, high = rough.min(axis=0), rough.max(axis=0)
    margin = 0.22 * (high - low) + 4
    low, high = np.maximum(low - margin, 0).astype(int), np.minimum(high + margin, picture.shape[::-1]).astype(int)
    part = np.ascontiguousarray(picture[low[1] : high[1], low[0] : high[0]])
    found = sectors(part, size, cv2.CALIB_CB_ACCURACY)
    found = sectors(picture, size) if found is None else found + low
    if found is None:
        return refined
    candidates = [refined, found]
    if noise > 2 * grid_noise(found, size):
        # a rough corner was too far off for its window: the sectors are the better start
        candidates.append(_refined(picture, found, size))
    return min(candidates, key=lambda corners: grid_noise(corners, size))


def grid_noise(corners, size):
    """Root mean square distance of a chessboard's corners (row by row) from a smooth grid, pixels.

    Smooth are a homography and polynomials of third order (second below 16 corners): lens distortion, a bent sheet.
    """
    y, x = (np.mgrid[: size[1], : size[0]] / (max(size) - 1) * 2 - 1).reshape(2, -1)
    order = 3 if len(x) >= 16 else 2
    homography = cv2.findHomography(np.column_stack([x, y]), np.asarray(corners, float))[0]
    left = corners - cv2.perspectiveTransform(np.column_stack([x, y])[None], homography)[0]
    design = np.stack([x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)], axis=1)
    noise = left - design @ np.linalg.lstsq(design, left, rcond=None)[0]
    return float(np.sqrt(np.mean(np.sum(noise**2, axis=1))))


def _refined(picture, rough, size):
    grid = rough.reshape(size[1], size[0], 2)
    step = min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1))
    window = int(np.clip(WINDOW_SHARE * step, 2, WIDEST_WINDOW))
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
    return cv2.cornerSubPix(picture, rough.astype(np.float32).copy(), (window, window), (-1, -1), stop).astype(float)


def _ends_in_squares(picture, corners, size):
    """Whether squares alternate outside the outermost corners: not where a pattern that is cut is taken a row off."""
    grid = corners.reshape(size[1], size[0], 2)
    for side in (np.rot90(grid, k) for k in range(4)):
        edge, inner = (side[:2, 1:] + side[:2, :-1]) / 2
        both = np.array([edge - BEYOND * (inner - edge), edge + BEYOND * (inner - edge)])
        seen = np.all((both >= 0) & (both <= np.array(picture.shape[::-1]) - 1), axis=(0, 2))
        outside, inside = cv2.remap(picture, both.astype(np.float32), None, cv2.INTER_LINEAR)[:, seen].astype(float)
        sign = np.resize([1.0, -1.0], len(seen))[seen]
        sign -= sign.mean() if len(sign) else 0.0
        if (sign @ outside) * (sign @ inside) > -LEAST_BEYOND * (sign @ inside) ** 2:
            return False
    return True


def pattern_orders(pattern, mirrored=True):
    """Orders of the corners that a chessboard allows, shape (n, k): as indices into the corners that were found.

    The first is the given one, the second the pattern turned by 180 deg; square patterns may also stand on their side.
    With `mirrored`, the second half counts from the last row: x to y turns the other way (frames whose z points out).
    """
    grid = np.arange(pattern.rows * pattern.columns).reshape(pattern.rows, pattern.columns)
    orders = [grid, grid[::-1, ::-1]]
    if pattern.rows == pattern.columns and mirrored:
        quarter = grid[::-1].T
        orders += [quarter, quarter[::-1, ::-1]]
    if mirrored:
        orders += [order[::-1] for order in orders]
    return np.stack([order.ravel() for order in orders])


def spread_views(pixels, count):
    """Which views of a pattern (their corners, k by 2) differ most: at most `count` places, the largest view first.

    Each of the others is the one whose corners lie farthest from those of all views before it.
    """
    if not len(pixels):
        return []
    pixels = np.asarray(pixels, float)
    flat, size = pixels.reshape(len(pixels), -1), np.ptp(pixels, axis=1).prod(axis=1)
    chosen, nearest = [], np.full(len(flat), np.inf)
    while len(chosen) < min(count, len(flat)):
        chosen.append(int(np.argmax(nearest if chosen else size)))
        nearest = np.minimum(nearest, np.linalg.norm(flat - flat[chosen[-1]], axis=1))
        nearest[chosen[-1]] = -1.0
    return chosen
