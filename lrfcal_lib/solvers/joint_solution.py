"""What the joint estimate hands over: the rig, and how well it is known.

No equations of its own; residuals are in :mod:`lrfcal_lib.solvers.joint_residuals`.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.covariance import motion_words, pseudo_inverse
from lrfcal_lib.fit.edge_likelihood import disc_edge
from lrfcal_lib.fit.least_squares import (
    Block,
    eliminate,
    linearise,
    reduced_hessian,
    stacked,
)
from lrfcal_lib.fit.result import AXIS_NAMES, AXIS_WORDS, Solution
from lrfcal_lib.model.geometry import (
    POSE,
    POSE_NAMES,
    TiltAxis,
    axis_of,
    pose_transform,
)
from lrfcal_lib.model.kinematics import Corrections, SweepPitch, camera_at
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.model.problem import Problem
from lrfcal_lib.solvers.joint_model import (
    SENSOR,
    JointData,
    JointState,
    Unknowns,
    gather,
)
from lrfcal_lib.solvers.joint_residuals import face_heights, named_blocks

WORDS = dict(zip(AXIS_NAMES, AXIS_WORDS, strict=True)) | {
    "range_offset": "the range offset",
    "edge_log_odds": "the edge bias",
    "edge_log_softness": "the softness of the edges",
    "pitch_scale": "the scale of the pitch",
    "pitch_by_direction": "the pitch offset by sweep direction",
}
NAMED = 0.3  # share of a direction's largest component from which an unknown is named


@dataclass(frozen=True)
class Score:
    """What placements say about the shared unknowns, all that is their own eliminated.

    Attributes
    ----------
    information : ndarray, shape (p, c, c)
    gradient : ndarray, shape (p, c)
        Of half the sum of squares.
    """

    information: np.ndarray
    gradient: np.ndarray

    def solved(
        self, expected: float | np.ndarray = 0.0, off: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What follows where everything is free.

        Parameters
        ----------
        expected : float or ndarray, shape (c,)
            Information about unknowns that are expected to be smaller by `off`.
        off : float

        Returns
        -------
        covariance : ndarray, shape (c, c)
        step : ndarray, shape (c,)
            To the likeliest values.
        pulls : ndarray, shape (p, c)
            Where each placement still pulls them from there.
        """
        whole = self.information.sum(axis=0) + expected * np.eye(self.gradient.shape[1])
        covariance = pseudo_inverse(whole)
        step = -covariance @ (self.gradient.sum(axis=0) + np.multiply(expected, off))
        return covariance, step, (self.gradient + self.information @ step) @ covariance


