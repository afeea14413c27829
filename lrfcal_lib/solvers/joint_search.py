"""The start value of the joint estimate that leads to the best minimum, among closed forms.

No equations of its own.
"""

from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.model.problem import Problem
from lrfcal_lib.solvers.joint_contradictions import (
    LARGEST_SHARE,
    face_miss,
    left_out_share,
    refuse_contradiction,
    without_contradictions,
)
from lrfcal_lib.solvers.joint_model import JointState, Levels, Unknowns, gather
from lrfcal_lib.solvers.joint_residuals import minimum
from lrfcal_lib.solvers.joint_start import start_states, state_of

# mean half squared residual; a start value this good is not searched further
GOOD_START = 0.7
ROUGH_MISS = 0.08  # metres, of a start value's boards from where images put them
# of all that is left out: what it counts against a start value
PENALTY = 16.0
FEW_STEPS = 8  # of a minimisation that only has to show where it leads


@dataclass(frozen=True)
class Start:
    """A start value of the joint estimate.

    Attributes
    ----------
    kept : JointObservations
        Without what contradicts it.
    state : JointState
    left_out : list of Problem
    badness : float
        Mean half squared residual of what is kept; the share that is left out counts against it.
    miss : float
        By how much the closed form, before any step, puts points off their boards, metres (median).
    converged : bool
        Whether the few steps led to the end.
    """

    kept: JointObservations
    state: JointState
    left_out: list[Problem]
    badness: float
    miss: float
    converged: bool


def best_start(obs: JointObservations, unknowns: Unknowns, levels: Levels) -> Start:
    """The most promising start value.

    More than 30 % of the placements that contradict the rest raise DegenerateGeometry: nobody knows
    which ones are wrong.
    """
    data = gather(obs, levels)
    tried = []
    for states in start_states(obs, unknowns.axis):
        tried += [agreeing_start(obs, state, data, unknowns) for state in states]
        best = min(tried, key=lambda start: start.badness)
        if best.badness < GOOD_START:
            break
    if best.miss > ROUGH_MISS:  # a camera that was knocked is to be named, not refused
        refuse_contradiction(best.kept, best.state, ROUGH_MISS)
    if left_out_share(obs, best.left_out) > LARGEST_SHARE:
        words = "; ".join(map(str, best.left_out[:8]))
        raise DegenerateGeometry(
            f"{len(best.left_out)} placements or images of {len(obs.placements)} placements "
            f"contradict the others ({words}); check that images and scans carry the right numbers"
        )
    return best


def coarse(unknowns: Unknowns) -> Unknowns:
    """The unknowns without those of the edges: from far away, beams on the wrong side would blow
    up the softness.
    """
    of_edges = ("edge_log_odds", "edge_log_softness")
    sensor = tuple(name for name in unknowns.sensor if name not in of_edges)
    return replace(unknowns, sensor=sensor, sides=False)


def agreeing_start(obs, state, data, unknowns):
    """A few steps without what contradicts a start value; what a rough one leaves out is judged
    again by the rest.

    The better one of both attempts, a Start: what still contradicts may have led the rest astray.
    """
    miss = face_miss(state, data)
    attempts = []
    for _ in range(2):
        kept, fitting, left_out = without_contradictions(obs, state, data)
        cut = gather(kept, data.levels) if left_out else data
        found = minimum(fitting, cut, coarse(unknowns), steps=FEW_STEPS)
        share = left_out_share(obs, left_out)
        cost = np.nan_to_num(found.cost_history[-1], nan=np.inf) / kept.count
        badness = cost * (1 + PENALTY * share)
        attempts.append(Start(kept, found.state, left_out, badness, miss, found.converged))
        if not left_out or share > LARGEST_SHARE:
            break
        state = state_of(obs, found.state.head, found.state.cameras)
    return min(attempts, key=lambda start: start.badness)
