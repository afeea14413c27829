"""One maximum-likelihood estimate of the whole rig from ranges, edges and images at all pitch angles."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.least_squares import minimise, solve, whiten
from lrfcal_lib.fit.residuals import (
    SENSOR,
    JointData,
    JointState,
    Unknowns,
    chart_parameters,
    disc_edge,
    gather,
    joint_blocks,
    move_state,
    named_blocks,
)
from lrfcal_lib.fit.result import AXIS_NAMES, AXIS_WORDS, Solution
from lrfcal_lib.model.geometry import (
    POSE_NAMES,
    DegenerateGeometry,
    TiltAxis,
    axis_of,
    head_from_axis,
    motion_words,
    pose_array,
    pose_parameters,
    pose_transform,
)
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.solvers.joint_noise import (
    CONTRADICTION,
    LARGEST_SHARE,
    LEAST_MISFIT,
    ROUGH_MISS,
    estimate_noise,
    image_misses,
    joint_warnings,
    lens_covariance,
    misfits,
    rough_misses,
    same_levels,
    view_misses,
)
from lrfcal_lib.solvers.joint_start import FEWEST_ANGLE_POINTS, boards_in_images, start_states, state_of

SCALES = {"range_offset": 1.0, "edge_log_odds": 10.0, "edge_log_softness": 10.0, "pitch_scale": 1.0}
START_STEPS = 8
NOISE_ROUNDS, ROUND_STEPS = 10, 10
OWN = ("boards", "sweeps", "sides")  # what every placement has of its own
LEVELS = (
    "face_scale", "view_scale", "sigma_pitch", "face_share", "beam_share", "lapse", "sweep_sigma", "side_sigma",
    "prior",
)  # fmt: skip
SWEEP_SIGMA = (np.radians(0.5), 0.05)
GOOD_START = 0.7  # mean half squared residual; a start value this good is not searched further
LEFT_OUT = 1000.0  # what a start value that needs all placements left out counts: try others before
ROUGH_STEP, LAST_STEP = 1e-2, 1e-4  # standard deviations: a shorter step ends a round, and the whole
UNSEEN = 0.5  # a direction whose standard deviation exceeds this (rad, m) is called unobservable


@dataclass(frozen=True)
class JointSolution:
    """The joint estimate.

    Attributes
    ----------
    T_head_lrf : RigidTransform
        In the gauge of the stated platform (rotation about the axis and shift along it cannot be observed).
    transforms : dict of str to RigidTransform
        ``T_camera_lrf`` or ``T_camera_platform`` by camera.
    boards : dict of int to RigidTransform
        ``T_platform_board`` by placement.
    sensor : dict of str to float
        Range offset (m), log odds and log softness of the edge, pitch scale, pitch offset by direction (rad).
    sweeps : dict of int to ndarray
        Offset (rad) and stretch of the recorded pitch of each sweep.
    size : dict of str to float
        By how much each edge lies outside the stated one, metres.
    noise : dict of str to float
        Factors on the stated standard deviations, and shares of independent errors, as estimated.
    misfit : dict of int to float
        Normalised squared residuals of each placement (1 is what the noise explains).
    excluded : dict of int or str to str
        Placements (and, under names of their own, cameras and single images) left out, with the reason.
    unobservable : tuple of str
        Motions that the data do not determine, in words.
    lens : ndarray, shape (c, c)
        The part of the covariances that comes from the intrinsics, which all placements share.
    warnings : tuple of str
        What is suspicious: no convergence, noise that contradicts what is stated, a weak axis, errors of the pitch that
        the data ask for.
    solution : Solution
        Of the shared unknowns (covariances, names, convergence).
    state : JointState
    unknowns : Unknowns
    data : JointData
    observations : JointObservations
        Without what is excluded.
    """

    T_head_lrf: RigidTransform
    transforms: dict
    boards: dict
    sensor: dict
    sweeps: dict
    size: dict
    noise: dict
    misfit: dict
    excluded: dict
    unobservable: tuple
    lens: np.ndarray
    warnings: tuple
    solution: Solution
    state: JointState
    unknowns: Unknowns
    data: JointData
    observations: JointObservations

    @property
    def converged(self):
        return bool(self.solution.converged)

    @property
    def axis(self) -> TiltAxis:
        return axis_of(self.T_head_lrf)

    @property
    def edge_bias(self):
        """Where readings flip with a background as far and bright as the board, spot radii outside the edge."""
        return float(disc_edge(self.sensor["edge_log_odds"])[0])

    def columns(self, prefix):
        """Indices of the shared unknowns whose names begin so."""
        return [i for i, name in enumerate(self.solution.names) if name.startswith(prefix)]

    def covariance(self, *prefixes):
        """Covariance to rely on of groups of shared unknowns, e.g. 'left_' or 'axis'; see `Solution.trusted`."""
        index = sum(map(self.columns, prefixes), [])
        return self.solution.trusted[np.ix_(index, index)]

    def correct(self, placement, p_lrf, pitch):
        """Measured points and recorded pitch as they should have been.

        Parameters
        ----------
        placement : int
        p_lrf : ndarray, shape (n, 3)
            LRF frame, metres.
        pitch : array_like, broadcastable to (n,)
            Radians.

        Returns
        -------
        p_lrf : ndarray, shape (n, 3)
            Without the range offset.
        pitch : ndarray
            With scale, offset by direction and the sweep's own errors, as far as they were estimated.
        """
        p_lrf, pitch = np.asarray(p_lrf, float), np.asarray(pitch, float)
        length = np.linalg.norm(p_lrf, axis=-1, keepdims=True)
        points = p_lrf * (1 - self.sensor["range_offset"] / np.maximum(length, 1e-9))
        corrected = pitch * (1 + self.sensor["pitch_scale"])
        if placement in self.sweeps:
            index = list(self.sweeps).index(placement)
            offset, stretch = self.sweeps[placement]
            turn = self.sensor["pitch_by_direction"] * self.data.direction[index]
            corrected = corrected + turn + offset + stretch * (pitch - self.data.middle[index])
        return points, corrected

    def camera(self, name):
        """The pose of one camera as a `Solution` like those of the other methods."""
        index, whole = self.columns(f"{name}_"), self.solution
        pose = pose_array(self.transforms[name])
        both = {key: getattr(whole, key) for key in ("covariance", "covariance_placements")}
        spread = {key: None if value is None else value[np.ix_(index, index)] for key, value in both.items()}
        return replace(
            whole, transform=self.transforms[name], parameters=pose_parameters(pose), names=POSE_NAMES,
            jacobian=whole.jacobian[..., index], unobservable=self.unobservable, state=pose, **spread,
        )  # fmt: skip

    def __repr__(self):
        return f"JointSolution({len(self.boards)} placements, {self.solution!r})"


def solve_joint(
    obs,
    T0=None,
    *,
    prior=None,
    axis=True,
    sensor=("range_offset", "edge_log_odds", "edge_log_softness"),
    size=False,
    sides=False,
    side_sigma=0.35,
    sweep="none",
    sweep_sigma=SWEEP_SIGMA,
    lapse=0.0,
    noise="stated",
    start=None,
    required=True,
    max_iterations=60,
):
    """Estimate axis, cameras, range offset, edge bias and the pose of every board at once.

    Parameters
    ----------
    obs : JointObservations
    T0 : RigidTransform, optional
        Rough ``T_head_lrf``; closed forms are tried in any case.
    prior : PlatformPrior, optional
        A rough measurement of the axis with its standard deviations. It yields where the data contradict it.
    axis : bool
        False: the axis is the one of T0 (or the stated one), and known.
    sensor : sequence of str
        Unknowns of the sensor, of :data:`lrfcal_lib.fit.residuals.SENSOR`; others stay zero (softness: 0.2).
    size : bool
        Estimate the board's size: one offset an edge.
    sides : bool
        Every side of every placement deviates from the sensor's edge bias, because backgrounds are not alike.
    side_sigma : float
        Scale of these deviations, log odds.
    sweep : {'none', 'offset', 'offset_stretch'}
        Errors of the recorded pitch that every sweep has of its own.
    sweep_sigma : tuple of float
        Their expected standard deviations, radians and fraction.
    lapse : float
        Share of edge beams expected to say nothing.
    noise : {'stated', 'estimate'}
        Estimate the noise levels (ranges, images, pitch, sides, repetition of errors among neighbours) from the
        residuals, and leave out placements and images that contradict all others, by name.
    start : JointState, optional
        Skips the search for a start value.
    required : bool
        False: report unobservable motions instead of raising.
    max_iterations : int

    Returns
    -------
    JointSolution

    Raises
    ------
    DegenerateGeometry
        Naming the unobservable motions, when `required`, or when there is no start value.
    ValueError
        For unknown names, contradictory noise settings, or observations that are not finite.
    """
    check_settings(obs, sensor, sweep_sigma, noise, lapse)
    obs, blind = without_blind_cameras(obs, required)
    unknowns = Unknowns(len(obs.cameras), len(obs.edges), axis, tuple(sensor), size, sweep, sides=sides)
    excluded = blind
    if start is None:
        obs, lost = without_lost_placements(obs)
        obs, start, bad = best_start(obs, unknowns, sweep_sigma, T0)
        excluded = excluded | lost | bad
    data = replace(gather(obs), sweep_sigma=tuple(sweep_sigma), side_sigma=side_sigma, prior=prior)
    state = _converge(start, data, coarse(unknowns), max_iterations)
    state = _converge(state, data, unknowns, max_iterations, LAST_STEP)
    data = replace(data, lapse=lapse)
    if noise == "estimate":
        state, data = settle(state, data, unknowns, max_iterations)
        obs, state, data, bad = drop_contradictions(obs, state, data, unknowns)
        excluded = excluded | bad
        if bad:
            state, data = settle(state, data, unknowns, max_iterations)
    if noise == "estimate" or lapse:
        state = _converge(state, data, unknowns, max_iterations, LAST_STEP)
    found = _solve(obs, data, in_stated_gauge(state, obs), unknowns, required, max_iterations)
    return _wrap(obs, data, unknowns, found, excluded)


def without_blind_cameras(obs, required):
    """Leave out cameras that never see a board, by name; refuse them where everything is required."""
    blind = [name for i, name in enumerate(obs.cameras) if not (obs.view_camera == i).any()]
    words = {f"camera {name}": f"camera '{name}' never sees the board: its pose stays open" for name in blind}
    if blind and required:
        raise DegenerateGeometry("; ".join(words.values()) + "; leave it out with obs.with_cameras")
    return (obs.with_cameras([n for n in obs.cameras if n not in blind]) if blind else obs), words


def without_lost_placements(obs):
    """Leave out placements that no image shows and whose scans cross fewer than two edges, by name."""
    count = np.zeros((len(obs.placements), len(obs.edges)), int)
    np.add.at(count, (obs.beam_placement[obs.beam_hit], obs.beam_edge[obs.beam_hit]), 1)
    crossed = np.sum(count >= FEWEST_ANGLE_POINTS, axis=1)
    lost = (crossed < 2) & ~np.isin(np.arange(len(crossed)), obs.view_placement)
    words = {
        int(p): f"placement {p}: no image shows the board and scans cross {n} edges, two needed; left out"
        for p, n in zip(obs.placements[lost], crossed[lost], strict=True)
    }
    if lost.all():
        raise DegenerateGeometry("; ".join(words.values()))
    return obs.select(obs.placements[~lost]), words


def settle(state, data, unknowns, iterations):
    """Estimate unknowns and noise levels in turn until they agree."""
    for _ in range(NOISE_ROUNDS):
        before, data = data, estimate_noise(state, data, unknowns)
        state = _converge(state, data, unknowns, min(iterations, ROUND_STEPS))
        if same_levels(before, data):
            break
    return state, data


def drop_contradictions(obs, state, data, unknowns):
    """Leave out placements whose residuals are far larger than the others', or the one image that makes them so."""
    found, usual = contradictions(state, data, unknowns)
    limits, rows, out, words = CONTRADICTION * usual, [], [], {}
    for i in np.flatnonzero((found > limits).any(axis=1)):
        row, board = wrong_image(obs, state, data, unknowns, i, limits)
        why = f"residuals are {np.sqrt(np.max(found[i] / usual)):.0f} times those of the others"
        if row is not None:
            rows, state.boards[i] = [*rows, row], board
            words[image_name(obs, row)] = f"{image_name(obs, row)}: with it {why}; the image is left out"
        elif found[i, 0] > limits[0]:
            out.append(i)
            words[int(obs.placements[i])] = f"placement {obs.placements[i]}: its {why}; left out"
    if not words:
        return obs, state, data, {}
    obs = obs.keep(view=~np.isin(np.arange(len(obs.view_camera)), rows)).select(np.delete(obs.placements, out))
    own = {key: np.delete(getattr(state, key), out, axis=0) for key in OWN}
    return obs, replace(state, **own), with_levels(gather(obs), data), words


