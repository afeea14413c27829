"""Things with materials, put together into a world that rays can be cast into."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import open3d as o3d
from scipy.spatial.transform import RigidTransform


@dataclass(frozen=True)
class Material:
    """What a surface does with light.

    Attributes
    ----------
    texture : callable
        Points in the thing's frame, shape (n, 3), to albedo, shape (n, 3); see :mod:`.textures`.
    infrared : float or None
        Diffuse reflectivity at the LRF's wavelength (905 nm); None takes the red albedo.
    dazzles : bool
        The LRF is dazzled when its spot meets it (a lamp, the sun in a window).
    glow : float
        Light it gives off by itself, in units of full albedo.
    """

    texture: Callable
    infrared: float | None = None
    dazzles: bool = False
    glow: float = 0.0


@dataclass(frozen=True)
class Thing:
    """A mesh with one material.

    Attributes
    ----------
    vertices : ndarray, shape (n, 3)
        In the thing's own frame, metres.
    faces : ndarray of int, shape (m, 3)
    material : Material
    pose : RigidTransform
        ``T_platform_thing``.
    """

    vertices: np.ndarray
    faces: np.ndarray
    material: Material
    pose: RigidTransform = field(default_factory=RigidTransform.identity)


@dataclass(frozen=True)
class Lights:
    """Point lights and an even background light.

    Attributes
    ----------
    positions : ndarray, shape (k, 3)
        Platform frame, metres.
    strengths : ndarray, shape (k,)
        Irradiance at 1 m and normal incidence, in units of full white; falls with the square of the distance.
    ambient : float
        The same from everywhere.
    """

    positions: np.ndarray
    strengths: np.ndarray
    ambient: float


@dataclass(frozen=True)
class Hits:
    """Where rays end.

    Attributes
    ----------
    distance : ndarray, shape (n,)
        Metres along the ray; inf where it meets nothing.
    face : ndarray of int, shape (n,)
        Number of the triangle in the world, -1 for none.
    thing : ndarray of int, shape (n,)
        Number of the thing, -1 for none.
    """

    distance: np.ndarray
    face: np.ndarray
    thing: np.ndarray


class World:
    """Things in the platform frame, ready for ray casting.

    Parameters
    ----------
    things : sequence of Thing
    lights : Lights, optional
        Only images need them.

    Raises
    ------
    ValueError
        If there is nothing in it.

    Notes
    -----
    Open3D (Embree, single precision) decides which triangle a ray meets; the distance is then computed in double
    precision from the triangle's plane.
    """

    def __init__(self, things, lights=None):
        if not things:
            raise ValueError("a world needs at least one thing to see, got none")
        self.things, self.lights = tuple(things), lights
        vertices = [thing.pose.apply(thing.vertices) for thing in self.things]
        starts = np.cumsum([0] + [len(v) for v in vertices[:-1]])
        faces = np.concatenate([t.faces + s for t, s in zip(self.things, starts, strict=True)])
        vertices = np.concatenate(vertices)
        corners = vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        size = np.linalg.norm(normals, axis=1)
        whole = size > 1e-12  # the poles of a lathe make empty triangles
        self.normals = normals[whole] / size[whole, None]
        self.offsets = np.sum(self.normals * corners[whole, 0], axis=1)
        self.thing_of = np.repeat(np.arange(len(self.things)), [len(t.faces) for t in self.things])[whole]
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(vertices.astype(np.float32), faces[whole].astype(np.uint32))

    def cast(self, origins, directions):
        """Follow rays to the first surface.

        Parameters
        ----------
        origins, directions : array_like, shape (n, 3)
            Platform frame; unit directions.

        Returns
        -------
        Hits
        """
        origins, directions = np.broadcast_arrays(np.asarray(origins, float), np.asarray(directions, float))
        rays = np.concatenate([origins, directions], axis=1, dtype=np.float32)
        found = self._scene.cast_rays(o3d.core.Tensor(rays))["primitive_ids"].numpy()
        face = np.where(found == o3d.t.geometry.RaycastingScene.INVALID_ID, -1, found.astype(np.int64))
        seen = face >= 0
        distance = np.full(len(face), np.inf)
        normal = self.normals[face[seen]]
        height = self.offsets[face[seen]] - np.einsum("ni,ni->n", normal, origins[seen])
        distance[seen] = height / np.einsum("ni,ni->n", normal, directions[seen])
        return Hits(distance, face, np.where(seen, self.thing_of[face], -1))

    def albedo(self, points, thing):
        """Albedo of surface points, shape (n, 3); zero where there is no thing.

        Parameters
        ----------
        points : ndarray, shape (n, 3)
            Platform frame.
        thing : ndarray of int, shape (n,)
        """
        out = np.zeros((len(points), 3))
        for number, rows in _groups(thing):
            if number >= 0:
                item = self.things[number]
                out[rows] = item.material.texture(item.pose.inv().apply(points[rows]))
        return out

    def infrared(self, points, thing):
        """Reflectivity of surface points for the LRF, shape (n,); zero where there is no thing."""
        fixed = np.array([np.nan if t.material.infrared is None else t.material.infrared for t in self.things] + [0.0])
        out = fixed[thing]
        ask = np.isnan(out)
        out[ask] = self.albedo(points[ask], thing[ask])[:, 0]
        return out

    def dazzling(self, thing):
        """Whether things dazzle the LRF, shape (n,)."""
        return np.array([t.material.dazzles for t in self.things] + [False])[thing]

    def glow(self, thing):
        """Light the things give off, shape (n,)."""
        return np.array([t.material.glow for t in self.things] + [1.0])[thing]

    def radiance(self, origins, directions, hits):
        """Light that comes back along rays, linear, shape (n, 3).

        Parameters
        ----------
        origins, directions : ndarray, shape (n, 3)
        hits : Hits

        Notes
        -----
        Lambert's law for every point light, each casting hard shadows, over an even background light. What is seen
        through an opening of the room is bright sky.
        """
        seen = hits.face >= 0
        points = origins[seen] + hits.distance[seen, None] * directions[seen]
        normal = self.normals[hits.face[seen]]
        normal *= -np.sign(np.einsum("ni,ni->n", normal, directions[seen]))[:, None]
        light = np.full(len(points), self.lights.ambient)
        for position, strength in zip(self.lights.positions, self.lights.strengths, strict=True):
            light += strength * self._lit(points, normal, position)
        out = np.tile([0.95, 0.98, 1.0], (len(seen), 1))
        glow = self.glow(hits.thing[seen])
        out[seen] = self.albedo(points, hits.thing[seen]) * (light + glow)[:, None]
        return out

    def _lit(self, points, normal, position):
        """Cosine over squared distance of a point light, zero in its shadow."""
        way = position - points
        squared = np.einsum("ni,ni->n", way, way)
        share = np.einsum("ni,ni->n", normal, way) / (squared * np.sqrt(squared))
        ask = share > 1e-3
        out = np.zeros(len(points))
        start = points[ask] + 2e-3 * normal[ask]
        rays = np.concatenate([start, 0.999 * way[ask]], axis=1, dtype=np.float32)
        out[ask] = share[ask] * ~self._scene.test_occlusions(o3d.core.Tensor(rays), 0.0, 1.0).numpy()
        return out


def _groups(labels):
    """(label, rows) of every label that occurs."""
    order = np.argsort(labels, kind="stable")
    values, starts = np.unique(labels[order], return_index=True)
    return zip(values, np.split(order, starts[1:]) if len(values) else [], strict=True)
