"""One function a figure: (axes, data) -> None. One colour a sensor, equal scales for geometry, units on every axis."""

from lrfcal_lib.plots.colors import AXES_RGB, COLORS, SERIES, color_of
from lrfcal_lib.plots.diagnosis import background_motion, board_bend
from lrfcal_lib.plots.images import (
    board_view,
    edge_detail,
    outline,
    picture,
    projected_points,
    seen_points,
    stretch_in_image,
)
from lrfcal_lib.plots.results import (
    cost_history,
    edge_errors,
    method_bars,
    parameter_comparison,
    pitch_offsets,
    residual_strips,
)
from lrfcal_lib.plots.scans import crossings, edge_of_line, projection, range_image, scan_line, sides
from lrfcal_lib.plots.uncertainty import (
    misfit_bars,
    observability_bars,
    point_map,
    point_parts,
    projection_map,
    residuals_by_range,
    residuals_by_region,
)
from lrfcal_lib.plots.views import cylinder, frames, look_at, polygon, rays, render, slab, space, sphere

__all__ = [
    "AXES_RGB", "COLORS", "SERIES", "background_motion", "board_bend", "board_view", "color_of", "cost_history",
    "crossings", "cylinder", "edge_detail", "edge_errors", "edge_of_line", "frames", "look_at", "method_bars",
    "misfit_bars", "observability_bars", "outline", "parameter_comparison", "picture", "pitch_offsets", "point_map",
    "point_parts", "polygon", "projected_points", "projection", "projection_map", "range_image", "rays", "render",
    "residual_strips", "residuals_by_range", "residuals_by_region", "scan_line", "seen_points", "sides", "slab",
    "space", "sphere", "stretch_in_image",
]  # fmt: skip
