"""What every solver hands back, and the names of unknowns."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.special import polygamma

from lrfcal_lib.fit.covariance import dyads, sigma_of
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.geometry import POSE_UNITS

AXIS_NAMES = (
    "axis_out_of_scan_plane",
    "axis_in_scan_plane",
    "offset_in_scan_plane",
    "offset_across_scan_plane",
)
AXIS_WORDS = (
    "the tilt of the axis out of the scan plane",
    "the turn of the axis within the scan plane",
    "the offset of the axis within the scan plane",
    "the offset of the axis across the scan plane",
)


def beyond_chance(excess: float | np.ndarray, freedom: float | np.ndarray) -> np.ndarray:
    """How far a variance is above another one, when what chance does is taken off.

    Off the square of the logarithm of the ratio goes its variance by chance, trigamma of half the
    degrees of freedom. A large excess of many numbers counts in full.

    Parameters
    ----------
    excess : float or ndarray
        Logarithm of the ratio of both variances, 0 or more.
    freedom : float or ndarray
        Of the first.

    Returns
    -------
    ndarray
        Logarithm of the ratio that is believed, 0 or more.
    """
    chance = polygamma(1, freedom / 2)
    return np.maximum(excess - chance / np.maximum(excess, 1e-9), 0.0)


@dataclass(frozen=True)
class PlatformPrior:
    """A rough measurement of the axis.

    Standard deviations of its two angles (radians) and two offsets (metres).
    """

    T_head_lrf: RigidTransform
    sigma_direction: float
    sigma_offset: float


@dataclass(frozen=True)
class Solution:
    """What a solver hands back.

    Attributes
    ----------
    transform : RigidTransform or None
        The estimate (a stack of them for a batch of trials).
    parameters : ndarray, shape (..., k)
        For a transform its rotation vector and translation (radians, metres), then whatever else
        was unknown.
    names : tuple of str, length k
    converged, cost_history
        The last, shape (iterations + 1, ...): half the sum of squared whitened residuals (or of the
        loss).
    residuals, jacobian : ndarray, shapes (..., n) and (..., n, k)
        Whitened at the solution, without the robust weights; Jacobian by the increments (``[w, v]``
        for a transform).
    covariance : ndarray, shape (..., k, k)
        Of the increments, from the propagated noise. Where chi-square is above its 99.9 % limit the
        stated noise is too small, and the covariance is multiplied by `inflation`, chi-square per
        degree of freedom; never shrunk below 1.
    covariance_placements : ndarray, shape (..., k, k)
        Clustered by placement: the jackknife to first order, ``(G - 1)/G sum_g d_g d_g^T`` where
        ``d_g`` is the change of the estimate when placement g is left out, scaled so that noise
        alone gives the variances of `covariance` in the mean. Model errors are
        common to one placement, which the first covariance cannot know. NaN where one placement
        alone carries an unknown, or with fewer than three placements.
    n_placements : int
        G.
    unobservable : tuple of str
        Motions that the data do not determine, in words.
    chi2, inflation : float or ndarray
        Sum of squared whitened residuals (weighted); 1 where it agrees with the stated noise.
    model : CameraModel or None
        Refined intrinsics.
    board_poses : ndarray, shape (p, 4, 4), or None
        Refined ``T_camera_board`` in the order of the observations' `placements`.
    rival : RigidTransform or None
        Another minimum, far from this one, that explains the data nearly as well.
    state : object
        What the core moved about: everything that was unknown, shared or not.
    """

    transform: RigidTransform | None
    parameters: np.ndarray
    names: tuple[str, ...]
    converged: bool | np.ndarray
    cost_history: np.ndarray
    residuals: np.ndarray
    jacobian: np.ndarray
    covariance: np.ndarray
    covariance_placements: np.ndarray
    n_placements: int
    unobservable: tuple[str, ...]
    method: str
    n_observations: int
    chi2: float | np.ndarray
    inflation: float | np.ndarray
    model: CameraModel | None = None
    board_poses: np.ndarray | None = None
    rival: RigidTransform | None = None
    state: Any = None

    @property
    def iterations(self):
        """How many steps were tried."""
        return len(self.cost_history) - 1

    @property
    def sigma(self):
        """Standard deviations of the increments from `covariance`, shape (..., k)."""
        return sigma_of(self.covariance)

    @property
    def sigma_placements(self):
        """Standard deviations from `covariance_placements`, shape (..., k); NaN without."""
        return sigma_of(self.covariance_placements)

    @property
    def trusted(self):
        """Covariance to rely on, shape (..., k, k): the one rule for every statement of how well
        something is known.

        That of the noise C, and where a parameter scatters more over placements than chance
        explains, as much more, C + h C h. What is added has the correlations of C: left and right
        camera lean on the same axis, and growing one of them by itself (``g C g``) would claim that
        their difference is known better than anybody measured it.

        What n placements leave to chance is taken off, see :func:`beyond_chance`.
        """
        ratio = self.sigma_placements / np.maximum(self.sigma, 1e-300)  # never 0 / 0
        excess = 2 * np.log(np.fmax(ratio, 1.0))
        h = np.sqrt(np.expm1(beyond_chance(excess, self.n_placements - 1)))
        return self.covariance * (1 + dyads(h))

    def widened(self, by_noise: np.ndarray, by_placements: np.ndarray) -> "Solution":
        """The same with covariances (k, k) added, to that of the noise and that by placement."""
        return replace(
            self,
            covariance=self.covariance + by_noise,
            covariance_placements=self.covariance_placements + by_placements,
        )

    @property
    def trusted_sigma(self):
        """Standard deviations from `trusted`, shape (..., k)."""
        return sigma_of(self.trusted)

    @property
    def shown(self):
        """Rotation vector and translation of a pose, and their trusted standard deviations,
        shape (2, 6), degrees and millimetres.
        """
        return POSE_UNITS * [self.parameters[:6], self.trusted_sigma[:6]]

    def __repr__(self):
        converged = "converged" if np.all(self.converged) else "NOT converged"
        return (
            f"Solution({self.method}: {converged} after {self.iterations} iterations, "
            f"{self.n_observations} observations)"
        )
