"""Straight edges of a scene: an edge of an image, on the plane that the scan shows beside it.

Where beams end at an edge is as wide as their spot. An image sees it to a tenth of a pixel: its
line and the eye of the camera span a plane of sight, which meets the plane of the surface there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.painting import View
from lrfcal_lib.judge.uncertainty import beams_to, carried, chain_of
from lrfcal_lib.measure.features import (
    Feature,
    Kind,
    by_all_unknowns,
)
from lrfcal_lib.model.camera import pinhole
from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.preprocess.edges_in_image import (
    EdgeNotSeen,
    ImageEdge,
    refine_edge,
    sample,
)

SHORTEST_PX = 40.0  # of an edge in an image
HALF_WIDTH_PX = 1.5  # about a detected segment, in which its line is looked for
CLOSE_PX = 5.0  # between two lines that pull each other
PULLED_PX = 0.4  # by how much: edges of a printed rim of 2 px
BESIDE_PX = (2.0, 40.0)  # from the edge: where the points of its surface lie
FEWEST = 30  # points that make a plane beside an edge
LEAST_SHARE = 0.6  # of the points beside an edge that lie on one plane
STEP = 0.03  # metres between two surfaces at an edge: there the nearer one ends
ROUNDS = 4  # of fitting a plane without what lies off it


@dataclass(frozen=True)
class SceneEdge:
    """A straight edge of a scene.

    Attributes
    ----------
    feature : Feature
    ends : ndarray, shape (2, 3)
        Of the stretch that the image shows, metres.
    image : int
        Number of the image.
    """

    feature: Feature
    ends: np.ndarray
    image: int


def edges_of(
    cloud: Cloud,
    surfaces: tuple[list[Feature], np.ndarray],
    views: Sequence[View],
    pitches: Sequence[float],
) -> list[SceneEdge]:
    """All straight edges that images show at the flat surfaces of a cloud.

    Parameters
    ----------
    cloud : Cloud
        Of one station, coloured from these views: an edge is looked for in the image that counts
        most for the points beside it.
    surfaces : tuple
        What :func:`lrfcal_lib.measure.surfaces.planes_of` found.
    views : sequence of View
    pitches : sequence of float
        Of the head at each view, radians.

    Returns
    -------
    list of SceneEdge
    """
    planes, of_point = surfaces
    edges = []
    for view, pitch in zip(views, pitches, strict=True):
        rows = np.flatnonzero(cloud.image == view.number)
        p_camera = view.T_camera_platform.apply(cloud.points[rows])
        seen = _Seen(pinhole(p_camera, view.model), p_camera[:, 2], of_point[rows])
        segments = _segments(view)
        for ends in segments:
            try:
                plane = planes[_surface_at(ends, seen)]
                line = _refined(view, ends, segments)
                edges.append(_on_plane(plane, view, pitch, line))
            except (EdgeNotSeen, DegenerateGeometry):
                continue
    return edges


@dataclass(frozen=True)
class _Seen:
    """What an image sees of a cloud, a row a point: undistorted pixels (n, 2), depth, plane."""

    uv: np.ndarray
    depth: np.ndarray
    plane: np.ndarray


def nearest_edge(edges: Sequence[SceneEdge], place: np.ndarray) -> tuple[int, float]:
    """The number of the edge that passes closest to a place (3,), and how close, metres."""
    if not edges:
        raise DegenerateGeometry("the images show no straight edge on a flat surface")
    first, last = np.moveaxis(np.array([edge.ends for edge in edges]), 1, 0)
    way = last - first
    along = np.vecdot(place - first, way) / np.vecdot(way, way)
    foot = first + np.clip(along, 0, 1)[:, None] * way
    away = np.linalg.norm(foot - place, axis=1)
    nearest = int(np.argmin(away))
    return nearest, float(away[nearest])


def _segments(view):
    """Straight segments (n, 2, 2) of an image, undistorted pixels."""
    model = view.model
    v, u = np.mgrid[: model.height, : model.width].astype(float)
    flat = sample(view.image, model, np.stack([u, v], axis=-1))
    grey = np.nan_to_num(flat).mean(axis=-1).astype(np.uint8)
    lines = cv2.createLineSegmentDetector(scale=1.0).detect(grey)[0]
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


def _surface_at(ends, seen):
    """The number of the surface that ends at a segment (2, 2) of an image, or that it is on."""
    first, last = ends
    length = np.linalg.norm(last - first)
    along = (last - first) / length
    s = (seen.uv - first) @ along
    t = (seen.uv - first) @ [along[1], -along[0]]
    near, far = BESIDE_PX
    beside = (s > 0) & (s < length) & (np.abs(t) > near) & (np.abs(t) < far)
    found = []  # depth, points of the surface, its number
    for side in (1.0, -1.0):
        rows = np.flatnonzero(beside & (side * t > 0))
        numbers, counts = np.unique(seen.plane[rows], return_counts=True)
        if counts.sum() < FEWEST:
            continue
        most = np.argmax(counts)
        plain = numbers[most] >= 0 and counts[most] > LEAST_SHARE * len(rows)
        depth = np.median(seen.depth[rows])
        found.append((depth, counts[most], int(numbers[most]) if plain else -1))
    found.sort()
    if len(found) == 2 and found[1][0] - found[0][0] < STEP:
        found.sort(key=lambda side: -side[1])
    if not found or found[0][2] < 0:
        raise DegenerateGeometry("no flat surface ends at the edge")
    return found[0][2]


def _meet(view, uv, normal, offset):
    """Where the sight through undistorted pixels (..., 2) meets a plane, platform frame."""
    T_platform_camera = view.T_camera_platform.inv()
    rays = np.insert(uv, 2, 1.0, axis=-1) @ np.linalg.inv(view.model.matrix).T
    rays = T_platform_camera.rotation.apply(rays)
    eye = T_platform_camera.translation
    far = (offset - eye @ normal) / (rays @ normal)
    return eye + far[..., None] * rays


def _on_plane(plane: Feature, view: View, pitch: float, line: ImageEdge) -> SceneEdge:
    """The edge of a scene that a line of an image shows on a plane."""
    normal = plane.axis
    ends = _meet(view, line.ends, normal, normal @ plane.centre)
    length = np.linalg.norm(ends[1] - ends[0])
    direction = (ends[1] - ends[0]) / length
    # the plane of sight: what it misses a point by, its gradient, pixels a metre
    R = view.T_camera_platform.rotation.as_matrix()
    depth = view.T_camera_platform.apply(ends)[:, 2]
    sight = line.line @ view.model.matrix / depth[:, None]
    gradient = sight @ R
    across = np.cross(normal, direction)
    way = across / (gradient @ across)[:, None]  # metres a pixel

    # ends by the plane's height and turn, and by the line's offset and turn
    height = np.column_stack([np.ones(2), -(ends - plane.centre)])
    lifted = normal - way * (gradient @ normal)[:, None]
    tangent = np.array([-line.line[1], line.line[0]])
    pixels = np.column_stack([-np.ones(2), (line.ends - line.centre) @ tangent])
    by_noise = np.concatenate(
        [lifted[:, :, None] * height[:, None], -way[:, :, None] * pixels[:, None]], axis=2
    )
    noise = np.zeros((6, 6))
    noise[0, 0] = normal @ plane.noise[:3, :3] @ normal
    noise[1:4, 1:4] = plane.noise[3:, 3:]
    noise[4:, 4:] = line.covariance

    by_noise = _to_line(by_noise, length)
    moved = _moved(ends, plane, view, pitch)
    jacobian = _to_line(
        moved["cloud"] - np.einsum("ki,kj,kju->kiu", way, sight, moved["camera"]), length
    )
    feature = Feature(
        kind=Kind.EDGE,
        centre=ends.mean(axis=0),
        axis=direction,
        noise=by_noise @ noise @ by_noise.T,
        jacobian=jacobian,
        rig=plane.rig,
        placement=plane.placement,
        camera=view.camera,
    )
    return SceneEdge(feature, ends, view.number)


def _to_line(by, length):
    """Derivatives (2, 3, m) of two ends as those of their middle and direction, (6, m)."""
    return np.concatenate([by.mean(axis=0), (by[1] - by[0]) / length])


def _moved(ends, plane, view, pitch):
    """How the unknowns of the rig move beams to ends (2, 3) in the cloud and before a camera."""
    rig = plane.rig
    beams = beams_to(ends, rig.T_head_lrf)
    chain = chain_of(rig)
    R = chain.head[:, :3]
    _, J, by_pitch = carried(chain, *beams)
    by_pitch = by_pitch @ R.T
    turn = beams[1][:, None]
    moved = {"cloud": by_all_unknowns(rig, None, R @ J, by_pitch, turn * by_pitch)}
    chain = chain_of(rig, view.camera)
    _, J, by_pitch = carried(chain, *beams, pitch)
    by_offset = 0 * by_pitch if chain.on_head else by_pitch
    turn = turn - pitch * chain.on_head
    moved["camera"] = by_all_unknowns(rig, view.camera, J, by_offset, turn * by_pitch)
    return moved
