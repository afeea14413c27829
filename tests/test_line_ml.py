"""The line method by likelihood: against half steps and planes in Monte-Carlo trials, gradients, bias, bad input."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from synthetic import camera_case

from lrfcal_lib.evaluate.monte_carlo import crossings, shots_table, solve_shots, start_near
from lrfcal_lib.model.geometry import DegenerateGeometry, pose_array, transform_difference
from lrfcal_lib.simulate.draw import ShotSetup, draw_shots
from lrfcal_lib.solvers.lines import _block, _Intervals, _move, edge_bias, softness, solve_line_ml, solve_line_ml_batch

FULL = ("points", "covariance", "half_step", "noise", "radius", "background", "lines", "line_sigma")
BIASES = (-0.5, -0.25, 0.0, 0.25, 0.5)
TRIALS = 20  # of each bias: 100 for either beam spacing


@pytest.fixture(scope="module", params=[0.25, 0.5])
def tables(request):
    """Tables of errors by bias, at one beam spacing."""
    out = {}
    for bias in BIASES:
        setup = ShotSetup(step=np.radians(request.param), bias=bias)
        rng = np.random.default_rng(int(1000 * request.param + 100 * bias))
        shots = draw_shots(setup, rng, TRIALS)
        out[bias] = shots_table(shots, setup, solve_shots(shots, setup, start_near(shots, rng))).set_index("method")
    return out


def pooled(tables, column, method):
    return np.sqrt(np.mean([t.loc[method, column] ** 2 for t in tables.values()]))


def test_better_than_any_rule_for_the_edge_point_when_the_bias_is_unknown(tables):
    rotation = {m: pooled(tables, "rotation_rms_deg", m) for m in ("line_last_beam", "line", "line_ml")}
    assert 1.3 * rotation["line_ml"] < min(rotation["line_last_beam"], rotation["line"])
    for table in tables.values():
        best = min(table.loc[m, "rotation_rms_deg"] for m in ("line_last_beam", "line"))
        assert table.loc["line_ml", "rotation_rms_deg"] < 1.1 * best  # 20 trials scatter by that


def test_better_than_planes(tables):
    ratio = {c: pooled(tables, c, "zhang_pless") / pooled(tables, c, "line_ml")
             for c in ("rotation_rms_deg", "translation_rms_mm")}  # fmt: skip
    assert ratio["rotation_rms_deg"] > 3 and ratio["translation_rms_mm"] > 2


def test_the_bias_is_found_and_its_uncertainty_is_not_played_down(tables):
    for table in tables.values():
        assert table.loc["line_ml", "bias_error"] < 0.05
        assert table.loc["line_ml", "converged"] == 1.0
    assert np.mean([t.loc["line_ml", "nees"] for t in tables.values()]) < 1.2


def test_score_is_the_derivative_of_the_cost():
    rig, obs = camera_case(3, noise=1.0)
    own = (obs.crossing_half_step, obs.crossing_noise, obs.crossing_radius, obs.crossing_background)
    intervals = _Intervals(obs.crossing_points, *own, obs.crossing_lines, obs.crossing_line_sigma, obs.model)
    state = np.concatenate([pose_array(rig.T_camera_lrf), [[0.4], [-1.0], [0.0]]], axis=1)
    half, variance = intervals.freeze(state[:, :4])
    sigma = intervals.sigma(np.array(0.2), half, variance)
    block = _block(intervals, state, half, sigma)
    gradient = block.jacobian.T @ block.residuals
    for k, step in enumerate(1e-6 * np.eye(7)):
        cost = [np.sum(_block(intervals, _move(state, s), half, sigma).cost) for s in (step, -step)]
        assert gradient[k] == pytest.approx((cost[0] - cost[1]) / 2e-6, rel=1e-4, abs=1e-2)


def test_batch_equals_single():
    setup = ShotSetup(bias=0.3)
    shots = draw_shots(setup, np.random.default_rng(5), 3)
    T0 = start_near(shots, np.random.default_rng(6))
    found = crossings(shots, setup)
    batch = solve_line_ml_batch(*(found[k] for k in FULL), setup.model, T0, groups=found["groups"])
    _, obs = camera_case(0)
    names = {k: f"crossing_{k}" for k in FULL}
    other = {"crossing_placement": found["groups"], "model": setup.model}
    for i in range(3):
        single = solve_line_ml(replace(obs, **{names[k]: found[k][i] for k in FULL}, **other), T0[i])
        np.testing.assert_allclose(single.transform.as_matrix(), batch.transform.as_matrix()[i], atol=1e-7)
        assert single.parameters[6] == pytest.approx(batch.parameters[i, 6], abs=1e-6)
        assert softness(single) == pytest.approx(softness(batch)[i])


def test_the_start_does_not_matter():
    setup = ShotSetup(bias=-0.2)
    shots = draw_shots(setup, np.random.default_rng(7), 1)
    found = crossings(shots, setup)
    found = {k: np.repeat(v, 40, axis=0) if k != "groups" else v for k, v in found.items()}
    rng = np.random.default_rng(8)
    truth = RigidTransform.from_matrix(np.concatenate([shots["T_camera_lrf"][0], [[0, 0, 0, 1.0]]]))
    turn = Rotation.from_rotvec(rng.normal(0, 0.15, (40, 3))) * truth.rotation
    T0 = RigidTransform.from_components(truth.translation + rng.normal(0, 0.1, (40, 3)), turn)
    pose = solve_line_ml_batch(*(found[k] for k in FULL), setup.model, T0).transform.as_matrix()
    np.testing.assert_allclose(pose, np.broadcast_to(np.median(pose, axis=0), pose.shape), atol=1e-6)


def test_without_a_start_value():
    rig, obs = camera_case(9, noise=1.0)
    angle, distance = transform_difference(solve_line_ml(obs).transform, solve_line_ml(obs, rig.T_camera_lrf).transform)
    assert angle < 1e-7 and distance < 1e-7


def test_bias_in_metres_follows_the_radius():
    _, obs = camera_case(10, noise=1.0)
    found = solve_line_ml(obs)
    shift, sigma = edge_bias(found, 0.02)
    assert (shift, sigma) == pytest.approx(tuple(0.02 * v for v in edge_bias(found)))
    assert edge_bias(found, background=-1.0)[0] > edge_bias(found)[0]


def test_too_few_crossings_are_refused():
    _, obs = camera_case(11)
    few = replace(obs, **{f: getattr(obs, f)[:6] for f in vars(obs) if f.startswith("crossing_")})
    with pytest.raises(DegenerateGeometry, match="at least 7 needed"):
        solve_line_ml(few)


def test_drawn_readings_end_where_the_bias_says():
    setup = ShotSetup(bias=0.4, softness=0.0, sigma_range=0.0)
    shots = draw_shots(setup, np.random.default_rng(12), 4, placements=5)
    found = crossings(shots, setup)
    assert np.isfinite(shots["ranges"]).sum(axis=-1).min() >= 8
    pose = shots["T_camera_lrf"]
    p = found["points"] @ np.swapaxes(pose[..., :3], -1, -2) + pose[:, None, :, 3]
    normal = found["lines"] @ setup.model.matrix
    outside = np.sum(p * normal, axis=-1) / np.linalg.norm(normal, axis=-1)
    half = np.linalg.norm(found["half_step"], axis=-1)
    slack = 0.1 * half + 3 * setup.sigma_px * p[..., 2] / 1000
    assert (np.abs(outside - 0.4 * found["radius"]) < half + slack).all()


def test_boards_that_cannot_be_drawn_are_refused():
    with pytest.raises(ValueError, match="hardly ever"):
        draw_shots(ShotSetup(distances=(40.0, 41.0), step=np.radians(1.0)), np.random.default_rng(0), 2, 2)
