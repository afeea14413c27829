"""Observations of made-up rigs with known truth, for the tests of the solvers (it shares no code with them)."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import outline_lines
from lrfcal_lib.model.camera import CameraModel, pinhole, project
from lrfcal_lib.model.geometry import polar_to_points
from lrfcal_lib.model.kinematics import beams_to
from lrfcal_lib.model.observations import CameraObservations

CORNERS = np.array([[-0.30, -0.22], [0.32, -0.25], [0.28, 0.24], [-0.33, 0.20]])
EDGES = np.array(["top", "right", "bottom", "left"])
PATTERN = np.stack(
    np.broadcast_arrays(
        np.linspace(-0.18, 0.18, 6), np.linspace(-0.12, 0.12, 5)[:, None], 0.0
    ),
    axis=-1,
).reshape(-1, 3)
TRIANGLE = np.array([[0.0, 0.0], [0.315, 0.0], [0.0, 0.380]])
SIGMA_LINE = 0.3
SIGMA_BOARD = np.repeat([2e-3, 1e-3], 3)


@dataclass(frozen=True)
class Rig:
    """Truth: ``T_camera_lrf`` (equal to ``T_camera_platform`` at pitch 0), ``T_head_lrf`` and the camera."""

    T_camera_lrf: RigidTransform
    T_head_lrf: RigidTransform
    model: CameraModel


def numeric(function, count, step=1e-6):
    """Derivative of a function of increments (count,) about zero, along the last axis."""
    return np.stack(
        [(function(s) - function(-s)) / (2 * step) for s in step * np.eye(count)], axis=-1
    )


def random_rig(rng):
    """A camera beside the LRF looking the same way, off by some 10 degrees and 20 cm."""
    ahead = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    turn = Rotation.from_rotvec(rng.normal(0, 0.1, 3)) * ahead
    lever = [0.0, *rng.normal(0, 0.08, 2)]
    head = RigidTransform.from_components(
        lever, Rotation.from_rotvec([0.0, *rng.normal(0, 0.03, 2)])
    )
    model = CameraModel(
        1280, 960, 900.0, 905.0, 641.0, 478.0, np.array([-0.15, 0.05, 1e-3, -5e-4, -0.01])
    )
    return Rig(RigidTransform.from_components(rng.normal(0, 0.15, 3), turn), head, model)


def random_board_poses(rng, count, rig, spread=0.6):
    """``T_camera_board`` of boards 1.2 to 2.5 m ahead of the LRF that its scan plane cuts through."""
    poses = []
    for _ in range(count):
        turn = Rotation.from_rotvec(rng.uniform(-spread, spread, 3)) * Rotation.from_euler(
            "x", 180, degrees=True
        )
        centre = rig.T_camera_lrf.apply(rng.uniform([-0.5, 1.2, -0.08], [0.5, 2.5, 0.08]))
        poses.append(
            RigidTransform.from_components(
                centre - turn.apply([*CORNERS.mean(axis=0), 0.0]), turn
            )
        )
    return poses


def camera_case(seed, count=12, spread=0.6, **options):
    """A random rig and what its camera sees of boards; options of :func:`camera_observations`."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng)
    return rig, camera_observations(
        rng, rig, random_board_poses(rng, count, rig, spread), **options
    )


def camera_observations(
    rng, rig, poses, *, noise=0.0, sigma_px=0.2, source="lrf", face=40, pattern=True
):
    """What a camera and one scan (``source='lrf'``) or a sweep (``source='platform'``) see of boards.

    `noise` scales errors that are drawn from the stated standard deviations (0: exact observations). Outline corners
    serve as scene points. With a sweep, crossings lie on all edges and face points all over the board.
    """
    model = rig.model
    numbers = np.arange(1, len(poses) + 1)
    flown = 1e-3 if source == "platform" else 0.0
    boards = [rig.T_camera_lrf.inv() * pose for pose in poses]
    crossings, edges = zip(
        *(_crossings(rng, board, source) for board in boards), strict=True
    )
    faces = [
        _face(rng, board, c, source, face)
        for board, c in zip(boards, crossings, strict=True)
    ]
    outlines = [board.apply(flat(CORNERS)) for board in boards]
    given = {}
    for name, group, spread in (
        ("crossing", crossings, flown),
        ("plane", faces, flown),
        ("scene", outlines, 1e-3),
    ):
        points, covariance, _ = measured(rng, np.concatenate(group), noise, spread)
        given |= {f"{name}_points": points, f"{name}_covariance": covariance}
        given[f"{name}_placement"] = np.repeat(numbers, [len(x) for x in group])
    given |= _images(rng, poses, model, edges, noise, sigma_px, pattern)
    off = noise * rng.normal(size=(len(poses), 6)) * SIGMA_BOARD
    known = [
        RigidTransform.from_components(
            pose.translation + d[3:], Rotation.from_rotvec(d[:3]) * pose.rotation
        )
        for pose, d in zip(poses, off, strict=True)
    ]
    given |= {
        "placements": numbers,
        "board_poses": np.array([T.as_matrix() for T in known]),
    }
    covariance = np.repeat(np.diag(SIGMA_BOARD**2)[None], len(poses), axis=0)
    return CameraObservations(
        model, camera="left", source=source, board_covariance=covariance, **given
    )


