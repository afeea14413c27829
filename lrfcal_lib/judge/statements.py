"""Does session.json state the devices as they are? What the data contradict."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd

from lrfcal_lib.calibrate.pipeline import JointCalibration
from lrfcal_lib.judge.alternatives import (
    alternatives_of,
    doubtful,
    far_from_stated,
)
from lrfcal_lib.judge.findings import Kind, by_sign
from lrfcal_lib.judge.weaknesses import ABSURD
from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.session.faults import Fault
from lrfcal_lib.solvers.joint import solve_joint

CONTRADICTS = 3.0  # standard deviations beyond which a difference is none of chance
SIZES = (Kind.SQUARES, Kind.RANGES)  # an error of them is one of all distances
LARGE_SIZE = 0.02  # error of a size that no estimate survives
LARGE_SCALE = 0.01  # of the pitch
RIM = 0.95  # of the radius of a spot: no share of it is left to flip a reading
# statements that are falsified on purpose, as relative errors of alternatives
LIES = {
    "as recorded": {},
    "squares 5 % too small": {Kind.SQUARES: -0.05},
    "all sizes 5 % too large": {Kind.OUTLINE: 0.05, Kind.SQUARES: 0.05},
    "angular step 3 % too large": {Kind.BEARINGS: 0.03},
}


def contradicts_stated(joint: JointCalibration) -> tuple[list[Fault], float]:
    """What the data contradict of what session.json states.

    What :mod:`lrfcal_lib.judge.alternatives` finds, a range offset that no maker admits, the
    scale of the pitch, axis and cameras far from where they are stated.

    Parameters
    ----------
    joint

    Returns
    -------
    list of Fault
    float
        By how much all ranges are off if a size is wrong, metres.
    """
    solution = joint.solution
    if not solution.converged:
        return [not_weighed("the estimate has not converged")], 0.0
    findings = []
    doubts = doubtful(
        solution,
        joint.prepared.session.lrf.admitted_offset,
        alternatives_of(joint.prepared),
    )
    level = solution.noise["face_scale"]
    if doubts:
        findings.append(finding_of(doubts))
    elif level > ABSURD:
        findings.append(
            not_weighed(
                f"no single error explains why ranges fit {level:.0f} times worse than stated"
            )
        )
    sizes = [abs(doubt.value) for doubt in doubts if doubt.kind in SIZES]
    range_doubt = max(sizes, default=0.0) * np.median(solution.observations.face_range)
    beyond = list(beyond_admitted(joint))
    if beyond:
        range_doubt = max(range_doubt, abs(solution.sensor["range_offset"]))
    findings += [*beyond, *sensor_otherwise(solution), *far_from_stated(joint)]
    return findings, range_doubt


def not_weighed(why):
    """The Fault that no statement could be tested."""
    return Fault(
        Kind.NOT_WEIGHED,
        "whether session.json states sizes, step and spot correctly could not be tested: "
        f"{why}",
        severe=True,
    )


def finding_of(doubts):
    """The Fault of statements (Doubts, the likeliest first) that explain the data alike."""
    best = doubts[0]
    certain = best.ratio > (2 * CONTRADICTS) ** 2
    large = best.kind in SIZES and abs(best.value) > LARGE_SIZE
    causes = "; or ".join(doubt.words for doubt in doubts)
    return Fault(
        best.kind, f"statements contradict the data: {causes}", severe=certain and large
    )


def beyond_admitted(joint) -> Iterator[Fault]:
    """A range offset that the maker of the range finder does not admit."""
    offset = joint.solution.sensor["range_offset"]
    admitted = joint.prepared.session.lrf.admitted_offset
    margin = CONTRADICTS * joint.solution.sigma.get("range_offset", 0.0)
    if abs(offset) > admitted + margin:
        yield Fault(
            Kind.RANGE_OFFSET,
            f"the range offset of {1000 * offset:.0f} mm exceeds the {1000 * admitted:.0f} mm that "
            "the maker of the range finder admits (session.json may state systematic_error_m): "
            "check the stated size of the board and of the squares of its chessboard (the expected "
            "errors count this as an error of every range), the unit of the ranges and the angular "
            "step",
            severe=abs(offset) > 2 * admitted + margin,
        )


def sensor_otherwise(solution) -> Iterator[Fault]:
    """Readings that change where the stated spot no longer touches the board, and a platform that
    turns more or less than its recorded pitch says.
    """
    bias = solution.edge_bias
    if abs(bias) > RIM:
        yield Fault(
            Kind.SPOT,
            f"readings change at the rim of the stated spot ({100 * bias:.0f} % of its radius "
            "outside the edges): state spot_exit_m and spot_divergence_rad as they are, or measure "
            "the board's edges",
        )
    scale = solution.sensor["pitch_scale"]
    sigma = solution.sigma.get("pitch_scale", 0.0)
    if abs(scale) > max(CONTRADICTS * sigma, LARGE_SCALE):
        yield Fault(
            Kind.PITCH_SCALE,
            f"the platform turns {100 * abs(scale):.1f} +- {100 * sigma:.1f} % "
            f"{by_sign(scale, 'more', 'less')} than its recorded pitch says: check its gear or "
            "encoder (the estimate has corrected this)",
        )


def falsified(joint: JointCalibration) -> pd.DataFrame:
    """Statements falsified on purpose, everything estimated again: what is doubted first.

    Parameters
    ----------
    joint

    Returns
    -------
    DataFrame
        Columns falsified, range_offset_mm (that the estimate finds), doubted (words).
    """
    rows = []
    stated = alternatives_of(joint.prepared)
    for name, sizes in LIES.items():
        obs = joint.observations
        for kind, size in sizes.items():
            if kind in stated:
                obs = stated[kind].change(obs, size)
        offset = np.nan
        doubted = "nothing"
        try:
            solution = joint.solution
            if sizes:
                solution = solve_joint(obs, required=False, **joint.settings)
            offset = solution.sensor["range_offset"]
            findings, _ = contradicts_stated(replace(joint, solution=solution))
            if findings:
                doubted = findings[0].words
        except DegenerateGeometry as error:
            doubted = f"refused: {error}"
        rows.append((name, 1000 * offset, doubted))
    return pd.DataFrame(rows, columns=["falsified", "range_offset_mm", "doubted"])
