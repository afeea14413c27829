"""Two calibrations of one rig: how far they differ, beside what both claim to know."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.linalg import pinvh
from scipy.spatial.transform import RigidTransform
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
    root_mean_square,
    spread,
)
from lrfcal_lib.model.camera import project, project_jacobians
from lrfcal_lib.model.geometry import (
    POSE_NAMES,
    length_of,
    pose_step,
)
from lrfcal_lib.session.read import open_session

DISTANCE = 2.0  # metres, at which differences are looked at, as the verdict does
PIXELS = (12, 9)  # columns and rows of the image
BEARINGS = 13  # of the field of view
PITCHES = np.radians(np.linspace(-15, 15, 9))
CHANCE = 0.01  # below it two calibrations are said to differ
UNITS = {  # of amounts: factor and name
    "turn": (np.degrees(1.0), "deg"),
    "shift": (1000.0, "mm"),
    "scale": (100.0, "%"),
}
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
    amounts : list of Amount
    chi2 : float
        Of its parameters by both covariances.
    freedom : int
    p : float
        How often honest calibrations differ more.
    p_of_others : float
        How often all other parts together do.
    """

    name: str
    amounts: list[Amount]
    chi2: float
    freedom: int
    p: float
    p_of_others: float

    def __str__(self):
        amounts = ", ".join(map(str, self.amounts))
        return f"{self.name}: {amounts}; chi2 {self.chi2:.1f} of {self.freedom}, p = {self.p:.2g}"


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
        Standard deviation as both claim, root of the sum over k; NaN where no beam gets.
    """

    at: np.ndarray
    off: np.ndarray
    claimed: np.ndarray

    def amount(self, unit: str, scale: float = 1.0) -> Amount:
        """Root mean squares as an Amount, times `scale`."""
        return Amount(
            what=f"at {DISTANCE:g} m",
            value=scale * root_mean_square(length_of(self.off)),
            claimed=scale * root_mean_square(self.claimed),
            unit=unit,
        )


@dataclass(frozen=True)
class Comparison:
    """How far a second calibration of a rig is from the first.

    Attributes
    ----------
    first, second : CalibratedRig
    parts : list of Part
        Axis, sensor and every camera.
    whole : Part
        All their parameters, and the cloud.
    images : dict of str to Shifts
        By camera.
    cloud : Shifts
        Of points relative to the head at pitch 0.
    one_lens : bool
        Both use the same intrinsics, whose errors are not in what is claimed.
    """

    first: CalibratedRig
    second: CalibratedRig
    parts: list[Part]
    whole: Part
    images: dict[str, Shifts]
    cloud: Shifts
    one_lens: bool

    @property
    def within(self) -> bool:
        """Whether the difference is within what both claim."""
        return self.whole.p >= CHANCE

    def sentence(self) -> str:
        """The answer."""
        share = float(f"{100 * self.whole.p:.2g}")  # 100, not 1e+02
        odds = f"honest calibrations differ more in {share:g} % of cases"
        if self.one_lens:
            odds += "; both use the same intrinsics, whose errors do not count"
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


def compare(first: CalibratedRig, second: CalibratedRig) -> Comparison:
    """Compare two calibrations of a rig.

    A turn about the tilt axis and a shift along it, which no data show, do not count, nor do errors
    of intrinsics that both were told alike. Others that both share, as of a board, make them agree
    better than they claim.

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
    lens, other_lens = (
        [rig.cameras[name].model.parameters for name in shared] for rig in (first, second)
    )
    one_lens = np.array_equal(lens, other_lens)  # from one place, equal to the last bit
    if one_lens:
        first = _without_lens(first)
        second = _without_lens(second)
    second_there = in_gauge_of(first, second)
    steps = _steps(first, second_there, shared)
    step = pd.concat(steps.values())
    covariance = sum(
        pd.DataFrame(known.trusted, known.names, known.names)
        for known in (first.known, second.known)
    )
    # nothing bounds what only one estimated
    covariance = covariance.reindex(index=step.index, columns=step.index).fillna(np.inf)
    images = {name: shifts(first, second_there, name) for name in shared}
    parts = [
        _part(name, of_part.index, step, covariance, images)
        for name, of_part in steps.items()
    ]
    cloud = shifts(first, second_there)
    moved = [cloud.amount("mm in the cloud", 1000)]
    whole = Part("everything", moved, *_chi2(step, covariance, step.index), 1.0)
    return Comparison(first, second, parts, whole, images, cloud, one_lens)