def contradictions(state, data, unknowns):
    """Misfits of placements, and of their images alone, shape (p, 2), and what is usual of both, shape (2,).

    A wrong image raises the noise level of all images until ranges outvote it: images are compared with images.
    """
    blocks, several = named_blocks(state, data, unknowns), data.view["used"].sum(axis=1) > 1
    found = np.stack([misfits(blocks, data), misfits(blocks, data, ("view",))], axis=1)
    images = np.median(found[several, 1]) if several.any() else np.inf
    return found, np.array([max(np.median(found[:, 0]), 1.0), max(images, LEAST_MISFIT)])


def image_name(obs, row):
    """A view in words."""
    pitch, camera = np.degrees(obs.view_pitch[row]), obs.cameras[obs.view_camera[row]]
    return f"placement {obs.placements[obs.view_placement[row]]}, image of '{camera}' at {pitch:.1f} deg"


def wrong_image(obs, state, data, unknowns, i, limits):
    """The view without which placement i agrees with the others (None where there is none), and its board then.

    Every view is left out once, in copies of the placement, with all that the placements share held.
    """
    rows = np.flatnonzero(obs.view_placement == i)
    if len(rows) < 2:
        return None, None
    copies = np.full(len(rows), i)
    own = {key: getattr(state, key)[copies] for key in OWN}
    own["boards"] = boards_in_images(obs, state.head, state.cameras, np.roll(rows, -1))
    groups = {name: {key: v[copies] for key, v in getattr(data, name).items()} for name in ("face", "beam", "view")}
    groups["view"]["used"][range(len(rows)), range(len(rows))] = False
    groups["view"]["whitener"] = groups["view"]["whitener"] * groups["view"]["used"][..., None, None]
    data = replace(data, **groups, middle=data.middle[copies], direction=data.direction[copies])
    lone = replace(unknowns, axis=False, sensor=(), poses=False, size=False)
    state = _converge(replace(state, **own), data, lone, START_STEPS)
    found = np.max(contradictions(state, data, lone)[0] / limits, axis=1)
    best = int(np.argmin(found))
    return (rows[best], state.boards[best]) if found[best] <= 1 else (None, None)


