"""Statements that contradict the data are named, with the size of the error; honest ones are not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from joint_draws import draw, rng
from scipy.spatial.transform import Rotation
from shared import campaign

from lrfcal_lib.evaluate.monte_carlo import state_errors
from lrfcal_lib.judge.alternatives import (
    ALTERNATIVES,
    alternatives_of,
    doubtful,
    step_words,
    weigh,
)
from lrfcal_lib.judge.lens import lens_findings
from lrfcal_lib.model.board import Chessboard
from lrfcal_lib.model.geometry import hat
from lrfcal_lib.preprocess.intrinsics import estimate_intrinsics, first_pose
from lrfcal_lib.preprocess.prepared import Prepared
from lrfcal_lib.solvers.joint import solve_joint

ADMITTED = 0.025
PATTERN = Chessboard(9, 5, 0.036, (0.1, 0.1))
SENSOR = ("range_offset", "edge_log_odds", "edge_log_softness", "pitch_scale")


def solved(seed, change=lambda obs: obs, step_sigma=0.0058, **settings):
    obs, _, rig = draw(rng(seed), 12, **settings)
    obs = change(replace(obs, T_head_lrf=rig.T_head_lrf))
    asked = {"sensor": SENSOR, "noise": "estimate", "step_sigma": step_sigma}
    return solve_joint(obs, required=False, **asked)


@pytest.mark.parametrize(
    ("kind", "value", "mount"),
    [("squares", 0.02, "head"), ("outline", 0.03, "platform"), ("ranges", -0.05, "head"),
     ("bearings", 0.03, "platform"), ("lag", 0.003, "head"), *(pytest.param(k, v, "platform", marks=campaign)
      for k, v in (("squares", -0.05), ("ranges", 0.02), ("lag", -0.005)))],
)  # fmt: skip
def test_a_wrong_statement_is_named_with_its_size(kind, value, mount):
    doubts = doubtful(
        solved(5, lambda obs: ALTERNATIVES[kind].change(obs, value), mount=mount), ADMITTED
    )
    assert kind in [doubt.kind for doubt in doubts]
    found = next(doubt for doubt in doubts if doubt.kind == kind)
    assert found.value == pytest.approx(-value, abs=0.25 * abs(value) + 3 * found.sigma)
    assert (
        ALTERNATIVES[kind].words.partition(": ")[2] in found.words
        and ALTERNATIVES[kind].signs[int(value > 0)] in found.words
    )


def doubt_about_squares(seed, by, corners):
    """What the data say of the squares with the board's origin moved by `by` (metres)."""

    def change(obs):
        poses = obs.view_pose.copy()
        arm = obs.view_pose[:, :3, :2] @ by
        poses[:, :3, 3] += arm
        turn = np.tile(np.eye(6), (len(poses), 1, 1))
        turn[:, 3:, :3] = -hat(arm)
        covariance = turn @ obs.view_covariance @ np.swapaxes(turn, -1, -2)
        return replace(
            obs, view_pose=poses, view_covariance=covariance, corners=obs.corners - by
        )

    solution = solved(seed, change)
    pattern = Chessboard(4, 5, 0.029, tuple(np.array([0.05, 0.05]) - by))
    lrf = SimpleNamespace(spot_exit=None)
    session = SimpleNamespace(lrf=lrf, board=SimpleNamespace(corners=corners))
    stated = alternatives_of(
        SimpleNamespace(session=session, board=SimpleNamespace(pattern=pattern))
    )
    return next(
        doubt for doubt in weigh(solution, ADMITTED, stated) if doubt.kind == "squares"
    )


@pytest.mark.parametrize("corners", [None, "stated"])
def test_what_the_data_say_of_squares_does_not_depend_on_the_origin(corners):
    here, there = (
        doubt_about_squares(5, np.array(by), corners) for by in ((0.0, 0.0), (0.315, 0.38))
    )
    assert there.value == pytest.approx(here.value, abs=0.3 * here.sigma)
    assert there.sigma == pytest.approx(here.sigma, rel=0.2)


def test_an_outline_that_the_images_measured_is_no_statement():
    plain = SimpleNamespace(pattern=None)
    session = SimpleNamespace(
        lrf=SimpleNamespace(spot_exit=0.01), board=SimpleNamespace(corners=None)
    )
    assert "squares" not in alternatives_of(SimpleNamespace(session=session, board=plain))
    printed = SimpleNamespace(pattern=PATTERN)
    assert "outline" not in alternatives_of(SimpleNamespace(session=session, board=printed))
    assert "leave" not in ALTERNATIVES["spot"].words


