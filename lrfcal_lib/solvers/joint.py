"""One maximum-likelihood estimate of the whole rig from ranges, edges and images at all pitch
angles.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.axis_chart import chart_parameters
from lrfcal_lib.fit.edge_likelihood import disc_edge
from lrfcal_lib.fit.least_squares import eliminate, minimise, solve
from lrfcal_lib.fit.result import AXIS_NAMES, AXIS_WORDS, Solution
from lrfcal_lib.model import geometry
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    pose_array,
    pose_parameters,
    pose_transform,
)
from lrfcal_lib.model.kinematics import Corrections, SweepPitch, camera_at
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.solvers import joint_noise
from lrfcal_lib.solvers.joint_model import (
    SENSOR,
    SWEEPS,
    JointData,
    JointState,
    Unknowns,
    gather,
    move_state,
)
from lrfcal_lib.solvers.joint_residuals import joint_blocks, named_blocks
from lrfcal_lib.solvers.joint_start import (
    FEWEST_ANGLE_POINTS,
    boards_in_images,
    start_states,
    state_of,
)
from lrfcal_lib.solvers.planes import NEARLY, SAME_TURN, rival_words

SCALES = {"range_offset": 1.0, "edge_log_odds": 10.0, "edge_log_softness": 10.0, "pitch_scale": 1.0}
SWEEP_SIGMA = (np.radians(0.5), 0.05)
SWEEP_HELD = (0.0, 0.0)
START_STEPS = 8
FIRST_STEPS = 60
NOISE_ROUNDS = 10
ROUND_STEPS = 10
MOST_STEPS = 300
OWN = ("boards", "sweeps", "sides")  # what every placement has of its own
GOOD_START = 0.7  # mean half squared residual; a start value this good is not searched further
# standard deviations: a shorter step ends a round, and the whole
ROUGH_STEP = 1e-2
LAST_STEP = 1e-4
UNSEEN = 0.5  # a direction whose standard deviation exceeds this (rad, m) is called unobservable
CONTRADICTION = 16.0  # mean squared residual, relative to the median placement's
LEAST_MISFIT = 1e-6  # of images: below, they agree exactly
LARGEST_SHARE = 0.3  # of the placements that may contradict the others
# metres, of a board from where images of it put it: of a start value, of the end
ROUGH_MISS = 0.08
LAST_MISS = 0.025
FAR_MISS = 5.0  # times the usual miss: an image puts the board elsewhere
WORDS = dict(zip(AXIS_NAMES, AXIS_WORDS, strict=True)) | {
    "range_offset": "the range offset",
    "edge_log_odds": "the edge bias",
    "edge_log_softness": "the softness of the edges",
    "pitch_scale": "the scale of the pitch",
    "pitch_by_direction": "the pitch offset by sweep direction",
}


@dataclass(frozen=True)
class Score:
    """What placements say about the shared unknowns, all that is their own eliminated.

    Attributes
    ----------
    information : ndarray, shape (p, c, c)
    gradient : ndarray, shape (p, c)
        Of half the sum of squares.
    """

    information: np.ndarray
    gradient: np.ndarray


@dataclass(frozen=True)
class JointSolution:
    """The joint estimate.

    Attributes
    ----------
    solution : Solution
        Of the shared unknowns (covariances, names, convergence).
    observations : JointObservations
        Without what is excluded.
    data, unknowns : JointData, Unknowns
        Padded observations with the noise levels used, and what was unknown; for `solvers` only.
    T_head_lrf : RigidTransform
        In the gauge of the stated platform (rotation about the axis and shift along it cannot be
        observed).
    transforms : dict of str to RigidTransform
        ``T_camera_lrf`` or ``T_camera_platform`` by camera.
    boards : dict of int to RigidTransform
        ``T_platform_board`` by placement.
    sensor : dict of str to float
        Range offset (m), log odds and log softness of the edge, pitch scale, pitch offset by
        direction (rad).
    sweeps : dict of int to ndarray
        Offset (rad) and stretch of the recorded pitch of each sweep.
    noise : dict of str to float
        Factors on the stated standard deviations, and shares of independent errors, as estimated.
    misfit : dict of int to float
        Normalised squared residuals of each placement (1 is what the noise explains).
    excluded : dict of int or str to str
        Placements (and, under names of their own, cameras and single images) left out, with the
        reason.
    lens : ndarray, shape (c, c)
        The part of the covariances that comes from the intrinsics, which all placements share.
    lens_scale : float
        By how much errors of the intrinsics let board poses in images scatter, in stated standard
        deviations.
    warnings : tuple of str
        What is suspicious: noise that contradicts what is stated, a weak axis,
        errors of the pitch that the data ask for.
    """

    solution: Solution
    observations: JointObservations
    data: JointData
    unknowns: Unknowns
    T_head_lrf: RigidTransform
    transforms: dict
    boards: dict
    sensor: dict
    sweeps: dict
    noise: dict
    misfit: dict
    excluded: dict
    lens: np.ndarray
    lens_scale: float
    warnings: tuple

    @property
    def state(self):
        """Everything that moved."""
        return self.solution.state

    @property
    def board_poses(self) -> np.ndarray:
        """``T_platform_board`` in the order of the observations' placements, shape (p, 3, 4)."""
        return self.state.boards

    @property
    def side_odds(self) -> np.ndarray:
        """By how much the log odds of each side differ from the sensor's, shape (p, e)."""
        return self.state.sides

    @property
    def sweep_sigma(self) -> tuple[float, float]:
        """Standard deviations of the pitch's offset (radians) and stretch of every sweep; 0 where
        held.
        """
        number = SWEEPS[self.unknowns.sweep]
        offset, stretch = (*self.data.sweep_sigma[:number], *SWEEP_HELD[number:])
        return offset, stretch

    @property
    def converged(self):
        """Whether the last step was small."""
        return bool(self.solution.converged)

    @property
    def unobservable(self):
        """Motions that the data do not determine, in words."""
        return self.solution.unobservable

    @property
    def axis(self):
        """The tilt axis in the LRF frame."""
        return geometry.axis_of(self.T_head_lrf)

    @property
    def sigma(self):
        """Standard deviations to rely on of the shared unknowns, by name."""
        return dict(zip(self.solution.names, self.solution.trusted_sigma.tolist(), strict=True))

    @property
    def edge_bias(self):
        """Where readings flip with a background as far and bright as the board, spot radii
        outside the edge.
        """
        return float(disc_edge(self.sensor["edge_log_odds"])[0])

    @cached_property
    def blocks(self):
        """Residuals by name at the solution, dict of str to Block; for `solvers` only."""
        return named_blocks(self.state, self.data, self.unknowns)

    def residuals(self, group: str) -> np.ndarray:
        """Residuals in the order of the observations.

        Parameters
        ----------
        group : {'face', 'view'}

        Returns
        -------
        ndarray, shape (m, 1) or (v, 6)
            Of ranges to faces, metres, or of poses in images, radians and metres.
        """
        if group not in self.blocks:
            return np.zeros((0, {"face": 1, "view": 6}[group]))
        used = getattr(self.data, group)["used"]
        return self._in_order(group, self.blocks[group].residuals.reshape(*used.shape, -1))

    def face_points(self) -> np.ndarray:
        """Measured points of the faces in the frames of their boards, metres, shape (m, 3)."""
        return self._in_order("face", joint_noise.on_board(self.state, self.data))

    def _in_order(self, group, padded):
        """Rows of a group in the order of the observations, shape (p, n, k) -> (m, k)."""
        placement = getattr(self.observations, f"{group}_placement")
        rows = np.zeros((len(placement), padded.shape[-1]))
        rows[np.argsort(placement, kind="stable")] = padded[getattr(self.data, group)["used"]]
        return rows

    def with_levels(self, **levels) -> "JointSolution":
        """The same estimate at other noise levels, fields of JointData by name."""
        return replace(self, data=replace(self.data, **levels))

    def information(self) -> np.ndarray:
        """What every placement says about the shared unknowns, shape (p, c, c)."""
        return self.score().information

    def score(self, changed: JointObservations | None = None, step: float = 1.0) -> Score:
        """What every placement says about the shared unknowns and, tested, about one more.

        Parameters
        ----------
        changed : JointObservations, optional
            As they would be if the truth were off by one unknown more.
        step : float
            The value of that unknown there.
        """
        shared = self.unknowns.shared
        after = {}
        if changed is not None:
            data = gather(changed, **self.data.levels)
            after = named_blocks(self.state, data, self.unknowns)
        hessian = gradient = 0.0
        for name, block in self.blocks.items():
            J = block.white_jacobian
            if after:
                by_one_more = (after[name].white - block.white) / step
                J = np.insert(J, shared, by_one_more, axis=-1)
            transposed = np.swapaxes(J, -1, -2)
            hessian = hessian + transposed @ J
            gradient = gradient + (transposed @ block.white[..., None])[..., 0]
        information, score, _ = eliminate(hessian, gradient, shared + bool(after))
        return Score(information, score)

    def board_information(self) -> np.ndarray:
        """What the scans of every placement say about the pose of its board, shape (p, 6, 6).

        By increments ``[w, v]`` of ``T_platform_board``, with everything else known.
        """
        columns = self.unknowns.columns["board"]
        information = np.zeros((len(self.boards), 6, 6))
        for group in self.blocks.keys() & {"face", "beam"}:
            J = self.blocks[group].white_jacobian[..., columns]
            information += np.swapaxes(J, -1, -2) @ J
        return information

    def columns(self, prefix):
        """Indices of the shared unknowns whose names begin so."""
        return [i for i, name in enumerate(self.solution.names) if name.startswith(prefix)]

    def covariance(self, *prefixes):
        """Covariance to rely on of groups of shared unknowns, e.g.

        'left_' or 'axis'; see `Solution.trusted`.
        """
        index = sum(map(self.columns, prefixes), [])
        return self.solution.trusted[np.ix_(index, index)]

    @property
    def corrections(self) -> Corrections:
        """Errors of what was recorded, as far as they were estimated: range offset, scale and
        sweeps of the pitch.
        """
        by_direction = self.sensor["pitch_by_direction"]
        sweeps = {}
        for row, (placement, (offset, stretch)) in enumerate(self.sweeps.items()):
            turn = by_direction * self.observations.direction[row]
            sweeps[placement] = SweepPitch(turn + offset, stretch, self.observations.middle[row])
        return Corrections(self.sensor["range_offset"], self.sensor["pitch_scale"], sweeps)

    def camera_at(self, name, pitch):
        """``T_camera_platform`` of a camera while the head stands at a pitch (radians), or at
        several.
        """
        mount = self.observations.mounts[self.observations.cameras.index(name)]
        return camera_at(self.transforms[name], mount, self.T_head_lrf, pitch)

    def camera(self, name):
        """The pose of one camera as a `Solution` like those of the other methods."""
        index = self.columns(f"{name}_")
        whole = self.solution
        pose = pose_array(self.transforms[name])
        both = {key: getattr(whole, key) for key in ("covariance", "covariance_placements")}
        spread = {
            key: None if value is None else value[np.ix_(index, index)]
            for key, value in both.items()
        }
        return replace(
            whole,
            transform=self.transforms[name],
            parameters=pose_parameters(pose),
            names=geometry.POSE_NAMES,
            jacobian=whole.jacobian[..., index],
            state=pose,
            **spread,
        )

    def __repr__(self):
        return f"JointSolution({len(self.boards)} placements, {self.solution!r})"


