"""The joint estimate: invariances, recovery of the truth, subsets of the data, and far starts."""

from dataclasses import replace

import numpy as np
import pytest
from joint_draws import MOUNTS, draw, joint_step, misses_of, none, rng, scores
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.evaluate.monte_carlo import bound, state_errors
from lrfcal_lib.fit.edge_likelihood import LEAST_STEP
from lrfcal_lib.fit.least_squares import eliminate, linearise
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    axis_difference,
    pose_transform,
    transform_difference,
)
from lrfcal_lib.solvers.joint import in_stated_gauge, solve_joint
from lrfcal_lib.solvers.joint_model import Unknowns, gather
from lrfcal_lib.solvers.joint_residuals import named_blocks

SAME = 3e-4  # rad and m: a hundredth of the standard deviations, what steps of the solver leave
PLAIN = ("range_offset", "edge_log_odds", "edge_log_softness")


def apart(a, b):
    """Largest of the angle (rad) and the distance (m) between two transforms."""
    return max(transform_difference(a, b))


# invariances


def about_x(angle, along=0.0):
    return RigidTransform.from_components([along, 0, 0], Rotation.from_euler("x", angle))


def pitch_from_elsewhere(obs, found):
    keys = ("face_pitch", "beam_pitch", "view_pitch", "middle")
    return replace(obs, **{key: getattr(obs, key) + 0.2 for key in keys}), about_x(0.2)


def another_platform_stated(obs, found):
    return replace(obs, T_head_lrf=about_x(0.4, 0.3) * found.T_head_lrf), about_x(0.4, 0.3)


def in_another_order(obs, chance):
    """The same observations, placements and rows shuffled."""
    order = chance.permutation(len(obs.placements))
    rows = {
        group: chance.permutation(len(getattr(obs, f"{group}_placement")))
        for group in ("face", "beam", "view")
    }
    shuffled = obs.keep(**rows)
    moved = {
        f"{group}_placement": np.argsort(order)[getattr(shuffled, f"{group}_placement")]
        for group in rows
    }
    own = {
        name: getattr(obs, name)[order] for name in ("placements", "direction", "middle")
    }
    return replace(shuffled, **moved, **own)


@MOUNTS
def test_the_order_of_placements_and_rows_changes_nothing(mount):
    obs, *_ = draw(rng(), 8, mount=mount)
    found, other = (
        solve_joint(each, noise="estimate") for each in (obs, in_another_order(obs, rng(1)))
    )
    assert np.all(
        np.abs(found.solution.parameters - other.solution.parameters)
        < 0.01 * found.solution.sigma
    )
    np.testing.assert_allclose(other.solution.sigma, found.solution.sigma, rtol=1e-3)
    for number, T in found.boards.items():
        assert apart(other.boards[number], T) < SAME and np.isclose(
            found.misfit[number], other.misfit[number], rtol=1e-2
        )


def test_a_camera_is_not_taken_for_one_whose_name_begins_like_its_own():
    obs, *_ = draw(rng(), 8, mount="head")
    first, second = obs.cameras
    names = {first: "left", second: "left_2"}
    known = solve_joint(obs)
    found = solve_joint(replace(obs, cameras=tuple(names.values())))
    for before, now in names.items():
        assert found.columns(now) == known.columns(before)
        assert found.covariance(now).shape == (6, 6)
        np.testing.assert_array_equal(
            found.camera(now).parameters, known.camera(before).parameters
        )


@MOUNTS
@pytest.mark.parametrize("change", [pitch_from_elsewhere, another_platform_stated])
def test_what_only_turns_the_frame_of_the_platform_changes_nothing_else(change, mount):
    """Recorded pitch counts from anywhere, the platform's frame is as stated."""
    obs, *_ = draw(rng(), 8, mount=mount)
    found = solve_joint(obs)
    changed, frame = change(obs, found)
    other = solve_joint(changed)
    assert max(axis_difference(found.axis, other.axis)) < SAME
    assert np.isclose(
        found.solution.cost_history[-1], other.solution.cost_history[-1], rtol=1e-6
    )
    assert (
        change is not another_platform_stated
        or apart(other.T_head_lrf, frame * found.T_head_lrf) < SAME
    )
    for name, T in found.transforms.items():
        assert (
            apart(other.transforms[name], T if mount == "head" else T * frame.inv()) < SAME
        )
    for number, T in found.boards.items():
        assert apart(other.boards[number], frame * T) < SAME
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
    assert (
        abs(found.sensor["pitch_scale"] - 0.03)
        < 4 * found.covariance("pitch_scale")[0, 0] ** 0.5
        < 0.05
    )
    assert np.abs(scores(found, truth)).max() < 4.5


