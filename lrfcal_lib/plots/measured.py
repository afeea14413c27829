"""Pictures of what is measured in a scene: surfaces and edges, lengths with their intervals."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.plots.colors import COLORS
from lrfcal_lib.plots.rig import pixels, render

PALETTE = np.array(  # of surfaces side by side, light enough for the edges upon them
    [
        [166, 206, 227],
        [178, 223, 138],
        [253, 191, 111],
        [202, 178, 214],
        [255, 255, 153],
        [251, 180, 174],
        [204, 235, 197],
        [222, 203, 228],
    ],
    np.uint8,
)
NO_SURFACE = np.array([70, 70, 70], np.uint8)
KIND_COLORS = {"plane": COLORS["left"], "edge": COLORS["fit"], "point": COLORS["platform"]}


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
    shades = PALETTE[of_point % len(PALETTE)]
    shades[of_point < 0] = NO_SURFACE
    ax.imshow(render(points, shades, T_view, size, splat=3))
    for edge in ends:
        u, v = pixels(T_view.apply(edge), size, None).T
        ax.plot(u, v, color=COLORS["fit"], linewidth=1.0)
    ax.set_xlim(0, size[1])
    ax.set_ylim(size[0], 0)
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
    number = np.asarray(counts)
    ax.loglog(number, 1000 * noise, "--", color=COLORS["platform"], label="noise of points")
    ax.loglog(
        counts, 1000 * together, ":", color=COLORS["right"], label="shared by all points"
    )
    ax.loglog(
        counts, 1000 * np.hypot(noise, together), "o-", color=COLORS["left"], label="both"
    )
    ax.set_xlabel("points / end")
    ax.set_ylabel("standard deviation [mm]")
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
        own = np.array([each == kind for each in kinds])
        ax.errorbar(
            np.asarray(errors)[own],
            rows[own],
            xerr=np.asarray(half)[own],
            fmt="o",
            color=KIND_COLORS[kind],
            capsize=3,
            label=f"{kind} to {kind}",
        )
    ax.axvline(0.0, color="black", linewidth=0.8)
    ax.set_yticks(rows, names)
    ax.set_xlabel("measured - true [mm]")
    ax.legend()
