"""Find the board in the range image of a sweep: pieces without a depth jump, planes in them, plausible size."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from lrfcal_lib.geometry import DegenerateGeometry, fit_plane, polar_to_points, tilt

STEEPEST = np.tan(np.radians(80))  # a face seen at a flatter angle than 10 deg is taken for a depth jump
DEPTH_NOISE = 0.03  # metres; what noise and dark print change between neighbouring beams of one face
PLANE_NOISE = 0.02  # metres; noise and warp of a board about its plane
LONGEST_HOLE = 0.15  # metres; a gap without returns that does not end a surface (print, gloss)
LARGEST_NOISE = 0.04  # metres; the farthest from its plane that a return of a noisy device still counts
FEWEST_POINTS = 12
LEAST_FILL = 0.5  # share of its convex hull that a board fills; what clutter leaves on a plane is patchy
FEWEST_LINES = 4  # that a surface of a sweep must span: points of one scan line lie in a plane whatever they hit
RIGID_SIZES = (0.02, 4.0, 4.0)  # m2, m2, m: what may be a board when nothing is known about it


class BoardNotFound(ValueError):
    """No board in a sweep; the message says what was seen instead."""


def depth_jump(ranges, step):
    """Change of range between neighbours that no face of a board makes, metres.

    Parameters
    ----------
    ranges : array_like
        Metres.
    step : array_like, broadcastable
        Angle between the neighbours, radians.
    """
    return DEPTH_NOISE + STEEPEST * np.asarray(ranges) * np.abs(step)


def segments(ranges, *, jump=DEPTH_NOISE, bridge=0):
    """Cut scan lines at depth discontinuities; step (i) of the paper's preprocessing.

    Parameters
    ----------
    ranges : ndarray, shape (L, B)
        Metres, NaN where nothing came back.
    jump : float or ndarray, shape (L, B)
        Metres: a change of range between neighbours (times the number of steps between them) above this ends a piece.
    bridge : int or ndarray, shape (L, B)
        Number of beams without a return that do not end a piece by themselves.

    Returns
    -------
    ndarray of int, shape (L, B)
        Number of the piece, ascending along the lines; -1 where there is no return.
    """
    ranges = np.asarray(ranges, float)
    seen = np.isfinite(ranges)
    line, beam = np.nonzero(seen)
    r, jump, bridge = (np.broadcast_to(v, ranges.shape)[seen] for v in (ranges, jump, bridge))
    gap = np.diff(beam)
    broken = (np.diff(line) != 0) | (gap - 1 > bridge[1:]) | (np.abs(np.diff(r)) > gap * jump[1:])
    labels = np.full(ranges.shape, -1)
    labels[seen] = np.cumsum(np.r_[True, broken])[: len(r)] - 1
    return labels


def surfaces(ranges, bearings, pitch):
    """Connected surfaces of a range image: pieces of scan lines joined across the lines.

    Parameters
    ----------
    ranges : ndarray, shape (L, B)
        Metres.
    bearings : ndarray, shape (B,)
        Radians.
    pitch : ndarray, shape (L,)
        Radians.

    Returns
    -------
    ndarray of int, shape (L, B)
        Number of the surface, -1 where there is no return.
    """
    step = np.median(np.diff(bearings)) if len(bearings) > 1 else 0.0
    near = np.where(np.isfinite(ranges), ranges, 1.0)
    bridge = (LONGEST_HOLE / np.maximum(near * step, 1e-9)).astype(int)
    pieces = segments(ranges, jump=depth_jump(near, step), bridge=bridge)
    close = np.abs(np.diff(ranges, axis=0)) < depth_jump(near[1:], np.diff(pitch)[:, None])
    pairs = np.unique(np.stack([pieces[:-1][close], pieces[1:][close]]), axis=1)
    n = pieces.max(initial=-1) + 1
    graph = coo_array((np.ones(pairs.shape[1]), (pairs[0], pairs[1])), shape=(n, n))
    joined = connected_components(graph, directed=False)[1] if n else np.zeros(0, int)
    return np.where(pieces >= 0, np.append(joined, -1)[pieces], -1)


def planar_surface(sweep, T_head_lrf, board=None, rng=None):
    """The nearest flat connected surface of a board's size.

    Parameters
    ----------
    sweep : Sweep
    T_head_lrf : RigidTransform
    board : Board, optional
        Tells the size: its outline, else its pattern, else anything from 0.02 to 4 m2.
    rng : numpy.random.Generator, optional

    Returns
    -------
    mask : ndarray of bool, shape (L, B)
    normal : ndarray, shape (3,)
        Of the plane in the nominal platform frame. With all scan lines at one pitch the plane is not determined by
        them; the one at right angles to the scan plane is returned.
    distance : float
        ``normal . p_platform = distance``, metres.

    Raises
    ------
    BoardNotFound
        With what was seen instead.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    if not np.isfinite(sweep.ranges).any():
        raise BoardNotFound(f"placement {sweep.placement}: no return in {len(sweep.pitch)} scan lines")
    labels = surfaces(sweep.ranges, sweep.bearings, sweep.pitch)
    points = platform_points(sweep, T_head_lrf)
    upright = upright_direction(sweep, T_head_lrf)
    seen, best = [], None
    for label in _by_distance(labels, sweep.ranges):
        surface = labels == label
        if best is not None and np.nanmin(sweep.ranges[surface]) > best[0]:
            break
        for mask, plane in _planes(sweep, points, surface, upright, rng):
            if best is not None and np.nanmin(sweep.ranges[mask]) > best[0]:
                continue
            reach = float(np.median(sweep.ranges[mask]))
            mask, size, fits = _judge(points, mask, plane, board, upright)
            fault = "" if upright is not None else _fault(sweep, T_head_lrf, points, mask, plane)
            seen.append(f"{size[0]:.2f} m2, {size[1]:.2f} m long at {reach:.2f} m{fault}")
            if fits and not fault and (best is None or reach < best[0]):
                best = (reach, mask, *plane)
    if best is None:
        found = "; ".join(seen[:4]) or "no flat surface"
        raise BoardNotFound(f"placement {sweep.placement}: no flat surface of the board's size; seen: {found}")
    return _with_noisy_returns(points, *best[1:])


