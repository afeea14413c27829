"""Start values of a camera from planes: minimal and closed forms, and the choice among minima.

After Zhang and Pless 2004, and Vasconcelos, Barreto and Nunes 2012.
"""

from functools import partial
from itertools import combinations
from math import comb

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.least_squares import minimise
from lrfcal_lib.fit.residuals import SIGMA_FLOOR
from lrfcal_lib.model.geometry import (
    apply_pose,
    move_pose,
    pose_transform,
)
from lrfcal_lib.model.observations import CameraObservations
from lrfcal_lib.solvers.planes import (
    check_normals,
    compress,
    plane_block,
    plane_residuals,
    plane_sets,
    source_planes,
)

SUBSETS = 400  # of the placements, tried at most
MINIMAL = 40  # of them by the minimal solution, which has eight poses each
SAME_TURN = np.radians(10.0)  # poses nearer to each other than this are one minimum
MOST_APART = 6  # minima to choose from
ROUGH_SIGMA = 0.005  # metres, of a point from its plane, for the search
# times the usual square: a larger miss (four standard deviations) fits no minimum
CAPPED = 16.0
NEARLY = 1.2  # times the misses of the best minimum: another one explains the data nearly as well
SEEN = 0.8  # of the placements: a few may be wrong
FEWEST_PLANES = 5  # that judge a candidate
FEWEST_LINES = 7  # the same, where placements are single scan lines
SIGNS = np.array(
    [[1, 1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1]]
)  # of roots of three squares
FLAT = 1e-3  # of its extent: what leaves a common plane less is a set of single scan lines


def start_from_planes(obs: CameraObservations) -> RigidTransform:
    """Start values of ``T_camera_source``: minimal and closed forms in random subsets of the
    placements, least trimmed squares.

    Parameters
    ----------
    obs : CameraObservations

    Returns
    -------
    RigidTransform
        A stack, mostly of one, the best one first. Others are minima far from it that explain the
        placements nearly as well.

    Raises
    ------
    DegenerateGeometry
        With fewer than three placements, or boards that leave a motion open.
    """
    sets = plane_sets(obs)
    check_normals(sets, obs.camera)
    triangles = compress(sets, 1.0)
    p = len(sets.placements)
    frame, flat = common_plane(triangles)
    threes = _threes(p)
    few = threes[:MINIMAL]
    in_frame = three_planes(triangles[few] @ frame, sets.boards[few])
    forms = [in_frame.reshape(-1, 3, 4) @ frame.T]
    if not flat:
        for rows in (threes, np.arange(p)[None]):
            forms.append(closed_form(triangles, sets.boards, rows))
    candidates = _before_boards(np.concatenate(forms), sets, _centred(triangles)[1])

    # more placements than a closed form uses; half of them may be wrong, or all but one right
    squares = np.sort(_squares(candidates, triangles, sets), axis=1)
    first = []
    half = p // 2 + 2
    for count in {half, max(half, FEWEST_LINES if flat else FEWEST_PLANES)}:
        order = np.argsort(squares[:, :count].mean(axis=1))
        first += [*order[:4], *far_apart(candidates, order)]
    best = candidates[np.unique(first)]

    def evaluate(pose):
        return plane_block(pose, triangles / ROUGH_SIGMA, sets.boards, None, sets.number)

    rough = partial(
        minimise, evaluate, retract=move_pose, max_iterations=12, tolerance=0.01
    )
    robust = rough(state=best, robust=True).state
    plain = rough(state=robust).state
    minima = np.concatenate([robust, plain, best])
    sizes = sizes_of_minima(_squares(minima, triangles, sets), sets.number)
    apart = np.array(far_apart(minima, np.argsort(sizes)))
    nearly = sizes[apart] <= NEARLY * sizes[apart[0]]
    return pose_transform(minima[apart[nearly]])


