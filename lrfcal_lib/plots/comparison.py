"""Figures of calibrations beside each other: where they differ."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh


def shift_map(ax: Axes, at: np.ndarray, off: np.ndarray) -> QuadMesh:
    """By how much things move over an image or a field of view, as colours.

    Parameters
    ----------
    ax
    at
        Where, shape (r, c, 2).
    off
        Shifts, shape (r, c, k); NaN where there is none.

    Returns
    -------
    QuadMesh
        For a colour bar in the unit of `off`.
    """
    u, v = np.moveaxis(at, -1, 0)
    return ax.pcolormesh(u, v, np.linalg.norm(off, axis=-1), vmin=0)
