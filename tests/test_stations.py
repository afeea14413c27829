"""Stations in one frame: poses and covariances against simulated rooms, and what is not joined."""

import re
from dataclasses import replace

import numpy as np
import pytest
import rooms
from scipy.spatial.transform import RigidTransform, Rotation
from shared import DATA

from lrfcal_lib.calibrate.cloud import join
from lrfcal_lib.measure.features import flatness, with_sigma
from lrfcal_lib.measure.pose_graph import connected, solved
from lrfcal_lib.measure.scene import colored_blocks
from lrfcal_lib.measure.stations import (
    Pair,
    _joined,
    advice,
    alone,
    join_stations,
    joined_cloud,
)
from lrfcal_lib.model.problem import ProblemKind
from lrfcal_lib.report import merge
from lrfcal_lib.report.reconstruct import SceneAsked
from lrfcal_lib.session.read import open_session
from lrfcal_lib.session.shown import escape
from lrfcal_lib.simulate.scene import World

IN_PLACE = RigidTransform.identity()
STEP = 0.5  # deg, half of what the rig can do: quick
ROOMS = [71, pytest.param(72, marks=pytest.mark.campaign), pytest.param(73, marks=pytest.mark.campaign)]  # fmt: skip


def pose(x, y, yaw):
    turn = Rotation.from_euler("z", yaw, degrees=True)
    return RigidTransform.from_components([x, y, 0.0], turn)


PLACES = {1: pose(0, 0, 0), 2: pose(1, 0, 20), 3: pose(0, 1, -15), 4: pose(1, 1, 30)}


def pair_of(first, second, off=None):
    """A Pair of two of PLACES, or off by a turn and a shift."""
    T = PLACES[first].inv() * PLACES[second]
    step = np.zeros(6) if off is None else np.array(off)
    turn = Rotation.from_rotvec(step[:3]) * T.rotation
    T = RigidTransform.from_components(T.translation + step[3:], turn)
    along = np.array([1.0, 0.0, 0.0])
    return Pair(
        first, second, T, 1e-6 * np.eye(6), np.zeros((6, 13)), 0.7, 0.005, along, 0.1
    )


def joined_of(pairs):
    return _joined(sorted(PLACES), list(pairs), [], np.zeros((13, 13)))


def test_noise_free_pairs_give_the_poses_and_close_every_loop():
    pairs = [pair_of(*names) for names in ((1, 2), (3, 2), (3, 4), (1, 3))]
    joined = joined_of(pairs)
    for number, T in joined.T_world_station.items():
        np.testing.assert_allclose(T.as_matrix(), PLACES[number].as_matrix(), atol=1e-9)
    assert all(max(joined.miss(pair)) < 1e-9 for pair in pairs)
    assert joined.problems == ()


def test_poses_answer_a_change_of_a_pair_as_stated():
    names = ((1, 2), (2, 3), (3, 4), (1, 3), (1, 4))
    pairs = [pair_of(*each) for each in names]
    _, response = solved(pairs, connected(pairs, 1))
    assert response.shape == (4, 6, 30) and np.all(response[0] == 0)
    step = 1e-4 * np.random.default_rng(5).standard_normal(6)
    changed = [pair_of(*each, off=step if each == (1, 4) else None) for each in names]
    poses, _ = solved(changed, connected(changed, 1))
    for i, number in enumerate(PLACES):
        turn = (poses[number].rotation * PLACES[number].rotation.inv()).as_rotvec()
        shift = poses[number].translation - PLACES[number].translation
        expected = response[i, :, 24:] @ step
        np.testing.assert_allclose([*turn, *shift], expected, atol=2e-8)


def test_a_wrong_pair_among_loops_is_named_and_not_used():
    good = [pair_of(*names) for names in ((1, 2), (2, 3), (3, 4), (1, 3), (2, 4))]
    joined = joined_of([*good, pair_of(1, 4, off=[0, 0, 0.5, 0.3, 0, 0])])
    assert [(p.first, p.second) for p in joined.pairs] == [(1, 2), (2, 3), (3, 4), (1, 3), (2, 4)]  # fmt: skip
    (problem,) = joined.problems
    assert problem.kind is ProblemKind.CONTRADICTS
    assert str(problem).startswith("stations 1 and 4: the loops through them miss by")
    np.testing.assert_allclose(
        joined.T_world_station[4].as_matrix(), PLACES[4].as_matrix(), atol=1e-9
    )


def test_stations_that_nothing_joins_are_left_out_by_name():
    joined = joined_of([pair_of(2, 3), pair_of(3, 4), pair_of(2, 4)])
    assert list(joined.T_world_station) == [2, 3, 4]  # world: station 2
    assert "station 1 is left out" in str(joined.problems[0])
    assert "Some stations are left out" in advice(joined)[0]