@dataclass(frozen=True)
class Start:
    """A start value of the joint estimate.

    Attributes
    ----------
    kept : JointObservations
        Without what contradicts it.
    state : JointState
    left_out : dict of int or str to str
        What is not kept, in words.
    settled : bool
        Whether more steps with the coarse unknowns would change nothing.
    badness : float
        Mean half squared residual of what is kept; the share that is left out counts against it.
    rough_miss : float
        Median distance of scans from the boards before any step, metres.
    """

    kept: JointObservations
    state: JointState
    left_out: dict
    settled: bool
    badness: float
    rough_miss: float = 0.0


def solve_joint(
    obs,
    T0=None,
    *,
    prior=None,
    axis=True,
    sensor=SENSOR[:3],
    sides=False,
    sweep="none",
    sweep_sigma=SWEEP_SIGMA,
    lapse=0.0,
    noise="stated",
    start=None,
    required=True,
):
    """Estimate axis, cameras, range offset, edge bias and the pose of every board at once.

    Parameters
    ----------
    obs : JointObservations
    T0 : RigidTransform, optional
        Rough ``T_head_lrf``; closed forms are tried in any case.
    prior : PlatformPrior, optional
        A rough measurement of the axis with its standard deviations. It yields where the data
        contradict it.
    axis : bool
        False: the axis is the one of T0 (or the stated one), and known.
    sensor : sequence of str
        Unknowns of the sensor, of :data:`lrfcal_lib.solvers.joint_model.SENSOR`; others stay zero
        (softness: 0.2).
    sides : bool
        Every side of every placement deviates from the sensor's edge bias, because backgrounds are
        not alike.
    sweep : {'none', 'offset', 'offset_stretch'}
        Errors of the recorded pitch that every sweep has of its own.
    sweep_sigma : tuple of float
        Their expected standard deviations, radians and fraction.
    lapse : float
        Share of edge beams expected to say nothing.
    noise : {'stated', 'estimate'}
        Estimate the noise levels (ranges, images, pitch, sides, repetition of errors among
        neighbours) from the residuals, and leave out placements and images that contradict all
        others, by name.
    start : JointState, optional
        Skips the search for a start value.
    required : bool
        False: report unobservable motions instead of raising.

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
    obs, excluded = without_blind_cameras(obs, required)
    unknowns = Unknowns(len(obs.cameras), len(obs.edges), axis, tuple(sensor), sweep, sides=sides)
    rivals = ()
    settled = False
    if start is None:
        obs, lost = without_lost_placements(obs)
        best, rivals = best_start(obs, unknowns, sweep_sigma, T0)
        obs = best.kept
        start = best.state
        settled = best.settled
        excluded = excluded | lost | best.left_out
    data = gather(obs, sweep_sigma=tuple(sweep_sigma), prior=prior)
    # stated levels of the noise may be wrong by far: what takes many steps with them leads away
    if prior is not None or not settled:
        start = converged(start, data, coarse(unknowns), steps=FIRST_STEPS)
    state = converged(start, data, unknowns, LAST_STEP, FIRST_STEPS)
    data = replace(data, lapse=lapse)
    if noise == "estimate":
        state, data = settle(state, data, unknowns)
        obs, state, data, bad = drop_contradictions(obs, state, data, unknowns)
        if bad:
            excluded = excluded | bad
            state, data = settle(state, data, unknowns)
    if noise == "estimate" or lapse:
        state = converged(state, data, unknowns, LAST_STEP)
    if required:  # a cause before what follows from it: edges that fit nowhere, say
        refuse_contradiction(state, data, LAST_MISS)
    found = finished(obs, state, data, unknowns, excluded, required)
    return replace(found, warnings=rivals + found.warnings)


def solve_again(obs, like):
    """Solve for some of the placements of a solution with its settings, noise levels and start
    value.

    Raises DegenerateGeometry when these placements leave a motion open.
    """
    known = list(like.boards)
    rows = [known.index(int(p)) for p in obs.placements if int(p) in known]
    obs = obs.select([known[row] for row in rows])
    data = gather(obs, **like.data.levels)
    state = converged(of_placements(like.state, rows), data, like.unknowns, LAST_STEP)
    return finished(obs, state, data, like.unknowns, like.excluded, True)


def check_settings(obs, sensor, sweep_sigma, noise, lapse):
    """Refuse settings that contradict themselves."""
    unknown = next((name for name in sensor if name not in SENSOR), None)
    for wrong, words in (
        (unknown is not None, f"sensor unknowns are {', '.join(SENSOR)}; got {unknown!r}"),
        (noise not in ("stated", "estimate"), f"noise is 'stated' or 'estimate', got {noise!r}"),
        (
            not 0 <= lapse < 0.5,
            f"lapse is the share of beams that say nothing, 0 to 0.5, got {lapse}",
        ),
        (
            min(sweep_sigma) <= 0,
            f"sweep_sigma must be positive (radians, fraction), got {sweep_sigma}",
        ),
    ):
        if wrong:
            raise ValueError(words)
    if len(obs.placements) == 0:
        raise DegenerateGeometry("no placement to calibrate with")


def without_blind_cameras(obs, required):
    """Leave out cameras that never see a board, by name.

    Refuse them where everything is required.
    """
    blind = [name for i, name in enumerate(obs.cameras) if not (obs.view_camera == i).any()]
    words = {
        f"camera {name}": f"camera '{name}' never sees the board: its pose stays open"
        for name in blind
    }
    if blind and required:
        raise DegenerateGeometry("; ".join(words.values()) + "; leave it out with obs.with_cameras")
    return (obs.with_cameras([n for n in obs.cameras if n not in blind]) if blind else obs), words


def without_lost_placements(obs):
    """Leave out placements that no image shows and whose scans cross fewer than two edges, by
    name.
    """
    count = np.zeros((len(obs.placements), len(obs.edges)), int)
    np.add.at(count, (obs.beam_placement[obs.beam_hit], obs.beam_edge[obs.beam_hit]), 1)
    crossed = np.sum(count >= FEWEST_ANGLE_POINTS, axis=1)
    lost = (crossed < 2) & ~np.isin(np.arange(len(crossed)), obs.view_placement)
    words = {}
    for placement, n in zip(obs.placements[lost].tolist(), crossed[lost], strict=True):
        words[placement] = (
            f"placement {placement}: no image shows the board and scans cross {n} edges, "
            "two needed; left out"
        )
    if lost.all():
        raise DegenerateGeometry("; ".join(words.values()))
    return obs.select(obs.placements[~lost]), words


def fit(state, data, unknowns, tolerance=ROUGH_STEP, steps=MOST_STEPS):
    """What :func:`lrfcal_lib.fit.least_squares.minimise` makes of a state nearby."""
    return minimise(
        lambda s: joint_blocks(s, data, unknowns),
        state,
        lambda s, step: move_state(s, step, unknowns),
        shared=unknowns.shared,
        max_iterations=steps,
        tolerance=tolerance,
    )


def converged(*problem, **options):
    """The state that explains the data best, from one nearby: the first that :func:`fit`
    returns.
    """
    return fit(*problem, **options)[0]


def coarse(unknowns):
    """The unknowns without those of the edges: from far away, beams on the wrong side would
    blow up the softness.
    """
    return replace(
        unknowns, sensor=tuple(n for n in unknowns.sensor if not n.startswith("edge_")), sides=False
    )


def of_placements(state, rows):
    """The state of some placements (by index)."""
    return replace(state, **{key: getattr(state, key)[rows] for key in OWN})


def without(obs, state, views, placements):
    """Observations and state without some views and placements (by index)."""
    kept = obs.keep(view=~np.isin(np.arange(len(obs.view_camera)), views)).select(
        np.delete(obs.placements, placements)
    )
    return kept, of_placements(state, np.delete(np.arange(len(obs.placements)), placements))


def image_name(obs, row):
    """A view in words."""
    pitch = np.degrees(obs.view_pitch[row])
    camera = obs.cameras[obs.view_camera[row]]
    return (
        f"placement {obs.placements[obs.view_placement[row]]}, image of '{camera}' at "
        f"{pitch:.1f} deg"
    )


def best_start(obs, unknowns, sweep_sigma, T0=None):
    """The most promising Start, and in words its rivals.

    More than 30 % of the placements that contradict the rest raise DegenerateGeometry: nobody knows
    which ones are wrong.
    """
    data = gather(obs, sweep_sigma=tuple(sweep_sigma))
    tried = []
    for number, states in enumerate(start_states(obs, T0)):
        for state in states:
            if not unknowns.axis:
                known = next(
                    h for h in (T0, obs.T_head_lrf, RigidTransform.identity()) if h is not None
                )
                state = replace(state, head=pose_array(known))
            misses = joint_noise.face_misses(
                state, data, state.boards, np.arange(len(state.boards))
            )
            start = agreeing_start(obs, state, data, unknowns)
            tried.append(replace(start, rough_miss=float(np.median(misses))))
        if min(start.badness for start in tried) < GOOD_START and (T0 is None or number):
            break
    best = min(tried, key=lambda start: start.badness)
    if best.rough_miss > ROUGH_MISS:
        refuse_contradiction(best.state, gather(best.kept), ROUGH_MISS)
    if max(left_out_shares(obs, best.left_out)) > LARGEST_SHARE:
        bad = list(best.left_out)
        raise DegenerateGeometry(
            f"{len(bad)} placements or images of {len(obs.placements)} placements contradict the "
            "others: images put "
            f"boards elsewhere than scans ({', '.join(map(str, bad[:8]))}); check that images and "
            "scans carry the right numbers"
        )
    return best, second_minima(obs, tried, best)


def refuse_contradiction(state, data, most):
    """Raise DegenerateGeometry where images put a third of the boards more than `most` metres
    off where they are.
    """
    seen = data.view["used"].any(axis=1)
    if (
        seen.any()
        and (miss := np.quantile(joint_noise.view_misses(state, data)[seen], 2 / 3)) > most
    ):
        raise DegenerateGeometry(
            "images and scans contradict each other: for a third of the placements the board "
            f"lies {1000 * miss:.0f} "
            "mm or more off where the images put it; check that images and scans carry the right "
            "numbers"
        )


def second_minima(obs, tried, best):
    """In words, which cameras a start value that fits nearly as well puts elsewhere."""
    others = sorted(tried, key=lambda start: start.badness)
    rivals = {}
    for start in (start for start in others if start.badness <= NEARLY**2 * best.badness):
        for name, *poses in zip(obs.cameras, best.state.cameras, start.state.cameras, strict=True):
            both = [pose_transform(pose) for pose in poses]
            if name not in rivals and geometry.transform_difference(*both)[0] > SAME_TURN:
                rivals[name] = rival_words(name, *both)
    return tuple(rivals.values())


def left_out_shares(obs, bad):
    """Shares of the placements, and of the images of the others, that a start value leaves out."""
    placements = sum(not isinstance(name, str) for name in bad)
    return placements / len(obs.placements), (len(bad) - placements) / max(len(obs.view_camera), 1)


def agreeing_start(obs, state, data, unknowns):
    """A few steps without what contradicts a start value; what a rough one leaves out is judged
    again by the rest.

    The better one of both attempts, a Start: what still contradicts may have led the rest astray.
    """
    few = coarse(unknowns)
    tried = []
    for _ in range(2):
        kept, fitting, bad = without_contradictions(obs, state, data)
        cut = gather(kept, **data.levels) if bad else data
        found, settled, _, costs = fit(fitting, cut, few, steps=START_STEPS)
        share = max(left_out_shares(obs, bad))
        cost = np.nan_to_num(costs[-1], nan=np.inf) / count_rows(kept) * (1 + CONTRADICTION * share)
        tried.append(Start(kept=kept, state=found, left_out=bad, settled=settled, badness=cost))
        if not bad or share > LARGEST_SHARE:
            break
        state = state_of(
            obs, pose_transform(found.head), [pose_transform(pose) for pose in found.cameras]
        )
    return min(tried, key=lambda start: start.badness)


def without_contradictions(obs, state, data):
    """Leave out images that put the board far off where it was scanned, and placements of which
    none is left.
    """
    place = obs.view_placement
    if len(place) == 0:
        return obs, state, {}
    boards = boards_in_images(obs, state.head, state.cameras, np.arange(len(place)))
    misses = joint_noise.face_misses(state, data, boards, place)
    wrong = misses > max(LAST_MISS, FAR_MISS * np.median(misses))
    if not wrong.any():
        return obs, state, {}
    good, first = np.unique(place[~wrong], return_index=True)
    out = np.setdiff1d(place, good)
    single = np.flatnonzero(wrong & np.isin(place, good))
    own = state.boards.copy()
    own[good] = boards[~wrong][first]
    words = {
        int(
            obs.placements[i]
        ): f"placement {obs.placements[i]}: the scan is {1000 * misses[place == i].min():.0f} mm "
        "off where its image puts the board; left out"
        for i in out
    }
    for row in single:
        name = image_name(obs, row)
        words[name] = (
            f"{name}: it puts the board {1000 * misses[row]:.0f} mm off the scan; the image is "
            "left out"
        )
    return *without(obs, replace(state, boards=own), single, out), words


def settle(state, data, unknowns):
    """Estimate unknowns and noise levels in turn until they agree."""
    for _ in range(NOISE_ROUNDS):
        before = data
        data = joint_noise.estimate_noise(state, data, unknowns)
        state = converged(state, data, unknowns, steps=ROUND_STEPS)
        if joint_noise.same_levels(before, data):
            break
    return state, data


def drop_contradictions(obs, state, data, unknowns):
    """Leave out placements whose residuals are far larger than the others', or the one image
    that makes them so.
    """
    found, usual = contradictions(state, data, unknowns)
    limits = CONTRADICTION * usual
    views = []
    out = []
    words = {}
    for i in np.flatnonzero((found > limits).any(axis=1)):
        view, board = wrong_image(obs, state, data, unknowns, i, limits)
        why = f"residuals are {np.sqrt(np.max(found[i] / usual)):.0f} times those of the others"
        if view is not None:
            views = [*views, view]
            state.boards[i] = board
            words[image_name(obs, view)] = (
                f"{image_name(obs, view)}: with it {why}; the image is left out"
            )
        elif found[i, 0] > limits[0]:
            out.append(i)
            words[int(obs.placements[i])] = f"placement {obs.placements[i]}: its {why}; left out"
    if words:
        obs, state = without(obs, state, views, out)
        data = gather(obs, **data.levels)
    return obs, state, data, words


def contradictions(state, data, unknowns):
    """Misfits of placements, and of their images alone, shape (p, 2), and what is usual of both,
    shape (2,).

    A wrong image raises the noise level of all images until ranges outvote it: images are compared
    with images.
    """
    blocks = named_blocks(state, data, unknowns)
    several = data.view["used"].sum(axis=1) > 1
    found = np.stack(
        [joint_noise.misfits(blocks, data, groups) for groups in (("face", "view"), ("view",))],
        axis=1,
    )
    images = np.median(found[several, 1]) if several.any() else np.inf
    return found, np.array([max(np.median(found[:, 0]), 1.0), max(images, LEAST_MISFIT)])


def wrong_image(obs, state, data, unknowns, i, limits):
    """The view without which placement i agrees with the others (None where there is none), and its
    board then.

    Every view is left out once, in copies of the placement, with all that the placements share
    held.
    """
    rows = np.flatnonzero(obs.view_placement == i)
    if len(rows) < 2:
        return None, None
    copies = np.full(len(rows), i)
    each = np.arange(len(rows))
    state = replace(
        of_placements(state, copies),
        boards=boards_in_images(obs, state.head, state.cameras, np.roll(rows, -1)),
    )
    groups = {
        name: {key: v[copies] for key, v in getattr(data, name).items()}
        for name in ("face", "beam", "view")
    }
    groups["view"]["used"][each, each] = False
    groups["view"]["whitener"] = (
        groups["view"]["whitener"] * groups["view"]["used"][..., None, None]
    )
    data = replace(data, **groups, middle=data.middle[copies], direction=data.direction[copies])
    lone = replace(unknowns, axis=False, sensor=(), poses=False)
    state = converged(state, data, lone, steps=START_STEPS)
    found = np.max(contradictions(state, data, lone)[0] / limits, axis=1)
    best = int(np.argmin(found))
    return (rows[best], state.boards[best]) if found[best] <= 1 else (None, None)


def count_rows(obs):
    """Number of observations."""
    return len(obs.face_range) + len(obs.beam_hit) + len(obs.view_pitch)


def in_stated_gauge(state, obs):
    """Turn about the axis and shift along it, which no data show, as the stated platform has
    them.
    """
    found = pose_transform(state.head)
    head = geometry.head_from_axis(geometry.axis_of(found))
    if obs.T_head_lrf is not None:
        head = (
            obs.T_head_lrf * geometry.head_from_axis(geometry.axis_of(obs.T_head_lrf)).inv() * head
        )
    change = head * found.inv()
    cameras = state.cameras.copy()
    for i in np.flatnonzero(np.array(obs.mounts) == "platform"):
        cameras[i] = pose_array(pose_transform(cameras[i]) * change.inv())
    boards = pose_array(change * pose_transform(state.boards))
    return replace(state, head=pose_array(head), boards=boards, cameras=cameras)


def joint_words(direction, names, cameras):
    """A direction of the shared unknowns in words."""
    direction = np.asarray(direction) / np.max(np.abs(direction))
    large = np.abs(direction) > 0.3
    words = []
    for camera in cameras:
        index = [i for i, name in enumerate(names) if name.startswith(f"{camera}_")]
        if large[index].any():
            words.append(geometry.motion_words(direction[index], camera))
    return " with ".join(
        words + [WORDS[name] for name, it in zip(names, large, strict=True) if it and name in WORDS]
    )


def finished(obs, state, data, unknowns, excluded, required):
    """The last steps, in the gauge of the stated platform, and all that a solution says."""
    names = unknowns.names(obs.cameras)

    def read(s):
        poses = pose_parameters(s.cameras).ravel() if len(s.cameras) else ()
        return None, np.concatenate([chart_parameters(s.head), poses, s.sensor])[unknowns.mask]

    found = solve(
        lambda s: joint_blocks(s, data, unknowns),
        in_stated_gauge(state, obs),
        lambda s, step: move_state(s, step, unknowns),
        names=names,
        method="joint",
        read=read,
        scales=[SCALES.get(name, 1.0) for name in names],
        words=lambda d: joint_words(d, names, obs.cameras),
        shared=unknowns.shared,
        freedom=0,
        required=required,
        limit=UNSEEN,
        max_iterations=MOST_STEPS,
        tolerance=LAST_STEP,
        n_observations=count_rows(obs),
    )
    lens, twice, lens_scale = joint_noise.lens_covariance(obs, found, data, unknowns)
    spread = None if found.covariance_placements is None else found.covariance_placements + lens
    found = replace(found, covariance=found.covariance + lens - twice, covariance_placements=spread)
    wider = replace(unknowns, sensor=tuple(dict.fromkeys((*unknowns.sensor, *joint_noise.TERMS))))
    state = found.state
    blocks = named_blocks(found.state, data, wider)
    numbers = obs.placements.tolist()
    levels = ("face_scale", "face_share", "beam_share", "sigma_pitch", "side_sigma")
    return JointSolution(
        found,
        obs,
        data,
        unknowns,
        T_head_lrf=pose_transform(state.head),
        transforms={
            name: pose_transform(pose)
            for name, pose in zip(obs.cameras, state.cameras, strict=True)
        },
        boards=dict(zip(numbers, pose_transform(state.boards), strict=True)),
        sensor=dict(zip(SENSOR, state.sensor.tolist(), strict=True)),
        sweeps=dict(zip(numbers, state.sweeps, strict=True)),
        noise={name: float(getattr(data, name)) for name in levels}
        | ({"view_scale": float(data.view_scale[0])} if len(obs.cameras) else {}),
        misfit=dict(zip(numbers, joint_noise.misfits(blocks, data).tolist(), strict=True)),
        excluded=excluded,
        lens=lens,
        lens_scale=lens_scale,
        warnings=joint_noise.joint_warnings(blocks, data, wider, found, obs.cameras),
    )
