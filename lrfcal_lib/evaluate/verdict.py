"""Can this calibration be trusted, for what error, and what to record next: the first page of a report."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from lrfcal_lib.evaluate.jointly import size_error
from lrfcal_lib.evaluate.next_placement import Suggestion, brief, group_sigma, outline, suggest_placement
from lrfcal_lib.evaluate.tables import handed_over, placements_table
from lrfcal_lib.evaluate.uncertainty import COLUMNS, Chain, chain_of, point_sigma, projection_sigma, range_noise
from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.model.geometry import DegenerateGeometry, pose_array

YES, CARE, NO = "yes", "with care", "no"
DISTANCES = (1.0, 2.0, 5.0)  # metres
FEWEST, FEW = 3, 6  # placements
PARALLEL = np.radians(6.0)  # normals of the boards about their mean
SAME_DISTANCE = 0.12  # range of the distances, relative to their median
SMALL_PITCH = np.radians(3.0)  # range of the recorded pitch
SMALL_IMAGE_PITCH = np.radians(2.0)  # range within a placement of images of a camera on the head
MISFIT = 4.0  # normalised squared residual, relative to the median placement's
MODEL_ERROR = 2.5  # scatter over placements, in standard deviations of the noise
STATED, ABSURD = 2.5, 10.0  # residuals in units of the stated noise: worth a word, and not that noise at all
DEPENDENT = 0.2  # share of independent errors: sigma comes from a fifth of the ranges only
CONTRADICTS = 3.0  # standard deviations beyond which a difference is none of chance
LOST = 0.1  # share of the placements that may be left out without a warning
SIZES = "check the stated size of the board and of the squares of its chessboard, which expected errors presume"
POOR = {"mm": 10.0, "px": 5.0}  # at 2 m
BAD = {"mm": 50.0, "px": 25.0}
BEARINGS = np.radians(np.linspace(60, 120, 7))
LEAST_FIELD = np.radians(10.0)  # errors are judged at least this far up and down from the middle of the sweeps


@dataclass(frozen=True)
class Reason:
    """Why a calibration is not simply to be trusted.

    Attributes
    ----------
    answer : {'with care', 'no'}
    kind : str
        A key: 'handed over', 'left out', 'range offset', 'size', 'dependent', 'convergence', 'unobservable', 'cameras',
        'placements', 'parallel', 'distance', 'pitch', 'image pitch', 'misfit', 'excluded', 'model error', 'noise',
        'warning', 'error'.
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
        By distance in metres: 'cloud_mm' and, by camera, '<camera>_px', one standard deviation (root mean square over
        the field), errors of the model included as far as they scatter over placements; inf where nothing bounds them.
    range_noise_mm : float
        Of every single point, on top.
    sweep_mm : float
        What the pitch error that every sweep has of its own adds to the cloud at 2 m; 0 where not estimated.
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

    def record(self):
        """Answer, reasons and expected errors, ready for JSON."""
        errors = {f"{distance:g}": values for distance, values in self.errors.items()}
        reasons = [vars(reason) for reason in self.reasons]
        return {"answer": self.answer, "reasons": reasons, "notes": self.notes, "expected_error_at_m": errors}

    def sentences(self):
        """For the first page: the warning before anything else, the errors, what to record next.

        Returns
        -------
        list of str
        """
        first = {
            YES: "This calibration can be trusted.",
            CARE: "Use this calibration with care: ",
            NO: "This calibration cannot be trusted: ",
        }[self.answer]
        words = [r.words for r in self.reasons]
        out = [first + ("; ".join(words) + "." if words else "")]
        out += [f"Expected error at {d:g} m: {_error_words(e)}." for d, e in self.errors.items()]
        out += self.notes
        if self.errors:
            out.append(
                "These are single standard deviations of the calibration, with errors of the model as they show "
                f"between placements; each range has {brief(self.range_noise_mm)} mm of noise of its own."
            )
        if self.sweep_mm:
            out.append(f"Of the cloud's error at 2 m, {brief(self.sweep_mm)} mm come from the pitch of single sweeps.")
        out.append(self.suggestion.sentence() if self.suggestion else self.no_suggestion)
        return [sentence for sentence in out if sentence]


