"""A world that rays can be cast into, and pictures of it.

Things with textures stand in a furnished room (``room.json``).

A row of ``room.json`` is a shape and a texture with their settings (functions of this module), the
pose of the thing (``at``, metres; turned about the vertical, then tipped about its own x, degrees)
and more settings of :class:`Thing`. Its numbers are kept to the last bit: the shipped sessions are
rebuilt from them to the byte.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import open3d as o3d
import pydantic
from numpy.typing import ArrayLike
from pydantic import Field, NonNegativeFloat, PositiveInt
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.camera import CameraModel, project, undistort
from lrfcal_lib.model.geometry import plane_axes, unit_vector
from lrfcal_lib.simulate import textures
from lrfcal_lib.simulate.textures import chessboard, plain

FLOOR = -1.1  # metres, below the platform
SKY = (0.95, 0.98, 1.0)  # light from where there is nothing
FLAT = 0.03  # difference of light over a block of pixels below which its four corners tell the rest
BLOCK = 2  # pixels
Mesh = tuple[np.ndarray, np.ndarray]  # vertices (n, 3), metres, and faces (m, 3)
BATCH = 1 << 19  # rays that are cast at once
ROOM = json.loads(Path(__file__).with_name("room.json").read_text())


def need(good: object, words: str) -> None:
    """A ValueError in these words, unless a setting is good.

    Parameters
    ----------
    good
    words
    """
    if not good:
        raise ValueError(words)


def polygon(corners: ArrayLike) -> Mesh:
    """A flat convex sheet of no thickness in the plane z = 0.

    Parameters
    ----------
    corners
        Shape (n, 2), metres.
    """
    corners = np.asarray(corners, float)
    fan = np.arange(1, len(corners) - 1)
    faces = np.stack([0 * fan, fan, fan + 1], axis=1)
    return np.insert(corners, 2, 0.0, axis=1), faces


def rectangle(width: float, height: float) -> Mesh:
    """A sheet about the origin in the plane z = 0.

    Parameters
    ----------
    width, height
        Along x and y, metres.
    """
    w = width / 2
    h = height / 2
    return polygon([[-w, -h], [w, -h], [w, h], [-w, h]])


def grid_surface(points):
    """A sheet through a grid of points, shape (rows, columns, 3)."""
    rows, columns = points.shape[:2]
    number = np.arange(rows * columns).reshape(rows, columns)
    first = number[:-1, :-1].ravel()
    low = np.stack([first, first + 1, first + columns], axis=1)
    high = np.stack([first + 1, first + columns + 1, first + columns], axis=1)
    return points.reshape(-1, 3), np.concatenate([low, high])


def box(size):
    """A box about the origin with edges along the axes."""
    corners = np.array(list(np.ndindex(2, 2, 2)), float)[:, ::-1]  # x changes fastest
    quads = np.array(
        [
            [0, 2, 3, 1],
            [4, 5, 7, 6],
            [0, 1, 5, 4],
            [2, 6, 7, 3],
            [0, 4, 6, 2],
            [1, 3, 7, 5],
        ]
    )
    faces = np.stack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]], axis=1)
    return (2 * corners - 1) * np.asarray(size, float) / 2, faces.reshape(-1, 3)


def lathe(radius, height, sides=48):
    """A body of revolution about z: its outline from below to above.

    A radius of zero closes an end.
    """
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    radius = np.asarray(radius, float)[:, None]
    height = np.asarray(height, float)[:, None]
    x = radius * np.cos(turn)
    y = radius * np.sin(turn)
    return grid_surface(np.stack([x, y, height + 0 * turn], axis=-1))


def cylinder(radius, height, sides=48, top=None):
    """A closed cylinder about z from z = 0 upwards; `top` is the upper radius of a cone."""
    return lathe(
        [0, radius, radius if top is None else top, 0], [0, 0, height, height], sides
    )


def sphere(radius):
    """A ball about the origin."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, 24)
    return lathe(radius * np.cos(turn), radius * np.sin(turn))


