"""The joint model: what moves, what of it is unknown, and the observations it is compared with.

Poses of equations (4) to (6) and (16); residuals are in :mod:`lrfcal_lib.solvers.joint_residuals`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, compress, pairwise, starmap

import numpy as np

from lrfcal_lib.fit.axis_chart import chart_parameters, move_head
from lrfcal_lib.fit.covariance import inverse_root
from lrfcal_lib.fit.padding import pad
from lrfcal_lib.fit.result import AXIS_NAMES, PlatformPrior
from lrfcal_lib.model.board import outline_lines
from lrfcal_lib.model.geometry import (
    POSE_NAMES,
    move_pose,
    polar_to_points,
    pose_parameters,
)
from lrfcal_lib.model.observations import JointObservations

SENSOR = (
    "range_offset",
    "edge_log_odds",
    "edge_log_softness",
    "pitch_scale",
    "pitch_by_direction",
)
SWEEPS = {"none": 0, "offset": 1, "offset_stretch": 2}
LARGEST_ODDS = 8.0  # beyond, the edge lies at the rim of the spot whatever the odds
SOFTEST = np.log([1e-3, 10.0])  # spot radii, limits of the softness


@dataclass(frozen=True, eq=False)
class JointState:
    """Everything that moves.

    Attributes
    ----------
    head, cameras, boards : ndarray, shapes (3, 4), (c, 3, 4), (p, 3, 4)
        ``T_head_lrf``, ``T_camera_lrf`` (mount 'head') or ``T_camera_platform`` (mount 'platform'),
        ``T_platform_board``.
    sensor : ndarray, shape (5,)
        In the order of `SENSOR`: metres, log odds, log of spot radii, fraction, radians.
    sweeps : ndarray, shape (p, 2)
        Offset (radians) and stretch of the recorded pitch of each sweep.
    sides : ndarray, shape (p, e + 1)
        By how much the log odds of each side differ from the sensor's: what stands behind it is
        darker or brighter. The last column is common to all sides of a placement: one wall behind
        the board.
    """

    head: np.ndarray
    cameras: np.ndarray
    sensor: np.ndarray
    boards: np.ndarray
    sweeps: np.ndarray
    sides: np.ndarray

    def of_placements(self, rows) -> "JointState":
        """The state of some placements (indices, or a mask)."""
        return replace(
            self, boards=self.boards[rows], sweeps=self.sweeps[rows], sides=self.sides[rows]
        )


def undisturbed(obs, head, cameras, sensor, boards) -> JointState:
    """A state whose sweeps have no errors of their own, and whose sides are like all others."""
    count = len(boards)
    sweeps = np.zeros((count, 2))
    sides = np.zeros((count, len(obs.edges) + 1))
    return JointState(head, cameras, sensor, boards, sweeps, sides)


@dataclass(frozen=True)
class Unknowns:
    """Which columns of the full Jacobian are unknown.

    `cameras` and `edges` are their numbers, `sensor` names some of `SENSOR`, `sweep` one of
    `SWEEPS`; `sides` tells whether every placement, and every side of it, has a deviation of its
    own from the sensor's edge bias.
    """

    cameras: int
    edges: int
    axis: bool = True
    sensor: tuple[str, ...] = SENSOR[:3]
    sweep: str = "none"
    sides: bool = False

    @property
    def mask(self) -> np.ndarray:
        """Of the full set of shared columns, those that are unknown."""
        sensor = [name in self.sensor for name in SENSOR]
        return np.array([self.axis] * 4 + [True] * 6 * self.cameras + sensor)

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Where the unknowns stand in a Jacobian: first the shared ones, then the placement's
        own.
        """
        widths = {
            "axis": 4 * self.axis,
            "cameras": 6 * self.cameras,
            **{name: name in self.sensor for name in SENSOR},
            "board": 6,
            "sweep": SWEEPS[self.sweep],
            "sides": (self.edges + 1) * self.sides,
        }
        ends = accumulate(widths.values(), initial=0)
        return dict(zip(widths, starmap(slice, pairwise(ends)), strict=True))

    @property
    def shared(self) -> int:
        """Number of unknowns common to all placements."""
        return self.columns["board"].start

    @property
    def size(self) -> int:
        """Number of unknowns of one placement, with the shared ones."""
        return self.columns["sides"].stop

    def names(self, cameras) -> tuple[str, ...]:
        """Names of the shared unknowns, of cameras with these names."""
        poses = [f"{camera}_{name}" for camera in cameras for name in POSE_NAMES]
        return tuple(compress([*AXIS_NAMES, *poses, *SENSOR], self.mask))

    def read(self, state: JointState) -> tuple[None, np.ndarray]:
        """No transform, and the shared unknowns of a state, (c,): axis, poses of the cameras,
        sensor.
        """
        poses = pose_parameters(state.cameras).ravel()
        every = np.concatenate([chart_parameters(state.head), poses, state.sensor])
        return None, every[self.mask]

    def move(self, state: JointState, step: np.ndarray) -> JointState:
        """Retraction of the joint estimate by increments (p, k), in every row the shared ones and
        those of a placement.
        """
        full = np.zeros(len(self.mask))
        full[self.mask] = step[0, : self.shared]
        axis, cameras, sensor = np.split(full, [4, len(full) - len(SENSOR)])
        own = step[:, self.shared :]
        boards, sweep, sides = np.split(own, [6, 6 + SWEEPS[self.sweep]], axis=1)
        sensor = state.sensor + sensor
        sensor[1] = np.clip(sensor[1], -LARGEST_ODDS, LARGEST_ODDS)
        sensor[2] = np.clip(sensor[2], *SOFTEST)
        sweeps = state.sweeps.copy()
        sweeps[:, : sweep.shape[1]] += sweep
        return JointState(
            head=move_head(state.head, axis),
            cameras=move_pose(state.cameras, cameras.reshape(-1, 6)),
            sensor=sensor,
            boards=move_pose(state.boards, boards),
            sweeps=sweeps,
            sides=state.sides + sides if self.sides else state.sides,
        )


