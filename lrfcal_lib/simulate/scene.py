"""A world that rays can be cast into, and pictures of it.

Things with textures stand in a furnished room (``room.json``).

A row of ``room.json`` is a shape and a texture with their settings (functions of
:mod:`lrfcal_lib.simulate.shapes` and :mod:`lrfcal_lib.simulate.textures`), the
pose of the thing (``at``, metres; turned about the vertical, then tipped about its own x, degrees)
and more settings of :class:`Thing`. Its numbers are kept to the last bit: the shipped sessions are
rebuilt from them to the byte.
"""

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import open3d as o3d
import pydantic
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.camera import CameraModel, project, undistort
from lrfcal_lib.model.geometry import (
    length_of,
    polar_to_points,
    unit_vector,
)
from lrfcal_lib.simulate import shapes, textures
from lrfcal_lib.simulate.shapes import polygon, rod
from lrfcal_lib.simulate.textures import chessboard, plain

FLOOR = -1.1  # metres, below the platform
SKY = (0.95, 0.98, 1.0)  # light from where there is nothing
FLAT = 0.03  # difference of light over a block of pixels below which its four corners tell the rest
BLOCK = 2  # pixels
RING = 0.65  # width of the outermost squares of a board's pattern as a share of a square
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


@dataclass(frozen=True)
class Thing:
    """A mesh with what its surface does with light."""

    mesh: np.ndarray  # corners of triangles (m, 3, 3) in the thing's own frame, metres
    # function of points (n, 3) in the thing's frame and settings to albedo (n, 3), or what is
    # broadcast to that; then the settings
    texture: tuple
    pose: RigidTransform = RigidTransform.identity()  # T_platform_thing
    # diffuse reflectivity at the LRF's wavelength (905 nm); NaN takes the red albedo
    infrared: float = np.nan
    # the LRF is dazzled when its spot meets it (a lamp, the sun in a window)
    dazzles: bool = False
    glow: float = 0.0  # light it gives off by itself, in units of full albedo


@dataclass(frozen=True)
class Lights:
    """Point lights and the same light from everywhere.

    Positions (k, 3) are in metres; strengths (k,) are irradiances at 1 m and normal incidence, in
    units of full white.
    """

    positions: ArrayLike
    strengths: ArrayLike
    ambient: float


@dataclass(frozen=True)
class Hits:
    """Where rays end, and what is there."""

    distance: np.ndarray  # metres, inf: nowhere
    points: np.ndarray  # (..., 3), metres; their origin for those that end nowhere
    thing: np.ndarray  # its number, -1: none
    normal: np.ndarray  # (..., 3), of its surface, on the side that the ray comes from
    cosine: np.ndarray  # of the angle between the two


