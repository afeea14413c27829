"""Studies: the same numbers whoever works, nothing lost or counted twice, and what cannot be asked is refused."""

import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest
from falsified_sessions import copied, image_twice, judged
from scipy.stats import binom
from shared import QUICK, ROOT
from test_reconstruct_scene import Case, two_stations

from lrfcal_lib.__main__ import main
from lrfcal_lib.evaluate import study
from lrfcal_lib.evaluate.export import calibration_record, write_calibration
from lrfcal_lib.evaluate.study import (
    COUNTS,
    finished,
    resampled,
    run_study,
    study_to_file,
    summary,
    tasks_of,
    variations,
)
from lrfcal_lib.evaluate.study_trials import (
    BATCHED,
    STUDIED,
    crossing_observations,
    run_task,
)
from lrfcal_lib.model.camera import pinhole
from lrfcal_lib.model.geometry import pose_array
from lrfcal_lib.session import cluster
from lrfcal_lib.session.cluster import checked, refuse_others, workers_at
from lrfcal_lib.simulate.scenarios import FILE, load_scenario, varied
from lrfcal_lib.simulate.shots import draw_shots

FAST = ("line", "zhang_pless")


@pytest.fixture
def small(monkeypatch):
    """A study of four tasks."""
    monkeypatch.setattr(study, "CHUNK", 2)
    return tasks_of(["paper_rig"], FAST, (6, 8), 4)


# scenarios


BOARDS = [name for name in FILE if not load_scenario(name).corner]
QUIET = {"sigma_range": 1e-9, "sigma_px": 1e-9}


@pytest.mark.parametrize("name", BOARDS)
def test_a_scenario_shows_boards_that_agree_with_its_sensors(name):
    """Without noise the readings lie on the board that the camera sees, and their ends near the edges."""
    scenario = replace(load_scenario(name), bias=0.0, softness=0.0, floor=0.0, **QUIET)
    shots = draw_shots(scenario, np.random.default_rng(5), 1, 6)
    T = shots["T_camera_lrf"][0]
    bearings = scenario.bearings()
    ranges_of_boards = shots["ranges"][0, :, 0]
    for ranges, board in zip(ranges_of_boards, shots["true_boards"][0], strict=True):
        hit = np.isfinite(ranges)
        rays = np.column_stack([np.cos(bearings), np.sin(bearings), 0 * bearings])
        in_camera = (ranges[:, None] * rays)[hit] @ T[:, :3].T + T[:, 3]
        on_board = (in_camera - board[:, 3]) @ board[:, :3]
        assert np.abs(on_board[:, 2]).max() < 1e-6
        outside = (
            on_board[:, :2] @ scenario.board.lines()[:, :2].T + scenario.board.lines()[:, 2]
        )
        assert outside.max() < 1e-6


def test_the_named_edge_is_the_one_that_the_scan_line_leaves_the_board_by():
    """Not the one nearest to the last beam: beams of 2004 are 4 cm apart on the board."""
    scenario = replace(load_scenario("zhang_pless_2004"), softness=0.0, floor=0.0, **QUIET)
    shots = draw_shots(scenario, np.random.default_rng(3), 3, 30)
    bearings = scenario.bearings()
    rays = np.column_stack([np.cos(bearings), np.sin(bearings), 0 * bearings])
    lines = scenario.board.lines()
    nearest = []
    for trial, T in enumerate(shots["T_camera_lrf"]):
        for number, board in enumerate(shots["true_boards"][trial]):
            ranges = shots["ranges"][trial, number, 0]
            hit = np.flatnonzero(np.isfinite(ranges))
            in_camera = (ranges[hit, None] * rays[hit]) @ T[:, :3].T + T[:, 3]
            on_board = ((in_camera - board[:, 3]) @ board[:, :3])[:, :2]
            for end, inner, edge in zip(
                (0, -1), (1, -2), shots["edges"][trial, number], strict=True
            ):
                inside = on_board[end] @ lines[:, :2].T + lines[:, 2]
                rate = (on_board[end] - on_board[inner]) @ lines[:, :2].T
                steps = np.where(rate > 0, -inside / np.where(rate > 0, rate, 1), np.inf)
                assert steps.argmin() == edge
                nearest.append(inside.argmax() == edge)
    assert np.mean(nearest) < 0.98, "else this shows nothing"


