"""A SICK LMS2xx laser range finder: a spot of finite size, mixed pixels, noise, codes."""

import math
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt
from pydantic.dataclasses import dataclass
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.geometry import apply_pose, polar_to_points, pose_array, unit_vector
from lrfcal_lib.model.kinematics import platform_from_head
from lrfcal_lib.session.lms2xx_codec import (
    REASONS,
    VARIANTS,
    encode_values,
    largest,
    scan_quarters,
)
from lrfcal_lib.session.stated import LrfInfo
from lrfcal_lib.simulate.scene import World, need

NOT_VALID, DAZZLED, WEAK = (
    REASONS.index(words) for words in ("not valid", "dazzled", "noise")
)
UNITS = {0.001: "mm", 0.01: "cm"}  # by metres a count


@dataclass(frozen=True)
class Beam:
    """Settings of a laser range finder, an outdoor LMS221 by default.

    ValueError for those that no device has.
    """

    name: str = "LMS221-30206"
    # fields of view it can be set to, degrees (technical description, chapter 12); for the record
    angles: tuple[int, ...] = (100, 180)
    # diameter of the spot at the window, metres, and its growth with distance, radians (technical
    # description)
    spot_exit: NonNegativeFloat = 0.016
    divergence: NonNegativeFloat = 0.0119
    # statistical error, 1 sigma, metres (technical description)
    sigma_range: NonNegativeFloat = 0.010
    systematic: float = 0.0  # constant error of this one device, metres
    # largest systematic error that the maker admits, by unit, metres
    systematic_bound: tuple[tuple[float, float], ...] = ((0.001, 0.035), (0.01, 0.05))
    # variant in degrees and 1/100 degree, as telegram 0x3B sets them
    field_of_view: int = 180
    resolution: int = 50
    unit: float = 0.001  # metres a count: 0.001 or 0.01
    # surfaces nearer together than this along the beam give one reading (telegram listing, 10.2:
    # about 1 m)
    pulse: NonNegativeFloat = 1.0
    # weakest echo that is a range: the 10 % reflectivity that the maker states the greatest range
    # for, there
    least_energy: NonNegativeFloat = 0.1 / 30.0**2
    # an echo is taken when it has this share of the strongest one. Assumed: the receiver's gain
    # follows the strongest
    # echo; the maker states nothing. It widens what stands before a brighter background.
    least_share: Annotated[float, Field(ge=0, le=1)] = 0.25
    rings: NonNegativeInt = 4  # of sub-rays over the spot, 1 + 3 rings (rings + 1) of them

    def __post_init__(self):
        step = self.resolution / 100
        listed = ", ".join(f"{angle}/{step:g}" for angle, step in sorted(VARIANTS))
        need(
            (self.field_of_view, step) in VARIANTS,
            f"{self.name} has no whole scans of {self.field_of_view} deg in steps of {step:g} deg; "
            f"it can be set to {listed}",
        )

    @property
    def turns(self) -> int:
        """Mirror turns of one whole scan."""
        return 100 // self.resolution

    def bearings(self) -> np.ndarray:
        """Bearings of a whole scan, radians.

        Returns
        -------
        ndarray, shape (B,)
            0 right, pi/2 ahead (40 to 140 deg for 100 deg variants).
        """
        values = self.field_of_view * 100 // self.resolution + 1
        return np.radians(scan_quarters(values) / 4)

    @property
    def unit_name(self) -> str:
        """'mm' or 'cm'."""
        return UNITS[self.unit]

    def info(self, made: str) -> LrfInfo:
        """What a session states of it.

        Parameters
        ----------
        made
            How: 'simulated'.
        """
        return LrfInfo(
            f"{self.name} ({made})",
            tuple(self.bearings()[[0, -1]].tolist()),
            math.radians(self.resolution / 100),
            self.sigma_range,
            range_resolution=self.unit,
            max_range=largest(0) * self.unit,
            spot_exit=self.spot_exit,
            spot_divergence=self.divergence,
        )


LMS221 = Beam()


def spot_pattern(rings: int) -> np.ndarray:
    """Points for equal parts of the unit disc across x: one in the middle, 6 k on ring k.

    Turning the pattern by 60 deg changes nothing: its centre and its moments of inertia are those
    of the disc.

    Parameters
    ----------
    rings

    Returns
    -------
    ndarray, shape (K, 3)
    """
    count = np.r_[1, 6 * np.arange(1, rings + 1)]
    inside = np.cumsum(count)
    radius = np.sqrt((inside - count / 2) / inside[-1])
    radius[0] = 0.0
    turn = np.concatenate([2 * np.pi * np.arange(n) / n for n in count])
    return np.roll(polar_to_points(np.repeat(radius, count), turn), 1, axis=1)


