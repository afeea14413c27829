"""The joint estimate on recordings that cannot work: a name for what is wrong, never a plausible wrong number."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from joint_draws import MOUNTS, draw, rng, scores, square_per_number
from scipy.spatial.transform import RigidTransform, Rotation
from shared import campaign

from lrfcal_lib.calibrate.rig import joint_rig
from lrfcal_lib.judge.uncertainty import chain_of, projection_sigma, root_mean_square
from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.solvers.joint import solve_joint

FACING = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


def worst(found, truth):
    """Largest error of axis and cameras in the solver's own standard deviations."""
    return np.abs(scores(found, truth))[: 4 + 6 * len(found.transforms)].max()


def parallel_boards(rng, count, spin=True):
    """Boards that all lean the same way, at different places and turned within their plane."""
    poses = []
    for _ in range(count):
        turn = (
            FACING
            * Rotation.from_rotvec([0.2, 0.1, 0])
            * Rotation.from_rotvec([0, 0, spin * rng.uniform(0, 6.28)])
        )
        centre = np.array(
            [rng.uniform(-0.35, 0.35), 1.0, rng.uniform(-0.1, 0.1)]
        ) * rng.uniform(1, 2.5)
        poses.append(
            RigidTransform.from_components(centre - turn.apply([0.105, 0.127, 0.0]), turn)
        )
    return poses


def one_pose(rng, count):
    return parallel_boards(rng, 1) * count


def mislabelled(obs, share, rng):
    """Images of some placements under the numbers of others."""
    count = len(obs.placements)
    who = rng.permutation(count)[: round(share * count)]
    number = np.arange(count)
    number[who] = np.roll(who, 1)
    return replace(obs, view_placement=number[obs.view_placement])


@pytest.mark.parametrize(
    ("mount", "lean"), [("head", parallel_boards), ("platform", one_pose)]
)
def test_parallel_boards_are_named(mount, lean):
    obs, *_ = draw(rng(), mount=mount, lean=lean)
    with pytest.raises(DegenerateGeometry, match="tilt the board in both directions"):
        solve_joint(obs)


@pytest.mark.parametrize(("mount", "share"), [("head", 0.1), ("platform", 0.2)])
def test_some_mislabelled_placements_are_left_out_by_name(mount, share):
    obs, truth, _ = draw(rng(), 20, mount=mount)
    wrong = mislabelled(obs, share, rng())
    moved = np.unique(
        obs.placements[obs.view_placement[obs.view_placement != wrong.view_placement]]
    )
    found = solve_joint(wrong)
    assert set(found.excluded_placements) == set(moved.tolist()) and len(
        found.excluded
    ) == len(moved)
    assert all(
        "off where its image puts the board; left out" in str(one) for one in found.excluded
    )
    assert worst(found, truth) < 4.5


@pytest.mark.parametrize(
    ("mount", "share", "seed"),
    [("head", 1.0, 3), *(pytest.param(m, s, n, marks=campaign) for m, s, n in (
        ("platform", 0.5, 4), ("head", 0.5, 5), ("head", 0.5, 9), ("platform", 0.5, 9), ("platform", 1.0, 5)))],
)  # fmt: skip
def test_many_mislabelled_placements_are_refused(mount, share, seed):
    obs, *_ = draw(rng(seed), 20, mount=mount)
    with pytest.raises(DegenerateGeometry, match="contradict .*right numbers"):
        solve_joint(mislabelled(obs, share, rng(seed)))


@lru_cache
def honest(mount):
    """Sigmas of the axis where the noise is stated as it is."""
    return solve_joint(draw(rng(), mount=mount)[0], noise="estimate").solution.sigma[:4]


@pytest.mark.parametrize(
    ("kind", "factor", "mount"),
    [("face", 1e3, "platform"), ("view", 10.0, "head"), *(pytest.param(k, f, m, marks=campaign) for k, f, m in (
        ("face", 1e-3, "head"), ("face", 1e-2, "platform"), ("view", 1e-3, "platform"), ("view", 1e3, "head")))],
)  # fmt: skip
def test_contradictory_noise_is_repaired_from_the_data(kind, factor, mount):
    obs, truth, _ = draw(rng(), mount=mount)
    found = solve_joint(mis_stated(obs, kind, factor), noise="estimate")
    level = found.noise["face_scale" if kind == "face" else "view_scale"]
    assert 0.7 < level * factor < 1.4
    assert worst(found, truth) < 4.5
    assert np.allclose(found.solution.sigma[:4], honest(mount), rtol=0.15)


