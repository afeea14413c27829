"""Can this calibration be trusted, for what error, and what to record next: the first page of a
report.
"""

from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
import pandas as pd
from scipy.linalg import block_diag
from scipy.special import stdtrit

from lrfcal_lib.calibrate.pipeline import handed_over, largest_range
from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.judge.alternatives import (
    alternatives_of,
    doubtful,
    far_from_stated,
    not_an_offset,
    places_of_cameras,
    step_not_told,
)
from lrfcal_lib.judge.diagnosis import OTHER_SIZE, lens_words
from lrfcal_lib.judge.next_placement import (
    Suggestion,
    brief,
    group_sigma,
    outline,
    suggest_placement,
)
from lrfcal_lib.judge.placements import placements_table
from lrfcal_lib.judge.recording_faults import explained, recording_faults
from lrfcal_lib.judge.uncertainty import (
    COLUMNS,
    Chain,
    chain_of,
    point_sigma,
    projection_sigma,
    range_noise,
)
from lrfcal_lib.model.geometry import POSE_NAMES, DegenerateGeometry, pose_array
from lrfcal_lib.model.problem import LEAVES_OUT, ProblemKind
from lrfcal_lib.preprocess.prepared import LEAST_SWEEP
from lrfcal_lib.solvers.joint import solve_joint
from lrfcal_lib.solvers.plane_start import rival_words

YES = "yes"
CARE = "with care"
NO = "no"
FIRST = {
    YES: "This calibration can be trusted",
    CARE: "Use this calibration with care",
    NO: "This calibration cannot be trusted",
}
DISTANCES = (1.0, 2.0, 5.0)  # metres
# placements: too few, few, enough to know their scatter
FEWEST = 3
FEW = 6
MANY = 12
PARALLEL = np.radians(6.0)  # normals of the boards about their mean
SAME_DISTANCE = 0.12  # range of the distances, relative to their median
SMALL_PITCH = np.radians(3.0)  # range of the recorded pitch
SMALL_IMAGE_PITCH = np.radians(2.0)  # range within a placement of images of a camera on the head
MISFIT = 4.0  # normalised squared residual, relative to the median placement's
MODEL_ERROR = 2.5  # scatter over placements, in standard deviations of the noise
# residuals in units of the stated noise: worth a word, and not that noise at all
STATED = 2.5
ABSURD = 10.0
DEPENDENT = 0.2  # share of independent errors: sigma comes from a fifth of the ranges only
CONTRADICTS = 3.0  # standard deviations beyond which a difference is none of chance
LARGE = {"squares": 0.02, "ranges": 0.02}  # errors of sizes that no estimate survives
LARGE_SCALE = 0.01  # of the pitch
RIM = 0.95  # of the radius of a spot: no share of it is left to flip a reading
LOST = 0.1  # share of the placements that may be left out without a warning
SIZES = (
    "check the stated size of the board and of the squares of its chessboard (expected errors "
    "count this as an error "
    "of every range)"
)
POOR = {"mm": 10.0, "px": 5.0}  # at 2 m
BAD = {"mm": 50.0, "px": 25.0}
BEARINGS = np.radians(np.linspace(60, 120, 7))
# errors are judged at least this far up and down from the middle of the sweeps
LEAST_FIELD = np.radians(10.0)
MOST = 0.5  # share of the scans across an edge: where so many lie elsewhere, its statement does
LEFT_OUT = 0.2  # share of the placements that is a finding of its own
RECORD = (
    f"Record next: {FEW} or more placements that all cameras see, the board leaning every way by "
    "20 deg and more, at "
    "several distances, with a sweep over its edges and images at several pitch angles each."
)
REGIONS = [
    " ".join(both).strip() or "middle"
    for both in product(("top", "", "bottom"), ("left", "", "right"))
]
NOT_WEIGHED = "whether session.json states sizes, step and spot rightly could not be weighed"

NO_BOUND = {"mm": 1e4, "px": 1e4}  # ten metres; more pixels than an image has

