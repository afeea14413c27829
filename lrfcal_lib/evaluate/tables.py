"""Tables that judge calibrations, the joint estimate among them, and the truth of simulated sessions."""

import os
import re
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
import pandas as pd
from scipy.spatial.transform import RigidTransform
from scipy.special import ndtri

from lrfcal_lib.calibrate.combined import combined_outlines
from lrfcal_lib.calibrate.outline import fused_outline_of, likely_outline_of, outline_of
from lrfcal_lib.evaluate.next_placement import outline
from lrfcal_lib.fit.residuals import disc_edge, edge_residuals_px, edge_shift, plane_residuals_m
from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.model import geometry
from lrfcal_lib.model.board import Board
from lrfcal_lib.model.camera import project
from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.preprocess.prepared import VARIANTS
from lrfcal_lib.session.stated import board_from_json, naming, read_json, transform_from_json
from lrfcal_lib.solvers import METHODS, solve_camera
from lrfcal_lib.solvers.joint import solve_again
from lrfcal_lib.solvers.joint_noise import on_board

# Li et al. 2009, section V.A: stated and reconstructed edges of their board, millimetres
PAPER_EDGES_MM = {"ab": (315.0, 300.3633), "ca": (380.0, 373.4127), "bc": (491.0, 496.2991)}
INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "k5")
ALL = 10**9  # crossings
ENDS = {"fused": ("image", ""), "combined": ("image", "scan")}  # what decides ends of edges: images, beams, the pitch
UNITS = {  # of parameters, and the factor from radians and metres
    r"axis_.*|phi_[xyz]|(.*_)?r[xyz]|pitch_by_direction": ("deg", np.rad2deg(1.0)),
    r"offset_.*|t_y|(.*_)?t[xyz]|range_offset": ("mm", 1000.0), r"pitch_scale": ("%", 100.0),
    r"[fc][xy]": ("px", 1.0),
}  # fmt: skip
NOISE_WORDS = {
    "face_scale": "scatter of ranges, in stated standard deviations",
    "view_scale": "scatter of board poses in images, in stated standard deviations",
    "face_share": "independent errors per range", "beam_share": "independent errors per beam at an edge",
    "sigma_pitch": "error of the pitch at a stop [deg]",
    "side_sigma": "spread of the edge bias from side to side [log odds]",
}  # fmt: skip


def unit_of(parameter):
    """Unit and factor in which a parameter is shown."""
    return next((unit for names, unit in UNITS.items() if re.fullmatch(names, parameter)), ("1", 1.0))


