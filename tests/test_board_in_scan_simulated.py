"""The board and its sides in the shipped simulated sweeps (a wide spot, a post, a room), against their truth."""

from functools import lru_cache

import numpy as np
import pytest

from lrfcal_lib.evaluate.truth import read_truth
from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points
from lrfcal_lib.preprocess.board_in_scan import find_board
from lrfcal_lib.preprocess.surfaces import planar_surface
from lrfcal_lib.report.notebook import ROOT
from lrfcal_lib.session.read import open_session

PLACEMENTS = [("sim_quick", n) for n in range(1, 5)] + [
    ("sim_lms221", n) for n in range(1, 25)
]
# metres; half a spot at 3 m, by which an edge before nothing lies farther out
WIDEST = 0.025


@lru_cache
def opened(name):
    session = open_session(ROOT / "data" / name)
    return session, read_truth(session)


@lru_cache
def seen(name, placement):
    """The board in a sweep, how far every beam lies outside the true outline on its true plane, and the true ranges."""
    session, truth = opened(name)
    sweep = session.sweep(placement)
    pose = truth.boards[placement]
    pitch = np.repeat(truth.pitch[placement][:, None], len(sweep.bearings), axis=1)
    origin = lrf_to_platform(np.zeros(pitch.shape + (3,)), pitch, truth.T_head_lrf)
    rays = (
        lrf_to_platform(
            polar_to_points(np.ones(pitch.shape), sweep.bearings), pitch, truth.T_head_lrf
        )
        - origin
    )
    normal = pose.rotation.apply([0, 0, 1.0])
    lines = truth.board.lines()
    ranges = (normal @ pose.translation - origin @ normal) / (rays @ normal)
    at = pose.inv().apply((origin + ranges[..., None] * rays).reshape(-1, 3))[:, :2]
    beyond = np.where(
        ranges > 0,
        (at @ lines[:, :2].T + lines[:, 2]).max(axis=1).reshape(pitch.shape),
        np.inf,
    )
    return find_board(sweep, session), beyond, ranges


@pytest.mark.parametrize(("name", "placement"), PLACEMENTS)
def test_the_board_and_hardly_anything_else_is_found(name, placement):
    board, beyond, ranges = seen(name, placement)
    assert (
        np.mean(board.mask[beyond < 0]) > 0.91
    )  # a post close behind takes a strip of some boards
    assert np.mean(board.mask[(beyond < -0.04) & np.isfinite(board.sweep.ranges)]) > 0.97
    assert np.mean(beyond[board.mask] > WIDEST) < 0.01
    assert (
        np.abs(board.sweep.ranges - ranges)[board.mask].max() < 0.07
    )  # the post is 35 cm behind
    assert board.sigma_range == pytest.approx(0.01, rel=0.15)


@pytest.mark.parametrize("seed", range(6))
def test_a_board_that_hangs_together_with_the_room_is_found_by_any_sample(seed):
    session, (expected, _, _) = opened("sim_lms221")[0], seen("sim_lms221", 2)
    rng = np.random.default_rng(seed)
    board = planar_surface(session.sweep(2), session.T_head_lrf, session, rng)
    assert np.sum(board.mask != expected.mask) < 0.03 * expected.mask.sum()
