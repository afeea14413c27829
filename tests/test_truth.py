"""The truth of a simulated session, and what it says about edge points and calibrations."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from shared import QUICK, ROOT

from lrfcal_lib.calibrate.cameras import KnownAxis
from lrfcal_lib.calibrate.observe import platform_observations
from lrfcal_lib.evaluate.truth import axis_errors, camera_errors, on_true_edges, read_truth
from lrfcal_lib.model import geometry
from lrfcal_lib.session.files import SessionError
from lrfcal_lib.session.read import open_session


def test_a_recording_has_no_truth(tmp_path):
    assert read_truth(SimpleNamespace(path=tmp_path)) is None


def test_damaged_truth_is_named(tmp_path):
    (tmp_path / "truth.json").write_text(json.dumps({"T_head_lrf": {}}))
    with pytest.raises(SessionError, match="truth.json.*simulate the session again"):
        read_truth(SimpleNamespace(path=tmp_path))


def test_the_true_calibration_has_no_error():
    truth = read_truth(open_session(QUICK))
    for camera, transform in truth.cameras.items():
        errors = camera_errors(
            SimpleNamespace(transform=transform, trusted=np.eye(6)), truth, camera
        )
        assert errors["rotation_error_deg"] < 1e-6 and errors["translation_error_mm"] < 1e-6
    errors = axis_errors(KnownAxis(truth.T_head_lrf, np.eye(4)), truth)
    assert errors["rotation_error_deg"] < 1e-6 and errors["translation_error_mm"] < 1e-6


def test_a_pull_is_the_error_over_its_standard_deviation():
    truth = read_truth(open_session(QUICK))
    (camera, transform), *_ = truth.cameras.items()
    off = RigidTransform.from_translation([0.006, 0.0, 0.0]) * transform
    covariance = np.diag([1e-4, 1e-4, 1e-4, 1e-6, 4e-6, 4e-6])
    errors = camera_errors(
        SimpleNamespace(transform=off, trusted=covariance), truth, camera
    )
    assert (
        errors["translation_pull"] == pytest.approx(6 / 3)
        and errors["rotation_pull"] < 1e-6
    )


def test_only_evaluate_reads_the_truth():
    """Of the library; the simulator writes it. A session without it gives the same bytes: test_same_numbers.py."""
    for path in (ROOT / "lrfcal_lib").rglob("*.py"):
        if "truth.json" in path.read_text():
            assert path.parent.name in ("evaluate", "simulate", "session"), path


def test_points_on_the_true_edges_are_straight_about_the_true_axis(quick):
    observations = platform_observations(quick.prepared)
    truth = read_truth(quick.prepared.session)
    moved = on_true_edges(observations, truth)
    assert (
        0
        < np.linalg.norm(moved.edge_points - observations.edge_points, axis=1).max()
        < 0.06
    )
    for placement, number in {*zip(moved.edge_placement, moved.edge_number, strict=True)}:
        rows = (moved.edge_placement == placement) & (moved.edge_number == number)
        points = geometry.lrf_to_platform(
            moved.edge_points[rows], moved.edge_pitch[rows], truth.T_head_lrf
        )
        assert geometry.fit_line(points)[2] < 1e-8