def _error_words(errors):
    words = []
    for name, value in errors.items():
        what, unit = name.rsplit("_", 1)
        where = "in the cloud" if what == "cloud" else f"in the image of '{what}'"
        words.append(f"{brief(value)} {unit} {where}" if np.isfinite(value) else f"no bound {where}")
    return ", ".join(words)


def verdict(solution, models, *, distances=DISTANCES, suggest=True, **options):
    """Judge a joint estimate.

    Parameters
    ----------
    solution : JointSolution
        Solved with ``required=False``, so that weak sessions get here.
    models : dict of str to CameraModel
    distances : sequence of float
        Metres.
    suggest : bool
        Also look for the next placement.
    **options
        Of :func:`lrfcal_lib.evaluate.next_placement.suggest_placement`.

    Returns
    -------
    Verdict
    """
    chains = {camera: chain_of(solution, camera) for camera in (None, *solution.transforms)}
    field = field_pitches(solution)
    found = _expected(chains, models, distances, field, range_noise(solution), diagnose(solution))
    suggestion, problem = None, ""
    if suggest:
        try:
            suggestion = suggest_placement(solution, models, **options)
        except DegenerateGeometry as error:
            problem = f"No placement can be suggested: {error}."
    sweep = 1000 * float(np.sqrt(np.mean(_cloud(chains[None], 2.0, field).parts["sweep"] ** 2)))
    return replace(found, sweep_mm=sweep, suggestion=suggestion, no_suggestion=problem)


def _expected(chains, models, distances, field, noise, reasons):
    """A verdict by reasons and by the errors that are to be expected."""
    errors = {float(d): expected_errors(chains, models, d, field) for d in distances}
    large = error_reasons(expected_errors(chains, models, 2.0, field))
    return _answered(Verdict(YES, (), errors, 1000 * float(noise), 0.0, None), reasons + large)


def _answered(found, reasons):
    """A verdict with more reasons, the worst first."""
    reasons = sorted((*reasons, *found.reasons), key=lambda r: r.answer != NO)
    answer = NO if any(r.answer == NO for r in reasons) else CARE if reasons else YES
    return replace(found, answer=answer, reasons=tuple(reasons))


def judge(calibration, method=None, **options):
    """Judge what a calibration hands over, by itself and by what became of the recording.

    Parameters
    ----------
    calibration : Calibration
    method : str, optional
        Whose camera poses are handed over; as :func:`lrfcal_lib.evaluate.tables.handed_over` says when left out.
    **options
        Of :func:`verdict`; what the LRF sees and the board's features are known.

    Returns
    -------
    Verdict
        'no' without errors where nothing is handed over.
    """
    prepared, joint = calibration.prepared, calibration.joint
    # also where the joint estimate is not handed over: a wrong size may be why
    sizes = [] if joint is None else [*_range_offset(joint), *_size(joint)]
    try:
        method = method or handed_over(calibration)
    except ValueError as error:
        found = calibration.problems.items()
        why = "; ".join([f"nothing can be handed over ({error})", *(f"{' '.join(k)}: {v}" for k, v in found)])
        return _answered(Verdict(NO, (), {}, np.nan, 0.0, None), [*sizes, Reason(NO, "handed over", why)])
    if method == "joint":
        found = verdict(joint.solution, prepared.models, **sight_of(prepared) | options)
    else:
        found = _without_joint(calibration, method, options.get("distances", DISTANCES))
    reasons, words = _left_out(calibration, method)
    if reasons:  # with the words of those that the estimate excluded
        found = replace(found, reasons=tuple(r for r in found.reasons if r.kind != "excluded"))
    axis = calibration.platform.axis_with(method)
    notes = (f"Handed over: the cameras of the method '{method}' and the axis '{axis}'.", words)
    return replace(_answered(found, sizes + reasons), notes=notes)


def sight_of(prepared):
    """What the rig can see, for suggestions: keyword arguments of :func:`verdict`."""
    pattern = prepared.board.pattern
    features = None if pattern is None else pattern.points()
    return {"field_of_view": prepared.session.lrf.field_of_view, "features": features}


