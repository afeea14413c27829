"""Record a session with a simulated rig: telegrams, platform log, images and the truth."""

import errno
import json
import math
import os
import shutil
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.kinematics import MIRROR_TURN
from lrfcal_lib.session.lms2xx_codec import (
    Configuration,
    encode_configuration,
    encode_words,
)
from lrfcal_lib.session.read import PLATFORM_COLUMNS
from lrfcal_lib.session.stated import transform_to_json
from lrfcal_lib.session.write import SessionWriter, write_file
from lrfcal_lib.simulate.beam import scan
from lrfcal_lib.simulate.lengths import room_lengths
from lrfcal_lib.simulate.rig import Placement, Setup, held_close, placements_of, random
from lrfcal_lib.simulate.scene import (
    Imager,
    World,
    board_on_stand,
    furnished,
    furnished_room,
    need,
)

LICENCE = "CC-BY-4.0"
RECORDING = (
    "stop-and-go: the head rests at every pitch step, one scan line and the images are taken at "
    "rest"
)
SWEEP, STOPS, PHOTO, _, VIEWS = range(
    5
)  # streams of random numbers; rig.PLACES is one more
# s from the end of a scan to the last byte of its telegram at 500 kBd, 812 bytes
REPLY_TIME = 0.0016 + 0.016


class Stops(NamedTuple):
    """The head at rest, one after the other: pitch, radians, shape (n,)."""

    commanded: np.ndarray
    true: np.ndarray
    measured: np.ndarray


class Shots(NamedTuple):
    """Images of one camera, by its number in the rig, in one arrangement of the room.

    The placement is -1 for the board held close; `T_platform_board` None where there is no board
    but a table with things; `poses` are ``T_camera_platform``, `key` that of the random numbers;
    `T_room_platform` is that of a station.
    """

    camera: int
    placement: int
    purpose: str
    T_platform_board: RigidTransform | None
    poses: list
    key: tuple
    T_room_platform: RigidTransform | None = None


def world_of(
    setup: Setup,
    T_platform_board: RigidTransform | None,
    stand: bool = True,
    T_room_platform: RigidTransform | None = None,
) -> World:
    """The room with the board in it.

    Parameters
    ----------
    setup
    T_platform_board
        None for a laid table instead of the board.
    stand
        Whether the board is on its stand, or held by nothing.
    T_room_platform
        Of a station, where there is no board.
    """
    if T_platform_board is None:
        room = furnished_room(*furnished("still life"))
        if T_room_platform is None:
            return room
        return room.seen_from(T_room_platform)
    things = board_on_stand(setup.rig.board, T_platform_board, setup.rig.ring)
    return furnished_room(*(things if stand else things[:1]))


def step_angles(first, last, step):
    """Pitch commands of a stop-and-go sweep: multiples of `step` about from `first` to `last`."""
    need(step > 0, f"a pitch step must be positive, got {step} rad")
    low, high = sorted((first, last))
    angles = np.arange(math.floor(low / step), math.ceil(high / step) + 1) * step
    return angles if last >= first else angles[::-1]


def stops_of(setup: Setup, placement: Placement) -> tuple[Stops, Stops]:
    """Where the head stands for the images and for the scan lines of a placement.

    Parameters
    ----------
    setup
    placement
    """
    step = setup.step if placement.T_platform_board is not None else setup.room_sweep[2]
    rng = random(setup, STOPS, placement.number)
    images = np.asarray(placement.image_pitch)
    lines = step_angles(*placement.sweep, step)
    stop = setup.rig.platform.stop
    return (
        Stops(images, *stop(images, placement.direction, rng)),
        Stops(lines, *stop(lines, placement.direction, rng)),
    )


def sweep_of(setup, placement):
    """The scan lines of a placement, one a stop of the sweep: words (L, B) as a device sends."""
    pitch = stops_of(setup, placement)[1].true
    station = placement.T_room_platform
    world = world_of(setup, placement.T_platform_board, T_room_platform=station)
    return scan(
        setup.rig.beam,
        world,
        pitch[:, None],
        setup.rig.T_head_lrf,
        random(setup, SWEEP, placement.number),
    )