def with_recorded_pitch(obs, recorded):
    """Observations whose pitch is another function of the true one and the placement."""
    keys = [f"{group}_pitch" for group in ("face", "beam", "view")]
    places = [getattr(obs, key.replace("pitch", "placement")) for key in keys]
    return replace(
        obs,
        **{
            key: recorded(getattr(obs, key), place)
            for key, place in zip(keys, places, strict=True)
        },
    )


def test_pitch_errors_of_sweeps_are_recovered():
    """Sweeps whose recorded pitch is off by a degree and stretched by some per cent."""
    obs, truth, _ = draw(rng(), 12, mount="platform")
    off = rng(7).normal(0, np.radians(1.0), 12)
    stretch = rng(8).normal(0, 0.02, 12)
    middle = obs.middle
    spoilt = with_recorded_pitch(
        obs, lambda true, p: middle[p] + (true - middle[p] - off[p]) / (1 + stretch[p])
    )
    found = solve_joint(spoilt, sweep="offset_stretch", sweep_sigma=(np.radians(1.0), 0.02))
    plain = solve_joint(spoilt)
    sweeps = found.state.sweeps
    common = np.mean(sweeps[:, 0] - off)  # what all have in common turns the platform frame
    assert np.std(sweeps[:, 0] - off - common) < 0.3 * np.std(off)
    assert np.corrcoef(sweeps[:, 1], stretch)[0, 1] > 0.9
    assert np.abs(scores(found, truth)[:4]).max() < 4.5
    costs = [s.solution.cost_history[-1] for s in (found, plain)]
    assert costs[1] > 1.2 * costs[0]


def test_the_direction_of_the_sweep_is_recovered():
    lag = np.radians(0.4)
    sensor = (*PLAIN, "pitch_by_direction")
    obs, truth, _ = draw(rng(), 12, mount="platform")
    found = solve_joint(
        with_recorded_pitch(obs, lambda true, p: true - lag * obs.direction[p]),
        sensor=sensor,
    )
    sigma = found.covariance("pitch_by_direction")[0, 0] ** 0.5
    assert abs(found.sensor["pitch_by_direction"] - lag) < 4.5 * sigma < lag
    with pytest.raises(
        DegenerateGeometry, match="do not determine the pitch offset by sweep direction"
    ):
        solve_joint(draw(rng(), 8)[0], sensor=sensor)  # cameras on the head lag alike


@MOUNTS
def test_scipy_finds_the_same_rig(mount):
    """Cameras on the base show the axis weakly, a curved valley: there it is known."""
    obs, truth, _ = draw(rng(), 6, mount=mount)
    obs = none(obs, "beam").keep(face=np.arange(len(obs.face_range)) % 3 == 0)
    found = solve_joint(obs, start=truth, sensor=("range_offset",), axis=mount == "head")
    unknowns = found.unknowns
    options = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-12)

    def moved(x):
        return unknowns.move(truth, joint_step(x, unknowns))

    theirs = least_squares(
        lambda x: misses_of(moved(x), obs),
        np.zeros(6 * unknowns.size - 5 * unknowns.shared),
        **options,
    )
    assert found.solution.cost_history[-1] == pytest.approx(theirs.cost, rel=1e-6)
    away = state_errors(in_stated_gauge(moved(theirs.x), obs), found.state, unknowns)
    assert np.abs(away / found.solution.sigma).max() < 1e-3
    covariance = np.linalg.inv(theirs.jac.T @ theirs.jac)[
        : unknowns.shared, : unknowns.shared
    ]
    np.testing.assert_allclose(
        found.solution.sigma, np.sqrt(np.diag(covariance)), rtol=0.01
    )


