"""TiM561 with a camera: three lines on a target, scanned in 23 poses; the pure point-on-line constraint."""

import numpy as np
import pytest
import scipy.io

from lrfcal_lib.fit.residuals import edge_residuals_px
from lrfcal_lib.model.camera import CameraModel, line_through
from lrfcal_lib.model.observations import CameraObservations
from lrfcal_lib.solvers import solve_camera


@pytest.fixture(scope="module")
def obs(real_data):
    folder = real_data / "tim561_lines"
    points = []
    lines = []
    for frame in range(23):
        ends = scipy.io.loadmat(folder / "image_data" / f"calibrationImage{frame:04d}.mat")[
            "imgLines"
        ]
        hits = scipy.io.loadmat(folder / "scan_data" / f"scan{frame}.mat")["scanPoints"]
        for n in range(
            3
        ):  # column n belongs to row 4 - n (both from 1); x, 0, z turns into our x, y, 0
            points.append([hits[0, n], hits[2, n], 0.0])
            lines.append(line_through(ends[2 - n, :2], ends[2 - n, 2:]))
    return CameraObservations(
        CameraModel(1280, 1024, 726.928, 780.887, 641.600, 476.630),
        crossing_points=np.array(points),
        crossing_covariance=np.tile(np.diag([1e-4, 1e-4, 0.0]), (69, 1, 1)),
        crossing_lines=np.array(lines),
        crossing_line_sigma=np.ones(69),
        crossing_placement=np.repeat(np.arange(23), 3),
        crossing_edge=np.tile(["1", "2", "3"], 23),
    )


def rms_px(obs, solution):
    return np.sqrt(np.mean(edge_residuals_px(obs, solution.transform) ** 2))


@pytest.mark.parametrize("frames, expected", [(20, 3.528), (23, 3.845)])
def test_line_constraint_reaches_the_reference(obs, frames, expected):
    some = obs.select(range(frames))
    found = solve_camera(some, "line", weighted=False)
    assert found.converged and rms_px(some, found) == pytest.approx(expected, abs=1e-3)
