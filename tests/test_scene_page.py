"""The page that shows a scene: one file, offline, and a browser draws it."""

import re

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from shared import campaign

from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.plots import interactive

BY_THE_PROCESSOR = [
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]


def page(folder, count=2000):
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, 2, -1], [1, 3, 1], (count, 3))
    camera = RigidTransform.from_rotation(
        Rotation.from_matrix([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    )
    boards = {"board 1": np.array([[0, 2.5, 0], [0.3, 2.5, 0], [0, 2.5, 0.4]])}
    views = {"left": (camera, CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5))}
    lines = interactive.rig_lines(RigidTransform.identity(), views, boards)
    colors = np.tile(np.uint8([230, 20, 20]), (count, 1))
    interactive.scene_page(folder / "scene.html", points, colors, points[:, 0] < 0.8, lines)
    return folder / "scene.html"


def test_the_page_holds_everything_itself(tmp_path):
    text = page(tmp_path).read_text()
    shown = (
        "points",
        "points that no image saw",
        "tilt axis",
        "view of left",
        "boards",
        "x of lrf, left",
    )
    assert all(f'"name":"{name}"' in text for name in shown)
    assert not re.search(r"<(script|link)[^>]+(src|href)=", text), (
        "nothing comes from the network"
    )


@campaign
@pytest.mark.parametrize("browser", [BY_THE_PROCESSOR], indirect=True, ids=["webgl"])
def test_a_browser_draws_it(tmp_path, browser):
    view = browser.new_page(viewport={"width": 900, "height": 700})
    view.set_default_timeout(280_000)
    view.goto(page(tmp_path).as_uri())
    view.wait_for_selector("canvas", state="attached")
    view.wait_for_timeout(1000)
    blue, green, red = (
        cv2.imdecode(np.frombuffer(view.screenshot(), np.uint8), 1)
        .astype(int)
        .transpose(2, 0, 1)
    )
    view.close()
    assert ((red > 180) & (green < 80) & (blue < 80)).sum() > 500, (
        "no red points in the picture"
    )
    assert len(np.unique(np.stack([blue, green, red], -1).reshape(-1, 3), axis=0)) > 50
