"""Boards that bend: synthetic scans of sheets whose shape is known, then recordings."""

from dataclasses import replace
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import binom
from shared import DATA

from lrfcal_lib.calibrate.observe import board_maps, rough_poses
from lrfcal_lib.evaluate.diagnosis import bend_words, bends_table
from lrfcal_lib.model.board import Board, Chessboard
from lrfcal_lib.model.camera import CameraModel, project
from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points
from lrfcal_lib.plots.results import board_bend
from lrfcal_lib.preprocess import bend as module
from lrfcal_lib.preprocess.bend import Bend, BoardBends, Face, around_pattern, bend_of, common_level, face_of
from lrfcal_lib.preprocess.board_in_scan import find_board
from lrfcal_lib.preprocess.prepared import prepare_scans
from lrfcal_lib.session.read import Sweep, open_session

SIZE = 0.8
BOARD = Board("square", ("a", "b", "c", "d"), SIZE * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]),
              Chessboard(5, 5, 0.08, (0.24, 0.24)))  # fmt: skip
MODEL = CameraModel(1280, 960, 1000.0, 1000.0, 640.0, 480.0)


def a_face(rng, n=4000, bend=(0.0, 0.0, 0.0), noise=0.004, level=0.0, waves=0.0):
    """Points on a board with a quadratic shape (1/m), tilted a little; waves are shared by neighbours."""
    flat = rng.uniform(0, SIZE, (n, 2))
    x, y = (flat - SIZE / 2).T
    around = around_pattern(flat, BOARD)
    height = 0.02 + 0.1 * x - 0.05 * y + np.stack([x * x, x * y, y * y], axis=1) @ bend
    height += noise * rng.standard_normal(n) + level * (np.abs(flat - SIZE / 2).max(axis=1) > 0.27)
    across, along = (np.sin(2 * np.pi * v / 0.16 + rng.uniform(0, 6)) for v in (x, y))
    height += waves * across * along
    return Face(flat, height, np.full(n, 0.98), around)


def a_scan(rng, bend=0.0, noise=0.003, stretch=0.0):
    """A board 1.4 m ahead, bent about a level axis by bend y^2 (1/m); the pitch is recorded too small by `stretch`."""
    bearings, pitch = np.radians(np.arange(60.0, 120.0, 0.5)), np.radians(np.arange(-25.0, 25.0, 0.5))
    rays = lrf_to_platform(
        polar_to_points(np.ones(len(pitch) * len(bearings)), np.tile(bearings, len(pitch))),
        np.repeat(pitch, len(bearings)), RigidTransform.identity(),
    ).reshape(len(pitch), len(bearings), 3)  # fmt: skip
    r = 1.4 / rays[..., 1]
    for _ in range(4):
        r = (1.4 + bend * (r * rays[..., 2]) ** 2) / rays[..., 1]
    inside = (np.abs(r * rays[..., 0]) < SIZE / 2) & (np.abs(r * rays[..., 2]) < SIZE / 2)
    ranges = np.where(inside, r, 4.0) + noise * rng.standard_normal(r.shape)
    sweep = Sweep(3, ranges, bearings, pitch / (1 + stretch), np.full(len(pitch), np.nan))
    return find_board(sweep, BOARD, RigidTransform.identity())


@pytest.mark.parametrize(("bend", "size"), [((0, 0, 0.06), 0.06 * 0.4**2), ((0, 0.05, 0), 2 * 0.05 * 0.4**2)])
def test_a_bend_is_measured(bend, size):
    found = bend_of(a_face(np.random.default_rng(1), bend=bend), 7)
    assert found.bends and found.placement == 7 and found.p_value < 1e-6
    assert found.size == pytest.approx(size, abs=3 * found.sigma + 4e-4)


@pytest.mark.parametrize("waves", [0.0, 0.003])
def test_flat_boards_do_not_bend_and_the_p_value_is_honest(waves):
    found = [bend_of(a_face(np.random.default_rng(seed), 1500, waves=waves)) for seed in range(100)]
    assert not any(b.bends for b in found)
    assert np.mean([b.p_value < 0.1 for b in found]) < 0.2
    assert np.mean([b.p_value < 0.5 for b in found]) > 0.25


def test_sigma_is_the_scatter_of_a_clear_bend():
    found = [bend_of(a_face(np.random.default_rng(seed), 1500, bend=(0.0, 0.0, 0.06))) for seed in range(100)]
    spread = np.std([b.size for b in found])
    assert np.median([b.sigma for b in found]) == pytest.approx(spread, rel=0.3)


