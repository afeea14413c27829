"""Does the model of a lens fit what its images show?"""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from lrfcal_lib.judge.findings import Kind
from lrfcal_lib.model.camera import project
from lrfcal_lib.preprocess.prepared import Prepared
from lrfcal_lib.session.faults import Fault

LENS_PARTS = np.array([6, 4])  # columns and rows that an image is cut into
LENS_CORNERS = 20  # corners of the chessboard in a part, at least
LENS_MISS = 0.15  # pixels that corners of a part may miss by alike
OFF_MIDDLE = 0.2  # of the image's size


def lens_findings(prepared: Prepared) -> Iterator[Fault]:
    """Cameras whose lens its model does not fit, as the corners of the chessboard show it.

    Parameters
    ----------
    prepared

    Yields
    ------
    Fault
        One a camera.
    """
    for camera, model in prepared.models.items():
        views = list(prepared.patterned(camera).values())
        if not views:
            continue
        faults = []
        miss = common_miss(views, prepared.pattern_points, model)
        if miss > LENS_MISS:
            faults.append(
                f"in parts of the images the corners of the chessboard lie {miss:.2f} px beside "
                "their prediction, all in one direction"
            )
        other_size = np.abs([model.cx, model.cy] / model.size - 0.5).max() > OFF_MIDDLE
        if other_size:
            faults.append(
                f"its principal point ({model.cx:.0f}, {model.cy:.0f}) is far from the "
                "image's centre, as with intrinsics of another image size"
            )
        if faults:
            yield Fault(
                Kind.LENS,
                f"the lens of camera '{camera}' is not that of its model ({'; '.join(faults)}): "
                "state intrinsics of this image size, or take sharp images with the chessboard all "
                "over; undistort the images of a wide lens first",
                severe=other_size,
            )


def common_miss(views, points, model):
    """What corners (k, 3) miss by alike in parts of the images (BoardViews), pixels.

    That is of the lens: noise and waves of the sheet differ from view to view.
    """
    uv = np.concatenate([view.pixels for view in views])
    expected = [project(view.T_camera_board.apply(points), model) for view in views]
    miss = uv - np.concatenate(expected)
    part = np.floor(LENS_PARTS * uv / model.size)
    table = pd.DataFrame(np.hstack([part, miss]), columns=["column", "row", "u", "v"])
    parts = table.dropna().groupby(["column", "row"])
    noise = parts.var(ddof=0).div(parts.size(), axis=0)
    squares = (parts.mean() ** 2 - noise).sum(axis=1)[parts.size() >= LENS_CORNERS]
    return np.sqrt(np.fmax(squares.mean(), 0.0))  # 0 where no part has corners enough
