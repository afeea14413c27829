"""Whole sessions of rigs that nothing was tuned on, as files with their truth, and how a calibration does on them.

Everything is drawn from a seed: mount and place of the cameras, lens, spot and noise of the range
finder, board (outline, size of its squares, dark or white), what stands behind it, how the head
lies about its pitch. The rendering shares nothing with the library but lens, spot pattern and echo.
::

    # some seconds
    session = varied_sessions.record(folder / "a", seed=7)
    session = varied_sessions.record(folder / "b", seed=7, mount="platform", white=True)
    # chi-square, scores, lengths, verdict
    outcome = varied_sessions.judged(session)
"""

import json
from dataclasses import dataclass, field, replace

import cv2
import numba
import numpy as np
from joint_draws import draw
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import norm

from lrfcal_lib.calibrate import combined, pipeline
from lrfcal_lib.evaluate.monte_carlo import joint_truth, state_errors
from lrfcal_lib.evaluate.truth import read_truth
from lrfcal_lib.judge.verdict import judge
from lrfcal_lib.model.board import Board, Chessboard, triangle_board
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points, pose_array
from lrfcal_lib.session.read import open_session
from lrfcal_lib.session.stated import (
    CameraInfo,
    LrfInfo,
    board_to_json,
    model_to_json,
    transform_to_json,
)
from lrfcal_lib.session.write import SessionWriter
from lrfcal_lib.simulate.beam import LMS221, Readings, echo, measured, spot_pattern
from lrfcal_lib.simulate.draw import AHEAD
from lrfcal_lib.simulate.rig import Platform, Rig, RigCamera, held_close, pairs
from lrfcal_lib.simulate.scene import Imager

RING = 1.0  # squares, width of the outermost ones of a pattern
SAMPLES = 3  # rays across a pixel and down a pixel, where the board is
COARSE = 4  # pixels between the rays to what is behind the board
BLUR = 0.7
NOISE = 1.5  # of lens and sensor: pixels, grey levels
INK = 0.07
PAPER = 0.75  # reflectivity
SPOTS = {
    "LMS221": (0.016, 0.0119),
    "LMS200": (0.012, 0.0044),
    "narrow": (0.008, 0.002),
}  # m at the window, rad
NOT_SHOWN = (
    "edge_log_odds",
    "edge_log_softness",
)  # of these a session of files has no truth


@dataclass(frozen=True)
class Variation:
    """What is drawn of a session; every field can be given."""

    seed: int
    mount: str = "head"
    white: bool = False  # dark squares on a white board, or light ones on a dark one
    triangle: bool = True
    square_px: float = 9.0  # at the middle distance
    spot: str = "LMS221"
    gaussian: bool = False  # energy over the spot, or even
    least_share: float = 0.25
    pulse: float = 1.0  # m
    placements: int = 14  # even
    # standard deviation of where the head stops about what it says, rad
    stop_noise: float = 0.0
    stretch: float = 0.0
    backlash: float = 0.0  # rad
    systematic: float = 0.0  # m
    sigma_range: float = 0.01  # m
    resolution: int = 50  # of the beams, 1/100 deg
    step: float = np.radians(0.5)  # between scan lines
    exact_lens: bool = False  # intrinsics are stated
    stand: bool = True
    sheets: int = 4  # things behind the board
    distances: tuple = field(default=(1.2, 2.6))


def vary(seed, **given):
    """A Variation; what is not given is drawn."""
    rng = np.random.default_rng([seed, 24])
    drawn = Variation(
        seed=seed,
        mount=str(rng.choice(["head", "platform"])),
        white=bool(rng.integers(2)),
        triangle=bool(rng.integers(2)),
        square_px=float(rng.uniform(7.0, 12.0)),
        spot=str(rng.choice(list(SPOTS))),
        gaussian=bool(rng.integers(2)),
        least_share=float(rng.uniform(0.15, 0.5)),
        pulse=float(rng.choice([0.3, 1.0])),
        placements=int(2 * rng.integers(5, 11)),
        stop_noise=float(np.radians(rng.choice([0.0, 0.005, 0.01, 0.02]))),
        stretch=float(rng.normal(0, 0.002)),
        backlash=float(np.radians(rng.choice([0.0, 0.04, 0.08]))),
        systematic=float(rng.normal(0, 0.008)),
        sigma_range=float(rng.uniform(0.004, 0.012)),
        resolution=int(rng.choice([25, 50])),
        step=float(np.radians(rng.choice([0.25, 0.5]))),
        exact_lens=bool(rng.random() < 0.4),
        stand=bool(rng.integers(2)),
        sheets=int(rng.integers(0, 7)),
    )
    return replace(drawn, **given)


