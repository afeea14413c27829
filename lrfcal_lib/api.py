"""What does most of the work, in one place: ``from lrfcal_lib.api import calibrate, open_session``.

The functions stand in the folders of their stages; two folders are called like their functions
(``calibrate``, ``judge``), which is why the package itself does not offer them.
"""

from lrfcal_lib.calibrate.calibration_file import load_calibration
from lrfcal_lib.calibrate.clouds import color_cloud
from lrfcal_lib.calibrate.observe import observe
from lrfcal_lib.calibrate.pipeline import calibrate, prepare
from lrfcal_lib.evaluate.tables import method_comparison
from lrfcal_lib.judge.verdict import judge
from lrfcal_lib.model.camera import project
from lrfcal_lib.model.geometry import polar_to_points
from lrfcal_lib.session.read import open_session
from lrfcal_lib.solvers import solve_camera
from lrfcal_lib.solvers.joint import solve_joint
from lrfcal_lib.solvers.platform import solve_platform

__all__ = [
    "calibrate",
    "color_cloud",
    "judge",
    "load_calibration",
    "method_comparison",
    "observe",
    "open_session",
    "polar_to_points",
    "prepare",
    "project",
    "solve_camera",
    "solve_joint",
    "solve_platform",
]