def _without_joint(calibration, method, distances):
    """Verdict on cameras that were calibrated one by one with the axis of the platform step."""
    prepared, problems, joint = calibration.prepared, calibration.problems, calibration.joint
    solved = {camera: found for (camera, name), found in calibration.solutions.items() if name == method}
    bad = [] if joint is None else [reason.words for reason in diagnose(joint.solution) if reason.answer == NO]
    why = "; ".join(bad) or problems.get(("rig", "joint"), "another method was asked for")
    answer = NO if joint is None or not joint.solution.converged else CARE
    reasons = [Reason(answer, "handed over", f"the joint estimate is not handed over ({why})")]
    fewest = min(len(calibration.observations[camera, "half_step"].all_placements) for camera in solved)
    if fewest < FEW:
        reasons.append(Reason(NO, "placements", f"{fewest} placements only, {FEW} or more are needed"))
    for camera in (c for c in prepared.views if c not in solved):
        words = f"camera '{camera}' is not handed over ({problems.get((camera, method), 'no result')})"
        reasons.append(Reason(CARE, "cameras", words))
    pitch = np.concatenate([board.sweep.pitch for board in prepared.scans.values()])
    noise = np.median([board.sigma_range for board in prepared.scans.values()])
    field = _wide(pitch.min(), pitch.max())
    return _expected(_plain_chains(calibration, solved), prepared.models, distances, field, noise, reasons)


def _plain_chains(calibration, solved):
    """Chains of cameras calibrated one by one, and of the cloud, whose range offset may be what the maker admits."""
    platform, session, noise = calibration.platform, calibration.prepared.session, calibration.prepared.pitch_noise
    rest = np.zeros((0, len(COLUMNS))), (noise.offset, noise.stretch)
    head, sigma = pose_array(platform.T_head_lrf), np.zeros((len(COLUMNS),) * 2)
    sigma[:4, :4], sigma[10, 10] = platform.covariance, session.lrf.admitted_offset**2
    chains = {None: Chain(head, None, "head", (sigma,), *rest)}
    for camera, found in solved.items():
        sigma = block_diag(platform.covariance, found.trusted[:6, :6], np.zeros((3, 3)))
        chains[camera] = Chain(head, pose_array(found.transform), session.cameras[camera].mount, (sigma,), *rest)
    return chains


def _range_offset(joint):
    """An offset of all ranges that no working range finder has: something that is stated must be wrong."""
    solution, admitted = joint.solution.solution, joint.prepared.session.lrf.admitted_offset
    offset = joint.solution.sensor["range_offset"]
    margin = CONTRADICTS * dict(zip(solution.names, solution.trusted_sigma, strict=True)).get("range_offset", 0.0)
    if abs(offset) > admitted + margin:
        words = (
            f"the range offset of {1000 * offset:.0f} mm is beyond the {1000 * admitted:.0f} mm that are admitted of "
            f"the range finder (session.json may state systematic_error_m): {SIZES}; and the unit of the ranges"
        )
        yield Reason(NO if abs(offset) > 2 * admitted + margin else CARE, "range offset", words)


def _size(joint):
    """Edges in the cloud that contradict the stated ones."""
    error, sigma = size_error(joint)
    if abs(error) > CONTRADICTS * sigma:
        length = 1000 * error * np.mean(list(joint.prepared.board.lengths().values()))
        words = (
            f"the board's edges are {abs(length):.0f} mm ({100 * abs(error):.1f} %) "
            f"{'longer' if error > 0 else 'shorter'} in the cloud than stated, {abs(error) / sigma:.0f} times the "
            f"expected error: {SIZES}"
        )
        yield Reason(NO if abs(error) > 2 * CONTRADICTS * sigma else CARE, "size", words)


def _left_out(calibration, method):
    """All placements that the result does not rest on, counted and with their reasons."""
    prepared, excluded = calibration.prepared, {}
    table = placements_table(prepared, calibration.observations).set_index("placement")
    used = set(table.index[table.used]) - set(prepared.problems)
    if method == "joint":
        used, excluded = set(calibration.joint.solution.boards), calibration.joint.solution.excluded
    lost = [p for p in table.index if p not in used]
    if not lost:
        return [], f"All {len(table)} placements were used."
    why = [f"{p} ({excluded.get(p) or prepared.problems.get(p) or table.reason[p] or 'no edge'})" for p in lost]
    words = f"{len(lost)} of {len(table)} placements are left out: {', '.join(why)}"
    reasons = [Reason(CARE, "left out", words)] if len(lost) > LOST * len(table) else []
    return reasons, "" if reasons else f"{words}."


