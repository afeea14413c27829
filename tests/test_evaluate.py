"""Tables of residuals, stereo check and edge lengths."""

import numpy as np
import pytest
from synthetic import camera_observations, random_board_poses, random_rig

from lrfcal_lib import solvers
from lrfcal_lib.evaluate import tables
from lrfcal_lib.solvers import solve_camera


@pytest.fixture(scope="module")
def observed():
    rng = np.random.default_rng(5)
    rig = random_rig(rng)
    poses = random_board_poses(rng, 14, rig)
    return {
        noise: camera_observations(rng, rig, poses, noise=noise) for noise in (0.0, 1.0)
    }


def left_out(obs, method, full=None):
    """Residuals of every placement under a calibration from the others: crossings and face points."""
    return tables.left_out_residuals(
        solvers.left_out(obs, obs, method, full or solve_camera(obs, method))
    )


def test_left_out_errors_vanish_without_noise(observed):
    edge, plane = left_out(observed[0.0], "line")
    assert len(edge) and np.abs(edge).max() < 1e-6 and np.nanmax(np.abs(plane)) < 1e-8


def test_placements_without_which_too_little_is_left_do_not_count(observed):
    obs = observed[0.0]
    some = obs.select(obs.placements[:3])
    assert [
        len(found)
        for found in left_out(some, "zhang_pless", solve_camera(obs, "zhang_pless"))
    ] == [0, 0]