class BaseRig(Rig):
    """Cameras fixed to the base, their `mounting` being ``T_camera_platform``."""

    def camera_pose(self, camera, pitch):
        still = (
            RigidTransform.identity()
            if np.ndim(pitch) == 0
            else RigidTransform.identity(len(pitch))
        )
        return camera.mounting * still


def rig_of(v):
    """A Rig with mounting errors of some degrees and centimetres, and a board whose squares have the size asked for."""
    rng = np.random.default_rng([v.seed, 1])
    head = RigidTransform.from_components(
        [0.0, *rng.normal(0, 0.03, 2)],
        Rotation.from_rotvec([0.0, *rng.normal(0, 1.0, 2)], degrees=True),
    )
    focal = rng.uniform(520, 620)
    cameras = []
    for i, name in enumerate(("left", "right")):
        turn = (
            Rotation.from_rotvec(
                rng.normal(0, 1.5, 3) + [-2.0, 1.5 - 3 * i, 0.0], degrees=True
            )
            * AHEAD
        )
        centre = np.array([0.24 * i - 0.12, 0.03, 0.12]) + rng.normal(0, 0.01, 3)
        lens = np.array([rng.uniform(-0.2, -0.05), 0.04, *rng.normal(0, 5e-4, 2), 0.0])
        middle = np.array([320.0, 240.0]) + rng.normal(0, 6, 2)
        mounting = RigidTransform.from_components(-turn.apply(centre), turn)
        model = CameraModel(
            640, 480, focal, focal * rng.uniform(0.998, 1.002), *middle, lens
        )
        cameras.append(RigCamera(model, name=name, mounting=mounting, guess=None))
    spot, divergence = SPOTS[v.spot]
    beam = replace(
        LMS221, name=v.spot, spot_exit=spot, divergence=divergence, sigma_range=v.sigma_range, systematic=v.systematic,
        field_of_view=100, resolution=v.resolution, pulse=v.pulse, least_share=v.least_share,
    )  # fmt: skip
    platform = Platform(backlash=v.backlash, stretch=v.stretch)
    board = _board(v, v.square_px * np.mean(v.distances) / focal)
    kind = BaseRig if v.mount == "platform" else Rig
    return kind(beam, platform, head, RigidTransform.identity(), tuple(cameras), board)


def _board(v, square):
    """The paper's triangle or a plate, with as many squares as fit."""
    if v.triangle:
        square = min(square, 0.034)  # of larger ones a pattern does not fit
        count = int((0.19 - 0.02) / square)
        columns = max(count - 1, 4)
        rows = max(count, 5)
        return triangle_board(
            pattern=Chessboard(columns, rows, square, (0.012 + square, 0.012 + square))
        )
    size = np.array([0.48, 0.36])
    columns, rows = np.floor((size - 0.03) / square).astype(int) - 1
    rows -= (
        columns + rows + 1
    ) % 2  # a pattern that is even both ways looks the same upside down
    origin = (size - np.array([columns - 1, rows - 1]) * square) / 2
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size
    pattern = Chessboard(int(columns), int(rows), float(square), tuple(origin))
    return Board(
        "plate", ("top", "right", "bottom", "left"), corners, pattern, ("top", "left")
    )


