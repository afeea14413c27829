"""Speed and memory, every figure beside a named alternative in the same run: ``make bench``.

Writes bench.json, bench.csv and growth.png into reports/bench. GTSAM is no part of the environment: `make bench`
installs it, and its ratio is null where it cannot be had.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
import tracemalloc
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import rooms
from distributed import LocalCluster
from joint_draws import draw, none
from rendered_boards import surveyed
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation
from synthetic import camera_observations, random_board_poses, random_rig
from telegrams import decode_scan, encode_scan

from lrfcal_lib.calibrate.painting import Painter, View
from lrfcal_lib.evaluate.study import finished, tasks_of
from lrfcal_lib.evaluate.study_trials import STUDIED
from lrfcal_lib.measure.stations import join_stations
from lrfcal_lib.model.camera import CameraModel, line_distance, pinhole
from lrfcal_lib.model.observations import thin
from lrfcal_lib.preprocess.pattern_in_image import PatternFinder
from lrfcal_lib.session.cluster import workers_at
from lrfcal_lib.session.lms2xx_codec import (
    decode_scans,
)
from lrfcal_lib.session.lms2xx_frame import (
    split_stream,
)
from lrfcal_lib.session.read import open_session
from lrfcal_lib.solvers import solve_camera
from lrfcal_lib.solvers.joint import solve_joint
from lrfcal_lib.solvers.joint_model import Unknowns, gather
from lrfcal_lib.solvers.joint_residuals import minimum, named_blocks
from lrfcal_lib.solvers.joint_start import start_states

ROOT = Path(__file__).resolve().parent.parent
FULL = {
    "repeats": 7, "trials": 1000, "placements": (10, 30, 100, 300, 1000), "joint": 100, "points": 10_000_000,
    "growth": (10_000, 100_000, 1_000_000, 10_000_000, 100_000_000), "telegrams": 20_000, "session": "sim_lms221",
    "pixels": 12_000_000, "study": 160, "calls": 2000, "step_deg": 0.25,
}  # fmt: skip
TINY = {  # for the test, which only asks whether everything is written
    "repeats": 1, "trials": 2, "placements": (10,), "joint": 10, "points": 10_000, "growth": (1_000,),
    "telegrams": 100, "session": None, "pixels": 2_000_000, "study": 10, "calls": 20, "step_deg": 0.5,
}  # fmt: skip
SURVEYED = 4  # images in a survey
CHUNK = 1_000_000  # points that growth hands over at a time
SHORT = 0.02  # seconds
ROWS = {"face": 40, "beam": 30}
MODEL = CameraModel(
    1024, 768, 900.0, 900.0, 512.0, 384.0, np.array([-0.2, 0.1, 0.001, -0.001, 0.0])
)


def seconds(repeats, *functions):
    """Median times of calls that take turns (so that both meet the same load), short ones ten times a turn."""
    calls = []
    times = np.zeros((repeats, len(functions)))
    for function in functions:  # to warm up, and to see which are short
        taken = [elapsed(function) for _ in range(2)]
        calls.append(10 if min(taken) < SHORT else 1)
    for row in times:
        row[:] = [
            elapsed(function, n) for function, n in zip(functions, calls, strict=True)
        ]
    return np.median(times, axis=0).tolist()


def elapsed(function, calls=1):
    """Mean time of some calls, seconds."""
    begin = time.perf_counter()
    for _ in range(calls):
        function()
    return (time.perf_counter() - begin) / calls


def memory(function):
    """Largest size of what Python and NumPy hold during a call, MB."""
    tracemalloc.start()
    function()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def cameras(size):
    """One line calibration of twenty placements, and many at once, against scipy with a numeric Jacobian."""
    rng = np.random.default_rng(0)
    rig = random_rig(rng)
    obs = camera_observations(rng, rig, random_board_poses(rng, 20, rig), noise=1.0)
    start = solve_camera(obs, "line").transform
    x0 = np.r_[start.rotation.as_rotvec(), start.translation] + 0.02
    T0 = RigidTransform.from_components(x0[3:], Rotation.from_rotvec(x0[:3]))
    points = obs.crossing_points + rng.normal(
        0, 0.002, (size["trials"], *obs.crossing_points.shape)
    )
    trials = replace(obs, crossing_points=points)
    some = points[: max(1, len(points) // 20)]

    def scipy(points):
        def residuals(x):
            T = RigidTransform.from_components(x[3:], Rotation.from_rotvec(x[:3]))
            return line_distance(pinhole(T.apply(points), obs.model), obs.crossing_lines)

        return least_squares(residuals, x0, method="lm").x

    calls = [
        lambda: solve_camera(obs, "line", T0, search=False),
        lambda: scipy(obs.crossing_points),
    ]
    ours, theirs = seconds(3 * size["repeats"], *calls)
    yield (
        "camera_solve_ms",
        1000 * ours,
        "camera_solve_vs_scipy",
        "scipy lm, numeric Jacobian",
        theirs / ours,
        calls[0],
    )
    calls = [lambda: solve_camera(trials, "line", T0), lambda: [scipy(p) for p in some]]
    ours, theirs = seconds(size["repeats"], *calls)
    faster = theirs * len(points) / len(some) / ours
    yield (
        "monte_carlo_1000_s",
        ours,
        "monte_carlo_vs_scipy",
        "scipy in a loop",
        faster,
        calls[0],
    )


def problem(count):
    """A drawn session with so many rows of each group a placement, evenly picked."""
    obs = draw(np.random.default_rng(0), count)[0]
    masks = {}
    for name, most in ROWS.items():
        places = getattr(obs, f"{name}_placement")
        rows = np.concatenate(
            [thin(np.flatnonzero(places == p), most) for p in range(count)]
        )
        masks[name] = np.isin(np.arange(len(places)), rows)
    return obs.keep(**masks)


def data_of_placement(data, p):
    """The part of the joint estimate's data that one placement has."""
    groups = {
        name: {key: values[[p]] for key, values in getattr(data, name).items()}
        for name in ("face", "beam", "view")
    }
    return replace(data, **groups, middle=data.middle[[p]], direction=data.direction[[p]])


