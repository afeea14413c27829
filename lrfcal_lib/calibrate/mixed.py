"""Mixed pixels: readings of a spot that meets two surfaces hang between them."""

from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter

from lrfcal_lib.session.stated import LrfInfo

PULSE = 1.0  # metres; surfaces farther apart give two echoes and no mixed pixel (see simulate.beam)
WIDEST = 8  # samples that a window reaches to a side at most
SIGMAS = 2.2  # by which a reading must miss the surfaces on both sides
ROUGH = 1.2  # residuals of the planes that readings lie on, standard deviations of a range
HALF_A_WINDOW = 0.375  # of the spot: a window is three quarters of it wide
# of a plane without samples, and the slope across a single line
UNKNOWN = (1e-9, 1e-6, 1e-6)
FARTHEST = 1.5  # lever of a place on the plane fitted to others
# shares of the spot across the lines and along them: strips as narrow as it, and what is about them
STRIPS = (
    ((1.0, HALF_A_WINDOW), (2.0, HALF_A_WINDOW)),
    ((HALF_A_WINDOW, 1.0), (HALF_A_WINDOW, 2.0)),
)


class _Window(NamedTuple):
    """A kind of window about readings whose plane may hold them.

    By direction, lines and beams: it reaches a `share` of the spot and at least the `fewest`
    samples to both sides, and the plane may rise by less than `steep` sigma over a spot. `rough` is
    the largest residual in sigma, `full` how much of the window must be there at least.
    """

    share: tuple
    fewest: tuple
    steep: tuple
    rough: float = ROUGH
    full: float = 0.0


WINDOWS = (
    _Window((HALF_A_WINDOW, HALF_A_WINDOW), (1, 1), steep=(np.inf, np.inf)),
    _Window((1.0, 0.0), (2, 1), steep=(np.inf, 4.0)),
    _Window((0.0, 1.0), (1, 2), steep=(4.0, np.inf)),
    _Window((0.0, 0.0), (1, 1), steep=(10.0, 10.0), rough=1.0, full=0.9),
)


def mixed(ranges: np.ndarray, steps: tuple[float, float], lrf: LrfInfo) -> np.ndarray:
    """How far behind the nearer of two surfaces readings hang that mix them; 0 for sound ones.

    A spot that meets two surfaces within one pulse reads between them. A reading is asked about
    where, half a spot or a spot away, both sides are at other ranges, one of them within a pulse.
    It is sound if it lies on a plane (straight in inverse range) about as wide as the spot both
    ways, in the middle, on a side or in a corner of it; or on a narrow long one, or a small one,
    that does not rise like a ramp. Readings a little before the one plane on both sides of them are
    not: what is narrower than the spot. Then planes are fitted without all these: readings that lie
    on one are sound after all. Mixtures are as wide as the spot: where that covers two samples both
    ways, a reading alone is noise, and one among mixed ones is mixed.

    Parameters
    ----------
    ranges : ndarray, shape (l, b)
        Metres, NaN where nothing came back.
    steps : (float, float)
        Between scan lines and between beams, radians.
    lrf : LrfInfo
        With `spot_exit` and `spot_divergence`.

    Returns
    -------
    ndarray, shape (l, b)
        Metres.
    """
    diameter = lrf.spot_exit / np.nan_to_num(ranges, nan=1.0) + lrf.spot_divergence
    # in samples, across the lines and along them (l, b, 2); next to nothing without a step
    spots = diameter[..., None] / np.where(np.greater(steps, 0), steps, 1e9)
    odd, dented, nearer = _beside(ranges, spots, lrf.sigma_range)
    planes = _Planes(ranges, spots, lrf.sigma_range)
    odd = planes.off(ranges, odd, 0.6)
    odd[dented] |= _before_a_plane(planes, ranges, dented)
    others = _Planes(np.where(odd, np.nan, ranges), spots, lrf.sigma_range)
    odd = others.off(ranges, odd, 0.5)
    count = 9 * uniform_filter(odd, 3, output=float, mode="constant")
    alike = (count > np.where(odd, 2.5, 4.5)) & np.isfinite(ranges)
    wide = spots.min(axis=-1) > 2
    return np.where(wide, alike, odd) * np.maximum(nearer, 1e-6)


def _samples(spots, share, fewest):
    """A share of spots (..., 2) in samples in both directions, none where there is no step."""
    reach = np.ceil(share * spots).clip(fewest, WIDEST)
    return np.where(spots > 1e-6, reach, 0).astype(int)