def close_views(setup: Setup, number: int) -> list[RigidTransform]:
    """Poses ``T_platform_board`` of the board held close to a camera while the head is at 0.

    Parameters
    ----------
    setup
    number
        Of the camera in the rig.
    """
    rig = setup.rig
    camera = setup.rig.cameras[number]
    still = rig.camera_pose(camera, 0.0).inv()
    return [
        still * pose
        for pose in held_close(
            rig, camera, setup.intrinsics_views, random(setup, VIEWS, number)
        )
    ]


def shots_of(setup, placements):
    """All images of a setup in the order in which they are written, a list of Shots."""
    out = []
    rig = setup.rig
    for number, camera in enumerate(rig.cameras):
        still = [rig.camera_pose(camera, 0.0)]
        for i, pose in enumerate(close_views(setup, number)):
            out.append(Shots(number, -1, "intrinsics", pose, still, (PHOTO, number, 0, i)))
    for placement in placements:
        pose = placement.T_platform_board
        purpose = "scene" if placement.T_platform_board is None else "board"
        for number, camera in enumerate(rig.cameras):
            poses = [
                rig.camera_pose(camera, pitch)
                for pitch in stops_of(setup, placement)[0].true
            ]
            out.append(
                Shots(
                    number,
                    placement.number,
                    purpose,
                    pose,
                    poses,
                    (PHOTO, number, placement.number),
                    placement.T_room_platform,
                )
            )
    return out


def photograph(setup, shots):
    """Take pictures, a list of JPEG files as bytes."""
    camera = setup.rig.cameras[shots.camera]
    imager = Imager(camera.model, camera.exposure)
    stand = shots.purpose == "board"
    world = world_of(setup, shots.T_platform_board, stand, shots.T_room_platform)
    rng = random(setup, *shots.key)
    quality = [cv2.IMWRITE_JPEG_QUALITY, setup.quality]
    return [
        cv2.imencode(".jpg", imager.render(world, pose, rng), quality)[1].tobytes()
        for pose in shots.poses
    ]


def simulate(path: str | os.PathLike, setup: Setup, workers: int = 1) -> None:
    """Simulate a recording and write its session into a new folder.

    Parameters
    ----------
    path
    setup
    workers
        Processes that render images.

    Raises
    ------
    ValueError
        If the folder exists, the board does not fit into the views, or the session cannot be
        written (a full disk). The session is made beside its place and moved there when it is
        complete; nothing is left of a failed one.
    """
    path = Path(path)
    if path.exists():
        raise ValueError(f"{path}: exists already; choose another name or remove it first")
    draft = path.with_name(f".{path.name}.draft{os.getpid()}")
    try:
        _record(draft, path.name, setup, workers)
        draft.rename(path)
    except OSError as error:
        full = (
            "; free some space"
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
            else ""
        )
        raise ValueError(
            f"{path}: cannot be written ({error.strerror}){full}; nothing was kept"
        ) from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _record(folder, name, setup, workers):
    rig = setup.rig
    placements = placements_of(setup)
    for placement in placements:
        rig.platform.check(np.array(placement.sweep))
    reference = {
        "recording": RECORDING,
        "scene_placements": [p.number for p in placements if p.T_platform_board is None],
    }
    truth = _truth(setup, placements)
    with SessionWriter(
        folder,
        rig.board,
        rig.beam.info("simulated"),
        rig.camera_infos(),
        rig.T_head_lrf_stated,
        name=name,
        licence=LICENCE,
        simulated=True,
        platform_sigma=rig.stated_sigma,
        reference=reference,
        source=f"simulated by lrfcal_lib.simulate, setup '{setup.name}', seed {setup.seed}",
    ) as writer:
        log = _add_placements(writer, setup, placements, truth, workers)
    lines = [",".join(PLATFORM_COLUMNS), *log]
    write_file(folder / "platform.csv", "\n".join(lines) + "\n", folder)
    write_file(folder / "truth.json", json.dumps(truth, indent=1) + "\n", folder)


