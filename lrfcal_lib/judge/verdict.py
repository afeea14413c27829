"""Can this calibration be trusted, for what error, and what to record next: the first page of a
report.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from lrfcal_lib.calibrate.pipeline import Calibration, handed_over
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.judge.alternatives import apart_words, step_words
from lrfcal_lib.judge.findings import ANSWERS, CARE, NO, YES, Answer, Kind, brief
from lrfcal_lib.judge.lens import lens_findings
from lrfcal_lib.judge.next_placement import suggest_placement
from lrfcal_lib.judge.recording_faults import explained, recording_faults
from lrfcal_lib.judge.statements import contradicts_stated
from lrfcal_lib.judge.uncertainty import (
    chain_of,
    point_sigma,
    projection_sigma,
    root_mean_square,
)
from lrfcal_lib.judge.weaknesses import (
    FEW,
    FEWEST,
    blind_cameras,
    diagnose,
    left_out,
    sides_elsewhere,
)
from lrfcal_lib.model.geometry import DegenerateGeometry, transform_difference
from lrfcal_lib.model.problem import ProblemKind
from lrfcal_lib.session.faults import Fault
from lrfcal_lib.solvers.joint_solution import JointSolution

FIRST = {
    YES: "This calibration can be trusted",
    CARE: "Use this calibration with care",
    NO: "This calibration cannot be trusted",
}
DISTANCES = (1.0, 2.0, 5.0)  # metres
WORKING = 2.0  # metres, one of them: errors there decide
POOR_MM = 10.0
POOR_PX = 5.0
BAD = 5.0  # times as much
NO_BOUND = 1e4  # ten metres in millimetres; more pixels than an image has
BEARINGS = np.radians(np.linspace(60, 120, 7))
PITCHES = 9  # of the field that errors are judged over
LEAST_FIELD = np.radians(10.0)  # at least so far up and down from the middle of the sweeps
PIXELS = (12, 9)  # columns and rows of pixels that errors are judged at
MANY = 12  # placements that are enough to know their scatter
RECORD = (
    f"Record next: {FEW} or more placements that all cameras see, the board leaning every way by "
    "20 deg and more, at several distances, with a sweep over its edges and images at several "
    "pitch angles each."
)


@dataclass(frozen=True)
class ExpectedError:
    """One standard deviation at one distance, root mean square over the field.

    Attributes
    ----------
    cloud_mm : float
    pixels : dict of str to float
        By camera. All are inf where nothing bounds them.
    """

    cloud_mm: float
    pixels: dict[str, float]

    def record(self) -> dict[str, float]:
        """By name, ready for JSON: 'cloud_mm' and, by camera, '<camera>_px'."""
        return {"cloud_mm": self.cloud_mm} | {
            f"{camera}_px": value for camera, value in self.pixels.items()
        }

    def words(self, above: float = -np.inf) -> str:
        """Those above so many times what is poor, with units; '' where none is."""
        parts = []
        if self.cloud_mm > above * POOR_MM:
            parts.append(_amount(self.cloud_mm, "mm", "in the cloud"))
        for camera, value in self.pixels.items():
            if value > above * POOR_PX:
                parts.append(_amount(value, "px", f"in the image of '{camera}'"))
        return ", ".join(parts)


def _amount(value, unit, where):
    """An error in words."""
    if np.isfinite(value):
        return f"{brief(value)} {unit} {where}"
    return f"no bound {where}"


def bounded(value: float) -> float:
    """An error in millimetres or pixels; infinite where so large a one is no bound at all."""
    return value if value < NO_BOUND else np.inf


@dataclass(frozen=True)
class Verdict:
    """Whether a calibration can be trusted.

    Attributes
    ----------
    reasons : tuple of Fault
        The worst first; empty for 'yes'.
    errors : dict of float to ExpectedError
        By distance in metres, errors of the model included as far as they scatter over placements;
        empty where nothing is handed over.
    range_noise_mm : float
        Of every single point, on top.
    advice : str
        What to record next, or why nothing is suggested.
    notes : tuple of str
        What is handed over, and what became of all placements.
    """

    reasons: tuple[Fault, ...]
    errors: dict[float, ExpectedError]
    range_noise_mm: float
    advice: str = ""
    notes: tuple[str, ...] = ()

    @property
    def answer(self) -> Answer:
        """Yes, with care, or no, by the worst of the reasons."""
        return ANSWERS[self.reasons[0].severe] if self.reasons else YES

    def record(self) -> dict:
        """Answer, reasons and expected errors, ready for JSON."""
        return {
            "answer": self.answer,
            "reasons": [
                {
                    "answer": ANSWERS[reason.severe],
                    "kind": reason.kind,
                    "words": reason.words,
                }
                for reason in self.reasons
            ],
            "notes": self.notes,
            "expected_error_at_m": {
                f"{d:g}": error.record() for d, error in self.errors.items()
            },
        }

    def sentences(self) -> list[str]:
        """For the first page: the warning before anything else, the errors, what to record next."""
        first = FIRST[self.answer]
        if self.reasons:
            first += f": {'; '.join(reason.words for reason in self.reasons)}"
        sentences = [f"{first}."]
        sentences += [
            f"Expected error at {distance:g} m: {error.words()}."
            for distance, error in self.errors.items()
        ]
        sentences += self.notes
        if self.errors:
            sentences.append(
                "These errors are single standard deviations of the calibration. They include "
                "errors of the model as far as placements disagree about them. Each range has "
                f"{brief(self.range_noise_mm)} mm of noise of its own."
            )
        return [*filter(None, [*sentences, self.advice])]

    def because(self, findings: list[Fault]) -> "Verdict":
        """The verdict with more findings, which stand before its own; the worst first."""
        every = (*findings, *self.reasons)
        return replace(
            self, reasons=tuple(sorted(every, key=lambda reason: not reason.severe))
        )


def judge(
    calibration: Calibration, method: str | None = None, *, suggest: bool = True
) -> Verdict:
    """Judge what a calibration hands over, by itself and by what became of the recording.

    Parameters
    ----------
    calibration
    method
        Whose camera poses are handed over; as :func:`lrfcal_lib.calibrate.pipeline.handed_over`
        says when left out.
    suggest
        Also look for the next placement.

    Returns
    -------
    Verdict
        'no' without errors, and with what to record, where nothing is handed over.
    """
    prepared = calibration.prepared
    joint = calibration.joint
    faults = recording_faults(calibration)
    findings = [*faults, *lens_findings(prepared)]
    doubt = 0.0
    # also where the joint estimate is not handed over: a wrong size may be why
    if joint is not None and not explained(faults):
        contradictions, doubt = contradicts_stated(joint)
        findings += contradictions
    method = method or handed_over(calibration)
    if method is None:
        return _refused(calibration, findings)

    rig = calibration.rig(method)
    if method == "joint":
        judged = verdict(joint.solution, rig, suggest=suggest, doubt=doubt)
    else:  # cameras that were calibrated one by one, with the axis of the platform step
        pitch = [scan.sweep.pitch for scan in prepared.scans.values()]
        judged = _expected(rig, np.concatenate(pitch), doubt).because(
            [_not_joint(calibration), *_weak_cameras(calibration, method)]
        )
    many_lost, note = left_out(calibration, method)
    findings += [*blind_cameras(prepared), *many_lost, *sides_elsewhere(prepared)]
    if many_lost:  # which says what was excluded, too
        kept = [reason for reason in judged.reasons if reason.kind != Kind.EXCLUDED]
        judged = replace(judged, reasons=tuple(kept))
    return replace(judged.because(findings), notes=_notes(calibration, method, note))


def _notes(calibration, method, lost):
    """What is handed over, where the cameras are, what was left out, and what is not known."""
    notes = [
        f"Handed over: the cameras of the method '{method}' and the axis "
        f"'{calibration.platform.axis_with(method)}'.",
        lost,
    ]
    if method == "joint":
        solution = calibration.joint.solution
        notes.append(step_words(solution))
        count = len(solution.boards)
        if FEWEST <= count < MANY:  # how well their scatter is itself known
            known = 100 / np.sqrt(2 * (count - 1))
            within = stdtrit(count - 1, 0.95)
            notes.append(
                f"{count} placements determine their own scatter to {known:.0f} % only: 90 % of "
                f"the errors lie within {within:.1f} stated standard deviations, not 1.6."
            )
    return tuple(filter(None, notes))


def verdict(
    solution: JointSolution,
    rig: CalibratedRig,
    *,
    suggest: bool = True,
    doubt: float = 0.0,
) -> Verdict:
    """Judge a joint estimate by itself.

    Parameters
    ----------
    solution
        Solved with ``required=False``, so that weak sessions get here.
    rig
        As the estimate has it.
    suggest
        Also look for the next placement.
    doubt
        By how much all ranges may be wrong beside what the estimate knows, metres; see
        :func:`lrfcal_lib.judge.statements.contradicts_stated`.
    """
    obs = solution.observations
    pitch = np.concatenate([obs.face_pitch, obs.beam_pitch])
    judged = _expected(rig, pitch, doubt).because(diagnose(solution))
    if not suggest:
        return judged
    try:
        advice = suggest_placement(solution, rig).sentence()
    except DegenerateGeometry as error:
        advice = f"No placement can be suggested: {error}."
    return replace(judged, advice=advice)


def _expected(rig, pitch, doubt):
    """A Verdict by the errors that are to be expected of a rig over the recorded pitch (n,), not a
    narrow strip, where all ranges may be wrong by `doubt` (metres) beside what is known.
    """
    middle = (pitch.min() + pitch.max()) / 2
    half = max(np.ptp(pitch) / 2, LEAST_FIELD)
    field = (middle - half, middle + half)
    errors = {}
    for distance in DISTANCES:
        cloud = point_sigma(
            chain_of(rig, doubt=doubt),
            BEARINGS,
            np.linspace(*field, PITCHES),
            distance,
            reference=middle,
        )
        pixels = {}
        for name, camera in rig.cameras.items():
            off = projection_sigma(
                chain_of(rig, name, doubt),
                camera.model,
                distance,
                PIXELS,
                image_pitch=middle,
                pitches=field,
            )
            pixels[name] = bounded(root_mean_square(off))
        errors[distance] = ExpectedError(bounded(1000 * root_mean_square(cloud)), pixels)

    judged = Verdict((), errors, range_noise_mm=1000 * rig.known.range_noise)
    large = errors[WORKING].words(above=1.0)
    if not large:
        return judged
    fault = Fault(
        Kind.ERROR,
        f"the expected error at {WORKING:g} m is {large}",
        severe=bool(errors[WORKING].words(BAD)),
    )
    return judged.because([fault])


def _refused(calibration, findings):
    """The Verdict where nothing is handed over.

    It says what keeps the joint estimate, or else every camera, from an answer.
    """
    prepared = calibration.prepared
    why = calibration.why_not("joint")
    if not why:
        words = dict.fromkeys(problem.words for problem in calibration.problems)
        why = "; ".join([*words][:3])
    if not prepared.views:
        lost = prepared.problems_of(ProblemKind.NO_IMAGES)
        why = lost[0].words if lost else "the session has no camera"
        if calibration.platform.solutions:
            why += "; the tilt axis is known from the edges in the sweeps"
    refused = Fault(Kind.HANDED_OVER, f"nothing can be handed over: {why}", severe=True)
    notes = ()
    if prepared.problems:
        named = "; ".join(map(str, prepared.problems))
        notes = (f"Left out: {len(prepared.problems)} ({named}).",)
    return Verdict((), {}, np.nan, RECORD, notes).because([*findings, refused])


def _weak_cameras(calibration, method) -> Iterator[Fault]:
    """What is weak about cameras that were calibrated one by one."""
    prepared = calibration.prepared
    solved = calibration.cameras(method)
    fewest = min(solution.n_placements for solution in solved.values())
    if fewest < FEW:
        yield Fault(
            Kind.PLACEMENTS,
            f"only {fewest} placements, {FEW} or more are needed",
            severe=True,
        )
    for camera in prepared.views:
        if camera not in solved:
            why = calibration.why_not(method, camera) or "no result"
            yield Fault(Kind.CAMERAS, f"camera '{camera}' is not handed over ({why})")
    for camera, solution in solved.items():
        if solution.rival is not None:
            turn, shift = transform_difference(solution.transform, solution.rival)
            yield Fault(
                Kind.SECOND_MINIMUM,
                f"a second minimum explains the data nearly as well: camera '{camera}' "
                f"{apart_words(turn, shift)} from where it is handed over; record more placements "
                "that lean other ways",
                severe=True,
            )
    unknown = calibration.platform.why_not("combined")
    if unknown and any(scan.swept for scan in prepared.scans.values()):
        yield Fault(Kind.FAR_FROM_STATED, unknown, severe=True)


def _not_joint(calibration):
    """The Fault that another method than the joint estimate is handed over, and why."""
    joint = calibration.joint
    why = calibration.why_not("joint")
    if joint is not None:
        why = "; ".join(fault.words for fault in diagnose(joint.solution) if fault.severe)
    why = why or "another method was asked for"
    return Fault(
        Kind.HANDED_OVER,
        f"the joint estimate is not handed over ({why})",
        severe=joint is None or not joint.solution.converged,
    )
