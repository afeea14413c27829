"""Drawn calibration sessions of single shots: one scan line and one image of every placement."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.fit.edge_likelihood import LEAST_STEP
from lrfcal_lib.model.board import Board, Chessboard, triangle_board
from lrfcal_lib.model.camera import pinhole
from lrfcal_lib.model.geometry import (
    apply_pose,
    bearings_of,
    carry,
    length_of,
    polar_to_points,
    pose_array,
    unit_lines,
    unit_vector,
)
from lrfcal_lib.simulate.corner import corner_shots
from lrfcal_lib.simulate.draw import (
    Devices,
    end_to_end,
    posed,
    seen_poses,
    upright_camera,
)

FORWARD_X = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]  # camera from an LRF that looks along x
FACING = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))  # camera from a board before it
TARGET = Rotation.from_euler("ZY", [45, 45], degrees=True)  # world from the board, 'around'
# of the triangle: 20 corners, away from the edges
PATTERN = Chessboard(4, 5, 0.029, (0.03885, 0.03885))
# between a crossing and a second edge: spot radii, and standard deviations of the least softness
CLEAR = 1.3
CLEAR_FLOORS = 2.0
FARTHER = 1.5  # than the farthest corner no beam reads a board
MOST_ROUNDS = 200
LEAST_DEPTH = 0.1  # of a corner before the camera, metres: nearer, its pixel means nothing


@dataclass(frozen=True, kw_only=True)
class Scenario(Devices):
    """What the single shots of a study are drawn from; see also
    :class:`lrfcal_lib.simulate.draw.Devices`.
    """

    name: str = "own"
    # settings that differ from its file
    varied: dict[str, float] = field(default_factory=dict)
    about: str = ""
    board: Board = triangle_board(pattern=PATTERN)
    field_of_view: tuple[float, float] = (np.radians(40.0), np.radians(140.0))
    uniform: bool = False  # the errors of ranges; normal otherwise
    floor: float = LEAST_STEP
    scans: int = 1  # lines of a placement, of the LRF at rest
    fewest_beams: int = 8  # of a scan line on a board
    whole_image: bool = True  # placements with corners outside the image are drawn anew
    # standard deviations of what iterative methods start with, radians and metres
    start: tuple[float, float] = (0.05, 0.05)
    # what the joint estimate does not know of the sensor; published simulations know it all
    sensor: tuple[str, ...] = ("range_offset", "edge_log_odds", "edge_log_softness")
    T_camera_lrf: RigidTransform | None = (
        None  # drawn anew for every trial where it is None
    )
    roll: float = 0.0  # of the scan plane about the viewing direction, radians
    poses: str = "ahead"  # of the boards: ahead, tilted or around
    distances: tuple[float, float] = (1.0, 2.5)  # metres
    lean: float = 0.6  # of the boards about x and y at most, radians ('ahead')
    tilt: float = 0.0  # of boards from the image plane, radians ('tilted')
    least_angle: float = 0.0  # between the LRF's place and the target's planes ('around')
    extra: tuple[float, float, float] = (0.0, 0.0, 0.0)  # turns about z, x, y ('around')
    corner: bool = False  # of two plates, which takes the place of boards

    def bearings(self):
        """Of the beams, radians, shape (B,)."""
        first, last = self.field_of_view
        return first + self.step * np.arange(int((last - first) / self.step + 1.5))

    def noisy(self, rng, ranges):
        """Ranges with errors, metres."""
        if self.uniform:
            return ranges + self.sigma_range * np.sqrt(3) * rng.uniform(-1, 1, ranges.shape)
        return rng.normal(ranges, self.sigma_range)

    def rigs(self, rng, trials):
        """True poses ``T_camera_lrf``, one a trial."""
        if self.T_camera_lrf is not None:
            return RigidTransform.concatenate([self.T_camera_lrf] * trials)
        roll = Rotation.from_euler("z", self.roll)
        return RigidTransform.from_rotation(roll) * upright_camera(rng, 1, trials)

    def boards(self, rng, T_camera_lrf):
        """Poses ``T_lrf_board`` of boards (or corners), one for each rig."""
        count = len(T_camera_lrf)
        middle = self.board.points().mean(axis=0)
        if self.poses == "tilted":
            return T_camera_lrf.inv() * self._tilted(rng, count, middle)
        if self.poses == "ahead":
            return self._ahead(rng, count, middle)
        T_lrf_world = self._around(rng, count).inv()
        if self.corner:
            return T_lrf_world
        return T_lrf_world * carry(TARGET, middle)

    def _ahead(self, rng, count, middle):
        """Poses ``T_lrf_board`` of boards that face the LRF but for a lean."""
        spin = rng.uniform(0, 2 * np.pi, count)
        lean = rng.uniform(-self.lean, self.lean, (count, 2))
        away = rng.uniform(*self.distances, count)
        right = rng.uniform(-0.35, 0.35, count) * away
        up = rng.uniform(-0.12, 0.12, count)
        return posed(spin, lean, np.column_stack([right, away, up]), middle)

    def _tilted(self, rng, count, middle):
        """Poses ``T_camera_board`` of boards parallel to the image but for a turn about a random
        axis in the board, anywhere in the image.
        """
        angle = rng.uniform(0, 2 * np.pi, count)
        rotation = Rotation.from_rotvec(polar_to_points(self.tilt, angle)) * FACING
        away = rng.uniform(*self.distances, count)
        pixels = rng.uniform(0, self.model.size, (count, 2))
        centre = away[:, None] * self.model.sights(pixels)
        return carry(rotation, middle, centre)

    def _around(self, rng, count):
        """Poses ``T_world_lrf`` of an LRF that looks at the origin but for turns."""
        direction = np.full((count, 3), -1.0)
        while np.any(open_ := direction.min(axis=1) < np.sin(self.least_angle)):
            direction[open_] = unit_vector(rng.uniform(0, 1, (open_.sum(), 3)))
        z = -direction
        x = unit_vector(np.cross(z, [0.0, 0.0, 1.0]))
        looking = np.stack([x, np.cross(z, x), z], axis=-1)
        turns = rng.uniform(-1, 1, (count, 3)) * self.extra
        turned = Rotation.from_matrix(looking) * Rotation.from_euler("ZXY", turns)
        away = rng.uniform(*self.distances, (count, 1))
        return RigidTransform.from_components(
            away * direction, turned * Rotation.from_matrix(FORWARD_X)
        )


def draw_shots(
    setup: Scenario, rng: np.random.Generator, trials: int, placements: int = 20
) -> dict[str, np.ndarray]:
    """Draw calibration sessions of single shots: one scan line and one image a placement.

    A beam reads the board while its ray passes an edge line at less than `bias` radii outside, give
    or take the softness. Placements whose crossings come near a corner are drawn anew.

    Parameters
    ----------
    setup : Scenario
    rng : numpy.random.Generator
    trials, placements : int
        Sessions t, and shots p of each.

    Returns
    -------
    dict of ndarray
        ``T_camera_lrf`` (t, 3, 4), truth; ``ranges`` (t, p, scans, B), metres, NaN off the board;
        ``lines`` (t, p, 2, 3) and ``edges`` (t, p, 2), undistorted image lines and numbers of the
        edges at the low and the high bearings; ``boards`` (t, p, 3, 4) and ``board_covariance`` (t,
        p, 6, 6), ``T_camera_board`` as the pattern shows it; ``true_boards``, the truth of that.

    Raises
    ------
    ValueError
        If hardly any board is crossed on two edges and seen by the camera, with the shares that
        fail each condition.
    """
    T_camera_lrf = setup.rigs(rng, trials)
    draw = corner_shots if setup.corner else board_shots
    parts = []
    failing = []
    missing = np.full(trials, placements)
    for _ in range(MOST_ROUNDS):
        trial = np.repeat(np.arange(trials), 2 * missing)
        conditions, shots = draw(setup, rng, T_camera_lrf[trial])
        good = np.array([*conditions.values()])
        failing.append(100 * np.mean(~good, axis=1))
        shots["trial"] = trial
        part = {name: value[good.all(axis=0)] for name, value in shots.items()}
        parts.append(part)
        missing = np.maximum(missing - np.bincount(part["trial"], minlength=trials), 0)
        if not missing.any():
            break
    else:
        means = zip(np.mean(failing, axis=0), conditions, strict=True)
        shares = [f"{share:.0f} % {words}" for share, words in means]
        raise ValueError(
            f"boards at {setup.distances} m are hardly ever crossed on two edges and seen by "
            f"the camera: {', '.join(shares)}"
        )

    drawn = end_to_end(parts)
    trial = drawn.pop("trial")
    kept = [np.flatnonzero(trial == t)[:placements] for t in range(trials)]
    shots = {name: value[kept] for name, value in drawn.items()}
    return {"T_camera_lrf": pose_array(T_camera_lrf)} | shots


def board_shots(setup, rng, T_camera_lrf):
    """Of shots, one for each of some rigs, which meet the conditions (named by what fails), and the
    shots.
    """
    board = setup.board
    T_lrf_board = setup.boards(rng, T_camera_lrf)
    at_lrf = pose_array(T_lrf_board)
    ends = apply_pose(at_lrf, board.points())
    edges, clear = _crossed_edges(setup, at_lrf, ends)
    ranges, hit, enough = _scans(setup, rng, at_lrf, ends)

    true = pose_array(T_camera_lrf * T_lrf_board)
    corners = apply_pose(true, board.points())
    uv = pinhole(corners, setup.model)
    ahead = (corners[..., 2] > LEAST_DEPTH).all(axis=1)
    if setup.whole_image:
        ahead &= ((uv > 0) & (uv < setup.model.size)).all(axis=(1, 2))
    conditions = {
        f"have fewer than {setup.fewest_beams} beams on the board": enough,
        "are crossed near a corner": clear,
        "are not in the image": ahead,
    }

    boards, covariance, pixels = seen_poses(setup, true, rng, 1.0)
    noisy = setup.noisy(rng, np.where(hit, ranges[:, None], np.nan))
    homography = (
        setup.model.matrix @ true[..., [0, 1, 3]]
    )  # from the board's plane to pixels
    # normals out of the board
    lines = unit_lines(board.lines()[edges] @ np.linalg.inv(homography))
    lines[..., 2] += setup.sigma_px * rng.standard_normal(edges.shape)
    return conditions, {
        "ranges": noisy,
        "lines": lines,
        "edges": edges,
        "boards": boards,
        "board_covariance": covariance,
        "pattern_pixels": pixels,
        "true_boards": true,
    }


def _crossed_edges(setup, pose, ends):
    """Edges (n, 2) that the scan plane crosses, at the low and the high bearing, of convex boards
    at poses (n, 3, 4) with corners there, and whether both crossings are clear of other edges.
    """
    along = np.roll(ends, -1, axis=1) - ends
    share = -ends[..., 2] / along[..., 2]
    crossed = (share > 0) & (share < 1)
    at = ends + share[..., None] * along
    bearing = np.where(crossed, bearings_of(at), np.nan)
    edges = np.argsort(bearing, axis=1)[:, :2]  # NaN comes last
    at = np.take_along_axis(at, edges[..., None], axis=1)
    radii, away = setup.beside(pose, unit_vector(at))
    second = np.sort(radii, axis=-1)[..., -2]
    least = CLEAR + CLEAR_FLOORS * setup.least_softness(away)
    return edges, (crossed.sum(axis=1) == 2) & (second < -least).all(axis=1)


def _scans(setup, rng, pose, ends):
    """Of the scan lines over boards at poses (n, 3, 4) with corners there: exact ranges (n, B),
    which beams hit (n, S, B), and whether there are enough in every one.
    """
    radii, ranges = setup.beside(pose, polar_to_points(1.0, setup.bearings()))
    if setup.spread:
        radii -= setup.spread * rng.standard_normal((len(pose), 1, radii.shape[-1]))
    outside = radii.max(axis=-1)[:, None]
    soft = np.hypot(setup.softness, setup.least_softness(ranges))[:, None]
    flips = rng.standard_normal((len(pose), setup.scans, ranges.shape[1]))
    # rays along the board meet its plane far away, where the least softness means nothing
    farthest = length_of(ends).max(axis=-1, keepdims=True)
    sensible = (ranges > 0) & (ranges < FARTHER * farthest)
    hit = (outside < setup.bias + soft * flips) & sensible[:, None]
    enough = hit.sum(axis=-1) >= setup.fewest_beams
    whole = ~hit[..., [0, -1]].any(axis=-1)
    return ranges, hit, (enough & whole).all(axis=1)
