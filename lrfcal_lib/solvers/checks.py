"""Observations are checked once, where a solver starts."""

from __future__ import annotations

import numpy as np

from lrfcal_lib.geometry import DegenerateGeometry

FIELDS = {
    "crossing": ("crossing_points", "crossing_covariance", "crossing_lines", "crossing_line_sigma"),
    "plane": ("plane_points", "plane_covariance", "board_poses", "board_covariance"),
    "scene": ("scene_points", "scene_covariance", "scene_pixels", "scene_sigma_px"),
}


def check_finite(obs, kind):
    """Refuse observations of a kind ('crossing', 'plane' or 'scene') that hold a NaN or an infinity."""
    for name in FIELDS[kind]:
        values = np.asarray(getattr(obs, name), float)
        bad = ~np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise ValueError(
                f"{name} of camera '{obs.camera}' is not finite in row {row}: {values[row].ravel()[:3]}: leave them out"
            )


def check_count(found, least, what, camera):
    """Refuse too few observations, with words for what they leave open."""
    if found < least:
        raise DegenerateGeometry(
            f"camera '{camera}': {found} {what}, at least {least} needed: the rest of the pose stays unobservable"
        )
