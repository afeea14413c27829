"""Observations of made-up rigs with known truth, for the tests of the solvers (it shares no code with them)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.camera import CameraModel, board_line_in_image, pinhole, project
from lrfcal_lib.geometry import lrf_to_platform
from lrfcal_lib.preprocess.observations import CameraObservations

CORNERS = np.array([[-0.30, -0.22], [0.32, -0.25], [0.28, 0.24], [-0.33, 0.20]])
EDGES = ("top", "right", "bottom", "left")
PATTERN = np.stack(
    np.broadcast_arrays(np.linspace(-0.18, 0.18, 6), np.linspace(-0.12, 0.12, 5)[:, None], 0.0), axis=-1
).reshape(-1, 3)
TRIANGLE = np.array([[0.0, 0.0], [0.315, 0.0], [0.0, 0.380]])


@dataclass(frozen=True)
class Rig:
    """Truth: ``T_camera_lrf`` (equal to ``T_camera_platform`` at pitch 0), ``T_head_lrf`` and the camera."""

    T_camera_lrf: RigidTransform
    T_head_lrf: RigidTransform
    model: CameraModel


def random_rig(rng, distortion=True):
    """A camera beside the LRF looking the same way, off by some 10 degrees and 20 cm."""
    nominal = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    rotation = Rotation.from_rotvec(rng.normal(0, 0.1, 3)) * nominal
    head = RigidTransform.from_components(
        [0.0, *rng.normal(0, 0.08, 2)], Rotation.from_rotvec([0.0, *rng.normal(0, 0.03, 2)])
    )
    lens = np.array([-0.15, 0.05, 1e-3, -5e-4, -0.01]) * distortion
    model = CameraModel(1280, 960, 900.0, 905.0, 641.0, 478.0, lens)
    return Rig(RigidTransform.from_components(rng.normal(0, 0.15, 3), rotation), head, model)


def random_board_poses(rng, count, rig, spread=0.6):
    """``T_camera_board`` of boards 1.2 to 2.5 m ahead of the LRF that its scan plane cuts through."""
    poses = []
    for _ in range(count):
        turn = Rotation.from_rotvec(rng.uniform(-spread, spread, 3)) * Rotation.from_euler("x", 180, degrees=True)
        centre = np.array([rng.uniform(-0.5, 0.5), rng.uniform(1.2, 2.5), rng.uniform(-0.08, 0.08)])
        centre = rig.T_camera_lrf.apply(centre)
        middle = turn.apply([*CORNERS.mean(axis=0), 0.0])
        poses.append(RigidTransform.from_components(centre - middle, turn))
    return poses


def scan_edge_crossings(T_lrf_board, corners=CORNERS):
    """Points where the plane z = 0 of the LRF crosses the outline, shape (m, 3), and the index of the edge."""
    outline = T_lrf_board.apply(np.column_stack([corners, np.zeros(len(corners))]))
    following = np.roll(outline, -1, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = outline[:, 2] / (outline[:, 2] - following[:, 2])
    hit = (share > 0) & (share < 1)
    return (outline + share[:, None] * (following - outline))[hit] * [1.0, 1.0, 0.0], np.flatnonzero(hit)


def near_lines(rng, count):
    """Rig and observations of single scan lines on small boards 0.4 to 0.9 m away, the camera turned by up to a radian.

    Ranges have 4 mm of noise: a few per cent of a line's length.
    """
    rig, poses, corners = random_rig(rng), [], 0.5 * CORNERS
    turn = Rotation.from_rotvec(rng.uniform(-1, 1, 3))
    T = RigidTransform.from_components(rig.T_camera_lrf.translation, turn * rig.T_camera_lrf.rotation)
    for _ in range(count):
        turn = Rotation.from_rotvec(rng.uniform(-0.35, 0.35, 3)) * Rotation.from_euler("x", 180, degrees=True)
        centre = np.array([rng.uniform(-0.3, 0.3), 1.0, rng.uniform(-0.1, 0.1)]) * rng.uniform(0.4, 0.9)
        middle = turn.apply([*corners.mean(axis=0), 0.0])
        poses.append(RigidTransform.from_components(T.apply(centre) - middle, turn))
    rig = Rig(T, rig.T_head_lrf, rig.model)
    options = {"noise": 1.0, "sigma_range": 0.004, "sigma_across": 1e-3, "pattern": False}
    return rig, camera_observations(rng, rig, poses, corners=corners, **options)


def polar_noise(points, sigma_range, sigma_across):
    """Covariance of points with independent noise along and across the ray from the origin, shape (n, 3, 3)."""
    along = points / np.linalg.norm(points, axis=1, keepdims=True)
    across = np.cross([0.0, 0.0, 1.0], along)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return (
        sigma_range**2 * along[:, :, None] * along[:, None, :]
        + sigma_across**2 * across[:, :, None] * across[:, None, :]
    )


def _draw(rng, points, covariance, noise):
    """Add noise from covariances that may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return points + noise * (root @ rng.normal(size=points.shape + (1,)))[..., 0]