def _part(name, names, step, covariance, images):
    """The Part of some differences: turns or a scale, as many shifts, and pixels of a camera."""
    amounts = []
    kinds = ("scale" if name == "sensor" else "turn", "shift")
    for what, members in zip(kinds, np.split(names, 2), strict=True):
        scale, unit = UNITS[what]
        amounts.append(
            Amount(
                what=what,
                value=scale * length_of(step[members]),
                claimed=scale * np.sqrt(np.trace(covariance.loc[members, members])),
                unit=unit,
            )
        )
    if name in images:
        amounts.append(images[name].amount("px"))
    *_, p_of_others = _chi2(step, covariance, step.index.difference(names))
    return Part(name, amounts, *_chi2(step, covariance, names), p_of_others)


def _chi2(step, covariance, names) -> tuple[float, int, float]:
    """Chi-square of some differences, its degrees of freedom, and how often chance exceeds it."""
    covariance = covariance.loc[names, names]
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance.div(sigma, axis=0) / sigma
    # NaN for what nothing bounds, or one of the two took as it is
    known = np.diag(correlation) > 0
    if not known.any():
        return 0.0, 0, 1.0
    inverse, freedom = pinvh(correlation.loc[known, known], rtol=TOLD, return_rank=True)
    z = (step[names] / sigma)[known]
    chi2 = z @ inverse @ z
    return chi2, freedom, chdtrc(freedom, chi2)


def _without_lens(rig):
    """A rig whose intrinsics are exact."""
    known = rig.known
    known = replace(
        known,
        covariance=known.covariance - known.lens,
        trusted=known.trusted - known.lens,
    )
    return replace(rig, uncertainty=known)


def in_gauge_of(first: CalibratedRig, second: CalibratedRig) -> CalibratedRig:
    """The second rig, its platform frame turned about the tilt axis and shifted along it to be
    that of the first.

    Parameters
    ----------
    first, second : CalibratedRig
    """
    step = pose_step(second.T_head_lrf, first.T_head_lrf)
    step[AXIS_COLUMNS] = 0  # what is left turns about x, and shifts along it
    gauge = RigidTransform.from_exp_coords(step)
    on_base = {
        name: replace(camera, T_camera=camera.T_camera * gauge.inv())
        for name, camera in second.cameras.items()
        if camera.mount == "platform"
    }
    axis = replace(second.axis, T_head_lrf=gauge * second.T_head_lrf)
    return replace(second, axis=axis, cameras=second.cameras | on_base)


def _steps(first, second, shared):
    """Increments from the first rig to the second: radians, metres, a fraction, by part and name.

    Turns or a scale, then as many shifts.
    """
    by_axis = pose_step(first.T_head_lrf, second.T_head_lrf)[AXIS_COLUMNS]
    before = first.corrections
    after = second.corrections
    sensor = {
        "pitch_scale": after.pitch_scale - before.pitch_scale,
        "range_offset": after.range_offset - before.range_offset,
    }
    steps = {"axis": pd.Series(by_axis, AXIS_NAMES), "sensor": pd.Series(sensor)}
    for name in shared:
        steps[name] = pd.Series(
            pose_step(first.cameras[name].T_camera, second.cameras[name].T_camera),
            [f"{name}_{pose}" for pose in POSE_NAMES],
        )
    return steps


def shifts(
    first: CalibratedRig, second: CalibratedRig, camera: str | None = None
) -> Shifts:
    """How the second rig shifts the ends of beams that are `DISTANCE` long by the first.

    Parameters
    ----------
    first, second : CalibratedRig
        In one gauge.
    camera : str, optional
        In its image, taken at pitch 0; unless given, relative to the head at pitch 0.

    Returns
    -------
    Shifts
    """
    if camera is None:
        bearing, pitch = np.meshgrid(
            np.linspace(*first.lrf.field_of_view, BEARINGS), PITCHES
        )
        at = np.stack([bearing, pitch], axis=-1)
    else:
        model = first.cameras[camera].model
        at = pixel_grid(model, PIXELS)
        bearing, pitch = beams_of_pixels(chain_of(first, camera), model, at, DISTANCE, 0.0)
    recorded = pitch / (1 + first.corrections.pitch_scale)
    ends = []
    sigma = np.zeros_like(bearing)
    for rig in (first, second):
        chain = chain_of(rig, camera)
        true = recorded * (1 + rig.corrections.pitch_scale)
        length = DISTANCE + first.corrections.range_offset - rig.corrections.range_offset
        end, derivative, _ = carried(chain, bearing, true, length)
        if camera is not None:
            model = rig.cameras[camera].model
            derivative = project_jacobians(end, model)[0] @ derivative
            end = project(end, model)
        ends.append(end)
        sigma = np.hypot(sigma, spread(chain, derivative))
    return Shifts(at, ends[1] - ends[0], sigma)


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
