"""One maximum-likelihood estimate of the whole rig from ranges, edges and images at all pitch
angles.

Equations (4) to (6) and (16) to (19) at once, every board's pose unknown and eliminated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from lrfcal_lib.fit.covariance import dyads, pseudo_inverse
from lrfcal_lib.fit.least_squares import solve
from lrfcal_lib.fit.padding import among
from lrfcal_lib.fit.result import PlatformPrior
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    axis_of,
    head_from_axis,
    pose_array,
    pose_transform,
)
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.solvers.joint_model import (
    SENSOR,
    SWEEPS,
    JointState,
    Levels,
    Unknowns,
    gather,
)
from lrfcal_lib.solvers.joint_noise import estimate_noise, settled
from lrfcal_lib.solvers.joint_residuals import MOST_STEPS, minimum, named_blocks
from lrfcal_lib.solvers.joint_solution import JointSolution, joint_words
from lrfcal_lib.solvers.joint_start import (
    LAST_MISS,
    best_start,
    coarse,
    refuse_contradiction,
    without_blind_cameras,
    without_lost_placements,
)

# what counts as a change by one, beside rad and m
SCALES = {
    "edge_log_odds": 10.0,
    "edge_log_softness": 10.0,
}
FIRST_STEPS = 60
NOISE_ROUNDS = 10
ROUND_STEPS = 10
LAST_STEP = 1e-4  # standard deviations: a shorter step ends the whole
STEP = 1e-4  # of the numeric derivative by the angular step, a fraction of it
# a direction whose standard deviation exceeds this (rad, m) is called unobservable
UNSEEN = 0.5


@dataclass(frozen=True, kw_only=True)
class JointSettings:
    """What is unknown and expected.

    Attributes
    ----------
    prior : PlatformPrior, optional
        A rough measurement of the axis with its standard deviations. It yields where the data
        contradict it.
    axis : bool
        False: the axis is the stated one, and known.
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
    step_sigma : float
        Standard deviation of the angular step of the beams, a fraction of it. It is no unknown; the
        covariance has what it does to the result.
    noise : {'stated', 'estimate'}
        Estimate the noise levels (ranges, images, pitch, sides, repetition of errors among
        neighbours) from the residuals, and leave out placements and images that contradict all
        others.

    Raises
    ------
    ValueError
        For unknown names and contradictory noise settings.
    """

    prior: PlatformPrior | None = None
    axis: bool = True
    sensor: tuple[str, ...] = SENSOR[:3]
    sides: bool = False
    sweep: str = "none"
    sweep_sigma: Sequence[float] = Levels.sweep_sigma
    lapse: float = 0.0
    step_sigma: float = 0.0
    noise: str = "stated"

    def __post_init__(self):
        for name in self.sensor:
            if name not in SENSOR:
                raise ValueError(f"sensor unknowns are {', '.join(SENSOR)}; got {name!r}")
        if self.noise not in ("stated", "estimate"):
            raise ValueError(f"noise is 'stated' or 'estimate', got {self.noise!r}")


def solve_joint(
    obs: JointObservations,
    *,
    start: JointState | None = None,
    required: bool = True,
    **settings,
) -> JointSolution:
    """Estimate axis, cameras, range offset, edge bias and the pose of every board at once.

    Parameters
    ----------
    obs : JointObservations
    start : JointState, optional
        Skips the search for a start value.
    required : bool
        False: report unobservable motions instead of raising.
    **settings
        Fields of :class:`JointSettings`.

    Raises
    ------
    DegenerateGeometry
        Naming the unobservable motions, when `required`, or when there is no start value.
    ValueError
        For settings that contradict themselves, or observations that are not finite.
    """
    chosen = JointSettings(**settings)
    if len(obs.placements) == 0:
        raise DegenerateGeometry("no placement to calibrate with")
    obs, left_out = without_blind_cameras(obs, required)
    unknowns = Unknowns(
        len(obs.cameras),
        len(obs.edges),
        axis=chosen.axis,
        sensor=chosen.sensor,
        sweep=chosen.sweep,
        sides=chosen.sides,
    )
    levels = Levels(
        sweep_sigma=chosen.sweep_sigma[: SWEEPS[chosen.sweep]], step_sigma=chosen.step_sigma
    )
    arrived = False
    if start is None:
        obs, lost = without_lost_placements(obs)
        best = best_start(obs, unknowns, levels)
        obs = best.kept
        start = best.state
        arrived = best.converged and chosen.prior is None
        left_out += lost + best.left_out
    data = gather(obs, replace(levels, prior=chosen.prior))
    # stated levels of the noise may be wrong by far: what takes many steps with them leads away
    if not arrived:
        start = minimum(start, data, coarse(unknowns), steps=FIRST_STEPS).state
    state = minimum(start, data, unknowns, LAST_STEP, FIRST_STEPS).state
    data = data.with_levels(lapse=chosen.lapse)
    if chosen.noise == "estimate":
        state, data = settle(state, data, unknowns)
    if chosen.noise == "estimate" or chosen.lapse:
        state = minimum(state, data, unknowns, LAST_STEP).state
    if required:  # a cause before what follows from it: edges that fit nowhere, say
        refuse_contradiction(obs, state, LAST_MISS, left_out)
    return finished(obs, state, data, unknowns, required, left_out)


def solve_again(obs: JointObservations, like: JointSolution) -> JointSolution:
    """Solve for some of the placements of a solution with its settings, noise levels and start
    value.

    Raises DegenerateGeometry when these placements leave a motion open.
    """
    rows = np.isin(like.observations.placements, obs.placements)
    obs = obs.select(like.observations.placements)
    data = gather(obs, like.data.levels)
    start = like.state.of_placements(rows)
    state = minimum(start, data, like.unknowns, LAST_STEP).state
    return finished(obs, state, data, like.unknowns, required=True, excluded=like.excluded)


def settle(state, data, unknowns):
    """Estimate unknowns and noise levels in turn until they agree."""
    for _ in range(NOISE_ROUNDS):
        before = data.levels
        data = estimate_noise(state, data, unknowns)
        state = minimum(state, data, unknowns, steps=ROUND_STEPS).state
        if settled(before, data.levels):
            break
    return state, data


def in_stated_gauge(state: JointState, obs: JointObservations) -> JointState:
    """Turn about the axis and shift along it, which no data show, as the stated platform has
    them.
    """
    found = pose_transform(state.head)
    head = head_from_axis(axis_of(found), obs.T_head_lrf)
    change = head * found.inv()
    on_base = pose_array(pose_transform(state.cameras) * change.inv())
    cameras = np.where(obs.on_head[:, None, None], state.cameras, on_base)
    boards = pose_array(change * pose_transform(state.boards))
    return replace(state, head=pose_array(head), boards=boards, cameras=cameras)


def finished(obs, state, data, unknowns, required, excluded):
    """The last steps, in the gauge of the stated platform, and all that a solution says."""
    names = unknowns.names(obs.cameras)
    found = solve(
        lambda at: named_blocks(at, data, unknowns).values(),
        in_stated_gauge(state, obs),
        unknowns.move,
        shared=unknowns.shared,
        names=names,
        method="joint",
        read=unknowns.read,
        scales=[SCALES.get(name, 1.0) for name in names],
        words=lambda direction: joint_words(direction, names, obs.cameras),
        freedom=0,
        required=required,
        limit=UNSEEN,
        max_iterations=MOST_STEPS,
        tolerance=LAST_STEP,
        n_observations=obs.count,
    )
    solution = JointSolution(
        found,
        obs,
        data,
        unknowns,
        excluded=tuple(excluded),
        lens=np.zeros_like(found.covariance),
        lens_scale=0.0,
        step=np.zeros(unknowns.shared),
    )
    return with_step_error(with_lens_error(solution))


def with_lens_error(solution: JointSolution) -> JointSolution:
    """The solution with what errors of the intrinsics, which all images share, do to it, by
    equations (18) and (19) to first order.

    They let views scatter, too, by what no unknown can take up of the error that all views of a
    camera share. As far as that exceeds the stated noise, the scale of views has added it to the
    covariance, where it would count twice.
    """
    obs = solution.observations
    if not np.any(obs.lens_covariance):
        return solution
    found = solution.solution
    view = solution.data.view
    c = solution.unknowns.shared
    block = solution.blocks["view"]
    J = block.white_jacobian
    J_own = J[..., c:]
    by_lens = among(view["lens"], view["camera"][..., None], len(obs.cameras))
    shift = block.whitened(by_lens.reshape(*J.shape[:2], -1))
    spread = block_diag(*obs.lens_covariance)
    hessian = found.jacobian.mT @ found.jacobian
    own = pseudo_inverse(hessian[:, c:, c:])
    reduced = J[..., :c] - J_own @ own @ hessian[:, c:, :c]
    finite = np.nan_to_num(found.covariance, posinf=0.0, neginf=0.0)
    gain = finite @ np.sum(reduced.mT @ shift, axis=0)
    left = shift - reduced @ gain - J_own @ (own @ (J_own.mT @ shift))
    square = np.sum(left @ spread * left)
    level = solution.data.levels.view_scale**2
    information = np.sum(reduced.mT @ reduced, axis=0)
    taken = np.sum((J_own @ own) * J_own) + np.sum(information * finite)
    # rows that are left to show it
    square *= level / max(6 * len(obs.view_camera) - taken, 1.0)
    share = np.clip(level - 1, 0, square) / level
    lens = gain @ spread @ gain.T
    widened = found.widened(lens - share * finite @ information @ finite, lens)
    return replace(solution, solution=widened, lens=lens, lens_scale=np.sqrt(square))


def with_step_error(solution: JointSolution) -> JointSolution:
    """The solution with what errors of the angular step do to it in its covariances."""
    sigma = solution.data.levels.step_sigma
    if sigma == 0:
        return solution
    changed = gather(solution.observations.stretched(STEP), solution.data.levels)
    here = solution.score()
    pull = replace(solution, data=changed).score().gradient - here.gradient
    free = pseudo_inverse(here.information.sum(axis=0))
    moved = -free @ pull.sum(axis=0) / STEP * sigma
    spread = dyads(moved)
    return replace(solution, solution=solution.solution.widened(spread, spread), step=moved)
