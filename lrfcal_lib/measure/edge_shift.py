"""By how much the rims of a sweep miss the edges of images: a camera's pose anew, and how sure."""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit
from scipy.stats import f as fisher

from lrfcal_lib.calibrate.mixed import PULSE
from lrfcal_lib.calibrate.rig_uncertainty import COLUMNS
from lrfcal_lib.judge.uncertainty import Chain, carried
from lrfcal_lib.measure.depth_jumps import DepthJumps
from lrfcal_lib.model.camera import CameraModel, pinhole, pinhole_jacobian, project
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
# readings change over, of blended ones and of first echoes; of the reflectivity by what the image
# shows
SPREAD = np.array([*np.radians([1.0, 1.0, 1.0]), 0.02, 0.02, 0.02, 0.7, 0.7, 0.5])
# readings that blend are halfway where both surfaces return as much; a receiver takes the first
# echo that has a quarter of the strongest (simulate.beam; the makers state nothing)
BLENDED = 0.0
FIRST_ECHO = np.log(0.25)
OUTSIDE = np.linspace(1, -1, 201)  # spot radii of the spot's middle from the rim
SHARE = (np.arccos(OUTSIDE) - OUTSIDE * np.sqrt(1 - OUTSIDE**2)) / np.pi
STARTS = np.linspace(-0.75, 0.75, 7)  # of REACH, right and down
BEST_STARTS = 4
WIDTHS = np.geomspace(0.3, 0.09, 12)  # of REACH: how far off an edge may lie, while it is sought
OUTLIERS = 0.15  # of the clearest edge's weight
RIM_SHARE = 0.25  # of the variance of places on a rim that all of them have in common


@dataclass(frozen=True)
class Sights:
    """Places of rims as images see them, a row each.

    Attributes
    ----------
    uv, normal : ndarray, shape (n, 2)
        Undistorted pixels; the unit normal points away from the nearer surface.
    by_unknown : ndarray, shape (n, 9)
        How far an edge moves along the normal, pixels: by the camera's pose ``[w, v]`` (radians,
        metres) and by the edge bias of blended readings and of echoes (spot radii).
    by_link : ndarray, shape (n, 14)
        By `COLUMNS` of the calibration and by the pitch of the sweep.
    offset, weight : ndarray, shape (n, k)
        Of edges in the image: distance along the normal, pixels, and how clear they are, 0 to 1.
    rim : ndarray of int, shape (n,)
    """

    uv: np.ndarray
    normal: np.ndarray
    by_unknown: np.ndarray
    by_link: np.ndarray
    offset: np.ndarray
    weight: np.ndarray
    rim: np.ndarray


@dataclass(frozen=True)
class EdgeShift:
    """How a camera would have to sit for the rims to meet the edges.

    Attributes
    ----------
    pose, pose_covariance : ndarray, shapes (6,), (6, 6)
        Increments ``[w, v]`` of the camera's pose, radians and metres; the calibration's own
        covariance is in it.
    bias : ndarray, shape (2,)
        Spot radii, of blended readings and of echoes.
    shift, shift_sigma : ndarray, shape (3,)
        What the pose does to the image: right and down (pixels), and a turn about its middle
        (radians).
    p_value : float
        Probability of such a pose where nothing has moved.
    rims, places : int
        That tell it; rims by their weight.
    scatter : float
        Pixels, of edges about their rims.
    """

    pose: np.ndarray
    pose_covariance: np.ndarray
    bias: np.ndarray
    shift: np.ndarray
    shift_sigma: np.ndarray
    p_value: float
    rims: float
    places: int
    scatter: float