def expected_errors(chains, models, distance, field):
    """Standard deviations at one distance: 'cloud_mm' (chain None), and '<camera>_px' of each camera."""
    out = {"cloud_mm": 1000 * float(_cloud(chains[None], distance, field).rms()[0])}
    for camera, chain in chains.items():
        if camera is not None:
            middle = (field[0] + field[1]) / 2
            found = projection_sigma(
                chain, camera, models[camera], distance, (12, 9), image_pitch=middle, pitches=field
            )
            out[f"{camera}_px"] = float(found.rms()[0])
    return out


def _cloud(chain, distance, field):
    return point_sigma(chain, BEARINGS, np.linspace(*field, 9), distance, reference=(field[0] + field[1]) / 2)


def field_pitches(solution):
    """First and last pitch over which errors are judged: as recorded, but not a narrow strip; radians."""
    groups = (solution.data.face, solution.data.beam)
    pitch = np.concatenate([group["pitch"][group["used"]] for group in groups])
    return _wide(*((pitch.min(), pitch.max()) if len(pitch) else (0.0, 0.0)))


def _wide(low, high):
    return min(low, (low + high) / 2 - LEAST_FIELD), max(high, (low + high) / 2 + LEAST_FIELD)


def error_reasons(errors):
    """Errors at 2 m that are too large for anybody."""
    large = {name: value for name, value in errors.items() if not value <= POOR[name.rsplit("_", 1)[1]]}
    if not large:
        return []
    bad = any(not value <= BAD[name.rsplit("_", 1)[1]] for name, value in large.items())
    return [Reason(NO if bad else CARE, "error", f"the expected error at 2 m is {_error_words(large)}")]


def diagnose(solution):
    """Weaknesses of a joint estimate and of the recording behind it.

    Parameters
    ----------
    solution : JointSolution

    Returns
    -------
    list of Reason
    """
    checks = (
        _convergence, _cameras, _unobservable, _placements, _pitch, _parallel, _distances, _misfit, _excluded,
        _model_error, _noise, _dependent, _warnings,
    )  # fmt: skip
    return [reason for check in checks for reason in check(solution)]


def _convergence(solution):
    if not solution.converged:
        n = solution.solution.iterations
        yield Reason(NO, "convergence", f"the estimate has not converged after {n} iterations")


def _cameras(solution):
    """Cameras that hardly see a board (those that never do are left out by name)."""
    view = solution.data.view
    for number, name in enumerate(solution.transforms):
        seen = int(np.any(view["used"] & (view["camera"] == number), axis=1).sum())
        if seen < FEWEST:
            yield Reason(CARE, "cameras", f"camera '{name}' sees the board in {seen} placements only")


def _unobservable(solution):
    if solution.unobservable:
        yield Reason(NO, "unobservable", "the data do not determine " + "; ".join(solution.unobservable))


def _placements(solution):
    n = len(solution.boards)
    if n < FEW:
        words = f"{n} placements only, {FEW} or more are needed to see errors of the model"
        yield Reason(NO if n < FEWEST else CARE, "placements", words)


def _pitch(solution):
    """Range of the pitch that shows the axis: of each placement, of the recording where a camera stands on the base."""
    if not any(name in solution.solution.names for name in AXIS_NAMES):
        return
    data = solution.data
    on_head = data.view["used"] & (data.on_head[data.view["camera"]] if len(data.on_head) else False)
    pitch = np.hstack([data.face["pitch"], data.beam["pitch"], data.view["pitch"]])
    used = np.hstack([data.face["used"], data.beam["used"], on_head])
    spans = _ranges(pitch, used)
    span, where = (spans.max(), "within a placement") if np.all(data.on_head) else (np.ptp(pitch[used]), "")
    if span < SMALL_PITCH:
        words = f"the recorded pitch ranges over {np.degrees(span):.1f} deg only {where}".strip()
        yield Reason(NO, "pitch", f"{words}: the tilt axis is hardly determined")
    elif on_head.any() and _ranges(data.view["pitch"], on_head).max() < SMALL_IMAGE_PITCH:
        words = "every placement has its images at one pitch: the tilt axis rests on the scans of small boards"
        yield Reason(CARE, "image pitch", words)


