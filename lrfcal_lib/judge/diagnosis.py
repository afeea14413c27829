"""What is wrong with a recording, in words: a lens that is not its model's, a pitch that is off."""

import numpy as np

from lrfcal_lib.model.camera import fold, lens_terms, project
from lrfcal_lib.preprocess.intrinsics import raised_points

SIGNIFICANT = 3.0  # standard deviations of an offset by sweep direction
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