def rms(values):
    """Root mean square of the finite values; NaN where there are none."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


@dataclass(frozen=True)
class Truth:
    """What a simulated session was made with.

    `cameras` are ``T_camera_lrf`` of a camera on the head, ``T_camera_platform`` of one on the base; `boards`
    ``T_platform_board`` by placement, `pitch` that of every scan line by placement, radians.
    """

    T_head_lrf: RigidTransform
    cameras: dict
    board: Board
    boards: dict
    pitch: dict


def read_truth(session):
    """The :class:`Truth` of a session, None for a recording; a SessionError if ``truth.json`` is damaged."""
    file = session.path / "truth.json"
    if not os.path.lexists(file):
        return None
    data = read_json(file, session.path)
    with naming(f"{file} (simulate the session again)"):
        mounts, cameras = ("T_camera_lrf", "T_camera_platform"), data["cameras"].items()
        return Truth(
            transform_from_json(data["T_head_lrf"]),
            {c: transform_from_json(next(e[mount] for mount in mounts if mount in e)) for c, e in cameras},
            board_from_json(data["board"]),
            {int(n): transform_from_json(entry["T_platform_board"]) for n, entry in data["boards"].items()},
            {int(n): np.asarray(entry["pitch_rad"], float) for n, entry in data["sweeps"].items()},
        )


def camera_errors(solution, truth, camera):
    """Rotation (degrees) and translation error (millimetres) of a camera, by column; none without truth."""
    if truth is None:
        return {}
    angle, distance = geometry.transform_difference(solution.transform, truth.cameras[camera])
    return {"rotation_error_deg": np.rad2deg(angle), "translation_error_mm": 1000 * distance}


def axis_errors(T_head_lrf, truth):
    """Direction (degrees) and offset error (millimetres) of a tilt axis."""
    angle, offset = geometry.axis_difference(geometry.axis_of(T_head_lrf), geometry.axis_of(truth.T_head_lrf))
    return np.rad2deg(angle), 1000 * offset


def edge_point_table(prepared, truth):
    """Bias of each rule for the edge point against the true edge, across the edge within the board's plane.

    Columns variant, edge, n, bias_mm (positive outside the board), sd_mm.
    """
    rows, lines = [], dict(zip(truth.board.edges, truth.board.lines(), strict=True))
    for variant in VARIANTS:
        misses = {edge: [np.zeros(0)] for edge in lines}
        for placement, names in prepared.names.items():
            found = prepared.edges[variant][placement]
            p_platform = geometry.lrf_to_platform(found.points, truth.pitch[placement][found.line], truth.T_head_lrf)
            p_board = truth.boards[placement].inv().apply(p_platform)
            for side, edge in names.items():
                misses[edge].append(p_board[found.side == side, :2] @ lines[edge][:2] + lines[edge][2])
        for edge, parts in misses.items():
            miss = pd.Series(1000 * np.concatenate(parts))
            rows.append((variant, edge, len(miss), miss.mean() if len(miss) > 1 else np.nan, miss.std()))
    return pd.DataFrame(rows, columns=["variant", "edge", "n", "bias_mm", "sd_mm"])


def placements_table(prepared, observations):
    """Every placement of the board: what is usable of it, and why not.

    Columns placement, used, reason, n_scan_lines, n_points, then one column ``edges_<camera>`` a camera: the number of
    edges of the board that a scan crosses and the camera sees. `observations` by camera and variant.
    """
    rows, own = [], {camera: observations[camera, "half_step"] for camera in prepared.views}
    for placement in prepared.session.board_placements:
        mask = prepared.scans[placement].mask if placement in prepared.scans else np.zeros((0, 0), bool)
        notes = []
        for camera, views in prepared.views.items():
            view = views.get(placement)
            if view is None or view.reason:
                notes.append(f"{camera}: {'no image' if view is None else view.reason}")
            else:
                notes += [f"{camera} {edge}: {why}" for edge, why in view.rejected]
        row = {
            "placement": placement, "used": any(placement in obs.all_placements for obs in own.values()),
            "reason": prepared.problems.get(placement) or "; ".join(notes), "n_scan_lines": int(mask.any(axis=1).sum()),
            "n_points": int(mask.sum()),
        }  # fmt: skip
        crossed = {c: np.unique(obs.crossing_edge[obs.crossing_placement == placement]) for c, obs in own.items()}
        rows.append(row | {f"edges_{camera}": len(edges) for camera, edges in crossed.items()})
    return pd.DataFrame(rows)


def poses_under(obs, model):
    """The board poses (p, 4, 4) that a camera sees under other intrinsics; as they are where no pattern was seen."""
    if model is None or len(obs.pattern_points) == 0:
        return obs.board_poses
    moved = obs.board_poses.copy()
    for pose, pixels in zip(moved, obs.pattern_pixels, strict=True):
        good = np.isfinite(pixels).all(axis=1)
        if good.sum() >= 6:
            start = cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3:].copy()
            seen = obs.pattern_points[good], pixels[good], model.matrix, model.distortion
            _, rotvec, shift = cv2.solvePnP(*seen, *start, useExtrinsicGuess=True, flags=cv2.SOLVEPNP_ITERATIVE)
            pose[:3, :3], pose[:3, 3:] = cv2.Rodrigues(rotvec)[0], shift
    return moved


def plane_residuals_of(obs, solution):
    """Distances of face points from the board planes, under the intrinsics of the solution; metres."""
    return plane_residuals_m(obs, solution.transform, poses_under(obs, solution.model))


def left_out(obs, judge, method, full):
    """Calibrations from all placements but one, and what that one shows: (CameraObservations, Solution) each.

    The `method` of METHODS works on `obs` and is judged on `judge`, CameraObservations of the same placements; `full`
    is the calibration from all of them, the start of each solve. Placements whose absence leaves the camera open are
    missing.
    """
    for placement in judge.all_placements:
        with suppress(DegenerateGeometry):
            rest = obs.select(obs.all_placements[obs.all_placements != placement])
            yield judge.select([placement]), solve_camera(rest, method, full.transform, search=False)


def jointly_left_out(joint, camera):
    """The same of the joint estimate (JointCalibration), which is judged with its own platform and range offset."""
    ready = joint.prepared
    for placement, solution in joint.without.items():
        alone = replace(joint, prepared=replace(ready, scans={placement: ready.scans[placement]}))
        yield alone.seen_by(camera, solution).along().select([placement]), solution.camera(camera)


def left_out_residuals(pairs):
    """Residuals of every placement under a calibration from all the others: crossings (pixels), face points (metres).

    `pairs` are those of :func:`left_out` or :func:`jointly_left_out`.
    """
    edges, planes = [np.zeros(0)], [np.zeros(0)]
    for held, solution in pairs:
        edges.append(edge_residuals_px(held, solution.transform, solution.model))
        planes.append(plane_residuals_of(held, solution))
    return np.concatenate(edges), np.concatenate(planes)


def method_comparison(observations, solutions, truth=None, joint=None):
    """Every method judged on the same crossings and face points, and on placements it has not seen.

    Parameters
    ----------
    observations : dict of (str, str) to CameraObservations
        By camera and edge-point variant. All methods are judged on the same points: the `half_step` crossings of scan
        lines (not where the sweep enters or leaves the board, which hangs on the pitch) and the face points.
    solutions : dict of (str, str) to Solution
        By camera and method.
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
        if name == "joint":
            own = observations[camera, "joint"]
            judge, used = own.along(), own.placements
            held = () if joint is None else jointly_left_out(joint, camera)
        else:
            own, judge = observations[camera, METHODS[name].variant], observations[camera, "half_step"].along()
            used = own.placements if METHODS[name].uses == "plane" else getattr(own, f"{METHODS[name].uses}_placement")
            held = left_out(own, judge, name, solution)
        edge, held = edge_residuals_px(judge, solution.transform, solution.model), left_out_residuals(held)
        row = {
            "camera": camera, "method": name, "n_placements": len(np.unique(used)),
            "edge_median_px": float(np.median(np.abs(edge))) if len(edge) else np.nan, "edge_rms_px": rms(edge),
            "plane_rms_mm": 1000 * rms(plane_residuals_of(judge, solution)), "left_out_edge_rms_px": rms(held[0]),
            "left_out_plane_rms_mm": 1000 * rms(held[1]),
        }  # fmt: skip
        rows.append(row | camera_errors(solution, truth, camera))
    return pd.DataFrame(rows)


