"""What is wrong with a recording, as tables and in words: cameras that moved, boards that bend, a pitch that is off."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from lrfcal_lib.calibrate.observe import rough_poses
from lrfcal_lib.calibrate.outline import platform_of
from lrfcal_lib.model.geometry import lrf_to_source
from lrfcal_lib.preprocess.bend import BoardBends, board_bends
from lrfcal_lib.preprocess.steadiness import camera_steadiness

SIGNIFICANT = 3.0  # standard deviations of an offset by sweep direction
SHEET_SHARE = 0.5  # a sheet bent less than this share of what the scan shows does not explain the scan
SAME_TURN = 0.5  # two cameras whose turns differ by less than this share of the larger one moved together


@dataclass(frozen=True)
class Diagnosis:
    """What a recording says about itself before anything is calibrated.

    Attributes
    ----------
    steadiness : dict of str to Steadiness
        By camera.
    bends : BoardBends
    pitch_errors : PitchErrors or None
    problems : dict
        Of the prepared session: what cannot be used and why.
    """

    steadiness: dict
    bends: BoardBends
    pitch_errors: object = None
    problems: dict = field(default_factory=dict)


def diagnose(prepared, pitch_errors=None):
    """Ask a recording whether its cameras stood still and its boards were flat.

    Parameters
    ----------
    prepared : Prepared
    pitch_errors : PitchErrors, optional
        Of :func:`lrfcal_lib.calibrate.pipeline.find_pitch_errors`.

    Returns
    -------
    Diagnosis
    """
    steadiness = {
        camera: camera_steadiness(prepared.session, camera, views, prepared.models[camera])
        for camera, views in prepared.views.items()
    }
    bends = board_bends(prepared, board_maps(prepared))
    return Diagnosis(steadiness, bends, pitch_errors, dict(prepared.problems))


def board_maps(prepared):
    """Where points of each sweep lie on the board, through the first camera that sees it.

    Parameters
    ----------
    prepared : Prepared

    Returns
    -------
    dict of int to callable
        By placement; from LRF points (n, 3) and their pitch (n,) to the board frame (n, 3). Cameras posed from the
        planes alone, so good to about a centimetre.
    """
    rough, _ = rough_poses(prepared)  # its findings are in the problems already
    maps = {}
    for camera, T_camera_source in rough.items():
        for placement, view in prepared.views[camera].items():
            if view.T_camera_board is not None and placement in prepared.scans:
                maps.setdefault(placement, _board_map(prepared, camera, view, T_camera_source))
    return maps


def _board_map(prepared, camera, view, T_camera_source):
    mount, T_head_lrf = prepared.session.cameras[camera].mount, platform_of(prepared)
    T_board_source = view.T_camera_board.inv() * T_camera_source
    image_pitch = 0.0 if mount == "platform" else view.pitch
    return lambda p_lrf, pitch: T_board_source.apply(lrf_to_source(p_lrf, pitch, T_head_lrf, mount, image_pitch))


def steadiness_table(steadiness):
    """Motion of the background in the images of each camera.

    Parameters
    ----------
    steadiness : dict of str to Steadiness

    Returns
    -------
    DataFrame
        camera, placement, turn_x_deg, turn_y_deg, turn_z_deg (of the camera, in its frame, since the reference
        placement), turn_sigma_deg (the largest of the three), turn_px (root mean square over the image), scale_ppm,
        scale_sigma_ppm, scale_px (motion of a corner of the image), n_features, residual_px. No rows for a camera on
        the head.
    """
    parts = [pd.DataFrame(columns=STEADINESS_COLUMNS)]
    for camera, found in steadiness.items():
        sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)).reshape(-1, 4)
        turn = np.rad2deg(found.rotvec)
        values = [camera, found.placements, *turn.T, np.rad2deg(sigma[:, :3].max(axis=1, initial=0.0)), found.size_px]
        values += [1e6 * (found.scale - 1), 1e6 * sigma[:, 3], found.corner_px, found.n_features, found.residual_px]
        parts.append(pd.DataFrame(dict(zip(STEADINESS_COLUMNS, values, strict=True))))
    return pd.concat([part for part in parts if len(part)] or parts[:1], ignore_index=True)


STEADINESS_COLUMNS = [
    "camera", "placement", "turn_x_deg", "turn_y_deg", "turn_z_deg", "turn_sigma_deg", "turn_px", "scale_ppm",
    "scale_sigma_ppm", "scale_px", "n_features", "residual_px",
]  # fmt: skip


def steps_table(steadiness):
    """Where cameras moved for good.

    Parameters
    ----------
    steadiness : dict of str to Steadiness

    Returns
    -------
    DataFrame
        camera, before, after (placements), turn_deg, turn_sigma_deg, turn_px, turn_sigma_px, p_value.
    """
    columns = ["camera", "before", "after", "turn_deg", "turn_sigma_deg", "turn_px", "turn_sigma_px", "p_value"]
    rows = [
        (c, s.before, s.after, np.rad2deg(s.angle), np.rad2deg(s.angle_sigma), s.size_px, s.sigma_px, s.p_value)
        for c, found in steadiness.items()
        for s in found.steps
    ]
    return pd.DataFrame(rows, columns=columns)


def bends_table(bends):
    """Bend of the board at every placement.

    Parameters
    ----------
    bends : BoardBends

    Returns
    -------
    DataFrame
        placement, bend_mm, sigma_mm (in the scan), p_value, bends, sheet_bend_mm, sheet_sigma_mm (in the images; NaN
        where not known), reason.
    """
    columns = ["placement", "bend_mm", "sigma_mm", "p_value", "bends", "sheet_bend_mm", "sheet_sigma_mm", "reason"]
    rows = []
    for b in bends.placements.values():
        size, sigma, sheet, sheet_sigma = (1000 * v for v in (b.size, b.sigma, b.sheet, b.sheet_sigma))
        rows.append((b.placement, size, sigma, b.p_value, b.bends, sheet, sheet_sigma, b.reason))
    return pd.DataFrame(rows, columns=columns)


def findings_in_words(diagnosis):
    """What a recording says about itself, one sentence a finding.

    Parameters
    ----------
    diagnosis : Diagnosis

    Returns
    -------
    list of str
        Empty for a recording without fault.
    """
    found = pitch_words(diagnosis.pitch_errors) + motion_words(diagnosis.steadiness)
    return found + bend_words(diagnosis.bends) + problem_words(diagnosis.problems)


def pitch_words(errors):
    """Sentences about the recorded pitch; none without errors that the data ask for.

    Parameters
    ----------
    errors : PitchErrors or None

    Returns
    -------
    list of str
    """
    if errors is None or errors.wanted == "none":
        return []
    offset, sigma = np.rad2deg(errors.direction_offset), np.rad2deg(errors.direction_sigma)
    out = []
    if np.isfinite(offset) and abs(offset) > SIGNIFICANT * sigma:
        out.append(
            f"the pitch depends on the direction of the sweep: upward and downward sweeps differ by "
            f"{2 * abs(offset):.2f} +- {2 * sigma:.2f} deg"
        )
    each = errors.models[errors.wanted]
    if errors.wanted.startswith("sweep"):
        out.append(f"every sweep has a pitch offset of its own: {np.rad2deg(np.std(each.offset)):.2f} deg (sd)")
    if errors.wanted == "sweep_stretch":
        low, high = 100 * each.stretch.min(), 100 * each.stretch.max()
        out.append(f"every sweep is stretched by an amount of its own: {low:+.1f} to {high:+.1f} % of the pitch")
    return out


def motion_words(steadiness):
    """Sentences about cameras fixed to the base that moved, or whose image scale drifts.

    Parameters
    ----------
    steadiness : dict of str to Steadiness

    Returns
    -------
    list of str
        Cameras that turned alike between the same placements make one sentence about the rig.
    """
    judged = {c: s for c, s in steadiness.items() if not s.reason}
    places = sorted({(step.before, step.after) for s in judged.values() for step in s.steps})
    out = []
    for place in places:
        moved = {c: step for c, s in judged.items() for step in s.steps if (step.before, step.after) == place}
        together = len(moved) > 1 and len(moved) == len(judged) and _alike([s.rotvec for s in moved.values()])
        groups = {"the rig": list(moved.values())} if together else {f"camera {c}": [s] for c, s in moved.items()}
        out += [_step_words(who, *place, group) for who, group in groups.items()]
    out += [_drift_words(s) for s in judged.values() if s.scale_drifts]
    return out + [why for s in judged.values() for why in s.problems.values()]


def _alike(turns):
    """Whether turns differ by less than half of the largest."""
    turns = np.array(turns)
    apart = np.linalg.norm(turns[:, None] - turns, axis=2).max()
    return bool(apart < SAME_TURN * np.linalg.norm(turns, axis=1).max())


def _step_words(who, before, after, steps):
    angle, sigma = (np.rad2deg(np.mean([getattr(s, k) for s in steps])) for k in ("angle", "angle_sigma"))
    pixels = np.mean([s.size_px for s in steps])
    return (
        f"{who} moved by {angle:.3f} +- {sigma:.3f} deg between placements {before} and {after}: "
        f"the background moves by {pixels:.1f} px"
    )


def _drift_words(found):
    low, high = found.placements[[found.scale.argmin(), found.scale.argmax()]]
    return (
        f"the image scale of camera {found.camera} changes by {100 * np.ptp(found.scale):.2f} % between placements "
        f"{low} and {high}, {np.ptp(found.corner_px):.1f} px at a corner: a lens that warms up, or other settings"
    )


def bend_words(bends):
    """Sentences about boards that bend and materials that read farther.

    Parameters
    ----------
    bends : BoardBends

    Returns
    -------
    list of str
    """
    out = []
    if bends.level_applied:
        further = "farther" if bends.level > 0 else "nearer"
        level, sigma = 1000 * abs(bends.level), 1000 * bends.level_sigma
        out.append(f"the board around the pattern reads {level:.1f} +- {sigma:.1f} mm {further} than the pattern")
    bent = {p: b for p, b in bends.placements.items() if b.bends}
    if bent:
        most = max(bent, key=lambda p: bent[p].size)
        who = f"placements {listed(bent)} bend" if len(bent) > 1 else f"placement {most} bends"
        out.append(f"{who} by {_span(b.size for b in bent.values())} mm in the scan{_sheet_words(bent)}")
    return out


def _span(metres):
    """'7' or '7 to 12', millimetres."""
    values = [f"{1000 * v:.0f}" for v in sorted(metres)]
    return values[0] if values[0] == values[-1] else f"{values[0]} to {values[-1]}"


def _sheet_words(bent):
    """What the images say about boards that look bent; nothing where they do not know."""
    sheets = {p: b.sheet for p, b in bent.items() if np.isfinite(b.sheet)}
    if not sheets:
        return ""
    flat = [p for p, b in bent.items() if b.sheet < SHEET_SHARE * b.size]
    out = f"; in the images the printed sheet departs from its usual shape there by {_span(sheets.values())} mm"
    if flat:
        out += f" (at {listed(flat)} by less than half: a pitch that is stretched looks like a bent board)"
    return out


def problem_words(problems):
    """Why placements or parts of them are left out, one sentence each.

    Parameters
    ----------
    problems : dict of (int or str) to str
        Of a prepared session.

    Returns
    -------
    list of str
    """
    return [why if isinstance(key, str) or "placement" in why else f"placement {key}: {why}"
            for key, why in problems.items()]  # fmt: skip


def listed(names):
    """Names as in a sentence: '1', '1 and 2', '1, 2 and 3'."""
    *most, last = [str(name) for name in names]
    return f"{', '.join(most)} and {last}" if most else last
