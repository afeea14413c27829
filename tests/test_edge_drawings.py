"""Drawings of faces and edges: each mark stands where geometry puts it."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.patches import Circle

from lrfcal_lib.plots import edge_drawings


@pytest.fixture
def ax():
    fig, ax = plt.subplots()
    yield ax
    fig.canvas.draw()
    plt.close(fig)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["away from the camera", "towards it"])
def test_heights_over_the_camera_are_distances_along_the_normal(ax, sign):
    rng = np.random.default_rng(3)
    normal = np.array([0.2, -0.3, 0.9])
    normal /= np.linalg.norm(normal)
    first = np.cross(normal, [1.0, 0.0, 0.0])
    middle = 1.5 * normal + 0.2 * first
    points = middle + rng.normal(0, 0.2, (50, 1)) * np.cross(normal, first)
    points += rng.normal(0, 0.01, (50, 1)) * normal
    origin = np.array([-0.12, 0.1, -0.05])
    edge_drawings.plane_constraint(ax, points, origin, sign * normal, sign * 1.5)
    plane = ax.lines[0].get_ydata()
    drawn = next(line for line in ax.lines if line.get_marker() == ".").get_xydata()
    lrf = next(line for line in ax.lines if line.get_marker() == "o").get_xydata()
    np.testing.assert_allclose(plane, 1.5)
    np.testing.assert_allclose(drawn[:, 1], points @ normal, atol=1e-12)
    np.testing.assert_allclose(lrf[0, 1], origin @ normal, atol=1e-12)


def test_the_spot_that_flips_stands_by_the_bias_outside_the_edge(ax):
    edge_drawings.spot_over_edge(ax, 0.015, 0.006)
    spots = [patch for patch in ax.patches if isinstance(patch, Circle)]
    assert [spot.radius for spot in spots] == [15.0] * 3
    assert sorted(spot.center[0] for spot in spots)[1] == 6.0
    assert 0 in [line.get_xdata()[0] for line in ax.lines if np.ptp(line.get_xdata()) == 0]


def test_readings_stand_at_their_distances_and_the_curve_is_one_half_at_the_bias(ax):
    distance = np.linspace(-0.02, 0.03, 11)
    edge_drawings.reading_by_distance(ax, distance, distance < 0.008, 0.006, 0.002)
    curve, on, beyond = (line.get_xydata() for line in ax.lines[:3])
    assert np.interp(6.0, *curve.T) == pytest.approx(0.5, abs=0.01)
    np.testing.assert_allclose(np.sort([*on[:, 0], *beyond[:, 0]]), 1000 * distance)
    assert set(on[:, 1]) == {1.0} and set(beyond[:, 1]) == {0.0}
