"""Bundle adjustment of chessboard corners: intrinsics, mounting, poses, the waves of the sheet."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.covariance import covariance_of
from lrfcal_lib.fit.least_squares import Block, minimise
from lrfcal_lib.model.camera import LENS, CameraModel, project, project_jacobians
from lrfcal_lib.model.geometry import (
    POSE,
    gradient_by_pose,
    move_pose,
    pose_array,
    pose_transform,
    rotate_and_move,
)

SIGMA_FLOOR_PX = 0.05  # corner detectors are never better than this on real prints
OUTLIER_SIGMAS = 4.5
RAYLEIGH_MEDIAN = 1.1774  # median of the length of a vector (2,) of normal variables
ROBUST_ROUNDS = 7
UP = np.array([0.0, 0.0, 1.0])
ALONE = RigidTransform.identity(1)  # the mounting of a single camera


@dataclass(frozen=True)
class Bundle:
    """What predicts the corners of a sheet in the images of rigidly mounted cameras.

    Attributes
    ----------
    lenses : ndarray, shape (c, 9)
    mounting : ndarray, shape (c, 3, 4)
        ``T_camera_first``; the first is the identity and no unknown.
    poses : ndarray, shape (v, 3, 4)
        ``T_first_board``.
    shape : ndarray, shape (m,)
        Coefficients of the heights of the corners in a basis.
    """

    lenses: np.ndarray
    mounting: np.ndarray
    poses: np.ndarray
    shape: np.ndarray

    @property
    def ends(self) -> np.ndarray:
        """Where the unknowns of each kind but the last one end, (3,)."""
        mounts = POSE * (len(self.mounting) - 1)
        return np.cumsum([self.lenses.size, mounts, POSE * len(self.poses)])

    def moved(self, step: np.ndarray) -> "Bundle":
        """After a step (n,) of all unknowns; poses move by ``[w, v]``."""
        lens, mount, pose, shape = np.split(step, self.ends)
        others = move_pose(self.mounting[1:], mount.reshape(-1, POSE))
        return Bundle(
            lenses=self.lenses + lens.reshape(-1, LENS),
            mounting=np.concatenate([self.mounting[:1], others]),
            poses=move_pose(self.poses, pose.reshape(-1, POSE)),
            shape=self.shape + shape,
        )

    def predict(
        self, points: np.ndarray, basis: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of the corners of a sheet, and their derivatives by all unknowns.

        Parameters
        ----------
        points : ndarray, shape (k, 3)
            Corners of a flat sheet, board frame, metres.
        basis : ndarray, shape (k, m)
            Heights over it.

        Returns
        -------
        pixels : ndarray, shape (c, v, k, 2)
        jacobian : ndarray, shape (c, v, k, 2, n)
        """
        raised = points + np.outer(basis @ self.shape, UP)
        turned, p_first = rotate_and_move(self.poses, raised)
        views = np.eye(len(self.poses))[:, None, None, :, None]
        pixels = []
        jacobian = []
        for lens, mount, own in zip(
            self.lenses, self.mounting, np.eye(len(self.lenses)), strict=True
        ):
            mounted, p_camera = rotate_and_move(mount, p_first)
            fx, fy, cx, cy = lens[:4]
            model = CameraModel(1, 1, fx, fy, cx, cy, lens[4:])
            by_point, by_lens = project_jacobians(p_camera, model)
            by_first = by_point @ mount[:, :3]
            by_mount = gradient_by_pose(mounted[..., None, :], by_point)
            by_pose = gradient_by_pose(turned[..., None, :], by_first)
            by_height = np.einsum("vkij,vj->vki", by_first, self.poses[:, :, 2])
            parts = (
                by_lens[..., None, :] * own[:, None],
                by_mount[..., None, :] * own[1:, None],
                by_pose[..., None, :] * views,
                by_height[..., None] * basis[:, None],
            )
            rows = [part.reshape(*by_height.shape, -1) for part in parts]
            jacobian.append(np.concatenate(rows, axis=-1))
            pixels.append(project(p_camera, model))
        return np.stack(pixels), np.stack(jacobian)


@dataclass(frozen=True)
class Adjustment:
    """Least squares over corners seen by rigidly mounted cameras.

    Attributes
    ----------
    models : tuple of CameraModel
        With covariances and rms where the intrinsics were free.
    mounting : RigidTransform
        A stack of ``T_camera_first``; the first is the identity.
    mounting_covariance : ndarray, shape (cameras - 1, 6, 6)
        Of ``[w, v]``.
    poses : RigidTransform
        A stack of ``T_first_board``.
    pose_covariance : ndarray, shape (views, 6, 6)
        Of ``[w, v]``.
    relief : ndarray, shape (k,)
        Heights of the corners over the sheet's mean plane, metres.
    predicted : ndarray, shape (cameras, views, k, 2)
        Pixels of all corners.
    residuals : ndarray, shape (cameras, views, k, 2)
        Recorded minus predicted pixels, NaN where a corner was not used.
    sigma_px : float
        Of one coordinate.
    bic : float
        Bayesian information criterion: compares adjustments of the same corners.
    """

    models: tuple[CameraModel, ...]
    mounting: RigidTransform
    mounting_covariance: np.ndarray
    poses: RigidTransform
    pose_covariance: np.ndarray
    relief: np.ndarray
    predicted: np.ndarray
    residuals: np.ndarray
    sigma_px: float
    bic: float


