"""Figures of calibrations beside each other: where they differ."""

import numpy as np
from matplotlib.axes import Axes


def shift_map(ax: Axes, at: np.ndarray, off: np.ndarray, unit: str, **looks: str) -> None:
    """By how much things move over an image or a field of view, as colours with a bar.

    Parameters
    ----------
    ax
    at
        Where, shape (r, c, 2).
    off
        Shifts, shape (r, c, k); NaN where there is none.
    unit
        Of `off`.
    looks
        Title and labels.
    """
    u, v = np.moveaxis(at, -1, 0)
    drawn = ax.pcolormesh(u, v, np.linalg.norm(off, axis=-1), vmin=0)
    ax.figure.colorbar(drawn, ax=ax, label=f"[{unit}]")
    ax.set(**looks)
