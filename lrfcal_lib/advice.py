"""What a joint estimate knows well and badly, in words, and which placement to record next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.candidates import board_grid, placed, visible
from lrfcal_lib.forecast import candidate_information, measure_yield
from lrfcal_lib.geometry import DegenerateGeometry
from lrfcal_lib.solvers.joint import UNSEEN
from lrfcal_lib.solvers.platform import AXIS_NAMES, AXIS_WORDS
from lrfcal_lib.solvers.pose import POSE_NAMES
from lrfcal_lib.uncertainty import information

RADIUS = 2.0  # metres: a turn counts as much as what it shifts at this distance
PRIOR = 1.0  # metres at RADIUS, so that what is not observed at all can be compared as well
LARGE = 0.5  # components of a direction below this share of the largest are not named
MOST = 3  # parts of a direction that are named
FIELD_OF_VIEW = (np.radians(40), np.radians(140))
PITCH_LIMITS = (np.radians(-30), np.radians(30))
OTHERS = {
    "range_offset": "the range offset",
    "edge_log_odds": "the edge bias",
    "pitch_scale": "the scale of the pitch",
    "pitch_by_direction": "the pitch offset by sweep direction",
}
PLACES = {
    "distances": (1.0, 1.5, 2.0, 2.5, 3.0),
    "bearings": tuple(np.radians([-20, -10, 0, 10, 20])),
    "elevations": tuple(np.radians([-12, 0, 12])),
    "turns": tuple(np.radians(np.arange(0, 360, 60))),
    "leans": tuple(np.radians([0, 35])),
}


@dataclass(frozen=True)
class Direction:
    """A combination of unknowns that is known more or less well by itself.

    Attributes
    ----------
    value : float
        Singular value of the scaled information: reciprocal of `sigma`, per metre.
    words : str
    sigma : float
        Standard deviation, metres at a distance of 2 m; inf where it is not observed.
    """

    value: float
    words: str
    sigma: float


def scales_of(solution, names):
    """How much of each unknown makes a metre at 2 m."""
    used = solution.data.beam["used"]
    radius = np.median(solution.data.beam["radius"][used]) if used.any() else 0.01
    special = {"range_offset": 1.0, "edge_log_odds": 2.0 / radius}
    turns = (*AXIS_NAMES[:2], "pitch_scale", "pitch_by_direction")
    plain = [1 / RADIUS if n in turns or n[-3:] in ("_rx", "_ry", "_rz") else 1.0 for n in names]
    return np.array([special.get(n, p) for n, p in zip(names, plain, strict=True)])


def _marginal(hessian, index):
    """Information on some unknowns with the others eliminated, shape (..., k, k)."""
    rest = np.setdiff1d(np.arange(hessian.shape[-1]), index)
    cross = hessian[..., index[:, None], rest]
    inverse = np.linalg.pinv(hessian[..., rest[:, None], rest], rcond=1e-13, hermitian=True)
    return hessian[..., index[:, None], index] - cross @ inverse @ np.swapaxes(cross, -1, -2)


def observability(solution):
    """Singular values and directions of the scaled information.

    Parameters
    ----------
    solution : JointSolution

    Returns
    -------
    list of Direction
        The least known first. Softness of the edges and sizes of the board are eliminated.
    """
    names = np.array(solution.solution.names)
    index = np.array([i for i, n in enumerate(names) if n != "edge_log_softness" and not n.startswith("size_")])
    scales = scales_of(solution, names[index])
    H = _marginal(information(solution).sum(axis=0), index)
    values, vectors = np.linalg.eigh(H * scales[:, None] * scales)
    least = max(1e-13 * values[-1], UNSEEN**-2)
    cameras = tuple(solution.transforms)
    return [
        Direction(float(np.sqrt(max(v, 0.0))), direction_words(x, names[index], cameras), _sigma(v, least))
        for v, x in zip(values, vectors.T, strict=True)
    ]


def _sigma(value, least):
    return float(value**-0.5) if value > least else np.inf


def direction_words(direction, names, cameras):
    """A direction of scaled unknowns in words.

    Parameters
    ----------
    direction : ndarray, shape (k,)
        In metres at 2 m.
    names : sequence of str
    cameras : sequence of str

    Returns
    -------
    str
        At most three parts; what the cameras have in common is said once.
    """
    direction = np.asarray(direction) / np.max(np.abs(direction))
    value = dict(zip(names, direction, strict=True))
    single = dict(zip(AXIS_NAMES, AXIS_WORDS, strict=True)) | OTHERS
    words = [(abs(value[n]), w) for n, w in single.items() if n in value]
    poses = {c: np.array([value[f"{c}_{p}"] for p in POSE_NAMES]) for c in cameras}
    for kind, part in (("rotation about", slice(0, 3)), ("shift along", slice(3, 6))):
        words += _camera_words(kind, {c: pose[part] for c, pose in poses.items()})
    words.sort(key=lambda pair: -pair[0])
    return " with ".join(w for size, w in words[:MOST] if size > LARGE * words[0][0])


def _camera_words(kind, found):
    """Sizes of rotations or shifts of cameras, and words; said once where all move alike."""
    vectors = list(found.values())
    mean = np.mean(vectors, axis=0) if vectors else np.zeros(3)
    if len(vectors) > 1 and all(np.linalg.norm(v - mean) < 0.3 * np.linalg.norm(mean) for v in vectors):
        return [(np.linalg.norm(mean), f"{kind} {_main_axes(mean)} of all cameras")]
    return [(np.linalg.norm(v), f"{kind} {_main_axes(v)} of camera '{c}'") for c, v in found.items() if v.any()]


def _main_axes(vector):
    """The axes that a vector mostly lies along, e.g. ``x`` or ``y and z``."""
    return " and ".join(np.array(["x", "y", "z"])[np.abs(vector) > 0.4 * np.linalg.norm(vector)])


@dataclass(frozen=True)
class Suggestion:
    """The placement that would shrink the uncertainty most.

    Attributes
    ----------
    T_platform_board : RigidTransform
    distance, bearing, elevation, turn, lean : float
        See :class:`lrfcal_lib.candidates.Candidates`; metres and radians.
    towards : str
    pitches : ndarray, shape (k,)
        Of the images, radians.
    before, after : dict of str to float
        Standard deviation of 'axis' and of each camera, metres at 2 m (root of the sum of the variances of rotation
        times 2 m and of translation), of the propagated noise.
    covariance_after : ndarray, shape (c, c)
        Predicted, of the shared unknowns.
    gain : float
        By how much the criterion's standard deviation shrinks, a fraction.
    median_gain : float
        Of all candidates: what a placement chosen blindly brings.
    candidates : int
        How many were compared.
    criterion : {'A', 'D'}
    on_head : bool
        Whether the pitch of the images matters.
    """

    T_platform_board: RigidTransform
    distance: float
    bearing: float
    elevation: float
    turn: float
    lean: float
    towards: str
    pitches: np.ndarray
    before: dict
    after: dict
    covariance_after: np.ndarray
    gain: float
    median_gain: float
    candidates: int
    criterion: str
    on_head: bool

    def words(self):
        """The pose in words, e.g. ``board 1.5 m ahead, 20 deg to the left, turned 60 deg in its plane, ...``."""
        parts = [f"board {self.distance:.1f} m ahead"]
        for angle, plus, minus in ((self.bearing, "to the left", "to the right"), (self.elevation, "up", "down")):
            if round(np.degrees(angle)):
                parts.append(f"{abs(np.degrees(angle)):.0f} deg {plus if angle > 0 else minus}")
        if round(np.degrees(self.turn)):
            parts.append(f"turned {np.degrees(self.turn):.0f} deg in its plane")
        way = {"back": "leaning back", "forward": "leaning forward"}.get(self.towards, f"facing {self.towards} by")
        parts.append(f"{way} {np.degrees(self.lean):.0f} deg" if self.towards else "upright")
        if not self.on_head:
            return ", ".join(parts)
        angles = [f"{np.degrees(p):+.0f}" for p in self.pitches]
        images = " and ".join([", ".join(angles[:-1]), angles[-1]] if len(angles) > 1 else angles)
        return ", ".join(parts) + f"; images at pitch {images} deg"

    def sentence(self):
        """What to record next and what it brings."""
        known = ", ".join(
            f"{name} {brief(1000 * self.before[name])} to {brief(1000 * self.after[name])} mm" for name in self.before
        )
        gain, blind = 100 * self.gain, 100 * self.median_gain
        return (
            f"Record next: {self.words()}. Predicted standard deviations at 2 m: {known} ({gain:.0f} % less; a blindly "
            f"chosen placement: {blind:.0f} %)."
        )


def brief(value):
    """A number with two digits, or more before the point."""
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.2g}"


def suggest_placement(
    solution,
    models,
    *,
    criterion="A",
    field_of_view=FIELD_OF_VIEW,
    pitch_limits=PITCH_LIMITS,
    images=3,
    steps=None,
    features=None,
    places=None,
):
    """The board pose and pitch angles of images that would shrink the uncertainty most.

    Parameters
    ----------
    solution : JointSolution
    models : dict of str to CameraModel
        Of every camera of the solution.
    criterion : {'A', 'D'}
        Least sum of variances of axis and cameras in metres at 2 m, or least volume.
    field_of_view, pitch_limits : tuple of float
        Bearings that the LRF measures and pitch angles that the platform reaches, radians.
    images : int
        Of each camera on the head; cameras on the base take one.
    steps, features
        See :func:`lrfcal_lib.forecast.measure_yield`.
    places : dict of str to sequence of float, optional
        Replaces entries of `PLACES`.

    Returns
    -------
    Suggestion

    Raises
    ------
    ValueError
        For an unknown criterion, a camera without a model, or limits out of order.
    DegenerateGeometry
        When no pose of the grid is seen by all.
    """
    _check(solution, models, criterion, field_of_view, pitch_limits)
    grid = board_grid(solution, **{**PLACES, **(places or {})})
    options = visible(grid, solution, models, field_of_view, pitch_limits, images)
    if len(options) == 0:
        low, high = np.degrees(pitch_limits)
        raise DegenerateGeometry(
            f"none of {len(grid)} board poses lies wholly in the view of the LRF and of all cameras at a pitch from "
            f"{low:.0f} to {high:.0f} deg: give other distances, wider limits, or check the calibration"
        )
    known = information(solution).sum(axis=0)
    added = candidate_information(options, solution, models, measure_yield(solution, models, steps, features))
    before, covariances = _covariances(known, solution), _covariances(known + added, solution)
    start, values = (_criterion(C, solution, criterion) for C in (before, covariances))
    best = int(np.argmin(values))
    return _suggestion(solution, options, best, before, covariances[best], 1 - values / start, criterion)


def _check(solution, models, criterion, field_of_view, pitch_limits):
    if criterion not in ("A", "D"):
        raise ValueError(f"criterion is 'A' or 'D', got {criterion!r}")
    missing = [c for c in solution.transforms if c not in models]
    if missing:
        raise ValueError(f"camera '{missing[0]}' has no intrinsics: give its CameraModel in `models`")
    for name, limits in (("field_of_view", field_of_view), ("pitch_limits", pitch_limits)):
        if not limits[0] < limits[1]:
            raise ValueError(f"{name} must be (lower, upper) in radians, got {limits}")


def _covariances(hessian, solution):
    """Covariances of the shared unknowns; what is not observed counts as known to a metre at 2 m, not better."""
    unit = PRIOR * scales_of(solution, solution.solution.names)
    scaled = hessian * unit[:, None] * unit + np.eye(len(unit))
    return np.linalg.inv(scaled) * unit[:, None] * unit


def _groups(solution):
    """Indices of the unknowns of the axis and of each camera."""
    found = {"axis": [i for i, n in enumerate(solution.solution.names) if n in AXIS_NAMES]}
    found |= {c: solution.columns(f"{c}_") for c in solution.transforms}
    return {name: index for name, index in found.items() if index}


def _scaled(covariance, solution, index):
    scales = scales_of(solution, np.array(solution.solution.names)[index])
    return covariance[..., np.array(index)[:, None], index] / (scales[:, None] * scales)


def _criterion(covariance, solution, criterion):
    """Standard deviation to be made small, metres at 2 m, (...)."""
    index = sum(_groups(solution).values(), [])
    C = _scaled(covariance, solution, index)
    if criterion == "A":
        return np.sqrt(np.trace(C, axis1=-2, axis2=-1))
    return np.exp(np.linalg.slogdet(C)[1] / (2 * len(index)))


def group_sigma(covariance, solution):
    """Standard deviation of the axis and of each camera, metres at 2 m."""
    groups = _groups(solution)
    return {name: float(np.sqrt(np.trace(_scaled(covariance, solution, index)))) for name, index in groups.items()}


def _suggestion(solution, options, best, before, after, gains, criterion):
    pose = {n: float(getattr(options, n)[best]) for n in ("distance", "bearing", "elevation", "turn", "lean")}
    return Suggestion(
        T_platform_board=placed(options, best), **pose, towards=str(options.towards[best]),
        pitches=options.pitches[best], before=group_sigma(before, solution), after=group_sigma(after, solution),
        covariance_after=after, gain=float(gains[best]), median_gain=float(np.median(gains)), candidates=len(options),
        criterion=criterion, on_head=bool(np.any(solution.data.on_head)),
    )  # fmt: skip


__all__ = ["Direction", "Suggestion", "brief", "direction_words", "group_sigma", "observability", "suggest_placement"]