LIES = {
    "as recorded": {},
    "squares 5 % too small": {"squares": -0.05},
    "all sizes 5 % too large": {"outline": 0.05, "squares": 0.05},
    "angular step 3 % too large": {"bearings": 0.03},
}


@dataclass(frozen=True)
class Reason:
    """Why a calibration is not simply to be trusted.

    Attributes
    ----------
    answer : {'with care', 'no'}
    kind : str
        A key: 'handed over', 'left out', 'range offset', 'dependent', 'pitch scale', 'far from
        stated', of :data:`lrfcal_lib.judge.alternatives.ALTERNATIVES`, 'not weighed',
        'convergence', 'unobservable', 'cameras', 'lens', 'second minimum', 'placements',
        'parallel', 'distance', 'pitch', 'image pitch', 'misfit', 'excluded', 'model error',
        'noise', 'warning', 'error'; of :class:`lrfcal_lib.session.faults.Fault`.
    words : str
    """

    answer: str
    kind: str
    words: str


@dataclass(frozen=True)
class Verdict:
    """Whether a calibration can be trusted.

    Attributes
    ----------
    answer : {'yes', 'with care', 'no'}
    reasons : tuple of Reason
        The worst first; empty for 'yes'.
    errors : dict of float to dict of str to float
        By distance in metres: 'cloud_mm' and, by camera, '<camera>_px', one standard deviation
        (root mean square over the field), errors of the model included as far as they scatter over
        placements; inf where nothing bounds them.
    regions : dict of str to dict of str to float
        By camera and ninth of its image ('top left', 'top', ..., 'middle'): pixels at 2 m; NaN
        where no scan reaches.
    range_noise_mm : float
        Of every single point, on top.
    sweep_mm : float
        What the pitch error that every sweep has of its own adds to the cloud at 2 m; 0 where not
        estimated.
    suggestion : Suggestion or None
    no_suggestion : str
        Why there is none.
    notes : tuple of str
        What is handed over, and what became of all placements.
    """

    answer: str
    reasons: tuple
    errors: dict
    range_noise_mm: float
    sweep_mm: float
    suggestion: Suggestion | None
    no_suggestion: str = ""
    notes: tuple = ()
    regions: dict = field(default_factory=dict)

    def record(self):
        """Answer, reasons and expected errors, ready for JSON."""
        reasons = [vars(reason) for reason in self.reasons]
        errors = {f"{d:g}": e for d, e in self.errors.items()}
        found = {
            "answer": self.answer,
            "reasons": reasons,
            "notes": self.notes,
            "expected_error_at_m": errors,
        }
        return found | {"expected_px_at_2_m": self.regions}

    def sentences(self):
        """For the first page: the warning before anything else, the errors, what to record next."""
        why = "; ".join(reason.words for reason in self.reasons)
        out = [f"{FIRST[self.answer]}: {why}." if why else f"{FIRST[self.answer]}."]
        out += [f"Expected error at {d:g} m: {_error_words(e)}." for d, e in self.errors.items()]
        for camera, own in self.regions.items():
            known = sorted((value, name) for name, value in own.items() if np.isfinite(value))
            ends = [f"{brief(value)} px {name}" for value, name in (known[:1] + known[-1:])]
            out += [f"In the image of '{camera}' at 2 m: {' to '.join(ends)}."] if ends else []
        out += self.notes
        if self.errors:
            out.append(
                "These are single standard deviations of the calibration, with errors of the "
                "model as they show "
                f"between placements; each range has {brief(self.range_noise_mm)} mm of noise of "
                "its own."
            )
        if self.sweep_mm:
            out.append(
                f"Of the cloud's error at 2 m, {brief(self.sweep_mm)} mm come from the pitch of "
                "single sweeps."
            )
        out.append(self.suggestion.sentence() if self.suggestion else self.no_suggestion)
        return [sentence for sentence in out if sentence]


def _error_words(errors):
    words = []
    for name, value in errors.items():
        what, unit = name.rsplit("_", 1)
        where = "in the cloud" if what == "cloud" else f"in the image of '{what}'"
        words.append(
            f"{brief(value)} {unit} {where}" if np.isfinite(value) else f"no bound {where}"
        )
    return ", ".join(words)


