"""Did a camera that is fixed to the base stand still while the board was carried about?"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from lrfcal_lib.model.camera import distort, undistort
from lrfcal_lib.preprocess.pattern_in_image import grey

MOST_FEATURES, FEATURE_QUALITY, FEATURE_DISTANCE = 1500, 0.01, 8  # cv2.goodFeaturesToTrack; the distance in pixels
CONTRAST_WIDTH, CONTRAST_FLOOR = 8.0, 4.0  # pixels, grey levels: below the floor the contrast is sensor noise
TRACKING = {"winSize": (21, 21), "maxLevel": 3, "criteria": (3, 40, 0.003)}  # three levels reach about 80 pixels
THERE_AND_BACK = 0.1  # pixels; a feature that does not come back is hidden in the other image
FEWEST_FEATURES, FEWEST_CELLS = 40, 10  # for four unknowns with a covariance from the scatter over cells
CELLS = np.array([8, 5])  # of the image; neighbouring features share their errors (parallax, a box that was pushed)
ROUNDS, FARTHEST = 4, 3.0  # of least squares; of the median miss of the features, whose lengths are Rayleigh: 3.5 sigma
GROWTH = 1.3  # of the board's hull in an image: its rim, stand, shadow and whoever holds it move along
LEAST_STEP = 0.2  # pixels: less than edges and corners of a board are off at one placement
LEAST_SCALE = 0.5  # pixels at the image's corner: more than that is seen in the residuals of a pattern
LEVEL = 0.001  # false alarms in recordings of a steady camera
BESIDE = 2  # placements on either side of a step that must show it: a step lasts
MEDIAN_VARIANCE = np.pi / 2  # of a median over that of a mean
FEWEST_PLACEMENTS = 2 * BESIDE + 2  # with fewer the scatter without a step is not known


class BackgroundLost(ValueError):
    """Too little of the background can be followed from one image to another."""


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
    size_px : float
        Root mean square motion of the background over the image, undistorted pixels.
    """

    before: int
    after: int
    rotvec: np.ndarray
    angle: float
    angle_sigma: float
    size_px: float


@dataclass(frozen=True)
class Steadiness:
    """How the background moved in the images of one camera.

    Attributes
    ----------
    camera : str
    placements : ndarray of int, shape (n,)
        In the order of the session; those whose background could not be followed are in `problems`.
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
    steps : tuple of Step
    reason : str
        Why there is nothing to judge; '' where there is.
    problems : dict of int to str
    """

    camera: str
    placements: np.ndarray
    rotvec: np.ndarray = ()
    scale: np.ndarray = ()
    covariance: np.ndarray = ()
    size_px: np.ndarray = ()
    corner_px: np.ndarray = ()
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


