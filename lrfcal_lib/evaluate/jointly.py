"""Tables about the joint estimate: unknowns, noise levels, what it leaves over, random halves, errors by truth."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pandas as pd

from lrfcal_lib.calibrate.outline import likely_outline_of
from lrfcal_lib.evaluate.next_placement import outline
from lrfcal_lib.evaluate.tables import axis_errors, camera_errors, ends_of, rms, unit_of
from lrfcal_lib.fit.residuals import disc_edge, edge_residuals_px, edge_shift, named_blocks
from lrfcal_lib.model.camera import project
from lrfcal_lib.model.geometry import DegenerateGeometry, exp_rotation, transform_difference
from lrfcal_lib.solvers.joint import solve_again
from lrfcal_lib.solvers.joint_noise import on_board

ALL = 10**9  # crossings
NOISE_WORDS = {
    "face_scale": "scatter of ranges, in stated standard deviations",
    "view_scale": "scatter of board poses in images, in stated standard deviations",
    "face_share": "independent errors per range", "beam_share": "independent errors per beam at an edge",
    "sigma_pitch": "error of the pitch of single images [deg]",
    "side_sigma": "spread of the edge bias from side to side [log odds]",
}  # fmt: skip


def range_residuals(solution):
    """Ranges on the boards' faces as measured, and predicted minus measured; metres, shapes (n,)."""
    used = solution.data.face["used"]
    blocks = named_blocks(solution.state, solution.data, solution.unknowns)
    residual = blocks["face"].residuals if "face" in blocks else np.zeros(used.shape)
    return solution.data.face["range"][used], residual[used]


def view_residuals(solution, camera, model):
    """Where the boards' middles were seen in the images of a camera, and predicted minus seen; pixels, shapes (n, 2).

    A ValueError if there is no such camera.
    """
    if camera not in solution.transforms:
        raise ValueError(f"cameras are {', '.join(solution.transforms) or 'none'}; got '{camera}'")
    view = solution.data.view
    used = view["used"] & (view["camera"] == list(solution.transforms).index(camera))
    if not used.any():
        return np.zeros((0, 2)), np.zeros((0, 2))
    block = named_blocks(solution.state, solution.data, solution.unknowns)["view"]
    change = block.residuals.reshape(used.shape + (6,))[used]
    pose = view["pose"][used]
    turned = pose[:, :3, :3] @ np.append(outline(solution).mean(axis=0), 0.0)
    seen = project(turned + pose[:, :3, 3], model)
    there = (exp_rotation(change[:, :3]) @ turned[..., None])[..., 0] + pose[:, :3, 3] + change[:, 3:]
    return seen, project(there, model) - seen


def joint_table(joint):
    """Every shared unknown of the joint estimate (JointCalibration).

    Columns parameter, unit, value, sigma_noise (propagated), sigma_placements (scatter over the placements, model
    errors included; NaN where unknown), sigma (the larger one).
    """
    solution = joint.solution.solution
    units, factors = zip(*map(unit_of, solution.names), strict=True)
    spread = np.full(len(factors), np.nan) if solution.sigma_placements is None else solution.sigma_placements
    return pd.DataFrame({
        "parameter": solution.names, "unit": units, "value": factors * solution.parameters,
        "sigma_noise": factors * solution.sigma, "sigma_placements": factors * spread,
        "sigma": factors * solution.trusted_sigma,
    })  # fmt: skip


def noise_table(joint):
    """Noise levels that the estimate took from the data, in words."""
    found = joint.solution.noise
    words = [NOISE_WORDS[name] for name in found]
    values = [np.rad2deg(value) if name == "sigma_pitch" else value for name, value in found.items()]
    return pd.DataFrame({"what": words, "value": values})


def edge_bias_mm(joint):
    """By how much boards look larger at each side: mean over the beams of every edge, millimetres.

    Columns placement, edge, distance_m, bias_mm (positive outwards), bias_radii.
    """
    solution = joint.solution
    beams, sensor, rows = solution.data.beam, solution.sensor["edge_log_odds"], []
    for (i, e), side in np.ndenumerate(solution.state.sides):
        mine = beams["used"][i] & (beams["edge"][i] == e)
        if mine.any():
            odds = beams["background"][i, mine] + side
            shift, radii = edge_shift(sensor, beams["radius"][i, mine], odds)[0], disc_edge(sensor + odds)[0]
            place = list(solution.boards)[i], joint.observations.edges[e]
            distance = np.linalg.norm(solution.state.boards[i, :, 3])
            rows.append((*place, distance, 1000 * shift.mean(), radii.mean()))
    return pd.DataFrame(rows, columns=["placement", "edge", "distance_m", "bias_mm", "bias_radii"])


