"""The platform calibration as the paper prints it: projected line fits, equations (7) to (15)."""

from __future__ import annotations

import numpy as np

from lrfcal_lib.geometry import DegenerateGeometry, axis_of, fit_line, head_from_axis, tilt
from lrfcal_lib.solvers.least_squares import Block, solve
from lrfcal_lib.solvers.platform import (
    AXIS_NAMES,
    axis_words,
    platform_solution,
    start_head,
)
from lrfcal_lib.solvers.platform_blocks import CHART, chart_parameters, move_head
from lrfcal_lib.solvers.pose import cross, pose_array, pose_transform

LEAST_SLOPE = 0.1  # nearer to a coordinate plane (6 degrees) a projected fit is useless


def solve_projected(obs, T0=None, *, least_slope=LEAST_SLOPE, max_iterations=100, required=True):
    """The tilt axis by the paper's projected line fits.

    Parameters
    ----------
    obs : PlatformObservations
        Its edge points are used, without their covariance.
    T0 : RigidTransform, optional
        Start value of ``T_head_lrf``; see :func:`lrfcal_lib.solvers.platform.start_head`.
    least_slope : float
        A placement is left out when an edge is nearer than this (radians) to the xy or the xz plane of the platform.
    max_iterations : int
    required : bool
        False: report unobservable motions instead of raising.

    Returns
    -------
    PlatformSolution
        `skipped` names the placements with an edge parallel to a coordinate plane: their projected fits would divide by
        zero. The covariance comes from the scatter of the residuals.

    Raises
    ------
    DegenerateGeometry
        When no placement is left, or when the data leave a motion of the axis open.

    Notes
    -----
    Equation (15) is garbled; it is read as the sum over the placements of the squares of six terms: the root mean
    square errors of the four projected fits (each point's error over the root of their number enters, which has the
    same sum of squares and stays smooth), ``|u1 . u2|`` of the unit directions (unit vectors, because the paper's (9)
    and (10) grow beyond bounds for level edges) and the gap D in metres. These have different units and no weights: the
    result depends on that. :func:`lrfcal_lib.solvers.platform.solve_platform` weighs every term by its noise.
    """
    head = pose_array(start_head(T0))
    groups, skipped = _usable(obs, head, least_slope)
    if not groups:
        raise DegenerateGeometry(f"projected fits: no placement can be used: {skipped}; use the 3D fits instead")
    rows = np.concatenate([np.full(2 * (len(a) + len(b)) + 2, placement) for placement, a, b in groups])
    options = dict(
        names=AXIS_NAMES, method="platform_projected", words=axis_words, groups=rows, limit=np.inf, required=required,
        read=lambda state: (pose_transform(state), chart_parameters(state)), max_iterations=max_iterations,
    )  # fmt: skip
    first = solve(lambda state: projected_block(state, obs, groups), head, move_head, **options)
    gauge = pose_array(head_from_axis(axis_of(first.transform)))
    count = len(first.residuals)
    scatter = max(np.sqrt(np.sum(first.residuals**2) / max(count - 4, 1)), 1e-6)
    found = solve(
        lambda state: _scaled(projected_block(state, obs, groups), scatter), gauge, move_head,
        earlier=[first.cost_history], **options,
    )  # fmt: skip
    placements = np.array([g[0] for g in groups])
    skew, gap = _properties(found, groups, scatter)
    return platform_solution(found, placements, skew, gap, skipped)


def _scaled(block, scatter):
    return Block(block.residuals, block.jacobian, np.full_like(block.residuals, 1.0 / scatter))


def _properties(found, groups, scatter):
    """Cosine of the two edges and their gap, the last two residuals of every placement."""
    ends = np.cumsum([2 * (len(a) + len(b)) + 2 for _, a, b in groups])
    residuals = found.residuals * scatter
    return np.arcsin(np.clip(residuals[ends - 2], -1, 1)), residuals[ends - 1]


def _usable(obs, head, least_slope):
    """Rows of edges 1 and 2 of every placement whose edges are slanted to the coordinate planes; reasons."""
    q = tilt(obs.points @ head[:, :3].T + head[:, 3], obs.pitch)
    groups, skipped = [], {}
    for placement in np.unique(obs.placement):
        rows = [np.flatnonzero((obs.placement == placement) & (obs.edge == e)) for e in (1, 2)]
        reason = ""
        for number, r in enumerate(rows, start=1):
            if len(r) < 3:
                reason = reason or f"edge {number} has {len(r)} points, at least 3 needed"
                continue
            direction = np.abs(fit_line(q[r])[1])
            for axis, plane in ((2, "xy"), (1, "xz")):
                if direction[axis] < least_slope:
                    reason = (
                        reason or f"edge {number} is parallel to the {plane} plane: its projected fits divide by zero"
                    )
        if reason:
            skipped[int(placement)] = reason
        else:
            groups.append((int(placement), *rows))
    return groups, skipped


