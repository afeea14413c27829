"""Did a camera change between two placements? Steps of its pose and of its image scale."""

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import chdtrc, fdtrc

from lrfcal_lib.fit.covariance import dyads, pseudo_inverse, sigma_of
from lrfcal_lib.judge.next_placement import board_middle, outline
from lrfcal_lib.model.camera import project
from lrfcal_lib.model.geometry import (
    POSE,
    DegenerateGeometry,
    apply_pose,
    carry,
    length_of,
    pose_step,
)
from lrfcal_lib.preprocess.bundle import adjust_robust
from lrfcal_lib.preprocess.prepared import Prepared
from lrfcal_lib.solvers.joint import solve_joint
from lrfcal_lib.solvers.joint_solution import JointSolution, Score

BESIDE = 2  # placements on either side of a step, at least: one alone may simply be wrong
# false alarms a recording, over all cameras and places that a step might be at
LEVEL = 0.001
MUCH_MORE = 5.0  # motion than growth of an image, pixels
LEAST_SIZE = 0.5  # pixels; edges and corners of a board are off by less at one placement
ASKED = 4.0  # standard deviations: a change of the image scale that is none of chance
STEP = 1e-4  # of the numeric derivative by the image scale
NOISY = 10.0  # residuals in units of the stated noise: an estimate that explains nothing
MOST_CHANGES = 3  # in one recording
FEWEST_VIEWS = 3  # of a chessboard, for a focal length
FOCAL_LENGTHS = 2  # the first of fx, fy, cx, cy, k1..k5


@dataclass(frozen=True)
class CameraChange:
    """A camera sits, or magnifies, otherwise from a placement on.

    Attributes
    ----------
    camera : str
    after : int
        The first placement after the change.
    turn, shift : float
        Radians, metres.
    p_value : float
        Probability of such a turn and shift by chance.
    motion_px : float
        Median motion of the boards' middles in the images.
    zoom, zoom_sigma : float
        Relative growth of the images.
    corner_px : float
        What that moves the corners of an image.
    """

    camera: str
    after: int
    turn: float
    shift: float
    p_value: float
    motion_px: float
    zoom: float
    zoom_sigma: float
    corner_px: float

    @property
    def zoomed(self):
        """Whether the image scale has changed; turn and shift are then off, too."""
        asked = abs(self.zoom) > ASKED * self.zoom_sigma and self.corner_px > LEAST_SIZE
        # the lens of an image that was moved by far fits no longer: that looks like a little zoom
        return asked and self.motion_px < MUCH_MORE * self.corner_px

    @property
    def moved(self):
        """Whether turn and shift are more than chance allows, and more than nothing."""
        return self.p_value < LEVEL and self.motion_px > LEAST_SIZE


class Step(NamedTuple):
    """A step in a camera's pose at some place (indices), and its probability by chance.

    `change` (6,) are the increments ``[w, v]`` of the pose, as a score test has them.
    """

    camera: int
    row: int
    p_value: float
    change: np.ndarray


def camera_changes(
    solution: JointSolution, prepared: Prepared, settings: dict
) -> list[CameraChange]:
    """Cameras that sit, or magnify, otherwise from some placement on.

    A score test of every camera and place; where it finds a step, an estimate with two poses of
    that camera.

    Parameters
    ----------
    solution : JointSolution
    prepared : Prepared
    settings : dict
        Keyword arguments of `solve_joint`, as `solution` was found with.

    Returns
    -------
    list of CameraChange
        In the order in which they were found, the clearest first.
    """
    cameras = list(solution.observations.cameras)  # of the poses
    changes: list[CameraChange] = []
    while len(changes) < MOST_CHANGES and (step := likeliest_step(solution)):
        camera = cameras[step.camera]
        # errors of the intrinsics make small steps out of nothing, which no estimate confirms
        if largest_motion(solution, step, prepared.models[camera]) < LEAST_SIZE:
            return changes
        parted = with_change(solution.observations, step, camera, prepared, settings)
        if parted is None:
            return changes
        solution, change = parted
        cameras.append(camera)
        changes.append(change)
        if change.zoomed:
            # two poses do not make up for that: what is left looks like more steps
            return changes
    # what is hopeless also with two poses of a camera has another cause
    return changes if explains(solution) else []


def explains(solution: JointSolution) -> bool:
    """Whether an estimate leaves residuals that are anything like the noise.

    Parameters
    ----------
    solution
    """
    noise = solution.noise
    return solution.converged and max(noise["face_scale"], noise["view_scale"]) <= NOISY


def with_change(obs, step, camera, prepared, settings):
    """The estimate with two poses of a camera and the CameraChange between them; None if none."""
    first = obs.cameras[step.camera]
    later = f"{camera} from placement {obs.placements[step.row]}"
    with suppress(DegenerateGeometry):
        solution = solve_joint(with_two_poses(obs, step, later), required=False, **settings)
        found = {first, later} <= solution.transforms.keys()
        if found and np.isfinite(solution.covariance(first, later)).all():
            change = change_between(solution, first, later, camera, prepared)
            if change.moved or change.zoomed:
                return solution, change
    return None