def _images(rng, poses, model, edges, noise, sigma_px, pattern):
    """Image lines of the edges that were crossed, outline corners, and corners of the pattern."""
    lines = [
        outline_lines(CORNERS)[e]
        @ np.linalg.inv(model.matrix @ T.as_matrix()[:3, [0, 1, 3]])
        for T, e in zip(poses, edges, strict=True)
    ]
    lines = np.concatenate(lines)
    edges = np.concatenate(edges)
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    lines[:, 2] += noise * rng.normal(0, SIGMA_LINE, len(lines))
    outline = np.concatenate([pinhole(pose.apply(flat(CORNERS)), model) for pose in poses])
    outline += noise * rng.normal(0, SIGMA_LINE, outline.shape)
    seen = np.array([project(pose.apply(PATTERN), model) for pose in poses])
    seen += noise * rng.normal(0, sigma_px, seen.shape)
    return {
        "crossing_lines": lines, "crossing_line_sigma": np.full(len(lines), SIGMA_LINE),
        "crossing_edge": EDGES[edges], "crossing_across": np.zeros(len(edges), bool),
        "crossing_radius": np.full(len(edges), 0.02), "scene_pixels": outline,
        "scene_sigma_px": np.full(len(outline), SIGMA_LINE), "pattern_points": PATTERN if pattern else PATTERN[:0],
        "pattern_pixels": seen if pattern else seen[:, :0], "pattern_sigma_px": sigma_px,
    }  # fmt: skip


def _crossings(rng, T_source_board, source):
    """Points where the plane z = 0 of the LRF crosses the outline, or along all edges for a sweep; their edges."""
    if source == "platform":
        edges = np.repeat(np.arange(4), 3)
        return T_source_board.apply(
            on_sides(CORNERS, edges, rng.uniform(0.1, 0.9, len(edges)))
        ), edges
    outline = T_source_board.apply(flat(CORNERS))
    following = np.roll(outline, -1, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = outline[:, 2] / (outline[:, 2] - following[:, 2])
    hit = (share > 0) & (share < 1)
    return (outline + share[:, None] * (following - outline))[hit] * [
        1.0,
        1.0,
        0.0,
    ], np.flatnonzero(hit)


def _face(rng, T_source_board, crossings, source, count):
    """Points on the board: between the two crossings of a scan line, or anywhere inside for a sweep."""
    if source == "platform":
        return T_source_board.apply(flat(rng.uniform(-0.18, 0.18, (count, 2))))
    if len(crossings) < 2:
        return np.zeros((0, 3))
    return crossings[0] + np.linspace(0.05, 0.95, count)[:, None] * (
        crossings[1] - crossings[0]
    )


def measured(rng, points, noise, spread=0.0, sigma_range=0.005, sigma_across=0.002):
    """Points with noise along and across the ray (and `spread` every way), its covariance, and half the beam step."""
    along = points / np.linalg.norm(points, axis=1, keepdims=True)
    across = np.cross([0.0, 0.0, 1.0], along)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    covariance = spread**2 * np.eye(3) + sum(
        sigma**2 * way[:, :, None] * way[:, None, :]
        for sigma, way in ((sigma_range, along), (sigma_across, across))
    )
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    drawn = points + noise * (root @ rng.normal(size=points.shape + (1,)))[..., 0]
    return drawn, covariance, np.sqrt(3) * sigma_across * across


def flat(corners):
    """Points (n, 2) of a board in its frame, shape (n, 3)."""
    return np.column_stack([corners, np.zeros(len(corners))])


def on_sides(corners, edges, share):
    """Points on sides of a board, at a share of their length, in its frame."""
    return flat(
        corners[edges]
        + np.asarray(share)[:, None] * (np.roll(corners, -1, axis=0) - corners)[edges]
    )


def edge_sweeps(rng, T_head_lrf, boards, corners, *, edges=(0, 1), noise=0.0):
    """Edge and face points of sweeps over boards (``T_platform_board``), the settings of PlatformObservations.

    Two sides serve as edge 1 and edge 2; each point comes with the pitch at which the scan plane meets it.
    """
    on_edge = []
    on_face = []
    out = {}
    for placement, board in enumerate(boards, start=1):
        for number, edge in enumerate(edges, start=1):
            points = on_sides(corners, np.full(25, edge), np.linspace(0.05, 0.95, 25))
            on_edge.append((*meet(board.apply(points), T_head_lrf), placement, number))
        inside = flat(rng.dirichlet(np.ones(len(corners)), 60) @ corners)
        on_face.append((*meet(board.apply(inside), T_head_lrf), placement))
    for prefix, parts in (("edge_", on_edge), ("face_", on_face)):
        points, pitch, placement, *number = zip(*parts, strict=True)
        of_point = np.repeat(np.arange(len(parts)), [len(p) for p in points])
        drawn, covariance, _ = measured(rng, np.concatenate(points), noise)
        own = {"points": drawn, "covariance": covariance, "pitch": np.concatenate(pitch)}
        own |= {"placement": np.array(placement)[of_point]}
        out |= {prefix + name: values for name, values in own.items()}
        if number:
            out["edge_number"] = np.array(number[0])[of_point]
    return out


def sweep_boards(rng, count, turn=0.7):
    """``T_platform_board`` of boards 1 to 2 m ahead, turned any way in their plane and up to `turn` out of it."""
    boards = []
    for _ in range(count):
        tip = Rotation.from_rotvec(rng.uniform(-turn, turn, 3)) * Rotation.from_euler(
            "x", 90, degrees=True
        )
        rotation = tip * Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))
        boards.append(
            RigidTransform.from_components(
                rng.uniform([-0.4, 1.0, -0.4], [0.4, 2.0, 0.4]), rotation
            )
        )
    return boards


def meet(p_platform, T_head_lrf):
    """LRF points and pitch at which the scan plane passes through platform points."""
    bearing, pitch, away = beams_to(p_platform, T_head_lrf)
    return polar_to_points(away, bearing), pitch
