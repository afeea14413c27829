"""Coloured clouds as a camera sees them."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.geometry import (
    carry,
    fit_plane,
    length_of,
    unit_vector,
)
from lrfcal_lib.plots.colors import FIT
from lrfcal_lib.plots.recording import CENTRED

NEAREST = 1e-6  # metres: what is nearer, or behind a camera, is not seen
PARALLEL = 1e-9  # sine of an angle below which two directions are one
FAR = 4.0  # widths of a part from which it is looked at, so that it is hardly distorted
COVER = 0.75  # half the width of a drawn point, of the usual spacing: scattered points leave gaps
Vector = Sequence[float] | np.ndarray


def render(
    points: np.ndarray,
    colors: np.ndarray,
    T_view: RigidTransform,
    size: tuple[int, int],
    focal: float | None = None,
    splat: int = 1,
) -> np.ndarray:
    """A coloured cloud as a pinhole camera sees it: the nearest point of each pixel, or white.

    Parameters
    ----------
    points
        Shape (n, 3), metres; NaN rows and points behind the camera are left out.
    colors
        Of uint8, shape (n, 3), in the order wanted in the picture.
    T_view
        From the frame of the points to the view (x right, y down, z ahead).
    size
        Height and width, pixels.
    focal
        Pixels; the width (53 deg across) unless given.
    splat
        Each point covers (2 splat + 1)^2 pixels.

    Returns
    -------
    ndarray of uint8, shape (height, width, 3)
    """
    seen = T_view.apply(points)
    order = np.argsort(-seen[:, 2], kind="stable")  # far to near
    order = order[seen[order, 2] > NEAREST]
    # with what is too far out to be seen, but for a part of its square
    height, width = np.add(size, 2 * splat)
    uv = np.rint(pixels(seen[order], size, focal)).astype(int) + splat
    inside = np.flatnonzero(np.all((uv >= 0) & (uv < [width, height]), axis=1))
    nearest = np.full((height, width), -1)
    u, v = uv[inside].T
    # of equal pixels the last one, the nearest, stays
    nearest[v, u] = inside
    covering = maximum_filter(nearest, 2 * splat + 1)
    white = np.full((1, 3), 255, np.uint8)  # the last row, where no point is
    picture = np.vstack([colors[order], white])[covering]
    return picture[splat : height - splat, splat : width - splat]


def pixels(
    seen: np.ndarray, size: tuple[int, int], focal: float | None = None
) -> np.ndarray:
    """Where points stand in a picture of :func:`render`.

    Parameters
    ----------
    seen
        Points of the view, shape (..., 3), metres.
    size, focal
        As there.

    Returns
    -------
    ndarray, shape (..., 2)
    """
    centre = (np.array(size[::-1]) - 1) / 2
    return (focal or size[1]) * seen[..., :2] / seen[..., 2:] + centre


def look_at(eye: Vector, target: Vector, up: Vector = (0.0, 0.0, 1.0)) -> RigidTransform:
    """The view from one point to another for :func:`render`.

    Parameters
    ----------
    eye, target
        Shape (3,), metres.
    up
        Shown upwards.

    Returns
    -------
    RigidTransform
        Of points.

    Raises
    ------
    ValueError
        If eye and target coincide, or `up` is the line of sight.
    """
    start, end = np.array([eye, target], float)
    ahead = end - start
    right = np.cross(ahead, up)
    if length_of(right) <= PARALLEL * length_of(ahead):
        raise ValueError(
            f"no view from {start} to {end} with {up} upwards: choose another eye or another up"
        )
    axes = unit_vector(np.stack([right, np.cross(ahead, right), ahead]))
    return carry(Rotation.from_matrix(axes), start)


def face_on(
    points: np.ndarray, size: tuple[int, int], fill: float = 0.85
) -> tuple[RigidTransform, float, int]:
    """The view of a flat part of a cloud from its front, for :func:`render`.

    Parameters
    ----------
    points
        Shape (n, 3), metres, in a frame whose origin is in front of them.
    size
        Height and width of the picture, pixels.
    fill
        Share of the picture that they fill.

    Returns
    -------
    T_view : RigidTransform
    focal : float
        Pixels.
    splat : int
        Half a width of a point that leaves few gaps, pixels.
    """
    normal, _, _ = fit_plane(points)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2

    wide = 2 * length_of(points - middle).max()
    T_view = look_at(middle - FAR * wide * normal, middle)
    spread = np.ptp(pixels(T_view.apply(points), size, 1.0), axis=0)
    focal = fill * (size[::-1] / spread).min()
    # half of a rectangle about points of a triangle is empty
    spacing = focal * np.sqrt(spread.prod() / 2 / len(points))
    return T_view, focal, int(np.ceil(COVER * spacing))


def measured_edges(
    ax,
    measured,
    known: dict[str, float],
    T_view: RigidTransform,
    size: tuple[int, int],
    focal: float | None,
) -> None:
    """Edges of a measured board over a picture of :func:`render`, with their lengths.

    Parameters
    ----------
    ax : Axes
    measured : MeasuredBoard
    known
        True lengths by edge, metres, in the order of the outline.
    T_view, size, focal
        Of the picture.
    """
    following = dict(pairwise([*known, *known]))  # around the outline
    centre = measured.T_platform_plane[:3, 3]
    middle = pixels(T_view.apply(centre), size, focal)
    for name, length in measured.lengths.items():
        ends = [measured.corner_point(corner) for corner in (name, following[name])]
        uv = pixels(T_view.apply(ends), size, focal)
        ax.plot(*uv.T, "o-", color=FIT)
        at = uv.mean(axis=0)
        at = at + 0.07 * size[1] * unit_vector(at - middle)
        words = f"{name.upper()} {1000 * length:.1f} mm\ntrue {1000 * known[name]:.1f} mm"
        ax.text(*at, words, color=FIT, **CENTRED)