def best_method(comparison, among=("line", "zhang_pless")):
    """The method of a :func:`method_comparison` to hand over: least product of its left-out edge and plane errors.

    A method that fits its own feature and fails on the other one (lines bent by a wide laser spot, say) loses. A
    ValueError where none of them was judged on left-out placements.

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
    """The method of a Calibration whose result goes into ``calibration.json`` and colours the cloud.

    'joint' where that estimate converged and left nothing open; otherwise what :func:`best_method` says. None where no
    camera was calibrated, or none could be judged.
    """
    joint = calibration.joint
    if joint is not None and joint.solution.converged and not joint.solution.unobservable:
        return "joint"
    compared = method_comparison(calibration.observations, calibration.solutions)
    with suppress(ValueError):
        return best_method(compared)
    return None


def _parameter_table(keys, found):
    """A row a parameter, in its unit; `found` has names, values and sigmas by a tuple of keys."""
    rows = []
    for key, columns in found.items():
        for name, value, sigma in zip(*columns, strict=True):
            unit, factor = unit_of(name)
            rows.append((*key, name, unit, factor * value, factor * sigma))
    return pd.DataFrame(rows, columns=[*keys, "parameter", "unit", "value", "sigma"])


def camera_calibration_table(solutions):
    """Parameters of every calibration (Solutions by camera and method) with their standard deviations.

    Columns camera, method, parameter, unit, value, sigma (`Solution.trusted`).
    """
    found = {key: (s.names, s.parameters, s.trusted_sigma) for key, s in solutions.items()}
    return _parameter_table(["camera", "method"], found)


def platform_calibration_table(platform, truth=None):
    """The tilt axis by every method (PlatformCalibration) with its sigmas, and the paper's own parameters.

    Columns method, parameter, unit, value, sigma; with truth also axis_direction_error_deg and axis_offset_error_mm of
    the method. The four numbers of the axis are its angles out of and within the scan plane and its offsets within and
    across it; phi and t_y are the same axis in the paper's chart.
    """
    names, found = (*AXIS_NAMES, "phi_x", "phi_y", "phi_z", "t_y"), {}
    for method, (values, covariance) in platform.parameters().items():
        phi, ty = geometry.paper_parameters(platform.transform(method))
        sigma = np.append(np.sqrt(np.diag(covariance)), np.full(4, np.nan))
        found[method,] = names, [*values, *phi, ty], sigma
    table = _parameter_table(["method"], found)
    if truth is not None:
        errors = {method: axis_errors(platform.transform(method), truth) for (method,) in found}
        table[["axis_direction_error_deg", "axis_offset_error_mm"]] = [errors[method] for method in table.method]
    return table


def sweeps_table(session):
    """What a session recorded at every placement.

    Columns placement, n_scan_lines, n_returns, invalid_percent, pitch_from_deg, pitch_to_deg, pitch_step_deg (median),
    direction (+1 up, -1 down, 0 neither), n_images.
    """
    rows = []
    for placement in session.placements:
        sweep = session.sweep(placement)
        pitch, valid = np.rad2deg(sweep.pitch), np.isfinite(sweep.ranges)
        rows.append({
            "placement": placement, "n_scan_lines": len(pitch), "n_returns": int(valid.sum()),
            "invalid_percent": 100 * (1 - valid.mean()), "pitch_from_deg": pitch[0], "pitch_to_deg": pitch[-1],
            "pitch_step_deg": float(np.median(np.abs(np.diff(pitch)))) if len(pitch) > 1 else 0.0,
            "direction": session.sweep_direction(placement), "n_images": len(session.images(placement=placement)),
        })  # fmt: skip
    return pd.DataFrame(rows)


def scans_table(prepared):
    """The board in every sweep (Prepared): noise, rejected points, and the sides that scans cross.

    Columns placement, n_points, sigma_range_mm, jump_points, sides_along (crossed by scan lines), sides_across (where
    the sweep enters or leaves the board).
    """
    rows = []
    for placement, board in prepared.scans.items():
        swept = prepared.swept["half_step"].get(placement)
        along = {s.side for s in prepared.edges["half_step"][placement].sides}
        across = set() if swept is None else {s.side for s in swept.sides} - along
        noise, points, jumps = 1000 * board.sigma_range, int(board.mask.sum()), int(board.n_jump_points)
        rows.append((placement, points, noise, jumps, len(along), len(across)))
    columns = ["placement", "n_points", "sigma_range_mm", "jump_points", "sides_along", "sides_across"]
    return pd.DataFrame(rows, columns=columns)


def intrinsics_table(models):
    """Intrinsics of every camera (CameraModels by name) with their standard deviations.

    Columns camera, parameter, unit, value, sigma (NaN where the session states the intrinsics).
    """
    unknown = np.full((9, 9), np.nan)
    sigmas = {c: np.sqrt(np.diag(unknown if m.covariance is None else m.covariance)) for c, m in models.items()}
    return _parameter_table(["camera"], {(c,): (INTRINSICS, m.parameters, sigmas[c]) for c, m in models.items()})


def outline_table(outline):
    """Edge lengths of a board (:class:`lrfcal_lib.preprocess.survey.Outline`) as the images show them.

    Columns edge, length_mm, sd_mm (over the images that show the edge with both neighbours), n_images.
    """
    lengths, sd, count = outline.board.lengths(), outline.length_sd, outline.n_lengths
    rows = [(name, 1000 * length, 1000 * sd[name], count[name]) for name, length in lengths.items()]
    return pd.DataFrame(rows, columns=["edge", "length_mm", "sd_mm", "n_images"])


def pitch_models_table(errors):
    """Which errors of the recorded pitch (PitchErrors) the data ask for.

    Columns model, n_parameters, plane_rms_mm, F, p_value (against the model before).
    """
    models = errors.models.values()
    rows = [(m.name, m.n_parameters, 1000 * np.mean(list(m.rms.values())), m.F, m.p_value) for m in models]
    return pd.DataFrame(rows, columns=["model", "n_parameters", "plane_rms_mm", "F", "p_value"])


def pitch_errors_table(errors):
    """Offset of the recorded pitch of every sweep (PitchErrors): placement, direction, offset_deg, sigma_deg."""
    each = errors.models["sweep"]
    offset, sigma = np.rad2deg(each.offset), np.rad2deg(each.offset_sigma)
    columns = {"placement": errors.placements, "direction": errors.direction, "offset_deg": offset, "sigma_deg": sigma}
    return pd.DataFrame(columns)


def axis_knowledge_table(platform):
    """Who knows each number of the tilt axis better: the data (solution 'line_3d'), or the rough measurement.

    Columns parameter, unit, sigma_data, sigma_rough, better.
    """
    data, rough = np.sqrt(np.diag(platform.parameters()["line_3d"][1])), np.repeat(platform.stated_sigma, 2)
    units, factors = zip(*map(unit_of, AXIS_NAMES), strict=True)
    return pd.DataFrame({
        "parameter": AXIS_NAMES, "unit": units, "sigma_data": factors * data, "sigma_rough": factors * rough,
        "better": np.where(data < rough, "data", "rough measurement"),
    })  # fmt: skip


def stereo_check(solutions, cameras, T_second_first):
    """What two cameras, each calibrated on its own, say about each other, against the chessboard in both images.

    Columns method, baseline_mm, baseline_error_mm, translation_error_mm, rotation_error_deg. Both calibrations use the
    same LRF points, so the check cannot see an error of the cloud.
    """
    rows, baseline = [], np.linalg.norm(T_second_first.translation)
    for method in (*METHODS, "joint"):
        if all((camera, method) in solutions for camera in cameras):
            first, second = (solutions[camera, method].transform for camera in cameras)
            angle, distance = geometry.transform_difference(second * first.inv(), T_second_first)
            length = np.linalg.norm((second * first.inv()).translation)
            rows.append((method, 1000 * length, 1000 * (length - baseline), 1000 * distance, np.rad2deg(angle)))
    columns = ["method", "baseline_mm", "baseline_error_mm", "translation_error_mm", "rotation_error_deg"]
    return pd.DataFrame(rows, columns=columns)


def edge_lengths(prepared, T_head_lrf=None, joint=None):
    """Edges of the board measured in the cloud of every placement, beside the paper's own row.

    Parameters
    ----------
    prepared : Prepared
    T_head_lrf : RigidTransform, optional
        For the least-squares variants; the session's own platform when left out.
    joint : JointCalibration, optional
        With its estimates without each placement. Adds 'combined', the one answer: all that is known, each weighted by
        what it is worth; and to compare with it 'fused', image edges on the plane of the cloud, and 'likelihood', beams
        about the edges. None knows the board's size, and their calibrations have not seen the placement.

    Returns
    -------
    DataFrame
        source, placement, edge, ends, variant, true_mm, measured_mm, sigma_mm, error_mm. One row for every edge that
        some camera sees at a placement; NaN where the cloud does not show both its ends. `ends` is 'scan' where beams
        decide both ends of the edge, 'pitch' where one hangs on the recorded pitch (the edge runs across the scan
        lines), 'image' where images show both ('fused', 'combined'). `sigma_mm` holds all that is known to be
        uncertain for 'combined' and 'likelihood', and only the scatter of points about the sides for the others.
    """

    measure = {v: lambda p, v=v: outline_of(prepared, p, v, T_head_lrf) for v in VARIANTS}
    known = {} if prepared.board.corners is None else prepared.board.lengths()
    if joint is not None and known:
        combined = combined_outlines(joint)
        measure["combined"] = lambda placement: combined.get(placement, (None, None))
        measure["fused"] = lambda placement: fused_outline_of(joint, placement)
        measure["likelihood"] = lambda p: likely_outline_of(prepared, p, joint.without.get(p, joint.solution))
    edges, rows = prepared.board.edges, []
    for variant, placement in product(measure, prepared.session.board_placements):
        measured, weak = None, None
        with suppress(DegenerateGeometry):
            if placement in prepared.names:
                measured, weak = measure[variant](placement)
        lengths, sigma = ({}, {}) if measured is None else (measured.lengths, measured.sigma)
        views = [views[placement] for views in prepared.views.values() if placement in views]
        for name in (name for name in known if any(view.edge(name) is not None for view in views)):
            length, i = lengths.get(name, np.nan), edges.index(name)
            worse = bool({edges[i - 1], edges[(i + 1) % len(edges)]} & set(weak or ()))
            ends = ENDS.get(variant, ("scan", "pitch"))[worse] if np.isfinite(length) else "not measured"
            row = prepared.session.name, placement, name, ends, variant
            rows.append((*row, 1000 * known[name], 1000 * length, 1000 * sigma.get(name, np.nan)))
    rows += [("paper", np.nan, name, "scan", "last_beam", *lengths, np.nan) for name, lengths in PAPER_EDGES_MM.items()]
    columns = ["source", "placement", "edge", "ends", "variant", "true_mm", "measured_mm", "sigma_mm"]
    table = pd.DataFrame(rows, columns=columns).astype({"placement": "Int64"})
    return table.assign(error_mm=table.measured_mm - table.true_mm)


def edge_summary(table):
    """Errors of an :func:`edge_lengths` table, of measured edges only.

    Columns source, ends, variant, n, mean_abs_error_mm, median_abs_error_mm, mean_error_mm, within_90_percent (share of
    the errors inside their 90 % intervals; NaN where nothing is said about them).
    """
    table = table[table.measured_mm.notna()]
    within = (table.error_mm.abs() < ndtri(0.95) * table.sigma_mm).where(table.sigma_mm.notna())
    groups = table.assign(size=table.error_mm.abs(), within=100 * within.astype(float))
    return groups.groupby(["source", "ends", "variant"], sort=False).agg(
        n=("size", "size"), mean_abs_error_mm=("size", "mean"), median_abs_error_mm=("size", "median"),
        mean_error_mm=("error_mm", "mean"), within_90_percent=("within", "mean"),
    ).reset_index()  # fmt: skip


def range_residuals(solution):
    """Ranges on the boards' faces as measured, and predicted minus measured; metres, shapes (n,)."""
    return solution.observations.face_range, solution.residuals("face")[:, 0]


