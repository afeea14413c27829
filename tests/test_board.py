"""Board outline, lines and corners."""

import numpy as np
import pytest

from lrfcal_lib.model import board as b
from lrfcal_lib.model.feature_sets import triangle_angle


@pytest.mark.parametrize("flip", [1, -1])
def test_lines_point_outwards_whatever_the_order_of_the_corners(flip):
    corners = b.triangle_board().corners[::flip]
    centre = np.r_[corners.mean(axis=0), 1]
    assert (b.outline_lines(corners) @ centre < 0).all()


def test_corners_come_back_from_lines():
    corners = np.array([[0, 0], [2, 0.1], [2.2, 1.5], [-0.3, 1]])
    np.testing.assert_allclose(
        b.corners_of_lines(b.outline_lines(corners)), corners, atol=1e-12
    )


def test_an_unmeasured_outline_is_refused():
    with pytest.raises(ValueError, match="outline of board 'x' is not known"):
        b.Board("x", ("a", "b", "c")).lines()


def test_pattern_points_run_along_the_rows():
    points = b.Chessboard(3, 2, 0.1, (1.0, 2.0)).points()
    np.testing.assert_allclose(points[[0, 1, 3]], [[1, 2, 0], [1.1, 2, 0], [1, 2.1, 0]])


def test_the_papers_board_is_not_quite_right_angled():
    assert np.degrees(triangle_angle(3.0, 4.0, 5.0)) == pytest.approx(90.0)
    assert np.degrees(triangle_angle(0.315, 0.380, 0.491)) == pytest.approx(89.4, abs=0.05)
    with pytest.raises(ValueError, match="1.0, 1.0 and 3.0 make no triangle"):
        triangle_angle(1.0, 1.0, 3.0)