def test_scans_of_a_placement_are_of_one_board():
    scenario = replace(load_scenario("paper_rig"), scans=3, sigma_range=0.001)
    shots = draw_shots(scenario, np.random.default_rng(0), 2, 4)
    ranges = shots["ranges"]
    assert ranges.shape[:3] == (2, 4, 3)
    spread = ranges.std(axis=2)  # NaN where one of the scans misses
    assert 0.0005 < np.nanmedian(spread) < 0.001, "drawn anew, about the same board"


def test_a_corner_without_noise_is_where_its_image_shows_it():
    scenario = replace(load_scenario("corner_calib_edge"), **QUIET)
    shots = draw_shots(scenario, np.random.default_rng(0), 2, 5)
    obs = crossing_observations(shots, scenario)
    T = shots["T_camera_lrf"][:, None]
    seen = np.matvec(T[..., :3], obs.crossing_points) + T[..., 3]
    u, v = np.moveaxis(pinhole(seen, scenario.model), -1, 0)
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    assert np.abs(np.vecdot(obs.crossing_lines, pixels)).max() < 1e-5
    assert len(np.unique(obs.crossing_placement)) == obs.crossing_points.shape[1] == 5


def test_published_rigs_are_as_published():
    corner = pose_array(load_scenario("corner_calib_2015").T_camera_lrf)
    stated = [[-0.258819045, -0.965925826, 0], [0, 0, -1], [0.965925826, -0.258819045, 0]]
    assert np.allclose(corner[:, :3], stated) and np.allclose(corner[:, 3], [0.15, 0, -0.1])
    zhang = load_scenario("zhang_pless_2004").T_camera_lrf.inv()
    assert np.allclose(zhang.translation, [0, 0.1, 1.0]), "the camera is a metre above"


def test_what_is_varied_changes_and_is_told():
    scenario = varied(load_scenario("outdoor_lms221"), "spot_mm", 30)
    assert 2000 * scenario.radius(2.0) == pytest.approx(30)
    big = varied(load_scenario("outdoor_lms221"), "board_scale", 2.0)
    assert np.allclose(big.board.corners, 2 * load_scenario("outdoor_lms221").board.corners)
    told = [s.varied for s in variations(["paper_rig"], ["step_deg=0.5,1", "bias=-0.5"])]
    assert told == [{"step_deg": 0.5, "bias": -0.5}, {"step_deg": 1.0, "bias": -0.5}]


# the study


def test_a_method_sees_the_same_draws_whatever_others_there_are_and_whoever_works(small):
    alone = run_study("paper_rig", ("line",), (6,), 4)
    both = run_study("paper_rig", FAST, (6,), 4)
    pd.testing.assert_frame_equal(alone, both[both.method == "line"].reset_index(drop=True))
    rows = [row for _, part in finished(small) for row in part]
    shuffled = pd.DataFrame(rows).sample(frac=1, random_state=1)
    pd.testing.assert_frame_equal(summary(pd.DataFrame(rows)), summary(shuffled))
    assert set(both.trials) == {4}


def test_errors_fall_with_noise_and_the_joint_estimate_keeps_to_its_bound():
    exact = replace(
        load_scenario("paper_rig"), sigma_range=1e-5, sigma_px=1e-3, name="nearly exact"
    )
    quiet = run_study(exact, ("zhang_pless",), (8,), 4)
    noisy = run_study("paper_rig", ("zhang_pless", "joint"), (8,), 8)
    assert quiet.rotation_deg[0] < 0.01 * noisy.rotation_deg.max()
    joint = noisy[noisy.method == "joint"].iloc[0]
    assert joint.failed == 0 and 0.6 < joint.rmse_over_bound < 1.6
    assert joint.rotation_deg_known <= joint.rotation_deg_bound


