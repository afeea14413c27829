"""A calibrated rig: all that turns its sweeps and images into a coloured cloud."""

from dataclasses import dataclass

from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.cameras import KnownAxis
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.kinematics import Corrections, camera_at


@dataclass(frozen=True)
class CalibratedCamera:
    """A camera as it is fixed to a rig.

    Attributes
    ----------
    T_camera : RigidTransform
        ``T_camera_lrf`` on the head, ``T_camera_platform`` on the base.
    mount : {'head', 'platform'}
    model : CameraModel
    """

    T_camera: RigidTransform
    mount: str
    model: CameraModel


@dataclass(frozen=True)
class CalibratedRig:
    """What a method says about a rig: all that turns its sweeps and images into a coloured cloud.

    Attributes
    ----------
    method : str
    axis : KnownAxis
    corrections : Corrections
        Of ranges and pitch.
    cameras : dict of str to CalibratedCamera
    """

    method: str
    axis: KnownAxis
    corrections: Corrections
    cameras: dict[str, CalibratedCamera]

    @property
    def T_head_lrf(self) -> RigidTransform:
        """Of its axis."""
        return self.axis.T_head_lrf

    def camera_at(self, name: str, pitch: float) -> RigidTransform:
        """``T_camera_platform`` of a camera at a true pitch (radians)."""
        camera = self.cameras[name]
        return camera_at(camera.T_camera, camera.mount, self.T_head_lrf, pitch)
