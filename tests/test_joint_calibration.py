"""The joint calibration of a session: which unknowns it takes, what it hands over, and boards in the coloured cloud."""

from dataclasses import replace

import numpy as np
import pytest
from shared import QUICK, campaign

from lrfcal_lib.calibrate import clouds, combined, pipeline
from lrfcal_lib.calibrate.joint_observations import observe_joint
from lrfcal_lib.evaluate import edge_tables, joint_tables, tables
from lrfcal_lib.evaluate.export import calibration_record
from lrfcal_lib.evaluate.truth import read_truth
from lrfcal_lib.model.problem import Problem, ProblemKind, Stage
from lrfcal_lib.preprocess.survey import all_views
from lrfcal_lib.session.read import open_session


@pytest.fixture(scope="module")
def joint(quick):
    return pipeline.leave_out(quick.joint, groups=4)


@pytest.fixture(scope="module")
def truth():
    return read_truth(open_session(QUICK))


def test_the_session_asks_for_its_unknowns(joint):
    """The scale of the pitch is free with the axis: held at zero, a wrong one would go into the axis; no sweep is off.

    Also with one image a placement, and with cameras on the base.
    """
    seen = observe_joint(
        joint.prepared,
        {name: found[:1] for name, found in all_views(joint.prepared).items()},
    )
    for settings in (joint.settings, pipeline.joint_settings(joint.prepared, seen)):
        assert "pitch_scale" in settings["sensor"] and "sweep" not in settings
        assert settings["prior"].sigma_offset == joint.prepared.session.platform_sigma[1]


def test_errors_agree_with_their_sigma(joint, truth):
    table = joint_tables.joint_errors(joint, truth)
    assert (table.rotation_error_deg < 3.5 * table.rotation_sigma_deg).all()
    assert (table.translation_error_mm < 3.5 * table.translation_sigma_mm).all()
    assert table.translation_error_mm.max() < 25


def test_corrections_undo_what_the_estimate_found(joint):
    """A point measured too far by the range offset comes back; a placement that took no part gets the scale only."""
    solution = joint.solution
    p = np.array([[0.3, 1.8, 0.0], [-0.2, 1.1, 0.0]])
    away = p * (
        1 + solution.sensor["range_offset"] / np.linalg.norm(p, axis=1, keepdims=True)
    )
    pitch = solution.corrections.pitch(99, np.array([0.1, -0.2]))
    np.testing.assert_allclose(solution.corrections.points(away), p, atol=2e-5)
    np.testing.assert_allclose(
        pitch, np.array([0.1, -0.2]) * (1 + solution.sensor["pitch_scale"])
    )


def test_it_is_handed_over_with_its_platform_and_sensor(quick):
    assert pipeline.handed_over(quick) == "joint"
    record = calibration_record(quick, "joint")
    np.testing.assert_allclose(
        record["platform"]["matrix"], quick.joint.solution.T_head_lrf.as_matrix()
    )
    assert set(record["cameras"]) == set(quick.joint.observations.cameras)
    assert (
        record["sensor"]["range_offset"]["sigma"] > 0 and record["sensor"]["excluded"] == []
    )
    assert (
        record["verdict"]["answer"] == "with care"
        and record["verdict"]["expected_error_at_m"]["2"]["cloud_mm"] > 0
    )
    edges = [
        camera["edge_rms_px"] for camera in record["cameras"].values()
    ]  # the same figure as in the report
    assert min(edges) <= joint_tables.joint_fit(quick.joint)["edge_rms_px"] <= max(edges)
    assert "sensor" not in calibration_record(quick, "line")


def test_a_cloud_is_coloured_by_what_is_handed_over(quick):
    default, joint, line = (
        clouds.color_cloud(quick, *method).points for method in ((), ("joint",), ("line",))
    )
    np.testing.assert_array_equal(default, joint)
    assert np.linalg.norm(joint - line, axis=1).min() > 0
    nothing = replace(quick, joint=None, solutions={})
    with pytest.raises(
        ValueError, match="no camera was calibrated that could colour a cloud"
    ):
        clouds.color_cloud(nothing)


@campaign
def test_what_did_not_converge_is_not_handed_over(quick):
    bad = replace(
        quick.joint.solution,
        solution=replace(quick.joint.solution.solution, converged=False),
    )
    assert pipeline.handed_over(
        replace(quick, joint=replace(quick.joint, solution=bad))
    ) in ("line", "zhang_pless")


def test_combined_lengths_are_good_know_how_good_they_are_and_do_not_know_the_board(joint):
    table = edge_tables.edge_lengths(joint.prepared, joint.solution.T_head_lrf, joint)
    own = table[(table.source != "paper") & table.measured_mm.notna()].set_index("variant")
    error = own.error_mm.abs().groupby("variant").mean()
    assert error["combined"] < 1.0 and error["combined"] < error.drop("combined").min() / 10
    assert (own.loc["combined"].error_mm / own.loc["combined"].sigma_mm).abs().max() < 3.5
    assert own.sigma_mm.notna().all() and set(own.loc["combined"].ends) <= {"image", "scan"}
    larger = replace(joint.prepared.board, corners=joint.prepared.board.corners * 1.1)
    other = combined.combined_outlines(
        replace(joint, prepared=replace(joint.prepared, board=larger))
    )
    same = combined.combined_outlines(joint)
    for placement, (board, _) in same.items():
        for name, length in board.lengths.items():
            assert other[placement][0].lengths[name] == pytest.approx(length, abs=1e-5)


def test_placements_are_judged_by_estimates_that_have_not_seen_them(quick, joint):
    own = tables.method_comparison(quick.observations, quick.solutions, joint=joint)
    own = own[own.method == "joint"]
    assert (own.left_out_edge_rms_px > own.edge_rms_px).all()
    assert (own.left_out_plane_rms_mm > own.plane_rms_mm).all()


def other_session(quick, **changes):
    """The calibration of a session whose images are not as they were."""
    session = quick.prepared.session
    records = tuple(replace(record, **changes) for record in session.image_records)
    return replace(
        quick,
        prepared=replace(quick.prepared, session=replace(session, image_records=records)),
    )


BAD = {
    "images without a known pitch": (lambda c: other_session(c, pitch=np.nan), "joint", "the pitch of none is known"),
    "a method that was not run": (lambda c: c, "line_printed", "'line_printed' poses no camera"),
    "another rig's cameras": (
        lambda c: other_session(c, camera="top"), "joint",
        "they are of top, the calibration by 'joint' poses left, right",
    ),
    "another rig's lenses": (
        lambda c: replace(c, prepared=replace(c.prepared, models={
            name: replace(model, width=320, height=240) for name, model in c.prepared.models.items()})),
        "joint", "has 320 x 240 pixels, its image",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_colour_a_cloud_is_refused(quick, case):
    change, method, words = BAD[case]
    with pytest.raises(ValueError, match=words):
        clouds.color_cloud(change(quick), method)


def test_a_rig_that_cannot_be_solved_jointly_keeps_the_other_methods(quick):
    """Without a usable placement the joint estimate has a problem in words; what was there stays."""
    kind = ProblemKind.NO_BOARD
    problems = [
        Problem(Stage.SCANS, kind, "a dog ran through", placement)
        for placement in quick.prepared.scans
    ]
    prepared = replace(quick.prepared, problems=tuple(problems))
    lost = pipeline.joint_or_problem(pipeline.without(prepared))
    again = pipeline.with_joint(replace(quick, joint=None), lost)
    assert again.joint is None and "no placement" in again.why_not("joint")
    assert again.solutions is quick.solutions