def test_every_method_solves_every_kind_of_target():
    boards = run_study("indoor_lms200", n_poses=(10,), trials=2)
    assert list(boards.method) == list(STUDIED) and (boards.failed == 0).all()
    assert boards.rotation_deg.max() < 10 and boards.coverage.notna().all()
    corners = run_study("corner_calib_edge", tuple(BATCHED), (20,), 2)
    assert (corners.failed == 0).all() and corners.coverage.isna().all(), "it has no bound"


def test_failures_are_counted_and_named():
    rows = pd.DataFrame(
        [
            {
                "scenario": "x",
                "n_poses": 3,
                "method": "line",
                "trial": i,
                "outcome": outcome,
            }
            for i, outcome in enumerate(
                ["refused: too few", "refused: too few", "not finite"]
            )
        ]
    )
    row = summary(rows).iloc[0]
    assert row.failed == 3 and row.failures == "1 not finite; 2 refused: too few"
    assert np.isnan(row.rotation_deg)


def test_the_interval_of_a_median_holds_it():
    values = np.random.default_rng(0).normal(size=101)
    low, high = (resampled(values, share) for share in (0.05, 0.95))
    assert low < np.median(values) < high and high - low < 0.6
    assert low == resampled(values[::-1], 0.05)
    assert np.isnan(resampled(np.array([np.nan]), 0.05))


def test_a_killed_study_goes_on(small, tmp_path, monkeypatch):
    out = tmp_path / "study.csv"
    whole = study_to_file(small, tmp_path / "whole.csv")

    begun = []

    def stop(task):
        begun.append(task)
        if len(begun) == 3:
            raise KeyboardInterrupt
        return run_task(task)

    monkeypatch.setattr(study, "run_task", stop)
    with pytest.raises(KeyboardInterrupt):
        study_to_file(small, out)
    part = tmp_path / "study.csv.part"
    assert part.read_text().count("task") == 2 and not out.exists()
    with part.open("a") as file:
        file.write('\n{"task": "0123", "ro')  # the end of a line is missing
    with pytest.raises(ValueError, match="belongs to another study"):
        study_to_file(small[2:], out)
    done = []
    monkeypatch.setattr(
        study, "run_task", lambda task: done.append(task.key) or run_task(task)
    )
    pd.testing.assert_frame_equal(study_to_file(small, out), whole)
    assert len(done) == 2 and not part.exists()
    assert out.read_bytes() == (tmp_path / "whole.csv").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((["mars"], FAST, (6,), 4), "unknown scenario 'mars': use one of paper_rig, "),
        (
            (["paper_rig"], ("bauermann",), (6,), 4),
            "unknown method 'bauermann': .* line_printed",
        ),
        ((["paper_rig"], (), (6,), 4), "no method"),
        ((["paper_rig"], FAST, (6,), 0), "0 trials"),
        ((["paper_rig"], FAST, (2,), 4), "3 or more"),
        ((["corner_calib_edge"], FAST, (6,), 4), "shows no board: use line_printed, line,"),
    ],
)
def test_what_cannot_be_asked_is_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        tasks_of(*arguments)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("wind=3", "nothing called 'wind'"),
        ("step_deg=x", "write key=number"),
        ("step_deg=-1", "positive"),
    ],
)
def test_what_cannot_be_varied_is_refused(setting, words):
    with pytest.raises(ValueError, match=words):
        variations(["paper_rig"], [setting])


def test_poses_that_cannot_be_drawn_name_the_condition():
    far = replace(load_scenario("paper_rig"), distances=(60.0, 61.0))
    with pytest.raises(ValueError, match="100 % have fewer than 8 beams"):
        run_study(far, ("line",), (3,), 1)


