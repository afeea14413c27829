"""Two stations of a scene beside each other: where one may stand in the frame of the other.

The start needs no guess but that both platforms stand on their feet: directions of walls and floor
give the turns, the correlation of all surfaces gives the shifts. Every start that is good enough is
refined, and judged by what overlaps and by what stands where the other station looked through.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from heapq import nlargest
from itertools import permutations, product
from operator import itemgetter

import numpy as np
import small_gicp
from scipy.fft import irfftn, next_fast_len, rfftn
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.spatial import KDTree
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.fit.robust import biweight, robust_sigma, sums_by
from lrfcal_lib.judge.uncertainty import COLUMNS
from lrfcal_lib.measure.features import moved_along
from lrfcal_lib.model.geometry import (
    gradient_by_pose,
    length_of,
    move_pose,
    pose_array,
    pose_step,
    pose_transform,
    transform_difference,
    unit_vector,
)

# metres, side of the cells whose points make one patch of a surface: for a start, for the fit
COARSE = 0.1
FINE = 0.05
IN_ONE = np.array([1e8, 1e4, 1.0])  # makes one number of the three of a cell
FLAT = 0.97  # length of the mean normal of a patch; less has an edge in it
DIRECTIONS = 8  # of walls, floor and furniture that make turns
NEAR = np.cos(np.radians(8.0))  # between normals of one direction
FEW = 0.01  # share of the patches that makes a direction
SAME_ANGLE = np.radians(4.0)  # between two directions in one station and in the other
SAME_TURN = np.radians(6.0)  # turns that are refined to the same one
UPRIGHT = np.cos(
    np.radians(25.0)
)  # between the z axes of platforms that stand on their feet
CELL = 0.2  # metres, of the grid on which shifts are looked for
GRID = (1, 2, 3)  # its axes, after that of the components of normals
ROOM = 4  # cells beside what is on it: four standard deviations of a blur
PEAKS = 6  # shifts tried a turn
STARTS = 10  # tried a pair
WIDTHS = (0.4, 0.2)  # metres within which patches are taken for the same, one by one
AROUND = 20  # patches that make a covariance
# turn and metres: nearer together, two starts ended at the same pose
SAME_POSE = np.array([np.radians(3.0), 0.15])
MATCHED = 0.1  # metres between patches of the same surface
FACING = np.cos(np.radians(30.0))  # between normals of the same surface
LOOK = np.radians(1.0)  # side of a cell of what a station saw
ALL_ABOUT = (361, 181)  # of these, in azimuth and height
CLEAR = 0.15  # metres before a surface; a patch there stands where the other looked through
CLOSER = (0.1, 0.05, 0.05, 0.05)  # metres within which a fit takes patches for the same
COMMON = 0.002  # metres, error of a patch that its neighbours have too
NEIGHBOURS = 0.5  # metres; errors of patches nearer together are not taken as independent
ACROSS = 0.35  # cosine between a normal and a direction from which a patch holds it


@dataclass(frozen=True)
class Surface:
    """What a station saw, in patches.

    Attributes
    ----------
    points, normals : ndarray, shape (n, 3)
        Means of the points of a patch, platform frame, metres; unit vectors.
    sigma : ndarray, shape (n,)
        Standard deviation of a mean along the normal, metres.
    moves : ndarray, shape (n, 15)
        Motion of a patch along its normal by what the calibration may have wrong, see `COLUMNS`,
        and by one sigma of the sweep's own offset and stretch of the pitch.
    nearest : ndarray, shape (k, l)
        Range by azimuth and height about the platform, metres; 0 where it saw nothing.
    """

    points: np.ndarray
    normals: np.ndarray
    sigma: np.ndarray
    moves: np.ndarray
    nearest: np.ndarray
    tree: KDTree

    @cached_property
    def gicp(self) -> tuple[small_gicp.PointCloud, small_gicp.KdTree]:
        """The points with their covariances, and what finds neighbours, as GICP wants both."""
        cloud = small_gicp.PointCloud(self.points)
        tree = small_gicp.KdTree(cloud)
        small_gicp.estimate_normals_covariances(cloud, tree, AROUND)
        return cloud, tree

    @cached_property
    def directions(self) -> list[np.ndarray]:
        """Directions (3,) in which many patches face, the most of them first."""
        left = self.normals[:: max(1, len(self.normals) // 2000)]
        least = FEW * len(left)
        found: list[np.ndarray] = []
        for _ in range(DIRECTIONS):
            near = left @ left.T > NEAR
            count = near.sum(axis=1)
            if count.max(initial=0) < least:
                break
            mean = unit_vector(left[near[count.argmax()]].mean(axis=0))
            found.append(mean)
            left = left[left @ mean < NEAR]
        return found


def surface_of(cloud: Cloud, size: float, rig: CalibratedRig | None = None) -> Surface:
    """The patches of a cloud of one station.

    Parameters
    ----------
    cloud : Cloud
    size : float
        Of a patch, metres: `COARSE` for a start, `FINE` for a fit.
    rig : CalibratedRig, optional
        That made the cloud; without it no error of the calibration is looked at.

    Returns
    -------
    Surface

    Raises
    ------
    ValueError
        If no part of it is smooth.
    """
    whole = cloud.rows(np.isfinite(cloud.normals).all(axis=1))
    moves = np.zeros((len(whole.points), len(COLUMNS) + 2))
    if rig is not None:
        moves = moved_along(whole.normals, whole, rig)
    columns = [
        whole.points,
        whole.normals,
        moves,
        whole.sigma**2,
        np.ones(len(whole.points)),
    ]
    sums = sums_by(np.floor(whole.points / size) @ IN_ONE, np.column_stack(columns))
    means = sums / sums[:, -1:]
    flat = length_of(means[:, 3:6]) > FLAT
    if not flat.any():
        raise ValueError("no part of the cloud is a smooth surface")
    points, normals, moves, _ = np.split(means[flat], [3, 6, -2], axis=1)
    variance, count = sums[flat, -2:].T
    return Surface(
        points=points,
        normals=unit_vector(normals),
        sigma=np.sqrt(variance) / count,
        moves=moves,
        nearest=_look(cloud.points),
        tree=KDTree(points),
    )


def _cells(points):
    """Where points (n, 3) stand in the view of a platform: row and column, and range (n,)."""
    x, y, z = points.T
    away = np.hypot(x, y)
    angles = np.array([np.arctan2(x, y) + np.pi, np.arctan2(z, away) + np.pi / 2])
    return tuple((angles / LOOK).astype(int)), np.hypot(away, z)


def _look(points):
    """Nearest range in every cell of the view of a platform and the cells about it, or 0."""
    cell, distance = _cells(points)
    nearest = np.full(ALL_ABOUT, np.inf)
    np.minimum.at(nearest, cell, distance)
    nearest = minimum_filter(nearest, 3)
    return np.nan_to_num(nearest, posinf=0.0)


@dataclass(frozen=True)
class Candidate:
    """Where the second of two stations may stand.

    Attributes
    ----------
    T_first_second : RigidTransform
    overlap : float
        Share of the patches of the station that has fewer which the other one has too.
    against : float
        Share of patches in the other's view that stand where it looked through.
    """

    T_first_second: RigidTransform
    overlap: float
    against: float


def candidates(first: Surface, second: Surface) -> list[Candidate]:
    """Poses of the second station at which surfaces of both fall together, the best first.

    Parameters
    ----------
    first, second : Surface

    Returns
    -------
    list of Candidate
        All different.
    """
    target, tree = first.gicp
    source, _ = second.gicp
    found: list[Candidate] = []
    for start in starts(first, second):
        matrix = start.as_matrix()
        for width in WIDTHS:
            matrix = small_gicp.align(
                target,
                source,
                tree,
                matrix,
                registration_type="GICP",
                max_correspondence_distance=width,
                max_iterations=30,
            ).T_target_source
        T = RigidTransform.from_matrix(matrix)
        if all(
            np.any(SAME_POSE <= transform_difference(T, other.T_first_second))
            for other in found
        ):
            found.append(agreement(first, second, T))
    return sorted(found, key=lambda c: -c.overlap * (1 - c.against))


def starts(first: Surface, second: Surface) -> list[RigidTransform]:
    """Rough poses of the second station in the frame of the first, the most likely first."""
    here, low = _on_grid(first.points, first.normals)
    blurred = gaussian_filter(here, 1.0, axes=GRID)
    found = []
    for turn in _turns(first.directions, second.directions):
        found += _shifts(blurred, low, second, turn)
    return [T for _, T in nlargest(STARTS, found, key=itemgetter(0))]


def _turns(first, second):
    """Turns of the second station by which two of its directions fall on two of the first."""
    found: list[Rotation] = []
    for (a, b), (c, d) in product(_two_of(first), _two_of(second)):
        if abs(np.arccos(a @ b) - np.arccos(c @ d)) > SAME_ANGLE:
            continue
        turn = Rotation.align_vectors([a, b], [c, d])[0]
        if turn.as_matrix()[2, 2] > UPRIGHT:
            if not any(turn.approx_equal(other, SAME_TURN) for other in found):
                found.append(turn)
    return found


def _two_of(directions):
    """Ordered pairs of directions that are neither parallel nor opposite."""
    return [(a, b) for a, b in permutations(directions, 2) if abs(a @ b) < FACING]


def _shifts(blurred, low, second, turn):
    """The best shifts of the second station after a turn: score and pose of each.

    The correlation of normals on a grid, that of the first station blurred: surfaces count that
    face the same way.
    """
    there, low_moved = _on_grid(turn.apply(second.points), turn.apply(second.normals))
    room = np.add(blurred.shape, there.shape)[1:]
    size = [next_fast_len(cells, real=True) for cells in room]
    spectra = rfftn(blurred, size, GRID) * rfftn(np.flip(there, GRID), size, GRID)
    score = irfftn(spectra.sum(axis=0), size)
    top = np.where(score == maximum_filter(score, 5), score, 0.0)
    best = np.argpartition(top, -PEAKS, axis=None)[-PEAKS:]
    cells = np.transpose(np.unravel_index(best, top.shape)) - there.shape[1:] + 1
    shifts = cells * CELL + low - low_moved
    return zip(top.flat[best], RigidTransform.from_components(shifts, turn), strict=True)


def _on_grid(points, values):
    """Sums of values (n, 3) on the nearest points of a grid (3, a, b, c), with room for what is
    blurred, and where it begins.
    """
    low = points.min(axis=0) - ROOM * CELL
    cells = np.rint((points - low) / CELL).astype(int)
    grid = np.zeros((3, *cells.max(axis=0) + ROOM + 1), np.float32)
    np.add.at(grid, (slice(None), *cells.T), values.T)
    return grid, low


def agreement(first: Surface, second: Surface, T: RigidTransform) -> Candidate:
    """How two stations agree at a pose of the second."""
    here, there = matches(first, second, T)
    both = (len(np.unique(here)), len(there))
    conflicts = _before(first, T.apply(second.points))
    conflicts += _before(second, T.inv().apply(first.points))
    return Candidate(
        T,
        overlap=min(both) / min(len(first.points), len(second.points)),
        against=conflicts / max(conflicts + sum(both), 1),
    )


def matches(first: Surface, second: Surface, T: RigidTransform, width: float = MATCHED):
    """Numbers of patches of the first and second station that are of one surface."""
    distance, near = first.tree.query(T.apply(second.points), distance_upper_bound=width)
    there = np.flatnonzero(np.isfinite(distance))
    here = near[there]
    normals = T.rotation.apply(second.normals[there])
    same = np.vecdot(first.normals[here], normals) > FACING
    return here[same], there[same]


def _before(surface, points):
    """How many points (n, 3) stand where a station looked through."""
    cell, distance = _cells(points)
    return np.sum(distance < surface.nearest[cell] - CLEAR)


@dataclass(frozen=True)
class Pair:
    """Two stations beside each other, and how well it is known how they stand.

    Attributes
    ----------
    first, second : int
    T_first_second : RigidTransform
    covariance : ndarray, shape (6, 6)
        Of its turn and shift in the first one's frame, without errors of the calibration.
    by_rig : ndarray, shape (6, 13)
        Turn and shift by what the calibration may have wrong, see `COLUMNS`.
    overlap : float
        Share of the surfaces of the station that saw less which the other saw too.
    rms : float
        Of the distances between their surfaces, metres.
    loose : ndarray, shape (3,)
        Direction in the first station's frame along which the least holds the second.
    held : float
        Share of the patches that hold it there.
    """

    first: int
    second: int
    T_first_second: RigidTransform
    covariance: np.ndarray
    by_rig: np.ndarray
    overlap: float
    rms: float
    loose: np.ndarray
    held: float

    def miss(self, poses: Mapping[int, RigidTransform]) -> np.ndarray:
        """Turn and shift (6,) by which poses of the stations differ from it."""
        T = poses[self.first].inv() * poses[self.second]
        return pose_step(self.T_first_second, T)


def fitted(
    names: tuple[int, int], first: Surface, second: Surface, start: RigidTransform
) -> Pair:
    """The pose of a second station by all patches of both, each by its sigma.

    The distance of a patch from the nearest one of the other station, along the normal. What few
    disagree about counts little (Tukey's weights). Errors of neighbours are taken as one in the
    covariance.

    Parameters
    ----------
    names : tuple of int
        Of the stations.
    first, second : Surface
        In patches of `FINE`.
    start : RigidTransform
        Within a few centimetres of it.

    Returns
    -------
    Pair
    """
    T = start
    for width in CLOSER:
        here, there = matches(first, second, T, width)
        turned = T.rotation.apply(second.points[there])
        normals = unit_vector(first.normals[here] + T.rotation.apply(second.normals[there]))
        r = np.vecdot(normals, turned + T.translation - first.points[here])
        J = gradient_by_pose(turned, normals)
        sigma = np.hypot(np.hypot(first.sigma[here], second.sigma[there]), COMMON)
        sigma *= robust_sigma(r / sigma, least=1.0)
        weight = biweight(r, sigma) / sigma**2
        weighted = J * weight[:, None]
        inverse = np.linalg.pinv(J.T @ weighted, rcond=1e-12)
        gain = -inverse @ weighted.T
        step = gain @ r
        T = pose_transform(move_pose(pose_array(T), step))
    pulls = weighted * (r + J @ step)[:, None]
    sums = sums_by(np.floor(first.points[here] / NEIGHBOURS) @ IN_ONE, pulls)
    by_first = gain @ first.moves[here]
    by_second = gain @ second.moves[there]
    by_sweeps = np.hstack([by_first[:, -2:], by_second[:, -2:]])
    # the loosest direction of the shift, whatever the turn
    loose = np.linalg.eigh(inverse[3:, 3:])[1][:, -1]
    return Pair(
        *names,
        T_first_second=T,
        covariance=inverse @ (sums.T @ sums) @ inverse + by_sweeps @ by_sweeps.T,
        by_rig=(by_second - by_first)[:, :-2],
        overlap=agreement(first, second, T).overlap,
        rms=np.sqrt(np.average(r**2, weights=weight)),
        loose=loose,
        held=np.mean(np.abs(J[:, 3:] @ loose) > ACROSS),
    )
