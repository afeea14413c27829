"""Edges are drawn in the image they were found in, whatever other images a placement has."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from tiny_sessions import record, rectangle

from lrfcal_lib.plots import recording
from lrfcal_lib.preprocess.prepared import Prepared
from lrfcal_lib.preprocess.survey import prepare_images
from lrfcal_lib.session.read import open_session


@pytest.fixture(scope="module")
def ready(tmp_path_factory):
    """Three images of each camera at every placement; the views are of those in the middle."""
    folder = tmp_path_factory.mktemp("figure7") / "session"
    session = open_session(
        record(folder, rectangle(0.02), 7, placements=3, image_pitch_deg=(-5.0, -2.5, 0.0))
    )
    return prepare_images(Prepared(session, session.board, {}))


def step_across(image, stretch, reach=3.0):
    """Median over a drawn edge of how much brighter one side is than the other, grey values."""
    along = np.gradient(stretch, axis=0)
    normal = (
        np.column_stack([-along[:, 1], along[:, 0]])
        / np.linalg.norm(along, axis=1)[:, None]
    )
    grey = image.mean(axis=2)
    a, b = (
        map_coordinates(grey, (stretch + s * reach * normal)[5:-5, ::-1].T, order=1)
        for s in (1, -1)
    )
    return np.median(np.abs(a - b))


def test_drawn_edges_lie_on_the_edges_of_the_board_in_the_drawn_image(ready):
    steps = []
    for camera, views in ready.views.items():
        for placement in views:
            fig, ax = plt.subplots()
            recording.seen_points(
                ax, *ready.seen(camera, placement), ready.models[camera], {}
            )
            steps += [
                step_across(ax.images[0].get_array(), line.get_xydata())
                for line in ax.lines
            ]
            plt.close(fig)
    assert (
        len(steps) >= 3 * 2 * 3 and min(steps) > 50
    )  # the board is darker than the wall by 90 grey values
