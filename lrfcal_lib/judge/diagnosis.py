"""What is wrong with a recording, as tables and in words: boards that bend, a pitch that is off."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from lrfcal_lib.calibrate.observe import board_maps, rough_poses
from lrfcal_lib.model.camera import fold, lens_terms, project
from lrfcal_lib.preprocess.bend import BoardBends, board_bends
from lrfcal_lib.preprocess.intrinsics import raised_points
from lrfcal_lib.solvers.pitch import PitchErrors

SIGNIFICANT = 3.0  # standard deviations of an offset by sweep direction
# a sheet bent less than this share of what the scan shows does not explain the scan
SHEET_SHARE = 0.5
# of an image; corners in a part; pixels
LENS_PARTS = np.array([6, 4])
LENS_CORNERS = 20
LENS_MISS = 0.15
OFF_MIDDLE = 0.2  # of the image's size
OTHER_SIZE = "as with intrinsics of another image size"
WIDE = np.radians(80.0)  # across an image, by the focal length: five numbers hardly hold it
REMEDY = "state intrinsics of this image size, or take sharp images with the chessboard all over"
REMEDY_WIDE = (
    "use a lens below 110 deg, crop or undistort the images first, state intrinsics of this size"
)
# two cameras whose turns differ by less than this share of the larger one moved together
SAME_TURN = 0.5


@dataclass(frozen=True)
class Diagnosis:
    """What a recording says about itself before anything is calibrated.

    `problems` are those of the prepared session: what cannot be used and why.
    """

    bends: BoardBends
    pitch_errors: PitchErrors | None
    problems: tuple


def diagnose(prepared, pitch_errors=None):
    """Ask a recording (Prepared) whether its boards were flat: a :class:`Diagnosis`.

    `pitch_errors` are those of :func:`lrfcal_lib.calibrate.pipeline.find_pitch_errors`.
    """
    # whose findings are in the problems already
    maps = board_maps(prepared, rough_poses(prepared)[0])
    return Diagnosis(board_bends(prepared, maps), pitch_errors, prepared.problems)


def bends_table(bends):
    """Bend of the board (BoardBends) at every placement.

    Columns placement, bend_mm, sigma_mm (in the scan), p_value, bends, sheet_bend_mm,
    sheet_sigma_mm (in the images; NaN where not known), reason.
    """
    columns = [
        "placement",
        "bend_mm",
        "sigma_mm",
        "p_value",
        "bends",
        "sheet_bend_mm",
        "sheet_sigma_mm",
        "reason",
    ]
    rows = [
        (
            b.placement,
            1e3 * b.size,
            1e3 * b.sigma,
            b.p_value,
            b.bends,
            1e3 * b.sheet,
            1e3 * b.sheet_sigma,
            b.reason,
        )
        for b in bends.placements.values()
    ]
    return pd.DataFrame(rows, columns=columns)


def findings_in_words(diagnosis):
    """What a recording says about itself, one sentence a finding.

    None for a recording without fault.
    """
    return (
        pitch_words(diagnosis.pitch_errors)
        + bend_words(diagnosis.bends)
        + [str(problem) for problem in diagnosis.problems]
    )


def lens_words(prepared):
    """Cameras whose lens its model does not fit, one sentence each by camera, from the corners of
    the chessboard.

    What corners miss by on the average over parts of the image is of the lens: noise and waves of
    the sheet differ from view to view. And radii that the model folds back inside the image.
    """
    out = {}
    for camera, views in prepared.views.items() if prepared.board.pattern else ():
        model = prepared.models[camera]
        seen = [v for v in views.values() if v.pixels is not None and not v.reason]
        if not seen:
            continue
        points = raised_points(prepared.board.pattern, prepared.relief)
        uv = np.concatenate([v.pixels for v in seen])
        off = uv - np.concatenate([project(v.T_camera_board.apply(points), model) for v in seen])
        part = np.floor(LENS_PARTS * uv / [model.width, model.height])
        parts = []
        for own in np.unique(part[np.isfinite(off).all(axis=1)], axis=0):
            mine = off[(part == own).all(axis=1)]
            if len(mine) >= LENS_CORNERS:
                parts.append(np.sum(mine.mean(axis=0) ** 2) - mine.var(axis=0).sum() / len(mine))
        alike = np.sqrt(max(np.mean(parts), 0.0)) if parts else 0.0
        ends = np.array([[0, 0], [0, model.height], [model.width, 0], [model.width, model.height]])
        corner = np.linalg.norm((ends - [model.cx, model.cy]) / [model.fx, model.fy], axis=1).max()
        r = np.sqrt(fold(model))
        reach = np.inf
        if np.isfinite(r):
            k1, k2, _, _, k5 = model.distortion
            # recorded radius of the fold
            reach = r * (1 + lens_terms(r, 0.0, k1, k2, 0.0, 0.0, k5)[0]) / corner
        words = [f"corners of the chessboard miss by {alike:.2f} px alike"] * int(alike > LENS_MISS)
        words += [
            f"the model folds back at {100 * reach:.0f} % of the way to the image's corners"
        ] * int(reach < 1)
        if (
            np.abs(np.array([model.cx / model.width, model.cy / model.height]) - 0.5).max()
            > OFF_MIDDLE
        ):
            words.append(
                f"its middle ({model.cx:.0f}, {model.cy:.0f}) is far from the image's, {OTHER_SIZE}"
            )
        if words:
            wide = 2 * np.arctan2(model.width / 2, model.fx) > WIDE
            remedy = REMEDY_WIDE if wide else REMEDY
            lens = f"the lens of camera '{camera}' is not that of its model"
            out[camera] = f"{lens} ({'; '.join(words)}): {remedy}"
    return out


def pitch_words(errors):
    """Sentences about the recorded pitch (PitchErrors or None).

    None without errors that the data ask for.
    """
    if errors is None or errors.wanted == "none":
        return []
    each = errors.models[errors.wanted]
    out = []
    offset, sigma = np.rad2deg([errors.direction_offset, errors.direction_sigma])
    if np.isfinite(offset) and abs(offset) > SIGNIFICANT * sigma:
        out.append(
            "the pitch depends on the direction of the sweep: upward and downward sweeps differ "
            "by "
            f"{2 * abs(offset):.2f} +- {2 * sigma:.2f} deg"
        )
    if errors.wanted.startswith("sweep"):
        out.append(
            f"every sweep has a pitch offset of its own: {np.rad2deg(np.std(each.offset)):.2f} "
            "deg (sd)"
        )
    if errors.wanted == "sweep_stretch":
        low = 100 * each.stretch.min()
        high = 100 * each.stretch.max()
        out.append(
            f"every sweep is stretched by an amount of its own: {low:+.1f} to {high:+.1f} % of "
            "the pitch"
        )
    return out


def bend_words(bends):
    """Sentences about boards that bend and materials that read farther (BoardBends)."""
    out = []
    bent = {p: b for p, b in bends.placements.items() if b.bends}
    if bends.level_applied:
        level = 1000 * abs(bends.level)
        sigma = 1000 * bends.level_sigma
        further = "farther" if bends.level > 0 else "nearer"
        out.append(
            f"the board around the pattern reads {level:.1f} +- {sigma:.1f} mm {further} than "
            "the pattern"
        )
    if bent:
        who = (
            f"placements {_listed(bent)} bend"
            if len(bent) > 1
            else f"placement {_listed(bent)} bends"
        )
        words = f"{who} by {_span(b.size for b in bent.values())} mm in the scan"
        sheets = [b.sheet for b in bent.values() if np.isfinite(b.sheet)]
        flat = [p for p, b in bent.items() if b.sheet < SHEET_SHARE * b.size]
        if sheets:
            words += (
                "; in the images the printed sheet departs from its usual shape there by "
                f"{_span(sheets)} mm"
            )
        if flat:
            words += (
                f" (at {_listed(flat)} by less than half: a pitch that is stretched looks like a "
                "bent board)"
            )
        out.append(words)
    return out


def _span(metres):
    """'7' or '7 to 12', millimetres."""
    values = [f"{1000 * v:.0f}" for v in sorted(metres)]
    return values[0] if values[0] == values[-1] else f"{values[0]} to {values[-1]}"


def _listed(names):
    """Names as in a sentence: '1', '1 and 2', '1, 2 and 3'."""
    *most, last = [str(name) for name in names]
    return f"{', '.join(most)} and {last}" if most else last
