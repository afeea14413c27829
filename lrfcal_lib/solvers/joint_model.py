"""What the joint estimate moves about: its state, its unknowns, its observations side by side."""

from dataclasses import MISSING, dataclass, fields, replace
from functools import cached_property

import numpy as np

from lrfcal_lib.fit.axis_chart import move_head
from lrfcal_lib.fit.least_squares import pad
from lrfcal_lib.fit.result import AXIS_NAMES, PlatformPrior
from lrfcal_lib.model import geometry
from lrfcal_lib.model.geometry import move_pose

SENSOR = ("range_offset", "edge_log_odds", "edge_log_softness", "pitch_scale", "pitch_by_direction")
SWEEPS = {"none": 0, "offset": 1, "offset_stretch": 2}
LARGEST_ODDS = 8.0  # beyond, the edge lies at the rim of the spot whatever the odds


@dataclass(frozen=True)
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
    sides : ndarray, shape (p, e)
        By how much the log odds of each side differ from the sensor's: what stands behind it is
        darker or brighter.
    """

    head: np.ndarray
    cameras: np.ndarray
    sensor: np.ndarray
    boards: np.ndarray
    sweeps: np.ndarray
    sides: np.ndarray


@dataclass(frozen=True)
class Unknowns:
    """Which columns of the full Jacobian are unknown.

    `cameras` and `edges` are their numbers, `sensor` names some of `SENSOR`, `sweep` one of
    `SWEEPS`; `poses` tells whether the cameras' are unknown, `sides` whether every side of every
    placement has a deviation of its own from the sensor's edge bias.
    """

    cameras: int
    edges: int
    axis: bool = True
    sensor: tuple = ("range_offset", "edge_log_odds", "edge_log_softness")
    sweep: str = "none"
    poses: bool = True
    sides: bool = False

    @property
    def mask(self):
        """Of the full set of shared columns, those that are unknown."""
        sensor = [name in self.sensor for name in SENSOR]
        return np.array([self.axis] * 4 + [self.poses] * 6 * self.cameras + sensor)

    @cached_property
    def columns(self):
        """Where the unknowns stand in a Jacobian: first the shared ones, then the placement's
        own.
        """
        widths = {"axis": 4 * self.axis, "cameras": 6 * self.cameras * self.poses}
        widths |= {name: int(name in self.sensor) for name in SENSOR}
        widths |= {"board": 6, "sweep": SWEEPS[self.sweep], "sides": self.edges * self.sides}
        ends = np.cumsum(list(widths.values())).tolist()
        return {
            name: slice(end - width, end)
            for (name, width), end in zip(widths.items(), ends, strict=True)
        }

    @property
    def shared(self):
        """Number of unknowns common to all placements."""
        return self.columns["board"].start

    @property
    def own(self):
        """Number of unknowns of one placement."""
        return self.columns["sides"].stop - self.shared

    def names(self, cameras):
        """Names of the shared unknowns."""
        every = [*AXIS_NAMES, *(f"{c}_{n}" for c in cameras for n in geometry.POSE_NAMES), *SENSOR]
        return tuple(np.array(every)[self.mask].tolist())


@dataclass(frozen=True)
class JointData:
    """Observations padded by placement: arrays (p, n, ...), `used` marks what is no padding.

    `face`, `beam` and `view` hold the fields of that group of JointObservations, with ``ray`` (LRF
    frame) or, for views, ``whitener`` (p, v, 6, 6); `lines` (e, 3) are the board's, `middle` and
    `direction` (p,) the sweeps'. Then come factors on the stated standard deviations of ranges and
    of each camera's views, the standard deviation of the recorded pitch at a stop (what a head at
    rest is off by, radians; see :mod:`lrfcal_lib.fit.stops`), shares of independent errors per
    observation (below one where neighbours repeat each other's errors), `lapse` (see
    :func:`beam_terms`), what is expected of the sweeps' own offset (radians) and stretch, the scale
    of the sides' deviations of the log odds (Student's t with `SIDE_FREEDOM` degrees of freedom:
    most backgrounds are alike, some are dark), and the stated platform, which yields where the data
    contradict it.
    """

    face: dict
    beam: dict
    view: dict
    lines: np.ndarray
    middle: np.ndarray
    direction: np.ndarray
    on_head: np.ndarray
    face_scale: float = 1.0
    view_scale: np.ndarray | None = None
    sigma_pitch: float = 0.0
    face_share: float = 1.0
    beam_share: float = 1.0
    lapse: float = 0.0
    sweep_sigma: tuple = (np.radians(0.5), 0.05)
    side_sigma: float = 0.35
    prior: PlatformPrior | None = None

    @property
    def levels(self):
        """Noise levels and prior: all that has a default."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.default is not MISSING}


def gather(obs, **levels):
    """JointObservations as padded arrays, a JointData, with noise levels other than those
    stated.
    """
    count = len(obs.placements)
    face, beam, view = (pad(obs.group(name), count) for name in ("face", "beam", "view"))
    for group in (face, beam):
        group["ray"] = geometry.polar_to_points(1.0, group["bearing"])
    view["covariance"] = np.where(view["used"][..., None, None], view["covariance"], np.eye(6))
    view["whitener"] = (
        np.linalg.inv(np.linalg.cholesky(view["covariance"])) * view["used"][..., None, None]
    )
    view["pose"] = np.where(view["used"][..., None, None], view["pose"], np.eye(4))
    on_head = np.array([m == "head" for m in obs.mounts], bool)
    levels = {"view_scale": np.ones(len(obs.cameras))} | levels
    return JointData(face, beam, view, obs.lines(), obs.middle, obs.direction, on_head, **levels)


def move_state(state, step, unknowns):
    """Retraction of the joint estimate: shared increments (c,) and those of each placement (p,
    l).
    """
    full = np.zeros(len(unknowns.mask))
    full[unknowns.mask] = step[0]
    c = len(state.cameras)
    sensor = state.sensor + full[4 + 6 * c :]
    sensor[1] = np.clip(sensor[1], -LARGEST_ODDS, LARGEST_ODDS)
    sensor[2] = np.clip(sensor[2], np.log(1e-3), np.log(10.0))
    count = SWEEPS[unknowns.sweep]
    sweeps = state.sweeps.copy()
    sweeps[:, :count] += step[1][:, 6 : 6 + count]
    return replace(
        state,
        head=move_head(state.head, full[:4]),
        cameras=move_pose(state.cameras, full[4 : 4 + 6 * c].reshape(c, 6)) if c else state.cameras,
        sensor=sensor,
        boards=move_pose(state.boards, step[1][:, :6]),
        sweeps=sweeps,
        sides=state.sides + step[1][:, 6 + count :] if unknowns.sides else state.sides,
    )
