"""Images at one stop of the head share the error of its pitch."""

import numpy as np
import pytest
from joint_draws import MOUNTS, draw, rng

from lrfcal_lib.fit.edge_likelihood import LEAST_STEP
from lrfcal_lib.fit.padding import pad
from lrfcal_lib.solvers.joint import solve_joint
from lrfcal_lib.solvers.joint_model import Levels, Unknowns, gather
from lrfcal_lib.solvers.joint_residuals import view_block

STOP = np.radians(0.010)


@MOUNTS
def test_whitened_views_are_those_of_the_whole_covariance(mount):
    """Noise of each view, and one error of the pitch for both cameras at each of three stops."""
    obs, truth, _ = draw(rng(1), 3, mount=mount)
    data = gather(obs, Levels(sigma_pitch=0.3, view_scale=2.0))
    block = view_block(truth, data, Unknowns(2, 3))
    stated = pad(obs.view_placement, 3, covariance=obs.view_covariance)["covariance"]
    p, v = data.view["used"].shape
    for i in range(p):
        whole = np.zeros((6 * v, 6 * v))
        g = block.by_pitch[i]
        for a in range(v):
            rows = slice(6 * a, 6 * a + 6)
            whole[rows, rows] += stated[i, a] * data.levels.view_scale**2
            for b in np.flatnonzero(data.view["pitch"][i] == data.view["pitch"][i, a]):
                whole[rows, 6 * b : 6 * b + 6] += 0.3**2 * np.outer(g[a], g[b])
        np.testing.assert_allclose(
            block.white[i] @ block.white[i], r_squared(block.residuals[i], whole), rtol=1e-6
        )
        J = block.jacobian[i]
        np.testing.assert_allclose(
            block.white_jacobian[i].T @ block.white_jacobian[i],
            J.T @ np.linalg.solve(whole, J),
            rtol=1e-5,
            atol=1e-3,
        )
    assert np.any(g) == (mount == "head")


def r_squared(r, covariance):
    return r @ np.linalg.solve(covariance, r)


@pytest.mark.parametrize("images", [2, 3])
def test_the_error_of_the_pitch_at_stops_is_found(images):
    """Also from two stops a placement: what the board itself takes up of both errors is no sign of small ones."""
    levels = []
    scales = []
    for seed in range(6):
        obs, _, _ = draw(
            rng(seed), 12, floor=LEAST_STEP, sigma_stop=STOP, see_images=images
        )
        noise = solve_joint(obs, noise="estimate").noise
        levels.append(noise["sigma_pitch"])
        scales.append(noise["view_scale"])
    assert np.sqrt(np.mean(np.square(levels))) == pytest.approx(STOP, rel=0.12)
    assert np.mean(scales) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("cameras", [("left",), ("left", "right")])
def test_one_image_a_placement_does_not_show_its_noise_to_be_small(cameras):
    """A board that follows its only image leaves nothing: the scale is known from the scans, and not far off."""
    scales = []
    for seed in range(4):
        obs, _, _ = draw(rng(seed), 12, cameras=cameras, floor=LEAST_STEP, see_images=1)
        scales.append(
            solve_joint(obs, noise="estimate", required=False).noise["view_scale"]
        )
    assert 0.6 < np.mean(scales) < 1.6
