"""Parts of images that are kept."""

from types import SimpleNamespace

import numpy as np
from rendered_boards import CORNERS, PATTERN, SHEET, on_board, pose_of, record, render

from lrfcal_lib.model.camera import project
from lrfcal_lib.preprocess import survey
from lrfcal_lib.preprocess.board_in_image import (
    BoardView,
)
from lrfcal_lib.preprocess.kept_images import part_around


def test_an_image_is_decoded_once_and_kept_where_the_board_is():
    pose = pose_of(at=(0.0, 0.0, 2.5))
    picture = render(pose)
    part = part_around(picture, on_board(pose, PATTERN.points()[:, :2], project), SHEET)
    reads = []
    shot = survey.Shot(record("left", "a.png", 3), BoardView(), part)
    image = shot.image(SimpleNamespace(read_image=reads.append))
    assert reads == []
    low = np.floor(on_board(pose, CORNERS, project).min(axis=0)).astype(int) - 40
    high = np.ceil(on_board(pose, CORNERS, project).max(axis=0)).astype(int) + 40
    board = np.s_[max(low[1], 0) : high[1], max(low[0], 0) : high[0]]
    np.testing.assert_array_equal(image[board], picture[board])
    assert np.any(image != picture)  # the rest is not kept
    other = survey.Shot(record("left", "b.png", 4), BoardView())
    session = SimpleNamespace(read_image=lambda r: reads.append(r) or picture)
    assert other.image(session) is picture and reads == [other.record]
