"""Points, planes and edges of a scanned cloud, lengths between them, and how good each is."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.linalg import block_diag, null_space

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.judge.uncertainty import (
    COLUMNS,
    carried,
    chain_of,
    spread,
)
from lrfcal_lib.model.geometry import DegenerateGeometry, fit_plane, length_of, unit_vector

AT_ONCE = 1 << 16  # points
ALIKE = np.radians(15.0)  # between normals of one plane
FACING = np.cos(ALIKE)
SURE = 1e-12  # a variance of what has none
# metres by which a surface may be off as a whole, for every station alike: what lies on it, and
# slanted spots beside things (the table and the seat of the shipped session)
SYSTEMATIC = 0.001
UNBOUNDED = 1.0  # variance (m2, rad2) of an unknown of the rig that nothing bounds
NINETY = 1.645  # standard deviations to either side that hold 90 %
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
    noise = rig.known.range_noise
    sigma = np.zeros(len(cloud.points))
    for rows in np.array_split(np.arange(len(sigma)), 1 + len(sigma) // AT_ONCE):
        part = cloud.rows(rows)
        _, J, by_pitch = carried(chain, part.bearing, part.pitch, part.range)
        normals = part.normals @ chain.head.rotation.as_matrix()
        beams = -J[..., COLUMNS.index("range_offset")]
        normals = np.where(np.isfinite(normals), normals, beams)
        calibration = spread(chain, normals[:, None] @ J)
        sweep = chain.sweep.sigma(part.pitch, 0.0) * np.vecdot(normals, by_pitch)
        reading = np.maximum(np.abs(noise * np.vecdot(normals, beams)), part.sigma)
        sigma[rows] = np.linalg.norm([calibration, sweep, reading], axis=0)
    return replace(cloud, sigma=sigma)


def moved_along(normals: np.ndarray, cloud: Cloud, rig: CalibratedRig) -> np.ndarray:
    """How errors move the points of a sweep along directions, whatever stands on the head.

    Parameters
    ----------
    normals : ndarray, shape (n, 3) or (3,)
        Platform frame.
    cloud : Cloud
        Of n points.
    rig : CalibratedRig
        That made it.

    Returns
    -------
    ndarray, shape (n, 15)
        By what the calibration may have wrong, see `COLUMNS`, and by one sigma of the sweep's own
        offset and stretch of the pitch.
    """
    chain = replace(chain_of(rig), on_head=False)
    _, J, by_pitch = carried(chain, cloud.bearing, cloud.pitch, cloud.range)
    turn = np.vecdot(normals, by_pitch)
    by_stretch = chain.sweep.stretch * cloud.pitch * turn
    by_rig = np.vecmat(normals, J)
    return np.column_stack([by_rig, chain.sweep.offset * turn, by_stretch])


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
    return near & (np.abs(cloud.normals @ normal) > FACING)


def flatness(points: np.ndarray, together: int = PATCH) -> tuple[np.ndarray, float]:
    """How far a wall is from a plane.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Metres.
    together : int
        How many of them average the noise out of a patch.

    Returns
    -------
    miss : ndarray, shape (n,)
        Signed distance of each point, metres.
    flatness : float
        Root mean square of the mean distances of patches, without their noise.
    """
    normal, offset, _ = fit_plane(points)
    miss = points @ normal - offset
    flat = (points - points.mean(axis=0)) @ null_space(normal[None])
    side = np.sqrt(together * np.prod(np.ptp(flat, axis=0)) / len(points))
    cells = np.rint(flat / side).astype(int)
    _, patch, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    mean = np.bincount(patch, miss) / count
    noise = np.var(miss - mean[patch]) / together
    square = np.mean(mean[count >= together / 2] ** 2)
    return miss, np.sqrt(max(square - noise, 0.0))


class Kind(StrEnum):
    """What a feature is, the more it says of a length the later."""

    POINT = "point"
    EDGE = "edge"
    PLANE = "plane"


@dataclass(frozen=True)
class Feature:
    """A point, a plane or an edge that one station shows, and how good it is.

    Attributes
    ----------
    kind : Kind
    centre : ndarray, shape (3,)
        Platform frame, metres.
    axis : ndarray, shape (3,)
        Normal of a plane, direction of an edge; zeros for a point.
    noise : ndarray, shape (6, 6)
        Covariance of centre and axis from the scatter of the points and that of image edges.
    jacobian : ndarray, shape (6, c + 3)
        Of centre and axis by the c unknowns of the rig in the order of its uncertainty, by offset
        and stretch of the sweep's pitch, and by what the surface is off as a whole.
    rig : CalibratedRig
    placement : int
        The sweep.
    ends : ndarray, shape (2, 3)
        Of the stretch of an edge that an image shows; the centre twice for others.
    image : int
        Number of the image that shows an edge, -1 for others.
    """

    kind: Kind
    centre: np.ndarray
    axis: np.ndarray
    noise: np.ndarray
    jacobian: np.ndarray
    rig: CalibratedRig
    placement: int
    ends: np.ndarray
    image: int = -1

    def is_same(self, other: "Feature") -> bool:
        """Whether another one is this feature, taken once more."""
        return np.array_equal(self.centre, other.centre)

    def lies_along(self, axis: np.ndarray | None) -> bool:
        """Whether its axis is parallel to another one (3,) to 15 deg; None is to all."""
        return axis is None or abs(self.axis @ axis) > FACING

    def foot(self, place: np.ndarray) -> np.ndarray:
        """The places (..., 3) on the plane or the line of an edge that are nearest to others."""
        along = np.multiply.outer((place - self.centre) @ self.axis, self.axis)
        if self.kind == Kind.PLANE:
            return place - along
        return self.centre + along

    def height_by(self, places: np.ndarray) -> np.ndarray:
        """Derivatives (n, 6) of the height of a plane at places (n, 3) by its centre and axis."""
        normals = np.broadcast_to(self.axis, places.shape)
        return np.column_stack([normals, self.centre - places])


@dataclass(frozen=True)
class Length:
    """A length and how well it is known.

    Attributes
    ----------
    metres : float
    noise : float
        Variance from what no other station has wrong, its sweep included, m2.
    shared : ndarray, shape (c + 2,)
        Derivatives by what all stations have wrong alike: the unknowns of the rig, and what the
        surfaces at both ends are off as a whole.
    rig : CalibratedRig
    """

    metres: float
    noise: float
    shared: np.ndarray
    rig: CalibratedRig

    @property
    def sigma(self) -> float:
        """Standard deviation, metres."""
        by_rig, by_surfaces = np.split(self.shared, [-2])
        of_rig = max(by_rig @ C @ by_rig for C in shared_covariances(self.rig))
        of_surfaces = SYSTEMATIC**2 * by_surfaces @ by_surfaces
        return np.sqrt(self.noise + of_rig + of_surfaces)


def mean_length(lengths: Sequence[Length]) -> Length:
    """One length of what several stations measured, each weighted by how well it knows it.

    What all stations have wrong alike does not become less.

    Parameters
    ----------
    lengths : sequence of Length
        With the same rig.

    Returns
    -------
    Length
    """
    weight = np.array([1 / length.sigma**2 for length in lengths])
    weight /= weight.sum()
    return Length(
        metres=float(weight @ [length.metres for length in lengths]),
        noise=float(weight**2 @ [length.noise for length in lengths]),
        shared=weight @ [length.shared for length in lengths],
        rig=lengths[0].rig,
    )


def shared_covariances(rig: CalibratedRig) -> list[np.ndarray]:
    """Covariances (c, c) of a rig's unknowns, of which the one that gives more counts."""
    known = rig.known
    unbounded = UNBOUNDED * np.eye(len(known.names))
    return [
        np.where(np.isfinite(covariance), covariance, unbounded)
        for covariance in (known.covariance, known.trusted)
    ]


