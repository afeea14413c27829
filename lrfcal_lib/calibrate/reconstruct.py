"""Sweeps, images and a calibration make a coloured cloud, block by block: any number of points
in bounded memory.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy.ndimage import uniform_filter

from lrfcal_lib.fit.robust import TUKEY, robust_sigma
from lrfcal_lib.model import geometry
from lrfcal_lib.model.camera import CameraModel, fold, project
from lrfcal_lib.model.kinematics import MIRROR_TURN
from lrfcal_lib.session.write import whole

GREY = 128  # colour of points that no camera sees
BLOCK = 1 << 18  # points worked on at once
SHARE = 1 << 15  # of them that a thread takes at a time
WORKERS = min(os.cpu_count() or 1, 8)
WINDOW = 4  # beams and scan lines on either side of a point that make its normal
PULSE = 1.0  # metres; surfaces farther apart give two echoes and no mixed pixel (see simulate.beam)
SIGMAS = 2.2  # by which a reading must miss the surfaces on both sides
ROUGH = 1.2  # residuals of the planes that readings lie on, standard deviations of a range
GAIN_POINTS = 30_000  # that compare the exposures of images
FRAME = "frame: platform (x = tilt axis, y ahead, z up at pitch 0)"
UNITS = (
    "units: metres, radians; sigma in metres, image is the number of the image that counts most "
    "(-1: none)"
)
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))  # of pairs of neighbours: lines and beams


@dataclass(frozen=True)
class Cloud:
    """Coloured points in the platform frame, a row each.

    Attributes
    ----------
    points, normals : ndarray, shape (n, 3)
        Metres; unit vectors towards the sensor, NaN where the surroundings are too small for one.
    colors : ndarray of uint8, shape (n, 3)
        Red, green, blue; grey where no camera sees the point.
    seen : ndarray of bool, shape (n,)
        Whether any camera sees the point.
    placement, image : ndarray of int, shape (n,)
        The sweep, and the number in `Session.image_records` of the image that counts most, -1 for
        none.
    pitch, bearing, range, intensity : ndarray, shape (n,)
        As measured (radians, radians, metres; NaN where no intensity was recorded).
    sigma : ndarray, shape (n,)
        Standard deviation across the surface, metres: scatter of the readings about it; see
        `scenes.with_sigma`.
    removed : int
        Mixed pixels that were left out.
    """

    points: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    seen: np.ndarray
    placement: np.ndarray
    image: np.ndarray
    pitch: np.ndarray
    bearing: np.ndarray
    range: np.ndarray
    intensity: np.ndarray
    sigma: np.ndarray
    removed: int = 0

    def __repr__(self):
        share = 100 * self.seen.mean() if len(self.seen) else 0.0
        return (
            f"Cloud({len(self.points)} points of {len(set(self.placement))} placements, "
            f"{share:.1f} % coloured)"
        )

    def rows(self, index):
        """Some of the points."""
        return replace(self, **{name: getattr(self, name)[index] for name in ROWS})


ROWS = tuple(f.name for f in fields(Cloud) if f.name != "removed")


def join(clouds):
    """One cloud of several."""
    clouds = list(clouds)
    rows = (np.concatenate([getattr(cloud, name) for cloud in clouds]) for name in ROWS)
    return Cloud(*rows, sum(cloud.removed for cloud in clouds))


@dataclass(frozen=True)
class View:
    """An image as it sees the platform frame.

    Attributes
    ----------
    number : int
        What points coloured from it remember.
    camera : str
    T_camera_platform : RigidTransform
    model : CameraModel
    image : ndarray of uint8, shape (height, width, 3)
        Blue, green, red as OpenCV reads it. ValueError if it has another size than the model.
    """

    number: int
    camera: str
    T_camera_platform: object
    model: CameraModel
    image: np.ndarray

    def __post_init__(self):
        size = self.image.shape[1::-1]
        m = self.model
        if size != (m.width, m.height):
            asked = f"camera '{self.camera}' has {m.width} x {m.height} pixels"
            raise ValueError(
                f"{asked}, its image {size[0]} x {size[1]}: intrinsics hold for one image size only"
            )

    @cached_property
    def pose(self):
        """Top three rows of the transform."""
        return _single(geometry.pose_array(self.T_camera_platform))

    @cached_property
    def lens(self):
        """Intrinsics, and the squared distance from the axis at which the lens folds, for the
        compiled loops.
        """
        return _single(np.r_[self.model.parameters, fold(self.model)])


class Painter:
    """Colours points from images: first everything that may hide something goes through
    :meth:`hide`.

    Parameters
    ----------
    views : sequence of View
    step : float
        Radians between neighbouring points as the sensor sees them: the resolution at which points
        hide others.
    noise : float
        Metres by which a point may lie behind another one of the same surface.
    """

    def __init__(self, views, step, noise):
        from lrfcal_lib.calibrate import colouring  # numba, which nothing else needs

        self.loops = colouring
        self.views = views
        self.noise = noise
        self.exposures = np.zeros((len(views), 2))
        self.cells = [max(2.0, 2 * step * view.model.fx) for view in self.views]
        sizes = [
            [int(n / cell) + 1 for n in v.image.shape[:2]]
            for v, cell in zip(self.views, self.cells, strict=True)
        ]
        self.nearest = [
            np.full((WORKERS, rows * columns), np.inf, np.float32) for rows, columns in sizes
        ]

    def hide(self, points):
        """Let points (n, 3) hide what is behind them."""

        def some(rows, worker):
            """A share of the points, into the depth buffers of one thread."""
            part = _single(points[rows])
            for v, cell, nearest in zip(self.views, self.cells, self.nearest, strict=True):
                self.loops.hide(part, v.pose, v.lens, v.image.shape[1::-1], cell, nearest[worker])

        _share(some, len(points))
        for nearest in self.nearest:
            np.min(nearest, axis=0, out=nearest[0])

    def paint(self, points, normals, only=slice(None)):
        """Colours (n, 3), whether any image sees the points (n,), and the number of the one
        that counts most.
        """
        n = len(points)
        views = range(len(self.views))[only]
        colors = np.empty((n, 3), np.float32)
        seen = np.empty(n, bool)
        source = np.full(n, -1, np.int32)

        def some(rows, _):
            """A share of the points, seen by all images."""
            part = _single(points[rows]), _single(normals[rows])
            sums = np.zeros((len(part[0]), 4), np.float32)
            best = np.zeros(len(part[0]), np.float32)
            for k in views:
                v = self.views[k]
                near = (self.cells[k], self.nearest[k][0], self.noise, self.exposures[k])
                self.loops.paint(
                    *part, v.pose, v.lens, v.image, *near, sums, best, source[rows], v.number
                )
            self.loops.finish(sums, colors[rows], seen[rows])

        _share(some, n)
        return colors, seen, source

    def compare_exposures(self, points, normals):
        """Estimate gain and fall-off towards the corners of every image from points that several
        images see.

        The log of a brightness is that of the surface, plus one number an image, plus one a camera
        times the squared distance from the principal point. Robust least squares; the gains are one
        in the mean.
        """
        if len(self.views) < 2 or not len(points):
            return
        names, which = np.unique([view.camera for view in self.views], return_inverse=True)
        logs, radii = (np.full((len(self.views), len(points)), np.nan) for _ in range(2))
        for k, view in enumerate(self.views):
            grey = self.paint(points, normals, slice(k, k + 1))[0].mean(axis=1)
            logs[k] = np.log(np.where((grey > 12) & (grey < 230), grey, np.nan))
            uv = project(view.T_camera_platform.apply(points), view.model) - [
                view.model.cx,
                view.model.cy,
            ]
            radii[k] = np.sum(uv**2, axis=1) / (0.25 * (view.model.width**2 + view.model.height**2))
        use = np.isfinite(logs)
        found = np.zeros(len(self.views) + len(names))
        for _ in range(4):
            use &= use.sum(axis=0) > 1
            k, i = np.nonzero(use)
            rows = np.hstack(
                [np.eye(len(self.views))[k], radii[use][:, None] * np.eye(len(names))[which[k]]]
            )
            both = np.column_stack([rows, logs[use]])
            count = np.maximum(use.sum(axis=0), 1)
            means = (
                np.stack([np.bincount(i, column, len(points)) for column in both.T], axis=1)
                / count[:, None]
            )
            both -= means[i]  # the brightness of the surface itself is nobody's concern
            J = both[:, :-1]
            y = both[:, -1]
            # zero for what no point compares
            found = np.linalg.solve(J.T @ J + 1e-3 * np.eye(len(found)), J.T @ y)
            miss = y - J @ found
            if len(miss):
                use[use] = np.abs(miss) < TUKEY * robust_sigma(miss, least=1e-3)
        self.exposures[:, 0] = found[: len(self.views)] - found[: len(self.views)].mean()
        self.exposures[:, 1] = np.minimum(found[len(self.views) :], 0.0)[which]


def _single(points):
    return np.ascontiguousarray(points, np.float32)


def _share(some, count):
    """Call ``some(rows, worker)`` for slices of so many rows, in threads: the compiled loops
    free the interpreter.
    """

    def work(worker):
        for start in range(worker * SHARE, count, WORKERS * SHARE):
            some(slice(start, start + SHARE), worker)

    with ThreadPoolExecutor(WORKERS) as pool:
        list(pool.map(work, range(WORKERS)))


def reconstruct(sweep, views, T_head_lrf, corrections, *, lrf, continuous=False, mask=None):
    """Turn a sweep of any size into coloured points of the platform frame.

    Parameters
    ----------
    sweep : Sweep
    views : sequence of View
        Images that may colour it.
    T_head_lrf : RigidTransform
    corrections : Corrections
        Known errors of ranges and pitch, for instance `JointSolution.corrections`.
    lrf : LrfInfo
        Its spot and noise tell mixed pixels.
    continuous : bool
        The head moved on within a scan line: its pitch is that of the middle beam.
    mask : ndarray of bool, shape (L, B), optional
        Points to hand out; all that came back unless given. All points hide others in any case.

    Yields
    ------
    Cloud
        Blocks of whole scan lines. Mixed pixels are left out, and hide what is behind the nearer of
        their surfaces.
    """
    if not np.isfinite(sweep.ranges).any():
        raise ValueError(
            f"placement {sweep.placement}: an empty sweep ({len(sweep.ranges)} scan lines, no "
            "range)"
        )
    ends, view = (
        np.degrees([min(v), max(v)]).round(2) for v in (sweep.bearings, lrf.field_of_view)
    )
    if ends[0] < view[0] - np.degrees(lrf.bearing_step) or ends[1] > view[1] + np.degrees(
        lrf.bearing_step
    ):
        words = (
            f"bearings {ends[0]} to {ends[1]} deg, '{lrf.model}' sees {view[0]} to {view[1]} deg"
        )
        raise ValueError(
            f"placement {sweep.placement}: {words}: take the calibration of the rig that "
            "recorded it"
        )
    turns = np.abs(np.diff(sweep.pitch))
    steps = float(np.median(turns[turns > 0])) if turns.any() else 0.0, lrf.bearing_step
    # the farthest and the nearest of a few points of a wall
    painter = Painter(views, max(steps), 5 * lrf.sigma_range)
    blocks = _Blocks(sweep, steps, T_head_lrf, corrections, lrf, continuous)
    # they are gone through twice
    blocks = list(blocks) if sweep.ranges.size <= 4 * BLOCK else blocks
    some = []
    every = max(1, sweep.ranges.size // GAIN_POINTS)
    for points, normals, _, hiding, good, _ in blocks:
        painter.hide(hiding[np.isfinite(hiding).all(axis=-1)])
        # a view would keep the whole block
        some.append([part[good][::every].copy() for part in (points, normals)])
    painter.compare_exposures(*(np.concatenate(part) for part in zip(*some, strict=True)))
    for points, normals, scatter, _, good, rows in blocks:
        wanted = np.isfinite(sweep.ranges[rows]) if mask is None else mask[rows]
        take = good & wanted
        line, beam = np.nonzero(take)
        colors, seen, source = painter.paint(points[take], normals[take])
        colors = np.where(
            seen[:, None], np.clip(np.rint(np.nan_to_num(colors)), 0, 255), GREY
        ).astype(np.uint8)
        ranges = sweep.ranges[rows][take]
        echo = np.full(len(line), np.nan)
        if sweep.intensities is not None:
            echo = sweep.intensities[rows][take].astype(float)
        number = np.full(len(line), sweep.placement)
        sigma = scatter[take]
        sigma = np.where(np.isfinite(sigma), sigma, lrf.sigma_range)
        measured = sweep.pitch[rows][line], sweep.bearings[beam], ranges, echo
        at = points[take], normals[take], colors, seen, number, source, *measured, sigma
        yield Cloud(*at, removed=int((wanted & ~good).sum()))


class _Blocks:
    """Points, normals, scatter, what hides others (at first), sound points, and the scan lines,
    block by block.
    """

    def __init__(self, sweep, steps, T_head_lrf, corrections, lrf, continuous):
        self.sweep = sweep
        self.steps = steps
        self.T_head_lrf = T_head_lrf
        self.corrections = corrections
        self.lrf = lrf
        self.rate = (
            np.gradient(sweep.pitch, sweep.time_s) if continuous and len(sweep.pitch) > 1 else None
        )
        self.sound = {}  # by first line: looked for once, where blocks are gone through twice

    def __iter__(self):
        sweep = self.sweep
        (lines, beams) = self.sweep.ranges.shape
        size = max(1, BLOCK // beams)
        margin = 4 * WINDOW
        for start in range(0, lines, size):
            rows = slice(start, min(start + size, lines))
            low = max(0, start - margin)
            high = min(lines, rows.stop + margin)
            inner = slice(start - low, rows.stop - low)
            ranges = sweep.ranges[low:high].astype(float)
            pitch = self._pitch(slice(low, high))
            p_lrf = self.corrections.points(geometry.polar_to_points(ranges, sweep.bearings))
            pitch = self.corrections.pitch(sweep.placement, pitch)
            points = geometry.lrf_to_platform(p_lrf, pitch, self.T_head_lrf)
            hiding = points
            good = self.sound.get(start, np.isfinite(ranges))
            if self.lrf.spot_divergence is not None and start not in self.sound:
                nearer = mixed(ranges, self.steps, self.lrf)
                toward = np.linalg.norm(p_lrf, axis=-1, keepdims=True)
                good = self.sound[start] = good & (nearer == 0)
                hiding = geometry.lrf_to_platform(
                    p_lrf * (1 - nearer[..., None] / toward), pitch, self.T_head_lrf
                )
            origin = geometry.lrf_to_platform(np.zeros(3), pitch, self.T_head_lrf)
            normals, scatter = grid_normals(np.where(good[..., None], points, np.nan), origin)
            yield points[inner], normals[inner], scatter[inner], hiding[inner], good[inner], rows

    def _pitch(self, rows):
        """Recorded pitch of every beam, shape (l, B): between scan lines the mirror turns while
        the head moves.
        """
        pitch = self.sweep.pitch[rows, None]
        bearings = self.sweep.bearings
        if self.rate is None:
            return np.broadcast_to(pitch, (len(pitch), len(bearings))).copy()
        # of the mirror, for lines finer than a degree
        turns = max(1, round(np.radians(1.0) / self.lrf.bearing_step))
        first, last = self.lrf.field_of_view
        beams = np.rint((np.r_[bearings, last] - first) / self.lrf.bearing_step)
        beams[-1] //= 2  # the middle one
        after = (beams * self.lrf.bearing_step / (2 * np.pi) + beams % turns) * MIRROR_TURN
        return pitch + self.rate[rows, None] * (after[:-1] - after[-1])


def mixed(ranges, steps, lrf):
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
    """
    r = np.where(np.isfinite(ranges), ranges, 1.0)
    off = 3 * lrf.sigma_range
    # in samples
    spots = [(lrf.spot_exit / r + lrf.spot_divergence) / s if s > 0 else 1e-9 * r for s in steps]
    place = np.indices(r.shape)
    size = np.array(r.shape)[:, None, None]
    asked = np.zeros(r.shape, bool)
    dent = np.zeros(r.shape, bool)
    nearer = np.zeros(r.shape)
    for share, (a, b) in product((0.5, 1.0), DIRECTIONS):
        way = np.stack(
            [
                sign * samples
                for sign, samples in zip((a, b), _samples(spots, share, 1), strict=True)
            ]
        )
        sides = [place + way, place - way]
        there = [ranges[tuple(np.clip(at, 0, size - 1))] - ranges for at in sides]
        out = [((at < 0) | (at >= size)).any(axis=0) for at in sides]
        away = np.where(np.array(out) | np.isnan(there), np.inf, there)
        least = np.abs(away).min(axis=0)
        most = np.min(np.where(away > -PULSE, away, 0.0), axis=0)
        asked |= (least > off) & (least < PULSE)
        dent |= (share == 1.0) & (away.min(axis=0) > 2 * lrf.sigma_range) & (least < PULSE)
        nearer = np.maximum(nearer, -most)
    table = _table(ranges)
    odd = np.zeros(r.shape, bool)
    at = np.nonzero(asked)
    odd[at] = ~_on_surface(table, ranges[at], at, spots, lrf, 0.6)
    at = np.nonzero(dent)
    odd[at] |= _thin(table, ranges, at, spots, lrf)
    at = np.nonzero(odd)
    odd[at] = ~_on_surface(_table(np.where(odd, np.nan, ranges)), ranges[at], at, spots, lrf, 0.5)
    others = np.rint(9 * uniform_filter(odd.astype(float), 3, mode="constant")) - odd
    alike = np.where(odd, others > 1, (others > 4) & np.isfinite(ranges))
    return np.where(np.where(np.minimum(*spots) > 2, alike, odd), np.maximum(nearer, 1e-6), 0.0)


