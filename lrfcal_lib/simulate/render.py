"""What a camera sees: ray casting through the full lens model, with blur, sensor noise and rounding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from lrfcal_lib.camera import CameraModel, distort, undistort

FLAT = 0.03  # difference of light over a block of pixels below which its four corners tell the rest
BLOCK = 2  # pixels
BATCH = 1 << 19  # rays that are cast at once


@dataclass(frozen=True)
class Exposure:
    """How a camera turns light into numbers.

    Attributes
    ----------
    gain : tuple of float
        Least and greatest grey level of full white (albedo 1 at irradiance 1). The response is linear, as machine
        vision cameras have it; automatic exposure puts the brightest 0.2 % of the image at `bright` within these
        limits.
    bright : float
        Grey level.
    blur_px : float
        Standard deviation of the point spread of lens and sensor together, pixels.
    read_noise, shot_noise : float
        Variance in grey levels squared is ``read_noise^2 + shot_noise * level``.
    vignetting : float
        Loss of light in the corners of the image, a share.
    samples : int
        Rays across a pixel and down a pixel, where the pixel is not plain.
    """

    gain: tuple[float, float] = (70.0, 300.0)
    bright: float = 235.0
    blur_px: float = 0.7
    read_noise: float = 0.8
    shot_noise: float = 0.008
    vignetting: float = 0.15
    samples: int = 3

    def __post_init__(self):
        if not 0 < self.gain[0] <= self.gain[1]:
            raise ValueError(f"gain is {self.gain}: two positive levels are needed, the smaller first")
        for name in ("bright", "blur_px", "read_noise", "shot_noise", "vignetting"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}: it cannot be negative")
        if self.samples < 1:
            raise ValueError(f"samples is {self.samples}: at least one ray a pixel is needed")


class Imager:
    """A camera with the viewing ray of every corner of every pixel.

    Parameters
    ----------
    model : CameraModel
    exposure : Exposure, optional

    Raises
    ------
    ValueError
        If the lens folds the image (two viewing rays would fall on one pixel), or for an odd size.
    """

    def __init__(self, model: CameraModel, exposure: Exposure | None = None):
        if model.width % BLOCK or model.height % BLOCK:
            raise ValueError(f"the image is {model.width} x {model.height} pixels, both must be multiples of {BLOCK}")
        self.model, self.exposure = model, exposure or Exposure()
        v, u = np.mgrid[: model.height + 1, : model.width + 1] - 0.5
        corners = np.stack([u, v], axis=-1)
        plain = undistort(corners, model)
        self.grid = (plain - [model.cx, model.cy]) / [model.fx, model.fy]
        again = distort(self.grid, model.distortion) * [model.fx, model.fy] + [model.cx, model.cy]
        miss = np.abs(again - corners).max()
        if not miss < 1e-3:
            raise ValueError(f"lens {model.distortion} folds the image (off by {miss:.3g} px): weaken the distortion")

    def render(self, world, T_camera_platform, rng):
        """Take a picture.

        Parameters
        ----------
        world : World
            With lights.
        T_camera_platform : RigidTransform
        rng : numpy.random.Generator
            Places the rays in the pixels and makes the noise.

        Returns
        -------
        ndarray of uint8, shape (height, width, 3)
            Blue, green, red.
        """
        light = self.light(world, T_camera_platform, rng)
        e, m = self.exposure, self.model
        light = gaussian_filter(light, (e.blur_px, e.blur_px, 0), mode="nearest", truncate=5.0)
        v, u = np.mgrid[: m.height, : m.width]
        radius = ((u - m.cx) ** 2 + (v - m.cy) ** 2) / (m.width**2 + m.height**2) * 4
        gain = np.clip(e.bright / max(np.quantile(light, 0.998), 1e-6), *e.gain)
        level = light * (gain * (1 - e.vignetting * radius))[..., None]
        sigma = np.sqrt(e.read_noise**2 + e.shot_noise * level)
        noisy = level + sigma * rng.standard_normal(level.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)[..., ::-1]

    def light(self, world, T_camera_platform, rng):
        """Mean light in every pixel, linear, shape (height, width, 3) in red, green, blue.

        Notes
        -----
        The corners of blocks of `BLOCK` x `BLOCK` pixels are cast first. Blocks over which neither the light nor the
        thing changes are interpolated; every pixel of the others gets `samples` x `samples` rays, one at a random place
        in each cell.
        """
        coarse = self.grid[::BLOCK, ::BLOCK]
        color, thing = self._trace(world, T_camera_platform, coarse.reshape(-1, 2))
        color, thing = color.reshape(*coarse.shape[:2], 3), thing.reshape(coarse.shape[:2])
        four = np.stack([_corner(color, i) for i in range(4)])
        changes = np.ptp(four, axis=0).max(axis=-1) > FLAT
        changes |= np.ptp([_corner(thing, i) for i in range(4)], axis=0) > 0
        out = _fill(four)
        rows, columns = np.nonzero(np.kron(changes, np.ones((BLOCK, BLOCK), bool)))
        n = self.exposure.samples
        cells = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), axis=-1).reshape(-1, 2)
        for part in np.array_split(np.arange(len(rows)), 1 + len(rows) * n * n // BATCH):
            f = (cells + rng.random((len(part), n * n, 2))) / n
            rays = self._between(rows[part, None], columns[part, None], f)
            color, _ = self._trace(world, T_camera_platform, rays.reshape(-1, 2))
            out[rows[part], columns[part]] = color.reshape(len(part), n * n, 3).mean(axis=1)
        return out

    def _between(self, row, column, f):
        """Viewing rays within pixels, from the rays of their corners; f = (down, across) from 0 to 1."""
        g, down, across = self.grid, f[..., :1], f[..., 1:]
        top = g[row, column] * (1 - across) + g[row, column + 1] * across
        low = g[row + 1, column] * (1 - across) + g[row + 1, column + 1] * across
        return top * (1 - down) + low * down

    def _trace(self, world, T_camera_platform, rays):
        back = T_camera_platform.inv()
        directions = np.column_stack([rays, np.ones(len(rays))])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        directions = directions @ back.rotation.as_matrix().T
        origins = np.broadcast_to(back.translation, directions.shape)
        hits = world.cast(origins, directions)
        return world.radiance(origins, directions, hits), hits.thing


def _corner(grid, i):
    """The i-th corner of every block out of a grid of block corners."""
    rows, columns = grid.shape[0] - 1, grid.shape[1] - 1
    return grid[i // 2 : i // 2 + rows, i % 2 : i % 2 + columns]


def _fill(four):
    """Pixels between the corners of their blocks, shape (height, width, 3)."""
    f = (np.arange(BLOCK) + 0.5) / BLOCK
    rows, columns = four.shape[1] * BLOCK, four.shape[2] * BLOCK
    out = np.zeros((four.shape[1], BLOCK, four.shape[2], BLOCK, 3))
    for corner, (down, across) in zip(four, ((1 - f, 1 - f), (1 - f, f), (f, 1 - f), (f, f)), strict=True):
        out += corner[:, None, :, None] * down[:, None, None, None] * across[:, None]
    return out.reshape(rows, columns, 3)
