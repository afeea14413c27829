"""Does a calibration still hold: named where a camera or the head has moved, quiet where nothing has."""

from dataclasses import replace

import numpy as np
import pytest
from holds_draws import any_way, changed, erring, on_base, room, true_rig
from shared import campaign

from lrfcal_lib.measure.holds import Answer, holds, passes_of
from lrfcal_lib.report.holds import held_in_words

TURN = np.radians(0.3)
MOVE = 0.008


@pytest.fixture(scope="module")
def seen():
    return room([1, 3], (-15, -4))


def test_an_honest_calibration_holds_and_says_what_it_rests_on(seen):
    held = holds(seen, true_rig(seen))
    assert held.answer is Answer.HOLDS and held.culprit is None
    assert all(wall.bend < 2 * wall.allowed for wall in held.walls)
    words = held_in_words(held)
    assert words[0] == "the calibration: holds"
    assert any("only turns the whole cloud" in line for line in words)


def test_a_turned_camera_is_named(seen):
    held = holds(seen, changed(true_rig(seen), "left", [0.0, TURN, 0.0, 0.0, 0.0, 0.0]))
    assert held.answer is Answer.MOVED and held.culprit.camera == "left"
    assert "camera 'left' has moved: recalibrate" in held_in_words(held)[0]
    np.testing.assert_allclose(held.culprit.change[1], TURN, atol=TURN / 2)


def test_too_little_to_see_is_not_called_holding(seen):
    first = tuple(record for record in seen.image_records if record.camera == "left")[:1]
    rig = true_rig(seen)
    blank = replace(
        seen, scans=seen.scans | {"ranges": np.full_like(seen.scans["ranges"], 3.0)}
    )
    held = holds(replace(blank, image_records=first), rig)
    assert held.answer is Answer.UNKNOWN
    assert "cannot be told here" in held_in_words(held)[0]


@pytest.mark.parametrize("slip", [0.0, np.radians(0.1), -np.radians(0.2)])
def test_two_passes_over_one_place_tell_the_slip_between_them(seen, slip):
    rows = seen.scans["placement"] == 1
    again = {
        key: values[rows] for key, values in seen.scans.items() if len(values) == len(rows)
    }
    down = {key: values[::-1].copy() for key, values in again.items()}
    down["pitch"] += slip
    down["placement"] = np.full(rows.sum(), 2)
    noise = np.random.default_rng(3).normal(0, 0.01, down["ranges"].shape)
    down["ranges"] = down["ranges"] + noise.astype(down["ranges"].dtype)
    both = {key: np.concatenate([again[key], down[key]]) for key in again}
    times = {"time_s": np.arange(2.0 * rows.sum())}
    session = replace(seen, placements=(1, 2), scans=seen.scans | both | times)
    (passes,) = passes_of(session)
    assert abs(passes.slip - slip) < 4 * passes.sigma + np.radians(0.01)


def test_images_of_no_camera_of_the_rig_are_refused(seen):
    with pytest.raises(ValueError, match="no placement has both a sweep and an image"):
        holds(replace(seen, image_records=()), true_rig(seen))


def test_a_rig_that_does_not_know_how_well_it_is_known_is_refused(seen):
    with pytest.raises(ValueError, match="how well the rig is known"):
        holds(seen, replace(true_rig(seen), uncertainty=None))


STATIONS = [(1, 2), (1, 3), (1, 4), (2, 3), (2, 4), (3, 4)]


@campaign
@pytest.mark.parametrize("kind", ["turned", "moved"])
def test_changed_cameras_are_named_in_9_of_10_draws(kind):
    rng = np.random.default_rng(28)
    named = 0
    for draw in range(10):
        session = room(STATIONS[draw % 6], (-15, -4, 7))
        increments = np.zeros(6)
        if kind == "turned":
            increments[:3] = any_way(rng, TURN)
        else:
            increments[3:] = any_way(rng, MOVE)
        camera = ("left", "right")[draw % 2]
        held = holds(session, changed(erring(true_rig(session), rng), camera, increments))
        named += held.culprit is not None and held.culprit.camera == camera
    assert named >= 9


@campaign
def test_a_head_that_slipped_under_cameras_on_the_base_is_named_in_9_of_10_draws():
    rng = np.random.default_rng(29)
    named = 0
    for draw in range(10):
        pitch = (-15, -4)[draw % 2]
        slip = TURN * (-1) ** (draw // 2)
        session = room(STATIONS[draw % 6], (pitch,), slip, "platform")
        rig = erring(on_base(true_rig(session), 1.003 * np.radians(pitch)), rng)
        held = holds(session, rig)
        named += held.culprit is not None and held.culprit.camera is None
    assert named >= 9


@campaign
@pytest.mark.parametrize("mount", ["head", "platform"])
def test_at_most_1_of_20_honest_recordings_is_called_moved(mount):
    rng = np.random.default_rng(30)
    wrong = 0
    for draw in range(10):
        pitches = (-15, -4, 7) if mount == "head" else ((-15, -4)[draw % 2],)
        session = room(STATIONS[draw % 6], pitches, 0.0, mount)
        rig = true_rig(session)
        if mount == "platform":
            rig = on_base(rig, 1.003 * np.radians(pitches[0]))
        wrong += holds(session, erring(rig, rng)).answer is Answer.MOVED
    assert wrong <= 1
