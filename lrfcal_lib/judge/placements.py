"""What is usable of every placement of the board, and why the rest is not."""

import numpy as np
import pandas as pd


def placements_table(prepared, observations):
    """Every placement of the board: what is usable of it, and why not.

    Columns placement, used, reason, n_scan_lines, n_points, then one column ``edges_<camera>`` a
    camera: the number of edges of the board that a scan crosses and the camera sees. `observations`
    by camera and variant.
    """
    rows = []
    own = {camera: observations[camera, "half_step"] for camera in prepared.views}
    for placement in prepared.session.board_placements:
        mask = np.zeros((0, 0), bool)
        if placement in prepared.scans:
            mask = prepared.scans[placement].mask
        notes = []
        for camera, views in prepared.views.items():
            view = views.get(placement)
            if view is None:
                notes.append(f"{camera}: no image")
            elif view.reason:
                notes.append(f"{camera}: {view.reason}")
            else:
                notes += [f"{camera} {edge}: {why}" for edge, why in view.rejected]
        row = {
            "placement": placement,
            "used": any(placement in obs.all_placements for obs in own.values()),
            "reason": prepared.left_out.get(placement) or "; ".join(notes),
            "n_scan_lines": int(mask.any(axis=1).sum()),
            "n_points": int(mask.sum()),
        }
        for camera, obs in own.items():
            crossed = obs.crossing_edge[obs.crossing_placement == placement]
            row[f"edges_{camera}"] = len(np.unique(crossed))
        rows.append(row)
    return pd.DataFrame(rows)
