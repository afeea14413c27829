"""A board to print: a chessboard at its true size, with the outline along which it is cut."""

from os import PathLike

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from lrfcal_lib.model.board import UNIT_SQUARE, Board, Chessboard
from lrfcal_lib.plots.recording import squares

BORDER = 0.5  # squares between the chessboard and the cut
PAPER = 0.02  # metres around the cut
RULER = 0.1  # metres, to check the size of the print
INCH = 0.0254


def sheet(columns: int, rows: int, square: float) -> Board:
    """A rectangular board around a chessboard, with its lower left corner in the origin.

    Parameters
    ----------
    columns, rows
        Inner corners along x and y.
    square
        Metres.
    """
    start = (1 + BORDER) * square
    corners = np.add([columns, rows], 1 + 2 * BORDER) * square * UNIT_SQUARE
    pattern = Chessboard(columns, rows, square, (start, start))
    return Board(
        "printed",
        edges=("bottom", "right", "top", "left"),
        corners=corners,
        pattern=pattern,
        features=("bottom", "left"),
    )


def print_sheet(path: str | PathLike, board: Board, dpi: float = 300) -> None:
    """Write a board as one page of its own size.

    Parameters
    ----------
    path
        Its ending decides: ``.pdf``, ``.svg``, or ``.png`` with `dpi`.
    board
        With an outline and a pattern.
    dpi
    """
    corners = board.known_corners()
    low = corners.min(axis=0) - PAPER
    high = corners.max(axis=0) + PAPER
    page = Figure(figsize=(high - low) / INCH)
    ax = page.add_axes((0, 0, 1, 1))
    columns, rows = np.transpose([low, high])
    ax.set(xlim=columns, ylim=rows)
    ax.set_axis_off()
    squares(ax, board.pattern, ListedColormap(["black", "white"]))
    ax.fill(*corners.T, fill=False, edgecolor="black", linewidth=0.5)
    x, y = low + [PAPER, PAPER / 3]
    ax.plot([x, x + RULER], [y, y], "|-", color="black")
    ax.text(
        x + 1.1 * RULER,
        y,
        f"{1000 * RULER:.0f} mm at 100 %; squares of {1000 * board.pattern.square:g} mm",
        fontsize=7,
        va="center",
    )
    page.savefig(path, dpi=dpi)
