"""What is suspicious about a joint estimate, in words, before anybody believes its numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lrfcal_lib.solvers.joint_blocks import named_blocks
from lrfcal_lib.solvers.least_squares import whiten

NOISE_LIMITS = (0.5, 2.0)  # scatter of residuals in stated standard deviations that still agrees with the statement
ASKED = 20.0  # squared score in standard deviations: chance alone exceeds it once in 100 000 times
WEAK_DIRECTION, WEAK_OFFSET = np.radians(1.0), 0.020  # standard deviations of an axis nobody should rely on
TERMS = {
    "pitch_scale": (0.001, "the scale of the pitch", 100.0, "%"),
    "pitch_by_direction": (np.radians(0.01), "a pitch offset by sweep direction", np.degrees(1.0), "deg"),
}


def joint_warnings(blocks, data, unknowns, found, names):
    """Warnings about a joint estimate.

    Parameters
    ----------
    blocks : dict of str to Block
        Of :func:`lrfcal_lib.solvers.joint_blocks.named_blocks` at the solution.
    data : JointData
    unknowns : Unknowns
    found : Solution
    names : tuple of str
        Of the cameras.

    Returns
    -------
    tuple of str
    """
    words = [] if found.converged else [f"not converged after {found.iterations} iterations: do not use the result"]
    words += [f"the data do not determine {motion}" for motion in found.unobservable]
    words += noise_words(blocks, data, names)
    words += weak_words(found)
    return tuple(words + asked_words(found.state, data, unknowns))


def noise_words(blocks, data, names):
    """Groups of observations that scatter more or less than stated."""
    scatter = {}
    if "face" in blocks:
        z = whiten(blocks["face"], False)[0][data.face["used"]] / np.sqrt(data.face_share)
        scatter["ranges", "face_sigma"] = np.sqrt(np.mean(z**2))
    if "view" in blocks:
        z = whiten(blocks["view"], False)[0].reshape(data.view["used"].shape + (6,))
        for number, name in enumerate(names):
            mine = data.view["used"] & (data.view["camera"] == number)
            if mine.sum() > len(data.middle):  # more views than placements: what a board's own pose takes up is minor
                scatter[f"poses of the board in camera '{name}'", "view_covariance"] = np.sqrt(np.mean(z[mine] ** 2))
    low, high = NOISE_LIMITS
    return [
        f"the {what} scatter {level:.2g} times what is stated ({field}): standard deviations of the result are off "
        "alike; noise='estimate' takes the level from the residuals"
        for (what, field), level in scatter.items()
        if not low < level < high
    ]


def weak_words(found):
    """A tilt axis that is hardly known."""
    sigma = dict(zip(found.names, found.sigma, strict=True))
    axis = [value for name, value in sigma.items() if name.startswith("axis_")]
    offset = [value for name, value in sigma.items() if name.startswith("offset_")]
    if not axis:
        return []
    turn, shift = np.linalg.norm(axis), np.linalg.norm(offset)
    if turn < WEAK_DIRECTION and shift < WEAK_OFFSET:
        return []
    return [
        f"the tilt axis is weakly known ({np.degrees(turn):.2f} deg, {1000 * shift:.0f} mm): sweep over a larger pitch "
        "range, take images at more pitch angles, or state the platform with its accuracy"
    ]


def asked_words(state, data, unknowns):
    """Errors of the pitch that were held at zero although the residuals ask for them (a score test)."""
    held = [name for name in TERMS if name not in unknowns.sensor]
    if not held:
        return []
    words, wider = [], replace(unknowns, sensor=(*unknowns.sensor, *held))
    for name, (square, value) in score_tests(state, data, wider, held).items():
        least, what, factor, unit = TERMS[name]
        if square > ASKED and abs(value) > least:
            words.append(f"the data ask for {what}, about {factor * value:+.2f} {unit}, which was held at zero")
    return words


def score_tests(state, data, unknowns, held):
    """Squared scores of shared unknowns held at zero, in standard deviations, and the values they would take.

    Each one is tested by itself, with all that was estimated free.
    """
    c, hessian, gradient = unknowns.shared, 0.0, 0.0
    for block in named_blocks(state, data, unknowns).values():
        r, J = whiten(block)
        transposed = np.swapaxes(J, -1, -2)
        hessian, gradient = hessian + transposed @ J, gradient + (transposed @ r[..., None])[..., 0]
    inverse = np.linalg.pinv(hessian[:, c:, c:], rcond=1e-12, hermitian=True)
    back = hessian[:, :c, c:] @ inverse
    whole = np.sum(hessian[:, :c, :c] - back @ hessian[:, c:, :c], axis=0)
    score = np.sum(gradient[:, :c] - (back @ gradient[:, c:, None])[..., 0], axis=0)
    names = unknowns.names(range(unknowns.cameras), range(unknowns.edges))
    others, out = [i for i, name in enumerate(names) if name not in held], {}
    for name in held:
        free = [*others, names.index(name)]
        covariance = np.linalg.pinv(whole[np.ix_(free, free)], rcond=1e-14, hermitian=True)
        step = -(covariance @ score[free])[-1]
        out[name] = float(step**2 / max(covariance[-1, -1], 1e-300)), float(step)
    return out
