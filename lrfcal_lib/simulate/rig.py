"""The simulated rig: a laser range finder and cameras on a pitching head, and the board they look at."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.board import Board
from lrfcal_lib.camera import CameraModel, project
from lrfcal_lib.simulate.beam import Beam
from lrfcal_lib.simulate.platform import Platform
from lrfcal_lib.simulate.render import Exposure

MOUNTS = ("head", "platform")
AHEAD = Rotation.from_matrix([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # lrf or platform axes to those of a camera


@dataclass(frozen=True)
class RigCamera:
    """A camera of the rig.

    Attributes
    ----------
    name : str
    model : CameraModel
        True intrinsics.
    mounting : RigidTransform
        ``T_camera_lrf`` on the head, ``T_camera_platform`` on the base.
    guess : RigidTransform
        The same as a tape measure gives it.
    mount : {'head', 'platform'}
    exposure : Exposure
    """

    name: str
    model: CameraModel
    mounting: RigidTransform
    guess: RigidTransform
    mount: str = "head"
    exposure: Exposure = Exposure()

    def __post_init__(self):
        if self.mount not in MOUNTS:
            raise ValueError(f"camera '{self.name}': mount is one of {', '.join(MOUNTS)}, got '{self.mount}'")


@dataclass(frozen=True)
class Rig:
    """Everything that stays the same over a recording.

    Attributes
    ----------
    beam : Beam
    platform : Platform
    T_head_lrf : RigidTransform
        The truth.
    T_head_lrf_stated : RigidTransform
        As a tape measure gives it.
    stated_sigma : tuple of float
        How well it is said to be known: direction (radians) and offset (metres).
    cameras : tuple of RigCamera
    board : Board
        With corners.
    ring : float
        Width of the outermost squares of the board's pattern as a share of a square.
    """

    beam: Beam
    platform: Platform
    T_head_lrf: RigidTransform
    T_head_lrf_stated: RigidTransform
    cameras: tuple[RigCamera, ...]
    board: Board
    ring: float = 0.65
    stated_sigma: tuple[float, float] = (math.radians(1.5), 0.020)

    def camera_pose(self, camera, pitch):
        """``T_camera_platform`` while the head stands at a true pitch.

        Parameters
        ----------
        camera : RigCamera
        pitch : float
            Radians.
        """
        if camera.mount == "platform":
            return camera.mounting
        back = RigidTransform.from_rotation(Rotation.from_rotvec([-pitch, 0.0, 0.0]))
        return camera.mounting * self.T_head_lrf.inv() * back

    def outline(self, T_platform_board):
        """Corners of the board in the platform frame, shape (n, 3)."""
        corners = self.board.known_corners()
        return T_platform_board.apply(np.column_stack([corners, np.zeros(len(corners))]))

    def sweep_pitch(self, p_platform):
        """Pitch at which the scan plane meets points, and their bearing there.

        Parameters
        ----------
        p_platform : ndarray, shape (n, 3)

        Returns
        -------
        pitch, bearing : ndarray, shape (n,)
            Radians. With n the third row of the rotation of ``T_head_lrf.inv()`` and h its shift, the point p lies in
            the scan plane where ``n . Rx(-pitch) p + h = 0``; of the two solutions the one ahead is taken.
        """
        back = self.T_head_lrf.inv()
        n, h = back.rotation.as_matrix()[2], back.translation[2]
        x, y, z = np.asarray(p_platform, float).T
        along, across = n[1] * y + n[2] * z, n[1] * z - n[2] * y
        turn = np.arctan2(across, along)
        lift = np.arccos(np.clip(-(n[0] * x + h) / np.hypot(along, across), -1, 1))
        both = [np.angle(np.exp(1j * (turn + s * lift))) for s in (1, -1)]
        pitch = np.where(np.abs(both[0]) < np.abs(both[1]), *both)
        c, s = np.cos(pitch), np.sin(pitch)
        p_lrf = back.apply(np.stack([x, c * y + s * z, c * z - s * y], axis=1))
        return pitch, np.arctan2(p_lrf[:, 1], p_lrf[:, 0])

    def shows(self, camera, T_camera_board, points=None, margin=12.0):
        """Whether a camera sees points of the board, its corners by default, inside the image by a margin in pixels."""
        corners = self.board.known_corners()
        points = np.column_stack([corners, np.zeros(len(corners))]) if points is None else points
        p = T_camera_board.apply(points)
        if p[:, 2].min() < 0.1 or np.abs(p[:, :2] / p[:, 2:]).max() > 1.0:
            return False
        uv, size = project(p, camera.model), [camera.model.width, camera.model.height]
        return bool(np.all((uv > margin) & (uv < np.asarray(size) - 1 - margin)))


def camera_mounting(centre_lrf, turn_deg):
    """``T_camera_lrf`` of a camera that looks ahead.

    Parameters
    ----------
    centre_lrf : array_like, shape (3,)
        Optical centre in the LRF frame, metres.
    turn_deg : array_like, shape (3,)
        Further turn about the camera's axes (right, down, ahead), a rotation vector in degrees.
    """
    turn = Rotation.from_rotvec(turn_deg, degrees=True) * AHEAD
    return RigidTransform.from_components(-turn.apply(centre_lrf), turn)


def disturbed(transform, turn_deg, shift):
    """A transform as it would be measured by hand, off by a turn (rotation vector, degrees) and a shift (metres)."""
    turn = Rotation.from_rotvec(turn_deg, degrees=True) * transform.rotation
    return RigidTransform.from_components(transform.translation + np.asarray(shift), turn)
