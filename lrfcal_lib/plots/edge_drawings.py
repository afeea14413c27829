"""Drawings of what faces and edges say, to scale and from what was estimated."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle
from scipy.special import ndtr

from lrfcal_lib.plots.colors import COLORS

BEAMS = 12  # drawn of a scan
ROOM = 0.45  # for labels at the sides, of the height of a drawing
ABOVE = 0.05  # of labels beside what they name, metres
ABOUT = 2.0  # spot radii shown on either side of an edge


def plane_constraint(
    ax: Axes, points: np.ndarray, origin: np.ndarray, normal: np.ndarray, distance: float
) -> None:
    """A board's plane as a section at right angles to it, with camera, LRF and measured points.

    Heights above the camera along the normal are true, and so is the way from the LRF along the
    plane; what lies across the section is not seen.

    Parameters
    ----------
    ax
    points, origin
        Measured points (n, 3) and the place of the LRF (3,), camera frame, metres.
    normal, distance
        Of the plane n . p = d, camera frame: a unit vector (3,), metres.
    """
    sign = np.sign(distance) or 1.0
    up = sign * np.asarray(normal)
    across = points.mean(axis=0) - origin
    across = across - up * (up @ across)
    across = across / np.linalg.norm(across)
    section = np.stack([across, up])
    flat = points @ section.T
    lrf = section @ origin
    height = sign * distance
    first, last = flat[:, 0].min() - 0.15, flat[:, 0].max() + 0.15
    ax.plot([first, last], [height, height], color=COLORS["truth"], linewidth=2)
    ax.text(last, height + ABOVE, "plane of the board", va="bottom", ha="right")
    for x, y in flat[:: max(1, len(flat) // BEAMS)]:
        ax.plot([lrf[0], x], [lrf[1], y], color=COLORS["lrf"], linewidth=0.5, alpha=0.6)
    ax.plot(*flat.T, ".", color=COLORS["lrf"], markersize=3)
    ax.annotate("", (0, height), (0, 0), arrowprops={"arrowstyle": "->"})
    ax.plot(
        [0, first], [height, height], color=COLORS["truth"], linewidth=0.6, linestyle=":"
    )
    ax.text(-ABOVE, height / 2, f"n, d = {height:.2f} m", va="center", ha="right")
    ax.plot(0, 0, "s", color=COLORS["left"], markersize=8)
    ax.text(-ABOVE, 0, "camera", va="center", ha="right", color=COLORS["left"])
    ax.plot(*lrf, "o", color=COLORS["lrf"], markersize=8)
    ax.text(lrf[0] + ABOVE, lrf[1], "LRF", va="center", color=COLORS["lrf"])
    ax.set(xlabel="along the board [m]", ylabel="along its normal [m]", aspect="equal")
    ax.set_xlim(min(0.0, first, lrf[0]) - ROOM * height, max(last, lrf[0] + ROOM * height))


def spot_over_edge(ax: Axes, radius: float, bias: float) -> None:
    """A spot as it passes an edge: on the board, where the reading flips, and beside the board.

    Parameters
    ----------
    ax
    radius, bias
        Of the spot, and how far outside the edge its centre lies where the reading flips, metres.
    """
    r = 1000 * radius
    reach = ABOUT * r
    places = {"reads the board": -0.9 * r, "flips": 1000 * bias, "reads beyond": 0.9 * r}
    colors = (COLORS["lrf"], COLORS["fit"], COLORS["platform"])
    height = 2.3 * r
    ax.add_patch(Rectangle((-reach, -height / 2), reach, 3 * height, color="#d9dee3"))
    ax.axvline(0, color=COLORS["truth"])
    for row, ((words, u), color) in enumerate(zip(places.items(), colors, strict=True)):
        at = (2 - row) * height
        ax.add_patch(Circle((u, at), r, color=color, alpha=0.3, linewidth=0))
        ax.plot(u, at, "+", color=color, markersize=9, markeredgewidth=1.6)
        ax.text(1.1 * reach, at, words, va="center", color=color)
    ax.text(-0.97 * reach, 2.3 * height, "board", va="center")
    ax.text(0.97 * reach, 2.3 * height, "beyond", va="center", ha="right")
    ax.annotate(
        "b", (1000 * bias, 0.5 * height), ha="center", va="center", color=COLORS["fit"]
    )
    ax.plot([0, 1000 * bias], [0.38 * height] * 2, color=COLORS["fit"], linewidth=2)
    ax.set(xlim=(-reach, 2.6 * reach), ylim=(-0.6 * height, 2.6 * height), aspect="equal")
    ax.set(xlabel="distance u of the beam from the edge [mm]", yticks=[])
    ax.grid(False)


def reading_by_distance(
    ax: Axes, distance: np.ndarray, hit: np.ndarray, bias: float, sigma: float
) -> None:
    """Whether beams read the board, over their distance from its edge, and what is expected.

    Parameters
    ----------
    ax
    distance, hit
        Of n beams: metres, positive outside, and whether they read the board.
    bias, sigma
        Where the reading flips, metres outside the edge, and its standard deviation.
    """
    u = 1000 * np.asarray(distance)
    b = 1000 * bias
    s = 1000 * sigma
    x = np.linspace(u.min(), u.max(), 400)
    ax.plot(x, ndtr((b - x) / s), color=COLORS["fit"], label="expected, Φ((b - u) / σ)")
    for read, color in ((True, COLORS["lrf"]), (False, COLORS["platform"])):
        chosen = u[hit == read]
        words = "beams that read the board" if read else "beams that read beyond"
        ax.plot(chosen, np.full(len(chosen), float(read)), "|", color=color, label=words)
    ax.axvline(0, color=COLORS["truth"])
    ax.axvline(b, color=COLORS["fit"], linestyle=":")
    ax.text(b, 0.5, f" b = {b:.1f} mm", color=COLORS["fit"])
    ax.set(xlabel="distance u of the beam from the edge [mm]", ylim=(-0.08, 1.35))
    ax.set(ylabel="reads the board [1]", yticks=[0, 0.5, 1])
    ax.legend(loc="upper right")
