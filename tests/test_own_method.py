"""What a researcher writes to add a method: a residual and a row; the comparison judges it beside the others."""

from dataclasses import replace

import numpy as np
import pytest
from shared import QUICK, stages
from synthetic import camera_case

from lrfcal_lib.calibrate import pipeline
from lrfcal_lib.calibrate.cameras import calibrate_cameras
from lrfcal_lib.evaluate.tables import method_comparison
from lrfcal_lib.fit.least_squares import Block
from lrfcal_lib.report import notebook
from lrfcal_lib.session import cache
from lrfcal_lib.session.read import open_session
from lrfcal_lib.solvers import METHODS, Method


def angles_to_sight(pose, obs):
    """Sines of the angles between crossings and the planes of sight through their image lines: blind to depth."""
    sight = obs.crossing_lines @ obs.model.matrix
    sight = sight / np.linalg.norm(sight, axis=-1, keepdims=True)
    turned = obs.crossing_points @ pose[:, :3].T
    q = turned + pose[:, 3]
    depth = np.linalg.norm(q, axis=-1, keepdims=True)
    residuals = np.sum(sight * q / depth, axis=-1)
    by_point = sight / depth - residuals[:, None] * q / depth**2
    jacobian = np.concatenate(
        [np.cross(turned, by_point), by_point], axis=-1
    )  # by [w, v], see lrfcal_lib
    return Block(
        residuals, jacobian, np.full(len(residuals), 1e3)
    )  # noise of a milliradian


ROW = Method(
    uses="crossing",
    label="angles to sight",
    residual=angles_to_sight,
)


def test_a_residual_and_a_row_are_a_method(monkeypatch):
    monkeypatch.setitem(METHODS, "angles", ROW)
    rig, obs = camera_case(1, noise=1.0)
    observations = {
        ("left", variant): obs for variant in ("half_step", "last_beam", "one_scan")
    }
    solutions, problems = calibrate_cameras(observations)
    table = method_comparison(observations, solutions).set_index("method")
    assert list(table.index) == list(METHODS) and problems == []
    assert (
        table.loc["angles", "left_out_edge_rms_px"]
        < 1.5 * table.loc["line", "left_out_edge_rms_px"]
    )
    error = solutions["left", "angles"].transform * rig.T_camera_lrf.inv()
    assert error.rotation.magnitude() < 0.02 and np.linalg.norm(error.translation) < 0.03
    assert notebook.in_words("angles") == "angles to sight"


def test_a_row_is_found_whenever_it_is_added_and_the_cache_keeps_nothing_of_it(
    monkeypatch, tmp_path
):
    """As in a notebook of `make lab`, whose residual is changed and run again."""
    monkeypatch.setenv(cache.VARIABLE, str(stages()))
    session = open_session(QUICK)
    monkeypatch.setitem(METHODS, "angles", ROW)
    first = pipeline.calibrate(session)
    assert {method for _, method in first.solutions} > {"angles", "line", "joint"}
    turned = replace(ROW, estimate=lambda *args, **options: "changed")
    monkeypatch.setitem(METHODS, "angles", turned)
    assert pipeline.calibrate(session).solutions["left", "angles"] == "changed"
    with pytest.raises(ValueError, match="unknown method 'circles': use one of .*angles"):
        pipeline.calibrate(session, ["circles"])
