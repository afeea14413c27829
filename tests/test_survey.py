"""All images of a session: turns, the outline that nobody measured, what cannot work."""

from dataclasses import replace

import numpy as np
import pytest
from rendered_boards import (
    BLANK,
    CORNERS,
    MODEL,
    SHEET,
    TRIANGLE,
    UNKNOWN,
    clutter,
    record,
    render,
    seen_by,
    turned,
    view_poses,
)
from rendered_boards import (
    surveyed as survey,
)
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.preprocess.outline_in_images import measure_outline


@pytest.fixture(scope="module")
def session():
    """Two cameras, seven placements; in every third image the board stands on its head."""
    poses = {}
    half = Rotation.from_euler("z", np.pi)
    for i, pose in enumerate(view_poses(7, seed=11)):
        turn = RigidTransform.from_components(
            pose.apply([0.25, 0.15, 0.0]), pose.rotation * half
        )
        poses["left", i] = turn if i % 3 == 2 else pose
        poses["right", i] = (
            RigidTransform.from_translation([-0.05, 0.0, 0.0]) * poses["left", i]
        )
    pictures = {
        key: render(pose, background=clutter(50 + key[1]), seed=key[1])
        for key, pose in poses.items()
    }
    records = [record(camera, f"/s/{camera}/{i}.png", i, 0.1 * i) for camera, i in poses]
    return poses, records, lambda r: pictures.get((r.camera, r.placement), BLANK)


@pytest.fixture(scope="module")
def surveyed(session):
    _, records, read = session
    models = {"left": MODEL, "right": MODEL}
    return survey(seen_by(models, records, read, UNKNOWN))


def test_survey_measures_the_outline_and_turns_all_views_alike(session, surveyed):
    # the truth up to a turn of the whole board, which nothing can tell
    views = [v for group in surveyed.views.values() for v in group.values()]
    over = {turned(v.T_camera_board, session[0][v.camera, v.placement]) > 1 for v in views}
    assert len(over) == 1 and {len(group) for group in surveyed.views.values()} == {7}
    truth = np.roll(np.array([0.25, 0.15]) - CORNERS, -2, axis=0) if over.pop() else CORNERS
    outline = surveyed.outline
    expected = replace(SHEET, corners=truth).lengths()
    np.testing.assert_allclose(surveyed.board.corners, truth, atol=8e-4)
    assert np.all(outline.line_sd < 0.002)
    for name, length in outline.board.lengths().items():
        assert (
            length == pytest.approx(expected[name], abs=0.001)
            and outline.length_sd[name] < 0.003
        )
    alone = measure_outline([surveyed.views["left"][0]], UNKNOWN, surveyed.models)
    assert np.isnan([*alone.line_sd, *alone.length_sd.values()]).all()


def test_surveys_that_cannot_work(session, surveyed):
    _, records, read = session
    both = {"left": MODEL, "right": MODEL}
    triple = replace(UNKNOWN, edges=("a", "b", "c"))
    for count, see, board, models, message in (
        (
            2,
            read,
            UNKNOWN,
            {"left": None},
            "camera 'left': intrinsics need at least three views",
        ),
        (
            14,
            read,
            TRIANGLE,
            {"left": None},
            "no intrinsics and board 'triangle' no pattern",
        ),
        (0, read, SHEET, {"left": None}, "camera 'left': intrinsics need .*, got 0"),
        (2, read, triple, {"left": MODEL}, "has 3 edges and no known corners"),
        (2, lambda r: BLANK, UNKNOWN, both, "none of 2 images shows the pattern"),
    ):
        with pytest.raises(ValueError, match=message):
            own = [each for each in records[:count] if each.camera in models]
            survey(seen_by(models, own, see, board))
    views = [
        replace(v, edges=v.edges[:1])
        for group in surveyed.views.values()
        for v in group.values()
    ]
    with pytest.raises(
        ValueError, match="edge '.*' of board 'sheet' was found in none of 14 images"
    ):
        measure_outline(views, UNKNOWN, surveyed.models)


def test_real_cameras_edges_and_outline(lms400):
    found = lms400.prepared
    for camera, model in found.models.items():
        assert model.rms_px < 0.32, camera
    for name, length in found.board.lengths().items():
        assert length == pytest.approx(0.858, abs=0.004), name
        assert found.outline.length_sd[name] < 0.007
    assert np.all(found.outline.line_sd < 0.0035)