def _fault(sweep, T_head_lrf, points, mask, plane):
    """Why a surface of a sweep is no face of a board: few scan lines, seen along itself, patchy. '' if it may be."""
    lines = int(mask.any(axis=1).sum())
    if lines < min(FEWEST_LINES, len(sweep.pitch)):
        return f" on {lines} of {len(sweep.pitch)} scan lines"
    row, beam = np.nonzero(mask)
    rays = points[mask] - tilt(T_head_lrf.translation, sweep.pitch[row])
    slope = np.abs(rays @ plane[0]) / np.linalg.norm(rays, axis=1)
    if np.median(slope) * STEEPEST < 1:
        return " seen along itself"
    fill = _fill(row, beam)
    return f" filled to {100 * fill:.0f} %" if fill < LEAST_FILL else ""


def _fill(row, beam):
    """Share of the cells of the range image within the convex hull of some of them that these are (Pick's theorem)."""
    try:
        hull = ConvexHull(np.column_stack([row, beam]))
    except QhullError:
        return 1.0
    corners = hull.points[hull.vertices].astype(int)
    rim = np.gcd(*np.abs(np.roll(corners, -1, axis=0) - corners).T).sum()
    return len(row) / (hull.volume + rim / 2 + 1)


def _with_noisy_returns(points, mask, normal, distance):
    """A surface with the returns in and beside it that only the noise of its own points takes off its plane."""
    miss = np.abs(points @ normal - distance)
    reach = np.clip(3 * 1.4826 * np.median(miss[mask]), PLANE_NOISE, LARGEST_NOISE)
    return mask | (ndimage.binary_dilation(mask, np.ones((3, 3))) & (miss < reach)), normal, distance


def _judge(points, mask, plane, board, upright):
    """Whether a flat surface may be the board, if need be without the thin strips of floor or wall it touches."""
    size = plane_size(points[mask], plane[0], upright)
    if _plausible(size, board, upright is not None) or upright is not None:
        return mask, size, _plausible(size, board, upright is not None)
    core = ndimage.binary_opening(ndimage.binary_closing(mask, iterations=2), np.ones((5, 5)))
    labels, count = ndimage.label(core)
    if count == 0:
        return mask, size, False
    core = labels == np.bincount(labels[labels > 0]).argmax()
    trimmed = mask & ndimage.binary_dilation(core, np.ones((3, 3)))
    smaller = plane_size(points[trimmed], plane[0])
    return trimmed, size, _plausible(smaller, board, False)


def platform_points(sweep, T_head_lrf):
    """All returns in the nominal platform frame, shape (L, B, 3), NaN where there is none; equation (6)."""
    p_lrf = polar_to_points(sweep.ranges, sweep.bearings)
    p_head = p_lrf @ T_head_lrf.rotation.as_matrix().T + T_head_lrf.translation
    return tilt(p_head, sweep.pitch[:, None])


