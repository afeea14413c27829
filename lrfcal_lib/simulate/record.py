"""Record a session with a simulated rig: telegrams, platform log, images and the truth."""

from __future__ import annotations

import errno
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

from lrfcal_lib.drivers.lms2xx import encode_words
from lrfcal_lib.drivers.lms2xx_replies import Configuration, encode_configuration
from lrfcal_lib.session import (
    CameraInfo,
    LrfInfo,
    SessionWriter,
    board_to_json,
    model_to_json,
    transform_to_json,
)
from lrfcal_lib.session.writer import write_file
from lrfcal_lib.simulate import beam as lrf
from lrfcal_lib.simulate import room
from lrfcal_lib.simulate.placements import Placement, held_close, pairs
from lrfcal_lib.simulate.platform import step_angles
from lrfcal_lib.simulate.render import Imager

LICENCE = "CC-BY-4.0"
PLATFORM_COLUMNS = ("t_s", "commanded_deg", "measured_deg")
SWEEP, STOPS, PHOTO, PLACES, VIEWS = range(5)  # streams of random numbers
REPLY_TIME = 0.0016 + 0.016  # s from the end of a scan to the last byte of its telegram at 500 kBd, 812 bytes


class SimulationError(ValueError):
    """A session that cannot be simulated or written; nothing is left behind."""


@dataclass(frozen=True)
class Stops:
    """The head at rest, one after the other.

    Attributes
    ----------
    commanded, true, measured : ndarray, shape (n,)
        Pitch, radians.
    """

    commanded: np.ndarray
    true: np.ndarray
    measured: np.ndarray


@dataclass(frozen=True)
class Shots:
    """Images of one camera in one arrangement of the room.

    Attributes
    ----------
    camera : int
        Number in the rig.
    placement : int
        -1 for the board held close.
    purpose : str
    T_platform_board : RigidTransform or None
        None where there is no board but a table with things.
    poses : tuple of RigidTransform
        ``T_camera_platform``.
    key : tuple of int
        Of the random numbers.
    """

    camera: int
    placement: int
    purpose: str
    T_platform_board: RigidTransform | None
    poses: tuple
    key: tuple


def random(setup, *key):
    """Random numbers that depend on the setup's seed and a key alone, whatever else is simulated."""
    return np.random.default_rng([setup.seed, *key])


def placements_of(setup):
    """The board placements of a setup, a list of Placement."""
    return pairs(setup.rig, setup.pairs, setup.distances, random(setup, PLACES))


def room_placement(setup):
    """The sweep of the room as a placement without a board; None where the setup has none."""
    if not setup.room_sweep:
        return None
    first, last, _ = setup.room_sweep
    return Placement(2 * setup.pairs + 1, None, (first, last), setup.room_images)


def world_of(setup, T_platform_board, stand=True):
    """The room with the board on its stand (or held by nothing); with a laid table where the pose is None."""
    if T_platform_board is None:
        return room.furnished_room(*room.still_life())
    things = room.board_on_stand(setup.rig.board, T_platform_board, ring=setup.rig.ring)
    return room.furnished_room(*(things if stand else things[:1]))


def stops_of(setup, placement):
    """Where the head stands for the images and for the scan lines of a placement.

    Parameters
    ----------
    setup : Setup
    placement : Placement

    Returns
    -------
    images, lines : Stops
    """
    step = setup.step if placement.T_platform_board is not None else setup.room_sweep[2]
    commands = np.asarray(placement.image_pitch), step_angles(*placement.sweep, step)
    rng, stops = random(setup, STOPS, placement.number), []
    for commanded in commands:
        true, measured = setup.rig.platform.stop(commanded, placement.direction, rng)
        stops.append(Stops(commanded, true, measured))
    return tuple(stops)


def sweep_of(setup, placement):
    """The scan lines of a placement, one at every stop of the sweep.

    Parameters
    ----------
    setup : Setup
    placement : Placement

    Returns
    -------
    Scan
    """
    _, lines = stops_of(setup, placement)
    world, rng = world_of(setup, placement.T_platform_board), random(setup, SWEEP, placement.number)
    return lrf.scan(setup.rig.beam, world, lines.true[:, None], setup.rig.T_head_lrf, rng)


def shots_of(setup, placements):
    """All images of a setup in the order in which they are written.

    Parameters
    ----------
    setup : Setup
    placements : sequence of Placement
        The room's last, if any.

    Returns
    -------
    list of Shots
    """
    out = []
    for number, camera in enumerate(setup.rig.cameras):
        still = setup.rig.camera_pose(camera, 0.0)
        views = held_close(setup.rig, camera, setup.intrinsics_views, random(setup, VIEWS, number))
        for i, pose in enumerate(views):
            out.append(Shots(number, -1, "intrinsics", still.inv() * pose, (still,), (PHOTO, number, 0, i)))
    for placement in placements:
        true = stops_of(setup, placement)[0].true
        purpose = "scene" if placement.T_platform_board is None else "board"
        for number, camera in enumerate(setup.rig.cameras):
            poses = tuple(setup.rig.camera_pose(camera, pitch) for pitch in true)
            key = PHOTO, number, placement.number
            out.append(Shots(number, placement.number, purpose, placement.T_platform_board, poses, key))
    return out


