"""Dark boards without pattern: all poses that explain an outline."""

import cv2
import numpy as np
import pytest
from rendered_boards import (
    BLANK,
    MODEL,
    TRIANGLE,
    on_board,
    render,
    score,
    triangle_pose,
    turned,
    worst_edge,
)

from lrfcal_lib.model.board import Board, corners_of_lines
from lrfcal_lib.model.camera import project, undistort
from lrfcal_lib.preprocess.board_in_image import (
    view_board,
)


def nearest(view, pose):
    """Of the poses that explain an image the one that is right."""
    return min([view, *view.alternatives], key=lambda v: turned(v.T_camera_board, pose))


@pytest.mark.parametrize("roll", [0.4, -1.5])
def test_a_plain_triangle_is_found_in_all_its_poses_with_the_names_of_its_edges(roll):
    pose = triangle_pose(roll)
    found = view_board(render(pose, TRIANGLE), TRIANGLE, MODEL)
    view = nearest(found, pose)
    corners = on_board(pose, TRIANGLE.corners)
    assert (
        view.reason == ""
        and len(view.edges) == 3
        and worst_edge(view, pose, TRIANGLE) < 0.05
    )
    np.testing.assert_allclose(
        corners_of_lines([e.line for e in view.edges]), corners, atol=0.05
    )
    assert (
        turned(view.T_camera_board, pose) < 0.01
        and score(view.T_camera_board, view.covariance, pose) < 5
    )
    assert len(found.alternatives) >= 2
    for other in (found, *found.alternatives):
        there = on_board(other.T_camera_board, TRIANGLE.corners)
        np.testing.assert_allclose(
            np.sort(there, axis=0), np.sort(corners, axis=0), atol=0.1
        )


def test_picked_edges_tell_which_side_is_which_and_all_of_them_need_no_detector():
    pose = triangle_pose()
    corners = on_board(pose, TRIANGLE.corners, project)
    picks = {name: corners[[i, (i + 1) % 3]] for i, name in enumerate(TRIANGLE.edges)}
    view = view_board(render(pose, TRIANGLE), TRIANGLE, MODEL, picks={"bc": picks["bc"]})
    picked = {name: undistort(ends, MODEL) for name, ends in picks.items()}
    np.testing.assert_allclose(view.edge("bc").ends, picked["bc"])
    assert worst_edge(view, pose, TRIANGLE) < 0.1
    view = view_board(BLANK, TRIANGLE, MODEL, picks=picks)
    assert view.reason == ""
    for edge in view.edges:
        np.testing.assert_allclose(edge.ends, picked[edge.name])
    np.testing.assert_allclose(
        nearest(view, pose).T_camera_board.as_matrix(), pose.as_matrix(), atol=1e-6
    )


def test_plain_boards_that_cannot_be_used():
    blank = np.full((480, 640, 3), 200, np.uint8)
    square = Board(
        "square", ("a", "b", "c", "d"), np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    )
    flat = cv2.fillPoly(
        blank.copy(),
        [np.array([[100, 100], [500, 140], [400, 200], [120, 300]])],
        (20, 20, 20),
    )
    for picture, board, message in (
        (blank, TRIANGLE, "no dark region with 3 straight edges"),
        (
            cv2.circle(blank.copy(), (300, 200), 80, (20, 20, 20), -1),
            TRIANGLE,
            "no dark region with 3 straight edges",
        ),
        (
            render(triangle_pose(at=(0.42, 0.0, 0.9)), TRIANGLE),
            TRIANGLE,
            "cut by the image border",
        ),
        (flat, square, "no pose of board 'square' explains the outline"),
    ):
        assert message in view_board(picture, board, MODEL).reason
