"""Does the model of a lens fit what its images show?"""

import numpy as np

from lrfcal_lib.judge.findings import Finding, Kind, no_if
from lrfcal_lib.model.camera import CameraModel, fold, lens_terms, project
from lrfcal_lib.preprocess.intrinsics import raised_points
from lrfcal_lib.preprocess.prepared import Prepared

LENS_PARTS = np.array([6, 4])  # columns and rows that an image is cut into
LENS_CORNERS = 20  # corners of the chessboard in a part, at least
LENS_MISS = 0.15  # pixels that corners of a part may miss by alike
OFF_MIDDLE = 0.2  # of the image's size
WIDE = np.radians(80.0)  # across an image, by the focal length: five numbers hardly hold it
REMEDY = (
    "state intrinsics of this image size, or take sharp images with the chessboard all over"
)
REMEDY_WIDE = (
    "use a lens below 110 deg, crop or undistort the images first, "
    "state intrinsics of this size"
)


def lens_findings(prepared: Prepared) -> list[Finding]:
    """Cameras whose lens its model does not fit, as the corners of the chessboard show it.

    Parameters
    ----------
    prepared

    Returns
    -------
    list of Finding
        One a camera.
    """
    if prepared.board.pattern is None:
        return []
    findings = []
    for camera, model in prepared.models.items():
        views = prepared.views[camera].values()
        views = [view for view in views if view.pixels is not None and not view.reason]
        if not views:
            continue
        faults = []
        miss = common_miss(
            views, raised_points(prepared.board.pattern, prepared.relief), model
        )
        if miss > LENS_MISS:
            faults.append(
                f"in parts of the images the corners of the chessboard lie {miss:.2f} px beside "
                "their prediction, all in one direction"
            )
        reach = reach_of_fold(model)
        if reach < 1:
            faults.append(
                f"the model folds back at {100 * reach:.0f} % of the way to the image's corners"
            )
        middle = np.array([model.cx / model.width, model.cy / model.height])
        other_size = np.abs(middle - 0.5).max() > OFF_MIDDLE
        if other_size:
            faults.append(
                f"its principal point ({model.cx:.0f}, {model.cy:.0f}) is far from the "
                "image's centre, as with intrinsics of another image size"
            )
        if faults:
            remedy = REMEDY
            if 2 * np.arctan2(model.width / 2, model.fx) > WIDE:
                remedy = REMEDY_WIDE
            words = (
                f"the lens of camera '{camera}' is not that of its model ({'; '.join(faults)}): "
                f"{remedy}"
            )
            findings.append(Finding(no_if(other_size), Kind.LENS, words))
    return findings


def common_miss(views, points, model):
    """What corners (k, 3) miss by alike in parts of the images (BoardViews), pixels.

    That is of the lens: noise and waves of the sheet differ from view to view.
    """
    uv = np.concatenate([view.pixels for view in views])
    expected = [project(view.T_camera_board.apply(points), model) for view in views]
    miss = uv - np.concatenate(expected)
    part = np.floor(LENS_PARTS * uv / [model.width, model.height])
    squares = []
    for here in np.unique(part[np.isfinite(miss).all(axis=1)], axis=0):
        of_part = miss[(part == here).all(axis=1)]
        if len(of_part) >= LENS_CORNERS:
            noise = of_part.var(axis=0).sum() / len(of_part)
            squares.append(np.sum(of_part.mean(axis=0) ** 2) - noise)
    if not squares:
        return 0.0
    return np.sqrt(max(np.mean(squares), 0.0))


def reach_of_fold(model: CameraModel) -> float:
    """Recorded radius at which a lens model folds back, relative to the image's corners.

    Parameters
    ----------
    model
    """
    r = np.sqrt(fold(model))
    if not np.isfinite(r):
        return np.inf
    far = np.maximum(
        [model.cx, model.cy], [model.width - model.cx, model.height - model.cy]
    )
    corner = np.linalg.norm(far / [model.fx, model.fy])
    k1, k2, _, _, k5 = model.distortion
    return float(r * (1 + lens_terms(r, 0.0, k1, k2, 0.0, 0.0, k5)[0]) / corner)