def waves(points: np.ndarray) -> np.ndarray:
    """Heights that corners of a sheet may have over its mean plane: a basis.

    Parameters
    ----------
    points : ndarray, shape (k, 3)

    Returns
    -------
    ndarray, shape (k, k - 3)
    """
    planes = np.insert(points[:, :2], 0, 1.0, axis=1)
    return null_space(planes.T)


def adjust(
    pixels, points, models, poses, mounting=ALONE, *, lens=LENS, wavy=False
) -> Adjustment:
    """Bundle adjustment of chessboard views with analytic derivatives.

    Parameters
    ----------
    pixels : ndarray, shape (cameras, views, k, 2)
        NaN where a corner was not found.
    points : ndarray, shape (k, 3)
        The corners on the board, metres.
    models : sequence of CameraModel
        Start values, as the next two.
    poses : RigidTransform
        A stack of ``T_first_board``.
    mounting : RigidTransform, optional
        A stack of ``T_camera_first``; may be left out for a single camera.
    lens : int
        How many of fx, fy, cx, cy, k1..k5 are unknown, from the first one on.
    wavy : bool
        Whether all views may have heights in common; those of :func:`waves` hold no plane, so that
        the poses are those of the sheet's mean plane.

    Returns
    -------
    Adjustment

    Raises
    ------
    ValueError
        If there are more unknowns than coordinates.
    """
    basis = waves(points) if wavy else np.zeros((len(points), 0))
    start = Bundle(
        lenses=np.stack([model.parameters for model in models]),
        mounting=pose_array(mounting),
        poses=pose_array(poses),
        shape=np.zeros(basis.shape[1]),
    )
    unknown = np.ones(start.ends[-1] + len(start.shape), bool)
    unknown[: start.lenses.size] = np.tile(np.arange(LENS) < lens, len(models))
    visible = np.isfinite(pixels)
    if visible.sum() < unknown.sum():
        raise ValueError(
            f"{visible.sum()} image coordinates cannot determine {unknown.sum()} unknowns: use "
            "more views"
        )

    def evaluate(bundle):
        predicted, jacobian = bundle.predict(points, basis)
        misses = (predicted - pixels)[visible]
        return Block(misses, jacobian[visible] * unknown)

    bundle = minimise(evaluate, start, Bundle.moved).state
    adjusted = _adjusted(bundle, pixels, points, basis, unknown, models)
    return adjusted if lens else replace(adjusted, models=tuple(models))


def adjust_robust(pixels, points, models, poses, mounting=ALONE, **options) -> Adjustment:
    """As :func:`adjust`, without corners far off the rest (glare, a shadow).

    Every corner is judged again in every round, so that one that its neighbour pulled out comes
    back.

    Parameters
    ----------
    pixels, points, models, poses, mounting, **options
        Those of :func:`adjust`.

    Returns
    -------
    Adjustment
    """
    start = models, poses, mounting
    used = np.isfinite(pixels[..., :1])
    for _ in range(ROBUST_ROUNDS):
        kept = np.where(used, pixels, np.nan)
        result = adjust(kept, points, *start, **options)
        start = result.models, result.poses, result.mounting
        distance = np.linalg.norm(pixels - result.predicted, axis=-1, keepdims=True)
        sigma = max(np.nanmedian(distance) / RAYLEIGH_MEDIAN, SIGMA_FLOOR_PX)
        before = used
        used = distance <= OUTLIER_SIGMAS * sigma
        if np.array_equal(used, before):
            break
    return result


def better(result: Adjustment, points, **options) -> Adjustment:
    """The same corners adjusted otherwise, where the Bayesian information criterion prefers that.

    Parameters
    ----------
    result : Adjustment
    points, **options
        Those of :func:`adjust`.

    Returns
    -------
    Adjustment
    """
    corners = result.predicted + result.residuals
    other = adjust(corners, points, result.models, result.poses, **options)
    return other if other.bic < result.bic else result


def _adjusted(bundle, pixels, points, basis, unknown, models):
    """The Adjustment that a solved bundle is."""
    predicted, jacobian = bundle.predict(points, basis)
    residuals = pixels - predicted
    visible = np.isfinite(pixels)
    count = visible.sum()
    error = np.nansum(residuals**2)
    variance = max(error / max(count - unknown.sum(), 1), 1e-18)
    lens, mount, pose = _covariances(bundle, variance, jacobian[visible] * unknown)
    rms = np.sqrt(2 * np.nanmean(residuals**2, axis=(1, 2, 3)))  # as OpenCV counts it
    adjusted = zip(models, bundle.lenses, lens, rms.tolist(), strict=True)
    return Adjustment(
        models=tuple(model.with_parameters(*values) for model, *values in adjusted),
        mounting=pose_transform(bundle.mounting),
        mounting_covariance=mount,
        poses=pose_transform(bundle.poses),
        pose_covariance=pose,
        relief=basis @ bundle.shape,
        predicted=predicted,
        residuals=residuals,
        sigma_px=np.sqrt(variance),
        bic=count * np.log(max(error, 1e-300) / count) + unknown.sum() * np.log(count),
    )


def _covariances(bundle, variance, jacobian):
    """Of every lens, mounting and pose (n, k, k); zero for what is no unknown."""
    normal = jacobian.T @ jacobian
    # pixels, radians and metres mix safely
    seen = np.diag(normal)
    scales = 1 / np.sqrt(np.where(seen > 0, seen, np.inf))
    covariance = variance * covariance_of(normal, scales, lost=())
    kinds = np.split(np.arange(len(normal)), bundle.ends)
    for unknowns, size in zip(kinds, (LENS, POSE, POSE), strict=False):
        rows = unknowns.reshape(-1, size)
        yield covariance[rows[:, :, None], rows[:, None]]