def camera_observations(
    rng,
    rig,
    poses,
    *,
    noise=0.0,
    sigma_range=0.005,
    sigma_across=0.002,
    sigma_line_px=0.3,
    sigma_px=0.2,
    sigma_board=(2e-3, 1e-3),
    source="lrf",
    face=40,
    pattern=True,
    corners=CORNERS,
):
    """What a camera and one scan (``source='lrf'``) or a sweep (``source='platform'``) see of boards.

    `noise` scales errors that are drawn from the stated standard deviations (0: exact observations). Outline corners
    serve as scene points. With a sweep, crossings lie on all edges and face points all over the board.
    """
    model, p = rig.model, len(poses)
    exact = _exact(rng, rig, poses, source, face, corners)
    spread = 1e-3 if source == "platform" else 0.0
    crossing, on_face, scene = (
        _measured(rng, x, noise, sigma_range, sigma_across, s)
        for x, s in zip(exact["points"], (spread, spread, 1e-3), strict=True)
    )
    lines, edges = exact["lines"], exact["edges"]
    lines = lines + np.column_stack([np.zeros((len(lines), 2)), noise * rng.normal(0, sigma_line_px, len(lines))])
    pixels = exact["pixels"] + noise * rng.normal(0, sigma_line_px, exact["pixels"].shape)
    seen = exact["pattern"] + noise * rng.normal(0, sigma_px, exact["pattern"].shape)
    return CameraObservations(
        camera="left",
        source=source,
        model=model,
        crossing_points=crossing[0],
        crossing_covariance=crossing[1],
        crossing_lines=lines,
        crossing_line_sigma=np.full(len(lines), sigma_line_px),
        crossing_placement=exact["placement"][0],
        crossing_edge=np.array(EDGES)[edges],
        crossing_across=np.zeros(len(edges), bool),
        crossing_half_step=crossing[2],
        crossing_noise=crossing[1] - crossing[2][:, :, None] * crossing[2][:, None, :] / 3,
        crossing_radius=np.full(len(edges), 0.02),
        crossing_background=np.zeros(len(edges)),
        plane_points=on_face[0],
        plane_covariance=on_face[1],
        plane_placement=exact["placement"][1],
        placements=np.arange(1, p + 1),
        board_poses=_noisy_poses(rng, poses, noise, sigma_board),
        board_covariance=np.repeat(np.diag(np.repeat(np.square(sigma_board), 3))[None], p, axis=0),
        pattern_points=PATTERN if pattern else np.zeros((0, 3)),
        pattern_pixels=seen if pattern else np.zeros((p, 0, 2)),
        pattern_sigma_px=sigma_px,
        scene_points=scene[0],
        scene_covariance=scene[1],
        scene_pixels=pixels,
        scene_sigma_px=np.full(len(pixels), sigma_line_px),
        scene_placement=exact["placement"][2],
    )


def _measured(rng, points, noise, sigma_range, sigma_across, spread):
    """Points with noise, its covariance (polar, plus `spread` in all directions), and half the beam step behind it."""
    covariance = polar_noise(points, sigma_range, sigma_across) + spread**2 * np.eye(3)
    across = np.cross([0.0, 0.0, 1.0], points)
    half_step = np.sqrt(3) * sigma_across * across / np.linalg.norm(across, axis=1, keepdims=True)
    return _draw(rng, points, covariance, noise), covariance, half_step


