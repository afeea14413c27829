"""Straight edges in an image at sub-pixel level: profiles, votes, a robust line fit; the wide search."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

from lrfcal_lib.model.camera import distort, pinhole

ACROSS_STEP_PX = 0.5  # sampling of a profile
AVERAGED_PROFILES = 5  # along the edge
SMOOTH_PX = 1.0  # of the derivative of a Gaussian across the edge
LEAST_CONTRAST = 6.0  # grey levels (norm over the colours) that make a step
LEAST_SUPPORT = 0.45  # share of the profiles that must agree on one line
LEAST_SHARE = 0.2  # of the edge that must lie inside the image
LEAST_PROFILES = 25
SYSTEMATIC_PX = 0.1  # of a line at its centre, whatever the number of profiles: rims, paint and optics
FULL_CONTRAST = 30.0  # grey levels: a step of this height counts half, cardboard and paint have weaker ones
PICK_SIGMA_PX = 1.0  # of a point clicked by hand


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
        Of the offset along the normal at `centre` (pixels) and of the angle (radians, turning the normal from u to v).
    centre : ndarray, shape (2,)
        Point of the line.
    ends : ndarray, shape (2, 2)
        Ends of the stretch that was really seen.
    n_points : int
        Profiles that the line was fitted to (2 for a pick).
    rms_px : float
    picked : bool
        True for an edge picked by hand.
    """

    name: str
    line: np.ndarray
    covariance: np.ndarray
    centre: np.ndarray
    ends: np.ndarray
    n_points: int
    rms_px: float
    picked: bool = False

    def sigma_at(self, uv):
        """Standard deviation of the line's offset at pixels along it.

        Parameters
        ----------
        uv : array_like, shape (..., 2)
            Undistorted pixels on (or near) the line.

        Returns
        -------
        ndarray, shape (...)
            Pixels.
        """
        # turning the normal by a moves the line at the position s along (-n1, n0) by -a s outwards
        lever = (np.asarray(uv, float) - self.centre) @ np.array([self.line[1], -self.line[0]])
        c = self.covariance
        return np.sqrt(c[0, 0] + 2 * lever * c[0, 1] + lever**2 * c[1, 1])


class EdgeNotSeen(ValueError):
    """An edge cannot be used in this image; the message is the reason."""


def sample(image, model, uv):
    """Colours at undistorted pixels, bilinear.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    model : CameraModel
    uv : ndarray, shape (..., 2)
        Undistorted pixels.

    Returns
    -------
    ndarray of float32, shape (..., channels)
        NaN outside the image.

    Notes
    -----
    `cv2.remap` rounds positions to 1/32 px: a bias for lines along the pixel grid, so the weights are computed here.
    """
    image = image.reshape(*image.shape[:2], -1)
    normalised = (uv - [model.cx, model.cy]) / [model.fx, model.fy]
    seen = distort(normalised, model.distortion) * [model.fx, model.fy] + [model.cx, model.cy]
    height, width, channels = image.shape
    inside = np.all((seen >= 0) & (seen < [width - 1, height - 1]), axis=-1) & _one_to_one(normalised, model)
    corner = np.floor(np.where(inside[..., None], seen, 0)).astype(np.intp)
    f = (np.where(inside[..., None], seen, 0) - corner).astype(np.float32)
    flat = image.reshape(-1, channels)
    at = corner[..., 1] * width + corner[..., 0]
    u, v = f[..., :1], f[..., 1:]
    top = flat[at] * (1 - u) + flat[at + 1] * u
    out = top * (1 - v) + (flat[at + width] * (1 - u) + flat[at + width + 1] * u) * v
    out[~inside] = np.nan
    return out


def _one_to_one(normalised, model):
    """Whether the radial distortion still grows there: far outside, it folds points back into the image."""
    r2 = np.sum(normalised**2, axis=-1)
    k1, k2, _, _, k5 = model.distortion
    return 1 + r2 * (3 * k1 + r2 * (5 * k2 + 7 * r2 * k5)) > 0


