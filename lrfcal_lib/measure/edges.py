"""Straight edges of a scene: an edge of an image, on the plane that the scan shows beside it.

Where beams end at an edge is as wide as their spot. An image sees it to a tenth of a pixel: its
line and the eye of the camera span a plane of sight, which meets the plane of the surface there.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from scipy.linalg import block_diag
from scipy.spatial import KDTree

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.painting import View
from lrfcal_lib.measure.features import Feature, Kind, beams_moved
from lrfcal_lib.model.camera import pinhole
from lrfcal_lib.model.geometry import (
    length_of,
    pose_array,
    unit_vector,
)
from lrfcal_lib.model.kinematics import beams_to
from lrfcal_lib.preprocess.edges_in_image import EdgeNotSeen, refine_edge
from lrfcal_lib.session.workers import spread

SHORTEST_PX = 40.0  # of an edge in an image
HALF_WIDTH_PX = 1.5  # about a detected segment, in which its line is looked for
CLOSE_PX = 5.0  # between two lines that pull each other
PULLED_PX = 0.4  # by how much: edges of a printed rim of 2 px
BESIDE_PX = (2.0, 40.0)  # from the edge: where the points of its surface lie
FEWEST = 30  # points that make a plane beside an edge
LEAST_OWN = 10  # of them for which the image counts most
LEAST_SHARE = 0.6  # of the points beside an edge that lie on one plane
STEP = 0.03  # metres between two surfaces at an edge: there the nearer one ends
PLANES_APART = 0.005  # the same of two planes, which are better known


def edges_of(
    cloud: Cloud,
    surfaces: tuple[list[Feature], np.ndarray],
    views: Sequence[View],
) -> list[Feature]:
    """All straight edges that images show at the flat surfaces of a cloud.

    Parameters
    ----------
    cloud : Cloud
        Of one station, coloured from these views: an edge is looked for in the image that counts
        most for the points beside it.
    surfaces : tuple
        What :func:`lrfcal_lib.measure.surfaces.planes_of` found.
    views : sequence of View

    Returns
    -------
    list of Feature
    """
    return sum(spread(partial(_edges_in, cloud, surfaces, views), views), [])


def _edges_in(cloud, surfaces, views, view):
    """The edges at planes of a cloud that one image shows."""
    planes, of_point = surfaces
    segments = _segments(view)
    pose = pose_array(view.T_camera_platform.inv())
    # what one image of a camera sees, all of them see that have it in view
    of_camera = [other.number for other in views if other.camera == view.camera]
    p_camera = view.T_camera_platform.apply(cloud.points)
    uv = pinhole(p_camera, view.model)
    about_image = view.model.shows(uv, -view.model.width / 2)
    near = about_image & np.isin(cloud.image, of_camera)
    points = np.column_stack([uv, p_camera[:, 2], of_point, cloud.image])[near]
    reach = length_of(np.ptp(segments, axis=1)) / 2 + BESIDE_PX[1]
    about = KDTree(points[:, :2]).query_ball_point(segments.mean(axis=1), reach)
    bounds = []
    for ends, rows in zip(segments, about, strict=True):
        plane = _surface_at(ends, points[rows], planes, view, pose)
        if plane is not None:
            with suppress(EdgeNotSeen):
                bounds.append((plane, _refined(view, ends, segments)))
    return _on_planes(bounds, view, pose)


def _segments(view):
    """Straight segments (n, 2, 2) of an image, undistorted pixels."""
    grey = view.grey.astype(np.uint8)
    flat = cv2.undistort(grey, view.model.matrix, view.model.distortion)
    lines = cv2.createLineSegmentDetector(scale=1.0).detect(flat)[0]
    if lines is None:
        lines = []
    ends = np.reshape(lines, (-1, 2, 2)).astype(float)
    return ends[length_of(np.ptp(ends, axis=1)) >= SHORTEST_PX]


def _refined(view, ends, segments):
    """The line of an image near a segment (2, 2), less certain where another one is beside it."""
    first, last = ends
    normal = (last - first)[::-1] * [1, -1]
    line = refine_edge(view.image, view.model, "", first, last, normal, HALF_WIDTH_PX)
    off = segments - line.centre
    away = np.abs(off @ line.line[:2]).max(axis=1)
    along = off @ [-line.line[1], line.line[0]]
    beside = (along.min(axis=1) < 0) & (along.max(axis=1) > 0) & (away < CLOSE_PX)
    if beside.sum() < 2:
        return line
    return replace(line, covariance=line.covariance + np.diag([PULLED_PX**2, 0.0]))


def _surface_at(ends, points, planes, view, pose):
    """The surface that ends at a segment (2, 2) of an image, or that it is on; None for none.

    Of points (n, 5) about it: undistorted pixels of the image, depth, numbers of the surface and of
    the image that counts most.
    """
    first, last = ends
    length = length_of(last - first)
    along = (last - first) / length
    off = points[:, :2] - first
    s = off @ along
    t = off @ [along[1], -along[0]]
    near, far = BESIDE_PX
    # depth, whether it is no flat surface, less the points of it, its number, those of the image
    sides = []
    for away in (t, -t):
        beside = (s > 0) & (s < length) & (away > near) & (away < far)
        depths, surface, image = points[beside, 2:].T
        if len(depths) < FEWEST:
            continue
        counts = np.bincount(surface.astype(int) + 1)  # of none first
        number = np.argmax(counts) - 1
        depth = np.median(depths)
        rough = number < 0 or counts.max() <= LEAST_SHARE * len(depths)
        if not rough:
            _, (depth,) = _where_seen(view, pose, planes[number], ends.mean(axis=0)[None])
            depth = depth if depth > 0 else np.inf  # behind the camera
        own = np.sum(image == view.number)
        sides.append((depth, rough, -counts.max(), number, own))
    if not sides:
        return None
    step = STEP if any(side[1] for side in sides) else PLANES_APART
    reach = min(sides)[0] + step
    nearest = [side for side in sides if side[0] <= reach]
    _, rough, _, number, own = min(nearest, key=lambda side: side[1:])
    return None if rough or own < LEAST_OWN else planes[number]


def _where_seen(view, pose, plane, pixels):
    """Where the sights through undistorted pixels (k, 2) of a camera with this pose (3, 4) in the
    platform meet a plane: places (k, 3), platform frame, and how deep these are (k,), metres.
    """
    rays = view.model.sights(pixels) @ pose[:, :3].T
    eye = pose[:, 3]
    depth = plane.axis @ (plane.centre - eye) / (rays @ plane.axis)
    return eye + depth[:, None] * rays, depth


def _on_planes(bounds, view, pose):
    """The edges of a scene that lines of an image show, each on its plane."""
    if not bounds:
        return []
    rig = bounds[0][0].rig
    ends = [_where_seen(view, pose, plane, line.ends)[0] for plane, line in bounds]
    beams = beams_to(ends, rig.T_head_lrf)
    of_image = beams_moved(rig, beams, view.camera, view.pitch)
    of_scan = beams_moved(rig, beams)
    return [
        _on_plane(plane, line, view, pose, by_image, by_scan)
        for (plane, line), by_image, by_scan in zip(bounds, of_image, of_scan, strict=True)
    ]


def _on_plane(plane, line, view, pose, of_image, of_scan):
    """One of them; what moves its ends, in the image and in the scan, is known."""
    ends, depth = _where_seen(view, pose, plane, line.ends)
    way = ends[1] - ends[0]
    direction = unit_vector(way)

    # the plane of sight: what it misses a point of the camera's frame by, its gradient, pixels a
    # metre
    sight = line.line @ view.model.matrix / depth[:, None]
    gradient = sight @ pose[:, :3].T
    # metres a metre of the plane's height and metres a pixel, not along the edge
    across = np.linalg.inv([[plane.axis, row, direction] for row in gradient])
    by_height, by_offset, _ = np.moveaxis(across, -1, 0)

    # ends by the plane's centre and axis, and by the line's offset and turn
    by_plane = by_height[..., None] * plane.height_by(ends)[:, None]
    stretch = (line.ends - line.centre) @ [-line.line[1], line.line[0]]
    by_line = -by_offset * stretch[:, None]
    by_noise = np.dstack([by_plane, by_offset, by_line])
    noise = block_diag(plane.noise, line.covariance)

    by_sight = sight[:, None] @ of_image
    by_shared = of_scan - by_offset[..., None] * by_sight
    by_shared[..., -1] = by_height

    # from both ends to middle and direction
    length = length_of(way)
    of_line = np.kron([[0.5, 0.5], [-1 / length, 1 / length]], np.eye(3))
    by_noise = of_line @ by_noise.reshape(6, -1)
    return replace(
        plane,
        kind=Kind.EDGE,
        centre=ends.mean(axis=0),
        axis=direction,
        noise=by_noise @ noise @ by_noise.T,
        jacobian=of_line @ by_shared.reshape(6, -1),
        ends=ends,
        image=view.number,
    )