def view_residuals(solution, camera, model):
    """Where the boards' middles were seen in the images of a camera, and predicted minus seen; pixels, shapes (n, 2).

    A ValueError if there is no such camera.
    """
    if camera not in solution.transforms:
        raise ValueError(f"cameras are {', '.join(solution.transforms) or 'none'}; got '{camera}'")
    mine = solution.observations.view_camera == list(solution.transforms).index(camera)
    pose, change = solution.observations.view_pose[mine], solution.residuals("view")[mine]
    turned, at = pose[:, :3, :3] @ outline(solution).mean(axis=0), pose[:, :3, 3]
    seen = project(turned + at, model)
    moved = (geometry.exp_rotation(change[:, :3]) @ turned[..., None])[..., 0]
    return seen, project(moved + at + change[:, 3:], model) - seen


def joint_table(joint):
    """Every shared unknown of the joint estimate (JointCalibration).

    Columns parameter, unit, value, sigma_noise (propagated), sigma_placements (scatter over the placements, model
    errors included; NaN where unknown), sigma (of both, see `Solution.trusted`).
    """
    solution = joint.solution.solution
    units, factors = zip(*map(unit_of, solution.names), strict=True)
    return pd.DataFrame({
        "parameter": solution.names, "unit": units, "value": factors * solution.parameters,
        "sigma_noise": factors * solution.sigma, "sigma_placements": factors * solution.sigma_placements,
        "sigma": factors * solution.trusted_sigma,
    })  # fmt: skip


