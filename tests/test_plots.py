"""Figures show what they are given: in the right place, in the right colour, with units."""

from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from figure_checks import complaints
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.calibrate.outline import MeasuredBoard
from lrfcal_lib.plots import recording, rig
from lrfcal_lib.session.read import Sweep


@pytest.fixture
def ax():
    """Axes whose figure is drawn after the test."""
    fig, ax = plt.subplots()
    yield ax
    fig.canvas.draw()
    plt.close(fig)


@pytest.fixture
def scan():
    """A board that four of six scan lines cross; one beam did not come back."""
    ranges = np.full((6, 41), 3.0)
    ranges[1:5, 10:30], ranges[0, 0] = 2.0, np.nan
    pitch = np.radians([5.0, 4.0, 3.0, 2.0, 1.0, 0.0])
    sweep = Sweep(4, ranges, np.radians(np.arange(70.0, 111.0)), pitch, np.full(6, np.nan))
    mask = ranges < 2.5
    on_board = np.where(mask, ranges, np.nan)
    return SimpleNamespace(
        placement=4, sweep=sweep, mask=mask, filtered=on_board, fitted=on_board + 0.001
    )


def labels(ax):
    return ax.get_xlabel(), ax.get_ylabel()


def texts(found):
    return [text.get_text() for text in found]


def falls(limits):
    """Whether an axis runs to the left, or downwards."""
    return limits[0] > limits[1]


def test_range_image_is_seen_from_behind_the_sensor(ax, scan):
    recording.range_image(ax, scan.sweep, scan.mask)
    assert falls(ax.get_xlim()), "large bearings are to the left"
    assert labels(ax) == ("bearing [deg]", "pitch [deg]")
    shown = ax.collections[0].get_array().reshape(6, 41)
    np.testing.assert_array_equal(shown[1, 10:30].filled(), scan.sweep.ranges[4, 10:30])
    assert shown.mask[5, 0] and shown.mask.sum() == 1, "what did not come back stays blank"


@pytest.mark.parametrize(("end", "bearing"), [(1, 99.5), (-1, 79.5)])
def test_edge_of_line_marks_the_crossing_of_its_end(ax, scan, end, bearing):
    points = 2.0 * np.array(
        [[np.cos(np.radians(b)), np.sin(np.radians(b)), 0.0] for b in (79.5, 99.5)]
    )
    found = SimpleNamespace(
        points=points, line=np.array([2, 2]), step=np.array([[0, -1], [0, 1]])
    )
    recording.edge_of_line(ax, scan, 2, end, edges={"half_step": found})
    (mark,) = [line for line in ax.lines if line.get_label() == "half step"]
    assert mark.get_xdata()[0] == pytest.approx(bearing)
    with pytest.raises(
        ValueError, match="no beam of scan line 0 is on the board of placement 4"
    ):
        recording.edge_of_line(ax, scan, 0)
    with pytest.raises(ValueError, match="plane must be one of xz, yz, xy, got 'zz'"):
        recording.projection(ax, {}, "zz")


IDENTITY = RigidTransform.identity()


def test_measured_edges_lie_on_the_rendered_corners(ax):
    T = np.eye(4)
    T[:3, 3] = 0.05, 0.05, 2.0
    corners = {
        "ab": np.array([0.0, 0.0]),
        "bc": np.array([0.3, 0.0]),
        "ca": np.array([0.0, 0.4]),
    }
    measured = MeasuredBoard(T, np.zeros((0, 3)), corners, {"bc": 0.499})
    rig.measured_edges(
        ax, measured, {"ab": 0.3, "bc": 0.5, "ca": 0.4}, IDENTITY, (100, 120), 150
    )
    cloud = [measured.corner_point("bc"), measured.corner_point("ca")]
    picture = rig.render(cloud, np.zeros((2, 3)), IDENTITY, (100, 120), 150, splat=0)
    drawn = np.rint(ax.lines[0].get_xydata()).astype(int)
    assert (picture[drawn[:, 1], drawn[:, 0]] == 0).all() and texts(ax.texts) == [
        "BC 499.0 mm\ntrue 500.0 mm"
    ]


@pytest.mark.parametrize("eye", [[0, 0, 1], [0, 0, 5]])
def test_look_at_refuses_an_impossible_view(eye):
    with pytest.raises(ValueError, match="choose another eye or another up"):
        rig.look_at(eye, [0, 0, 1])


FAULTS = {
    "no title": ({"xlabel": "x [m]"}, "no title says what the figure claims"),
    "no unit": ({"xlabel": "length", "title": "t"}, "'length' of the x axis has no unit"),
    "small": ({"xlabel": "x [m]", "title": "t"}, "'tiny' is 5.0 pt in the report"),
    "cut off": ({"xlabel": "x [m]", "title": "far too long " * 20}, "is cut off"),
    "overlap": ({"xlabel": "x [m]", "title": "t", "xticks": [0.5, 0.501]}, "lies over"),
    "scales": (
        {"xlabel": "x [m]", "ylabel": "y [m]", "title": "t"},
        "x [m] and y [m] are drawn at different scales",
    ),
    "none": ({"xlabel": "x [m]", "title": "t"}, ""),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_faults_of_a_figure_are_found(kind):
    looks, told = FAULTS[kind]
    fig, ax = plt.subplots()
    ax.plot([0, 1], [0, 1])
    ax.set(**{"ylabel": "time [s]"} | looks)
    if kind == "small":
        ax.text(0.5, 0.2, "tiny", fontsize=5)
    fig.canvas.draw()
    words = complaints(fig, fig.canvas.get_renderer())
    plt.close(fig)
    assert bool(words) == bool(told) and any(told in word for word in words or [""])


def test_face_on_shows_a_flat_part_square_and_whole():
    x, y = np.mgrid[-0.2:0.2:21j, -0.1:0.1:11j]
    flat = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    turn = Rotation.from_euler("xyz", [100, 15, 20], degrees=True)
    points = turn.apply(flat) + [0.3, 2.0, 0.1]
    view, focal, splat = rig.face_on(points, (300, 400), fill=0.8)
    uv = rig.pixels(view.apply(points), (300, 400), focal)
    assert (uv >= 0).all() and (uv < [400, 300]).all()
    assert max(np.ptp(uv, axis=0) / [400, 300]) == pytest.approx(0.8, abs=1e-6)
    depth = view.apply(points)[:, 2]
    assert np.ptp(depth) < 1e-9 and depth.min() > 0, "seen from its front"
    assert splat >= 1
