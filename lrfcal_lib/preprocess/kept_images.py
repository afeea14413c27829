"""The part of an image around the board, kept for several passes: decoding costs most."""

from dataclasses import dataclass

import numpy as np

from lrfcal_lib.preprocess.outline_in_images import FARTHEST
from lrfcal_lib.preprocess.pattern_in_image import around, square_axes

ALONG = 1.0  # beyond the farthest distance at which edges are looked for, squares
# times as large as the largest square of the pattern: what is nearer to the camera
NEARER = 2.0
ROOM_PX = 60  # edges are looked for 40 px beside their prediction


@dataclass(frozen=True)
class Part:
    """The part of an image around the board.

    `shape` is that of the image, `place` are the rows and columns of the part.
    """

    shape: tuple
    place: tuple[slice, slice]
    pixels: np.ndarray

    def image(self) -> np.ndarray:
        """The image, black where nothing of the board can be."""
        image = np.zeros(self.shape, np.uint8)
        image[self.place] = self.pixels
        return image


def part_around(image: np.ndarray, corners: np.ndarray, board) -> Part:
    """The part of an image that may be looked at.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    corners : ndarray, shape (k, 2)
        Of the pattern, in any of its orders, pixels.
    board : Board
        With a pattern.

    Returns
    -------
    Part
    """
    pattern = board.pattern
    beyond = FARTHEST + ALONG  # squares
    if board.corners is not None:
        printed = pattern.points()[:, :2]
        before = printed.min(axis=0) - board.corners
        behind = board.corners - printed.max(axis=0)
        beyond = np.maximum(before, behind).max() / pattern.square
    grid = pattern.grid(corners)
    sides = np.linalg.norm(square_axes(grid), axis=-2)
    _, place = around(grid, NEARER * beyond * sides.max() + ROOM_PX)
    return Part(image.shape, place, image[place].copy())
