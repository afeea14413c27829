"""Corners of the chessboard in an image."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from rendered_boards import (
    MODEL,
    PATTERN,
    SHEET,
    find_pattern,
    on_board,
    pose_of,
    render,
    up_to_a_turn,
    view_poses,
)
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.board import Chessboard
from lrfcal_lib.model.camera import project
from lrfcal_lib.preprocess.pattern_in_image import (
    PatternNotFound,
)


# squares along the pixel grid are the hard case of the sector-based detector (and no limit on real prints)
@pytest.mark.parametrize(
    ("roll", "negative", "limit"),
    [(0.0, False, 0.1), (-1.2, False, 0.05), (-1.2, True, 0.1)],
)
def test_corners_are_found_at_subpixel_level(roll, negative, limit):
    """Also of white squares on a dark board."""
    pose = pose_of(roll)
    picture = 255 - render(pose) if negative else render(pose)
    off = up_to_a_turn(
        find_pattern(picture), on_board(pose, PATTERN.points()[:, :2], project)
    )
    assert np.sqrt(np.mean(off**2)) < limit


@pytest.mark.parametrize(
    ("side", "rim"), [(6.5, 0.65), (9.5, 1.0), (10.5, 0.65)]
)  # pixels, squares
def test_small_squares_have_the_right_scale(side, rim):
    """Also where the outermost squares are cut: no window may reach over the rim of the pattern."""
    pattern = Chessboard(7, 5, 0.05)
    corners = np.array([[-0.13, -0.11], [0.42, -0.11], [0.42, 0.35], [-0.13, 0.35]])
    sheet = replace(SHEET, corners=corners, pattern=pattern)
    scales = []
    for seed, pose in enumerate(view_poses(6, seed=3)):
        far = RigidTransform.from_components(
            [0.01 * seed, -0.07, MODEL.fx * pattern.square / side], pose.rotation
        )
        exact = on_board(far, pattern.points()[:, :2], project)
        picture = render(far, sheet, seed=seed, rim=rim)
        off = up_to_a_turn(find_pattern(picture, pattern), exact)
        spread = exact - exact.mean(axis=0)
        scales.append(np.sum(off * spread) / np.sum(spread**2))
    assert (
        abs(np.median(scales)) < 0.0003
    )  # a corner that the detector puts elsewhere is left out later


def test_large_images_are_searched_small_and_refined_as_they_are(monkeypatch):
    pose = pose_of(-1.2)
    looked_at = []
    small = render(pose, noise=0.0)
    exact = on_board(pose, PATTERN.points()[:, :2], project)

    def watched(ask):
        """The same detector, which notes how large the pictures are."""
        return lambda picture, *rest, **options: (
            looked_at.append(picture.size) or ask(picture, *rest, **options)
        )

    for name in ("findChessboardCorners", "findChessboardCornersSB"):
        monkeypatch.setattr(cv2, name, watched(getattr(cv2, name)))
    found = find_pattern(cv2.resize(small, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC))
    off = up_to_a_turn((found + 0.5) / 4 - 0.5, exact)
    assert np.abs(off).max() < 0.1
    assert looked_at and max(looked_at) < 2e6
    # squares that only the whole image shows
    far = pose_of(-1.2, at=(0.0, 0.0, 3.3))
    large = np.full((2400, 3200, 3), 170, np.uint8)
    large[1200:1680, 900:1540] = render(far)
    exact = on_board(far, PATTERN.points()[:, :2], project) + [900, 1200]
    assert np.abs(up_to_a_turn(find_pattern(large), exact)).max() < 0.2


def test_corners_run_clockwise_also_in_a_mirrored_image():
    found = find_pattern(render(pose_of())[:, ::-1].copy()).reshape(4, 6, 2)
    x = found[0, -1] - found[0, 0]
    y = found[-1, 0] - found[0, 0]
    assert x[0] * y[1] - x[1] * y[0] > 0


@pytest.mark.parametrize("shape", [(480, 640, 3), (1, 1), (1, 5000), (8, 8)])
def test_no_pattern(shape):  # OpenCV refuses narrow ones
    with pytest.raises(PatternNotFound, match="6 x 4 inner corners"):
        find_pattern(np.full(shape, 90, np.uint8))


@pytest.mark.parametrize("roll", [1.7, -1.4])
def test_a_pattern_that_the_image_cuts_is_not_taken_a_row_off(roll):
    picture = render(pose_of(roll, (0.0, 0.0)))
    whole = find_pattern(picture)
    for beyond in (-5, 3, 45):
        try:
            found = find_pattern(
                np.ascontiguousarray(picture[: int(whole[:, 1].max()) + beyond])
            )
        except PatternNotFound:
            assert beyond < 30  # where all squares are seen it is found
        else:
            assert np.abs(up_to_a_turn(found, whole)).max() < 0.3
