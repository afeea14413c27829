"""Draws of a whole rig with known truth, for the tests of the joint estimate."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.evaluate.monte_carlo import joint_truth, state_errors
from lrfcal_lib.model.geometry import polar_to_points, pose_transform
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.simulate.draw import bench, board_poses, observe

OFFSET = 0.005
COARSE = np.radians(1.0)
MOUNTS = pytest.mark.parametrize("mount", ["head", "platform"])


def rng(seed=3):
    return np.random.default_rng(seed)


def scores(found, truth):
    """Errors of an estimate in its own standard deviations."""
    return state_errors(found.state, truth, found.unknowns) / found.solution.sigma


def square_per_number(found, truth):
    """Normalised squared error of axis and cameras: 1 on the average where the covariance tells the truth."""
    count = 4 + 6 * len(found.transforms)
    error = state_errors(found.state, truth, found.unknowns)[:count]
    k = found.solution.covariance[:count, :count]
    return error @ np.linalg.solve(k, error) / count


def draw(
    rng,
    count=10,
    *,
    cameras=("left", "right"),
    seen=None,
    distances=(1.0, 2.5),
    lean=None,
    **settings,
):
    """Observations, truth and the bench itself; settings of Bench, or of observe with the prefix `see_`."""
    see = {key[4:]: settings.pop(key) for key in list(settings) if key.startswith("see_")}
    settings = {
        "pitch_step": COARSE,
        "range_offset": OFFSET,
        "bias": rng.uniform(-0.5, 0.5),
    } | settings
    rig = bench(rng, cameras, **settings)
    poses = board_poses(rng, count, distances) if lean is None else lean(rng, count)
    obs = JointObservations(**observe(rig, poses, rng, **see))
    obs = obs if seen is None else obs.with_cameras(seen)
    known = {
        "range_offset": rig.range_offset,
        "bias": rig.bias,
        "softness": rig.softness,
        "pitch_scale": rig.stretch,
    }
    return obs, joint_truth(obs, rig.T_head_lrf, rig.cameras, poses, **known), rig


def none(obs, *groups):
    """The observations without some groups."""
    return obs.keep(
        **{name: np.zeros(len(getattr(obs, f"{name}_placement")), bool) for name in groups}
    )


def joint_step(x, unknowns):
    """The step of six placements from the shared increments and then those of each of them."""
    shared, own = np.split(x, [unknowns.shared])
    return np.hstack([np.tile(shared, (6, 1)), own.reshape(6, -1)])


def misses_of(state, obs):
    """Whitened residuals of ranges and images, from the chain of transforms as one would write it down."""
    T_head_lrf = pose_transform(state.head)
    boards = pose_transform(state.boards)
    lifted = RigidTransform.from_rotation(
        Rotation.from_rotvec(np.outer(obs.face_pitch, [1, 0, 0]))
    )
    ray = polar_to_points(1.0, obs.face_bearing)
    T_board_lrf = boards[obs.face_placement].inv() * lifted * T_head_lrf
    start = T_board_lrf.apply(0 * ray)
    way = T_board_lrf.rotation.apply(ray)
    ranges = (-start[:, 2] / way[:, 2] + state.sensor[0] - obs.face_range) / obs.face_sigma
    cameras = pose_transform(state.cameras)[obs.view_camera] * RigidTransform.identity()
    if obs.mounts[0] == "head":
        lifted = RigidTransform.from_rotation(
            Rotation.from_rotvec(np.outer(obs.view_pitch, [1, 0, 0]))
        )
        cameras = cameras * (lifted * T_head_lrf).inv()
    predicted = cameras * boards[obs.view_placement]
    measured = RigidTransform.from_matrix(obs.view_pose)
    turn = (predicted.rotation * measured.rotation.inv()).as_rotvec()
    images = np.concatenate([turn, predicted.translation - measured.translation], axis=1)[
        ..., None
    ]
    white = np.linalg.solve(np.linalg.cholesky(obs.view_covariance), images)
    return np.concatenate([ranges, white.ravel()])