def joint_fit(joint):
    """How well ranges and edges fit the joint estimate: ``plane_rms_mm`` and ``edge_rms_px``.

    Of face points from their boards, and of all half-step crossings of scan lines from the image edges, the estimated
    edge bias taken off, over all cameras.
    """
    solution = joint.solution
    plane = on_board(solution.state, solution.data)[..., 2][solution.data.face["used"]]
    edges = [edge_misses_px(joint, camera) for camera in joint.observations.cameras]
    return {"plane_rms_mm": 1000 * rms(plane), "edge_rms_px": rms(np.concatenate(edges))}


def edge_misses_px(joint, camera):
    """Distances of crossings of scan lines from one camera's edges without the edge bias, undistorted pixels, (n,)."""
    solution, edges = joint.solution, list(joint.observations.edges)
    obs = joint.seen_by(camera, crossings=ALL).along().select(solution.boards)
    if len(obs.crossing_points) == 0:
        return np.zeros(0)
    miss = edge_residuals_px(obs, solution.transforms[camera])
    depth = solution.transforms[camera].apply(obs.crossing_points)[:, 2]
    row = {placement: i for i, placement in enumerate(solution.boards)}
    own = solution.state.sides[[row[p] for p in obs.crossing_placement], [edges.index(e) for e in obs.crossing_edge]]
    shift = edge_shift(solution.sensor["edge_log_odds"], obs.crossing_radius, obs.crossing_background + own)[0]
    return miss - shift * obs.model.fx / depth


def size_error(joint):
    """How much larger the board is in the cloud than stated, ranges as recorded, and the standard deviation of that.

    An offset of all ranges would stretch the cloud until it fits a board whose size is stated wrong, so it is left out;
    the offset that the maker admits is a part of the expected error, beside the scatter over placements and the edge
    bias. The error is the mean relative one of the lengths whose ends beams decide; NaN with fewer than three
    placements, or where nobody knows the outline.
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


def random_halves(joint, pairs=8):
    """How far estimates from two random halves of the placements differ, beside what their sigmas predict.

    Columns pair, camera, rotation_deg, translation_mm (differences), predicted_rotation_deg, predicted_translation_mm
    (root mean square difference that the sigma of the whole estimate, model error included, predicts: twice that sigma,
    without the part of the intrinsics, which the halves share). Splits of which a half leaves something open are
    missing.
    """
    rng, numbers, rows = np.random.default_rng(0), np.array(list(joint.solution.boards)), []
    for pair in range(pairs):
        parts = np.array_split(rng.permutation(numbers), 2)
        try:
            halves = [solve_again(joint.observations.select(np.sort(part)), joint.solution) for part in parts]
        except DegenerateGeometry:
            continue
        for camera in joint.observations.cameras:
            turn, shift = transform_difference(*(half.transforms[camera] for half in halves))
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
    solution, found = joint.solution, {}
    if joint.settings["axis"]:
        sigma = np.sqrt(np.diag(solution.covariance("axis_", "offset_")))
        found["tilt axis"] = *axis_errors(solution.T_head_lrf, truth), sigma
    for camera in solution.transforms:
        own = solution.camera(camera)
        found[f"camera {camera}"] = *camera_errors(own, truth, camera).values(), own.trusted_sigma
    rows = []
    for what, (turn, shift, sigma) in found.items():
        turn_sigma, shift_sigma = np.linalg.norm(sigma.reshape(2, -1), axis=1)
        rows.append((what, turn, np.rad2deg(turn_sigma), shift, 1000 * shift_sigma))
    columns = ["rotation_error_deg", "rotation_sigma_deg", "translation_error_mm", "translation_sigma_mm"]
    return pd.DataFrame(rows, columns=["what", *columns])
