"""Record a session with a simulated rig: telegrams, platform log, images and the truth."""

import json
import os
import shutil
from dataclasses import asdict
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from lrfcal_lib.model.kinematics import MIRROR_TURN
from lrfcal_lib.session.images import encode_jpeg
from lrfcal_lib.session.lms2xx_codec import (
    Configuration,
    encode_configuration,
    encode_words,
)
from lrfcal_lib.session.read import PLATFORM_COLUMNS
from lrfcal_lib.session.stated import board_to_json, model_to_json, transform_to_json
from lrfcal_lib.session.workers import spread
from lrfcal_lib.session.write import SessionWriter, write_file
from lrfcal_lib.simulate.beam import scan
from lrfcal_lib.simulate.lengths import room_lengths
from lrfcal_lib.simulate.rig import (
    CLOSE,
    Placement,
    Setup,
    held_close,
    placements_of,
    random,
)
from lrfcal_lib.simulate.scene import (
    World,
    board_on_stand,
    furnished,
    furnished_room,
)

LICENCE = "CC-BY-4.0"
# how well T_head_lrf is said to be known: direction (radians) and offset (metres)
STATED_SIGMA = (np.radians(1.5), 0.020)
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
    """Images of one camera, by its number in the rig, at one placement.

    `key` is that of the random numbers.
    """

    camera: int
    placement: Placement
    stops: Stops
    key: tuple


def world_of(setup: Setup, placement: Placement) -> World:
    """The room at a placement: with the board on its stand, or held by nothing before a camera; or
    with a laid table instead, seen from a station if it is one.

    Parameters
    ----------
    setup
    placement
    """
    if placement.T_platform_board is None:
        room = furnished_room(*furnished("still life"))
        station = placement.T_room_platform
        return room if station is None else room.seen_from(station)
    things = board_on_stand(setup.rig.board, placement.T_platform_board)
    return furnished_room(*(things if placement.purpose == "board" else things[:1]))


def stops_of(setup: Setup, placement: Placement) -> list[Stops]:
    """Where the head stands for the images and for the scan lines of a placement.

    Scan lines are at multiples of the step, about from the first to the last pitch of the sweep.

    Parameters
    ----------
    setup
    placement
    """
    rng = random(setup, STOPS, placement.number)
    images = np.array(placement.image_pitch)
    first, last, step = placement.sweep
    way = 1 if first <= last else -1
    low, high = sorted([first, last])
    lines = np.arange(np.floor(low / step), np.ceil(high / step) + 1)[::way] * step
    return [
        Stops(commanded, *setup.rig.platform.stop(commanded, way, rng))
        for commanded in (images, lines)
    ]


def sweep_of(setup, placement):
    """The scan lines of a placement, one a stop of the sweep: words (L, B) as a device sends."""
    _, lines = stops_of(setup, placement)
    world = world_of(setup, placement)
    rng = random(setup, SWEEP, placement.number)
    return scan(setup.rig.beam, world, lines.true[:, None], setup.rig.T_head_lrf, rng)


def close_views(setup: Setup, number: int) -> list[Placement]:
    """Placements of the board held close to a camera while the head is at 0.

    Parameters
    ----------
    setup
    number
        Of the camera in the rig.
    """
    rig = setup.rig
    camera = rig.cameras[number]
    still = rig.camera_pose(camera, 0.0).inv()
    rng = random(setup, VIEWS, number)
    return [
        Placement(CLOSE, still * pose)
        for pose in held_close(rig, camera, setup.intrinsics_views, rng)
    ]


def shots_of(setup, placements):
    """All images of a setup in the order in which they are written, a list of Shots."""
    cameras = range(len(setup.rig.cameras))
    still = Stops(*np.zeros((3, 1)))
    close = [
        Shots(number, placement, still, (PHOTO, number, 0, i))
        for number in cameras
        for i, placement in enumerate(close_views(setup, number))
    ]
    return close + [
        Shots(number, p, stops_of(setup, p)[0], (PHOTO, number, p.number))
        for p in placements
        for number in cameras
    ]


def photograph(setup, shots):
    """Take pictures, a list of JPEG files as bytes."""
    rig = setup.rig
    camera = rig.cameras[shots.camera]
    world = world_of(setup, shots.placement)
    rng = random(setup, *shots.key)
    return [
        encode_jpeg(camera.render(world, pose, rng), setup.quality)
        for pose in rig.camera_pose(camera, shots.stops.true)
    ]