def verdict(solution, models, *, suggest=True, doubt=0.0, **options):
    """Judge a joint estimate: a :class:`Verdict`.

    Parameters
    ----------
    solution : JointSolution
        Solved with ``required=False``, so that weak sessions get here.
    models : dict of str to CameraModel
    suggest : bool
        Also look for the next placement.
    doubt : float
        By how much all ranges may be wrong beside what the estimate knows, metres; see
        :func:`contradicts_stated`.
    **options
        Of :func:`lrfcal_lib.judge.next_placement.suggest_placement`.
    """
    chains = {camera: chain_of(solution, camera) for camera in (None, *solution.transforms)}
    pitch = np.concatenate([solution.observations.face_pitch, solution.observations.beam_pitch])
    found = _expected(chains, models, pitch, range_noise(solution), diagnose(solution), doubt)
    try:
        return replace(
            found, suggestion=suggest_placement(solution, models, **options) if suggest else None
        )
    except DegenerateGeometry as error:
        return replace(found, no_suggestion=f"No placement can be suggested: {error}.")


def _expected(chains, models, pitch, noise, reasons, doubt):
    """A verdict by reasons and by the errors that are to be expected over the recorded pitch
    (not a narrow strip).
    """
    # boards of a wrong size stand elsewhere before the cameras: ranges or the cameras' places have
    # taken it up
    unsure = np.diag([doubt**2 * (name in ("range_offset", *POSE_NAMES[3:])) for name in COLUMNS])
    chains = {
        k: replace(v, covariances=tuple(C + unsure for C in v.covariances))
        for k, v in chains.items()
    }
    low, high = (pitch.min(), pitch.max()) if len(pitch) else (0.0, 0.0)
    middle = (low + high) / 2
    field = min(low, middle - LEAST_FIELD), max(high, middle + LEAST_FIELD)
    cloud = point_sigma(
        chains[None], BEARINGS, np.linspace(*field, 9), DISTANCES, reference=sum(field) / 2
    )
    looks = {"image_pitch": sum(field) / 2, "pitches": field}
    seen = {
        camera: projection_sigma(chain, camera, models[camera], DISTANCES, (12, 9), **looks)
        for camera, chain in chains.items()
        if camera is not None
    }
    maps = {"cloud_mm": 1000 * cloud.rms()} | {
        f"{camera}_px": found.rms() for camera, found in seen.items()
    }
    regions = {
        camera: _regions(found.sigma[DISTANCES.index(2.0)]) for camera, found in seen.items()
    }
    errors = {}
    for i, distance in enumerate(DISTANCES):
        errors[distance] = bounded({name: float(rms[i]) for name, rms in maps.items()})
    large = {name: value for name, value in errors[2.0].items() if not value <= POOR[name[-2:]]}
    if large:
        bad = any(not value <= BAD[name[-2:]] for name, value in large.items())
        words = f"the expected error at 2 m is {_error_words(large)}"
        reasons = [*reasons, Reason(NO if bad else CARE, "error", words)]
    sweep = 1000 * float(np.sqrt(np.mean(cloud.parts["sweep"][DISTANCES.index(2.0)] ** 2)))
    return _answered(
        Verdict(YES, (), errors, 1000 * float(noise), sweep, None, regions=regions), reasons
    )


def bounded(errors):
    """Errors by name, millimetres and pixels; infinite where so large a one is no bound at all."""
    bounds = {name: NO_BOUND[name[-2:]] for name in errors}
    return {name: value if value < bounds[name] else np.inf for name, value in errors.items()}


def _regions(sigma):
    """Root mean square of a map (rows, columns) over the ninths of an image, by their names."""
    parts = [part for rows in np.array_split(sigma, 3) for part in np.array_split(rows, 3, axis=1)]
    known = [part[~np.isnan(part)] for part in parts]
    return {
        n: float(np.sqrt(np.mean(p**2))) if p.size else np.nan
        for n, p in zip(REGIONS, known, strict=True)
    }


