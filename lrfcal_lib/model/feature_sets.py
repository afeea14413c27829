"""Where a sensor may be that measured one distance to a point, a line or a plane: figure 3."""

import numpy as np
from numpy.typing import ArrayLike

from lrfcal_lib.model.geometry import (
    length_of,
    unit_vector,
)


def point_set(
    positions: ArrayLike, point: ArrayLike, distance: float, tolerance: float
) -> np.ndarray:
    """Which positions a point at a measured distance allows: a spherical shell around it, figure
    3 (a).

    Parameters
    ----------
    positions : array_like, shape (..., 3)
    point : array_like, shape (3,)
    distance, tolerance : float
        Metres.

    Returns
    -------
    ndarray of bool, shape (...)
    """
    away = length_of(np.subtract(positions, point))
    return np.abs(away - distance) <= tolerance


def line_set(
    positions: ArrayLike,
    point: ArrayLike,
    direction: np.ndarray,
    distance: float,
    tolerance: float,
) -> np.ndarray:
    """Which positions a line with one hit point at a measured distance allows: a cylinder, figure
    3 (b).

    Parameters
    ----------
    positions : array_like, shape (..., 3)
    point, direction : ndarray, shape (3,)
        A point of the line and its unit direction; which point was hit is not known.
    distance, tolerance : float
        Metres.

    Returns
    -------
    ndarray of bool, shape (...)
    """
    away = length_of(np.cross(np.subtract(positions, point), direction))
    return away <= distance + tolerance


def plane_set(
    positions: ArrayLike,
    point: ArrayLike,
    normal: ArrayLike,
    distance: float,
    tolerance: float,
) -> np.ndarray:
    """Which positions a plane with one hit point at a measured distance allows: a slab, figure
    3 (c).

    Parameters
    ----------
    positions : array_like, shape (..., 3)
    point, normal : array_like, shape (3,)
        Of the plane; the unit normal points towards the sensor.
    distance, tolerance : float
        Metres.

    Returns
    -------
    ndarray of bool, shape (...)
    """
    height = np.vecdot(np.subtract(positions, point), normal)
    return (height >= -tolerance) & (height <= distance + tolerance)


def shell_volume(distance: float, tolerance: float) -> float:
    """Volume of a spherical shell, cubic metres.

    Parameters
    ----------
    distance : float
        Radius of its middle, metres.
    tolerance : float
        Half its thickness, metres.
    """
    return (
        4 / 3 * np.pi * ((distance + tolerance) ** 3 - max(distance - tolerance, 0.0) ** 3)
    )


def crossing_volume(radius: float, angle: ArrayLike) -> np.ndarray:
    """Volume common to two cylinders whose axes meet, ``16 r^3 / (3 sin angle)``.

    Parameters
    ----------
    radius : float
        Of both, metres.
    angle : array_like, shape (...)
        Between the axes, radians.

    Returns
    -------
    ndarray, shape (...)
        Cubic metres: smallest for perpendicular axes, infinite for parallel ones.
    """
    sine = np.abs(np.sin(angle))
    with np.errstate(divide="ignore"):
        return np.where(sine > 1e-15, 16 * radius**3 / 3 / sine, np.inf)


def ball(radius: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Positions drawn evenly from a ball around the origin.

    Parameters
    ----------
    radius : float
        Metres.
    count : int
    rng : Generator

    Returns
    -------
    ndarray, shape (count, 3)
    """
    positions = unit_vector(rng.normal(size=(count, 3)))
    return radius * positions * np.cbrt(rng.uniform(size=(count, 1)))


def triangle_angle(ab: float, ac: float, bc: float) -> float:
    """Angle at A of a triangle, radians (law of cosines).

    Parameters
    ----------
    ab, ac, bc : float
        Lengths of the sides; ValueError where they make no triangle.
    """
    cosine = (ab**2 + ac**2 - bc**2) / (2 * ab * ac)
    if abs(cosine) > 1:
        raise ValueError(
            f"sides {ab}, {ac} and {bc} make no triangle: "
            "each must be shorter than the sum of the others"
        )
    return float(np.arccos(cosine))
