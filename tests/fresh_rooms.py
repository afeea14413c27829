"""Recordings of rooms and rigs that nothing was tuned on: everything is drawn from a seed, the simulator draws the images."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.simulate import record as recording
from lrfcal_lib.simulate import scene
from lrfcal_lib.simulate.rig import load_setup

FLOOR = scene.FLOOR


def room_of(rng):
    """What `scene.ROOM` is, drawn: a room with furniture before the rig, pictures on the walls, two lamps."""
    width, depth = rng.uniform([4.0, 4.5], [7.0, 7.5])
    height = rng.uniform(2.4, 3.2)
    ahead = rng.uniform(3.2, depth - 0.8)  # from the rig to the wall before it
    middle = FLOOR + height / 2
    back = ahead - depth / 2
    wall = colour(rng, 0.5, 0.85)
    shell = [
        sheet(width, depth, floor_of(rng), [0, back, FLOOR]),
        sheet(width, depth, ["plain", [0.85] * 3], [0, back, FLOOR + height]),
        sheet(width, height, wall, [0, ahead, middle], tip=90),
        sheet(width, height, wall, [0, ahead - depth, middle], tip=90),
        sheet(depth, height, colour(rng, 0.5, 0.85), [-width / 2, back, middle], 90, 90),
        sheet(depth, height, colour(rng, 0.5, 0.85), [width / 2, back, middle], 90, 90),
    ]
    fittings = [
        row for _ in range(rng.integers(2, 6)) for row in picture(rng, width, ahead)
    ]
    furniture = []
    for _ in range(rng.integers(7, 14)):
        place = rng.uniform([-width / 2 + 0.3, 1.4], [width / 2 - 0.3, ahead - 0.3])
        kind = rng.choice([cupboard, table, column, shelf, heap])
        furniture += kind(rng, *place)
    lamps = {
        "positions": [
            [rng.uniform(-1, 1), rng.uniform(-1, 1), FLOOR + height - 0.3],
            [rng.uniform(-1.5, 1.5), ahead - 1.2, FLOOR + height - 0.3],
        ],
        "strengths": rng.uniform(2.5, 5.0, 2).tolist(),
        "ambient": rng.uniform(0.3, 0.5),
    }
    parts = {"shell": shell, "fittings": fittings, "desk": furniture, "still life": []}
    return {"parts": ["shell", "fittings", "desk"], "lights": lamps} | parts


def colour(rng, low, high):
    """A plain, slightly uneven surface."""
    return ["plain", rng.uniform(low, high, 3).tolist(), 0.1, rng.uniform(0.1, 0.6)]


def floor_of(rng):
    """Boards, a rug or stone."""
    kind = rng.integers(3)
    if kind == 0:
        return ["planks", rng.uniform(0.25, 0.6, 3).tolist()]
    if kind == 1:
        return ["plain", rng.uniform(0.2, 0.6, 3).tolist(), 0.5, 0.04]
    first, second = rng.uniform(0.3, 0.7, (2, 3)).tolist()
    return ["stripes", first, second, rng.uniform(0.2, 0.8)]


def surface_of(rng):
    """Of furniture: wood or paint, seen in infrared as in red or by chance."""
    texture = colour(rng, 0.1, 0.8)
    if rng.random() < 0.5:
        texture = ["wood", rng.uniform(0.2, 0.7, 3).tolist()]
    row = {"texture": texture}
    if rng.random() < 0.3:
        row["infrared"] = rng.uniform(0.15, 0.8)
    return row


def sheet(width, height, texture, at, turn=0.0, tip=0.0):
    """A flat rectangle."""
    shape = ["rectangle", width, height]
    return {"shape": shape, "texture": texture, "at": list(at), "turn": turn, "tip": tip}


def picture(rng, width, ahead):
    """A poster on the wall ahead or on one at the side."""
    wide, high = rng.uniform(0.4, 1.1, 2)
    texture = ["poster", wide, high, rng.uniform(0.1, 0.9, (4, 3)).tolist()]
    z = rng.uniform(-0.2, 0.8)
    if rng.random() < 0.7:
        x = rng.uniform(-0.4, 0.4) * width
        yield sheet(wide, high, texture, [x, ahead - 0.02, z], tip=90)
    else:
        side = rng.choice([-1, 1])
        at = [side * (width / 2 - 0.02), rng.uniform(2.0, ahead - 0.6), z]
        yield sheet(wide, high, texture, at, turn=90 * side, tip=90)


def standing(rng, x, y, size, turn):
    """A box on the floor."""
    at = [x, y, FLOOR + size[2] / 2]
    return {"shape": ["box", list(size)], "at": at, "turn": turn} | surface_of(rng)


def cupboard(rng, x, y):
    """A box as high as a man, or half."""
    yield standing(rng, x, y, rng.uniform([0.3, 0.3, 0.5], [1.1, 0.6, 1.9]), turned(rng))


def turned(rng):
    """Most furniture stands along the walls."""
    return float(rng.choice([0.0, 90.0, rng.uniform(0, 90)]))


def table(rng, x, y):
    """A top on four legs, with something on it."""
    wide, deep = rng.uniform([0.7, 0.5], [1.5, 0.9])
    high = rng.uniform(0.5, 0.8)
    look = surface_of(rng)
    top = {"shape": ["box", [wide, deep, 0.03]], "at": [x, y, FLOOR + high]}
    yield top | look
    for i, j in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        at = [x + i * (wide / 2 - 0.04), y + j * (deep / 2 - 0.04), FLOOR + high / 2]
        yield {"shape": ["box", [0.05, 0.05, high]], "at": at} | look
    size = rng.uniform(0.1, 0.35, 3)
    yield standing(rng, x, y, size, turned(rng)) | {
        "at": [x, y, FLOOR + high + 0.015 + size[2] / 2]
    }


def column(rng, x, y):
    """Round, from the floor up."""
    shape = ["cylinder", rng.uniform(0.08, 0.25), rng.uniform(0.4, 2.2)]
    yield {"shape": shape, "at": [x, y, FLOOR]} | surface_of(rng)


def shelf(rng, x, y):
    """Boards with books between them."""
    wide, high = rng.uniform([0.6, 0.9], [1.2, 1.9])
    look = surface_of(rng)
    for z in np.arange(0.0, high, 0.35):
        yield {"shape": ["box", [wide, 0.3, 0.022]], "at": [x, y, FLOOR + z + 0.01]} | look
        books = ["book_spines", int(rng.integers(1000))]
        at = [x, y + 0.03, FLOOR + z + 0.14]
        yield {"shape": ["box", [0.9 * wide, 0.2, 0.25]], "texture": books, "at": at}
    for side in (-1, 1):
        at = [x + side * wide / 2, y, FLOOR + high / 2]
        yield {"shape": ["box", [0.025, 0.3, high]], "at": at} | look


def heap(rng, x, y):
    """Boxes on each other."""
    z = FLOOR
    for _ in range(rng.integers(2, 4)):
        size = rng.uniform(0.2, 0.6, 3)
        row = standing(rng, x, y, size, turned(rng))
        yield row | {"at": [x, y, z + size[2] / 2]}
        z += size[2]


def setup_of(seed, rng):
    """The set-up of room_lms221 with another rig: axis, cameras, lenses, head and stations are drawn."""
    setup = load_setup("room_lms221")
    rig = setup.rig
    cameras = []
    for camera in rig.cameras:
        centre = -camera.mounting.rotation.inv().apply(camera.mounting.translation)
        turn = Rotation.from_rotvec(rng.normal(0, 1.5, 3), degrees=True)
        turn = turn * camera.mounting.rotation
        centre = centre + rng.normal(0, 0.02, 3)
        mounting = RigidTransform.from_components(-turn.apply(centre), turn)
        model = camera.model
        focal = model.fx * rng.uniform(0.9, 1.1)
        model = replace(
            model,
            fx=focal,
            fy=focal * (1 + rng.normal(0, 0.001)),
            cx=model.cx + rng.normal(0, 8),
            cy=model.cy + rng.normal(0, 8),
            distortion=model.distortion * rng.uniform(0.6, 1.1),
        )
        cameras.append(replace(camera, model=model, mounting=mounting, guess=mounting))
    platform = replace(
        rig.platform,
        backlash=np.radians(rng.uniform(0.0, 0.1)),
        stretch=rng.normal(0, 0.003),
    )
    lean = Rotation.from_rotvec([0, *rng.normal(0, 1.0, 2)], degrees=True)
    head = RigidTransform.from_components([0.0, *rng.normal(0, 0.03, 2)], lean)
    rig = replace(
        rig,
        beam=replace(rig.beam, systematic=rng.normal(0, 0.006)),
        platform=platform,
        T_head_lrf=head * rig.T_head_lrf,
        cameras=tuple(cameras),
    )
    stations = []
    for yaw in rng.permutation([-25, -8, 8, 25]) + rng.uniform(-5, 5, 4):
        turn = Rotation.from_euler("ZYX", [yaw, *rng.normal(0, 0.7, 2)], degrees=True)
        place = rng.uniform([-0.6, -0.6, -0.04], [0.6, 0.3, 0.04])
        stations.append(RigidTransform.from_components(place, turn))
    return replace(setup, name="fresh", seed=seed, rig=rig, stations=tuple(stations))


def record(folder, seed):
    """A recording of a drawn room by a drawn rig at four stations, and its Setup."""
    rng = np.random.default_rng([seed, 28])
    setup = setup_of(seed, rng)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene, "ROOM", room_of(rng))
        patch.setattr(recording, "room_lengths", list)  # of the shipped room
        recording.simulate(folder, setup)
    return setup
