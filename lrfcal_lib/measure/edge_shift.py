"""By how much the rims of a sweep miss the edges of images, and what that says about a camera."""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from lrfcal_lib.calibrate.mixed import PULSE
from lrfcal_lib.calibrate.rig_uncertainty import COLUMNS
from lrfcal_lib.judge.uncertainty import carried
from lrfcal_lib.measure.depth_jumps import DepthJumps
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

POSE = [COLUMNS.index(name) for name in POSE_NAMES]
ASIDE = 1e-4  # radians, of numeric derivatives along and across a rim
REACH = 0.016  # of the image's width: 0.9 deg of a camera that sees 56 deg
ALONG = 5  # pixels of a profile that are averaged
CANDIDATES = 6  # edges of one profile, the clearest
# before anything is seen: radians and metres of a pose; log odds of the share of a spot at which
# readings change over, of blended ones and of first echoes
SPREAD = np.array([*np.radians([1.0, 1.0, 1.0]), 0.02, 0.02, 0.02, 0.7, 0.7])
# readings that blend are halfway where both surfaces return as much; a receiver takes the first
# echo that has a quarter of the strongest (simulate.beam; the makers state nothing)
BLENDED = 0.0
FIRST_ECHO = np.log(0.25)
OUTSIDE = np.linspace(1, -1, 201)  # spot radii of the spot's middle from the rim
SHARE = (np.arccos(OUTSIDE) - OUTSIDE * np.sqrt(1 - OUTSIDE**2)) / np.pi
STARTS = np.linspace(-0.75, 0.75, 7)  # of REACH, right and down
BEST_STARTS = 4
WIDTHS = np.geomspace(
    0.3, 0.09, 12
)  # of REACH: how far off an edge may lie, while it is sought
OUTLIERS = 0.15  # of the clearest edge's weight
UNKNOWN_BIAS = 0.3  # spot radii, of one rim: reflectivities differ by a factor of 2
LEAST_MISS = 1.0  # pixels, of rounded rims and shadows


@dataclass(frozen=True)
class Sights:
    """Places of rims as images see them, a row each.

    Attributes
    ----------
    by_unknown : ndarray, shape (n, 8)
        How far an edge moves along the normal, pixels: by the camera's pose ``[w, v]`` (radians,
        metres) and by the edge bias of blended readings and of first echoes (log odds).
    by_all : ndarray, shape (n, c)
        By all unknowns of the rig.
    offset, weight : ndarray, shape (n, k)
        Of edges in the image: distance along the normal, pixels, and how clear they are, 0 to 1.
    sigma : ndarray, shape (n,)
        Of what the edge bias of a rim has of its own, pixels.
    rim : ndarray of int, shape (n,)
    """

    by_unknown: np.ndarray
    by_all: np.ndarray
    offset: np.ndarray
    weight: np.ndarray
    sigma: np.ndarray
    rim: np.ndarray


def sights(jumps: DepthJumps, view: View) -> Sights:
    """Look in an image for edges near the rims of a sweep.

    Parameters
    ----------
    jumps : DepthJumps
    view : View

    Returns
    -------
    Sights
        Of places inside the image.
    """
    model = view.model
    blended = jumps.behind - jumps.range < PULSE
    odds = np.where(blended, BLENDED, FIRST_ECHO) + jumps.returns
    outside, by_odds = _change_over(odds)
    angle = jumps.radius / jumps.range
    beams = np.stack([jumps.bearing, jumps.pitch]) - outside * angle * jumps.outward.T
    ranges = jumps.range - outside * angle * jumps.slope

    def seen(directions):
        points, by_link, by_pitch = carried(view.chain, *directions, ranges, view.pitch)
        return pinhole(points, model), points, by_link, by_pitch

    edge, points, by_link, by_pitch = seen(beams)
    along = (seen(beams + ASIDE * jumps.along.T)[0] - edge) / ASIDE
    outward = (seen(beams + ASIDE * jumps.outward.T)[0] - edge) / ASIDE
    normal = np.stack([along[:, 1], -along[:, 0]], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal *= np.sign(np.vecdot(normal, outward))[:, None]
    reach = REACH * model.width
    size = np.array([model.width, model.height])
    recorded = project(points, model)
    inside = ((recorded > reach) & (recorded < size - 1 - reach)).all(axis=1)
    n = normal[inside]
    spot = (np.vecdot(normal, outward) * angle)[inside]

    offset, weight = _candidates(view, edge[inside], n, reach)

    P = np.einsum("ni,nij->nj", n, pinhole_jacobian(points[inside], model))
    links = view.links(by_link, by_pitch)[inside]
    by_link = np.einsum("nj,njk->nk", P, links)
    biases = (
        -(spot * by_odds[inside])[:, None] * np.stack([blended, ~blended], axis=-1)[inside]
    )
    return Sights(
        by_unknown=np.hstack([by_link[:, POSE], biases]),
        by_all=view.spread(by_link),
        offset=offset,
        weight=weight,
        sigma=np.hypot(UNKNOWN_BIAS * spot, LEAST_MISS),
        rim=jumps.rim[inside],
    )


def _change_over(odds):
    """How far outside a rim the middle of a spot is when the nearer surface has a share of it with
    these log odds (n,), spot radii, and the derivative.
    """
    outside = np.interp(expit(odds), SHARE, OUTSIDE)
    more = np.interp(expit(odds + 0.1), SHARE, OUTSIDE)
    less = np.interp(expit(odds - 0.1), SHARE, OUTSIDE)
    return outside, (more - less) / 0.2


def _candidates(view, edge, n, reach):
    """Places and clearness (n, k) of edges about pixels (n, 2), along their normals (n, 2)."""
    if not len(edge):
        return np.zeros((0, CANDIDATES)), np.zeros((0, CANDIDATES))
    across = np.arange(-reach, reach + ACROSS_STEP_PX, ACROSS_STEP_PX)
    tangent = np.stack([-n[:, 1], n[:, 0]], axis=-1)
    side = np.arange(ALONG) - ALONG // 2
    profile = edge[:, None] + side[:, None] * tangent[:, None]
    away = across[:, None, None, None] * n[:, None]
    strips = sample(view.image, view.model, profile + away)
    count = strips.shape[1]
    mean = strips.mean(axis=2)  # NaN outside the image
    height = step_contrast(mean, SMOOTH_PX / ACROSS_STEP_PX, along=1)
    row, place, contrast = peaks(height)
    order = np.lexsort([-contrast, row])
    row = row[order]
    number = np.arange(len(row)) - np.searchsorted(row, row)
    kept = number < CANDIDATES
    at = (row[kept], number[kept])
    offset = np.zeros((count, CANDIDATES))
    weight = np.zeros((count, CANDIDATES))
    offset[at] = across[0] + ACROSS_STEP_PX * place[order][kept]
    weight[at] = (contrast / (contrast + FULL_CONTRAST))[order][kept]
    return offset, weight


def join(parts: list[Sights]) -> Sights:
    """Sights of several images as one."""
    names = Sights.__dataclass_fields__
    return Sights(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})


