"""The board in a sweep and its edges, against scans made by intersecting rays with planes."""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import pytest
from matplotlib.path import Path as Polygon
from scipy import ndimage
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import Board, triangle_board
from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points
from lrfcal_lib.preprocess import board_in_scan
from lrfcal_lib.preprocess.board_in_scan import BoardNotFound, find_board, fit_lines, median_filter
from lrfcal_lib.preprocess.edges_in_scan import crossings
from lrfcal_lib.session.read import Sweep

HEAD = RigidTransform.from_components([0.02, 0.01, 0.12], Rotation.from_rotvec([0.01, -0.02, 0.03]))
SQUARE = Board("plate", ("top", "right", "bottom", "left"), np.array([[0, 0], [0.8, 0], [0.8, 0.7], [0, 0.7]]), None,
               ("left", "top"))  # fmt: skip
TRIANGLE = triangle_board()


def edge_points(scan):
    return crossings(scan)[0]["half_step"]


def sweep_edges(scan):
    return crossings(scan, True, crossings(scan)[1])[0]["half_step"]


def facing(distance=1.6, roll=8.0, tilt=20.0, centre=(0.4, 0.35), x=0.0):
    """``T_platform_board`` of a board that faces the sensor (its y axis down), turned about two axes."""
    upright = Rotation.from_matrix(np.array([[1, 0, 0], [0, 0, 1.0], [0, -1, 0]]))
    rotation = upright * Rotation.from_euler("ZX", [roll, tilt], degrees=True)
    return RigidTransform.from_components(np.array([x, distance, 0.0]) - rotation.apply([*centre, 0]), rotation)


@dataclass
class Scene:
    """What one sweep sees; `on` is the truth about every beam."""

    sweep: Sweep
    on: np.ndarray
    pose: RigidTransform
    board: Board

    def edge_errors(self, edges):
        """Distance of the edge points from the nearest true edge (outwards positive), and which edge that is."""
        p = self.pose.inv().apply(lrf_to_platform(edges.points, edges.pitch, HEAD))
        lines = self.board.lines()
        distance = p[:, :2] @ lines[:, :2].T + lines[:, 2]
        nearest = np.abs(distance).argmin(axis=1)
        return distance[np.arange(len(p)), nearest], nearest

    def outwards(self, edges):
        """The same of the points of straight sides alone."""
        return self.edge_errors(edges)[0][edges.side >= 0]

    def worst(self, edges):
        """Largest error of the edge points of straight sides, metres."""
        return np.abs(self.outwards(edges)).max()

    def in_lrf(self, vectors, pitch):
        """Directions given in the board frame as the LRF sees them at a pitch."""
        at_head = Rotation.from_euler("x", -pitch[:, None]).apply(self.pose.rotation.apply(vectors))
        return HEAD.rotation.inv().apply(at_head)

    def variance(self, edges):
        """Of edge points across their nearest edge, as their covariance says."""
        edge = self.edge_errors(edges)[1]
        n = self.in_lrf(np.column_stack([self.board.lines()[edge, :2], 0 * edges.pitch]), edges.pitch)
        return np.einsum("ni,nij,nj->n", n, edges.covariance, n)


def beams_of(sweep):
    """Origins and directions (L, B, 3) of all beams, platform frame."""
    pitch = np.repeat(sweep.pitch[:, None], len(sweep.bearings), axis=1)
    origin = lrf_to_platform(np.zeros(pitch.shape + (3,)), pitch, HEAD)
    return origin, lrf_to_platform(polar_to_points(np.ones(pitch.shape), sweep.bearings), pitch, HEAD) - origin


def on_plane(sweep, normal, offset):
    """Ranges (L, B) to a plane ``normal . p = offset``, and the points there."""
    origin, rays = beams_of(sweep)
    with np.errstate(divide="ignore"):
        ranges = (offset - origin @ normal) / (rays @ normal)
    return ranges, origin + ranges[..., None] * rays


