"""Tables that judge a calibration, and the truth of simulated sessions."""

from __future__ import annotations

import os
from dataclasses import dataclass

import cv2
import numpy as np
import pandas as pd
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.calibrate.outline import fused_outline_of, likely_outline_of, outline_of
from lrfcal_lib.calibrate.pipeline import left_out_residuals as jointly_left_out
from lrfcal_lib.fit.residuals import edge_residuals_px, plane_residuals_m
from lrfcal_lib.model.board import Board
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    axis_difference,
    axis_of,
    lrf_to_platform,
    paper_parameters,
    transform_difference,
)
from lrfcal_lib.preprocess.prepared import VARIANTS
from lrfcal_lib.session.stated import board_from_json, naming, read_json, transform_from_json
from lrfcal_lib.solvers import METHODS, solve_camera


@dataclass(frozen=True)
class Truth:
    """What a simulated session was made with.

    Attributes
    ----------
    T_head_lrf : RigidTransform
    cameras : dict of str to RigidTransform
        ``T_camera_lrf`` of a camera on the head, ``T_camera_platform`` of one on the base.
    board : Board
    boards : dict of int to RigidTransform
        ``T_platform_board`` by placement.
    pitch : dict of int to ndarray, shape (n_scan_lines,)
        Of every scan line, radians.
    """

    T_head_lrf: RigidTransform
    cameras: dict
    board: Board
    boards: dict
    pitch: dict


def read_truth(session):
    """The truth of a session, None for a recording.

    Parameters
    ----------
    session : Session

    Returns
    -------
    Truth or None

    Raises
    ------
    SessionError
        If ``truth.json`` is damaged.
    """
    file = session.path / "truth.json"
    if not os.path.lexists(file):
        return None
    data = read_json(file, session.path)
    with naming(f"{file} (simulate the session again)"):
        return Truth(
            transform_from_json(data["T_head_lrf"]),
            {name: _camera(entry) for name, entry in data["cameras"].items()},
            board_from_json(data["board"]),
            {int(n): transform_from_json(entry["T_platform_board"]) for n, entry in data["boards"].items()},
            {int(n): np.asarray(entry["pitch_rad"], float) for n, entry in data["sweeps"].items()},
        )


def _camera(entry):
    return transform_from_json(entry["T_camera_lrf"] if "T_camera_lrf" in entry else entry["T_camera_platform"])


def camera_errors(solution, truth, camera):
    """Rotation (degrees) and translation error (millimetres) of a camera, NaN without truth."""
    if truth is None:
        return {}
    angle, distance = transform_difference(solution.transform, truth.cameras[camera])
    return {"rotation_error_deg": np.rad2deg(angle), "translation_error_mm": 1000 * distance}


def axis_errors(T_head_lrf, truth):
    """Direction (degrees) and offset error (millimetres) of a tilt axis, NaN without truth."""
    if truth is None:
        return np.nan, np.nan
    angle, offset = axis_difference(axis_of(T_head_lrf), axis_of(truth.T_head_lrf))
    return np.rad2deg(angle), 1000 * offset


def edge_point_table(prepared, truth):
    """Bias of each rule for the edge point against the true edge, across the edge within the board's plane.

    Parameters
    ----------
    prepared : Prepared
    truth : Truth

    Returns
    -------
    DataFrame
        variant, edge, n, bias_mm (positive outside the board), sd_mm.
    """
    rows = []
    for variant in VARIANTS:
        misses = {edge: [] for edge in truth.board.edges}
        for placement, names in prepared.names.items():
            found = prepared.edges[variant][placement]
            for side, edge in names.items():
                misses[edge].append(_miss(found, found.side == side, edge, truth, placement))
        for edge, parts in misses.items():
            miss = 1000 * np.concatenate([*parts, np.zeros(0)])
            bias, spread = (miss.mean(), miss.std(ddof=1)) if len(miss) > 1 else (np.nan, np.nan)
            rows.append((variant, edge, len(miss), bias, spread))
    return pd.DataFrame(rows, columns=["variant", "edge", "n", "bias_mm", "sd_mm"])


def _miss(found, rows, edge, truth, placement):
    """Signed distances of edge points from the true edge, metres."""
    pitch = truth.pitch[placement][found.line[rows]]
    p_platform = lrf_to_platform(found.points[rows], pitch, truth.T_head_lrf)
    p_board = truth.boards[placement].inv().apply(p_platform)
    line = truth.board.lines()[truth.board.edges.index(edge)]
    return p_board[:, :2] @ line[:2] + line[2]