def test_pairs_that_nothing_checks_are_advised():
    joined = joined_of([pair_of(1, 2), pair_of(2, 3), pair_of(1, 3), pair_of(3, 4)])
    (sentence,) = advice(joined)
    assert sentence.startswith("Nothing checks how stations 3 and 4 lie")


def test_pairs_lead_from_any_station():
    poses = connected([pair_of(1, 2), pair_of(2, 4)], 4)
    assert list(poses) == [4, 1, 2]
    T = poses[1].inv() * poses[2]
    np.testing.assert_allclose(
        T.as_matrix(), (PLACES[1].inv() * PLACES[2]).as_matrix(), atol=1e-12
    )


@pytest.fixture(scope="module")
def rig(quick):
    """The calibrated rig of sim_quick, which is that of the simulated rooms."""
    rig = quick.rig("joint")
    return replace(rig, corrections=replace(rig.corrections, sweeps={}))


def gauge(rig):
    """A turn about the tilt axis and a shift along it, true frame from calibrated one: no data show them."""
    setup = rooms.SETUP
    off = setup.rig.T_head_lrf * rig.T_head_lrf.inv()
    rng = np.random.default_rng(0)
    true, recorded = setup.rig.platform.stop(np.radians(np.arange(-38, 24, 0.5)), 1, rng)
    turn = off.rotation.as_rotvec()[0]
    turn += np.mean(true - rig.corrections.pitch(0, recorded))
    shift = [off.translation[0], 0.0, 0.0]
    return RigidTransform.from_components(shift, Rotation.from_rotvec([turn, 0.0, 0.0]))


def misses(joined, stations, G):
    """Of every station but the first: turn and shift off the truth, and their sigmas."""
    first, *others = joined.T_world_station
    for number in others:
        true = (stations[first] * G).inv() * stations[number] * G
        T = joined.T_world_station[number]
        variance = np.diag(joined.covariance[number])
        turn = (T.rotation * true.rotation.inv()).magnitude()
        shift = np.linalg.norm(T.translation - true.translation)
        yield turn, shift, np.sqrt(variance[:3].sum()), np.sqrt(variance[3:].sum())


@pytest.mark.parametrize("seed", ROOMS)
def test_four_stations_of_a_room_nobody_tuned_on(seed):
    rng = np.random.default_rng(seed)
    world, half = rooms.furnished_at_random(rng)
    stations = rooms.around(rng, half)
    clouds = {
        n: rooms.scanned(world, T, rng, number=n, step=STEP) for n, T in stations.items()
    }
    joined = join_stations(clouds)
    assert len(joined.T_world_station) == 4
    for turn, shift, turn_sigma, shift_sigma in misses(joined, stations, IN_PLACE):
        assert shift < max(0.0025, 2 * shift_sigma) and shift < 0.01
        assert turn < max(np.radians(0.05), 2 * turn_sigma) and turn < np.radians(0.2)
    cloud = joined_cloud(clouds, joined)
    points = stations[1].apply(cloud.points)
    away = world._scene.compute_distance(points.astype(np.float32)).numpy()
    assert np.median(away) < 0.0055  # each range has 10 mm of noise
    normals = stations[1].rotation.apply(cloud.normals)
    for axis, side in ((0, half[0]), (1, half[1])):
        for wall in (-side, side):
            near = np.abs(points[:, axis] - wall) < 0.05
            near &= np.abs(normals[:, axis]) > 0.97
            if near.sum() > 2000:
                assert flatness(points[near])[1] < 0.003


def test_covariances_know_what_the_calibration_may_have_wrong(rig):
    """Four placements know little: poses are off by more than their noise, as is said of them."""
    rng = np.random.default_rng(71)
    world, half = rooms.furnished_at_random(rng)
    stations = {n: T for n, T in rooms.around(rng, half).items() if n < 3}
    clouds = {}
    for number, T in stations.items():
        cloud = rooms.scanned(world, T, rng, number=number, step=STEP, rig=rig)
        clouds[number] = with_sigma(cloud, rig)
    joined = join_stations(clouds, rig)
    ((turn, shift, turn_sigma, shift_sigma),) = misses(joined, stations, gauge(rig))
    assert turn < 3 * turn_sigma and shift < 3 * shift_sigma
    noise = np.sqrt(np.trace(joined.pairs[0].covariance[3:, 3:]))
    assert shift_sigma > 1.5 * noise
    # the joined cloud's points are known as well as their stations at best
    sigma = joined_cloud(clouds, joined).sigma
    before = np.concatenate([cloud.sigma for cloud in clouds.values()])
    assert np.all(sigma >= before) and np.all(
        sigma[: len(clouds[1].sigma)] == clouds[1].sigma
    )


