"""The stages in order, each one call: prepare a session, calibrate platform, cameras, and
everything at once.
"""

import operator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate import reconstruct
from lrfcal_lib.calibrate.observe import (
    name_sides,
    observe,
    observe_all,
    observe_joint,
    platform_observations,
)
from lrfcal_lib.fit.residuals import chart_parameters
from lrfcal_lib.fit.result import PlatformPrior
from lrfcal_lib.model import geometry
from lrfcal_lib.model.geometry import DegenerateGeometry, pose_array
from lrfcal_lib.model.kinematics import AS_RECORDED, camera_at
from lrfcal_lib.preprocess.intrinsics import adjust_robust, board_pose, waves
from lrfcal_lib.preprocess.prepared import (
    LEAST_SWEEP,
    PitchNoise,
    Prepared,
    prepare_images,
    prepare_scans,
)
from lrfcal_lib.preprocess.survey import all_views
from lrfcal_lib.session.cache import cached
from lrfcal_lib.session.workers import spread
from lrfcal_lib.solvers import METHODS, SHIPPED, best_method, row_of, solve_camera
from lrfcal_lib.solvers.joint import JointSolution, solve_again, solve_joint
from lrfcal_lib.solvers.pitch import estimate_pitch_errors
from lrfcal_lib.solvers.platform import solve_platform, solve_projected

LAPSE = 0.01  # share of beams about an edge that something else than the edge decides
PITCH_POINTS = 300  # of a placement's face, for the errors of its pitch
ASSUMED = np.radians(10.0), 0.1  # how well an axis is known that nothing tells
UNKNOWN_AXIS = (
    "the tilt axis is neither stated nor determined by the sweeps, and taken to lie along x "
    "through the mirror: state "
    "the platform in session.json, or record sweeps of straight edges and images at several "
    "pitch angles"
)
LEAST_SIDES = 8  # of all placements, for a spread of the edge bias from side to side


@dataclass(frozen=True)
class PlatformCalibration:
    """The tilt axis by every method, and the one to use.

    Attributes
    ----------
    axes : dict of str to (RigidTransform, ndarray of shape (4, 4))
        ``T_head_lrf`` by method, and the covariance of the four numbers in `parameters` of its axis
        (radians, metres): of `solutions`, 'stated' where the session states it, 'joint' where there
        is a joint estimate, and 'combined', the one to use: the stated platform, corrected by what
        the data know better. Rotation about the axis and shift along it, which no data can show,
        are the stated ones.
    solutions : dict of str to PlatformSolution
        ``projected_printed`` (the paper), ``projected_last_beam`` (the same in the chart used
        here), ``line_3d``.
    problems : dict of str to str
        Why a method has no result.
    stated_sigma : tuple of float
        How well the stated one is known: direction (radians) and offset (metres).
    """

    axes: dict
    solutions: dict
    problems: dict
    stated_sigma: tuple

    @property
    def covariance(self):
        """Of its axis, shape (4, 4)."""
        return self.axes["combined"][1]

    def parameters(self):
        """Angles of the axis out of and within the scan plane, its offsets within and across it,
        and their covariance.

        By method.
        """
        return {
            name: (chart_parameters(pose_array(T)), covariance)
            for name, (T, covariance) in self.axes.items()
        }

    def axis_with(self, method):
        """Name of the axis that goes with the camera poses of a method."""
        return "joint" if method == "joint" else "combined"

    def transform(self, method):
        """``T_head_lrf`` of a method (also 'stated', 'combined' and 'joint')."""
        return self.axes[method][0]


@dataclass(frozen=True)
class JointCalibration:
    """The joint calibration of a session.

    Attributes
    ----------
    prepared : Prepared
    solution : JointSolution
    settings : dict
        What was unknown, and why (see :func:`joint_settings`): keyword arguments of `solve_joint`.
    without : dict of int to JointSolution
        An estimate that has not seen the placement, by placement; filled by :func:`leave_out`.
    """

    prepared: Prepared
    solution: JointSolution
    settings: dict
    without: dict

    @property
    def observations(self):
        """Those that took part."""
        return self.solution.observations

    def seen_by(self, camera, solution=None, **options):
        """Observations of a camera made with the platform, range offset and pitch of the joint
        estimate.

        `solution` is another estimate than the whole session's (without a placement), `options` are
        those of :func:`lrfcal_lib.calibrate.observe.observe`.
        """
        solution = solution or self.solution
        return observe(
            self.prepared, camera, "half_step", solution.T_head_lrf, solution.corrections, **options
        )