def camera_steadiness(prepared, camera):
    """Whether a camera that is fixed to the base stood still over the placements of a session.

    Parameters
    ----------
    prepared : Prepared
        Its views tell where the board is, which is left out with its surroundings. A board that was not seen must cover
        less than about half of the features for the robust fit to see through.
    camera : str

    Returns
    -------
    Steadiness
        With a `reason` and no placements for a camera on the head, or with fewer than two images.
    """
    session, model = prepared.session, prepared.models[camera]
    if session.cameras[camera].mount != "platform":
        return Steadiness(camera, (), reason=f"camera {camera} rides on the head: its background moves with the pitch")
    records = {r.placement: r for r in reversed(session.images(camera, purpose="board"))}
    records = {p: records[p] for p in session.placements if p in records}
    if len(records) < 2:
        reason = f"camera {camera} has {len(records)} images of placements: nothing to compare"
        return Steadiness(camera, (), reason=reason)
    hulls = {p: board_hull(view, model) for p, view in prepared.views[camera].items()}
    # the placement whose board covers least of the image; the middle one where boards are unknown
    areas = {p: cv2.contourArea(hulls[p].astype(np.float32)) for p in records if hulls.get(p) is not None}
    reference = min(areas, key=areas.get) if areas else list(records)[len(records) // 2]
    first = session.read_image(records[reference])
    mask, quality = outside(hulls.get(reference), first), (MOST_FEATURES, FEATURE_QUALITY, FEATURE_DISTANCE)
    level, features = even_contrast(first), cv2.goodFeaturesToTrack(grey(first), *quality, mask=mask)
    motions, problems = {reference: (np.zeros(3), 1.0, np.zeros((4, 4)))}, {}
    for placement in (p for p in records if p != reference):
        image = session.read_image(records[placement])
        try:
            pairs = follow(level, even_contrast(image), features, outside(hulls.get(placement), image))
            motions[placement] = fit_motion(*pairs, model)
        except BackgroundLost as lost:
            problems[placement] = f"camera {camera}, placement {placement}: {lost}"
    order, root = [p for p in records if p in motions], pixel_root(model)
    turn, scale, covariance = (np.array(each) for each in zip(*map(motions.get, order), strict=True))
    # the camera's own turn is the opposite of the background's
    turn, covariance = -turn, covariance * np.outer([-1, -1, -1, 1], [-1, -1, -1, 1])
    size, corner = np.linalg.norm(turn @ root.T, axis=1), np.hypot(model.width, model.height) / 2 * (scale - 1)
    steps = find_steps(order, turn, covariance[:, :3, :3], root)
    motion = turn, scale, covariance, size, corner, steps
    return Steadiness(camera, np.array(order, int), *motion, problems=problems)


def board_hull(view, model):
    """What to leave out about the board in one image (its BoardView): recorded pixels (k, 2), None without a board."""
    corners = np.zeros((0, 2)) if view.pixels is None else view.pixels[np.isfinite(view.pixels).all(axis=1)]
    ends = np.reshape([edge.ends for edge in view.edges], (-1, 2))
    focal, centre = np.array([model.fx, model.fy]), np.array([model.cx, model.cy])
    points = np.concatenate([corners, distort((ends - centre) / focal, model.distortion) * focal + centre])
    if len(points) < 3:
        return None
    hull = cv2.convexHull(points.astype(np.float32))[:, 0].astype(float)
    middle = (hull.min(axis=0) + hull.max(axis=0)) / 2
    return middle + GROWTH * (hull - middle)


def even_contrast(image):
    """Grey image with the same brightness and contrast everywhere, so that a change of the light moves nothing."""
    picture = grey(image).astype(np.float32)
    detail = picture - cv2.GaussianBlur(picture, (0, 0), CONTRAST_WIDTH)
    spread = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), CONTRAST_WIDTH)) + CONTRAST_FLOOR
    return np.clip(128 + 40 * detail / spread, 0, 255).astype(np.uint8)


def outside(hull, image):
    """Mask (uint8) of an image outside a hull (pixels), all of it without one."""
    mask = np.full(image.shape[:2], 255, np.uint8)
    return mask if hull is None else cv2.fillConvexPoly(mask, np.round(hull).astype(np.int32), 0)


def follow(first, second, start, mask):
    """Find features (n, 1, 2; None without any) of one image in another, both of :func:`even_contrast` (Lucas-Kanade).

    Returns start and end (m, 2) of those that lead back to where they came from, and end where the mask is not zero.
    """
    if start is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    end, there, _ = cv2.calcOpticalFlowPyrLK(first, second, start, None, **TRACKING)
    back, here, _ = cv2.calcOpticalFlowPyrLK(second, first, end, None, **TRACKING)
    good = (there[:, 0] > 0) & (here[:, 0] > 0) & (np.linalg.norm(back - start, axis=2)[:, 0] < THERE_AND_BACK)
    column, row = np.clip(np.round(end[:, 0]), 0, np.array(second.shape[::-1]) - 1).astype(int).T
    good &= mask[row, column] > 0
    return start[good, 0].astype(float), end[good, 0].astype(float)


def fit_motion(start, end, model):
    """Turn and scale that carry features (n, 2) of one image to where another shows them, robust.

    Returns the rotation vector of the background in the camera frame (the camera's own turn is the opposite), the
    scale, and their covariance (4, 4) from the scatter over cells of the image, whose features share their errors.
    BackgroundLost with fewer than 40 features or 10 cells of the image (8 by 5) that agree.
    """
    focal, centre = np.array([model.fx, model.fy]), np.array([model.cx, model.cy])
    column, row = np.clip((start * CELLS / [model.width, model.height]).astype(int), 0, CELLS - 1).T
    cell, (first, second) = row * CELLS[0] + column, (undistort(p, model) for p in (start, end))
    rays, motion = np.column_stack([(first - centre) / focal, np.ones(len(first))]), np.array([0.0, 0.0, 0.0, 1.0])
    good = cv2.findHomography(first, second, cv2.LMEDS)[1] if len(start) > FEWEST_FEATURES else None
    good = np.ones(len(start), bool) if good is None else good.ravel() > 0

    def misses(motion, some):
        """Undistorted pixels, of a rotation vector and a scale."""
        x, y, z = Rotation.from_rotvec(motion[:3]).apply(rays[some]).T
        return (focal * motion[3] * np.stack([x / z, y / z], axis=1) + centre - second[some]).ravel()

    for _ in range(ROUNDS):
        (cells, which), count = np.unique(cell[good], return_inverse=True), good.sum()
        if count < FEWEST_FEATURES or len(cells) < FEWEST_CELLS:
            raise BackgroundLost(
                f"{count} features of the background in {len(cells)} parts of the image can be followed, "
                f"{FEWEST_FEATURES} in {FEWEST_CELLS} are needed: was the camera mounted anew, or is the scene too "
                "plain?"
            )
        found = least_squares(misses, motion, x_scale=1e-3, args=(good,))
        motion, length = found.x, np.linalg.norm(misses(found.x, slice(None)).reshape(-1, 2), axis=1)
        good = length < FARTHEST * np.median(length[good])
    # sandwich covariance with cells of the image as its independent parts
    filling, bread = np.zeros((len(cells), 4)), np.linalg.inv(found.jac.T @ found.jac)
    np.add.at(filling, np.repeat(which, 2), found.jac * found.fun[:, None])
    covariance = bread @ (filling.T @ filling) @ bread * len(cells) / (len(cells) - 4)
    return motion[:3], float(motion[3]), covariance