def rod(start, end, radius, sides=12):
    """A thin round bar between two points."""
    start = np.asarray(start, float)
    end = np.asarray(end, float)
    length = np.linalg.norm(end - start)
    z = (end - start) / length
    y, x = plane_axes(z)
    vertices, faces = cylinder(radius, length, sides)
    return start + vertices @ np.stack([x, -y, z]), faces


def curtain(width, height, depth, folds):
    """A hanging cloth in the plane y = 0, sine-shaped along x, `depth` from trough to crest."""
    s = np.linspace(-0.5, 0.5, 24 * folds)
    z = np.linspace(0.0, height, 5)[:, None]
    swing = 0.7 + 0.3 * z / height  # less at the top
    wave = depth / 2 * np.sin(2 * np.pi * folds * s) * swing
    return grid_surface(np.stack(np.broadcast_arrays(width * s, wave, z), axis=-1))


SHAPES = {
    f.__name__: f for f in (polygon, rectangle, box, lathe, cylinder, sphere, rod, curtain)
}


@dataclass(frozen=True)
class Thing:
    """A mesh with what its surface does with light."""

    mesh: Mesh  # in the thing's own frame
    # function of points (n, 3) in the thing's frame and settings to albedo (n, 3), then the
    # settings
    texture: tuple
    pose: RigidTransform = RigidTransform.identity()  # T_platform_thing
    # diffuse reflectivity at the LRF's wavelength (905 nm); None takes the red albedo
    infrared: float | None = None
    # the LRF is dazzled when its spot meets it (a lamp, the sun in a window)
    dazzles: bool = False
    glow: float = 0.0  # light it gives off by itself, in units of full albedo


@dataclass(frozen=True)
class Lights:
    """Point lights and the same light from everywhere.

    Strengths (k,) are irradiances at 1 m and normal incidence, in units of full white.
    """

    positions: np.ndarray
    strengths: np.ndarray
    ambient: float


@dataclass(frozen=True)
class Hits:
    """Where rays end, metres (inf: nowhere), and numbers of the triangle and thing (-1: none)."""

    distance: np.ndarray
    face: np.ndarray
    thing: np.ndarray


