"""Tables about the joint estimate: unknowns, noise levels, what it leaves over, random halves, errors by truth."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pandas as pd

from lrfcal_lib.calibrate.outline import likely_outline_of
from lrfcal_lib.evaluate.next_placement import outline
from lrfcal_lib.evaluate.tables import ends_of, rms, unit_of
from lrfcal_lib.fit.residuals import disc_edge, edge_residuals_px, edge_shift, named_blocks
from lrfcal_lib.model.camera import project
from lrfcal_lib.model.geometry import DegenerateGeometry, axis_difference, axis_of, exp_rotation, transform_difference
from lrfcal_lib.solvers.joint import solve_again
from lrfcal_lib.solvers.joint_noise import on_board


def range_residuals(solution):
    """Predicted minus measured ranges on the boards' faces.

    Parameters
    ----------
    solution : JointSolution

    Returns
    -------
    distance, residual : ndarray, shape (n,)
        Metres.
    placement : ndarray of int, shape (n,)
    """
    used = solution.data.face["used"]
    blocks = named_blocks(solution.state, solution.data, solution.unknowns)
    residual = blocks["face"].residuals if "face" in blocks else np.zeros(used.shape)
    return solution.data.face["range"][used], residual[used], _placements(solution, used)


def view_residuals(solution, camera, model):
    """Where the calibration puts the boards' middles in the images of a camera, and where they were seen.

    Parameters
    ----------
    solution : JointSolution
    camera : str
    model : CameraModel

    Returns
    -------
    uv : ndarray, shape (n, 2)
        As seen, pixels.
    shift : ndarray, shape (n, 2)
        Predicted minus seen, pixels.
    placement : ndarray of int, shape (n,)

    Raises
    ------
    ValueError
        If there is no such camera.
    """
    if camera not in solution.transforms:
        raise ValueError(f"cameras are {', '.join(solution.transforms) or 'none'}; got '{camera}'")
    view = solution.data.view
    used = view["used"] & (view["camera"] == list(solution.transforms).index(camera))
    if not used.any():
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, int)
    block = named_blocks(solution.state, solution.data, solution.unknowns)["view"]
    change = block.residuals.reshape(used.shape + (6,))[used]
    pose = view["pose"][used]
    turned = pose[:, :3, :3] @ np.append(outline(solution).mean(axis=0), 0.0)
    seen = project(turned + pose[:, :3, 3], model)
    there = (exp_rotation(change[:, :3]) @ turned[..., None])[..., 0] + pose[:, :3, 3] + change[:, 3:]
    return seen, project(there, model) - seen, _placements(solution, used)


def _placements(solution, used):
    return np.broadcast_to(np.array(list(solution.boards))[:, None], used.shape)[used]


ALL = 10**9  # crossings
NOISE_WORDS = {
    "face_scale": "scatter of ranges, in stated standard deviations",
    "view_scale": "scatter of board poses in images, in stated standard deviations",
    "face_share": "independent errors per range",
    "beam_share": "independent errors per beam at an edge",
    "sigma_pitch": "error of the pitch of single images [deg]",
    "side_sigma": "spread of the edge bias from side to side [log odds]",
}


def joint_table(joint):
    """Every shared unknown of the joint estimate.

    Parameters
    ----------
    joint : JointCalibration

    Returns
    -------
    DataFrame
        parameter, unit, value, sigma_noise (propagated), sigma_placements (scatter over the placements, model errors
        included; NaN where unknown), sigma (the larger one).
    """
    solution = joint.solution.solution
    spread = solution.sigma_placements
    spread = np.full(len(solution.names), np.nan) if spread is None else spread
    rows = []
    columns = solution.parameters, solution.sigma, spread, solution.trusted_sigma
    for name, *values in zip(solution.names, *columns, strict=True):
        unit, factor = _unit(name)
        rows.append((name, unit, *(factor * value for value in values)))
    columns = ["parameter", "unit", "value", "sigma_noise", "sigma_placements", "sigma"]
    return pd.DataFrame(rows, columns=columns)


def _unit(name):
    if name.startswith("axis_") or name == "pitch_by_direction":
        return "deg", np.rad2deg(1.0)
    if name.startswith(("offset_", "size_")) or name == "range_offset":
        return "mm", 1000.0
    if name == "pitch_scale":
        return "%", 100.0
    return unit_of(name.rsplit("_", 1)[-1]) if name[-2:] in ("rx", "ry", "rz", "tx", "ty", "tz") else ("1", 1.0)


def noise_table(joint):
    """Noise levels that the estimate took from the data, in words."""
    found = joint.solution.noise
    words = [NOISE_WORDS[name] for name in found]
    values = [np.rad2deg(value) if name == "sigma_pitch" else value for name, value in found.items()]
    return pd.DataFrame({"what": words, "value": values})


def edge_bias_mm(joint):
    """By how much boards look larger at each side: mean over the beams of every edge, millimetres.

    Parameters
    ----------
    joint : JointCalibration

    Returns
    -------
    DataFrame
        placement, edge, distance_m, bias_mm (positive outwards), bias_radii.
    """
    solution = joint.solution
    beams, rows = solution.data.beam, []
    for i, placement in enumerate(solution.boards):
        for e, edge in enumerate(joint.observations.edges):
            mine = beams["used"][i] & (beams["edge"][i] == e)
            if mine.any():
                odds = beams["background"][i, mine] + solution.state.sides[i, e]
                radius = beams["radius"][i, mine]
                shift = edge_shift(solution.sensor["edge_log_odds"], radius, odds)[0]
                x = disc_edge(solution.sensor["edge_log_odds"] + odds)[0]
                distance = np.linalg.norm(solution.state.boards[i, :, 3])
                rows.append((placement, edge, distance, 1000 * shift.mean(), x.mean()))
    return pd.DataFrame(rows, columns=["placement", "edge", "distance_m", "bias_mm", "bias_radii"])


def joint_fit(joint):
    """How well ranges and edges fit the joint estimate.

    Parameters
    ----------
    joint : JointCalibration

    Returns
    -------
    dict of str to float
        ``plane_rms_mm`` (face points from their boards), ``edge_rms_px`` (all half-step crossings of scan lines
        from the image edges, the estimated edge bias taken off, over all cameras).
    """
    solution = joint.solution
    used = solution.data.face["used"]
    plane = on_board(solution.state, solution.data)[..., 2][used]
    edges = [edge_misses_px(joint, camera) for camera in joint.observations.cameras]
    return {"plane_rms_mm": 1000 * rms(plane), "edge_rms_px": rms(np.concatenate(edges))}


def size_error(joint):
    """How much larger the board is in the cloud than stated, ranges as recorded.

    An offset of all ranges would stretch the cloud until it fits a board whose size is stated wrong, so it is left out;
    the offset that the maker admits is a part of the expected error.

    Parameters
    ----------
    joint : JointCalibration

    Returns
    -------
    error, sigma : float
        Mean relative error of the lengths whose ends beams decide, and its standard deviation: scatter over placements,
        range offset, edge bias. NaN with fewer than three placements, or where nobody knows the outline.
    """
    prepared, model = joint.prepared, replace(joint.edge_model(), range_offset=0.0)
    if prepared.board.corners is None:
        return np.nan, np.nan
    true, edges, found = prepared.board.lengths(), prepared.board.edges, []
    for placement in joint.solution.boards:
        with suppress(DegenerateGeometry):
            measured, across = likely_outline_of(prepared, placement, model)
            own = [v / true[k] - 1 for k, v in measured.lengths.items() if ends_of(edges, k, across) == "scan"]
            found += [np.mean(own)] if own else []
    if len(found) < 3:
        return np.nan, np.nan
    beams, faces = joint.solution.data.beam, joint.solution.data.face
    slope = edge_shift(model.log_odds, np.median(beams["radius"][beams["used"]]))[1]
    bias = 2 * slope * model.log_odds_sigma / np.mean(list(true.values()))
    offset = prepared.session.lrf.admitted_offset / np.median(faces["range"][faces["used"]])
    return float(np.mean(found)), float(np.linalg.norm([np.std(found, ddof=1) / np.sqrt(len(found)), offset, bias]))


def edge_misses_px(joint, camera):
    """Distances of crossings of scan lines from one camera's edges without the edge bias, undistorted pixels, (n,)."""
    solution, obs = joint.solution, joint.seen_by(camera, crossings=ALL).along()
    miss = edge_residuals_px(obs, solution.transforms[camera])
    depth = solution.transforms[camera].apply(obs.crossing_points)[:, 2] if len(miss) else np.zeros(0)
    row = {p: i for i, p in enumerate(solution.boards)}
    column = {edge: i for i, edge in enumerate(joint.observations.edges)}
    known = np.array([p in row for p in obs.crossing_placement], bool)
    at = [row.get(p, 0) for p in obs.crossing_placement], [column[e] for e in obs.crossing_edge]
    own = solution.state.sides[at] if len(miss) else np.zeros(0)
    odds = obs.crossing_background + own
    shift = edge_shift(solution.sensor["edge_log_odds"], obs.crossing_radius, odds)[0]
    return (miss - shift * obs.model.fx / depth)[known] if len(miss) else miss