def upright_direction(sweep, T_head_lrf):
    """Normal of the scan plane in the platform frame where all lines share one pitch, else None."""
    if len(sweep.pitch) > 1 and np.ptp(sweep.pitch) > 1e-4:
        return None
    return tilt(T_head_lrf.rotation.apply([0.0, 0.0, 1.0]), float(sweep.pitch[0]))


def _by_distance(labels, ranges):
    """Surfaces with enough points, the nearest first."""
    seen = labels >= 0
    count = np.bincount(labels[seen])
    nearest = np.full(len(count), np.inf)
    np.minimum.at(nearest, labels[seen], ranges[seen])
    enough = np.flatnonzero(count >= FEWEST_POINTS)
    return enough[np.argsort(nearest[enough])]


def _planes(sweep, points, surface, upright, rng, most=25):
    """Flat connected parts of a surface: the largest plane first, then what is left."""
    left = surface.copy()
    for _ in range(most):
        if left.sum() < FEWEST_POINTS:
            return
        plane = _best_plane(points[left], upright, rng)
        if plane is None:
            return
        on = left & (np.abs(np.nan_to_num(points, nan=1e9) @ plane[0] - plane[1]) < PLANE_NOISE)
        labels = surfaces(np.where(on, sweep.ranges, np.nan), sweep.bearings, sweep.pitch)
        count = np.bincount(labels[labels >= 0])
        for label in np.flatnonzero(count >= max(FEWEST_POINTS, 0.2 * count.max())):
            yield labels == label, plane
        left &= ~on


def _best_plane(points, upright, rng, trials=200, sample=1500):
    """Random sample consensus over neighbouring points, then total least squares over all that agree."""
    few = points[rng.permutation(len(points))[:sample]]
    seeds = few[rng.integers(len(few), size=trials)]
    near = np.linalg.norm(seeds[:, None] - few, axis=2)
    near = np.where((near < 0.3) & (near > 1e-6), rng.random(near.shape), -1.0)
    others = few[np.argpartition(-near, 1, axis=1)[:, :2]]
    second = others[:, 1] - seeds if upright is None else np.broadcast_to(upright, seeds.shape)
    normals = np.cross(others[:, 0] - seeds, second)
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 1e-9] / length[length > 1e-9, None]
    offsets = np.sum(normals * seeds[length > 1e-9], axis=1)
    if len(normals) == 0:
        return None
    votes = np.sum(np.abs(normals @ few.T - offsets[:, None]) < PLANE_NOISE, axis=1)
    plane = normals[votes.argmax()], offsets[votes.argmax()]
    for _ in range(3):
        on = np.abs(points @ plane[0] - plane[1]) < PLANE_NOISE
        try:
            plane = _fit(points[on], upright)
        except DegenerateGeometry:
            return None
    return plane


def _fit(points, upright):
    if upright is not None:
        points = np.concatenate([points + 0.1 * upright, points - 0.1 * upright])
    return fit_plane(points)[:2]


def plane_axes(normal):
    """Two unit vectors in a plane, shape (2, 3): the first as level as the second is steep."""
    across = np.cross(normal, [1.0, 0.0, 0.0] if abs(normal[0]) < 0.9 else [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    return np.stack([np.cross(across, normal), across])


def plane_size(points, normal, upright=None):
    """Area (m2; 0 for a single line) and greatest length (m) of points in a plane."""
    flat = points @ plane_axes(normal).T
    if upright is None:
        try:
            hull = ConvexHull(flat)
        except QhullError:
            return 0.0, float(np.linalg.norm(np.ptp(flat, axis=0)))
        corners = flat[hull.vertices]
        return float(hull.volume), float(np.linalg.norm(corners[:, None] - corners, axis=2).max())
    return 0.0, float(np.ptp(points @ np.cross(normal, upright)))


def expected_size(board):
    """Least area, greatest area (m2) and greatest length (m) of what is seen of a board."""
    if board is not None and board.corners is not None:
        corners = np.asarray(board.corners, float)
        length = np.linalg.norm(corners[:, None] - corners, axis=2).max()
        return 0.25 * ConvexHull(corners).volume, 1.35 * ConvexHull(corners).volume, 1.2 * length
    if board is not None and board.pattern is not None:
        size = board.pattern.square * np.array([board.pattern.columns + 1, board.pattern.rows + 1])
        return 0.3 * np.prod(size), 4 * np.prod(size), 2.5 * np.linalg.norm(size)
    return RIGID_SIZES


def _plausible(size, board, single_line):
    least, most, longest = expected_size(board)
    if single_line:
        return 0.3 * np.sqrt(least) < size[1] < longest
    return least < size[0] < most and size[1] < longest