def test_a_file_that_is_of_no_study_is_refused(small, tmp_path):
    (tmp_path / "a.csv.part").write_text("nonsense\n")
    with pytest.raises(ValueError, match="belongs to another study"):
        study_to_file(small, tmp_path / "a.csv")


# what is stored


def stored(name):
    return pd.read_csv(ROOT / "data" / "studies" / f"{name}.csv")


def test_what_is_stored_is_of_the_scenarios_and_methods_that_there_are():
    table = stored("methods")
    assert set(table.scenario) < set(FILE) and len(set(table.scenario)) == 7
    assert set(table.method) == set(STUDIED)
    assert (table.groupby(["scenario", "method"]).n_poses.agg(tuple) == COUNTS).all()


def test_the_stored_joint_estimates_keep_to_the_bound_in_every_scenario():
    """With ten placements and more, within the scatter of so many trials."""
    table = stored("methods").query("method == 'joint' and n_poses > 5")
    for name, part in table.groupby("scenario"):
        square = part.rmse_over_bound**2
        scatter = (part.rmse_over_bound_high**2 - square).pow(2).sum() ** 0.5 / len(part)
        assert square.mean() - 1.5 * scatter < 1.05**2, name
        count = 3 * part.trials.sum()  # six numbers of a pose are worth about three
        least, most = binom.ppf([0.001, 0.999], count, [0.86, 0.94]) / count
        assert least <= part.coverage.mean() <= most, name


PUBLISHED = [  # medians of the stored trials of 2015, from 20 poses on
    ("methods", "corner_calib_2015", "zhang_pless_printed",
     {20: (0.621, 13.7), 50: (0.401, 8.1), 100: (0.278, 5.05)}),
    ("corner_calib_edge", "corner_calib_edge", "line_printed",
     {20: (1.206, 50.3), 50: (0.615, 22.7), 100: (0.398, 14.7)}),
]  # fmt: skip


@pytest.mark.parametrize(("file", "scenario", "method", "published"), PUBLISHED)
def test_stored_medians_are_within_a_quarter_of_the_published_ones(
    file, scenario, method, published
):
    rows = stored(file).query("scenario == @scenario and method == @method")
    for count, theirs in published.items():
        ours = rows.set_index("n_poses").loc[count]
        for column, value in zip(("rotation_deg", "translation_mm"), theirs, strict=True):
            assert ours[f"{column}_low"] < 1.25 * value, (count, column)
            assert ours[f"{column}_high"] > 0.75 * value, (count, column)


def test_the_stored_orientation_of_2004_is_within_a_quarter_of_a_degree():
    ours = stored("zhang_pless_2004").set_index("n_poses").rotation_deg_mean
    for count, published in {10: 1.39, 15: 1.03, 20: 0.87, 24: 0.76}.items():
        assert abs(ours[count] - published) < 0.25


def test_a_large_triangle_beats_the_best_of_2015():
    one, ten = stored("corner_calib_triangle").sort_values("scenario").itertuples()
    assert one.rotation_deg <= 0.18 and one.translation_mm <= 6
    assert ten.rotation_deg < 0.22 and ten.translation_mm < 3.7


# a cluster


def die_once(marker, task):
    """As a worker whose machine goes down in its first task."""
    if not os.path.exists(marker):
        with open(marker, "w"):
            pass
        time.sleep(0.2)
        os._exit(1)
    return run_task(task)


