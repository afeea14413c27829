"""What all camera methods share, and the line methods: exact data, covariance, start values, bad input."""

import doctest
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import RigidTransform, Rotation
from synthetic import camera_case, camera_observations

from lrfcal_lib.fit.residuals import line_block, plane_residuals_m
from lrfcal_lib.model import observations
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    move_pose,
    pose_array,
    pose_transform,
    transform_difference,
)
from lrfcal_lib.solvers import (
    CANDIDATES,
    METHODS,
    best_method,
    solve_camera,
    starting_transform,
)
from lrfcal_lib.solvers.lines import distance_block, point_block

OFF = RigidTransform.from_components(
    [0.05, -0.04, 0.06], Rotation.from_rotvec([0.05, -0.04, 0.03])
)
RESIDUALS = {
    "line": line_block,
    "wasielewski_strauss": distance_block,
    "bauermann": point_block,
}


def increment(found, truth):
    """Error as [w, v]."""
    turn = found.rotation * truth.rotation.inv()
    return np.concatenate(
        [turn.as_rotvec(), found.translation - truth.translation], axis=-1
    )


def miss(found, rig):
    """Rotation (radians) and translation error (metres) of a solution or a transform."""
    return np.array(
        transform_difference(getattr(found, "transform", found), rig.T_camera_lrf)
    )


def rows_of(obs, prefix, rows):
    return replace(
        obs, **{f: getattr(obs, f)[rows] for f in vars(obs) if f.startswith(prefix)}
    )


def test_the_example_of_plain_arrays_runs():
    failed, attempted = doctest.testmod(observations)
    assert attempted and not failed


@pytest.mark.parametrize("source", ["lrf", "platform"])
@pytest.mark.parametrize("name", METHODS)
def test_every_method_recovers_exact_data(name, source):
    rig, obs = camera_case(1, source=source)
    found = solve_camera(obs, name)
    assert (miss(found, rig) < 1e-9).all()
    assert found.converged and found.unobservable == ()
    assert (
        found.covariance.shape == (len(found.names),) * 2
        and np.isfinite(found.covariance).all()
    )


@pytest.mark.parametrize(
    "field", ["crossing_points", "crossing_covariance", "plane_points", "scene_points"]
)
def test_values_that_are_not_finite_are_refused(field):
    _, obs = camera_case(3)
    values = getattr(obs, field).copy()
    values[2].flat[1] = np.inf
    with pytest.raises(
        ValueError,
        match=f"{field} of camera 'left' holds 1 values that are not finite, .* row 2",
    ):
        replace(obs, **{field: values})


@pytest.mark.parametrize("name", METHODS)
def test_every_method_refuses_one_placement_only(name):
    _, obs = camera_case(4)
    one = obs.select([1])
    one = rows_of(one, "scene_", slice(1)) if METHODS[name].uses == "scene" else one
    with pytest.raises(DegenerateGeometry, match="unobservable|do not determine"):
        solve_camera(one, name)


@pytest.mark.parametrize(
    ("name", "prefix", "count", "words"),
    [
        *(
            (
                name,
                "crossing_",
                n,
                f"{n} of the {n + 1} crossings of scan lines with edges",
            )
            for name, n in (("line", 5), ("wasielewski_strauss", 5))
        ),
        ("bauermann", "scene_", 2, "2 of the 3 scene points"),
        (
            "lines",
            "scene_",
            2,
            "unknown method 'lines': use one of line_printed, line_last_beam, line,",
        ),
    ],
)
def test_too_few_rows_and_unknown_methods_are_refused(name, prefix, count, words):
    with pytest.raises(ValueError, match=words):
        solve_camera(rows_of(camera_case(6)[1], prefix, slice(count)), name)


def bent_lines(obs):
    """Every edge of the board seems to lie 20 px outside, as a wide spot of the laser makes it."""
    return replace(obs, crossing_lines=obs.crossing_lines - [0.0, 0.0, 20.0])


def crooked_planes(obs):
    """Every face of the board seems to lie elsewhere, as a wrong pattern makes it."""
    poses = obs.board_poses.copy()
    poses[:, :3, 3] += np.random.default_rng(2).normal(0, 0.05, (len(poses), 3))
    return replace(obs, board_poses=poses)