def _truth(setup, placements):
    """What only the simulator knows, as truth.json has it; sweeps and images come later."""
    rig = setup.rig
    boards = {}
    stations = {}
    for p in placements:
        if p.T_platform_board is not None:
            boards[p.number] = {"T_platform_board": transform_to_json(p.T_platform_board)}
        if p.T_room_platform is not None:
            stations[p.number] = {"T_room_platform": transform_to_json(p.T_room_platform)}
    truth = {
        "simulated": True,
        "setup": setup.name,
        "seed": setup.seed,
        **rig.truth(),
        "boards": boards,
        "lrf": asdict(rig.beam),
        "platform": asdict(rig.platform),
        "sweeps": {},
        "images": {},
    }
    if stations:
        truth |= {"stations": stations, "lengths": room_lengths()}
    return truth


def _add_placements(writer, setup, placements, truth, workers):
    """Write the images for the intrinsics, then images and sweep of each placement.

    Returns the rows of the platform's log.
    """
    beam = setup.rig.beam
    pause = setup.rig.platform.settle
    clock = 0.0
    log = []
    took = beam.turns * MIRROR_TURN
    unit = beam.unit_name
    configuration = Configuration().changed(measuring_mode=0, unit=unit)
    writer.add_telegrams(-1, [encode_configuration(configuration)], time_s=0.0)
    shots = shots_of(setup, placements)
    files = _photographs(setup, shots, workers)
    _add_images(writer, setup, [s for s in shots if s.placement < 0], files, truth)
    for placement in placements:
        images, lines = stops_of(setup, placement)
        shot_at = clock + pause * np.arange(1, len(images.true) + 1)
        own = [s for s in shots if s.placement == placement.number]
        _add_images(writer, setup, own, files, truth, images, shot_at)
        first = shot_at[-1] + pause
        began = first + (pause + took) * np.arange(len(lines.true))
        telegrams = [encode_words(words, unit=unit) for words in sweep_of(setup, placement)]
        arrived = np.round(began + took + REPLY_TIME, 4)
        writer.add_telegrams(placement.number, telegrams, lines.measured, arrived)
        for stops, times in ((images, shot_at), (lines, began)):
            commanded = np.degrees(stops.commanded)
            measured = np.degrees(stops.measured)
            for t, c, m in zip(times, commanded, measured, strict=True):
                log.append(f"{t:.4f},{c:.4f},{m:.4f}")
        truth["sweeps"][placement.number] = {"pitch_rad": lines.true.tolist()}
        clock = float(began[-1] + took + pause)
    return log


def _photographs(setup, shots, workers):
    """The images of all shots in order, lists of files, rendered ahead by worker processes."""
    if workers <= 1:
        yield from (photograph(setup, item) for item in shots)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(photograph, [setup] * len(shots), shots)


def _add_images(writer, setup, shots, files, truth, stops=None, times=None):
    """Write the next images, with where the head then stood: at pitch 0 without stops."""
    for shot, images in zip(shots, files, strict=False):
        name = setup.rig.cameras[shot.camera].name
        for i, data in enumerate(images):
            pitch = true = 0.0
            time = math.nan
            if stops is not None:
                pitch = float(stops.measured[i])
                true = float(stops.true[i])
                time = float(np.round(times[i], 4))
            writer.add_image(
                name, data, shot.placement, pitch=pitch, time_s=time, purpose=shot.purpose
            )
            known = {"pitch_rad": true}
            if shot.T_platform_board is not None:
                known["T_camera_board"] = transform_to_json(
                    shot.poses[i] * shot.T_platform_board
                )
            file = f"images/{name}/{writer.shots[name]:04d}.jpg"
            truth["images"][file] = known
