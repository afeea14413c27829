"""Furnished rooms of other sizes with other things in other places, and the stations in them: fresh scenes to measure in."""

import copy
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.simulate.record import simulate
from lrfcal_lib.simulate.rig import load_setup
from lrfcal_lib.simulate.scene import FLOOR, ROOM

WHOLE = {
    "cylinder": [2],
    "rod": [3],
    "curtain": [3],
}  # settings of a shape that count something
SHEETS = ("poster", "printed_page")  # textures that are as large as their sheet
TABLE = slice(0, 17)  # of the still life: the table and what is on it
SEAT = slice(17, 25)


def scaled(value, scale):
    """A size or a list of sizes in another scale."""
    if isinstance(value, list):
        return [scaled(each, scale) for each in value]
    return value * scale


def sized(row, scale):
    """A row of room.json in another scale, about the floor below the rig."""
    shape, *sizes = row["shape"]
    middle = np.array([0.0, 0.0, FLOOR])
    kept = WHOLE.get(shape, [])
    sizes = [s if i in kept else scaled(s, scale) for i, s in enumerate(sizes)]
    if shape == "rod":
        sizes[:2] = [
            (middle + scale * (np.array(end) - middle)).tolist() for end in sizes[:2]
        ]
    texture = list(row["texture"])
    if texture[0] in SHEETS:
        texture[1:3] = scaled(texture[1:3], scale)
    at = middle + scale * (np.array(row.get("at", [0.0, 0.0, 0.0])) - middle)
    if "at" not in row:
        at = np.zeros(3)
    return row | {"shape": [shape, *sizes], "texture": texture, "at": at.tolist()}


def turned(rows, middle, angle, shift):
    """Rows of room.json turned about a vertical (degrees) and shifted."""
    turn = Rotation.from_euler("z", angle, degrees=True)

    def moved(place):
        return (turn.apply(np.array(place) - middle) + middle + shift).tolist()

    for row in rows:
        if row["shape"][0] == "rod":
            row["shape"][1:3] = [moved(end) for end in row["shape"][1:3]]
        else:
            row["at"] = moved(row["at"])
            row["turn"] = row.get("turn", 0.0) + angle


def draw_room(rng):
    """What room.json may say: another scale, the table, the chair, the door and the pictures elsewhere."""
    scale = rng.uniform(0.88, 1.12)
    room = {"parts": ROOM["parts"], "lights": copy.deepcopy(ROOM["lights"])}
    for part in ROOM.keys() - room.keys():
        room[part] = [sized(copy.deepcopy(row), scale) for row in ROOM[part]]
    room["lights"]["positions"] = [
        [scale * x, scale * y, FLOOR + scale * (z - FLOOR)]
        for x, y, z in room["lights"]["positions"]
    ]
    life = room["still life"]
    for rows, most in ((life[TABLE], 12), (life[SEAT], 25)):
        middle = np.array(rows[0]["at"]) * [1, 1, 0]
        shift = [*rng.uniform(-0.12, 0.12, 2), 0.0]
        turned(rows, middle, rng.uniform(-most, most), np.array(shift))
    fittings = room["fittings"]
    door = rng.uniform(-0.15, 0.15)
    for row in fittings[:2]:
        row["at"][1] += door
    for row in fittings[4:6]:
        row["at"][0] += rng.uniform(-0.1, 0.1)
        row["at"][2] += rng.uniform(-0.1, 0.1)
    return {part: room[part] for part in ROOM}


def stations(rng, count=4):
    """``T_room_platform`` of stations, each 0.5 to 1.2 m and 12 to 40 deg from one before."""
    places = [np.zeros(2)]
    yaws = [rng.uniform(-10, 10)]
    while len(places) < count:
        k = rng.integers(len(places))
        angle = rng.uniform(0, 2 * np.pi)
        place = places[k] + rng.uniform(0.5, 1.2) * np.array([np.cos(angle), np.sin(angle)])
        yaw = yaws[k] + rng.choice([-1, 1]) * rng.uniform(12, 40)
        apart = min(np.linalg.norm(place - other) for other in places)
        if apart > 0.4 and abs(place[0]) < 0.8 and -0.8 < place[1] < 0.5 and abs(yaw) < 40:
            places.append(place)
            yaws.append(yaw)
    for place, yaw in zip(places, yaws, strict=True):
        turn = Rotation.from_euler("ZYX", [yaw, *rng.normal(0, 0.7, 2)], degrees=True)
        yield RigidTransform.from_components([*place, rng.normal(0, 0.03)], turn)


@contextmanager
def furnished_with(room):
    """The simulator's room is another one."""
    shipped = dict(ROOM)
    ROOM.update(room)
    try:
        yield
    finally:
        ROOM.update(shipped)


def simulate_room(folder, seed):
    """Simulate four stations of a drawn room, as data/room_lms221 is made."""
    rng = np.random.default_rng(seed)
    room = draw_room(rng)
    setup = replace(load_setup("room_lms221"), seed=seed, stations=tuple(stations(rng)))
    with furnished_with(room):
        simulate(folder, setup)
