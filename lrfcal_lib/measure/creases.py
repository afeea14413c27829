"""Where flat surfaces of a scan meet, and by how much that misses the edges of images.

A crease is known to millimetres from planes through hundreds of readings, and no spot widens it.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.painting import View
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.measure.features import SYSTEMATIC, Feature
from lrfcal_lib.measure.pulls import Pull, seen
from lrfcal_lib.measure.surfaces import BENT, LIMIT
from lrfcal_lib.model.camera import pinhole, project
from lrfcal_lib.model.geometry import (
    length_of,
    unit_vector,
)
from lrfcal_lib.preprocess.edges_in_image import (
    ACROSS_STEP_PX,
    FULL_CONTRAST,
    SMOOTH_PX,
    peaks,
    sample,
    step_contrast,
)

LEAST_SINE = 0.5  # of the angle between two surfaces that make an edge
BESIDE = 0.1  # metres from a crease, within which both surfaces have readings
STEP = 0.05  # metres between places of a crease
FEWEST = 4  # places of a crease
REACH = 0.016  # of the image's width: 0.9 deg of a camera that sees 56 deg
ALONG = 5  # pixels of a profile that are averaged
EDGE = 0.01  # of REACH: how well an image tells where an edge is, 0.009 deg of that camera
PLACES = 5  # of a crease, 0.25 m of it, that are worth one observation
# edges that are no crease's lie anywhere: how dense they are, beside a crease's own one
OTHERS = 1.5


@dataclass(frozen=True)
class Creases:
    """Places where two flat surfaces meet, a row each; platform frame.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Metres.
    motions : ndarray, shape (n, 3, 3)
        By how much an error of each surface, of one standard deviation, moves the place; and the
        unit vector along the crease.
    """

    points: np.ndarray
    motions: np.ndarray


def creases_of(cloud: Cloud, planes: list[Feature], of_point: np.ndarray) -> Creases:
    """Where flat surfaces of a cloud meet.

    Parameters
    ----------
    cloud : Cloud
    planes, of_point
        What :func:`lrfcal_lib.measure.surfaces.planes_of` found.

    Returns
    -------
    Creases
    """
    creases = [(np.zeros((0, 3)), np.zeros((0, 3, 3)))]
    surfaces = [(plane, cloud.points[of_point == k]) for k, plane in enumerate(planes)]
    for pair in combinations(surfaces, 2):
        (first, _), (second, _) = pair
        way = np.cross(first.axis, second.axis)
        sine = length_of(way)
        if sine < LEAST_SINE:
            continue
        way /= sine
        normals = [first.axis, second.axis, way]
        by_height = np.linalg.inv(normals)
        centres = [first.centre, second.centre, (first.centre + second.centre) / 2]
        origin = by_height @ np.vecdot(normals, centres)
        beside = [_beside(readings - origin, plane, way) for plane, readings in pair]
        numbers, lifts = zip(*beside, strict=True)
        common = np.intersect1d(*numbers)
        if len(common) < FEWEST:
            continue
        places = origin + by_height[:, :2] @ lifts + STEP * common[:, None] * way
        # the smaller a surface, the more of it is rim, where spots are mixed with what is beside
        rim = SYSTEMATIC / min(STEP * len(common), 1.0)
        sigma = [
            _sigma(plane, places, np.hypot(rim, lift / 2))
            for plane, lift in zip((first, second), lifts, strict=True)
        ]
        steps = np.transpose([*sigma, np.ones_like(common)])
        creases.append((places, steps[..., None] * by_height.T))
    return Creases(*map(np.concatenate, zip(*creases, strict=True)))


def _beside(points, plane, way):
    """Numbers of the places of a line through the origin beside which a plane has points (n, 3),
    and how far these are off it, metres, if that is not chance: there is a skirting board, a frame.
    """
    place = points @ way
    near = length_of(points - place[:, None] * way) < BESIDE
    height = points[near] @ plane.axis
    lift = 0.0
    if abs(height.sum()) > BENT * len(height) + LIMIT * np.linalg.norm(height):
        lift = height.mean()
    return np.rint(place[near] / STEP), lift


def _sigma(plane, points, systematic):
    """How well the height of a plane is known at points (n, 3), with what all have in common,
    metres.
    """
    by_plane = plane.height_by(points)
    return np.sqrt(np.vecdot(by_plane @ plane.noise, by_plane) + systematic**2)


@dataclass(frozen=True)
class Sights:
    """Edges of an image near places of creases, a row each; lengths are shares of `REACH` of it.

    Attributes
    ----------
    place : ndarray of int, shape (n,)
        The number of the place; several edges may be near it.
    by_unknown : ndarray, shape (n, c)
        How far the place moves along the normal of the crease, by the unknowns of a Pull.
    across, clear : ndarray, shape (n,)
        How far from it along the normal the edge is, and how clear, 0 to 1.
    sigma : ndarray, shape (n,)
        How well the place and its edge are known.
    """

    place: np.ndarray
    by_unknown: np.ndarray
    across: np.ndarray
    clear: np.ndarray
    sigma: np.ndarray

    def pull(self, change: np.ndarray, width: float) -> Pull:
        """What edges ask for: each place may go with one of several edges, or with none.

        Parameters
        ----------
        change : ndarray, shape (c,)
            Of the unknowns, about which they are sought.
        width : float
            By how much more than by their errors.

        Returns
        -------
        Pull
            Its groups are as many observations as have an edge.
        """
        share, sigma = self._shares(change, width)
        weighted = self.by_unknown.T * (share / (PLACES * sigma**2))
        return Pull(
            information=weighted @ self.by_unknown,
            slope=weighted @ self.across,
            groups=share.sum() / PLACES,
        )

    def explained(self, change: np.ndarray) -> float:
        """Logarithm of the likelihood of a change (c,), beside edges that are no crease's.

        Parameters
        ----------
        change : ndarray, shape (c,)
        """
        share, _ = self._shares(change, 0.0)
        return -np.log(1 - np.bincount(self.place, share)).sum() / PLACES

    def _shares(self, change, width):
        """What each edge has of its place, and how far off it may be, both (n,)."""
        sigma = np.hypot(self.sigma, width)
        miss = self.across - self.by_unknown @ change
        likely = self.clear * np.exp(-0.5 * (miss / sigma) ** 2)
        of_place = np.bincount(self.place, likely)[self.place]
        return likely / (OTHERS * sigma + of_place), sigma


def sights(creases: Creases, view: View, rig: CalibratedRig) -> Sights:
    """Look in an image for edges near creases.

    Parameters
    ----------
    creases : Creases
    view : View
    rig : CalibratedRig
        That knows its uncertainty.

    Returns
    -------
    Sights
        Of places inside the image.
    """
    model = view.model
    points, J = seen(creases.points, creases.motions, view, rig)
    reach = REACH * model.width
    inside = model.shows(project(points, model), reach)
    J = J[inside]
    tangent = unit_vector(J[..., -1])
    normal = tangent[:, ::-1] * [-1, 1]
    pixels = pinhole(points[inside], model)
    place, across, contrast = _edges(view, reach, pixels, tangent, normal)
    moved = np.vecmat(normal, J)[place] / reach
    return Sights(
        place=place,
        by_unknown=moved[:, :-3],
        across=across / reach,
        clear=contrast / (contrast + FULL_CONTRAST),
        sigma=np.hypot(length_of(moved[:, -3:]), EDGE),
    )


def _edges(view, reach, places, tangent, normal):
    """Edges up to some pixels from pixels (n, 2) along their normals (n, 2): the number of the
    pixel, how far from it, and contrast.
    """
    grid = np.arange(-reach, reach + ACROSS_STEP_PX, ACROSS_STEP_PX)
    height = np.zeros((len(grid), len(places)))
    if len(places):
        side = np.arange(ALONG) - ALONG // 2
        profile = places[:, None] + side[:, None] * tangent[:, None]
        away = grid[:, None, None, None] * normal[:, None]
        strips = sample(view.image, view.model, profile + away)
        mean = strips.mean(axis=2)  # NaN outside the image
        height = step_contrast(mean, SMOOTH_PX / ACROSS_STEP_PX, along=1)
    number, cell, contrast = peaks(height)
    return number, grid[0] + ACROSS_STEP_PX * cell, contrast
