"""Points, planes and edges of a scanned cloud, lengths between them, and how good each is."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.calibrate.rig_uncertainty import columns_of
from lrfcal_lib.judge.uncertainty import (
    COLUMNS,
    carried,
    chain_of,
    range_noise,
    spread,
    uncertainty_of,
)
from lrfcal_lib.model.geometry import DegenerateGeometry, fit_plane

AT_ONCE = 1 << 16  # points
ALIKE = np.radians(15.0)  # between normals of one plane
SURE = 1e-12  # a variance of what has none
STEP = 1e-6  # of numerical derivatives: metres, radians
# metres by which a surface may be off as a whole: what lies on it, and slanted spots beside things
# (the table and the seat of the shipped session)
SYSTEMATIC = 0.001
PATCH = 40  # points that average the noise out of a patch of a wall


def with_sigma(cloud: Cloud, rig: CalibratedRig) -> Cloud:
    """The same cloud with the standard deviations of its points that a calibration predicts.

    Of the distance of a point from its surface: calibration, errors of the sweep's pitch and range
    noise along the normal (along the beam where there is none), or the scatter of readings about
    the surface where that is more: a spot averages over what is finer than itself. A turn of the
    whole cloud about the tilt axis does not count.

    Parameters
    ----------
    cloud : Cloud
    rig : CalibratedRig
        That made it.

    Returns
    -------
    Cloud
    """
    chain = chain_of(rig)
    noise = range_noise(rig)
    offset, stretch = chain.sweep_sigma
    sigma = np.zeros(len(cloud.points))
    for part in np.array_split(np.arange(len(sigma)), 1 + len(sigma) // AT_ONCE):
        pitch = cloud.pitch[part]
        _, J, by_pitch = carried(chain, cloud.bearing[part], pitch, cloud.range[part])
        normals = cloud.normals[part] @ chain.head[:, :3]
        beams = -J[..., COLUMNS.index("range_offset")]
        normals = np.where(np.isfinite(normals), normals, beams)
        calibration = spread(chain, np.einsum("ni,nij->nj", normals, J)[:, None])
        sweep = np.hypot(offset, stretch * pitch) * np.vecdot(normals, by_pitch)
        reading = np.maximum(np.abs(noise * np.vecdot(normals, beams)), cloud.sigma[part])
        sigma[part] = np.sqrt(calibration**2 + sweep**2 + reading**2)
    return replace(cloud, sigma=sigma)


def largest_plane(cloud: Cloud, tolerance: float = 0.04) -> np.ndarray:
    """Which points lie on the largest plane and face as it does to 15 deg.

    Parameters
    ----------
    cloud : Cloud
        Of n points.
    tolerance : float
        Metres.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    import open3d as o3d

    o3d.utility.random.seed(0)
    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
    (*normal, offset), _ = points.segment_plane(tolerance, 3, 500)
    near = np.abs(cloud.points @ normal + offset) < tolerance
    return near & (np.abs(cloud.normals @ normal) > np.cos(ALIKE))


def flatness(points: np.ndarray) -> tuple[np.ndarray, float]:
    """How far a wall is from a plane.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Metres.

    Returns
    -------
    miss : ndarray, shape (n,)
        Signed distance of each point, metres.
    flatness : float
        Root mean square of the mean distances of patches of `PATCH` points, without their noise.
    """
    normal, offset, _ = fit_plane(points)
    miss = points @ normal - offset
    across = np.linalg.svd(normal[None])[2][1:]
    flat = (points - points.mean(axis=0)) @ across.T
    side = np.sqrt(PATCH * np.prod(np.ptp(flat, axis=0)) / len(points))
    cells = np.rint(flat / side).astype(int)
    _, patch, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    mean = np.bincount(patch, miss) / count
    noise = np.var(miss - mean[patch]) / PATCH
    square = np.mean(mean[count >= PATCH / 2] ** 2)
    return miss, float(np.sqrt(max(square - noise, 0.0)))


class Kind(StrEnum):
    """What a feature is, the more it says of a length the later."""

    POINT = "point"
    EDGE = "edge"
    PLANE = "plane"


