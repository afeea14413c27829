"""Corners, intrinsics, poses, straight edges and outlines from images whose truth is computed, and from real ones."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from shared import campaign

from lrfcal_lib.calibrate import naming
from lrfcal_lib.evaluate.stereo import stereo_reference
from lrfcal_lib.model.board import Board, Chessboard, corners_of_lines, triangle_board
from lrfcal_lib.model.camera import CameraModel, line_distance, pinhole, project, undistort
from lrfcal_lib.model.problem import ProblemKind
from lrfcal_lib.preprocess import edges_in_image, intrinsics, prepared, survey
from lrfcal_lib.preprocess.board_in_image import (
    BoardView,
    mirrored_pose,
    order_scores,
    pose_with_edges,
    view_board,
)
from lrfcal_lib.preprocess.edges_in_image import picked_edge, refine_edge
from lrfcal_lib.preprocess.intrinsics import (
    adjust,
    board_pose,
    estimate_intrinsics,
    estimate_relief,
    first_pose,
)
from lrfcal_lib.preprocess.kept_images import part_around
from lrfcal_lib.preprocess.outline_in_images import measure_outline
from lrfcal_lib.preprocess.pattern_in_image import (
    PatternFinder,
    PatternNotFound,
    pattern_orders,
    scale_error,
    square_px,
)
from lrfcal_lib.session.read import EdgePick, ImageRecord

SIZE = 640, 480
MODEL = CameraModel(*SIZE, 600.0, 598.0, 322.0, 236.0, np.array([-0.15, 0.05, 0.001, -0.0005, 0.0]))
PATTERN = Chessboard(6, 4, 0.05)
# margins outside the inner corners: left 0.13, right 0.12, top 0.11, bottom 0.15; the left edge is not parallel
CORNERS = np.array([[-0.13, -0.11], [0.37, -0.11], [0.37, 0.30], [-0.125, 0.30]])
SHEET = Board("sheet", ("top", "right", "bottom", "left"), CORNERS, PATTERN, ("left", "top"))
UNKNOWN, TRIANGLE = replace(SHEET, corners=None), triangle_board()
SAMPLES = 3  # rays a pixel along u and v
BLANK = np.zeros((480, 640, 3), np.uint8)


def record(camera, file, placement, pitch=0.0, purpose="board"):
    return ImageRecord(camera, Path(file), placement, pitch, 0.0, purpose)


@lru_cache(maxsize=4)
def rays():
    """Normalised directions of all rays of the image, shape (h * SAMPLES, w * SAMPLES, 2)."""
    uv = np.stack(np.meshgrid(*(((np.arange(n * SAMPLES) + 0.5) / SAMPLES - 0.5) for n in SIZE)), axis=-1)
    return ((undistort(uv, MODEL) - [MODEL.cx, MODEL.cy]) / [MODEL.fx, MODEL.fy]).astype(np.float32)


def render(pose, board=SHEET, background=170.0, noise=1.5, seed=0, rim=1.0):
    """Image of a board, every pixel averaged over rays, blurred a little, with noise."""
    inverse = np.linalg.inv(pose.as_matrix()[:3, [0, 1, 3]]).astype(np.float32)
    plane = rays() @ inverse[:, :2].T + inverse[:, 2]
    x, y = plane[..., 0] / plane[..., 2], plane[..., 1] / plane[..., 2]
    lines = board.lines().astype(np.float32)
    inside = np.all([a * x + b * y + c < 0 for a, b, c in lines], axis=0) & (plane[..., 2] > 0)
    shade = np.where(inside, face(x, y, board, rim), background)
    small = cv2.GaussianBlur(shade.reshape(MODEL.height, SAMPLES, MODEL.width, SAMPLES).mean(axis=(1, 3)), (0, 0), 0.7)
    noisy = np.clip(small + np.random.default_rng(seed).normal(0, noise, small.shape), 0, 255)
    return np.repeat(np.rint(noisy).astype(np.uint8)[..., None], 3, axis=2)


def face(x, y, board, rim=1.0):
    """Grey values of a board: dark, or a white sheet with a chessboard on a brown one, its rim cut to `rim` squares."""
    if board.pattern is None:
        return np.full_like(x, 35.0)
    p = board.pattern
    u, v = (x - p.origin[0]) / p.square, (y - p.origin[1]) / p.square
    i, j = np.floor(u).astype(np.int16), np.floor(v).astype(np.int16)
    squares = (u > -rim) & (u < p.columns - 1 + rim) & (v > -rim) & (v < p.rows - 1 + rim)
    white = (u > -1.3) & (u < p.columns + 0.3) & (v > -1.3) & (v < p.rows + 0.3)
    return np.where(squares, np.where((i + j) % 2 == 0, 20.0, 235.0), np.where(white, 235.0, 105.0))


def clutter(seed=3):
    """A background full of straight edges: boxes of all grey values and sizes."""
    rng, out = np.random.default_rng(seed), np.full((MODEL.height, MODEL.width), 160, np.uint8)
    for _ in range(90):
        box = cv2.boxPoints((rng.uniform([0, 0], [640, 480]), rng.uniform(20, 120, 2), rng.uniform(0, 90)))
        cv2.fillPoly(out, [np.rint(box).astype(np.int32)], int(rng.uniform(10, 250)))
    return np.kron(out, np.ones((SAMPLES, SAMPLES), np.uint8)).astype(np.float32)


def pose_of(roll=0.0, tilt=(0.2, -0.3), at=(0.0, 0.0, 0.9), centre=(0.12, 0.095), facing=False):
    """Board with its centre at `at`, tilted about its own axes, then rolled about the optical axis.

    The x axis is to the right and y down, so that z points away from the camera unless it is `facing` it.
    """
    rotation = Rotation.from_rotvec([0, 0, roll]) * Rotation.from_rotvec([*tilt, 0])
    rotation = rotation * Rotation.from_euler("x", np.pi) if facing else rotation
    return RigidTransform.from_components(np.array(at) - rotation.apply([*centre, 0.0]), rotation)


def triangle_pose(roll=0.4, at=(0.02, 0.0, 0.9)):
    return pose_of(roll, (0.3, -0.35), at, (0.105, 0.127), facing=True)


def view_poses(n, seed=0):
    low, high = [-0.4, -0.5, -0.5, -0.12, -0.08, 0.75], [0.4, 0.5, 0.5, 0.12, 0.08, 1.2]
    drawn = np.random.default_rng(seed).uniform(low, high, (n, 6))
    return [pose_of(roll, (a, b), at) for roll, a, b, *at in drawn]


def pixels_of(poses, sigma=0.0, seed=0, model=MODEL, points=None):
    points = PATTERN.points() if points is None else points
    exact = np.stack([project(p.apply(points), model) for p in poses])
    return exact + np.random.default_rng(seed).normal(0, 1, exact.shape) * sigma


def on_board(pose, xy, camera=pinhole):
    """Pixels of points of the board, undistorted but for `camera=project`."""
    return camera(pose.apply(np.column_stack([xy, np.zeros(len(xy))])), MODEL)


def true_line(name, pose, board=SHEET):
    line = np.linalg.solve((MODEL.matrix @ pose.as_matrix()[:3, [0, 1, 3]]).T, board.lines()[board.edges.index(name)])
    return line / np.hypot(line[0], line[1])


def worst_edge(view, pose, board=SHEET):
    """Largest distance of the ends of any edge from the truth, pixels."""
    return max(np.abs(line_distance(e.ends, true_line(e.name, pose, board))).max() for e in view.edges)


def small_turn(a, b):
    """[w, v] that leads from b to a."""
    return np.r_[(a.rotation * b.rotation.inv()).as_rotvec(), a.translation - b.translation]


def turned(a, b):
    return np.linalg.norm(small_turn(a, b)[:3])


def score(pose, covariance, exact):
    """Chi-square of a pose per degree of freedom."""
    error = small_turn(pose, exact)
    return error @ np.linalg.solve(covariance, error) / 6


def find_pattern(picture, pattern=PATTERN):
    return PatternFinder(pattern)(picture)


def up_to_a_turn(corners, exact):
    """Distances of corners from the truth or, if nearer, from the same turned by 180 deg."""
    return min((corners - p for p in (exact, exact[::-1])), key=lambda off: np.abs(off).max())


def seen(picture, board=SHEET, picks=()):
    """The view of a single image."""
    records = [record("left", "a.png", 3, 0.1)]
    return survey.survey(records, lambda r: picture, board, {"left": MODEL}, picks).views["left"][0]


# --- corners -------------------------------------------------------------------------------------------------------


# squares along the pixel grid are the hard case of the sector-based detector (and no limit on real prints)
@pytest.mark.parametrize(("roll", "negative", "limit"), [(0.0, False, 0.1), (-1.2, False, 0.05), (-1.2, True, 0.1)])
def test_corners_are_found_at_subpixel_level(roll, negative, limit):
    """Also of white squares on a dark board."""
    pose = pose_of(roll)
    picture = 255 - render(pose) if negative else render(pose)
    off = up_to_a_turn(find_pattern(picture), on_board(pose, PATTERN.points()[:, :2], project))
    assert np.sqrt(np.mean(off**2)) < limit


@pytest.mark.parametrize(("side", "rim"), [(6.5, 0.65), (9.5, 1.0), (10.5, 0.65)])  # pixels, squares
def test_small_squares_have_the_right_scale(side, rim):
    """Also where the outermost squares are cut: no window may reach over the rim of the pattern."""
    pattern = Chessboard(7, 5, 0.05)
    corners = np.array([[-0.13, -0.11], [0.42, -0.11], [0.42, 0.35], [-0.13, 0.35]])
    sheet = replace(SHEET, corners=corners, pattern=pattern)
    scales = []
    for seed, pose in enumerate(view_poses(6, seed=3)):
        far = RigidTransform.from_components([0.01 * seed, -0.07, MODEL.fx * pattern.square / side], pose.rotation)
        exact = on_board(far, pattern.points()[:, :2], project)
        picture = render(far, sheet, seed=seed, rim=rim)
        off = up_to_a_turn(find_pattern(picture, pattern), exact)
        spread = exact - exact.mean(axis=0)
        scales.append(np.sum(off * spread) / np.sum(spread**2))
    assert abs(np.median(scales)) < 0.0003  # a corner that the detector puts elsewhere is left out later


def pixels_of_squares(side):
    """Corners of a pattern whose squares are so many pixels wide."""
    pose = pose_of(at=(0.0, 0.0, MODEL.fx * PATTERN.square / side), tilt=(0.0, 0.0))
    return pixels_of([pose], 0.02)[0]


def test_small_squares_widen_the_covariance_and_are_named():
    for side, least in ((6.0, 0.001), (30.0, 0.0)):
        pixels = pixels_of_squares(side)
        found, covariance, _ = board_pose(pixels, PATTERN, MODEL)
        middle = found.apply(PATTERN.points().mean(axis=0))
        added = intrinsics.scale_covariance(found, pixels, PATTERN)
        np.testing.assert_allclose(np.sqrt(np.trace(added)), least * np.linalg.norm(middle), rtol=0.05, atol=2e-6)
        assert np.all(np.diag(covariance) > np.diag(added))
        words = survey.small_squares({"left": {4: BoardView(pixels=pixels), 7: BoardView()}}, PATTERN)
        assert ("left" in words) == (side < 9)
    assert words == {} == survey.small_squares({"left": {4: BoardView(pixels=pixels)}}, None)
    assert scale_error(square_px(np.full((24, 2), np.nan), (6, 4))) == 0.01  # no two neighbours


def test_small_squares_are_a_problem_of_their_camera(monkeypatch):
    views = {
        "left": [BoardView("left", placement=4, pixels=pixels_of_squares(7.0))],
        "right": [BoardView("right", placement=4, pixels=pixels_of_squares(12.0))],
    }
    seen = survey.Survey(views, {}, None, SHEET)
    monkeypatch.setattr(prepared, "views_of", lambda session, **options: seen)
    problems = prepared.prepare_images(prepared.Prepared(None, SHEET, {}, {}, {})).problems
    (problem,) = problems
    assert problem.kind == ProblemKind.SMALL_SQUARES and problem.camera == "left"
    assert "placements 4), 7.0 px at least" in problem.words and str(problem).startswith("camera 'left': squares")


@pytest.mark.parametrize(("side", "named"), [(7.0, True), (12.0, False)])
def test_where_all_cameras_contradict_a_scan_small_squares_are_a_cause(monkeypatch, side, named):
    views = {c: {4: BoardView(c, placement=4, pixels=pixels_of_squares(side))} for c in ("left", "right")}
    data = SimpleNamespace(placements=np.array([4]), select=lambda inliers: None)
    monkeypatch.setattr(naming, "observe", lambda prepared, camera: data)
    monkeypatch.setattr(naming, "find_outlying_placements", lambda obs: ([], {4: 0.02}))
    monkeypatch.setattr(naming, "solve_camera", lambda obs, method: SimpleNamespace(transform=None))
    (problem,) = naming.rough_poses(SimpleNamespace(views=views, board=SHEET))[1]
    assert problem.placement == 4 and "another surface" in problem.words
    assert ("or the images: squares below 9 px" in problem.words) == named


def test_large_images_are_searched_small_and_refined_as_they_are(monkeypatch):
    pose, looked_at = pose_of(-1.2), []
    small = render(pose, noise=0.0)
    exact = on_board(pose, PATTERN.points()[:, :2], project)

    def watched(ask):
        """The same detector, which notes how large the pictures are."""
        return lambda picture, *rest, **options: looked_at.append(picture.size) or ask(picture, *rest, **options)

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


def test_an_image_is_decoded_once_and_kept_where_the_board_is():
    pose = pose_of(at=(0.0, 0.0, 2.5))
    picture = render(pose)
    part = part_around(picture, on_board(pose, PATTERN.points()[:, :2], project), SHEET)
    reads = []
    shot = survey.Shot(record("left", "a.png", 3), BoardView(), part)
    image = shot.image(reads.append)
    assert reads == []
    low = np.floor(on_board(pose, CORNERS, project).min(axis=0)).astype(int) - 40
    high = np.ceil(on_board(pose, CORNERS, project).max(axis=0)).astype(int) + 40
    board = np.s_[max(low[1], 0) : high[1], max(low[0], 0) : high[0]]
    np.testing.assert_array_equal(image[board], picture[board])
    assert np.any(image != picture)  # the rest is not kept
    other = survey.Shot(record("left", "b.png", 4), BoardView())
    assert other.image(lambda r: reads.append(r) or picture) is picture and reads == [other.record]


def test_corners_run_clockwise_also_in_a_mirrored_image():
    found = find_pattern(render(pose_of())[:, ::-1].copy()).reshape(4, 6, 2)
    x, y = found[0, -1] - found[0, 0], found[-1, 0] - found[0, 0]
    assert x[0] * y[1] - x[1] * y[0] > 0


@pytest.mark.parametrize(("shape", "kind", "message"), [
    *[(shape, np.uint8, "6 x 4 inner corners") for shape in ((480, 640, 3), (1, 1), (1, 5000), (8, 8))],
    *[(shape, np.uint8, "must be uint8") for shape in ((4, 4, 3, 1), (0, 0))],
    ((4, 4), float, "must be uint8"),
])  # fmt: skip


def test_no_pattern_and_no_image(shape, kind, message):  # OpenCV refuses narrow ones
    with pytest.raises(PatternNotFound if "corners" in message else ValueError, match=message):
        find_pattern(np.full(shape, 90, kind))


@pytest.mark.parametrize("roll", [1.7, -1.4])
def test_a_pattern_that_the_image_cuts_is_not_taken_a_row_off(roll):
    picture = render(pose_of(roll, (0.0, 0.0)))
    whole = find_pattern(picture)
    for beyond in (-5, 3, 45):
        try:
            found = find_pattern(np.ascontiguousarray(picture[: int(whole[:, 1].max()) + beyond]))
        except PatternNotFound:
            assert beyond < 30  # where all squares are seen it is found
        else:
            assert np.abs(up_to_a_turn(found, whole)).max() < 0.3


# --- adjustment ----------------------------------------------------------------------------------------------------


def test_intrinsics_without_noise_are_exact():
    poses = view_poses(8)
    result = estimate_intrinsics(pixels_of(poses), PATTERN, SIZE)
    model = result.models[0]
    np.testing.assert_allclose(model.parameters, MODEL.parameters, atol=2e-5)
    assert (model.width, model.height) == SIZE and model.rms_px < 1e-5
    np.testing.assert_allclose(result.poses.as_matrix(), [true.as_matrix() for true in poses], atol=1e-6)


def test_intrinsics_covariance_tells_the_error():
    poses, errors = view_poses(8, seed=2), []
    for seed in range(30):
        model = estimate_intrinsics(pixels_of(poses, 0.2, seed), PATTERN, SIZE).models[0]
        errors.append((model.parameters - MODEL.parameters)[:8] / np.sqrt(np.diag(model.covariance))[:8])
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) < 1.25


def test_third_radial_term_stays_out_unless_the_images_need_it():
    rng = np.random.default_rng(4)
    poses = [pose_of(0, rng.uniform(-0.4, 0.4, 2), (*rng.uniform(-0.3, 0.3, 2), 0.8)) for _ in range(10)]
    assert estimate_intrinsics(pixels_of(poses, 0.1), PATTERN, SIZE).models[0].distortion[4] == 0
    bent = MODEL.with_parameters([*MODEL.parameters[:8], 1.5])
    model = estimate_intrinsics(pixels_of(poses, 0.1, model=bent), PATTERN, SIZE).models[0]
    assert model.distortion[4] == pytest.approx(1.5, abs=4 * np.sqrt(model.covariance[8, 8]))


def test_waves_of_the_sheet_are_found_and_only_where_there_are_any():
    points, poses = PATTERN.points(), view_poses(12, seed=5)
    basis = intrinsics.waves(points)
    waves = basis @ basis.T @ (0.001 * np.sin(40 * points[:, 0]) * np.cos(25 * points[:, 1]))
    bumpy = pixels_of(poses, 0.02, points=points + waves[:, None] * [0, 0, 1])
    result = estimate_intrinsics(bumpy, PATTERN, SIZE, relief=True)
    np.testing.assert_allclose(result.relief, waves, atol=2e-4)
    assert abs(result.models[0].fx - MODEL.fx) < 4 * np.sqrt(result.models[0].covariance[0, 0])
    np.testing.assert_allclose(estimate_relief(bumpy, PATTERN, MODEL).relief, waves, atol=2e-4)
    assert not estimate_relief(pixels_of(poses, 0.05), PATTERN, MODEL).relief.any()


STACKED = RigidTransform.concatenate([pose_of()])
ONE = pixels_of([pose_of()])[0]
PARALLEL = [pose_of(0.3 * i, (0.0, 0.0), (0.02 * i, 0.0, 0.8 + 0.1 * i)) for i in range(4)]


@pytest.mark.parametrize(("message", "call"), {
    "at least three views of the pattern, got 2": lambda: estimate_intrinsics([ONE, ONE], PATTERN, SIZE),
    "parallel to itself.*focal length": lambda: estimate_intrinsics(pixels_of(PARALLEL, 0.01), PATTERN, SIZE),
    "8 image coordinates cannot determine 15 unknowns":
        lambda: adjust(ONE[None, None, :4], PATTERN.points()[:4], [MODEL], STACKED),
    "four or more of the pattern's 24 corners": lambda: board_pose(ONE[:10], PATTERN, MODEL),
    "four or more": lambda: board_pose(np.where(np.arange(24)[:, None] < 3, ONE, np.nan), PATTERN, MODEL),
    "two points 0.00 px apart": lambda: picked_edge("top", np.full((2, 2), 3.0), np.zeros(2)),
    "predicted length is 3 px": lambda: refine_edge(BLANK, MODEL, "top", *np.array([[10, 10], [13, 10], [0, -1]]), 5.0),
}.items())  # fmt: skip


def test_what_does_not_suffice(message, call):
    with pytest.raises(ValueError, match=message):
        call()


# --- pose ----------------------------------------------------------------------------------------------------------


def test_pose_without_noise_is_exact_and_its_covariance_tells_the_error():
    pose = pose_of(0.3)
    got = board_pose(pixels_of([pose])[0], PATTERN, MODEL)[0]
    np.testing.assert_allclose(got.as_matrix(), pose.as_matrix(), atol=1e-8)
    chi2 = [score(*board_pose(pixels_of([pose], 0.3, s)[0], PATTERN, MODEL)[:2], pose) for s in range(60)]
    assert 0.6 < np.mean(chi2) < 1.4


def test_errors_that_agree_between_neighbours_widen_the_covariance():
    pose, rng, chi2 = pose_of(0.3), np.random.default_rng(1), []
    for _ in range(40):
        coarse = cv2.resize(rng.normal(0, 0.3, (3, 3, 2)), (6, 4), interpolation=cv2.INTER_CUBIC)
        noise = coarse.reshape(-1, 2) + rng.normal(0, 0.05, (24, 2))
        chi2.append(score(*board_pose(pixels_of([pose])[0] + noise, PATTERN, MODEL)[:2], pose))
    assert np.mean(chi2) < 5


FAR = pose_of(0.3, (0.14, -0.1), (0.1, 0.0, 3.0))


def far_view(sigma, seed, edges=()):
    pixels = pixels_of([FAR], sigma, seed)[0]
    pose, covariance, _ = board_pose(pixels, PATTERN, MODEL)
    return BoardView(pixels=pixels, T_camera_board=pose, covariance=covariance, edges=tuple(edges))


def noisy_edges(pose, seed, sigma=0.1):
    """All four edges as a detector with that error (of the two ends alike) would see them, and their covariances."""
    rng, out = np.random.default_rng(seed), []
    for i, name in enumerate(SHEET.edges):
        exact = true_line(name, pose)
        ends = on_board(pose, CORNERS[[i, (i + 1) % 4]]) + rng.normal(0, sigma, (2, 1)) * exact[:2]
        edge = picked_edge(name, ends, ends.mean(axis=0) - exact[:2])  # by a hand that errs by a pixel
        out.append(replace(edge, covariance=sigma**2 * edge.covariance))
    return out


def test_corners_and_edges_together_are_better_and_know_how_much():
    chi2, alone, both = [], [], []
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


def test_edges_tell_a_pose_from_its_mirror_in_depth():
    wrong = mirrored_pose(FAR, PATTERN)
    assert turned(wrong, FAR) > 0.2
    np.testing.assert_allclose(mirrored_pose(wrong, PATTERN).as_matrix(), FAR.as_matrix(), atol=1e-12)
    view = replace(far_view(0.05, 1), T_camera_board=wrong, covariance=np.diag([1e-4] * 3 + [1e-6] * 3))
    assert turned(pose_with_edges(replace(view, edges=noisy_edges(FAR, 2)), SHEET, MODEL)[0], FAR) < 0.05


def test_an_edge_that_contradicts_the_corners_is_left_out():
    view, edges = far_view(0.05, 1), noisy_edges(FAR, 3, 0.05)
    good, _ = pose_with_edges(replace(view, edges=edges[:3]), SHEET, MODEL)
    moved = replace(edges[3], line=edges[3].line + [0, 0, 9.0])
    same, _ = pose_with_edges(replace(view, edges=[*edges[:3], moved]), SHEET, MODEL)
    np.testing.assert_allclose(same.as_matrix(), good.as_matrix(), atol=1e-9)
    for useless in ([moved], []):
        pose, covariance = pose_with_edges(replace(view, edges=useless), SHEET, MODEL)
        assert pose is view.T_camera_board and covariance is view.covariance


# --- edges ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("roll", [0.0, -2.5])
def test_edges_of_a_known_board_at_any_roll(roll):
    pose = pose_of(roll)
    view = seen(render(pose))
    assert (view.file, view.reason, view.rejected, view.placement, view.pitch) == ("a.png", "", (), 3, 0.1)
    assert [e.name for e in view.edges] == list(SHEET.edges)
    assert worst_edge(view, pose) < 0.05 and turned(view.T_camera_board, pose) < 0.003
    centre = on_board(pose, [[0.12, 0.095]])[0]
    assert all(line_distance(centre, e.line) < 0 for e in view.edges)


def test_the_order_of_corners_follows_the_outline():
    for pose, background in zip(view_poses(3, seed=6), (170.0, clutter(1), clutter(2)), strict=True):
        picture, exact = render(pose, background=background), pixels_of([pose])[0]
        for start in pattern_orders(PATTERN):
            orders = exact[start][pattern_orders(PATTERN)]
            poses = RigidTransform.concatenate([first_pose(PATTERN.points(), pixels, MODEL) for pixels in orders])
            np.testing.assert_array_equal(orders[np.argmax(order_scores(picture, SHEET, MODEL, poses))], exact)


def test_line_covariance_tells_the_error_over_noise():
    pose, scores = pose_of(0.2), []
    clean, exact = render(pose, noise=0.0).astype(float), true_line("top", pose)
    start, end = (e - line_distance(e, exact) * exact[:2] for e in on_board(pose, CORNERS[[0, 1]] * 0.9))
    for seed in range(40):
        noisy = np.clip(clean + np.random.default_rng(seed).normal(0, 18, clean.shape), 0, 255)
        edge = refine_edge(np.rint(noisy).astype(np.uint8), MODEL, "top", start, end, exact[:2], 6.0)
        # what the covariance says beyond the fixed systematic part
        length = np.linalg.norm(edge.ends[1] - edge.ends[0])
        variance = np.diag(edge.covariance) - edges_in_image.SYSTEMATIC_PX**2 * np.array([1, 12 / length**2])
        turn = np.arctan2(exact[0] * edge.line[1] - exact[1] * edge.line[0], exact[:2] @ edge.line[:2])
        scores.append(np.array([line_distance(edge.centre, exact), turn]) ** 2 / variance)
    assert np.all(np.abs(np.sqrt(np.mean(scores, axis=0)) - 1) < 0.35)


def test_what_cannot_be_used_is_listed_with_the_reason():
    view = seen(render(pose_of(at=(0.0, 0.17, 0.8))))
    assert view.reason == "" and [name for name, _ in view.rejected] == ["bottom"]
    assert "cut by the image border" in view.rejected[0][1]
    view = seen(render(pose_of(), background=105.0))
    assert [reason.split(":")[0] for _, reason in view.rejected] == ["no clear edge"] * 4
    view = view_board(np.zeros((100, 120, 3), np.uint8), SHEET, MODEL)
    assert "120 x 100" in view.reason and "640 x 480" in view.reason
    view = seen(BLANK + np.uint8(80))
    assert "inner corners" in view.reason and (view.edges, view.T_camera_board) == ((), None)


def test_picks_override_the_detector():
    pose = pose_of()
    corners = on_board(pose, CORNERS, project)
    picks = [
        EdgePick("left", Path("a.png"), "top", corners[[1, 0]] + [0.5, 0.5]),
        EdgePick("left", Path("b.png"), "right", corners[:2]),
        EdgePick("right", Path("a.png"), "left", corners[:2]),
    ]
    view = seen(render(pose), picks=picks)
    assert [e.name for e in view.edges if e.n_points == 2] == ["top"]
    top, ends = view.edge("top"), undistort(picks[0].ends, MODEL)
    np.testing.assert_allclose(top.ends, ends, atol=1e-9)
    assert np.abs(line_distance(ends, top.line)).max() < 1e-9
    assert line_distance(on_board(pose, [[0.12, 0.095]])[0], top.line) < 0
    assert view.edge("left").n_points > 2 and view.edge("nowhere") is None
    with pytest.raises(ValueError, match="picked edge 'hypotenuse' is not one of"):
        seen(render(pose), picks=[replace(picks[0], edge="hypotenuse")])


# --- the outline that nobody measured ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def session():
    """Two cameras, seven placements; in every third image the board stands on its head."""
    poses, half = {}, Rotation.from_euler("z", np.pi)
    for i, pose in enumerate(view_poses(7, seed=11)):
        turn = RigidTransform.from_components(pose.apply([0.25, 0.15, 0.0]), pose.rotation * half)
        poses["left", i] = turn if i % 3 == 2 else pose
        poses["right", i] = RigidTransform.from_translation([-0.05, 0.0, 0.0]) * poses["left", i]
    pictures = {key: render(pose, background=clutter(50 + key[1]), seed=key[1]) for key, pose in poses.items()}
    records = [record(camera, f"/s/{camera}/{i}.png", i, 0.1 * i) for camera, i in poses]
    return poses, records, lambda r: pictures.get((r.camera, r.placement), BLANK)


@pytest.fixture(scope="module")
def surveyed(session):
    _, records, read = session
    return survey.survey(records, read, UNKNOWN, {"left": MODEL, "right": MODEL})


def test_survey_measures_the_outline_and_turns_all_views_alike(session, surveyed):
    # the truth up to a turn of the whole board, which nothing can tell
    views = [v for group in surveyed.views.values() for v in group]
    over = {turned(v.T_camera_board, session[0][v.camera, v.placement]) > 1 for v in views}
    assert len(over) == 1 and {len(group) for group in surveyed.views.values()} == {7}
    truth = np.roll(np.array([0.25, 0.15]) - CORNERS, -2, axis=0) if over.pop() else CORNERS
    outline, expected = surveyed.outline, replace(SHEET, corners=truth).lengths()
    np.testing.assert_allclose(surveyed.board.corners, truth, atol=8e-4)
    assert np.all(outline.line_sd < 0.002)
    for name, length in outline.board.lengths().items():
        assert length == pytest.approx(expected[name], abs=0.001) and outline.length_sd[name] < 0.003
    alone = measure_outline(surveyed.views["left"][:1], UNKNOWN, surveyed.models)
    assert np.isnan([*alone.line_sd, *alone.length_sd.values()]).all()


def test_surveys_that_cannot_work(session, surveyed):
    _, records, read = session
    both, triple = {"left": MODEL, "right": MODEL}, replace(UNKNOWN, edges=("a", "b", "c"))
    for count, see, board, models, message in (
        (2, read, UNKNOWN, {"left": None}, "camera 'left': intrinsics need at least three views"),
        (14, read, TRIANGLE, {"left": None}, "no intrinsics and board 'triangle' no pattern"),
        (2, read, triple, {"left": MODEL}, "has 3 edges and no known corners"),
        (2, lambda r: BLANK, UNKNOWN, both, "none of 2 images shows the pattern"),
    ):
        with pytest.raises(ValueError, match=message):
            survey.survey(records[:count], see, board, models)
    views = [replace(v, edges=v.edges[:1]) for group in surveyed.views.values() for v in group]
    with pytest.raises(ValueError, match="edge '.*' of board 'sheet' was found in none of 14 images"):
        measure_outline(views, UNKNOWN, surveyed.models)


def stereo(first, second, pattern=PATTERN, models=(MODEL, MODEL)):
    """The mounting of two cameras from the corners that they see at placements 0, 1, ..., and its covariance."""
    views = [{p: SimpleNamespace(pixels=own) for p, own in enumerate(seen)} for seen in (first, second)]
    views, models = (dict(enumerate(each)) for each in (views, models))
    board = SimpleNamespace(pattern=pattern)
    reference = stereo_reference(SimpleNamespace(board=board, views=views, models=models, relief=None))
    return reference.T_second_first, reference.covariance


def test_stereo_reference_recovers_the_mounting_and_its_covariance_tells_the_error():
    poses, mount, chi2 = view_poses(6, seed=8), pose_of(0.02, (0.01, -0.02), (-0.12, 0.002, 0.004), (0, 0)), []
    for seed in range(16):
        first = pixels_of(poses, 0.2, 2 * seed)
        second = pixels_of([mount * p for p in poses], 0.2, 2 * seed + 1)
        chi2.append(score(*stereo(first, second), mount))
    assert 0.6 < np.mean(chi2) < 1.5
    with pytest.raises(ValueError, match="no placement shows the pattern to both cameras"):
        stereo(first, [])
    with pytest.raises(ValueError, match="needs two cameras and a pattern"):
        stereo(first, first, pattern=None)


# --- boards without pattern ----------------------------------------------------------------------------------------


def nearest(view, pose):
    """Of the poses that explain an image the one that is right."""
    return min([view, *view.alternatives], key=lambda v: turned(v.T_camera_board, pose))


@pytest.mark.parametrize("roll", [0.4, -1.5])
def test_a_plain_triangle_is_found_in_all_its_poses_with_the_names_of_its_edges(roll):
    pose = triangle_pose(roll)
    found = view_board(render(pose, TRIANGLE), TRIANGLE, MODEL)
    view, corners = nearest(found, pose), on_board(pose, TRIANGLE.corners)
    assert view.reason == "" and len(view.edges) == 3 and worst_edge(view, pose, TRIANGLE) < 0.05
    np.testing.assert_allclose(corners_of_lines([e.line for e in view.edges]), corners, atol=0.05)
    assert turned(view.T_camera_board, pose) < 0.01 and score(view.T_camera_board, view.covariance, pose) < 5
    assert len(found.alternatives) >= 2
    for other in (found, *found.alternatives):
        there = on_board(other.T_camera_board, TRIANGLE.corners)
        np.testing.assert_allclose(np.sort(there, axis=0), np.sort(corners, axis=0), atol=0.1)


def test_picked_edges_tell_which_side_is_which_and_all_of_them_need_no_detector():
    pose = triangle_pose()
    corners = on_board(pose, TRIANGLE.corners, project)
    picks = {name: corners[[i, (i + 1) % 3]] for i, name in enumerate(TRIANGLE.edges)}
    view = view_board(render(pose, TRIANGLE), TRIANGLE, MODEL, picks={"bc": picks["bc"]})
    assert view.edge("bc").n_points == 2 and worst_edge(view, pose, TRIANGLE) < 0.1
    view = view_board(BLANK, TRIANGLE, MODEL, picks=picks)
    assert view.reason == "" and all(e.n_points == 2 for e in view.edges)
    np.testing.assert_allclose(nearest(view, pose).T_camera_board.as_matrix(), pose.as_matrix(), atol=1e-6)


def test_plain_boards_that_cannot_be_used():
    blank = np.full((480, 640, 3), 200, np.uint8)
    square = Board("square", ("a", "b", "c", "d"), np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]))
    flat = cv2.fillPoly(blank.copy(), [np.array([[100, 100], [500, 140], [400, 200], [120, 300]])], (20, 20, 20))
    for picture, board, message in (
        (blank, TRIANGLE, "no dark region with 3 straight edges"),
        (cv2.circle(blank.copy(), (300, 200), 80, (20, 20, 20), -1), TRIANGLE, "no dark region with 3 straight edges"),
        (render(triangle_pose(at=(0.42, 0.0, 0.9)), TRIANGLE), TRIANGLE, "cut by the image border"),
        (flat, square, "no pose of board 'square' explains the outline"),
    ):
        assert message in view_board(picture, board, MODEL).reason


# --- a simulated session, and real recordings ----------------------------------------------------------------------


def test_real_cameras_edges_and_outline(lms400):
    found = lms400.prepared
    for camera, model in found.models.items():
        assert model.rms_px < 0.32, camera
    for name, length in found.board.lengths().items():
        assert length == pytest.approx(0.858, abs=0.004), name
        assert found.outline.length_sd[name] < 0.007
    assert np.all(found.outline.line_sd < 0.0035)


def test_real_stereo(lms400):
    reference = stereo_reference(lms400.prepared)
    refined, covariance = reference.T_second_first, reference.covariance
    # shape-free bundle of an independent analysis, with its own uncertainty
    off = np.r_[np.rad2deg(refined.rotation.as_rotvec()), 1000 * refined.translation]
    sigma = np.sqrt(np.diag(covariance)) * np.repeat([np.rad2deg(1), 1000], 3)
    off -= [0.457, 0.479, -0.025, -120.0, -0.3, -0.8]
    assert np.all(np.abs(off) < 3 * np.hypot(sigma, [0.017, 0.038, 0.007, 0.36, 0.14, 0.90]))


@campaign
def test_opencv_stereo_pairs(real_data):
    folder, pattern = real_data / "opencv_stereo13", Chessboard(9, 6, 0.025)
    corners, models = [], []
    for camera, rms in (("left", 0.4087), ("right", 0.4586)):
        files = [folder / f"{camera}{i:02d}.jpg" for i in range(1, 15) if i != 10]
        corners.append([find_pattern(cv2.imread(str(file)), pattern) for file in files])
        result = estimate_intrinsics(corners[-1], pattern, SIZE)
        assert result.rms_px < rms
        models += result.models
    assert models[0].fx == pytest.approx(535.9, abs=4)
    transform, _ = stereo(*corners, pattern, models)
    # along the axis the pairs tell little: the detectors of OpenCV alone move it by 1 mm
    assert np.all(np.abs(1000 * transform.translation - [-83.606, 1.043, 1.324]) < [0.8, 0.3, 2.2])