def test_what_does_not_count_as_a_bend():
    found = bend_of(a_face(np.random.default_rng(3), bend=(0.0, 0.0, 0.02)))
    assert found.p_value < 1e-3 and not found.bends, "too small"
    face = a_face(np.random.default_rng(4))
    face.height[np.random.default_rng(5).choice(len(face.height), 120, replace=False)] += 0.15
    assert not bend_of(face).bends, "outliers"
    found = bend_of(replace(face, flat=face.flat * [1, 0]), 4)
    assert np.isnan(found.size) and not found.bends
    assert "placement 4: the scan shows 6 of 36 parts of the board, 18 are needed" in found.reason


def a_triangle(rng, lines=22, beams=25, noise=0.01):
    """A coarse sweep of a flat triangle: few points, 25 parts of very different weight."""
    height = np.linspace(0.01, 0.37, lines)
    share = 1 - height / 0.38
    flat = np.concatenate([np.linspace([0.0, y], [0.315 * s, y], int(2 + beams * s))
                           for y, s in zip(height, share, strict=True)])  # fmt: skip
    noise = noise * rng.standard_normal(len(flat))
    return Face(flat, noise, np.full(len(flat), 0.98), np.zeros(len(flat)))


def test_coarse_sweeps_of_flat_boards_seldom_look_bent():
    """Five percent of them at a level of 5 %, or fewer: the scatter of few parts must not be trusted too far."""
    rng = np.random.default_rng(11)
    p_values = np.array([bend_of(a_triangle(rng)).p_value for _ in range(200)])
    assert np.sum(p_values < 0.05) <= binom.ppf(0.999, len(p_values), 0.05)
    assert np.sum(p_values < 0.001) <= 2


def test_a_second_material_is_told_from_a_bend():
    rng = np.random.default_rng(6)
    faces = [a_face(rng, level=0.006) for _ in range(8)]
    level, sigma = common_level(faces)
    assert level == pytest.approx(0.006 / 0.98, abs=4e-4) and sigma < 4e-4
    assert bend_of(faces[0]).size > 0.004, "taken for a bend where the materials are not known"
    assert bend_of(faces[0], level=level).size < 0.002


def test_one_material_has_no_level():
    level, sigma = common_level([a_face(np.random.default_rng(seed)) for seed in range(12)])
    assert abs(level) < 3 * sigma + 3e-4
    assert np.isnan(common_level([])[0])
    bare = replace(a_face(np.random.default_rng(0)), around=np.zeros(4000))
    assert np.isnan(common_level([bare] * 6)[0])


@pytest.mark.parametrize("bend", [0.0, 0.08, -0.08])
def test_scans_of_a_bent_board(bend):
    face = face_of(a_scan(np.random.default_rng(7), bend))
    found, half = bend_of(face), np.ptp(face.flat, axis=0).min() / 2
    assert 0.35 < half < 0.41
    assert found.size == pytest.approx(abs(bend) * half**2, abs=1.5e-3)
    assert found.bends == (bend != 0)


def views_of(bend, rng, noise=0.05):
    """A view of the pattern on a bent board."""
    points, at = BOARD.pattern.points(), np.array([0.1, -0.05, 1.5])
    x, y = (points[:, :2] - points[:, :2].mean(axis=0)).T
    points[:, 2] += np.stack([x * x, x * y, y * y], axis=1) @ bend
    pixels = project(RigidTransform.from_components(at, Rotation.from_rotvec([0.5, -0.4, 0.1])).apply(points), MODEL)
    start = RigidTransform.from_components(at + 0.003, Rotation.from_rotvec([0.505, -0.4, 0.1]))
    return SimpleNamespace(pixels=pixels + noise * rng.standard_normal(pixels.shape), T_camera_board=start)


def seen_by(cameras):
    views = {camera: {1: view} for camera, view in cameras.items()}
    return SimpleNamespace(board=BOARD, views=views, models=dict.fromkeys(cameras, MODEL), relief=None)


