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
from lrfcal_lib.model.camera import pinhole, pinhole_jacobian, project
from lrfcal_lib.model.geometry import unit_vector
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
    points, along : ndarray, shape (n, 3)
        Metres, and unit vectors along the crease.
    off : ndarray, shape (n, 2, 3)
        By how much an error of each surface, of one standard deviation, moves the place.
    """

    points: np.ndarray
    along: np.ndarray
    off: np.ndarray


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
    creases = [(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2, 3)))]
    surfaces = [(plane, cloud.points[of_point == k]) for k, plane in enumerate(planes)]
    for pair in combinations(surfaces, 2):
        (first, _), (second, _) = pair
        way = np.cross(first.axis, second.axis)
        sine = np.linalg.norm(way)
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
        off = np.einsum("kn,ik->nki", sigma, by_height[:, :2])
        creases.append((places, np.tile(way, (len(common), 1)), off))
    return Creases(*map(np.concatenate, zip(*creases, strict=True)))


def _beside(points, plane, way):
    """Numbers of the places of a line through the origin beside which a plane has points (n, 3),
    and how far these are off it, metres, if that is not chance: there is a skirting board, a frame.
    """
    place = points @ way
    near = np.linalg.norm(points - place[:, None] * way, axis=1) < BESIDE
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
    """Places of creases as an image sees them, a row each; lengths are shares of `REACH` of it.

    Attributes
    ----------
    by_unknown : ndarray, shape (n, c)
        How far the place moves along the normal of the crease, by the unknowns of a Pull.
    across, clear : ndarray, shape (n, k)
        Distances along the normal, and how clear an edge of the image is there, 0 to 1.
    sigma : ndarray, shape (n,)
        How well the place and its edge are known.
    """

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
        share, miss, sigma = self._shares(change, width)
        matched = share.sum(axis=1)
        weight = 1 / (PLACES * sigma**2)
        wanted = np.vecdot(share, miss) + matched * (self.by_unknown @ change)
        return Pull(
            information=(self.by_unknown.T * (weight * matched)) @ self.by_unknown,
            slope=self.by_unknown.T @ (weight * wanted),
            groups=matched.sum() / PLACES,
        )

    def explained(self, change: np.ndarray) -> float:
        """Logarithm of the likelihood of a change (c,), beside edges that are no crease's.

        Parameters
        ----------
        change : ndarray, shape (c,)
        """
        share, _, _ = self._shares(change, 0.0)
        return -np.log(1 - share.sum(axis=1)).sum() / PLACES

    def _shares(self, change, width):
        """What each edge has of its place (n, k), how far off it is, and how far it may be (n,)."""
        sigma = np.hypot(self.sigma, width)
        miss = self.across - (self.by_unknown @ change)[:, None]
        likely = self.clear * np.exp(-0.5 * (miss / sigma[:, None]) ** 2)
        others = OTHERS * sigma
        return likely / (others + likely.sum(axis=1))[:, None], miss, sigma


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
    points, J = seen(creases.points, view, rig)
    reach = REACH * model.width
    inside = model.shows(project(points, model), reach)
    by_point = pinhole_jacobian(points[inside], model)
    R = view.T_camera_platform.rotation.as_matrix()
    way = creases.along[inside] @ R.T
    tangent = unit_vector(np.matvec(by_point, way))
    normal = tangent[:, ::-1] * [-1, 1]
    across, clear = _edges(view, reach, pinhole(points[inside], model), tangent, normal)
    by_place = np.vecmat(normal, by_point) / reach
    off = np.matvec(creases.off[inside] @ R.T, by_place)
    return Sights(
        by_unknown=np.vecmat(by_place, J[inside]),
        across=across / reach,
        clear=clear,
        sigma=np.hypot(np.linalg.norm(off, axis=1), EDGE),
    )


def _edges(view, reach, places, tangent, normal):
    """Offsets (n, k) of edges, up to some pixels, from pixels (n, 2) along their normals (n, 2),
    and how clear each is, 0 to 1.
    """
    grid = np.arange(-reach, reach + ACROSS_STEP_PX, ACROSS_STEP_PX)
    across = np.tile(grid, (len(places), 1))
    clear = np.zeros_like(across)
    if len(places):
        side = np.arange(ALONG) - ALONG // 2
        profile = places[:, None] + side[:, None] * tangent[:, None]
        away = grid[:, None, None, None] * normal[:, None]
        strips = sample(view.image, view.model, profile + away)
        mean = strips.mean(axis=2)  # NaN outside the image
        height = step_contrast(mean, SMOOTH_PX / ACROSS_STEP_PX, along=1)
        row, place, contrast = peaks(height)
        cell = place.round().astype(int)
        across[row, cell] = grid[0] + ACROSS_STEP_PX * place
        clear[row, cell] = contrast / (contrast + FULL_CONTRAST)
    return across, clear