def with_gtsam(count):
    """What runs GTSAM's iterations from the start value, with a Python factor a placement.

    Ranges and views only; residuals and Jacobian of increments about the start are ours, whitened.
    """
    import gtsam

    obs = none(problem(count), "beam")
    data = gather(obs)
    unknowns = Unknowns(2, 3, sensor=("range_offset",))
    start = next(start_states(obs, axis=True))[0]
    c = unknowns.shared
    pieces = [(start.of_placements([p]), data_of_placement(data, p)) for p in range(count)]

    def error(p, values, jacobians):
        at, piece = pieces[p]
        moved = unknowns.move(at, (values.atVector(0), values.atVector(p + 1)[None]))
        parts = [
            (b.white, b.white_jacobian)
            for b in named_blocks(moved, piece, unknowns).values()
        ]
        r, J = (np.concatenate(rows, axis=1)[0] for rows in zip(*parts, strict=True))
        if jacobians is not None:
            jacobians[0], jacobians[1] = (
                np.asfortranarray(J[:, :c]),
                np.asfortranarray(J[:, c:]),
            )
        return r

    graph = gtsam.NonlinearFactorGraph()
    first = gtsam.Values()
    first.insert(0, np.zeros(c))
    for p in range(count):
        first.insert(p + 1, np.zeros(unknowns.own))
        noise = gtsam.noiseModel.Unit.Create(len(error(p, first, None)))
        graph.add(
            gtsam.CustomFactor(
                noise, [0, p + 1], lambda _, values, H, p=p: error(p, values, H)
            )
        )

    def run():
        found = gtsam.LevenbergMarquardtOptimizer(
            graph, first, gtsam.LevenbergMarquardtParams()
        ).optimize()
        own = np.stack([found.atVector(p + 1) for p in range(count)])
        return unknowns.move(start, (found.atVector(0), own))

    apart = np.abs(run().cameras - minimum(start, data, unknowns, 1e-4).state.cameras).max()
    assert apart < 1e-4, f"GTSAM and we end in different places, {apart}"
    return run


