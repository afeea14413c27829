"""The tilt axis: the paper's projected fits and the weighted 3D estimate; and errors of the recorded pitch."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
import synthetic
from scipy.spatial.transform import RigidTransform, Rotation
from synthetic import CORNERS, TRIANGLE, edge_sweeps, sweep_boards

from lrfcal_lib.fit.axis_chart import move_head
from lrfcal_lib.model import geometry
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    axis_difference,
    head_from_axis,
    lrf_to_platform,
    pose_array,
    pose_transform,
)
from lrfcal_lib.model.observations import PlatformObservations
from lrfcal_lib.solvers import platform
from lrfcal_lib.solvers.pitch import estimate_pitch_errors
from lrfcal_lib.solvers.platform import solve_platform, solve_projected

DIRECTION = np.array([0.9993, 0.02, -0.0317])
TRUTH = head_from_axis(
    geometry.TiltAxis(DIRECTION / np.linalg.norm(DIRECTION), np.array([0.0, -0.05, -0.12]))
)
AXIS = geometry.axis_of(TRUTH)
ROUGH = RigidTransform.from_components([0.0, 0.03, 0.10], Rotation.identity())


def swept(rng, boards, corners=TRIANGLE, edges=(0, 2), **options):
    return PlatformObservations(
        **edge_sweeps(rng, TRUTH, boards, corners, edges=edges, **options)
    )


def make(seed=0, count=20, **options):
    rng = np.random.default_rng(seed)
    return swept(rng, sweep_boards(rng, count), **options)


def without_faces(obs):
    return obs.keep(face=obs.face_placement < 0)


def miss(found):
    """Angle (radians) and offset (metres) of an axis from the true one."""
    return np.array(axis_difference(found.axis, AXIS))


def chart_error(T):
    """Error in the chart (w_y, w_z, v_y, v_z)."""
    turn = (T * TRUTH.inv()).rotation.as_rotvec()
    return np.r_[turn[1:], (T.translation - TRUTH.translation)[1:]]


@pytest.mark.parametrize("faces", [True, False])
@pytest.mark.parametrize(
    ("solve", "T0"),
    [(solve_platform, None), (solve_platform, ROUGH), (solve_projected, ROUGH)],
)
def test_exact_data_are_recovered(solve, faces, T0):
    obs = make(2)
    found = solve(obs if faces else without_faces(obs), T0)
    assert found.solution.converged and (miss(found) < 1e-9).all()
    assert found.solution.unobservable == () and (
        found.skipped == {} or solve is solve_projected
    )


def pairs(obs, placements):
    return [
        [np.flatnonzero((obs.edge_placement == p) & (obs.edge_number == e)) for e in (1, 2)]
        for p in placements
    ]


def test_level_edges_are_reported_not_divided_by_zero():
    rng = np.random.default_rng(7)
    upright = Rotation.from_euler("x", 90, degrees=True)
    boards = sweep_boards(rng, 8) + [
        RigidTransform.from_components([0.0, 1.5, 0.0], upright)
    ]
    found = solve_projected(swept(rng, boards), TRUTH)
    assert "parallel to the x" in found.skipped[9] and miss(found)[1] < 1e-9
    with pytest.raises(
        DegenerateGeometry,
        match="projected fits: no placement can be used.*parallel to the x",
    ):
        solve_projected(swept(rng, boards[-1:]), TRUTH)


@pytest.mark.parametrize("printed", [False, True])
def test_scipy_agrees_with_the_projected_fits(printed):
    obs = make(21, noise=1.0)
    found = solve_projected(obs, TRUTH, printed=printed)
    start = pose_array(head_from_axis(found.axis))  # the terms hang on the frame
    groups = pairs(obs, found.placements)

    def residuals(step):
        return platform.projected_block(
            move_head(start, step), obs, groups, printed=printed
        ).residuals

    theirs = scipy.optimize.least_squares(
        residuals, np.zeros(4), xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    axis = geometry.axis_of(pose_transform(move_head(start, theirs.x)))
    assert max(axis_difference(found.axis, axis)) < 1e-6


def test_error_agrees_with_the_predicted_covariance(monkeypatch):
    monkeypatch.setattr(platform, "SIGMA_SKEW", 1e-4)
    monkeypatch.setattr(platform, "SIGMA_GAP", 1e-4)
    rng = np.random.default_rng(11)
    boards = sweep_boards(rng, 20)
    scores = []
    errors = []
    for _ in range(10):
        obs = swept(rng, boards, noise=1.0)
        found = solve_platform(obs, ROUGH)
        e = chart_error(found.T_head_lrf)
        covariance = found.solution.covariance
        scores.append(e @ np.linalg.solve(covariance, e) / 4)
        errors.append(e / np.sqrt(np.diag(covariance)))
    assert 0.6 < np.mean(scores) < 1.5
    assert np.abs(np.mean(errors, axis=0)).max() < 4.5 / np.sqrt(10)


def test_one_edge_with_a_face_serves_too():
    obs = make(14)
    keep = (obs.edge_number == 1) | (obs.edge_placement > 10)
    lone = obs.keep(edge=keep)
    found = solve_platform(lone, ROUGH)
    assert len(found.placements) == 20 and miss(found)[1] < 1e-9
    without = solve_platform(without_faces(lone), ROUGH)
    assert (
        set(without.skipped) == set(range(1, 11))
        and "no points on the face" in without.skipped[1]
    )


def test_parallel_edges_are_skipped_with_the_reason():
    rng = np.random.default_rng(15)
    with pytest.raises(DegenerateGeometry, match="nearly parallel"):
        solve_platform(swept(rng, sweep_boards(rng, 3), CORNERS, (1, 3)), ROUGH)


def test_pitch_that_never_changes_leaves_the_axis_open():
    obs = make(16)
    flat = replace(obs, edge_pitch=0 * obs.edge_pitch, face_pitch=0 * obs.face_pitch)
    with pytest.raises(DegenerateGeometry, match="do not determine .*offset of the axis"):
        solve_platform(flat, ROUGH)


@pytest.mark.parametrize(("field", "value", "message"), [
    ("edge_points", np.nan, "edge_points holds 3 values that are not finite, the first in row 4"),
    ("edge_pitch", np.inf, "edge_pitch holds 1 values that are not finite, the first in row 4"),
    ("face_points", np.nan, "face_points holds 3 values that are not finite"),
    ("edge_number", 3, r"edge_number must be 1 or 2 \(the two perpendicular edges\), got \[1 2 3\]"),
])  # fmt: skip
def test_what_cannot_be_is_refused(field, value, message):
    obs = make(18, count=2)
    values = getattr(obs, field).copy()
    values[4] = value
    with pytest.raises(ValueError, match=message):
        replace(obs, **{field: values})


# Errors of the recorded pitch


ALTERNATING = np.where(np.arange(1, 25) % 2 == 1, 1.0, -1.0)


def pitched(seed, offset, stretch, *, count=24, noise=0.0, cameras=("left",)):
    """Sweeps whose recorded pitch is the true one minus an error, and cameras on the base."""
    rng = np.random.default_rng(seed)
    rig = synthetic.random_rig(rng)
    poses = synthetic.random_board_poses(rng, count, rig, spread=0.7)
    obs = synthetic.camera_observations(
        rng, rig, poses, noise=0.0, source="platform", face=80
    )
    faces = (obs.plane_points[obs.plane_placement == p] for p in range(1, count + 1))
    middle = np.array([synthetic.meet(points, TRUTH)[1].mean() for points in faces])
    given = {}
    for name in ("crossing", "plane"):
        (p, true), rows = (
            synthetic.meet(getattr(obs, f"{name}_points"), TRUTH),
            getattr(obs, f"{name}_placement") - 1,
        )
        m, o, s = (np.broadcast_to(x, count)[rows] for x in (middle, offset, stretch))
        pitch = m + (true - m - o) / (1 + s)
        p = p + noise * rng.normal(size=(len(p), 1)) * p / np.linalg.norm(
            p, axis=1, keepdims=True
        )
        given |= {
            f"{name}_points": lrf_to_platform(p, pitch, TRUTH),
            f"{name}_pitch": pitch,
        }
    direction = {p: 1 if p % 2 else -1 for p in range(1, count + 1)}
    sweeps = (
        {name: replace(obs, **given) for name in cameras},
        direction,
        dict(enumerate(middle, start=1)),
    )
    return rig, sweeps


@pytest.mark.parametrize("edges", [True, False])
def test_direction_offset_is_recovered_and_asked_for(edges):
    _, (cameras, *sweeps) = pitched(20, np.radians(0.3) * ALTERNATING, 0.0, noise=0.003)
    if not edges:
        cameras = {
            name: obs.keep(crossing=np.zeros(len(obs.crossing_points), bool))
            for name, obs in cameras.items()
        }
    found = estimate_pitch_errors(cameras, *sweeps)
    assert np.degrees(found.direction_offset) == pytest.approx(0.3, abs=0.03)
    assert abs(found.direction_offset - np.radians(0.3)) < 4 * found.direction_sigma
    assert found.wanted == "direction" and found.models["direction"].p_value < 1e-6
    assert found.models["direction"].misfit < found.models["none"].misfit


def test_an_honest_platform_asks_for_nothing():
    wanted = []
    scores = []
    for seed in range(100, 110):
        _, sweeps = pitched(seed, 0.0, 0.0, noise=0.003)
        found = estimate_pitch_errors(*sweeps)
        wanted.append(found.wanted)
        scores.append(found.direction_offset / found.direction_sigma)
    assert wanted.count("none") >= 9
    assert 0.4 < np.std(scores) < 1.6


def test_offsets_and_stretches_of_single_sweeps_are_recovered():
    rng = np.random.default_rng(23)
    offset = np.radians(rng.normal(0, 0.3, 24))
    stretch = rng.normal(0, 0.03, 24)
    _, sweeps = pitched(24, offset - offset.mean(), stretch, cameras=("left", "right"))
    found = estimate_pitch_errors(*sweeps)
    model = found.models["sweep_stretch"]
    assert found.wanted == "sweep_stretch" and model.converged
    assert np.degrees(np.abs(model.offset - offset + offset.mean())).max() < 0.02
    assert np.abs(model.stretch - stretch).max() < 0.003


def test_pitch_errors_need_cameras_on_the_base():
    _, (cameras, *sweeps) = pitched(28, 0.0, 0.0)
    obs = cameras["left"]
    with pytest.raises(ValueError, match="source 'lrf'"):
        estimate_pitch_errors({"left": replace(obs, source="lrf")}, *sweeps)
    with pytest.raises(DegenerateGeometry, match="3 placements seen by the LRF"):
        estimate_pitch_errors({"left": obs.select([1, 2, 3])}, *sweeps)
    with pytest.raises(
        ValueError, match="plane_pitch of camera 'left' holds 1 values that are not finite"
    ):
        replace(
            obs,
            plane_pitch=np.where(
                np.arange(len(obs.plane_pitch)) == 3, np.nan, obs.plane_pitch
            ),
        )
