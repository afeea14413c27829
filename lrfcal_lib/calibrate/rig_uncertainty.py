"""How well a calibrated rig is known: covariances of all that is shared, and what nothing tells."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import numpy as np
import pandas as pd
from pydantic import PlainValidator
from scipy.linalg import block_diag

from lrfcal_lib.fit.covariance import dyads, null_space
from lrfcal_lib.fit.least_squares import reduced_hessian
from lrfcal_lib.fit.result import AXIS_NAMES, Solution
from lrfcal_lib.model.geometry import POSE_NAMES
from lrfcal_lib.solvers.joint import SCALES, UNSEEN
from lrfcal_lib.solvers.joint_solution import JointSolution

# what may be wrong about the way of a beam: radians and metres; metres, a fraction, radians
COLUMNS = (*AXIS_NAMES, *POSE_NAMES, "range_offset", "pitch_scale", "pitch_by_direction")


def rows(width: int | None = None, height: int | None = None) -> PlainValidator:
    """How pydantic makes an array of rows of numbers, of any width and as many as there are unless
    given; null is infinite.
    """

    def array_of(given):
        """An array (height, width) of what a file has."""
        values = np.array(given, float)
        if not len(given):
            values = np.zeros((0, width))
        shape = (height or len(given), width or values.shape[-1])
        if values.shape != shape:
            raise ValueError(f"shape {values.shape} instead of {shape}")
        return np.where(np.isnan(values), np.inf, values)

    return PlainValidator(array_of)


Square = Annotated[np.ndarray, rows()]
Motions = Annotated[np.ndarray, rows(len(COLUMNS))]


@dataclass(frozen=True)
class RigUncertainty:
    """How well everything that a rig shares is known, radians and metres.

    Attributes
    ----------
    names : tuple of str, length c
        Of the unknowns: the axis, 'left_rx' to 'left_tz' and so on of each camera, the sensor.
    covariance, trusted : ndarray, shape (c, c)
        Of the increments, from the noise alone and to rely on, see
        :class:`lrfcal_lib.fit.result.Solution`; not finite where nothing bounds an unknown.
    lens : ndarray, shape (c, c)
        What errors of the intrinsics have in both.
    unseen_of_cloud : ndarray, shape (m, 13)
        Motions of `COLUMNS` that nothing determines and that move points of the cloud.
    unseen_of_cameras : dict of str to ndarray, shape (m, 13)
        Those that move what a camera sees.
    sweep_sigma : tuple of float
        Of the offset (radians) and the stretch that the pitch of every sweep has of its own.
    range_noise : float
        Standard deviation of one range, metres.
    """

    names: tuple[str, ...]
    covariance: Square
    trusted: Square
    lens: Square
    unseen_of_cloud: Motions
    unseen_of_cameras: dict[str, Motions]
    sweep_sigma: tuple[float, float]
    range_noise: float


@cache  # asked for at every edge of a scene
def columns_of(names: tuple[str, ...], camera: str | None = None) -> np.ndarray:
    """Where each of `COLUMNS` stands among shared unknowns, -1 where it was none, (13,)."""
    poses = [f"{camera}_{name}" for name in POSE_NAMES]
    return pd.Index(names).get_indexer([*AXIS_NAMES, *poses, *COLUMNS[10:]])


def joint_uncertainty(solution: JointSolution) -> RigUncertainty:
    """What a joint estimate says about its rig.

    Parameters
    ----------
    solution : JointSolution

    Returns
    -------
    RigUncertainty
    """
    estimate = solution.solution
    information = solution.score().information.sum(axis=0)
    noise = 0.0
    if len(solution.observations.face_sigma):
        noise = solution.noise["face_scale"] * np.median(solution.observations.face_sigma)
    return RigUncertainty(
        names=estimate.names,
        covariance=estimate.covariance,
        trusted=estimate.trusted,
        lens=solution.lens,
        unseen_of_cloud=_unseen(information, estimate.names),
        unseen_of_cameras={
            camera: _unseen(information, estimate.names, camera)
            for camera in solution.transforms
        },
        sweep_sigma=solution.sweep_sigma,
        range_noise=noise,
    )


def uncertainty_one_by_one(
    of_axis: np.ndarray,
    solutions: Mapping[str, Solution],
    *,
    admitted_offset: float,
    sweep_sigma: tuple[float, float],
    range_noise: float,
) -> RigUncertainty:
    """What cameras that were calibrated one by one say about their rig, each by itself.

    Parameters
    ----------
    of_axis : ndarray, shape (4, 4)
        Covariance of the axis.
    solutions : dict of str to Solution
        By camera.
    admitted_offset : float
        What the range offset may be, metres.
    sweep_sigma, range_noise
        See :class:`RigUncertainty`.

    Returns
    -------
    RigUncertainty
    """
    names = (
        *AXIS_NAMES,
        *(f"{camera}_{name}" for camera in solutions for name in POSE_NAMES),
        "range_offset",
    )
    noise_only = [solution.covariance[:6, :6] for solution in solutions.values()]
    trusted = [solution.trusted[:6, :6] for solution in solutions.values()]
    offset = np.array([[admitted_offset**2]])
    nothing = np.zeros((0, len(COLUMNS)))
    return RigUncertainty(
        names=names,
        covariance=block_diag(of_axis, *noise_only, offset),
        trusted=block_diag(of_axis, *trusted, offset),
        lens=np.zeros((len(names), len(names))),
        unseen_of_cloud=nothing,
        unseen_of_cameras=dict.fromkeys(solutions, nothing),
        sweep_sigma=sweep_sigma,
        range_noise=range_noise,
    )


def _unseen(information, names, camera=None):
    """Motions (m, 13) of the links to a camera, or to the cloud, that leave no trace.

    What stays open beside the links leaves none either: cameras that planes fix are known,
    whatever the edge bias.
    """
    index = columns_of(names, camera)
    known = index >= 0
    links = index[known]
    order = np.concatenate([links, np.setdiff1d(np.arange(len(names)), links)])
    scales = np.array([SCALES.get(name, 1.0) for name in names])[order]
    whole = information[np.ix_(order, order)]
    hessian = reduced_hessian((whole * dyads(scales))[None], len(links))[0]
    motions = null_space(hessian, np.ones(len(links)), UNSEEN)
    unseen = np.zeros((len(motions), len(COLUMNS)))
    unseen[:, known] = motions * scales[: len(links)]
    return unseen