@numba.njit(cache=True)
def _cast(origin, direction, T, lines, pattern, tones, sheets):
    """Nearest surface along rays (n, 3): distance (inf for none), reflectivity, and the cosine of incidence.

    One origin may serve all rays. `T` (3, 4) is ``T_platform_board``, `lines` its sides, `pattern`
    its first corner, square, columns, rows and ring; `tones` the board, the squares that differ
    from it, the light on it, whether a camera looks, and which squares differ (0 or 1); `sheets`
    (k, 7) are rectangles behind the board that face the rig: y, least and greatest x and z,
    reflectivity for the LRF and for cameras.
    """
    n = len(direction)
    distance = np.full(n, np.inf)
    value = np.zeros(n)
    cosine = np.ones(n)
    column = 5 + int(tones[3])
    step = 1 if len(origin) > 1 else 0
    for i in range(n):
        ox = origin[i * step, 0]
        oy = origin[i * step, 1]
        oz = origin[i * step, 2]
        dx = direction[i, 0]
        dy = direction[i, 1]
        dz = direction[i, 2]
        along = T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz
        r = (
            T[0, 2] * (T[0, 3] - ox) + T[1, 2] * (T[1, 3] - oy) + T[2, 2] * (T[2, 3] - oz)
        ) / along
        px = ox + r * dx - T[0, 3]
        py = oy + r * dy - T[1, 3]
        pz = oz + r * dz - T[2, 3]
        x = T[0, 0] * px + T[1, 0] * py + T[2, 0] * pz
        y = T[0, 1] * px + T[1, 1] * py + T[2, 1] * pz
        inside = r > 0.05
        for k in range(len(lines)):
            inside = inside and lines[k, 0] * x + lines[k, 1] * y + lines[k, 2] < 0
        if inside:
            u = (x - pattern[0]) / pattern[2]
            w = (y - pattern[1]) / pattern[2]
            ring = pattern[5]
            on = -ring < u < pattern[3] - 1 + ring and -ring < w < pattern[4] - 1 + ring
            other = on and (int(np.floor(u)) + int(np.floor(w))) % 2 == int(tones[4])
            distance[i], cosine[i] = r, abs(along)
            value[i] = (tones[1] if other else tones[0]) * tones[2]
            continue
        for k in range(len(sheets)):
            r = (sheets[k, 0] - oy) / dy
            if 0.05 < r < distance[i]:
                x = ox + r * dx
                z = oz + r * dz
                if sheets[k, 1] < x < sheets[k, 2] and sheets[k, 3] < z < sheets[k, 4]:
                    distance[i], value[i], cosine[i] = r, sheets[k, column], abs(dy)
    return distance, value, cosine


def _scene(v, rig, T_platform_board, rng):
    """What a ray may meet, for the LRF or for a camera: the settings of `_cast` by 'lrf' and 'camera'."""
    pattern = rig.board.pattern
    settings = np.array(
        [*pattern.origin, pattern.square, pattern.columns, pattern.rows, RING]
    )
    far = T_platform_board.apply(rig.board.points())[:, 1].max()
    ground = (
        rng.uniform(0.15, 0.35) if v.white else rng.uniform(0.4, 0.7)
    )  # cameras have to see the board before it
    sheets = [[far + rng.uniform(0.5, 2.5), -6, 6, -4, 4, rng.uniform(0.1, 0.9), ground]]
    for _ in range(v.sheets):
        x, z = rng.uniform([-1.2, -0.8], [1.2, 0.8])
        wide, high = rng.uniform(0.1, 0.8, 2)
        tone = np.clip(ground + rng.uniform(-0.1, 0.1), 0.1, 0.8)
        away = far + rng.uniform(0.2, 1.5)
        sheets.append(
            [away, x - wide, x + wide, z - high, z + high, rng.uniform(0.05, 0.9), tone]
        )
    if v.stand:
        x, _, z = T_platform_board.apply([*rig.board.corners.mean(axis=0), 0.0])
        sheets.append([far + 0.06, x - 0.012, x + 0.012, -1.2, z, 0.4, 0.4])
    face, squares = (PAPER, INK) if v.white else (INK, PAPER)
    lamp = np.array([0.3, -0.8, 0.5])
    shade = 0.55 + 0.45 * abs(T_platform_board.rotation.as_matrix()[:, 2] @ lamp)
    known = pose_array(T_platform_board), rig.board.lines(), settings
    # of a Chessboard the square diagonally before the first corner is light
    tones = {
        "lrf": [face, squares, 1.0, 0, v.white],
        "camera": [face, squares, shade, 1, v.white],
    }
    return {
        name: (*known, np.array(value, float), np.array(sheets, float))
        for name, value in tones.items()
    }


