"""Two calibrations of one rig: how far they differ, beside what both claim to know."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import chdtrc

from lrfcal_lib.calibrate.calibration_file import load_calibration, require_same_rig
from lrfcal_lib.calibrate.pipeline import calibrate, handed_over
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.fit.axis_chart import AXIS_COLUMNS
from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.judge.uncertainty import (
    beams_of_pixels,
    carried,
    chain_of,
    pixel_grid,
    spread,
    uncertainty_of,
)
from lrfcal_lib.model.camera import project, project_jacobians
from lrfcal_lib.model.geometry import POSE_NAMES
from lrfcal_lib.session.read import open_session

DISTANCE = 2.0  # metres, at which differences are looked at, as the verdict does
PIXELS = (12, 9)  # columns and rows of the image
BEARINGS = 13  # of the field of view
PITCHES = np.radians(np.linspace(-15, 15, 9))
CHANCE = 0.01  # below it two calibrations are said to differ
TOLD = 1e-9  # share of the largest eigenvalue: less is no freedom of its own


@dataclass(frozen=True)
class Amount:
    """A difference and its standard deviation as both calibrations claim, in one unit.

    `claimed` is infinite where nothing bounds it.
    """

    what: str
    value: float
    claimed: float
    unit: str

    def __str__(self):
        claimed = f"{self.claimed:.2g}" if np.isfinite(self.claimed) else "no bound"
        return f"{self.what} {self.value:.2g} {self.unit} (claimed {claimed})"


@dataclass(frozen=True)
class Part:
    """What differs of one part of a rig.

    Attributes
    ----------
    name : str
        'axis', 'sensor', or a camera's.
    amounts : tuple of Amount
    chi2 : float
        Of its parameters by both covariances.
    freedom : int
    p : float
        How often honest calibrations differ more.
    p_of_others : float
        How often all other parts together do.
    """

    name: str
    amounts: tuple[Amount, ...]
    chi2: float
    freedom: int
    p: float
    p_of_others: float

    def __str__(self):
        amounts = ", ".join(map(str, self.amounts))
        test = f"chi2 {self.chi2:.1f} of {self.freedom}, p = {self.p:.2g}"
        return f"{self.name}: {amounts}; {test}"


@dataclass(frozen=True)
class Shifts:
    """By how much one calibration shifts what the other one shows at `DISTANCE`.

    Attributes
    ----------
    at : ndarray, shape (rows, columns, 2)
        Pixels of an image, or bearings and pitches (radians) of the cloud.
    off : ndarray, shape (rows, columns, k)
        Pixels (k = 2), or metres (k = 3).
    claimed : ndarray, shape (rows, columns)
        Standard deviation as both claim, root of the sum over k.
    """

    at: np.ndarray
    off: np.ndarray
    claimed: np.ndarray

    def amount(self, unit: str, scale: float = 1.0) -> Amount:
        """Root mean squares as an Amount, times `scale`."""
        value = scale * np.sqrt(np.nanmean(np.sum(self.off**2, axis=-1)))
        claimed = scale * np.sqrt(np.mean(self.claimed[np.isfinite(self.off[..., 0])] ** 2))
        return Amount(f"at {DISTANCE:g} m", float(value), float(claimed), unit)


@dataclass(frozen=True)
class Comparison:
    """How far a second calibration of a rig is from the first.

    Attributes
    ----------
    first, second : CalibratedRig
    parts : tuple of Part
        Axis, sensor and every camera.
    whole : Part
        All their parameters, and the cloud.
    images : dict of str to Shifts
        By camera.
    cloud : Shifts
        Of points relative to the head at pitch 0.
    """

    first: CalibratedRig
    second: CalibratedRig
    parts: tuple[Part, ...]
    whole: Part
    images: dict[str, Shifts]
    cloud: Shifts

    @property
    def within(self) -> bool:
        """Whether the difference is within what both claim."""
        return self.whole.p >= CHANCE

    def sentence(self) -> str:
        """The answer."""
        odds = f"honest calibrations differ more in {_percent(self.whole.p)} of cases"
        names = f"'{self.first.session}' and '{self.second.session}'"
        if self.within:
            return f"{names} differ within what both claim ({odds})."
        suspects = [part.name for part in self.parts if part.p_of_others >= CHANCE]
        where = "in more than one part"
        if suspects:
            where = f"in {' or '.join(suspects)} alone, all others agree"
        return (
            f"{names} differ by more than both claim ({odds}): {where}. The rig has changed in "
            "between, or one of them errs."
        )


def _percent(share):
    """A share in words."""
    if share < 1e-4:
        return "less than 0.01 %"
    return f"{100 * share:.{0 if share > 0.1 else 2}f} %"


def compare(first: CalibratedRig, second: CalibratedRig) -> Comparison:
    """Compare two calibrations of a rig.

    A turn about the tilt axis and a shift along it, which no data show, do not count. Errors that
    both share, as of intrinsics or of a board that both were told of, make them agree better than
    they claim.

    Parameters
    ----------
    first, second : CalibratedRig

    Returns
    -------
    Comparison
        Of the cameras that both know.

    Raises
    ------
    ValueError
        For calibrations of different rigs, or one that does not say how well it knows the rig.
    """
    require_same_rig(first, second)
    shared = [name for name in first.cameras if name in second.cameras]
    second_there = in_gauge_of(first, second)
    steps = dict(_steps(first, second_there, shared))
    test = _Test(steps, _covariance(first, list(steps)) + _covariance(second, list(steps)))
    images = {name: image_shifts(first, second_there, name) for name in shared}
    cloud = cloud_shifts(first, second_there)
    parts = [
        test.part("axis", AXIS_NAMES[:2], AXIS_NAMES[2:]),
        test.part("sensor", ("pitch_scale",), ("range_offset",)),
    ]
    for name in shared:
        names = [f"{name}_{pose}" for pose in POSE_NAMES]
        parts.append(test.part(name, names[:3], names[3:], images[name].amount("px")))
    whole = test.part("everything", (), (), cloud.amount("mm in the cloud", 1000))
    return Comparison(first, second, tuple(parts), whole, images, cloud)


def in_gauge_of(first: CalibratedRig, second: CalibratedRig) -> CalibratedRig:
    """The second rig, its platform frame turned about the tilt axis and shifted along it to be
    that of the first.

    Parameters
    ----------
    first, second : CalibratedRig
    """
    apart = first.T_head_lrf * second.T_head_lrf.inv()
    turn = Rotation.from_rotvec(apart.rotation.as_rotvec() * [1, 0, 0])
    moved = second.T_head_lrf.translation
    shift = (first.T_head_lrf.translation - turn.apply(moved)) * [1, 0, 0]
    gauge = RigidTransform.from_components(shift, turn)
    cameras = {}
    for name, camera in second.cameras.items():
        if camera.mount == "platform":
            camera = replace(camera, T_camera=camera.T_camera * gauge.inv())
        cameras[name] = camera
    axis = replace(second.axis, T_head_lrf=gauge * second.T_head_lrf)
    return replace(second, axis=axis, cameras=cameras)


def _steps(first, second, shared) -> Iterator[tuple[str, float]]:
    """Increments from the first rig to the second by name, radians, metres and a fraction."""
    by_axis = _increments(first.T_head_lrf, second.T_head_lrf)[AXIS_COLUMNS]
    yield from zip(AXIS_NAMES, by_axis, strict=True)
    for name in shared:
        step = _increments(first.cameras[name].T_camera, second.cameras[name].T_camera)
        yield from zip([f"{name}_{pose}" for pose in POSE_NAMES], step, strict=True)
    one = first.corrections
    other = second.corrections
    yield "range_offset", other.range_offset - one.range_offset
    yield "pitch_scale", other.pitch_scale - one.pitch_scale


def _increments(first, second):
    """``[w, v]`` (6,) from one RigidTransform to another."""
    turn = second.rotation * first.rotation.inv()
    return np.r_[turn.as_rotvec(), second.translation - first.translation]


def _covariance(rig, names):
    """Covariance to rely on of shared unknowns; what was taken as it is has no bound."""
    known = uncertainty_of(rig)
    covariance = np.zeros((len(names), len(names)))
    np.fill_diagonal(covariance, np.inf)
    rows = [row for row, name in enumerate(names) if name in known.names]
    index = [known.names.index(names[row]) for row in rows]
    covariance[np.ix_(rows, rows)] = known.trusted[np.ix_(index, index)]
    return covariance


@dataclass(frozen=True)
class _Test:
    """Differences by name, and their covariance."""

    steps: dict[str, float]
    covariance: np.ndarray

    def part(self, name, turns, shifts, *more):
        """The Part of some turns and shifts; of everything where there are none."""
        amounts = []
        if turns:
            scale, unit = (100, "%") if name == "sensor" else (np.degrees(1.0), "deg")
            amounts.append(
                self._amount("scale" if unit == "%" else "turn", turns, scale, unit)
            )
        if shifts:
            amounts.append(self._amount("shift", shifts, 1000, "mm"))
        names = [*turns, *shifts] or list(self.steps)
        chi2, freedom = self._chi2(names)
        others = self._chi2([other for other in self.steps if other not in names])
        p = _exceeds(chi2, freedom)
        return Part(name, (*amounts, *more), chi2, freedom, p, _exceeds(*others))

    def _amount(self, what, names, scale, unit):
        index = self._index(names)
        value = np.linalg.norm([self.steps[name] for name in names])
        claimed = np.sqrt(np.trace(self.covariance[np.ix_(index, index)]))
        return Amount(what, scale * float(value), scale * float(claimed), unit)

    def _index(self, names):
        return [list(self.steps).index(name) for name in names]

    def _chi2(self, names):
        """Chi-square of the differences and its degrees of freedom.

        Without what nothing bounds, or one of the two took as it is.
        """
        index = np.array(self._index(names), int)
        variance = np.diag(self.covariance)[index]
        index = index[np.isfinite(variance) & (variance > 0)]
        sigma = np.sqrt(np.diag(self.covariance)[index])
        z = np.array(list(self.steps.values()))[index] / sigma
        correlation = self.covariance[np.ix_(index, index)] / np.outer(sigma, sigma)
        inverse = np.linalg.pinv(correlation, rcond=TOLD, hermitian=True)
        return float(z @ inverse @ z), int(np.linalg.matrix_rank(inverse, hermitian=True))


def _exceeds(chi2, freedom):
    """How often chance exceeds a chi-square; always, where nothing is free."""
    return float(chdtrc(freedom, chi2)) if freedom else 1.0


def recorded_by(rig: CalibratedRig, pitch, distance):
    """What a rig records of beams of some true pitch (radians) and length (metres)."""
    by_scale = 1 + rig.corrections.pitch_scale
    return np.asarray(pitch) / by_scale, np.asarray(distance) + rig.corrections.range_offset


def true_beams(rig: CalibratedRig, pitch, distance):
    """Inverse of :func:`recorded_by`."""
    by_scale = 1 + rig.corrections.pitch_scale
    return np.asarray(pitch) * by_scale, np.asarray(distance) - rig.corrections.range_offset


def image_shifts(first: CalibratedRig, second: CalibratedRig, name: str) -> Shifts:
    """How the second rig shifts points of scans in the image of a camera, taken at pitch 0.

    Parameters
    ----------
    first, second : CalibratedRig
        In one gauge.
    name : str
        The camera.
    """
    model = first.cameras[name].model
    pixels = pixel_grid(model, PIXELS)
    chain = chain_of(first, name)
    bearing, pitch = beams_of_pixels(chain, model, pixels, DISTANCE, 0.0)
    variance = _squares(chain, model, bearing, pitch, DISTANCE)
    recorded = recorded_by(first, pitch, DISTANCE)
    there = true_beams(second, *recorded)
    other = chain_of(second, name)
    points, *_ = carried(other, bearing, *there)
    there_model = second.cameras[name].model
    variance = variance + _squares(other, there_model, bearing, *there)
    return Shifts(pixels, project(points, there_model) - pixels, np.sqrt(variance))


def _squares(chain, model, bearing, pitch, distance):
    """Variances (...) in px^2 of the ends of beams in an image at pitch 0."""
    points, by_link, _ = carried(chain, bearing, pitch, distance)
    return spread(chain, project_jacobians(points, model)[0] @ by_link) ** 2


def cloud_shifts(first: CalibratedRig, second: CalibratedRig) -> Shifts:
    """How the second rig shifts points of scans, relative to the head at pitch 0.

    Parameters
    ----------
    first, second : CalibratedRig
        In one gauge.
    """
    bearings = np.linspace(*first.lrf.field_of_view, BEARINGS)
    at = np.stack(np.meshgrid(bearings, PITCHES), axis=-1)
    bearing, pitch = np.moveaxis(at, -1, 0)
    ends = []
    variance = np.zeros(bearing.shape)
    for rig in (first, second):
        chain = chain_of(rig)
        points, by_link, _ = carried(chain, bearing, *true_beams(rig, pitch, DISTANCE))
        ends.append(points)
        variance = variance + spread(chain, by_link) ** 2
    return Shifts(at, ends[1] - ends[0], np.sqrt(variance))


def rig_at(path: str | Path) -> CalibratedRig:
    """The rig of a ``calibration.json``, of the folder it is in, or of a session, which is
    calibrated.

    Parameters
    ----------
    path : path-like

    Raises
    ------
    ValueError
        Where there is none.
    """
    path = Path(path)
    if (path / "session.json").exists():
        calibration = calibrate(open_session(path))
        method = handed_over(calibration)
        if method is None:
            raise ValueError(f"{path}: cannot be calibrated; 'calibrate' says why")
        return calibration.rig(method)
    return load_calibration(path)


def history(rigs: Sequence[CalibratedRig]) -> list[Comparison]:
    """Every calibration of a rig beside the one before it.

    Parameters
    ----------
    rigs : sequence of CalibratedRig
    """
    return [compare(*pair) for pair in zip(rigs[:-1], rigs[1:], strict=True)]
