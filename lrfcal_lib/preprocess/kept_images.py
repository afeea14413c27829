"""The part of an image around the board, kept for several passes: decoding costs most."""

from dataclasses import dataclass

import cv2
import numpy as np

from lrfcal_lib.model.board import Board
from lrfcal_lib.preprocess.outline_in_images import FARTHEST

ALONG = 1.0  # beyond the farthest distance at which edges are looked for, squares
ROOM = 0.1  # of the part on each side: the lens bends what is predicted here without it
ROOM_PX = 60  # edges are looked for 40 px beside their prediction


@dataclass(frozen=True)
class Part:
    """The part of an image around the board.

    `shape` is that of the image, `left` and `top` tell where the part begins.
    """

    shape: tuple
    left: int
    top: int
    pixels: np.ndarray

    def image(self) -> np.ndarray:
        """The image, black where nothing of the board can be."""
        height, width = self.pixels.shape[:2]
        image = np.zeros(self.shape, np.uint8)  # the system gives memory where it is written to
        image[self.top : self.top + height, self.left : self.left + width] = self.pixels
        return image


def part_around(image: np.ndarray, corners: np.ndarray, board: Board) -> Part:
    """The part of an image that may be looked at; all of it where that is behind the camera.

    `corners` (k, 2) are those of the pattern of the `board`, in any of its orders, pixels.
    """
    height, width = image.shape[:2]
    grid = board.pattern.points()[:, :2]
    homography = cv2.findHomography(grid, np.asarray(corners, float))[0]
    ends = np.column_stack([_rectangle(grid, board), np.ones(4)]) @ homography.T
    middle = np.append(grid.mean(axis=0), 1.0) @ homography.T
    depth = ends[:, 2] / middle[2]
    if not np.all(depth > 0):
        return Part(image.shape, 0, 0, image)
    uv = ends[:, :2] / ends[:, 2:]
    room = ROOM * np.ptp(uv, axis=0) + ROOM_PX
    left, top = np.clip(uv.min(axis=0) - room, 0, [width, height]).astype(int)
    right, bottom = np.clip(uv.max(axis=0) + room + 1, 0, [width, height]).astype(int)
    return Part(image.shape, left, top, image[top:bottom, left:right].copy())


def _rectangle(grid, board):
    """Corners (4, 2) of a rectangle about the middle of the pattern that holds all of the board.

    It holds the board also where the pattern is turned by 180 deg or mirrored (a square one also on
    its side): which order its corners are found in does not matter.
    """
    middle = grid.mean(axis=0)
    if board.corners is None:
        beyond = (FARTHEST + ALONG) * board.pattern.square
        half = np.ptp(grid, axis=0) / 2 + beyond
    else:
        half = np.max(np.abs(board.points()[:, :2] - middle), axis=0)
    if board.pattern.rows == board.pattern.columns:
        half = np.full(2, np.max(half))
    return middle + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