@dataclass(frozen=True)
class JointSolution:
    """The joint estimate.

    Attributes
    ----------
    solution : Solution
        Of the shared unknowns (covariances, names, convergence).
    observations : JointObservations
        Without what is left out.
    data, unknowns : JointData, Unknowns
        Padded observations with the noise levels used, and what was unknown; for `solvers` only.
    excluded : tuple of Problem
        Placements, cameras and single images left out, with the reason.
    lens : ndarray, shape (c, c)
        The part of the covariances that comes from the intrinsics, which all placements share.
    lens_scale : float
        By how much errors of the intrinsics let board poses in images scatter, in stated standard
        deviations.
    step : ndarray, shape (c,)
        What one standard deviation of the angular step does to the shared unknowns; in the
        covariances.
    """

    solution: Solution
    observations: JointObservations
    data: JointData
    unknowns: Unknowns
    excluded: tuple[Problem, ...]
    lens: np.ndarray
    lens_scale: float
    step: np.ndarray

    @property
    def excluded_placements(self) -> dict[int, str]:
        """Why placements are left out, in words, by their numbers."""
        return {
            problem.placement: str(problem)
            for problem in self.excluded
            if problem.camera is None
        }

    @property
    def state(self) -> JointState:
        """Everything that moved."""
        return self.solution.state

    @property
    def converged(self) -> bool:
        """Whether the last step was small."""
        return bool(self.solution.converged)

    @property
    def unobservable(self) -> tuple[str, ...]:
        """Motions that the data do not determine, in words."""
        return self.solution.unobservable

    @cached_property
    def T_head_lrf(self) -> RigidTransform:
        """In the gauge of the stated platform (rotation about the axis and shift along it cannot
        be observed).
        """
        return pose_transform(self.state.head)

    @cached_property
    def transforms(self) -> dict[str, RigidTransform]:
        """``T_camera_lrf`` or ``T_camera_platform`` by camera."""
        poses = map(pose_transform, self.state.cameras)
        return dict(zip(self.observations.cameras, poses, strict=True))

    @cached_property
    def boards(self) -> dict[int, RigidTransform]:
        """``T_platform_board`` by placement."""
        return self._by_placement(pose_transform(self.state.boards))

    @property
    def board_poses(self) -> np.ndarray:
        """``T_platform_board`` in the order of the observations' placements, shape (p, 3, 4)."""
        return self.state.boards

    @property
    def sensor(self) -> dict[str, float]:
        """Range offset (m), log odds and log softness of the edge, pitch scale, pitch offset by
        direction (rad).
        """
        return dict(zip(SENSOR, self.state.sensor.tolist(), strict=True))

    def _by_placement(self, values):
        return dict(zip(self.observations.placements.tolist(), values, strict=True))

    @property
    def sweep_sigma(self) -> tuple[float, float]:
        """Standard deviations of the pitch's offset (radians) and stretch of every sweep; 0 where
        held.
        """
        offset, stretch, *_ = (*self.data.levels.sweep_sigma, 0.0, 0.0)
        return offset, stretch

    @property
    def side_odds(self) -> np.ndarray:
        """By how much the log odds of each side differ from the sensor's, shape (p, e)."""
        return self.state.sides[:, :-1] + self.state.sides[:, -1:]

    @property
    def noise(self) -> dict[str, float]:
        """Factors on the stated standard deviations, and shares of independent errors, as
        estimated.
        """
        names = (
            "face_scale",
            "face_share",
            "beam_share",
            "sigma_pitch",
            "side_sigma",
            "background_sigma",
            "view_scale",
        )
        return {name: float(getattr(self.data.levels, name)) for name in names}

    @property
    def axis(self) -> TiltAxis:
        """The tilt axis in the LRF frame."""
        return axis_of(self.T_head_lrf)

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviations to rely on of the shared unknowns, by name."""
        return dict(
            zip(self.solution.names, self.solution.trusted_sigma.tolist(), strict=True)
        )

    @property
    def edge_bias(self) -> float:
        """Where readings flip with a background as far and bright as the board, spot radii
        outside the edge.
        """
        return float(disc_edge(self.sensor["edge_log_odds"])[0])

    @property
    def corrections(self) -> Corrections:
        """Errors of what was recorded, as far as they were estimated: range offset, scale and
        sweeps of the pitch.
        """
        turn = self.sensor["pitch_by_direction"] * self.observations.direction
        offset, stretch = self.state.sweeps.T
        sweeps = map(SweepPitch, turn + offset, stretch, self.observations.middle)
        return Corrections(
            self.sensor["range_offset"],
            self.sensor["pitch_scale"],
            self._by_placement(sweeps),
        )

    def columns(self, *names: str) -> list[int]:
        """Indices of the shared unknowns with these names, and of the cameras with these names."""
        wanted = {*names, *(f"{name}_{part}" for name in names for part in POSE_NAMES)}
        return [i for i, name in enumerate(self.solution.names) if name in wanted]

    def covariance(self, *names: str) -> np.ndarray:
        """Covariance to rely on of shared unknowns and of cameras, see `Solution.trusted`."""
        index = self.columns(*names)
        return self.solution.trusted[np.ix_(index, index)]

    def camera_at(self, name: str, pitch: ArrayLike) -> RigidTransform:
        """``T_camera_platform`` of a camera while the head stands at a pitch (radians), or at
        several.
        """
        mount = self.observations.mounts[self.observations.cameras.index(name)]
        return camera_at(self.transforms[name], mount, self.T_head_lrf, pitch)

    def camera(self, name: str) -> Solution:
        """The pose of one camera as a `Solution` like those of the other methods."""
        index = self.columns(name)
        both = np.ix_(index, index)
        whole = self.solution
        return replace(
            whole,
            transform=self.transforms[name],
            parameters=whole.parameters[index],
            names=POSE_NAMES,
            jacobian=whole.jacobian[..., index],
            covariance=whole.covariance[both],
            covariance_placements=whole.covariance_placements[both],
        )

    @cached_property
    def blocks(self) -> dict[str, Block]:
        """Residuals by name at the solution; for `solvers` only."""
        return named_blocks(self.state, self.data, self.unknowns)

    @cached_property
    def misfit(self) -> dict[int, float]:
        """Normalised mean squared residual of ranges and views of each placement; 1 is what the
        noise explains.
        """
        data = self.data
        count = data.face["used"].sum(axis=1) + POSE * data.view["used"].sum(axis=1)
        shares = {"face": data.levels.face_share, "view": 1.0}
        squares = sum(
            np.sum(self.blocks[name].white ** 2, axis=1) / share
            for name, share in shares.items()
            if name in self.blocks
        )
        return self._by_placement((squares / np.maximum(count - POSE, 1)).tolist())

    def residuals(self, group: str) -> np.ndarray:
        """Residuals in the order of the observations.

        Parameters
        ----------
        group : {'face', 'view'}

        Returns
        -------
        ndarray, shape (m, 1) or (v, 6)
            Of ranges to faces, metres, or of poses in images, radians and metres.
        """
        used = getattr(self.data, group)["used"]
        padded = self.blocks[group].residuals.reshape(*used.shape, -1)
        placement = getattr(self.observations, f"{group}_placement")
        rows = np.zeros((len(placement), padded.shape[-1]))
        rows[np.argsort(placement, kind="stable")] = padded[used]
        return rows

    def face_heights(self) -> np.ndarray:
        """Heights of the measured points over their boards, metres, placement by placement."""
        heights = face_heights(self.state, self.data, self.state.boards)
        return heights[self.data.face["used"]]

    def with_levels(self, **changed) -> "JointSolution":
        """The same estimate at other noise levels, fields of
        :class:`lrfcal_lib.solvers.joint_model.Levels` by name.
        """
        return replace(self, data=self.data.with_levels(**changed))

    def score(self, changed: JointObservations | None = None, step: float = 1.0) -> Score:
        """What every placement says about the shared unknowns and, tested, about one more.

        Parameters
        ----------
        changed : JointObservations, optional
            As they would be if the truth were off by one unknown more.
        step : float
            The value of that unknown there.
        """
        r, J = stacked(self.blocks.values())
        shared = self.unknowns.shared
        if changed is not None:
            data = gather(changed, self.data.levels)
            after, _ = stacked(named_blocks(self.state, data, self.unknowns).values())
            J = np.insert(J, shared, (after - r) / step, axis=-1)
            shared += 1
        return Score(*eliminate(J.mT @ J, np.matvec(J.mT, r), shared)[:2])

    def board_information(self) -> np.ndarray:
        """What the scans of every placement say about the pose of its board, shape (p, 6, 6).

        By increments ``[w, v]`` of ``T_platform_board``, with everything else known.
        """
        of_scans = [
            self.blocks[group] for group in ("face", "beam") if group in self.blocks
        ]
        board = self.unknowns.columns["board"]
        return linearise(of_scans).hessian[:, board, board]

    def __repr__(self):
        return f"JointSolution({len(self.boards)} placements, {self.solution!r})"


def joint_words(
    direction: np.ndarray, names: tuple[str, ...], cameras: tuple[str, ...]
) -> str:
    """A direction of the shared unknowns, its largest component 1, in words."""
    large = np.abs(direction) > NAMED
    words = []
    for camera in cameras:
        index = np.isin(names, [f"{camera}_{part}" for part in POSE_NAMES])
        if large[index].any():
            words.append(motion_words(direction[index], camera))
    words += [WORDS[name] for name in np.array(names)[large] if name in WORDS]
    return " with ".join(words)


def expected_information(
    obs: JointObservations, state: JointState, unknowns: Unknowns
) -> np.ndarray:
    """What placements are expected to say about the shared unknowns.

    Parameters
    ----------
    obs : JointObservations
        Of the drawn values nothing enters but which beams and views there are.
    state : JointState
        The truth.
    unknowns : Unknowns

    Returns
    -------
    ndarray, shape (p, c, c)
    """
    data = gather(obs)
    hessian = np.zeros(())
    for reads in (True, False):  # each beam, weighted by how likely that is
        hit = np.full_like(data.beam["hit"], reads)
        trial = replace(data, beam=data.beam | {"hit": hit})
        blocks = named_blocks(state, trial, unknowns)
        if "beam" in blocks:
            beams = blocks.pop("beam")
            J = np.exp(-0.5 * beams.cost)[..., None] * beams.white_jacobian
            hessian = hessian + J.mT @ J
    hessian = hessian + linearise(blocks.values()).hessian
    return reduced_hessian(hessian, unknowns.shared)
