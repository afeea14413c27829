"""LMS400 and ZED: board planes with the published intrinsics and board poses."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.fit.residuals import plane_residuals_m
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points
from lrfcal_lib.model.observations import CameraObservations
from lrfcal_lib.solvers import solve_camera

HEAD = RigidTransform.from_translation([-0.038, 0.0045, 0.157])  # the authors' platform


def published(folder, side):
    """Intrinsics and board poses of a Bouguet result file."""
    text = (folder / f"Calib_Results_{side}.m").read_text()

    def numbers(name):
        return np.array(
            re.search(rf"^{name}\s*= \[([^\]]*)\]", text, re.M)
            .group(1)
            .replace(";", " ")
            .split(),
            float,
        )

    poses = [
        RigidTransform.from_components(
            numbers(f"Tc_{i}") / 1000, Rotation.from_rotvec(numbers(f"omc_{i}"))
        )
        for i in range(1, 21)
    ]
    return CameraModel(1280, 720, *numbers("fc"), *numbers("cc"), numbers("kc")), poses


@pytest.fixture(scope="module")
def cameras(real_data):
    parts = []
    found = {}
    for placement in range(1, 21):
        raw = np.load(real_data / "lms400_zed" / "raw" / f"pose_{placement:02d}.npz")
        points = polar_to_points(raw["range_m"], np.pi / 2 - np.radians(raw["bearing_deg"]))
        pitch = raw["pitch_rad"] - np.pi / 2
        parts.append((points[::50], pitch[::50], np.full(len(pitch[::50]), placement)))
    points, pitch, placement = map(np.concatenate, zip(*parts, strict=True))
    for side in ("left", "right"):
        model, poses = published(real_data / "lms400_zed", side)
        found[side] = CameraObservations(
            model,
            camera=side,
            source="platform",
            plane_points=lrf_to_platform(points, pitch, HEAD),
            plane_covariance=np.tile(0.005**2 * np.eye(3), (len(points), 1, 1)),
            plane_placement=placement,
            placements=np.arange(1, 21),
            board_poses=np.array([pose.as_matrix() for pose in poses]),
            board_covariance=np.tile(np.diag([1e-6] * 3 + [2.5e-7] * 3), (20, 1, 1)),
        )
    return found


def test_zhang_pless_reaches_the_reference(cameras):
    found = {
        side: solve_camera(obs, "zhang_pless", weighted=False).transform
        for side, obs in cameras.items()
    }
    rms = {
        side: 1000 * np.sqrt(np.mean(plane_residuals_m(obs, found[side]) ** 2))
        for side, obs in cameras.items()
    }
    assert rms["left"] == pytest.approx(6.90, abs=0.01) and rms["right"] == pytest.approx(
        7.05, abs=0.01
    )
    stereo = found["right"] * found["left"].inv()
    assert 1000 * np.linalg.norm(stereo.translation) == pytest.approx(117.76, abs=0.02)
    np.testing.assert_allclose(
        np.degrees(stereo.rotation.as_rotvec()), [0.529, 0.330, -0.014], atol=2e-3
    )