@dataclass(frozen=True)
class Calibration:
    """Everything that a calibrated session holds.

    Attributes
    ----------
    observations : dict of (str, str) to CameraObservations
        By camera and edge-point variant, made with the calibrated platform.
    solutions, problems : dict of (str, str) to Solution, or to str
        By camera and method; why there is no result. ``('rig', 'joint')`` for the joint estimate.
    joint : JointCalibration or None
        Its cameras are in `solutions` as method 'joint', with observations of their own under that
        variant.
    """

    prepared: Prepared
    platform: PlatformCalibration
    observations: dict
    solutions: dict
    problems: dict
    joint: JointCalibration | None = None

    def frame(self, method):
        """``T_head_lrf`` that goes with a method's camera poses, and the Corrections of what
        was recorded.
        """
        axis = self.platform.axis_with(method)
        T_head_lrf = self.platform.transform(axis)
        if axis == "joint":
            return T_head_lrf, self.joint.solution.corrections
        return T_head_lrf, AS_RECORDED


def calibrate(session, methods=None):
    """All stages: preprocessing, platform, cameras, and the joint estimate of everything.

    Parameters
    ----------
    session : Session
    methods : sequence of str, optional
        Of :data:`lrfcal_lib.solvers.METHODS`; all rows that are there when this is called by
        default.

    Returns
    -------
    Calibration

    Raises
    ------
    ValueError
        For a method that is not there.
    """
    methods = tuple(METHODS if methods is None else methods)
    if any(row_of(name) is not SHIPPED.get(name) for name in methods):
        return _calibrate.__wrapped__(session, methods)  # a row may change without its name
    return _calibrate(session, methods)


@cached
def _calibrate(session, methods):
    """As :func:`calibrate`, by methods that do not change."""
    prepared = prepare(session)
    stages = [partial(joint_or_words, prepared, all_views(prepared))] if prepared.views else []
    *joint, found = spread(operator.call, [*stages, partial(_by_themselves, prepared, methods)])
    return with_joint(found, *joint) if joint else found


def _by_themselves(prepared, methods):
    """Calibrate the platform, then every camera."""
    platform = calibrate_platform(prepared, prepared.pitch_noise.offset)
    observations = observe_all(prepared, platform.transform("combined"))
    return Calibration(prepared, platform, observations, *calibrate_cameras(observations, methods))


@cached
def prepare(session):
    """Preprocess scans and images of a session, and name the sides that scans cross.

    Placements that cannot be used are in `problems` of the Prepared, with their reason.
    """
    ready = prepare_images(prepare_scans(session))
    names, dropped, problems = name_sides(ready)
    problems = ready.problems | problems
    ready = without(replace(ready, names=names, dropped=dropped, problems=problems))
    return replace(ready, pitch_noise=pitch_noise(find_pitch_errors(ready)))


def without(prepared):
    """Drop the placements that are named in `problems` from everything but the images."""

    def kept(found):
        return {key: value for key, value in found.items() if key not in prepared.problems}

    edges, swept = (
        {v: kept(found) for v, found in both.items()} for both in (prepared.edges, prepared.swept)
    )
    left = {name: kept(getattr(prepared, name)) for name in ("scans", "names", "dropped")}
    return replace(prepared, edges=edges, swept=swept, **left)


def find_pitch_errors(prepared):
    """Ask the cameras that are fixed to the base whether the platform tells the truth about its
    pitch: PitchErrors.

    None where no camera is fixed to the base, or too few placements are seen.
    """
    session = prepared.session
    scans = prepared.scans
    fixed = [c for c in prepared.views if session.cameras[c].mount == "platform"]
    if not fixed or not scans:
        return None
    direction = {placement: session.sweep_direction(placement) for placement in scans}
    middle = {placement: float(np.mean(scan.sweep.pitch)) for placement, scan in scans.items()}
    with suppress(DegenerateGeometry):
        return estimate_pitch_errors(
            {c: observe(prepared, c, faces=PITCH_POINTS) for c in fixed}, direction, middle
        )


def pitch_noise(errors):
    """How far a recorded pitch is off, from PitchErrors (or None).

    Zero where the data do not ask for any.
    """
    if errors is None or errors.wanted == "none":
        return PitchNoise()
    model = errors.models[errors.wanted]
    return PitchNoise(
        float(np.sqrt(np.mean(model.offset**2))), float(np.sqrt(np.mean(model.stretch**2)))
    )


