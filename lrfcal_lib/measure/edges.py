"""Straight edges of a scene: an edge of an image, on the plane that the scan shows beside it.

Where beams end at an edge is as wide as their spot. An image sees it to a tenth of a pixel: its
line and the eye of the camera span a plane of sight, which meets the plane of the surface there.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import KDTree

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.painting import View
from lrfcal_lib.measure.features import Feature, Kind, beams_moved
from lrfcal_lib.model.camera import pinhole
from lrfcal_lib.model.geometry import unit_vector
from lrfcal_lib.model.kinematics import beams_to
from lrfcal_lib.preprocess.edges_in_image import EdgeNotSeen, ImageEdge, refine_edge
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
    planes, _ = surfaces
    edges = []
    seen = spread(partial(_lines_on_planes, cloud, surfaces, views), views)
    for view, (numbers, lines) in zip(views, seen, strict=True):
        if lines:
            edges += _on_planes([planes[number] for number in numbers], lines, view)
    return edges


def _lines_on_planes(cloud, surfaces, views, view):
    """The lines of one image at planes of a cloud, and the numbers of these planes."""
    planes, of_point = surfaces
    segments = _segments(view)
    # what one image of a camera sees, all of them see that have it in view
    of_camera = [other.number for other in views if other.camera == view.camera]
    rows = np.flatnonzero(np.isin(cloud.image, of_camera))
    p_camera = view.T_camera_platform.apply(cloud.points[rows])
    uv = pinhole(p_camera, view.model)
    size = view.model.size
    inside = np.flatnonzero((np.abs(uv - size / 2) < size).all(axis=1))
    rows = rows[inside]
    uv = uv[inside]
    beside = _Beside(uv, p_camera[inside, 2], of_point[rows], cloud.image[rows])
    tree = KDTree(uv)
    depths = partial(_depth, view, planes)
    numbers = []
    lines = []
    for ends in segments:
        reach = np.linalg.norm(ends[1] - ends[0]) / 2 + BESIDE_PX[1]
        near = tree.query_ball_point(ends.mean(axis=0), reach, return_sorted=False)
        near = np.array(near, int)
        points = _Beside(*(column[near] for column in beside))
        number = _surface_at(ends, points, depths, view.number)
        if number >= 0:
            with suppress(EdgeNotSeen):
                lines.append(_refined(view, ends, segments))
                numbers.append(number)
    return numbers, lines


class _Beside(NamedTuple):
    """Points that a camera sees, a row each: undistorted pixels of an image, depth, numbers of the
    surface and of the image that counts most.
    """

    uv: np.ndarray
    depth: np.ndarray
    plane: np.ndarray
    image: np.ndarray


def _segments(view):
    """Straight segments (n, 2, 2) of an image, undistorted pixels."""
    grey = view.image
    if grey.ndim == 3:
        grey = cv2.cvtColor(grey, cv2.COLOR_BGR2GRAY)
    flat = cv2.undistort(grey, view.model.matrix, view.model.distortion)
    lines = cv2.createLineSegmentDetector(scale=1.0).detect(flat)[0]
    if lines is None:
        return np.zeros((0, 2, 2))
    ends = lines.reshape(-1, 2, 2).astype(float)
    return ends[np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) >= SHORTEST_PX]


def _refined(view, ends, segments):
    """The line of an image near a segment (2, 2), less certain where another one is beside it."""
    first, last = ends
    normal = np.array([last[1] - first[1], first[0] - last[0]])
    line = refine_edge(view.image, view.model, "", first, last, normal, HALF_WIDTH_PX)
    off = segments - line.centre
    away = np.abs(off @ line.line[:2]).max(axis=1)
    along = off @ [-line.line[1], line.line[0]]
    beside = (along.min(axis=1) < 0) & (along.max(axis=1) > 0) & (away < CLOSE_PX)
    if beside.sum() < 2:
        return line
    covariance = line.covariance + np.diag([PULLED_PX**2, 0.0])
    return replace(line, covariance=covariance)


def _depth(view, planes, number, pixel):
    """How deep in an image a plane is at an undistorted pixel (2,); inf behind it."""
    plane = planes[number]
    T = view.T_camera_platform
    normal = T.rotation.apply(plane.axis)
    depth = normal @ T.apply(plane.centre) / (normal @ view.model.sights(pixel))
    return depth if depth > 0 else np.inf


def _surface_at(ends, points, depths, image):
    """The number of the surface that ends at a segment (2, 2) of an image, or that it is on; -1
    for none.

    Of `points` about it; ``depths(number, pixel)`` are those of surfaces.
    """
    first, last = ends
    length = np.linalg.norm(last - first)
    along = (last - first) / length
    s = (points.uv - first) @ along
    t = (points.uv - first) @ [along[1], -along[0]]
    near, far = BESIDE_PX
    beside = (s > 0) & (s < length) & (np.abs(t) > near) & (np.abs(t) < far)
    # depth, whether it is no flat surface, less the points of it, its number, points of the image
    sides = []
    for side in (1.0, -1.0):
        rows = np.flatnonzero(beside & (side * t > 0))
        if len(rows) < FEWEST:
            continue
        counts = np.bincount(points.plane[rows] + 1)  # of none first
        number = int(np.argmax(counts)) - 1
        if number >= 0 and counts.max() > LEAST_SHARE * len(rows):
            depth = depths(number, (first + last) / 2)
        else:
            number = -1
            depth = np.median(points.depth[rows])
        own = np.sum(points.image[rows] == image)
        sides.append((depth, number < 0, -counts.max(), number, own))
    sides.sort()
    step = STEP if any(side[1] for side in sides) else PLANES_APART
    if len(sides) == 2 and sides[1][0] - sides[0][0] < step:
        sides.sort(key=lambda side: side[1:])
    if not sides or sides[0][-1] < LEAST_OWN:
        return -1
    return sides[0][3]


def _on_planes(
    planes: Sequence[Feature], lines: Sequence[ImageEdge], view: View
) -> list[Feature]:
    """The edges of a scene that k lines of an image show, each on its plane."""
    rig = planes[0].rig
    normal = np.array([plane.axis for plane in planes])
    centre = np.array([plane.centre for plane in planes])
    line = np.array([each.line for each in lines])
    pixels = np.array([each.ends for each in lines])

    ends = _where_seen(view, normal, centre, pixels)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)[:, None]
    direction = (ends[:, 1] - ends[:, 0]) / length

    # the plane of sight: what it misses a point of the camera's frame by, its gradient, pixels a
    # metre
    R = view.T_camera_platform.rotation.as_matrix()
    depth = ends @ R[2] + view.T_camera_platform.translation[2]
    sight = (line @ view.model.matrix)[:, None] / depth[..., None]
    gradient = sight @ R
    across = np.cross(normal, direction)[:, None]
    way = across / np.vecdot(gradient, across)[..., None]  # metres a pixel

    # ends by the plane's height and turn, and by the line's offset and turn
    lifted = normal[:, None] - way * np.vecdot(gradient, normal[:, None])[..., None]
    middle = np.array([each.centre for each in lines])[:, None]
    tangent = np.stack([-line[:, 1], line[:, 0]], axis=-1)[:, None]
    stretch = np.vecdot(pixels - middle, tangent)[..., None, None]
    turned = -lifted[..., None] * (ends - centre[:, None])[..., None, :]
    by = (lifted[..., None], turned, way[..., None], -way[..., None] * stretch)
    by_noise = _of_line(np.concatenate(by, axis=-1), length)

    beams = beams_to(ends, rig.T_head_lrf)
    by_camera = beams_moved(rig, beams, view.camera, view.pitch)
    by_shared = beams_moved(rig, beams)
    by_shared -= way[..., None] * (sight[..., None, :] @ by_camera)
    by_shared[..., -1] = lifted
    jacobian = _of_line(by_shared, length)
    parts = zip(planes, lines, ends, by_noise, jacobian, strict=True)
    return [_edge(*one, view.number) for one in parts]


def _where_seen(view, normal, centre, pixels):
    """Where the sights through pixels (k, 2, 2) meet planes (k, 3), platform frame, (k, 2, 3)."""
    T_platform_camera = view.T_camera_platform.inv()
    rays = view.model.sights(pixels) @ T_platform_camera.rotation.as_matrix().T
    eye = T_platform_camera.translation
    far = np.vecdot(normal, centre - eye)[:, None] / np.vecdot(rays, normal[:, None])
    return eye + far[..., None] * rays


def _edge(plane, line, ends, by_noise, jacobian, number):
    """An edge of a plane between two ends (2, 3), from an image by its number."""
    noise = np.zeros(
        (6, 6)
    )  # of the plane's height and turn, of the line's offset and turn
    noise[0, 0] = plane.axis @ plane.noise[:3, :3] @ plane.axis
    noise[1:4, 1:4] = plane.noise[3:, 3:]
    noise[4:, 4:] = line.covariance
    way = ends[1] - ends[0]
    return replace(
        plane,
        kind=Kind.EDGE,
        centre=ends.mean(axis=0),
        axis=unit_vector(way),
        noise=by_noise @ noise @ by_noise.T,
        jacobian=jacobian,
        ends=ends,
        image=number,
    )


def _of_line(by, length):
    """Derivatives (k, 2, 3, m) of two ends as those of their middle and direction, (k, 6, m)."""
    direction = (by[:, 1] - by[:, 0]) / length[..., None]
    return np.concatenate([by.mean(axis=1), direction], axis=1)