def step_contrast(strip, sigma, along=AVERAGED_PROFILES):
    """Height of the step at every place of a strip, from the derivative of a Gaussian across the edge.

    Parameters
    ----------
    strip : ndarray, shape (across, along, channels)
    sigma : float
        Of the Gaussian, samples.
    along : int
        Profiles averaged along the edge.

    Returns
    -------
    ndarray, shape (across, along)
        Norm over the colours, grey levels; 0 where the profile leaves the image.
    """
    gone = np.isnan(strip).any(axis=-1)
    filled = uniform_filter1d(np.where(gone[..., None], 0, strip), along, axis=1)
    slope = gaussian_filter1d(filled, sigma, axis=0, order=1)
    height = np.linalg.norm(slope, axis=-1) * sigma * np.sqrt(2 * np.pi)
    reach = int(np.ceil(2 * sigma))
    near_gone = cv2.dilate(gone.astype(np.uint8), np.ones((2 * reach + 1, along), np.uint8)) > 0
    return np.where(near_gone, 0, height)


def peaks(height, least=LEAST_CONTRAST):
    """Local maxima of the step height in every profile, to a fraction of a sample.

    Parameters
    ----------
    height : ndarray, shape (across, along)
    least : float
        Smallest step, grey levels.

    Returns
    -------
    column : ndarray of int, shape (n,)
    place : ndarray, shape (n,)
        Samples across.
    contrast : ndarray, shape (n,)
        Grey levels.
    """
    low, mid, high = height[:-2], height[1:-1], height[2:]
    row, column = np.nonzero((mid >= low) & (mid > high) & (mid > least))
    a, b, c = low[row, column], mid[row, column], high[row, column]
    return column, row + 1 + 0.5 * (a - c) / np.minimum(a - 2 * b + c, -1e-12), b


def vote(column, place, weight, shape, slopes, tolerance):
    """How many profiles agree on each line.

    Parameters
    ----------
    column, place, weight : ndarray, shape (n,)
        Peaks, and what each of them counts.
    shape : tuple of int
        (across, along) of the strip.
    slopes : array_like, shape (m,)
        Samples across per profile.
    tolerance : int
        Samples on either side that still agree.

    Returns
    -------
    ndarray, shape (m, across)
        Weight of the profiles with a peak near the line ``place = offset + slope (column - middle)``.
    """
    slopes = np.atleast_1d(slopes)
    across, along = shape
    out = np.zeros((len(slopes), across))
    for i, slope in enumerate(slopes):
        offset = np.rint(place - slope * (column - (along - 1) / 2)).astype(int)
        hit = np.zeros((across + 2 * tolerance + 1, along))
        good = (offset >= 0) & (offset < across)
        for shift in range(2 * tolerance + 1):
            np.maximum.at(hit, (offset[good] + shift, column[good]), weight[good])
        out[i] = hit[tolerance : tolerance + across].sum(axis=1)
    return out


def fit_line(column, place, offset, slope, tolerance, rounds=12):
    """Robust straight line through the peaks near a start line (Tukey's biweight), with its covariance.

    Parameters
    ----------
    column, place : ndarray, shape (n,)
    offset, slope : float
        Start: ``place = offset + slope column``.
    tolerance : float
        Half width of the band that may take part, samples.
    rounds : int

    Returns
    -------
    parameters : ndarray, shape (2,)
        Offset and slope.
    covariance : ndarray, shape (2, 2)
    kept : ndarray of bool, shape (n,)
    rms : float
        Of the kept peaks.

    Notes
    -----
    Neighbouring profiles share pixels and the same dents, so errors are correlated along the edge; the covariance is
    multiplied by the integrated autocorrelation of the residuals.
    """
    for _ in range(rounds):
        residual = place - offset - slope * column
        near = np.abs(residual) < tolerance
        if near.sum() < 3:
            return np.array([offset, slope]), np.full((2, 2), np.inf), near, np.inf
        scale = max(1.4826 * np.median(np.abs(residual[near])), 0.02)
        weight = np.where(near, np.clip(1 - (residual / (4.685 * scale)) ** 2, 0, None) ** 2, 0)
        design = np.column_stack([np.ones(len(column)), column])
        normal = design.T @ (design * weight[:, None])
        new = np.linalg.solve(normal, design.T @ (weight * place))
        done = np.allclose(new, [offset, slope], rtol=0, atol=1e-7)
        offset, slope = new
        if done:
            break
    kept = weight > 0
    residual = (place - offset - slope * column)[kept]
    variance = residual @ residual / max(kept.sum() - 2, 1)
    kept_normal = design[kept].T @ design[kept]
    # averaged profiles share pixels: their errors are correlated at least that much, whatever a short series says
    factor = max(correlation_factor(column[kept], residual), 1.1 * AVERAGED_PROFILES)
    covariance = np.linalg.inv(kept_normal) * variance * factor
    return np.array([offset, slope]), covariance, kept, float(np.sqrt(np.mean(residual**2)))


