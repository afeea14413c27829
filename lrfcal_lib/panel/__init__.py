"""The data collection panel: connect a rig, watch it, record placement by placement, calibrate at once."""

from lrfcal_lib.panel.collector import Busy, Collector, Interrupted
from lrfcal_lib.panel.result import Result, calibrate_recording
from lrfcal_lib.panel.tasks import Task
from lrfcal_lib.panel.widgets import Panel

__all__ = ["Busy", "Collector", "Interrupted", "Panel", "Result", "Task", "calibrate_recording"]
