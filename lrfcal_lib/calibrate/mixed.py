"""Mixed pixels: readings of a spot that meets two surfaces hang between them."""

from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter

from lrfcal_lib.fit.covariance import dyads
from lrfcal_lib.session.stated import LrfInfo

PULSE = 1.0  # metres; surfaces farther apart give two echoes and no mixed pixel (see simulate.beam)
WIDEST = 8  # samples that a window reaches to a side at most
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))  # of pairs of neighbours: lines and beams
SIGMAS = 2.2  # by which a reading must miss the surfaces on both sides
ROUGH = 1.2  # residuals of the planes that readings lie on, standard deviations of a range
HALF_A_WINDOW = 0.375  # of the spot: a window is three quarters of it wide
FARTHEST = 1.5  # lever of a place on the plane fitted to others


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
    spots = _spots(ranges, steps, lrf)
    asked, dented, nearer = _beside(ranges, spots, lrf.sigma_range)
    planes = _Planes(ranges, spots, lrf.sigma_range)
    odd = np.zeros(ranges.shape, bool)
    at = np.nonzero(asked)
    odd[at] = ~planes.hold(ranges[at], at, 0.6)
    at = np.nonzero(dented)
    odd[at] |= _before_a_plane(planes, ranges, at)
    at = np.nonzero(odd)
    others = _Planes(np.where(odd, np.nan, ranges), spots, lrf.sigma_range)
    odd[at] = ~others.hold(ranges[at], at, 0.5)
    about = np.rint(9 * uniform_filter(odd.astype(float), 3, mode="constant")) - odd
    alike = np.where(odd, about > 1, (about > 4) & np.isfinite(ranges))
    wide = np.minimum(*spots) > 2
    return np.where(np.where(wide, alike, odd), np.maximum(nearer, 1e-6), 0.0)


def _spots(ranges, steps, lrf):
    """Diameter of the spot in samples, across the lines and along them, two arrays (l, b)."""
    distance = np.where(np.isfinite(ranges), ranges, 1.0)
    diameter = lrf.spot_exit / distance + lrf.spot_divergence  # radians
    return [diameter / step if step > 0 else 1e-9 * distance for step in steps]


def _samples(spots, share, fewest):
    """A share of the spot in samples in both directions, none where there is no step."""
    samples = []
    for spot in spots:
        reach = np.ceil(share * spot).clip(fewest, WIDEST)
        samples.append(np.where(spot > 1e-6, reach, 0).astype(int))
    return samples


def _beside(ranges, spots, sigma):
    """Compare readings with those half a spot and a spot away, in all directions.

    Arrays (l, b): whether both sides are at other ranges, one of them within a pulse; whether both
    are farther; how far before the reading the nearer side is, metres.
    """
    place = np.indices(ranges.shape)
    size = np.array(ranges.shape)[:, None, None]
    asked = np.zeros(ranges.shape, bool)
    dented = np.zeros(ranges.shape, bool)
    nearer = np.zeros(ranges.shape)
    for share, (by_line, by_beam) in product((0.5, 1.0), DIRECTIONS):
        lines, beams = _samples(spots, share, 1)
        way = np.stack([by_line * lines, by_beam * beams])
        away = []
        for there in (place + way, place - way):
            outside = ((there < 0) | (there >= size)).any(axis=0)
            step = ranges[tuple(np.clip(there, 0, size - 1))] - ranges
            away.append(np.where(outside | np.isnan(step), np.inf, step))
        least = np.abs(away).min(axis=0)
        asked |= (least > 3 * sigma) & (least < PULSE)
        if share == 1.0:
            dented |= (np.min(away, axis=0) > 2 * sigma) & (least < PULSE)
        within = np.where(np.array(away) > -PULSE, away, 0.0)
        nearer = np.maximum(nearer, -within.min(axis=0))
    return asked, dented, nearer


class _Window(NamedTuple):
    """A kind of window about readings whose plane may hold them.

    `reach` to both sides, by direction. `narrow` directions are those in which the plane may rise
    by less than `steep` sigma over a spot. `rough` is its largest residual in sigma, `share` how
    much of the window must be there.
    """

    reach: tuple
    narrow: tuple
    steep: float
    rough: float
    share: float