def pixel_root(model):
    """Matrix (3, 3) that makes of a turn a vector as long as the rms motion of undistorted pixels over the image."""
    u, v = np.meshgrid(np.linspace(0, model.width - 1, 17), np.linspace(0, model.height - 1, 11))
    x, y = (u.ravel() - model.cx) / model.fx, (v.ravel() - model.cy) / model.fy
    by_turn = np.array([[-x * y, 1 + x * x, -y], [-(1 + y * y), x * y, x]]) * [[[model.fx]], [[model.fy]]]
    return np.linalg.cholesky(np.einsum("ijn,ikn->jk", by_turn, by_turn) / len(x)).T


def find_steps(placements, rotvec, covariance, root):
    """Turns of a camera that happened between two placements and lasted: a tuple of Step in order.

    From the turns (n, 3) of the placements in the order of recording, with their covariance and a :func:`pixel_root`.
    A step is significant at a level of 0.001 over all places it might be at, at least 0.2 px, and the two placements on
    either side lie on their own side of it. None with fewer than 6 placements. Binary segmentation; the noise without
    steps comes from the median absolute difference of neighbours, which a few steps do not change, or from the measured
    covariance where that is larger.
    """
    n = len(placements)
    if n < FEWEST_PLACEMENTS:
        return ()
    moved = rotvec @ root.T  # in pixels: its length is the motion over the image
    own = np.einsum("ij,njk,ik->ni", root, covariance, root)
    sigma = np.maximum(1.4826 * np.median(np.abs(np.diff(moved, axis=0))) / np.sqrt(2), np.sqrt(np.median(own)))
    sigma = max(float(sigma), 1e-6)

    def splits(low, high):
        """Where a part of the recording falls in pieces."""
        k, p_value = _best_split(moved[low:high], sigma, n)
        return [*splits(low, low + k), low + k, *splits(low + k, high)] if p_value < LEVEL else []

    cuts, steps = [0, *splits(0, n), n], []
    for before, k, after in zip(cuts, cuts[1:], cuts[2:], strict=False):
        turn = np.median(rotvec[k:after], axis=0) - np.median(rotvec[before:k], axis=0)
        spread = sigma * np.sqrt(MEDIAN_VARIANCE * (1 / (k - before) + 1 / (after - k)))
        angle, size = float(np.linalg.norm(turn)), float(np.linalg.norm(root @ turn))
        angle_sigma = spread * float(np.linalg.norm(np.linalg.inv(root).T @ (turn / angle)))
        steps.append(Step(int(placements[k - 1]), int(placements[k]), turn, angle, angle_sigma, size))
    return tuple(steps)


def _best_split(moved, sigma, total):
    """Where a run of motions falls in two, and how likely that is by chance (1 where it does not)."""
    n, best, most = len(moved), 0, 0.0
    for k in range(BESIDE, n - BESIDE + 1):
        before, after = np.median(moved[:k], axis=0), np.median(moved[k:], axis=0)
        step = after - before
        along = (moved - (before + after) / 2) @ step
        lasts = (along[k - BESIDE : k] < 0).all() and (along[k : k + BESIDE] > 0).all()
        F = step @ step / (3 * MEDIAN_VARIANCE * sigma**2 * (1 / k + 1 / (n - k)))
        if np.linalg.norm(step) >= LEAST_STEP and lasts and F > most:
            best, most = k, F
    free = 1.1 * (total - 1)  # 3 (n - 1) differences, used with the efficiency 0.37 of a median deviation
    return best, min(1.0, (total - 1) * float(fdtrc(3, free, most)))
