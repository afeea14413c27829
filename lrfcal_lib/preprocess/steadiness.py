"""Did a camera that is fixed to the base stand still while the board was carried about?

Its background must. Corners of the background are tracked from one image into those of all other placements; a small
turn of the camera and a change of the image scale (a lens that warms up) explain their motion. A shift of the camera
cannot be told from a turn where the background is far away, and counts as one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import f as f_distribution

from lrfcal_lib.preprocess.image_motion import (
    BackgroundLost,
    Motion,
    even_contrast,
    find_features,
    fit_motion,
    follow,
    motion_misses,
    outside,
)

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
