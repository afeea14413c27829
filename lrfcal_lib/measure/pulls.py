"""What observations say about all unknowns of a calibrated rig: a slope, and its information."""

from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.calibrate.painting import View
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.calibrate.rig_uncertainty import columns_of
from lrfcal_lib.fit.least_squares import eliminate
from lrfcal_lib.fit.robust import sums_by
from lrfcal_lib.judge.uncertainty import carried, chain_of
from lrfcal_lib.model.camera import pinhole_jacobian
from lrfcal_lib.model.geometry import length_of
from lrfcal_lib.model.kinematics import beams_to

# a camera's likely changes, radians and metres of its pose
SPREAD = np.repeat([np.radians(1.0), 0.02], 3)
PITCH_NOISE = np.radians(0.01)  # of a head at rest: what encoders resolve


@dataclass(frozen=True)
class Pull:
    """What observations say about the unknowns of a rig: those of its uncertainty, then the pitch
    of sweeps.

    Attributes
    ----------
    information : ndarray, shape (c, c)
        Inverse of a covariance, zero where they say nothing.
    slope : ndarray, shape (c,)
        Information times the change of the unknowns that they ask for.
    groups : float
        Of observations that err together.
    alike : float
        Share of the places that two images show alike, where images are compared.
    """

    information: np.ndarray
    slope: np.ndarray
    groups: float
    alike: float = 1.0

    def pull(self, change: np.ndarray, width: float) -> "Pull":
        """The same, wherever it is asked; see :class:`lrfcal_lib.measure.creases.Sights`."""
        return self

    def explained(self, change: np.ndarray) -> float:
        """Logarithm of the likelihood of a change (c,), beside none."""
        return self.slope @ change - change @ self.information @ change / 2


def poses_of(rig: CalibratedRig, camera: str) -> np.ndarray:
    """Where the pose of a camera stands among the unknowns, (6,)."""
    return columns_of(rig.uncertainty.names, camera)[4:10]


def seen(
    points: np.ndarray, motions: np.ndarray, view: View, rig: CalibratedRig
) -> tuple[np.ndarray, np.ndarray]:
    """Scanned points as a camera of a calibrated rig sees them.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Platform frame, metres.
    motions : ndarray, shape (n, m, 3)
        What else moves each of them, platform frame.
    view : View
    rig : CalibratedRig
        That knows its uncertainty.

    Returns
    -------
    p_camera : ndarray, shape (n, 3)
        Camera frame, metres.
    by_unknown : ndarray, shape (n, 2, c + m)
        Derivatives of their undistorted pixels by the unknowns of a Pull, and by the motions.
    """
    beams = beams_to(points, rig.T_head_lrf)
    chain = chain_of(rig, view.camera)
    p_camera, by_link, by_pitch = carried(chain, *beams, view.pitch)
    by_rig = by_link @ chain.links
    moved = view.T_camera_platform.rotation.as_matrix() @ motions.mT
    by_all = np.concatenate([by_rig, by_pitch[..., None], moved], axis=-1)
    return p_camera, pinhole_jacobian(p_camera, view.model) @ by_all


def pull_of_groups(
    information: np.ndarray,
    by_row: np.ndarray,
    group: np.ndarray,
    x: np.ndarray,
    fitted: np.ndarray,
) -> Pull:
    """A Pull whose information is what the scatter of groups leaves of it.

    Parameters
    ----------
    information : ndarray, shape (c, c)
    by_row : ndarray, shape (n, c)
        Slopes that observations have left at `x`.
    group : ndarray of int, shape (n,)
        Those of one group err together.
    x : ndarray, shape (c,)
        Change of the unknowns.
    fitted : ndarray of int, shape (f,)
        Which of them were fitted: by their slopes groups scatter.
    """
    sums = sums_by(group, by_row[:, fitted])
    load = sums_by(group, length_of(by_row))
    groups = load.sum() ** 2 / max(load @ load, 1e-300)
    own = np.linalg.pinv(information[np.ix_(fitted, fitted)], rcond=1e-9, hermitian=True)
    excess = np.trace(own @ sums.T @ sums) / len(fitted)
    few = groups / max(groups - len(fitted), 1.0)
    scale = 1 / max(excess * few, 1e-12)
    return Pull(scale * information, scale * (information @ x + by_row.sum(axis=0)), groups)


def without(pull: Pull, sigma: np.ndarray) -> Pull:
    """What a Pull says of all unknowns but the last ones, which are not known better than so.

    Parameters
    ----------
    pull : Pull
    sigma : ndarray, shape (s,)
        Of the last unknowns before.
    """
    kept = len(pull.slope) - len(sigma)
    whole = pull.information + np.diag(np.pad(sigma**-2.0, (kept, 0)))
    (information,), (slope,), _ = eliminate(
        whole[None], pull.slope[None], kept, regular=True
    )
    return replace(pull, information=information, slope=slope)
