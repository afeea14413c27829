"""What is weak about a joint estimate, and about the recording behind any result."""

from collections.abc import Iterator

import numpy as np

from lrfcal_lib.calibrate.pipeline import Calibration, largest_range
from lrfcal_lib.fit.covariance import inverse_root
from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.fit.robust import rms
from lrfcal_lib.judge.findings import Kind
from lrfcal_lib.judge.next_placement import group_sigma, sights
from lrfcal_lib.judge.placements import NO_IMAGE, placements_table
from lrfcal_lib.model.geometry import length_of
from lrfcal_lib.model.problem import LEAVES_OUT
from lrfcal_lib.preprocess.prepared import Prepared
from lrfcal_lib.session.faults import Fault
from lrfcal_lib.solvers.joint_solution import JointSolution

# placements: too few, and few
FEWEST = 3
FEW = 6
SAME_DISTANCE = 0.12  # range of the distances, relative to their median
SMALL_PITCH = np.radians(3.0)  # range of the recorded pitch
SMALL_IMAGE_PITCH = np.radians(
    2.0
)  # range within a placement of images of a camera on the head
MISFIT = 4.0  # normalised squared residual, relative to the median placement's
MODEL_ERROR = 2.5  # scatter over placements, in standard deviations of the noise
# residuals in units of the stated noise: worth a word, and not that noise at all
STATED = 2.5
ABSURD = 10.0
DEPENDENT = 0.2  # share of independent errors: sigma comes from a fifth of the ranges only
LOST = 0.1  # share of the placements that may be left out without a warning
UNSEEN = 0.2  # share of the placements that a camera may miss without a warning
MOST = 0.5  # share of the scans across an edge: where so many lie elsewhere, its statement does


def diagnose(solution: JointSolution) -> list[Fault]:
    """Weaknesses of a joint estimate and of the recording behind it.

    Parameters
    ----------
    solution

    Returns
    -------
    list of Fault
    """
    return [
        *weak_estimate(solution),
        *weak_placements(solution),
        *weak_pitch(solution),
        *large_residuals(solution),
    ]


def weak_estimate(solution) -> Iterator[Fault]:
    """What keeps the estimate from an answer."""
    if not solution.converged:
        yield Fault(
            Kind.CONVERGENCE,
            f"the estimate has not converged after {solution.solution.iterations} iterations",
            severe=True,
        )
    if solution.unobservable:
        yield Fault(
            Kind.UNOBSERVABLE,
            f"the data do not determine {'; '.join(solution.unobservable)}",
            severe=True,
        )


def weak_placements(solution) -> Iterator[Fault]:
    """The number of placements, and boards that stand alike."""
    count = len(solution.boards)
    if count < FEW:
        yield Fault(
            Kind.PLACEMENTS,
            f"only {count} placements, {FEW} or more are needed to see errors of the model",
            severe=count < FEWEST,
        )
    distance = length_of(sights(solution.board_poses, solution))
    if count > 1 and np.ptp(distance) < SAME_DISTANCE * np.median(distance):
        yield Fault(
            Kind.DISTANCE,
            f"all boards stand at one distance ({distance.min():.2f} to {distance.max():.2f} m): "
            "errors at other distances are extrapolated, and a range offset is hard to tell from "
            "shifts",
        )


def weak_pitch(solution) -> Iterator[Fault]:
    """The pitch of scans and images, which shows the axis."""
    if AXIS_NAMES[0] not in solution.solution.names:
        return
    obs = solution.observations
    obs = obs.keep(view=obs.on_head[obs.view_camera])
    pitch = np.concatenate([obs.face_pitch, obs.beam_pitch, obs.view_pitch])
    placement = np.concatenate([obs.face_placement, obs.beam_placement, obs.view_placement])
    where = " within a placement"
    if "platform" in obs.mounts:  # a camera on the base ties all placements together
        placement = np.zeros_like(placement)
        where = ""
    span = largest_range(pitch, placement)
    if span < SMALL_PITCH:
        yield Fault(
            Kind.PITCH,
            f"the recorded pitch spans only {np.degrees(span):.1f} deg{where}: the tilt axis "
            "is hardly determined",
            severe=True,
        )
    elif (
        len(obs.view_pitch)
        and largest_range(obs.view_pitch, obs.view_placement) < SMALL_IMAGE_PITCH
    ):
        yield Fault(
            Kind.IMAGE_PITCH,
            "every placement has its images at one pitch: the tilt axis rests on the scans of "
            "small boards",
        )