def _samples(spots, share, fewest):
    """A share of the spot in samples in both directions, none where there is no step."""
    return [
        np.where(s > 1e-6, np.ceil(share * s).clip(fewest, 2 * WINDOW), 0).astype(int)
        for s in spots
    ]


def _on_surface(table, readings, at, spots, lrf, share):
    """Which readings at (line, beam) lie on a plane of a window about them, of which that
    `share` is there.
    """
    wide = _samples(spots, 0.375, 1)
    long = _samples(spots, 1.0, 2)
    sound = np.zeros(len(readings), bool)
    thin = [half.clip(max=1) for half in wide]
    # reach of windows; directions in which, and by how many sigma over a spot, they rise no more;
    # what of them is there
    kinds = [(wide, (), 0, ROUGH, share), ((long[0], thin[1]), (1,), 4, ROUGH, share)]
    kinds += [((thin[0], long[1]), (0,), 4, ROUGH, share), (thin, (0, 1), 10, 1.0, 0.9)]
    for half, narrow, steep, rough, part in kinds:
        # most lie on the one about them
        for place in sorted(np.ndindex(3, 3), key=lambda each: each != (1, 1)):
            rest = np.flatnonzero(~sound)
            own = tuple(index[rest] for index in at)
            reach = [h[own] for h in half]
            sums, number = _sums(
                table, [i + (k - 1) * h for i, k, h in zip(own, place, reach, strict=True)], reach
            )
            slope, there, good = _planes(sums, own, rough * lrf.sigma_range)
            good &= sums[:, 0, 0] >= part * number
            for d in narrow:  # no ramp
                good &= np.abs(slope[d]) * there**2 < steep * lrf.sigma_range / spots[d][own]
            sound[rest] = good & (np.abs(readings[rest] - there) <= SIGMAS * lrf.sigma_range)
    return sound


