"""Boards that look the same when turned: one turn for all images of a placement."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from rendered_boards import surveyed
from scipy.spatial.transform import RigidTransform, Rotation
from tiny_sessions import CAMERAS, MODEL, record, rectangle

from lrfcal_lib.model.camera import project
from lrfcal_lib.session.read import ImageRecord, open_session
from lrfcal_lib.session.stated import TransformStated, from_json

HALF = Rotation.from_rotvec([0, 0, np.pi])


@pytest.fixture(scope="module")
def centred(tmp_path_factory):
    return open_session(
        record(
            tmp_path_factory.mktemp("turns") / "centred",
            rectangle(),
            3,
            placements=3,
            image_pitch_deg=(-4.0, -1.0),
        )
    )


@pytest.mark.parametrize(
    "stated", [True, False], ids=["outline stated", "outline measured"]
)
def test_a_centred_chessboard_is_turned_alike_in_all_images_of_a_placement(centred, stated):
    board = centred.board if stated else replace(centred.board, corners=None)
    found = surveyed(replace(centred, board=board))
    truth = json.loads((centred.path / "truth.json").read_text())["images"]
    turns = {}
    for view in (
        v for views in found.views.values() for v in views.values() if not v.reason
    ):
        true = from_json(
            TransformStated, truth[f"images/{view.camera}/{view.file}"]["T_camera_board"]
        )
        turns.setdefault(view.placement, []).append(
            true.rotation.inv() * view.T_camera_board.rotation
        )
    for number, own in turns.items():
        assert len(own) == 2
        assert max((own[0].inv() * turn).magnitude() for turn in own) < 0.1, (
            f"placement {number}"
        )
        # a stated frame is the board's, as it is or turned by half a turn, never seen from behind
        assert not stated or min(own[0].magnitude(), (own[0] * HALF).magnitude()) < 0.1


def test_a_plain_rectangle_is_turned_alike_in_both_cameras():
    board = replace(rectangle(), pattern=None)
    rng = np.random.default_rng(1)
    pictures = {}
    true = {}
    beside = CAMERAS["right"] * CAMERAS["left"].inv()
    for placement in range(6):
        turn = Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]) * Rotation.from_rotvec(
            [*rng.uniform(-0.6, 0.6, 2), 0]
        )
        turn = turn * Rotation.from_euler("x", np.pi)  # z of the board faces the cameras
        pose = RigidTransform.from_components(
            [0.1, 0, 1.2] - turn.apply([*board.corners.mean(axis=0), 0.0]), turn
        )
        for camera, seen in {"left": pose, "right": beside * pose}.items():
            uv = project(seen.apply(np.column_stack([board.corners, np.zeros(4)])), MODEL)
            picture = np.full((MODEL.height, MODEL.width), 170, np.uint8)
            cv2.fillConvexPoly(
                picture, np.rint(uv * 256).astype(np.int32), 35, cv2.LINE_AA, 8
            )
            pictures[f"{camera}{placement}"] = cv2.GaussianBlur(picture, (0, 0), 0.7)
            true[camera, placement] = seen.rotation
    records = [
        ImageRecord(n[:-1], Path(n), int(n[-1]), 0.0, 0.0, "board") for n in pictures
    ]
    session = SimpleNamespace(
        image_records=records,
        read_image=lambda r: pictures[r.file.name],
        board=board,
        cameras=dict.fromkeys(CAMERAS, SimpleNamespace(model=MODEL)),
        picks=(),
    )
    views = surveyed(session).views
    off = [
        [true[c, v.placement].inv() * v.T_camera_board.rotation for v in views[c].values()]
        for c in CAMERAS
    ]
    assert max((a.inv() * b).magnitude() for a, b in zip(*off, strict=True)) < 0.1
