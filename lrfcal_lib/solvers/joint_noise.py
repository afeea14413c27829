"""Noise levels of the joint estimate from its own residuals, and placements that contradict all others.

Real devices err alike at neighbouring points: a board bends, print reads nearer or farther than paper. Residuals
averaged over parts of a board then scatter more than independent ones would; the observations count accordingly less.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lrfcal_lib.solvers.joint_blocks import (
    SIDE_FREEDOM,
    SWEEPS,
    Unknowns,
    edge_distance,
    named_blocks,
    rays,
    view_block,
    view_whitener,
)
from lrfcal_lib.solvers.least_squares import whiten

PARTS = 3  # of a board in x and y, and of an edge
PLANE = 3  # numbers of a plane, that a placement's own pose takes up
PITCH_LEVELS = np.radians([0.0, 0.001, 0.002, 0.003, 0.005, 0.007, 0.01, 0.015, 0.02, 0.03, 0.05, 0.1])
LEAST_FREEDOM = 0.2  # share of the residuals of views that a scale is taken from, at least
SCALE_ROUNDS, SCALE_LIMITS = 4, (1e-4, 1e4)
CONTRADICTION = 16.0  # mean squared residual, relative to the median placement's
LEAST_MISFIT = 1e-6  # of images: below, they agree exactly
LARGEST_SHARE = 0.3  # of the placements that may contradict the others
SETTLED = 0.02  # change of the logarithm of a noise level
ROUGH_MISS = 0.08  # metres, of a board's face from where the first image of it puts it


def estimate_noise(state, data, unknowns):
    """Update the noise levels from the residuals at a solution.

    Parameters
    ----------
    state : JointState
    data : JointData
    unknowns : Unknowns

    Returns
    -------
    JointData
    """
    blocks = named_blocks(state, data, unknowns)
    own = own_variance(blocks, unknowns)
    if "face" in blocks:
        data = replace(data, **face_levels(state, data, blocks["face"]))
    if "beam" in blocks:
        data = replace(data, beam_share=beam_share(state, data, blocks["beam"], unknowns))
    if "view" in blocks:
        data = view_levels(data, blocks["view"], state)
    first = 6 + SWEEPS[unknowns.sweep]
    if unknowns.sides:
        data = replace(data, side_sigma=side_level(state.sides, own[:, first:], data.side_sigma))
    if SWEEPS[unknowns.sweep]:
        found = np.sqrt(np.mean(state.sweeps[:, : first - 6] ** 2 + own[:, 6:first], axis=0))
        data = replace(data, sweep_sigma=(*np.maximum(found, 1e-6), *data.sweep_sigma[len(found) :]))
    return data


def own_variance(blocks, unknowns):
    """Variances of every placement's own unknowns with the shared ones held, shape (p, l)."""
    c = unknowns.shared
    hessian = 0.0
    for block in blocks.values():
        J = whiten(block)[1][..., c:]
        hessian = hessian + np.swapaxes(J, -1, -2) @ J
    return np.diagonal(np.linalg.pinv(hessian, rcond=1e-13, hermitian=True), axis1=1, axis2=2)


def face_levels(state, data, block):
    """Scale of the ranges' noise, and the share of independent errors, from means over parts of the boards."""
    used = data.face["used"]
    z = np.where(used, block.residuals / np.where(used, data.face["sigma"], 1.0), 0.0)
    number = used.sum(axis=1)
    scale = np.sqrt(np.sum(z**2) / max(np.sum(np.maximum(number - PLANE, 1)), 1))
    x = on_board(state, data)
    part = _part(x[..., 0], used) * PARTS + _part(x[..., 1], used)
    rows = np.arange(len(used))[:, None] * PARTS**2 + part
    size = len(used) * PARTS**2
    total, count = np.bincount(rows[used], z[used], size), np.bincount(rows[used], minlength=size)
    full = count > 1
    free = full.sum() - PLANE * np.sum(number > 0)
    ratio = np.sum(total[full] ** 2 / count[full]) / scale**2 / max(free, 1)
    return {"face_scale": float(scale), "face_share": float(1 / max(ratio, 1.0))}


def on_board(state, data):
    """Measured face points in the boards' frames, shape (p, n, 3)."""
    o, d = rays(state, data, data.face)[:2]
    x = o + (data.face["range"] - state.sensor[0])[..., None] * d - state.boards[:, None, :, 3]
    return x @ state.boards[:, :, :3]


def _part(values, used):
    """Third of the spread of values that each one lies in, row by row."""
    ordered = np.where(used | ~used.any(axis=1, keepdims=True), values, np.nan)
    limits = np.nanquantile(ordered, np.arange(1, PARTS) / PARTS, axis=1)
    return np.sum(values[None] > limits[..., None], axis=0)


