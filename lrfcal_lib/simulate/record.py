"""Record a session with a simulated rig: telegrams, platform log, images and the truth; and the card of its sums."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.session.lms2xx_codec import Configuration, encode_configuration, encode_words
from lrfcal_lib.session.stated import CameraInfo, LrfInfo, board_to_json, model_to_json, transform_to_json
from lrfcal_lib.session.write import SessionWriter, write_file
from lrfcal_lib.simulate import beam as lrf
from lrfcal_lib.simulate.rig import held_close, placements_of, random, room_placement
from lrfcal_lib.simulate.scene import Imager, board_on_stand, furnished, furnished_room

LICENCE = "CC-BY-4.0"
SWEEP, STOPS, PHOTO, _, VIEWS = range(5)  # streams of random numbers; rig.PLACES is one more
REPLY_TIME = 0.0016 + 0.016  # s from the end of a scan to the last byte of its telegram at 500 kBd, 812 bytes
SUMS = "SHA256SUMS"
BEGIN, END = "<!-- sums -->", "<!-- end of sums -->"
SMALL = ("session.json", "lrf/telegrams.bin", "lrf/index.csv", "platform.csv", "images.csv", "truth.json")


class SimulationError(ValueError):
    """A session that cannot be simulated or written; nothing is left behind."""


@dataclass(frozen=True)
class Stops:
    """The head at rest, one after the other: pitch, radians, shape (n,)."""

    commanded: np.ndarray
    true: np.ndarray
    measured: np.ndarray


@dataclass(frozen=True)
class Shots:
    """Images of one camera, by its number in the rig, in one arrangement of the room.

    The placement is -1 for the board held close; `T_platform_board` None where there is no board but a table with
    things; `poses` are ``T_camera_platform``, `key` that of the random numbers.
    """

    camera: int
    placement: int
    purpose: str
    T_platform_board: RigidTransform | None
    poses: tuple
    key: tuple


def world_of(setup, T_platform_board, stand=True):
    """The room with the board on its stand (or held by nothing); with a laid table where the pose is None."""
    if T_platform_board is None:
        return furnished_room(*furnished("still life"))
    things = board_on_stand(setup.rig.board, T_platform_board, setup.rig.ring)
    return furnished_room(*(things if stand else things[:1]))


def step_angles(first, last, step):
    """Pitch commands of a stop-and-go sweep: multiples of `step` from about `first` to about `last`, radians."""
    if step <= 0:
        raise ValueError(f"a pitch step must be positive, got {step} rad")
    low, high = sorted((first, last))
    angles = np.arange(math.floor(low / step), math.ceil(high / step) + 1) * step
    return angles if last >= first else angles[::-1]


def stops_of(setup, placement):
    """Where the head stands for the images and for the scan lines of a placement, two Stops."""
    step = setup.step if placement.T_platform_board is not None else setup.room_sweep[2]
    rng, stops = random(setup, STOPS, placement.number), []
    for commanded in (np.asarray(placement.image_pitch), step_angles(*placement.sweep, step)):
        stops.append(Stops(commanded, *setup.rig.platform.stop(commanded, placement.direction, rng)))
    return tuple(stops)


def sweep_of(setup, placement):
    """The scan lines of a placement, one at every stop of the sweep, a Scan."""
    _, lines = stops_of(setup, placement)
    world, rng = world_of(setup, placement.T_platform_board), random(setup, SWEEP, placement.number)
    return lrf.scan(setup.rig.beam, world, lines.true[:, None], setup.rig.T_head_lrf, rng)


def shots_of(setup, placements):
    """All images of a setup in the order in which they are written, a list of Shots."""
    out, rig = [], setup.rig
    for number, camera in enumerate(rig.cameras):
        still = rig.camera_pose(camera, 0.0)
        views = held_close(rig, camera, setup.intrinsics_views, random(setup, VIEWS, number))
        for i, pose in enumerate(views):
            out.append(Shots(number, -1, "intrinsics", still.inv() * pose, (still,), (PHOTO, number, 0, i)))
    for placement in placements:
        true, pose = stops_of(setup, placement)[0].true, placement.T_platform_board
        for number, camera in enumerate(rig.cameras):
            poses, key = tuple(rig.camera_pose(camera, pitch) for pitch in true), (PHOTO, number, placement.number)
            out.append(Shots(number, placement.number, "scene" if pose is None else "board", pose, poses, key))
    return out


def photograph(setup, shots):
    """Take pictures, a list of JPEG files as bytes."""
    camera = setup.rig.cameras[shots.camera]
    imager = Imager(camera.model, camera.exposure)
    world = world_of(setup, shots.T_platform_board, stand=shots.purpose == "board")
    rng, quality = random(setup, *shots.key), [cv2.IMWRITE_JPEG_QUALITY, setup.quality]
    return [cv2.imencode(".jpg", imager.render(world, pose, rng), quality)[1].tobytes() for pose in shots.poses]


def simulate(path, setup, workers=1):
    """Simulate a recording and write its session.

    Parameters
    ----------
    path : path-like
        Folder of the new session; must not exist.
    setup : Setup
    workers : int
        Processes that render images.

    Raises
    ------
    SimulationError
        If the folder exists, the board does not fit into the views, or the session cannot be written (a full disk).
        The session is made beside its place and moved there when it is complete; nothing is left of a failed one.
    """
    path = Path(path)
    if path.exists():
        raise SimulationError(f"{path}: exists already; choose another name or remove it first")
    draft = path.with_name(f".{path.name}.draft{os.getpid()}")
    try:
        _record(draft, path.name, setup, workers)
        draft.rename(path)
    except OSError as error:
        full = "; free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) else ""
        raise SimulationError(f"{path}: cannot be written ({error.strerror}){full}; nothing was kept") from error
    except ValueError as error:
        raise SimulationError(f"{path}: {error}") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _record(folder, name, setup, workers):
    boards, room, beam = placements_of(setup), room_placement(setup), setup.rig.beam
    everything = boards if room is None else [*boards, room]
    for placement in everything:
        setup.rig.platform.check(np.array(placement.sweep))
    clock, log, truth = 0.0, ["t_s,commanded_deg,measured_deg"], _truth(setup, boards)
    with _writer(folder, name, setup) as writer:
        mode = Configuration().changed(measuring_mode=0, unit="mm" if beam.unit < 0.005 else "cm")
        writer.add_telegrams(-1, [encode_configuration(mode)], time_s=0.0)
        shots = shots_of(setup, everything)
        files = _photographs(setup, shots, workers)
        for item in (s for s in shots if s.placement < 0):
            _add_images(writer, setup, item, next(files), truth)
        for placement in everything:
            own = [(s, next(files)) for s in shots if s.placement == placement.number]
            clock = _add_placement(writer, setup, placement, own, clock, log, truth)
    write_file(folder / "platform.csv", "\n".join(log) + "\n", folder)
    write_file(folder / "truth.json", json.dumps(truth, indent=1) + "\n", folder)


def _photographs(setup, shots, workers) -> Iterator[list[bytes]]:
    """The images of all shots in order, rendered ahead by worker processes."""
    if workers <= 1:
        yield from (photograph(setup, item) for item in shots)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(photograph, [setup] * len(shots), shots)


def _writer(folder, name, setup):
    rig, beam = setup.rig, setup.rig.beam
    info = LrfInfo(
        model=f"{beam.name} (simulated)", field_of_view=tuple(beam.bearings()[[0, -1]].tolist()),
        bearing_step=math.radians(beam.resolution / 100), sigma_range=beam.sigma_range, range_resolution=beam.unit,
        max_range=lrf.LARGEST_WORD * beam.unit, spot_exit=beam.spot_exit, spot_divergence=beam.divergence,
    )  # fmt: skip
    cameras = [CameraInfo(c.name, c.mount, c.model.width, c.model.height, None, c.guess) for c in rig.cameras]
    reference = {
        "recording": "stop-and-go: the head rests at every pitch step, one scan line and the images are taken at rest",
        "scene_placements": [2 * setup.pairs + 1] if setup.room_sweep else [],
    }
    return SessionWriter(
        folder, rig.board, info, cameras, rig.T_head_lrf_stated, name=name, licence=LICENCE, simulated=True,
        platform_sigma=rig.stated_sigma,
        source=f"simulated by lrfcal_lib.simulate, setup '{setup.name}', seed {setup.seed}", reference=reference,
    )  # fmt: skip


def _add_placement(writer, setup, placement, photos, clock, log, truth):
    """Write the images and then the sweep of a placement; the time when it is done."""
    beam, pause, (images, lines) = setup.rig.beam, setup.rig.platform.settle, stops_of(setup, placement)
    shot_at = clock + pause * np.arange(1, len(images.true) + 1)
    for item, files in photos:
        _add_images(writer, setup, item, files, truth, images, shot_at)
    scan_time = beam.turns * lrf.MIRROR_TURN
    began = shot_at[-1] + pause + (pause + scan_time) * np.arange(len(lines.true))
    unit = "mm" if beam.unit < 0.005 else "cm"
    telegrams = [encode_words(words, unit=unit) for words in sweep_of(setup, placement).words]
    writer.add_telegrams(placement.number, telegrams, lines.measured, np.round(began + scan_time + REPLY_TIME, 4))
    for stops, times in ((images, shot_at), (lines, began)):
        rows = zip(times, np.degrees(stops.commanded), np.degrees(stops.measured), strict=True)
        log += [f"{t:.4f},{c:.4f},{m:.4f}" for t, c, m in rows]
    truth["sweeps"][placement.number] = {"pitch_rad": lines.true.tolist()}
    return float(began[-1] + scan_time + pause)


def _add_images(writer, setup, item, files, truth, stops=None, times=None):
    name = setup.rig.cameras[item.camera].name
    for i, data in enumerate(files):
        picture = writer.path / f"{name}.jpg"
        write_file(picture, data, writer.path)
        pitch, true = (0.0, 0.0) if stops is None else (float(stops.measured[i]), float(stops.true[i]))
        time = math.nan if times is None else float(np.round(times[i], 4))
        writer.add_image(name, picture, item.placement, pitch=pitch, time_s=time, purpose=item.purpose)
        picture.unlink()
        known = {"pitch_rad": true}
        if item.T_platform_board is not None:
            known["T_camera_board"] = transform_to_json(item.poses[i] * item.T_platform_board)
        truth["images"][f"images/{name}/{writer.shots[name]:04d}.jpg"] = known


def _truth(setup, placements):
    """What only the simulator knows; sweeps and images follow as they are made."""
    rig, cameras = setup.rig, {}
    for c in rig.cameras:
        key = "T_camera_lrf" if c.mount == "head" else "T_camera_platform"
        cameras[c.name] = {key: transform_to_json(c.mounting), "intrinsics": model_to_json(c.model)}
        cameras[c.name]["exposure"] = asdict(c.exposure)
    return {
        "simulated": True, "setup": setup.name, "seed": setup.seed,
        "T_head_lrf": transform_to_json(rig.T_head_lrf), "cameras": cameras, "board": board_to_json(rig.board),
        "boards": {p.number: {"T_platform_board": transform_to_json(p.T_platform_board)} for p in placements},
        "lrf": asdict(rig.beam), "platform": asdict(rig.platform), "sweeps": {}, "images": {},
    }  # fmt: skip


def write_card(folder, names):
    """Write the data card: the sums of sessions in a file for ``sha256sum -c``, and a table of them in the README.

    The folder holds the sessions of these names and a README.md with two marks, between which the table stands.
    """
    folder = Path(folder)
    files = sorted(f for name in names for f in (folder / name).rglob("*") if f.is_file())
    sums = {f.relative_to(folder).as_posix(): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}
    lines = {name: f"{value}  {name}\n" for name, value in sums.items()}
    before, first, rest = (folder / "README.md").read_text().partition(BEGIN)
    _, last, after = rest.partition(END)
    if not (first and last):
        raise ValueError(f"{folder / 'README.md'}: put the marks '{BEGIN}' and '{END}' around the table of sums")
    rows = ["| file | bytes | SHA-256 |", "|---|---|---|"]
    for name in names:
        rows += [f"| {name}/{f} | {(folder / name / f).stat().st_size} | `{sums[f'{name}/{f}']}` |" for f in SMALL]
        images = [f for f in sums if f.startswith(f"{name}/images/")]
        joint, size = _sum("".join(lines[f] for f in images)), sum((folder / f).stat().st_size for f in images)
        rows.append(f"| {name}/images, {len(images)} files (sum of their lines in {SUMS}) | {size} | `{joint}` |")
    listing = "".join(lines.values())
    rows.append(f"| {SUMS} | {len(listing)} | `{_sum(listing)}` |")
    (folder / SUMS).write_text(listing)
    (folder / "README.md").write_text(f"{before}{BEGIN}\n" + "\n".join(rows) + f"\n{END}{after}")


def _sum(text):
    return hashlib.sha256(text.encode()).hexdigest()
