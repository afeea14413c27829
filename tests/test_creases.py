"""Where surfaces meet, also behind a skirting board, and what edges beside that ask for."""

from dataclasses import replace

import numpy as np
import pytest
from holds_draws import ROOM, true_rig

from lrfcal_lib.calibrate.cloud import COLUMNS, Cloud
from lrfcal_lib.measure.creases import EDGE, Sights, creases_of
from lrfcal_lib.measure.features import fit_feature
from lrfcal_lib.session.read import open_session

NOISE = 0.01  # metres


@pytest.fixture(scope="module")
def rig():
    return true_rig(open_session(ROOM))


def corner(rig, seed, thick=0.0, high=0.0):
    """A floor at z = -1 that meets a wall at y = 3, as noisy readings show both."""
    rng = np.random.default_rng(seed)
    x, along = np.meshgrid(np.arange(-1, 1, 0.02), np.arange(0.01, 1.5, 0.02))
    x, along = x.ravel(), along.ravel()
    floor = np.stack([x, 3 - along, np.full_like(x, -1.0)], axis=1)
    wall = np.stack([x, 3 - thick * (along < high), along - 1], axis=1)
    floor[:, 2] += rng.normal(0, NOISE, len(x))
    wall[:, 1] += rng.normal(0, NOISE, len(x))
    points = np.concatenate([floor, wall])
    values = dict.fromkeys(COLUMNS, np.zeros(len(points)))
    values["range"] = np.linalg.norm(points, axis=1)
    values["bearing"] = np.arctan2(points[:, 0], points[:, 1])
    cloud = Cloud(**values | {"points": points, "normals": np.zeros_like(points)})
    of_point = np.repeat([0, 1], len(x))
    far = np.tile(along > 0.2, 2)
    planes = [fit_feature(cloud, far & (of_point == k), rig) for k in (0, 1)]
    return creases_of(cloud, planes, of_point)


@pytest.mark.parametrize("thick", [0.0, 0.015])
def test_a_crease_is_where_readings_beside_it_are(rig, thick):
    """It errs as it says; a skirting board moves it, by its thickness, and makes it less certain."""
    squares = []
    for seed in range(20):
        creases = corner(rig, seed, thick, 0.09)
        assert len(creases.points) > 30
        np.testing.assert_allclose(np.abs(creases.motions[:, 2, 0]), 1.0, atol=1e-3)
        miss = creases.points - [0.0, 3.0 - thick, -1.0]
        off = np.linalg.norm(creases.motions[:, :2], axis=1)
        squares.append((miss / off)[:, 1:].mean(axis=0) ** 2)
        assert (off[:, 1] > 0.003).all() == (thick > 0)
        assert np.abs(miss[:, 1]).max() < 0.006
    assert np.mean(squares) < 1.5


def test_surfaces_that_do_not_reach_each_other_have_no_crease(rig):
    creases = corner(rig, 1)
    assert creases.motions.shape == (len(creases.points), 3, 3)
    cloud = Cloud(**{name: np.zeros((0, 3)) for name in ("points", "normals", *COLUMNS)})
    assert len(creases_of(cloud, [], np.zeros(0, int)).points) == 0


def sights_of(seed, places=30, edges=5, unknowns=4):
    """Places with edges at random."""
    rng = np.random.default_rng(seed)
    place = np.repeat(np.arange(places), edges)
    return Sights(
        place=place,
        by_unknown=rng.normal(size=(places, unknowns))[place],
        across=rng.uniform(-1, 1, len(place)),
        clear=rng.uniform(0, 1, len(place)),
        sigma=rng.uniform(EDGE, 0.3, places)[place],
    )


def test_edges_ask_for_what_makes_them_likelier():
    """Their pull is the slope of the likelihood, wherever it is asked."""
    sights = sights_of(1)
    rng = np.random.default_rng(2)
    for change in 0.1 * rng.normal(size=(5, 4)):
        pull = sights.pull(change, 0.0)
        slope = []
        for step in 1e-6 * np.eye(4):
            more, less = sights.explained(change + step), sights.explained(change - step)
            slope.append((more - less) / 2e-6)
        np.testing.assert_allclose(
            pull.slope - pull.information @ change, slope, rtol=1e-5, atol=1e-7
        )


def test_places_without_an_edge_say_nothing():
    sights = sights_of(3)
    blind = replace(sights, clear=np.zeros_like(sights.clear))
    pull = blind.pull(np.zeros(4), 0.1)
    assert not pull.information.any() and not pull.slope.any() and pull.groups == 0
    assert blind.explained(np.ones(4)) == 0


def test_edges_are_heard_from_farther_away_while_they_are_sought():
    sights = Sights(
        np.arange(8), np.ones((8, 1)), np.full(8, 0.3), np.ones(8), np.full(8, EDGE)
    )
    start = np.zeros(1)
    assert sights.pull(start, 0.3).groups > 100 * sights.pull(start, 0.0).groups
    at_edge = sights.pull(np.array([0.3]), 0.0)
    assert at_edge.slope / at_edge.information == pytest.approx(0.3)