def random_halves(joint, pairs=8, seed=0):
    """How far estimates from two random halves of the placements differ, beside what their sigmas predict.

    Parameters
    ----------
    joint : JointCalibration
    pairs : int
    seed : int

    Returns
    -------
    DataFrame
        pair, camera, rotation_deg, translation_mm (differences), predicted_rotation_deg, predicted_translation_mm (root
        mean square difference that the sigma of the whole estimate, model error included, predicts: twice that sigma,
        without the part of the intrinsics, which the halves share).
        Splits of which a half leaves something open are missing.
    """
    rng, numbers = np.random.default_rng(seed), np.array(list(joint.solution.boards))
    rows = []
    for pair in range(pairs):
        order = rng.permutation(numbers)
        try:
            halves = [
                solve_again(joint.observations.select(np.sort(part)), joint.solution)
                for part in np.array_split(order, 2)
            ]
        except DegenerateGeometry:
            continue
        for camera in joint.observations.cameras:
            turn, shift = transform_difference(*(half.transforms[camera] for half in halves))
            sigma = 2 * own_sigma(joint.solution, camera)
            expected = np.rad2deg(np.linalg.norm(sigma[:3])), 1000 * np.linalg.norm(sigma[3:])
            rows.append((pair, camera, np.rad2deg(turn), 1000 * shift, *expected))
    columns = ["pair", "camera", "rotation_deg", "translation_mm", "predicted_rotation_deg", "predicted_translation_mm"]
    return pd.DataFrame(rows, columns=columns)


