"""Rooms that stations stand in, cast straight from the simulator: no images, no files."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.calibrate.cloud import Cloud, join
from lrfcal_lib.calibrate.reconstruct import reconstruct
from lrfcal_lib.model.kinematics import Corrections
from lrfcal_lib.session.read import Sweep
from lrfcal_lib.simulate.beam import ideal_readings, measured
from lrfcal_lib.simulate.rig import Setup, load_setup
from lrfcal_lib.simulate.scene import Thing, World
from lrfcal_lib.simulate.shapes import box, cylinder, rectangle
from lrfcal_lib.simulate.textures import plain

FLOOR = -1.1
SETUP = load_setup("room_lms221")
GREY = (plain, (0.6, 0.6, 0.6))


def put(mesh, at, turn=0.0, tip=0.0):
    """A grey thing somewhere, turned about the vertical (degrees), after it was tipped."""
    turned = Rotation.from_euler("ZX", [turn, tip], degrees=True)
    return Thing(mesh, GREY, RigidTransform.from_components(at, turned))


def shell(width, depth, height):
    """Floor, ceiling and four walls about the middle of the floor, (0, 0)."""
    middle = FLOOR + height / 2
    return [
        put(rectangle(width, depth), [0, 0, FLOOR]),
        put(rectangle(width, depth), [0, 0, FLOOR + height]),
        put(rectangle(width, height), [0, depth / 2, middle], tip=90),
        put(rectangle(width, height), [0, -depth / 2, middle], tip=90),
        put(rectangle(depth, height), [width / 2, 0, middle], turn=90, tip=90),
        put(rectangle(depth, height), [-width / 2, 0, middle], turn=90, tip=90),
    ]


def furnished_at_random(rng, pieces=14):
    """A room of random size with boxes and columns along its walls and in it; its half sizes."""
    width, depth = rng.uniform(4.5, 7.5, 2)
    height = rng.uniform(2.4, 3.2)
    things = shell(width, depth, height)
    for _ in range(pieces):
        x, y = rng.uniform(-0.5, 0.5, 2) * [width, depth]
        if max(abs(x) - 0.25 * width, abs(y) - 0.25 * depth) < 0:
            y = depth / 2 - 0.3  # keeps the middle free for the rig
        size = rng.uniform([0.3, 0.3, 0.4], [1.2, 0.6, 1.9])
        if rng.random() < 0.25:
            things.append(put(cylinder(size[1] / 2, size[2]), [x, y, FLOOR]))
        else:
            turn = rng.choice([0.0, 90.0, rng.uniform(0, 90)])
            things.append(put(box(size), [x, y, FLOOR + size[2] / 2], turn))
    return World(things), np.array([width, depth]) / 2


def pose(rng, place, yaw):
    """``T_room_platform`` of a rig that stands somewhere, a little out of level."""
    lean = rng.normal(0, 0.8, 2)
    turn = Rotation.from_euler("ZYX", [yaw, *lean], degrees=True)
    return RigidTransform.from_components([*place, rng.normal(0, 0.03)], turn)


def around(rng, half, count=4):
    """Stations 0.5 to 1.2 m and 15 to 50 deg from one before, in the middle of a room."""
    places = [rng.uniform(-0.15, 0.15, 2) * half]
    yaws = [rng.uniform(0, 360)]
    while len(places) < count:
        k = rng.integers(len(places))
        direction = rng.uniform(0, 2 * np.pi)
        step = rng.uniform(0.5, 1.2)
        place = places[k] + step * np.array([np.cos(direction), np.sin(direction)])
        if np.all(np.abs(place) < 0.4 * half):
            places.append(place)
            yaws.append(yaws[k] + rng.choice([-1, 1]) * rng.uniform(15, 50))
    return {i + 1: pose(rng, *at) for i, at in enumerate(zip(places, yaws, strict=True))}


def scanned(
    world: World,
    T_room_platform: RigidTransform,
    rng: np.random.Generator,
    *,
    number: int = 1,
    step: float = 0.5,
    rings: int = 1,
    setup: Setup = SETUP,
    rig=None,
) -> Cloud:
    """The cloud of one station: cast with the rig of a setup, built with its truth or a calibrated rig.

    `step` is that of the pitch, degrees; beams are as far apart.
    """
    beam = replace(setup.rig.beam, rings=rings)
    bearings = beam.bearings()[:: max(1, round(step / 0.25))]
    commanded = np.radians(np.arange(-38, 24, step))
    true, recorded = setup.rig.platform.stop(commanded, 1, rng)
    grid = np.broadcast_arrays(bearings, true[:, None])
    there = world.seen_from(T_room_platform)
    flat = [values.ravel() for values in grid]
    ideal = ideal_readings(beam, there, *flat, setup.rig.T_head_lrf)
    ranges, reasons = measured(beam, ideal, rng)
    ranges = np.round(ranges, 3)
    # 0 is no range, as a session reads it
    good = (reasons == 0) & (ranges > 0)
    ranges = np.where(good, ranges, np.nan).reshape(grid[0].shape)
    corrections = Corrections(range_offset=beam.systematic)
    T_head_lrf = setup.rig.T_head_lrf
    pitch = true
    if rig is not None:
        corrections = replace(rig.corrections, sweeps={})
        T_head_lrf = rig.T_head_lrf
        pitch = recorded
    info = replace(beam.info("cast"), bearing_step=float(bearings[1] - bearings[0]))
    sweep = Sweep(number, ranges, bearings, pitch, np.full(len(pitch), np.nan))
    return join(reconstruct(sweep, [], T_head_lrf, corrections, lrf=info))
