"""How good a coloured scene is: predicted sigma of its points, flatness of a wall, errors
against a simulated room.
"""

from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.calibrate.cloud import join
from lrfcal_lib.calibrate.clouds import views_of
from lrfcal_lib.calibrate.reconstruct import reconstruct
from lrfcal_lib.evaluate.truth import read_truth
from lrfcal_lib.judge.uncertainty import COLUMNS, carried, chain_of, range_noise, spread
from lrfcal_lib.model.geometry import DegenerateGeometry, fit_plane, tilt
from lrfcal_lib.model.kinematics import AS_RECORDED
from lrfcal_lib.session.stated import read_json

AT_ONCE = 1 << 16  # points
# metres along the beam by which a reading is of another surface than the beam's centre meets
BESIDE = 0.05
PATCH = 40  # points that average the noise out of a patch of a wall


def with_sigma(cloud, solution):
    """A Cloud with the standard deviations (metres) of its points that a JointSolution predicts.

    Of the distance of a point from its surface: calibration, errors of the sweep's pitch and range
    noise along the normal (along the beam where there is none), or the scatter of readings about
    the surface where that is more: a spot averages over what is finer than itself. A turn of the
    whole cloud about the tilt axis does not count.
    """
    chain = chain_of(solution)
    noise = range_noise(solution)
    sigma = np.zeros(len(cloud.points))
    for part in np.array_split(np.arange(len(sigma)), 1 + len(sigma) // AT_ONCE):
        _, J, by_pitch = carried(chain, cloud.bearing[part], cloud.pitch[part], cloud.range[part])
        normals = cloud.normals[part] @ chain.head[:, :3]
        beams = -J[..., COLUMNS.index("range_offset")]
        normals = np.where(np.isfinite(normals), normals, beams)
        sweep = np.hypot(chain.sweep_sigma[0], chain.sweep_sigma[1] * cloud.pitch[part])
        sweep, own = (
            v * np.sum(normals * by, axis=1) for v, by in ((sweep, by_pitch), (noise, beams))
        )
        own = np.maximum(np.abs(own), cloud.sigma[part])
        sigma[part] = np.sqrt(
            spread(chain, np.einsum("ni,nij->nj", normals, J)[:, None]) ** 2 + sweep**2 + own**2
        )
    return replace(cloud, sigma=sigma)


def largest_plane(cloud, tolerance=0.04):
    """Which points of a Cloud lie on its largest plane: within a tolerance (metres), facing as
    it does to 15 deg.
    """
    import open3d as o3d

    o3d.utility.random.seed(0)
    geometry = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
    plane, _ = geometry.segment_plane(tolerance, 3, 500)
    near = np.abs(cloud.points @ plane[:3] + plane[3]) < tolerance
    return near & (np.abs(cloud.normals @ plane[:3]) > np.cos(np.radians(15)))


def flatness(points):
    """How far a wall (n, 3) is from a plane, metres: the signed distance of each point, and the
    flatness.

    The flatness is the root mean square of the mean distances of patches of `PATCH` points, without
    their noise.
    """
    normal, offset, _ = fit_plane(points)
    miss = points @ normal - offset
    across = np.linalg.svd(normal[None])[2][1:]
    u, v = ((points - points.mean(axis=0)) @ across.T).T
    side = np.sqrt(PATCH * np.ptp(u) * np.ptp(v) / len(points))
    cell = np.rint(u / side).astype(int) * 100_000 + np.rint(v / side).astype(int)
    _, which, count = np.unique(cell, return_inverse=True, return_counts=True)
    mean = (np.bincount(which, miss) / count)[count >= PATCH / 2]
    noise = np.var(miss - (np.bincount(which, miss) / count)[which]) / PATCH
    return miss, float(np.sqrt(max(np.mean(mean**2) - noise, 0.0)))


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
    chain: object


def fit_feature(cloud, chosen, solution, plane=True):
    """Fit a plane, or else take the middle, of chosen points (index or mask) of a Cloud: a Feature.

    `solution` is the JointSolution that the cloud was made with. DegenerateGeometry if the points
    span no plane.
    """
    part = cloud.rows(chosen)
    chain = chain_of(solution)
    noise = range_noise(solution)
    if not len(part.points):
        raise DegenerateGeometry("no point of the cloud was chosen")
    J = carried(chain, part.bearing, part.pitch, part.range)[1]
    R = chain.head[:, :3]
    centre = part.points.mean(axis=0)
    beams = -J[..., COLUMNS.index("range_offset")] @ R.T
    scatter = noise**2 * beams.T @ beams
    count = len(beams)
    normal = None
    tilted = np.zeros((3, 3))
    if plane:
        normal, _, rough = fit_plane(part.points)
        variance = max(noise**2 * np.mean((beams @ normal) ** 2), rough**2)
        size, axes = np.linalg.eigh(np.cov(part.points.T, bias=True))
        scatter = variance * count * np.outer(normal, normal)
        tilted = variance / count * (axes[:, 1:] / size[1:]) @ axes[:, 1:].T
    return Feature(centre, normal, scatter / count**2, tilted, R @ J.mean(axis=0), chain)


def length_between(first, second):
    """Length between two Features and its standard deviation, metres.

    Between two points along the line that joins them, otherwise along the normal of the plane, or
    the mean of both. What the calibration has wrong counts as far as it moves the two apart.
    """
    way = second.centre - first.centre
    planes = [f for f in (first, second) if f.normal is not None]
    normals = [f.normal * np.copysign(1.0, f.normal @ planes[0].normal) for f in planes] or [way]
    along = np.mean(normals, axis=0)
    along = along / np.linalg.norm(along)
    variance = along @ (first.noise + second.noise) @ along
    variance += sum(way @ plane.tilt @ way for plane in planes) / len(normals) ** 2
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


def scene_errors(cloud, calibration, method):
    """Errors of a Cloud of one scene, made by a method, against the simulator: SceneErrors; None
    for a recording.

    A turn about the tilt axis and a shift along it, which no data can show, do not count.
    """
    session = calibration.prepared.session
    truth = read_truth(calibration.prepared.session)
    if truth is None:
        return None
    from lrfcal_lib.simulate.record import world_of
    from lrfcal_lib.simulate.rig import load_setup

    world = world_of(
        load_setup(read_json(session.path / "truth.json", session.path)["setup"]), None
    )
    rig = calibration.rig(method)
    gauge = truth.T_head_lrf * rig.T_head_lrf.inv()
    turn = gauge.rotation.as_rotvec()[0]
    shift = np.array([gauge.translation[0], 0.0, 0.0])
    placement = int(cloud.placement[0])
    sweep = session.sweep(placement)
    turn += np.mean(truth.pitch[placement] - rig.corrections.pitch(placement, sweep.pitch))
    order = np.argsort(sweep.pitch)
    pitch = np.interp(cloud.pitch, sweep.pitch[order], truth.pitch[placement][order])
    points = tilt(cloud.points, turn) + shift
    origins = tilt(np.broadcast_to(truth.T_head_lrf.translation, points.shape), pitch)
    length = np.linalg.norm(points - origins, axis=1)
    directions = (points - origins) / length[:, None]
    hits = world.cast(origins, directions)
    depth = np.where(np.isfinite(hits.distance), length - hits.distance, np.nan)
    normal = depth * np.abs(np.sum(world.normals[hits.face] * directions, axis=1))
    light = 255 * world.radiance(origins, directions, hits)
    ratio = cloud.colors[cloud.seen] / np.maximum(light[cloud.seen], 1e-9)
    light = np.clip(light * np.median(ratio), 0, 255)
    color = np.where(cloud.seen, np.abs(cloud.colors - light).mean(axis=1), np.nan)
    # else the rim of the spot read a surface beside the beam: the point is where it is
    own = np.abs(depth) < BESIDE
    blocked = np.zeros(len(points), bool)
    true = origins + np.where(own, hits.distance, length)[:, None] * directions
    for view in views_of(session, rig, placement):
        mine = np.flatnonzero((cloud.image == view.number) & np.isfinite(depth))
        eye = tilt(view.T_camera_platform.inv().translation, turn) + shift
        way = true[mine] - eye
        far = np.linalg.norm(way, axis=1)
        blocked[mine] = (
            world.cast(np.broadcast_to(eye, way.shape), way / far[:, None]).distance < far - 0.02
        )
    return SceneErrors(depth, normal, color, blocked)


def as_stated(calibration):
    """The first scene with the platform as it is stated, ranges and pitch as recorded, and no
    colours; a Cloud.
    """
    session = calibration.prepared.session
    sweep = session.sweep(session.scene_placements[0])
    T_head_lrf = calibration.platform.transform("stated")
    return join(reconstruct(sweep, [], T_head_lrf, AS_RECORDED, lrf=session.lrf))