def sights(
    jumps: DepthJumps,
    chain: Chain,
    model: CameraModel,
    image: np.ndarray,
    image_pitch: float,
) -> Sights:
    """Look in an image for edges near the rims of a sweep.

    Parameters
    ----------
    jumps : DepthJumps
    chain : Chain
        To the camera.
    model : CameraModel
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    image_pitch : float
        True pitch, radians.

    Returns
    -------
    Sights
        Of places inside the image.
    """
    beams = np.stack([jumps.bearing, jumps.pitch])

    def seen(directions):
        points, by_link, by_pitch = carried(chain, *directions, jumps.range, image_pitch)
        return pinhole(points, model), points, by_link, by_pitch

    uv, points, by_link, by_pitch = seen(beams)
    along = (seen(beams + ASIDE * jumps.along.T)[0] - uv) / ASIDE
    outward = (seen(beams + ASIDE * jumps.outward.T)[0] - uv) / ASIDE
    normal = np.stack([along[:, 1], -along[:, 0]], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal *= np.sign(np.vecdot(normal, outward))[:, None]
    reach = REACH * model.width
    size = np.array([model.width, model.height])
    recorded = project(points, model)
    inside = ((recorded > reach) & (recorded < size - 1 - reach)).all(axis=1)

    n = normal[inside]
    spot = np.vecdot(n, outward[inside]) * (jumps.radius / jumps.range)[inside]
    blended = (jumps.behind - jumps.range)[inside] < PULSE
    farther = np.log(jumps.behind / jumps.range)[inside]
    odds = np.where(blended, BLENDED, FIRST_ECHO) - 2 * farther
    outside, by_odds = _change_over(odds)
    edge = uv[inside] - (spot * outside)[:, None] * n

    across = np.arange(-reach, reach + ACROSS_STEP_PX, ACROSS_STEP_PX)
    tangent = np.stack([-n[:, 1], n[:, 0]], axis=-1)
    side = np.arange(ALONG) - ALONG // 2
    profile = edge[:, None] + side[:, None] * tangent[:, None]
    strips = sample(image, model, profile + across[:, None, None, None] * n[:, None])
    offset, weight = _candidates(strips, across)

    brighter = _brightness(strips, across)
    P = np.einsum("ni,nij->nj", n, pinhole_jacobian(points[inside], model))
    links = np.concatenate([by_link, by_pitch[..., None]], axis=-1)[inside]
    by_link = np.einsum("nj,njk->nk", P, links)
    kinds = np.stack([blended, ~blended, brighter], axis=-1)
    return Sights(
        uv=edge,
        normal=n,
        by_unknown=np.hstack([by_link[:, POSE], -(spot * by_odds)[:, None] * kinds]),
        by_link=by_link,
        offset=offset,
        weight=weight,
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


def _brightness(strips, across):
    """Logarithm (n,) of the red outside of a rim over that inside, as an image has it."""
    red = np.nanmean(strips[..., -1], axis=2)
    beside = [across > 6, across < -6]
    outer, inner = (np.nan_to_num(np.nanmean(red[side], axis=0)) for side in beside)
    return np.log((outer + 5.0) / (inner + 5.0))


def _candidates(strips, across):
    """Places and clearness (n, k) of steps in strips (across, n, along, channels)."""
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


def edge_shift(seen: Sights, chain: Chain, model: CameraModel) -> EdgeShift:
    """The camera's pose, robustly: every rim may go with one of several edges, or with none.

    From several starts, with a width that narrows (expectation and maximisation). Places of one rim
    err together: the covariance is that of the rims' pulls.

    Parameters
    ----------
    seen : Sights
        Of one place or more.
    chain : Chain
        To the camera.
    model : CameraModel
    """
    _, rim, count = np.unique(seen.rim, return_inverse=True, return_counts=True)
    trust = 1 / (1 - RIM_SHARE + RIM_SHARE * count[rim])
    reach = REACH * model.width
    turns = [[-v / model.fy, u / model.fx] for u in STARTS * reach for v in STARTS * reach]
    starts = np.zeros((len(turns), len(SPREAD)))
    starts[:, :2] = turns
    width = WIDTHS[0] * reach
    starts = sorted(starts, key=lambda x: -_score(seen, trust, x, width))[:BEST_STARTS]
    fits = [_narrowed(seen, trust, start, reach) for start in [np.zeros(len(SPREAD)), *starts]]
    best = max(fits, key=lambda x: _score(seen, trust, x, WIDTHS[-1] * reach))
    return _judged(seen, trust, rim, best, chain, model)


def _shares(seen, x, width):
    """What each edge has of its place (n, k), and what is left over (n, k) in pixels."""
    miss = seen.offset - (seen.by_unknown @ x)[:, None]
    likely = seen.weight * np.exp(-0.5 * (miss / width) ** 2)
    return likely / (OUTLIERS + likely.sum(axis=1, keepdims=True)), miss


def _score(seen, trust, x, width):
    """Log likelihood but for a constant."""
    miss = seen.offset - (seen.by_unknown @ x)[:, None]
    likely = seen.weight * np.exp(-0.5 * (miss / width) ** 2)
    prior = 0.5 * np.sum((x / SPREAD) ** 2)
    return float(trust @ np.log(OUTLIERS + likely.sum(axis=1)) - prior)


def _narrowed(seen, trust, x, reach):
    """Unknowns (9,) from a start, with narrower and narrower widths."""
    J = seen.by_unknown
    for width in [*WIDTHS, *WIDTHS[-1:].repeat(8)] * np.array(reach):
        share, miss = _shares(seen, x, width)
        pull = trust * np.sum(share * miss, axis=1) / width**2
        weight = trust * share.sum(axis=1) / width**2
        H = (J.T * weight) @ J + np.diag(SPREAD**-2.0)
        x = x + np.linalg.solve(H, J.T @ pull - x / SPREAD**2)
    return x


def _judged(seen, trust, rim, x, chain, model):
    """The EdgeShift of unknowns (9,)."""
    J = seen.by_unknown
    width = WIDTHS[-1] * REACH * model.width
    share, miss = _shares(seen, x, width)
    pull = trust * np.sum(share * miss, axis=1) / width**2
    weight = trust * share.sum(axis=1) / width**2
    H = (J.T * weight) @ J + np.diag(SPREAD**-2.0)
    by_rim = np.zeros((rim.max() + 1, len(x)))
    np.add.at(by_rim, rim, pull[:, None] * J)
    load = np.bincount(rim, weight)
    rims = float(load.sum() ** 2 / np.sum(load**2))
    free = max(rims - len(x), 1.0)
    of_edges = by_rim.T @ by_rim * rims / free
    into = np.linalg.solve(H, (J.T * weight) @ seen.by_link)
    offset, _ = chain.sweep_sigma
    covariance = np.linalg.solve(H, np.linalg.solve(H, of_edges).T)
    known = [into[:, :-1] @ C @ into[:, :-1].T for C in chain.covariances]
    covariance = covariance + max(known, key=np.trace)
    covariance = covariance + offset**2 * np.outer(into[:, -1], into[:, -1])
    pose = x[:6]
    C = covariance[:6, :6]
    square = pose @ np.linalg.solve(C, pose)
    shift = _image_motion(seen, weight, model)
    return EdgeShift(
        pose=pose,
        pose_covariance=C,
        bias=x[6:],
        shift=shift @ pose,
        shift_sigma=np.sqrt(np.diag(shift @ C @ shift.T)),
        p_value=float(fisher.sf(square / 6 * free / max(rims - 1, 1), 6, free)),
        rims=rims,
        places=len(seen.rim),
        scatter=float(np.sqrt(np.sum(trust[:, None] * share * miss**2) / np.sum(trust[:, None] * share))),
    )


def _image_motion(seen, weight, model):
    """Right, down and turn (3, 6) of the image by the pose, as places along their normals see it."""
    from_middle = seen.uv - [model.cx, model.cy]
    turn = np.vecdot(seen.normal, np.stack([-from_middle[:, 1], from_middle[:, 0]], -1))
    plain = np.column_stack([seen.normal, turn])
    left = (plain.T * weight) @ plain
    return np.linalg.solve(left, (plain.T * weight) @ seen.by_unknown[:, :6])