class _Planes:
    """Planes through windows of a range image, fitted in inverse range by sums over all before a
    place.
    """

    def __init__(self, ranges, spots, sigma):
        self.spots = spots
        self.sigma = sigma
        self.last = np.array(ranges.shape) - 1
        valid = np.isfinite(ranges)
        inverse = 1 / np.where(valid, ranges, 1.0)
        basis = np.stack([valid, *np.indices(ranges.shape), inverse], axis=-1)
        basis = basis * valid[..., None]
        products = dyads(basis)
        before = products.cumsum(axis=0).cumsum(axis=1)
        self.table = np.pad(before, ((1, 0), (1, 0), (0, 0), (0, 0)))

    def sums(self, centre, reach):
        """Sums (n, 4, 4) of products of one, line, beam and inverse range over windows, and the
        number of samples of whole ones (n,).
        """
        low = []
        high = []
        # windows end at the border, and none has its middle beyond
        for middle, half, last in zip(centre, reach, self.last, strict=True):
            middle = np.clip(middle, 0, last)
            low.append(np.maximum(middle - half, 0))
            high.append(np.minimum(middle + half, last) + 1)
        (a, b), (c, d) = low, high
        table = self.table
        sums = table[c, d] - table[a, d] - table[c, b] + table[a, b]
        return sums, np.prod([2 * half + 1 for half in reach], axis=0)

    def fit(self, sums, at, rough):
        """Planes in inverse range of sums (n, 4, 4), as they are at places (line, beam).

        Slopes by line and by beam (2, n), range there (n,), and whether they fit (n,): where their
        residuals are less than `rough` sigma and the place is not far from what they were fitted
        to.
        """
        number = np.maximum(sums[:, 0, 0], 1e-9)
        mean = sums[:, 0, 1:] / number[:, None]
        scatter = sums[:, 1:, 1:] - np.einsum("n,ni,nj->nij", number, mean, mean)
        by_place = scatter[:, :2, 2]
        # a single line has no slope across
        known = np.linalg.inv(scatter[:, :2, :2] + 1e-6 * np.eye(2))
        slope = np.matvec(known, by_place)
        away = np.transpose(at) - mean[:, :2]
        inverse = mean[:, 2] + np.vecdot(slope, away)
        square = scatter[:, 2, 2] - np.vecdot(slope, by_place)
        rms = np.sqrt(np.maximum(square, 0.0) / np.maximum(number - 3, 1))
        lever = 1 / number + np.vecdot(away, np.matvec(known, away))
        good = (number >= 4) & (inverse > 0) & (rms < rough * self.sigma * inverse**2)
        there = 1 / np.where(inverse > 0, inverse, np.nan)
        return slope.T, there, good & (lever < FARTHEST)

    def hold(self, readings, at, share):
        """Which readings (n,) at (line, beam) lie on a plane of a window about them, of which that
        `share` is there.
        """
        wide = _samples(self.spots, HALF_A_WINDOW, 1)
        long = _samples(self.spots, 1.0, 2)
        small = [half.clip(max=1) for half in wide]
        windows = [
            _Window(tuple(wide), (), 0.0, ROUGH, share),
            _Window((long[0], small[1]), (1,), 4.0, ROUGH, share),
            _Window((small[0], long[1]), (0,), 4.0, ROUGH, share),
            _Window(tuple(small), (0, 1), 10.0, 1.0, 0.9),
        ]
        sound = np.zeros(len(readings), bool)
        middle_first = sorted(
            product((-1, 0, 1), repeat=2), key=lambda place: place != (0, 0)
        )
        for window, place in product(windows, middle_first):
            rest = np.flatnonzero(~sound)
            sound[rest] = self._holds(window, place, readings[rest], [i[rest] for i in at])
        return sound

    def _holds(self, window, place, readings, at):
        """Which readings lie on the plane of a window that has them at this place."""
        at = tuple(at)
        reach = [half[at] for half in window.reach]
        centre = [i + where * half for i, where, half in zip(at, place, reach, strict=True)]
        sums, whole = self.sums(centre, reach)
        slope, there, good = self.fit(sums, at, window.rough)
        good &= sums[:, 0, 0] >= window.share * whole
        for d in window.narrow:
            rise = np.abs(slope[d]) * there**2  # metres a sample
            good &= rise < window.steep * self.sigma / self.spots[d][at]
        return good & (np.abs(readings - there) <= SIGMAS * self.sigma)


def _before_a_plane(planes, ranges, at):
    """Which readings at (line, beam) are a little before one plane on both sides of a strip as
    narrow as the spot.
    """
    valid = np.isfinite(ranges)
    count = np.maximum(uniform_filter(valid.astype(float), 3, mode="constant"), 1e-9)
    mean = uniform_filter(np.where(valid, ranges, 0.0), 3, mode="constant") / count
    long, inner, outer = (
        [half[at] for half in _samples(planes.spots, share, 1)]
        for share in (HALF_A_WINDOW, 1.0, 2.0)
    )
    before = np.zeros(len(at[0]), bool)
    for direction in (0, 1):  # strips along beams, along lines
        strip = list(long)
        whole = list(long)
        strip[direction] = inner[direction]
        whole[direction] = outer[direction]
        all_of_it, number = planes.sums(at, whole)
        near, fewer = planes.sums(at, strip)
        beside = all_of_it - near
        _, there, good = planes.fit(beside, at, 1.3)
        depth = (there - ranges[at]) / planes.sigma
        good &= beside[:, 0, 0] >= 0.8 * (number - fewer)
        good &= (depth > SIGMAS) & (depth < 10)
        before |= good & (there - mean[at] > SIGMAS * planes.sigma)
    return before
