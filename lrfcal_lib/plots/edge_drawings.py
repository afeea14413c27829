"""Drawings of what faces and edges say, to scale and from what was estimated."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from scipy.special import ndtr

from lrfcal_lib.model.geometry import unit_vector
from lrfcal_lib.model.observations import thin
from lrfcal_lib.plots.colors import FIT, LEFT, LRF, PLATFORM, TRUTH

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
    up = np.sign(distance) * normal
    height = abs(distance)
    away = points.mean(axis=0) - origin
    section = np.stack([unit_vector(away - up * (up @ away)), up])
    flat = points @ section.T
    x, y = section @ origin  # of the LRF
    first = flat[:, 0].min() - 0.15
    last = flat[:, 0].max() + 0.15
    ax.plot([first, last], [height, height], color=TRUTH, linewidth=2)
    ax.hlines(height, 0, first, TRUTH, linewidth=0.6, linestyle=":")
    beams = np.array([[(x, y), point] for point in thin(flat, BEAMS)])
    ax.plot(*beams.T, color=LRF, linewidth=0.5, alpha=0.6)
    ax.plot(*flat.T, ".", color=LRF, markersize=3)
    ax.plot(x, y, "o", color=LRF, markersize=8)
    ax.plot(0, 0, "s", color=LEFT, markersize=8)
    ax.annotate("", (0, height), (0, 0), arrowprops={"arrowstyle": "->"})
    ax.text(last, height + ABOVE, "plane of the board", ha="right")
    ax.text(-ABOVE, height / 2, f"n, d = {height:.2f} m", ha="right")
    # each name on the side where the other sensor is not
    beside = np.copysign(ABOVE, x)
    sides = ("right", "left")[:: int(np.sign(beside))]
    ax.text(-beside, 0, "camera", va="center", ha=sides[0], color=LEFT)
    ax.text(x + beside, y, "LRF", va="center", ha=sides[1], color=LRF)
    ax.set(
        xlabel="along the board [m]",
        ylabel="along its normal [m]",
        aspect="equal",
        xlim=(
            min(0.0, first, x) - ROOM * height,
            max(last, x + ROOM * height),
        ),
    )


def spot_over_edge(ax: Axes, radius: float, bias: float) -> None:
    """A spot as it passes an edge: on the board, where the reading flips, and beside the board.

    Parameters
    ----------
    ax
    radius, bias
        Of the spot, and how far outside the edge its centre lies where the reading flips, metres.
    """
    r = 1000 * radius
    b = 1000 * bias
    reach = ABOUT * r
    ax.axvspan(-reach, 0, color="#d9dee3")
    ax.axvline(0, color=TRUTH)
    spots = (
        ("reads beyond", 0.9 * r, PLATFORM),
        ("flips", b, FIT),
        ("reads the board", -0.9 * r, LRF),
    )
    for row, (words, u, color) in enumerate(spots):
        at = 2.3 * row * r
        ax.add_patch(Circle((u, at), r, color=color, alpha=0.3, linewidth=0))
        ax.plot(u, at, "+", color=color, markersize=9, markeredgewidth=1.6)
        ax.text(1.1 * reach, at, words, va="center", color=color)
    top = 6.2 * r
    ax.text(-0.97 * reach, top, "board", va="center")
    ax.text(0.97 * reach, top, "beyond", va="center", ha="right")
    ax.hlines(0.9 * r, 0, b, FIT, linewidth=2)
    ax.text(b / 2, 1.15 * r, "b", ha="center", va="center", color=FIT)
    ax.set(
        xlabel="distance u of the beam from the edge [mm]",
        xlim=(-reach, 2.6 * reach),
        ylim=(-1.4 * r, 6.8 * r),
        yticks=[],
        aspect="equal",
    )
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
    u = 1000 * distance
    b = 1000 * bias
    x = np.linspace(u.min(), u.max(), 400)
    ax.plot(x, ndtr((b - x) / (1000 * sigma)), color=FIT, label="expected, Φ((b - u) / σ)")
    ax.plot(u[hit], hit[hit], "|", color=LRF, label="beams that read the board")
    ax.plot(u[~hit], hit[~hit], "|", color=PLATFORM, label="beams that read beyond")
    ax.axvline(0, color=TRUTH)
    ax.axvline(b, color=FIT, linestyle=":")
    ax.text(b, 0.5, f" b = {b:.1f} mm", color=FIT)
    ax.set(
        xlabel="distance u of the beam from the edge [mm]",
        ylabel="reads the board [1]",
        yticks=[0, 0.5, 1],
        ylim=(-0.08, 1.35),
    )
    ax.legend(loc="upper right")
