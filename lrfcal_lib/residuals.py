"""What the joint estimate leaves over, in millimetres and pixels, with where it arose."""

from __future__ import annotations

import numpy as np

from lrfcal_lib.camera import project
from lrfcal_lib.candidates import outline
from lrfcal_lib.solvers.joint_blocks import named_blocks
from lrfcal_lib.solvers.pose import exp_rotation


def range_residuals(solution):
    """Predicted minus measured ranges on the boards' faces.

    Parameters
    ----------
    solution : JointSolution

    Returns
    -------
    distance, residual : ndarray, shape (n,)
        Metres.
    placement : ndarray of int, shape (n,)
    """
    used = solution.data.face["used"]
    blocks = named_blocks(solution.state, solution.data, solution.unknowns)
    residual = blocks["face"].residuals if "face" in blocks else np.zeros(used.shape)
    return solution.data.face["range"][used], residual[used], _placements(solution, used)


def view_residuals(solution, camera, model):
    """Where the calibration puts the boards' middles in the images of a camera, and where they were seen.

    Parameters
    ----------
    solution : JointSolution
    camera : str
    model : CameraModel

    Returns
    -------
    uv : ndarray, shape (n, 2)
        As seen, pixels.
    shift : ndarray, shape (n, 2)
        Predicted minus seen, pixels.
    placement : ndarray of int, shape (n,)

    Raises
    ------
    ValueError
        If there is no such camera.
    """
    if camera not in solution.transforms:
        raise ValueError(f"cameras are {', '.join(solution.transforms) or 'none'}; got '{camera}'")
    view = solution.data.view
    used = view["used"] & (view["camera"] == list(solution.transforms).index(camera))
    if not used.any():
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, int)
    block = named_blocks(solution.state, solution.data, solution.unknowns)["view"]
    change = block.residuals.reshape(used.shape + (6,))[used]
    pose = view["pose"][used]
    turned = pose[:, :3, :3] @ np.append(outline(solution).mean(axis=0), 0.0)
    seen = project(turned + pose[:, :3, 3], model)
    there = (exp_rotation(change[:, :3]) @ turned[..., None])[..., 0] + pose[:, :3, 3] + change[:, 3:]
    return seen, project(there, model) - seen, _placements(solution, used)


def _placements(solution, used):
    return np.broadcast_to(np.array(list(solution.boards))[:, None], used.shape)[used]


__all__ = ["range_residuals", "view_residuals"]