def _beside(ranges, spots, sigma):
    """Compare readings with those half a spot and a spot away, in all directions.

    Arrays (l, b): whether both sides are at other ranges, one of them within a pulse; whether both
    are farther; how far before the reading the nearer side is, metres.
    """
    around = np.pad(ranges, WIDEST, constant_values=np.nan)
    line, beam = np.indices(ranges.shape) + WIDEST
    beside = []
    for share, by_line, by_beam in product((0.5, 1.0), (-1, 0, 1), (-1, 0, 1)):
        lines, beams = np.moveaxis(_samples(spots, share, 1), -1, 0)
        beside.append(around[line + by_line * lines, beam + by_beam * beams])
    away = np.reshape(beside, (2, 9, *ranges.shape)) - ranges
    away = np.nan_to_num(away, nan=np.inf)
    apart = np.abs(away)
    least = np.minimum(apart, apart[:, ::-1])  # of opposite ones
    other = (least > 3 * sigma) & (least < PULSE)
    farther = np.minimum(away[1], away[1, ::-1]) > 2 * sigma
    farther &= least[1] < PULSE
    nearer = np.where(away > -PULSE, -away, 0.0).max(axis=(0, 1))
    return other.any(axis=(0, 1)), farther.any(axis=0), nearer


class _Planes:
    """Planes through windows of a range image, fitted in inverse range by sums over all before a
    place.
    """

    def __init__(self, ranges, spots, sigma):
        self.spots = spots
        self.sigma = sigma
        self.last = np.array(ranges.shape) - 1
        valid = np.isfinite(ranges)
        basis = np.array([valid, *np.indices(ranges.shape), 1 / ranges])
        basis = np.where(valid, basis, 0.0)
        products = np.einsum("i...,j...->...ij", basis, basis)
        before = products.cumsum(axis=0).cumsum(axis=1)
        self.table = np.pad(before, ((1, 0), (1, 0), (0, 0), (0, 0)))

    def sums(self, centre, reach):
        """Sums (n, 4, 4) of products of one, line, beam and inverse range over windows, and the
        number of samples of whole ones (n,).
        """
        # windows end at the border, and none has its middle beyond
        middle = np.clip(centre, 0, self.last)
        a, b = np.maximum(middle - reach, 0).T
        c, d = np.minimum(middle + reach, self.last).T + 1
        table = self.table
        sums = table[c, d] - table[a, d] - table[c, b] + table[a, b]
        return sums, np.prod(2 * reach + 1, axis=1)

    def fit(self, sums, at, rough):
        """Planes in inverse range of sums (n, 4, 4), as they are at places (n, 2).

        Slopes by line and by beam (n, 2), range there (n,), NaN for none, and whether they fit
        (n,): where their residuals are less than `rough` sigma and the place is not far from what
        they were fitted to.
        """
        # with lines and beams counted from the place
        moved = np.tile(np.eye(4), (len(at), 1, 1))
        moved[:, 1:3, 0] = -at
        products = moved @ sums @ moved.mT
        known = np.linalg.inv(products[:, :3, :3] + np.diag(UNKNOWN))
        by_place = products[:, :3, 3]
        plane = np.matvec(known, by_place)
        inverse = plane[:, 0]
        there = 1 / np.where(inverse > 0, inverse, np.nan)
        number = sums[:, 0, 0]
        square = products[:, 3, 3] - np.vecdot(plane, by_place)
        rms = np.sqrt(np.maximum(square, 0.0) / np.maximum(number - 3, 1))
        good = (number >= 4) & (rms * there**2 < rough * self.sigma)
        return plane[:, 1:], there, good & (known[:, 0, 0] < FARTHEST)

    def off(self, ranges, asked, share):
        """Which of the readings asked about (l, b) lie on no plane of a window about them, of which
        that `share` is there.
        """
        off = asked.copy()
        for window, *place in product(WINDOWS, (0, -1, 1), (0, -1, 1)):
            off[off] = ~self._holds(window, place, ranges, off, share)
        return off

    def _holds(self, window, place, ranges, asked, share):
        """Which readings lie on the plane of a window that has them at this place."""
        at = np.argwhere(asked)
        spot = self.spots[asked]
        reach = _samples(spot, window.share, window.fewest)
        sums, whole = self.sums(at + place * reach, reach)
        slope, there, good = self.fit(sums, at, window.rough)
        good &= sums[:, 0, 0] >= max(share, window.full) * whole
        rise = np.abs(slope) * there[:, None] ** 2  # metres a sample
        gentle = rise < np.multiply(window.steep, self.sigma) / spot
        near = np.abs(ranges[asked] - there) <= SIGMAS * self.sigma
        return good & gentle.all(axis=1) & near


def _before_a_plane(planes, ranges, dented):
    """Which of the dented readings (n,) are a little before one plane on both sides of a strip as
    narrow as the spot.
    """
    count = uniform_filter(np.isfinite(ranges), 3, output=float, mode="constant")
    total = uniform_filter(np.nan_to_num(ranges), 3, mode="constant")
    mean = total[dented] / count[dented]
    at = np.argwhere(dented)
    spot = planes.spots[dented]
    before = np.zeros(len(at), bool)
    for strip, whole in STRIPS:
        near, fewer = planes.sums(at, _samples(spot, strip, 1))
        all_of_it, number = planes.sums(at, _samples(spot, whole, 1))
        beside = all_of_it - near
        _, there, good = planes.fit(beside, at, 1.3)
        depth = (there - ranges[dented]) / planes.sigma
        good &= beside[:, 0, 0] >= 0.8 * (number - fewer)
        good &= (depth > SIGMAS) & (depth < 10)
        before |= good & (there - mean > SIGMAS * planes.sigma)
    return before