def _ranges(values, used):
    """Range of the used values in each row, 0 where there are none."""
    high, low = np.max(values, axis=1, where=used, initial=-np.inf), np.min(values, axis=1, where=used, initial=np.inf)
    return np.where(used.any(axis=1), high - low, 0.0)


def _parallel(solution):
    normals = solution.state.boards[:, :, 2]
    mean = normals.mean(axis=0) / np.linalg.norm(normals.mean(axis=0))
    off = np.arccos(np.clip(normals @ mean, -1, 1)).max()
    if off < PARALLEL and len(normals) > 1:
        words = f"all boards are parallel (within {np.degrees(off):.1f} deg): lean them every way by 20 deg and more"
        yield Reason(CARE, "parallel", words)


def _distances(solution):
    """Spread of the distances of the boards' middles from the head."""
    middle = board_middles(solution)
    distance = np.linalg.norm(middle - solution.T_head_lrf.translation, axis=1)
    if len(distance) > 1 and np.ptp(distance) < SAME_DISTANCE * np.median(distance):
        words = (
            f"all boards stand at one distance ({distance.min():.2f} to {distance.max():.2f} m): errors elsewhere are "
            "extrapolated, and the range offset is hard to tell from shifts"
        )
        yield Reason(CARE, "distance", words)


def board_middles(solution):
    """Middles of the boards in the platform frame, shape (p, 3), metres."""
    middle = np.append(outline(solution).mean(axis=0), 0.0)
    return solution.state.boards[:, :, :3] @ middle + solution.state.boards[:, :, 3]


def _misfit(solution):
    found = solution.misfit
    level = max(np.median(list(found.values())), 1.0) if found else 1.0
    bad = [p for p, value in found.items() if value > MISFIT * level]
    if bad:
        words = ", ".join(f"{p} ({np.sqrt(found[p] / level):.1f} times)" for p in bad)
        yield Reason(CARE, "misfit", f"placements fit much worse than the others: {words}")


def _excluded(solution):
    if solution.excluded:
        yield Reason(CARE, "excluded", "; ".join(solution.excluded.values()))


def _model_error(solution):
    """Scatter over placements against the propagated noise."""
    clustered = solution.solution.covariance_placements
    if clustered is None:
        return
    plain, scatter = group_sigma(solution.solution.covariance, solution), group_sigma(clustered, solution)
    worst = max(plain, key=lambda name: scatter[name] / max(plain[name], 1e-12))
    ratio = scatter[worst] / max(plain[worst], 1e-12)
    if ratio > MODEL_ERROR:
        what = "the axis" if worst == "axis" else f"camera '{worst}'"
        words = f"placements disagree about {what} {ratio:.1f} times more than noise explains: an error of the model"
        yield Reason(CARE, "model error", words)


def _noise(solution):
    """Noise estimated much larger than stated."""
    found = {"ranges": solution.noise.get("face_scale", 1.0)}
    found |= {"images": solution.noise.get("view_scale", 1.0)}
    large = [f"{name} {scale:.1f} times" for name, scale in found.items() if scale > STATED]
    if large:
        words = "residuals are larger than the stated noise (" + ", ".join(large) + ")"
        yield Reason(NO if max(found.values()) > ABSURD else CARE, "noise", words)


def _dependent(solution):
    """Ranges that repeat their neighbours' errors; beams about an edge always do, they share one background."""
    share = solution.noise.get("face_share", 1.0)
    if share < DEPENDENT:
        words = "of the errors of ranges are independent: neighbours err alike (boards that bend, a pitch that is off)"
        yield Reason(CARE, "dependent", f"only {100 * share:.0f} % {words}")


def _warnings(solution):
    """What the solver itself finds suspicious, as far as no other check says it."""
    for words in solution.warnings:
        if not words.startswith(("not converged", "the data do not determine")):
            yield Reason(CARE, "warning", words)