def projected_block(head, obs, groups):
    """The six terms of equation (15) of every placement, with their analytic Jacobian by the axis chart.

    Parameters
    ----------
    head : ndarray, shape (3, 4)
        ``T_head_lrf``.
    obs : PlatformObservations
    groups : list of (placement, rows of edge 1, rows of edge 2)

    Returns
    -------
    Block
    """
    rotated = obs.points @ head[:, :3].T
    q = tilt(rotated + head[:, 3], obs.pitch)
    slopes = np.stack([_coordinate_slope(rotated, obs.pitch, axis) for axis in range(3)], axis=1)
    parts = [_placement_terms(q, slopes, a, b) for _, a, b in groups]
    residuals, jacobian = (np.concatenate([part[i] for part in parts]) for i in range(2))
    return Block(residuals, jacobian, np.ones_like(residuals))


def _coordinate_slope(rotated, pitch, axis):
    """Derivative (n, 4) of a platform coordinate of every point by the axis chart."""
    gradient = tilt(np.broadcast_to(np.eye(3)[axis], rotated.shape), -pitch)
    return np.concatenate([cross(rotated, gradient), gradient], axis=1)[:, CHART]


def _placement_terms(q, slopes, first, second):
    """Residuals (2 n1 + 2 n2 + 2,) of one placement and their Jacobian."""
    lines = [_projected_line(q[rows], slopes[rows]) for rows in (first, second)]
    (u1, du1, p1, dp1), (u2, du2, p2, dp2) = (line[2:] for line in lines)
    normal = np.cross(u1, u2)
    dnormal = np.cross(du1.T, u2) + np.cross(u1, du2.T)
    length, between = np.linalg.norm(normal), p1 - p2
    gap = normal @ between / length
    dgap = (dnormal @ between + (dp1 - dp2).T @ normal) / length - gap * (dnormal @ normal) / length**2
    residuals = [lines[0][0], lines[1][0], [u1 @ u2, gap]]
    jacobian = [lines[0][1], lines[1][1], np.stack([u2 @ du1 + u1 @ du2, dgap])]
    return np.concatenate(residuals), np.concatenate(jacobian)


def _projected_line(q, slopes):
    """Fit ``x = a z + b`` and ``z = c y + d`` (equations (7), (8)) to one edge.

    Returns
    -------
    errors : ndarray, shape (2 n,)
        Over the root of n.
    jacobian : ndarray, shape (2 n, 4)
    direction, its jacobian (3, 4), point, its jacobian (3, 4)
        Equations (9) to (12): ``u ~ (a, 1 / c, 1)`` as a unit vector and ``p = (b, -d / c, 0)``.
    """
    x, y, z = q.T
    dx, dy, dz = (slopes[:, i] for i in range(3))
    e1, de1, a, da, b, db = _regression(z, dz, x, dx)
    e2, de2, c, dc, d, dd = _regression(y, dy, z, dz)
    root = np.sqrt(len(q))
    raw, draw = np.array([a, 1 / c, 1.0]), np.stack([da, -dc / c**2, 0 * da])
    length = np.linalg.norm(raw)
    u = raw / length
    du = (draw - np.outer(u, u @ draw)) / length
    point, dpoint = np.array([b, -d / c, 0.0]), np.stack([db, -dd / c + d * dc / c**2, 0 * da])
    return np.concatenate([e1, e2]) / root, np.concatenate([de1, de2]) / root, u, du, point, dpoint


def _regression(s, ds, v, dv):
    """Errors, slope and offset of the straight-line fit ``v = slope s + offset``, each with its derivative."""
    sc, dsc, vc, dvc = (w - w.mean(axis=0) for w in (s, ds, v, dv))
    total = sc @ sc
    slope = sc @ vc / total
    errors = vc - slope * sc
    dslope = (dsc.T @ errors + (dvc - slope * dsc).T @ sc) / total
    derrors = dvc - slope * dsc - np.outer(sc, dslope)
    offset = v.mean() - slope * s.mean()
    doffset = dv.mean(axis=0) - slope * ds.mean(axis=0) - dslope * s.mean()
    return errors, derrors, slope, dslope, offset, doffset