def corridor():
    """Two walls, floor and ceiling, whose ends nothing sees."""
    return World(rooms.shell(1.8, 60.0, 2.5)), {1: (0, 0), 2: (0, 0.8)}, (0, 0)


def empty_square():
    """A square room with nothing in it: four turns are alike."""
    return World(rooms.shell(4.0, 4.0, 2.5)), {1: (0, 0), 2: (0.3, 0.2)}, (45, 65)


def back_to_back():
    """Two stations in a furnished room that look away from each other."""
    world, _ = rooms.furnished_at_random(np.random.default_rng(3))
    return world, {1: (0, -0.3), 2: (0, 0.3)}, (180, 0)


@pytest.mark.parametrize(("make", "words"), [
    (corridor, "a corridor|in two ways"),
    (empty_square, "in two ways"),
    (back_to_back, "do not overlap enough"),
])  # fmt: skip
def test_what_cannot_be_told_is_refused_with_the_cause(make, words):
    world, places, yaws = make()
    rng = np.random.default_rng(11)
    clouds = {}
    for (number, place), yaw in zip(places.items(), yaws, strict=True):
        T = rooms.pose(rng, place, yaw)
        clouds[number] = rooms.scanned(world, T, rng, number=number, step=STEP)
    joined = join_stations(clouds)
    assert len(joined.T_world_station) == 1 and joined.pairs == ()
    assert re.search(words, str(joined.problems[0]))
    assert str(joined.problems[0]).startswith("stations 1 and 2: ")


@pytest.mark.campaign
def test_no_pair_is_joined_wrongly():
    """50 rooms, three stations anywhere in each, looking anywhere: what is joined is right."""
    count = 0
    for seed in range(6000, 6050):
        rng = np.random.default_rng(seed)
        world, half = rooms.furnished_at_random(rng)
        stations = {
            k: rooms.pose(rng, rng.uniform(-0.5, 0.5, 2) * half, rng.uniform(0, 360))
            for k in (1, 2, 3)
        }
        clouds = {
            k: rooms.scanned(world, T, rng, number=k, step=STEP)
            for k, T in stations.items()
        }
        try:
            joined = join_stations(clouds)
        except ValueError:  # in a cupboard
            continue
        for pair in joined.pairs:
            count += 1
            true = stations[pair.first].inv() * stations[pair.second]
            off = true.inv() * pair.T_first_second
            assert np.linalg.norm(off.translation) < 0.04, (seed, pair)
            assert off.rotation.magnitude() < np.radians(1.0), (seed, pair)
    assert count > 20


def test_bad_input():
    with pytest.raises(ValueError, match="1 station: two or more are needed"):
        join_stations({1: rooms.scanned(*corridor_cloud())})
    empty = rooms.scanned(*corridor_cloud())
    rough = replace(empty, normals=np.full_like(empty.normals, np.nan))
    with pytest.raises(ValueError, match="station 2: no part of the cloud is a smooth"):
        join_stations({1: empty, 2: rough})


def corridor_cloud():
    world, places, _ = corridor()
    rng = np.random.default_rng(0)
    return world, rooms.pose(rng, places[1], 0), rng


def test_merge_writes_one_cloud_and_a_page(tmp_path, rig, monkeypatch, capsys):
    room = DATA / "room_lms221"
    foreign = replace(rig, session="<b>bold</b> & $x$")
    asked = SceneAsked(open_session(room), foreign, (1, 3), tmp_path)
    monkeypatch.setattr(merge, "station_cloud", grey_cloud)
    monkeypatch.setattr(merge, "open_scene", lambda *scene: asked)
    monkeypatch.setattr(
        merge, "write_scene", lambda folder, *rest, **clouds: [folder / "scene.ply"]
    )
    assert merge.merge_session(room, "calibration.json", tmp_path) == 0
    said = capsys.readouterr().out
    assert "platform frame of station 1" in said
    assert "Nothing checks how stations 1 and 3 lie" in said
    page = (tmp_path / "stations.html").read_text()
    assert "UNTRUSTED" not in page and escape(asked.about) in page
    assert "<b>" not in page and "<b>bold</b>" in asked.about
    for words in (
        "Nothing checks how stations 1 and 3 lie",
        "<td>1 and 3</td>",
        "image/png",
    ):
        assert words in page
    monkeypatch.setattr(merge, "join_stations", lambda clouds, rig: lonely())
    with pytest.raises(ValueError, match="room_lms221: no two stations can be joined"):
        merge.merge_session(room, "calibration.json")


def grey_cloud(session, rig, number):
    """A station without its images, which another rig took."""
    return with_sigma(join(colored_blocks(session, rig, session.sweep(number), [])), rig)


def lonely():
    return alone(1)