def beams_moved(
    rig: CalibratedRig,
    beams: tuple[np.ndarray, np.ndarray, np.ndarray],
    camera: str | None = None,
    image_pitch: float = 0.0,
) -> np.ndarray:
    """Derivatives (..., 3, c + 3) of the ends of beams as the columns of `Feature.jacobian`.

    Parameters
    ----------
    rig : CalibratedRig
    beams : tuple of ndarray, shape (...)
        Bearing, pitch (radians) and range (metres).
    camera : str, optional
        In whose frame the ends are, with the head at `image_pitch`; the platform's unless given.
    image_pitch : float
        Radians; 0 for a camera on the base.
    """
    chain = chain_of(rig, camera)
    _, by_link, by_pitch = carried(chain, *beams, image_pitch)
    moved = by_link @ chain.links
    by_offset = by_pitch
    if camera and chain.on_head:  # the offset is that of the image, too
        by_offset = 0 * by_pitch
    by_stretch = (beams[1] - image_pitch)[..., None] * by_pitch
    sweep = np.stack([by_offset, by_stretch, 0 * by_pitch], axis=-1)
    moved = np.concatenate([moved, sweep], axis=-1)
    return moved if camera else chain.head.rotation.as_matrix() @ moved


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
    moved = beams_moved(rig, (part.bearing, part.pitch, part.range))
    centre = part.points.mean(axis=0)
    normal = np.zeros(3)
    by_shared = moved.mean(axis=0)
    turning = np.zeros_like(by_shared)
    if plane:
        normal, _, rough = fit_plane(part.points)
        size, axes = np.linalg.eigh(np.cov(part.points.T, bias=True))
        # of the normal by the mean of products of places and heights
        turned = -(axes[:, 1:] / size[1:]) @ axes[:, 1:].T
        turning = turned @ (part.points - centre).T @ (normal @ moved) / count
        by_shared[:, -1] = normal
        noise = rough**2 / count * block_diag(np.outer(normal, normal), -turned)
    else:
        beams = unit_vector(part.points)
        of_ranges = rig.known.range_noise**2 * beams.T @ beams / count**2
        noise = np.pad(of_ranges, (0, 3))
    return Feature(
        kind=Kind.PLANE if plane else Kind.POINT,
        centre=centre,
        axis=normal,
        noise=noise,
        jacobian=np.concatenate([by_shared, turning]),
        rig=rig,
        placement=int(part.placement[0]),
        ends=np.array([centre, centre]),
    )