def _exact(rng, rig, poses, source, face, outline=CORNERS):
    """Noise-free observations: points (crossings, face, outline corners) with placements, lines, pixels, pattern."""
    lines, corners = _outline_lines(outline), np.column_stack([outline, np.zeros(4)])
    boards = [rig.T_camera_lrf.inv() * pose for pose in poses]
    crossings = [_source_crossings(rng, board, source, outline) for board in boards]
    faces = [_face(rng, b, c[0], source, face) for b, c in zip(boards, crossings, strict=True)]
    groups = [[c[0] for c in crossings], faces, [board.apply(corners) for board in boards]]
    image = [
        board_line_in_image(lines[e], pose, rig.model)
        for pose, (_, edges) in zip(poses, crossings, strict=True)
        for e in edges
    ]
    return {
        "points": [np.concatenate(group) for group in groups],
        "placement": [np.repeat(np.arange(1, len(poses) + 1), [len(x) for x in group]) for group in groups],
        "lines": np.array(image),
        "edges": np.concatenate([edges for _, edges in crossings]),
        "pixels": np.concatenate([pinhole(pose.apply(corners), rig.model) for pose in poses]),
        "pattern": np.array([project(pose.apply(PATTERN), rig.model) for pose in poses]),
    }


def _noisy_poses(rng, poses, noise, sigma_board):
    drawn = noise * rng.normal(size=(len(poses), 6)) * np.repeat(sigma_board, 3)
    noisy = [
        RigidTransform.from_components(p.translation + d[3:], Rotation.from_rotvec(d[:3]) * p.rotation)
        for p, d in zip(poses, drawn, strict=True)
    ]
    return np.array([p.as_matrix() for p in noisy])


def _outline_lines(corners):
    along = np.roll(corners, -1, axis=0) - corners
    normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    return np.column_stack([normal, -np.sum(normal * corners, axis=1)])


def _source_crossings(rng, T_source_board, source, outline):
    """Crossings of one scan line, or points along all four edges for a sweep."""
    if source == "lrf":
        return scan_edge_crossings(T_source_board, outline)
    edges = np.repeat(np.arange(4), 3)
    share = rng.uniform(0.1, 0.9, len(edges))[:, None]
    flat = outline[edges] + share * (np.roll(outline, -1, axis=0)[edges] - outline[edges])
    return T_source_board.apply(np.column_stack([flat, np.zeros(len(flat))])), edges


def _face(rng, T_source_board, crossings, source, count):
    """Points on the board: between the two crossings of a scan line, or anywhere inside for a sweep."""
    if source == "platform":
        flat = rng.uniform(-0.18, 0.18, (count, 2))
        return T_source_board.apply(np.column_stack([flat, np.zeros(count)]))
    if len(crossings) < 2:
        return np.zeros((0, 3))
    share = np.linspace(0.05, 0.95, count)[:, None]
    return crossings[0] + share * (crossings[1] - crossings[0])


def edge_sweeps(
    rng,
    T_head_lrf,
    boards,
    corners,
    *,
    edges=(0, 1),
    count=25,
    noise=0.0,
    sigma_range=0.005,
    sigma_across=0.002,
    face=60,
):
    """Edge and face points of sweeps over boards: LRF points with the pitch at which the scan plane meets them.

    Parameters
    ----------
    boards : list of RigidTransform
        ``T_platform_board``.
    corners : ndarray, shape (k, 2)
    edges : tuple of int
        Which sides serve as edge 1 and edge 2.

    Returns
    -------
    dict of arrays: points, covariance, pitch, placement, edge (1 or 2); face_points, face_pitch, face_placement,
    face_covariance.
    """
    out = {name: [] for name in ("points", "pitch", "placement", "edge", "face_points", "face_pitch", "face_placement")}
    for index, board in enumerate(boards):
        for which, e in enumerate(edges):
            share = np.linspace(0.05, 0.95, count)[:, None]
            flat = corners[e] + share * (np.roll(corners, -1, axis=0)[e] - corners[e])
            points, pitch = meet(board.apply(np.column_stack([flat, np.zeros(count)])), T_head_lrf)
            for name, values in (
                ("points", points),
                ("pitch", pitch),
                ("placement", np.full(count, index + 1)),
                ("edge", np.full(count, which + 1)),
            ):
                out[name].append(values)
        weights = rng.dirichlet(np.ones(len(corners)), face)
        points, pitch = meet(board.apply(np.column_stack([weights @ corners, np.zeros(face)])), T_head_lrf)
        for name, values in (
            ("face_points", points),
            ("face_pitch", pitch),
            ("face_placement", np.full(face, index + 1)),
        ):
            out[name].append(values)
    out = {name: np.concatenate(values) for name, values in out.items()}
    for prefix in ("", "face_"):
        points = out[prefix + "points"]
        covariance = polar_noise(points, sigma_range, sigma_across)
        out[prefix + "points"] = _draw(rng, points, covariance, noise)
        out[prefix + "covariance"] = covariance
    return out