def _scan(v, rig, scene, pitch, rng):
    """Ranges (L, B) at the true pitch of every line, metres, NaN without an echo."""
    beam = rig.beam
    bearings = rig.beam.bearings()
    disc = spot_pattern(beam.rings)[:, 1:]
    up, bearing = (part.ravel() for part in np.meshgrid(pitch, bearings, indexing="ij"))
    across = np.stack([-np.sin(bearing), np.cos(bearing), 0 * bearing], axis=-1)
    shift = disc[:, :1] * across[:, None] + disc[:, 1:] * np.array([0.0, 0.0, 1.0])
    ray = polar_to_points(1.0, bearing)[:, None] + beam.divergence / 2 * shift
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    start = beam.spot_exit / 2 * shift
    origin = lrf_to_platform(start.reshape(-1, 3), np.repeat(up, len(disc)), rig.T_head_lrf)
    end = lrf_to_platform(
        (start + ray).reshape(-1, 3), np.repeat(up, len(disc)), rig.T_head_lrf
    )
    distance, value, cosine = _cast(origin, end - origin, *scene["lrf"])
    weight = np.exp(-2 * np.sum(disc**2, axis=1)) if v.gaussian else np.ones(len(disc))
    hit = np.isfinite(distance)
    energy = np.where(hit, value * cosine / np.where(hit, distance, 1.0) ** 2, 0.0).reshape(
        -1, len(disc)
    )
    reading, _ = echo(beam, distance.reshape(-1, len(disc)), energy * weight / weight.sum())
    ideal = Readings(reading, np.isnan(reading).astype(int))
    ranges, reasons = measured(beam, ideal, rng)
    ranges = np.where(reasons == 0, np.round(ranges / beam.unit) * beam.unit, np.nan)
    return ranges.reshape(len(pitch), len(bearings))