def large_residuals(solution) -> Iterator[Fault]:
    """What residuals and their scatter over placements say against the model."""
    usual = max(np.median([*solution.misfit.values()]), 1.0)
    misfits = [
        f"{placement} ({np.sqrt(square / usual):.1f} times)"
        for placement, square in solution.misfit.items()
        if square > MISFIT * usual
    ]
    if misfits:
        yield Fault(
            Kind.MISFIT,
            f"placements fit much worse than the others: {', '.join(misfits)}",
        )
    if solution.excluded:
        yield Fault(Kind.EXCLUDED, "; ".join(map(str, solution.excluded)))

    ratio = scatter_over_placements(solution)
    worst = max(ratio, key=ratio.__getitem__)
    if ratio[worst] > MODEL_ERROR:
        yield Fault(
            Kind.MODEL_ERROR,
            f"placements disagree about {worst} {ratio[worst]:.1f} times more than noise explains: "
            "an error of the model",
        )

    noise = {"ranges": solution.noise["face_scale"]} | noise_of_images(solution)
    large = [f"{name} {scale:.1f} times" for name, scale in noise.items() if scale > STATED]
    if large:
        yield Fault(
            Kind.NOISE,
            f"residuals are larger than the stated noise ({', '.join(large)})",
            severe=max(noise.values()) > ABSURD,
        )

    # beams about an edge always repeat errors: they share a background
    share = solution.noise["face_share"]
    if share < DEPENDENT:
        yield Fault(
            Kind.DEPENDENT,
            f"only {100 * share:.0f} % of the errors of ranges are independent: neighbouring "
            "ranges have the same error (bent boards, or a wrong pitch)",
        )


def scatter_over_placements(solution):
    """Scatter of axis and cameras over placements, in standard deviations of the noise."""
    noise = group_sigma(solution.solution.covariance, solution)
    scatter = group_sigma(solution.solution.covariance_placements, solution)
    return {name: scatter[name] / max(sigma, 1e-12) for name, sigma in noise.items()}


def noise_of_images(solution: JointSolution) -> dict[str, float]:
    """How far board poses in the images of each camera scatter, in stated standard deviations.

    By its name in words. All cameras have one level; how their residuals differ tells whose it is.
    What errors of the intrinsics cause is taken off.

    Parameters
    ----------
    solution
    """
    obs = solution.observations
    level = solution.noise["view_scale"] / np.hypot(1.0, solution.lens_scale)
    white = np.matvec(inverse_root(obs.view_covariance), solution.residuals("view"))
    usual = max(rms(white), np.finfo(float).tiny)
    return {
        f"images of '{camera}'": level * rms(white[obs.view_camera == number]) / usual
        for number, camera in enumerate(obs.cameras)
    }


def sides_elsewhere(prepared: Prepared) -> Iterator[Fault]:
    """Edges of the board that lie elsewhere than stated in most scans across them.

    Parameters
    ----------
    prepared

    Yields
    ------
    Fault
        One an edge.
    """
    scans = prepared.scans.values()
    elsewhere = [side for scan in scans for side in scan.dropped.values()]
    for edge in prepared.board.edges:
        dropped = [side for side in elsewhere if side.edge == edge]
        crossed = len(dropped) + sum(edge in scan.names.values() for scan in scans)
        if len(dropped) >= FEWEST and len(dropped) > MOST * crossed:
            off, turn = np.median([[side.distance, side.turn] for side in dropped], axis=0)
            yield Fault(
                Kind.OUTLINE,
                f"the board's edge '{edge}' lies elsewhere than its outline says in "
                f"{len(dropped)} of {crossed} scans ({1000 * off:.0f} mm off, turned by "
                f"{np.degrees(turn):.1f} deg) and is not used there: measure the board's edges "
                "(corners_m)",
            )


def blind_cameras(prepared: Prepared) -> Iterator[Fault]:
    """Cameras that do not see the board in many placements.

    Parameters
    ----------
    prepared

    Yields
    ------
    Fault
        One a camera.
    """
    placements = prepared.session.board_placements
    for camera, views in prepared.views.items():
        unseen = [
            f"{placement} ({why})"
            for placement in placements
            if (why := views.get(placement, NO_IMAGE).reason)
        ]
        if len(unseen) > UNSEEN * len(placements):
            yield Fault(
                Kind.LEFT_OUT,
                f"camera '{camera}' does not see the board in {len(unseen)} of {len(placements)} "
                f"placements: {', '.join(unseen)}",
            )


def left_out(calibration: Calibration, method: str) -> tuple[list[Fault], str]:
    """What the result of a method does not rest on.

    Parameters
    ----------
    calibration
    method
        Whose camera poses are handed over.

    Returns
    -------
    list of Fault
        One where more placements are left out than may be without a warning. It stands for what
        :func:`large_residuals` says of those that the estimate excluded.
    str
        What became of all placements, as far as it is no finding.
    """
    prepared = calibration.prepared
    table = placements_table(prepared, calibration.observations).set_index("placement")
    reasons = table.reason.replace("", "no edge").to_dict()
    parts = [problem for problem in prepared.problems if problem.kind not in LEAVES_OUT]
    if method == "joint":
        solution = calibration.joint.solution
        used = set(solution.boards)
        reasons |= solution.excluded_placements
        images = [problem for problem in solution.excluded if problem.camera is not None]
    else:
        used = set(table.index[table.used]) - set(prepared.left_out)
        images = []  # and cameras
    lost = [f"{number} ({why})" for number, why in reasons.items() if number not in used]
    words = (
        f"{len(lost)} of {len(table)} placements are left out: {', '.join(lost) or 'none'}"
    )
    findings = []
    note = f"{words}. "
    if len(lost) > LOST * len(table):
        findings.append(Fault(Kind.LEFT_OUT, words))
        note = ""
        parts += images  # otherwise a finding says it
    if parts:
        note += f"Parts left out beside them: {len(parts)} ({'; '.join(map(str, parts))})."
    return findings, note.strip()