def _table(ranges):
    """Sums (l + 1, b + 1, 4, 4) over all before a place of products of one, line, beam and
    inverse range.
    """
    valid = np.isfinite(ranges)
    basis = (
        np.stack([valid, *np.indices(ranges.shape), 1 / np.where(valid, ranges, 1.0)], axis=-1)
        * valid[..., None]
    )
    products = basis[..., :, None] * basis[..., None, :]
    return np.pad(products.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0), (0, 0), (0, 0)))


def _sums(table, centre, half):
    """Sums (n, 4, 4) over windows that reach `half` samples about `centre`, and the number of
    samples of whole ones.
    """
    # windows end at the border, and none has its middle beyond
    last = [n - 1 for n in table.shape[:2]]
    centre = [np.clip(i, 0, n - 1) for i, n in zip(centre, last, strict=True)]
    a, b = (np.maximum(i - h, 0) for i, h in zip(centre, half, strict=True))
    c, d = (np.minimum(i + h + 1, n) for i, h, n in zip(centre, half, last, strict=True))
    return table[c, d] - table[a, d] - table[c, b] + table[a, b], np.prod(
        [2 * h + 1 for h in half], axis=0
    )


def _planes(G, at, rough):
    """Slopes (2, n) of planes in inverse range from sums G (n, 4, 4), their range at places, and
    whether they fit.

    They do where their residuals are not `rough` (metres) and the place is not far from what they
    were fitted to.
    """
    number = np.maximum(G[:, 0, 0], 1e-9)
    mean = G[:, 0, 1:] / number[:, None]
    C = np.moveaxis(G[:, 1:, 1:], 0, -1) - number * mean.T[:, None] * mean.T
    # a single line has no slope across
    (xx, xy, xr), (_, yy, yr), (*_, rr) = C + np.diag([1e-6, 1e-6, 0.0])[..., None]
    slope = np.stack([yy * xr - xy * yr, xx * yr - xy * xr]) / (xx * yy - xy**2)
    x, y = np.array(at) - mean.T[:2]
    inverse = mean[:, 2] + slope[0] * x + slope[1] * y
    square = rr - slope[0] * xr - slope[1] * yr
    lever = 1 / number + (yy * x**2 - 2 * xy * x * y + xx * y**2) / (xx * yy - xy**2)
    rms = np.sqrt(np.maximum(square, 0.0) / np.maximum(number - 3, 1))
    good = (number >= 4) & (inverse > 0) & (rms < rough * inverse**2) & (lever < 1.5)
    return slope, 1 / np.where(inverse > 0, inverse, np.nan), good