def sizes_of_minima(squares: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Robust sizes (n,) of the misses at n minima, which tell the one that explains the data best.

    Roots of weighted means of squares (n, k), each one counted up to `CAPPED` times the level: that
    of the minimum with the smallest median, one level for all. The median alone would not see what
    half of the data say.
    """
    level = np.median(squares, axis=1).min()
    capped = np.minimum(squares, CAPPED * level + SIGMA_FLOOR**2)
    return np.sqrt(np.average(capped, axis=1, weights=weights))


def far_apart(poses, order):
    """Indices of the first poses in some order that are turned against all before, `MOST_APART`."""
    chosen = []
    left = order
    while len(left) and len(chosen) < MOST_APART:
        first = left[0]
        chosen.append(first)
        turns = np.linalg.trace(poses[left, :, :3] @ poses[first, :, :3].T)
        left = left[turns < 1 + 2 * np.cos(SAME_TURN)]
    return chosen


def common_plane(triangles):
    """The plane that all compressed points of a recording lie in, and whether they do.

    The first, (4, 4), turns rows ``[p, 1]`` into rows of a frame whose plane z = 0 it is. They do
    for single scan lines in one plane of the LRF: how far noise scatters them within it tells
    nothing.
    """
    root, centre = _centred(triangles.reshape(-1, 4))
    _, spread, axes = np.linalg.svd(root)
    axes[2] *= np.linalg.det(axes)
    frame = np.eye(4)
    frame[:3, :3] = axes.T
    frame[3, :3] = -axes @ centre
    return frame, spread[2] < FLAT * spread[0]


def closed_form(triangles: np.ndarray, boards: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The linear solution of Zhang and Pless: the rotation from the planes' normals.

    Parameters
    ----------
    triangles : ndarray, shape (p, 4, 4)
        Compressed points of placements, which span a plane each.
    boards : ndarray, shape (p, 3, 4)
        ``T_camera_board``.
    rows : ndarray of int, shape (n, k)
        Sets of k placements, a solution each.

    Returns
    -------
    ndarray, shape (n, 3, 4)
        ``T_camera_source``.
    """
    normal = boards[..., 2]
    root, centre = _centred(triangles)
    source = np.linalg.svd(root)[2][..., 2, :]
    source = source * np.sign(np.vecdot(source, centre))[..., None]
    camera = normal * np.sign(np.vecdot(normal, boards[..., 3]))[..., None]
    across = camera[rows].mT @ source[rows]
    return on_planes(across, normal[rows], boards[rows, :, 3], centre[rows])


def three_planes(triangles: np.ndarray, boards: np.ndarray) -> np.ndarray:
    """The minimal solution of Vasconcelos, Barreto and Nunes (2012).

    That the directions of scan lines lie in the boards' planes leaves three dimensions to the first
    two columns of R; two quadrics there make these orthogonal and of one length. Each of four
    solutions has both signs; complex ones keep their real part.

    Parameters
    ----------
    triangles : ndarray, shape (..., 3, 4, 4)
        Compressed points of three single scan lines (z = 0).
    boards : ndarray, shape (..., 3, 3, 4)
        ``T_camera_board``.

    Returns
    -------
    ndarray, shape (..., 8, 3, 4)
        ``T_camera_source``.
    """
    normal = boards[..., 2]
    root, centre = _centred(triangles)
    along = np.linalg.svd(root[..., :2])[2][..., 0, :]
    rows = np.einsum("...i,...j->...ij", along, normal)
    null = np.linalg.svd(rows.reshape(*normal.shape[:-1], 6))[2][..., 3:, :]
    both = null[..., :3] + 1j * null[..., 3:]
    products = both @ both.mT  # real: by how much the lengths differ; imaginary: the angle
    columns = _common_points(products.real, products.imag) @ null
    columns = np.concatenate([columns, -columns], axis=-2)
    x = columns[..., :3]
    y = columns[..., 3:]
    rotation = np.stack([x, y, np.cross(x, y)], axis=-1)
    each = (..., None, slice(None), slice(None))  # of the eight
    return on_planes(rotation, normal[each], boards[..., 3][each], centre[each])


def on_planes(
    rotation: np.ndarray,
    normal: np.ndarray,
    point: np.ndarray | float,
    centre: np.ndarray,
) -> np.ndarray:
    """Poses (..., 3, 4) with the proper rotations nearest to some matrices that put points on
    planes as well as they can.

    Parameters
    ----------
    rotation : ndarray, shape (..., 3, 3)
    normal, point : ndarray, shape (..., k, 3)
        Of the planes, camera frame, metres.
    centre : ndarray, shape (..., k, 3)
        The points, source frame, metres.
    """
    u, _, vt = np.linalg.svd(rotation)
    u[..., 2] *= np.linalg.det(u @ vt)[..., None]
    rotation = u @ vt
    away = np.vecdot(normal, point - centre @ rotation.mT)
    shift = np.linalg.pinv(normal) @ away[..., None]
    return np.concatenate([rotation, shift], axis=-1)


def _threes(p):
    """Sets of three of p placements to try: all of them, or many."""
    if comb(p, 3) <= SUBSETS:
        return np.array(list(combinations(range(p), 3)))
    return np.argsort(np.random.default_rng(0).random((SUBSETS, p)), axis=1)[:, :3]


def _before_boards(poses, sets, centres):
    """Poses that put (most of) the boards before the camera, and the range finder on the side
    that the camera sees.
    """
    lrf_side = source_planes(poses, sets.boards)[..., 3]
    camera_side = -np.vecdot(sets.boards[..., 3], sets.boards[..., 2])
    facing = lrf_side * camera_side > 0
    ahead = apply_pose(poses, centres)[..., 2] > 0
    share = np.mean(facing & ahead, axis=1)
    good = share >= min(SEEN, share.max())
    return poses[good & np.isfinite(poses).all(axis=(1, 2))]


def _squares(poses, triangles, sets):
    """Mean squared distances (n, p) of each placement's points from its plane, at n poses."""
    residuals = plane_residuals(poses, triangles, sets.boards)
    return np.vecdot(residuals, residuals) / sets.number


def _centred(triangles):
    """Scatter roots about the centroid (..., 3, 3), and the centroids (..., 3), of compressed
    points.
    """
    turned = np.linalg.qr(np.roll(triangles, 1, axis=-1), mode="r")
    return turned[..., 1:, 1:], turned[..., 0, 1:] / turned[..., 0, :1]


@np.errstate(all="ignore")
def _common_points(first, second):
    """The four points ``[x, y, 1]`` (..., 4, 3) that two conics (..., 3, 3) share.

    Real parts of complex ones. Along common axes both conics are diagonal: the squares of the
    coordinates are at right angles to both diagonals.
    """
    axes = np.linalg.eig(np.linalg.pinv(first) @ second)[1]
    diagonals = [np.linalg.diagonal(axes.mT @ conic @ axes) for conic in (first, second)]
    squares = np.cross(*diagonals)
    points = SIGNS * np.sqrt(squares + 0j)[..., None, :] @ axes.mT
    # parallel boards leave nothing
    return np.nan_to_num((points / points[..., 2:]).real, posinf=0.0, neginf=0.0)
