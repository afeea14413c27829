"""Least squares over chessboard corners: intrinsics, poses, the mounting of cameras, the waves of the sheet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.camera import CameraModel, project, project_jacobians
from lrfcal_lib.model.geometry import hat

SIGMA_FLOOR_PX = 0.05  # corner detectors are never better than this on real prints
OUTLIER_SIGMAS = 4.5
ROBUST_ROUNDS = 6


@dataclass(frozen=True)
class Adjustment:
    """Least squares over corners seen by rigidly mounted cameras.

    Attributes
    ----------
    models : tuple of CameraModel
        With `covariance` where the intrinsics were free; `rms_px` per camera.
    mounting : tuple of RigidTransform
        ``T_camera_first`` of every camera; the first is the identity.
    mounting_covariance : ndarray, shape (cameras - 1, 6, 6)
    poses : tuple of RigidTransform
        ``T_first_board`` of every view.
    pose_covariance : ndarray, shape (views, 6, 6)
    relief : ndarray, shape (k,)
        Height of every corner over the sheet's mean plane, along z of the board, metres; zero unless it was free.
    residuals : ndarray, shape (cameras, views, k, 2)
        Seen minus predicted, pixels; NaN where a corner was not used.
    sigma_px : float
        Standard deviation of one coordinate, from the residuals.
    rms_px : float
        Root mean square distance between seen and predicted corners, as OpenCV counts it.
    bic : float
        Bayesian information criterion, to compare adjustments of the same corners.
    """

    models: tuple
    mounting: tuple
    mounting_covariance: np.ndarray
    poses: tuple
    pose_covariance: np.ndarray
    relief: np.ndarray
    residuals: np.ndarray
    sigma_px: float
    rms_px: float
    bic: float

    @property
    def model(self):
        """Intrinsics of the first camera."""
        return self.models[0]


@dataclass(frozen=True)
class _State:
    intrinsics: np.ndarray  # (c, 9)
    mounting: np.ndarray  # (c, 4, 4)
    poses: np.ndarray  # (v, 4, 4)
    relief: np.ndarray  # (m,) coordinates of the height in the basis that is orthogonal to planes


def adjust(pixels, pattern, models, poses, mounting=None, *, intrinsics=True, relief=False, fixed=(), iterations=50):
    """Bundle adjustment of chessboard views by damped Gauss-Newton with analytic derivatives.

    Parameters
    ----------
    pixels : array_like, shape (cameras, views, k, 2)
        Recorded pixels, NaN where a corner was not seen.
    pattern : Chessboard
    models : sequence of CameraModel
        Start values (or the truth, with ``intrinsics=False``).
    poses : sequence of RigidTransform
        Start values of ``T_first_board``.
    mounting : sequence of RigidTransform, optional
        Start values of ``T_camera_first``; needed for more than one camera.
    intrinsics : bool
        Whether the intrinsics are free.
    relief : bool
        Whether the sheet may be wavy: one height a corner, common to all views. Heights hold no plane, so the pose is
        that of the sheet's mean plane.
    fixed : sequence of int
        Places in (fx, fy, cx, cy, k1..k5) that stay as they are.
    iterations : int

    Returns
    -------
    Adjustment

    Raises
    ------
    ValueError
        If there are fewer observations than unknowns.
    """
    pixels = np.asarray(pixels, float)
    points = pattern.points()
    plane = np.column_stack([np.ones(len(points)), points[:, :2]])
    basis = np.linalg.svd(plane)[0][:, 3:] if relief else np.zeros((len(points), 0))
    mounts = np.stack([np.eye(4)] + [m.as_matrix() for m in (mounting or ())[1:]])
    start = np.stack([m.parameters for m in models])
    state = _State(start, mounts, np.stack([p.as_matrix() for p in poses]), np.zeros(basis.shape[1]))
    free = _free_columns(state, intrinsics, fixed)
    seen = np.isfinite(pixels)
    if seen.sum() < free.sum():
        raise ValueError(f"{seen.sum()} image coordinates cannot determine {free.sum()} unknowns: use more views")
    state = _iterate(state, pixels, points, basis, free, iterations)
    return _finish(state, pixels, points, basis, free, models, intrinsics)


def _free_columns(state, intrinsics, fixed):
    lens = np.full((len(state.intrinsics), 9), bool(intrinsics))
    lens[:, list(fixed)] = False
    rest = 6 * (len(state.mounting) - 1) + 6 * len(state.poses) + len(state.relief)
    return np.r_[lens.ravel(), np.ones(rest, bool)]


def _iterate(state, pixels, points, basis, free, iterations):
    damping = 1e-6
    error, normal, gradient = _normal_equations(state, pixels, points, basis, free)
    for _ in range(iterations):
        step = np.zeros(len(free))
        step[free] = _solve_scaled(normal, gradient, damping)
        trial = _moved(state, step)
        trial_error, trial_normal, trial_gradient = _normal_equations(trial, pixels, points, basis, free)
        if trial_error < error:
            done = error - trial_error < 1e-12 * error
            state, error, normal, gradient = trial, trial_error, trial_normal, trial_gradient
            damping = max(damping / 10, 1e-12)
            if done:
                break
        elif damping > 1e3:
            break
        else:
            damping *= 10
    return state


def _solve_scaled(normal, gradient, damping):
    """Solve damped normal equations with unit diagonal, so that pixels, radians and metres mix safely."""
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * scale[:, None] * scale
    return scale * np.linalg.solve(scaled + damping * np.eye(len(scale)), scale * gradient)


def _residuals(state, pixels, points, basis, jacobian=True):
    """Residuals (c, v, k, 2) and their derivatives, one block for each group of unknowns."""
    height = basis @ state.relief
    p_board = points + height[:, None] * [0.0, 0.0, 1.0]
    turned = np.einsum("vij,kj->vki", state.poses[:, :3, :3], p_board)
    p_first = turned + state.poses[:, None, :3, 3]
    mounted = np.einsum("cij,vkj->cvki", state.mounting[:, :3, :3], p_first)
    p_camera = mounted + state.mounting[:, None, None, :3, 3]
    out, blocks = np.empty(pixels.shape), []
    for c, lens in enumerate(state.intrinsics):
        by_point, by_lens = project_jacobians(p_camera[c], CameraModel(1, 1, *lens[:4], lens[4:]))
        x, y = p_camera[c, ..., 0] / p_camera[c, ..., 2], p_camera[c, ..., 1] / p_camera[c, ..., 2]
        out[c] = pixels[c] - _predict(x, y, lens, by_lens)
        blocks.append((by_lens, by_point, by_point @ state.mounting[c, :3, :3]))
    return out, blocks, turned, mounted


def _predict(x, y, lens, by_lens):
    # the derivatives by fx and fy are the distorted normalised coordinates themselves
    return np.stack([lens[0] * by_lens[..., 0, 0] + lens[2], lens[1] * by_lens[..., 1, 1] + lens[3]], axis=-1)


def _jacobian(state, blocks, turned, mounted, basis):
    """Derivatives of the prediction, shape (c, v, k, 2, n_parameters)."""
    cameras, views, corners = len(state.intrinsics), len(state.poses), turned.shape[1]
    n_lens, n_mount = 9 * cameras, 6 * (cameras - 1)
    out = np.zeros((cameras, views, corners, 2, n_lens + n_mount + 6 * views + basis.shape[1]))
    for c, (by_lens, by_point, by_first) in enumerate(blocks):
        out[c, ..., 9 * c : 9 * c + 9] = by_lens
        if c:
            at = n_lens + 6 * (c - 1)
            out[c, ..., at : at + 3], out[c, ..., at + 3 : at + 6] = -by_point @ hat(mounted[c]), by_point
        pose = np.concatenate([-by_first @ hat(turned), by_first], axis=-1)
        start = n_lens + n_mount
        view = out[c, ..., start : start + 6 * views].reshape(views, corners, 2, views, 6)
        index = np.arange(views)
        view[index, :, :, index] = pose
        out[c, ..., start : start + 6 * views] = view.reshape(views, corners, 2, 6 * views)
        normal = np.einsum("vkij,vj->vki", by_first, state.poses[:, :3, 2])
        out[c, ..., start + 6 * views :] = normal[..., None] * basis[None, :, None, :]
    return out


def _normal_equations(state, pixels, points, basis, free):
    residuals, blocks, turned, mounted = _residuals(state, pixels, points, basis)
    jacobian = _jacobian(state, blocks, turned, mounted, basis).reshape(residuals.size, -1)[:, free]
    flat = residuals.ravel()
    good = np.isfinite(flat)
    jacobian, flat = jacobian[good], flat[good]
    return flat @ flat, jacobian.T @ jacobian, jacobian.T @ flat


def _moved(state, step):
    cameras, views = len(state.intrinsics), len(state.poses)
    cuts = np.cumsum([9 * cameras, 6 * (cameras - 1), 6 * views])
    lens, mount, pose, relief = np.split(step, cuts)
    mounting = state.mounting.copy()
    mounting[1:] = _turned(mounting[1:], mount.reshape(-1, 6))
    poses = _turned(state.poses, pose.reshape(-1, 6))
    return _State(state.intrinsics + lens.reshape(-1, 9), mounting, poses, state.relief + relief)


def _turned(transforms, steps):
    out = transforms.copy()
    out[:, :3, :3] = Rotation.from_rotvec(steps[:, :3]).as_matrix() @ transforms[:, :3, :3]
    out[:, :3, 3] += steps[:, 3:]
    return out


def _finish(state, pixels, points, basis, free, models, intrinsics):
    error, normal, _ = _normal_equations(state, pixels, points, basis, free)
    residuals = _residuals(state, pixels, points, basis)[0]
    count = np.isfinite(residuals).sum()
    sigma2 = max(error / max(count - free.sum(), 1), 1e-18)
    covariance = np.zeros((len(free),) * 2)
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal * scale[:, None] * scale, hermitian=True) * scale[:, None] * scale
    covariance[np.ix_(free, free)] = sigma2 * inverse
    cameras, views = len(models), len(state.poses)
    at = np.cumsum([0, 9 * cameras, 6 * (cameras - 1), 6 * views])
    fitted = tuple(
        m.with_parameters(
            state.intrinsics[c],
            covariance[9 * c : 9 * c + 9, 9 * c : 9 * c + 9] if intrinsics else m.covariance,
            _rms(residuals[c]) if intrinsics else m.rms_px,
        )
        for c, m in enumerate(models)
    )
    return Adjustment(
        fitted,
        tuple(RigidTransform.from_matrix(m) for m in state.mounting),
        _diagonal_blocks(covariance[at[1] : at[2], at[1] : at[2]]),
        tuple(RigidTransform.from_matrix(p) for p in state.poses),
        _diagonal_blocks(covariance[at[2] : at[3], at[2] : at[3]]),
        basis @ state.relief,
        residuals,
        float(np.sqrt(sigma2)),
        _rms(residuals),
        float(count * np.log(max(error, 1e-300) / count) + free.sum() * np.log(count)),
    )


def _rms(residuals):
    return float(np.sqrt(2 * np.nanmean(residuals**2)))


def _diagonal_blocks(covariance):
    n = len(covariance) // 6
    index = np.arange(n)
    return covariance.reshape(n, 6, n, 6)[index, :, index]


def adjust_robust(pixels, pattern, models, poses, mounting=None, **options):
    """As :func:`adjust`, without corners far off the rest (glare, a shadow): NaN in `residuals`.

    Every corner is judged again after each adjustment, so that one that was pulled out by its neighbour comes back.
    """
    pixels = np.asarray(pixels, float)
    result = adjust(pixels, pattern, models, poses, mounting, **options)
    used = np.isfinite(result.residuals)
    for _ in range(ROBUST_ROUNDS):
        kept = _near_enough(_prediction_errors(result, pixels, pattern))
        if np.array_equal(kept, used):
            break
        used = kept
        masked = np.where(used, pixels, np.nan)
        result = adjust(masked, pattern, result.models, result.poses, result.mounting, **options)
    return result


def _near_enough(errors):
    """Which coordinates belong to corners that are not outliers, same shape as `errors`."""
    distance = np.linalg.norm(errors, axis=-1)
    # the median of a Rayleigh variable is 1.1774 sigma
    limit = OUTLIER_SIGMAS * max(np.nanmedian(distance) / 1.1774, SIGMA_FLOOR_PX)
    return np.broadcast_to((distance <= limit)[..., None], errors.shape)


def _prediction_errors(result, pixels, pattern):
    """Seen minus predicted for all corners, also those the result did without."""
    raised = pattern.points() + result.relief[:, None] * [0.0, 0.0, 1.0]
    errors = np.empty(pixels.shape)
    for c, (model, T_camera_first) in enumerate(zip(result.models, result.mounting, strict=True)):
        for v, pose in enumerate(result.poses):
            errors[c, v] = pixels[c, v] - project((T_camera_first * pose).apply(raised), model)
    return errors


def better(result, pixels, pattern, **options):
    """The same corners adjusted otherwise, where the Bayesian information criterion prefers that."""
    same = np.where(np.isfinite(result.residuals), pixels, np.nan)
    other = adjust(same, pattern, result.models, result.poses, **options)
    return other if other.bic < result.bic else result