def _thin(table, ranges, at, spots, lrf):
    """Readings at (line, beam) a little before one plane on both sides of a strip as narrow as
    the spot.
    """
    valid = np.isfinite(ranges)
    found = np.zeros(len(at[0]), bool)
    count = np.maximum(uniform_filter(valid.astype(float), 3, mode="constant"), 1e-9)
    mean = (uniform_filter(np.where(valid, ranges, 0.0), 3, mode="constant") / count)[at]
    long, inner, outer = (
        [n[at] for n in _samples(spots, *how)] for how in ((0.375, 1), (1.0, 1), (2.0, 2))
    )
    for d in (0, 1):  # strips along beams, along lines
        whole, strip = ((n[0], long[1]) if d == 0 else (long[0], n[1]) for n in (outer, inner))
        (far, number) = _sums(table, at, whole)
        (near, fewer) = _sums(table, at, strip)
        _, there, good = _planes(far - near, at, 1.3 * lrf.sigma_range)
        good &= (far - near)[:, 0, 0] >= 0.8 * (number - fewer)
        depth = (there - ranges[at]) / lrf.sigma_range
        found |= good & (depth > SIGMAS) & (depth < 10) & (there - mean > SIGMAS * lrf.sigma_range)
    return found


def grid_normals(points, origins):
    """Unit normals (l, b, 3) towards `origins` of points on a grid (l, b, 3), and the scatter (l,
    b) along them.

    Of the flattest window that holds the point: nine windows, the point in the middle, on a side or
    in a corner of them, so that an edge spoils none of its sides. NaN where less than a third of
    every window is there.
    """
    valid = np.isfinite(points).all(axis=-1)
    n = 2 * WINDOW + 1
    centre = np.nanmean(points[valid], axis=0) if valid.any() else np.zeros(3)
    p = np.where(valid[..., None], points - centre, 0.0)
    size = (n, n, 1)
    share = uniform_filter(valid.astype(float)[..., None], size, mode="constant")
    whole = np.maximum(share, 0.5 / n**2)
    mean = uniform_filter(p, size, mode="constant") / whole
    i, j = np.triu_indices(3)
    square = uniform_filter(p[..., i] * p[..., j], size, mode="constant")
    least, middle, across = flattest(
        *np.moveaxis(square / whole - mean[..., i] * mean[..., j], -1, 0)
    )
    rough = np.where((share[..., 0] > 1 / 3) & (middle > 0), np.maximum(least, 0.0), np.inf)
    places = np.indices(valid.shape)[:, None] + WINDOW * (
        np.indices((3, 3)).reshape(2, 9, 1, 1) - 1
    )
    places = np.clip(places, 0, np.array(valid.shape)[:, None, None, None] - 1)
    flat = np.where(valid, rough[tuple(places)], np.inf)
    chosen = np.argmin(flat, axis=0)[None]
    best = np.take_along_axis(flat, chosen, axis=0)[0]
    normals = across[tuple(np.take_along_axis(places, chosen[None], axis=1)[:, 0])]
    scatter = np.sqrt(np.where(np.isfinite(best), best, np.nan))
    away = np.sum(normals * (points - origins), axis=-1) > 0
    return np.where(away, -1.0, np.where(np.isfinite(best), 1.0, np.nan))[
        ..., None
    ] * normals, scatter