@dataclass(frozen=True)
class Feature:
    """A point, a plane or an edge of a scene, and how good it is.

    Attributes
    ----------
    kind : Kind
    centre : ndarray, shape (3,)
        Metres.
    axis : ndarray, shape (3,)
        Normal of a plane, direction of an edge; zeros for a point.
    noise : ndarray, shape (6, 6)
        Covariance of centre and axis from the range noise (or the points' scatter about the
        plane) and from that of image edges.
    jacobian : ndarray, shape (6, c + 2)
        Of centre and axis by what may be wrong with all points of a scan alike: the rig's unknowns,
        in the order of its uncertainty, and offset and stretch of the pitch of the sweep.
    rig : CalibratedRig
    placement : int
        The sweep.
    camera : str or None
        Whose image shows an edge.
    """

    kind: Kind
    centre: np.ndarray
    axis: np.ndarray
    noise: np.ndarray
    jacobian: np.ndarray
    rig: CalibratedRig
    placement: int
    camera: str | None = None


def by_all_unknowns(
    rig: CalibratedRig,
    camera: str | None,
    by_link: np.ndarray,
    by_offset: np.ndarray,
    by_stretch: np.ndarray,
) -> np.ndarray:
    """Derivatives (..., 13) by the links to a camera as the columns of `Feature.jacobian`.

    `by_offset` and `by_stretch` (...) are those by the pitch of the sweep.
    """
    known = uncertainty_of(rig)
    index = columns_of(known.names, camera)
    out = np.zeros((*by_link.shape[:-1], len(known.names) + 2))
    out[..., index[index >= 0]] = by_link[..., index >= 0]
    out[..., -2] = by_offset
    out[..., -1] = by_stretch
    return out


def fit_feature(
    cloud: Cloud, chosen: np.ndarray | slice, rig: CalibratedRig, plane: bool = True
) -> Feature:
    """Fit a plane, or else take the middle, of chosen points.

    Parameters
    ----------
    cloud : Cloud
    chosen : index or mask
        Of points of one sweep.
    rig : CalibratedRig
        That the cloud was made with.
    plane : bool

    Returns
    -------
    Feature

    Raises
    ------
    DegenerateGeometry
        If the points span no plane.
    """
    part = cloud.rows(chosen)
    count = len(part.points)
    if not count:
        raise DegenerateGeometry("no point of the cloud was chosen")
    chain = chain_of(rig)
    noise = range_noise(rig)
    R = chain.head[:, :3]
    _, J, by_pitch = carried(chain, part.bearing, part.pitch, part.range)
    beams = -J[..., COLUMNS.index("range_offset")] @ R.T
    by_pitch = by_pitch @ R.T
    stretched = by_pitch * part.pitch[:, None]
    moved = by_all_unknowns(rig, None, R @ J, by_pitch, stretched)
    normal = np.zeros(3)
    covariance = np.zeros((6, 6))
    jacobian = np.zeros((6, moved.shape[-1]))
    jacobian[:3] = moved.mean(axis=0)
    centre = part.points.mean(axis=0)
    covariance[:3, :3] = noise**2 * beams.T @ beams / count**2
    if plane:
        normal, _, rough = fit_plane(part.points)
        variance = max(noise**2 * np.mean((beams @ normal) ** 2), rough**2) / count
        size, axes = np.linalg.eigh(np.cov(part.points.T, bias=True))
        variance *= _bent(part.points - centre, axes, size)
        # of the normal by the mean of products of places and heights
        turned = -(axes[:, 1:] / size[1:]) @ axes[:, 1:].T
        jacobian[3:] = turned @ (part.points - centre).T @ (normal @ moved) / count
        covariance[:3, :3] = (variance + SYSTEMATIC**2) * np.outer(normal, normal)
        covariance[3:, 3:] = -variance * turned
    kind = Kind.PLANE if plane else Kind.POINT
    placement = int(part.placement[0])
    return Feature(kind, centre, normal, covariance, jacobian, rig, placement)


def _bent(off, axes, size):
    """By how much more a plane varies than by the noise of its points, at least 1.

    Readings of one part of a surface may err alike: the sandwich of its nine parts. `off` (n, 3) is
    from the centre, `axes` and `size` are the principal ones.
    """
    height, *along = (off @ axes).T
    part = np.zeros(len(off), int)
    for flat in along:
        third = (flat - flat.min()) / max(np.ptp(flat), SURE) * 3
        part = 3 * part + np.minimum(third.astype(int), 2)
    design = np.column_stack([np.ones(len(off)), *along]) / np.sqrt([1.0, *size[1:]])
    scores = np.zeros((9, 3))
    np.add.at(scores, part, design * height[:, None])
    parts = len(np.unique(part))
    square = np.sum(scores**2) / 3 * parts / max(parts - 3, 1)
    return max(1.0, square / max(len(off) * size[0], SURE))