def photograph(setup, shots):
    """Take pictures.

    Parameters
    ----------
    setup : Setup
    shots : Shots

    Returns
    -------
    list of bytes
        JPEG files.
    """
    camera = setup.rig.cameras[shots.camera]
    imager = Imager(camera.model, camera.exposure)
    world = world_of(setup, shots.T_platform_board, stand=shots.purpose == "board")
    rng, out = random(setup, *shots.key), []
    for pose in shots.poses:
        image = imager.render(world, pose, rng)
        out.append(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, setup.quality])[1].tobytes())
    return out


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
    placements, bare = placements_of(setup), room_placement(setup)
    everything = placements if bare is None else [*placements, bare]
    for placement in everything:
        setup.rig.platform.check(np.array(placement.sweep))
    clock, log, truth = 0.0, [], _truth(setup, placements)
    with _writer(folder, name, setup) as writer:
        writer.add_telegrams(-1, [_configuration(setup.rig.beam)], time_s=0.0)
        shots = shots_of(setup, everything)
        files = _photographs(setup, shots, workers)
        for item in (s for s in shots if s.placement < 0):
            _add_images(writer, setup, item, next(files), truth)
        for placement in everything:
            own = [s for s in shots if s.placement == placement.number]
            clock = _add_placement(writer, setup, placement, [(s, next(files)) for s in own], clock, log, truth)
    write_file(folder / "platform.csv", "\n".join([",".join(PLATFORM_COLUMNS), *log]) + "\n", folder)
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
    bearings = beam.bearings()
    info = LrfInfo(
        model=f"{beam.name} (simulated)",
        field_of_view=(float(bearings[0]), float(bearings[-1])),
        bearing_step=math.radians(beam.resolution / 100),
        sigma_range=beam.sigma_range,
        range_resolution=beam.unit,
        max_range=lrf.LARGEST_WORD * beam.unit,
        spot=(beam.spot_exit, beam.divergence),
    )
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


def _configuration(beam):
    return encode_configuration(Configuration().changed(measuring_mode=0, unit="mm" if beam.unit < 0.005 else "cm"))


def _add_placement(writer, setup, placement, photos, clock, log, truth):
    """Write the images and then the sweep of a placement; the time when it is done."""
    rig, (images, lines) = setup.rig, stops_of(setup, placement)
    pause = rig.platform.settle
    shot_at = clock + pause * np.arange(1, len(images.true) + 1)
    for item, files in photos:
        _add_images(writer, setup, item, files, truth, images, shot_at)
    scan_time = rig.beam.turns * lrf.MIRROR_TURN
    began = shot_at[-1] + pause + (pause + scan_time) * np.arange(len(lines.true))
    scan, unit = sweep_of(setup, placement), "mm" if rig.beam.unit < 0.005 else "cm"
    telegrams = [encode_words(words, unit=unit) for words in scan.words]
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
        pitch = 0.0 if stops is None else float(stops.measured[i])
        time = math.nan if times is None else float(np.round(times[i], 4))
        writer.add_image(name, picture, item.placement, pitch=pitch, time_s=time, purpose=item.purpose)
        picture.unlink()
        known = {"pitch_rad": 0.0 if stops is None else float(stops.true[i])}
        if item.T_platform_board is not None:
            known["T_camera_board"] = transform_to_json(item.poses[i] * item.T_platform_board)
        truth["images"][f"images/{name}/{writer.shots[name]:04d}.jpg"] = known


def _truth(setup, placements):
    """What only the simulator knows; sweeps and images follow as they are made."""
    rig = setup.rig
    cameras = {}
    for c in rig.cameras:
        key = "T_camera_lrf" if c.mount == "head" else "T_camera_platform"
        cameras[c.name] = {key: transform_to_json(c.mounting), "intrinsics": model_to_json(c.model)}
        cameras[c.name]["exposure"] = asdict(c.exposure)
    return {
        "simulated": True,
        "setup": setup.name,
        "seed": setup.seed,
        "T_head_lrf": transform_to_json(rig.T_head_lrf),
        "cameras": cameras,
        "board": board_to_json(rig.board),
        "boards": {p.number: {"T_platform_board": transform_to_json(p.T_platform_board)} for p in placements},
        "lrf": asdict(rig.beam),
        "platform": asdict(rig.platform),
        "sweeps": {},
        "images": {},
    }