def with_levels(data, like):
    """Padded observations with the noise levels of others."""
    return replace(data, **{key: getattr(like, key) for key in LEVELS})


def solve_again(obs, like, max_iterations=60):
    """Solve for other placements with the settings, noise levels and start value of a solution.

    Parameters
    ----------
    obs : JointObservations
        Some of the placements that `like` was made from (for leave-one-out and random halves).
    like : JointSolution
    max_iterations : int

    Returns
    -------
    JointSolution

    Raises
    ------
    DegenerateGeometry
        When these placements leave a motion open.
    """
    known = list(like.boards)
    rows = [known.index(int(p)) for p in obs.placements if int(p) in known]
    obs = obs.select([known[row] for row in rows])
    state = replace(like.state, **{key: getattr(like.state, key)[rows] for key in OWN})
    data = with_levels(gather(obs), like.data)
    state = _converge(state, data, like.unknowns, max_iterations, LAST_STEP)
    found = _solve(obs, data, in_stated_gauge(state, obs), like.unknowns, True, max_iterations)
    return _wrap(obs, data, like.unknowns, found, like.excluded)


def check_settings(obs, sensor, sweep_sigma, noise, lapse):
    """Refuse settings that contradict themselves."""
    unknown = [name for name in sensor if name not in SENSOR]
    if unknown:
        raise ValueError(f"sensor unknowns are {', '.join(SENSOR)}; got {unknown[0]!r}")
    if noise not in ("stated", "estimate"):
        raise ValueError(f"noise is 'stated' or 'estimate', got {noise!r}")
    if not 0 <= lapse < 0.5:
        raise ValueError(f"lapse is the share of beams that say nothing, 0 to 0.5, got {lapse}")
    if min(sweep_sigma) <= 0:
        raise ValueError(f"sweep_sigma must be positive (radians, fraction), got {sweep_sigma}")
    if len(obs.placements) == 0:
        raise DegenerateGeometry("no placement to calibrate with")