def noise_table(joint):
    """Noise levels that the estimate took from the data, in words."""
    found = joint.solution.noise.items()
    rows = [(NOISE_WORDS[name], np.rad2deg(value) if name == "sigma_pitch" else value) for name, value in found]
    return pd.DataFrame(rows, columns=["what", "value"])


def edge_bias_mm(joint):
    """By how much boards look larger at each side: mean over the beams of every edge, millimetres.

    Columns placement, edge, distance_m, bias_mm (positive outwards), bias_radii.
    """
    solution, obs = joint.solution, joint.observations
    sensor, distance = solution.sensor["edge_log_odds"], np.linalg.norm(solution.state.boards[:, :, 3], axis=1)
    odds = obs.beam_background + solution.state.sides[obs.beam_placement, obs.beam_edge]
    beams = pd.DataFrame({
        "placement": obs.placements[obs.beam_placement], "edge": np.array(obs.edges)[obs.beam_edge],
        "distance_m": distance[obs.beam_placement], "bias_mm": 1000 * edge_shift(sensor, obs.beam_radius, odds)[0],
        "bias_radii": disc_edge(sensor + odds)[0],
    }).iloc[np.lexsort((obs.beam_edge, obs.beam_placement))]  # fmt: skip
    return beams.groupby(["placement", "edge", "distance_m"], sort=False).mean().reset_index()


