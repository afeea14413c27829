"""Outlines by likelihood: exact widths of drawn boards, statistics, bad input."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from test_scan import facing

from lrfcal_lib.calibrate.outline import measure_outline
from lrfcal_lib.fit.residuals import edge_shift
from lrfcal_lib.model.board import Board
from lrfcal_lib.model.geometry import DegenerateGeometry, lrf_to_platform, polar_to_points

HEAD = RigidTransform.from_components([0.0, 0.01, 0.05], Rotation.from_rotvec([0.0, 0.02, -0.01]))
BOARD = Board("plate", ("top", "right", "bottom", "left"), np.array([[0, 0], [0.5, 0], [0.5, 0.4], [0, 0.4]]))
SENSOR = {"edge_log_odds": -0.8, "edge_log_softness": np.log(0.05), "range_offset": 0.004}


def told(sensor=SENSOR, sigma=None, spread=0.0):
    """What a joint estimate knows about how a sensor sees edges."""
    sides = {"noise": {"side_sigma": spread}, "unknowns": SimpleNamespace(sides=True)}
    return SimpleNamespace(sensor=sensor, sigma=sigma or {}, T_head_lrf=HEAD, **sides)


MODEL = told()
STEP = np.radians(0.25)


def sweep(pose, rng, sigma=0.003, bend=0.0):
    """(cells, face, names) of a board drawn from the model of the edges itself."""
    bearing, pitch = (a.ravel() for a in np.meshgrid(np.radians(np.arange(60, 120.1, 0.25)),
                                                     np.radians(np.arange(-18, 18.1, 0.25))))  # fmt: skip
    origin = lrf_to_platform(np.zeros((len(bearing), 3)), pitch, HEAD)
    rays = lrf_to_platform(polar_to_points(1.0, bearing), pitch, HEAD) - origin
    o, d, r = pose.inv().apply(origin), pose.rotation.inv().apply(rays), 0.0
    for _ in range(5):
        at = o + r * d
        r = ((bend * (at[:, 0] - 0.25) ** 2 - o[:, 2]) / d[:, 2])[:, None]
    lines, r = BOARD.lines(), r[:, 0]
    inside, across = at[:, :2] @ lines[:, :2].T + lines[:, 2], d[:, :2] @ lines[:, :2].T
    u = inside * np.abs(d[:, 2:]) / np.hypot(across, d[:, 2:])
    radius = 0.008 + 0.006 * r
    hit = u.max(axis=1) - edge_shift(-0.8, radius)[0] < 0.05 * radius * rng.standard_normal(len(r))
    some = np.flatnonzero((np.abs(u.max(axis=1)) < 0.02) & (np.sort(inside, axis=1)[:, -2] < -0.025))
    zero = np.zeros(len(some))
    columns = bearing[some], pitch[some], hit[some], u[some].argmax(axis=1), r[some], radius[some], zero, zero + STEP
    cells = np.rec.fromarrays(columns, names="bearing,pitch,hit,side,range_m,radius,background,step")
    face = np.flatnonzero(inside.max(axis=1) < -0.03)
    ranges = r[face] + 0.004 + sigma * rng.standard_normal(len(face))
    return cells, (polar_to_points(ranges, bearing[face]), pitch[face], sigma), dict(enumerate(BOARD.edges))


def poses(count, seed=0):
    places = np.random.default_rng(seed).uniform([1.2, 10, -25], [2.0, 80, 25], (count, 3))
    return [facing(*place, centre=(0.25, 0.2)) for place in places]


def errors(measured):
    true = BOARD.lengths()
    return np.array([measured.lengths[n] - true[n] for n in true]), np.array([measured.sigma[n] for n in true])


def test_lengths_agree_with_their_standard_deviations():
    rng, scaled, sizes = np.random.default_rng(1), [], []
    for pose in poses(12):
        error, sigma = errors(measure_outline(*sweep(pose, rng), BOARD.edges, MODEL))
        scaled.append(error / sigma)
        sizes.append(error)
    assert np.mean(np.abs(sizes)) < 0.0015
    assert 0.3 < np.mean(np.square(scaled)) < 2.0


def test_the_wrong_odds_make_the_board_larger_by_twice_the_shift():
    rng = np.random.default_rng(2)
    cells, face, names = sweep(poses(1)[0], rng)
    right = measure_outline(cells, face, names, BOARD.edges, MODEL)
    model = told(SENSOR | {"edge_log_odds": 0.4})
    wrong = measure_outline(cells, face, names, BOARD.edges, model)
    shift = np.subtract(*(edge_shift(v, np.median(cells.radius))[0] for v in (-0.8, 0.4)))
    for name in BOARD.edges:
        assert wrong.lengths[name] - right.lengths[name] == pytest.approx(2 * shift, rel=0.15)


def test_sides_that_were_not_seen_have_no_length():
    cells, face, names = sweep(poses(1)[0], np.random.default_rng(5))
    measured = measure_outline(cells, face, {k: v for k, v in names.items() if v != "left"}, BOARD.edges, MODEL)
    assert set(measured.lengths) == {"right"} and set(measured.corners) == {"right", "bottom"}


def test_what_nothing_was_seen_of_is_named():
    cells, face, names = sweep(poses(1)[0], np.random.default_rng(9))
    with pytest.raises(DegenerateGeometry, match="no side has 8 beams"):
        measure_outline(cells[:6], face, names, BOARD.edges, MODEL)
