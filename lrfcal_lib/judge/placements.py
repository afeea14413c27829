"""What is usable of every placement of the board, and why the rest is not."""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from lrfcal_lib.model.observations import CameraObservations
from lrfcal_lib.preprocess.board_in_image import BoardView
from lrfcal_lib.preprocess.prepared import Prepared

NO_IMAGE = BoardView(reason="no image")


def placements_table(
    prepared: Prepared, observations: Mapping[tuple[str, str], CameraObservations]
) -> pd.DataFrame:
    """Every placement of the board: what is usable of it, and why not.

    Parameters
    ----------
    prepared
    observations
        By camera and variant.

    Returns
    -------
    DataFrame
        Columns placement, used, reason, n_scan_lines, n_points, then one column ``edges_<camera>``
        a camera: the number of edges of the board that a scan crosses and the camera sees.
    """
    rows = []
    by_camera = {camera: observations[camera, "half_step"] for camera in prepared.views}
    for placement in prepared.session.board_placements:
        mask = np.zeros((0, 0), bool)
        if placement in prepared.scans:
            mask = prepared.scans[placement].mask
        notes = []
        for camera, views in prepared.views.items():
            view = views.get(placement, NO_IMAGE)
            if view.reason:
                notes.append(f"{camera}: {view.reason}")
            else:
                notes += [f"{camera} {edge}: {why}" for edge, why in view.rejected]
        row = {
            "placement": placement,
            "used": any(placement in obs.all_placements for obs in by_camera.values()),
            "reason": prepared.left_out.get(placement) or "; ".join(notes),
            "n_scan_lines": mask.any(axis=1).sum(),
            "n_points": mask.sum(),
        }
        for camera, obs in by_camera.items():
            crossed = obs.crossing_placement == placement
            row[f"edges_{camera}"] = len(set(obs.crossing_edge[crossed]))
        rows.append(row)
    return pd.DataFrame(rows)