def test_the_bound_is_the_variance_of_the_score():
    """Over 200 draws at the truth; chance alone leaves 2 %. What placements own is eliminated."""
    unknowns = Unknowns(2, 3)
    squares = []
    for seed in range(200):
        obs, truth, _ = draw(rng(seed), 3, floor=LEAST_STEP, pitch_step=np.radians(2.0))
        blocks = named_blocks(truth, gather(obs), unknowns)
        score = eliminate(*linearise(blocks.values())[:2], unknowns.shared)[1].sum(axis=0)
        squares.append(score @ bound(obs, truth, unknowns) @ score / len(score))
    assert np.mean(squares) == pytest.approx(1.0, abs=0.1)


# subsets of the data


def test_no_camera_leaves_the_platform_step():
    obs, truth, _ = draw(rng(), 20, seen=())
    with pytest.raises(DegenerateGeometry, match="placement 20: no image shows the board"):
        solve_joint(obs, required=False)
    found = solve_joint(obs, start=truth, required=False)
    assert found.transforms == {} and np.abs(scores(found, truth)).max() < 5
    assert np.degrees(found.solution.sigma[0]) > 0.2, (
        "the small board hardly shows the axis"
    )


def test_single_shots_do_not_show_the_axis():
    """Without motion of the platform cameras on the head are found; the axis is named as what is missing."""
    obs, truth, _ = draw(rng(), 20, see_span=0.0)
    with pytest.raises(DegenerateGeometry, match="the data do not determine .* axis"):
        solve_joint(obs, sensor=PLAIN[:2])
    found = solve_joint(obs, required=False, sensor=PLAIN[:2])
    assert sum("axis" in words for words in found.unobservable) == 4
    assert not np.any(
        found.solution.sigma[:4] < 0.5
    )  # what the data do not show has no small sigma
    cameras = [
        i
        for i, name in enumerate(found.solution.names)
        if name.startswith(("left", "right"))
    ]
    assert np.abs(scores(found, truth)[cameras]).max() < 4.5


@pytest.mark.parametrize(("gone", "words", "sensor"), [
    ("beam", "edge bias", ("range_offset",)),
    ("face", "range offset", PLAIN[1:]),  # from a start value
])  # fmt: skip
def test_what_shows_an_error_of_the_sensor_is_named_where_it_is_missing(
    gone, words, sensor
):
    obs, truth, _ = draw(rng(), 12)
    bare = none(obs, gone)
    start = replace(truth, sensor=np.array([0.0, 0.0, np.log(0.2), 0.0, 0.0]))
    options = {"start": start} if gone == "face" else {}
    with pytest.raises(DegenerateGeometry, match=words):
        solve_joint(bare, **options)
    found = solve_joint(bare, sensor=sensor, **options)
    known = replace(truth, sensor=truth.sensor * [gone != "face", 1, 1, 1, 1])
    assert np.abs(scores(found, known)).max() < 4.5


# far starts


@MOUNTS
def test_any_start_gives_the_same_answer(mount):
    """60 degrees and half a metre wrong, or none."""
    obs, truth, _ = draw(rng(), 12, mount=mount)
    best = solve_joint(obs)
    turn, away = rng(11).normal(size=(2, 3))
    turned = Rotation.from_rotvec(np.radians(60) * turn / np.linalg.norm(turn))
    wrong = RigidTransform.from_components(0.5 * away / np.linalg.norm(away), turned)
    stated = wrong * pose_transform(truth.head)
    found = solve_joint(replace(obs, T_head_lrf=stated))
    assert max(axis_difference(found.axis, best.axis)) < 1e-5
    costs = [each.solution.cost_history[-1] for each in (found, best)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-6)


# errors


@pytest.mark.parametrize(("change", "words"), [
    ({"sensor": ("tilt",)}, "sensor unknowns are range_offset.*got 'tilt'"),
    ({"noise": "guess"}, "noise is 'stated' or 'estimate', got 'guess'"),
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
