"""Points take their colours from images: what hides what, and the exposures of the images."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate import colouring
from lrfcal_lib.model.camera import CameraModel, fold, project
from lrfcal_lib.model.geometry import pose_array

SHARE = 1 << 15  # points that a thread takes at a time
WORKERS = min(os.cpu_count() or 1, 8)
LEAST_CELL = 2.0  # pixels of a depth buffer
# levels of grey: between these the exposures of images are compared
DARKEST = 12.0
BRIGHTEST = 230.0
EXPOSURE_ROUNDS = 50
LARGEST_MISS = 0.1  # of the logarithm of a brightness: more is another surface


@dataclass(frozen=True)
class View:
    """An image as it sees the platform frame.

    Attributes
    ----------
    number : int
        What points coloured from it remember.
    camera : str
    T_camera_platform : RigidTransform
    model : CameraModel
    image : ndarray of uint8, shape (height, width, 3)
        Blue, green, red as OpenCV reads it. ValueError if it has another size than the model.
    pitch : float
        Of the head, radians; 0 for a camera on the base.
    """

    number: int
    camera: str
    T_camera_platform: RigidTransform
    model: CameraModel
    image: np.ndarray
    pitch: float = 0.0

    def __post_init__(self):
        height, width = self.image.shape[:2]
        model = self.model
        if (width, height) != (model.width, model.height):
            raise ValueError(
                f"camera '{self.camera}' has {model.width} x {model.height} pixels, its image "
                f"{width} x {height}: intrinsics hold for one image size only"
            )

    @cached_property
    def grey(self) -> np.ndarray:
        """The image in grey, (height, width), float32."""
        return cv2.cvtColor(self.image, cv2.COLOR_BGR2GRAY).astype(np.float32)


class Painter:
    """Colours points from images: first everything that may hide something goes through
    :meth:`hide`.

    Parameters
    ----------
    views : sequence of View
    step : float
        Radians between neighbouring points as the sensor sees them: the resolution at which points
        hide others.
    noise : float
        Metres by which a point may lie behind another one of the same surface.
    """

    def __init__(self, views: Sequence[View], step: float, noise: float):
        self.views = views
        self.exposures = np.zeros((len(views), 2))
        self.eyes = []
        for view, exposure in zip(views, self.exposures, strict=True):
            pose = _single(pose_array(view.T_camera_platform))
            cell = max(LEAST_CELL, 2 * step * view.model.fx)
            rows, columns = (int(n / cell) + 1 for n in view.image.shape[:2])
            self.eyes.append(
                colouring.Eye(
                    pose=pose,
                    centre=-pose[:, :3].T @ pose[:, 3],
                    lens=_single(np.r_[view.model.parameters, fold(view.model)]),
                    image=view.image,
                    cell=cell,
                    nearest=np.full((WORKERS, rows * columns), np.inf, np.float32),
                    noise=noise,
                    exposure=exposure,
                    number=view.number,
                    corner=np.sum(view.model.size**2) / 4,
                )
            )

    def hide(self, points: np.ndarray) -> None:
        """Let points (n, 3) hide what is behind them."""

        def work(rows, worker):
            """Some points, into the depth buffers of one thread."""
            part = _single(points[rows].T)
            for eye in self.eyes:
                colouring.hide(part, eye, worker)

        _share(work, len(points))
        for eye in self.eyes:
            np.min(eye.nearest, axis=0, out=eye.nearest[0])

    def paint(
        self, points: np.ndarray, normals: np.ndarray, only: slice = slice(None)
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colour points.

        Parameters
        ----------
        points, normals : ndarray, shape (n, 3)
            Metres; unit vectors, NaN where unknown.
        only : slice
            Of the views.

        Returns
        -------
        colors : ndarray, shape (n, 3)
            Red, green, blue; NaN where no image sees the point.
        seen : ndarray of bool, shape (n,)
        source : ndarray of int, shape (n,)
            The number of the image that counts most, -1 for none.
        """
        n = len(points)
        colors = np.full((n, 3), np.nan, np.float32)
        source = np.full(n, -1, np.int32)

        def work(rows, _):
            """Some points, seen by all images."""
            part = _single(points[rows].T)
            facing = _single(normals[rows])
            sums = np.zeros((len(facing), 4), np.float32)
            best = np.zeros(len(facing), np.float32)
            for eye in self.eyes[only]:
                colouring.paint(part, facing, eye, sums, best, source[rows])
            weight = sums[:, 3:]
            np.divide(sums[:, 2::-1], weight, out=colors[rows], where=weight > 0)

        _share(work, n)
        return colors, ~np.isnan(colors[:, 0]), source

    def compare_exposures(self, points: np.ndarray, normals: np.ndarray) -> None:
        """Estimate gain and fall-off towards the corners of every image from points that several
        images see.

        The log of a brightness is that of the surface, plus one number an image, plus one for all
        times the squared distance from the principal point. Each is found from what the others
        leave, in turn; the gains are one in the mean.
        """
        if len(self.views) < 2:
            return
        logs = []
        radii = []
        for k, view in enumerate(self.views):
            colors, _, _ = self.paint(points, normals, slice(k, k + 1))
            grey = colors.mean(axis=1)
            known = (grey > DARKEST) & (grey < BRIGHTEST)
            logs.append(np.log(np.where(known, grey, np.nan)))
            model = view.model
            uv = project(view.T_camera_platform.apply(points), model)
            away = np.sum((uv - [model.cx, model.cy]) ** 2, axis=1)
            radii.append(away / self.eyes[k].corner)
        gain, falloff = _compared(np.array(logs, float), np.array(radii))
        self.exposures[:, 0] = gain - gain.mean()
        self.exposures[:, 1] = min(falloff, 0.0)


def _compared(logs, radii):
    """Gain (v,) of images and their common fall-off that bring the logs (v, n) of the same points
    together.

    `radii` (v, n) are squared distances from the middle. What no point compares is zero.
    """
    shared = np.isfinite(logs).sum(axis=0) > 1
    gain = np.zeros(len(logs))
    falloff = 0.0
    logs = logs[:, shared]
    radii = np.where(np.isfinite(logs), radii[:, shared], np.nan)
    apart = np.nan_to_num(radii - np.nanmean(radii, axis=0))
    for _ in range(EXPOSURE_ROUNDS):
        light = logs - gain[:, None] - falloff * radii
        miss = np.nan_to_num(light - np.nanmean(light, axis=0))
        miss = np.clip(miss, -LARGEST_MISS, LARGEST_MISS)
        gain += np.sum(miss, axis=1) / np.maximum(np.isfinite(logs).sum(axis=1), 1)
        falloff += np.sum(miss * apart) / max(np.sum(apart**2), 1e-9)
    return gain, falloff


def _single(array):
    return np.ascontiguousarray(array, np.float32)


def _share(work: Callable, count: int):
    """Call ``work(rows, worker)`` for slices of so many rows, in threads: the compiled loops free
    the interpreter.
    """

    def every_other(worker):
        for start in range(worker * SHARE, count, WORKERS * SHARE):
            work(slice(start, start + SHARE), worker)

    with ThreadPoolExecutor(WORKERS) as pool:
        list(pool.map(every_other, range(WORKERS)))