def _answered(found, reasons):
    """A verdict with more reasons, the worst first."""
    reasons = sorted((*reasons, *found.reasons), key=lambda r: r.answer != NO)
    answer = NO if any(r.answer == NO for r in reasons) else CARE if reasons else YES
    return replace(found, answer=answer, reasons=tuple(reasons))


def judge(calibration, method=None, **options):
    """Judge what a calibration hands over, by itself and by what became of the recording: a
    :class:`Verdict`.

    'no' without errors, and with what to record, where nothing is handed over. `method` is that
    whose camera poses are handed over, as :func:`lrfcal_lib.calibrate.pipeline.handed_over` says
    when left out; options of :func:`verdict` (what the LRF sees and the board's features are
    known).
    """
    prepared = calibration.prepared
    joint = calibration.joint
    lens = [
        Reason(NO if OTHER_SIZE in words else CARE, "lens", words)
        for words in lens_words(prepared).values()
    ]
    faults = recording_faults(calibration)
    lens = [
        Reason(NO if fault.severe else CARE, fault.kind, fault.words) for fault in faults
    ] + lens
    # also where the joint estimate is not handed over: a wrong size may be why
    sizes, doubt = ([], 0.0) if joint is None or explained(faults) else contradicts_stated(joint)
    method = method or handed_over(calibration)
    if method is None:
        refused = Reason(NO, "handed over", _refusal(calibration))
        lost = [str(problem) for problem in prepared.problems]
        notes = (f"Left out: {len(lost)} ({'; '.join(lost)}).",) if lost else ()
        return replace(
            _answered(Verdict(NO, (), {}, np.nan, 0.0, None, RECORD), [*lens, *sizes, refused]),
            notes=notes,
        )
    if method == "joint":
        found = verdict(
            joint.solution, prepared.models, doubt=doubt, **sight_of(prepared) | options
        )
    else:
        found = _without_joint(calibration, method, doubt)
    reasons, words = _left_out(calibration, method)
    reasons += sides_elsewhere(prepared)
    # with words of what was excluded
    if any("placements are left out" in reason.words for reason in reasons):
        found = replace(found, reasons=tuple(r for r in found.reasons if r.kind != "excluded"))
    axis = calibration.platform.axis_with(method)
    places = places_of_cameras(joint.solution) if method == "joint" else []
    notes = (
        f"Handed over: the cameras of the method '{method}' and the axis '{axis}'.",
        *places,
        words,
    )
    if method == "joint" and not sizes:
        words = step_not_told(joint.solution, prepared.session.lrf.admitted_offset)
        notes += (words,) if words else ()
    if method == "joint" and FEWEST <= (n := len(joint.solution.boards)) < MANY:
        known = 100 / np.sqrt(2 * (n - 1))
        within = stdtrit(n - 1, 0.95)
        words = f"The scatter over {n} placements is itself known to {known:.0f} % only"
        notes += (
            f"{words}: 90 % of errors lie within {within:.1f} of its standard deviations, not 1.6.",
        )
    return replace(_answered(found, lens + sizes + reasons), notes=notes)


def _refusal(calibration):
    """Why nothing can be handed over: what keeps the joint estimate, or else every camera, from
    an answer.
    """
    prepared = calibration.prepared
    at_once = calibration.problem("joint")
    if at_once is not None:
        why = at_once.words
    else:
        words = dict.fromkeys(problem.words for problem in calibration.problems)
        why = "; ".join([*words][:3])
    if not prepared.views:
        lost = prepared.problems_of(ProblemKind.NO_IMAGES)
        why = lost[0].words if lost else "the session has no camera"
        why += "; the tilt axis is known from the edges in the sweeps" * bool(
            calibration.platform.solutions
        )
    return f"nothing can be handed over: {why}"


def sight_of(prepared):
    """What the rig can see, for suggestions: keyword arguments of :func:`verdict`."""
    pattern = prepared.board.pattern
    features = None if pattern is None else pattern.points()
    return {"field_of_view": prepared.session.lrf.field_of_view, "features": features}


