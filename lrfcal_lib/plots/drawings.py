"""Drawings of the geometry behind the equations, seen in perspective and named at the things."""

from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.board import Board
from lrfcal_lib.model.camera import CameraModel, pinhole
from lrfcal_lib.model.geometry import unit_vector
from lrfcal_lib.plots.colors import AXES_RGB, COLORS, closed
from lrfcal_lib.plots.recording import CENTRED, to_scale
from lrfcal_lib.plots.rig import SQUARE, Vector, look_at

# of a box: the axis along which a face lies at the low or at the high end
SIDES = tuple(product(range(3), (0, 1)))
DIMENSION = {
    "arrowstyle": "<|-|>",
    "color": COLORS["truth"],
    "linewidth": 0.9,
    "shrinkA": 0,
    "shrinkB": 0,
}
ARROW = {"arrowstyle": "-|>", "linewidth": 1.8, "shrinkA": 0}
Place = tuple[float, float]


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
        ax.yaxis.set_inverted(True)

    def flat(self, points: ArrayLike) -> np.ndarray:
        """Where points (..., 3), metres, stand on the axes, (..., 2)."""
        seen = self.T_view.apply(np.asarray(points, float))
        return seen[..., :2] / seen[..., 2:]

    def line(self, points: ArrayLike, style: str = "-", **looks: Any) -> None:
        """A line through points (n, 3), metres."""
        self.ax.plot(*self.flat(points).T, style, **looks)

    def face(
        self, corners: np.ndarray, color: str, alpha: float = 0.2, edge: str | None = None
    ) -> None:
        """A flat area with corners (n, 3), metres."""
        flat = self.flat(closed(corners))
        self.ax.fill(*flat.T, facecolor=to_rgba(color, alpha), edgecolor=edge or color)

    def name(
        self,
        point: ArrayLike,
        text: str,
        away: Place = (8, 8),
        color: str = COLORS["truth"],
    ) -> None:
        """A text beside a point (3,), so many printer's points to the right and up."""
        place = self.flat(point)
        self.ax.annotate(
            text, place, away, textcoords="offset points", color=color, **CENTRED
        )

    def arrow(self, ends: ArrayLike, color: str) -> None:
        """From one to the other of two points (2, 3)."""
        start, end = self.flat(ends)
        self.ax.annotate("", end, start, arrowprops=ARROW | {"color": color})
        self.ax.update_datalim([start, end])

    def frame(self, T: RigidTransform, length: float, names: str = "xyz") -> None:
        """Axes x red, y green, z blue of a frame, by the transform out of it."""
        for axis, name, color in zip(np.eye(3), names, AXES_RGB, strict=True):
            ends = T.apply([0 * axis, length * axis])
            self.arrow(ends, color)
            self.name(ends[1] + 0.15 * (ends[1] - ends[0]), name, (0, 0), color)

    def dimension(self, ends: ArrayLike, text: str, away: Place = (0, 8)) -> None:
        """The distance of two points (2, 3) as in a drawing of a machine."""
        start, end = self.flat(ends)
        self.ax.annotate("", end, start, arrowprops=DIMENSION)
        self.name(np.asarray(ends).mean(axis=0), text, away)

    def box(self, T: RigidTransform, low: ArrayLike, high: ArrayLike, color: str) -> None:
        """A solid box between two corners (3,) of its own frame, metres, the far faces first."""
        corners = np.array([low, high])
        faces = []
        for axis, side in SIDES:
            rows = np.insert((SQUARE + 1) // 2, axis, side, axis=1)
            faces.append(T.apply(corners[rows, np.arange(3)]))
        depth = [self.T_view.apply(face)[:, 2].mean() for face in faces]
        for index in np.argsort(depth)[::-1]:
            self.face(faces[index], "white", 1.0, edge=color)
            self.face(faces[index], color, 0.35)


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
    centre = T_lrf_camera.translation
    view.face(corners, COLORS["truth"], 0.15)
    points = dict(zip("ABC", corners, strict=True))
    points["E"] = _crossing(points["A"], points["B"])
    points["F"] = _crossing(points["A"], points["C"])
    fan = np.array([np.zeros(3), *(1.25 * points[name] for name in "EF")])
    view.face(fan, COLORS["lrf"], 0.12)
    view.line([points["E"], points["F"]], color=COLORS["lrf"], linewidth=2)
    half = np.array([model.width, model.height]) / 2
    rim = np.column_stack([SQUARE * half / model.fx, np.ones(4)])
    view.face(T_lrf_camera.apply(depth * rim), COLORS["left"], 0.12)
    view.line([points["E"], centre, points["F"]], ":", color=COLORS["left"], linewidth=1)
    for name, point in list(points.items()):
        towards = T_lrf_camera.inv().apply(point)
        seen = T_lrf_camera.apply(depth * towards / towards[2])
        if name in "EF":
            view.line([seen], "o", color=COLORS["lrf"], markersize=4)
        points[name.lower()] = seen
    for name in "bc":
        view.line([points["a"], points[name]], color=COLORS["left"], linewidth=1.8)
    return points


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
    for name, other, color in (("e", "b", COLORS["left"]), ("f", "c", COLORS["right"])):
        uv[name] = pinhole(T_guess.apply(points[name.upper()]), model)
        ends = np.array([uv["a"], uv[other]])
        along = unit_vector(ends[1] - ends[0])
        foot = ends[0] + (uv[name] - ends[0]) @ along * along
        uv[f"{name} on a{other}"] = foot
        ax.plot(*ends.T, color=color, label=f"image line a{other}")
        ax.plot(*uv[name], "o", color=COLORS["lrf"], markersize=6)
        ax.annotate("", foot, uv[name], arrowprops=DIMENSION)
        beside = np.sign(uv[name] - foot) * [30, -16]  # v runs downwards
        words = f"{name}, off by\nd({name}, a{other})"
        ax.annotate(words, uv[name], beside, textcoords="offset points", **CENTRED)
    for name in "abc":
        ax.annotate(name, uv[name], xytext=(10, 6), textcoords="offset points", **CENTRED)
    to_scale(ax, "u [px]", "v [px]")
    ax.yaxis.set_inverted(True)
    return uv