def best_start(obs, unknowns, sweep_sigma, T0=None):
    """The most promising start value, and the placements that no start value can bring together.

    Returns
    -------
    obs : JointObservations
        Without those placements.
    state : JointState
    excluded : dict of int to str

    Raises
    ------
    DegenerateGeometry
        When more than 30 % of the placements contradict the rest: then nobody knows which ones are wrong.
    """
    data, best, least = gather(obs), None, np.inf
    for number, state in enumerate(start_states(obs, T0)):
        if not unknowns.axis:
            known = next(h for h in (T0, obs.T_head_lrf, RigidTransform.identity()) if h is not None)
            state = replace(state, head=pose_array(known))
        rough = np.median(rough_misses(state, data))
        kept, state, bad, cost = agreeing_start(obs, state, data, unknowns, tuple(sweep_sigma))
        badness = cost + LEFT_OUT * max(left_out_shares(obs, bad))
        if best is None or badness < least:
            best, least = (kept, state, bad, rough), badness
        if least < GOOD_START and (T0 is None or number):
            break
    kept, state, bad, rough = best
    miss = np.median(view_misses(state, gather(kept)))
    if min(rough, miss) > ROUGH_MISS:
        raise DegenerateGeometry(
            f"images and scans contradict each other: for half of the placements the board lies {1000 * miss:.0f} mm "
            "or more off where the images put it; check that images and scans carry the right numbers"
        )
    if max(left_out_shares(obs, bad)) > LARGEST_SHARE:
        raise DegenerateGeometry(
            f"{len(bad)} placements or images of {len(obs.placements)} placements contradict the others: images put "
            f"boards elsewhere than scans ({', '.join(map(str, list(bad)[:8]))}); check that images and scans carry "
            "the right numbers"
        )
    return kept, state, bad


