"""Did a camera that is fixed to the base stand still while the board was carried about?"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import f as f_distribution

from lrfcal_lib.model.camera import undistort

MOST_FEATURES, FEATURE_QUALITY, FEATURE_DISTANCE = 1500, 0.01, 8  # cv2.goodFeaturesToTrack; the distance in pixels
CONTRAST_WIDTH, CONTRAST_FLOOR = 8.0, 4.0  # pixels, grey levels: below the floor the contrast is sensor noise
TRACKING = {"winSize": (21, 21), "maxLevel": 3, "criteria": (3, 40, 0.003)}  # three levels reach about 80 pixels
THERE_AND_BACK = 0.1  # pixels; a feature that does not come back is hidden in the other image
FEWEST_FEATURES, FEWEST_CELLS = 40, 10  # for four unknowns with a covariance from the scatter over cells
CELLS = (8, 5)  # of the image; neighbouring features share their errors (parallax, a box that was pushed)
TUKEY = 3.0  # of the median residual of the features, whose lengths are Rayleigh: 3 medians are 3.5 sigma


@dataclass(frozen=True)
class Motion:
    """Motion of the background between two images.

    Attributes
    ----------
    rotvec : ndarray, shape (3,)
        Turn of the background in the camera frame (the camera's own turn is the opposite), radians.
    scale : float
    covariance : ndarray, shape (4, 4)
    residual_px : float
    n_features : int
    """

    rotvec: np.ndarray
    scale: float
    covariance: np.ndarray
    residual_px: float
    n_features: int


class BackgroundLost(ValueError):
    """Too little of the background can be followed from one image to another."""


def even_contrast(image):
    """Grey image with the same brightness and contrast everywhere, so that a change of the light moves nothing.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)

    Returns
    -------
    ndarray of uint8, shape (h, w)
    """
    grey = _grey(image).astype(np.float32)
    detail = grey - cv2.GaussianBlur(grey, (0, 0), CONTRAST_WIDTH)
    spread = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), CONTRAST_WIDTH)) + CONTRAST_FLOOR
    return np.clip(128 + 40 * detail / spread, 0, 255).astype(np.uint8)


def _grey(image):
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def outside(hull, shape):
    """Mask (uint8) of the image outside a hull (pixels), all of it without one."""
    mask = np.full(shape, 255, np.uint8)
    return mask if hull is None else cv2.fillConvexPoly(mask, np.round(hull).astype(np.int32), 0)


def find_features(image, mask=None):
    """Corners to follow, pixels, shape (n, 2); none where the mask (uint8) is zero."""
    found = cv2.goodFeaturesToTrack(_grey(image), MOST_FEATURES, FEATURE_QUALITY, FEATURE_DISTANCE, mask=mask)
    return np.zeros((0, 2), np.float32) if found is None else found[:, 0]


def follow(first, second, features, mask=None):
    """Find features of one image in another (pyramidal Lucas-Kanade), forwards and backwards.

    Parameters
    ----------
    first, second : ndarray of uint8, shape (h, w)
        Of :func:`even_contrast`.
    features : ndarray, shape (n, 2)
    mask : ndarray of uint8, shape (h, w), optional
        Zero where the second image shows no background.

    Returns
    -------
    start, end : ndarray, shape (m, 2)
        Only those that lead back to where they came from.
    """
    if len(features) == 0:
        return np.zeros((0, 2)), np.zeros((0, 2))
    start = features.astype(np.float32)[:, None]
    end, there, _ = cv2.calcOpticalFlowPyrLK(first, second, start, None, **TRACKING)
    back, here, _ = cv2.calcOpticalFlowPyrLK(second, first, end, None, **TRACKING)
    good = (there[:, 0] > 0) & (here[:, 0] > 0) & (np.linalg.norm(back - start, axis=2)[:, 0] < THERE_AND_BACK)
    column, row = np.clip(np.round(end[:, 0]), 0, np.array(second.shape[::-1]) - 1).astype(int).T
    good &= True if mask is None else mask[row, column] > 0
    return start[good, 0].astype(float), end[good, 0].astype(float)


def fit_motion(start, end, model):
    """Turn and scale that carry features of one image to where another shows them, robust.

    Parameters
    ----------
    start, end : ndarray, shape (n, 2)
        Recorded pixels.
    model : CameraModel

    Returns
    -------
    Motion
        The covariance comes from the scatter over cells of the image, whose features share their errors.

    Raises
    ------
    BackgroundLost
        With fewer than 40 features or 10 cells of the image (8 by 5) that agree.
    """
    cell = _cell_of(start, model)
    _check_enough(len(start), cell)
    focal = np.array([model.fx, model.fy])
    first, second = ((undistort(p, model) - [model.cx, model.cy]) / focal for p in (start, end))
    turn, scale, weight = Rotation.identity(), 1.0, np.ones(len(start))
    for robust in (False,) * 10 + (True,) * 20:
        miss, by_state = motion_misses(first, second, turn, scale)
        length = np.maximum(np.linalg.norm(miss * focal, axis=1), 1e-4)
        unit = np.median(length[weight > 0])
        weight = np.clip(1 - (length / (TUKEY * unit)) ** 2, 0, None) ** 2 if robust else 1 / np.maximum(length, 0.01)
        _check_enough((weight > 0).sum(), cell[weight > 0])
        step = _solve(by_state, miss, weight)
        turn, scale = Rotation.from_rotvec(step[:3]) * turn, scale + step[3]
    covariance = _covariance(by_state, miss, weight, cell)
    return Motion(turn.as_rotvec(), float(scale), covariance, float(unit), int((weight > 0).sum()))


def _check_enough(count, cell):
    cells = len(np.unique(cell))
    if count < FEWEST_FEATURES or cells < FEWEST_CELLS:
        raise BackgroundLost(
            f"{count} features of the background in {cells} parts of the image can be followed, "
            f"{FEWEST_FEATURES} in {FEWEST_CELLS} are needed: was the camera mounted anew, or is the scene too plain?"
        )


def _cell_of(pixels, model):
    column, row = (pixels * np.array(CELLS) / [model.width, model.height]).astype(int).T
    return np.clip(row, 0, CELLS[1] - 1) * CELLS[0] + np.clip(column, 0, CELLS[0] - 1)


def motion_misses(first, second, turn, scale):
    """Observed minus predicted normalised coordinates (n, 2), and the derivative of the prediction (n, 2, 4).

    Parameters
    ----------
    first, second : ndarray, shape (n, 2)
        Normalised image coordinates of the features in both images, without lens distortion.
    turn : Rotation
        Of the background in the camera frame; its derivative is that of a further small turn from the left.
    scale : float
    """
    rays = turn.apply(np.column_stack([first, np.ones(len(first))]))
    x, y = (rays[:, :2] / rays[:, 2:]).T
    by_turn = [np.stack([-x * y, 1 + x * x, -y, x], axis=1), np.stack([-(1 + y * y), x * y, x, y], axis=1)]
    by_state = np.stack(by_turn, axis=1)
    by_state[:, :, :3] *= scale
    return second - scale * np.stack([x, y], axis=1), by_state


def _solve(by_state, miss, weight):
    weighted = by_state * weight[:, None, None]
    return np.linalg.solve(np.einsum("nij,nik->jk", weighted, by_state), np.einsum("nij,ni->j", weighted, miss))


def _covariance(by_state, miss, weight, cell):
    """Sandwich covariance with cells of the image as its independent parts."""
    weighted = by_state * weight[:, None, None]
    score = np.zeros((cell.max() + 1, 4))
    np.add.at(score, cell, np.einsum("nij,ni->nj", weighted, miss))
    cells = len(np.unique(cell[weight > 0]))
    bread = np.linalg.inv(np.einsum("nij,nik->jk", weighted, by_state))
    return bread @ (score.T @ score) @ bread * cells / (cells - 4)


GROWTH = 1.3  # of the board's hull in an image: its rim, stand, shadow and whoever holds it move along
LEAST_STEP = 0.2  # pixels: less than edges and corners of a board are off at one placement
LEAST_SCALE = 0.5  # pixels at the image's corner: more than that is seen in the residuals of a pattern
LEVEL = 0.001  # false alarms in recordings of a steady camera
BESIDE = 2  # placements on either side of a step that must show it: a step lasts
MEDIAN_VARIANCE = np.pi / 2  # of a median over that of a mean
FEWEST_PLACEMENTS = 2 * BESIDE + 2  # with fewer the scatter without a step is not known


@dataclass(frozen=True)
class Step:
    """A camera turned between two placements and stayed so.

    Attributes
    ----------
    before, after : int
        The placements next to it.
    rotvec : ndarray, shape (3,)
        Turn of the camera, rotation vector in its own frame, radians.
    angle, angle_sigma : float
        Radians.
    size_px, sigma_px : float
        Root mean square motion of the background over the image, undistorted pixels.
    p_value : float
        Of a step so large anywhere in a recording without one.
    """

    before: int
    after: int
    rotvec: np.ndarray
    angle: float
    angle_sigma: float
    size_px: float
    sigma_px: float
    p_value: float


@dataclass(frozen=True)
class Steadiness:
    """How the background moved in the images of one camera.

    Attributes
    ----------
    camera : str
    placements : ndarray of int, shape (n,)
        In the order of the session; those whose background could not be followed are in `problems`.
    reference : int
        Placement that all motion is relative to; -1 where the question does not arise.
    rotvec : ndarray, shape (n, 3)
        Turn of the camera since the reference, rotation vector in its own frame, radians.
    scale : ndarray, shape (n,)
        Image scale over that of the reference.
    covariance : ndarray, shape (n, 4, 4)
        Of (rotvec, scale), from the scatter over cells of the image; zero for the reference.
    size_px : ndarray, shape (n,)
        Root mean square motion of the background over the image that the turn makes.
    corner_px : ndarray, shape (n,)
        Motion of a corner of the image that the scale makes, with its sign.
    residual_px : ndarray, shape (n,)
        Median distance of the features from the fitted motion.
    n_features : ndarray of int, shape (n,)
        That agree on the motion.
    steps : tuple of Step
    reason : str
        Why there is nothing to judge; '' where there is.
    problems : dict of int to str
    """

    camera: str
    placements: np.ndarray
    reference: int = -1
    rotvec: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    scale: np.ndarray = field(default_factory=lambda: np.zeros(0))
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    size_px: np.ndarray = field(default_factory=lambda: np.zeros(0))
    corner_px: np.ndarray = field(default_factory=lambda: np.zeros(0))
    residual_px: np.ndarray = field(default_factory=lambda: np.zeros(0))
    n_features: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    steps: tuple[Step, ...] = ()
    reason: str = ""
    problems: dict = field(default_factory=dict)

    @property
    def scale_drifts(self):
        """Whether the image scale changes by more than LEAST_SCALE pixels at a corner, and five sigma."""
        if len(self.scale) < 2:
            return False
        low, high = np.argmin(self.scale), np.argmax(self.scale)
        sigma = np.sqrt(self.covariance[low, 3, 3] + self.covariance[high, 3, 3])
        return bool(np.ptp(self.corner_px) > LEAST_SCALE and np.ptp(self.scale) > 5 * sigma)


def camera_steadiness(session, camera, views=None, model=None):
    """Whether a camera that is fixed to the base stood still over the placements of a session.

    Parameters
    ----------
    session : Session
    camera : str
    views : dict of int to BoardView, optional
        The board in the images, by placement; it and its surroundings are left out. Without it the board must cover
        less than about half of the features for the robust fit to see through.
    model : CameraModel, optional
        The session's own intrinsics when left out.

    Returns
    -------
    Steadiness
        With a `reason` and no placements for a camera on the head, or with fewer than two images.

    Raises
    ------
    ValueError
        For a camera the session does not have, or one without intrinsics.
    """
    if camera not in session.cameras:
        raise ValueError(f"no camera '{camera}'; the session has {', '.join(session.cameras)}")
    info = session.cameras[camera]
    if info.mount != "platform":
        return _not_judged(camera, f"camera {camera} rides on the head: its background moves with the pitch")
    model = info.model if model is None else model
    if model is None:
        raise ValueError(f"camera '{camera}' has no intrinsics in the session: give model (Prepared.models holds it)")
    records = {r.placement: r for r in reversed(session.images(camera, purpose="board")) if r.placement >= 0}
    records = {p: records[p] for p in session.placements if p in records}
    if len(records) < 2:
        return _not_judged(camera, f"camera {camera} has {len(records)} images of placements: nothing to compare")
    hulls = {p: board_hull(view, model) for p, view in (views or {}).items()}
    images = ((p, session.read_image(record)) for p, record in records.items())
    reference = _most_background(list(records), hulls)
    return steadiness_of(camera, images, session.read_image(records[reference]), reference, model, hulls)


def _not_judged(camera, reason):
    return Steadiness(camera, np.zeros(0, int), reason=reason)


def _most_background(placements, hulls):
    """The placement whose board covers least of the image; the middle one where boards are unknown."""
    areas = {p: cv2.contourArea(hulls[p].astype(np.float32)) for p in placements if hulls.get(p) is not None}
    return min(areas, key=areas.get) if areas else placements[len(placements) // 2]


def board_hull(view, model):
    """What to leave out about the board in one image.

    Parameters
    ----------
    view : BoardView
    model : CameraModel

    Returns
    -------
    ndarray, shape (k, 2), or None
        Recorded pixels; None where the board was not seen.
    """
    points = [] if view.pixels is None else [np.asarray(view.pixels)[np.isfinite(view.pixels).all(axis=1)]]
    normal = [(edge.ends - [model.cx, model.cy]) / [model.fx, model.fy] for edge in view.edges]
    rays = [np.column_stack([ends, np.ones(2)]) for ends in normal]
    points += [cv2.projectPoints(r, np.zeros(3), np.zeros(3), model.matrix, model.distortion)[0][:, 0] for r in rays]
    points = np.concatenate(points) if points else np.zeros((0, 2))
    if len(points) < 3:
        return None
    hull = cv2.convexHull(points.astype(np.float32))[:, 0].astype(float)
    centre = (hull.min(axis=0) + hull.max(axis=0)) / 2
    return centre + GROWTH * (hull - centre)


def steadiness_of(camera, images, reference_image, reference, model, hulls=None):
    """The same as :func:`camera_steadiness` for images at hand.

    Parameters
    ----------
    camera : str
    images : iterable of (int, ndarray of uint8)
        Placement and image, in the order of recording.
    reference_image : ndarray of uint8
    reference : int
        Its placement.
    model : CameraModel
    hulls : dict of int to ndarray, shape (k, 2), optional
        What to leave out, recorded pixels.

    Returns
    -------
    Steadiness
    """
    hulls = hulls or {}
    level, mask = even_contrast(reference_image), outside(hulls.get(reference), reference_image.shape[:2])
    features = find_features(reference_image, mask)
    motions, problems = {}, {}
    for placement, image in images:
        if placement == reference:
            motions[placement] = Motion(np.zeros(3), 1.0, np.zeros((4, 4)), 0.0, len(features))
            continue
        try:
            start, end = follow(level, even_contrast(image), features, outside(hulls.get(placement), image.shape[:2]))
            motions[placement] = fit_motion(start, end, model)
        except BackgroundLost as lost:
            problems[placement] = f"camera {camera}, placement {placement}: {lost}"
    return _judge(camera, motions, reference, model, problems)


def _judge(camera, motions, reference, model, problems):
    placements = np.array(list(motions), int)
    rotvec = -np.array([m.rotvec for m in motions.values()]).reshape(-1, 3)
    scale, covariance = (np.array([getattr(m, k) for m in motions.values()]) for k in ("scale", "covariance"))
    covariance[:, :3, 3] *= -1
    covariance[:, 3, :3] *= -1
    corner = np.hypot(model.width, model.height) / 2 * (scale - 1)
    metric = pixel_metric(model)
    return Steadiness(
        camera, placements, reference, rotvec, scale, covariance, turn_px(rotvec, metric), corner,
        np.array([m.residual_px for m in motions.values()]), np.array([m.n_features for m in motions.values()]),
        find_steps(placements, rotvec, covariance[:, :3, :3], metric), "", problems,
    )  # fmt: skip


def pixel_metric(model):
    """Matrix M (3, 3) with w M w the mean squared motion of undistorted pixels over the image for a turn w."""
    u, v = np.meshgrid(np.linspace(0, model.width - 1, 17), np.linspace(0, model.height - 1, 11))
    x, y = (u.ravel() - model.cx) / model.fx, (v.ravel() - model.cy) / model.fy
    _, by_state = motion_misses(np.stack([x, y], axis=1), np.zeros((len(x), 2)), Rotation.identity(), 1.0)
    by_turn = by_state[:, :, :3] * np.array([model.fx, model.fy])[:, None]
    return np.einsum("nij,nik->jk", by_turn, by_turn) / len(x)


def turn_px(rotvec, metric):
    """Root mean square motion over the image of small turns (..., 3), pixels."""
    return np.sqrt(np.einsum("...i,ij,...j->...", rotvec, metric, rotvec))


def find_steps(placements, rotvec, covariance, metric):
    """Turns of a camera that happened between two placements and lasted.

    Parameters
    ----------
    placements : ndarray of int, shape (n,)
        In the order of recording.
    rotvec : ndarray, shape (n, 3)
        Radians.
    covariance : ndarray, shape (n, 3, 3)
    metric : ndarray, shape (3, 3)
        Of :func:`pixel_metric`.

    Returns
    -------
    tuple of Step
        In order. A step is significant at a level of 0.001 over all places it might be at, at least 0.2 px, and the
        two placements on either side lie on their own side of it. None with fewer than 6 placements.

    Notes
    -----
    Binary segmentation. The noise without steps comes from the median absolute difference of neighbours, which a few
    steps do not change, or from the measured covariance where that is larger.
    """
    n = len(placements)
    if n < FEWEST_PLACEMENTS:
        return ()
    root = np.linalg.cholesky(metric).T
    moved = rotvec @ root.T  # in pixels: its length is the motion over the image
    own = np.einsum("ij,njk,ik->ni", root, covariance, root)
    sigma = np.maximum(1.4826 * np.median(np.abs(np.diff(moved, axis=0))) / np.sqrt(2), np.sqrt(np.median(own)))
    sigma = max(float(sigma), 1e-6)
    places, todo = [], [(0, n)]
    while todo:
        low, high = todo.pop()
        found = _best_split(moved[low:high], sigma, n)
        if found:
            places.append((low + found[0], found[1]))
            todo += [(low, low + found[0]), (low + found[0], high)]
    cuts = [0, *sorted(k for k, _ in places), n]
    return tuple(_step(placements, rotvec, root, sigma, cuts, k, p) for k, p in sorted(places))


def _best_split(moved, sigma, total):
    """Where a run of motions falls in two, and how likely that is by chance; None where it does not."""
    n = len(moved)
    best, free = None, 1.1 * (total - 1)  # 3 (n - 1) differences, used with the efficiency 0.37 of a median deviation
    for k in range(BESIDE, n - BESIDE + 1):
        step = np.median(moved[k:], axis=0) - np.median(moved[:k], axis=0)
        size = np.linalg.norm(step)
        F = size**2 / (3 * MEDIAN_VARIANCE * sigma**2 * (1 / k + 1 / (n - k)))
        if size >= LEAST_STEP and _lasts(moved, k, step) and (best is None or F > best[1]):
            best = k, F
    p_value = 1.0 if best is None else min(1.0, (total - 1) * float(f_distribution.sf(best[1], 3, free)))
    return (best[0], p_value) if p_value < LEVEL else None


def _lasts(moved, k, step):
    """Whether the placements next to a step lie on their own side of it."""
    along = (moved - (np.median(moved[:k], axis=0) + np.median(moved[k:], axis=0)) / 2) @ step
    return bool((along[k - BESIDE : k] < 0).all() and (along[k : k + BESIDE] > 0).all())


def _step(placements, rotvec, root, sigma, cuts, k, p_value):
    """Describe the step before index k, from the runs of placements on either side of it."""
    i = cuts.index(k)
    before, after = slice(cuts[i - 1], k), slice(k, cuts[i + 1])
    turn = np.median(rotvec[after], axis=0) - np.median(rotvec[before], axis=0)
    share = MEDIAN_VARIANCE * (1 / (k - cuts[i - 1]) + 1 / (cuts[i + 1] - k))
    angle, size = float(np.linalg.norm(turn)), float(np.linalg.norm(root @ turn))
    along = np.linalg.inv(root).T @ (turn / angle)
    sigma_px, sigma_angle = sigma * np.sqrt(share), sigma * np.sqrt(share) * float(np.linalg.norm(along))
    ends = int(placements[k - 1]), int(placements[k])
    return Step(*ends, turn, angle, sigma_angle, size, float(sigma_px), p_value)
