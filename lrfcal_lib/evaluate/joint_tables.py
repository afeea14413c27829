"""Tables that judge the joint estimate."""

from collections.abc import Iterable

import numpy as np
import pandas as pd

from lrfcal_lib.calibrate.cameras import KnownAxis
from lrfcal_lib.calibrate.pipeline import JointCalibration
from lrfcal_lib.evaluate.tables import parameter_table
from lrfcal_lib.evaluate.truth import Truth, axis_errors, camera_errors
from lrfcal_lib.fit.covariance import sigma_turn_shift
from lrfcal_lib.fit.edge_likelihood import disc_edge, edge_shift
from lrfcal_lib.fit.residuals import edge_residuals_px
from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.fit.robust import rms
from lrfcal_lib.judge.next_placement import board_middle
from lrfcal_lib.model.camera import CameraModel, project
from lrfcal_lib.model.geometry import (
    POSE_UNITS,
    DegenerateGeometry,
    length_of,
    move_pose,
    transform_difference,
)
from lrfcal_lib.session.files import short
from lrfcal_lib.solvers.joint import solve_again
from lrfcal_lib.solvers.joint_solution import JointSolution

ALL = 10**9  # crossings
DEG_MM = POSE_UNITS[[0, 3]]  # of a turn and a shift
NOISE_WORDS = {
    "face_scale": "scatter of ranges, in stated standard deviations",
    "view_scale": "scatter of board poses in images, in stated standard deviations",
    "face_share": "independent errors per range",
    "beam_share": "independent errors per beam at an edge",
    "sigma_pitch": "error of the pitch at a stop [deg]",
    "side_sigma": "spread of the edge bias from side to side [log odds]",
    "background_sigma": "spread of the edge bias from placement to placement [log odds]",
}


def range_residuals(solution: JointSolution) -> tuple[np.ndarray, np.ndarray]:
    """Ranges on the boards' faces.

    Parameters
    ----------
    solution : JointSolution

    Returns
    -------
    measured, residuals : ndarray, shape (n,)
        Metres; predicted minus measured.
    """
    return solution.observations.face_range, solution.residuals("face")[:, 0]


def view_residuals(
    solution: JointSolution, camera: str, model: CameraModel
) -> tuple[np.ndarray, np.ndarray]:
    """The boards' middles in a camera's images.

    Parameters
    ----------
    solution : JointSolution
    camera : str
    model : CameraModel
        Of it.

    Returns
    -------
    measured, residuals : ndarray, shape (n, 2)
        Pixels; predicted minus measured.

    Raises
    ------
    ValueError
        If there is no such camera.
    """
    if camera not in solution.transforms:
        raise ValueError(f"cameras are {short(solution.transforms)}; got '{camera}'")
    obs = solution.observations
    mine = obs.view_camera == obs.cameras.index(camera)
    pose = obs.view_pose[mine, :3]
    predicted = move_pose(pose, solution.residuals("view")[mine])
    middle = board_middle(solution)
    seen = project(pose @ middle, model)
    return seen, project(predicted @ middle, model) - seen


def joint_table(joint: JointCalibration) -> pd.DataFrame:
    """Every shared unknown of the joint estimate.

    Parameters
    ----------
    joint : JointCalibration

    Returns
    -------
    DataFrame
        Columns parameter, unit, value, sigma_noise (propagated), sigma_placements (scatter over the
        placements, model errors included; NaN where unknown), sigma (of both, see
        `Solution.trusted`).
    """
    s = joint.solution.solution
    return parameter_table(
        [],
        {(): (s.names, s.parameters, s.sigma, s.sigma_placements, s.trusted_sigma)},
        ("value", "sigma_noise", "sigma_placements", "sigma"),
    )


def noise_table(joint: JointCalibration) -> pd.DataFrame:
    """Noise levels that the estimate took from the data.

    Parameters
    ----------
    joint : JointCalibration

    Returns
    -------
    DataFrame
        Columns what, value.
    """
    noise = joint.solution.noise
    noise["sigma_pitch"] = np.rad2deg(noise["sigma_pitch"])
    values = pd.Series(noise).rename(NOISE_WORDS).rename_axis("what")
    return values.reset_index(name="value")


def edge_bias_mm(joint: JointCalibration) -> pd.DataFrame:
    """By how much boards look larger at each side: mean over the beams of every edge, millimetres.

    Parameters
    ----------
    joint : JointCalibration

    Returns
    -------
    DataFrame
        Columns placement, edge, distance_m, bias_mm (positive outwards), bias_radii.
    """
    solution = joint.solution
    obs = joint.observations
    distance = length_of(solution.board_poses[:, :, 3])
    odds = obs.beam_background + solution.side_odds[obs.beam_placement, obs.beam_edge]
    radii = disc_edge(solution.sensor["edge_log_odds"] + odds)[0]
    columns = {
        "placement": obs.placements[obs.beam_placement],
        "edge": obs.beam_edge,
        "distance_m": distance[obs.beam_placement],
        "bias_mm": 1000 * obs.beam_radius * radii,
        "bias_radii": radii,
    }
    sides = pd.DataFrame(columns).groupby([*columns][:3], as_index=False).mean()
    return sides.assign(edge=np.array(obs.edges)[sides.edge])


