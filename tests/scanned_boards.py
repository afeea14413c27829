"""Scans of boards made by intersecting rays with planes."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
from matplotlib.path import Path as Polygon
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import Board, triangle_board
from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points
from lrfcal_lib.preprocess.board_in_scan import find_board
from lrfcal_lib.preprocess.edges_in_scan import with_edges
from lrfcal_lib.session.read import Sweep
from lrfcal_lib.session.stated import LrfInfo

HEAD = RigidTransform.from_components(
    [0.02, 0.01, 0.12], Rotation.from_rotvec([0.01, -0.02, 0.03])
)
SQUARE = Board("plate", ("top", "right", "bottom", "left"), np.array([[0, 0], [0.8, 0], [0.8, 0.7], [0, 0.7]]), None,
               ("left", "top"))  # fmt: skip
TRIANGLE = triangle_board()
LRF = LrfInfo("test", (0.0, np.pi), np.radians(0.25), 0.005)


def edge_points(scan, across=False, variant="half_step"):
    """Points where scan lines (or columns) cross the board, and the sides that they see by number."""
    scan = with_edges(scan)
    edges = scan.edges[variant]
    edges = edges[edges.across == across]
    sides = {side.number: side for side in scan.sides if side.across == across}
    columns = {name: edges[name] for name in edges.dtype.names}
    return SimpleNamespace(sides=sides, end=edges.step.sum(axis=1), **columns)


def sweep_edges(scan):
    return edge_points(scan, across=True)


def facing(distance=1.6, roll=8.0, tilt=20.0, centre=(0.4, 0.35), x=0.0):
    """``T_platform_board`` of a board that faces the sensor (its y axis down), turned about two axes."""
    upright = Rotation.from_matrix(np.array([[1, 0, 0], [0, 0, 1.0], [0, -1, 0]]))
    rotation = upright * Rotation.from_euler("ZX", [roll, tilt], degrees=True)
    return RigidTransform.from_components(
        np.array([x, distance, 0.0]) - rotation.apply([*centre, 0]), rotation
    )


@dataclass
class Scene:
    """What one sweep sees; `on` is the truth about every beam."""

    sweep: Sweep
    on: np.ndarray
    pose: RigidTransform
    board: Board

    def edge_errors(self, edges):
        """Distance of the edge points from the nearest true edge (outwards positive), and which edge that is."""
        p = self.pose.inv().apply(lrf_to_platform(edges.points, edges.pitch, HEAD))
        lines = self.board.lines()
        distance = p[:, :2] @ lines[:, :2].T + lines[:, 2]
        nearest = np.abs(distance).argmin(axis=1)
        return distance[np.arange(len(p)), nearest], nearest

    def outwards(self, edges):
        """The same of the points of straight sides alone."""
        return self.edge_errors(edges)[0][edges.side >= 0]

    def worst(self, edges):
        """Largest error of the edge points of straight sides, metres."""
        return np.abs(self.outwards(edges)).max()

    def in_lrf(self, vectors, pitch):
        """Directions given in the board frame as the LRF sees them at a pitch."""
        at_head = Rotation.from_euler("x", -pitch[:, None]).apply(
            self.pose.rotation.apply(vectors)
        )
        return HEAD.rotation.inv().apply(at_head)

    def variance(self, edges):
        """Of edge points across their nearest edge, as their covariance says."""
        edge = self.edge_errors(edges)[1]
        n = self.in_lrf(
            np.column_stack([self.board.lines()[edge, :2], 0 * edges.pitch]), edges.pitch
        )
        return np.einsum("ni,nij,nj->n", n, edges.covariance, n)


def beams_of(sweep):
    """Origins and directions (L, B, 3) of all beams, platform frame."""
    pitch = np.repeat(sweep.pitch[:, None], len(sweep.bearings), axis=1)
    origin = lrf_to_platform(np.zeros(pitch.shape + (3,)), pitch, HEAD)
    return origin, lrf_to_platform(
        polar_to_points(np.ones(pitch.shape), sweep.bearings), pitch, HEAD
    ) - origin


def on_plane(sweep, normal, offset):
    """Ranges (L, B) to a plane ``normal . p = offset``, and the points there."""
    origin, rays = beams_of(sweep)
    with np.errstate(divide="ignore"):
        ranges = (offset - origin @ normal) / (rays @ normal)
    return ranges, origin + ranges[..., None] * rays


def scene(board=SQUARE, pose=None, step=0.25, view=(55, 125), pitch=(-20, 20), pitch_step=0.25, wall=3.5, sigma=0.0,
          seed=0):  # fmt: skip
    """Rays against a board in front of a wall (None: nothing behind it)."""
    pose = facing() if pose is None else pose
    bearings = np.radians(np.arange(view[0], view[1] + step / 2, step))
    pitches = (
        np.radians(np.arange(pitch[0], pitch[1] + 1e-9, pitch_step))
        if np.ndim(pitch)
        else np.radians([pitch])
    )
    sweep = Sweep(
        1,
        np.zeros((len(pitches), len(bearings))),
        bearings,
        pitches,
        np.full(len(pitches), np.nan),
    )
    normal = pose.rotation.apply([0, 0, 1.0])
    ranges, hits = on_plane(sweep, normal, normal @ pose.translation)
    inside = Polygon(board.corners).contains_points(
        pose.inv().apply(hits.reshape(-1, 3))[:, :2]
    )
    on = inside.reshape(ranges.shape) & (ranges > 0)
    behind = np.nan if wall is None else on_plane(sweep, np.array([0.0, 1.0, 0.0]), wall)[0]
    ranges = np.where(on, ranges, behind) + sigma * np.random.default_rng(
        seed
    ).standard_normal(on.shape)
    return spoiled(Scene(sweep, on, pose, board), ranges)


def spoiled(s, ranges):
    return replace(s, sweep=replace(s.sweep, ranges=ranges))


def found(s):
    return find_board(s.sweep, rig_of(s.board))


def rig_of(board, lrf=LRF):
    """What a rig states that is needed to find a board."""
    return SimpleNamespace(board=board, T_head_lrf=HEAD, lrf=lrf)


def noisy_triangle(seed=0, roll=25.0, **options):
    return scene(
        TRIANGLE,
        facing(1.5, roll, 20.0, (0.1, 0.13)),
        seed=seed,
        **({"sigma": 0.01} | options),
    )
