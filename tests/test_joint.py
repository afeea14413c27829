"""The joint estimate: derivatives, invariances, recovery of the truth, subsets of the data, and far starts."""

from dataclasses import replace

import numpy as np
import pytest
from joint_draws import MOUNTS, draw, none, rng, scores
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.evaluate.monte_carlo import state_errors
from lrfcal_lib.fit.least_squares import whiten
from lrfcal_lib.fit.residuals import SENSOR, Unknowns, gather, move_state, named_blocks
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    axis_difference,
    pose_transform,
    transform_difference,
)
from lrfcal_lib.solvers.joint import solve_joint

SAME = 3e-4  # rad and m: a hundredth of the standard deviations, what steps of the solver leave
PLAIN = ("range_offset", "edge_log_odds", "edge_log_softness")


def apart(a, b):
    """Largest of the angle (rad) and the distance (m) between two transforms."""
    return max(transform_difference(a, b))


# derivatives


EVERY = Unknowns(2, 3, sensor=SENSOR, sweep="offset_stretch", sides=True)


def random_problem(rng, mount="head"):
    """Some rows of drawn observations, and a state that does not fit them."""
    obs, truth, _ = draw(rng, 3, mount=mount)
    places = {name: getattr(obs, f"{name}_placement") for name in ("face", "beam", "view")}
    obs = obs.keep(**{name: rng.random(len(place)) < max(0.1, 9 / len(place)) for name, place in places.items()})
    step = rng.normal(0, 0.03, EVERY.shared), rng.normal(0, 0.03, (3, EVERY.own))
    return obs, move_state(truth, step, EVERY)


def moved(state, column, amount):
    """The state after a step of one unknown: a shared one, or the same one of every placement."""
    shared, own = np.zeros(EVERY.shared), np.zeros((len(state.boards), EVERY.own))
    if column < EVERY.shared:
        shared[column] = amount
    else:
        own[:, column - EVERY.shared] = amount
    return move_state(state, (shared, own), EVERY)


@pytest.mark.parametrize(
    ("name", "lapse"), [("face", 0), ("beam", 0), ("beam", 0.05), ("view", 0), ("sweep", 0), ("side", 0)]
)
@MOUNTS
def test_derivatives_of_every_block(name, lapse, mount):
    """Gradient of each placement's cost, and for least squares the Jacobian itself, against differences."""
    obs, state = random_problem(rng(1), mount)
    data = replace(gather(obs), lapse=lapse)

    def block(s):
        return named_blocks(s, data, EVERY)[name]

    def costs(s):
        b = block(s)
        return np.sum(b.cost if b.cost is not None else 0.5 * whiten(b, False)[0] ** 2, axis=1)

    r, J = whiten(block(state))
    gradient = np.sum(r[..., None] * J, axis=1)
    step, columns = 1e-6, range(EVERY.shared + EVERY.own)
    numeric = [(costs(moved(state, i, step)) - costs(moved(state, i, -step))) / (2 * step) for i in columns]
    assert np.allclose(gradient, np.transpose(numeric), rtol=1e-5, atol=1e-5 * np.abs(numeric).max())
    if block(state).cost is None:
        two = [[whiten(block(moved(state, i, e)), False)[0] for e in (step, -step)] for i in columns]
        numeric = np.stack([(a - b) / (2 * step) for a, b in two], axis=-1)
        assert np.allclose(J, numeric, rtol=1e-5, atol=1e-6 * np.abs(J).max())


# invariances


@MOUNTS
def test_a_constant_in_the_pitch_only_turns_boards_and_base(mount):
    """Recorded pitch counts from anywhere: axis and cameras on the head do not change, all else turns about it."""
    obs, *_ = draw(rng(), 8, mount=mount)
    angle = 0.2
    turned = replace(obs, **{key: getattr(obs, key) + angle for key in ("face_pitch", "beam_pitch", "view_pitch")})
    turned = replace(turned, middle=obs.middle + angle)
    one, two = solve_joint(obs), solve_joint(turned)
    about = RigidTransform.from_rotation(Rotation.from_euler("x", angle))
    tiny = 0.01 * one.solution.sigma[:4]
    assert np.all(np.abs(one.solution.parameters[:4] - two.solution.parameters[:4]) < tiny)
    for name, T in one.transforms.items():
        expected = T if mount == "head" else T * about.inv()
        assert apart(two.transforms[name], expected) < SAME
    for number, T in one.boards.items():
        assert apart(two.boards[number], about * T) < SAME


