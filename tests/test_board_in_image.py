"""The board in an image: poses from corners and edges."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rendered_boards import (
    BLANK,
    CORNERS,
    MODEL,
    PATTERN,
    SHEET,
    clutter,
    on_board,
    pixels_of,
    pose_of,
    render,
    score,
    seen,
    small_turn,
    true_line,
    turned,
    view_poses,
    worst_edge,
)
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.camera import line_distance, project, undistort
from lrfcal_lib.preprocess.board_in_image import (
    BoardView,
    order_scores,
    pose_with_edges,
)
from lrfcal_lib.preprocess.edges_in_image import picked_edge
from lrfcal_lib.preprocess.intrinsics import (
    board_pose,
    first_pose,
)
from lrfcal_lib.preprocess.pattern_in_image import (
    pattern_orders,
)
from lrfcal_lib.session.read import EdgePick

FAR = pose_of(0.3, (0.14, -0.1), (0.1, 0.0, 3.0))


def far_view(sigma, seed, edges=()):
    pixels = pixels_of([FAR], sigma, seed)[0]
    pose, covariance, _ = board_pose(pixels, PATTERN, MODEL)
    return BoardView(
        pixels=pixels, T_camera_board=pose, covariance=covariance, edges=tuple(edges)
    )


def noisy_edges(pose, seed, sigma=0.1):
    """All four edges as a detector with that error (of the two ends alike) would see them, and their covariances."""
    rng = np.random.default_rng(seed)
    out = []
    for i, name in enumerate(SHEET.edges):
        exact = true_line(name, pose)
        ends = (
            on_board(pose, CORNERS[[i, (i + 1) % 4]])
            + rng.normal(0, sigma, (2, 1)) * exact[:2]
        )
        edge = picked_edge(
            name, ends, ends.mean(axis=0) - exact[:2]
        )  # by a hand that errs by a pixel
        out.append(replace(edge, covariance=sigma**2 * edge.covariance))
    return out


def test_corners_and_edges_together_are_better_and_know_how_much():
    chi2 = []
    alone = []
    both = []
    for seed in range(60):
        view = far_view(0.1, seed, noisy_edges(FAR, 100 + seed))
        pose, covariance = pose_with_edges(view, SHEET, MODEL)
        chi2.append(score(pose, covariance, FAR))
        alone.append(np.abs(small_turn(view.T_camera_board, FAR)))
        both.append(np.abs(small_turn(pose, FAR)))
        smaller = np.all(np.diag(covariance) < np.diag(view.covariance) * (1 + 1e-9))
        assert smaller or turned(view.T_camera_board, pose) > 0.05
    assert 0.5 < np.mean(chi2) < 1.5
    assert np.all(np.median(both, axis=0) < np.median(alone, axis=0))


def test_an_edge_that_contradicts_the_corners_is_left_out():
    view = far_view(0.05, 1)
    edges = noisy_edges(FAR, 3, 0.05)
    good, _ = pose_with_edges(replace(view, edges=edges[:3]), SHEET, MODEL)
    moved = replace(edges[3], line=edges[3].line + [0, 0, 9.0])
    same, _ = pose_with_edges(replace(view, edges=[*edges[:3], moved]), SHEET, MODEL)
    np.testing.assert_allclose(same.as_matrix(), good.as_matrix(), atol=1e-9)
    for useless in ([moved], []):
        pose, covariance = pose_with_edges(replace(view, edges=useless), SHEET, MODEL)
        assert pose is view.T_camera_board and covariance is view.covariance


@pytest.mark.parametrize("roll", [0.0, -2.5])
def test_edges_of_a_known_board_at_any_roll(roll):
    pose = pose_of(roll)
    view = seen(render(pose))
    assert (view.file, view.reason, view.rejected, view.placement, view.pitch) == (
        "a.png",
        "",
        (),
        3,
        0.1,
    )
    assert [e.name for e in view.edges] == list(SHEET.edges)
    assert worst_edge(view, pose) < 0.05 and turned(view.T_camera_board, pose) < 0.003
    centre = on_board(pose, [[0.12, 0.095]])[0]
    assert all(line_distance(centre, e.line) < 0 for e in view.edges)


def test_the_order_of_corners_follows_the_outline():
    for pose, background in zip(
        view_poses(3, seed=6), (170.0, clutter(1), clutter(2)), strict=True
    ):
        picture = render(pose, background=background)
        exact = pixels_of([pose])[0]
        for start in pattern_orders(PATTERN):
            orders = exact[start][pattern_orders(PATTERN)]
            poses = RigidTransform.concatenate(
                [first_pose(PATTERN.points(), pixels, MODEL) for pixels in orders]
            )
            np.testing.assert_array_equal(
                orders[np.argmax(order_scores(picture, SHEET, MODEL, poses))], exact
            )


def test_what_cannot_be_used_is_listed_with_the_reason():
    view = seen(render(pose_of(at=(0.0, 0.17, 0.8))))
    assert view.reason == "" and [name for name, _ in view.rejected] == ["bottom"]
    assert "cut by the image border" in view.rejected[0][1]
    view = seen(render(pose_of(), background=105.0))
    assert [reason.split(":")[0] for _, reason in view.rejected] == ["no clear edge"] * 4
    view = seen(BLANK + np.uint8(80))
    assert "inner corners" in view.reason and (view.edges, view.T_camera_board) == (
        (),
        None,
    )


def test_picks_override_the_detector():
    pose = pose_of()
    corners = on_board(pose, CORNERS, project)
    picks = [
        EdgePick("left", Path("a.png"), "top", corners[[1, 0]] + [0.5, 0.5]),
        EdgePick("left", Path("b.png"), "right", corners[:2]),
        EdgePick("right", Path("a.png"), "left", corners[:2]),
    ]
    view = seen(render(pose), picks=picks)
    top = view.edge("top")
    ends = undistort(picks[0].ends, MODEL)
    np.testing.assert_allclose(top.ends, ends, atol=1e-9)
    assert np.abs(line_distance(ends, top.line)).max() < 1e-9
    assert line_distance(on_board(pose, [[0.12, 0.095]])[0], top.line) < 0
    assert (
        view.edge("right").covariance[0, 0] < top.covariance[0, 0]
    )  # that of another image
    assert view.edge("left").covariance[0, 0] < top.covariance[0, 0]  # of another camera
    assert view.edge("nowhere") is None