def joint_fit(joint: JointCalibration, cameras: Iterable[str] = ()) -> dict[str, float]:
    """How well ranges and edges fit the joint estimate.

    Parameters
    ----------
    joint : JointCalibration
    cameras : iterable of str
        Whose edges; all by default.

    Returns
    -------
    dict of str to float
        ``plane_rms_mm`` of face points from their boards, ``edge_rms_px`` of all half-step
        crossings of scan lines from the image edges, the estimated edge bias taken off.
    """
    cameras = cameras or joint.observations.cameras
    edges = np.concatenate([edge_misses_px(joint, camera) for camera in cameras])
    return {
        "plane_rms_mm": 1000 * rms(joint.solution.face_heights()),
        "edge_rms_px": rms(edges),
    }


def edge_misses_px(joint: JointCalibration, camera: str) -> np.ndarray:
    """Distances (n,) of crossings of scan lines from one camera's edges without the edge bias.

    Undistorted pixels.
    """
    solution = joint.solution
    placements = list(solution.boards)
    obs = joint.seen_by(camera, crossings=ALL, faces=0).along().select(placements)
    pose = solution.transforms[camera]
    row = pd.Index(placements).get_indexer(obs.crossing_placement)
    side = pd.Index(joint.observations.edges).get_indexer(obs.crossing_edge)
    odds = obs.crossing_background + solution.side_odds[row, side]
    shift = edge_shift(solution.sensor["edge_log_odds"], obs.crossing_radius, odds)[0]
    depth = pose.apply(obs.crossing_points)[:, 2]
    return edge_residuals_px(obs, pose) - shift * obs.model.fx / depth


def random_halves(joint: JointCalibration, pairs: int = 8) -> pd.DataFrame:
    """How far estimates from two random halves of the placements differ, beside their sigmas.

    Parameters
    ----------
    joint : JointCalibration
    pairs : int
        How often they are split.

    Returns
    -------
    DataFrame
        Columns pair, camera, rotation_deg, translation_mm (differences), predicted_rotation_deg,
        predicted_translation_mm (root mean square difference that the sigma of the whole estimate,
        model error included, predicts: twice that sigma, without the part of the intrinsics, which
        the halves share). Splits of which a half leaves something open are missing.
    """
    rng = np.random.default_rng(0)
    solution = joint.solution
    common = np.diag(solution.lens) + solution.step**2  # of what halves share
    variances = np.maximum(solution.solution.trusted_sigma**2 - common, 0.0)
    numbers = list(solution.boards)
    rows = []
    if len(numbers) <= 4:  # two placements determine no rig
        pairs = 0
    for pair in range(pairs):
        parts = np.array_split(rng.permutation(numbers), 2)
        try:
            first, second = (
                solve_again(joint.observations.select(np.sort(part)), solution)
                for part in parts
            )
        except DegenerateGeometry:
            continue
        for camera in joint.observations.cameras:
            apart = transform_difference(
                first.transforms[camera], second.transforms[camera]
            )
            sigma = sigma_turn_shift(np.diag(variances[solution.columns(camera)]))
            rows.append((pair, camera, *DEG_MM * apart, *(2 * DEG_MM * sigma)))
    return pd.DataFrame(
        rows,
        columns=[
            "pair",
            "camera",
            "rotation_deg",
            "translation_mm",
            "predicted_rotation_deg",
            "predicted_translation_mm",
        ],
    )


def joint_errors(joint: JointCalibration, truth: Truth) -> pd.DataFrame:
    """Errors of axis and cameras against the truth, beside their predicted sigmas.

    Parameters
    ----------
    joint : JointCalibration
    truth : Truth

    Returns
    -------
    DataFrame
        Columns what, rotation_error_deg, rotation_sigma_deg, rotation_pull (error over sigma), and
        the same of the translation in millimetres; no axis where it was not estimated.
    """
    solution = joint.solution
    rows = []
    if joint.settings["axis"]:
        axis = KnownAxis(solution.T_head_lrf, solution.covariance(*AXIS_NAMES))
        rows.append({"what": "tilt axis"} | axis_errors(axis, truth))
    for camera in solution.transforms:
        rows.append(
            {"what": f"camera {camera}"}
            | camera_errors(solution.camera(camera), truth, camera)
        )
    return pd.DataFrame(rows)