@MOUNTS
def test_the_stated_platform_only_sets_the_gauge(mount):
    """A turn about the axis and a shift along it come from the stated platform; what is observable stays."""
    obs, *_ = draw(rng(), 8, mount=mount)
    found = solve_joint(obs)
    change = RigidTransform.from_components([0.3, 0, 0], Rotation.from_euler("x", 0.4))
    other = solve_joint(replace(obs, T_head_lrf=change * found.T_head_lrf))
    angle, offset = axis_difference(found.axis, other.axis)
    assert angle < SAME and offset < SAME
    assert apart(other.T_head_lrf, change * found.T_head_lrf) < SAME
    for name, T in found.transforms.items():
        expected = T if mount == "head" else T * change.inv()
        assert apart(other.transforms[name], expected) < SAME
    assert np.isclose(found.solution.cost_history[-1], other.solution.cost_history[-1], rtol=1e-6)


def test_order_of_placements_and_rows_does_not_matter():
    obs, *_ = draw(rng(), 8)
    found = solve_joint(obs)
    order = rng(1).permutation(len(obs.placements))
    place = np.argsort(order)
    mixed = replace(obs, **{key: getattr(obs, key)[order] for key in ("placements", "direction", "middle")})
    rows = {g: getattr(obs, f"{g}_placement") for g in ("face", "beam", "view")}
    mixed = replace(mixed, **{f"{g}_placement": place[old] for g, old in rows.items()})
    mixed = mixed.keep(**{g: rng(2).permutation(len(old)) for g, old in rows.items()})
    other = solve_joint(mixed)
    assert np.all(np.abs(found.solution.parameters - other.solution.parameters) < 0.01 * found.solution.sigma)
    for number, T in found.boards.items():
        assert apart(T, other.boards[number]) < SAME
        assert np.isclose(found.misfit[number], other.misfit[number], rtol=1e-2)


# recovery of the truth


def test_exact_observations_give_the_truth():
    """Ranges and images without noise: to rounding."""
    obs, truth, _ = draw(rng(), 8, see_noise=0.0)
    found = solve_joint(none(obs, "beam"), sensor=("range_offset",))
    assert found.converged
    assert np.abs(state_errors(found.state, truth, found.unknowns)).max() < 1e-9


@MOUNTS
def test_scale_of_the_pitch_is_recovered(mount):
    obs, truth, _ = draw(rng(), 12, mount=mount, stretch=0.03)
    found = solve_joint(obs, sensor=(*PLAIN, "pitch_scale"))
    assert abs(found.sensor["pitch_scale"] - 0.03) < 4 * found.covariance("pitch_scale")[0, 0] ** 0.5 < 0.05
    assert np.abs(scores(found, truth)).max() < 4.5


def with_recorded_pitch(obs, recorded):
    """Observations whose pitch is another function of the true one and the placement."""
    keys = [f"{group}_pitch" for group in ("face", "beam", "view")]
    places = [getattr(obs, key.replace("pitch", "placement")) for key in keys]
    return replace(obs, **{key: recorded(getattr(obs, key), place) for key, place in zip(keys, places, strict=True)})


def test_pitch_errors_of_sweeps_are_recovered():
    """Sweeps whose recorded pitch is off by a degree and stretched by some per cent."""
    obs, truth, _ = draw(rng(), 12, mount="platform")
    off, stretch = rng(7).normal(0, np.radians(1.0), 12), rng(8).normal(0, 0.02, 12)
    middle = obs.middle
    spoilt = with_recorded_pitch(obs, lambda true, p: middle[p] + (true - middle[p] - off[p]) / (1 + stretch[p]))
    found = solve_joint(spoilt, sweep="offset_stretch", sweep_sigma=(np.radians(1.0), 0.02))
    plain = solve_joint(spoilt)
    sweeps = np.array([found.sweeps[n] for n in obs.placements])
    common = np.mean(sweeps[:, 0] - off)  # what all have in common turns the platform frame
    assert np.std(sweeps[:, 0] - off - common) < 0.3 * np.std(off)
    assert np.corrcoef(sweeps[:, 1], stretch)[0, 1] > 0.9
    assert np.abs(scores(found, truth)[:4]).max() < 4.5
    costs = [s.solution.cost_history[-1] for s in (found, plain)]
    assert costs[1] > 1.2 * costs[0]


def test_the_direction_of_the_sweep_is_recovered():
    lag, sensor = np.radians(0.4), (*PLAIN, "pitch_by_direction")
    obs, truth, _ = draw(rng(), 12, mount="platform")
    found = solve_joint(with_recorded_pitch(obs, lambda true, p: true - lag * obs.direction[p]), sensor=sensor)
    sigma = found.covariance("pitch_by_direction")[0, 0] ** 0.5
    assert abs(found.sensor["pitch_by_direction"] - lag) < 4.5 * sigma < lag
    with pytest.raises(DegenerateGeometry, match="do not determine the pitch offset by sweep direction"):
        solve_joint(draw(rng(), 8)[0], sensor=sensor)  # cameras on the head lag alike


