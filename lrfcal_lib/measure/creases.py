"""Where flat surfaces of a scan meet, and by how much that misses the edges of images.

A crease is known to millimetres from planes through hundreds of readings, and no spot widens it.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.calibrate.rig_uncertainty import COLUMNS, columns_of
from lrfcal_lib.judge.uncertainty import beams_to, carried
from lrfcal_lib.measure.features import Feature
from lrfcal_lib.measure.pulls import Pull, View, pull_of_groups
from lrfcal_lib.model.camera import pinhole, pinhole_jacobian, project
from lrfcal_lib.model.geometry import POSE_NAMES
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
POSE = [COLUMNS.index(name) for name in POSE_NAMES]
REACH = 0.016  # of the image's width: 0.9 deg of a camera that sees 56 deg
ALONG = 5  # pixels of a profile that are averaged
CANDIDATES = 6  # edges of one profile, the clearest
# before anything is seen: radians and metres of a camera's pose
SPREAD = np.array([*np.radians([1.0, 1.0, 1.0]), 0.02, 0.02, 0.02])
STARTS = np.linspace(-0.75, 0.75, 7)  # of REACH, right and down
BEST_STARTS = 4
# of REACH: how far off an edge may lie, while it is sought
WIDTHS = np.geomspace(0.3, 0.09, 12)
OUTLIERS = 0.15  # of the clearest edge's weight
MISS = 1.0  # pixels, of one crease: rounded edges and shadows


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
    """Places of creases as an image sees them, a row each.

    Attributes
    ----------
    by_pose, by_all : ndarray, shapes (n, 6), (n, c)
        How far the place moves along the normal of the crease, pixels, by the camera's pose
        ``[w, v]`` (radians, metres), and by all unknowns of the rig.
    offset, weight : ndarray, shape (n, k)
        Of edges in the image: distance along the normal, pixels, and how clear they are, 0 to 1.
    number : ndarray of int, shape (n,)
        Of the crease.
    """

    by_pose: np.ndarray
    by_all: np.ndarray
    offset: np.ndarray
    weight: np.ndarray
    number: np.ndarray


def sights(creases: Creases, rig: CalibratedRig, view: View) -> Sights:
    """Look in an image for edges near creases.

    Parameters
    ----------
    creases : Creases
    rig : CalibratedRig
    view : View

    Returns
    -------
    Sights
        Of places inside the image.
    """
    model = view.model
    beams = beams_to(creases.points, rig.T_head_lrf)
    points, by_link, by_pitch = carried(view.chain, *beams, view.pitch)
    reach = REACH * model.width
    size = np.array([model.width, model.height])
    recorded = project(points, model)
    inside = ((recorded > reach) & (recorded < size - 1 - reach)).all(axis=1)
    by_point = pinhole_jacobian(points[inside], model)
    way = view.T_camera_platform.rotation.apply(creases.along[inside])
    tangent = np.einsum("nij,nj->ni", by_point, way)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    links = view.links(by_link, by_pitch)[inside]
    by_link = np.einsum("ni,nij,njk->nk", normal, by_point, links)
    offset, weight = _candidates(view, pinhole(points[inside], model), tangent, normal)
    return Sights(
        by_pose=by_link[:, POSE],
        by_all=view.spread(by_link),
        offset=offset,
        weight=weight,
        number=creases.number[inside],
    )


def _candidates(view, edge, tangent, normal):
    """Places and clearness (n, k) of edges about pixels (n, 2), along their normals (n, 2)."""
    offset = np.zeros((len(edge), CANDIDATES))
    weight = np.zeros((len(edge), CANDIDATES))
    if not len(edge):
        return offset, weight
    reach = REACH * view.model.width
    across = np.arange(-reach, reach + ACROSS_STEP_PX, ACROSS_STEP_PX)
    side = np.arange(ALONG) - ALONG // 2
    profile = edge[:, None] + side[:, None] * tangent[:, None]
    away = across[:, None, None, None] * normal[:, None]
    strips = sample(view.image, view.model, profile + away)
    mean = strips.mean(axis=2)  # NaN outside the image
    row, place, contrast = peaks(step_contrast(mean, SMOOTH_PX / ACROSS_STEP_PX, along=1))
    order = np.lexsort([-contrast, row])
    row = row[order]
    number = np.arange(len(row)) - np.searchsorted(row, row)
    kept = number < CANDIDATES
    at = (row[kept], number[kept])
    offset[at] = across[0] + ACROSS_STEP_PX * place[order][kept]
    weight[at] = (contrast / (contrast + FULL_CONTRAST))[order][kept]
    return offset, weight


def creases_pull(parts: list[Sights], rig: CalibratedRig, camera: str) -> Pull | None:
    """What creases and edges say about a camera: each place may go with one of several edges, or
    with none.

    Its pose is found from several starts, with a width that narrows (expectation and
    maximisation). Places of one crease err together.

    Parameters
    ----------
    parts : list of Sights
        Of the images of one camera.
    rig : CalibratedRig
    camera : str

    Returns
    -------
    Pull or None
        None where no crease is seen.
    """
    parts = [part for part in parts if len(part.number)]
    if not parts:
        return None
    names = Sights.__dataclass_fields__
    seen = Sights(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})
    poses = columns_of(rig.uncertainty.names, camera)[4:10]
    _, crease, count = np.unique(seen.number, return_inverse=True, return_counts=True)
    trust = 1 / count[crease]
    reach = REACH * rig.cameras[camera].model.width
    a_pixel = 1 / np.sqrt(np.mean(np.sum(seen.by_pose[:, :2] ** 2, axis=1)) / 2)
    starts = np.zeros((len(STARTS) ** 2, len(SPREAD)))
    starts[:, :2] = np.stack(np.meshgrid(STARTS, STARTS), axis=-1).reshape(-1, 2)
    starts *= reach * a_pixel
    ordered = sorted(starts, key=lambda x: -_score(seen, trust, x, WIDTHS[0] * reach))
    nothing = np.zeros(len(SPREAD))
    fits = [_narrowed(seen, trust, x, reach) for x in [nothing, *ordered[:BEST_STARTS]]]
    best = max(fits, key=lambda x: _score(seen, trust, x, WIDTHS[-1] * reach))

    likely, miss = _likely(seen, best, WIDTHS[-1] * reach)
    share = likely / (OUTLIERS + likely.sum(axis=1, keepdims=True))
    weight = trust * share.sum(axis=1) / MISS**2
    information = (seen.by_all.T * weight) @ seen.by_all
    pull = trust * np.sum(share * miss, axis=1) / MISS**2
    change = np.zeros(seen.by_all.shape[1])
    change[poses] = best
    return pull_of_groups(information, pull[:, None] * seen.by_all, crease, change, poses)


def _likely(seen, x, width):
    """How likely each edge goes with its place (n, k), and how far off it is (n, k), pixels."""
    miss = seen.offset - (seen.by_pose @ x)[:, None]
    return seen.weight * np.exp(-0.5 * (miss / width) ** 2), miss


def _score(seen, trust, x, width):
    """Log likelihood but for a constant."""
    likely, _ = _likely(seen, x, width)
    fit = trust @ np.log(OUTLIERS + likely.sum(axis=1))
    return float(fit - 0.5 * np.sum((x / SPREAD) ** 2))


def _narrowed(seen, trust, x, reach):
    """Unknowns (6,) from a start, with narrower and narrower widths."""
    J = seen.by_pose
    for width in [*WIDTHS, *WIDTHS[-1:].repeat(8)] * np.array(reach):
        likely, miss = _likely(seen, x, width)
        share = likely / (OUTLIERS + likely.sum(axis=1, keepdims=True))
        pull = trust * np.sum(share * miss, axis=1) / width**2
        weight = trust * share.sum(axis=1) / width**2
        H = (J.T * weight) @ J + np.diag(SPREAD**-2.0)
        x = x + np.linalg.solve(H, J.T @ pull - x / SPREAD**2)
    return x
