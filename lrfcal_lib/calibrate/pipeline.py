"""The stages in order, each one call: prepare a session, calibrate platform, cameras, and everything at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.observe import (
    FACE_POINTS,
    all_views,
    join_parts,
    name_sides,
    observe,
    observe_all,
    observe_joint,
    platform_of,
    thin,
)
from lrfcal_lib.calibrate.outline import EdgeModel
from lrfcal_lib.calibrate.reconstruct import Cloud, blend, color_points, join
from lrfcal_lib.fit.residuals import chart_parameters, edge_residuals_px, plane_residuals_m
from lrfcal_lib.fit.result import PlatformPrior
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    TiltAxis,
    axis_of,
    head_from_axis,
    lrf_to_platform,
    lrf_to_source,
    polar_to_points,
    pose_array,
)
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.preprocess import board_in_scan
from lrfcal_lib.preprocess.prepared import PitchNoise, Prepared, prepare_images, prepare_scans
from lrfcal_lib.preprocess.survey import stereo_check
from lrfcal_lib.session.cache import cached
from lrfcal_lib.solvers import METHODS, solve_camera
from lrfcal_lib.solvers.joint import JointSolution, solve_again, solve_joint
from lrfcal_lib.solvers.pitch import SweepPoints, estimate_pitch_errors
from lrfcal_lib.solvers.platform import PlatformObservations, solve_platform, solve_projected

LAPSE = 0.01  # share of beams about an edge that something else than the edge decides
LEAST_SWEEP = np.radians(1.0)  # of the scan lines' pitch, for the axis
LEAST_SIDES = 8  # of all placements, for a spread of the edge bias from side to side


@dataclass(frozen=True)
class JointCalibration:
    """The joint calibration of a session.

    Attributes
    ----------
    prepared : Prepared
    observations : JointObservations
        Those that took part.
    solution : JointSolution
    settings : dict
        What was unknown, and why (see :func:`joint_settings`): keyword arguments of `solve_joint`.
    without : dict of int to JointSolution
        An estimate that has not seen the placement, by placement; filled by :func:`leave_out`.
    """

    prepared: object
    observations: JointObservations
    solution: JointSolution
    settings: dict
    without: dict

    def axis_parameters(self):
        """The four numbers of the axis and their covariance (see `Solution.trusted`); zero where it was not unknown."""
        found = self.solution.covariance("axis_", "offset_")
        covariance = found if len(found) else np.zeros((4, 4))
        return chart_parameters(pose_array(self.solution.T_head_lrf)), covariance

    def seen_by(self, camera, solution=None, **options):
        """Observations of a camera made with the platform, range offset and pitch of the joint estimate.

        Parameters
        ----------
        camera : str
        solution : JointSolution, optional
            Another one than the whole session's (without a placement).
        **options
            Of :func:`lrfcal_lib.calibrate.observe.observe`.
        """
        solution = solution or self.solution
        return observe(self.prepared, camera, "half_step", solution.T_head_lrf, solution.correct, **options)

    def edge_model(self, placement=None):
        """What the estimate knows about how the sensor sees edges, from all placements but one.

        Parameters
        ----------
        placement : int, optional
            The one that must not have taken part.

        Returns
        -------
        EdgeModel
        """
        solution = self.without.get(placement, self.solution)
        sigma = dict(zip(solution.solution.names, solution.solution.trusted_sigma, strict=True))
        sensor = solution.sensor
        return EdgeModel(
            log_odds=sensor["edge_log_odds"],
            log_odds_sigma=float(sigma.get("edge_log_odds", 0.0)),
            spread=solution.data.side_sigma if solution.unknowns.sides else 0.0,
            softness=float(np.exp(sensor["edge_log_softness"])),
            range_offset=sensor["range_offset"],
            range_offset_sigma=float(sigma.get("range_offset", 0.0)),
            T_head_lrf=solution.T_head_lrf,
            correct=solution.correct,
        )


def joint_settings(prepared, observations):
    """Which unknowns the data of a session ask for.

    Parameters
    ----------
    prepared : Prepared
    observations : JointObservations

    Returns
    -------
    dict
        Keyword arguments of :func:`lrfcal_lib.solvers.joint.solve_joint`: the axis and the scale of
        the pitch where something sweeps; a pitch error of every sweep where cameras on the base show that there is one;
        a spread of the edge bias where there are sides enough; the stated platform as a prior with its stated standard
        deviations.
    """
    session, noise = prepared.session, prepared.pitch_noise
    sensor, axis = ["range_offset", "edge_log_odds", "edge_log_softness"], bool(sweep_span(observations) > LEAST_SWEEP)
    if axis:  # a wrong scale that is held at zero goes into the axis
        sensor.append("pitch_scale")
    sides = len(np.unique(observations.beam_placement * 100 + observations.beam_edge))
    settings = {"sensor": tuple(sensor), "noise": "estimate", "lapse": LAPSE, "sides": sides >= LEAST_SIDES}
    settings["axis"] = axis
    if noise.offset:
        settings["sweep"] = "offset_stretch" if noise.stretch else "offset"
        settings["sweep_sigma"] = (noise.offset, noise.stretch or 0.01)
    if session.T_head_lrf is not None and settings["axis"]:
        settings["prior"] = PlatformPrior(session.T_head_lrf, *session.platform_sigma)
    return settings


def sweep_span(observations):
    """Largest pitch range of the scan lines on one board, radians."""
    places, pitch = observations.face_placement, observations.face_pitch
    return float(max((np.ptp(pitch[places == i]) for i in np.unique(places)), default=0.0))


def calibrate_jointly(prepared, views=None):
    """Estimate everything about a session's rig at once.

    Parameters
    ----------
    prepared : Prepared
    views : dict of str to list of BoardView, optional
        The board in all images; see :func:`lrfcal_lib.calibrate.observe.all_views`.

    Returns
    -------
    JointCalibration
        What the session does not determine is in `solution.unobservable` and `solution.warnings`, in words.

    Raises
    ------
    DegenerateGeometry
        When there is no start value, or most placements contradict each other.
    """
    observations = observe_joint(prepared, all_views(prepared) if views is None else views)
    settings = joint_settings(prepared, observations)
    solution = solve_joint(observations, required=False, **settings)
    return JointCalibration(prepared, solution.observations, solution, settings, {})


def leave_out(joint, groups=8):
    """The estimate without each placement: groups of them are left out in turn.

    Parameters
    ----------
    joint : JointCalibration
    groups : int
        Placements are dealt out to so many groups; as many as there are placements leaves out one at a time.

    Returns
    -------
    JointCalibration
        With `without` filled; placements whose absence leaves something open are missing there.
    """
    numbers, found = np.array(list(joint.solution.boards)), {}
    for group in range(min(groups, len(numbers))):
        out = numbers[group::groups]
        try:
            solution = solve_again(joint.observations.select(np.setdiff1d(numbers, out)), joint.solution)
        except DegenerateGeometry:
            continue
        found |= {int(placement): solution for placement in out}
    return JointCalibration(joint.prepared, joint.observations, joint.solution, joint.settings, found)


def left_out_residuals(joint, camera):
    """Residuals of every placement under the estimate from all the others.

    Parameters
    ----------
    joint : JointCalibration
        With `without`.
    camera : str

    Returns
    -------
    edge_px, plane_m : ndarray
        As :func:`lrfcal_lib.evaluate.tables.left_out_residuals`: crossings of scan lines, and face points.
    """
    edges, planes = [np.zeros(0)], [np.zeros(0)]
    for placement, solution in joint.without.items():
        held = joint.seen_by(camera, solution).along().select([placement])
        edges.append(edge_residuals_px(held, solution.transforms[camera]))
        planes.append(plane_residuals_m(held, solution.transforms[camera]))
    return np.concatenate(edges), np.concatenate(planes)


RIGHT_ANGLE = 0.15  # largest |cosine| between two sides that are taken for the board's perpendicular edges
PLATFORM_POINTS = 40  # per edge


@cached
def prepare(session):
    """Preprocess scans and images, and name the sides that scans cross.

    Parameters
    ----------
    session : Session

    Returns
    -------
    Prepared
        Placements that cannot be used are in `problems` with their reason.
    """
    ready = prepare_images(prepare_scans(session))
    ready = without(replace(ready, names=name_sides(ready)))
    return replace(ready, pitch_noise=pitch_noise(find_pitch_errors(ready)))


def without(prepared):
    """Drop the placements that are named in `problems` from everything but the images."""
    bad = {key for key in prepared.problems if key in prepared.scans}

    def kept(found):
        return {key: value for key, value in found.items() if key not in bad}

    edges = {variant: kept(found) for variant, found in prepared.edges.items()}
    swept = {variant: kept(found) for variant, found in prepared.swept.items()}
    return replace(prepared, scans=kept(prepared.scans), edges=edges, swept=swept, names=kept(prepared.names))


def find_pitch_errors(prepared):
    """Ask the cameras that are fixed to the base whether the platform tells the truth about its pitch.

    Parameters
    ----------
    prepared : Prepared

    Returns
    -------
    PitchErrors or None
        None where no camera is fixed to the base, or too few placements are seen.
    """
    fixed = [c for c in prepared.views if prepared.session.cameras[c].mount == "platform"]
    if not fixed or not prepared.scans:
        return None
    faces = {
        placement: board_in_scan.face_points(board, 2 * FACE_POINTS) for placement, board in prepared.scans.items()
    }
    number = np.repeat(list(faces), [len(pitch) for _, pitch, _ in faces.values()])
    points, pitch = (np.concatenate([face[i] for face in faces.values()]) for i in (0, 1))
    direction = {placement: prepared.session.sweep_direction(placement) for placement in faces}
    middle = {placement: float(np.mean(board.sweep.pitch)) for placement, board in prepared.scans.items()}
    sweeps = SweepPoints(points, pitch, number, platform_of(prepared), direction, middle)
    try:
        return estimate_pitch_errors(sweeps, {c: observe(prepared, c) for c in fixed})
    except DegenerateGeometry:
        return None


def pitch_noise(errors):
    """How far a recorded pitch is off, from the errors of all sweeps; zero where the data do not ask for any.

    Parameters
    ----------
    errors : PitchErrors or None

    Returns
    -------
    PitchNoise
    """
    if errors is None or errors.wanted == "none":
        return PitchNoise()
    model = errors.models[errors.wanted]
    return PitchNoise(float(np.sqrt(np.mean(model.offset**2))), float(np.sqrt(np.mean(model.stretch**2))))


def platform_observations(prepared, variant="half_step"):
    """Two perpendicular sides and the face of the board in every sweep, for the platform calibration.

    Parameters
    ----------
    prepared : Prepared
        No cameras are needed.
    variant : {'half_step', 'last_beam'}

    Returns
    -------
    PlatformObservations
        Of each sweep the longest pair of perpendicular sides; a sweep with only one side gives that one.
    """
    edge, face = {k: [] for k in ("points", "covariance", "pitch", "placement", "edge")}, {k: [] for k in _FACE}
    for placement, found in prepared.swept[variant].items():
        for number, (edges, side) in enumerate(_perpendicular(prepared.edges[variant][placement], found), 1):
            rows = thin(np.flatnonzero(edges.side == side), PLATFORM_POINTS)
            for key in ("points", "covariance", "pitch"):
                edge[key].append(getattr(edges, key)[rows])
            edge["placement"].append(np.full(len(rows), placement))
            edge["edge"].append(np.full(len(rows), number))
        points, pitch, covariance = board_in_scan.face_points(prepared.scans[placement], FACE_POINTS)
        for key, values in zip(_FACE, (points, covariance, pitch, np.full(len(pitch), placement)), strict=True):
            face[key].append(values)
    shapes = {"points": (3,), "covariance": (3, 3)}
    parts = {k: join_parts(v, shapes.get(k, ()), int if k in ("placement", "edge") else float) for k, v in edge.items()}
    faces = {f"face_{k}": join_parts(v, shapes.get(k, ()), int if k == "placement" else float) for k, v in face.items()}
    return PlatformObservations(**parts, **faces)


_FACE = ("points", "covariance", "pitch", "placement")


def _perpendicular(along, swept):
    """The longest pair of perpendicular sides of a sweep, or the longest side: (edges, side number) each."""
    known = {s.side for s in along.sides}
    sides = [(along, s) for s in along.sides] + [(swept, s) for s in swept.sides if s.side not in known]
    pairs = [(a, b) for a, b in combinations(sides, 2) if abs(_cosine(a[1], b[1])) < RIGHT_ANGLE]
    if pairs:
        best = max(pairs, key=lambda pair: pair[0][1].length * pair[1][1].length)
    else:
        best = sorted(sides, key=lambda found: -found[1].length)[:1]
    return [(edges, s.side) for edges, s in best]


def _cosine(a, b):
    u, v = a.ends[1] - a.ends[0], b.ends[1] - b.ends[0]
    return u @ v / (np.linalg.norm(u) * np.linalg.norm(v))


@dataclass(frozen=True)
class PlatformCalibration:
    """The tilt axis by every method, and the one to use.

    Attributes
    ----------
    T_head_lrf : RigidTransform
        To use: the stated platform, corrected by what the data know better. Rotation about the axis and shift along it,
        which no data can show, are the stated ones.
    covariance : ndarray, shape (4, 4)
        Of the four numbers in `parameters` of that axis; radians and metres.
    solutions : dict of str to PlatformSolution
        ``projected_last_beam`` (the paper), ``line_3d``.
    problems : dict of str to str
        Why a method has no result.
    stated : RigidTransform or None
    stated_sigma : tuple of float
        How well the stated one is known: direction (radians) and offset (metres).
    joint : (RigidTransform, ndarray of shape (4, 4)), or None
        The axis of the joint estimate and its covariance.
    """

    T_head_lrf: RigidTransform
    covariance: np.ndarray
    solutions: dict
    problems: dict
    stated: RigidTransform | None
    stated_sigma: tuple
    joint: tuple | None = None

    def parameters(self):
        """Angles of the axis out of and within the scan plane, and its offsets within and across it, by method."""
        found = {name: (s.solution.parameters, s.solution.trusted) for name, s in self.solutions.items()}
        if self.stated is not None:
            found["stated"] = chart_parameters(pose_array(self.stated)), stated_covariance(self.stated_sigma)
        found["combined"] = chart_parameters(pose_array(self.T_head_lrf)), self.covariance
        if self.joint is not None:
            found["joint"] = chart_parameters(pose_array(self.joint[0])), self.joint[1]
        return found

    def axis_with(self, method):
        """Name of the axis that goes with the camera poses of a method."""
        return "joint" if method == "joint" else "combined"

    def transform(self, method):
        """``T_head_lrf`` of a method (also 'stated', 'combined' and 'joint')."""
        special = {"stated": self.stated, "combined": self.T_head_lrf}
        if self.joint is not None:
            special["joint"] = self.joint[0]
        return special[method] if method in special else self.solutions[method].T_head_lrf


def calibrate_platform(prepared, sigma_pitch=0.0):
    """Estimate the tilt axis by the paper's projected fits and by whitened 3D fits, and combine it with the stated one.

    Parameters
    ----------
    prepared : Prepared
        No cameras are needed.
    sigma_pitch : float
        Standard deviation of a recorded pitch, radians.

    Returns
    -------
    PlatformCalibration

    Raises
    ------
    DegenerateGeometry
        If the session neither states its platform nor holds sweeps that determine it.
    """
    stated, sigma = prepared.session.T_head_lrf, prepared.session.platform_sigma
    solutions, problems = {}, {}
    methods = {
        "projected_last_beam": lambda: solve_projected(platform_observations(prepared, "last_beam"), stated),
        "line_3d": lambda: solve_platform(platform_observations(prepared), stated, sigma_pitch=sigma_pitch),
    }
    for name, solve in methods.items():
        try:
            solutions[name] = solve()
        except DegenerateGeometry as error:
            problems[name] = str(error)
    if "line_3d" in solutions:
        T_head_lrf, covariance = combine(solutions["line_3d"], stated, sigma)
    elif stated is not None:
        T_head_lrf, covariance = stated, stated_covariance(sigma)
    else:
        raise DegenerateGeometry(f"the platform is neither stated nor determined by the sweeps: {problems}")
    return PlatformCalibration(T_head_lrf, covariance, solutions, problems, stated, sigma)


def stated_covariance(sigma):
    """Covariance of the stated axis in the chart, shape (4, 4), from its two standard deviations."""
    return np.diag(np.repeat(np.square(sigma), 2))


def combine(solution, stated, sigma):
    """Weigh an estimated axis and the stated one by their covariances.

    Parameters
    ----------
    solution : PlatformSolution
    stated : RigidTransform or None
    sigma : tuple of float
        Of the stated one: direction (radians) and offset (metres).

    Returns
    -------
    T_head_lrf : RigidTransform
    covariance : ndarray, shape (4, 4)
    """
    covariance = solution.solution.trusted
    if stated is None:
        return solution.T_head_lrf, covariance
    prior, known = stated_covariance(sigma), chart_parameters(pose_array(stated))
    gain = prior @ np.linalg.inv(prior + covariance)
    axis = axis_from_chart(known + gain @ (solution.solution.parameters - known))
    unseen = stated * head_from_axis(axis_of(stated)).inv()  # rotation about the axis and shift along it
    return unseen * head_from_axis(axis), prior - gain @ prior


def axis_from_chart(parameters):
    """The axis of two angles and two offsets; undoes :func:`lrfcal_lib.fit.residuals.chart_parameters`."""
    out_of_plane, within, *offset = parameters
    direction = np.array([1.0, -np.tan(within), np.tan(out_of_plane)])
    direction /= np.linalg.norm(direction)
    y, z = -np.asarray(offset)
    return TiltAxis(direction, np.array([-(direction[1] * y + direction[2] * z) / direction[0], y, z]))


@dataclass(frozen=True)
class Calibration:
    """Everything that a calibrated session holds.

    Attributes
    ----------
    prepared : Prepared
    platform : PlatformCalibration
    observations : dict of (str, str) to CameraObservations
        By camera and edge-point variant, made with the calibrated platform.
    solutions : dict of (str, str) to Solution
        By camera and method.
    problems : dict of (str, str) to str
        Why a method has no result for a camera; ``('rig', 'joint')`` for the joint estimate.
    joint : JointCalibration or None
        Its cameras are in `solutions` as method 'joint', with observations of their own under that variant.
    """

    prepared: Prepared
    platform: PlatformCalibration
    observations: dict
    solutions: dict
    problems: dict
    joint: JointCalibration | None = None


@cached
def calibrate(session, methods=tuple(METHODS), joint=True):
    """All stages: preprocessing, platform, cameras, and the joint estimate of everything.

    Parameters
    ----------
    session : Session
    methods : sequence of str
        Of :data:`lrfcal_lib.solvers.METHODS`.
    joint : bool

    Returns
    -------
    Calibration
    """
    prepared = prepare(session)
    platform = calibrate_platform(prepared, prepared.pitch_noise.offset)
    observations = observe_all(prepared, platform.T_head_lrf)
    solutions, problems = calibrate_cameras(observations, methods)
    found = Calibration(prepared, platform, observations, solutions, problems)
    return with_joint(found) if joint and prepared.views else found


def with_joint(calibration):
    """Add the joint estimate to a calibration: its axis, its cameras, and observations made with them.

    Parameters
    ----------
    calibration : Calibration

    Returns
    -------
    Calibration
        Unchanged but for a problem where the session does not determine the whole rig.
    """
    try:
        joint = calibrate_jointly(calibration.prepared)
    except DegenerateGeometry as error:
        return replace(calibration, problems=calibration.problems | {("rig", "joint"): str(error)})
    cameras = joint.observations.cameras
    seen = {(camera, "joint"): joint.seen_by(camera) for camera in cameras}
    solved = {(camera, "joint"): joint.solution.camera(camera) for camera in cameras}
    covariance = stated_covariance(calibration.platform.stated_sigma)  # scan lines of one pitch say nothing about it
    covariance = joint.axis_parameters()[1] if joint.settings["axis"] else covariance
    platform = replace(calibration.platform, joint=(joint.solution.T_head_lrf, covariance))
    found = {"observations": calibration.observations | seen, "solutions": calibration.solutions | solved}
    return replace(calibration, platform=platform, joint=joint, **found)


def stereo_reference(prepared):
    """Relative pose of the first two cameras from the chessboard in both images.

    Parameters
    ----------
    prepared : Prepared

    Returns
    -------
    cameras : (str, str)
    T_second_first : RigidTransform
    covariance : ndarray, shape (6, 6)

    Raises
    ------
    ValueError
        With fewer than two cameras, without a pattern, or when no placement is seen by both.
    """
    if len(prepared.views) < 2 or prepared.board.pattern is None:
        raise ValueError(f"a stereo reference needs two cameras and a pattern, got {len(prepared.views)} cameras")
    first, second = list(prepared.views)[:2]
    views = [list(prepared.views[camera].values()) for camera in (first, second)]
    models = [prepared.models[camera] for camera in (first, second)]
    T_second_first, covariance, _ = stereo_check(
        *views, prepared.board.pattern, models, relief=prepared.relief, refine=True
    )
    return (first, second), T_second_first, covariance


def color_cloud(calibration, method="line", every=1, scene=False):
    """Sweeps of a session as one coloured cloud in the platform frame.

    Parameters
    ----------
    calibration : Calibration
    method : str
        Whose camera poses colour the cloud.
    every : int
        Take every n-th point of a sweep.
    scene : bool
        The sweeps of scenes, with all their returns, instead of the boards.

    Returns
    -------
    Cloud
        Each sweep takes its colours from the images of its own placement, of all cameras that see the point.

    Raises
    ------
    ValueError
        If there is no such sweep.
    """
    session, scans = calibration.prepared.session, calibration.prepared.scans
    masks = {p: np.isfinite(session.sweep(p).ranges) for p in session.scene_placements} if scene else {}
    masks = masks if scene else {p: board.mask for p, board in scans.items()}
    if not masks:
        raise ValueError(f"{session.name}: no sweep of {'a scene' if scene else 'the board'} to colour")
    return join([_color_sweep(calibration, method, placement, mask, every) for placement, mask in masks.items()])


def _color_sweep(calibration, method, placement, mask, every):
    session, (T_head_lrf, correct) = calibration.prepared.session, _platform_and_corrections(calibration, method)
    sweep = session.sweep(placement)
    line, beam = (index[::every] for index in np.nonzero(mask))
    points = polar_to_points(sweep.ranges[line, beam], sweep.bearings[beam])
    p_lrf, pitch = correct(placement, points, sweep.pitch[line])
    layers = [np.full(p_lrf.shape, np.nan)]
    for record in session.images(placement=placement):
        mount = session.cameras[record.camera].mount
        if (record.camera, method) in calibration.solutions and (mount == "platform" or np.isfinite(record.pitch)):
            at = 0.0 if mount == "platform" else float(correct(placement, np.zeros(3), record.pitch)[1])
            points = lrf_to_source(p_lrf, pitch, T_head_lrf, mount, at)
            T_camera_source = calibration.solutions[record.camera, method].transform
            model, image = calibration.prepared.models[record.camera], session.read_image(record)
            layers.append(color_points(points, image, T_camera_source, model)[0])
    colors, seen = blend(layers)
    return Cloud(lrf_to_platform(p_lrf, pitch, T_head_lrf), colors, seen, np.full(len(pitch), placement))


def _platform_and_corrections(calibration, method):
    """``T_head_lrf`` and the function that takes known errors out of a sweep, as a method has them."""
    axis = calibration.platform.axis_with(method)
    correct = calibration.joint.solution.correct if axis == "joint" else lambda placement, p_lrf, pitch: (p_lrf, pitch)
    return calibration.platform.transform(axis), correct


def calibrate_cameras(observations, methods=METHODS):
    """Calibrate every camera by every method.

    Parameters
    ----------
    observations : dict of (str, str) to CameraObservations
        Of :func:`observe_all`.
    methods : iterable of str
        Of :data:`lrfcal_lib.solvers.METHODS`.

    Returns
    -------
    solutions : dict of (str, str) to Solution
        By camera and method.
    problems : dict of (str, str) to str
        Why a method has no result for a camera.
    """
    solutions, problems = {}, {}
    for camera in dict.fromkeys(camera for camera, _ in observations):
        for name in methods:
            try:
                solutions[camera, name] = solve_camera(observations[camera, METHODS[name].variant], name)
            except DegenerateGeometry as error:
                problems[camera, name] = str(error)
    return solutions, problems