def length_between(first: Feature, second: Feature) -> tuple[float, float]:
    """Length between two features and its standard deviation, metres.

    Along the normal of a plane, else across the direction of an edge, else from point to point; of
    two planes or edges their mean counts, each weighted by how well it is known. What the
    calibration has wrong counts as far as it moves the two apart.

    Parameters
    ----------
    first, second : Feature
        Of one rig.

    Returns
    -------
    length, sigma : float

    Raises
    ------
    DegenerateGeometry
        For planes or edges that are not parallel to 15 deg.
    """
    _refuse_askew(first, second)
    kind, weights = _axes(first, second)
    place = np.concatenate([first.centre, first.axis, second.centre, second.axis])
    length = _length(place, kind, weights)
    steps = STEP * np.eye(12)
    higher = np.array([_length(place + step, kind, weights) for step in steps])
    lower = np.array([_length(place - step, kind, weights) for step in steps])
    by_first, by_second = np.split((higher - lower) / (2 * STEP), 2)
    variance = by_first @ first.noise @ by_first + by_second @ second.noise @ by_second
    moved = [by_first @ first.jacobian, by_second @ second.jacobian]
    by_sweep = np.array([change[-2:] for change in moved])
    if first.placement == second.placement:
        by_sweep = by_sweep.sum(axis=0, keepdims=True)
    sweep = by_sweep * uncertainty_of(first.rig).sweep_sigma
    common = _spread_of_rig(first, second, (moved[0] + moved[1])[:-2])
    return length, float(np.sqrt(variance + np.sum(sweep**2) + common**2))


def _refuse_askew(first, second):
    """DegenerateGeometry for planes or edges that are not parallel."""
    if Kind.POINT in (first.kind, second.kind):
        return
    between = np.arccos(np.clip(abs(first.axis @ second.axis), 0, 1))
    if first.kind != second.kind:
        between = np.pi / 2 - between
    if between > ALIKE:
        raise DegenerateGeometry(
            f"{first.kind} and {second.kind} are {np.degrees(between):.0f} deg from parallel: "
            "pick two that are, or points of them"
        )


def _axes(first, second):
    """Which kind of axes a length goes by, and their weights, which turn them to one side."""
    features = (first, second)
    kind = max((feature.kind for feature in features), key=list(Kind).index)
    weights = np.zeros(2)
    for number, feature in enumerate(features):
        if feature.kind == kind != Kind.POINT:
            weights[number] = 1 / max(np.trace(feature.noise[3:, 3:]), SURE)
    if first.axis @ second.axis < 0:
        weights[1] = -weights[1]
    return kind, weights / max(np.abs(weights).sum(), SURE)


def _length(place, kind, weights):
    """Length between two features with these centres and axes (12,)."""
    first, first_axis, second, second_axis = place.reshape(4, 3)
    way = second - first
    along = weights[0] * first_axis + weights[1] * second_axis
    along = along / max(np.linalg.norm(along), SURE)
    if kind == Kind.PLANE:
        return float(abs(along @ way))
    return float(np.linalg.norm(way - (way @ along) * along))


def _spread_of_rig(first, second, by_unknowns):
    """Standard deviation of a length from all unknowns of the rig, of which it has derivatives
    (c,); inf where a motion that nothing determines matters.
    """
    rig = first.rig
    unseen = [unseen_motions(rig, feature.camera) for feature in (first, second)]
    chain = replace(
        chain_of(rig), covariances=shared_covariances(rig), unseen=np.concatenate(unseen)
    )
    return float(spread(chain, by_unknowns[None]))


def shared_covariances(rig: CalibratedRig) -> tuple[np.ndarray, np.ndarray]:
    """Covariances (c, c) of a rig's unknowns, of which the one that gives more counts; zero where
    nothing bounds them, see :func:`unseen_motions`.
    """
    known = uncertainty_of(rig)
    noise_only = np.where(np.isfinite(known.covariance), known.covariance, 0.0)
    trusted = np.where(np.isfinite(known.trusted), known.trusted, 0.0)
    return noise_only, trusted


def unseen_motions(rig: CalibratedRig, camera: str | None) -> np.ndarray:
    """Motions (m, c) of a rig's unknowns that nothing determines, and that move points of the cloud
    or what a camera sees.
    """
    known = uncertainty_of(rig)
    motions = known.unseen_of_cloud
    if camera is not None:
        motions = known.unseen_of_cameras[camera]
    still = np.zeros(len(motions))
    return by_all_unknowns(rig, camera, motions, still, still)[:, :-2]