def calibrate_platform(prepared, sigma_pitch=0.0):
    """Estimate the tilt axis by the paper's projected fits and by whitened 3D fits, and combine it
    with the stated one.

    Parameters
    ----------
    prepared : Prepared
        No cameras are needed.
    sigma_pitch : float
        Standard deviation of a recorded pitch, radians.

    Returns
    -------
    PlatformCalibration
        Where the platform is neither stated nor determined, 'combined' is an assumption, and so
        named in `problems`.
    """
    T0 = prepared.session.T_head_lrf
    sigma = prepared.session.platform_sigma
    stated = None if T0 is None else (T0, stated_covariance(sigma))
    solutions = {}
    problems = {}
    methods = {
        "projected_printed": ("last_beam", partial(solve_projected, printed=True)),
        "projected_last_beam": ("last_beam", solve_projected),
        "line_3d": ("half_step", partial(solve_platform, sigma_pitch=sigma_pitch)),
    }
    for name, (variant, solve) in methods.items():
        try:
            solutions[name] = solve(platform_observations(prepared, variant), T0)
        except DegenerateGeometry as error:
            problems[name] = str(error)
    axes = {name: (found.T_head_lrf, found.solution.trusted) for name, found in solutions.items()}
    best = combine(solutions["line_3d"], stated) if "line_3d" in solutions else stated
    if best is None:
        problems["combined"] = UNKNOWN_AXIS
        best = (RigidTransform.identity(), stated_covariance(ASSUMED))
    axes |= ({} if stated is None else {"stated": stated}) | {"combined": best}
    return PlatformCalibration(axes, solutions, problems, sigma)


def stated_covariance(sigma):
    """Covariance of the stated axis in the chart, shape (4, 4), from its two standard
    deviations.
    """
    return np.diag(np.repeat(np.square(sigma), 2))


def combine(found, stated):
    """Weigh an estimated axis (PlatformSolution) and the stated one by their covariances.

    `stated` and what is returned are ``T_head_lrf`` and the covariance of its axis; None where
    nothing is stated.
    """
    covariance = found.solution.trusted
    if stated is None:
        return found.T_head_lrf, covariance
    T_stated, prior = stated
    known = chart_parameters(pose_array(T_stated))
    gain = prior @ np.linalg.inv(prior + covariance)
    axis = axis_from_chart(known + gain @ (found.solution.parameters - known))
    # turn about the axis, shift along it
    unseen = T_stated * geometry.head_from_axis(geometry.axis_of(T_stated)).inv()
    return unseen * geometry.head_from_axis(axis), prior - gain @ prior


def axis_from_chart(parameters):
    """The axis of two angles and two offsets.

    Undoes :func:`lrfcal_lib.fit.residuals.chart_parameters`.
    """
    out_of_plane, within, *offset = parameters
    direction = np.array([1.0, -np.tan(within), np.tan(out_of_plane)])
    direction /= np.linalg.norm(direction)
    y, z = -np.asarray(offset)
    return geometry.TiltAxis(
        direction, np.array([-(direction[1] * y + direction[2] * z) / direction[0], y, z])
    )


def calibrate_cameras(observations, methods=None):
    """Calibrate every camera by methods of :data:`lrfcal_lib.solvers.METHODS`, all by default.

    Returns a Solution, or in words why there is none, by camera and method.
    """
    solutions = {}
    problems = {}
    for camera in dict.fromkeys(camera for camera, _ in observations):
        for name in METHODS if methods is None else methods:
            try:
                solutions[camera, name] = solve_camera(
                    observations[camera, row_of(name).variant], name
                )
            except DegenerateGeometry as error:
                problems[camera, name] = str(error)
    return solutions, problems


def largest_range(values, groups):
    """Largest range of the values of one group, 0 where there are none."""
    return max((np.ptp(values[groups == group]) for group in np.unique(groups)), default=0.0)


def joint_settings(prepared, observations):
    """Which unknowns the data of a session ask for: keyword arguments of `solve_joint`.

    The axis and the scale of the pitch where something sweeps; a pitch error of every sweep where
    cameras on the base show that there is one; a spread of the edge bias where there are sides
    enough; the stated platform as a prior with its stated standard deviations.
    """
    session = prepared.session
    noise = prepared.pitch_noise
    axis = bool(largest_range(observations.face_pitch, observations.face_placement) > LEAST_SWEEP)
    sensor = ("range_offset", "edge_log_odds", "edge_log_softness")
    # a wrong scale that is held at zero goes into the axis
    sensor += ("pitch_scale",) if axis else ()
    sides = len(
        set(zip(observations.beam_placement.tolist(), observations.beam_edge.tolist(), strict=True))
    )
    settings = {
        "sensor": sensor,
        "noise": "estimate",
        "lapse": LAPSE,
        "sides": sides >= LEAST_SIDES,
        "axis": axis,
    }
    if noise.offset:
        settings["sweep"] = "offset_stretch" if noise.stretch else "offset"
        settings["sweep_sigma"] = (noise.offset, noise.stretch or 0.01)
    if session.T_head_lrf is not None and axis:
        settings["prior"] = PlatformPrior(session.T_head_lrf, *session.platform_sigma)
    return settings


