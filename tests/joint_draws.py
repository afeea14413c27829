"""Draws of a whole rig with known truth, for the tests of the joint estimate."""

import numpy as np
import pytest

from lrfcal_lib.evaluate.monte_carlo import joint_truth, state_errors
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
