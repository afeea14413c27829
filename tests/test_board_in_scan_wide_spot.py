"""A wide spot reads a board while it only touches it: the board looks larger, and its rim less slanted than it is."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import triangle_board
from lrfcal_lib.model.geometry import fit_plane, lrf_to_platform, polar_to_points
from lrfcal_lib.preprocess.board_in_scan import BoardNotFound, face_points, find_board
from lrfcal_lib.session.read import Sweep
from lrfcal_lib.session.stated import LrfInfo
from lrfcal_lib.simulate.beam import LMS221, ideal_readings
from lrfcal_lib.simulate.scene import Thing, World, plain
from lrfcal_lib.simulate.shapes import polygon, rectangle

HEAD = RigidTransform.identity()
BOARD = triangle_board()
LEAN = np.radians(35.0)
WIDE = {"spot_exit": 0.030, "divergence": 0.015}
LRF = LrfInfo(
    "wide", (0.0, np.pi), np.radians(0.5), 0.003, spot_exit=0.030, spot_divergence=0.015
)
RIG = SimpleNamespace(board=BOARD, T_head_lrf=HEAD, lrf=LRF)


@pytest.fixture(scope="module")
def sweep():
    """The triangle 1.6 m ahead, leant back, before a dark wall at 3.6 m."""
    upright = Rotation.from_euler("x", 90, degrees=True)
    turn = Rotation.from_euler("x", -LEAN) * upright
    centre = np.append(BOARD.corners.mean(axis=0), 0.0)
    pose = RigidTransform.from_components([0.0, 1.6, 0.0] - turn.apply(centre), turn)
    wall = RigidTransform.from_components([0.0, 3.6, 0.0], upright)
    world = World([
        Thing(polygon(BOARD.corners), (plain, (0.5,) * 3), pose), Thing(rectangle(9.0, 9.0), (plain, (0.3,) * 3), wall)
    ])  # fmt: skip
    bearings = np.radians(np.arange(78, 102.1, 0.5))
    pitch = np.radians(np.arange(-11, 11.1, 0.5))
    at, up = (v.ravel() for v in np.meshgrid(bearings, pitch))
    reading = ideal_readings(replace(LMS221, **WIDE), world, at, up, HEAD)[0].reshape(
        len(pitch), len(bearings)
    )
    noise = 0.003 * np.random.default_rng(0).standard_normal(reading.shape)
    return Sweep(1, reading + noise, bearings, pitch, np.zeros(len(pitch)))


def lean_of(scan):
    """Of the plane through face points, against the upright, radians."""
    p_lrf, pitch, _ = face_points(scan)
    return np.arccos(abs(fit_plane(lrf_to_platform(p_lrf, pitch, HEAD))[0][1]))


def test_a_board_grown_by_the_stated_spot_is_found(sweep):
    scan = find_board(sweep, RIG)
    points = lrf_to_platform(
        polar_to_points(sweep.ranges, sweep.bearings), sweep.pitch[:, None], HEAD
    )[scan.mask]
    assert np.abs(points[:, 1] - 1.6).max() < 0.3
    with pytest.raises(BoardNotFound, match="no flat surface of the board's size"):
        # of a narrow spot it would be too large for the board
        narrow = replace(LRF, spot_exit=0.001, spot_divergence=0.0)
        find_board(sweep, SimpleNamespace(board=BOARD, T_head_lrf=HEAD, lrf=narrow))


def test_spots_that_reach_over_the_edge_do_not_straighten_the_board(sweep):
    scan = find_board(sweep, RIG)
    assert lean_of(scan) == pytest.approx(LEAN, abs=np.radians(0.35))
    assert LEAN - lean_of(replace(scan, spot=0.0)) > np.radians(
        0.5
    )  # as much as two beams leave