@cached
def calibrate_jointly(prepared, views=None):
    """Estimate everything about a session's rig at once, from all its images or from `views` (see
    `observe_joint`).

    What the session does not determine is in `unobservable` and `warnings` of the solution, in
    words. Raises DegenerateGeometry when there is no start value, or most placements contradict
    each other.
    """
    observations = observe_joint(prepared, views)
    settings = joint_settings(prepared, observations)
    return JointCalibration(
        prepared, solve_joint(observations, required=False, **settings), settings, {}
    )


def joint_or_words(prepared, views=None):
    """The joint estimate, or in words why there is none."""
    try:
        return calibrate_jointly(prepared, views)
    except DegenerateGeometry as error:
        return str(error)


def with_joint(calibration, joint):
    """Add the joint estimate to a calibration: its axis, its cameras, and observations made with
    them.

    Where the session does not determine the whole rig (`joint` says why), only a problem is added.
    """
    platform = calibration.platform
    if isinstance(joint, str):
        return replace(calibration, problems=calibration.problems | {("rig", "joint"): joint})
    cameras = joint.observations.cameras
    outlines = {}
    seen = {(camera, "joint"): joint.seen_by(camera, outlines=outlines) for camera in cameras}
    solved = {(camera, "joint"): joint.solution.camera(camera) for camera in cameras}
    # scan lines of one pitch say nothing about it
    covariance = stated_covariance(platform.stated_sigma)
    covariance = (
        joint.solution.covariance("axis_", "offset_") if joint.settings["axis"] else covariance
    )
    axes = platform.axes | {"joint": (joint.solution.T_head_lrf, covariance)}
    found = {
        "observations": calibration.observations | seen,
        "solutions": calibration.solutions | solved,
    }
    return replace(calibration, platform=replace(platform, axes=axes), joint=joint, **found)


@cached
def leave_out(joint, groups=8):
    """The estimate without each placement: `groups` of them are left out in turn.

    Returns the JointCalibration with `without` filled; placements whose absence leaves something
    open are missing there.
    """
    numbers = np.array(list(joint.solution.boards))
    found = {}
    for group in range(min(groups, len(numbers))):
        out = numbers[group::groups]
        with suppress(DegenerateGeometry):
            solution = solve_again(
                joint.observations.select(np.setdiff1d(numbers, out)), joint.solution
            )
            found |= dict.fromkeys(out.tolist(), solution)
    return replace(joint, without=found)


def stereo_reference(prepared):
    """Relative pose of the first two cameras from the chessboard in both images: the best knowledge
    of the mounting.

    The intrinsics of both are estimated along, and the shape of a wavy sheet. Returns the names of
    the cameras, ``T_second_first`` and its covariance (6, 6) of ``[w, v]``. Raises ValueError with
    fewer than two cameras, without a pattern, or when no placement is seen by both.
    """
    pattern = prepared.board.pattern
    pair = tuple(prepared.views)[:2]
    if len(pair) < 2 or pattern is None:
        raise ValueError(
            f"a stereo reference needs two cameras and a pattern, got {len(prepared.views)} cameras"
        )
    seen = [
        {p: v.pixels for p, v in prepared.views[c].items() if v.pixels is not None} for c in pair
    ]
    common = sorted(seen[0].keys() & seen[1].keys())
    if not common:
        raise ValueError(
            "no placement shows the pattern to both cameras: the stereo check needs at least one"
        )
    pixels = np.array([[own[p] for p in common] for own in seen])
    models = [prepared.models[c] for c in pair]
    rough = [
        [board_pose(p, pattern, model)[0] for p in own]
        for own, model in zip(pixels, models, strict=True)
    ]
    poses = [RigidTransform.concatenate(own) for own in rough]
    between = poses[1] * poses[0].inv()
    second = RigidTransform.from_components(
        np.median(between.translation, axis=0), between.rotation.mean()
    )
    mounting = RigidTransform.concatenate([RigidTransform.identity(), second])
    basis = waves(pattern.points()) if np.any(prepared.relief) else None
    fixed = (8,) if all(m.distortion[4] == 0 for m in models) else ()
    found = adjust_robust(
        pixels, pattern.points(), models, poses[0], mounting, basis=basis, fixed=fixed
    )
    return pair, found.mounting[1], found.mounting_covariance[0]


