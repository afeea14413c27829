"""Sweeps, images and a calibration make a coloured cloud, block by block: any number of points
in bounded memory.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter, uniform_filter
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.mixed import mixed
from lrfcal_lib.calibrate.painting import Painter, View
from lrfcal_lib.fit.covariance import dyads
from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points, unit_vector
from lrfcal_lib.model.kinematics import MIRROR_TURN, Corrections
from lrfcal_lib.session.read import Sweep
from lrfcal_lib.session.stated import LrfInfo

GREY = 128  # colour of points that no camera sees
BLOCK = 1 << 18  # points worked on at once
KEPT = (
    4 * BLOCK
)  # points of a sweep whose blocks are made once: they are gone through twice
WINDOW = 4  # beams and scan lines on either side of a point that make its normal
MARGIN = 4 * WINDOW  # scan lines about a block that its normals and mixed pixels need
GAIN_POINTS = 30_000  # that compare the exposures of images
LEAST_SPREAD = 1e-12  # square metres: points on a line span no plane
BEHIND = 5.0  # sigma: between the farthest and the nearest of a few points of a wall


def reconstruct(
    sweep: Sweep,
    views: Sequence[View],
    T_head_lrf: RigidTransform,
    corrections: Corrections,
    *,
    lrf: LrfInfo,
    continuous: bool = False,
    mask: np.ndarray | None = None,
) -> Iterator[Cloud]:
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

    Raises
    ------
    ValueError
        For a sweep without a range, or of another rig.
    """
    _refuse(sweep, lrf)
    if mask is None:
        mask = np.isfinite(sweep.ranges)
    steps = (sweep.pitch_step, lrf.bearing_step)
    painter = Painter(views, max(steps), BEHIND * lrf.sigma_range)
    blocks_of = partial(_blocks, sweep, steps, T_head_lrf, corrections, lrf, continuous, {})
    if sweep.ranges.size <= KEPT:
        blocks_of = partial(iter, list(blocks_of()))
    samples = []
    every = max(1, sweep.ranges.size // GAIN_POINTS)
    for block in blocks_of():
        painter.hide(block.hiding.reshape(-1, 3))
        sound = np.stack([block.points, block.normals])[:, block.good]
        # a view would keep the whole block
        samples.append(sound[:, ::every].copy())
    painter.compare_exposures(*np.concatenate(samples, axis=1))
    for block in blocks_of():
        yield _coloured(block, sweep, painter, mask[block.lines], lrf.sigma_range)


def _refuse(sweep, lrf):
    """ValueError for a sweep without a range, or with bearings that the LRF does not have."""
    if not np.isfinite(sweep.ranges).any():
        raise ValueError(
            f"placement {sweep.placement}: an empty sweep ({len(sweep.ranges)} scan lines, no "
            "range)"
        )
    first, last = np.degrees(sweep.bearings[[0, -1]]).round(2)
    right, left = np.degrees(lrf.field_of_view).round(2)
    step = np.degrees(lrf.bearing_step)
    if first < right - step or last > left + step:
        raise ValueError(
            f"placement {sweep.placement}: bearings {first} to {last} deg, '{lrf.model}' sees "
            f"{right} to {left} deg: take the calibration of the rig that recorded it"
        )


def _coloured(block, sweep, painter, wanted, sigma_range):
    """The sound ones among wanted points (l, B) of a block, as a Cloud."""
    take = block.good & wanted
    line, beam = np.nonzero(take)
    n = len(line)
    points = block.points[take]
    normals = block.normals[take]
    colors, seen, source = painter.paint(points, normals)
    colors = np.rint(np.nan_to_num(colors, nan=GREY))
    intensity = np.full(n, np.nan)
    if sweep.intensities is not None:
        intensity = sweep.intensities[block.lines][take].astype(float)
    return Cloud(
        points=points,
        normals=normals,
        colors=np.clip(colors, 0, 255).astype(np.uint8),
        seen=seen,
        placement=np.full(n, sweep.placement),
        image=source,
        pitch=sweep.pitch[block.lines][line],
        bearing=sweep.bearings[beam],
        range=sweep.ranges[block.lines][take],
        intensity=intensity,
        sigma=np.nan_to_num(block.scatter[take], nan=sigma_range),
        removed=(wanted & ~block.good).sum(),
    )


class _Block(NamedTuple):
    """Some scan lines of a sweep, points on a grid (l, B): in space, with normals and scatter
    about the surface, as they hide others, and whether they are sound.
    """

    lines: slice
    points: np.ndarray
    normals: np.ndarray
    scatter: np.ndarray
    hiding: np.ndarray
    good: np.ndarray


def _blocks(sweep, steps, T_head_lrf, corrections, lrf, continuous, sound):
    """The blocks of a sweep, one by one; mixed pixels are looked for where `sound`, by first line,
    does not know them yet.
    """
    rate = np.zeros(len(sweep.pitch))
    if continuous and len(sweep.pitch) > 1:
        rate = np.gradient(sweep.pitch, sweep.time_s)
    after = after_middle(sweep.bearings, lrf)
    lines, beams = sweep.ranges.shape
    size = max(1, BLOCK // beams)
    for start in range(0, lines, size):
        about = slice(max(0, start - MARGIN), start + size + MARGIN)
        ranges = sweep.ranges[about].astype(float)
        p_lrf = corrections.points(polar_to_points(ranges, sweep.bearings))
        # of every beam: between scan lines the mirror turns while the head moves
        recorded = sweep.pitch[about, None] + rate[about, None] * after
        pitch = corrections.pitch(sweep.placement, recorded)
        points = lrf_to_platform(p_lrf, pitch, T_head_lrf)
        hiding = points
        good = sound.get(start, np.isfinite(ranges))
        spot_stated = None not in (lrf.spot_exit, lrf.spot_divergence)
        if spot_stated and start not in sound:
            nearer = mixed(ranges, steps, lrf)
            good = sound[start] = good & (nearer == 0)
            surface = p_lrf - nearer[..., None] * unit_vector(p_lrf)
            hiding = lrf_to_platform(surface, pitch, T_head_lrf)
        origin = lrf_to_platform(np.zeros(3), pitch, T_head_lrf)
        normals, scatter = grid_normals(np.where(good[..., None], points, np.nan), origin)
        inner = slice(start - about.start, start - about.start + size)
        yield _Block(
            lines=slice(start, start + size),
            points=points[inner],
            normals=normals[inner],
            scatter=scatter[inner],
            hiding=hiding[inner],
            good=good[inner],
        )


def after_middle(bearings: np.ndarray, lrf: LrfInfo) -> np.ndarray:
    """Seconds from the middle beam of a scan line to beams at these bearings, shape (B,)."""
    # of the mirror, for lines finer than a degree
    turns = max(1, round(np.radians(1.0) / lrf.bearing_step))
    first, last = lrf.field_of_view
    beams = np.rint((bearings - first) / lrf.bearing_step)
    middle = np.rint((last - first) / lrf.bearing_step) // 2

    def instant(beam):
        return (beam * lrf.bearing_step / (2 * np.pi) + beam % turns) * MIRROR_TURN

    return instant(beams) - instant(middle)


def grid_normals(points: np.ndarray, origins: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals of points on a grid, and how rough the surface is.

    Of the flattest window that holds the point: nine windows, the point in the middle, on a side or
    in a corner of them, so that an edge spoils none of its sides.

    Parameters
    ----------
    points, origins : ndarray, shape (l, b, 3)
        Metres, NaN where there is no point; where the sensor was.

    Returns
    -------
    normals : ndarray, shape (l, b, 3)
        Unit vectors towards the origins; NaN where less than a third of every window is there.
    scatter : ndarray, shape (l, b)
        Standard deviation along them, metres.
    """
    valid = np.isfinite(points).all(axis=-1)
    centre = np.sum(points[valid], axis=0) / max(valid.sum(), 1)
    p = np.where(valid[..., None], points - centre, 0.0)
    width = 2 * WINDOW + 1
    # means over all windows, where nothing is counts as zero
    means = partial(uniform_filter, size=width, mode="constant", axes=(0, 1))
    share = means(valid, output=float)
    whole = np.maximum(share, 0.5 / width**2)[..., None]
    spread = means(dyads(p)) / whole[..., None] - dyads(means(p) / whole)
    variances, directions = np.linalg.eigh(spread)
    least, middle, _ = np.moveaxis(variances, -1, 0)
    known = (share > 1 / 3) & (middle > LEAST_SPREAD)
    rough = np.where(known, np.maximum(least, 0.0), np.nan).ravel()
    flattest = rough.argsort()  # numbers of windows, unknown ones last
    rank = flattest.argsort().reshape(valid.shape)
    nine = np.zeros((width, width))
    nine[::WINDOW, ::WINDOW] = 1
    best = flattest[minimum_filter(rank, footprint=nine, mode="nearest")]
    normals = directions[..., 0].reshape(-1, 3)[best]
    away = np.vecdot(normals, points - origins) > 0
    normals[away] *= -1
    scatter = np.sqrt(np.where(valid, rough[best], np.nan))
    normals[np.isnan(scatter)] = np.nan
    return normals, scatter
