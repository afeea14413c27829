"""Drawings of the geometry behind the equations, seen in perspective and named at the things."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.board import UNIT_SQUARE, Board
from lrfcal_lib.model.camera import CameraModel, pinhole
from lrfcal_lib.model.geometry import unit_vector
from lrfcal_lib.plots.colors import AXES_RGB, LEFT, LRF, RIGHT, TRUTH
from lrfcal_lib.plots.recording import CENTRED, to_scale
from lrfcal_lib.plots.rig import Vector, look_at, pixels

DIMENSION = {
    "arrowstyle": "<|-|>",
    "linewidth": 0.9,
    "shrinkA": 0,
    "shrinkB": 0,
}
ARROW = {"arrowstyle": "-|>", "linewidth": 1.8, "shrinkA": 0}


class View:
    """Flat axes that show things in space as an eye sees them.

    Parameters
    ----------
    ax
    eye, target
        Where one looks from and to, shape (3,), metres.
    up
        Shown upwards.
    """

    def __init__(self, ax: Axes, eye: Vector, target: Vector, up: Vector = (0, 0, 1)):
        self.ax = ax
        self.T_view = look_at(eye, target, up)
        ax.set_axis_off()
        ax.set(aspect="equal")
        ax.invert_yaxis()

    def flat(self, points: ArrayLike) -> np.ndarray:
        """Where points (..., 3), metres, stand on the axes, (..., 2)."""
        return pixels(self.T_view.apply(points), (1, 1))

    def line(self, points: ArrayLike, style: str = "-", **looks: Any) -> None:
        """A line through points (n, 3), metres."""
        self.ax.plot(*self.flat(points).T, style, **looks)

    def face(
        self, corners: np.ndarray, color: str, alpha: float = 0.2, edge: str | None = None
    ) -> None:
        """A flat area with corners (n, 3), metres."""
        self.ax.fill(
            *self.flat(corners).T, facecolor=(color, alpha), edgecolor=edge or color
        )

    def name(
        self,
        point: ArrayLike,
        text: str,
        away: tuple[float, float] = (8, 8),
        color: str = TRUTH,
    ) -> None:
        """A text beside a point (3,), so many printer's points to the right and up."""
        self.ax.annotate(
            text,
            self.flat(point),
            away,
            textcoords="offset points",
            color=color,
            **CENTRED,
        )

    def arrow(self, ends: ArrayLike, color: str, looks: dict = ARROW) -> None:
        """From one to the other of two points (2, 3)."""
        start, end = self.flat(ends)
        self.ax.annotate("", end, start, arrowprops=looks | {"color": color})
        self.ax.update_datalim([start, end])

    def frame(self, T: RigidTransform, length: float, names: str = "xyz") -> None:
        """Axes x red, y green, z blue of a frame, by the transform out of it."""
        for axis, name, color in zip(length * np.eye(3), names, AXES_RGB, strict=True):
            self.arrow(T.apply([0 * axis, axis]), color)
            self.name(T.apply(1.15 * axis), name, (0, 0), color)

    def dimension(
        self, ends: ArrayLike, text: str, away: tuple[float, float] = (0, 8)
    ) -> None:
        """The distance of two points (2, 3) as in a drawing of a machine."""
        self.arrow(ends, TRUTH, DIMENSION)
        self.name(np.asarray(ends).mean(axis=0), text, away)

    def box(self, T: RigidTransform, low: ArrayLike, high: ArrayLike, color: str) -> None:
        """A solid box between two corners (3,) of its own frame, metres, the far faces first."""
        at_high = [
            np.insert(UNIT_SQUARE, axis, end, axis=1) for axis in range(3) for end in (0, 1)
        ]
        faces = T.apply(np.where(at_high, high, low))
        for face in sorted(faces, key=lambda face: -self.T_view.apply(face)[:, 2].mean()):
            self.face(face, "white", 1.0, edge=color)
            self.face(face, color, 0.35)


