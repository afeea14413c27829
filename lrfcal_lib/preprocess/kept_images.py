"""The part of every image around the board, kept while several passes look at it: decoding
costs most.
"""

from mmap import mmap

import cv2
import numpy as np

from lrfcal_lib.preprocess.edges_in_image import FARTHEST

KEPT_BYTES = 800_000_000  # of all images: half of each of 40 with 12 megapixels
ALONG = 1.0  # beyond the farthest distance at which edges are looked for, squares
ROOM = 0.1  # of the part on each side: the lens bends what is predicted here without it
ROOM_PX = 60  # edges are looked for 40 px beside their prediction


class KeptImages:
    """Images of a session, each decoded once where the part around the board finds room.

    The memory is shared with forked processes, so that one may use what another decoded.

    Parameters
    ----------
    read : callable
        ``read(record)`` gives the image, uint8.
    board : Board
        With a pattern.
    """

    def __init__(self, read, board):
        self.read = read
        self.grid, self.rectangle = _grids(board)
        self.slots = {}
        self.shape = None

    def make_room(self, records, image):
        """Reserve room for these records; `image` tells how large theirs are."""
        if not records:
            return
        self.slots = {(r.camera, r.file): i for i, r in enumerate(records)}
        self.shape = image.shape
        self.room = min(image.nbytes, KEPT_BYTES // len(records))
        self.boxes = np.frombuffer(mmap(-1, 16 * len(records)), np.int32).reshape(-1, 4)
        self.memory = np.frombuffer(mmap(-1, max(self.room, 1) * len(records)), np.uint8)

    def keep(self, record, image, corners):
        """Keep the part of an image around the board whose corners (k, 2) were found in it."""
        number = self.slots.get((record.camera, record.file))
        if number is None or image.shape != self.shape:
            return
        left, top, right, bottom = self._around(corners)
        part = image[top:bottom, left:right]
        if not 0 < part.nbytes <= self.room:
            return
        self._memory_of(number, part.shape)[:] = part
        self.boxes[number] = left, top, right, bottom

    def around_board(self, record):
        """The image of a record, black where nothing of the board can be."""
        number = self.slots.get((record.camera, record.file))
        if number is None or not self.boxes[number].any():
            return self.read(record)
        left, top, right, bottom = self.boxes[number]
        image = np.zeros(self.shape, np.uint8)  # the system gives memory where it is written to
        shape = (bottom - top, right - left, *self.shape[2:])
        image[top:bottom, left:right] = self._memory_of(number, shape)
        return image

    def _memory_of(self, number, shape):
        """The room of a record in the shape of its part."""
        start = number * self.room
        return self.memory[start : start + int(np.prod(shape))].reshape(shape)

    def _around(self, corners):
        """Left, top, right and bottom of what may be looked at.

        All of an image where that is behind the camera.
        """
        height, width = self.shape[:2]
        homography = cv2.findHomography(self.grid, np.asarray(corners, float))[0]
        ends = np.column_stack([self.rectangle, np.ones(4)]) @ homography.T
        middle = np.append(self.grid.mean(axis=0), 1.0) @ homography.T
        depth = ends[:, 2] / middle[2]
        if not np.all(depth > 0):
            return 0, 0, width, height
        uv = ends[:, :2] / ends[:, 2:]
        room = ROOM * np.ptp(uv, axis=0) + ROOM_PX
        low = np.clip(uv.min(axis=0) - room, 0, [width, height]).astype(int)
        high = np.clip(uv.max(axis=0) + room + 1, 0, [width, height]).astype(int)
        return *low, *high


def _grids(board):
    """Corners of the pattern (k, 2) on the board, and of a rectangle about its middle that holds
    all of the board.

    It holds the board also where the pattern is turned by 180 deg or mirrored (a square one also on
    its side): which order its corners are found in does not matter.
    """
    grid = board.pattern.points()[:, :2]
    middle = grid.mean(axis=0)
    if board.corners is None:
        beyond = (FARTHEST + ALONG) * board.pattern.square
        half = np.ptp(grid, axis=0) / 2 + beyond
    else:
        half = np.max(np.abs(board.points()[:, :2] - middle), axis=0)
    if board.pattern.rows == board.pattern.columns:
        half = np.full(2, np.max(half))
    return grid, middle + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