def likeliest_step(solution):
    """The Step that explains most of what residuals hold against one pose a camera; None by chance.

    A score test with all that was estimated free. Where placements scatter more than their noise
    explains, the statistic is measured by their scatter.
    """
    obs = solution.observations
    score = solution.score()

    tested = []
    for camera, name in enumerate(obs.cameras):
        columns = solution.columns(name)
        shown = np.unique(obs.view_placement[obs.view_camera == camera])
        for row in range(len(obs.placements)):
            if BESIDE <= np.searchsorted(shown, row) <= len(shown) - BESIDE:
                tested.append(Step(camera, row, *_chance_of_step(score, columns, row)))
    best = min(tested, key=lambda step: step.p_value, default=None)
    if best and best.p_value * len(tested) <= LEVEL:
        return best
    return None


def _chance_of_step(score, columns, row):
    """Probability that chance makes the pose in these columns seem another one from a row on, and
    by how much (6,).

    `score` is what each placement says about the shared unknowns.
    """
    count, shared = score.gradient.shape
    # the normal equations with the pose's change as more unknowns, placement by placement
    repeated = np.concatenate([np.arange(shared), columns])
    kept = np.ones((count, len(repeated)))
    kept[:row, shared:] = 0.0
    whole = dyads(kept) * score.information[:, repeated[:, None], repeated]
    covariance, step, pulls = Score(whole, score.gradient[:, repeated] * kept).solved()
    information = pseudo_inverse(covariance[-POSE:, -POSE:])
    change = step[-POSE:]
    square = change @ information @ change
    pull = pulls[:, -POSE:]  # its scatter is that of the placements
    scatter = np.einsum("pi,ij,pj->", pull, information, pull) / POSE * count / (count - 1)
    return fdtrc(POSE, POSE * (count - 1), square / POSE / max(scatter, 1.0)), change


def largest_motion(solution, step, model):
    """By how many pixels the change of a Step moves a corner of a board in an image, at most."""
    obs = solution.observations
    poses = obs.view_pose[obs.view_camera == step.camera, :3]
    corners = apply_pose(poses, outline(solution))
    origin = solution.transforms[obs.cameras[step.camera]].translation
    turn = Rotation.from_rotvec(step.change[:3])
    moved = carry(turn, origin, origin + step.change[3:]).apply(corners)
    motion = project(moved, model) - project(corners, model)
    return np.max(length_of(motion))


def with_two_poses(obs, step, name):
    """Observations in which a camera is another one, of this name, from a Step on."""
    later = (obs.view_camera == step.camera) & (obs.view_placement >= step.row)
    return replace(
        obs,
        view_camera=np.where(later, len(obs.cameras), obs.view_camera),
        cameras=(*obs.cameras, name),
        mounts=(*obs.mounts, obs.mounts[step.camera]),
        lens_covariance=np.concatenate(
            [obs.lens_covariance, obs.lens_covariance[[step.camera]]]
        ),
    )


def change_between(solution, first, later, camera, prepared):
    """The CameraChange between two poses of a camera, which `solution` knows by these names."""
    obs = solution.observations
    model = prepared.models[camera]
    index = obs.cameras.index(later)
    change = solution.transforms[later] * solution.transforms[first].inv()
    later_less_first = np.kron([-1.0, 1.0], np.eye(POSE))
    spread = later_less_first @ solution.covariance(first, later) @ later_less_first.T
    step = pose_step(solution.transforms[first], solution.transforms[later])
    square = step @ pseudo_inverse(spread) @ step

    views = obs.view_camera == index
    middles = obs.view_pose[views, :3] @ board_middle(solution)
    motion = project(middles, model) - project(change.inv().apply(middles), model)
    after = int(obs.placements[obs.view_placement[views].min()])
    zoom, zoom_sigma = max(
        growth_by_depth(solution, index),
        growth_of_focal_length(prepared, camera, after),
        key=lambda growth: abs(growth[0]) / growth[1],
    )
    return CameraChange(
        camera=camera,
        after=after,
        turn=change.rotation.magnitude(),
        shift=length_of(step[3:]),
        p_value=chdtrc(POSE, square),
        motion_px=np.median(length_of(motion)),
        zoom=zoom,
        zoom_sigma=zoom_sigma,
        corner_px=abs(zoom) * length_of(model.size) / 2,
    )


def growth_of_focal_length(prepared, camera, placement):
    """Relative growth of a camera's focal length from a placement on, and its standard deviation.

    From the corners of the chessboard, the rest of the lens held; 0 and infinity where too few
    images show them.
    """
    model = prepared.models[camera]
    lengths = []
    spreads = []
    for later in (False, True):
        views = [
            view
            for number, view in prepared.patterned(camera).items()
            if (number >= placement) is later
        ]
        if len(views) < FEWEST_VIEWS:
            return 0.0, np.inf
        pixels = np.array([[view.pixels for view in views]])
        poses = RigidTransform.concatenate([view.T_camera_board for view in views])
        lens = adjust_robust(
            pixels, prepared.pattern_points, [model], poses, lens=FOCAL_LENGTHS
        ).models[0]
        lengths.append(np.mean([lens.fx / model.fx, lens.fy / model.fy]))
        spreads.append(lens.covariance[:2, :2].mean() / model.fx**2)
    return lengths[1] / lengths[0] - 1, np.sqrt(sum(spreads))


def growth_by_depth(solution, camera):
    """How much more a camera (index) magnifies than its model, and the standard deviation.

    A score test with all that was estimated free: who magnifies sees boards nearer than they are.
    """
    obs = solution.observations
    nearer = obs.view_pose.copy()
    nearer[obs.view_camera == camera, 2, 3] *= 1 + STEP
    covariance, step, _ = solution.score(replace(obs, view_pose=nearer), STEP).solved()
    return step[-1], sigma_of(covariance)[-1]