def own_sigma(solution, camera):
    """Standard deviations of a camera's pose without the part of the intrinsics, which all placements share."""
    index = solution.columns(f"{camera}_")
    lens = np.diag(solution.lens)[index]
    return np.sqrt(np.maximum(solution.camera(camera).trusted_sigma ** 2 - lens, 0.0))


def joint_errors(joint, truth):
    """Errors of axis and cameras against the truth, beside the predicted standard deviations.

    Parameters
    ----------
    joint : JointCalibration
    truth : Truth

    Returns
    -------
    DataFrame
        what, rotation_error_deg, rotation_sigma_deg, translation_error_mm, translation_sigma_mm; no axis where it was
        not estimated.
    """
    solution, rows = joint.solution, []
    if joint.settings["axis"]:
        sigma = np.sqrt(np.diag(solution.covariance("axis_", "offset_")))
        turn, shift = axis_difference(solution.axis, axis_of(truth.T_head_lrf))
        rows = [("tilt axis", turn, np.linalg.norm(sigma[:2]), shift, np.linalg.norm(sigma[2:]))]
    for camera, found in solution.transforms.items():
        turn, shift = transform_difference(found, truth.cameras[camera])
        spread = solution.camera(camera).trusted_sigma
        rows.append((f"camera {camera}", turn, np.linalg.norm(spread[:3]), shift, np.linalg.norm(spread[3:])))
    factors = np.array([np.rad2deg(1.0), np.rad2deg(1.0), 1000.0, 1000.0])
    columns = ["rotation_error_deg", "rotation_sigma_deg", "translation_error_mm", "translation_sigma_mm"]
    table = pd.DataFrame([factors * np.array(row[1:]) for row in rows], columns=columns)
    return table.assign(what=[row[0] for row in rows])[["what", *columns]]