def flattest(xx, xy, xz, yy, yz, zz):
    """The least and the middle eigenvalue (...) of covariances of points, and the direction (...,
    3) of the least.

    In closed form, many times as fast as LAPACK on as many small matrices (Smith 1961).
    """
    mean = (xx + yy + zz) / 3
    a = xx - mean
    b = yy - mean
    c = zz - mean
    p = np.maximum(np.sqrt((a * a + b * b + c * c) / 6 + (xy * xy + xz * xz + yz * yz) / 3), 1e-100)
    half = (a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)) / (2 * p**3)
    turn = np.arccos(np.clip(half, -1, 1)) / 3
    most, least = (2 * p * np.cos(turn + shift) for shift in (0.0, 2 * np.pi / 3))
    a = a - least
    b = b - least
    c = c - least
    # columns of the adjugate of the matrix without it all point across; the longest is the most
    # precise
    u = xy * yz - xz * b
    v = xz * xy - a * yz
    w = xz * yz - xy * c
    columns = np.stack([[b * c - yz * yz, w, u], [w, a * c - xz * xz, v], [u, v, a * b - xy * xy]])
    longest = np.argmax(columns[[0, 1, 2], [0, 1, 2]], axis=0)[None, None]
    across = np.take_along_axis(columns, longest, axis=0)[0]
    x, y, z = across / np.maximum(np.sqrt(np.sum(across**2, axis=0)), 1e-300)
    # to all digits
    least = x * (xx * x + 2 * (xy * y + xz * z)) + y * (yy * y + 2 * yz * z) + zz * z * z
    return least, 2 * mean - most - least, np.stack([x, y, z], axis=-1)