def _without_joint(calibration, method, doubt):
    """Verdict on cameras that were calibrated one by one with the axis of the platform step."""
    prepared = calibration.prepared
    joint = calibration.joint
    solved = {
        camera: found for (camera, name), found in calibration.solutions.items() if name == method
    }
    bad = (
        []
        if joint is None
        else [reason.words for reason in diagnose(joint.solution) if reason.answer == NO]
    )
    at_once = calibration.problem("joint")
    asked = "another method was asked for" if at_once is None else at_once.words
    why = "; ".join(bad) or asked
    answer = NO if joint is None or not joint.solution.converged else CARE
    reasons = [Reason(answer, "handed over", f"the joint estimate is not handed over ({why})")]
    fewest = min(
        len(calibration.observations[camera, "half_step"].all_placements) for camera in solved
    )
    if fewest < FEW:
        reasons.append(
            Reason(NO, "placements", f"{fewest} placements only, {FEW} or more are needed")
        )
    for camera in prepared.views:
        if camera not in solved:
            problem = calibration.problem(method, camera)
            why = "no result" if problem is None else problem.words
            reasons.append(Reason(CARE, "cameras", f"camera '{camera}' is not handed over ({why})"))
    reasons += [
        Reason(NO, "second minimum", rival_words(camera, found.transform, found.rival))
        for camera, found in solved.items()
        if found.rival is not None
    ]
    sweeps = any(np.ptp(board.sweep.pitch) > LEAST_SWEEP for board in prepared.scans.values())
    unknown = calibration.platform.problem("combined")
    if unknown is not None and sweeps:
        reasons.append(Reason(NO, "far from stated", unknown.words))
    # the range offset of the cloud may be what the maker admits
    platform = calibration.platform
    session = prepared.session
    unseen = np.zeros((0, len(COLUMNS)))
    rest = (unseen, (prepared.pitch_noise.offset, prepared.pitch_noise.stretch))
    admitted = session.lrf.admitted_offset
    head = pose_array(platform.transform("combined"))
    offset = np.diag([admitted**2, 0.0, 0.0])
    of_axis = platform.axes["combined"].covariance
    sigma = block_diag(of_axis, np.zeros((6, 6)), offset)
    chains = {None: Chain(head, None, True, (sigma,), *rest)}
    for camera, found in solved.items():
        sigma = block_diag(of_axis, found.trusted[:6, :6], 0 * offset)
        on_head = session.cameras[camera].mount == "head"
        chains[camera] = Chain(head, pose_array(found.transform), on_head, (sigma,), *rest)
    pitch = np.concatenate([board.sweep.pitch for board in prepared.scans.values()])
    noise = np.median([board.sigma_range for board in prepared.scans.values()])
    return replace(_expected(chains, prepared.models, pitch, noise, reasons, doubt), sweep_mm=0.0)


