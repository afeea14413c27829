"""Images of boards whose truth is computed, and what to compare with it."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import Board, Chessboard, triangle_board
from lrfcal_lib.model.camera import CameraModel, line_distance, pinhole, project, undistort
from lrfcal_lib.preprocess import survey
from lrfcal_lib.preprocess.pattern_in_image import (
    PatternFinder,
)
from lrfcal_lib.preprocess.prepared import Prepared
from lrfcal_lib.session.read import ImageRecord
from lrfcal_lib.session.stated import CameraInfo

SIZE = 640, 480
MODEL = CameraModel(
    *SIZE, 600.0, 598.0, 322.0, 236.0, np.array([-0.15, 0.05, 0.001, -0.0005, 0.0])
)
PATTERN = Chessboard(6, 4, 0.05)
# margins outside the inner corners: left 0.13, right 0.12, top 0.11, bottom 0.15; the left edge is not parallel
CORNERS = np.array([[-0.13, -0.11], [0.37, -0.11], [0.37, 0.30], [-0.125, 0.30]])
SHEET = Board(
    "sheet", ("top", "right", "bottom", "left"), CORNERS, PATTERN, ("left", "top")
)
UNKNOWN = replace(SHEET, corners=None)
TRIANGLE = triangle_board()
SAMPLES = 3  # rays a pixel along u and v
BLANK = np.zeros((480, 640, 3), np.uint8)


def record(camera, file, placement, pitch=0.0, purpose="board"):
    return ImageRecord(camera, Path(file), placement, pitch, 0.0, purpose)


def seen_by(models, records, read, board, picks=()):
    """What a survey needs of a session, by the models of its cameras."""
    cameras = {
        name: CameraInfo(name, "head", *SIZE, model) for name, model in models.items()
    }
    return SimpleNamespace(
        image_records=records, read_image=read, board=board, cameras=cameras, picks=picks
    )


@lru_cache(maxsize=4)
def rays():
    """Normalised directions of all rays of the image, shape (h * SAMPLES, w * SAMPLES, 2)."""
    uv = np.stack(
        np.meshgrid(*(((np.arange(n * SAMPLES) + 0.5) / SAMPLES - 0.5) for n in SIZE)),
        axis=-1,
    )
    return ((undistort(uv, MODEL) - [MODEL.cx, MODEL.cy]) / [MODEL.fx, MODEL.fy]).astype(
        np.float32
    )


def render(pose, board=SHEET, background=170.0, noise=1.5, seed=0, rim=1.0):
    """Image of a board, every pixel averaged over rays, blurred a little, with noise."""
    inverse = np.linalg.inv(pose.as_matrix()[:3, [0, 1, 3]]).astype(np.float32)
    plane = rays() @ inverse[:, :2].T + inverse[:, 2]
    x = plane[..., 0] / plane[..., 2]
    y = plane[..., 1] / plane[..., 2]
    lines = board.lines().astype(np.float32)
    inside = np.all([a * x + b * y + c < 0 for a, b, c in lines], axis=0) & (
        plane[..., 2] > 0
    )
    shade = np.where(inside, face(x, y, board, rim), background)
    small = cv2.GaussianBlur(
        shade.reshape(MODEL.height, SAMPLES, MODEL.width, SAMPLES).mean(axis=(1, 3)),
        (0, 0),
        0.7,
    )
    noisy = np.clip(
        small + np.random.default_rng(seed).normal(0, noise, small.shape), 0, 255
    )
    return np.repeat(np.rint(noisy).astype(np.uint8)[..., None], 3, axis=2)


def face(x, y, board, rim=1.0):
    """Grey values of a board: dark, or a white sheet with a chessboard on a brown one, its rim cut to `rim` squares."""
    if board.pattern is None:
        return np.full_like(x, 35.0)
    p = board.pattern
    u = (x - p.origin[0]) / p.square
    v = (y - p.origin[1]) / p.square
    i = np.floor(u).astype(np.int16)
    j = np.floor(v).astype(np.int16)
    squares = (u > -rim) & (u < p.columns - 1 + rim) & (v > -rim) & (v < p.rows - 1 + rim)
    white = (u > -1.3) & (u < p.columns + 0.3) & (v > -1.3) & (v < p.rows + 0.3)
    return np.where(
        squares, np.where((i + j) % 2 == 0, 20.0, 235.0), np.where(white, 235.0, 105.0)
    )


def clutter(seed=3):
    """A background full of straight edges: boxes of all grey values and sizes."""
    rng = np.random.default_rng(seed)
    out = np.full((MODEL.height, MODEL.width), 160, np.uint8)
    for _ in range(90):
        box = cv2.boxPoints(
            (rng.uniform([0, 0], [640, 480]), rng.uniform(20, 120, 2), rng.uniform(0, 90))
        )
        cv2.fillPoly(out, [np.rint(box).astype(np.int32)], int(rng.uniform(10, 250)))
    return np.kron(out, np.ones((SAMPLES, SAMPLES), np.uint8)).astype(np.float32)


def pose_of(
    roll=0.0, tilt=(0.2, -0.3), at=(0.0, 0.0, 0.9), centre=(0.12, 0.095), facing=False
):
    """Board with its centre at `at`, tilted about its own axes, then rolled about the optical axis.

    The x axis is to the right and y down, so that z points away from the camera unless it is `facing` it.
    """
    rotation = Rotation.from_rotvec([0, 0, roll]) * Rotation.from_rotvec([*tilt, 0])
    rotation = rotation * Rotation.from_euler("x", np.pi) if facing else rotation
    return RigidTransform.from_components(
        np.array(at) - rotation.apply([*centre, 0.0]), rotation
    )


def triangle_pose(roll=0.4, at=(0.02, 0.0, 0.9)):
    return pose_of(roll, (0.3, -0.35), at, (0.105, 0.127), facing=True)


def view_poses(n, seed=0):
    low = [-0.4, -0.5, -0.5, -0.12, -0.08, 0.75]
    high = [0.4, 0.5, 0.5, 0.12, 0.08, 1.2]
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
    line = np.linalg.solve(
        (MODEL.matrix @ pose.as_matrix()[:3, [0, 1, 3]]).T,
        board.lines()[board.edges.index(name)],
    )
    return line / np.hypot(line[0], line[1])


def worst_edge(view, pose, board=SHEET):
    """Largest distance of the ends of any edge from the truth, pixels."""
    return max(
        np.abs(line_distance(e.ends, true_line(e.name, pose, board))).max()
        for e in view.edges
    )


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
    return min(
        (corners - p for p in (exact, exact[::-1])), key=lambda off: np.abs(off).max()
    )


def surveyed(session):
    """The survey of all images of a session, without its scans."""
    return survey.survey(Prepared(session, session.board, {}, {}))


def seen(picture, board=SHEET, picks=()):
    """The view of a single image."""
    records = [record("left", "a.png", 3, 0.1)]
    session = seen_by({"left": MODEL}, records, lambda r: picture, board, picks)
    return surveyed(session).views["left"][3]


def pixels_of_squares(side):
    """Corners of a pattern whose squares are so many pixels wide."""
    pose = pose_of(at=(0.0, 0.0, MODEL.fx * PATTERN.square / side), tilt=(0.0, 0.0))
    return pixels_of([pose], 0.02)[0]
