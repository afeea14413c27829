"""A SICK LMS2xx laser range finder: a spot of finite size, mixed pixels, noise, codes, and
beams one after another.
"""

import math
from dataclasses import dataclass

import numpy as np

from lrfcal_lib.model.geometry import tilt
from lrfcal_lib.session.lms2xx_codec import MODES, REASONS, encode_values
from lrfcal_lib.session.stated import LrfInfo
from lrfcal_lib.simulate.scene import need

NOT_VALID, DAZZLED, WEAK = (REASONS.index(words) for words in ("not valid", "dazzled", "noise"))
# deg, 1/100 deg: of telegram 0x3B
VARIANTS = ((100, 25), (100, 50), (100, 100), (180, 50), (180, 100))
RAYS_AT_ONCE = 1 << 19


@dataclass(frozen=True)
class Beam:
    """Settings of a laser range finder, an outdoor LMS221 by default.

    ValueError for those that no device has.
    """

    name: str = "LMS221-30206"
    # fields of view it can be set to, degrees (technical description, chapter 12)
    angles: tuple[int, ...] = (100, 180)
    # diameter of the spot at the window, metres, and its growth with distance, radians (technical
    # description)
    spot_exit: float = 0.016
    divergence: float = 0.0119
    sigma_range: float = 0.010  # statistical error, 1 sigma, metres (technical description)
    systematic: float = 0.0  # constant error of this one device, metres
    # largest systematic error that the maker admits, by unit, metres
    systematic_bound: tuple[tuple[float, float], ...] = ((0.001, 0.035), (0.01, 0.05))
    # variant in degrees and 1/100 degree, as telegram 0x3B sets them
    field_of_view: int = 180
    resolution: int = 50
    unit: float = 0.001  # metres a count: 0.001 or 0.01
    # surfaces nearer together than this along the beam give one reading (telegram listing, 10.2:
    # about 1 m)
    pulse: float = 1.0
    # weakest echo that is a range: the 10 % reflectivity that the maker states the greatest range
    # for, there
    least_energy: float = 0.1 / 30.0**2
    # an echo is taken when it has this share of the strongest one. Assumed: the receiver's gain
    # follows the strongest
    # echo; the maker states nothing. It widens what stands before a brighter background.
    least_share: float = 0.25
    rings: int = 4  # of sub-rays over the spot, 1 + 3 rings (rings + 1) of them

    def __post_init__(self):
        known = [variant for variant in VARIANTS if variant[0] in self.angles]
        variant = f"{self.field_of_view} deg in steps of {self.resolution / 100:g} deg"
        words = f"no whole scans of {variant}; it can be set to {', '.join(f'{a}/{s / 100:g}' for a, s in known)}"
        need((self.field_of_view, self.resolution) in known, f"{self.name} has {words}")
        for name in ("spot_exit", "divergence", "sigma_range", "pulse", "least_energy"):
            value = getattr(self, name)
            need(
                0 <= value < math.inf,
                f"{self.name}: {name} is {value}, it must be zero or positive",
            )
        bound = dict(self.systematic_bound).get(self.unit)
        need(bound, f"{self.name}: the unit is 0.001 or 0.01 m, got {self.unit}")
        offset = f"{self.name}: a systematic error of {self.systematic} m"
        need(abs(self.systematic) <= bound, f"{offset} is beyond the maker's {bound} m")
        share = f"least_share is {self.least_share}, a share lies between 0 and 1"
        need(0 <= self.least_share <= 1, f"{self.name}: {share}")
        need(
            self.rings >= 0,
            f"{self.name}: {self.rings} rings of rays cannot fill the spot, take 0 (one ray) or more",
        )

    @property
    def rays(self):
        """Sub-rays of one spot."""
        return 1 + 3 * self.rings * (self.rings + 1)

    @property
    def turns(self):
        """Mirror turns of one whole scan."""
        return 100 // self.resolution

    def bearings(self):
        """Bearings of a whole scan, shape (B,), radians.

        0 right, pi/2 ahead (40 to 140 deg for 100 deg variants).
        """
        count = self.field_of_view * 100 // self.resolution + 1
        return np.radians(90 - self.field_of_view / 2 + np.arange(count) * self.resolution / 100)

    @property
    def unit_name(self):
        """'mm' or 'cm'."""
        return "mm" if self.unit < 0.005 else "cm"

    def info(self, made):
        """What a session states of it, an LrfInfo; `made` is how ('simulated')."""
        return LrfInfo(
            f"{self.name} ({made})",
            tuple(self.bearings()[[0, -1]].tolist()),
            math.radians(self.resolution / 100),
            self.sigma_range,
            range_resolution=self.unit,
            max_range=MODES[0].largest * self.unit,
            spot_exit=self.spot_exit,
            spot_divergence=self.divergence,
        )


LMS221 = Beam()


