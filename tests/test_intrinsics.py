"""Intrinsics, poses and waves of the sheet from corners of a chessboard."""

import cv2
import numpy as np
import pytest
from rendered_boards import (
    BLANK,
    MODEL,
    PATTERN,
    SIZE,
    pixels_of,
    pixels_of_squares,
    pose_of,
    score,
    view_poses,
)
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import Chessboard
from lrfcal_lib.model.camera import project
from lrfcal_lib.preprocess import intrinsics, survey
from lrfcal_lib.preprocess.board_in_image import (
    BoardView,
)
from lrfcal_lib.preprocess.bundle import adjust, waves
from lrfcal_lib.preprocess.edges_in_image import picked_edge, refine_edge
from lrfcal_lib.preprocess.intrinsics import (
    board_pose,
    estimate_intrinsics,
    estimate_relief,
)
from lrfcal_lib.preprocess.pattern_in_image import (
    scale_error,
)


def test_small_squares_widen_the_covariance_and_are_named():
    for side, least in ((6.0, 0.001), (30.0, 0.0)):
        pixels = pixels_of_squares(side)
        found, covariance, _ = board_pose(pixels, PATTERN, MODEL)
        middle = found.apply(PATTERN.points().mean(axis=0))
        added = intrinsics.scale_covariance(found, pixels, PATTERN)
        np.testing.assert_allclose(
            np.sqrt(np.trace(added)), least * np.linalg.norm(middle), rtol=0.05, atol=2e-6
        )
        assert np.all(np.diag(covariance) > np.diag(added))
        problems = survey.small_squares(
            {"left": {4: BoardView(pixels=pixels), 7: BoardView()}}, PATTERN
        )
        assert [problem.camera for problem in problems] == ["left"] * (side < 9)
    assert problems == [] == survey.small_squares({"left": {4: BoardView()}}, None)
    assert scale_error(np.nan) == 0.01  # no two neighbours are left


def test_intrinsics_without_noise_are_exact():
    poses = view_poses(8)
    result = estimate_intrinsics(pixels_of(poses), PATTERN, SIZE)
    model = result.models[0]
    np.testing.assert_allclose(model.parameters, MODEL.parameters, atol=2e-5)
    assert (model.width, model.height) == SIZE and model.rms_px < 1e-5
    np.testing.assert_allclose(
        result.poses.as_matrix(), [true.as_matrix() for true in poses], atol=1e-6
    )


def test_intrinsics_covariance_tells_the_error():
    poses = view_poses(8, seed=2)
    errors = []
    for seed in range(30):
        model = estimate_intrinsics(pixels_of(poses, 0.2, seed), PATTERN, SIZE).models[0]
        errors.append(
            (model.parameters - MODEL.parameters)[:8]
            / np.sqrt(np.diag(model.covariance))[:8]
        )
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) < 1.25


def test_third_radial_term_stays_out_unless_the_images_need_it():
    rng = np.random.default_rng(4)
    poses = [
        pose_of(0, rng.uniform(-0.4, 0.4, 2), (*rng.uniform(-0.3, 0.3, 2), 0.8))
        for _ in range(10)
    ]
    assert (
        estimate_intrinsics(pixels_of(poses, 0.1), PATTERN, SIZE).models[0].distortion[4]
        == 0
    )
    bent = MODEL.with_parameters([*MODEL.parameters[:8], 1.5])
    model = estimate_intrinsics(pixels_of(poses, 0.1, model=bent), PATTERN, SIZE).models[0]
    assert model.distortion[4] == pytest.approx(
        1.5, abs=4 * np.sqrt(model.covariance[8, 8])
    )


def test_waves_of_the_sheet_are_found_and_only_where_there_are_any():
    points = PATTERN.points()
    poses = view_poses(12, seed=5)
    basis = waves(points)
    heights = (
        basis @ basis.T @ (0.001 * np.sin(40 * points[:, 0]) * np.cos(25 * points[:, 1]))
    )
    bumpy = pixels_of(poses, 0.02, points=points + heights[:, None] * [0, 0, 1])
    result = estimate_intrinsics(bumpy, PATTERN, SIZE, relief=True)
    np.testing.assert_allclose(result.relief, heights, atol=2e-4)
    assert abs(result.models[0].fx - MODEL.fx) < 4 * np.sqrt(
        result.models[0].covariance[0, 0]
    )
    np.testing.assert_allclose(
        estimate_relief(bumpy, PATTERN, MODEL).relief, heights, atol=2e-4
    )
    assert not estimate_relief(pixels_of(poses, 0.05), PATTERN, MODEL).relief.any()