def length_between(first: Feature, second: Feature) -> Length:
    """Length between two features.

    Along the normal of a plane, else across the direction of an edge, else from point to point; of
    two planes or edges their mean counts, each weighted by how well it is known. What the
    calibration has wrong counts as far as it moves the two apart.

    Parameters
    ----------
    first, second : Feature
        Of one rig.

    Returns
    -------
    Length

    Raises
    ------
    DegenerateGeometry
        For planes or edges that are not parallel to 15 deg, and for one feature taken twice.
    """
    if first.is_same(second):
        raise DegenerateGeometry(
            f"both places are on the same {first.kind}: pick two, or two points of it"
        )
    _refuse_askew(first, second)
    kind, weights = _axes(first, second)
    along = weights @ [first.axis, second.axis]
    size = max(length_of(along), SURE)
    along /= size
    way = second.centre - first.centre
    height = along @ way
    upright = height * along
    across = way - upright
    measured = upright if kind == Kind.PLANE else across
    metres = length_of(measured)
    # by the second centre, and by the weighted sum of axes
    by_place = measured / metres
    by_axis = height * across / size / metres
    if kind != Kind.PLANE:
        by_axis *= -1
    # by centre and axis of both, (2, 6)
    by = np.hstack([np.outer([-1.0, 1.0], by_place), np.outer(weights, by_axis)])
    noise = np.sum(by * np.vecmat(by, [first.noise, second.noise]))
    moved = np.vecmat(by, [first.jacobian, second.jacobian])
    by_sweep = moved[:, -3:-1]
    if first.placement == second.placement:
        by_sweep = by_sweep.sum(axis=0)
    noise += np.sum((by_sweep * first.rig.known.sweep_sigma) ** 2)
    return Length(
        metres=float(metres),
        noise=noise,
        shared=np.append(moved[:, :-3].sum(axis=0), moved[:, -1]),
        rig=first.rig,
    )


def _refuse_askew(first, second):
    """DegenerateGeometry for planes or edges that are not parallel."""
    if Kind.POINT in (first.kind, second.kind):
        return
    between = np.arccos(min(abs(first.axis @ second.axis), 1.0))
    if first.kind != second.kind:
        between = np.pi / 2 - between
    if between > ALIKE:
        raise DegenerateGeometry(
            f"{first.kind} and {second.kind} are {np.degrees(between):.0f} deg from parallel: "
            "pick two that are, or points of them"
        )


def _axes(first, second):
    """Which kind of axes a length goes by, and their weights, which turn them to one side."""
    kind = max(first.kind, second.kind, key=list(Kind).index)
    weights = np.array(
        [(f.kind == kind) / max(np.trace(f.noise[3:, 3:]), SURE) for f in (first, second)]
    )
    weights /= weights.sum()
    if first.axis @ second.axis < 0:
        weights[1] *= -1
    return kind, weights
