"""How much a point, a line or a plane, seen by the LRF, says about where the sensor is (section II of the paper)."""

from __future__ import annotations

import numpy as np


def point_set(positions, point, distance, tolerance):
    """Positions that a point at a measured distance allows: a spherical shell around it, figure 3 (a).

    Parameters
    ----------
    positions : array_like, shape (..., 3)
        Candidate positions of the sensor, metres.
    point : array_like, shape (3,)
    distance, tolerance : float
        Measured distance and how far it may be off, metres.

    Returns
    -------
    ndarray of bool, shape (...)
    """
    away = np.linalg.norm(np.asarray(positions, float) - point, axis=-1)
    return np.abs(away - distance) <= tolerance


def line_set(positions, point, direction, distance, tolerance):
    """Positions that a line with one hit point at a measured distance allows: the inside of a cylinder, figure 3 (b).

    Parameters
    ----------
    positions : array_like, shape (..., 3)
        Metres.
    point, direction : array_like, shape (3,)
        A point of the line and its unit direction. Which point of the line was hit is not known.
    distance, tolerance : float
        Metres.

    Returns
    -------
    ndarray of bool, shape (...)
    """
    away = np.linalg.norm(np.cross(np.asarray(positions, float) - point, direction), axis=-1)
    return away <= distance + tolerance


def plane_set(positions, point, normal, distance, tolerance):
    """Positions that a plane with one hit point at a measured distance allows: a slab in front of it, figure 3 (c).

    Parameters
    ----------
    positions : array_like, shape (..., 3)
        Metres.
    point, normal : array_like, shape (3,)
        A point of the plane and its unit normal, towards the sensor.
    distance, tolerance : float
        Metres.

    Returns
    -------
    ndarray of bool, shape (...)
    """
    height = (np.asarray(positions, float) - point) @ np.asarray(normal, float)
    return (height >= -tolerance) & (height <= distance + tolerance)


def shell_volume(distance, tolerance):
    """Volume of a spherical shell of half thickness `tolerance`, cubic metres."""
    return 4 / 3 * np.pi * ((distance + tolerance) ** 3 - max(distance - tolerance, 0.0) ** 3)


def crossing_volume(radius, angle):
    """Volume common to two cylinders of equal radius whose axes meet at an angle.

    Parameters
    ----------
    radius : float
        Metres.
    angle : array_like
        Between the axes, radians.

    Returns
    -------
    ndarray
        ``16 r^3 / (3 sin angle)``, cubic metres; smallest for perpendicular axes, without bound for parallel ones
        (inf).
    """
    sine = np.abs(np.sin(np.asarray(angle, float)))
    with np.errstate(divide="ignore"):
        return np.where(sine > 1e-15, 16 * radius**3 / 3 / sine, np.inf)


def ball(radius, count, rng):
    """Positions drawn evenly from a ball around the origin, shape (count, 3), metres."""
    positions = rng.normal(size=(count, 3))
    positions /= np.linalg.norm(positions, axis=1, keepdims=True)
    return radius * positions * np.cbrt(rng.uniform(size=(count, 1)))


def triangle_angle(ab, ac, bc):
    """Angle at A of a triangle with the given sides, radians (law of cosines)."""
    cosine = (ab**2 + ac**2 - bc**2) / (2 * ab * ac)
    if abs(cosine) > 1:
        raise ValueError(f"sides {ab}, {ac} and {bc} make no triangle: each must be shorter than the sum of the others")
    return float(np.arccos(cosine))