def spot_pattern(rings):
    """Points that stand for equal parts of the unit disc: one in the middle, 6 k on the k-th ring,
    shape (K, 2).

    Turning the pattern by 60 deg changes nothing: its centre and its moments of inertia are those
    of the disc.
    """
    count = np.r_[1, 6 * np.arange(1, rings + 1)]
    inside = np.cumsum(count)
    radius = np.sqrt((inside - count / 2) / inside[-1])
    radius[0] = 0.0
    turn = np.concatenate([2 * np.pi * np.arange(n) / n for n in count])
    return np.repeat(radius, count)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def echo(beam, distance, energy):
    """One reading (n,), NaN without an echo, and the whole energy (n,) out of the sub-rays (n, K)
    of spots.

    Surfaces within one pulse length of the nearest one blend into its reading, weighted by energy
    (a mixed pixel); what is farther makes an echo of its own. The first echo above both thresholds
    is the reading.
    """
    left = np.where(np.isfinite(distance), distance, np.inf)
    best = np.zeros(len(distance))
    echoes = []
    while np.isfinite(left).any():
        near = left.min(axis=1)
        group = np.isfinite(left) & (left <= near[:, None] + beam.pulse)
        part = np.where(group, energy, 0.0)
        strength = part.sum(axis=1)
        mean = np.sum(part * np.where(group, distance, 0.0), axis=1)
        echoes.append(
            (
                np.divide(mean, strength, out=np.full(len(near), np.nan), where=strength > 0),
                strength,
            )
        )
        best = np.maximum(best, strength)
        left = np.where(group, np.inf, left)
    reading = np.full(len(distance), np.nan)
    for place, strength in reversed(echoes):
        good = (strength >= np.maximum(beam.least_energy, beam.least_share * best)) & np.isfinite(
            place
        )
        reading = np.where(good, place, reading)
    return reading, sum((strength for _, strength in echoes), np.zeros(len(distance)))


def ideal_readings(beam, world, bearings, pitch, T_head_lrf):
    """Readings without noise, offset and rounding, of beams at bearings (n,) while the head is at
    pitch (n,), radians.

    Returns
    -------
    reading, total : ndarray, shape (n,)
        Metres, NaN without an echo; returned energy.
    dazzled : ndarray of bool, shape (n,)

    Notes
    -----
    Sub-rays leave a disc of `spot_exit` about the mirror. The energy of one is reflectivity times
    cosine of incidence over squared distance (a Lambertian surface). The nearer part of a spot on a
    slanted plane is therefore brighter: at 45 deg the reading is 0.09 mm short.
    """
    c = np.cos(bearings)
    s = np.sin(bearings)
    zero = np.zeros_like(c)
    disc = spot_pattern(beam.rings)
    across = np.stack([-s, c, zero], axis=-1)
    up = np.array([0.0, 0.0, 1.0])
    shift = disc[:, :1] * across[:, None] + disc[:, 1:] * up
    directions = np.stack([c, s, zero], axis=-1)[:, None] + beam.divergence / 2 * shift
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    rotation = T_head_lrf.rotation.as_matrix().T
    origins = tilt(
        beam.spot_exit / 2 * shift @ rotation + T_head_lrf.translation, pitch[:, None]
    ).reshape(-1, 3)
    directions = tilt(directions @ rotation, pitch[:, None]).reshape(-1, 3)
    hits = world.cast(origins, directions)
    seen = hits.face >= 0
    energy = np.zeros(len(seen))
    distance = hits.distance[seen]
    points = origins[seen] + distance[:, None] * directions[seen]
    cosine = np.abs(np.sum(world.normals[hits.face[seen]] * directions[seen], axis=1))
    energy[seen] = world.infrared(points, hits.thing[seen]) * cosine / distance**2 / beam.rays
    shape = len(bearings), beam.rays
    reading, total = echo(beam, hits.distance.reshape(shape), energy.reshape(shape))
    return reading, total, world.dazzling[hits.thing].reshape(shape).any(axis=1)


def measured(beam, reading, total, dazzled, rng):
    """What the device makes of ideal readings: noisy ranges, metres, and why there is none
    (index into REASONS).
    """
    ranges = reading + beam.systematic + beam.sigma_range * rng.standard_normal(reading.shape)
    reasons = np.where(np.isfinite(reading), 0, np.where(total > 0, WEAK, NOT_VALID))
    return np.clip(ranges, 0, None), np.where(dazzled, DAZZLED, reasons)


def scan(beam, world, pitch, T_head_lrf, rng):
    """Record scan lines, words (L, B) of 13 bits, at the true pitch of the head in each line
    (L, 1) or beam (L, B).
    """
    bearings, pitch = np.broadcast_arrays(beam.bearings(), pitch)
    flat = (bearings.ravel(), pitch.ravel())
    step = max(1, RAYS_AT_ONCE // beam.rays)
    starts = range(0, bearings.size, step)
    parts = [
        ideal_readings(beam, world, *(v[i : i + step] for v in flat), T_head_lrf) for i in starts
    ]
    ideal = (np.concatenate(part).reshape(bearings.shape) for part in zip(*parts, strict=True))
    ranges, reasons = measured(beam, *ideal, rng)
    return encode_values(ranges, unit=beam.unit_name, reasons=reasons)