# Li et al. 2009, section V.A: stated and reconstructed edges of their board, millimetres
PAPER_EDGES_MM = {"ab": (315.0, 300.3633), "ca": (380.0, 373.4127), "bc": (491.0, 496.2991)}
AXIS = ("axis_out_of_scan_plane", "axis_in_scan_plane", "offset_in_scan_plane", "offset_across_scan_plane")
INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "k5")
USED = {"crossing": "crossing_placement", "plane": "placements", "scene": "scene_placement"}


def rms(values):
    """Root mean square of the finite values; NaN where there are none."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


def placements_table(prepared, observations):
    """Every placement of the board: what is usable of it, and why not.

    Parameters
    ----------
    prepared : Prepared
    observations : dict of (str, str) to CameraObservations
        By camera and variant.

    Returns
    -------
    DataFrame
        placement, used, reason, n_scan_lines, n_points, then one column ``edges_<camera>`` a camera: the number of
        edges of the board that a scan crosses and the camera sees.
    """
    rows = []
    for placement in prepared.session.board_placements:
        scan = prepared.scans.get(placement)
        row = {
            "placement": placement,
            "used": False,
            "reason": prepared.problems.get(placement, ""),
            "n_scan_lines": 0 if scan is None else int(scan.mask.any(axis=1).sum()),
            "n_points": 0 if scan is None else int(scan.mask.sum()),
        }
        for camera in prepared.views:
            obs = observations[camera, "half_step"]
            row[f"edges_{camera}"] = len(set(obs.crossing_edge[obs.crossing_placement == placement]))
            row["used"] |= placement in obs.all_placements
        row["reason"] = row["reason"] or _why_not(prepared, placement)
        rows.append(row)
    return pd.DataFrame(rows)


def _why_not(prepared, placement):
    """What the cameras could not use of a placement."""
    notes = []
    for camera, views in prepared.views.items():
        view = views.get(placement)
        if view is None:
            notes.append(f"{camera}: no image")
        elif view.reason:
            notes.append(f"{camera}: {view.reason}")
        else:
            notes += [f"{camera} {edge}: {why}" for edge, why in view.rejected]
    return "; ".join(notes)


def poses_under(obs, model):
    """The board poses a camera sees under other intrinsics.

    Parameters
    ----------
    obs : CameraObservations
    model : CameraModel or None
        None leaves the poses as they are.

    Returns
    -------
    ndarray, shape (p, 4, 4)
        Unchanged where the pattern was not seen.
    """
    if model is None or len(obs.pattern_points) == 0:
        return obs.board_poses
    moved = obs.board_poses.copy()
    for row, pixels in enumerate(obs.pattern_pixels):
        good = np.isfinite(pixels).all(axis=1)
        if good.sum() >= 6:
            moved[row] = _refit(obs.board_poses[row], obs.pattern_points[good], pixels[good], model)
    return moved


def _refit(pose, points, pixels, model):
    start = cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3:].copy()
    flags = {"useExtrinsicGuess": True, "flags": cv2.SOLVEPNP_ITERATIVE}
    _, rotvec, shift = cv2.solvePnP(
        points, np.ascontiguousarray(pixels), model.matrix, model.distortion, *start, **flags
    )
    return RigidTransform.from_components(shift[:, 0], Rotation.from_rotvec(rotvec[:, 0])).as_matrix()


def plane_residuals_of(obs, solution):
    """Distances of face points from the board planes, under the intrinsics of the solution; metres."""
    return plane_residuals_m(obs, solution.transform, poses_under(obs, solution.model))


def left_out_residuals(obs, judge, method, full):
    """Residuals of every placement under a calibration from all the others.

    Parameters
    ----------
    obs : CameraObservations
        What the method works on.
    judge : CameraObservations
        What it is judged on; the same placements.
    method : str
    full : Solution
        The calibration from all placements; the start of each solve.

    Returns
    -------
    edge_px : ndarray, shape (n_crossings of `judge`,)
    plane_m : ndarray, shape (n_plane_points of `judge`,)
        NaN where the remaining placements do not determine the camera.
    """
    edge_px = np.full(len(judge.crossing_points), np.nan)
    plane_m = np.full(len(judge.plane_points), np.nan)
    for placement in judge.all_placements:
        try:
            rest = obs.select(obs.all_placements[obs.all_placements != placement])
            solution = solve_camera(rest, method, full.transform)
        except DegenerateGeometry:
            continue
        held = judge.select([placement])
        edge_px[judge.crossing_placement == placement] = edge_residuals_px(held, solution.transform, solution.model)
        plane_m[judge.plane_placement == placement] = plane_residuals_of(held, solution)
    return edge_px, plane_m


def method_comparison(observations, solutions, left_out=True, truth=None, joint=None):
    """Every method judged on the same crossings and face points, and on placements it has not seen.

    Parameters
    ----------
    observations : dict of (str, str) to CameraObservations
        By camera and edge-point variant. All methods are judged on the same points: the `half_step` crossings of scan
        lines (not where the sweep enters or leaves the board, which hangs on the pitch) and the face points.
    solutions : dict of (str, str) to Solution
        By camera and method.
    left_out : bool
        Also leave out one placement after another (one more solve for each).
    truth : Truth, optional
        Of a simulated session.
    joint : JointCalibration, optional
        With its estimates without each placement (:func:`lrfcal_lib.calibrate.pipeline.leave_out`): the left-out
        columns of the method 'joint'. It is judged on the same beams, with its own platform and range offset.

    Returns
    -------
    DataFrame
        camera, method, n_placements, edge_median_px, edge_rms_px, plane_rms_mm, left_out_edge_rms_px,
        left_out_plane_rms_mm; with truth also rotation_error_deg, translation_error_mm.
    """
    rows = []
    for (camera, name), solution in solutions.items():
        variant, uses = ("joint", "plane") if name == "joint" else (METHODS[name].variant, METHODS[name].uses)
        own, judge = observations[camera, variant], _judge(observations, camera, name)
        edge = edge_residuals_px(judge, solution.transform, solution.model)
        held_edge, held_plane = np.zeros(0), np.zeros(0)
        if left_out and name == "joint" and joint is not None:
            held_edge, held_plane = jointly_left_out(joint, camera)
        elif left_out and name != "joint":
            held_edge, held_plane = left_out_residuals(own, judge, name, solution)
        row = {"camera": camera, "method": name, "n_placements": len(np.unique(getattr(own, USED[uses])))}
        row["edge_median_px"] = float(np.median(np.abs(edge))) if len(edge) else np.nan
        row["edge_rms_px"] = rms(edge)
        row["plane_rms_mm"] = 1000 * rms(plane_residuals_of(judge, solution))
        row["left_out_edge_rms_px"], row["left_out_plane_rms_mm"] = rms(held_edge), 1000 * rms(held_plane)
        rows.append(row | camera_errors(solution, truth, camera))
    return pd.DataFrame(rows)


def _judge(observations, camera, name):
    """The points that methods are judged on; the joint estimate has its own platform."""
    return observations[camera, "joint" if name == "joint" else "half_step"].along()


def best_method(comparison, among=("line", "zhang_pless")):
    """The method to hand over: the smallest product of its edge and plane errors on left-out placements.

    Parameters
    ----------
    comparison : DataFrame
        Of :func:`method_comparison`.
    among : sequence of str
        A method that fits its own feature and fails on the other one (lines bent by a wide laser spot, say) loses.

    Returns
    -------
    str

    Raises
    ------
    ValueError
        If none of them was judged on left-out placements, or there is none.

    Notes
    -----
    A rule of thumb, made after the two sessions it was first used on had been seen. It picks one winner by a margin
    that may be within the noise (48.9 against 53.9 px mm on the LMS400 recording).
    """
    if comparison.empty:
        raise ValueError("no camera was calibrated by any method")
    mean = comparison.groupby("method")[["left_out_edge_rms_px", "left_out_plane_rms_mm"]].mean()
    mean = mean.reindex(list(among)).dropna(axis=1, how="all")  # where no edge was seen, planes judge alone
    score = mean.prod(axis=1, skipna=False).dropna()
    if mean.empty or score.empty:
        raise ValueError(f"none of {', '.join(among)} was judged on left-out placements; it takes more of them")
    return score.idxmin()


def handed_over(calibration):
    """The method whose result goes into ``calibration.json`` and colours the cloud.

    Parameters
    ----------
    calibration : Calibration

    Returns
    -------
    str
        'joint' where that estimate converged and left nothing open; otherwise what :func:`best_method` says.

    Raises
    ------
    ValueError
        If no method was judged on left-out placements.
    """
    joint = calibration.joint
    if joint is not None and joint.solution.converged and not joint.solution.unobservable:
        return "joint"
    return best_method(method_comparison(calibration.observations, calibration.solutions))


def camera_calibration_table(solutions):
    """Parameters of every calibration with their standard deviations.

    Parameters
    ----------
    solutions : dict of (str, str) to Solution
        By camera and method.

    Returns
    -------
    DataFrame
        camera, method, parameter, unit, value, sigma. sigma is the larger of the propagated noise and the spread over
        placements.
    """
    rows = []
    for (camera, method), solution in solutions.items():
        sigma = solution.trusted_sigma
        for name, value, spread in zip(solution.names, solution.parameters, sigma, strict=True):
            unit, factor = unit_of(name)
            rows.append((camera, method, name, unit, factor * value, factor * spread))
    return pd.DataFrame(rows, columns=["camera", "method", "parameter", "unit", "value", "sigma"])


def platform_calibration_table(platform, truth=None):
    """The tilt axis by every method with its standard deviations, and the paper's own parameters.

    Parameters
    ----------
    platform : PlatformCalibration
    truth : Truth, optional
        Of a simulated session.

    Returns
    -------
    DataFrame
        method, parameter, unit, value, sigma; with truth also axis_direction_error_deg and axis_offset_error_mm of the
        method. The four numbers of the axis are its angles out of and within the scan
        plane and its offsets within and across it; phi and t_y are the same axis in the paper's chart.
    """
    factors = np.array([np.rad2deg(1.0), np.rad2deg(1.0), 1000.0, 1000.0])
    rows = []
    for method, (values, covariance) in platform.parameters().items():
        for name, value, sigma in zip(AXIS, factors * values, factors * np.sqrt(np.diag(covariance)), strict=True):
            rows.append((method, name, "deg" if name.startswith("axis") else "mm", value, sigma))
        phi, ty = paper_parameters(platform.transform(method))
        for name, value in zip(("phi_x", "phi_y", "phi_z"), np.rad2deg(phi), strict=True):
            rows.append((method, name, "deg", value, np.nan))
        rows.append((method, "t_y", "mm", 1000 * ty, np.nan))
    table = pd.DataFrame(rows, columns=["method", "parameter", "unit", "value", "sigma"])
    if truth is None:
        return table
    errors = {method: axis_errors(platform.transform(method), truth) for method in platform.parameters()}
    direction, offset = (table.method.map({m: e[i] for m, e in errors.items()}) for i in (0, 1))
    return table.assign(axis_direction_error_deg=direction, axis_offset_error_mm=offset)


def sweeps_table(session):
    """What was recorded at every placement.

    Parameters
    ----------
    session : Session

    Returns
    -------
    DataFrame
        placement, n_scan_lines, n_returns, invalid_percent, pitch_from_deg, pitch_to_deg, pitch_step_deg (median),
        direction (+1 up, -1 down, 0 neither), n_images.
    """
    rows = []
    for placement in session.placements:
        sweep = session.sweep(placement)
        pitch = np.rad2deg(sweep.pitch)
        valid = np.isfinite(sweep.ranges)
        row = {"placement": placement, "n_scan_lines": len(pitch), "n_returns": int(valid.sum())}
        row |= {"invalid_percent": 100 * (1 - valid.mean()), "pitch_from_deg": pitch[0], "pitch_to_deg": pitch[-1]}
        row["pitch_step_deg"] = float(np.median(np.abs(np.diff(pitch)))) if len(pitch) > 1 else 0.0
        row |= {"direction": session.sweep_direction(placement), "n_images": len(session.images(placement=placement))}
        rows.append(row)
    return pd.DataFrame(rows)


def scans_table(prepared):
    """The board in every sweep: noise, rejected points, and the sides that scans cross.

    Parameters
    ----------
    prepared : Prepared

    Returns
    -------
    DataFrame
        placement, n_points, sigma_range_mm, jump_points, sides_along (crossed by scan lines), sides_across (where the
        sweep enters or leaves the board).
    """
    rows = []
    for placement, board in prepared.scans.items():
        along = {s.side for s in prepared.edges["half_step"][placement].sides}
        swept = prepared.swept["half_step"].get(placement)
        across = set() if swept is None else {s.side for s in swept.sides} - along
        row = {"placement": placement, "n_points": int(board.mask.sum()), "sigma_range_mm": 1000 * board.sigma_range}
        rows.append(
            row | {"jump_points": int(board.n_jump_points), "sides_along": len(along), "sides_across": len(across)}
        )
    return pd.DataFrame(rows)


def intrinsics_table(models):
    """Intrinsics of every camera with their standard deviations.

    Parameters
    ----------
    models : dict of str to CameraModel

    Returns
    -------
    DataFrame
        camera, parameter, unit, value, sigma (NaN where the session states the intrinsics).
    """
    rows = []
    for camera, model in models.items():
        sigma = np.full(9, np.nan) if model.covariance is None else np.sqrt(np.diag(model.covariance))
        for name, value, spread in zip(INTRINSICS, model.parameters, sigma, strict=True):
            rows.append((camera, name, unit_of(name)[0], value, spread))
    return pd.DataFrame(rows, columns=["camera", "parameter", "unit", "value", "sigma"])


def outline_table(outline):
    """Edge lengths of a board as the images show them.

    Parameters
    ----------
    outline : Outline

    Returns
    -------
    DataFrame
        edge, length_mm, sd_mm (over the images that show the edge with both neighbours), n_images.
    """
    rows = [(n, 1000 * v, 1000 * outline.length_sd[n], outline.n_lengths[n]) for n, v in outline.lengths.items()]
    return pd.DataFrame(rows, columns=["edge", "length_mm", "sd_mm", "n_images"])


def pitch_models_table(errors):
    """Which errors of the recorded pitch the data ask for.

    Parameters
    ----------
    errors : PitchErrors

    Returns
    -------
    DataFrame
        model, n_parameters, plane_rms_mm, F, p_value (against the model before).
    """
    rows = [
        (m.name, m.n_parameters, 1000 * np.mean(list(m.rms.values())), m.F, m.p_value) for m in errors.models.values()
    ]
    return pd.DataFrame(rows, columns=["model", "n_parameters", "plane_rms_mm", "F", "p_value"])


def pitch_errors_table(errors):
    """Offset of the recorded pitch of every sweep.

    Parameters
    ----------
    errors : PitchErrors

    Returns
    -------
    DataFrame
        placement, direction, offset_deg, sigma_deg.
    """
    each = errors.models["sweep"]
    offset, sigma = np.rad2deg(each.offset), np.rad2deg(each.offset_sigma)
    columns = {"placement": errors.placements, "direction": errors.direction, "offset_deg": offset, "sigma_deg": sigma}
    return pd.DataFrame(columns)


def axis_knowledge_table(platform):
    """Who knows each number of the tilt axis better: the data, or the rough measurement.

    Parameters
    ----------
    platform : PlatformCalibration
        With a ``line_3d`` solution.

    Returns
    -------
    DataFrame
        parameter, unit, sigma_data, sigma_rough, better.
    """
    found = np.sqrt(np.diag(platform.parameters()["line_3d"][1]))
    rows = []
    for name, data, rough in zip(AXIS, found, np.repeat(platform.stated_sigma, 2), strict=True):
        unit, factor = ("deg", np.rad2deg(1.0)) if name.startswith("axis") else ("mm", 1000.0)
        rows.append((name, unit, factor * data, factor * rough, "data" if data < rough else "rough measurement"))
    return pd.DataFrame(rows, columns=["parameter", "unit", "sigma_data", "sigma_rough", "better"])


def unit_of(parameter):
    """Unit and factor in which a parameter is shown."""
    if parameter[0] == "r":
        return "deg", np.rad2deg(1.0)
    if parameter[0] == "t":
        return "mm", 1000.0
    return ("px", 1.0) if parameter in ("fx", "fy", "cx", "cy") else ("1", 1.0)


def stereo_check(solutions, cameras, T_second_first):
    """What the cameras, each calibrated on its own, say about each other, against the chessboard.

    Parameters
    ----------
    solutions : dict of (str, str) to Solution
    cameras : (str, str)
        First and second camera.
    T_second_first : RigidTransform
        From the chessboard in both images.

    Returns
    -------
    DataFrame
        method, baseline_mm, baseline_error_mm, translation_error_mm, rotation_error_deg. Both calibrations use the same
        LRF points, so the check cannot see an error of the cloud.
    """
    first, second = cameras
    baseline = np.linalg.norm(T_second_first.translation)
    rows = []
    for method in (*METHODS, "joint"):
        if (first, method) not in solutions or (second, method) not in solutions:
            continue
        found = solutions[second, method].transform * solutions[first, method].transform.inv()
        angle, distance = transform_difference(found, T_second_first)
        length = np.linalg.norm(found.translation)
        row = {"method": method, "baseline_mm": 1000 * length, "baseline_error_mm": 1000 * (length - baseline)}
        rows.append(row | {"translation_error_mm": 1000 * distance, "rotation_error_deg": np.rad2deg(angle)})
    return pd.DataFrame(rows)


def edge_lengths(prepared, T_head_lrf=None, edge_model_of=None, joint=None):
    """Edges of the board measured in the cloud of every placement, beside the paper's own row.

    Parameters
    ----------
    prepared : Prepared
    T_head_lrf : RigidTransform, optional
        For the least-squares variants; the session's own platform when left out.
    edge_model_of : callable, optional
        ``edge_model_of(placement) -> EdgeModel``, from a calibration that has not seen the placement. Adds the variant
        'likelihood', which does not know the board's size.
    joint : JointCalibration, optional
        With its estimates without each placement. Adds 'likelihood' from its edge model, and 'fused': image edges on
        the plane of the cloud. Neither knows the board's size, and neither calibration has seen the placement.

    Returns
    -------
    DataFrame
        source, placement, edge, ends, variant, true_mm, measured_mm, error_mm. One row for every edge that some camera
        sees at a placement; NaN where the cloud does not show both its ends. `ends` is 'scan' where beams decide both
        ends of the edge, 'pitch' where one hangs on the recorded pitch (the edge runs across the scan lines), 'image'
        where images show them ('fused').
    """
    ways = {v: lambda placement, v=v: outline_of(prepared, placement, v, T_head_lrf) for v in VARIANTS}
    if joint is not None:
        edge_model_of = joint.edge_model
        ways["fused"] = lambda placement: fused_outline_of(joint, placement)
    if edge_model_of is not None:
        ways["likelihood"] = lambda placement: likely_outline_of(prepared, placement, edge_model_of(placement))
    rows = []
    for variant, measure in ways.items():
        for placement in prepared.session.board_placements:
            rows += _placement_lengths(prepared, placement, variant, measure)
    rows += [("paper", np.nan, name, "scan", "last_beam", *PAPER_EDGES_MM[name]) for name in PAPER_EDGES_MM]
    columns = ["source", "placement", "edge", "ends", "variant", "true_mm", "measured_mm"]
    table = pd.DataFrame(rows, columns=columns).astype({"placement": "Int64"})
    return table.assign(error_mm=table.measured_mm - table.true_mm)


def _placement_lengths(prepared, placement, variant, measure):
    """Rows of one placement: every edge that a camera sees, NaN where the cloud does not show both its ends."""
    try:
        measured, across = measure(placement) if placement in prepared.names else (None, frozenset())
    except DegenerateGeometry:
        measured, across = None, frozenset()
    rows = []
    known = {} if prepared.board.corners is None else prepared.board.lengths()
    for name, true in known.items():
        length = np.nan if measured is None else measured.lengths.get(name, np.nan)
        ends = "not measured"
        if np.isfinite(length):
            ends = ends_of(prepared.board.edges, name, across)
        if _seen_in_image(prepared, placement, name):
            rows.append((prepared.session.name, placement, name, ends, variant, 1000 * true, 1000 * length))
    return rows


def ends_of(edges, name, across):
    """What decides the ends of an edge: its neighbours in the image, beams, or the recorded pitch."""
    if across is None:
        return "image"
    return "pitch" if _neighbours(edges, name) & across else "scan"


def _neighbours(edges, name):
    i = edges.index(name)
    return {edges[i - 1], edges[(i + 1) % len(edges)]}


def _seen_in_image(prepared, placement, name):
    views = [views.get(placement) for views in prepared.views.values()]
    return any(view is not None and view.edge(name) is not None for view in views)


def edge_summary(table):
    """Mean absolute, median and signed mean error of an edge-length table.

    Parameters
    ----------
    table : DataFrame
        Of :func:`edge_lengths`.

    Returns
    -------
    DataFrame
        source, ends, variant, n, mean_abs_error_mm, median_abs_error_mm, mean_error_mm. Measured edges only.
    """
    table = table[table.measured_mm.notna()]
    groups = table.assign(size=table.error_mm.abs()).groupby(["source", "ends", "variant"], sort=False)
    return groups.agg(
        n=("size", "size"),
        mean_abs_error_mm=("size", "mean"),
        median_abs_error_mm=("size", "median"),
        mean_error_mm=("error_mm", "mean"),
    ).reset_index()