def echo(
    beam: Beam, distance: np.ndarray, energy: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Readings out of sub-rays.

    Surfaces within one pulse length of the nearest one blend into its reading, weighted by energy
    (a mixed pixel); what is farther makes an echo of its own. The first echo above both thresholds
    is the reading.

    Parameters
    ----------
    beam
    distance
        Of the sub-rays of spots, metres, inf where they end nowhere, shape (n, K).
    energy
        That they bring back, shape (n, K).

    Returns
    -------
    reading, total : ndarray, shape (n,)
        Metres, NaN without an echo; the whole energy.
    """
    left = distance
    places = []
    strengths = []
    with np.errstate(invalid="ignore"):  # of what ends nowhere, and of groups without a ray
        moments = energy * distance
        while not places or np.isfinite(left).any():
            near = left.min(axis=1, keepdims=True)
            group = np.isfinite(left) & (left <= near + beam.pulse)
            strengths.append(energy.sum(axis=1, where=group))
            places.append(moments.sum(axis=1, where=group) / strengths[-1])
            left = np.where(group, np.inf, left)
    best = np.max(strengths, axis=0)
    threshold = np.maximum(beam.least_energy, beam.least_share * best)
    good = np.greater_equal(strengths, threshold)
    return np.select(good, places, np.nan), sum(strengths)


class Readings(NamedTuple):
    """Of beams, without noise, offset and rounding: metres (NaN without an echo), and why there is
    none, index into REASONS.
    """

    reading: np.ndarray
    reasons: np.ndarray


def ideal_readings(
    beam: Beam,
    world: World,
    bearings: np.ndarray,
    pitch: np.ndarray,
    T_head_lrf: RigidTransform,
) -> Readings:
    """Readings without noise, offset and rounding.

    Parameters
    ----------
    beam
    world
    bearings, pitch
        Of the beams, radians, shape (n,), the pitch also (1,).
    T_head_lrf

    Returns
    -------
    Readings
        Of shape (n,).

    Notes
    -----
    Sub-rays leave a disc of `spot_exit` about the mirror. The energy of one is reflectivity times
    cosine of incidence over squared distance (a Lambertian surface). The nearer part of a spot on a
    slanted plane is therefore brighter: at 45 deg the reading is 0.09 mm short.
    """
    disc = spot_pattern(beam.rings)
    turn = RigidTransform.from_rotation(Rotation.from_euler("z", bearings[:, None]))
    pose = pose_array(platform_from_head(pitch) * T_head_lrf * turn)
    ahead = unit_vector([1.0, 0.0, 0.0] + beam.divergence / 2 * disc)
    origins = apply_pose(pose, beam.spot_exit / 2 * disc)
    hits = world.cast(origins, ahead @ pose[..., :3].mT)
    reflected = world.infrared(hits.points, hits.thing) * hits.cosine
    energy = reflected / hits.distance**2 / len(disc)
    reading, total = echo(beam, hits.distance, energy)
    dazzled = world.dazzling[hits.thing].any(axis=1)
    known = [dazzled, np.isfinite(reading), total > 0]
    return Readings(reading, np.select(known, [DAZZLED, 0, WEAK], NOT_VALID))


def measured(
    beam: Beam, ideal: Readings, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Noisy ranges out of ideal readings.

    Parameters
    ----------
    beam
    ideal
        Of shape (n,), or any other.
    rng

    Returns
    -------
    ranges, reasons : ndarray
        Metres, and why there is none: index into REASONS.
    """
    ranges = rng.normal(ideal.reading + beam.systematic, beam.sigma_range)
    return np.maximum(ranges, 0), ideal.reasons


def scan(
    beam: Beam,
    world: World,
    pitch: np.ndarray,
    T_head_lrf: RigidTransform,
    rng: np.random.Generator,
) -> np.ndarray:
    """Record scan lines.

    Parameters
    ----------
    beam
    world
    pitch
        The true one of the head, radians, in each line (L, 1) or beam (L, B).
    T_head_lrf
    rng

    Returns
    -------
    ndarray of uint16, shape (L, B)
        Words of 13 bits.
    """
    words = []
    bearings = beam.bearings()
    for pitches in pitch:
        ideal = ideal_readings(beam, world, bearings, pitches, T_head_lrf)
        ranges, reasons = measured(beam, ideal, rng)
        words.append(encode_values(ranges, unit=beam.unit_name, reasons=reasons))
    return np.array(words)
