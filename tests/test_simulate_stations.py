"""The simulated room from several stations, and the lengths in it."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from shared import DATA

from lrfcal_lib.evaluate.truth import read_truth
from lrfcal_lib.session.lms2xx_codec import largest
from lrfcal_lib.session.read import open_session
from lrfcal_lib.simulate import lengths, record
from lrfcal_lib.simulate.rig import Placement, load_setup
from lrfcal_lib.simulate.scene import furnished_room

ROOM = DATA / "room_lms221"
SETUP = load_setup("room_lms221")


@pytest.fixture(scope="module")
def session():
    return open_session(ROOM)


def test_a_session_of_scenes_only_is_whole(session):
    assert session.board_placements == ()
    assert session.scene_placements == (1, 2, 3, 4)
    for placement in session.scene_placements:
        for camera in session.cameras:
            pitch = [r.pitch for r in session.images(camera, placement)]
            assert len(pitch) == 5 and np.ptp(pitch) > np.radians(40)


def test_the_sweep_of_a_station_is_rebuilt(session):
    placement = record.placements_of(SETUP)[2]
    made = record.sweep_of(SETUP, placement)
    shipped = session.sweep(3).ranges
    made = np.where(made > largest(0), np.nan, made * 0.001)
    np.testing.assert_array_equal(np.isnan(made), np.isnan(shipped))
    off = np.nan_to_num(np.abs(made - shipped))
    assert off.max() < 0.0011 and np.mean(off > 0) < 1e-3


def test_the_rig_is_that_of_the_calibrated_session():
    room, calibrated = (
        json.loads((DATA / name / "truth.json").read_text())
        for name in ("room_lms221", "sim_lms221")
    )
    for part in ("T_head_lrf", "cameras", "board", "lrf", "platform"):
        assert room[part] == calibrated[part]
    assert room["seed"] != calibrated["seed"]


def test_stations_are_as_far_apart_as_the_data_card_says(session):
    stations = read_truth(session).stations
    assert list(stations) == [1, 2, 3, 4]
    for i, first in stations.items():
        for second in (stations[k] for k in stations if k > i):
            apart = first.inv() * second
            assert 0.5 < np.linalg.norm(apart.translation) < 1.2
            assert 14.5 < np.degrees(apart.rotation.magnitude()) < 47.5


def test_a_world_seen_from_elsewhere_is_the_same_world():
    room = furnished_room()
    turn = Rotation.from_rotvec([2, -3, 40], degrees=True)
    T_room_platform = RigidTransform.from_components([0.5, -0.3, 0.1], turn)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    there = room.seen_from(T_room_platform)
    origin = np.zeros((500, 3))
    moved = turn.apply(directions)
    expected = room.cast(T_room_platform.apply(origin), moved)
    hits = there.cast(origin, directions)
    # an edge in single precision may go either way
    same = np.vecdot(turn.apply(hits.normal), expected.normal) > 1 - 1e-9
    same &= hits.thing == expected.thing
    assert same.mean() > 0.99
    np.testing.assert_allclose(hits.distance[same], expected.distance[same], atol=1e-6)
    light = there.radiance(hits)
    np.testing.assert_allclose(
        light[same],
        room.radiance(expected)[same],
        atol=1e-3,
    )


def test_ends_of_lengths_lie_on_things_of_the_room():
    truth = json.loads((ROOM / "truth.json").read_text())["lengths"]
    for stored, computed in zip(truth, lengths.room_lengths(), strict=True):
        assert stored["name"] == computed["name"] and stored["kind"] == computed["kind"]
        # to the last digit only on one machine: another LAPACK rounds the SVD in another way
        assert stored["metres"] == pytest.approx(computed["metres"], abs=1e-12)
        np.testing.assert_allclose(stored["ends"], computed["ends"], rtol=0, atol=1e-12)
    assert [row["kind"] for row in truth].count("edge-edge") == 10 and len(truth) == 20
    assert len({row["name"] for row in truth}) == 20
    room = record.world_of(SETUP, Placement(0))
    for row in truth:
        assert 0.01 < row["metres"] < 6.5
        for corners in map(np.array, row["ends"]):
            assert len(corners) == {"plane-plane": 4, "edge-edge": 2}[row["kind"]]
            away = room._scene.compute_distance(corners.astype(np.float32)).numpy()
            assert away.max() < 1e-5


@pytest.mark.parametrize(("row", "message"), [
    ({"name": "a", "ends": [["shell", 0, "+z"], ["shell", 2, "+z"]]}, "'a': its ends are not parallel"),
    ({"name": "b", "ends": [["fittings", 1, "+z"], ["shell", 2, "+z"]]}, "fittings 1 is a sphere"),
])  # fmt: skip
def test_ends_that_are_no_faces_are_refused(monkeypatch, row, message):
    monkeypatch.setattr(lengths, "LENGTHS", [row | {"kind": "plane-plane"}])
    with pytest.raises(ValueError, match=message):
        lengths.room_lengths()