COLUMNS = {  # of a PLY file, of attributes that are no single float by the attribute's own name
    "points": ("<f4", "x y z"),
    "normals": ("<f4", "nx ny nz"),
    "colors": ("u1", "red green blue"),
    "seen": ("u1", "seen"),
    "placement": ("<i4", "placement"),
    "image": ("<i4", "image"),
}
COLUMNS |= {name: ("<f4", name) for name in ("pitch", "bearing", "range", "intensity", "sigma")}
KINDS = {"<f4": "float", "<i4": "int", "u1": "uchar"}


def write_ply(path, clouds, comments=()):
    """Write a cloud, or blocks of one as they come, as binary PLY with all attributes; frame and
    units are comments.

    Returns the number of points. ValueError if the file cannot be written; it is whole, or as it
    was before.
    """
    clouds = [clouds] if isinstance(clouds, Cloud) else clouds
    count = 0
    head = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {c}" for c in (FRAME, UNITS, *comments)),
    ]
    body = [
        f"property {KINDS[kind]} {name}"
        for kind, names in COLUMNS.values()
        for name in names.split()
    ]
    table = np.dtype(
        [(field, kind, (len(names.split()),)) for field, (kind, names) in COLUMNS.items()]
    )

    def header(number):
        """The same length for every number of points."""
        return "\n".join([*head, f"element vertex {number:<12d}", *body, "end_header", ""]).encode()

    with whole(path) as draft, open(draft, "wb") as file:
        file.write(header(0))
        for cloud in clouds:
            rows = np.empty(len(cloud.points), table)
            for field in COLUMNS:
                rows[field] = getattr(cloud, field).reshape(len(rows), -1)
            file.write(rows.tobytes())
            count += len(rows)
        file.seek(0)
        file.write(header(count))
    return count