class World:
    """Things in the platform frame, ready for ray casting; only images need lights.

    Open3D (Embree, single precision) decides which triangle a ray meets; the distance is then
    computed in double precision from the triangle's plane.
    """

    def __init__(self, things, lights=None):
        need(things, "a world needs at least one thing to see, got none")
        self.things = tuple(things)
        self.lights = lights
        # by the number of a thing, the last: nothing
        self.dazzling = np.array([t.dazzles for t in things] + [False])
        vertices = [thing.pose.apply(thing.mesh[0]) for thing in self.things]
        starts = np.cumsum([0] + [len(v) for v in vertices[:-1]])
        meshes = [thing.mesh[1] for thing in self.things]
        faces = np.concatenate([mesh + s for mesh, s in zip(meshes, starts, strict=True)])
        vertices = np.concatenate(vertices)
        corners = vertices[faces]
        first, second, third = np.moveaxis(corners, 1, 0)
        normals = np.cross(second - first, third - first)
        size = np.linalg.norm(normals, axis=1)
        whole = size > 1e-12  # the poles of a lathe make empty triangles
        self.normals = normals[whole] / size[whole, None]
        self.offsets = np.sum(self.normals * corners[whole, 0], axis=1)
        numbers = np.arange(len(self.things))
        self.thing_of = np.repeat(numbers, [len(mesh) for mesh in meshes])[whole]
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            vertices.astype(np.float32), faces[whole].astype(np.uint32)
        )

    def seen_from(self, T_world_platform: RigidTransform) -> "World":
        """The same world in the frame of a platform that stands elsewhere."""
        back = T_world_platform.inv()
        things = [replace(thing, pose=back * thing.pose) for thing in self.things]
        lights = self.lights
        if lights is not None:
            lights = replace(lights, positions=back.apply(lights.positions))
        return World(things, lights)

    def cast(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """Follow rays to the first surface.

        Parameters
        ----------
        origins, directions
            Metres and unit vectors in the platform frame, shape (n, 3).
        """
        origins = np.asarray(origins, float)
        directions = np.asarray(directions, float)
        origins, directions = np.broadcast_arrays(origins, directions)
        rays = np.concatenate([origins, directions], axis=1, dtype=np.float32)
        ids = self._scene.cast_rays(o3d.core.Tensor(rays))["primitive_ids"].numpy()
        seen = ids != o3d.t.geometry.RaycastingScene.INVALID_ID
        face = np.where(seen, ids.astype(np.int64), -1)
        distance = np.full(len(face), np.inf)
        normal = self.normals[face[seen]]
        height = self.offsets[face[seen]] - np.einsum("ni,ni->n", normal, origins[seen])
        distance[seen] = height / np.einsum("ni,ni->n", normal, directions[seen])
        return Hits(distance, face, np.where(seen, self.thing_of[face], -1))

    def albedo(self, points: np.ndarray, thing: np.ndarray) -> np.ndarray:
        """Albedo (n, 3) of points (n, 3) on things of these numbers (n,)."""
        out = np.zeros((len(points), 3))
        for number in np.unique(thing):
            rows = thing == number
            item = self.things[number]
            texture, *settings = item.texture
            out[rows] = texture(item.pose.inv().apply(points[rows]), *settings)
        return out

    def infrared(self, points: np.ndarray, thing: np.ndarray) -> np.ndarray:
        """Reflectivity of surface points for the LRF.

        Parameters
        ----------
        points
            In the platform frame, metres, shape (n, 3).
        thing
            Numbers of the things that they are on, shape (n,).

        Returns
        -------
        ndarray, shape (n,)
        """
        stated = np.array([t.infrared for t in self.things], float)  # NaN for None
        out = stated[thing]
        ask = np.isnan(out)
        out[ask] = self.albedo(points[ask], thing[ask])[:, 0]
        return out

    def radiance(
        self, origins: np.ndarray, directions: np.ndarray, hits: Hits
    ) -> np.ndarray:
        """Light that comes back along rays, linear.

        Lambert's law for every point light, each casting hard shadows, over an even background
        light. What is seen through an opening of the room is bright sky.

        Parameters
        ----------
        origins, directions
            Metres and unit vectors in the platform frame, shape (n, 3).
        hits
            Of these rays.

        Returns
        -------
        ndarray, shape (n, 3)
        """
        seen = hits.face >= 0
        points = origins[seen] + hits.distance[seen, None] * directions[seen]
        thing = hits.thing[seen]
        normal = self.normals[hits.face[seen]]
        normal *= -np.sign(np.einsum("ni,ni->n", normal, directions[seen]))[:, None]
        light = np.full(len(points), self.lights.ambient)
        lamps = zip(self.lights.positions, self.lights.strengths, strict=True)
        for position, strength in lamps:
            way = position - points
            squared = np.einsum("ni,ni->n", way, way)
            share = np.einsum("ni,ni->n", normal, way) / (squared * np.sqrt(squared))
            ask = share > 1e-3
            # 2 mm off, so that no surface shades itself
            off = points[ask] + 2e-3 * normal[ask]
            rays = np.concatenate([off, 0.999 * way[ask]], axis=1, dtype=np.float32)
            dark = self._scene.test_occlusions(o3d.core.Tensor(rays), 0.0, 1.0).numpy()
            light[ask] += strength * (share[ask] * ~dark)
        out = np.tile(SKY, (len(seen), 1))
        glow = np.array([t.glow for t in self.things])[thing]
        out[seen] = self.albedo(points, thing) * (light + glow)[:, None]
        return out


def furnished(*parts: str) -> list[Thing]:
    """Things of parts of ``room.json``."""
    return [_thing(**row) for part in parts for row in ROOM[part]]


def _thing(shape, texture, at=(0.0, 0.0, 0.0), turn=0.0, tip=0.0, **settings):
    """The thing of a row."""
    mesh = SHAPES[shape[0]](*shape[1:])
    pattern = (getattr(textures, texture[0]), *texture[1:])
    turned = Rotation.from_euler("ZX", [turn, tip], degrees=True)
    return Thing(mesh, pattern, RigidTransform.from_components(at, turned), **settings)


def furnished_room(*more: Thing) -> World:
    """The room around the rig with further things in it, under two lamps."""
    lamps = ROOM["lights"]
    lights = Lights(np.array(lamps["positions"]), lamps["strengths"], lamps["ambient"])
    return World([*furnished(*ROOM["parts"]), *more], lights)


def board_on_stand(board, T_platform_board, ring):
    """The board, a sheet of no thickness whose edges are its outline, and a tripod behind it."""
    centre = np.mean(board.corners, axis=0)
    middle = T_platform_board.apply([*centre, -0.004])
    behind = T_platform_board.apply([*centre, -0.07])
    away = T_platform_board.rotation.apply([0.0, 0.0, -1.0]) * [1, 1, 0]
    # a tilted board stays clear of it
    head = behind + 0.3 * unit_vector(away) + np.array([0.0, 0.0, -0.02])
    knee = np.array([*head[:2], min(head[2] - 0.3, FLOOR + 0.75)])
    rods = [(middle, behind, 0.006), (behind, head, 0.008), (head, knee, 0.011)]
    for turn in np.radians([80, 200, 320]):
        foot = [head[0] + 0.38 * np.cos(turn), head[1] + 0.38 * np.sin(turn), FLOOR]
        rods.append((knee, foot, 0.010))
    sheet = Thing(
        polygon(board.corners), (chessboard, board, 0.07, 0.75, ring), T_platform_board
    )
    return [sheet, *(Thing(rod(*each), (plain, (0.4, 0.41, 0.43))) for each in rods)]


@pydantic.dataclasses.dataclass(frozen=True)
class Exposure:
    """How a camera turns light into numbers."""

    # least and greatest grey level of full white (albedo 1 at irradiance 1). The response is
    # linear, as machine vision
    # cameras have it; automatic exposure puts the brightest 0.2 % of the image at bright within
    # these limits.
    gain: tuple[Annotated[float, Field(gt=0)], float] = (70.0, 300.0)
    bright: NonNegativeFloat = 235.0  # grey level
    # standard deviation of the point spread of lens and sensor together, pixels
    blur_px: NonNegativeFloat = 0.7
    # variance in grey levels squared is read_noise^2 + shot_noise * level
    read_noise: NonNegativeFloat = 0.8
    shot_noise: NonNegativeFloat = 0.008
    # loss of light in the corners of the image, a share
    vignetting: NonNegativeFloat = 0.15
    # rays across a pixel and down a pixel, where the pixel is not plain
    samples: PositiveInt = 3


class Imager:
    """A camera with the viewing ray of every corner of every pixel.

    Raises ValueError if the lens folds the image (two viewing rays would fall on one pixel), or for
    an odd size.
    """

    def __init__(self, model: CameraModel, exposure: Exposure | None = None):
        size = f"{model.width} x {model.height} pixels"
        whole = not (model.width % BLOCK or model.height % BLOCK)
        need(whole, f"the image is {size}, both must be multiples of {BLOCK}")
        self.model = model
        self.exposure = exposure or Exposure()
        v, u = np.mgrid[: model.height + 1, : model.width + 1] - 0.5
        corners = np.stack([u, v], axis=-1)
        rays = model.sights(undistort(corners, model))
        self.grid = rays[..., :2]
        miss = np.abs(project(rays, model) - corners).max()
        need(miss < 1e-3, f"lens {model.distortion} folds the image: weaken the distortion")

    def render(
        self, world: World, T_camera_platform: RigidTransform, rng: np.random.Generator
    ) -> np.ndarray:
        """Take a picture.

        Parameters
        ----------
        world
            With lights.
        T_camera_platform
        rng
            Places the rays in the pixels and makes the noise.

        Returns
        -------
        ndarray of uint8, shape (height, width, 3)
            Blue, green, red.
        """
        e = self.exposure
        m = self.model
        light = self.light(world, T_camera_platform, rng)
        light = gaussian_filter(
            light, (e.blur_px, e.blur_px, 0), mode="nearest", truncate=5.0
        )
        v, u = np.mgrid[: m.height, : m.width]
        squared = (u - m.cx) ** 2 + (v - m.cy) ** 2
        radius = squared / (m.width**2 + m.height**2) * 4
        brightest = max(np.quantile(light, 0.998), 1e-6)
        gain = np.clip(e.bright / brightest, *e.gain)
        level = light * (gain * (1 - e.vignetting * radius))[..., None]
        sigma = np.sqrt(e.read_noise**2 + e.shot_noise * level)
        noisy = level + sigma * rng.standard_normal(level.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)[..., ::-1]

    def light(self, world, T_camera_platform, rng):
        """Light on every pixel, linear, shape (height, width, 3), before lens blur and sensor.

        The corners of blocks of pixels are cast first. Blocks over which neither the light nor the
        thing changes are interpolated; every pixel of the others gets `samples` x `samples` rays,
        one at a random place in each cell.
        """
        g = self.grid
        n = self.exposure.samples
        color, thing = self._trace(world, T_camera_platform, g[::BLOCK, ::BLOCK])
        four = _corners(color)
        things = _corners(thing)
        changes = np.ptp(four, axis=0).max(axis=-1) > FLAT
        changes |= np.ptp(things, axis=0) > 0
        f = (np.arange(BLOCK) + 0.5) / BLOCK
        out = np.zeros((four.shape[1], BLOCK, four.shape[2], BLOCK, 3))
        shares = ((1 - f, 1 - f), (1 - f, f), (f, 1 - f), (f, f))
        for corner, (down, across) in zip(four, shares, strict=True):
            rows = corner[:, None, :, None] * down[:, None, None, None]
            out += rows * across[:, None]
        out = out.reshape(self.model.height, self.model.width, 3)
        rows, columns = np.nonzero(np.kron(changes, np.ones((BLOCK, BLOCK), bool)))
        cells = np.array(list(np.ndindex(n, n)))
        batches = 1 + len(rows) * n * n // BATCH
        for part in np.array_split(np.arange(len(rows)), batches):
            f = (cells + rng.random((len(part), n * n, 2))) / n
            row = rows[part, None]
            column = columns[part, None]
            down = f[..., :1]
            across = f[..., 1:]
            top = g[row, column] * (1 - across) + g[row, column + 1] * across
            low = g[row + 1, column] * (1 - across) + g[row + 1, column + 1] * across
            color, _ = self._trace(world, T_camera_platform, top * (1 - down) + low * down)
            out[rows[part], columns[part]] = color.mean(axis=1)
        return out

    def _trace(self, world, T_camera_platform, rays):
        """Light and thing along viewing rays (..., 2)."""
        back = T_camera_platform.inv()
        flat = rays.reshape(-1, 2)
        directions = unit_vector(np.insert(flat, 2, 1.0, axis=1))
        directions = directions @ back.rotation.as_matrix().T
        origins = np.broadcast_to(back.translation, directions.shape)
        hits = world.cast(origins, directions)
        light = world.radiance(origins, directions, hits)
        shape = rays.shape[:-1]
        return light.reshape(*shape, 3), hits.thing.reshape(shape)


def _corners(grid):
    """The four corners of every block of a grid of block corners, shape (4, rows, columns, ...)."""
    above = [grid[:-1, :-1], grid[:-1, 1:]]
    below = [grid[1:, :-1], grid[1:, 1:]]
    return np.stack(above + below)
