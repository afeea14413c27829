"""Figures of calibrations beside each other: where they differ."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh

from lrfcal_lib.plots.colors import COLORS

LONGEST = 0.08  # of the image's width, the arrow of the largest shift
LEAST = 0.01  # pixels that such an arrow stands for


def pixel_shifts(ax: Axes, at: np.ndarray, off: np.ndarray, size: tuple[int, int]) -> float:
    """Arrows over an image, enlarged.

    Parameters
    ----------
    ax
    at, off
        Pixels and their shifts, shape (..., 2); NaN where there is none.
    size
        Width and height of the image, pixels.

    Returns
    -------
    float
        What the longest arrow stands for, pixels.
    """
    at = at.reshape(-1, 2)
    off = off.reshape(-1, 2)
    length = np.linalg.norm(off, axis=1)
    largest = np.nanmax(length, initial=LEAST)
    ax.quiver(
        *at.T,
        *off.T,
        angles="xy",
        scale_units="xy",
        scale=largest / (LONGEST * size[0]),
        color=COLORS["fit"],
    )
    ax.set(xlim=(0, size[0]), ylim=(size[1], 0), xlabel="u [px]", ylabel="v [px]")
    ax.set_aspect("equal")
    return float(largest)


def field_shifts(ax: Axes, at: np.ndarray, off: np.ndarray) -> QuadMesh:
    """By how much points move over the field of view, as colours.

    Parameters
    ----------
    ax
    at
        Bearings and pitches, radians, shape (r, c, 2).
    off
        Metres, shape (r, c, 3).

    Returns
    -------
    QuadMesh
        For a colour bar in millimetres.
    """
    bearing, pitch = np.degrees(np.moveaxis(at, -1, 0))
    drawn = ax.pcolormesh(bearing, pitch, 1000 * np.linalg.norm(off, axis=-1), vmin=0)
    ax.set(xlabel="bearing [deg] (0: right)", ylabel="pitch [deg]")
    ax.invert_xaxis()  # as the rig sees it
    return drawn