HANDED_OVER = {  # what a session shows, and which method is then the default
    "bent lines": (bent_lines, "zhang_pless"),
    "crooked planes": (crooked_planes, "line"),
    "no planes": (lambda obs: rows_of(obs, "plane_", slice(0)), "line"),
    "no edges": (lambda obs: rows_of(obs, "crossing_", slice(0)), "zhang_pless"),
    "too few to leave one out": (lambda obs: obs.select(obs.placements[:3]), None),
}


@pytest.mark.parametrize("case", HANDED_OVER)
def test_the_method_that_errs_less_on_placements_left_out_is_handed_over(case):
    change, best = HANDED_OVER[case]
    obs = change(camera_case(7, 14, noise=1.0)[1])
    found = {}
    for method in CANDIDATES:
        with suppress(DegenerateGeometry):
            found["left", method] = solve_camera(obs, method)
    assert best_method({"left": obs}, found) == best


def test_without_a_result_nothing_is_handed_over():
    assert best_method({"left": camera_case(7)[1]}, {}) is None


@pytest.mark.parametrize("name", METHODS)
def test_errors_agree_with_the_covariance(name):
    rig, obs = camera_case(5, 12)
    rng = np.random.default_rng(6)
    scores = []
    poses = [RigidTransform.from_matrix(m) for m in obs.board_poses]
    for _ in range(10):
        found = solve_camera(
            camera_observations(rng, rig, poses, noise=1.0), name, rig.T_camera_lrf
        )
        e = increment(found.transform, rig.T_camera_lrf)
        known = found.trusted if name == "zhang_pless_printed" else found.covariance
        scores.append(e @ np.linalg.solve(known[:6, :6], e) / 6)
    # it takes boards as exact: all it knows of their errors is the scatter of 12 placements (Hotelling: 11 / 4)
    assert 0.6 < np.mean(scores) < (2.75 if name == "zhang_pless_printed" else 1.6)


@pytest.mark.parametrize(
    ("name", "weighted"),
    [
        ("line", True),
        ("line", False),
        ("wasielewski_strauss", False),
        ("planes", False),
        ("bauermann", True),
        ("bauermann", False),
    ],
)
def test_scipy_agrees(name, weighted):
    rig, obs = camera_case(10, noise=1.0, source="platform" if name == "planes" else "lrf")
    start = pose_array(rig.T_camera_lrf)
    options = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15)

    def residuals(d):
        pose = move_pose(start, d)
        if name == "planes":
            return plane_residuals_m(obs, pose_transform(pose))
        block = RESIDUALS[name](pose, obs)
        return block.white if weighted else block.residuals

    theirs = scipy.optimize.least_squares(residuals, np.zeros(6), **options)
    ours = solve_camera(
        obs,
        "zhang_pless" if name == "planes" else name,
        rig.T_camera_lrf,
        weighted=weighted,
    )
    np.testing.assert_allclose(
        pose_array(ours.transform), move_pose(start, theirs.x), atol=2e-6
    )
    assert not weighted or ours.chi2 / 2 == pytest.approx(theirs.cost, rel=1e-9)
    counts = {"planes": len(obs.plane_points), "bauermann": 2 * len(obs.scene_points)}
    assert ours.n_observations == counts.get(name, len(obs.crossing_points))


BATCHED = {  # methods that solve many trials at once, and the points that differ between trials
    "line": "crossing", "line_printed": "crossing", "wasielewski_strauss": "crossing", "bauermann": "scene",
    "zhang_pless": "plane", "zhang_pless_printed": "plane",
}  # fmt: skip


@pytest.mark.parametrize("name", BATCHED)
def test_many_trials_at_once_are_the_trials_one_by_one(name):
    rig, obs = camera_case(11, noise=1.0)
    rng = np.random.default_rng(12)
    field = f"{BATCHED[name]}_points"
    points = getattr(obs, field) + rng.normal(0, 0.002, (4, *getattr(obs, field).shape))
    boards, covariance = (
        np.stack([x] * 4) for x in (obs.board_poses, obs.board_covariance)
    )
    more = (
        {"board_poses": boards, "board_covariance": covariance}
        if BATCHED[name] == "plane"
        else {}
    )
    if BATCHED[name] == "plane":
        more["plane_covariance"] = np.stack([obs.plane_covariance] * 4)
    many = solve_camera(replace(obs, **{field: points}, **more), name, rig.T_camera_lrf)
    assert many.converged.shape == (4,) and many.converged.all()
    for i, one in enumerate(points):
        alone = solve_camera(
            replace(obs, **{field: one}), name, rig.T_camera_lrf, search=False
        )
        np.testing.assert_allclose(
            pose_array(many.transform[i]), pose_array(alone.transform), atol=1e-9
        )
        np.testing.assert_allclose(
            many.covariance[i], alone.covariance, rtol=1e-6, atol=1e-15
        )


