"""A board to print has the size that is stated: its picture is found by the search that recordings go through."""

import cv2
import matplotlib.image
import numpy as np
import pytest

from lrfcal_lib import __main__ as command_line
from lrfcal_lib.plots.sheet import INCH, PAPER, print_sheet, sheet
from lrfcal_lib.preprocess.pattern_in_image import PatternFinder
from lrfcal_lib.session.stated import BoardStated, board_to_json

DPI = 127  # five pixels a millimetre


def test_corners_are_printed_where_the_board_says(tmp_path):
    board = sheet(6, 5, 0.03)
    print_sheet(tmp_path / "board.png", board, dpi=DPI)
    picture = (255 * matplotlib.image.imread(tmp_path / "board.png")[..., 0]).astype(
        np.uint8
    )
    pixels = PatternFinder(board.pattern)(cv2.blur(picture, (3, 3)))
    height = len(picture)
    points = board.pattern.points()[:, :2] + PAPER  # from the lower left corner of the page
    expected = points * DPI / INCH * [1, -1] + [-0.5, height - 0.5]
    apart = np.linalg.norm(pixels[:, None] - expected, axis=-1).min(axis=0)
    assert apart.max() < 0.6, "an eighth of a millimetre"


def test_the_cut_leaves_half_a_square_around_the_pattern():
    board = sheet(6, 5, 0.03)
    margin = board.pattern.outline() - board.known_corners()
    np.testing.assert_allclose(np.abs(margin), 0.015)
    assert BoardStated.model_validate(board_to_json(board)).lengths() == board.lengths()


def test_the_command_writes_a_page_of_its_size_and_says_what_to_state(tmp_path, capsys):
    assert (
        command_line.main(["board", "6", "9", "0.04", "--out", str(tmp_path / "b.pdf")])
        == 0
    )
    width, height = ((side + 2 * PAPER) / INCH * 72 for side in (0.32, 0.44))
    box = f"/MediaBox [ 0 0 {width:.3f}".encode()
    assert box in (tmp_path / "b.pdf").read_bytes() and height > width
    assert '"square_m": 0.04' in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["2", "9", "0.04"], "2: 3 to 50 inner corners are possible"),
        (["6", "9", "40"], "40.0: 0.001 to 1 m are possible"),
        (["6", "9", "0.04", "--out", "board.xyz"], "xyz"),
    ],
)
def test_impossible_boards_are_refused(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    try:
        assert command_line.main(["board", *words]) == 1
    except SystemExit as error:
        assert error.code == 2
    assert said in capsys.readouterr().err and not list(tmp_path.iterdir())
