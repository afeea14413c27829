"""A session after preprocessing: what cannot be used."""

from types import SimpleNamespace

import numpy as np
import pytest
from rendered_boards import (
    BLANK,
    MODEL,
    SHEET,
    pixels_of_squares,
    record,
    seen_by,
    surveyed,
)

from lrfcal_lib.calibrate import naming
from lrfcal_lib.model.problem import ProblemKind
from lrfcal_lib.preprocess import survey
from lrfcal_lib.preprocess.board_in_image import (
    BoardView,
)


def test_small_squares_are_a_problem_of_their_camera(monkeypatch):
    pictures = {"left": BLANK, "right": BLANK + 1}
    monkeypatch.setattr(
        survey,
        "PatternFinder",
        lambda pattern: lambda image: pixels_of_squares(12.0 if image.any() else 7.0),
    )
    session = seen_by(
        dict.fromkeys(pictures, MODEL),
        [record(camera, f"{camera}.png", 4) for camera in pictures],
        lambda r: pictures[r.camera],
        SHEET,
    )
    (problem,) = surveyed(session).problems
    assert problem.kind == ProblemKind.SMALL_SQUARES and problem.camera == "left"
    assert "placements 4), 7.0 px at least" in problem.words and str(problem).startswith(
        "camera 'left': squares"
    )


@pytest.mark.parametrize(("side", "named"), [(7.0, True), (12.0, False)])
def test_where_all_cameras_contradict_a_scan_small_squares_are_a_cause(
    monkeypatch, side, named
):
    views = {
        c: {4: BoardView(c, placement=4, pixels=pixels_of_squares(side))}
        for c in ("left", "right")
    }
    data = SimpleNamespace(placements=np.array([4]), select=lambda inliers: None)
    monkeypatch.setattr(naming, "observe", lambda prepared, camera: data)
    monkeypatch.setattr(naming, "find_outlying_placements", lambda obs: ([], {4: 0.02}))
    monkeypatch.setattr(
        naming, "solve_camera", lambda obs, method: SimpleNamespace(transform=None)
    )
    (problem,) = naming.rough_poses(SimpleNamespace(views=views, board=SHEET))[1]
    assert problem.placement == 4 and "another surface" in problem.words
    assert ("or the images: squares below 9 px" in problem.words) == named
