"""A calibrated rig: all that turns its sweeps and images into a coloured cloud."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.cameras import KnownAxis
from lrfcal_lib.calibrate.rig_uncertainty import RigUncertainty, joint_uncertainty
from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.model.camera import CameraModel, project
from lrfcal_lib.model.geometry import polar_to_points
from lrfcal_lib.model.kinematics import Corrections, SourceFrame, camera_at
from lrfcal_lib.session.stated import LrfInfo
from lrfcal_lib.solvers.joint_solution import JointSolution

# the paper's, for rigs that come without a session
LMS200 = LrfInfo("LMS 200", (np.radians(40), np.radians(140)), np.radians(0.25), 0.005)


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
    lrf : LrfInfo
    uncertainty : RigUncertainty or None
        None where the method does not say how well it knows the rig.
    session : str
        Name of the session that it was calibrated with.
    answer : str
        Of the verdict, 'yes', 'with care' or 'no'; '' where nobody has judged it.
    reasons : tuple of str
        Why it is not 'yes', in words.
    date : str
        Of the calibration, ISO 8601; '' where it is of this moment.
    """

    method: str
    axis: KnownAxis
    corrections: Corrections
    cameras: dict[str, CalibratedCamera]
    lrf: LrfInfo = LMS200
    uncertainty: RigUncertainty | None = None
    session: str = ""
    answer: str = ""
    reasons: tuple[str, ...] = ()
    date: str = ""

    @property
    def name(self) -> str:
        """For messages."""
        return f"the calibration of '{self.session}'"

    @property
    def known(self) -> RigUncertainty:
        """Its uncertainty, or a ValueError that nothing says how well it is known."""
        if self.uncertainty is None:
            raise ValueError(
                f"the calibration of '{self.session}' by '{self.method}' does not say how well the "
                "rig is known: calibrate it by 'joint'"
            )
        return self.uncertainty

    @property
    def T_head_lrf(self) -> RigidTransform:
        """Of its axis."""
        return self.axis.T_head_lrf

    @property
    def for_scenes(self) -> "CalibratedRig":
        """Without what single sweeps of a board were off by, which is of no other sweep."""
        return replace(self, corrections=replace(self.corrections, sweeps={}))

    def camera_at(self, name: str, pitch: ArrayLike) -> RigidTransform:
        """``T_camera_platform`` of a camera at a true pitch (radians), or at several."""
        camera = self.cameras[name]
        return camera_at(camera.T_camera, camera.mount, self.T_head_lrf, pitch)

    def project_scan(
        self, name: str, ranges: np.ndarray, bearings: np.ndarray, pitch: float
    ) -> np.ndarray:
        """Pixels of a scan line in an image that a camera takes at the same pitch, shape (n, 2).

        Parameters
        ----------
        name : str
            The camera.
        ranges, bearings : ndarray, shape (n,)
            As recorded, metres (NaN for none) and radians.
        pitch : float
            As recorded, radians.

        Returns
        -------
        ndarray
            NaN where nothing came back, or behind the camera.
        """
        camera = self.cameras[name]
        source = SourceFrame(
            self.T_head_lrf, camera.mount, pitch, corrections=self.corrections
        )
        p_source = source.points(polar_to_points(ranges, bearings), pitch)
        return project(camera.T_camera.apply(p_source), camera.model)


def joint_rig(solution: JointSolution, models: dict[str, CameraModel]) -> CalibratedRig:
    """The rig of a joint estimate that came without a session.

    Parameters
    ----------
    solution : JointSolution
    models : dict of str to CameraModel

    Returns
    -------
    CalibratedRig
    """
    mounts = solution.observations.mounts
    cameras = {
        name: CalibratedCamera(T_camera, mount, models[name])
        for (name, T_camera), mount in zip(solution.transforms.items(), mounts, strict=True)
    }
    return CalibratedRig(
        method="joint",
        axis=KnownAxis(solution.T_head_lrf, solution.covariance(*AXIS_NAMES)),
        corrections=solution.corrections,
        cameras=cameras,
        uncertainty=joint_uncertainty(solution),
    )