def scene(board=SQUARE, pose=None, step=0.25, view=(55, 125), pitch=(-20, 20), pitch_step=0.25, wall=3.5, sigma=0.0,
          seed=0):  # fmt: skip
    """Rays against a board in front of a wall (None: nothing behind it)."""
    pose = facing() if pose is None else pose
    bearings = np.radians(np.arange(view[0], view[1] + step / 2, step))
    pitches = np.radians(np.arange(pitch[0], pitch[1] + 1e-9, pitch_step)) if np.ndim(pitch) else np.radians([pitch])
    sweep = Sweep(1, np.zeros((len(pitches), len(bearings))), bearings, pitches, np.full(len(pitches), np.nan))
    normal = pose.rotation.apply([0, 0, 1.0])
    ranges, hits = on_plane(sweep, normal, normal @ pose.translation)
    inside = Polygon(board.corners).contains_points(pose.inv().apply(hits.reshape(-1, 3))[:, :2])
    on = inside.reshape(ranges.shape) & (ranges > 0)
    behind = np.nan if wall is None else on_plane(sweep, np.array([0.0, 1.0, 0.0]), wall)[0]
    ranges = np.where(on, ranges, behind) + sigma * np.random.default_rng(seed).standard_normal(on.shape)
    return spoiled(Scene(sweep, on, pose, board), ranges)


def spoiled(s, ranges):
    return replace(s, sweep=replace(s.sweep, ranges=ranges))


def found(s):
    return find_board(s.sweep, s.board, HEAD)


# ---------------------------------------------------------------------------------------------- finding the board


@pytest.mark.parametrize("wall", [None, 3.5, 1.9])
def test_the_board_and_nothing_else_is_found(wall):
    s = scene(wall=wall, sigma=0.004)
    b = found(s)
    assert np.mean(b.mask != s.on) < 1e-4
    assert abs(b.normal @ s.pose.rotation.apply([0, 0, 1.0])) > np.cos(1e-3)
    assert b.sigma_range == pytest.approx(0.004, rel=0.05)


def test_the_nearest_of_two_boards_is_taken_and_no_small_thing_before_it():
    near, far, apart = scene(), scene(pose=facing(2.6), wall=None), scene(pose=facing(1.2, x=-0.5), wall=None)
    small = near.sweep.ranges.copy()
    small[10:16, 100:110] = 0.6
    for s, ranges, limit in (
        (near, np.fmin(near.sweep.ranges, far.sweep.ranges), 0.01),
        (apart, np.fmin(near.sweep.ranges, apart.sweep.ranges), 1e-3),
        (near, small, 0.01),
    ):
        assert np.mean(found(spoiled(s, ranges)).mask != s.on) < limit


def test_a_board_that_stands_on_the_floor_is_cut_out_of_it():
    s = scene(pose=facing(roll=0.0, tilt=10.0), wall=None, sigma=0.003)
    floor = on_plane(s.sweep, np.array([0.0, 0.0, 1.0]), s.pose.apply([0.4, 0.7, 0.0])[2])[0]
    b = found(spoiled(s, np.fmin(s.sweep.ranges, np.where((floor > 0) & (floor < 6), floor, np.nan))))
    assert np.mean(b.mask & ~s.on) < 0.01 and np.mean(s.on & ~b.mask) < 0.005


def noisy_triangle(seed=0, roll=25.0, **options):
    return scene(TRIANGLE, facing(1.5, roll, 20.0, (0.1, 0.13)), seed=seed, **({"sigma": 0.01} | options))


def shelf(s):
    """A shelf at the height of the sensor that a single scan line sees, triangular in the scan plane."""
    ranges = s.sweep.ranges.copy()
    ranges[12, 60:100] = 0.95 + 0.25 * np.abs(np.linspace(-1, 1, 40))
    return ranges