def correlation_factor(column, residual, window=3.0):
    """Integrated autocorrelation of residuals along the edge, ``1 + 2 sum rho``; gaps in the columns are allowed.

    Notes
    -----
    Sokal's window: lags are summed up to `window` times the integral itself. At least 1.
    """
    length = int(column.max() - column.min()) + 1
    series = np.zeros(length)
    seen = np.zeros(length)
    series[column - column.min()], seen[column - column.min()] = residual, 1.0
    size = 2 ** int(np.ceil(np.log2(2 * length)))
    power = np.fft.irfft(np.abs(np.fft.rfft(series, size)) ** 2, size)[:length]
    pairs = np.fft.irfft(np.abs(np.fft.rfft(seen, size)) ** 2, size)[:length]
    rho = power / np.maximum(pairs, 1) / max(power[0] / max(pairs[0], 1), 1e-300)
    # a line was taken out: the residuals of white noise already sum to about -1, so no further correction is needed
    total = 1 + 2 * np.cumsum(np.r_[0.0, rho[1 : length // 3]])
    stop = np.argmax(np.arange(len(total)) >= window * total) if np.any(np.arange(len(total)) >= window * total) else -1
    return float(max(total[stop], 1.0))


def refine_edge(image, model, name, start, end, outward, half_width, prior_px=np.inf):
    """Find a straight edge near a predicted stretch.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    model : CameraModel
    name : str
    start, end : array_like, shape (2,)
        Predicted ends, undistorted pixels.
    outward : array_like, shape (2,)
        Any vector that points out of the board.
    half_width : float
        The edge is searched this far to both sides, pixels.
    prior_px : float
        Standard deviation of the prediction: of two lines with similar support the nearer one is taken.

    Returns
    -------
    ImageEdge

    Raises
    ------
    EdgeNotSeen
        With the reason.
    """
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = np.linalg.norm(end - start)
    if not LEAST_PROFILES <= length < 8 * max(image.shape):
        raise EdgeNotSeen(f"its predicted length is {length:.0f} px")
    along = (end - start) / length
    normal = np.array([along[1], -along[0]])
    normal = normal * np.sign(normal @ outward)
    columns = np.arange(int(length) + 1)
    pad = 3 * SMOOTH_PX + 1
    across = np.arange(-half_width - pad, half_width + pad + ACROSS_STEP_PX, ACROSS_STEP_PX)
    uv = start + columns[None, :, None] * along + across[:, None, None] * normal
    strip = sample(image, model, uv)
    visible = int(np.isfinite(strip[np.abs(across) <= 2.0, :, 0]).all(axis=0).sum())
    if visible < max(LEAST_PROFILES, LEAST_SHARE * len(columns)):
        raise EdgeNotSeen(f"cut by the image border: {100 * visible / len(columns):.0f}% of it inside the image")
    height = step_contrast(strip, SMOOTH_PX / ACROSS_STEP_PX)
    fit = _line_in_strip(height, visible, across, half_width, prior_px)
    return _image_edge(name, fit, across, start, along, normal)


def _line_in_strip(height, visible, across, half_width, prior_px):
    column, place, contrast = peaks(height)
    slopes = np.linspace(-1, 1, 41) * min(half_width / ACROSS_STEP_PX, 24) / height.shape[1] * 2
    votes = vote(column, place, contrast / (contrast + FULL_CONTRAST), height.shape, slopes, tolerance=1)
    # the prediction is as uncertain at either end as it is in the middle
    tilted = slopes[:, None] * ACROSS_STEP_PX * height.shape[1] / 2
    allowed = (np.abs(across) <= half_width) * np.exp(-0.5 * (across**2 + tilted**2) / prior_px**2)
    best = np.unravel_index(np.argmax(votes * allowed), votes.shape)
    slope = slopes[best[0]]
    offset = best[1] - slope * (height.shape[1] - 1) / 2
    parameters, covariance, kept, rms = fit_line(column, place, offset, slope, tolerance=1.5 / ACROSS_STEP_PX)
    support = len(np.unique(column[kept])) / visible
    if support < LEAST_SUPPORT or kept.sum() < LEAST_PROFILES:
        raise EdgeNotSeen(f"no clear edge: {100 * support:.0f}% of the profiles agree on a line")
    return parameters, covariance, column[kept], rms


def _image_edge(name, fit, across, start, along, normal):
    """From the strip's coordinates (samples across, profiles along) to a pixel line."""
    parameters, covariance, columns, rms = fit
    middle = columns.mean()
    to_middle = np.array([[1.0, middle], [0.0, 1.0]])
    covariance = to_middle @ covariance @ to_middle.T * ACROSS_STEP_PX**2
    covariance[0, 0] += SYSTEMATIC_PX**2
    covariance[1, 1] += 12 * SYSTEMATIC_PX**2 / max(np.ptp(columns), 1) ** 2

    def point(column):
        return start + column * along + (across[0] + ACROSS_STEP_PX * (parameters @ [1.0, column])) * normal

    ends = np.stack([point(columns.min()), point(columns.max())])
    line = _outward_line(ends[0], ends[1], normal)
    # a slope ds moves the far end outwards; the angle turns the normal from u to v
    turn = -np.sign(along @ [-line[1], line[0]])
    covariance = covariance * np.outer([1, turn], [1, turn])
    return ImageEdge(name, line, covariance, point(middle), ends, len(columns), rms * ACROSS_STEP_PX)


def _outward_line(a, b, outward):
    along = (b - a) / np.linalg.norm(b - a)
    normal = np.array([along[1], -along[0]])
    normal = normal if normal @ outward > 0 else -normal
    return np.r_[normal, -normal @ a]


def picked_edge(name, start, end, outward, sigma=PICK_SIGMA_PX):
    """The edge through two points clicked by hand.

    Parameters
    ----------
    name : str
    start, end : array_like, shape (2,)
        Undistorted pixels.
    outward : array_like, shape (2,)
    sigma : float
        Of a click, pixels.

    Returns
    -------
    ImageEdge

    Raises
    ------
    ValueError
        If the two points are the same.
    """
    ends = np.stack([np.asarray(start, float), np.asarray(end, float)])
    length = np.linalg.norm(ends[1] - ends[0])
    if length < 1:
        raise ValueError(f"edge '{name}' was picked with two points {length:.2f} px apart: pick them far apart")
    covariance = np.diag([sigma**2 / 2, 2 * sigma**2 / length**2])
    return ImageEdge(name, _outward_line(*ends, outward), covariance, ends.mean(axis=0), ends, 2, 0.0, True)


def _spread(values):
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) if len(values) > 1 else float("nan")


def board_line(view, edge, model):
    """The image line of an edge as a line on the board, unit normal outwards, metres; shape (3,)."""
    pose = view.T_camera_board.as_matrix()
    line = (model.matrix @ pose[:3, [0, 1, 3]]).T @ edge.line
    return line / np.hypot(line[0], line[1])


def _median_line(lines, ends):
    """Median line from its offsets at two ends, and the spread at the middle."""
    lines = np.asarray(lines)
    normal = np.median(lines[:, :2], axis=0)
    normal /= np.linalg.norm(normal)
    # where every line crosses the normals raised at the two ends
    offsets = -(lines[:, :2] @ ends.T + lines[:, 2:]) / (lines[:, :2] @ normal)[:, None]
    middle = np.median(offsets, axis=0)
    a, b = ends + middle[:, None] * normal
    along = (b - a) / np.linalg.norm(b - a)
    out = np.array([along[1], -along[0]])
    out = out if out @ normal > 0 else -out
    return np.r_[out, -out @ a], _spread(offsets.mean(axis=1)) if len(lines) > 1 else float("nan")


STEP = 0.02  # of the search, in squares
NEAREST, FARTHEST = 1.1, 6.0  # squares outside the outermost inner corners
SIDES = ("top", "right", "bottom", "left")
SIDE_NORMALS = np.array([[0, -1], [1, 0], [0, 1], [-1, 0]], float)


def wide_distances(pattern):
    """Distances outside the outermost inner corners at which edges are looked for, metres."""
    return np.arange(NEAREST, FARTHEST, STEP) * pattern.square


def edge_votes(image, board, model, pose):
    """Share of the profiles that agree on an edge, by side of the pattern and distance outside it.

    Parameters
    ----------
    image : ndarray of uint8
    board : Board
        Its pattern has four sides: top (y least), right, bottom, left.
    model : CameraModel
    pose : RigidTransform
        ``T_camera_board``.

    Returns
    -------
    ndarray, shape (4, n)
        At :func:`wide_distances`; NaN where less than 30 % of the profiles lie inside the image.
    """
    pattern = board.pattern
    distances = wide_distances(pattern)
    slopes = np.linspace(-0.025, 0.025, 11) * 4  # the profiles stand four steps apart
    out = []
    for side in range(4):
        points = _side_grid(pattern, side, distances)
        uv = pinhole(pose.apply(points.reshape(-1, 3)), model).reshape(*points.shape[:2], 2)
        strip = sample(image, model, np.nan_to_num(uv, nan=-1e6))
        height = step_contrast(strip, 1.5, along=3)
        column, place, _ = peaks(height, 8.0)
        votes = vote(column, place, np.ones(len(column)), height.shape, slopes, 1).max(axis=0)
        seen = np.isfinite(strip[..., 0]).sum(axis=1)
        out.append(np.where(seen > 0.3 * height.shape[1], votes / np.maximum(seen, 1), np.nan))
    return np.stack(out)


def _side_grid(pattern, side, distances):
    """Board points of a strip outside one side of the pattern, shape (n_distances, n_profiles, 3)."""
    size = np.array([pattern.columns - 1, pattern.rows - 1]) * pattern.square
    normal = SIDE_NORMALS[side]
    along = np.abs(normal[::-1])
    s = np.arange(-pattern.square, size @ along + pattern.square, 4 * STEP * pattern.square)
    base = np.asarray(pattern.origin) + np.maximum(normal, 0) * size
    xy = base + s[None, :, None] * along + distances[:, None, None] * normal
    return np.concatenate([xy, np.zeros(xy.shape[:2] + (1,))], axis=-1)


def outer_peak(votes, least=0.45, quiet=0.1, width=4):
    """Place of the board's edge in the votes of one side: the last line before the clutter begins.

    Parameters
    ----------
    votes : ndarray, shape (n,)
        Share of profiles; NaN outside the image.
    least : float
        Share that makes a line.
    quiet : float
        The board between two of its lines (the border of the sheet, the edge) shows fewer votes than this.
    width : int
        Samples around a line that belong to it.

    Returns
    -------
    int
        -1 if there is none.
    """
    votes = np.nan_to_num(np.asarray(votes, float))
    best, start = -1, 0
    for i in np.nonzero(votes >= least)[0]:
        if votes[i] < votes[max(i - width, 0) : i + width + 1].max():
            continue
        gap = votes[start : max(i - 2 * width, start)]
        if gap.size and gap.mean() > quiet:
            break
        best, start = int(i), int(i) + 2 * width
    return best


def widest_lines(votes, board):
    """Board lines of the edges seen in the votes of one view, NaN where a side shows none; shape (4, 3)."""
    distances = wide_distances(board.pattern)
    places = [outer_peak(v) for v in votes]
    return side_lines(board.pattern, [distances[p] if p >= 0 else np.nan for p in places])


def side_lines(pattern, distances):
    """Board lines parallel to the sides of the pattern, at distances outside the outermost inner corners.

    Parameters
    ----------
    pattern : Chessboard
    distances : sequence of 4 floats
        Top, right, bottom, left; metres.

    Returns
    -------
    ndarray, shape (4, 3)
    """
    size = np.array([pattern.columns - 1, pattern.rows - 1]) * pattern.square
    base = np.asarray(pattern.origin) + np.maximum(SIDE_NORMALS, 0) * size
    offset = -np.sum(base * SIDE_NORMALS, axis=1) - np.asarray(distances, float)
    return np.column_stack([SIDE_NORMALS, offset])