def joint_fit(joint, cameras=None):
    """How well ranges and edges fit the joint estimate: ``plane_rms_mm`` and ``edge_rms_px``.

    Of face points from their boards, and of all half-step crossings of scan lines from the image edges, the estimated
    edge bias taken off, over all cameras or those named.
    """
    solution = joint.solution
    plane = on_board(solution.state, solution.data)[..., 2][solution.data.face["used"]]
    edges = [edge_misses_px(joint, camera) for camera in cameras or joint.observations.cameras]
    return {"plane_rms_mm": 1000 * rms(plane), "edge_rms_px": rms(np.concatenate(edges))}


def edge_misses_px(joint, camera):
    """Distances of crossings of scan lines from one camera's edges without the edge bias, undistorted pixels, (n,)."""
    solution, edges, placements = joint.solution, list(joint.observations.edges), list(joint.solution.boards)
    obs, pose = joint.seen_by(camera, crossings=ALL, faces=0).along().select(placements), solution.transforms[camera]
    if len(obs.crossing_points) == 0:
        return np.zeros(0)
    rows = [placements.index(p) for p in obs.crossing_placement], [edges.index(e) for e in obs.crossing_edge]
    odds = obs.crossing_background + solution.state.sides[rows]
    shift = edge_shift(solution.sensor["edge_log_odds"], obs.crossing_radius, odds)[0]
    return edge_residuals_px(obs, pose) - shift * obs.model.fx / pose.apply(obs.crossing_points)[:, 2]