def contradicts_stated(joint):
    """Reasons to doubt what session.json states, and by how much all ranges are off if a size is
    wrong (metres).

    What :mod:`lrfcal_lib.judge.alternatives` finds, a range offset that no maker admits, the
    scale of the pitch.
    """
    lrf = joint.prepared.session.lrf
    reasons = []
    doubt = 0.0
    level = joint.solution.noise["face_scale"]
    if not joint.solution.converged:
        return [Reason(NO, "not weighed", f"{NOT_WEIGHED}: the estimate has not converged")], doubt
    offset = joint.solution.sensor["range_offset"]
    admitted = lrf.admitted_offset
    sigma = joint.solution.sigma
    margin = CONTRADICTS * sigma.get("range_offset", 0.0)
    asked, instead = _asked(joint)
    doubt = abs(offset) if instead in asked else 0.0
    if level > ABSURD and not asked:
        why = f"no single one explains why ranges fit {level:.0f} times worse than stated"
        reasons.append(Reason(NO, "not weighed", f"{NOT_WEIGHED}: {why}"))
    if asked:
        best = asked[0]
        large = best.ratio > (2 * CONTRADICTS) ** 2 and abs(best.value) > LARGE.get(
            best.kind, np.inf
        )
        words = f"statements contradict the data: {'; or '.join(doubt.words for doubt in asked)}"
        reasons.append(Reason(NO if large else CARE, best.kind, words))
        off = max((abs(found.value) for found in asked if found.kind in LARGE), default=0.0)
        doubt = max(doubt, off * float(np.median(joint.solution.observations.face_range)))
    if abs(offset) > admitted + margin and instead not in asked:
        words = (
            f"the range offset of {1000 * offset:.0f} mm is beyond the {1000 * admitted:.0f} mm "
            "that are admitted of "
            f"the range finder (session.json may state systematic_error_m): {SIZES}; the unit of "
            "the ranges; the "
            "angular step"
        )
        reasons.append(
            Reason(NO if abs(offset) > 2 * admitted + margin else CARE, "range offset", words)
        )
        doubt = max(doubt, abs(offset))
    if abs(bias := joint.solution.edge_bias) > RIM:
        words = (
            f"readings change at the rim of the stated spot ({100 * bias:.0f} % of its radius "
            "outside the edges)"
        )
        words = (
            f"{words}: state spot_exit_m and spot_divergence_rad as they are, or measure the "
            "board's edges"
        )
        reasons.append(Reason(CARE, "spot", words))
    scale = joint.solution.sensor["pitch_scale"]
    spread = sigma.get("pitch_scale", 0.0)
    if abs(scale) > max(CONTRADICTS * spread, LARGE_SCALE):
        words = (
            f"the platform turns {100 * abs(scale):.1f} +- {100 * spread:.1f} % "
            f"{'more' if scale > 0 else 'less'} than "
            "its recorded pitch says: check its gear or encoder (the estimate has taken this off)"
        )
        reasons.append(Reason(CARE, "pitch scale", words))
    for words, angle in far_from_stated(joint):
        reasons.append(Reason(NO if angle > np.pi / 2 else CARE, "far from stated", words))
    return reasons, doubt


def _asked(joint):
    """Statements that the data contradict (Doubts), and one that stands for a range offset,
    which may be of them.
    """
    stated = alternatives_of(joint.prepared)
    admitted = joint.prepared.session.lrf.admitted_offset
    # a spot that is no evenly lit disc looks like one of another size, which does no harm
    asked = doubtful(joint.solution, admitted, stated, faint=("spot",))
    instead = not_an_offset(joint.solution, admitted, stated)
    return [instead] if instead and (not asked or asked[0].kind == instead.kind) else asked, instead


def falsified(joint):
    """Statements falsified on purpose, everything estimated again (JointCalibration): what is
    doubted first.

    Columns falsified, range_offset_mm (that the estimate finds), doubted (words).
    """
    rows = []
    stated = alternatives_of(joint.prepared)
    for name, sizes in LIES.items():
        obs = joint.observations
        offset = np.nan
        for kind in (kind for kind in sizes if kind in stated):
            obs = stated[kind].change(obs, sizes[kind])
        try:
            solution = (
                solve_joint(obs, required=False, **joint.settings) if sizes else joint.solution
            )
            offset = solution.sensor["range_offset"]
            reasons = contradicts_stated(replace(joint, solution=solution))[0]
            words = reasons[0].words if reasons else "nothing"
        except DegenerateGeometry as error:
            words = f"refused: {error}"
        rows.append((name, 1000 * offset, words))
    return pd.DataFrame(rows, columns=["falsified", "range_offset_mm", "doubted"])