@pytest.mark.parametrize("name", METHODS)
def test_the_frame_of_the_source_does_not_matter(name):
    """Scanner coordinates turned and shifted by T: the pose is the old one times the inverse of T."""
    rig, obs = camera_case(13, noise=1.0)
    T = RigidTransform.from_components(
        [0.3, -0.2, 0.1], Rotation.from_rotvec([0.2, -0.4, 0.3])
    )
    R = T.rotation.as_matrix()
    moved = {}
    for group in ("crossing", "plane", "scene"):
        moved[f"{group}_points"] = T.apply(getattr(obs, f"{group}_points"))
        moved[f"{group}_covariance"] = R @ getattr(obs, f"{group}_covariance") @ R.T
    start = rig.T_camera_lrf * OFF
    before = solve_camera(obs, name, start, search=False)
    after = solve_camera(replace(obs, **moved), name, start * T.inv(), search=False)
    np.testing.assert_allclose(
        pose_array(after.transform), pose_array(before.transform * T.inv()), atol=2e-8
    )
    assert np.sum(after.chi2) == pytest.approx(np.sum(before.chi2), rel=1e-6)


@pytest.mark.parametrize("name", METHODS)
def test_the_order_of_the_rows_does_not_matter(name):
    rig, obs = camera_case(14, noise=1.0)
    rng = np.random.default_rng(15)
    shuffled = obs
    for prefix in ("crossing_", "plane_", "scene_"):
        order = rng.permutation(len(getattr(obs, f"{prefix}placement")))
        shuffled = rows_of(shuffled, prefix, order)
    order = rng.permutation(len(obs.placements))
    of_boards = ("placements", "board_poses", "board_covariance", "pattern_pixels")
    shuffled = replace(
        shuffled, **{field: getattr(obs, field)[order] for field in of_boards}
    )
    start = rig.T_camera_lrf * OFF
    one, other = (solve_camera(each, name, start, search=False) for each in (obs, shuffled))
    np.testing.assert_allclose(
        pose_array(other.transform), pose_array(one.transform), atol=1e-8
    )
    np.testing.assert_allclose(
        other.covariance_placements, one.covariance_placements, rtol=1e-4, atol=1e-14
    )


def test_robust_loss_resists_wrong_edges():
    rig, obs = camera_case(15, count=20, noise=1.0)
    lines = obs.crossing_lines.copy()
    lines[::10, 2] += 60.0
    spoiled = replace(obs, crossing_lines=lines)
    plain, robust = (
        miss(solve_camera(spoiled, "line", robust=robust), rig)[1]
        for robust in (False, True)
    )
    assert robust < 0.03 and robust < 0.5 * plain


def test_nothing_to_start_from():
    with pytest.raises(DegenerateGeometry, match="no start value.*planes:.*lines:"):
        starting_transform(camera_case(19)[1].select([]))


def test_parallel_edges_leave_a_motion_open():
    rig, obs = camera_case(20, count=6)
    lines = np.tile([1.0, 0.0, -rig.model.cx], (len(obs.crossing_lines), 1))
    x, y, _ = obs.crossing_points.T
    points = rig.T_camera_lrf.inv().apply(np.column_stack([0 * x, x, 2 + y]))
    parallel = replace(obs, crossing_lines=lines, crossing_points=points)
    with pytest.raises(DegenerateGeometry, match="do not determine .*translation along y"):
        solve_camera(parallel, "line", rig.T_camera_lrf)


def test_points_on_one_line_leave_a_rotation_open():
    rig, obs = camera_case(5, 3)
    points = np.linspace([0.0, 1.5, -0.2], [0.2, 1.5, 0.3], 12)
    q = rig.T_camera_lrf.apply(points) @ rig.model.matrix.T
    with pytest.raises(DegenerateGeometry, match="do not determine rotation about"):
        solve_camera(
            replace(obs, scene_points=points, scene_pixels=q[:, :2] / q[:, 2:]),
            "bauermann",
            rig.T_camera_lrf,
        )
