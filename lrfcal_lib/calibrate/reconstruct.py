"""Sweeps, images and a calibration make a coloured cloud."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lrfcal_lib.model.camera import project

GREY = np.array([128, 128, 128], np.uint8)  # colour of points that no camera sees
CELL = 4  # pixels, side of a cell of the depth buffer: about the spacing of the projected points
BEHIND = 0.02  # a point this share of its depth behind the nearest one in its cell still counts as the same surface


@dataclass(frozen=True)
class Cloud:
    """Coloured points in the platform frame.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Metres.
    colors : ndarray of uint8, shape (n, 3)
        Red, green, blue; grey where no camera sees the point.
    seen : ndarray of bool, shape (n,)
        Whether any camera sees the point.
    placement : ndarray of int, shape (n,)
    """

    points: np.ndarray
    colors: np.ndarray
    seen: np.ndarray
    placement: np.ndarray

    def __repr__(self):
        share = 100 * self.seen.mean() if len(self.seen) else 0.0
        return (
            f"Cloud({len(self.points)} points of {len(np.unique(self.placement))} placements, {share:.1f} % coloured)"
        )


def visible(uv, depth, width, height):
    """Which points (pixels (n, 2), NaN behind the camera; distances (n,)) lie in the image and behind no other one."""
    with np.errstate(invalid="ignore"):
        inside = np.all((uv >= -0.5) & (uv < [width - 0.5, height - 0.5]), axis=1)
    columns = width // CELL + 1
    index = ((uv[inside] + 0.5) // CELL).astype(int) @ [1, columns]
    nearest = np.full(columns * (height // CELL + 1), np.inf)
    np.minimum.at(nearest, index, depth[inside])
    seen = inside.copy()
    seen[inside] = depth[inside] <= nearest[index] * (1 + BEHIND)
    return seen


def color_points(points, image, T_camera_source, model):
    """Colour points from one image, with the lens distortion and with occlusion.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        In the camera's source frame, metres.
    image : ndarray of uint8, shape (height, width, 3)
        Blue, green, red as OpenCV reads it.
    T_camera_source : RigidTransform
    model : CameraModel

    Returns
    -------
    colors : ndarray of float, shape (n, 3)
        Red, green, blue in 0..255; NaN where the camera does not see the point.
    uv : ndarray, shape (n, 2)
        Pixels the points project to.
    """
    p_camera = T_camera_source.apply(points)
    uv = project(p_camera, model)
    seen = visible(uv, np.linalg.norm(p_camera, axis=1), model.width, model.height)
    colors = np.full((len(points), 3), np.nan)
    if seen.any():
        maps = np.zeros((-(-seen.sum() // 4096) * 4096, 2), np.float32)  # remap wants maps narrower than 32768
        maps[: seen.sum()] = uv[seen]
        u, v = np.ascontiguousarray(maps.reshape(-1, 4096, 2).transpose(2, 0, 1))
        bgr = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).reshape(-1, 3)
        colors[seen] = bgr[: seen.sum(), ::-1]
    return colors, uv


def blend(colors):
    """Mean colours (n, 3) over layers with NaN where a camera does not see a point, and whether any does."""
    stack = np.stack(colors)
    count = np.isfinite(stack[..., 0]).sum(axis=0)
    mean = np.nansum(stack, axis=0) / np.maximum(count, 1)[:, None]
    seen = count > 0
    return np.where(seen[:, None], np.rint(mean), GREY).astype(np.uint8), seen


def join(clouds):
    """One cloud of several."""
    names = ("points", "colors", "seen", "placement")
    return Cloud(*(np.concatenate([getattr(cloud, name) for cloud in clouds]) for name in names))


def write_ply(path, cloud):
    """Write a cloud as a binary coloured PLY. Raises OSError if the file cannot be written."""
    import open3d as o3d

    geometry = o3d.t.geometry.PointCloud(o3d.core.Tensor(cloud.points.astype(np.float32)))
    geometry.point.colors = o3d.core.Tensor(np.ascontiguousarray(cloud.colors))
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    if not o3d.t.io.write_point_cloud(str(path), geometry):
        raise OSError(f"{path}: the cloud could not be written; is the disk full?")
