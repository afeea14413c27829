"""Planes and points of a scanned cloud, lengths between them, and how good each is."""

from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.judge.uncertainty import (
    COLUMNS,
    Chain,
    carried,
    chain_of,
    range_noise,
    spread,
)
from lrfcal_lib.model.geometry import DegenerateGeometry, fit_plane

AT_ONCE = 1 << 16  # points
ALIKE = np.radians(15.0)  # between normals of one plane
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


@dataclass(frozen=True)
class Feature:
    """A plane or a point fitted to some points of a Cloud, metres.

    Attributes
    ----------
    centre : ndarray, shape (3,)
    normal : ndarray, shape (3,), or None
        Of a plane.
    noise, tilt : ndarray, shape (3, 3)
        Covariances of centre and normal from the range noise (or the points' scatter about the
        plane).
    jacobian : ndarray, shape (3, 13)
        Of the centre by what the calibration may have wrong; `chain` knows how much.
    """

    centre: np.ndarray
    normal: np.ndarray | None
    noise: np.ndarray
    tilt: np.ndarray
    jacobian: np.ndarray
    chain: Chain


def fit_feature(
    cloud: Cloud, chosen: np.ndarray | slice, rig: CalibratedRig, plane: bool = True
) -> Feature:
    """Fit a plane, or else take the middle, of chosen points.

    Parameters
    ----------
    cloud : Cloud
    chosen : index or mask
        Of points.
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
    if not len(part.points):
        raise DegenerateGeometry("no point of the cloud was chosen")
    chain = chain_of(rig)
    noise = range_noise(rig)
    _, J, _ = carried(chain, part.bearing, part.pitch, part.range)
    R = chain.head[:, :3]
    beams = -J[..., COLUMNS.index("range_offset")] @ R.T
    count = len(beams)
    normal = None
    tilted = np.zeros((3, 3))
    of_centre = noise**2 * beams.T @ beams / count**2
    if plane:
        normal, _, rough = fit_plane(part.points)
        variance = max(noise**2 * np.mean((beams @ normal) ** 2), rough**2)
        size, axes = np.linalg.eigh(np.cov(part.points.T, bias=True))
        of_centre = variance / count * np.outer(normal, normal)
        along = axes[:, 1:]
        tilted = variance / count * (along / size[1:]) @ along.T
    return Feature(
        part.points.mean(axis=0), normal, of_centre, tilted, R @ J.mean(axis=0), chain
    )


def length_between(first: Feature, second: Feature) -> tuple[float, float]:
    """Length between two features and its standard deviation, metres.

    Between two points along the line that joins them, otherwise along the normal of the plane, or
    the mean of both. What the calibration has wrong counts as far as it moves the two apart.

    Parameters
    ----------
    first, second : Feature

    Returns
    -------
    length, sigma : float
    """
    way = second.centre - first.centre
    planes = [feature for feature in (first, second) if feature.normal is not None]
    along = way
    if planes:
        normals = np.array([plane.normal for plane in planes])
        along = np.mean(normals * np.copysign(1.0, normals @ normals[0])[:, None], axis=0)
    along = along / np.linalg.norm(along)
    variance = along @ (first.noise + second.noise) @ along
    for plane in planes:
        variance += way @ plane.tilt @ way / len(planes) ** 2
    common = spread(first.chain, (along @ (second.jacobian - first.jacobian))[None])
    return float(abs(along @ way)), float(np.sqrt(variance + common**2))
