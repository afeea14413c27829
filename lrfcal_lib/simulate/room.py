"""A furnished room around the rig, and the board on its stand."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.simulate import shapes, textures
from lrfcal_lib.simulate.scene import Lights, Material, Thing, World

WIDTH, DEPTH, BEHIND, FLOOR, CEILING = 6.2, 5.3, 1.3, -1.1, 1.7  # metres about the rig
OAK, WHITE, STEEL = (0.52, 0.38, 0.24), (0.82, 0.81, 0.78), (0.55, 0.56, 0.58)


def at(x, y, z, *, turn=0.0, tip=0.0):
    """Pose of a thing: where its origin stands, turned about the vertical and then tipped about its own x, degrees."""
    return RigidTransform.from_components([x, y, z], Rotation.from_euler("ZX", [turn, tip], degrees=True))


def _thing(mesh, texture, pose=None, **material):
    vertices, faces = mesh
    return Thing(vertices, faces, Material(texture, **material), RigidTransform.identity() if pose is None else pose)


def _box(size, place, texture, turn=0.0, **material):
    """A box that stands on the height given."""
    x, y, z = place
    return _thing(shapes.box(size), texture, at(x, y, z + size[2] / 2, turn=turn), **material)


LAMPS = ((-0.7, -0.8, 1.25), (1.7, 3.0, 1.3))


def lights():
    """Two hanging lamps, one of them behind the rig, and the even light of window and walls."""
    return Lights(np.array(LAMPS), np.array([4.6, 3.4]), 0.42)


def _hanging_lamps():
    metal, glass = textures.plain((0.25, 0.27, 0.3)), textures.plain((0.95, 0.93, 0.85))
    things = []
    for x, y, z in LAMPS:
        things.append(_thing(shapes.lathe([0.2, 0.16, 0.05, 0], [0.03, 0.1, 0.16, 0.16]), metal, at(x, y, z)))
        things.append(_thing(shapes.cylinder(0.19, 0.01), glass, at(x, y, z + 0.03), glow=0.8))
        things.append(_thing(shapes.rod([x, y, z + 0.16], [x, y, CEILING], 0.006), metal))
    return things


def shell():
    """Floor, ceiling, and walls with a window, a door, skirting boards and posters."""
    w, y0, y1, height = WIDTH / 2, -BEHIND, DEPTH, CEILING - FLOOR
    middle, long = (y0 + y1) / 2, y1 - y0
    paint = textures.plain((0.74, 0.72, 0.66), 0.08, 0.6)
    side = textures.plain((0.62, 0.68, 0.70), 0.08, 0.6)
    things = [
        _thing(shapes.rectangle(WIDTH, long), textures.planks(OAK), at(0, middle, FLOOR)),
        _thing(shapes.rectangle(WIDTH, long), textures.plain((0.88,) * 3), at(0, middle, CEILING)),
        _thing(shapes.rectangle(WIDTH, height), paint, at(0, y1, FLOOR + height / 2, tip=90)),
        _thing(shapes.rectangle(WIDTH, height), paint, at(0, y0, FLOOR + height / 2, tip=90)),
        _thing(shapes.rectangle(long, height), side, at(-w, middle, FLOOR + height / 2, turn=90, tip=90)),
    ]
    for low, high in ((y0, 2.6), (3.9, y1)):  # the right wall leaves a window open
        things.append(_wall_part(side, w, low, high, FLOOR, CEILING))
    things += [_wall_part(side, w, 2.6, 3.9, FLOOR, -0.2), _wall_part(side, w, 2.6, 3.9, 1.3, CEILING)]
    things += [_box((0.05, 0.06, 1.5), (w, y, -0.2), textures.plain(WHITE)) for y in (2.62, 3.25, 3.88)]
    things += [_box((WIDTH, 0.015, 0.09), (0, y1 - 0.008, FLOOR), textures.plain(WHITE))]
    things += [_box((0.015, long, 0.09), (s * (w - 0.008), middle, FLOOR), textures.plain(WHITE)) for s in (-1, 1)]
    return things


def _wall_part(texture, x, y0, y1, z0, z1):
    return _thing(shapes.rectangle(y1 - y0, z1 - z0), texture, at(x, (y0 + y1) / 2, (z0 + z1) / 2, turn=90, tip=90))


def fittings():
    """What hangs on the walls: door, curtains, radiator, posters, a clock, a lamp that dazzles the LRF."""
    w, back = WIDTH / 2, DEPTH
    door = textures.plain((0.55, 0.36, 0.22), 0.1)
    cloth = textures.stripes((0.55, 0.16, 0.14), (0.62, 0.24, 0.18), 0.12)
    first = ((0.45, 0.62, 0.85), (0.95, 0.8, 0.3), (0.35, 0.45, 0.55), (0.15, 0.35, 0.15))
    second = ((0.9, 0.6, 0.4), (0.85, 0.25, 0.15), (0.5, 0.25, 0.4), (0.2, 0.12, 0.25))
    things = [
        _box((0.05, 0.95, 2.1), (-w + 0.02, 4.3, FLOOR), door),
        _thing(shapes.sphere(0.03), textures.plain(STEEL), at(-w + 0.08, 3.9, FLOOR + 1.05)),
        _thing(shapes.curtain(0.55, 1.9, 0.07, 5), cloth, at(w - 0.12, 2.45, -0.5, turn=90)),
        _thing(shapes.curtain(0.55, 1.9, 0.07, 5), cloth, at(w - 0.12, 4.05, -0.5, turn=90)),
        _thing(shapes.rectangle(0.9, 0.6), textures.poster(0.9, 0.6, first), at(-0.45, back - 0.02, 0.75, tip=90)),
        _thing(shapes.rectangle(0.5, 0.7), textures.poster(0.5, 0.7, second), at(0.75, back - 0.02, 0.8, tip=90)),
        _thing(shapes.cylinder(0.16, 0.04), textures.plain((0.85, 0.85, 0.8)), at(1.5, back, 1.15, tip=90)),
        _thing(shapes.rectangle(0.03, 0.11), textures.plain((0.05,) * 3), at(1.5, back - 0.05, 1.19, tip=90)),
        _thing(shapes.sphere(0.07), textures.plain((0.95, 0.9, 0.75)), at(2.62, 4.9, 0.62), dazzles=True, glow=1.2),
    ]
    fins = [
        _box((0.05, 0.03, 0.55), (w - 0.1, y, FLOOR + 0.1), textures.plain(WHITE)) for y in np.arange(2.7, 3.8, 0.06)
    ]
    return [*things, *fins, *_hanging_lamps()]


def furniture():
    """Bookshelf, desk with a screen, chair, plant, bin, column, ball: flat, curved and thin things."""
    return [*_bookshelf(-2.0), *_desk(0.75), *_chair(0.55, 4.05, turn=200), *_plant(-0.75, 4.75), *_standing_lamp(),
            *_small_things()]  # fmt: skip


def _bookshelf(x, y=DEPTH - 0.17, width=1.1, height=1.95):
    board = textures.wood((0.48, 0.33, 0.2))
    things = [_box((0.025, 0.3, height), (x + s * width / 2, y, FLOOR), board) for s in (-1, 1)]
    things.append(_box((width, 0.01, height), (x, y + 0.15, FLOOR), board))
    rng = np.random.default_rng(5)
    for shelf in range(6):
        z = FLOOR + 0.05 + shelf * 0.38
        things.append(_box((width, 0.3, 0.022), (x, y, z), board))
        place = x - width / 2 + 0.03
        while shelf < 5 and place < x + width / 2 - 0.22:
            size = rng.uniform((0.12, 0.14, 0.2), (0.3, 0.22, 0.31))
            where = (place + size[0] / 2, y - 0.13 + size[1] / 2 + rng.uniform(0, 0.06), z + 0.022)
            things.append(_box(size, where, textures.book_spines(int(rng.integers(1000)))))
            place += size[0] + rng.choice([0.004, 0.06])
    return things


def _desk(x, y=4.75):
    top, z = textures.wood((0.62, 0.5, 0.36)), FLOOR + 0.72
    legs = [
        _box((0.05, 0.05, 0.72), (x + a, y + b, FLOOR), textures.plain(STEEL)) for a in (-0.7, 0.7) for b in (-0.3, 0.3)
    ]
    screen = _box((0.62, 0.03, 0.37), (x + 0.25, y + 0.05, z + 0.16), textures.plain((0.03, 0.03, 0.04)), infrared=0.0)
    foot = _thing(shapes.cylinder(0.012, 0.2), textures.plain(STEEL), at(x + 0.25, y + 0.1, z + 0.03))
    plate = _thing(shapes.cylinder(0.11, 0.015), textures.plain(STEEL), at(x + 0.25, y + 0.1, z + 0.03))
    keys = textures.stripes((0.12,) * 3, (0.2,) * 3, 0.018)
    return [
        _box((1.5, 0.7, 0.03), (x, y, z), top), *legs, screen, foot, plate,
        _box((0.42, 0.14, 0.02), (x + 0.25, y - 0.22, z + 0.03), keys),
        _thing(shapes.cylinder(0.04, 0.095), textures.plain((0.75, 0.2, 0.15)), at(x - 0.3, y - 0.15, z + 0.03)),
        _box((0.21, 0.3, 0.05), (x - 0.52, y, z + 0.03), textures.plain((0.85,) * 3), turn=12),
    ]  # fmt: skip


def _chair(x, y, turn=0.0):
    seat, frame = textures.plain((0.2, 0.3, 0.42), 0.3, 0.02), textures.plain((0.2,) * 3)
    place = at(x, y, FLOOR, turn=turn)
    parts = [
        (shapes.box((0.44, 0.44, 0.05)), (0, 0, 0.46), seat),
        (shapes.box((0.42, 0.04, 0.34)), (0, 0.21, 0.78), seat),
    ]
    parts += [(shapes.cylinder(0.016, 0.45, 12), (a, b, 0), frame) for a in (-0.19, 0.19) for b in (-0.19, 0.19)]
    parts += [(shapes.cylinder(0.014, 0.3, 12), (a, 0.21, 0.46), frame) for a in (-0.15, 0.15)]
    return [_thing(mesh, texture, place * RigidTransform.from_translation(shift)) for mesh, shift, texture in parts]


def _plant(x, y):
    pot = _thing(shapes.cylinder(0.13, 0.28, top=0.17), textures.plain((0.6, 0.3, 0.18), 0.2), at(x, y, FLOOR))
    rng, things = np.random.default_rng(11), [pot]
    for turn in np.linspace(0, 2 * np.pi, 11, endpoint=False):
        out = rng.uniform(0.12, 0.34)
        tip = np.array([x + out * np.cos(turn), y + out * np.sin(turn), FLOOR + rng.uniform(0.7, 1.35)])
        root = np.array([x + 0.05 * np.cos(turn), y + 0.05 * np.sin(turn), FLOOR + 0.25])
        things.append(_thing(shapes.rod(root, tip, 0.005, 6), textures.plain((0.2, 0.32, 0.1))))
        leaf = shapes.polygon([[0, 0], [0.05, 0.07], [0.04, 0.18], [0, 0.26], [-0.04, 0.18], [-0.05, 0.07]])
        hang = Rotation.from_euler("ZX", [np.degrees(turn) - 90, rng.uniform(10, 70)], degrees=True)
        pose = RigidTransform.from_components(tip, hang)
        things.append(_thing(leaf, textures.plain((0.16, 0.38, 0.12), 0.4, 0.02), pose))
    return things


def _standing_lamp(x=2.3, y=4.7):
    grey = textures.plain((0.3, 0.3, 0.32))
    shade = shapes.lathe([0.22, 0.14], [0, 0.3])
    return [
        _thing(shapes.cylinder(0.15, 0.02), grey, at(x, y, FLOOR)),
        _thing(shapes.cylinder(0.012, 1.55, 12), grey, at(x, y, FLOOR)),
        _thing(shade, textures.plain((0.85, 0.76, 0.6)), at(x, y, FLOOR + 1.5), glow=0.5),
    ]


def _small_things():
    return [
        _thing(
            shapes.cylinder(0.19, CEILING - FLOOR),
            textures.tiles((0.5, 0.52, 0.5), (0.75,) * 3, 0.2),
            at(-2.75, 3.5, FLOOR),
        ),
        _thing(shapes.cylinder(0.12, 0.32, top=0.15), textures.plain((0.25, 0.27, 0.3)), at(1.75, 4.5, FLOOR)),
        _thing(
            shapes.sphere(0.16),
            textures.stripes((0.8, 0.35, 0.1), (0.85, 0.8, 0.7), 0.14, 2),
            at(-0.1, 4.2, FLOOR + 0.16),
        ),
        _box((0.5, 0.4, 0.35), (2.35, 3.6, FLOOR), textures.plain((0.6, 0.47, 0.32), 0.1), turn=20),
        _box((0.35, 0.3, 0.25), (2.32, 3.62, FLOOR + 0.35), textures.plain((0.64, 0.5, 0.35), 0.1), turn=-8),
    ]


def still_life():
    """A table near the rig with printed paper, books, a mug, a globe and a bottle, and a chair beside it."""
    x, y, z = 0.15, 2.05, FLOOR + 0.74
    wood, white = textures.wood((0.58, 0.44, 0.3), (0.6, 0.04, 0.04)), textures.plain((0.83,) * 3)
    legs = [_box((0.06, 0.06, 0.71), (x + a, y + b, FLOOR), wood) for a in (-0.55, 0.55) for b in (-0.35, 0.35)]
    pages = [(-0.32, -0.12, 14), (-0.02, -0.2, -9), (0.12, 0.12, 33)]
    paper = [
        _thing(
            shapes.rectangle(0.21, 0.297),
            textures.printed_page(0.21, 0.297),
            at(x + a, y + b, z + 0.002 * (i + 1), turn=t),
        )
        for i, (a, b, t) in enumerate(pages)
    ]
    easel = _thing(
        shapes.rectangle(0.297, 0.42),
        textures.printed_page(0.297, 0.42),
        at(x - 0.2, y + 0.3, z + 0.21, turn=8, tip=74),
    )
    rest = _thing(shapes.rod([x - 0.2, y + 0.33, z + 0.36], [x - 0.22, y + 0.36, z], 0.008), white)
    books = [
        _box((0.24, 0.17, 0.035), (x + 0.38, y + 0.02, z + 0.035 * i), textures.plain(c), turn=t)
        for i, (c, t) in enumerate([((0.5, 0.12, 0.1), 5), ((0.1, 0.25, 0.45), -6), ((0.7, 0.6, 0.2), 14)])
    ]
    globe = _thing(shapes.sphere(0.11), textures.plain((0.25, 0.42, 0.6), 0.9, 0.07), at(x + 0.36, y + 0.28, z + 0.17))
    stand = _thing(shapes.cylinder(0.07, 0.06, top=0.02), textures.plain(OAK), at(x + 0.36, y + 0.28, z))
    mug = _thing(shapes.cylinder(0.042, 0.1), textures.plain((0.75, 0.2, 0.15)), at(x - 0.48, y + 0.1, z))
    bottle = _thing(shapes.lathe([0, 0.036, 0.036, 0.014, 0.014, 0], [0, 0, 0.17, 0.23, 0.28, 0.28]),
                    textures.plain((0.12, 0.35, 0.2)), at(x + 0.1, y + 0.3, z))  # fmt: skip
    top = _box((1.25, 0.85, 0.03), (x, y, z - 0.03), wood)
    return [top, *legs, *paper, easel, rest, *books, globe, stand, mug, bottle, *_chair(-1.15, 2.3, turn=65)]


def board_on_stand(board, T_platform_board, dark=0.07, light=0.75, ring=0.5):
    """The board, held from behind by a rod and a tripod.

    Parameters
    ----------
    board : Board
    T_platform_board : RigidTransform
    dark, light : float
        Albedo of the dark and the light squares, also at the LRF's wavelength.
    ring : float
        See :func:`lrfcal_lib.simulate.textures.chessboard`.

    Returns
    -------
    list of Thing
        The board is a sheet of no thickness, so that its edges are exactly its outline. Its post stands 35 cm
        behind it.
    """
    front = textures.chessboard(board, dark, light, ring)
    middle = T_platform_board.apply([*np.mean(board.corners, axis=0), -0.004])
    behind = T_platform_board.apply([*np.mean(board.corners, axis=0), -0.07])
    away = T_platform_board.rotation.apply([0.0, 0.0, -1.0]) * [1, 1, 0]
    head = behind + 0.3 * away / np.linalg.norm(away) + np.array([0.0, 0.0, -0.02])  # a tilted board stays clear of it
    knee = np.array([head[0], head[1], min(head[2] - 0.3, FLOOR + 0.75)])
    steel = textures.plain((0.4, 0.41, 0.43))
    rods = [(middle, behind, 0.006), (behind, head, 0.008), (head, knee, 0.011)]
    for turn in np.radians([80, 200, 320]):
        foot = [head[0] + 0.38 * np.cos(turn), head[1] + 0.38 * np.sin(turn), FLOOR]
        rods.append((knee, foot, 0.010))
    sheet = _thing(shapes.polygon(board.corners), front, T_platform_board)
    return [sheet, *(_thing(shapes.rod(*rod), steel) for rod in rods)]


def furnished_room(*more):
    """The room with further things in it, a World."""
    return World([*shell(), *fittings(), *furniture(), *more], lights())
