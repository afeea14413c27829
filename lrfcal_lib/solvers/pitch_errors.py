"""Errors of the recorded pitch, found from the board planes that cameras on the base see.

A constant error is only a turn of the platform frame, and each camera's pose takes it up. An error that differs between
sweeps does not: scans of one board then disagree with the cameras. Nested models are compared with an F-test whose
independent numbers are placements, not points: neighbouring points err together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.stats import f as f_distribution

from lrfcal_lib.solvers.least_squares import solve
from lrfcal_lib.solvers.pitch_blocks import (
    MODELS,
    gather,
    misfit,
    move_pitch_state,
    pitch_blocks,
)
from lrfcal_lib.solvers.pose import pose_array, pose_transform
from lrfcal_lib.solvers.start import start_from_planes


@dataclass(frozen=True)
class SweepPoints:
    """Points on the boards' faces as the LRF measured them.

    Attributes
    ----------
    points : ndarray, shape (m, 3)
        LRF frame, metres.
    pitch : ndarray, shape (m,)
        Recorded pitch, radians.
    placement : ndarray of int, shape (m,)
    T_head_lrf : RigidTransform
    direction : dict of int to int
        Sweep direction (+1 or -1; 0 for a single shot) of each placement.
    middle : dict of int to float, optional
        Pitch about which a sweep is stretched; the mean of the points' pitch when left out.
    """

    points: np.ndarray
    pitch: np.ndarray
    placement: np.ndarray
    T_head_lrf: RigidTransform
    direction: dict[int, int]
    middle: dict[int, float] | None = None


@dataclass(frozen=True)
class PitchModel:
    """One of the nested models, solved.

    Attributes
    ----------
    name : str
        'none', 'direction' (+offset for sweeps with direction +1, -offset for -1), 'sweep' (an offset each), or
        'sweep_stretch' (an offset and a stretch about the middle each).
    offset, offset_sigma : ndarray, shape (p,)
        Radians to *add* to the recorded pitch of each placement.
    stretch, stretch_sigma : ndarray, shape (p,)
        Relative; the corrected pitch is ``pitch + offset + stretch (pitch - middle)``.
    transforms : dict of str to RigidTransform
        ``T_camera_platform``.
    rms : dict of str to float
        Of all point-plane distances, metres.
    edge_rms : dict of str to float
        Of the crossings' distances from the planes of sight, metres; nan without edges.
    misfit : float
        See :func:`lrfcal_lib.solvers.pitch_blocks.misfit`, m^2.
    n_parameters, n_numbers : int
    F, p_value : float
        Test against the model before (nan for the first): would the misfit fall so much by chance?
    converged : bool
    """

    name: str
    offset: np.ndarray
    offset_sigma: np.ndarray
    stretch: np.ndarray
    stretch_sigma: np.ndarray
    transforms: dict[str, RigidTransform]
    rms: dict[str, float]
    edge_rms: dict[str, float]
    misfit: float
    n_parameters: int
    n_numbers: int
    F: float
    p_value: float
    converged: bool


@dataclass(frozen=True)
class PitchErrors:
    """What the recordings say about the recorded pitch.

    Attributes
    ----------
    placements : ndarray of int, shape (p,)
    direction : ndarray of int, shape (p,)
    direction_offset, direction_sigma : float
        Radians to add to the recorded pitch of sweeps with direction +1 (and to subtract for -1), with its standard
        deviation, the larger of noise (at the level of the residuals) and scatter over the placements. nan where the
        sweeps all go one way.
    models : dict of str to PitchModel
    wanted : str
        The model that the data ask for: each larger one must beat the last one wanted with p < 0.01.
    """

    placements: np.ndarray
    direction: np.ndarray
    direction_offset: float
    direction_sigma: float
    models: dict[str, PitchModel]
    wanted: str


def estimate_pitch_errors(
    sweeps, cameras, T0=None, *, sigma=0.003, sigma_edge=0.003, points=300, use_edges=True, required=False
):
    """Estimate errors of the recorded pitch together with the cameras' poses, in nested models.

    Parameters
    ----------
    sweeps : SweepPoints
    cameras : dict of str to CameraObservations
        Cameras fixed to the platform (``source='platform'``); their board poses are used, and their crossings.
    T0 : dict of str to RigidTransform, optional
        Start values of ``T_camera_platform``.
    sigma, sigma_edge : float
        Standard deviation of one of the three numbers that a placement's scan plane stands for, and of the two that the
        crossings of one edge stand for, metres: how much faces and edges weigh against each other. Neighbouring points
        do not count as independent.
    points : int
        Points used of each placement, evenly thinned.
    use_edges : bool
        False: faces only.
    required : bool
        Raise when the board poses leave a camera's pose open.

    Returns
    -------
    PitchErrors

    Raises
    ------
    DegenerateGeometry
        With fewer than four placements that the LRF and all cameras see.
    ValueError
        When a camera is not fixed to the platform, or an observation is not finite.
    """
    data, sigmas = gather(sweeps, cameras, points, use_edges), (sigma, sigma_edge)
    start = [pose_array((T0 or {}).get(name) or start_from_planes(cameras[name])) for name in data.cameras]
    models, state = {}, (np.array(start), 0.0, np.zeros(len(data.placements)), np.zeros(len(data.placements)))
    names = [m for m in MODELS if m != "direction" or len(set(data.direction[data.direction != 0])) == 2]
    direction = (np.nan, np.nan)
    for name in names:
        found, state = _solve_model(name, data, state, sigmas, required)
        if name == "direction":
            direction = float(state[1]), float(found.trusted_sigma[6 * len(data.cameras)])
        previous = models.get(names[names.index(name) - 1]) if models else None
        models[name] = _model(name, data, state, found, previous, sigma)
    return PitchErrors(data.placements, data.direction, *direction, models, wanted_model(models))


def _solve_model(name, data, state, sigmas, required):
    poses, direction, offset, stretch = state
    if name.startswith("sweep"):
        offset, direction = offset + direction * data.direction, 0.0
    start = (poses, direction, offset, stretch)
    cameras = len(poses)
    names = [f"{c}_{n}" for c in data.cameras for n in ("rx", "ry", "rz", "tx", "ty", "tz")] + ["direction_offset"] * (
        name == "direction"
    )

    def read(s):
        return None, np.concatenate([s[0][:, :, 3].ravel(), [s[1]] * (name == "direction")])

    found = solve(
        lambda s: pitch_blocks(s, data, name, *sigmas),
        start,
        lambda s, d: move_pitch_state(s, d, name),
        names=names,
        method=f"pitch_{name}",
        read=read,
        shared=6 * cameras + (name == "direction"),
        required=required,
        limit=10.0,
        freedom=data.n_numbers - 6,
    )
    # the stated sigmas only weigh faces against edges: the level of the noise comes from the residuals
    level = misfit(data, found.state)[0] / max(data.n_numbers - 6, 1) / sigmas[0] ** 2 / found.inflation
    return replace(found, covariance=level * found.covariance), found.state


def _model(name, data, state, found, previous, sigma):
    """Wrap a solved model and test it against the one before."""
    p = len(data.placements)
    total, rms, edge_rms = misfit(data, state)
    pitch_parameters = {"none": 0, "direction": 1, "sweep": p - 1, "sweep_stretch": 2 * p - 1}[name]
    parameters, numbers = 6 + pitch_parameters, data.n_numbers
    small = None if previous is None else (previous.misfit, previous.n_parameters)
    F, p_value = (np.nan, np.nan) if small is None else f_test(*small, total, parameters, numbers)
    level = total / max(numbers - parameters, 1) / sigma**2
    offset_sigma, stretch_sigma = _own_sigmas(name, found, p, len(data.cameras), level)
    offset = state[1] * data.direction + state[2]
    offset = offset - offset.mean() if name.startswith("sweep") else offset
    transforms = {c: pose_transform(pose) for c, pose in zip(data.cameras, state[0], strict=True)}
    return PitchModel(
        name,
        offset,
        offset_sigma,
        state[3],
        stretch_sigma,
        transforms,
        rms,
        edge_rms,
        total,
        parameters,
        numbers,
        float(F),
        p_value,
        bool(found.converged),
    )


def f_test(small_misfit, small_parameters, misfit, parameters, numbers):
    """F and its p-value: would the misfit fall so much by chance when parameters are added?"""
    more, free = parameters - small_parameters, numbers - parameters
    if more <= 0 or free <= 0:
        return np.nan, np.nan
    F = (small_misfit - misfit) / more / (misfit / free)
    return float(F), float(f_distribution.sf(F, more, free))


def wanted_model(models, level=0.01):
    """Name of the model that the data ask for: a larger one must beat the last one wanted at the given level."""
    names = list(models)
    wanted = models[names[0]]
    for name in names[1:]:
        model = models[name]
        test = f_test(wanted.misfit, wanted.n_parameters, model.misfit, model.n_parameters, model.n_numbers)
        wanted = model if test[1] < level else wanted
    return wanted.name


def _own_sigmas(name, found, p, cameras, level):
    """Standard deviations of the sweeps' own unknowns, from the scatter of the residuals (the shared ones held)."""
    if name == "none":
        return np.zeros(p), np.zeros(p)
    if name == "direction":
        return np.full(p, found.trusted_sigma[6 * cameras]), np.zeros(p)
    own = found.jacobian[..., 6 * cameras :]
    inverse = np.linalg.inv(np.swapaxes(own, -1, -2) @ own) * level
    sigma = np.sqrt(np.diagonal(inverse, axis1=1, axis2=2))
    return sigma[:, 0], sigma[:, 1] if name == "sweep_stretch" else np.zeros(p)
