"""Observations drawn without images: what comes out, and what cannot be drawn."""

import numpy as np
import pytest

from lrfcal_lib.model.geometry import pose_transform
from lrfcal_lib.simulate.shots import Scenario, draw_shots


def test_shots_are_as_many_as_asked_for_and_cross_two_edges_each():
    setup = Scenario()
    shots = draw_shots(setup, np.random.default_rng(1), 3, 5)
    count = len(setup.bearings())
    shapes = {name: values.shape for name, values in shots.items()}
    assert shapes == {
        "T_camera_lrf": (3, 3, 4), "ranges": (3, 5, 1, count), "lines": (3, 5, 2, 3), "edges": (3, 5, 2),
        "boards": (3, 5, 3, 4), "board_covariance": (3, 5, 6, 6), "pattern_pixels": (3, 5, 20, 2),
        "true_boards": (3, 5, 3, 4),
    }  # fmt: skip
    assert (shots["edges"][..., 0] != shots["edges"][..., 1]).all()
    assert np.isnan(shots["ranges"][..., [0, -1]]).all(), (
        "lines begin and end off the board"
    )


def test_readings_lie_on_the_boards_that_the_pattern_shows():
    setup = Scenario(sigma_range=1e-6, sigma_px=1e-6)
    shots = draw_shots(setup, np.random.default_rng(2), 1, 8)
    T_camera_lrf = pose_transform(shots["T_camera_lrf"][0])
    bearings = setup.bearings()
    for ranges, board in zip(shots["ranges"][0, :, 0], shots["boards"][0], strict=True):
        hit = np.isfinite(ranges)
        flat = (
            np.column_stack([np.cos(bearings), np.sin(bearings), 0 * bearings])[hit]
            * ranges[hit, None]
        )
        on_board = pose_transform(board).inv().apply(T_camera_lrf.apply(flat))
        assert np.abs(on_board[:, 2]).max() < 1e-4


def test_boards_that_cannot_be_drawn_are_refused():
    with pytest.raises(ValueError, match="hardly ever .*100 % have fewer than 8 beams"):
        draw_shots(
            Scenario(distances=(40.0, 41.0), step=np.radians(1.0)),
            np.random.default_rng(0),
            2,
            2,
        )
