"""Where the board's edges cross a scan: points, covariance, sides."""

import numpy as np
import pytest
from scanned_boards import (
    HEAD,
    edge_points,
    facing,
    found,
    noisy_triangle,
    on_plane,
    scene,
    spoiled,
    sweep_edges,
)
from scipy import ndimage

from lrfcal_lib.model.geometry import lrf_to_platform


def behind(s, centre, width, length, depth):
    """Ranges of a scene with a strip `depth` behind the board, its axis down from `centre` (board frame), mixed."""
    normal = s.pose.rotation.apply([0, 0, 1.0])
    normal = normal * np.sign(normal[1])
    r, points = on_plane(s.sweep, normal, normal @ s.pose.translation + depth)
    at = s.pose.inv().apply(points.reshape(-1, 3))[:, :2].reshape(r.shape + (2,)) - centre
    strip = (
        (np.abs(at[..., 0]) < width / 2) & (at[..., 1] > 0) & (at[..., 1] < length) & ~s.on
    )
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


@pytest.mark.parametrize("across", [False, True])
def test_half_step_is_unbiased_and_last_beam_lies_half_a_step_inside(across):
    errors = {"last_beam": [], "half_step": []}
    spacing = 1.65 * np.radians(0.25)
    rolls = [3.0] if across else np.linspace(5, 14, 7)
    for s in (scene(pose=facing(roll=roll)) for roll in rolls):
        for variant, own in errors.items():
            e = edge_points(found(s), across, variant)
            own.append(s.outwards(e) / spacing)
    last, half = (np.concatenate(own) for own in errors.values())
    assert abs(half.mean()) < 0.1 and -0.65 < last.mean() < -0.35
    assert np.abs(half).max() < 0.75 and last.max() < 0.25
    if across:  # columns see the edges that lie along the scan lines
        assert (
            set(e.end[e.side >= 0]) == {-1, 1}
            and np.mean(np.isin(s.edge_errors(e)[1][e.side >= 0], [0, 2])) > 0.97
        )
        assert 0.6 < np.mean((s.edge_errors(e)[0] ** 2 / s.variance(e))[e.side >= 0]) < 1.5


@pytest.mark.parametrize("sigma", [0.0, 0.006, 0.01])
def test_the_covariance_of_edge_points_is_realistic(sigma):
    across = []
    ranges = []
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
    lines = edge_points(b)
    columns = sweep_edges(b)
    assert len(lines.sides) == 4 and lines.sides.keys() == columns.sides.keys()
    names = [
        [np.bincount(s.edge_errors(e)[1][e.side == k]).argmax() for k in range(4)]
        for e in (lines, columns)
    ]
    assert (
        names[0] == names[1] and sorted(names[0]) == [0, 1, 2, 3] and s.worst(lines) < 0.008
    )
    for across, e in enumerate((lines, columns)):
        last = edge_points(b, bool(across), "last_beam")
        np.testing.assert_array_equal([e.side, e.line], [last.side, last.line])


def directions(s, e):
    """Each side with the angle between it and the true edge nearest to its points, radians."""
    edge = s.edge_errors(e)[1]
    lines = s.board.lines()
    p = s.pose.inv().apply(lrf_to_platform(e.points, e.pitch, HEAD))[:, :2]
    for number, side in e.sides.items():
        mine = e.side == number
        along = np.linalg.svd(p[mine] - p[mine].mean(axis=0))[2][0]
        yield (
            side,
            np.arcsin(min(abs(along @ lines[np.bincount(edge[mine]).argmax(), :2]), 1.0)),
        )


def turn_sigma(side):
    """Standard deviation of the direction of a side whose neighbours share their errors, and a millimetre always."""
    return np.sqrt(12 * (2 * side.rms**2 / side.n_points + 0.001**2)) / side.length


def test_sides_are_turned_as_little_as_their_scatter_says():
    turned = []
    for seed in range(8):
        b = found(s := noisy_triangle(seed, roll=10.0 + 40 * seed))
        for e in (edge_points(b), sweep_edges(b)):
            turned += [angle / turn_sigma(side) for side, angle in directions(s, e)]
    assert (
        len(turned) > 30 and max(turned) < 1.5
    )  # a spot of no size before an even wall does better than a real one


@pytest.mark.parametrize("fill", [np.nan, 3.4, 0.5])
def test_holes_do_not_make_edges(fill):
    s = scene(sigma=0.003)
    rng = np.random.default_rng(3)
    ranges = s.sweep.ranges.copy()
    rows = np.flatnonzero(s.on.any(axis=1))
    middle = s.on.argmax(axis=1) + s.on.sum(axis=1) // 2
    for row in rows[5:-5:2]:
        ranges[row, middle[row] + rng.integers(-25, 20) + np.arange(rng.integers(1, 8))] = (
            fill
        )
    holed = edge_points(found(spoiled(s, ranges)))
    clean = edge_points(found(s))
    np.testing.assert_array_equal(holed.line, clean.line)
    assert (
        s.worst(holed) < 0.008
        and np.linalg.norm(holed.points - clean.points, axis=1).max() < 0.01
    )


def test_where_view_or_sweep_end_or_something_hides_the_board_is_no_edge():
    post = scene(sigma=0.003)
    hidden = np.abs(np.degrees(post.sweep.bearings) - 102) < 5
    for s, function, end in (
        (scene(pose=facing(x=0.95), sigma=0.003), edge_points, 1),
        (scene(pose=facing(roll=2.0), pitch=(-5, 20), sigma=0.003), sweep_edges, 1),
        (spoiled(post, np.where(hidden, 0.8, post.sweep.ranges)), edge_points, -1),
    ):
        e = function(found(s))
        assert set(e.end[e.side >= 0]) == {end} and s.worst(e) < 0.012


def test_a_board_that_is_larger_than_the_view_has_no_edges():
    b = found(scene(pose=facing(1.3), view=(82, 98), pitch=(-9, 8)))
    for edges in (edge_points(b), sweep_edges(b)):
        assert not len(edges.side) and not edges.sides
