"""Where flat surfaces of a scan meet, and by how much that misses the edges of images.

A crease is known to millimetres from planes through hundreds of readings, and no spot widens it.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.measure.features import Feature
from lrfcal_lib.measure.pulls import SPREAD, Pull, View, poses_of, pull_of_groups
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
MOST = 100_000  # creases of a station
FEWEST = 4  # places of a crease
REACH = 0.016  # of the image's width: 0.9 deg of a camera that sees 56 deg
ALONG = 5  # pixels of a profile that are averaged
HONEST = SPREAD / 10  # of a calibration that holds
# of REACH: how far off an edge may lie, while it is sought
WIDTHS = np.append(np.geomspace(0.3, 0.04, 12), np.full(8, 0.04))
SLIPS = np.radians(np.arange(-10, 11) / 10)  # that are tried
MATTERS = np.radians(0.15)  # of a slip: where one may be, or chance, nothing can be said
OUTLIERS = 0.15  # of the clearest edge's weight
# of what edges say: those that agree are taken for those of creases, also where they are others
# (simulated rooms, cameras that moved by 8 mm: off by 2 sigma)
WORTH = 0.5


@dataclass(frozen=True)
class Creases:
    """Places where two flat surfaces meet, a row each.

    Attributes
    ----------
    points, along : ndarray, shape (n, 3)
        Metres, and unit vectors along the crease; platform frame.
    number : ndarray of int, shape (n,)
        Of the crease. Its places err together.
    """

    points: np.ndarray
    along: np.ndarray
    number: np.ndarray


def creases_of(
    cloud: Cloud, planes: list[Feature], of_point: np.ndarray, station: int = 0
) -> Creases:
    """Where flat surfaces of a cloud meet.

    Parameters
    ----------
    cloud : Cloud
    planes, of_point
        What :func:`lrfcal_lib.measure.surfaces.planes_of` found.
    station : int
        Its placement, for the numbers of creases.

    Returns
    -------
    Creases
    """
    points = [np.zeros((0, 3))]
    along = [np.zeros((0, 3))]
    for (i, first), (j, second) in combinations(enumerate(planes), 2):
        way = np.cross(first.axis, second.axis)
        sine = np.linalg.norm(way)
        if sine < LEAST_SINE:
            continue
        way /= sine
        rows = np.array([first.axis, second.axis, way])
        middle = (first.centre + second.centre) / 2
        origin = np.linalg.solve(
            rows, np.vecdot(rows, [first.centre, second.centre, middle])
        )
        places = []
        for plane in (i, j):
            off = cloud.points[of_point == plane] - origin
            place = off @ way
            near = np.linalg.norm(off - place[:, None] * way, axis=1) < BESIDE
            places.append(np.rint(place[near] / STEP))
        common = np.intersect1d(*places)
        if len(common) < FEWEST:
            continue
        points.append(origin + STEP * common[:, None] * way)
        along.append(np.tile(way, (len(common), 1)))
    number = np.repeat(np.arange(len(points)), [len(part) for part in points])
    number = number + MOST * station
    return Creases(np.concatenate(points), np.concatenate(along), number)


@dataclass(frozen=True)
class Sights:
    """Places of creases as an image sees them, a row each; lengths are shares of `REACH` of it.

    Attributes
    ----------
    by_unknown : ndarray, shape (n, c)
        How far the place moves along the normal of the crease, by the unknowns of a Pull.
    across, clear : ndarray, shape (n, k)
        Distances along the normal, and how clear an edge of the image is there, 0 to 1.
    number : ndarray of int, shape (n,)
        Of the crease.
    """

    by_unknown: np.ndarray
    across: np.ndarray
    clear: np.ndarray
    number: np.ndarray

    @property
    def trust(self) -> np.ndarray:
        """Places of one crease count as one together, (n,)."""
        _, crease, count = np.unique(self.number, return_inverse=True, return_counts=True)
        return 1 / count[crease]

    def after(self, slip: float) -> "Sights":
        """The same where the head slipped, radians."""
        return replace(self, across=self.across - slip * self.by_unknown[:, -1:])


def sights(creases: Creases, view: View) -> Sights:
    """Look in an image for edges near creases.

    Parameters
    ----------
    creases : Creases
    view : View

    Returns
    -------
    Sights
        Of places inside the image.
    """
    model = view.model
    points, J = view.carried(creases.points)
    reach = REACH * model.width
    recorded = project(points, model)
    inside = model.shows(recorded, reach)
    by_point = pinhole_jacobian(points[inside], model)
    way = view.T_camera_platform.rotation.apply(creases.along[inside])
    tangent = unit_vector(np.einsum("nij,nj->ni", by_point, way))
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    across, clear = _edges(view, pinhole(points[inside], model), tangent, normal)
    return Sights(
        by_unknown=np.einsum("ni,nij,njk->nk", normal, by_point, J[inside]) / reach,
        across=across / reach,
        clear=clear,
        number=creases.number[inside],
    )


def _edges(view, places, tangent, normal):
    """Offsets (n, k) of edges in pixels from pixels (n, 2) along their normals (n, 2), and how
    clear each is, 0 to 1.
    """
    reach = REACH * view.model.width
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


def creases_pulls(of_creases: dict[str, list[Sights]], rig: CalibratedRig) -> list[Pull]:
    """What creases and edges say about each camera that sees some: each place may go with one of
    several edges, or with none.

    A slip of the head is sought under all cameras on the base, then the pose of each camera with a
    width that narrows (expectation and maximisation). Places of one crease err together.

    Parameters
    ----------
    of_creases : dict of str to list of Sights
        By camera and image.
    rig : CalibratedRig

    Returns
    -------
    list of Pull
    """
    names = Sights.__dataclass_fields__
    mounted: dict[str, list] = {"head": [], "platform": []}
    for camera, parts in of_creases.items():
        if sum(len(part.number) for part in parts):
            rows = {n: np.concatenate([getattr(p, n) for p in parts]) for n in names}
            looks = mounted[rig.cameras[camera].mount]
            looks.append((Sights(**rows), poses_of(rig, camera)))
    pulls = [_pull(seen, poses, 0.0) for seen, poses in mounted["head"]]
    slip = _slip(mounted["platform"])
    if slip is not None:
        pulls += [_pull(seen, poses, slip) for seen, poses in mounted["platform"]]
    return pulls


def _slip(fixed):
    """By how much the head slipped under cameras on the base that creases meet edges, radians; 0
    where that explains no more than chance finds (Schwarz's criterion), None where it must matter.
    """
    explained = np.zeros(len(SLIPS))
    creases = 1
    for seen, poses in fixed:
        explained += [_fitted(seen.after(slip), poses, HONEST)[1] for slip in SLIPS]
        creases += len(np.unique(seen.number))
    slip = SLIPS[np.argmax(explained)]
    if explained.max() - explained[SLIPS == 0] > np.log(creases) / 2:
        return slip
    return None if abs(slip) > MATTERS else 0.0


def _pull(seen, poses, slip):
    """The Pull of a camera whose pose stands in these columns (6,), after a slip of the head."""
    after = seen.after(slip)
    x, fit = _fitted(after, poses, HONEST)
    moved, fit_moved = _fitted(after, poses, SPREAD)
    # edges run beside each other: what has moved must explain more than chance finds
    if fit_moved - fit > len(x) / 2 * np.log(len(np.unique(seen.number))):
        x = moved

    weight, pull = _weighed(after, seen.by_unknown[:, poses] @ x, WIDTHS[-1])
    information = (seen.by_unknown.T * weight) @ seen.by_unknown
    fitted = np.zeros(seen.by_unknown.shape[1])
    fitted[poses] = x
    fitted[-1] = slip
    return pull_of_groups(
        information, pull[:, None] * seen.by_unknown, seen.number, fitted, WORTH
    )


def _fitted(seen, poses, spread):
    """A camera's pose (6,) that is likely to `spread` (6,), and how much it explains, less what it
    takes for that.
    """
    by_pose = seen.by_unknown[:, poses]
    x = np.zeros(len(spread))
    for width in WIDTHS:
        weight, pull = _weighed(seen, by_pose @ x, width)
        H = (by_pose.T * weight) @ by_pose / width**2 + np.diag(spread**-2.0)
        x = x + np.linalg.solve(H, by_pose.T @ pull / width**2 - x / spread**2)
    cost = np.sum((x / spread) ** 2) / 2
    return x, _explained(seen, by_pose @ x, WIDTHS[-1]) - cost


def _explained(seen, moved, width):
    """Log likelihood of places that have moved (n,), but for a constant."""
    share, _ = _shares(seen, moved, width)
    return -float(seen.trust @ np.log(1 - share.sum(axis=1)))


def _weighed(seen, moved, width):
    """What places that have moved (n,) count, (n,), and that times how far off their edges are."""
    share, miss = _shares(seen, moved, width)
    return seen.trust * share.sum(axis=1), seen.trust * np.sum(share * miss, axis=1)


def _shares(seen, moved, width):
    """What each edge has of its place (n, k) that has moved (n,), and how far off it is."""
    miss = seen.across - moved[:, None]
    likely = seen.clear * np.exp(-0.5 * (miss / width) ** 2)
    return likely / (OUTLIERS + likely.sum(axis=1, keepdims=True)), miss