@pytest.mark.parametrize(("value", "mount"), [(0.03, "head"), (-0.03, "platform")])
def test_an_angular_step_that_is_off_is_no_range_offset(value, mount):
    best = doubtful(solved(7, lambda obs: obs.stretched(value), mount=mount), ADMITTED)[0]
    assert best.kind == "bearings" and "check the angular step" in best.words
    assert best.value == pytest.approx(-value, abs=5 * best.sigma)


@pytest.mark.parametrize(("mount", "least"), [("head", 1.5), ("platform", 0.5)])
def test_what_errors_of_the_step_do_is_what_another_estimate_finds(mount, least):
    obs, _, rig = draw(rng(1), 12, mount=mount)
    obs = replace(obs, T_head_lrf=rig.T_head_lrf)
    known, open_step, stretched = (
        solve_joint(at, sensor=SENSOR, step_sigma=sigma)
        for at, sigma in ((obs, 0.0), (obs, 0.004), (obs.stretched(0.004), 0.0))
    )
    moved = state_errors(stretched.state, known.state, known.unknowns)
    sigma = known.solution.sigma
    np.testing.assert_allclose(open_step.step / sigma, moved / sigma, atol=0.1)
    assert np.abs(moved / sigma).max() > least
    spread = open_step.solution.covariance - known.solution.covariance
    np.testing.assert_allclose(spread, np.outer(open_step.step, open_step.step), atol=1e-12)


@pytest.mark.parametrize(("step_sigma", "named"), [(0.0, False), (0.0058, True)])
def test_a_step_that_is_known_is_doubted_beyond_chance_only(step_sigma, named):
    """Of 11 honest sessions, 2 were told that the step of their LMS was off by two standard deviations."""
    solution = solved(3, lambda obs: obs.stretched(0.01), step_sigma=step_sigma)
    doubts = doubtful(solution, ADMITTED)
    assert ("bearings" in [doubt.kind for doubt in doubts]) is named
    free = next(doubt for doubt in weigh(solution, ADMITTED) if doubt.kind == "bearings")
    assert 2.0 < free.deviations < 4.0


@pytest.mark.parametrize(("step_sigma", "said"), [(0.0, False), (0.0058, True)])
def test_a_step_that_makes_up_most_of_the_errors_is_said(step_sigma, said):
    words = step_words(solved(1, step_sigma=step_sigma))
    assert ("angular_step_relative" in words) is said


def fisheye_views(field_deg, count, rng, size=(640, 480)):
    """Corners of a chessboard as a lens of the equidistant law shows them (a pinhole below 90 deg)."""
    points = PATTERN.points() - PATTERN.points().mean(axis=0)
    views = []
    f = size[0] / 2 / np.radians(field_deg / 2)
    while len(views) < count:
        off = rng.uniform(0, np.radians(0.42 * field_deg))
        around = rng.uniform(0, 2 * np.pi)
        at = np.array(
            [np.sin(off) * np.cos(around), 0.75 * np.sin(off) * np.sin(around), np.cos(off)]
        )
        face = Rotation.align_vectors([at], [[0, 0, 1]])[0] * Rotation.from_euler(
            "xyz", rng.uniform(-0.7, 0.7, 3)
        )
        p = face.apply(points) + rng.uniform(0.35, 1.0) * at
        across = np.hypot(p[:, 0], p[:, 1])
        bent = f * (np.arctan2(across, p[:, 2]) if field_deg > 90 else across / p[:, 2])
        uv = (
            p[:, :2] * (bent / across)[:, None]
            + np.array(size) / 2
            + rng.normal(0, 0.1, (len(p), 2))
        )
        if p[:, 2].min() > 0.02 and (np.abs(uv / size - 0.5) < 0.49).all():
            views.append(uv)
    return views


@pytest.mark.parametrize(
    ("field_deg", "scale", "named"),
    [(60, 1.0, None), (140, 1.0, "all in one direction"),
     (60, 2.0, "as with intrinsics of another image size")],
)  # fmt: skip
def test_a_lens_that_its_model_does_not_fit_is_named(field_deg, scale, named):
    pixels = fisheye_views(field_deg, 15, rng(3))
    model = estimate_intrinsics(pixels, PATTERN, (640, 480)).models[0]
    model = model.with_parameters(model.parameters * np.r_[[scale] * 4, [1.0] * 5])
    views = {i: SimpleNamespace(pixels=uv, T_camera_board=first_pose(PATTERN.points(), uv, model)[0], reason="")
             for i, uv in enumerate(pixels)}  # fmt: skip
    prepared = Prepared(
        session=None,
        board=SimpleNamespace(pattern=PATTERN),
        scans={},
        models={"left": model},
        views={"left": views},
    )
    words = "".join(finding.words for finding in lens_findings(prepared))
    assert words == "" if named is None else "camera 'left'" in words and named in words
