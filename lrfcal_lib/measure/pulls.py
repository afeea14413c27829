"""What observations say about all unknowns of a calibrated rig: a change, and its information."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.reconstruct import after_middle
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.calibrate.rig_uncertainty import columns_of
from lrfcal_lib.judge.uncertainty import Chain, chain_of
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.session.read import Session, Sweep
from lrfcal_lib.session.stated import LrfInfo


@dataclass(frozen=True)
class View:
    """An image and how a calibrated rig sees it.

    Attributes
    ----------
    camera : str
    chain : Chain
        To the camera.
    model : CameraModel
    pitch : float
        True one of the head, radians.
    T_camera_platform : RigidTransform
    image : ndarray of uint8, shape (h, w, 3)
    columns : ndarray of int, shape (14,)
        Where the chain's columns and the sweep's pitch stand among the unknowns; -1 for none.
    count : int
        Of unknowns.
    """

    camera: str
    chain: Chain
    model: CameraModel
    pitch: float
    T_camera_platform: RigidTransform
    image: np.ndarray
    columns: np.ndarray
    count: int

    @property
    def fixed(self):
        """Whether the camera stands on the base."""
        return not self.chain.on_head

    @property
    def pose_columns(self):
        """Of the camera's pose among the unknowns, (6,)."""
        return self.columns[4:10]

    @cached_property
    def grey(self):
        """The image in grey, (h, w), float."""
        return cv2.cvtColor(self.image, cv2.COLOR_BGR2GRAY).astype(np.float32)

    def links(self, by_link, by_pitch):
        """Derivatives (..., 3, 14) of points by the links of the chain and the sweep's pitch."""
        return np.concatenate([by_link, by_pitch[..., None]], axis=-1)

    def spread(self, by_link):
        """Derivatives (..., 14) by links as those by all unknowns (..., c)."""
        out = np.zeros((*by_link.shape[:-1], self.count))
        known = self.columns >= 0
        out[..., self.columns[known]] = by_link[..., known]
        return out


@dataclass(frozen=True)
class Pull:
    """What observations say about the unknowns of a rig.

    These are those of its uncertainty, then the pitch of sweeps.

    Attributes
    ----------
    information : ndarray, shape (c, c)
        Inverse of a covariance, zero where they say nothing.
    change : ndarray, shape (c,)
        By which they differ from the calibration, radians and metres.
    groups : float
        Of observations that err together.
    """

    information: np.ndarray
    change: np.ndarray
    groups: float


def views_of_station(session: Session, rig: CalibratedRig, placement: int) -> list[View]:
    """The images of a placement as a calibrated rig sees them.

    Parameters
    ----------
    session : Session
    rig : CalibratedRig
        That knows its uncertainty.
    placement : int
    """
    records = [r for r in session.images(placement=placement) if r.camera in rig.cameras]
    names = rig.uncertainty.names
    views = []
    taken = set()
    for record in records:
        camera = rig.cameras[record.camera]
        pitch = record.pitch * (1 + rig.corrections.pitch_scale)
        if camera.mount == "platform":
            pitch = 0.0
        # a camera on the base sees the same again
        if not np.isfinite(pitch) or (record.camera, pitch) in taken:
            continue
        taken.add((record.camera, pitch))
        view = View(
            camera=record.camera,
            chain=chain_of(rig, record.camera),
            model=camera.model,
            pitch=float(pitch),
            T_camera_platform=rig.camera_at(record.camera, pitch),
            image=session.read_image(record),
            columns=np.append(columns_of(names, record.camera), len(names)),
            count=len(names) + 1,
        )
        views.append(view)
    return views


def directions(
    sweep: Sweep, rig: CalibratedRig, lrf: LrfInfo, continuous: bool
) -> np.ndarray:
    """Bearing and true pitch of every beam, (l, b, 2), radians."""
    pitch = np.repeat(sweep.pitch[:, None], len(sweep.bearings), axis=1)
    if continuous and len(sweep.pitch) > 1:
        rate = np.gradient(sweep.pitch, sweep.time_s)
        pitch = pitch + rate[:, None] * after_middle(sweep.bearings, lrf)
    pitch = pitch * (1 + rig.corrections.pitch_scale)
    return np.stack([np.broadcast_to(sweep.bearings, pitch.shape), pitch], axis=-1)


def pull_of_groups(information, by_row, group, change, fitted):
    """A Pull whose information is what the scatter of groups leaves of it.

    `by_row` (n, c) are the slopes that rows, of groups (n,), have left at `change`, which was
    `fitted` in some of its places.
    """
    _, group = np.unique(group, return_inverse=True)
    sums = np.zeros((group.max() + 1, len(change)))
    np.add.at(sums, group, by_row)
    load = np.bincount(group, np.linalg.norm(by_row, axis=1))
    groups = float(load.sum() ** 2 / np.sum(load**2))
    own = information[np.ix_(fitted, fitted)]
    scatter = sums[:, fitted].T @ sums[:, fitted]
    excess = np.trace(np.linalg.pinv(own, rcond=1e-9, hermitian=True) @ scatter) / len(
        fitted
    )
    few = groups / max(groups - len(fitted), 1.0)
    return Pull(information / max(excess * few, 1e-12), change, groups)
