"""Small sessions whose recording takes seconds: a board in front of a wall, or a sheet that hangs on one."""

import json
from functools import lru_cache

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import Board, Chessboard
from lrfcal_lib.model.camera import CameraModel, project, undistort
from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points
from lrfcal_lib.session.stated import (
    CameraInfo,
    LrfInfo,
    board_to_json,
    model_to_json,
    transform_to_json,
)
from lrfcal_lib.session.write import SessionWriter
from lrfcal_lib.simulate.draw import AHEAD

MODEL = CameraModel(
    480, 360, 500.0, 499.0, 241.0, 178.0, np.array([-0.12, 0.04, 0.001, -0.0005, 0.0])
)
HEAD = RigidTransform.from_components(
    [0.0, 0.012, 0.055], Rotation.from_rotvec([0.3, 0.8, -1.0], degrees=True)
)
STATED = RigidTransform.from_translation([0.0, 0.0, 0.05])


def _ahead(centre, turn_deg):
    """``T_camera_lrf`` of a camera at a point (metres) that looks ahead but for a turn (rotation vector, degrees)."""
    turn = Rotation.from_rotvec(turn_deg, degrees=True) * AHEAD
    return RigidTransform.from_components(-turn.apply(centre), turn)


CAMERAS = {
    "left": _ahead([-0.12, 0.03, 0.11], [-2.0, 1.5, 0.7]),
    "right": _ahead([0.12, 0.03, 0.12], [-1.8, -1.9, -0.4]),
}
FACING = Rotation.from_matrix([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
BEARINGS = np.radians(np.arange(40.0, 140.1, 0.5))
SIGMA_RANGE = 0.004
SAMPLES = 2  # m; rays a pixel along u and v
WALL = 2.6
CUT = (0.30, 0.22)  # m ahead; half the size of what is kept of a wall, m


def rectangle(shift=0.0, columns=9, rows=5, square=0.036, size=(0.46, 0.34)):
    """A board with a chessboard in its middle, or so far beside it (metres, along x and y)."""
    origin = (np.array(size) - np.array([columns - 1, rows - 1]) * square) / 2 + shift
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size
    names = ("top", "right", "bottom", "left")
    return Board(
        "plate",
        names,
        corners,
        Chessboard(columns, rows, square, tuple(origin)),
        ("top", "left"),
    )


def _truth(board, cameras):
    """What ``truth.json`` says of a session before its first placement."""
    lens = model_to_json(MODEL)
    of_cameras = {
        name: {"T_camera_lrf": transform_to_json(CAMERAS[name]), "intrinsics": lens}
        for name in cameras
    }
    return {
        "simulated": True,
        "T_head_lrf": transform_to_json(HEAD),
        "board": board_to_json(board),
        "boards": {},
        "cameras": of_cameras,
        "images": {},
        "sweeps": {},
        "lrf": {},
    }


def record(
    path, board, seed=0, *, placements=4, pitch_deg=None, on_wall=False, image_pitch_deg=(0.0,), cameras=CAMERAS,
    platform=STATED, still=(), purpose="board",
):  # fmt: skip
    """Write a simulated session with its truth.

    Parameters
    ----------
    path : Path
    board : Board
        With its corners, which the session states unless the sheet hangs on a wall.
    pitch_deg : sequence of float, optional
        Of the scan lines; a sweep over the board by default.
    on_wall : bool
        The board is a sheet on a wall of its own colour, and the rig is moved before it.
    image_pitch_deg : sequence of float
        Of the images of every placement.
    cameras : sequence of str
        Of `CAMERAS`.
    platform : RigidTransform or None
        As it is stated.
    still : sequence of str
        What does not change from placement to placement: 'turn', 'place'.
    purpose : str
        Of the images: 'scene' where nobody is to look for the board.
    """
    rng = np.random.default_rng(seed)
    pitch = np.radians(np.arange(-14, 14.1, 1.0) if pitch_deg is None else pitch_deg)
    info = LrfInfo("pinpoint", (BEARINGS[0], BEARINGS[-1]), np.radians(0.5), SIGMA_RANGE)
    infos = [CameraInfo(name, "head", MODEL.width, MODEL.height, MODEL) for name in cameras]
    stated = board
    if on_wall:
        stated = Board(board.name, board.edges, None, board.pattern, board.features)
    truth = _truth(board, cameras)
    own = {"platform_sigma": (0.03, 0.02), "simulated": True}
    with SessionWriter(path, stated, info, infos, platform, **own) as writer:
        for number in range(1, placements + 1):
            pose = _pose(board, rng, number, on_wall, still)
            truth["boards"][number] = {"T_platform_board": transform_to_json(pose)}
            truth["sweeps"][number] = {"pitch_rad": pitch.tolist()}
            writer.add_sweep(
                number, _scan(pose, board, pitch, on_wall, rng), BEARINGS, pitch
            )
            for name in cameras:
                for at in np.radians(image_pitch_deg):
                    back = RigidTransform.from_rotation(Rotation.from_rotvec([-at, 0, 0]))
                    seen = CAMERAS[name] * HEAD.inv() * back * pose
                    file = writer.add_image(
                        name,
                        _image(seen, board, on_wall, rng),
                        number,
                        pitch=float(at),
                        purpose=purpose,
                    )
                    truth["images"][file] = {
                        "pitch_rad": float(at),
                        "T_camera_board": transform_to_json(seen),
                    }
    (path / "truth.json").write_text(json.dumps(truth))
    return path


def _pose(board, rng, number, on_wall, still):
    """The board a metre ahead, turned another way at every placement; a sheet on a wall hangs nearly upright."""
    roll = rng.uniform(-8, 8) if on_wall else 50.0 * number + rng.uniform(-10, 10)
    tilt = rng.uniform(-28, 28, 2)
    turn = FACING * Rotation.from_euler(
        "YXZ", [*tilt * ("turn" not in still), roll], degrees=True
    )
    at = rng.uniform([-0.08, 0.95, -0.05], [0.08, 1.35, 0.05])
    at = np.array([0.0, 1.1, 0.0]) if "place" in still else at
    return RigidTransform.from_components(
        at - turn.apply([*board.corners.mean(axis=0), 0.0]), turn
    )


def _scan(pose, board, pitch, on_wall, rng):
    """Ranges of pinpoint beams, shape (lines, beams)."""
    up, bearing = np.meshgrid(pitch, BEARINGS, indexing="ij")
    origin = lrf_to_platform(np.zeros(up.shape + (3,)), up, HEAD)
    ray = lrf_to_platform(polar_to_points(np.ones(up.shape), bearing), up, HEAD) - origin
    normal = pose.rotation.apply([0, 0, 1])
    reach = (pose.translation - origin) @ normal / (ray @ normal)
    hit = pose.inv().apply((origin + reach[..., None] * ray).reshape(-1, 3))[:, :2]
    inside = np.all(hit @ board.lines()[:, :2].T + board.lines()[:, 2] < 0, axis=1).reshape(
        up.shape
    )
    behind = np.nan if on_wall else (WALL - origin[..., 1]) / ray[..., 1]
    if on_wall:  # clouds are cut to the neighbourhood of the sheet by hand
        inside = (
            (np.abs(hit - board.corners.mean(axis=0)) < CUT).all(axis=1).reshape(up.shape)
        )
    ranges = np.where(inside & (reach > 0), reach, behind)
    ranges = ranges + rng.normal(0, SIGMA_RANGE, ranges.shape)
    return np.where((ranges > 0.2) & (ranges < 6), ranges, np.nan)


@lru_cache(maxsize=1)
def _rays():
    u, v = (
        ((np.arange(n * SAMPLES) + 0.5) / SAMPLES - 0.5)
        for n in (MODEL.width, MODEL.height)
    )
    rays = (
        undistort(np.stack(np.meshgrid(u, v), axis=-1), MODEL) - [MODEL.cx, MODEL.cy]
    ) / [MODEL.fx, MODEL.fy]
    return rays.reshape(MODEL.height, SAMPLES, MODEL.width, SAMPLES, 2)


def _image(T_camera_board, board, on_wall, rng):
    """A chessboard on a dark board before a grey wall, or on a wall as white as its paper."""
    image = np.full((MODEL.height, MODEL.width), 225.0 if on_wall else 160.0)
    uv = project(
        T_camera_board.apply(
            np.column_stack([board.corners, np.zeros(len(board.corners))])
        ),
        MODEL,
    )
    bounds = uv.min(axis=0) - 3, uv.max(axis=0) + 4
    low, high = (
        np.clip(bound, 0, [MODEL.width, MODEL.height]).astype(int) for bound in bounds
    )
    part = np.s_[low[1] : high[1], low[0] : high[0]]
    back = np.linalg.inv(T_camera_board.as_matrix()[:3, [0, 1, 3]])
    x, y, w = np.moveaxis(_rays()[part[0], :, part[1]] @ back[:, :2].T + back[:, 2], -1, 0)
    image[part] = _face(x / w, y / w, board, image[0, 0], on_wall).mean(axis=(1, 3))
    image = cv2.GaussianBlur(image, (0, 0), 0.6) + rng.normal(0, 1.5, image.shape)
    return np.repeat(np.rint(np.clip(image, 0, 255)).astype(np.uint8)[..., None], 3, axis=2)


def _face(x, y, board, ground, on_wall):
    """Grey values in the plane of the board."""
    inside = np.all([a * x + b * y + c < 0 for a, b, c in board.lines()], axis=0) & (
        not on_wall
    )
    p = board.pattern
    if p is None:
        return np.where(inside, 70.0, ground)
    u = (x - p.origin[0]) / p.square
    v = (y - p.origin[1]) / p.square
    squares = (u >= -1) & (v >= -1) & (u < p.columns) & (v < p.rows)
    paper = (u > -1.25) & (v > -1.25) & (u < p.columns + 0.25) & (v < p.rows + 0.25)
    face = np.where(inside, np.where(paper, 225.0, 70.0), ground)
    return np.where(
        squares, np.where((np.floor(u) + np.floor(v)) % 2 == 0, 25.0, 225.0), face
    )