def beam_share(state, data, block, unknowns):
    """Share of independent errors among neighbouring beams, from the scores of parts of every edge."""
    used = data.beam["used"]
    ray = rays(state, data, data.beam)
    a, t = edge_distance(state, data, data.beam, ray)[4:6]
    o, d = ray[:2]
    normal, origin = state.boards[:, None, :, 2], state.boards[:, None, :, 3]
    r = np.sum(normal * (origin - o), axis=-1) / np.sum(normal * d, axis=-1)
    along = np.sum((o + r[..., None] * d - origin - a) * t, axis=-1)
    root = np.linalg.norm(block.jacobian[..., unknowns.shared + 3 : unknowns.shared + 6], axis=-1)  # root information
    score = block.residuals * root
    ratios = []
    for edge in range(len(data.lines)):
        mine = used & (data.beam["edge"] == edge)
        part = _part(along, mine)
        for k in range(PARTS):
            here = mine & (part == k)
            information = np.sum(np.where(here, root**2, 0.0), axis=1)
            total = np.sum(np.where(here, score, 0.0), axis=1)
            ratios.append(np.divide(total**2, information, out=np.full(len(total), np.nan), where=information > 0))
    ratio = np.nanmean(ratios) * PARTS / (PARTS - 1) if np.isfinite(ratios).any() else 1.0
    return float(1 / max(ratio, 1.0))


def view_levels(data, block, state):
    """Scale of the pose errors in images and the error of the pitch of single images: the most likely pair.

    One scale serves all cameras: with one view each, a camera could buy itself perfection at the other's cost.
    """
    p, v = data.view["used"].shape
    r, used, by_pitch = block.residuals.reshape(p, v, 6), data.view["used"], pitch_columns(state, data)
    free = 1 - 6 * used.any(axis=1).sum() / max(6 * used.sum(), 1)  # the boards' own poses take up the rest
    free = max(free, LEAST_FREEDOM)

    def level(sigma):
        trial = replace(data, sigma_pitch=float(sigma))
        for _ in range(SCALE_ROUNDS):
            z = (view_whitener(trial, by_pitch) @ r[..., None])[..., 0][used]
            factor = np.sqrt(np.mean(z**2) / free)
            trial = replace(trial, view_scale=np.clip(trial.view_scale * factor**0.7, *SCALE_LIMITS))
        whitener = view_whitener(trial, by_pitch)
        z = (whitener @ r[..., None])[..., 0][used]
        return 0.5 * np.sum(z**2) / free - np.log(np.diagonal(whitener[used], axis1=-2, axis2=-1)).sum(), trial

    found = [level(sigma) for sigma in (PITCH_LEVELS if data.on_head.any() else PITCH_LEVELS[:1])]
    return min(found, key=lambda pair: pair[0])[1]


def pitch_columns(state, data):
    """Derivative of the views' residuals by the pitch of the image, shape (p, v, 6); zero for cameras on the base."""
    c = len(state.cameras)
    lone = Unknowns(c, len(data.lines), axis=False, poses=False, sensor=("pitch_by_direction",))
    turned = replace(data, direction=np.ones(len(data.direction)))
    J = view_block(state, turned, lone).jacobian
    return J[..., 0].reshape(J.shape[0], -1, 6)


def side_level(sides, variance, sigma):
    """Scale of the sides' deviations, Student's t by expectation and maximisation."""
    square = sides**2 + variance
    for _ in range(20):
        weight = (SIDE_FREEDOM + 1) / (SIDE_FREEDOM + square / sigma**2)
        sigma = np.sqrt(np.mean(weight * square))
    return float(np.clip(sigma, 0.01, 2.0))


def misfits(blocks, data, groups=("face", "view")):
    """Normalised mean squared residual of ranges and views of each placement; 1 is what the noise explains, (p,)."""
    total, count = np.zeros(len(data.middle)), np.zeros(len(data.middle))
    for name in set(groups) & set(blocks):
        share, numbers = (data.face_share, 1) if name == "face" else (1.0, 6)
        total += np.sum(whiten(blocks[name], False)[0] ** 2, axis=1) / share
        count += numbers * getattr(data, name)["used"].sum(axis=1)
    return total / np.maximum(count - 6, 1)


def rough_misses(state, data):
    """Median distance of every board's face points from where the start value puts the board, metres, (p,)."""
    return _medians(np.abs(on_board(state, data)[..., 2]), data.face["used"])


def image_misses(state, data, boards, placement):
    """Median distance of face points from boards (n, 3, 4) of some placements (n,), metres, (n,)."""
    o, d = rays(state, data, data.face)[:2]
    x = (o + (data.face["range"] - state.sensor[0])[..., None] * d)[placement] - boards[:, None, :, 3]
    return _medians(np.abs(np.sum(x * boards[:, None, :, 2], axis=-1)), data.face["used"][placement])


def _medians(values, used):
    """Medians of the used values of every row; 0 where there are none."""
    return np.array([np.median(row[mine]) if mine.any() else 0.0 for row, mine in zip(values, used, strict=True)])


def view_misses(state, data):
    """Median distance of every board from where its images put it, metres, (p,); 0 without images."""
    used = data.view["used"]
    if not used.any():
        return np.zeros(len(used))
    lone = Unknowns(len(state.cameras), len(data.lines), axis=False, poses=False, sensor=())
    shift = view_block(state, data, lone).residuals.reshape(used.shape + (6,))[..., 3:]
    return _medians(np.linalg.norm(shift, axis=-1), used)


def same_levels(before, after):
    """Whether noise levels have settled within a few per cent."""
    ratios = [getattr(after, name) / getattr(before, name) for name in ("face_scale", "face_share", "beam_share")]
    ratios += (after.view_scale / before.view_scale).tolist()
    return bool(np.all(np.abs(np.log(ratios)) < SETTLED))
