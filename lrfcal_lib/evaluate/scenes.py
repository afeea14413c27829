"""How good a coloured scene is: predicted sigma of its points, flatness of a wall, errors
against a simulated room.
"""

from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.calibrate.cloud import Cloud, join
from lrfcal_lib.calibrate.clouds import views_of
from lrfcal_lib.calibrate.pipeline import Calibration
from lrfcal_lib.calibrate.reconstruct import reconstruct
from lrfcal_lib.evaluate.truth import read_truth
from lrfcal_lib.judge.uncertainty import (
    COLUMNS,
    Chain,
    carried,
    chain_of,
    range_noise,
    spread,
)
from lrfcal_lib.model.geometry import DegenerateGeometry, fit_plane, tilt
from lrfcal_lib.model.kinematics import AS_RECORDED
from lrfcal_lib.solvers.joint_solution import JointSolution

AT_ONCE = 1 << 16  # points
# metres along the beam by which a reading is of another surface than the beam's centre meets
BESIDE = 0.05
ALIKE = np.radians(15.0)  # between normals of one plane
CLEAR = 0.02  # metres before a point in which something hides it
PATCH = 40  # points that average the noise out of a patch of a wall


def with_sigma(cloud: Cloud, solution: JointSolution) -> Cloud:
    """The same cloud with the standard deviations of its points that a joint estimate predicts.

    Of the distance of a point from its surface: calibration, errors of the sweep's pitch and range
    noise along the normal (along the beam where there is none), or the scatter of readings about
    the surface where that is more: a spot averages over what is finer than itself. A turn of the
    whole cloud about the tilt axis does not count.

    Parameters
    ----------
    cloud : Cloud
    solution : JointSolution

    Returns
    -------
    Cloud
    """
    chain = chain_of(solution)
    noise = range_noise(solution)
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
    cloud: Cloud, chosen: np.ndarray | slice, solution: JointSolution, plane: bool = True
) -> Feature:
    """Fit a plane, or else take the middle, of chosen points.

    Parameters
    ----------
    cloud : Cloud
    chosen : index or mask
        Of points.
    solution : JointSolution
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
    chain = chain_of(solution)
    noise = range_noise(solution)
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


@dataclass(frozen=True)
class SceneErrors:
    """What a simulated room says about a Cloud of it, a row a point.

    Attributes
    ----------
    depth : ndarray, shape (n,)
        Signed, along the beam, metres; NaN where the truth shows nothing.
    normal : ndarray, shape (n,)
        The same along the normal of the true surface.
    color : ndarray, shape (n,)
        Mean over red, green, blue of the absolute difference to the true light at one exposure; NaN
        where unseen.
    blocked : ndarray of bool, shape (n,)
        Coloured from an image in which something hides the point.
    """

    depth: np.ndarray
    normal: np.ndarray
    color: np.ndarray
    blocked: np.ndarray


def scene_errors(cloud: Cloud, calibration: Calibration, method: str) -> SceneErrors | None:
    """Errors of the cloud of one scene against the simulator.

    A turn about the tilt axis and a shift along it, which no data can show, do not count.

    Parameters
    ----------
    cloud : Cloud
    calibration : Calibration
        That made it.
    method : str
        That made it.

    Returns
    -------
    SceneErrors or None
        None for a recording.
    """
    session = calibration.prepared.session
    truth = read_truth(session)
    if truth is None:
        return None
    from lrfcal_lib.simulate.record import world_of
    from lrfcal_lib.simulate.rig import load_setup

    rig = calibration.rig(method)
    placement = int(cloud.placement[0])
    station = truth.stations.get(placement)
    world = world_of(load_setup(truth.setup), None, T_room_platform=station)
    recorded = session.sweep(placement).pitch
    true_pitch = truth.pitch[placement]
    gauge = truth.T_head_lrf * rig.T_head_lrf.inv()
    turn = gauge.rotation.as_rotvec()[0]
    turn += np.mean(true_pitch - rig.corrections.pitch(placement, recorded))
    shift = np.array([gauge.translation[0], 0.0, 0.0])
    order = np.argsort(recorded)
    pitch = np.interp(cloud.pitch, recorded[order], true_pitch[order])
    points = tilt(cloud.points, turn) + shift
    origins = tilt(np.broadcast_to(truth.T_head_lrf.translation, points.shape), pitch)
    length = np.linalg.norm(points - origins, axis=1)
    directions = (points - origins) / length[:, None]
    hits = world.cast(origins, directions)
    depth = np.where(np.isfinite(hits.distance), length - hits.distance, np.nan)
    # else the rim of the spot read a surface beside the beam: the point is where it is
    beside = ~(np.abs(depth) < BESIDE)
    true = origins + np.where(beside, length, hits.distance)[:, None] * directions
    blocked = np.zeros(len(points), bool)
    for view in views_of(session, rig, placement):
        painted = np.flatnonzero((cloud.image == view.number) & np.isfinite(depth))
        eye = tilt(view.T_camera_platform.inv().translation, turn) + shift
        blocked[painted] = _hidden(world, eye, true[painted])
    light = 255 * world.radiance(origins, directions, hits)
    return SceneErrors(
        depth=depth,
        normal=depth * np.abs(np.vecdot(world.normals[hits.face], directions)),
        color=_color_errors(cloud, light),
        blocked=blocked,
    )


def _hidden(world, eye, points):
    """Which points (n, 3) something of a World hides from an eye (3,)."""
    way = points - eye
    far = np.linalg.norm(way, axis=1)
    hits = world.cast(np.broadcast_to(eye, way.shape), way / far[:, None])
    return hits.distance < far - CLEAR


def _color_errors(cloud, light):
    """Mean absolute difference (n,) of colours from the true light (n, 3) at one exposure."""
    ratio = cloud.colors[cloud.seen] / np.maximum(light[cloud.seen], 1e-9)
    exposed = np.clip(light * np.median(ratio), 0, 255)
    return np.where(cloud.seen, np.abs(cloud.colors - exposed).mean(axis=1), np.nan)


def as_stated(calibration: Calibration) -> Cloud:
    """The first scene with the platform as it is stated, ranges and pitch as recorded, and no
    colours.

    Parameters
    ----------
    calibration : Calibration

    Returns
    -------
    Cloud
    """
    session = calibration.prepared.session
    sweep = session.sweep(session.scene_placements[0])
    T_head_lrf = calibration.platform.transform("stated")
    return join(reconstruct(sweep, [], T_head_lrf, AS_RECORDED, lrf=session.lrf))