STACKED = RigidTransform.concatenate([pose_of()])
ONE = pixels_of([pose_of()])[0]
PARALLEL = [pose_of(0.3 * i, (0.0, 0.0), (0.02 * i, 0.0, 0.8 + 0.1 * i)) for i in range(4)]


@pytest.mark.parametrize(("message", "call"), {
    "at least three views of the pattern, got 2": lambda: estimate_intrinsics([ONE, ONE], PATTERN, SIZE),
    "parallel to itself.*focal length": lambda: estimate_intrinsics(pixels_of(PARALLEL, 0.01), PATTERN, SIZE),
    "8 image coordinates cannot determine 15 unknowns":
        lambda: adjust(ONE[None, None, :4], PATTERN.points()[:4], [MODEL], STACKED),
    "four corners of the pattern or more, got 3": lambda: board_pose(np.where(np.arange(24)[:, None] < 3, ONE, np.nan), PATTERN, MODEL),
    "a line needs two different points": lambda: picked_edge("top", np.full((2, 2), 3.0), np.zeros(2)),
    "predicted length is 3 px": lambda: refine_edge(BLANK, MODEL, "top", *np.array([[10, 10], [13, 10], [0, -1]]), 5.0),
}.items())  # fmt: skip
def test_what_does_not_suffice(message, call):
    with pytest.raises(ValueError, match=message):
        call()


def test_pose_without_noise_is_exact_and_its_covariance_tells_the_error():
    pose = pose_of(0.3)
    got = board_pose(pixels_of([pose])[0], PATTERN, MODEL)[0]
    np.testing.assert_allclose(got.as_matrix(), pose.as_matrix(), atol=1e-8)
    chi2 = [
        score(*board_pose(pixels_of([pose], 0.3, s)[0], PATTERN, MODEL)[:2], pose)
        for s in range(60)
    ]
    assert 0.6 < np.mean(chi2) < 1.4


def test_a_corner_far_off_does_not_turn_a_small_board_over():
    """Seen from afar a board leaning the other way looks nearly the same."""
    small = Chessboard(5, 6, 0.025)
    rng = np.random.default_rng(0)
    wrong = 0
    for _ in range(100):
        lean = rng.uniform(0.1, 1.0) * np.append(uniform_direction(rng), 0.0)
        turn = Rotation.from_rotvec(lean) * Rotation.from_euler(
            "xz", [np.pi, rng.uniform(0, 6)]
        )
        place = rng.uniform([-0.2, -0.2, 1.2], [0.2, 0.2, 2.6])
        pose = RigidTransform.from_components(place, turn)
        pixels = project(pose.apply(small.points()), MODEL) + rng.normal(0, 0.02, (30, 2))
        pixels[rng.integers(30)] += 3 * uniform_direction(rng)
        found = board_pose(pixels, small, MODEL)[0]
        wrong += (found.inv() * pose).rotation.magnitude() > np.radians(5)
    assert wrong <= 1  # 10 without a second start


def uniform_direction(rng):
    """A unit vector (2,) of any direction."""
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def test_errors_that_agree_between_neighbours_widen_the_covariance():
    pose = pose_of(0.3)
    rng = np.random.default_rng(1)
    chi2 = []
    for _ in range(40):
        coarse = cv2.resize(
            rng.normal(0, 0.3, (3, 3, 2)), (6, 4), interpolation=cv2.INTER_CUBIC
        )
        noise = coarse.reshape(-1, 2) + rng.normal(0, 0.05, (24, 2))
        chi2.append(
            score(*board_pose(pixels_of([pose])[0] + noise, PATTERN, MODEL)[:2], pose)
        )
    assert np.mean(chi2) < 5
