"""Combining axes, naming sides, pitch noise: the parts of the chain that need no recording."""

from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.calibrate import observe, pipeline
from lrfcal_lib.fit.residuals import chart_parameters
from lrfcal_lib.fit.result import Solution
from lrfcal_lib.model.board import triangle_board
from lrfcal_lib.model.geometry import axis_difference, axis_of, pose_array
from lrfcal_lib.preprocess.prepared import PitchNoise, Prepared

SIGMA = (np.radians(0.5), 0.010)
STATED = pipeline.stated_covariance(SIGMA)


def head(rng, angle=0.05):
    return RigidTransform.from_components(rng.normal(size=3) * 0.1, Rotation.from_rotvec(rng.normal(size=3) * angle))


def estimate(T_head_lrf, covariance, scatter=None):
    inner = dict.fromkeys(field.name for field in fields(Solution))
    inner |= {"parameters": chart_parameters(pose_array(T_head_lrf)), "covariance": covariance}
    return SimpleNamespace(T_head_lrf=T_head_lrf, solution=Solution(**inner | {"covariance_placements": scatter}))


def test_the_chart_of_the_axis_is_undone():
    T = head(np.random.default_rng(0))
    again = pipeline.axis_from_chart(chart_parameters(pose_array(T)))
    assert max(axis_difference(axis_of(T), again)) < 1e-12


@pytest.mark.parametrize(("scale", "wins"), [(1e-8, "data"), (1e8, "stated")])
def test_the_better_known_axis_wins(scale, wins):
    rng = np.random.default_rng(1)
    stated, data = head(rng), head(rng)
    found, covariance = pipeline.combine(estimate(data, scale * STATED), (stated, STATED))
    winner = {"data": data, "stated": stated}[wins]
    assert max(axis_difference(axis_of(found), axis_of(winner))) < 1e-6
    assert (np.diag(covariance) <= np.diag(STATED) * (1 + 1e-9)).all()


def test_placements_that_agree_by_chance_do_not_outweigh_the_stated_axis():
    rng = np.random.default_rng(4)
    stated, data = head(rng), head(rng)
    found, _ = pipeline.combine(estimate(data, 1e8 * STATED, 1e-8 * STATED), (stated, STATED))
    assert max(axis_difference(axis_of(found), axis_of(stated))) < 1e-6


def test_combining_keeps_what_no_data_can_show():
    rng = np.random.default_rng(2)
    stated = head(rng)
    found, _ = pipeline.combine(estimate(stated, STATED), (stated, STATED))
    np.testing.assert_allclose(found.as_matrix(), stated.as_matrix(), atol=1e-12)


def test_without_a_stated_platform_the_data_stand_alone():
    data = head(np.random.default_rng(3))
    found, covariance = pipeline.combine(estimate(data, np.eye(4)), None)
    assert found is data and (covariance == np.eye(4)).all()


def test_pitch_noise_grows_away_from_the_middle():
    noise = PitchNoise(offset=0.003, stretch=0.04)
    np.testing.assert_allclose(noise.sigma([0.1, 0.2], 0.1), [0.003, 0.005])


def test_no_pitch_errors_mean_no_pitch_noise():
    assert pipeline.pitch_noise(None) == PitchNoise()


def side(board, edge, n=20, shift=0.0, turn_deg=0.0):
    """Board-frame points on an edge, moved outwards and turned about its middle."""
    i = board.edges.index(edge)
    a, b = board.corners[i], board.corners[(i + 1) % len(board.edges)]
    turn = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()[:2, :2]
    points = (a + b) / 2 + np.linspace(-0.4, 0.4, n)[:, None] * (turn @ (b - a)) + shift * board.lines()[i, :2]
    return np.column_stack([points, np.zeros(n)])


def test_sides_are_named_after_the_nearest_edge():
    board = triangle_board()
    sides = {4: side(board, "bc", shift=0.01), 7: side(board, "ab", shift=-0.01), 9: side(board, "ca")}
    assert observe.nearest_edges(board, sides) == ({4: "bc", 7: "ab", 9: "ca"}, {})


def test_far_and_crooked_sides_stay_unnamed_with_a_reason():
    board = triangle_board()
    names, problems = observe.nearest_edges(board, {0: side(board, "ab", turn_deg=5), 1: side(board, "bc", shift=0.2)})
    assert names == {}
    assert "turned by 5.0 deg" in problems[0] and "200 mm from the edge 'bc'" in problems[1]


def test_two_sides_do_not_share_an_edge():
    board = triangle_board()
    names, _ = observe.nearest_edges(board, {0: side(board, "ab"), 1: side(board, "ab", shift=0.02)})
    assert list(names.values()).count("ab") == 1


def test_thinning_keeps_the_ends():
    rows = np.arange(5, 205)
    kept = observe.thin(rows, 24)
    assert len(kept) == 24 and kept[0] == 5 and kept[-1] == 204
    assert (observe.thin(rows[:7], 24) == rows[:7]).all()


def test_placements_with_a_problem_are_left_out_of_everything_but_the_images():
    parts = {"last_beam": {1: "a", 2: "b"}, "half_step": {1: "a", 2: "b"}}
    ready = Prepared(None, None, {1: "a", 2: "b"}, parts, parts, names={1: {}, 2: {}}, views={"left": {1: "v", 2: "v"}})
    ready.problems.update({2: "off", "2 0": "a side, not a placement"})
    left = pipeline.without(ready)
    assert list(left.scans) == list(left.names) == list(left.edges["half_step"]) == [1]
    assert list(left.views["left"]) == [1, 2]
