"""Where the board is put: pairs of near-perpendicular poses that the LRF and both cameras see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

MOST_TRIES = 4000
PITCH_GRID = np.radians(np.arange(-30.0, 30.1, 0.5))  # pitch angles at which an image may be taken
OUTSIDE = np.radians(2.0)  # a sweep begins and ends this far outside the board
LEAST_SPAN = np.radians(4.0)  # of the pitch angles at which all cameras see the board
FACING = Rotation.from_matrix([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # board axes of a board that faces the rig, upright


@dataclass(frozen=True)
class Placement:
    """The board at one place, and what is recorded of it.

    Attributes
    ----------
    number : int
    T_platform_board : RigidTransform
    sweep : tuple of float
        Pitch commands of the first and the last scan line, radians.
    image_pitch : tuple of float
        Pitch commands of the images in the order in which they are taken, radians.
    """

    number: int
    T_platform_board: RigidTransform
    sweep: tuple[float, float]
    image_pitch: tuple[float, ...]

    @property
    def direction(self):
        """+1 for a sweep upwards, -1 downwards."""
        return 1 if self.sweep[1] >= self.sweep[0] else -1


def check_size(rig, nearest):
    """Refuse a board that does not fit into the view of the LRF or of a camera.

    Parameters
    ----------
    rig : Rig
    nearest : float
        Distance of the nearest placement, metres.

    Raises
    ------
    ValueError
    """
    corners = rig.board.known_corners()
    length = np.linalg.norm(corners[:, None] - corners, axis=2).max()
    angle = np.degrees(2 * np.arctan(length / 2 / nearest))
    views = {f"{rig.beam.name}": float(rig.beam.field_of_view)}
    for camera in rig.cameras:
        m = camera.model
        views[f"camera '{camera.name}'"] = float(np.degrees(2 * np.arctan(min(m.width / m.fx, m.height / m.fy) / 2)))
    for name, view in views.items():
        if angle > 0.9 * view:
            raise ValueError(
                f"board '{rig.board.name}' is {length:.3g} m long: {angle:.0f} deg at {nearest:g} m, but {name} sees "
                f"{view:.0f} deg; take a smaller board or a greater distance"
            )


def pairs(rig, count, distances, rng, margin=OUTSIDE):
    """Placements in pairs: at one place, turned by about a right angle and tilted otherwise.

    Parameters
    ----------
    rig : Rig
    count : int
        Of pairs.
    distances : tuple of float
        Least and greatest distance of the board from the platform, metres.
    rng : numpy.random.Generator
    margin : float
        The sweep begins and ends this far outside the board, radians.

    Returns
    -------
    list of Placement
        Numbered from 1. The first of each pair has images at three pitch angles, the second at one. Sweeps go upwards
        at odd placements and downwards at even ones.

    Raises
    ------
    ValueError
        If the board does not fit into a view, or no place is found that everything sees.
    """
    if count < 1 or not 0.3 <= distances[0] <= distances[1]:
        raise ValueError(f"{count} pairs at {distances} m: at least one pair, at 0.3 m or more, is needed")
    check_size(rig, distances[0])
    out = []
    for i, distance in enumerate(rng.permutation(np.linspace(*distances, count))):
        turn = -135.0 + 90.0 * (i % 4)  # which way the right angle points: up, left, down, right
        for _ in range(MOST_TRIES):
            poses = _pair(rig, distance, turn, rng)
            views = [_image_pitches(rig, pose) for pose in poses]
            if all(v is not None for v in views) and all(_in_scan(rig, pose, margin) for pose in poses):
                break
        else:
            raise ValueError(f"no place at {distance:.2f} m where the LRF and all cameras see board '{rig.board.name}'")
        for k, (pose, span) in enumerate(zip(poses, views, strict=True)):
            out.append(_placement(rig, 2 * i + k + 1, pose, span, margin, 3 if k == 0 else 1))
    return out


def _pair(rig, distance, turn, rng):
    """Two poses about one middle; boards face the rig up to 35 deg."""
    azimuth, height = np.radians(rng.uniform(-24, 24)), rng.uniform(-0.22, 0.28) * distance / 1.6
    middle = np.array([distance * np.sin(azimuth), distance * np.cos(azimuth), height])
    centre = np.r_[np.mean(rig.board.known_corners(), axis=0), 0.0]
    out = []
    for more in (0.0, 90.0):
        yaw, tilt, roll = rng.uniform(-35, 35), rng.uniform(-28, 28), turn + more + rng.uniform(-12, 12)
        own = Rotation.from_euler("YXZ", [yaw, tilt, roll], degrees=True)
        turned = Rotation.from_euler("z", -azimuth) * FACING * own
        out.append(RigidTransform.from_components(middle - turned.apply(centre), turned))
    return out


def _image_pitches(rig, T_platform_board, least=LEAST_SPAN):
    """First and last pitch at which all cameras see the whole board; None where that is too little."""
    shown = [
        all(rig.shows(c, rig.camera_pose(c, pitch) * T_platform_board) for c in rig.cameras) for pitch in PITCH_GRID
    ]
    seen = PITCH_GRID[np.array(shown)]
    return (seen[0], seen[-1]) if len(seen) and seen[-1] - seen[0] > least else None


def _in_scan(rig, T_platform_board, margin):
    _, bearing = rig.sweep_pitch(rig.outline(T_platform_board))
    return np.abs(bearing - np.pi / 2).max() < np.radians(rig.beam.field_of_view / 2) - 2 * margin


def _placement(rig, number, pose, span, margin, images):
    pitch, _ = rig.sweep_pitch(rig.outline(pose))
    middle, half = np.mean(span), min(np.ptp(span) * 0.4, np.radians(9.0))
    angles = middle + half * np.array([-1.0, 0.0, 1.0]) if images == 3 else np.array([middle])
    angles = np.radians(np.round(np.degrees(angles), 2))
    low, high = pitch.min() - margin, pitch.max() + margin
    if number % 2:
        return Placement(number, pose, (low, high), tuple(angles))
    return Placement(number, pose, (high, low), tuple(angles[::-1]))


def held_close(rig, camera, count, rng, distances=(0.22, 0.45)):
    """Poses of the board in front of one camera, tilted every way, its pattern spread over the image.

    Parameters
    ----------
    rig : Rig
    camera : RigCamera
    count : int
    rng : numpy.random.Generator
    distances : tuple of float
        Metres from the camera.

    Returns
    -------
    list of RigidTransform
        ``T_camera_board``; the whole pattern is inside the image.

    Raises
    ------
    ValueError
        If the pattern does not fit into the image.
    """
    if count == 0:
        return []
    m, pattern = camera.model, rig.board.pattern
    if pattern is None:
        raise ValueError(f"board '{rig.board.name}' has no pattern: it cannot serve for the intrinsics")
    columns = int(np.ceil(np.sqrt(count * 4 / 3)))
    cells = [((i % columns + 0.5) / columns, (i // columns + 0.5) / np.ceil(count / columns)) for i in range(count)]
    return [_close_pose(rig, camera, np.array(cell) * [m.width, m.height], rng, distances) for cell in cells]


def _close_pose(rig, camera, pixel, rng, distances):
    m, points = camera.model, rig.board.pattern.points()
    middle, image = points.mean(axis=0), np.array([m.width, m.height]) / 2
    for attempt in range(MOST_TRIES):
        uv = pixel + (image - pixel) * attempt / MOST_TRIES + rng.normal(0, 15, 2)
        z = rng.uniform(*distances)
        turn = Rotation.from_euler("x", 180, degrees=True) * Rotation.from_euler(
            "YXZ", [rng.uniform(-42, 42), rng.uniform(-42, 42), rng.uniform(-180, 180)], degrees=True
        )
        place = z * np.array([(uv[0] - m.cx) / m.fx, (uv[1] - m.cy) / m.fy, 1.0])
        pose = RigidTransform.from_components(place - turn.apply(middle), turn)
        if rig.shows(camera, pose, points, margin=18.0):
            return pose
    raise ValueError(f"the pattern of board '{rig.board.name}' does not fit into the image of camera '{camera.name}'")