def _left_out(calibration, method):
    """All placements that the result does not rest on, counted and with their reasons."""
    prepared = calibration.prepared
    excluded = {}
    table = placements_table(prepared, calibration.observations).set_index("placement")
    used = set(table.index[table.used]) - set(prepared.left_out)
    if method == "joint":
        used = set(calibration.joint.solution.boards)
        excluded = calibration.joint.solution.excluded_placements
    lost = [p for p in table.index if p not in used]
    reasons = []
    for camera, views in prepared.views.items():
        why = {p: views[p].reason if p in views else "no image" for p in table.index}
        unseen = [f"{p} ({words})" for p, words in why.items() if words]
        if len(unseen) > LEFT_OUT * len(table):
            words = (
                f"camera '{camera}' does not see the board in {len(unseen)} of {len(table)} "
                "placements"
            )
            reasons.append(Reason(CARE, "left out", f"{words}: {', '.join(unseen)}"))
    large = len(lost) > LOST * len(table)
    parts = [str(problem) for problem in prepared.problems if problem.kind not in LEAVES_OUT]
    if large:
        parts += [words for key, words in excluded.items() if key not in table.index]
    also = (
        f"Parts left out beside whole placements: {len(parts)} ({'; '.join(parts)})."
        if parts
        else ""
    )
    if not lost:
        return reasons, f"All {len(table)} placements were used. {also}".strip()
    why = [
        f"{p} ({excluded.get(p) or prepared.left_out.get(p) or table.reason[p] or 'no edge'})"
        for p in lost
    ]
    words = f"{len(lost)} of {len(table)} placements are left out: {', '.join(why)}"
    reasons += [Reason(CARE, "left out", words)] * large
    return reasons, f"{'' if large else f'{words}.'} {also}".strip()


def sides_elsewhere(prepared):
    """Edges of the board that lie elsewhere in most scans across them (Prepared)."""
    reasons = []
    elsewhere = [side for own in prepared.dropped.values() for side in own.values()]
    for edge in prepared.board.edges:
        dropped = [side for side in elsewhere if side.edge == edge]
        crossed = len(dropped) + sum(edge in own.values() for own in prepared.names.values())
        if len(dropped) < FEWEST or len(dropped) <= MOST * crossed:
            continue
        turn = np.degrees(np.median([side.turn for side in dropped]))
        off = 1000 * np.median([side.distance for side in dropped])
        words = (
            f"the board's edge '{edge}' lies elsewhere than its outline says in {len(dropped)} of "
            f"{crossed} scans ({off:.0f} mm off, turned by {turn:.1f} deg) and is not used there: "
            "measure the board's edges (corners_m)"
        )
        reasons.append(Reason(CARE, "outline", words))
    return reasons


def diagnose(solution):
    """Weaknesses of a JointSolution and of the recording behind it: list of Reason."""
    iterations = solution.solution.iterations
    obs = solution.observations
    seen = [
        (len(np.unique(obs.view_placement[obs.view_camera == i])), c)
        for i, c in enumerate(obs.cameras)
    ]
    own = solution.warnings
    findings = [
        (
            not solution.converged,
            NO,
            "convergence",
            f"the estimate has not converged after {iterations} iterations",
        ),
        *(
            (n < FEWEST, CARE, "cameras", f"camera '{c}' sees the board in {n} placements only")
            for n, c in seen
        ),
        (
            solution.unobservable,
            NO,
            "unobservable",
            f"the data do not determine {'; '.join(solution.unobservable)}",
        ),
        *_of_placements(solution),
        *_of_residuals(solution),
        *((True, CARE, "warning", words) for words in own),
    ]
    return [Reason(*reason) for found, *reason in findings if found]