# subsets of the data


def test_no_camera_leaves_the_platform_step():
    obs, truth, _ = draw(rng(), 20, seen=())
    found = solve_joint(obs, required=False)
    assert found.transforms == {} and np.abs(scores(found, truth)).max() < 5
    assert np.degrees(found.solution.sigma[0]) > 0.2, "the small board hardly shows the axis"


def test_single_shots_do_not_show_the_axis():
    """Without motion of the platform cameras on the head are found; the axis is named as what is missing."""
    obs, truth, _ = draw(rng(), 20, see_span=0.0)
    with pytest.raises(DegenerateGeometry, match="the data do not determine .* axis"):
        solve_joint(obs, sensor=PLAIN[:2])
    found = solve_joint(obs, required=False, sensor=PLAIN[:2])
    assert sum("axis" in words for words in found.unobservable) == 4
    assert not np.any(found.solution.sigma[:4] < 0.5)  # what the data do not show has no small sigma
    cameras = [i for i, name in enumerate(found.solution.names) if name.startswith(("left", "right"))]
    assert np.abs(scores(found, truth)[cameras]).max() < 4.5


@MOUNTS
def test_single_shots_with_a_known_axis(mount):
    obs, truth, _ = draw(rng(), 20, mount=mount, see_span=0.0)
    found = solve_joint(obs, pose_transform(truth.head), axis=False, sensor=PLAIN[:2])
    assert np.allclose(found.state.head, truth.head, atol=1e-9)
    assert np.abs(scores(found, truth)).max() < 4.5


def test_without_edges_their_bias_is_named():
    obs, truth, _ = draw(rng(), 12)
    with pytest.raises(DegenerateGeometry, match="edge bias"):
        solve_joint(none(obs, "beam"))
    found = solve_joint(none(obs, "beam"), sensor=("range_offset",))
    assert np.abs(scores(found, truth)).max() < 4.5


def test_without_ranges_their_offset_is_named():
    """Edges and images alone, from a start value: all but the range offset."""
    obs, truth, _ = draw(rng(), 12)
    bare = none(obs, "face")
    start = replace(truth, sensor=np.array([0.0, 0.0, np.log(0.2), 0.0, 0.0]))
    with pytest.raises(DegenerateGeometry, match="range offset"):
        solve_joint(bare, start=start)
    found = solve_joint(bare, start=start, sensor=PLAIN[1:])
    assert np.abs(scores(found, replace(truth, sensor=truth.sensor * [0, 1, 1, 1, 1]))).max() < 4.5


# far starts


@MOUNTS
def test_any_start_gives_the_same_answer(mount):
    """60 degrees and half a metre wrong, or none."""
    obs, truth, _ = draw(rng(), 12, mount=mount)
    best = solve_joint(obs)
    turn, away = rng(11).normal(size=(2, 3))
    turned = Rotation.from_rotvec(np.radians(60) * turn / np.linalg.norm(turn))
    wrong = RigidTransform.from_components(0.5 * away / np.linalg.norm(away), turned)
    found = solve_joint(obs, wrong * pose_transform(truth.head))
    assert np.all(np.abs(found.solution.parameters - best.solution.parameters) < 0.01 * best.solution.sigma)


# errors


@pytest.mark.parametrize(("change", "words"), [
    ({"sensor": ("tilt",)}, "sensor unknowns are range_offset.*got 'tilt'"),
    ({"noise": "guess"}, "noise is 'stated' or 'estimate', got 'guess'"),
    ({"lapse": 0.6}, "lapse is the share .* got 0.6"),
    ({"sweep_sigma": (0.0, 0.05)}, "sweep_sigma must be positive"),
])  # fmt: skip
def test_settings_are_checked(change, words):
    with pytest.raises(ValueError, match=words):
        solve_joint(draw(rng(), 4)[0], **change)


@pytest.mark.parametrize(("field", "change", "words"), [
    ("face_range", lambda r: np.r_[r[:3], np.nan, r[4:]], "face_range .* finite"),
    ("view_placement", lambda place: place + 1, "view_placement are indices below 4, got up to 4"),
    ("face_sigma", lambda sigma: 0 * sigma, "face_sigma must be positive, got 0.0"),
])  # fmt: skip
def test_observations_are_checked(field, change, words):
    obs, *_ = draw(rng(), 4)
    with pytest.raises(ValueError, match=words):
        replace(obs, **{field: change(getattr(obs, field))})
    with pytest.raises(DegenerateGeometry, match="no placement"):
        solve_joint(obs.select([]))