def handed_over(calibration):
    """The method of a Calibration whose result goes into ``calibration.json`` and colours the
    cloud.

    'joint' where that estimate converged and left nothing open; otherwise what :func:`best_method`
    says. None where no camera was calibrated, or none could be judged.
    """
    joint = calibration.joint
    if joint is not None and joint.solution.converged and not joint.solution.unobservable:
        return "joint"
    halfway = {
        c: obs for (c, variant), obs in calibration.observations.items() if variant == "half_step"
    }
    return best_method(halfway, calibration.solutions)


def color_cloud(calibration, method=None, scene=False):
    """Sweeps of a session as one coloured Cloud in the platform frame, see :func:`cloud_blocks`."""
    return reconstruct.join(cloud_blocks(calibration, method, scene))


def cloud_blocks(calibration, method=None, scene=False):
    """Coloured points of a session, block by block.

    Parameters
    ----------
    calibration : Calibration
    method : str, optional
        Whose camera poses and axis make the cloud; what is handed over by default.
    scene : bool
        The sweeps of scenes, with all their returns, instead of the boards.

    Yields
    ------
    Cloud
        Each sweep takes its colours from the images of its own placement, of all cameras that see
        the point.

    Raises
    ------
    ValueError
        If there is no such sweep, or no method.
    """
    method = method or handed_over(calibration)
    if method is None:
        raise ValueError(
            "no camera was calibrated that could colour a cloud: see `problems` of the calibration"
        )
    session = calibration.prepared.session
    masks = {p: scan.mask for p, scan in calibration.prepared.scans.items()}
    if scene:
        masks = dict.fromkeys(session.scene_placements)
    if not masks:
        raise ValueError(
            f"{session.name}: no sweep of {'a scene' if scene else 'the board'} to colour"
        )
    frame = calibration.frame(method)
    continuous = str(session.reference.get("recording", "")).startswith("continuous")
    for placement, mask in masks.items():
        sweep = session.sweep(placement)
        views = views_of(calibration, method, placement)
        if mask is not None:  # the board and what is around it
            lines, beams = (slice(max(0, at.min() - 20), at.max() + 21) for at in np.nonzero(mask))
            part = {
                "pitch": sweep.pitch[lines],
                "time_s": sweep.time_s[lines],
                "bearings": sweep.bearings[beams],
            }
            echoes = None if sweep.intensities is None else sweep.intensities[lines, beams]
            sweep = replace(sweep, ranges=sweep.ranges[lines, beams], intensities=echoes, **part)
            mask = mask[lines, beams]
        yield from reconstruct.reconstruct(
            sweep, views, *frame, lrf=session.lrf, continuous=continuous, mask=mask
        )


def views_of(calibration, method, placement):
    """The images of a placement as a method poses them, a list of View; without those of which no
    pitch is known.

    ValueError where there are images and none of them can be posed.
    """
    session = calibration.prepared.session
    T_head_lrf, corrections = calibration.frame(method)
    views = []
    records = session.images(placement=placement)
    posed = [name for name, own in calibration.solutions if own == method]
    for record in records:
        name = record.camera
        mount = session.cameras[record.camera].mount
        if (name, method) in calibration.solutions and (
            mount == "platform" or np.isfinite(record.pitch)
        ):
            pitch = float(corrections.pitch(placement, record.pitch))
            pose = camera_at(
                calibration.solutions[name, method].transform, mount, T_head_lrf, pitch
            )
            number = session.image_records.index(record)
            model = calibration.prepared.models[name]
            views.append(reconstruct.View(number, name, pose, model, session.read_image(record)))
    if records and not views:
        asked = ", ".join(sorted({record.camera for record in records}))
        known = ", ".join(posed) or "no camera"
        why = (
            f"they are of {asked}, the calibration by '{method}' poses {known}: take that of the "
            "same rig"
        )
        if {record.camera for record in records} & set(posed):
            why = "of none is the pitch known: state pitch_deg in images.csv"
        raise ValueError(
            f"{session.name}, placement {placement}: its {len(records)} images cannot colour it; "
            f"{why}"
        )
    return views