def left_out_shares(obs, bad):
    """Shares of the placements, and of the images of the others, that a start value leaves out."""
    placements = sum(not isinstance(name, str) for name in bad)
    return placements / len(obs.placements), (len(bad) - placements) / max(len(obs.view_camera), 1)


def agreeing_start(obs, state, data, unknowns, sweep_sigma):
    """A few steps without what contradicts a start value; what a rough one leaves out is judged again by the rest.

    Returns the observations kept, the state, what is left out in words, and the mean cost.
    """
    for _ in range(2):
        kept, fitting, bad = without_contradictions(obs, state, data)
        cut = replace(gather(kept) if bad else data, sweep_sigma=sweep_sigma)
        found, cost = a_few_steps(fitting, cut, unknowns)
        if not bad or max(left_out_shares(obs, bad)) > LARGEST_SHARE:
            break
        state = state_of(obs, pose_transform(found.head), [pose_transform(pose) for pose in found.cameras])
    return kept, found, bad, cost / count_rows(cut)


def without_contradictions(obs, state, data):
    """Leave out images that put the board far off where it was scanned, and placements of which none is left."""
    place, count = obs.view_placement, len(obs.placements)
    boards = boards_in_images(obs, state.head, state.cameras, np.arange(len(place))) if len(place) else state.boards[:0]
    misses, alone = image_misses(state, data, boards, place), ~np.isin(np.arange(count), place)
    wrong = misses > max(ROUGH_MISS, 5 * np.median(misses)) if len(place) else np.zeros(0, bool)
    good = alone | np.isin(np.arange(count), place[~wrong])
    if not wrong.any():
        return obs, state, {}
    rows, first = np.unique(place[~wrong], return_index=True)
    own = {key: getattr(state, key).copy() for key in OWN}
    own["boards"][rows] = boards[~wrong][first]
    words = {
        int(obs.placements[i]): f"placement {obs.placements[i]}: the scan is {1000 * misses[place == i].min():.0f} mm "
        "off where its image puts the board; left out"
        for i in np.flatnonzero(~good)
    }
    single = np.flatnonzero(wrong & good[place])
    for row in single:
        name = image_name(obs, row)
        words[name] = f"{name}: it puts the board {1000 * misses[row]:.0f} mm off the scan; the image is left out"
    kept = obs.keep(view=~np.isin(np.arange(len(place)), single)).select(obs.placements[good])
    return kept, replace(state, **{key: value[good] for key, value in own.items()}), words


def a_few_steps(state, data, unknowns):
    """A state after a few steps with soft edges, and its cost."""
    few = coarse(unknowns)
    state = _converge(state, data, few, START_STEPS)
    return state, total_cost(state, data, few)


def coarse(unknowns):
    """The unknowns without those of the edges: from far away, beams on the wrong side would blow up the softness."""
    return replace(unknowns, sensor=tuple(n for n in unknowns.sensor if not n.startswith("edge_")), sides=False)


def count_rows(data):
    """Number of observations."""
    return sum(int(group["used"].sum()) for group in (data.face, data.beam, data.view))


def in_stated_gauge(state, obs):
    """Turn about the axis and shift along it, which no data show, as the stated platform has them."""
    axis = head_from_axis(axis_of(pose_transform(state.head)))
    stated = obs.T_head_lrf
    head = axis if stated is None else stated * head_from_axis(axis_of(stated)).inv() * axis
    change = head * pose_transform(state.head).inv()
    boards = pose_array(change * pose_transform(state.boards))
    cameras = state.cameras.copy()
    fixed = [i for i, mount in enumerate(obs.mounts) if mount == "platform"]
    if fixed:
        cameras[fixed] = pose_array(pose_transform(cameras[fixed]) * change.inv())
    return replace(state, head=pose_array(head), boards=boards, cameras=cameras)


