"""Pictures of what is measured in a scene: surfaces and edges, lengths with their intervals."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.plots.colors import FIT, LEFT, PLATFORM, RIGHT
from lrfcal_lib.plots.rig import pixels, render

PALETTE = (  # of surfaces side by side, light enough for the edges upon them
    "#a6cee3",
    "#b2df8a",
    "#fdbf6f",
    "#cab2d6",
    "#ffff99",
    "#fbb4ae",
    "#ccebc5",
    "#decbe4",
)
NO_SURFACE = "#464646"
KIND_COLORS = {"plane": LEFT, "edge": FIT, "point": PLATFORM}


def surfaces_and_edges(
    ax: Axes,
    points: np.ndarray,
    of_point: np.ndarray,
    ends: Sequence[np.ndarray],
    T_view: RigidTransform,
    size: tuple[int, int] = (900, 1200),
) -> None:
    """A cloud in the colours of its flat surfaces, points of none dark, and its edges.

    Parameters
    ----------
    ax
    points
        Shape (n, 3), metres.
    of_point
        Number of the surface of each, -1 for none, shape (n,).
    ends
        Of each edge, shape (2, 3), metres.
    T_view, size
        See :func:`lrfcal_lib.plots.rig.render`.
    """
    colors = ListedColormap(PALETTE).with_extremes(under=NO_SURFACE)
    shades = colors(np.minimum(of_point, of_point % len(PALETTE)), bytes=True)[:, :3]
    ax.imshow(render(points, shades, T_view, size, splat=3))
    for edge in ends:
        ax.plot(*pixels(T_view.apply(edge), size).T, color=FIT, linewidth=1.0)
    ax.set(xlim=(0, size[1]), ylim=(size[0], 0))
    ax.set_axis_off()


def sigma_by_points(
    ax: Axes, counts: Sequence[int], noise: np.ndarray, together: np.ndarray
) -> None:
    """Standard deviation of a length by the number of points at each end, and its two parts.

    Parameters
    ----------
    ax
    counts
    noise, together
        Parts of single points and of what all points share, metres, shape as `counts`.
    """
    ax.loglog(counts, 1000 * noise, "--", color=PLATFORM, label="noise of points")
    ax.loglog(counts, 1000 * together, ":", color=RIGHT, label="shared by all points")
    ax.loglog(counts, 1000 * np.hypot(noise, together), "o-", color=LEFT, label="both")
    ax.set(xlabel="points / end", ylabel="standard deviation [mm]")
    ax.legend()


def length_errors(
    ax: Axes,
    names: Sequence[str],
    kinds: Sequence[str],
    errors: np.ndarray,
    half: np.ndarray,
) -> None:
    """Errors of lengths with their 90 % intervals, a row each.

    Parameters
    ----------
    ax
    names, kinds
        Of each length, and 'plane', 'edge' or 'point'.
    errors, half
        Millimetres; half the width of the interval.
    """
    rows = np.arange(len(names))[::-1]
    for kind in dict.fromkeys(kinds):
        own = np.equal(kinds, kind)
        ax.errorbar(
            errors[own],
            rows[own],
            xerr=half[own],
            fmt="o",
            color=KIND_COLORS[kind],
            capsize=3,
            label=f"{kind} to {kind}",
        )
    ax.axvline(0.0, color="black", linewidth=0.8)
    ax.set_yticks(rows, names)
    ax.set_xlabel("measured - true [mm]")
    ax.legend()