def simulate(path: str | os.PathLike, setup: Setup) -> None:
    """Simulate a recording and write its session into a new folder.

    Images are rendered by the workers of :func:`lrfcal_lib.session.workers.side_by_side`.

    Parameters
    ----------
    path
    setup

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
        _record(draft, path.name, setup)
        draft.rename(path)
    except OSError as error:
        raise ValueError(
            f"{path}: cannot be written ({error.strerror}): is there space? Nothing was kept"
        ) from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _record(folder, name, setup):
    rig = setup.rig
    placements = placements_of(setup)
    reference = {
        "recording": RECORDING,
        "scene_placements": [p.number for p in placements if p.purpose == "scene"],
    }
    truth = _truth(setup, placements)
    with SessionWriter(
        folder,
        rig.board,
        rig.beam.info("simulated"),
        rig.camera_infos().values(),
        rig.T_head_lrf_stated,
        name=name,
        licence=LICENCE,
        simulated=True,
        platform_sigma=STATED_SIGMA,
        reference=reference,
        source=f"simulated by lrfcal_lib.simulate, setup '{setup.name}', seed {setup.seed}",
    ) as writer:
        log = _add_placements(writer, setup, placements, truth)
    table = pd.DataFrame(log, columns=PLATFORM_COLUMNS)
    rows = table.to_csv(index=False, float_format="%.4f")
    write_file(folder, "platform.csv", rows.encode())
    write_file(folder, "truth.json", (json.dumps(truth, indent=1) + "\n").encode())


def _truth(setup, placements):
    """What only the simulator knows, as JSON has it; sweeps and images come with the recording."""
    rig = setup.rig
    cameras = {
        c.name: {
            "T_camera_lrf": transform_to_json(c.mounting),
            "intrinsics": model_to_json(c.model),
            "exposure": asdict(c.exposure),
        }
        for c in rig.cameras
    }
    boards = {
        p.number: {"T_platform_board": transform_to_json(p.T_platform_board)}
        for p in placements
        if p.purpose == "board"
    }
    truth = {
        "simulated": True,
        "setup": setup.name,
        "seed": setup.seed,
        "T_head_lrf": transform_to_json(rig.T_head_lrf),
        "cameras": cameras,
        "board": board_to_json(rig.board),
        "boards": boards,
        "lrf": asdict(rig.beam),
        "platform": asdict(rig.platform),
        "sweeps": {},
        "images": {},
    }
    if setup.stations:
        truth["stations"] = {
            p.number: {"T_room_platform": transform_to_json(p.T_room_platform)}
            for p in placements
            if p.purpose == "scene"
        }
        truth["lengths"] = room_lengths()
    return truth


def _add_placements(writer, setup, placements, truth):
    """Write the images for the intrinsics, then images and sweep of each placement, and note where
    all was.

    Returns the rows of the platform's log.
    """
    beam = setup.rig.beam
    pause = setup.rig.platform.settle
    clock = 0.0
    log = []
    took = beam.turns * MIRROR_TURN
    unit = beam.unit_name
    configuration = encode_configuration(Configuration().changed(unit=unit))
    writer.add_telegrams(-1, [configuration], time_s=0.0)
    shots = shots_of(setup, placements)
    taken = zip(shots, spread(partial(photograph, setup), shots), strict=True)
    cameras = len(setup.rig.cameras)
    close = islice(taken, cameras * setup.intrinsics_views)
    _add_images(writer, setup, close, truth, [np.nan])
    for placement in placements:
        number = placement.number
        images, lines = stops_of(setup, placement)
        *shot_at, first = clock + pause * np.arange(1, len(images.true) + 2)
        _add_images(writer, setup, islice(taken, cameras), truth, shot_at)
        began = first + (pause + took) * np.arange(len(lines.true))
        telegrams = [encode_words(words, unit=unit) for words in sweep_of(setup, placement)]
        arrived = np.round(began + took + REPLY_TIME, 4)
        writer.add_telegrams(number, telegrams, lines.measured, arrived)
        for stops, times in ((images, shot_at), (lines, began)):
            angles = np.degrees([stops.commanded, stops.measured])
            log += zip(times, *angles, strict=True)
        truth["sweeps"][number] = {"pitch_rad": lines.true.tolist()}
        clock = began[-1] + took + pause
    return log


def _add_images(writer, setup, taken, truth, times):
    """Write images as JPEG files, each with its shot: where the head then stood."""
    rig = setup.rig
    for shot, images in taken:
        camera = rig.cameras[shot.camera]
        board = shot.placement.T_platform_board
        stops = zip(images, times, shot.stops.true, shot.stops.measured, strict=True)
        for data, time_s, true, measured in stops:
            file = writer.add_image(
                camera.name,
                data,
                shot.placement.number,
                pitch=measured,
                time_s=np.round(time_s, 4),
                purpose=shot.placement.purpose,
            )
            known = {"pitch_rad": true}
            if board is not None:
                T_camera_board = rig.camera_pose(camera, true) * board
                known["T_camera_board"] = transform_to_json(T_camera_board)
            truth["images"][file] = known