def total_cost(state, data, unknowns):
    """Half the squared residuals and the negative log likelihood of all observations."""
    total = 0.0
    for block in joint_blocks(state, data, unknowns):
        total += block.cost.sum() if block.cost is not None else 0.5 * np.sum(whiten(block, False)[0] ** 2)
    return float(total) if np.isfinite(total) else np.inf


def _converge(state, data, unknowns, iterations, tolerance=None):
    evaluate, move = _problem(data, unknowns)
    options = {"shared": unknowns.shared, "max_iterations": iterations, "tolerance": tolerance or ROUGH_STEP}
    return minimise(evaluate, state, move, **options)[0]


def _problem(data, unknowns):
    return (lambda s: joint_blocks(s, data, unknowns)), (lambda s, step: move_state(s, step, unknowns))


def _solve(obs, data, state, unknowns, required, max_iterations):
    evaluate, move = _problem(data, unknowns)
    names = unknowns.names(obs.cameras, obs.edges)
    return solve(
        evaluate, state, move, names=names, method="joint", read=lambda s: (None, _parameters(s, unknowns)),
        scales=[SCALES.get(name, 1.0) for name in names], words=lambda d: joint_words(d, names, obs.cameras),
        shared=unknowns.shared, freedom=0, required=required, limit=UNSEEN, max_iterations=max_iterations,
        tolerance=LAST_STEP,
        n_observations=count_rows(data),
    )  # fmt: skip


def _parameters(state, unknowns):
    poses = pose_parameters(state.cameras).ravel() if len(state.cameras) else np.zeros(0)
    return np.concatenate([chart_parameters(state.head), poses, state.sensor, state.size])[unknowns.mask]


def joint_words(direction, names, cameras):
    """A direction of the shared unknowns in words."""
    direction = np.asarray(direction) / np.max(np.abs(direction))
    words = []
    for camera in cameras:
        index = [i for i, name in enumerate(names) if name.startswith(f"{camera}_")]
        if index and np.max(np.abs(direction[index])) > 0.3:
            words.append(motion_words(direction[index], camera))
    for name, value in zip(names, direction, strict=True):
        if abs(value) > 0.3 and not any(name.startswith(f"{c}_") for c in cameras):
            words.append(_WORDS.get(name, name.replace("_", " ")))
    return " with ".join(words)


_WORDS = dict(zip(AXIS_NAMES, AXIS_WORDS, strict=True)) | {
    "range_offset": "the range offset",
    "edge_log_odds": "the edge bias",
    "edge_log_softness": "the softness of the edges",
    "pitch_scale": "the scale of the pitch",
    "pitch_by_direction": "the pitch offset by sweep direction",
}


def _wrap(obs, data, unknowns, found, excluded):
    state, blocks = found.state, named_blocks(found.state, data, unknowns)
    lens = lens_covariance(obs, found, data, unknowns)
    spread = None if found.covariance_placements is None else found.covariance_placements + lens
    found = replace(found, covariance=found.covariance + lens, covariance_placements=spread)
    T_head_lrf = pose_transform(state.head)
    return JointSolution(
        T_head_lrf,
        {name: pose_transform(pose) for name, pose in zip(obs.cameras, state.cameras, strict=True)},
        dict(zip(obs.placements.tolist(), pose_transform(state.boards), strict=True)),
        dict(zip(SENSOR, state.sensor.tolist(), strict=True)),
        {int(p): s for p, s in zip(obs.placements, state.sweeps, strict=True)},
        dict(zip(obs.edges, state.size.tolist(), strict=True)),
        noise_levels(data),
        dict(zip(obs.placements.tolist(), misfits(blocks, data).tolist(), strict=True)),
        excluded, found.unobservable, lens, joint_warnings(blocks, data, unknowns, found, obs.cameras), found, state,
        unknowns, data, obs,
    )  # fmt: skip


def noise_levels(data):
    """Noise levels in use by name."""
    views = {"view_scale": float(data.view_scale[0])} if len(data.view_scale) else {}
    names = ("face_scale", "face_share", "beam_share", "sigma_pitch", "side_sigma")
    return {name: float(getattr(data, name)) for name in names} | views
