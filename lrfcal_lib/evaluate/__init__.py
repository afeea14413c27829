"""Tables that judge a calibration, and the truth of simulated sessions."""

from lrfcal_lib.evaluate.tables import (
    PAPER_EDGES_MM,
    axis_knowledge_table,
    best_method,
    camera_calibration_table,
    edge_lengths,
    edge_summary,
    handed_over,
    intrinsics_table,
    left_out_residuals,
    method_comparison,
    outline_table,
    pitch_errors_table,
    pitch_models_table,
    placements_table,
    plane_residuals_of,
    platform_calibration_table,
    poses_under,
    rms,
    scans_table,
    stereo_check,
    sweeps_table,
    trusted_sigma,
)
from lrfcal_lib.evaluate.truth import Truth, axis_errors, camera_errors, edge_point_table, read_truth

__all__ = [
    "PAPER_EDGES_MM", "Truth", "axis_errors", "axis_knowledge_table", "best_method", "camera_calibration_table",
    "camera_errors", "edge_lengths", "edge_point_table", "edge_summary", "handed_over", "intrinsics_table",
    "left_out_residuals",
    "method_comparison", "outline_table", "pitch_errors_table", "pitch_models_table", "placements_table",
    "plane_residuals_of", "platform_calibration_table", "poses_under", "read_truth", "rms", "scans_table",
    "stereo_check", "sweeps_table", "trusted_sigma",
]  # fmt: skip
