"""The way of a beam: from the LRF over the head and the platform to a camera, equations (3) to (6)
and (16).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.geometry import (
    bearings_of,
    length_of,
    lrf_to_platform,
    tilt,
)

TILT_AXIS = np.array([1.0, 0.0, 0.0])  # of the head and of the platform
# s; 75 Hz nominal, 148 us for a ninetieth of a turn on a real LMS200
MIRROR_TURN = 1 / 75.08


@dataclass(frozen=True)
class SweepPitch:
    """How the recorded pitch of one sweep errs: ``offset + stretch * (pitch - middle)`` has to be
    added to it.

    `offset` and `middle` are in radians, `stretch` is a fraction.
    """

    offset: float
    stretch: float
    middle: float

    def error(self, pitch: np.ndarray) -> np.ndarray:
        """What has to be added to the recorded pitch, radians."""
        return self.offset + self.stretch * (pitch - self.middle)


@dataclass(frozen=True)
class Corrections:
    """Known errors of what a rig records; without arguments none.

    Attributes
    ----------
    range_offset : float
        By how much every range is too long, metres.
    pitch_scale : float
        The head turns ``1 + pitch_scale`` times as far as its recorded pitch says.
    sweeps : dict of int to SweepPitch
        What single sweeps are off by, by placement.
    """

    range_offset: float = 0.0
    pitch_scale: float = 0.0
    sweeps: Mapping[int, SweepPitch] = field(default_factory=dict)

    def points(self, p_lrf: ArrayLike) -> np.ndarray:
        """Measured points (..., 3) of the LRF frame without the range offset, metres."""
        length = np.linalg.norm(p_lrf, axis=-1, keepdims=True)
        return p_lrf * (1 - self.range_offset / np.maximum(length, 1e-9))

    def pitch(self, placement: int, recorded: ArrayLike) -> np.ndarray:
        """The recorded pitch of a placement as it should have been, radians."""
        recorded = np.asarray(recorded, float)
        corrected = recorded * (1 + self.pitch_scale)
        if placement in self.sweeps:
            corrected = corrected + self.sweeps[placement].error(recorded)
        return corrected


AS_RECORDED = Corrections()


@dataclass(frozen=True)
class SourceFrame:
    """The frame that a camera is fixed to, as points of scans reach it as they are recorded.

    Known errors of ranges and pitch are taken out first; they change where a point lies, but not
    how its noise turns.

    Attributes
    ----------
    T_head_lrf : RigidTransform
    mount : {'head', 'platform'}
        What the camera is fixed to.
    image_pitch : array_like
        Recorded when the image, or that of each point, was taken, radians; it matters for a camera
        on the head only.
    placement : int or None
        Of scans and image.
    corrections : Corrections
    """

    T_head_lrf: RigidTransform
    mount: str
    image_pitch: ArrayLike = 0.0
    placement: int | None = None
    corrections: Corrections = AS_RECORDED

    @cached_property
    def T_source_platform(self) -> RigidTransform:
        """While the head stands at the pitch of the image."""
        pitch = self.corrections.pitch(self.placement, self.image_pitch)
        return camera_at(RigidTransform.identity(), self.mount, self.T_head_lrf, pitch)

    def points(self, p_lrf: np.ndarray, pitch: ArrayLike) -> np.ndarray:
        """Measured points (..., 3) at their recorded pitch (...), in this frame, metres."""
        return self.T_source_platform.apply(self._in_platform(p_lrf, pitch))

    def covariance(self, covariance: np.ndarray, pitch: np.ndarray) -> np.ndarray:
        """Covariances (n, 3, 3) of measured points, turned into this frame."""
        corrected = self.corrections.pitch(self.placement, pitch)
        T_platform_lrf = platform_from_head(corrected) * self.T_head_lrf
        R = (self.T_source_platform * T_platform_lrf).rotation.as_matrix()
        return R @ covariance @ R.mT

    def by_pitch(self, p_lrf: np.ndarray, pitch: np.ndarray) -> np.ndarray:
        """Derivative (n, 3) of :meth:`points` by an error of the recorded pitch, metres a
        radian.
        """
        moved = np.cross(TILT_AXIS, self._in_platform(p_lrf, pitch))
        return self.T_source_platform.rotation.apply(moved)

    def _in_platform(self, p_lrf, pitch):
        corrected = self.corrections.pitch(self.placement, pitch)
        return lrf_to_platform(self.corrections.points(p_lrf), corrected, self.T_head_lrf)


def platform_from_head(pitch: ArrayLike) -> RigidTransform:
    """``T_platform_head`` of the head at a true pitch (radians), or at several, equation (4)."""
    turn = Rotation.from_rotvec(np.multiply.outer(pitch, TILT_AXIS))
    return RigidTransform.from_rotation(turn)


def camera_at(
    T_camera: RigidTransform, mount: str, T_head_lrf: RigidTransform, pitch: ArrayLike
) -> RigidTransform:
    """``T_camera_platform`` while the head stands at a true pitch, or at several.

    Parameters
    ----------
    T_camera : RigidTransform
        ``T_camera_lrf`` of a camera on the head, ``T_camera_platform`` of one on the base.
    mount : {'head', 'platform'}
    T_head_lrf : RigidTransform
    pitch : array_like
        Radians.
    """
    if mount == "platform":
        return T_camera
    return T_camera * T_head_lrf.inv() * platform_from_head(pitch).inv()


def beams_to(
    points: ArrayLike, T_head_lrf: RigidTransform
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bearing, pitch (radians) and range (metres) at which scans reach points.

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Platform frame, metres.
    T_head_lrf

    Returns
    -------
    ndarray, shape (...)
        Each of the three; NaN where the scan plane never gets there.
    """
    points = np.asarray(points, float)
    R = T_head_lrf.rotation.as_matrix()
    t = T_head_lrf.translation
    k = R[:, 2]  # normal of the scan plane: k . (Rx(-pitch) x - t) = 0
    across = points[..., 1:]
    a = np.vecdot(across, k[1:])
    b = np.vecdot(across, [-k[2], k[1]])
    c = k @ t - k[0] * points[..., 0]
    with np.errstate(invalid="ignore"):
        pitch = np.arctan2(b, a) + np.arccos(c / np.hypot(a, b))
    pitch = (pitch + np.pi) % (2 * np.pi) - np.pi
    p = (tilt(points, -pitch) - t) @ R
    return bearings_of(p), pitch, length_of(p)
