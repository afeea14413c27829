"""Monte-Carlo over single shots: every method on the same trials, beside the truth."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.geometry import polar_to_points
from lrfcal_lib.preprocess.board_scan import fit_lines, row_ends
from lrfcal_lib.solvers.camera import solve_lines_batch
from lrfcal_lib.solvers.line_ml import edge_bias, solve_line_ml_batch
from lrfcal_lib.solvers.planes import PlaneSets
from lrfcal_lib.solvers.zhang_pless import solve_zhang_pless_batch

UNIFORM = 1 / np.sqrt(12.0)
FACE = 24  # face points a placement


def crossings(shots, setup, last_beam=False):
    """Edge points of drawn shots, as the preprocessing makes them of a scan line.

    Parameters
    ----------
    shots : dict of ndarray
        Of :func:`lrfcal_lib.simulate.draw.draw_shots`.
    setup : ShotSetup
    last_beam : bool
        The last beam on the board instead of the half step to the first one off it.

    Returns
    -------
    dict of ndarray
        points, half_step (t, n, 3), covariance, noise (t, n, 3, 3), lines (t, n, 3), radius, background, line_sigma
        (t, n), with n = 2 p crossings a trial; groups (n,), the placement of each.
    """
    ranges, bearings = shots["ranges"], setup.bearings()
    t, p, _ = ranges.shape
    flat = ranges.reshape(t * p, -1)
    lines, information = fit_lines(flat, bearings)
    _, first, last = row_ends(np.isfinite(flat))
    half = np.array([-0.5, 0.5]) * setup.step
    bearing = bearings[np.stack([first, last], axis=1)] + (0.0 if last_beam else half)
    points, turned, variance = _on_lines(lines, information, bearing, setup.sigma_range)
    noise = variance[..., None, None] * _outer(points / np.linalg.norm(points, axis=-1, keepdims=True))
    spacing = _outer(turned * setup.step * UNIFORM)
    radius = setup.radius(np.linalg.norm(points, axis=-1))
    found = {"points": points, "half_step": turned * half[:, None], "noise": noise, "covariance": noise + spacing}
    found |= {"radius": radius, "background": 0 * radius, "line_sigma": np.full(radius.shape, setup.sigma_px)}
    found = {k: v.reshape((t, 2 * p) + v.shape[2:]) for k, v in found.items()}
    return found | {"lines": shots["lines"].reshape(t, 2 * p, 3), "groups": np.repeat(np.arange(p), 2)}


def _on_lines(lines, information, bearing, sigma):
    """Points of fitted lines at bearings (n, 2), how they move with the bearing, and their range variance."""
    ray = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    across = np.stack([-ray[..., 1], ray[..., 0]], axis=-1)
    r = 1 / np.sum(lines[:, None] * ray, axis=-1)
    slope = -(r**2) * np.sum(lines[:, None] * across, axis=-1)
    turned = slope[..., None] * ray + r[..., None] * across
    variance = r**4 * np.einsum("nei,nij,nej->ne", ray, np.linalg.inv(information) * sigma**2, ray)
    zero = np.zeros(r.shape + (1,))
    return polar_to_points(r, bearing), np.concatenate([turned, zero], axis=-1), variance


def _outer(v):
    return v[..., :, None] * v[..., None, :]


def faces(shots, setup):
    """Face points of drawn shots for the plane method, a PlaneSets with a leading trial axis."""
    ranges, bearings = shots["ranges"], setup.bearings()
    t, p, b = ranges.shape
    hit = np.isfinite(ranges)
    order = np.argsort(~hit, axis=-1, kind="stable")
    count = hit.sum(axis=-1)
    pick = np.minimum((np.linspace(0, 1, FACE) * (count[..., None] - 1)).round().astype(int), count[..., None] - 1)
    beam = np.take_along_axis(order, pick, axis=-1)
    points = polar_to_points(np.take_along_axis(ranges, beam, axis=-1), bearings[beam])
    rays = points / np.linalg.norm(points, axis=-1, keepdims=True)
    repeats = np.maximum(FACE / count, 1.0)  # a short line gives some of its points twice
    covariance = _outer(rays) * (setup.sigma_range**2 * repeats)[..., None, None, None] + 1e-10 * np.eye(3)
    used = np.ones((p, FACE), bool)
    return PlaneSets(np.arange(p), points, covariance, used, shots["boards"], shots["board_covariance"])


def solve_shots(shots, setup, T0):
    """All trials by every method.

    Parameters
    ----------
    shots : dict of ndarray
    setup : ShotSetup
    T0 : RigidTransform
        Start values, one a trial.

    Returns
    -------
    dict of str to Solution
        With a leading trial axis: line_last_beam (weighted), line, line_ml, zhang_pless.
    """
    half, last = crossings(shots, setup), crossings(shots, setup, last_beam=True)
    basic = ("points", "covariance", "lines", "line_sigma")
    full = ("points", "covariance", "half_step", "noise", "radius", "background", "lines", "line_sigma")
    model, groups = setup.model, half["groups"]
    return {
        "line_last_beam": solve_lines_batch(*(last[k] for k in basic), model, T0, groups=groups),
        "line": solve_lines_batch(*(half[k] for k in basic), model, T0, groups=groups),
        "line_ml": solve_line_ml_batch(*(half[k] for k in full), model, T0, groups=groups),
        "zhang_pless": solve_zhang_pless_batch(faces(shots, setup), T0),
    }


def shots_table(shots, setup, solutions):
    """Errors of every method over the trials.

    Parameters
    ----------
    shots : dict of ndarray
    setup : ShotSetup
    solutions : dict of str to Solution

    Returns
    -------
    DataFrame
        method, rotation_median_deg, rotation_rms_deg, translation_median_mm, translation_rms_mm, nees (mean normalised
        squared error of the pose over 6), bias_error (median absolute error of the edge bias in spot radii, NaN for
        methods without), converged (share).
    """
    truth = shots["T_camera_lrf"]
    rows = []
    for method, found in solutions.items():
        pose = found.transform.as_matrix()[:, :3]
        w = Rotation.from_matrix(pose[..., :3] @ np.swapaxes(truth[..., :3], -1, -2)).as_rotvec()
        v = pose[..., 3] - truth[..., 3]
        error = np.concatenate([w, v], axis=-1)
        angle, distance = np.degrees(np.linalg.norm(w, axis=-1)), 1000 * np.linalg.norm(v, axis=-1)
        spread = np.linalg.solve(found.covariance[..., :6, :6], error[..., None])[..., 0]
        row = {"method": method, "rotation_median_deg": np.median(angle), "rotation_rms_deg": _rms(angle)}
        row |= {"translation_median_mm": np.median(distance), "translation_rms_mm": _rms(distance)}
        bias = np.abs(edge_bias(found)[0] - setup.bias) if method == "line_ml" else np.array([np.nan])
        row |= {"nees": np.mean(np.sum(error * spread, axis=-1)) / 6, "bias_error": np.median(bias)}
        rows.append(row | {"converged": np.mean(found.converged)})
    return pd.DataFrame(rows)


def _rms(values):
    return float(np.sqrt(np.mean(values**2)))


def start_near(shots, rng, rotation=0.05, shift=0.05):
    """Start values some degrees and centimetres off the truth, a stack of RigidTransform."""
    truth = shots["T_camera_lrf"]
    turn = Rotation.from_rotvec(rng.normal(0, rotation, truth.shape[:1] + (3,)))
    moved = truth[..., 3] + rng.normal(0, shift, truth.shape[:1] + (3,))
    return RigidTransform.from_components(moved, turn * Rotation.from_matrix(truth[..., :3]))
