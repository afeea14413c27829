"""Tables that judge a calibration, and the truth of simulated sessions."""

from lrfcal_lib.evaluate.diagnosis import bends_table, diagnose, findings_in_words, steadiness_table, steps_table
from lrfcal_lib.evaluate.jointly import (
    edge_bias_mm,
    edge_misses_px,
    joint_errors,
    joint_fit,
    joint_table,
    noise_table,
    random_halves,
    size_error,
)
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
)
from lrfcal_lib.evaluate.truth import Truth, axis_errors, camera_errors, edge_point_table, read_truth

__all__ = [
    "PAPER_EDGES_MM", "Truth", "axis_errors", "axis_knowledge_table", "bends_table", "best_method",
    "camera_calibration_table", "camera_errors", "diagnose", "edge_bias_mm", "edge_lengths", "edge_misses_px",
    "edge_point_table", "edge_summary", "findings_in_words", "handed_over", "intrinsics_table", "joint_errors",
    "joint_fit", "joint_table", "left_out_residuals", "method_comparison", "noise_table", "outline_table",
    "pitch_errors_table", "pitch_models_table", "placements_table", "plane_residuals_of", "platform_calibration_table",
    "poses_under", "random_halves", "read_truth", "rms", "scans_table", "size_error", "steadiness_table",
    "steps_table", "stereo_check", "sweeps_table",
]  # fmt: skip
