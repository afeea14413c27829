"""Record sessions with a rig: what the program asks, shows, checks and writes while the board is moved about."""

from lrfcal_lib.acquisition.checks import Light, check_image, check_placement, check_scan
from lrfcal_lib.acquisition.recording import Recording, RecordingError
from lrfcal_lib.acquisition.terminal import Terminal, main, record

__all__ = [
    "Light", "Recording", "RecordingError", "Terminal", "check_image", "check_placement", "check_scan", "main",
    "record",
]  # fmt: skip