def edges_pull(seen: Sights, poses: np.ndarray, width: int) -> Pull:
    """What rims and edges say about a camera: every rim may go with one of several edges, or with
    none.

    Its pose is found from several starts, with a width that narrows (expectation and
    maximisation). Places of one rim err together.

    Parameters
    ----------
    seen : Sights
        Of one place or more.
    poses : ndarray of int, shape (6,)
        Where the pose stands among the unknowns.
    width : int
        Of the image, pixels.
    """
    _, rim, count = np.unique(seen.rim, return_inverse=True, return_counts=True)
    trust = 1 / count[rim]
    reach = REACH * width
    turns = seen.by_unknown[:, :2]
    a_pixel = 1 / np.sqrt(np.mean(np.sum(turns**2, axis=1)) / 2 + 1e-12)
    starts = np.zeros((len(STARTS) ** 2, len(SPREAD)))
    starts[:, :2] = np.stack(np.meshgrid(STARTS, STARTS), axis=-1).reshape(-1, 2)
    starts *= reach * a_pixel
    ordered = sorted(starts, key=lambda x: -_score(seen, trust, x, WIDTHS[0] * reach))
    nothing = np.zeros(len(SPREAD))
    fits = [_narrowed(seen, trust, x, reach) for x in [nothing, *ordered[:BEST_STARTS]]]
    best = max(fits, key=lambda x: _score(seen, trust, x, WIDTHS[-1] * reach))

    share, miss = _shares(seen, best, WIDTHS[-1] * reach)
    weight = trust * share.sum(axis=1) / seen.sigma**2
    biases = seen.by_unknown[:, 6:]
    both = np.hstack([seen.by_all, biases])
    whole = (both.T * weight) @ both
    inner = whole[-2:, -2:] + np.diag(SPREAD[6:] ** -2.0)
    taken = whole[:-2, -2:] @ np.linalg.inv(inner)
    information = whole[:-2, :-2] - taken @ whole[-2:, :-2]
    free = seen.by_all - biases @ taken.T
    pull = trust * np.sum(share * miss, axis=1) / seen.sigma**2
    change = np.zeros(seen.by_all.shape[1])
    change[poses] = best[:6]
    return pull_of_groups(information, pull[:, None] * free, rim, change, poses)


def _shares(seen, x, width):
    """What each edge has of its place (n, k), and how far off it is (n, k), pixels."""
    miss = seen.offset - (seen.by_unknown @ x)[:, None]
    likely = seen.weight * np.exp(-0.5 * (miss / width) ** 2)
    return likely / (OUTLIERS + likely.sum(axis=1, keepdims=True)), miss


def _score(seen, trust, x, width):
    """Log likelihood but for a constant."""
    miss = seen.offset - (seen.by_unknown @ x)[:, None]
    likely = seen.weight * np.exp(-0.5 * (miss / width) ** 2)
    return float(
        trust @ np.log(OUTLIERS + likely.sum(axis=1)) - 0.5 * np.sum((x / SPREAD) ** 2)
    )


def _narrowed(seen, trust, x, reach):
    """Unknowns (8,) from a start, with narrower and narrower widths."""
    J = seen.by_unknown
    for width in [*WIDTHS, *WIDTHS[-1:].repeat(8)] * np.array(reach):
        share, miss = _shares(seen, x, width)
        pull = trust * np.sum(share * miss, axis=1) / width**2
        weight = trust * share.sum(axis=1) / width**2
        H = (J.T * weight) @ J + np.diag(SPREAD**-2.0)
        x = x + np.linalg.solve(H, J.T @ pull - x / SPREAD**2)
    return x
