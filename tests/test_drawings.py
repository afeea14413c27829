"""Drawings of the geometry behind the equations: each mark stands where geometry puts it."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgba
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model import board, camera
from lrfcal_lib.plots import drawings

MODEL = camera.CameraModel(1024, 768, 900.0, 900.0, 511.5, 383.5, np.zeros(5))
AHEAD = Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
T_LRF_CAMERA = RigidTransform.from_components([-0.2, 0.1, 0.15], AHEAD)
UPRIGHT = Rotation.from_euler("x", 90, degrees=True) * Rotation.from_euler(
    "z", 225, degrees=True
)
T_LRF_BOARD = RigidTransform.from_components([0.1, 1.2, 0.1], UPRIGHT)


@pytest.fixture
def view():
    """A view from the right, behind and above."""
    fig, ax = plt.subplots()
    yield drawings.View(ax, (1.0, -1.0, 0.8), (0.0, 0.5, 0.0))
    fig.canvas.draw()
    plt.close(fig)


def distance(point, a, b):
    """Of a point from the line through two others."""
    along = (b - a) / np.linalg.norm(b - a)
    return np.linalg.norm(point - a - (point - a) @ along * along)


def test_a_view_is_a_perspective(view):
    line = np.linspace([-0.3, 0.2, 0.1], [0.4, 0.9, -0.2], 7)
    flat = view.flat(line)
    assert max(distance(p, flat[0], flat[-1]) for p in flat) < 1e-12, "lines stay straight"
    (right, _), (_, up) = view.flat([[1, 1, 0], [0, 0.5, 0.1]]) - view.flat([0, 0.5, 0])
    assert right > 0 > up and view.ax.yaxis_inverted(), "z is drawn upwards"
    view.dimension([line[0], line[1]], "far")
    assert view.ax.texts[-1].get_text() == "far"
    np.testing.assert_allclose(view.ax.texts[-1].xy, view.flat(line[:2].mean(axis=0)))


def test_a_box_hides_what_is_behind_it(view):
    view.box(RigidTransform.identity(), [-0.1] * 3, [0.1, 0.1, 0.2], "#0072b2")
    faces = view.ax.patches
    assert len(faces) == 12 and faces[-2].get_facecolor() == to_rgba("white")
    corners = view.flat([[0.1, -0.1, 0.2], [-0.1, 0.1, -0.1]])
    near, far = (
        np.isclose(faces[-1].get_xy(), corner).all(axis=1).any() for corner in corners
    )
    assert near and not far, "the nearest face is drawn last"


def test_the_marks_of_equation_20(view):
    points = drawings.edge_in_image(
        view, board.triangle_board(), T_LRF_BOARD, T_LRF_CAMERA, MODEL, 0.3
    )
    for name, ends in {"E": "AB", "F": "AC"}.items():
        assert abs(points[name][2]) < 1e-12, "a crossing lies in the scan plane"
        assert distance(points[name], *(points[end] for end in ends)) < 1e-12
        seen = distance(points[name.lower()], T_LRF_CAMERA.translation, points[name])
        assert seen < 1e-12, "its image lies on the ray to the camera's centre"
    guess = (
        RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.04, 0.0]))
        * T_LRF_CAMERA.inv()
    )
    uv = drawings.image_of_edges(view.ax, points, T_LRF_CAMERA.inv(), guess, MODEL)
    for name, other in {"e": "b", "f": "c"}.items():
        drawn = np.linalg.norm(uv[name] - uv[f"{name} on a{other}"])
        assert drawn == pytest.approx(distance(uv[name], uv["a"], uv[other])) and drawn > 1
    right = drawings.image_of_edges(
        view.ax, points, T_LRF_CAMERA.inv(), T_LRF_CAMERA.inv(), MODEL
    )
    assert np.linalg.norm(right["e"] - right["e on ab"]) < 1e-9, (
        "without an error no distance"
    )