def _photo(imager, scene, T_camera_platform, rng):
    """A picture as bytes of a JPEG file."""
    model = imager.model
    back = T_camera_platform.inv()
    T, lines, _, _, _ = scene["camera"]
    R = back.rotation.as_matrix().T
    light = cv2.resize(
        _light(imager.rays[COARSE // 2 :: COARSE, COARSE // 2 :: COARSE], R, back.translation, scene),
        (model.width, model.height), interpolation=cv2.INTER_LINEAR,
    )  # fmt: skip
    rows, columns = _where(imager, T, lines, R, back.translation)
    if rows.stop > rows.start and columns.stop > columns.start:
        f = (np.arange(SAMPLES) + 0.5) / SAMPLES
        grid = imager.rays[rows.start : rows.stop + 1, columns.start : columns.stop + 1]
        down = f[:, None, None]
        side = f[None, :, None]
        top = grid[:-1, None, :-1, None] * (1 - side) + grid[:-1, None, 1:, None] * side
        low = grid[1:, None, :-1, None] * (1 - side) + grid[1:, None, 1:, None] * side
        rays = (
            top * (1 - down[:, None]) + low * down[:, None]
        )  # (rows, SAMPLES, columns, SAMPLES, 3)
        light[rows, columns] = _light(rays, R, back.translation, scene).mean(axis=(1, 3))
    level = 250.0 * cv2.GaussianBlur(light, (0, 0), BLUR)
    grey = np.clip(np.rint(level + rng.normal(0, NOISE, level.shape)), 0, 255).astype(
        np.uint8
    )
    return cv2.imencode(
        ".jpg", np.repeat(grey[..., None], 3, axis=2), [cv2.IMWRITE_JPEG_QUALITY, 95]
    )[1].tobytes()


def _light(rays, R, centre, scene):
    """Light along viewing rays (..., 3) of a camera at `centre` whose axes are the rows of `R`."""
    direction = rays.reshape(-1, 3) @ R
    return _cast(centre[None], direction, *scene["camera"])[1].reshape(rays.shape[:-1])


def _where(imager, T, lines, R, centre):
    """Rows and columns of pixels about the board: those whose viewing ray meets its outline, with some more."""
    direction = imager.rays[:-1:COARSE, :-1:COARSE] @ R
    reach = (T[:, 2] @ (T[:, 3] - centre)) / (direction @ T[:, 2])
    at = (centre + reach[..., None] * direction - T[:, 3]) @ T[:, :2]
    met = np.all(at @ lines[:, :2].T + lines[:, 2] < 0, axis=-1) & (reach > 0)
    if not met.any():
        return slice(0, 0), slice(0, 0)
    found = []
    for axis, size in enumerate((imager.model.height, imager.model.width)):
        index = np.flatnonzero(met.any(axis=1 - axis)) * COARSE
        found.append(
            slice(max(index[0] - 3 * COARSE, 0), min(index[-1] + 4 * COARSE, size))
        )
    return found


def record(path, seed, **given):
    """Write a session with its truth into a folder; `given` as in Variation, the rest is drawn from the seed."""
    v = vary(seed, **given)
    rig = rig_of(v)
    rng = np.random.default_rng([v.seed, 2])
    placements = pairs(
        rig,
        v.placements // 2,
        v.distances,
        np.random.default_rng([v.seed, 3]),
        np.radians(2.0),
        v.step,
    )
    lrf = LrfInfo(
        f"{rig.beam.name} (varied)", tuple(rig.beam.bearings()[[0, -1]]), np.radians(v.resolution / 100), v.sigma_range,
        range_resolution=rig.beam.unit, spot_exit=rig.beam.spot_exit, spot_divergence=rig.beam.divergence,
        systematic_error=0.035, step_error=0.0,  # beams are drawn at the stated step
    )  # fmt: skip
    infos = [
        CameraInfo(
            c.name,
            v.mount,
            c.model.width,
            c.model.height,
            c.model if v.exact_lens else None,
        )
        for c in rig.cameras
    ]
    frame = "T_camera_lrf" if v.mount == "head" else "T_camera_platform"
    truth = {
        "simulated": True, "variation": vars(v) | {"distances": list(v.distances)}, "boards": {}, "sweeps": {},
        "T_head_lrf": transform_to_json(rig.T_head_lrf), "board": board_to_json(rig.board), "images": {},
        "cameras": {
            c.name: {frame: transform_to_json(c.mounting), "intrinsics": model_to_json(c.model)} for c in rig.cameras
        },
    }  # fmt: skip
    own = {"platform_sigma": (np.radians(2.0), 0.05), "simulated": True}
    with SessionWriter(path, rig.board, lrf, infos, rig.T_head_lrf_stated, **own) as writer:
        imagers = {camera.name: Imager(camera.model) for camera in rig.cameras}
        _close_views(v, rig, imagers, writer, truth, rng)
        for placement in placements:
            _placement(v, rig, imagers, placement, writer, truth, rng)
    (path / "truth.json").write_text(json.dumps(truth))
    return path


def _close_views(v, rig, imagers, writer, truth, rng):
    """The board held close, for the intrinsics, where these are not stated."""
    for camera in () if v.exact_lens else rig.cameras:
        pose = rig.camera_pose(camera, 0.0)
        for T_camera_board in held_close(rig, camera, 16, rng):
            scene = _scene(v, rig, pose.inv() * T_camera_board, rng)
            _image(
                writer,
                truth,
                camera,
                imagers,
                scene,
                pose,
                T_camera_board,
                rng,
                purpose="intrinsics",
            )


def _placement(v, rig, imagers, placement, writer, truth, rng):
    """Images at their stops, then the sweep."""
    board = placement.T_platform_board
    number = placement.number
    truth["boards"][number] = {"T_platform_board": transform_to_json(board)}
    scene = _scene(v, rig, board, rng)
    low, high = sorted(placement.sweep[:2])
    way = 1 if placement.sweep[0] == low else -1

    def stops(commanded):
        """True pitch at rest."""
        head = (1 + v.stretch) * np.asarray(commanded) - way * v.backlash / 2
        return head + v.stop_noise * rng.standard_normal(head.shape)

    commanded = placement.image_pitch if v.mount == "head" else placement.image_pitch[:1]
    for recorded, true in zip(commanded, stops(commanded), strict=True):
        for camera in rig.cameras:
            pose = rig.camera_pose(camera, true)
            own = {"placement": number, "pitch": float(recorded), "true": float(true)}
            _image(writer, truth, camera, imagers, scene, pose, pose * board, rng, **own)
    lines = np.arange(np.floor(low / v.step), np.ceil(high / v.step) + 1)
    pitch = lines[::way] * v.step
    true = stops(pitch)
    truth["sweeps"][number] = {"pitch_rad": true.tolist()}
    writer.add_sweep(number, _scan(v, rig, scene, true, rng), rig.beam.bearings(), pitch)


def _image(
    writer, truth, camera, imagers, scene, pose, T_camera_board, rng, true=0.0, **own
):
    """One picture of a session, and what only the simulator knows of it."""
    picture = _photo(imagers[camera.name], scene, pose, rng)
    file = writer.add_image(camera.name, picture, **own)
    truth["images"][file] = {
        "pitch_rad": true,
        "T_camera_board": transform_to_json(T_camera_board),
    }


def drawn(seed):
    """Observations of a varied rig, drawn from noise models without any picture, and the truth: a fast stand-in."""
    own = np.random.default_rng([seed, 25])
    settings = {
        "mount": str(own.choice(["head", "platform"])),
        "spot": SPOTS[str(own.choice(list(SPOTS)))],
        "bias": own.uniform(-0.8, 0.8),
        "softness": own.uniform(0.02, 0.2),
        "spread": own.uniform(0.0, 1.0),
        "sigma_stop": np.radians(own.choice([0.0, 0.005, 0.01, 0.02])),
        "sigma_range": own.uniform(0.004, 0.012),
        "sigma_px": own.uniform(0.05, 0.3),
        "stretch": own.normal(0, 0.002),
        "pitch_step": np.radians(0.5),
        "see_images": int(own.integers(2, 4)),
    }
    if settings["mount"] == "platform":
        settings["see_images"] = 1
    obs, truth, _ = draw(own, int(own.integers(10, 20)), **settings)
    return obs, truth


@dataclass(frozen=True)
class Outcome:
    """How a calibration did on a session whose truth is known.

    `names` (k), `errors` (k,) and `covariance` (k, k) are of the shared unknowns that have a truth;
    `lengths` are errors of the `combined` edge lengths in their standard deviations; `answer` and
    `words` are the verdict's.
    """

    names: tuple
    errors: np.ndarray
    covariance: np.ndarray
    lengths: np.ndarray
    answer: str
    words: tuple
    noise: dict
    calibration: object = field(repr=False, default=None)

    @property
    def scores(self):
        """Errors in their standard deviations, (k,)."""
        return self.errors / np.sqrt(np.diag(self.covariance))

    @property
    def square(self):
        """Normalised square of all errors together, chi-square with k degrees of freedom."""
        return float(self.errors @ np.linalg.solve(self.covariance, self.errors))


def judged(path):
    """Calibrate a session, everything at once: an Outcome, without names where there is no joint estimate."""
    session = open_session(path)
    truth = read_truth(session)
    calibration = pipeline.calibrate(session, methods=("line",))
    verdict = judge(calibration, suggest=False)
    words = tuple(reason.words for reason in verdict.reasons)
    if calibration.joint is None or not calibration.joint.solution.converged:
        return Outcome(
            (),
            np.zeros(0),
            np.zeros((0, 0)),
            np.zeros(0),
            verdict.answer,
            words,
            {},
            calibration,
        )
    joint = pipeline.leave_out(calibration.joint)
    found = joint.solution
    v = json.loads((path / "truth.json").read_text())["variation"]
    numbers = found.observations.placements.tolist()
    boards = [truth.boards[number] for number in numbers]
    known = {"range_offset": v["systematic"], "pitch_scale": v["stretch"]}
    state = joint_truth(
        found.observations, truth.T_head_lrf, truth.cameras, boards, **known
    )
    shown = [i for i, name in enumerate(found.solution.names) if name not in NOT_SHOWN]
    errors = state_errors(found.state, state, found.unknowns)[shown]
    covariance = found.solution.trusted[np.ix_(shown, shown)]
    names = tuple(np.array(found.solution.names)[shown])
    lengths = _length_scores(joint, truth.board)
    calibration = replace(calibration, joint=joint)
    return Outcome(
        names, errors, covariance, lengths, verdict.answer, words, found.noise, calibration
    )


def _length_scores(joint, board):
    """Errors of the `combined` lengths over their standard deviations, (n,)."""
    true = board.lengths()
    out = []
    for measured_board, _ in combined.combined_outlines(joint).values():
        for name, length in measured_board.lengths.items():
            out.append((length - true[name]) / measured_board.sigma[name])
    return np.array(out)


def inside(scores, share=0.9):
    """Share of scores within the interval that should hold `share` of them."""
    return float(np.mean(np.abs(scores) < norm.ppf((1 + share) / 2)))
