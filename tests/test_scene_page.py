"""The page that shows a scene: one file, offline, and a browser draws it."""

import re

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from shared import campaign

from lrfcal_lib.measure.features import length_between
from lrfcal_lib.measure.lengths import features_of_station, for_page, measure, read_picks
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.geometry import DegenerateGeometry
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


@pytest.fixture(scope="module")
def scene(quick):
    """What can be measured in the scene of the small session."""
    session = quick.prepared.session
    return features_of_station(session, quick.rig("joint"), session.scene_placements[0])


@pytest.fixture(scope="module")
def measuring(scene, tmp_path_factory):
    """A page with it."""
    file = tmp_path_factory.mktemp("page") / "scene.html"
    cloud = scene.cloud
    number = scene.planes[0].placement
    data = for_page({number: scene}, {number: RigidTransform.identity()})
    interactive.scene_page(
        file, cloud.points, cloud.colors, cloud.seen, {}, title="A room", measuring=data
    )
    return file


def test_the_browser_computes_what_python_computes(scene, measuring, browser):
    """Lengths and intervals between planes and edges, between points, and the list that it saves."""
    view = browser.new_page()
    view.goto(measuring.as_uri())
    view.wait_for_selector("#measure", state="attached")
    between = "([i, j]) => { const m = measuring.measurer; return m.between(m.feature(i), m.feature(j)) }"
    found = [*scene.planes, *scene.edges]
    rng = np.random.default_rng(0)
    compared = 0
    pairs = [[0, 0], *rng.integers(0, len(found), (150, 2)).tolist()]
    for i, j in pairs:
        told = view.evaluate(between, [i, j])
        try:
            expected = length_between(found[i], found[j])
        except DegenerateGeometry as problem:
            assert told == str(problem)
            continue
        if expected.metres > 0.01 and expected.sigma < 0.1:
            compared += 1
            assert told["length"] == pytest.approx(expected.metres, abs=1e-5)
            assert told["sigma"] == pytest.approx(expected.sigma, rel=1e-2, abs=1e-5)
    assert compared > 20

    seen = np.flatnonzero(scene.cloud.seen)
    numbers = [100, len(seen) - 100]
    for number in numbers:
        place = scene.cloud.points[seen[number]].tolist()
        view.evaluate("([p, n]) => measuring.pick('point', p, 0, n)", [place, number])
    saved = measuring.with_name("picks.csv")
    saved.write_text(view.evaluate("measuring.csv()"))
    view.close()
    told = pd.read_csv(saved).iloc[0]
    expected = measure({1: scene}, read_picks(saved)).iloc[0]
    for column in ("length_m", "low_m", "high_m"):
        assert told[column] == pytest.approx(expected[column], abs=1e-4)


def click_twice(view):
    """Click on points in the middle of a page until two are hit: their length and its interval, mm, as it says."""
    view.click("input[value=point]")
    for x in range(300, 700, 25):
        if view.evaluate("measuring.list.length"):
            break
        view.mouse.move(x, 350)
        view.wait_for_timeout(700)
        view.mouse.click(x, 350)
        view.wait_for_timeout(700)
    return said_on_page(view)


def said_on_page(view):
    """Length and its interval in the only row of the list, mm."""
    row = r"length 1([\d.]+) mm90 %: ([\d.]+) to ([\d.]+)"
    return tuple(map(float, re.fullmatch(row, view.text_content("#lengths")).groups()))


@campaign
@pytest.mark.parametrize("browser", [BY_THE_PROCESSOR], indirect=True, ids=["webgl"])
def test_two_clicks_measure_and_the_wheel_comes_closer_slowly(measuring, browser):
    view = browser.new_page(viewport={"width": 900, "height": 700})
    view.set_default_timeout(280_000)
    view.goto(measuring.as_uri())
    view.wait_for_selector("canvas", state="attached")
    eye = "Object.values(document.getElementById('scene')._fullLayout.scene._scene.getCamera().eye)"
    before = np.array(view.evaluate(eye))
    click_twice(view)
    view.mouse.wheel(0, -300)
    view.wait_for_timeout(1000)
    after = np.array(view.evaluate(eye))
    view.close()
    assert 0.8 < np.linalg.norm(after) / np.linalg.norm(before) < 0.95