def edge_on(s):
    """Returns from a surface that is seen along itself."""
    flat = np.abs(np.degrees(s.sweep.bearings)[None] - 70) < 0.6
    ranges = np.full(s.on.shape, np.nan)
    depth = 1.0 + 0.25 * np.random.default_rng(0).random(s.on.shape) ** 0.5
    ranges[40:80] = np.where(flat, depth, np.nan)[40:80]
    return np.sort(ranges, axis=0)


def patchy(s):
    return np.where(np.random.default_rng(1).random(s.on.shape) < 0.75, np.nan, s.sweep.ranges)


MISSING = {
    "no return in 161 scan lines": (scene, lambda s: np.full_like(s.sweep.ranges, np.nan)),
    r"no flat surface of the board's size; seen: .* m2": (scene, lambda s: np.where(s.on, np.nan, s.sweep.ranges)),
    "seen: no flat": (scene, lambda s: np.random.default_rng(0).uniform(1, 90, s.on.shape)),
    "on 1 of 161 scan lines": (noisy_triangle, lambda s: np.where(s.on, np.nan, shelf(s))),
    "seen along itself": (lambda: noisy_triangle(wall=None), edge_on),
    "filled to 2[0-9] %": (lambda: noisy_triangle(wall=None), patchy),
    r"seen: 0\.5\d m2": (lambda: replace(scene(wall=None), board=TRIANGLE), lambda s: s.sweep.ranges),
}


@pytest.mark.parametrize("message", MISSING)
def test_no_board_is_said_with_what_was_seen(message):
    make, change = MISSING[message]
    s = make()
    with pytest.raises(BoardNotFound, match=message):
        found(spoiled(s, change(s)))


def behind(s, centre, width, length, depth):
    """Ranges of a scene with a strip `depth` behind the board, its axis down from `centre` (board frame), mixed."""
    normal = s.pose.rotation.apply([0, 0, 1.0])
    normal = normal * np.sign(normal[1])
    r, points = on_plane(s.sweep, normal, normal @ s.pose.translation + depth)
    at = s.pose.inv().apply(points.reshape(-1, 3))[:, :2].reshape(r.shape + (2,)) - centre
    strip = (np.abs(at[..., 0]) < width / 2) & (at[..., 1] > 0) & (at[..., 1] < length) & ~s.on
    ranges = np.where(strip, np.minimum(r, s.sweep.ranges), s.sweep.ranges)
    near = np.where(np.isfinite(ranges) & (s.on | strip), ranges, np.nan)
    padded = np.pad(near, ((0, 0), (2, 2)), constant_values=np.nan)
    windows = np.stack([padded[:, k : k + near.shape[1]] for k in range(5)])
    mean = np.nansum(windows, axis=0) / np.maximum(np.isfinite(windows).sum(axis=0), 1)
    mixed = np.isfinite(near) & ndimage.binary_dilation(strip, np.ones((5, 5)))
    return np.where(mixed, mean, ranges), strip


@pytest.mark.parametrize("roll", [25.0, 160.0])
def test_a_post_behind_the_board_is_no_part_of_it(roll):
    s = noisy_triangle(roll=roll)
    ranges, post = behind(s, (0.08, 0.05), 0.06, 1.0, 0.2)
    b = found(spoiled(s, ranges))
    assert post.sum() > 50 and not np.any(b.mask & post)
    for e in (edge_points(b), sweep_edges(b)):
        assert 1 <= len(e.sides) <= 3 and s.worst(e) < 0.025
        assert np.mean(np.abs(s.edge_errors(e)[0][e.side >= 0])) < 0.006
        assert all(turned < 4 * turn_sigma(side) for side, turned in directions(s, e))


# ---------------------------------------------------------------------------------------------- filter and fit


