"""``calibration.json``: what is needed to use a calibrated rig, without the session it is of."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, FiniteFloat
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.cameras import KnownAxis
from lrfcal_lib.calibrate.rig import CalibratedCamera, CalibratedRig
from lrfcal_lib.calibrate.rig_uncertainty import RigUncertainty, rows
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.geometry import pose_transform
from lrfcal_lib.model.kinematics import Corrections
from lrfcal_lib.session.files import SessionError, naming, read_json
from lrfcal_lib.session.read import Session
from lrfcal_lib.session.stated import (
    Endless,
    LensStated,
    LrfInfo,
    Positive,
    from_json,
    plain,
)

SCHEMA = 3
KIND = "lrfcal calibration"
FORMULAS = {
    "frames": (
        "Destination first: p_camera = T_camera_source p_source, metres and radians; `matrix` is "
        "the 4 x 4 matrix, `rotvec_rad` and `translation_m` say the same. Camera: x right, y "
        "down, z ahead; LRF: x right, y ahead, in the scan plane."
    ),
    "range": (
        "A range is too long by range_offset_m: p_lrf = (range - range_offset_m) (cos b, sin b, "
        "0), where the bearing b is 0 to the right and pi/2 ahead."
    ),
    "pitch": (
        "Radians, positive lifts the view: true pitch = (1 + pitch_scale) times the recorded "
        "one, of scans and of images."
    ),
    "head": (
        "p_platform = Rx(pitch) T_head_lrf p_lrf with the pitch of the scan line; `platform` is "
        "T_head_lrf. Rx(a) turns about x: y' = y cos a - z sin a, z' = y sin a + z cos a."
    ),
    "camera on the head": (
        "p_camera = T_camera_lrf inverse(T_head_lrf) Rx(-pitch of the image) p_platform."
    ),
    "camera on the platform": "p_camera = T_camera_platform p_platform, at any pitch.",
    "lens": (
        "K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] and distortion (k1, k2, p1, p2, k3) as OpenCV "
        "takes them; pixel (0, 0) is the centre of the top-left one."
    ),
    "covariance": (
        "Of the increments [w, v] of a pose: R <- exp(w) R, t <- t + v. `trusted` is what to rely "
        "on, `covariance` what noise alone explains, `lens` the share of the intrinsics in both; "
        "null where nothing bounds an unknown. A turn about the tilt axis and a shift along it are "
        "as stated: no data show them."
    ),
    "uncertainty": (
        "`unseen_...` are motions of (axis: 4, pose of the camera: 6, range offset, pitch scale, "
        "pitch offset by direction) that nothing determines; `sweep_sigma` (radians, a fraction) "
        "is the offset and stretch that the pitch of every sweep has of its own."
    ),
}
ROUND = 1e-9  # a rotation's matrix may be off by so much


def _pose(whole):
    """A RigidTransform of a matrix (4, 4), to the last bit."""
    R = whole[:3, :3]
    proper = np.allclose(R @ R.T, np.eye(3), 0, ROUND) and np.linalg.det(R) > 0
    if not proper or whole[3].tolist() != [0, 0, 0, 1]:
        raise ValueError("it is no rotation and translation")
    return pose_transform(whole[:3], proper=True)


Pose = Annotated[RigidTransform, rows(4, 4), AfterValidator(_pose)]


class PlatformWritten(BaseModel):
    """The tilt axis."""

    matrix: Pose
    axis_covariance: Annotated[np.ndarray, rows(4, 4)]


class LensWritten(LensStated):
    """What ``CameraModel(**lens)`` takes; without bound where nothing has determined it."""

    width: Annotated[int, Field(ge=1)]
    height: Annotated[int, Field(ge=1)]
    covariance: Annotated[np.ndarray, rows(9, 9)] | None  # type: ignore[assignment]


class CameraWritten(BaseModel):
    """A camera."""

    matrix: Pose
    mount: Literal["head", "platform"]
    lens: LensWritten


class LrfWritten(BaseModel):
    """A range finder as `LrfInfo` has it, but radians."""

    model: str
    field_of_view: tuple[FiniteFloat, FiniteFloat]
    bearing_step: Positive
    sigma_range: FiniteFloat
    sigma_bearing: FiniteFloat
    range_resolution: FiniteFloat
    max_range: Endless
    systematic_error: FiniteFloat | None
    step_error: FiniteFloat | None = None
    spot_exit: FiniteFloat | None
    spot_divergence: FiniteFloat | None


class CorrectionsWritten(BaseModel):
    """What is wrong with what any session records."""

    range_offset_m: FiniteFloat
    pitch_scale: FiniteFloat


class ReasonWritten(BaseModel):
    """Why a calibration is not to be trusted as it is."""

    words: str


class VerdictWritten(BaseModel):
    """Whether a calibration can be trusted."""

    answer: Literal["yes", "with care", "no"]
    reasons: tuple[ReasonWritten, ...]


class CalibrationFile(BaseModel):
    """What a use of a calibration reads of its file; other keys are for people."""

    session: str
    date: str
    method: str
    verdict: VerdictWritten
    platform: PlatformWritten
    cameras: dict[str, CameraWritten]
    corrections: CorrectionsWritten
    lrf: LrfWritten
    uncertainty: RigUncertainty | None


def rig_record(rig: CalibratedRig) -> dict[str, Any]:
    """A rig as `CalibrationFile` reads it, without a verdict, by key.

    The errors of the recorded sweeps are left out: they say nothing about any other sweep.

    Parameters
    ----------
    rig : CalibratedRig
    """
    return {
        "platform": {
            "maps": "lrf to head",
            **pose_record(rig.axis.T_head_lrf),
            "axis_covariance": rig.axis.covariance.tolist(),
            "axis_covariance_of": [
                "out_of_scan_plane_rad",
                "in_scan_plane_rad",
                "offset_in_scan_plane_m",
                "offset_across_scan_plane_m",
            ],
        },
        "cameras": {
            name: {
                "mount": camera.mount,
                **pose_record(camera.T_camera),
                "lens": plain(vars(camera.model)),
            }
            for name, camera in rig.cameras.items()
        },
        "corrections": {
            "range_offset_m": rig.corrections.range_offset,
            "pitch_scale": rig.corrections.pitch_scale,
        },
        "lrf": vars(rig.lrf),
        "uncertainty": rig.uncertainty and plain(vars(rig.uncertainty)),
    }


def pose_record(transform) -> dict[str, list]:
    """A RigidTransform by its matrix and, the same, by rotation vector and translation."""
    return {
        "matrix": transform.as_matrix().tolist(),
        "rotvec_rad": transform.rotation.as_rotvec().tolist(),
        "translation_m": transform.translation.tolist(),
    }


def load_calibration(path: str | Path) -> CalibratedRig:
    """Read a calibrated rig from ``calibration.json``: the numbers that were written, to the last
    bit.

    It needs no other file. What single sweeps of the calibrated session were off by is not in it.

    Parameters
    ----------
    path : path-like
        Of the file, or of its folder.

    Returns
    -------
    CalibratedRig
        Also one whose verdict was 'no', which it says in `answer`, see
        :func:`refuse_untrusted`.

    Raises
    ------
    SessionError
        For a file that cannot be read, is damaged, no calibration, or of another schema.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "calibration.json"
    if not path.exists():
        raise SessionError(f"{path}: there is no such file; 'calibrate' writes it")
    data = read_json(path, None)
    schema = data.get("schema")
    if data.get("kind") != KIND and schema != 1:
        raise SessionError(
            f"{path}: is no calibration: its key 'kind' is {data.get('kind')!r}, not {KIND!r}; "
            "'calibrate' writes calibration.json"
        )
    if schema != SCHEMA:
        remedy = "calibrate its session again"
        if isinstance(schema, int) and schema > SCHEMA:
            remedy = "take a newer lrfcal"
        raise SessionError(f"{path}: schema {schema}, this reads {SCHEMA}: {remedy}")
    with naming(path):
        return _made(from_json(CalibrationFile, data))


