"""The truth of a simulated session, and what it says about edge points and calibrations."""

import json
from types import SimpleNamespace

import pytest
from shared import QUICK, ROOT

from lrfcal_lib.evaluate.truth import axis_errors, camera_errors, read_truth
from lrfcal_lib.session.read import open_session
from lrfcal_lib.session.stated import SessionError


def test_a_recording_has_no_truth(tmp_path):
    assert read_truth(SimpleNamespace(path=tmp_path)) is None


def test_damaged_truth_is_named(tmp_path):
    (tmp_path / "truth.json").write_text(json.dumps({"T_head_lrf": {}}))
    with pytest.raises(SessionError, match="truth.json.*simulate the session again"):
        read_truth(SimpleNamespace(path=tmp_path))


def test_the_true_calibration_has_no_error():
    truth = read_truth(open_session(QUICK))
    for camera, transform in truth.cameras.items():
        errors = camera_errors(SimpleNamespace(transform=transform), truth, camera)
        assert max(errors.values()) < 1e-6
    assert max(axis_errors(truth.T_head_lrf, truth)) < 1e-6


def test_only_evaluate_reads_the_truth():
    """Of the library; the simulator writes it. A session without it gives the same bytes: test_same_numbers.py."""
    for path in (ROOT / "lrfcal_lib").rglob("*.py"):
        if "truth.json" in path.read_text():
            assert path.parent.name in ("evaluate", "simulate", "session"), path
