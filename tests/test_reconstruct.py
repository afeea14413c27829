"""Colouring, occlusion and measuring edges."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.calibrate import reconstruct as rec
from lrfcal_lib.calibrate.outline import measure_board
from lrfcal_lib.model.board import triangle_board
from lrfcal_lib.model.camera import CameraModel

MODEL = CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5)


def grid(z, half=0.2, n=40):
    x, y = np.meshgrid(np.linspace(-half, half, n), np.linspace(-half, half, n))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])


def test_a_near_wall_hides_a_far_one():
    near, far = grid(1.0), grid(2.0, 0.3)
    points = np.vstack([near, far])
    colors, _ = rec.color_points(points, np.full((48, 64, 3), 7, np.uint8), RigidTransform.identity(), MODEL)
    assert np.isfinite(colors[: len(near)]).all() and np.isnan(colors[len(near) :]).all()


def test_colours_are_interpolated_and_turned_to_rgb():
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    image = np.stack([u, 2 * v, np.full_like(u, 9)], -1).astype(np.uint8)
    colors, uv = rec.color_points(np.array([[0.01, 0.02, 1.0]]), image, RigidTransform.identity(), MODEL)
    np.testing.assert_allclose(colors[0], [9, 2 * uv[0, 1], uv[0, 0]], atol=0.6)


def test_points_outside_or_behind_are_not_coloured():
    points = np.array([[5.0, 0, 1], [0, 0, -1]])
    colors, _ = rec.color_points(points, np.zeros((48, 64, 3), np.uint8), RigidTransform.identity(), MODEL)
    assert np.isnan(colors).all()


def test_blend_averages_only_what_is_seen():
    a, b = np.array([[10.0] * 3, [np.nan] * 3, [np.nan] * 3]), np.array([[20.0] * 3, [30.0] * 3, [np.nan] * 3])
    colors, seen = rec.blend([a, b])
    assert colors[:, 0].tolist() == [15, 30, 128] and seen.tolist() == [True, True, False]


def test_ply_round_trip(tmp_path):
    import open3d as o3d

    cloud = rec.Cloud(grid(1.0, n=3), np.arange(27, dtype=np.uint8).reshape(9, 3), np.ones(9, bool), np.zeros(9, int))
    rec.write_ply(tmp_path / "deep" / "c.ply", rec.join([cloud, cloud]))
    back = o3d.t.io.read_point_cloud(str(tmp_path / "deep" / "c.ply"))
    np.testing.assert_allclose(back.point.positions.numpy()[:9], cloud.points, atol=1e-6)
    assert (back.point.colors.numpy()[9:] == cloud.colors).all()


def test_exact_edge_points_give_exact_lengths():
    board = triangle_board()
    pose = RigidTransform.from_components([0.1, 0.2, 1.5], Rotation.from_rotvec([0.2, 0.5, -0.7]))
    corners = np.column_stack([board.corners, np.zeros(3)])
    s = np.linspace(0.1, 0.9, 12)[:, None]
    sides = {e: pose.apply(corners[i] * (1 - s) + corners[(i + 1) % 3] * s) for i, e in enumerate(board.edges)}
    face = pose.apply(np.random.default_rng(0).dirichlet([1, 1, 1], 50) @ corners)
    lengths = measure_board(face, sides, board.edges).lengths
    for name, value in board.lengths().items():
        assert lengths[name] == pytest.approx(value, abs=1e-9)
    del sides["bc"]
    assert measure_board(face, sides, board.edges).lengths == {}
