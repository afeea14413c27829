"""Draws of a whole rig with known truth, for the tests of the joint estimate."""

import numpy as np

from lrfcal_lib.evaluate.monte_carlo import joint_truth
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.simulate.draw import bench, board_poses, observe

OFFSET = 0.005
COARSE = np.radians(1.0)


def draw(rng, count=10, *, cameras=("left", "right"), seen=None, distances=(1.0, 2.5), lean=None, **settings):
    """Observations, truth and the bench itself; settings of Bench, or of observe with the prefix `see_`."""
    see = {key[4:]: settings.pop(key) for key in list(settings) if key.startswith("see_")}
    settings = {"pitch_step": COARSE, "range_offset": OFFSET, "bias": rng.uniform(-0.5, 0.5)} | settings
    rig = bench(rng, cameras, **settings)
    poses = board_poses(rng, count, distances) if lean is None else lean(rng, count)
    obs = JointObservations(**observe(rig, poses, rng, **see))
    obs = obs if seen is None else obs.with_cameras(seen)
    known = {"range_offset": rig.range_offset, "bias": rig.bias, "softness": rig.softness, "pitch_scale": rig.stretch}
    return obs, joint_truth(obs, rig.T_head_lrf, rig.cameras, poses, **known), rig


def none(obs, *groups):
    """The observations without some groups."""
    return obs.keep(**{name: np.zeros(len(getattr(obs, f"{name}_placement")), bool) for name in groups})