def _of_placements(solution):
    """What is weak about the recorded poses: rows of whether, answer, kind and words."""
    obs = solution.observations
    boards = solution.board_poses
    n = len(solution.boards)
    head = np.array([mount == "head" for mount in obs.mounts], bool)[obs.view_camera]
    turned = obs.view_pitch[head]
    shown = obs.view_placement[head]
    pitch = np.concatenate([obs.face_pitch, obs.beam_pitch, turned])
    place = np.concatenate([obs.face_placement, obs.beam_placement, shown])
    # the pitch shows the axis: of each placement, of the whole recording where a camera stands on
    # the base
    within = "" if "platform" in obs.mounts else " within a placement"
    span = largest_range(pitch, place if within else 0 * place)
    axis = any(name in solution.solution.names for name in AXIS_NAMES)
    flat = len(turned) and largest_range(turned, shown) < SMALL_IMAGE_PITCH
    mean = boards[:, :, 2].mean(axis=0)
    off = np.arccos(np.clip(boards[:, :, 2] @ mean / np.linalg.norm(mean), -1, 1)).max()
    middles = boards[:, :, :3] @ outline(solution).mean(axis=0) + boards[:, :, 3]
    distance = np.linalg.norm(middles - solution.T_head_lrf.translation, axis=1)
    return [
        (
            n < FEW,
            NO if n < FEWEST else CARE,
            "placements",
            f"{n} placements only, {FEW} or more are needed to see errors of the model",
        ),
        (
            axis and span < SMALL_PITCH,
            NO,
            "pitch",
            f"the recorded pitch ranges over {np.degrees(span):.1f} deg only{within}: the tilt "
            "axis is hardly determined",
        ),
        (
            axis and span >= SMALL_PITCH and flat,
            CARE,
            "image pitch",
            "every placement has its images at one pitch: the tilt axis rests on the scans of "
            "small boards",
        ),
        (
            n > 1 and off < PARALLEL,
            CARE,
            "parallel",
            f"all boards are parallel (within {np.degrees(off):.1f} deg): lean them every way by "
            "20 deg and more",
        ),
        (
            n > 1 and np.ptp(distance) < SAME_DISTANCE * np.median(distance),
            CARE,
            "distance",
            f"all boards stand at one distance ({distance.min():.2f} to {distance.max():.2f} m): "
            "errors elsewhere are "
            "extrapolated, and the range offset is hard to tell from shifts",
        ),
    ]


def noise_of_images(solution):
    """How far board poses in the images of each camera scatter, in stated standard deviations.

    By its name in words. All cameras have one level; how their residuals differ tells whose it is.
    What errors of the intrinsics cause is taken off.
    """
    obs = solution.observations
    if len(obs.view_camera) == 0:
        return {}
    level = solution.noise["view_scale"] / np.hypot(1.0, solution.lens_scale)
    factors = np.linalg.cholesky(obs.view_covariance)
    white = np.linalg.solve(factors, solution.residuals("view")[..., None])[..., 0]
    squares = np.mean(white**2, axis=1)
    usual = max(np.mean(squares), np.finfo(float).tiny)
    scatter = {}
    for i, name in enumerate(obs.cameras):
        mean = np.mean(squares[obs.view_camera == i])
        scatter[f"images of '{name}'"] = float(level * np.sqrt(mean / usual))
    return scatter


def _of_residuals(solution):
    """What residuals and their scatter say against the model: rows of whether, answer, kind and
    words.
    """
    level = max(np.median([*solution.misfit.values()]), 1.0)
    misfit = solution.misfit.items()
    misfits = ", ".join(
        f"{p} ({np.sqrt(z / level):.1f} times)" for p, z in misfit if z > MISFIT * level
    )
    clustered = solution.solution.covariance_placements
    ratio = {"axis": 0.0}
    worst = "axis"
    if clustered is not None:
        plain, scatter = (
            group_sigma(C, solution) for C in (solution.solution.covariance, clustered)
        )
        ratio = {name: scatter[name] / max(sigma, 1e-12) for name, sigma in plain.items()}
        worst = max(ratio, key=ratio.get)
    what = "the axis" if worst == "axis" else f"camera '{worst}'"
    noise = {"ranges": solution.noise["face_scale"]} | noise_of_images(solution)
    large = ", ".join(
        f"{name} {scale:.1f} times" for name, scale in noise.items() if scale > STATED
    )
    # beams about an edge always repeat errors: they share a background
    share = solution.noise["face_share"]
    return [
        (misfits, CARE, "misfit", f"placements fit much worse than the others: {misfits}"),
        (solution.excluded, CARE, "excluded", "; ".join(map(str, solution.excluded))),
        (
            ratio[worst] > MODEL_ERROR,
            CARE,
            "model error",
            f"placements disagree about {what} {ratio[worst]:.1f} times more than noise "
            "explains: an error of the model",
        ),
        (
            large,
            NO if max(noise.values()) > ABSURD else CARE,
            "noise",
            f"residuals are larger than the stated noise ({large})",
        ),
        (
            share < DEPENDENT,
            CARE,
            "dependent",
            f"only {100 * share:.0f} % of the errors of ranges are independent: "
            "neighbours err alike (boards that bend, a pitch that is off)",
        ),
    ]