def sweep_boards(rng, count, turn=0.7):
    """``T_platform_board`` of boards 1 to 2 m ahead, turned any way in their plane and up to `turn` out of it."""
    boards = []
    for _ in range(count):
        tip = Rotation.from_rotvec(rng.uniform(-turn, turn, 3)) * Rotation.from_euler("x", 90, degrees=True)
        rotation = tip * Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))
        centre = [rng.uniform(-0.4, 0.4), rng.uniform(1.0, 2.0), rng.uniform(-0.4, 0.4)]
        boards.append(RigidTransform.from_components(centre, rotation))
    return boards


def meet(p_platform, T_head_lrf):
    """LRF points and pitch at which the scan plane passes through platform points (the pitch nearest to 0)."""
    normal, point = T_head_lrf.rotation.apply([0.0, 0.0, 1.0]), T_head_lrf.translation
    y, z, x = p_platform[:, 1], p_platform[:, 2], p_platform[:, 0]
    # n . (Rx(-pitch) p - t) = 0:  a cos(pitch) + b sin(pitch) = c
    a, b, c = normal[1] * y + normal[2] * z, normal[1] * z - normal[2] * y, normal @ point - normal[0] * x
    base, reach = np.arctan2(b, a), np.arccos(np.clip(c / np.hypot(a, b), -1, 1))
    both = np.stack([base + reach, base - reach])
    both = (both + np.pi) % (2 * np.pi) - np.pi
    pitch = np.where(np.abs(both[0]) < np.abs(both[1]), both[0], both[1])
    p_lrf = T_head_lrf.inv().apply(lrf_to_platform(p_platform, -pitch, RigidTransform.identity()))
    return p_lrf * [1.0, 1.0, 0.0], pitch


def bare_observations(model, **given):
    """`CameraObservations` with nothing in it but what is given."""
    shapes = {
        "crossing_points": (0, 3),
        "crossing_covariance": (0, 3, 3),
        "crossing_lines": (0, 3),
        "crossing_line_sigma": (0,),
        "plane_points": (0, 3),
        "plane_covariance": (0, 3, 3),
        "board_poses": (0, 4, 4),
        "board_covariance": (0, 6, 6),
        "pattern_points": (0, 3),
        "scene_points": (0, 3),
        "scene_covariance": (0, 3, 3),
        "scene_pixels": (0, 2),
        "scene_sigma_px": (0,),
    }
    whole = ("crossing_placement", "plane_placement", "placements", "scene_placement")
    empty = {name: np.zeros(shape) for name, shape in shapes.items()} | {name: np.zeros(0, int) for name in whole}
    empty |= {"crossing_edge": np.zeros(0, "<U8"), "crossing_across": np.zeros(0, bool)}
    count = len(given.get("crossing_points", ()))
    empty |= {"crossing_half_step": np.zeros((count, 3)), "crossing_noise": np.zeros((count, 3, 3))}
    empty |= {"crossing_radius": np.full(count, 0.005), "crossing_background": np.zeros(count)}
    pixels = np.zeros((len(given.get("placements", ())), 0, 2))
    common = {"camera": "camera", "source": "lrf", "model": model, "pattern_pixels": pixels, "pattern_sigma_px": 0.2}
    return CameraObservations(**(empty | common | given))