class World:
    """Things in the platform frame, ready for ray casting; only images need lights.

    Open3D (Embree, single precision) decides which triangle a ray meets; the distance is then
    computed in double precision from the triangle's plane.
    """

    def __init__(self, things, lights=None):
        need(things, "a world needs at least one thing to see, got none")
        self.things = things
        self.lights = lights
        # by the number of a thing, the last: nothing
        self.dazzling = np.array([t.dazzles for t in things] + [False])
        meshes = [thing.pose.apply(thing.mesh) for thing in things]
        corners = np.concatenate(meshes)
        first, second, third = np.moveaxis(corners, 1, 0)
        normals = np.cross(second - first, third - first)
        # the poles of a lathe make empty triangles
        whole = length_of(normals) > 1e-12
        self.normals = unit_vector(normals[whole])
        self.offsets = np.vecdot(self.normals, first[whole])
        sizes = [len(mesh) for mesh in meshes]
        self.thing_of = np.repeat(np.arange(len(sizes)), sizes)[whole]
        vertices = corners[whole].reshape(-1, 3).astype(np.float32)
        faces = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(vertices, faces)

    def seen_from(self, T_world_platform: RigidTransform) -> "World":
        """The same world in the frame of a platform that stands elsewhere."""
        back = T_world_platform.inv()
        things = [replace(thing, pose=back * thing.pose) for thing in self.things]
        lights = self.lights
        return World(
            things, lights and replace(lights, positions=back.apply(lights.positions))
        )

    def cast(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """Follow rays to the first surface.

        Parameters
        ----------
        origins, directions
            Metres and unit vectors in the platform frame, shape (..., 3).
        """
        origins, directions = np.broadcast_arrays(origins, directions)
        rays = _rays(origins, directions)
        ids = self._scene.cast_rays(rays)["primitive_ids"].numpy()
        face = ids.astype(np.int32)  # none is the greatest unsigned number
        seen = face >= 0
        normal = self.normals[face]
        along = np.vecdot(normal, directions)
        height = self.offsets[face] - np.vecdot(normal, origins)
        reach = np.divide(height, along, out=np.zeros(face.shape), where=seen)
        return Hits(
            distance=np.where(seen, reach, np.inf),
            points=origins + reach[..., None] * directions,
            thing=np.where(seen, self.thing_of[face], -1),
            normal=-np.sign(along)[..., None] * normal,
            cosine=np.abs(along),
        )

    def albedo(self, points: np.ndarray, thing: np.ndarray) -> np.ndarray:
        """Albedo (..., 3) of points (..., 3) on things of these numbers (...)."""
        out = np.zeros_like(points)
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
            In the platform frame, metres, shape (..., 3).
        thing
            Numbers of the things that they are on, shape (...).

        Returns
        -------
        ndarray, shape (...)
        """
        stated = np.array([t.infrared for t in self.things])[thing]
        red = self.albedo(points, thing)[..., 0]
        return np.where(np.isnan(stated), red, stated)

    def radiance(self, hits: Hits) -> np.ndarray:
        """Light that comes back along rays, linear.

        Lambert's law for every point light, each casting hard shadows, over an even background
        light. What is seen through an opening of the room is bright sky.

        Parameters
        ----------
        hits
            Of rays (...).

        Returns
        -------
        ndarray, shape (..., 3)
        """
        light = np.array([t.glow for t in self.things])[hits.thing] + self.lights.ambient
        lamps = zip(self.lights.positions, self.lights.strengths, strict=True)
        for position, strength in lamps:
            way = position - hits.points
            share = np.vecdot(hits.normal, way) / length_of(way) ** 3
            # 2 mm off, so that no surface shades itself
            rays = _rays(hits.points + 2e-3 * hits.normal, 0.999 * way)
            dark = self._scene.test_occlusions(rays, 0.0, 1.0).numpy()
            light += strength * np.where(dark | (share < 1e-3), 0.0, share)
        out = self.albedo(hits.points, hits.thing) * light[..., None]
        out[hits.thing < 0] = SKY
        return out


def _rays(origins, directions):
    """Rays (..., 6) as Open3D takes them."""
    return o3d.core.Tensor(np.concatenate([origins, directions], axis=-1, dtype=np.float32))


def furnished(*parts: str) -> list[Thing]:
    """Things of parts of ``room.json``."""
    return [_thing(**row) for part in parts for row in ROOM[part]]


def _thing(shape, texture, at=(0.0, 0.0, 0.0), turn=0.0, tip=0.0, **settings):
    """The thing of a row."""
    mesh = getattr(shapes, shape[0])(*shape[1:])
    pattern = (getattr(textures, texture[0]), *texture[1:])
    turned = Rotation.from_euler("ZX", [turn, tip], degrees=True)
    return Thing(mesh, pattern, RigidTransform.from_components(at, turned), **settings)


def furnished_room(*more: Thing) -> World:
    """The room around the rig with further things in it, under two lamps."""
    return World([*furnished(*ROOM["parts"]), *more], Lights(**ROOM["lights"]))


def board_on_stand(board, T_platform_board):
    """The board, a sheet of no thickness whose edges are its outline, and a tripod behind it."""
    centre = np.mean(board.corners, axis=0)
    middle, behind = T_platform_board.apply([[*centre, -0.004], [*centre, -0.07]])
    away = (behind - middle) * [1, 1, 0]
    # a tilted board stays clear of it
    head = behind + 0.3 * unit_vector(away) + [0.0, 0.0, -0.02]
    knee = [*head[:2], min(head[2] - 0.3, FLOOR + 0.75)]
    rods = [(middle, behind, 0.006), (behind, head, 0.008), (head, knee, 0.011)]
    feet = polar_to_points(0.38, np.radians([80, 200, 320])) + [*head[:2], FLOOR]
    rods += [(knee, foot, 0.010) for foot in feet]
    sheet = Thing(
        polygon(board.corners), (chessboard, board, 0.07, 0.75, RING), T_platform_board
    )
    return [sheet, *(Thing(rod(*each), (plain, (0.4, 0.41, 0.43))) for each in rods)]


@pydantic.dataclasses.dataclass(frozen=True)
class Exposure:
    """How a camera turns light into numbers."""

    # least and greatest grey level of full white (albedo 1 at irradiance 1). The response is
    # linear, as machine vision
    # cameras have it; automatic exposure puts the brightest 0.2 % of the image at bright within
    # these limits.
    gain: tuple[PositiveFloat, float] = (70.0, 300.0)
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


@dataclass(frozen=True)
class Imager:
    """A camera that takes pictures."""

    model: CameraModel  # true intrinsics
    exposure: Exposure = Exposure()

    @cached_property
    def rays(self) -> np.ndarray:
        """Viewing rays (height + 1, width + 1, 3) of every corner of every pixel.

        Raises ValueError if the lens folds the image (two viewing rays would fall on one pixel), or
        for an odd size.
        """
        m = self.model
        need(
            not np.any(m.size % BLOCK),
            f"the image is {m.width} x {m.height} pixels, both must be multiples of {BLOCK}",
        )
        corners = np.indices(m.size + 1).T - 0.5  # u, v
        rays = m.sights(undistort(corners, m))
        miss = np.abs(project(rays, m) - corners).max()
        need(miss < 1e-3, f"lens {m.distortion} folds the image: weaken the distortion")
        return rays

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
        light = gaussian_filter(
            self.light(world, T_camera_platform, rng),
            e.blur_px,
            axes=(0, 1),
            mode="nearest",
            truncate=5.0,
        )
        away = np.indices(m.size).T - [m.cx, m.cy]
        radius = 4 * np.vecdot(away, away) / (m.size @ m.size)
        brightest = max(np.quantile(light, 0.998), 1e-6)
        gain = np.clip(e.bright / brightest, *e.gain)
        level = light * (gain * (1 - e.vignetting * radius))[..., None]
        sigma = np.sqrt(e.read_noise**2 + e.shot_noise * level)
        noisy = rng.normal(level, sigma)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)[..., ::-1]

    def light(self, world, T_camera_platform, rng):
        """Light on every pixel, linear, shape (height, width, 3), before lens blur and sensor.

        The corners of blocks of pixels are cast first. Blocks over which neither the light nor the
        thing changes are interpolated; every pixel of the others gets `samples` x `samples` rays,
        one at a random place in each cell.
        """
        n = self.exposure.samples
        color, thing = self._trace(world, T_camera_platform, self.rays[::BLOCK, ::BLOCK])
        corners = sliding_window_view(np.dstack([color, thing]), (2, 2), axis=(0, 1))
        # another thing is a change of one at least
        changes = np.ptp(corners, axis=(3, 4)).max(axis=2) > FLAT
        pixels = np.indices(self.model.size[::-1])
        out = _between(color, (pixels + 0.5) / BLOCK)
        mixed = np.argwhere(changes[tuple(pixels // BLOCK)])
        cells = np.indices((n, n)).reshape(2, -1, 1)
        for part in np.array_split(mixed, 1 + len(mixed) * n * n // BATCH):
            within = (cells + rng.random((len(part), n * n, 2)).T) / n
            rays = _between(self.rays, part.T[:, None] + within)
            color, _ = self._trace(world, T_camera_platform, rays)
            out[tuple(part.T)] = color.mean(axis=0)
        return out

    def _trace(self, world, T_camera_platform, rays):
        """Light and thing along viewing rays (..., 3)."""
        back = T_camera_platform.inv()
        directions = unit_vector(rays) @ back.rotation.as_matrix().T
        hits = world.cast(back.translation, directions)
        return world.radiance(hits), hits.thing


def _between(grid, places):
    """What a grid (rows, columns, k) holds at places (2, ...) between its points."""
    layers = [map_coordinates(layer, places, order=1) for layer in np.moveaxis(grid, -1, 0)]
    return np.stack(layers, axis=-1)
