"""lrfcal: calibrate a pitching 2D laser range finder (LRF) and its cameras from edges of a board.

Frames (destination first: ``p_camera = T_camera_lrf.apply(p_lrf)``, inner names cancel):

============== =============================================================== =============
frame          axes                                                            paper
============== =============================================================== =============
``lrf``        origin at the mirror; scan plane z = 0; x at bearing 0 (to the  P_L, eq. 17
               right), y at bearing 90 deg (ahead)
``head``       turns with the platform; x is the tilt axis                     P_P, eqs. 1-3
``platform``   stands still: ``p_platform = Rx(pitch) p_head``                 P, eqs. 4-6
``left``, ...  cameras as in OpenCV: x right, y down, z ahead                  P_C, eq. 16
``board``      in the board, z = 0; see :mod:`lrfcal_lib.model.board`          fig. 2
============== =============================================================== =============

Units are SI and radians. A name carries a suffix only where it is not SI (``pitch_deg``,
``edge_mm``, ``sigma_px``). Pixel (0, 0) is the centre of the top-left pixel.

Transforms are ``scipy.spatial.transform.RigidTransform``. A small change of a transform is the
vector ``[w, v]``: ``R <- exp(w) R``, ``t <- t + v``, rotation first, both in the destination frame.
Covariances of transforms are 6 x 6 in this order.
"""

import ctypes
import os
import sys

__version__ = "0.1.0"


def _one_thread():
    """Let OpenBLAS and OpenCV, loaded already or later, add up in one order on any machine."""
    # kernels and workers inherit them
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)
    if os.path.exists("/proc/self/maps"):
        with open("/proc/self/maps", encoding="utf-8", errors="surrogateescape") as maps:
            files = {
                line.split(maxsplit=5)[5].strip() for line in maps if "openblas" in line
            }
        for library in map(ctypes.CDLL, files):
            # NumPy's, SciPy's, OpenCV's
            for name in (
                "scipy_openblas_set_num_threads64_",
                "scipy_openblas_set_num_threads",
                "openblas_set_num_threads",
            ):
                getattr(library, name, int)(1)


_one_thread()
