"""Images at one stop of the head: all its cameras share the error of the pitch there."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lrfcal_lib.fit.least_squares import Block

SAME_STOP = np.radians(
    0.001
)  # of recorded pitch angles: platforms record steps of 0.01 deg or so


def same_stop(pitch: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Which images of a placement were taken at one stop.

    Parameters
    ----------
    pitch : ndarray, shape (p, v)
        Recorded, radians.
    used : ndarray of bool, shape (p, v)

    Returns
    -------
    ndarray of bool, shape (p, v, v)
    """
    stop = np.where(used, np.rint(pitch / SAME_STOP), np.nan)  # which is like no other
    return stop[:, :, None] == stop[:, None, :]


@dataclass(frozen=True)
class ViewBlock(Block):
    """Board poses in images (p, 6 v), and the error of the pitch that the images of a stop share.

    The covariance of whitened views of a stop is ``I + sigma^2 g g^T``, of which ``I - h h^T`` with
    h along g is the inverse root: no matrix larger than that of one view is needed.

    Attributes
    ----------
    by_pitch : ndarray, shape (p, v, 6)
        Derivative of the residuals by the pitch of the image; zeros for cameras on the base.
    same : ndarray of bool, shape (p, v, v)
        See :func:`same_stop`.
    sigma_pitch : float
        Standard deviation of the pitch at a stop, radians.
    """

    by_pitch: np.ndarray = None
    same: np.ndarray = None
    sigma_pitch: float = 0.0

    @cached_property
    def white_by_pitch(self):
        """The vectors g (p, v, 6), and the square of the whole one of a view's stop (p, v)."""
        g = np.matvec(self.whitener, self.by_pitch)
        return g, np.matvec(self.same, np.vecdot(g, g))

    def whitened(self, rows):
        """Rows (p, 6 v, k) in independent standard deviations."""
        white = super().whitened(rows)
        if self.sigma_pitch == 0:
            return white
        g, square = self.white_by_pitch
        gain = 1 - 1 / np.sqrt(1 + self.sigma_pitch**2 * square)
        h = np.sqrt(gain / np.maximum(square, 1e-300))[..., None, None] * g[..., None]
        views = white.reshape(*h.shape[:-1], -1)
        common = self.same @ np.sum(h * views, axis=2)
        return (views - h * common[:, :, None]).reshape(white.shape)

    @property
    def log_determinant(self):
        """Of the covariance of whitened views: what the pitch of the stops adds to it."""
        _, square = self.white_by_pitch
        number = np.maximum(self.same.sum(axis=-1), 1)  # every stop counts once
        return np.sum(np.log1p(self.sigma_pitch**2 * square) / number)