# what runs as a process of its own, because a cluster leaves threads behind
CLUSTER = """
import sys
from distributed import LocalCluster

if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as local:
        print(local.scheduler_address, flush=True)
        sys.stdin.read()
"""


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """Of a cluster with two worker processes."""
    script = tmp_path_factory.mktemp("cluster") / "cluster.py"
    script.write_text(CLUSTER)
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}"}
    with subprocess.Popen(
        [sys.executable, script],
        env=environment,
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as local:
        yield local.stdout.readline().strip()


def test_a_worker_that_dies_loses_nothing_and_nothing_counts_twice(
    address, small, tmp_path, monkeypatch
):
    alone = study_to_file(small, tmp_path / "alone.csv")
    monkeypatch.setattr(study, "run_task", partial(die_once, str(tmp_path / "marker")))
    with workers_at(address) as executor:
        shared = study_to_file(small, tmp_path / "shared.csv", executor)
    assert (tmp_path / "marker").exists(), "a worker died"
    pd.testing.assert_frame_equal(alone, shared)
    assert (tmp_path / "alone.csv").read_bytes() == (tmp_path / "shared.csv").read_bytes()


def test_sessions_are_calibrated_on_a_cluster_as_here(
    address, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    quick = shutil.copytree(QUICK, tmp_path / QUICK.name)
    assert main(["calibrate", str(quick), "--out", "here"]) == 0
    assert capsys.readouterr().out.count("Handed over") == 1
    assert main(["calibrate", str(quick), "nowhere", "--scheduler", address]) == 1
    out = capsys.readouterr().out
    assert "Handed over" in out and "nowhere/session.json: No such file" in out
    for name in ("cloud.ply", "scene.ply"):
        elsewhere = tmp_path / "reports" / quick.name / name
        assert elsewhere.read_bytes() == (tmp_path / "here" / name).read_bytes()
    assert main(["calibrate", "a", "b", "--out", "here"]) == 1
    assert "one session" in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["reconstruct", "merge"])
def test_scenes_are_used_on_a_cluster_as_here(verb, address, quick, tmp_path, monkeypatch):
    """The same bytes, but for the names (GUIDs) that every E57 file has of its own."""
    monkeypatch.chdir(tmp_path)
    write_calibration(tmp_path / "quick.json", calibration_record(quick, "joint"))
    case = Case(tmp_path, tmp_path / "quick.json", quick.prepared.session.scans)
    two_stations(case)
    command = [verb, "room", "--calibration", "calibration.json"]
    assert main([*command, "--out", "here"]) == 0
    assert main([*command, "--scheduler", address]) == 0
    for file in (tmp_path / "here").rglob("*.*"):
        there = tmp_path / "reports" / "room" / file.relative_to(tmp_path / "here")
        assert file.suffix == ".e57" or there.read_bytes() == file.read_bytes()
    assert sorted(p.name for p in (tmp_path / "here").rglob("scene.*")) == sorted(
        p.name for p in (tmp_path / "reports").rglob("scene.*")
    )


def test_falsified_recordings_are_judged_on_a_cluster_as_here(
    address, tmp_path, monkeypatch
):
    """`make campaign` has many of them."""
    folder = copied(QUICK, tmp_path / "quick")
    image_twice(folder)
    here = judged(folder)
    monkeypatch.setenv("LRFCAL_SCHEDULER", address)
    assert judged(folder).record() == here.record()


def test_a_worker_with_another_version_is_refused(address, monkeypatch):
    monkeypatch.setattr(cluster, "source_digest", lambda: "0123")
    with (
        pytest.raises(ValueError, match=r"worker tcp.* another version of lrfcal_lib"),
        workers_at(address),
    ):
        pass
    with pytest.raises(ValueError, match="joined later has another version"):
        checked("4567", abs, -1)


def test_a_dead_scheduler_is_a_clear_error(monkeypatch):
    monkeypatch.setattr(cluster, "PATIENCE", 0.5)
    with (
        pytest.raises(ValueError, match=r"no scheduler answers at tcp://127.0.0.1:9"),
        workers_at("tcp://127.0.0.1:9"),
    ):
        pass


def test_a_cluster_without_workers_is_refused():
    class Empty:
        scheduler = type("Scheduler", (), {"address": "tcp://x:1"})

        def run(self, work):
            return {}

    with pytest.raises(ValueError, match="tcp://x:1 has no workers"):
        refuse_others(Empty())
