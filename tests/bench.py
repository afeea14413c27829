"""Speed, as ratios within one run: ours against scipy, OpenCV, or itself one by one. Run with ``make bench``."""

import time
from dataclasses import replace

import cv2
import numpy as np
import pandas as pd
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation
from synthetic import camera_observations, random_board_poses, random_rig

from lrfcal_lib.calibrate.reconstruct import Painter, View
from lrfcal_lib.model.camera import CameraModel, line_distance, pinhole, project
from lrfcal_lib.session.lms2xx_codec import decode_scans, encode_scan, split_stream
from lrfcal_lib.solvers import solve_camera

REPEATS = 7


def seconds(function):
    """Median time of a call, after one to warm up."""
    function()
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def solving():
    """One line calibration: ours, scipy with a numeric Jacobian, and a thousand trials at once."""
    rng = np.random.default_rng(0)
    rig = random_rig(rng)
    obs = camera_observations(rng, rig, random_board_poses(rng, 20, rig), noise=1.0)
    start = solve_camera(obs).transform

    def residuals(x):
        T = RigidTransform.from_components(x[3:], Rotation.from_rotvec(x[:3]))
        return line_distance(pinhole(T.apply(obs.crossing_points), obs.model), obs.crossing_lines)

    x0 = np.r_[start.rotation.as_rotvec(), start.translation] + 0.02
    T0 = RigidTransform.from_components(x0[3:], Rotation.from_rotvec(x0[:3]))
    ours = seconds(lambda: solve_camera(obs, "line", T0))
    theirs = seconds(lambda: least_squares(residuals, x0, method="lm"))
    points = np.broadcast_to(obs.crossing_points, (1000,) + obs.crossing_points.shape)
    trials = replace(obs, crossing_points=points, crossing_placement=0 * obs.crossing_placement)
    batch = seconds(lambda: solve_camera(trials, "line", T0)) / 1000
    what = f"line calibration, {len(obs.crossing_points)} crossings"
    yield what, 1000 * ours, "ms", "scipy lm, numeric", theirs / ours
    yield "the same in a batch of 1000", 1000 * batch, "ms", "one by one", ours / batch


def colouring():
    """A million points through the lens; ten million coloured with occlusion, against OpenCV and a depth buffer."""
    rng = np.random.default_rng(1)
    model = CameraModel(1024, 768, 900.0, 900.0, 512.0, 384.0, np.array([-0.2, 0.1, 0.001, -0.001, 0.0]))
    points = rng.uniform([-1, -0.7, 1.5], [1, 0.7, 4], (10_000_000, 3)).astype(np.float32)
    image = rng.integers(0, 255, (768, 1024, 3), dtype=np.uint8)
    zero, ahead = np.zeros(3), np.tile(np.float32([0, 0, -1]), (len(points), 1))
    some = points[::10].astype(float)
    ours = seconds(lambda: project(some, model))
    theirs = seconds(lambda: cv2.projectPoints(some, zero, zero, model.matrix, model.distortion))
    yield "projection", 1 / ours, "Mpoint/s", "cv2.projectPoints", theirs / ours

    def paint():
        painter = Painter([View(0, "one", RigidTransform.identity(), model, image)], 2 / 900, 0.05)
        painter.hide(points)
        return painter.paint(points, ahead)

    def with_opencv():
        uv = cv2.projectPoints(some, zero, zero, model.matrix, model.distortion)[0][:, 0]
        depth, (column, row) = np.linalg.norm(some, axis=1), np.rint(uv / 4).astype(int).T
        inside = np.flatnonzero((uv > 0).all(axis=1) & (uv < [1023, 767]).all(axis=1))
        cells = row[inside] * 257 + column[inside]
        nearest = np.full(257 * 193, np.inf)
        np.minimum.at(nearest, cells, depth[inside])
        seen = inside[depth[inside] <= nearest[cells] + 0.05]
        maps = np.resize(uv[seen].astype(np.float32), (-(-len(seen) // 4096), 4096, 2))
        return cv2.remap(image, maps, None, cv2.INTER_LINEAR)

    taken, slow = seconds(paint), 10 * seconds(with_opencv)
    yield "colour_mpoints_per_s", len(points) / 1e6 / taken, "Mpoint/s", "colour_vs_cv2", slow / taken


def decoding():
    """Telegrams of an LMS2xx: found, checked and decoded."""
    data = b"".join(encode_scan(r) for r in np.random.default_rng(2).uniform(1, 8, (200, 361))) * 100

    def whole():
        stream = split_stream(data)
        return decode_scans(data, stream.offset, stream.length)

    taken = seconds(whole)
    speed = len(data) / 1e6 / taken
    yield "telegrams with their checksums", speed, "MB/s", "the line at 500 kBd", 20 * speed


if __name__ == "__main__":
    rows = [row for part in (solving, colouring, decoding) for row in part()]
    table = pd.DataFrame(rows, columns=["what", "value", "unit", "against", "times_faster"])
    print(table.round(2).to_string(index=False))
