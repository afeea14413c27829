"""Several stations of a scene in one frame.

The frame of a joined cloud is the platform frame of one station, as the calibration states it. No
calibration knows the zero of the pitch: its platform frames are turned about the tilt axis, all by
the same angle. Stations joined do not tell that angle either. With G for the turn, a pose of the
true frames, ``T_12``, is ``G T_12 G^-1`` here: a joined cloud has the right shape whatever G is,
and only a level or a plumb line would tell G. Compare poses with a truth after turning it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.cloud import Cloud, join
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.fit.covariance import sigma_of
from lrfcal_lib.judge.uncertainty import COLUMNS, chain_of
from lrfcal_lib.measure.pairs import (
    COARSE,
    FINE,
    Pair,
    Surface,
    candidates,
    fitted,
    surface_of,
)
from lrfcal_lib.measure.pose_graph import connected, solved
from lrfcal_lib.model.geometry import (
    gradient_by_pose,
    length_of,
    transform_difference,
)
from lrfcal_lib.model.problem import Problem, ProblemKind, Stage

# Of pairs that were drawn (tests/rooms.py, other seeds than any test): right ones have an overlap
# of 0.4 to 0.95 and 0.001 to 0.022 against them, wrong ones seldom less than 0.06 against them
LEAST_OVERLAP = 0.2
MOST_AGAINST = 0.02
RIVAL = 0.3  # share of the best overlap from which another pose may be the right one
DOUBTFUL = 0.03  # against a rival
LEAST_HELD = 0.03  # share of patches that hold a station in its loosest direction
MOST_SIGMA = (np.radians(0.3), 0.015)  # of the turn and shift of a pair that is joined
GREATEST_MISS = 5.0  # sigma of a pair in a loop
ALLOWED_MISS = (np.radians(0.2), 0.01)  # and at least, of turn and shift


@dataclass(frozen=True)
class Joined:
    """Stations in one frame.

    Attributes
    ----------
    T_world_station : dict of int to RigidTransform
        Of all stations that could be joined. The world is the platform frame of the first of them.
    covariance : dict of int to ndarray, shape (6, 6)
        Of turn and shift of each; zeros for the first.
    pairs : tuple of Pair
        That were used.
    problems : tuple of Problem
        Stations and pairs that were not, and why.
    """

    T_world_station: dict[int, RigidTransform]
    covariance: dict[int, np.ndarray]
    pairs: tuple[Pair, ...]
    problems: tuple[Problem, ...]

    def miss(self, pair: Pair) -> np.ndarray:
        """Turn (radians) and shift (metres), (2,), by which a pair differs from the poses of all.

        That is the error which loops through it leave there; 0 without loops.
        """
        miss = pair.miss(self.T_world_station).reshape(2, 3)
        return length_of(miss)


def alone(station: int) -> Joined:
    """One station in its own frame."""
    return Joined({station: RigidTransform.identity()}, {station: np.zeros((6, 6))}, (), ())


def join_stations(clouds: Mapping[int, Cloud], rig: CalibratedRig | None = None) -> Joined:
    """Bring stations into one frame, without a guess where they stood.

    Parameters
    ----------
    clouds : dict of int to Cloud
        By station, each in its own platform frame, with sigma (:func:`features.with_sigma`). The
        platforms stood upright to about 10 deg.
    rig : CalibratedRig, optional
        That made them; without it, covariances leave out errors of the calibration.

    Returns
    -------
    Joined

    Raises
    ------
    ValueError
        For fewer than two stations, or a station without a smooth surface.
    """
    if len(clouds) < 2:
        raise ValueError(f"{len(clouds)} station: two or more are needed to join them")
    surfaces = {}
    for number, cloud in clouds.items():
        try:
            surfaces[number] = surface_of(cloud, COARSE), surface_of(cloud, FINE, rig)
        except ValueError as error:
            raise ValueError(f"station {number}: {error}") from error
    numbers = sorted(clouds)
    results = [join_pair(names, surfaces) for names in combinations(numbers, 2)]
    pairs = [result for result in results if isinstance(result, Pair)]
    problems = [result for result in results if isinstance(result, Problem)]
    of_rig = chain_of(rig).covariances[-1] if rig else np.eye(len(COLUMNS))
    return _joined(numbers, pairs, problems, of_rig)


def join_pair(
    names: tuple[int, int], surfaces: Mapping[int, tuple[Surface, Surface]]
) -> Pair | Problem:
    """Two stations beside each other.

    Parameters
    ----------
    names : tuple of int
        Their numbers.
    surfaces : dict of int to tuple of Surface
        By station, in patches of `COARSE` and of `FINE`.

    Returns
    -------
    Pair or Problem
        Why they are not joined.
    """
    (coarse, fine), (other_coarse, other_fine) = (surfaces[name] for name in names)
    tried = candidates(coarse, other_coarse)
    good = [c for c in tried if c.overlap > LEAST_OVERLAP and c.against < MOST_AGAINST]
    if not good:
        words = "they have no two directions of walls in common"
        if tried:
            best = max(tried, key=lambda c: c.overlap)
            words = (
                f"they do not overlap enough: at best {100 * best.overlap:.0f} % of the surfaces "
                f"fall together, while {100 * best.against:.0f} % of what one saw stands where the "
                "other looked through"
            )
        return _problem(names, ProblemKind.NO_OVERLAP, words)
    best = good[0]
    for other in tried:
        as_much = other.overlap > RIVAL * best.overlap and other.against < DOUBTFUL
        if other is not best and as_much:
            angle, far = transform_difference(best.T_first_second, other.T_first_second)
            return _problem(
                names,
                ProblemKind.AMBIGUOUS,
                f"they fit together in two ways, {far:.2f} m and {np.degrees(angle):.0f} deg apart "
                f"(overlap {100 * best.overlap:.0f} % and {100 * other.overlap:.0f} %): the scene "
                "repeats itself or is symmetric",
            )
    pair = fitted(names, fine, other_fine, best.T_first_second)
    turn_and_shift = [pair.covariance[:3, :3], pair.covariance[3:, 3:]]
    variance = np.linalg.norm(turn_and_shift, 2, axis=(1, 2))  # in the worst direction
    if pair.held < LEAST_HELD or np.any(np.sqrt(variance) > MOST_SIGMA):
        loose = "({:.2f}, {:.2f}, {:.2f})".format(*pair.loose)
        return _problem(
            names,
            ProblemKind.AMBIGUOUS,
            f"nothing holds the second along {loose} of the first, where "
            f"{100 * pair.held:.1f} % of the surfaces stand across: a corridor, or too little of "
            "both in view",
        )
    return pair


def _problem(names, kind, words):
    return Problem(Stage.STATIONS, kind, "stations {} and {}: {}".format(*names, words))


def _joined(numbers, pairs, problems, of_rig):
    """The Joined of the largest group of stations, without pairs that loops contradict."""
    largest = max((connected(pairs, number) for number in numbers), key=len)
    reference = min(largest)
    pairs = [pair for pair in pairs if pair.first in largest]
    joined = alone(reference)
    if pairs:
        poses, response = solved(pairs, largest)
        # noise of each pair, and the calibration, common to all
        noise = block_diag(*(pair.covariance for pair in pairs))
        by_rig = response @ np.vstack([pair.by_rig for pair in pairs])
        covariance = response @ noise @ response.mT + by_rig @ of_rig @ by_rig.mT
        of_each = dict(zip(poses, covariance, strict=True))
        joined = Joined(poses, of_each, tuple(pairs), ())
        worst = max(pairs, key=partial(_excess, joined))
        if _excess(joined, worst) >= 1.0:
            turn, shift = joined.miss(worst)
            problem = _problem(
                (worst.first, worst.second),
                ProblemKind.CONTRADICTS,
                f"the loops through them miss by {np.degrees(turn):.2f} deg and "
                f"{1000 * shift:.0f} mm: they are not used together",
            )
            others = [pair for pair in pairs if pair is not worst]
            return _joined(numbers, others, [*problems, problem], of_rig)
    for number in numbers:
        if number not in largest:
            words = (
                f"station {number} is left out: nothing joins it to station {reference}; record "
                "one between them that sees what both see"
            )
            problems.append(Problem(Stage.STATIONS, ProblemKind.LEFT_OUT, words))
    return replace(joined, problems=tuple(problems))


def _excess(joined, pair):
    """By how much a pair misses the poses of all, as a share of what is allowed."""
    expected = GREATEST_MISS * sigma_of(pair.covariance)
    allowed = np.maximum(expected, np.repeat(ALLOWED_MISS, 3))
    return np.max(np.abs(pair.miss(joined.T_world_station)) / allowed)


def advice(joined: Joined) -> list[str]:
    """What to record next, in sentences; empty where every pair is checked by others.

    Parameters
    ----------
    joined : Joined
    """
    sentences = []
    if ProblemKind.LEFT_OUT in [problem.kind for problem in joined.problems]:
        sentences.append(
            "Some stations are left out: record one between them and the others, that sees what "
            "both see, at most 1 m and 40 deg from each."
        )
    for pair in joined.pairs:
        others = [other for other in joined.pairs if other is not pair]
        if pair.second not in connected(others, pair.first):
            sentences.append(
                f"Nothing checks how stations {pair.first} and {pair.second} lie: record one more "
                "that overlaps with both."
            )
    return sentences


def joined_cloud(clouds: Mapping[int, Cloud], joined: Joined) -> Cloud:
    """One cloud of all stations that were joined, in the frame of the first.

    Parameters
    ----------
    clouds : dict of int to Cloud
    joined : Joined
        Of them.

    Returns
    -------
    Cloud
        With the sigma of the stations' poses added to that of the points.
    """
    return join(
        placed(clouds[number], T, joined.covariance[number])
        for number, T in joined.T_world_station.items()
    )


def placed(cloud: Cloud, T: RigidTransform, covariance: np.ndarray) -> Cloud:
    """A cloud after a pose with the (6, 6) covariance of its turn and shift."""
    turned = T.rotation.apply(cloud.points)
    normals = T.rotation.apply(cloud.normals)
    J = gradient_by_pose(turned, normals)
    of_pose = np.vecdot(J @ covariance, J)
    return replace(
        cloud,
        points=turned + T.translation,
        normals=normals,
        sigma=np.sqrt(cloud.sigma**2 + np.nan_to_num(of_pose)),
    )
