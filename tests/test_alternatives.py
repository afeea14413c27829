"""Statements that contradict the data are named, with the size of the error; honest ones are not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from joint_draws import MOUNTS, draw, rng

from lrfcal_lib.evaluate.alternatives import ALTERNATIVES, doubtful, far_from_stated, places_of_cameras, weigh
from lrfcal_lib.solvers.joint import solve_joint

ADMITTED = 0.025
SENSOR = ("range_offset", "edge_log_odds", "edge_log_softness", "pitch_scale")


def solved(seed, change=lambda obs: obs, **settings):
    obs, _, rig = draw(rng(seed), 12, **settings)
    return solve_joint(change(obs), rig.T_head_lrf, sensor=SENSOR, noise="estimate", required=False)


@MOUNTS
def test_honest_statements_are_not_doubted(mount):
    scores = []
    for seed in range(6):
        found = solved(seed, mount=mount)
        assert doubtful(found, ADMITTED) == []
        scores += [doubt.value / doubt.sigma for doubt in weigh(found, ADMITTED)]
    assert np.sqrt(np.mean(np.square(scores))) < 1.4 and np.max(np.abs(scores)) < 4.0


@MOUNTS
@pytest.mark.parametrize(
    ("kind", "value"),
    [("squares", 0.02), ("squares", -0.05), ("outline", 0.03), ("ranges", 0.02), ("ranges", -0.05),
     ("bearings", 0.02)],
)  # fmt: skip
def test_a_wrong_statement_is_named_with_its_size(mount, kind, value):
    doubts = doubtful(solved(5, lambda obs: ALTERNATIVES[kind].change(obs, value), mount=mount), ADMITTED)
    assert kind in [doubt.kind for doubt in doubts]
    found = next(doubt for doubt in doubts if doubt.kind == kind)
    assert found.value == pytest.approx(-value, abs=0.25 * abs(value) + 3 * found.sigma)
    assert ALTERNATIVES[kind].remedy in found.words and ALTERNATIVES[kind].signs[int(value > 0)] in found.words


def mirrored(obs):
    return replace(obs, face_bearing=np.pi - obs.face_bearing, beam_bearing=np.pi - obs.beam_bearing)


def reversed_pitch(obs):
    return replace(obs, **{name: -getattr(obs, name) for name in ("face_pitch", "beam_pitch", "view_pitch", "middle")})


@pytest.mark.parametrize(
    ("change", "far", "angle"),
    [(lambda obs: obs, [], 0), (mirrored, ["axis", "'left'"], 180), (reversed_pitch, ["axis"], 180)],
)
def test_what_only_the_statement_of_the_rig_can_tell(change, far, angle):
    obs, _, rig = draw(rng(2), 12, mount="head", cameras=("left",))
    solution = solve_joint(change(obs), sensor=SENSOR, noise="estimate", required=False)
    cameras = {"left": SimpleNamespace(guess=rig.cameras["left"])}
    session = SimpleNamespace(T_head_lrf=rig.T_head_lrf, platform_sigma=(np.radians(3.0), 0.03), cameras=cameras)
    joint = SimpleNamespace(prepared=SimpleNamespace(session=session), solution=solution, settings={"axis": True})
    found = far_from_stated(joint)
    assert len(found) == len(far)
    for name, (words, turn) in zip(far, found, strict=True):
        assert name in words and "bearings or pitch of the other sense" in words
        assert np.degrees(turn) == pytest.approx(angle, abs=5)
    assert "camera 'left' sits" in places_of_cameras(solution)[0]