@dataclass(frozen=True)
class Levels:
    """Noise levels and what is expected.

    Attributes
    ----------
    face_scale : float
        Factor on the stated standard deviations of ranges.
    view_scale : float
        The same of all cameras' board poses.
    sigma_pitch : float
        Standard deviation of the recorded pitch at a stop, radians: what a head at rest is off by
        (see :class:`lrfcal_lib.solvers.joint_residuals.ViewBlock`).
    face_share, beam_share : float
        Share of independent errors per observation, below one where neighbours repeat each other's.
    lapse : float
        Share of beams that say nothing, see :func:`lrfcal_lib.fit.edge_likelihood.beam_terms`.
    sweep_sigma : sequence of float
        Of the sweeps' own offset (radians) and stretch, as far as they are unknown.
    side_sigma : float
        Scale of the sides' deviations of the log odds, Student's t.
    background_sigma : float
        The same of what these have in common at a placement.
    prior : PlatformPrior or None
        The stated platform, which yields where the data contradict it.
    step_sigma : float
        Standard deviation of the angular step of the beams, a fraction of it.
    """

    face_scale: float = 1.0
    view_scale: float = 1.0
    sigma_pitch: float = 0.0
    face_share: float = 1.0
    beam_share: float = 1.0
    lapse: float = 0.0
    sweep_sigma: Sequence[float] = (np.radians(0.5), 0.05)
    side_sigma: float = 0.35
    background_sigma: float = 0.35
    prior: PlatformPrior | None = None
    step_sigma: float = 0.0

    def of_sides(self, edges: int) -> np.ndarray:
        """Scales of the deviations that a placement has, (e + 1,)."""
        return np.array([self.side_sigma] * edges + [self.background_sigma])


@dataclass(frozen=True)
class JointData:
    """Observations padded by placement: arrays (p, n, ...), `used` marks what is no padding.

    Attributes
    ----------
    face, beam, view : dict of str to ndarray
        Fields of that group of JointObservations, with ``ray`` (LRF frame); for standard deviations
        of ranges ``weight``, their reciprocals, for covariances of views ``whitener`` (p, v, 6, 6).
    lines : ndarray, shape (e, 3)
        Sides of the board.
    middle, direction : ndarray, shape (p,)
        Of the sweeps.
    on_head : ndarray of bool, shape (c,)
        Whether cameras are fixed to the head.
    levels : Levels
    """

    face: dict
    beam: dict
    view: dict
    lines: np.ndarray
    middle: np.ndarray
    direction: np.ndarray
    on_head: np.ndarray
    levels: Levels

    def with_levels(self, **changed) -> "JointData":
        """The same with other noise levels, fields of :class:`Levels` by name."""
        return replace(self, levels=replace(self.levels, **changed))


def gather(obs: JointObservations, levels: Levels = Levels()) -> JointData:
    """Observations as padded arrays, with noise levels other than those stated."""
    count = len(obs.placements)
    face = pad(
        obs.face_placement,
        count,
        range=obs.face_range,
        bearing=obs.face_bearing,
        pitch=obs.face_pitch,
        weight=1 / obs.face_sigma,
    )
    beam = pad(
        obs.beam_placement,
        count,
        bearing=obs.beam_bearing,
        pitch=obs.beam_pitch,
        hit=obs.beam_hit,
        edge=obs.beam_edge,
        radius=obs.beam_radius,
        background=obs.beam_background,
        step=obs.beam_step,
    )
    view = pad(
        obs.view_placement,
        count,
        camera=obs.view_camera,
        pitch=obs.view_pitch,
        pose=obs.view_pose,
        whitener=inverse_root(obs.view_covariance),
        lens=obs.view_lens,
    )
    for group in (face, beam):
        group["ray"] = polar_to_points(1.0, group["bearing"])
    view["pose"][~view["used"]] = np.eye(4)
    return JointData(
        face,
        beam,
        view,
        outline_lines(obs.corners),
        obs.middle,
        obs.direction,
        obs.on_head,
        levels,
    )
