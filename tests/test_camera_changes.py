"""A camera that moves or zooms half-way is named, with placement and size; no steady one is."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from joint_draws import draw, rng
from scipy.spatial.transform import RigidTransform, Rotation
from shared import campaign

from lrfcal_lib.fit.result import PlatformPrior
from lrfcal_lib.judge.camera_changes import (
    LEAST_SIZE,
    Step,
    camera_changes,
    largest_motion,
    likeliest_step,
)
from lrfcal_lib.judge.recording_faults import faults_of_changes
from lrfcal_lib.preprocess.prepared import Prepared
from lrfcal_lib.solvers.joint import solve_joint

SENSOR = ("range_offset", "edge_log_odds", "edge_log_softness", "pitch_scale")
FIRST = 7  # row of the placements from which on something is changed


def drawn(seed, count=14, **settings):
    """Observations of a sound recording, what solves them, and what is known of the cameras."""
    obs, _, rig = draw(rng(seed), count, pitch_step=np.radians(2.0), **settings)
    prior = PlatformPrior(rig.T_head_lrf, np.radians(3.0), 0.03)
    settings = {
        "sensor": SENSOR,
        "noise": "estimate",
        "lapse": 0.01,
        "sides": True,
        "axis": True,
    }
    models = dict.fromkeys(rig.cameras, rig.model)
    prepared = Prepared(
        session=None,
        board=SimpleNamespace(pattern=None),
        scans={},
        models=models,
        views={camera: {} for camera in models},
    )
    return obs, settings | {"prior": prior}, prepared


def changed(obs, cameras=(0,), turn_deg=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0), growth=0.0):
    """Observations with cameras (by index) that are turned, shifted or magnify more later."""
    pose = obs.view_pose.copy()
    later = np.isin(obs.view_camera, cameras) & (obs.view_placement >= FIRST)
    turn = Rotation.from_rotvec(turn_deg, degrees=True)
    pose[later] = RigidTransform.from_components(shift, turn).as_matrix() @ pose[later]
    pose[later, 2, 3] /= 1 + growth
    return replace(obs, view_pose=pose)


def found_in(obs, settings, prepared):
    return camera_changes(solve_joint(obs, required=False, **settings), prepared, settings)


@pytest.mark.parametrize(
    ("seed", "mount", "turn_deg", "shift"),
    [
        (7, "head", [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]),
        pytest.param(8, "platform", [0.0, 0.0, 0.0], [0.03, 0.0, 0.0], marks=campaign),
        pytest.param(9, "head", [0.1, -0.2, 0.0], [0.0, 0.0, 0.0], marks=campaign),
        pytest.param(10, "platform", [0.5, 0.0, 2.0], [0.01, 0.02, -0.01], marks=campaign),
    ],
)
def test_a_camera_that_is_knocked_is_named_with_its_size(seed, mount, turn_deg, shift):
    obs, settings, prepared = drawn(seed, mount=mount)
    (change,) = found_in(changed(obs, turn_deg=turn_deg, shift=shift), settings, prepared)
    assert (change.camera, change.after) == ("left", obs.placements[FIRST])
    assert change.moved and not change.zoomed
    turn = np.radians(np.linalg.norm(turn_deg))
    assert change.turn == pytest.approx(turn, abs=np.radians(0.1))
    (fault,) = faults_of_changes([change], obs.cameras)
    for words in (
        "camera 'left' was moved",
        f"placement {change.after}",
        "px in its images",
        "record anew",
    ):
        assert words in fault.words
    assert (fault.kind, fault.camera, fault.placements) == (
        "camera moved",
        "left",
        (change.after,),
    )


@pytest.mark.parametrize(
    ("seed", "mount", "growth"),
    [(7, "platform", 0.05), pytest.param(8, "head", -0.04, marks=campaign)],
)
def test_a_camera_that_zooms_is_named_with_its_size(seed, mount, growth):
    obs, settings, prepared = drawn(seed, mount=mount)
    (change,) = found_in(changed(obs, (1,), growth=growth), settings, prepared)
    assert (change.camera, change.after, change.zoomed) == (
        "right",
        obs.placements[FIRST],
        True,
    )
    assert change.zoom == pytest.approx(growth, abs=0.25 * abs(growth))
    (fault,) = faults_of_changes([change], obs.cameras)
    assert (
        fault.kind == "camera zoomed"
        and ("larger" if growth > 0 else "smaller") in fault.words
    )


@campaign
def test_where_all_cameras_change_at_once_it_may_be_the_range_finder():
    obs, settings, prepared = drawn(7)
    both = found_in(changed(obs, (0, 1), turn_deg=[0.0, 1.0, 0.0]), settings, prepared)
    assert {change.camera for change in both} == {"left", "right"}
    assert all(
        "range finder" in fault.words for fault in faults_of_changes(both, obs.cameras)
    )


@campaign
def test_the_only_camera_is_judged_by_the_scans():
    obs, settings, prepared = drawn(7, cameras=("left",), count=18)
    (change,) = found_in(
        changed(obs, turn_deg=[0.0, 2.0, 0.0], shift=[0.02, 0.0, 0.0]), settings, prepared
    )
    assert (change.camera, change.after) == ("left", obs.placements[FIRST])


def ordered(obs):
    """The same recording, the board carried from near to far: what is off looks like a drift."""
    places = range(len(obs.placements))
    distance = [np.median(obs.face_range[obs.face_placement == place]) for place in places]
    order = np.argsort(distance)
    rank = np.argsort(order)
    moved = {
        f"{group}_placement": rank[getattr(obs, f"{group}_placement")]
        for group in ("face", "beam", "view")
    }
    return replace(obs, **moved, direction=obs.direction[order], middle=obs.middle[order])


@pytest.mark.parametrize(
    "order", [lambda obs: obs, ordered], ids=["as drawn", "near to far"]
)
@pytest.mark.parametrize(
    "seed", [21, *(pytest.param(seed, marks=campaign) for seed in range(100, 120))]
)
def test_steady_cameras_are_not_accused(seed, order):
    mount = ("head", "platform")[seed % 2]
    obs, settings, _ = drawn(seed, (8, 12, 16, 20)[seed % 4], mount=mount)
    assert likeliest_step(solve_joint(order(obs), required=False, **settings)) is None


def test_too_few_placements_say_nothing():
    obs, settings, _ = drawn(7, 3)
    assert likeliest_step(solve_joint(obs, required=False, **settings)) is None


def test_a_step_that_moves_no_board_in_the_images_needs_no_other_estimate(monkeypatch):
    """Errors of the intrinsics look like one of a third of a pixel, as in data/sim_lms221."""
    obs, settings, prepared = drawn(7)
    solution = solve_joint(
        changed(obs, turn_deg=(0.02, 0.0, 0.0)), required=False, **settings
    )
    step = Step(
        camera=0, row=FIRST, p_value=0.0, change=np.array([0.0, 3e-4, 0.0, 0.0, 0.0, 0.0])
    )
    assert 0.1 < largest_motion(solution, step, prepared.models["left"]) < LEAST_SIZE
    monkeypatch.setattr("lrfcal_lib.judge.camera_changes.likeliest_step", lambda _: step)
    monkeypatch.setattr("lrfcal_lib.judge.camera_changes.solve_joint", None)
    assert camera_changes(solution, prepared, settings) == []