def test_median_filter_is_the_median_of_what_exists():
    rng = np.random.default_rng(0)
    ranges = rng.random((7, 30))
    ranges[rng.random(ranges.shape) < 0.2] = np.nan
    mask = rng.random(ranges.shape) < 0.8
    taken = np.where(mask, ranges, np.nan)
    expected = pd.DataFrame(taken).T.rolling(5, min_periods=1, center=True).median().T
    np.testing.assert_array_equal(median_filter(ranges, mask, 5), np.where(np.isfinite(taken), expected, np.nan))
    np.testing.assert_array_equal(median_filter(ranges, True, 1), ranges)
    assert np.isnan(median_filter(np.full((2, 3), np.nan), True)).all()
    for width in (0, 4, -1):
        with pytest.raises(ValueError, match=f"odd and positive, got {width}"):
            median_filter(ranges, True, width)


def test_lines_are_fitted_exactly_and_outliers_do_not_count():
    bearings = np.radians(np.arange(60, 121, 0.5))
    truth = np.array([[0.1, 0.5], [-0.3, 0.7], [0.0, 0.4]])
    ranges = 1 / (truth @ np.stack([np.cos(bearings), np.sin(bearings)]))
    np.testing.assert_allclose(fit_lines(ranges, bearings)[0], truth, atol=1e-12)
    ranges[:, ::9] += 0.3
    np.testing.assert_allclose(fit_lines(ranges, bearings)[0], truth, atol=1e-6)
    ranges[1, 3:] = np.nan
    assert np.isnan(fit_lines(ranges, bearings)[0][1]).all()


# ---------------------------------------------------------------------------------------------- edges


@pytest.mark.parametrize("across", [False, True])
def test_half_step_is_unbiased_and_last_beam_lies_half_a_step_inside(across):
    errors, spacing = {"last_beam": [], "half_step": []}, 1.65 * np.radians(0.25)
    rolls = [3.0] if across else np.linspace(5, 14, 7)
    for s in (scene(pose=facing(roll=roll)) for roll in rolls):
        for variant, own in errors.items():
            e = crossings(found(s), across)[0][variant]
            own.append(s.outwards(e) / spacing)
    last, half = (np.concatenate(own) for own in errors.values())
    assert abs(half.mean()) < 0.1 and -0.65 < last.mean() < -0.35
    assert np.abs(half).max() < 0.75 and last.max() < 0.25
    if across:  # columns see the edges that lie along the scan lines
        assert {x.end for x in e.sides} == {-1, 1} and np.mean(np.isin(s.edge_errors(e)[1][e.side >= 0], [0, 2])) > 0.97
        assert 0.6 < np.mean((s.edge_errors(e)[0] ** 2 / s.variance(e))[e.side >= 0]) < 1.5


@pytest.mark.parametrize("sigma", [0.0, 0.006, 0.01])
def test_the_covariance_of_edge_points_is_realistic(sigma):
    across, ranges = [], []
    for seed, roll in enumerate(np.linspace(5, 14, 6)):
        s = scene(pose=facing(roll=roll), sigma=sigma, seed=seed)
        e = edge_points(found(s))
        across.append((s.edge_errors(e)[0] ** 2 / s.variance(e))[e.side >= 0])
        normal = s.in_lrf([0, 0, 1.0], e.pitch)
        height = s.pose.inv().apply(lrf_to_platform(e.points, e.pitch, HEAD))[:, 2]
        ranges.append(height**2 / np.einsum("ni,nij,nj->n", normal, e.covariance, normal))
    assert 0.7 < np.concatenate(across).mean() < 1.4
    assert not sigma or 0.6 < np.concatenate(ranges).mean() < 1.6


def test_four_sides_are_found_and_named_alike_by_lines_and_columns_in_both_variants():
    s = scene(pose=facing(roll=32.0), sigma=0.004)
    b = found(s)
    lines, columns = edge_points(b), sweep_edges(b)
    assert len(lines.sides) == 4 and {x.side for x in lines.sides} == {x.side for x in columns.sides}
    names = [[np.bincount(s.edge_errors(e)[1][e.side == k]).argmax() for k in range(4)] for e in (lines, columns)]
    assert names[0] == names[1] and sorted(names[0]) == [0, 1, 2, 3] and s.worst(lines) < 0.008
    along, sides = crossings(b)
    for e, last in ((lines, along["last_beam"]), (columns, crossings(b, True, sides)[0]["last_beam"])):
        np.testing.assert_array_equal([e.side, e.line], [last.side, last.line])


