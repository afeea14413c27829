"""Weak recordings are named before any number is shown."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lrfcal_lib.calibrate.rig import joint_rig
from lrfcal_lib.evaluate.monte_carlo import joint_truth
from lrfcal_lib.judge.findings import ANSWERS
from lrfcal_lib.judge.next_placement import suggest_placement
from lrfcal_lib.judge.verdict import verdict
from lrfcal_lib.judge.weaknesses import diagnose, sides_elsewhere
from lrfcal_lib.model.board import triangle_board
from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.model.problem import Problem, ProblemKind, Stage
from lrfcal_lib.preprocess.prepared import DroppedSide
from lrfcal_lib.simulate.draw import bench, board_poses, observe
from lrfcal_lib.solvers.joint import solve_joint


def seen(rig, poses, rng, **settings):
    return JointObservations(**observe(rig, poses, rng, **settings))


def solved(obs, rig, poses):
    return solve_joint(
        obs, start=joint_truth(obs, rig.T_head_lrf, rig.cameras, poses), required=False
    )


def solve(rig, poses, rng, **settings):
    return solved(seen(rig, poses, rng, **settings), rig, poses)


def rig_of(solution, rig):
    """The calibrated rig behind an estimate, with the cameras of a drawn one."""
    return joint_rig(solution, dict.fromkeys(rig.cameras, rig.model))


@pytest.fixture(scope="module")
def good():
    rng = np.random.default_rng(1)
    rig = bench(rng)
    poses = board_poses(rng, 8)
    return rig, poses, solve(rig, poses, rng)


def test_a_good_recording_is_trusted(good):
    rig, _, solution = good
    found = verdict(solution, rig_of(solution, rig))
    words = found.sentences()
    errors = found.errors[2.0]
    assert (
        found.answer == "yes"
        and found.reasons == ()
        and words[0] == "This calibration can be trusted."
    )
    assert [w.split(":")[0] for w in words[1:4]] == [
        f"Expected error at {d} m" for d in (1, 2, 5)
    ]
    assert "in the image of 'right'" in words[2] and words[-1].startswith(
        "Record next: board"
    )
    assert set(errors.pixels) == {"left", "right"}
    assert set(errors.record()) == {"cloud_mm", "left_px", "right_px"}
    assert 0.1 < errors.pixels["left"] < 3 and 0.1 < errors.cloud_mm < 10


WEAK = {
    "pitch": (lambda poses: poses, {"span": np.radians(1.0), "images": 1}, "no", "tilt axis is hardly determined"),
    "image pitch": (lambda poses: poses, {"images": 1}, "with care", "every placement has its images at one pitch"),
    "distance": (lambda poses: board_poses(np.random.default_rng(8), 8, (1.5, 1.52)), {}, "with care",
                 "all boards stand at one distance"),
    "placements": (lambda poses: poses[:4], {}, "with care", "only 4 placements, 6 or more are needed"),
}  # fmt: skip


@pytest.mark.parametrize("kind", WEAK)
def test_weak_recordings_are_named(good, kind):
    """A pitch range of one degree leaves much to gain, too."""
    rig, poses, _ = good
    chosen, settings, answer, words = WEAK[kind]
    solution = solve(rig, chosen(poses), np.random.default_rng(4), **settings)
    found = verdict(solution, rig_of(solution, rig), suggest=kind == "pitch")
    reasons = {reason.kind: reason for reason in found.reasons}
    assert (
        ANSWERS[reasons[kind].severe] == answer
        and words in reasons[kind].words
        and words in found.sentences()[0]
    )
    assert found.answer == (
        "no" if any(reason.severe for reason in found.reasons) else "with care"
    )
    if kind == "pitch":
        assert (
            "the recorded pitch spans only 1.0 deg within a placement"
            in found.sentences()[0]
        )
        assert found.errors[2.0].cloud_mm > 10 and "Record next: board" in found.advice
        assert suggest_placement(solution, rig_of(solution, rig)).gain > 0.5


def test_a_camera_that_never_sees_the_board(good):
    rig, poses, _ = good
    obs = seen(rig, poses, np.random.default_rng(3))
    obs = obs.keep(view=obs.view_camera == 0)
    with pytest.raises(DegenerateGeometry, match="camera 'right': it never sees the board"):
        solve_joint(obs)
    solution = solve_joint(obs, required=False)
    found = verdict(solution, rig_of(solution, rig), suggest=False)
    assert found.sentences()[0].startswith(
        "Use this calibration with care: camera 'right': it never sees the board"
    )
    assert set(found.errors[2.0].pixels) == {"left"}


def test_a_motion_that_nothing_determines(good):
    rig, poses, _ = good
    obs = seen(rig, poses, np.random.default_rng(3))
    first = (
        obs.view_placement == 0
    )  # the right camera sees the first board only, which no scan hits
    obs = obs.keep(
        view=first == (obs.view_camera == 1),
        beam=obs.beam_placement != 0,
        face=obs.face_placement != 0,
    )
    solution = solved(obs, rig, poses)
    found = verdict(solution, rig_of(solution, rig), suggest=False)
    assert found.sentences()[0].startswith(
        "This calibration cannot be trusted: the data do not determine"
    )
    assert np.isinf(found.errors[2.0].pixels["right"]) and np.isfinite(
        found.errors[2.0].pixels["left"]
    )
    assert "no bound in the image of 'right'" in found.sentences()[2]
    assert not np.isnan(solution.solution.sigma).any(), "rounding errors are no information"
    assert any("right" in words for words in solution.unobservable), solution.unobservable


def test_misfit_model_error_and_noise_are_named(good):
    solution = good[2]
    inner = replace(
        solution.solution,
        covariance_placements=25 * solution.solution.covariance,
        converged=False,
    )
    left_out = Problem(Stage.JOINT, ProblemKind.CONTRADICTS, "left out", 9)
    bad = replace(solution, excluded=(left_out,), solution=inner).with_levels(
        face_scale=2.6
    )
    vars(bad)["misfit"] = solution.misfit | {3: 30.0}
    words = {r.kind: r.words for r in diagnose(bad)}
    assert words["misfit"].startswith("placements fit much worse than the others: 3 (5.")
    assert (
        words["excluded"] == "placement 9: left out"
        and "has not converged" in words["convergence"]
    )
    assert "5.0 times more than noise explains" in words["model error"]
    assert words["noise"] == "residuals are larger than the stated noise (ranges 2.6 times)"
    absurd = bad.with_levels(face_scale=1.0, view_scale=11.0, face_share=0.05)
    found = {r.kind: r for r in diagnose(absurd)}
    assert found["noise"].severe and found["dependent"].words.startswith(
        "only 5 % of the errors of ranges"
    )
    blurred = {
        r.kind: r for r in diagnose(replace(absurd, lens_scale=4.0))
    }  # intrinsics are as uncertain
    assert (
        not blurred["noise"].severe
        and "images of 'right' 2.7 times" in blurred["noise"].words
    )


def test_large_errors_forbid_trust(good):
    rig, _, solution = good
    wide = replace(
        solution,
        solution=replace(solution.solution, covariance=4e4 * solution.solution.covariance),
    )
    found = verdict(wide, rig_of(wide, rig), suggest=False)
    assert found.answer == "no" and "the expected error at 2 m is" in found.sentences()[0]


@pytest.mark.parametrize(
    ("dropped", "named", "words"),
    [
        (16, 0, "16 of 16 scans (12 mm off, turned by 8.0 deg)"),
        (9, 7, "9 of 16"),
        (8, 8, None),
        (2, 0, None),
    ],
)
def test_an_edge_that_lies_elsewhere_in_most_scans_is_a_reason(dropped, named, words):
    turned = DroppedSide("bc", 0.012, np.radians(8.0))
    whole = SimpleNamespace(names={0: "ab", 1: "bc"}, dropped={})
    half = SimpleNamespace(names={0: "ab"}, dropped={1: turned})
    prepared = SimpleNamespace(
        board=triangle_board(),
        scans=dict.fromkeys(range(named), whole)
        | dict.fromkeys(range(100, 100 + dropped), half),
    )
    reasons = list(sides_elsewhere(prepared))
    assert [reason.kind for reason in reasons] == ["outline"] * (words is not None)
    assert all("edge 'bc'" in reason.words and words in reason.words for reason in reasons)
