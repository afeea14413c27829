"""Straight edges in an image at sub-pixel level: profiles across, votes, a robust line."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from lrfcal_lib.fit.robust import biweight, robust_sigma
from lrfcal_lib.model.camera import CameraModel, line_through, pinhole, redistort
from lrfcal_lib.model.geometry import length_of

ACROSS_STEP_PX = 0.5  # sampling of a profile
AVERAGED_PROFILES = 5  # along the edge
SMOOTH_PX = 1.0  # of the derivative of a Gaussian across the edge
MARGIN_PX = 4.0  # beyond where an edge is looked for: what its smooth derivative needs
LEAST_CONTRAST = 6.0  # grey levels (norm over the colours) that make a step
LEAST_SUPPORT = 0.45  # share of the profiles that must agree on one line
LEAST_SHARE = 0.2  # of the edge that must lie inside the image
LEAST_PROFILES = 25
# of a line at its centre, whatever the number of profiles: rims, paint and optics
SYSTEMATIC_PX = 0.1
# grey levels: a step of this height counts half, cardboard and paint have weaker ones
FULL_CONTRAST = 30.0
PICK_SIGMA_PX = 1.0  # of a point clicked by hand
BEHIND = -1e6  # pixels; where points behind the camera are drawn
NEAR_PX = 2.0  # from the prediction: what must lie inside the image
LONGEST = 8  # times the image
SLOPES = 41  # of lines that are voted for
STEEPEST = 24  # samples from the middle of a line to its end
TOLERANCE_PX = 1.5  # from the line of most votes
FIT_ROUNDS = 12
LEAST_SIGMA_PX = 0.01
SETTLED_PX = 5e-8
# of the correlation of averaged profiles, which share pixels, whatever a short series says
LEAST_CORRELATION = 1.1 * AVERAGED_PROFILES
SOKAL = 3.0  # window of an integrated autocorrelation, in units of the latter


@dataclass(frozen=True)
class ImageEdge:
    """One straight edge of the board in one image, undistorted pixels.

    Attributes
    ----------
    name : str
        Edge of the board.
    line : ndarray, shape (3,)
        ``l0 u + l1 v + l2 = 0`` with the unit normal pointing out of the board.
    covariance : ndarray, shape (2, 2)
        Of the offset along the normal at `centre` (pixels) and of the angle (radians, turning the
        normal from u to v).
    centre : ndarray, shape (2,)
        Point of the line.
    ends : ndarray, shape (2, 2)
        Ends of the stretch that was really seen.
    """

    name: str
    line: np.ndarray
    covariance: np.ndarray
    centre: np.ndarray
    ends: np.ndarray


class EdgeNotSeen(ValueError):
    """An edge cannot be used in this image; the message is the reason."""


def refine_edge(
    image: np.ndarray,
    model: CameraModel,
    name: str,
    start: np.ndarray,
    end: np.ndarray,
    outward: np.ndarray,
    half_width: float,
    prior_px: float = np.inf,
) -> ImageEdge:
    """Find a straight edge near a predicted stretch.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    model : CameraModel
    name : str
        Of the edge.
    start, end : ndarray, shape (2,)
        Predicted ends, undistorted pixels.
    outward : ndarray, shape (2,)
        Any vector that points out of the board.
    half_width : float
        How far to both sides the edge is looked for, pixels.
    prior_px : float
        Standard deviation of the prediction: of two lines with similar support the nearer one is
        taken.

    Returns
    -------
    ImageEdge

    Raises
    ------
    EdgeNotSeen
        With the reason.
    """
    length = length_of(end - start)
    if not LEAST_PROFILES <= length < LONGEST * max(image.shape):
        raise EdgeNotSeen(f"its predicted length is {length:.0f} px")
    along = (end - start) / length
    normal = outward_line(start, end, outward)[:2]
    columns = np.arange(int(length) + 1)
    reach = half_width + MARGIN_PX
    across = np.arange(-reach, reach + ACROSS_STEP_PX, ACROSS_STEP_PX)
    on_edge = start + np.outer(columns, along)
    strip = sample(image, model, on_edge + across[:, None, None] * normal)
    visible = np.isfinite(strip[np.abs(across) <= NEAR_PX, :, 0]).all(axis=0).sum()
    if visible < max(LEAST_PROFILES, LEAST_SHARE * len(columns)):
        share = 100 * visible / len(columns)
        raise EdgeNotSeen(f"cut by the image border: {share:.0f}% of it inside the image")
    line, columns, misses = _line_in_strip(strip, visible, across, half_width, prior_px)
    stretch = np.array([columns.min(), columns.max(), columns.mean()])[:, None]
    first, last, centre = start + stretch * along + np.polyval(line, stretch) * normal
    return ImageEdge(
        name=name,
        line=outward_line(first, last, normal),
        covariance=_line_covariance(columns, misses),
        centre=centre,
        ends=np.stack([first, last]),
    )


def picked_edge(name: str, ends: np.ndarray, inner: np.ndarray) -> ImageEdge:
    """The edge through two points clicked by hand.

    Parameters
    ----------
    name : str
    ends : ndarray, shape (2, 2)
        Undistorted pixels; ValueError where they are the same.
    inner : ndarray, shape (2,)
        A point of the board, likewise.

    Returns
    -------
    ImageEdge
    """
    length = length_of(ends[1] - ends[0])
    centre = ends.mean(axis=0)
    return ImageEdge(
        name=name,
        line=outward_line(ends[0], ends[1], centre - inner),
        covariance=PICK_SIGMA_PX**2 * np.diag([0.5, 2 / length**2]),
        centre=centre,
        ends=ends,
    )


def sample(image: np.ndarray, model: CameraModel, uv: np.ndarray) -> np.ndarray:
    """Colours (..., channels) at undistorted pixels (..., 2), bilinear; NaN outside the image.

    `cv2.remap` rounds positions to 1/32 px: a bias for lines along the pixel grid.
    """
    recorded = np.nan_to_num(redistort(uv, model), nan=BEHIND)
    places = np.moveaxis(recorded, -1, 0)[::-1]
    channels = np.moveaxis(np.atleast_3d(image), -1, 0)
    colours = [
        map_coordinates(channel, places, np.float32, order=1, cval=np.nan)
        for channel in channels
    ]
    return np.stack(colours, axis=-1)


def vote(column, place, weight, shape, slopes):
    """Weight of the profiles with a peak near each line ``place = offset + slope (column -
    middle)``, (m, across).

    `shape` is (across, along) of the strip; a sample to either side still agrees, and of the peaks
    of one profile that agree with a line the highest counts.
    """
    across, along = shape
    order = np.argsort(weight)
    leaning = slopes[:, None] * (column[order] - (along - 1) / 2)
    first = np.rint(place[order] - leaning).astype(int)
    rows = np.clip(
        first[..., None] + np.arange(3), 0, across + 1
    )  # a row beyond either border
    lines = np.arange(len(slopes))[:, None, None]
    # of peaks in one place the last one, the highest, stays
    highest = np.zeros((len(slopes), across + 2, along))
    highest[lines, rows, column[order, None]] = weight[order, None]
    return highest[:, 1:-1].sum(axis=2)


def step_contrast(strip, sigma, along=AVERAGED_PROFILES):
    """Height of the step at every place of a strip (across, along, channels), grey levels.

    0 where it leaves the image. Derivative of a Gaussian of `sigma` samples across the edge, of
    `along` averaged profiles, norm over the colours.
    """
    wide = int(4 * sigma + 0.5)
    bell = cv2.getGaussianKernel(2 * wide + 1, sigma)[:, 0]
    slope = np.arange(-wide, wide + 1) / sigma * bell * np.sqrt(2 * np.pi)
    mean = np.full(along, 1 / along)
    filled = np.nan_to_num(strip)
    steps = cv2.sepFilter2D(filled, cv2.CV_32F, mean, slope, borderType=cv2.BORDER_REFLECT)
    height = length_of(steps.reshape(strip.shape))
    gone = np.isnan(strip[..., 0]).astype(np.uint8)
    reach = int(np.ceil(2 * sigma))
    height[cv2.dilate(gone, np.ones((2 * reach + 1, along), np.uint8)) > 0] = 0
    return height


def peaks(height, least=LEAST_CONTRAST):
    """Local maxima of the step height by profile: column, place across, contrast.

    The place is that of a parabola through three samples.
    """
    windows = np.stack([height[:-2], height[1:-1], height[2:]])
    low, mid, high = windows
    column, row = np.nonzero(((mid >= low) & (mid > high) & (mid > least)).T)
    a, b, c = windows[:, row, column]
    return column, row + 1 + 0.5 * (a - c) / (a - 2 * b + c), b


def outward_line(a, b, outward):
    """Pixel (or board) line through two points whose unit normal points to one side."""
    line = line_through(a, b)
    return line if line[:2] @ outward > 0 else -line


def on_board(xy, pose, model):
    """Undistorted pixels of points (..., 2) of the board.

    Far outside the image where they lie behind the camera.
    """
    points = pose.apply(np.insert(xy, 2, 0.0, axis=-1))
    return np.nan_to_num(pinhole(points, model), nan=BEHIND)


def _line_in_strip(strip, visible, across, half_width, prior_px):
    """The line of most votes in a strip (across, along, channels): its slope and offset, pixels
    from the prediction, the columns of the peaks that it goes through, and how far it misses them.
    """
    height = step_contrast(strip, SMOOTH_PX / ACROSS_STEP_PX)
    count = height.shape[1]
    column, place, contrast = peaks(height)
    widest = min(half_width / ACROSS_STEP_PX, STEEPEST)
    slopes = np.linspace(-1, 1, SLOPES) * widest / count * 2
    weight = contrast / (contrast + FULL_CONTRAST)
    votes = vote(column, place, weight, height.shape, slopes)
    # the prediction is as uncertain at either end as it is in the middle
    tilted = slopes[:, None] * ACROSS_STEP_PX * count / 2
    likely = np.exp(-0.5 * (across**2 + tilted**2) / prior_px**2)
    allowed = (np.abs(across) <= half_width) * likely
    turned, at = np.unravel_index(np.argmax(votes * allowed), votes.shape)
    slope = ACROSS_STEP_PX * slopes[turned]
    offset = across[at] - slope * (count - 1) / 2
    places = across[0] + ACROSS_STEP_PX * place
    line, columns, misses = _fit_line(column, places, (slope, offset))
    support = len(np.unique(columns)) / visible
    if support < LEAST_SUPPORT:
        raise EdgeNotSeen(
            f"no clear edge: {100 * support:.0f}% of the profiles agree on a line"
        )
    return line, columns, misses


def _fit_line(column, place, line):
    """Robust line (slope, offset) through the peaks near a start line (Tukey's biweight), their
    columns and residuals.
    """
    for _ in range(FIT_ROUNDS):
        residuals = place - np.polyval(line, column)
        near = np.abs(residuals) < TOLERANCE_PX
        if near.sum() < LEAST_PROFILES:
            raise EdgeNotSeen(f"no clear edge: {near.sum()} profiles agree on a line")
        sigma = robust_sigma(residuals[near], least=LEAST_SIGMA_PX)
        weight = np.where(near, biweight(residuals, sigma), 0)
        before = line
        line = np.polyfit(column, place, 1, w=np.sqrt(weight))
        if np.abs(line - before).max() <= SETTLED_PX:
            break
    kept = weight > 0
    return line, column[kept], (place - np.polyval(line, column))[kept]


def _line_covariance(column, residuals):
    """Covariance (2, 2) of the offset of a line at the middle of its points, and of its slope.

    Neighbouring profiles share pixels and the same dents, so errors are correlated along the edge;
    the covariance is multiplied by the integrated autocorrelation of the residuals.
    """
    count = len(column)
    variance = residuals @ residuals / (count - 2)
    variance *= max(_correlation_factor(column, residuals), LEAST_CORRELATION)
    noise = variance / count * np.array([1.0, 1 / np.var(column)])
    systematic = SYSTEMATIC_PX**2 * np.array([1.0, 12 / np.ptp(column) ** 2])
    return np.diag(noise + systematic)


def _correlation_factor(column, residuals):
    """Integrated autocorrelation of residuals along the edge, ``1 + 2 sum rho``."""
    place = column - column.min()
    series, present = np.zeros((2, place.max() + 1))
    series[place] = residuals
    present[place] = 1.0
    products, pairs = (
        np.correlate(values, values, "full")[place.max() :] for values in (series, present)
    )
    mean_product = products / np.maximum(pairs, 1)
    rho = mean_product / max(mean_product[0], 1e-300)
    # a line was taken out: the residuals of white noise already sum to about -1, so no further
    # correction is needed
    total = 2 * np.cumsum(rho[: len(rho) // 3]) - 1
    wide = np.arange(len(total)) >= SOKAL * total
    wide[-1] = True
    return total[wide.argmax()]
