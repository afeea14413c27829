"""Sweeps, images and a calibration make a coloured cloud; the edges of the board are measured in it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lrfcal_lib.model.board import corners_of_lines
from lrfcal_lib.model.camera import project
from lrfcal_lib.model.geometry import fit_line, fit_plane, hat

UNSEEN = np.array([128, 128, 128], np.uint8)  # colour of points that no camera sees


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


def visible(uv, depth, width, height, *, cell=4, tolerance=0.02):
    """Which points a camera sees: inside the image and not behind another point.

    Parameters
    ----------
    uv : ndarray, shape (n, 2)
        Pixels; NaN behind the camera.
    depth : ndarray, shape (n,)
        Distance from the camera, metres.
    width, height : int
        Image size, pixels.
    cell : int
        Side of a cell of the depth buffer, pixels: about the spacing of the projected points.
    tolerance : float
        A point this share of its depth behind the nearest one in its cell still counts as the same surface.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    inside = np.isfinite(uv).all(axis=1)
    inside &= (np.nan_to_num(uv, nan=-9.0) >= -0.5).all(axis=1)
    inside &= (np.nan_to_num(uv, nan=1e9) < [width - 0.5, height - 0.5]).all(axis=1)
    columns = width // cell + 1
    index = ((uv[inside] + 0.5) // cell).astype(int) @ [1, columns]
    nearest = np.full(columns * (height // cell + 1), np.inf)
    np.minimum.at(nearest, index, depth[inside])
    seen = inside.copy()
    seen[inside] = depth[inside] <= nearest[index] * (1 + tolerance)
    return seen


def color_points(points, image, T_camera_source, model, **options):
    """Colour points from one image, with the lens distortion and with occlusion.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        In the camera's source frame, metres.
    image : ndarray of uint8, shape (height, width, 3)
        Blue, green, red as OpenCV reads it.
    T_camera_source : RigidTransform
    model : CameraModel
    **options
        Passed to :func:`visible`.

    Returns
    -------
    colors : ndarray of float, shape (n, 3)
        Red, green, blue in 0..255; NaN where the camera does not see the point.
    uv : ndarray, shape (n, 2)
        Pixels the points project to.
    """
    p_camera = T_camera_source.apply(points)
    uv = project(p_camera, model)
    seen = visible(uv, np.linalg.norm(p_camera, axis=1), model.width, model.height, **options)
    colors = np.full((len(points), 3), np.nan)
    colors[seen] = sample(image, uv[seen])[:, ::-1]
    return colors, uv


def sample(image, uv):
    """Bilinear pixel values at sub-pixel positions, shape (n, channels)."""
    if len(uv) == 0:
        return np.zeros((0, image.shape[2]))
    rows = -(-len(uv) // 4096)  # remap wants maps narrower than 32768
    maps = np.zeros((rows * 4096, 2), np.float32)
    maps[: len(uv)] = uv
    maps = maps.reshape(rows, 4096, 2)
    out = cv2.remap(image, maps[..., 0].copy(), maps[..., 1].copy(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out.reshape(rows * 4096, -1)[: len(uv)].astype(float)


def blend(colors):
    """Mean colour of all cameras that see a point.

    Parameters
    ----------
    colors : sequence of ndarray, shape (n, 3)
        NaN where a camera does not see the point.

    Returns
    -------
    colors : ndarray of uint8, shape (n, 3)
    seen : ndarray of bool, shape (n,)
    """
    stack = np.stack(colors)
    count = np.isfinite(stack[..., 0]).sum(axis=0)
    mean = np.nansum(stack, axis=0) / np.maximum(count, 1)[:, None]
    seen = count > 0
    return np.where(seen[:, None], np.rint(mean), UNSEEN).astype(np.uint8), seen


def join(clouds):
    """One cloud of several."""
    return Cloud(
        *(np.concatenate([getattr(c, name) for c in clouds]) for name in ("points", "colors", "seen", "placement"))
    )


def write_ply(path, cloud):
    """Write a cloud as a binary coloured PLY.

    Parameters
    ----------
    path : path-like
    cloud : Cloud

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    import open3d as o3d

    geometry = o3d.t.geometry.PointCloud(o3d.core.Tensor(cloud.points.astype(np.float32)))
    geometry.point.colors = o3d.core.Tensor(np.ascontiguousarray(cloud.colors))
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    if not o3d.t.io.write_point_cloud(str(path), geometry):
        raise OSError(f"{path}: the cloud could not be written; is the disk full?")


@dataclass(frozen=True)
class MeasuredBoard:
    """The outline of the board as the cloud shows it.

    Attributes
    ----------
    T_source_plane : ndarray, shape (4, 4)
        Pose of the fitted plane; its z axis is the normal.
    lines : dict of str to ndarray, shape (3,)
        Sides in plane coordinates, ``a x + b y + c = 0``, metres.
    corners : dict of str to ndarray, shape (2,)
        Where an edge starts (it meets the edge before it), by the name of the edge.
    lengths : dict of str to float
        Metres; only edges of which both ends are measured.
    """

    T_source_plane: np.ndarray
    lines: dict
    corners: dict
    lengths: dict

    def corner_point(self, name):
        """The corner where an edge starts, shape (3,), in the frame of the cloud."""
        return self.T_source_plane[:3, 3] + self.T_source_plane[:3, :2] @ self.corners[name]


def plane_frame(points):
    """A frame in the plane of some points, shape (4, 4): origin in their centre, z along the normal."""
    normal, distance, _ = fit_plane(points)
    across = np.linalg.svd(hat(normal))[2][0]
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = across, np.cross(normal, across), normal
    centre = np.nanmean(points, axis=0)
    pose[:3, 3] = centre - normal * (normal @ centre - distance)
    return pose


def measure_board(face, sides, edges):
    """Measure a board's outline in a cloud: plane through the face, lines through its sides, corners where they meet.

    Parameters
    ----------
    face : ndarray, shape (n, 3)
        Points on the face, metres.
    sides : dict of str to ndarray, shape (k, 3)
        Edge points by edge name, same frame.
    edges : tuple of str
        All edges of the board in order around it.

    Returns
    -------
    MeasuredBoard
    """
    pose = plane_frame(face)
    lines = {}
    for name, points in sides.items():
        flat = (points - pose[:3, 3]) @ pose[:3, :2]
        centre, direction, _ = fit_line(np.column_stack([flat, np.zeros(len(flat))]))
        normal = np.array([direction[1], -direction[0]])
        lines[name] = np.r_[normal, -normal @ centre[:2]]
    before = dict(zip(edges, edges[-1:] + edges[:-1], strict=True))
    after = dict(zip(edges, edges[1:] + edges[:1], strict=True))
    corners = {
        name: _meet(lines[before[name]], lines[name]) for name in edges if name in lines and before[name] in lines
    }
    lengths = {
        name: float(np.linalg.norm(corners[after[name]] - corners[name]))
        for name in edges
        if name in corners and after[name] in corners
    }
    return MeasuredBoard(pose, lines, corners, lengths)


def _meet(first, second):
    return corners_of_lines(np.stack([first, second]))[1]