def test_images_show_the_bend_of_the_sheet():
    rng, bend = np.random.default_rng(9), np.array([0.1, -0.2, 0.15])
    exact, _ = module.sheet_surface(seen_by({"left": views_of(bend, rng, 1e-9)}), 1)
    np.testing.assert_allclose(exact, bend, atol=1e-6)
    found = [module.sheet_surface(seen_by({c: views_of(bend, rng) for c in ("left", "right")}), 1) for _ in range(60)]
    misses = np.array([np.linalg.solve(np.linalg.cholesky(C), q - bend) for q, C in found])
    assert 0.6 < np.mean(misses**2) < 1.3, "the covariance is that of the noise, or more where two cameras differ"


def test_sheets_are_measured_away_from_the_camera_whichever_way_their_frame_points():
    rng, bend = np.random.default_rng(10), np.array([0.1, 0.0, 0.15])
    view = views_of(bend, rng, 1e-9)
    back = RigidTransform.from_rotation(Rotation.from_rotvec([np.pi, 0, 0]))
    height = BOARD.pattern.points()[:, 1].max() + BOARD.pattern.points()[:, 1].min()
    flip = RigidTransform.from_translation([0, height, 0]) * back
    other = SimpleNamespace(pixels=view.pixels.reshape(5, 5, 2)[::-1].reshape(-1, 2),
                            T_camera_board=view.T_camera_board * flip)  # fmt: skip
    found, _ = module.sheet_surface(seen_by({"left": other}), 1)
    np.testing.assert_allclose(found, bend * [1, -1, 1], atol=1e-6)


def test_no_pattern_in_an_image_is_no_sheet():
    assert module.sheet_surface(seen_by({"left": SimpleNamespace(pixels=None, T_camera_board=None)}), 1) is None
    few = views_of(np.zeros(3), np.random.default_rng(0))
    few.pixels[5:] = np.nan
    assert module.sheet_surface(seen_by({"left": few}), 1) is None


def test_bends_in_words_and_in_a_table():
    bends = {15: Bend(15, 0.012, 0.001, 1e-5, True, sheet=0.001, sheet_sigma=0.001),
             16: Bend(16, 0.008, 0.001, 1e-5, True, sheet=0.006, sheet_sigma=0.001),
             17: Bend(17, 0.002, 0.001, 0.3, False)}  # fmt: skip
    words = bend_words(BoardBends(bends, 0.0043, 0.0002, True))
    assert words[0] == "the board around the pattern reads 4.3 +- 0.2 mm farther than the pattern"
    assert words[1].startswith("placements 15 and 16 bend by 8 to 12 mm in the scan")
    assert "by 1 to 6 mm (at 15 by less than half" in words[1]
    assert bend_words(BoardBends({17: bends[17]})) == []
    assert bend_words(BoardBends({16: replace(bends[16], sheet=np.nan)})) == ["placement 16 bends by 8 mm in the scan"]
    table = bends_table(BoardBends(bends))
    assert list(table.bend_mm) == [12.0, 8.0, 2.0] and list(table.bends) == [True, True, False]


def test_the_figure_shows_what_bends():
    fig, ax = plt.subplots()
    bends = {15: Bend(15, 0.012, 0.001, 1e-5, True), 17: Bend(17, 0.002, 0.001, 0.3, False)}
    board_bend(ax, BoardBends(bends))
    assert ax.get_title() == "1 of 2 boards bend in the scan, by up to 12 mm"
    assert sorted(bar.get_height() for bar in ax.patches) == pytest.approx([2.0, 12.0])
    plt.close(fig)
    with pytest.raises(ValueError, match="none of 1 placements shows enough"):
        board_bend(None, BoardBends({3: Bend(3, np.nan, np.nan, np.nan, False, "too little")}))


def test_flat_simulated_boards_do_not_bend():
    session = open_session(DATA / "sim_lms221")
    found = module.board_bends(prepare_scans(session))
    assert len(found.placements) == len(session.board_placements)
    assert not any(b.bends for b in found.placements.values()) and bend_words(found) == []


def test_real_boards_that_bend_are_found(lms400):
    """The list was known when the threshold of 6 mm was chosen; 5 and 7 are flat by any measure."""
    found = module.board_bends(lms400.prepared, board_maps(lms400.prepared, rough_poses(lms400.prepared)[0]))
    bent = {p for p, b in found.placements.items() if b.bends}
    assert {15, 16, 18, 20} <= bent and not bent & {1, 2, 3, 4, 5, 6, 7, 9, 13, 17}
    assert found.level_applied and 0.004 < found.level < 0.008
    assert max(found.placements.values(), key=lambda b: b.size).placement == 20
    assert found.placements[18].sheet < 0.5 * found.placements[18].size, "the images do not confirm all of it"
