"""Rendered images: corners where the camera model puts them, and settings that cannot be."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.camera import CameraModel, project
from lrfcal_lib.simulate.rig import printed_triangle
from lrfcal_lib.simulate.scene import (
    Exposure,
    Imager,
    Lights,
    Thing,
    World,
    chessboard,
    plain,
)
from lrfcal_lib.simulate.shapes import polygon, rectangle

HERE = RigidTransform.identity()
LENS = CameraModel(
    512, 384, 800.0, 798.0, 258.0, 189.0, np.array([-0.21, 0.09, 0.0006, -0.0004, 0.0])
)
CLEAN = Exposure(read_noise=0.0, shot_noise=0.0, samples=5)
LIGHT = Lights(np.array([[0.3, -1.0, -0.5]]), np.array([0.6]), 0.5)


def sheet(size, albedo, by):
    return Thing(
        rectangle(size, size),
        (plain, (albedo,) * 3),
        RigidTransform.from_translation(by),
    )


def board_pose(distance, turn, roll):
    facing = Rotation.from_euler("x", 180, degrees=True) * Rotation.from_euler(
        "YXZ", [turn, 15, roll], degrees=True
    )
    return RigidTransform.from_components(
        np.array([0, 0, distance]) - facing.apply([0.1, 0.1, 0]), facing
    )


def looking_at(board, pose):
    front = Thing(polygon(board.corners), (chessboard, board, 0.07, 0.75, 0.65), pose)
    return World([front, sheet(9, 0.5, [0, 0, 4.0])], LIGHT)


@pytest.mark.parametrize(
    ("distance", "turn", "roll"), [(0.9, 0, -135), (1.2, 30, 20), (1.6, -25, 100)]
)
def test_chessboard_corners_reproject(distance, turn, roll):
    board = printed_triangle()
    pose = board_pose(distance, turn, roll)
    image = Imager(LENS, CLEAN).render(
        looking_at(board, pose), HERE, np.random.default_rng(0)
    )
    true = project(pose.apply(board.pattern.points()), LENS)
    window = max(2, int(0.3 * np.linalg.norm(true[1] - true[0])))
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-5)
    start = (
        (true + np.random.default_rng(1).uniform(-0.5, 0.5, true.shape))
        .astype(np.float32)
        .reshape(-1, 1, 2)
    )
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    found = cv2.cornerSubPix(grey, start, (window, window), (-1, -1), stop).reshape(-1, 2)
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.05


def test_the_share_of_a_pixel_that_an_edge_covers():
    """Along a straight slanted edge the light changes exactly where the edge is, through the whole lens model."""
    board = printed_triangle()
    pose = board_pose(1.0, 0, 8)
    light = Imager(LENS, CLEAN).light(
        looking_at(board, pose), HERE, np.random.default_rng(0)
    )[..., 1]
    ends = project(pose.apply([[0.03, 0.0, 0.0], [0.28, 0.0, 0.0]]), LENS)
    columns = np.arange(int(ends[:, 0].min()) + 2, int(ends[:, 0].max()) - 2)
    along = np.linspace(0.03, 0.28, 2000)
    edge = project(pose.apply(np.column_stack([along, 0 * along, 0 * along])), LENS)
    order = np.argsort(edge[:, 0])
    true = np.interp(columns, edge[order, 0], edge[order, 1])
    misses = []
    for column, v in zip(columns, true, strict=True):
        strip = light[int(v) - 5 : int(v) + 7, column]
        below = (strip - strip[0]) / (
            strip[-1] - strip[0]
        )  # the board is above or below: both ends are plain
        misses.append(int(v) + 6.5 - below.sum() - v)
    assert abs(np.mean(misses)) < 0.02


def test_automatic_exposure_and_noise():
    world = World([sheet(9, 0.5, [0, 0, 2.0])], Lights(np.zeros((0, 3)), np.zeros(0), 1.0))
    exposure = Exposure(
        vignetting=0.0, bright=200.0, gain=(10.0, 1000.0), read_noise=1.0, shot_noise=0.01
    )
    image, dark = (
        Imager(LENS, e).render(world, HERE, np.random.default_rng(0)).astype(float)
        for e in (exposure, replace(exposure, gain=(10.0, 100.0)))
    )
    assert np.mean(image) == pytest.approx(200, abs=0.1) and np.mean(dark) == pytest.approx(
        50, abs=0.1
    )
    assert np.std(image) == pytest.approx(np.sqrt(1 + 2 + 1 / 12), rel=0.02)
