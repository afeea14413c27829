"""What to record next comes true, and weak recordings are named before any number is shown."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.evaluate.jointly import range_residuals, view_residuals
from lrfcal_lib.evaluate.next_placement import (
    Suggestion,
    board_grid,
    candidate_information,
    direction_words,
    group_sigma,
    measure_yield,
    observability,
    own_placements,
    suggest_placement,
    visible,
)
from lrfcal_lib.evaluate.uncertainty import beams_to, information
from lrfcal_lib.evaluate.verdict import diagnose, verdict
from lrfcal_lib.fit.residuals import JointState
from lrfcal_lib.model.geometry import DegenerateGeometry, pose_array
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.simulate.draw import bench, board_poses, observe
from lrfcal_lib.solvers.joint import solve_joint

PATTERN = np.array([[0.04 + 0.03 * i, 0.04 + 0.03 * j, 0.0] for i in range(5) for j in range(6) if i + j < 7])
COARSE = {"distances": (1.0, 2.0), "turns": tuple(np.radians([0, 120, 240])), "elevations": (0.0,)}
VIEW, PITCHES = np.radians([40.0, 140.0]), np.radians([-25.0, 25.0])


def truth(rig, poses):
    """The state that observations were drawn from."""
    count = len(poses)
    sensor = np.array([rig.range_offset, 0.0, np.log(rig.softness), 0.0, 0.0])
    cameras, boards = (np.stack([pose_array(T) for T in some]) for some in (rig.cameras.values(), poses))
    return JointState(
        pose_array(rig.T_head_lrf), cameras, sensor, np.zeros(3), boards, np.zeros((count, 2)), np.zeros((count, 3))
    )


def solve(rig, poses, rng, **settings):
    obs = JointObservations(**observe(rig, poses, rng, **settings))
    return solve_joint(obs, start=truth(rig, poses), required=False)


def models_of(rig):
    return dict.fromkeys(rig.cameras, rig.model)


@pytest.fixture(scope="module")
def good():
    rng = np.random.default_rng(1)
    rig = bench(rng)
    poses = board_poses(rng, 8)
    return rig, poses, solve(rig, poses, rng)


@pytest.fixture(scope="module")
def suggested(good):
    rig, _, solution = good
    return suggest_placement(solution, models_of(rig), features=PATTERN)


def spread(solution):
    """What the A criterion makes small."""
    return np.sqrt(sum(s**2 for s in group_sigma(solution.solution.covariance, solution).values()))


def with_board(rig, poses, pose, solution, seed):
    """By how much one more placement really shrinks the uncertainty, and the new solution."""
    found = solve(rig, [*poses, pose], np.random.default_rng(seed))
    return 1 - spread(found) / spread(solution), found


def test_information_of_own_placements_is_predicted(good):
    rig, _, solution = good
    rate = measure_yield(solution, models_of(rig), features=PATTERN)
    assert np.allclose(np.degrees([rate.bearing_step, rate.pitch_step]), 0.5, rtol=1e-3)
    assert np.allclose(rate.pixels, rig.sigma_px, rtol=0.02)
    here = replace(own_placements(solution), pitches=solution.data.view["pitch"][:, :3])
    forecast = candidate_information(here, solution, models_of(rig), rate).sum(axis=0)
    sigma, wanted = (np.sqrt(np.diag(np.linalg.inv(H))) for H in (forecast, information(solution).sum(axis=0)))
    assert np.allclose(sigma, wanted, rtol=0.15)


def test_the_suggested_placement_brings_what_it_promises(good, suggested):
    rig, poses, solution = good
    gain, found = with_board(rig, poses, suggested.T_platform_board, solution, 5)
    assert gain > 0.8 * suggested.gain
    after = group_sigma(found.solution.covariance, found)
    assert suggested.after == pytest.approx(after, rel=0.2)
    blind = [with_board(rig, poses, p, solution, 6)[0] for p in board_poses(np.random.default_rng(7), 5)]
    assert gain > 1.2 * np.median(blind)
    assert suggested.gain > 1.5 * suggested.median_gain > 0


def test_the_suggestion_in_words(suggested):
    words = suggested.sentence()
    assert words.startswith(f"Record next: board {suggested.distance:.1f} m ahead")
    assert "images at pitch" in words and "axis" in words and "left" in words and "% less" in words
    fixed = replace(suggested, on_head=False, bearing=np.radians(-20), elevation=0.0, turn=0.0, towards="", lean=0.0)
    assert fixed.words() == f"board {fixed.distance:.1f} m ahead, 20 deg to the right, upright"
    leaning = replace(fixed, towards="left", lean=np.radians(35), turn=np.radians(60), elevation=np.radians(-12))
    assert leaning.words().endswith("12 deg down, turned 60 deg in its plane, facing left by 35 deg")
    assert isinstance(suggested, Suggestion)


def test_candidates_stand_where_their_words_say(good):
    solution = good[2]
    grid = board_grid(solution, (1.5,), np.radians([20.0]), np.radians([10.0]), (0.0,), np.radians([0.0, 30.0]))
    middle = grid.boards[:, :, :3] @ [0.105, 0.38 / 3, 0.0] + grid.boards[:, :, 3]
    p = solution.T_head_lrf.inv().apply(middle)
    assert np.allclose(np.linalg.norm(p, axis=1), 1.5)
    assert np.allclose(np.degrees(np.arctan2(-p[:, 0], p[:, 1])), 20)
    assert np.allclose(np.degrees(np.arcsin(p[:, 2] / 1.5)), 10)
    normal = solution.T_head_lrf.rotation.inv().apply(grid.boards[:, :, 2])
    facing = dict(zip(grid.towards.tolist(), normal, strict=True))
    assert np.allclose(facing[""], -p[0] / 1.5)  # upright boards face the LRF
    assert facing["back"][2] > facing[""][2] > facing["forward"][2]
    assert facing["left"][0] < facing[""][0] < facing["right"][0]


def test_only_poses_that_all_see(good):
    rig, _, solution = good
    grid = board_grid(solution, (0.3, 1.5), np.radians([-60, 0, 20]), (0.0,), (0.0, 2.0), np.radians([0, 35, 70]))
    seen = visible(grid, solution, models_of(rig), VIEW, PITCHES, 3)
    assert 0 < len(seen) < len(grid)
    assert (seen.distance > 1).all() and (np.abs(seen.bearing) < 0.5).all() and (seen.lean < 1.1).all()
    assert seen.pitches.shape[1] == 3 and (np.abs(seen.pitches) <= PITCHES[1] + 1e-9).all()
    ends = np.einsum("nij,kj->nki", seen.boards[:, :, :3], [[0.315, 0, 0], [0, 0.38, 0]])
    corners = seen.boards[:, None, :, 3] + ends
    bearing, pitch, _ = beams_to(corners, solution.T_head_lrf)
    assert ((bearing > VIEW[0]) & (bearing < VIEW[1]) & (np.abs(pitch) < PITCHES[1])).all()


def test_volume_criterion_and_cameras_on_the_base():
    rng = np.random.default_rng(2)
    rig = bench(rng, mount="platform")
    solution = solve(rig, board_poses(rng, 6), rng)
    found = suggest_placement(solution, models_of(rig), criterion="D", places=COARSE)
    assert 0 < found.median_gain < found.gain < 1
    assert len(found.pitches) == 1 and "images at" not in found.words()


def test_suggestions_refuse_bad_input(good):
    rig, _, solution = good
    models = models_of(rig)
    with pytest.raises(ValueError, match="criterion is 'A' or 'D', got 'E'"):
        suggest_placement(solution, models, criterion="E")
    with pytest.raises(ValueError, match="camera 'right' has no intrinsics"):
        suggest_placement(solution, {"left": rig.model})
    with pytest.raises(ValueError, match="pitch_limits must be"):
        suggest_placement(solution, models, pitch_limits=(0.1, -0.1))
    with pytest.raises(DegenerateGeometry, match="none of .* board poses lies wholly in the view"):
        suggest_placement(solution, models, places=COARSE | {"distances": (0.1,)})
    words = verdict(solution, models, places=COARSE | {"distances": (0.1,)}).sentences()
    assert words[-1].startswith("No placement can be suggested: none of")


def test_observability_lists_what_is_known_least_first(good):
    directions = observability(good[2])
    values = [d.value for d in directions]
    assert values == sorted(values) and len(values) == 18  # all but the softness of the edges
    assert all(d.sigma == pytest.approx(1 / d.value) for d in directions)
    assert 1e-4 < directions[0].sigma < 0.05 and all(d.words for d in directions)


def test_directions_in_words():
    names = ["offset_in_scan_plane", "range_offset"]
    names += [f"{c}_{p}" for c in ("left", "right") for p in ("rx", "ry", "rz", "tx", "ty", "tz")]
    x = np.zeros(len(names))
    x[[5, 11]] = 0.9, 0.9
    x[1] = 1.0
    assert direction_words(x, names, ("left", "right")) == "the range offset with shift along x of all cameras"
    x[11], x[1] = 0.0, 0.1
    assert direction_words(x, names, ("left", "right")) == "shift along x of camera 'left'"


def test_a_good_recording_is_trusted(good):
    rig, _, solution = good
    found = verdict(solution, models_of(rig), places=COARSE)
    assert found.answer == "yes" and found.reasons == ()
    words = found.sentences()
    assert words[0] == "This calibration can be trusted."
    assert [w.split(":")[0] for w in words[1:4]] == [f"Expected error at {d} m" for d in (1, 2, 5)]
    assert "in the image of 'right'" in words[2] and words[-1].startswith("Record next: board")
    assert set(found.errors[2.0]) == {"cloud_mm", "left_px", "right_px"}
    assert 0.1 < found.errors[2.0]["left_px"] < 3 and 0.1 < found.errors[2.0]["cloud_mm"] < 10


def kinds(solution):
    return {reason.kind for reason in diagnose(solution)}


def test_a_camera_that_never_sees_the_board(good):
    rig, poses, _ = good
    obs = JointObservations(**observe(rig, poses, np.random.default_rng(3)))
    obs = obs.keep(view=obs.view_camera == 0)
    with pytest.raises(DegenerateGeometry, match="camera 'right' never sees the board"):
        solve_joint(obs)
    solution = solve_joint(obs, required=False)
    found = verdict(solution, models_of(rig), suggest=False)
    assert found.answer == "with care"
    assert found.sentences()[0].startswith("Use this calibration with care: camera 'right' never sees the board")
    assert set(found.errors[2.0]) == {"cloud_mm", "left_px"}


def test_a_motion_that_nothing_determines(good):
    rig, poses, _ = good
    rng = np.random.default_rng(3)
    obs = JointObservations(**observe(rig, poses, rng))
    first = obs.view_placement == 0  # the right camera sees the first board only, which no scan hits
    obs = obs.keep(view=first == (obs.view_camera == 1), beam=obs.beam_placement != 0, face=obs.face_placement != 0)
    solution = solve_joint(obs, start=truth(rig, poses), required=False)
    found = verdict(solution, models_of(rig), suggest=False)
    assert found.answer == "no"
    assert found.sentences()[0].startswith("This calibration cannot be trusted: the data do not determine")
    assert np.isinf(found.errors[2.0]["right_px"]) and np.isfinite(found.errors[2.0]["left_px"])
    assert "no bound in the image of 'right'" in found.sentences()[2]
    assert not np.isnan(solution.solution.sigma).any(), "rounding errors are no information"
    lost = [d.words for d in observability(solution) if np.isinf(d.sigma)]
    assert lost and any("camera 'right'" in words for words in lost)


def test_a_pitch_range_of_one_degree(good):
    rig, poses, _ = good
    solution = solve(rig, poses, np.random.default_rng(4), span=np.radians(1.0), images=1)
    found = verdict(solution, models_of(rig), places=COARSE)
    assert found.answer == "no"
    assert "the recorded pitch ranges over 1.0 deg only within a placement" in found.sentences()[0]
    assert found.errors[2.0]["cloud_mm"] > 10
    assert found.suggestion.gain > 0.5


def test_images_at_one_pitch_are_named(good):
    rig, poses, _ = good
    assert "image pitch" in kinds(solve(rig, poses, np.random.default_rng(5), images=1))


def test_all_boards_parallel(good):
    rig, poses, _ = good
    rng = np.random.default_rng(6)
    face = poses[0].rotation
    spun = [face * Rotation.from_rotvec([0, 0, angle]) for angle in rng.uniform(0, 6, len(poses))]
    parallel = [RigidTransform.from_components(p.translation, R) for p, R in zip(poses, spun, strict=True)]
    found = verdict(solve(rig, parallel, rng), models_of(rig), suggest=False)
    assert found.answer != "yes" and "all boards are parallel" in found.sentences()[0]


def test_all_boards_at_one_distance(good):
    rig, _, _ = good
    rng = np.random.default_rng(8)
    found = verdict(solve(rig, board_poses(rng, 8, (1.5, 1.52)), rng), models_of(rig), suggest=False)
    assert found.answer != "yes" and "all boards stand at one distance" in found.sentences()[0]


def test_few_placements_are_named(good):
    rig, poses, _ = good
    few = solve(rig, poses[:4], np.random.default_rng(9))
    assert "placements" in kinds(few)
    two = diagnose(solve(rig, poses[:2], np.random.default_rng(9)))
    assert {r.answer for r in two if r.kind in ("placements", "cameras")} == {"no", "with care"}


def test_misfit_model_error_and_noise_are_named(good):
    solution = good[2]
    bad = replace(solution, misfit=solution.misfit | {3: 30.0}, excluded={9: "placement 9: left out"})
    bad = replace(bad, warnings=("not converged after 60 iterations", "the data ask for the scale of the pitch"))
    bad = replace(bad, noise=solution.noise | {"face_scale": 2.6})
    covariance = 25 * solution.solution.covariance
    bad = replace(bad, solution=replace(bad.solution, covariance_placements=covariance, converged=False))
    words = {r.kind: r.words for r in diagnose(bad)}
    assert words["misfit"].startswith("placements fit much worse than the others: 3 (5.")
    assert words["warning"] == "the data ask for the scale of the pitch"
    assert words["excluded"] == "placement 9: left out"
    assert "5.0 times more than noise explains" in words["model error"]
    assert words["noise"] == "residuals are larger than the stated noise (ranges 2.6 times)"
    assert "has not converged" in words["convergence"]
    absurd = replace(bad, noise=solution.noise | {"view_scale": 11.0, "face_share": 0.05})
    found = {r.kind: r for r in diagnose(absurd)}
    assert found["noise"].answer == "no" and found["dependent"].words.startswith("only 5 % of the errors of ranges")


def test_large_errors_forbid_trust(good):
    rig, _, solution = good
    wide = replace(solution, solution=replace(solution.solution, covariance=4e4 * solution.solution.covariance))
    found = verdict(wide, models_of(rig), suggest=False)
    assert found.answer == "no" and "the expected error at 2 m is" in found.sentences()[0]


def test_residuals_are_what_the_noise_makes(good):
    rig, _, solution = good
    distance, residual, placement = range_residuals(solution)
    assert np.std(residual) == pytest.approx(rig.sigma_range, rel=0.05)
    assert len(distance) == len(residual) == len(placement) and set(placement) == set(solution.boards)
    uv, shift, placement = view_residuals(solution, "left", rig.model)
    assert len(uv) == 24 and (uv > 0).all() and (uv < [rig.model.width, rig.model.height]).all()
    assert 0.02 < np.sqrt(np.mean(shift**2)) < 0.5  # a board's middle is better known than a corner's 0.3 px
    with pytest.raises(ValueError, match="got 'rear'"):
        view_residuals(solution, "rear", rig.model)
