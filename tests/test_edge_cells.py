"""Cells about the board's edges: one each, on the right side of the edge, clear of corners, holes and clutter."""

from dataclasses import replace

import numpy as np
import pytest
from scanned_boards import HEAD, rig_of, scene

from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points
from lrfcal_lib.preprocess import board_in_scan
from lrfcal_lib.preprocess.edge_cells import edge_cells
from lrfcal_lib.preprocess.edges_in_scan import with_edges
from lrfcal_lib.session.stated import LrfInfo

LRF = LrfInfo(
    "test", (0.0, np.pi), np.radians(0.25), 0.005, spot_exit=0.01, spot_divergence=0.004
)


def cells_of(made, change=None):
    sweep = (
        made.sweep
        if change is None
        else replace(made.sweep, ranges=change(made.sweep.ranges.copy()))
    )
    board = board_in_scan.find_board(sweep, rig_of(made.board))
    return board, edge_cells(with_edges(board), LRF)


def outside(made, cells):
    """Signed distance of cells from the nearest true edge, and which that is."""
    p = lrf_to_platform(polar_to_points(cells.range_m, cells.bearing), cells.pitch, HEAD)
    p = made.pose.inv().apply(p)
    lines = made.board.lines()
    distance = p[:, :2] @ lines[:, :2].T + lines[:, 2]
    return distance, distance.argmax(axis=1)


@pytest.fixture(scope="module")
def made():
    return scene(sigma=0.004)


@pytest.fixture(scope="module")
def found(made):
    return cells_of(made)


def test_every_cell_once_with_its_reading(made, found):
    board, cells = found
    number = cells.line * made.sweep.ranges.shape[1] + cells.beam
    assert len(np.unique(number)) == len(cells) > 500
    np.testing.assert_array_equal(cells.hit, made.on[cells.line, cells.beam])
    np.testing.assert_allclose(cells.bearing, made.sweep.bearings[cells.beam])
    np.testing.assert_allclose(cells.pitch, made.sweep.pitch[cells.line])
    hit = cells.hit
    miss = made.sweep.ranges[cells.line, cells.beam][hit] - cells.range_m[hit]
    assert np.abs(np.median(miss)) < 0.001 and np.abs(miss).max() < 0.03


def test_hits_lie_inside_and_misses_outside_within_reach(made, found):
    distance, nearest = outside(made, found[1])
    signed = distance[np.arange(len(nearest)), nearest]
    step = 2 * np.radians(0.25) * found[1].range_m * 1.6  # two steps at a slant
    assert (signed[found[1].hit] < 0.002).all() and (signed[~found[1].hit] > -0.002).all()
    assert (np.abs(signed) < step + 0.002).all()
    assert 0.4 < found[1].hit.mean() < 0.6


def test_all_sides_have_cells_and_each_side_is_one_edge(made, found):
    _, nearest = outside(made, found[1])
    sides = np.unique(found[1].side)
    assert len(sides) == 4 and set(nearest) == {0, 1, 2, 3}
    for side in sides:
        mine = (found[1].side == side) & ~found[
            1
        ].hit  # inside, beside a corner, the other edge may be nearer
        assert len(set(nearest[mine])) == 1


def test_holes_what_hides_the_board_and_a_post_close_behind_are_left_out_but_a_close_wall_is_not(
    made,
):
    first = np.flatnonzero(made.on[75])[0]

    def spoil(ranges):
        ranges[70:80, first - 8 : first + 12] = 0.8
        ranges[50:65] = np.where(made.on[50:65], ranges[50:65], 1.9)
        return ranges

    _, cells = cells_of(made, change=spoil)
    assert not (
        (cells.line >= 70) & (cells.line < 80) & (np.abs(cells.beam - first) < 12)
    ).any()
    assert not ((cells.line >= 50) & (cells.line < 65) & ~cells.across).any()
    _, near = cells_of(scene(wall=2.3, sigma=0.004))
    assert len(near) > 500 and not near.background.any()
