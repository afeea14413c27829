"""Tables of what was recorded and calibrated, and the comparison of methods."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from lrfcal_lib.calibrate.cameras import PlatformCalibration
from lrfcal_lib.calibrate.observe import sides_of
from lrfcal_lib.calibrate.pipeline import JointCalibration
from lrfcal_lib.evaluate.truth import Truth, axis_errors, camera_errors
from lrfcal_lib.fit.covariance import sigma_of
from lrfcal_lib.fit.result import AXIS_NAMES, Solution
from lrfcal_lib.fit.robust import rms
from lrfcal_lib.model.camera import INTRINSIC_NAMES, CameraModel
from lrfcal_lib.model.geometry import paper_parameters
from lrfcal_lib.model.observations import CameraObservations
from lrfcal_lib.preprocess.outline_in_images import Outline
from lrfcal_lib.preprocess.prepared import Prepared
from lrfcal_lib.session.read import Session
from lrfcal_lib.solvers import METHODS, left_out, left_out_residuals
from lrfcal_lib.solvers.pitch import PitchErrors

UNITS = {  # of parameters, and the factor from radians and metres
    r"axis_.*|phi_[xyz]|(.*_)?r[xyz]|pitch_by_direction": ("deg", np.rad2deg(1.0)),
    r"offset_.*|t_y|(.*_)?t[xyz]|range_offset": ("mm", 1000.0),
    r"pitch_scale": ("%", 100.0),
    r"[fc][xy]": ("px", 1.0),
    r".*": ("1", 1.0),
}
AXIS_ERRORS = {  # of an axis, and what they are called of a camera
    "axis_direction_error_deg": "rotation_error_deg",
    "axis_offset_error_mm": "translation_error_mm",
    "axis_direction_pull": "rotation_pull",
    "axis_offset_pull": "translation_pull",
}


def unit_of(parameter: str) -> tuple[str, float]:
    """Unit in which a parameter is shown.

    Parameters
    ----------
    parameter : str

    Returns
    -------
    unit : str
    factor : float
        From radians and metres.
    """
    return next(unit for names, unit in UNITS.items() if re.fullmatch(names, parameter))


def jointly_left_out(
    joint: JointCalibration, camera: str
) -> Iterator[tuple[CameraObservations, Solution]]:
    """What every placement shows, made with the platform and range of the joint estimate without
    it, and that estimate's camera.
    """
    ready = joint.prepared
    for placement, solution in joint.without.items():
        alone = replace(ready, scans={placement: ready.scans[placement]})
        shown = replace(joint, prepared=alone).seen_by(camera, solution)
        yield shown.along().select([placement]), solution.camera(camera)


def method_comparison(
    observations: dict[tuple[str, str], CameraObservations],
    solutions: dict[tuple[str, str], Solution],
    truth: Truth | None = None,
    joint: JointCalibration | None = None,
) -> pd.DataFrame:
    """Every method judged on the same crossings and face points, and on placements it has not seen.

    Parameters
    ----------
    observations : dict of (str, str) to CameraObservations
        By camera and edge-point variant. All methods are judged on the same points: the `half_step`
        crossings of scan lines (not where the sweep enters or leaves the board, which hangs on the
        pitch) and the face points.
    solutions : dict of (str, str) to Solution
        By camera and method.
    truth : Truth, optional
        Of a simulated session.
    joint : JointCalibration, optional
        With its estimates without each placement (:func:`lrfcal_lib.calibrate.pipeline.leave_out`):
        the left-out columns of the method 'joint'. It is judged on the same beams, with its own
        platform and range offset.

    Returns
    -------
    DataFrame
        camera, method, n_placements, edge_median_px, edge_rms_px, plane_rms_mm,
        left_out_edge_rms_px, left_out_plane_rms_mm; with truth also
        rotation_error_deg, translation_error_mm, rotation_pull, translation_pull.
    """
    rows = []
    for (camera, name), solution in solutions.items():
        if name == "joint":
            judge = observations[camera, "joint"].along()
            held = () if joint is None else jointly_left_out(joint, camera)
        else:
            judge = observations[camera, "half_step"].along()
            obs = observations[camera, METHODS[name].variant]
            held = left_out(obs, judge, name, solution)
        edge, plane = left_out_residuals([(judge, solution)])
        held_edge, held_plane = left_out_residuals(held)
        row = {
            "camera": camera,
            "method": name,
            "n_placements": solution.n_placements,
            "edge_median_px": pd.Series(edge).abs().median(),
            "edge_rms_px": rms(edge),
            "plane_rms_mm": 1000 * rms(plane),
            "left_out_edge_rms_px": rms(held_edge),
            "left_out_plane_rms_mm": 1000 * rms(held_plane),
        }
        if truth is not None:
            errors = camera_errors(solution, truth, camera)
            row |= {name: errors[name] for name in AXIS_ERRORS.values()}
        rows.append(row)
    return pd.DataFrame(rows)


def parameter_table(
    keys: Sequence[str],
    parameters: Mapping[tuple, tuple],
    columns: Sequence[str] = ("value", "sigma"),
) -> pd.DataFrame:
    """Parameters in their units, a row each.

    Parameters
    ----------
    keys : sequence of str
        Columns that tell whose parameters they are.
    parameters : dict of tuple to tuple
        By what these columns hold: names, and an array for every one of `columns`.
    columns : sequence of str

    Returns
    -------
    DataFrame
        Columns as `keys`, parameter, unit, and `columns`.
    """
    rows = []
    for key, arrays in parameters.items():
        for name, *values in zip(*arrays, strict=True):
            unit, factor = unit_of(name)
            rows.append((*key, name, unit, *np.multiply(factor, values)))
    return pd.DataFrame(rows, columns=[*keys, "parameter", "unit", *columns])


def camera_calibration_table(solutions: dict[tuple[str, str], Solution]) -> pd.DataFrame:
    """Parameters of every calibration with their sigmas.

    Parameters
    ----------
    solutions : dict of (str, str) to Solution
        By camera and method.

    Returns
    -------
    DataFrame
        Columns camera, method, parameter, unit, value, sigma (`Solution.trusted`).
    """
    return parameter_table(
        ["camera", "method"],
        {key: (s.names, s.parameters, s.trusted_sigma) for key, s in solutions.items()},
    )


def platform_calibration_table(
    platform: PlatformCalibration, truth: Truth | None = None
) -> pd.DataFrame:
    """The tilt axis by every method with sigmas, and in the paper's chart.

    Parameters
    ----------
    platform : PlatformCalibration
    truth : Truth, optional

    Returns
    -------
    DataFrame
        Columns method, parameter, unit, value, sigma; with truth also axis_direction_error_deg and
        axis_offset_error_mm of the method, and both over their standard deviations
        (axis_direction_pull, axis_offset_pull). The four numbers of the axis are its angles out of
        and within the scan plane and its offsets within and across it; phi and t_y are the same
        axis in the paper's chart.
    """
    names = (*AXIS_NAMES, "phi_x", "phi_y", "phi_z", "t_y")
    parameters = {}
    for method, axis in platform.axes.items():
        phi, ty = paper_parameters(axis.T_head_lrf)
        sigma = np.append(axis.sigma, np.full(4, np.nan))
        parameters[method,] = names, [*axis.parameters, *phi, ty], sigma
    table = parameter_table(["method"], parameters)
    if truth is not None:
        errors = [axis_errors(platform.axes[method], truth) for method in table.method]
        table[[*AXIS_ERRORS]] = pd.DataFrame(errors)[[*AXIS_ERRORS.values()]]
    return table


def sweeps_table(session: Session) -> pd.DataFrame:
    """What a session recorded at every placement.

    Parameters
    ----------
    session : Session

    Returns
    -------
    DataFrame
        Columns placement, n_scan_lines, n_returns, invalid_percent, pitch_from_deg, pitch_to_deg,
        pitch_step_deg (median, where it moves), direction (+1 up, -1 down, 0 neither), n_images.
    """
    rows = []
    for placement in session.placements:
        sweep = session.sweep(placement)
        pitch = np.rad2deg(sweep.pitch)
        valid = np.isfinite(sweep.ranges)
        rows.append(
            {
                "placement": placement,
                "n_scan_lines": len(pitch),
                "n_returns": valid.sum(),
                "invalid_percent": 100 * (1 - valid.mean()),
                "pitch_from_deg": pitch[0],
                "pitch_to_deg": pitch[-1],
                "pitch_step_deg": np.rad2deg(sweep.pitch_step),
                "direction": sweep.direction,
                "n_images": len(session.images(placement=placement)),
            }
        )
    return pd.DataFrame(rows)


def scans_table(prepared: Prepared) -> pd.DataFrame:
    """The board in every sweep: noise, rejected points, and the sides that scans cross.

    Parameters
    ----------
    prepared : Prepared

    Returns
    -------
    DataFrame
        Columns placement, n_points, sigma_range_mm, jump_points, sides_along (crossed by scan
        lines), sides_across (where the sweep enters or leaves the board).
    """
    rows = []
    for placement, board in prepared.scans.items():
        across = [side.across for side in sides_of(board) if side.straight]
        rows.append(
            (
                placement,
                board.mask.sum(),
                1000 * board.sigma_range,
                board.n_jump_points,
                across.count(False),
                across.count(True),
            )
        )
    return pd.DataFrame(
        rows,
        columns=[
            "placement",
            "n_points",
            "sigma_range_mm",
            "jump_points",
            "sides_along",
            "sides_across",
        ],
    )


def intrinsics_table(models: dict[str, CameraModel]) -> pd.DataFrame:
    """Intrinsics of every camera with their standard deviations.

    Parameters
    ----------
    models : dict of str to CameraModel

    Returns
    -------
    DataFrame
        Columns camera, parameter, unit, value, sigma (NaN where the session states the
        intrinsics).
    """
    parameters = {}
    for camera, model in models.items():
        sigma = np.full(9, np.nan)
        if model.covariance is not None:
            sigma = sigma_of(model.covariance)
        parameters[camera,] = INTRINSIC_NAMES, model.parameters, sigma
    return parameter_table(["camera"], parameters)


def outline_table(outline: Outline) -> pd.DataFrame:
    """Edge lengths of a board in the images.

    Parameters
    ----------
    outline : Outline

    Returns
    -------
    DataFrame
        Columns edge, length_mm, sd_mm (over the images that show the edge with both neighbours),
        n_images.
    """
    table = pd.DataFrame(
        {
            "length_mm": outline.board.lengths(),
            "sd_mm": outline.length_sd,
            "n_images": outline.n_lengths,
        }
    )
    table[["length_mm", "sd_mm"]] *= 1000
    return table.rename_axis("edge").reset_index()


def pitch_models_table(errors: PitchErrors) -> pd.DataFrame:
    """Which errors of the recorded pitch the data ask for.

    Parameters
    ----------
    errors : PitchErrors

    Returns
    -------
    DataFrame
        Columns model, n_parameters, plane_rms_mm, F, p_value (against the model before).
    """
    return pd.DataFrame(
        [
            (model.name, model.n_parameters, 1000 * model.plane_rms, model.F, model.p_value)
            for model in errors.models.values()
        ],
        columns=["model", "n_parameters", "plane_rms_mm", "F", "p_value"],
    )


def pitch_errors_table(errors: PitchErrors) -> pd.DataFrame:
    """Offset of the recorded pitch of every sweep.

    Parameters
    ----------
    errors : PitchErrors

    Returns
    -------
    DataFrame
        Columns placement, direction, offset_deg, sigma_deg.
    """
    each = errors.models["sweep"]
    return pd.DataFrame(
        {
            "placement": errors.placements,
            "direction": errors.direction,
            "offset_deg": np.rad2deg(each.offset),
            "sigma_deg": np.rad2deg(each.offset_sigma),
        }
    )


def axis_knowledge_table(platform: PlatformCalibration) -> pd.DataFrame:
    """Who knows each number of the tilt axis better: data ('line_3d') or the rough measurement.

    Parameters
    ----------
    platform : PlatformCalibration

    Returns
    -------
    DataFrame
        Columns parameter, unit, sigma_data, sigma_rough, better.
    """
    data = platform.axes["line_3d"].sigma
    rough = np.repeat(platform.stated_sigma, 2)
    table = parameter_table(
        [], {(): (AXIS_NAMES, data, rough)}, ("sigma_data", "sigma_rough")
    )
    return table.assign(better=np.where(data < rough, "data", "rough measurement"))