def directions(s, e):
    """Each side with the angle between it and the true edge nearest to its points, radians."""
    edge, lines = s.edge_errors(e)[1], s.board.lines()
    p = s.pose.inv().apply(lrf_to_platform(e.points, e.pitch, HEAD))[:, :2]
    for side in e.sides:
        mine = e.side == side.side
        along = np.linalg.svd(p[mine] - p[mine].mean(axis=0))[2][0]
        yield side, np.arcsin(min(abs(along @ lines[np.bincount(edge[mine]).argmax(), :2]), 1.0))


def turn_sigma(side):
    """Standard deviation of the direction of a side whose neighbours share their errors, and a millimetre always."""
    return np.sqrt(12 * (2 * side.rms**2 / side.n_points + 0.001**2)) / side.length


def test_sides_are_turned_as_little_as_their_scatter_says():
    turned = []
    for seed in range(8):
        b = found(s := noisy_triangle(seed, roll=10.0 + 40 * seed))
        for e in (edge_points(b), sweep_edges(b)):
            turned += [angle / turn_sigma(side) for side, angle in directions(s, e)]
    assert len(turned) > 30 and max(turned) < 1.5  # a spot of no size before an even wall does better than a real one


@pytest.mark.parametrize("fill", [np.nan, 3.4, 0.5])
def test_holes_do_not_make_edges(fill):
    s = scene(sigma=0.003)
    rng, ranges, rows = np.random.default_rng(3), s.sweep.ranges.copy(), np.flatnonzero(s.on.any(axis=1))
    middle = s.on.argmax(axis=1) + s.on.sum(axis=1) // 2
    for row in rows[5:-5:2]:
        ranges[row, middle[row] + rng.integers(-25, 20) + np.arange(rng.integers(1, 8))] = fill
    holed, clean = edge_points(found(spoiled(s, ranges))), edge_points(found(s))
    np.testing.assert_array_equal(holed.line, clean.line)
    assert s.worst(holed) < 0.008 and np.linalg.norm(holed.points - clean.points, axis=1).max() < 0.01


def test_where_view_or_sweep_end_or_something_hides_the_board_is_no_edge():
    post = scene(sigma=0.003)
    hidden = np.abs(np.degrees(post.sweep.bearings) - 102) < 5
    for s, function, end in (
        (scene(pose=facing(x=0.95), sigma=0.003), edge_points, 1),
        (scene(pose=facing(roll=2.0), pitch=(-5, 20), sigma=0.003), sweep_edges, 1),
        (spoiled(post, np.where(hidden, 0.8, post.sweep.ranges)), edge_points, -1),
    ):
        e = function(found(s))
        assert {x.end for x in e.sides} == {end} and s.worst(e) < 0.012


# ---------------------------------------------------------------------------------------------- invariances


def test_face_points_lie_on_the_face_and_away_from_the_edges():
    s = scene(sigma=0.005)
    p_lrf, pitch, covariance = board_in_scan.face_points(found(s), 300)
    assert p_lrf.shape == (300, 3) and pitch.shape == (300,) and covariance.shape == (300, 3, 3)
    p, lines = s.pose.inv().apply(lrf_to_platform(p_lrf, pitch, HEAD)), s.board.lines()
    assert (p[:, :2] @ lines[:, :2].T + lines[:, 2]).max() < -0.01
    normal = s.in_lrf([0, 0, 1.0], pitch)
    assert 0.8 < np.mean(p[:, 2] ** 2 / np.einsum("ni,nij,nj->n", normal, covariance, normal)) < 1.25
    assert np.linalg.eigvalsh(covariance)[:, 1].min() > 0


# ---------------------------------------------------------------------------------------------- the real recording