def edge_in_image(
    view: View,
    board: Board,
    T_lrf_board: RigidTransform,
    T_lrf_camera: RigidTransform,
    model: CameraModel,
    depth: float,
) -> dict[str, np.ndarray]:
    """The board, the scan plane with E and F, the camera and its image, figure of equation (20).

    Parameters
    ----------
    view
        In the frame of the LRF, whose scan plane is z = 0.
    board
        With the right angle A in its first corner.
    T_lrf_board, T_lrf_camera
    model
        Of the camera.
    depth
        Distance of the drawn image from the camera's centre, metres.

    Returns
    -------
    dict of str to ndarray, shape (3,)
        Corners A, B, C and the crossings E on AB and F on CA, metres, in the frame of the LRF.
    """
    corners = T_lrf_board.apply(board.points())
    A, B, C = corners
    E = _crossing(A, B)
    F = _crossing(A, C)
    view.face(corners, TRUTH, 0.15)
    view.face(1.25 * np.array([0 * E, E, F]), LRF, 0.12)
    view.line([E, F], color=LRF, linewidth=2)
    rim = np.insert(model.size * (UNIT_SQUARE - 0.5) / model.fx, 2, 1.0, axis=1)
    view.face(T_lrf_camera.apply(depth * rim), LEFT, 0.12)
    view.line([E, T_lrf_camera.translation, F], ":", color=LEFT, linewidth=1)
    points = np.array([A, B, C, E, F])
    rays = T_lrf_camera.inv().apply(points)
    seen = T_lrf_camera.apply(depth * rays / rays[:, 2:])
    a, b, c, e, f = seen
    view.line([e, f], "o", color=LRF, markersize=4)
    for end in (b, c):
        view.line([a, end], color=LEFT, linewidth=1.8)
    return dict(zip("ABCEFabcef", [*points, *seen], strict=True))


def _crossing(a, b):
    """Where the line through two points (3,) meets the plane z = 0."""
    return a + (b - a) * a[2] / (a[2] - b[2])


def image_of_edges(
    ax: Axes,
    points: dict[str, np.ndarray],
    T_camera_lrf: RigidTransform,
    T_guess: RigidTransform,
    model: CameraModel,
) -> dict[str, np.ndarray]:
    """What a camera sees of the edges, and where a guess of its pose puts E and F.

    Parameters
    ----------
    ax
    points
        Of :func:`edge_in_image`.
    T_camera_lrf, T_guess
        The camera that took the image, and the guess.
    model

    Returns
    -------
    dict of str to ndarray, shape (2,)
        Pixels a, b, c; e and f by the guess; and their feet 'e on ab' and 'f on ac'.
    """
    uv = {n.lower(): pinhole(T_camera_lrf.apply(points[n]), model) for n in "ABC"}
    a = uv["a"]
    for name, other, color in (("e", "b", LEFT), ("f", "c", RIGHT)):
        ends = np.array([a, uv[other]])
        along = unit_vector(ends[1] - a)
        place = pinhole(T_guess.apply(points[name.upper()]), model)
        foot = a + (place - a) @ along * along
        uv[name] = place
        uv[f"{name} on a{other}"] = foot
        ax.plot(*ends.T, color=color, label=f"image line a{other}")
        ax.plot(*place, "o", color=LRF, markersize=6)
        ax.annotate("", foot, place, arrowprops=DIMENSION | {"color": TRUTH})
        beside = np.sign(place - foot) * [30, -16]  # v runs downwards
        words = f"{name}, off by\nd({name}, a{other})"
        ax.annotate(words, place, beside, textcoords="offset points", **CENTRED)
    for name in "abc":
        ax.annotate(name, uv[name], (10, 6), textcoords="offset points", **CENTRED)
    to_scale(ax, "u [px]", "v [px]")
    ax.invert_yaxis()
    return uv