def mis_stated(obs, kind, factor):
    """Observations whose stated standard deviations are wrong by a factor."""
    field, power = {"face": ("face_sigma", 1), "view": ("view_covariance", 2)}[kind]
    return replace(obs, **{field: getattr(obs, field) * factor**power})


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_placements_are_named(count):
    obs, *_ = draw(rng(), count)
    with pytest.raises(DegenerateGeometry, match=f"{count} of the 3 placements .* needed"):
        solve_joint(obs)


@MOUNTS
def test_a_placement_that_no_image_shows_is_left_out_by_name(mount):
    obs, truth, _ = draw(rng(), mount=mount)
    found = solve_joint(obs.keep(view=obs.view_placement != 4))
    (lost,) = found.excluded
    assert lost.placement == 5 and "no image shows the board" in str(lost)
    assert (
        5 not in found.observations.placements
        and worst(found, replace_boards(truth, 4)) < 4.5
    )


def replace_boards(truth, out):
    """The truth without one placement."""
    return replace(
        truth,
        **{
            key: np.delete(getattr(truth, key), out, axis=0)
            for key in ("boards", "sweeps", "sides")
        },
    )


@pytest.mark.parametrize(("mount", "number"), [("head", 0), ("platform", -1)])
def test_one_wrong_image_of_several_costs_the_image_not_the_placement(mount, number):
    obs, truth, _ = draw(rng(), mount=mount)
    wrong, other = (np.flatnonzero(obs.view_placement == i)[number] for i in (2, 7))
    pose = obs.view_pose.copy()
    pose[wrong] = pose[other]
    found = solve_joint(replace(obs, view_pose=pose), noise="estimate")
    assert (
        len(found.boards) == 10
        and len(found.observations.view_pitch) == len(obs.view_pitch) - 1
    )
    (words,) = map(str, found.excluded)
    assert "placement 3: image of " in words and "the image is left out" in words
    assert worst(found, truth) < 4.5


def test_an_edge_bias_that_only_what_is_usual_bounds_leaves_cameras_that_planes_fix():
    obs, _, rig = draw(rng())
    found = solve_joint(obs.keep(beam=~obs.beam_hit), required=False)
    assert (
        found.unobservable == ()
        and found.solution.sigma[found.columns("edge_log_odds")] > 2
    )
    sigma = projection_sigma(
        chain_of(joint_rig(found, dict.fromkeys(rig.cameras, rig.model)), "left"),
        rig.model,
        1.5,
        (4, 3),
        image_pitch=0.0,
        pitches=(-np.pi, np.pi),
    )
    assert root_mean_square(sigma) < 20


@pytest.mark.parametrize(
    "settings",
    [
        {"spot": (0.004, 0.0)},
        pytest.param({"spot": (0.012, 0.0044), "softness": 0.05}, marks=campaign),
    ],
)
def test_sigma_is_honest_where_beams_are_wider_apart_than_readings_flip(settings):
    """Mean normalised squared error of axis and cameras; chance alone exceeds 1.38 once in a thousand."""
    square = 0.0
    for seed in range(10):
        obs, truth, _ = draw(rng(seed), **settings)
        found = solve_joint(obs)
        square += square_per_number(found, truth) / 10
        assert found.converged
    assert 0.7 < square < 1.38


@MOUNTS
def test_a_scale_of_the_pitch_that_nothing_shows_stays_within_what_is_usual(mount):
    obs, *_ = draw(
        rng(),
        mount=mount,
        see_span=np.radians(0.5),
        pitch_step=np.radians(0.25),
        see_images=1,
    )
    sensor = ("range_offset", "edge_log_odds", "edge_log_softness", "pitch_scale")
    found = solve_joint(obs, sensor=sensor, required=False)
    assert not any("scale of the pitch" in words for words in found.unobservable)
    assert (
        abs(found.sensor["pitch_scale"]) < 0.15
        and found.solution.sigma[found.columns("pitch_scale")] < 0.051
    )