def joint(size):
    """The whole joint estimate, start values included, against GTSAM's iterations alone (on less: no beams)."""
    obs = problem(size["joint"])
    calls = [lambda: solve_joint(obs)]
    try:
        calls.append(with_gtsam(size["joint"]))
    except ImportError:
        print("no GTSAM here: its ratio stays empty", file=sys.stderr)
    ours, *others = seconds(size["repeats"], *calls)
    faster = others[0] / ours if others else np.nan
    yield (
        "joint_100_s",
        ours,
        "joint_vs_gtsam",
        "GTSAM's iterations, a factor a placement",
        faster,
        calls[0],
    )


def scene(rng, count):
    """Points (n, 3) before a camera, and an image."""
    points = rng.random((count, 3), np.float32)
    points *= np.float32([2, 1.4, 2.5])
    points += np.float32([-1, -0.7, 1.5])
    return points


def painter(image):
    return Painter([View(0, "one", RigidTransform.identity(), MODEL, image)], 2 / 900, 0.05)


def colouring(size):
    """Points coloured from one image with occlusion, against OpenCV and a depth buffer."""
    rng = np.random.default_rng(1)
    count = size["points"]
    image = rng.integers(0, 255, (768, 1024, 3), dtype=np.uint8)
    points = scene(rng, count)
    zero = np.zeros(3)
    ahead = np.tile(np.float32([0, 0, -1]), (count, 1))
    some = points[::10].astype(float)

    def paint():
        one = painter(image)
        one.hide(points)
        return one.paint(points, ahead)

    def with_opencv():
        uv = cv2.projectPoints(some, zero, zero, MODEL.matrix, MODEL.distortion)[0][:, 0]
        depth, (column, row) = np.linalg.norm(some, axis=1), np.rint(uv / 4).astype(int).T
        inside = np.flatnonzero((uv > 0).all(axis=1) & (uv < [1023, 767]).all(axis=1))
        cells = row[inside] * 257 + column[inside]
        nearest = np.full(257 * 193, np.inf)
        np.minimum.at(nearest, cells, depth[inside])
        seen = inside[depth[inside] <= nearest[cells] + 0.05]
        maps = np.resize(uv[seen].astype(np.float32), (-(-len(seen) // 4096), 4096, 2))
        return cv2.remap(image, maps, None, cv2.INTER_LINEAR)

    ours, tenth = seconds(size["repeats"], paint, with_opencv)
    against = "cv2.projectPoints, depth buffer, cv2.remap"
    yield (
        "colour_mpoints_per_s",
        count / 1e6 / ours,
        "colour_vs_cv2",
        against,
        10 * tenth / ours,
        paint,
    )


def decoding(size):
    """Telegrams of an LMS2xx found, checked and decoded, against one by one in plain Python."""
    raw = [
        encode_scan(r)
        for r in np.random.default_rng(2).uniform(1, 8, (size["telegrams"] // 100, 361))
    ]
    data = b"".join(raw) * 100

    def whole():
        stream = split_stream(data)
        return decode_scans(data, stream.offset, stream.length, 0)

    ours, theirs = seconds(
        size["repeats"], whole, lambda: [decode_scan(one) for one in raw]
    )
    yield (
        "decode_mb_per_s",
        len(data) / 1e6 / ours,
        "decode_vs_plain",
        "one by one",
        100 * theirs / ours,
        whole,
    )


def images(size):
    """Large images decoded and the board found in them, as JPEG the corners alone: nothing else does the same."""
    session = open_session(ROOT / "data" / "sim_quick")
    record = session.images("left", purpose="board")[0]
    model = surveyed(session).models["left"]
    board = session.board
    small = session.read_image(record)
    times = np.sqrt(size["pixels"] / (small.shape[0] * small.shape[1]))
    large = cv2.resize(small, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC)
    jpeg = cv2.imencode(".jpg", large)[1]
    png = cv2.imencode(".png", large)[1]
    finder = PatternFinder(board.pattern)
    middle = (np.array([model.cx, model.cy]) + 0.5) * times - 0.5
    lens = (model.fx * times, model.fy * times, *middle, model.distortion)
    model = CameraModel(large.shape[1], large.shape[0], *lens)

    def find():
        return finder(cv2.imdecode(jpeg, cv2.IMREAD_COLOR))

    def see():
        """The whole survey of one camera's images, of which all are the same."""
        records = [
            replace(record, placement=i, file=Path(f"{i}.png")) for i in range(SURVEYED)
        ]
        return surveyed(
            SimpleNamespace(
                image_records=records,
                read_image=lambda r: cv2.imdecode(png, cv2.IMREAD_COLOR),
                board=board,
                cameras={"left": replace(session.cameras["left"], model=model)},
                picks=(),
            )
        )

    repeats = min(size["repeats"], 3)
    yield "image_12mp_s", seconds(repeats, find)[0], None, "", np.nan, find
    yield "survey_12mp_png_s", seconds(repeats, see)[0] / SURVEYED, None, "", np.nan, see


COMMANDS = {
    "calibrate_s": ["calibrate", "session", "--out", "calibrated"],
    "reconstruct_s": ["reconstruct", "station", "--calibration", "calibrated"],
    "merge_s": ["merge", "room", "--calibration", "calibrated"],
    "report_s": ["report", "session", "--out", "out"],
}


def commands(size):
    """Whole commands on shipped sessions, once each: nothing else does the same.

    The station has some 90 000 points and 6 images, the room four stations of 10 images.
    """
    with TemporaryDirectory() as folder:
        if size["session"]:
            shutil.copytree(ROOT / "data" / size["session"], Path(folder, "session"))
            for name in ("room", "station"):
                shutil.copytree(ROOT / "data" / "room_lms221", Path(folder, name))
            images = pd.read_csv(Path(folder, "station", "images.csv"))
            pitches = images.pitch_deg.unique()[::2]
            kept = images[(images.placement == 1) & images.pitch_deg.isin(pitches)]
            kept.to_csv(Path(folder, "station", "images.csv"), index=False)
        for key, words in COMMANDS.items():
            taken = np.nan
            if size["session"]:
                command = [sys.executable, "-m", "lrfcal_lib", *words]
                environment = os.environ | {
                    "LRFCAL_CACHE": f"{folder}/{key}",  # none finds what another one left
                    "PYTHONPATH": str(ROOT),
                }
                where = {"cwd": folder, "env": environment, "stdout": subprocess.DEVNULL}
                taken = elapsed(partial(subprocess.run, command, check=True, **where))
            yield key, taken, None, "", np.nan, None


def paint_blocks(count):
    """Colour so many points block by block: seconds and the largest memory of this process, MB."""
    image = np.random.default_rng(1).integers(0, 255, (768, 1024, 3), dtype=np.uint8)
    one = painter(image)
    ahead = np.tile(np.float32([0, 0, -1]), (min(count, CHUNK), 1))
    taken = 0.0
    one.paint(scene(np.random.default_rng(0), 10), ahead[:10])  # loads the compiled loops
    for work in (one.hide, lambda points: one.paint(points, ahead)):
        rng = np.random.default_rng(2)  # the same points again
        for start in range(0, count, CHUNK):
            points = scene(rng, min(CHUNK, count - start))
            begin = time.perf_counter()
            work(points)
            taken += time.perf_counter() - begin
    status = Path(
        "/proc/self/status"
    ).read_text()  # getrusage would count the parent's memory
    return taken, int(status.split("VmHWM:")[1].split()[0]) / 1024


def growth(size):
    """Time and memory by number of points (a process each) and of placements."""
    for count in size["growth"]:
        command = [sys.executable, __file__, "--paint", str(count)]
        taken, peak = json.loads(
            subprocess.run(command, check=True, capture_output=True, text=True).stdout
        )
        yield "colouring", "points", count, taken, peak
    for count in size["placements"]:
        obs = problem(count)
        taken = seconds(min(size["repeats"], 3), lambda obs=obs: solve_joint(obs))[0]
        yield (
            "joint estimate",
            "placements",
            count,
            taken,
            memory(lambda obs=obs: solve_joint(obs)),
        )


def plot(table, path):
    """Time and memory over size, both logarithmic."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for ax, (what, rows) in zip(axes, table.groupby("what"), strict=True):
        ax.loglog(rows["count"], rows["seconds"], "o-", label="seconds")
        ax.loglog(rows["count"], rows["peak_mb"], "s--", label="memory, MB")
        ax.set(title=what, xlabel=rows["of"].iloc[0])
        ax.grid(alpha=0.3)
        ax.legend()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def studies(size):
    """A study on a Dask cluster of this machine: two workers beside one, and the overhead of a task.

    On paper a thousand workers are busy as long as the scheduler hands out tasks faster than they finish: the
    speed-up ends at the time of a task over the overhead. A task is some hundred bytes, its rows some ten kilobytes.
    """
    tasks = tasks_of(["paper_rig"], STUDIED, (20,), size["study"])
    taken = {}
    for count in (1, 2):
        with (
            LocalCluster(
                n_workers=count, threads_per_worker=1, dashboard_address=None
            ) as local,
            workers_at(local.scheduler_address) as executor,
        ):
            list(finished(tasks[: 2 * count], executor))  # imports and compiles
            taken[count] = elapsed(lambda: list(finished(tasks, executor)))  # noqa: B023
            calls = elapsed(lambda: list(executor.map(abs, range(size["calls"]))))  # noqa: B023
    task = taken[1] / len(tasks)
    overhead = calls / size["calls"]
    yield (
        "study_2_workers_s",
        taken[2],
        "study_scaling",
        "one worker",
        taken[1] / taken[2],
        None,
    )
    yield "study_task_ms", 1000 * task, None, "", np.nan, None
    yield "study_overhead_ms", 1000 * overhead, None, "", np.nan, None
    yield "study_most_workers_on_paper", task / overhead, None, "", np.nan, None


def joining(size):
    """Four stations of a simulated room in one frame, without a guess."""
    rng = np.random.default_rng(71)
    world, half = rooms.furnished_at_random(rng)
    clouds = {
        number: rooms.scanned(world, T, rng, number=number, step=size["step_deg"])
        for number, T in rooms.around(rng, half).items()
    }
    yield (
        "join_4_stations_s",
        elapsed(lambda: join_stations(clouds)),
        None,
        "",
        np.nan,
        None,
    )


def main(out, size=None):
    """Measure everything at a size and write bench.json, bench.csv and growth.png."""
    size = size or FULL
    rows = []
    figures = {}
    parts = (cameras, joint, colouring, decoding, images, studies, joining, commands)
    for part in parts:
        for key, value, ratio_key, against, times_faster, call in part(size):
            rows.append(
                [key, value, against, times_faster, memory(call) if call else np.nan]
            )
            figures |= {key: value, ratio_key: times_faster} if ratio_key else {key: value}
            print(
                f"{key} {value:.4g}"
                + (f", {times_faster:.3g} times {against}" if against else ""),
                flush=True,
            )
    grown = pd.DataFrame(
        growth(size), columns=["what", "of", "count", "seconds", "peak_mb"]
    )
    figures["peak_mb_1e8_points"] = grown[grown["of"] == "points"]["peak_mb"].iloc[-1]
    print(grown.round(3).to_string(index=False))
    out.mkdir(parents=True, exist_ok=True)
    table = pd.DataFrame(
        rows, columns=["figure", "value", "against", "times_faster", "memory_mb"]
    )
    table.to_csv(out / "bench.csv", index=False, float_format="%.5g")
    plot(grown, out / "growth.png")
    figures = {
        key: None if np.isnan(value) else float(f"{value:.5g}")
        for key, value in figures.items()
    }
    figures["growth"] = json.loads(grown.to_json(orient="records"))
    figures["sizes"], figures["machine"] = (
        size,
        {"cpus": os.cpu_count(), "load": os.getloadavg()[0]},
    )
    (out / "bench.json").write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "reports" / "bench")
    parser.add_argument(
        "--without-commands",
        action="store_true",
        help="without the minutes of calibrate and report",
    )
    parser.add_argument("--paint", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.paint:
        print(json.dumps(paint_blocks(options.paint)))
    else:
        main(options.out, FULL | ({"session": None} if options.without_commands else {}))