def _made(file):
    """The CalibratedRig of a CalibrationFile."""
    cameras = {
        name: CalibratedCamera(
            camera.matrix, camera.mount, CameraModel(**dict(camera.lens))
        )
        for name, camera in file.cameras.items()
    }
    known = file.uncertainty
    if known is not None:
        if set(known.unseen_of_cameras) != set(cameras):
            raise ValueError("uncertainty.unseen_of_cameras is of other cameras")
        size = (len(known.names),) * 2
        if any(C.shape != size for C in (known.covariance, known.trusted, known.lens)):
            raise ValueError(f"uncertainty: its covariances are not of {size[0]} names")
    return CalibratedRig(
        method=file.method,
        axis=KnownAxis(file.platform.matrix, file.platform.axis_covariance),
        corrections=Corrections(
            file.corrections.range_offset_m, file.corrections.pitch_scale
        ),
        cameras=cameras,
        lrf=LrfInfo(**dict(file.lrf)),
        uncertainty=known,
        session=file.session,
        answer=file.verdict.answer,
        reasons=tuple(reason.words for reason in file.verdict.reasons),
        date=file.date,
    )


def refuse_untrusted(rig: CalibratedRig, untrusted: bool = False) -> None:
    """ValueError for a calibration whose verdict was 'no', unless it is wanted all the same.

    Parameters
    ----------
    rig : CalibratedRig
    untrusted : bool
        It is wanted.
    """
    if rig.answer == "no" and not untrusted:
        raise ValueError(
            f"the calibration of '{rig.session}' cannot be trusted: {'; '.join(rig.reasons)}. "
            "Take a better one, or --untrusted"
        )


def require_same_rig(rig: CalibratedRig, other: Session | CalibratedRig) -> None:
    """ValueError where a session cannot have been recorded by a calibrated rig, or another
    calibration is of another rig.

    One may know fewer cameras than the other; those both know are the same.

    Parameters
    ----------
    rig : CalibratedRig
    other : Session or CalibratedRig
    """
    known = set(rig.cameras)
    recorded = set(other.cameras)
    differences = []
    if not (known <= recorded or recorded <= known):
        differences.append(f"its cameras are {sorted(recorded)}, not {sorted(known)}")
    expected = _facts(rig)
    differences += [
        f"{what} {value}, not {expected[what]}"
        for what, value in _facts(other).items()
        if value != expected.get(what, value)
    ]
    if differences:
        raise ValueError(
            f"{other.name} is of another rig than the calibration of '{rig.session}': "
            f"{'; '.join(differences)}"
        )


def _facts(rig):
    """What must be alike in a session and a calibration of the same rig: words by words."""
    low, high = np.degrees(rig.lrf.field_of_view).round(4)
    facts = {
        "its beams are, in deg,": f"{np.degrees(rig.lrf.bearing_step):.6f} apart",
        "its range finder sees": f"{low} to {high} deg",
    }
    for name, camera in rig.cameras.items():
        model = getattr(camera, "model", None) or camera
        facts[f"images of '{name}' have"] = f"{model.width} x {model.height} pixels"
        facts[f"'{name}' is fixed to the"] = camera.mount
    return facts
