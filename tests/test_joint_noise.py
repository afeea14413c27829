"""Noise levels of beams and sides of the joint estimate."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from joint_draws import draw, rng

from lrfcal_lib.fit.edge_likelihood import LEAST_STEP
from lrfcal_lib.solvers.joint import solve_joint
from lrfcal_lib.solvers.joint_model import Levels
from lrfcal_lib.solvers.joint_noise import with_beam_share, with_side_levels
from lrfcal_lib.solvers.joint_residuals import SIDE_FREEDOM, named_blocks

FINE = np.radians(0.5)
NARROW = (0.012, 0.0044)  # m at the window, rad: an LMS200


def levels(count, **settings):
    """Noise levels of some draws, with deviations of the sides estimated."""
    found = []
    for seed in range(count):
        obs, _, _ = draw(rng(seed), 12, pitch_step=FINE, **settings)
        found.append(
            solve_joint(obs, noise="estimate", sides=True, lapse=0.01, required=False).noise
        )
    return found


def test_the_scatter_of_the_sides_is_found():
    """Student's t with three degrees of freedom has a scale of 0.63 where normal deviations scatter by 0.8."""
    noise = levels(4, softness=0.02, spread=0.8, bias=0.0, spot=NARROW)
    assert np.mean([one["side_sigma"] for one in noise]) == pytest.approx(0.63, rel=0.25)


@pytest.mark.parametrize(
    ("true_deg", "least_deg", "most_deg"), [(0.0, 0.0, 0.02), (0.2, 0.14, 0.27)]
)
def test_errors_of_the_pitch_of_sweeps_are_found_whatever_was_believed(
    true_deg, least_deg, most_deg
):
    """A first guess must not stay for ever where images and ranges say little about a sweep."""
    own = rng(1)
    obs, _, _ = draw(own, 14, mount="platform", see_images=1, pitch_step=FINE)
    off = np.radians(true_deg) * own.standard_normal(14)
    obs = replace(
        obs,
        face_pitch=obs.face_pitch + off[obs.face_placement],
        beam_pitch=obs.beam_pitch + off[obs.beam_placement],
    )
    settings = {"noise": "estimate", "sweep": "offset_stretch", "required": False}
    found = []
    for believed in np.radians([0.03, 0.5]):
        solution = solve_joint(obs, sweep_sigma=(believed, 0.01), **settings)
        found.append(np.degrees(solution.data.levels.sweep_sigma[0]))
    assert found[0] == pytest.approx(found[1], rel=0.05)
    assert least_deg < found[0] < most_deg


def most_likely(y, known, sigma):
    """Deviations that make measured ones `y` of information `known` most likely, and the weight of what is expected."""
    x = np.zeros_like(y)
    for _ in range(100):
        prior = (SIDE_FREEDOM + 1) / (SIDE_FREEDOM * sigma**2 + x**2)
        x = known * y / (known + prior)
    return x, prior


@pytest.mark.parametrize("start", [0.1, 0.35, 1.5])
@pytest.mark.parametrize("true", [0.2, 0.8])
def test_sides_that_beams_hardly_show_do_not_pull_their_scale_down(true, start):
    """Two of three say nothing, as bright boards do at the rim of the spot; the third tells the scale."""
    own = rng(2)
    known = np.tile([400.0, 0.01, 0.01], (200, 1))
    y = true * own.standard_t(3, known.shape) + own.standard_normal(known.shape) / np.sqrt(
        known
    )
    used = {"used": np.ones(known.shape, bool), "edge": np.tile(np.arange(3), (200, 1))}
    level = start
    for _ in range(10):
        x, prior = most_likely(y, known, level)
        hessian = np.zeros((200, 10, 10))
        # the last is of what sides have in common: known to be nothing
        own = [np.ones((200, 6)), known + prior, np.full((200, 1), 1e9)]
        hessian[:, range(10), range(10)] = np.concatenate(own, axis=1)
        told = SimpleNamespace(levels=Levels(side_sigma=level), beam=used, with_levels=dict)
        gradient = np.zeros((200, 10))
        sides = np.pad(x, [(0, 0), (0, 1)])
        level = with_side_levels(sides, told, hessian, gradient)["side_sigma"]
    assert level == pytest.approx(true, rel=0.15)


def test_what_sides_have_in_common_is_no_deviation_of_single_sides():
    """One wall behind the board, brighter than another: four sides are not four witnesses."""
    found = []
    for seed in range(4):
        own = rng(seed)
        obs, _, _ = draw(own, 14, pitch_step=FINE, spread=0.2, spot=NARROW)
        wall = 0.8 * own.standard_normal(14)
        obs = replace(obs, beam_background=obs.beam_background + wall[obs.beam_placement])
        solution = solve_joint(obs, noise="estimate", sides=True, required=False)
        found.append([solution.noise[name] for name in ("side_sigma", "background_sigma")])
    side, wall = np.mean(found, axis=0)
    # Student's t has a scale of 0.79 of the standard deviation of what is normal
    assert side < 0.3
    assert wall == pytest.approx(0.63, rel=0.3)


@pytest.mark.parametrize("sigma_px", [0.05, 1.0])
def test_ranges_are_independent_whether_images_or_ranges_show_the_plane(sigma_px):
    """Images that show the plane better take up what residuals of ranges would have lost to it."""
    noise = levels(4, sigma_range=0.012, sigma_px=sigma_px)
    assert np.mean([one["face_share"] for one in noise]) > 0.93
    scale = np.mean([one["face_scale"] for one in noise])
    assert scale == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("seed", range(3))
def test_errors_common_to_a_board_are_found_beside_larger_ones_of_single_ranges(seed):
    """A surface that reads 5 mm long shows in no scatter of its ranges, and in all that they say."""
    own = rng(seed)
    obs, _, _ = draw(own, 14, pitch_step=FINE, sigma_range=0.012)
    wrong = 0.005 * own.standard_normal(14)
    obs = replace(obs, face_range=obs.face_range + wrong[obs.face_placement])
    share = solve_joint(obs, noise="estimate", required=False).noise["face_share"]
    points = len(obs.face_range) / 14
    expected = 3 / (3 + points * (5 / 12) ** 2)  # of three numbers of a plane, one errs
    assert expected / 2 < share < 2 * expected


def test_beams_of_the_model_itself_are_independent():
    noise = levels(4, softness=0.3, spread=0.8, floor=LEAST_STEP)
    assert 0.7 < np.mean([one["beam_share"] for one in noise]) <= 1


def test_beams_about_sharp_edges_say_no_more_than_their_spacing():
    noise = levels(2, softness=0.02, spread=0.3, spot=NARROW)
    assert all(0.5 < one["beam_share"] <= 1 for one in noise)


def test_beams_that_all_contradict_their_edges_still_have_a_share():
    """Bearings of the other sense: the cost of beams is bent the other way, and a share below 0 ended in a traceback."""
    found = solve_joint(draw(rng(3), 6)[0], required=False)
    data = found.with_levels(lapse=0.01).data
    block = named_blocks(found.state, data, found.unknowns)["beam"]
    cost = np.full(block.cost.shape, 4.0)
    own = np.zeros((6, *[block.jacobian.shape[-1] - found.unknowns.shared] * 2))
    contradicted = replace(block, residuals=np.sqrt(2 * cost), cost=cost)
    shared = found.unknowns.shared
    estimated = with_beam_share(found.state, data, contradicted, shared, own)
    assert 0 < estimated.levels.beam_share < 0.01