def random_halves(joint, pairs=8):
    """How far estimates from two random halves of the placements differ, beside what their sigmas predict.

    Columns pair, camera, rotation_deg, translation_mm (differences), predicted_rotation_deg, predicted_translation_mm
    (root mean square difference that the sigma of the whole estimate, model error included, predicts: twice that sigma,
    without the part of the intrinsics, which the halves share). Splits of which a half leaves something open are
    missing.
    """
    rng, numbers, rows = np.random.default_rng(0), np.array(list(joint.solution.boards)), []
    for pair in range(pairs if len(numbers) > 4 else 0):  # two placements determine no rig
        parts = np.array_split(rng.permutation(numbers), 2)
        halves = []
        with suppress(DegenerateGeometry):
            halves = [solve_again(joint.observations.select(np.sort(part)), joint.solution) for part in parts]
        for camera in joint.observations.cameras if halves else ():
            turn, shift = geometry.transform_difference(*(half.transforms[camera] for half in halves))
            lens = np.diag(joint.solution.lens)[joint.solution.columns(f"{camera}_")]
            sigma = 2 * np.sqrt(np.maximum(joint.solution.camera(camera).trusted_sigma ** 2 - lens, 0.0))
            expected = np.rad2deg(np.linalg.norm(sigma[:3])), 1000 * np.linalg.norm(sigma[3:])
            rows.append((pair, camera, np.rad2deg(turn), 1000 * shift, *expected))
    columns = ["pair", "camera", "rotation_deg", "translation_mm", "predicted_rotation_deg", "predicted_translation_mm"]
    return pd.DataFrame(rows, columns=columns)


def joint_errors(joint, truth):
    """Errors of axis and cameras against the :class:`~lrfcal_lib.evaluate.tables.Truth`, beside their predicted sigmas.

    Columns what, rotation_error_deg, rotation_sigma_deg, translation_error_mm, translation_sigma_mm; no axis where it
    was not estimated.
    """
    solution, rows, found = joint.solution, [], {}
    if joint.settings["axis"]:
        found["tilt axis"] = *axis_errors(solution.T_head_lrf, truth), solution.covariance("axis_", "offset_")
    for camera in solution.transforms:
        errors = camera_errors(solution.camera(camera), truth, camera).values()
        found[f"camera {camera}"] = *errors, solution.covariance(f"{camera}_")
    for what, (turn, shift, covariance) in found.items():
        turn_sigma, shift_sigma = np.sqrt(np.diag(covariance).reshape(2, -1).sum(axis=1))
        rows.append((what, turn, np.rad2deg(turn_sigma), shift, 1000 * shift_sigma))
    columns = ["rotation_error_deg", "rotation_sigma_deg", "translation_error_mm", "translation_sigma_mm"]
    return pd.DataFrame(rows, columns=["what", *columns])
