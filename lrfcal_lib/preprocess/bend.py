"""Which boards look bent in the scan, which really are, and which materials read farther than
others.

A plane and a quadratic surface are fitted to the face of the board. Neighbouring points share their
errors (waves of a printed sheet, the print itself, errors of the pitch), so parts of the board
count as independent, not points. A pitch that is recorded too small by a share s makes a flat board
look bent by s y^2 / r, with y half its height: 5 % over 0.86 m at 1.4 m are 6.6 mm. The corners of
a printed pattern in the images tell such a scan from a bent board.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull, Delaunay
from scipy.spatial.transform import RigidTransform
from scipy.special import fdtrc

from lrfcal_lib.fit.robust import TUKEY, robust_sigma
from lrfcal_lib.model.geometry import lrf_to_platform
from lrfcal_lib.preprocess.board_in_scan import face_points, plane_axes
from lrfcal_lib.preprocess.intrinsics import adjust, raised_points

MOST_POINTS = 12000  # a placement; more of them only cost time, since parts of the board count
MARGIN = 0.02  # of a scan line and of a column, left out at either end: mixed pixels
PARTS = 6  # along and across the board; a sixth is wider than a square of a usual pattern
FEWEST_PARTS = 18  # for a surface of six numbers with a covariance from the scatter over parts
LEVEL = 0.001  # false alarms a placement
# Metres; as much as edge points are allowed to scatter about a straight edge (scan.EDGE_SCATTER): a
# board bent less is
# not what limits a calibration. Chosen with the LMS400 recording in view: its bends are below 5.6
# mm or above 6.9 mm,
# but for one of 6.1 mm that is not significant.
LEAST_BEND = 0.006
# squares about a pattern that may be its sheet's white rim or the board under it: they belong to
# neither
RIM = 0.6
# of the points within the pattern and of those outside it, to compare two materials
LEAST_SHARE = 0.08
FEWEST_CORNERS = 12  # of a pattern, for a pose and a surface
FEWEST_SHEETS = 4  # placements for a usual shape
GRID = 33  # points along and across the outline on which a surface is evaluated


@dataclass(frozen=True)
class Bend:
    """How bent one board looks in the scan, and its printed sheet in the images.

    Attributes
    ----------
    placement : int
    size, sigma : float
        From the highest to the lowest point of the quadratic surface over what was scanned of the
        board, metres; nan where the scan shows too little. Noise alone makes a size above zero:
        judge it by `p_value`.
    p_value : float
        Of such a surface on a flat board.
    bends : bool
        Significant at 0.001, and larger than 6 mm.
    reason : str
        Why there is no size; '' where there is one.
    sheet, sheet_sigma : float
        How far the printed sheet departs from its usual shape (the median over the placements) in
        the images: the same range of heights, continued from the pattern to the area that was
        scanned; nan where that is not known. A bend that all placements share cannot be told from
        the lens. Where `sheet` is much smaller than `size`, the scan is at fault (its pitch), or
        the board beside the sheet, or the sheet has always been so.
    """

    placement: int
    size: float
    sigma: float
    p_value: float
    bends: bool
    reason: str = ""
    sheet: float = np.nan
    sheet_sigma: float = np.nan


@dataclass(frozen=True)
class BoardBends:
    """The shape of the board in all sweeps.

    Attributes
    ----------
    placements : dict of int to Bend
    level, level_sigma : float
        How much farther the board around its printed pattern reads than the pattern, metres; nan
        where the scans do not show both. The standard deviation comes from the scatter over
        placements.
    level_applied : bool
        Whether the level is significant (three standard deviations) and was taken out before bends
        were measured.
    """

    placements: dict[int, Bend]
    level: float = np.nan
    level_sigma: float = np.nan
    level_applied: bool = False


@dataclass(frozen=True)
class Face:
    """Points on a board's face in coordinates of its plane.

    `flat` (n, 2) in metres; `height` (n,) over the plane, away from the LRF, and its derivative by
    the range; `around` (n,) is 0 within the pattern, 1 around it, nan in between (all 0 for one
    material, or an unknown place of the pattern).
    """

    flat: np.ndarray
    height: np.ndarray
    by_range: np.ndarray
    around: np.ndarray

    def columns(self, flat):
        """Those of :func:`quadratic` about the middle of the face at points of it, shape (n, 6)."""
        return quadratic(flat - (self.flat.min(axis=0) + self.flat.max(axis=0)) / 2)


def quadratic(points):
    """Columns (n, 6) of a plane and a quadratic surface at points (n, 2)."""
    x, y = points.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def board_bends(prepared, to_board=None):
    """How the board bends at every placement.

    Parameters
    ----------
    prepared : Prepared
        Its `scans` and its `board` are used, and its `views`, `models` and `relief` where it has
        any.
    to_board : dict of int to callable, optional
        By placement a function from LRF points (n, 3) and their pitch (n,) to the board frame, to
        about a centimetre. It tells the pattern from the board around it. Without it two materials
        cannot be told apart from a bend (a board whose rim reads farther than its sheet seems to
        bulge), and the images are not asked.

    Returns
    -------
    BoardBends
    """
    to_board = to_board or {}
    faces = {
        p: face_of(scan, prepared.board, to_board.get(p)) for p, scan in prepared.scans.items()
    }
    level, sigma = common_level(list(faces.values()))
    applied = bool(abs(level) > 3 * sigma)
    found = {p: bend_of(face, p, level if applied else 0.0) for p, face in faces.items()}
    seen = (p for p in faces if p in to_board and not found[p].reason)
    sheets = {p: sheet for p in seen if (sheet := sheet_surface(prepared, p)) is not None}
    if len(sheets) >= FEWEST_SHEETS:
        usual = np.median([surface for surface, _ in sheets.values()], axis=0)
        for p, (surface, covariance) in sheets.items():
            size, spread = _height_range(faces[p], surface - usual, covariance)
            found[p] = replace(found[p], sheet=size, sheet_sigma=spread)
    return BoardBends(found, level, sigma, applied)


def face_of(scan, board=None, to_board=None):
    """The face of a scanned board in board coordinates with `to_board`, else in arbitrary ones
    of its plane.
    """
    p_lrf, pitch, _ = face_points(scan, MOST_POINTS, MARGIN)
    points, origin = (
        lrf_to_platform(p, pitch, scan.T_head_lrf) for p in (p_lrf, np.zeros_like(p_lrf))
    )
    by_range = (points - origin) @ scan.normal / np.linalg.norm(p_lrf, axis=1)
    away = np.sign(np.median(by_range))
    height = away * (points @ scan.normal - scan.distance)
    by_range = away * by_range
    flat = points @ plane_axes(scan.normal).T if to_board is None else to_board(p_lrf, pitch)[:, :2]
    return Face(
        flat,
        height,
        by_range,
        np.zeros(len(flat)) if to_board is None else around_pattern(flat, board),
    )


def around_pattern(flat, board):
    """0 within the squares of the pattern, 1 around it, nan where the sheet may end, shape (n,)."""
    if board is None or board.pattern is None:
        return np.zeros(len(flat))
    pattern = board.pattern
    low = np.asarray(pattern.origin) - pattern.square
    high = low + pattern.square * np.array([pattern.columns + 1, pattern.rows + 1])
    outside = np.maximum(low - flat, flat - high).max(axis=1)
    return np.where(outside <= 0, 0.0, np.where(outside > RIM * pattern.square, 1.0, np.nan))


def common_level(faces):
    """How much farther the board reads than its pattern, and the sigma of that, metres.

    Nan below four faces.
    """
    levels = []
    for face in faces:
        known = np.isfinite(face.around)
        share = np.mean(face.around[known]) if known.any() else 0.0
        if LEAST_SHARE < share < 1 - LEAST_SHARE:
            columns = np.column_stack(
                [face.columns(face.flat), np.nan_to_num(face.around) * face.by_range]
            )
            levels.append(_robust_fit(columns[known], face.height[known])[0][-1])
    if len(levels) < FEWEST_SHEETS:
        return np.nan, np.nan
    middle = float(np.median(levels))
    of_mean = robust_sigma(np.array(levels) - middle) / np.sqrt(len(levels))
    return middle, np.sqrt(np.pi / 2) * of_mean  # a median scatters that much more than a mean


def _robust_fit(columns, values, rounds=3):
    """Least squares without outliers: coefficients, residuals, and which values were used."""
    used = np.ones(len(values), bool)
    for _ in range(rounds):
        found = np.linalg.lstsq(columns[used], values[used], rcond=None)[0]
        miss = values - columns @ found
        miss_of_middle = miss - np.median(miss[used])
        used = np.abs(miss_of_middle) <= TUKEY * robust_sigma(miss_of_middle[used], least=1e-12)
    return found, miss, used


def bend_of(face, placement=0, level=0.0):
    """The bend of one board.

    `level` (metres) is taken off the ranges around the pattern; points that may belong to either
    material are left out then. The covariance comes from the scatter over parts of the board. Few
    parts may agree by luck, so that single points have their say in the p-value as well.
    """
    low = face.flat.min(axis=0)
    high = face.flat.max(axis=0)
    cell = np.clip(
        (PARTS * (face.flat - low) / np.maximum(high - low, 1e-9)).astype(int), 0, PARTS - 1
    )
    known = np.isfinite(face.around) if level else np.ones(len(face.flat), bool)
    part = (cell @ [1, PARTS])[known]
    if len(np.unique(part)) < FEWEST_PARTS:
        shown = f"the scan shows {len(np.unique(part))} of {PARTS**2} parts of the board"
        reason = f"{shown}, {FEWEST_PARTS} are needed"
        return Bend(placement, np.nan, np.nan, np.nan, False, f"placement {placement}: {reason}")
    columns = face.columns(face.flat[known])
    height = face.height[known] - (level * np.nan_to_num(face.around) * face.by_range)[known]
    found, miss, used = _robust_fit(columns, height)
    columns = columns[used]
    miss = miss[used]
    part = part[used]
    q = found[3:]
    bread = np.linalg.inv(columns.T @ columns)
    pieces = np.unique(part)
    unknowns = columns.shape[1]
    # leaves out each part in turn (the jackknife, without refitting): plain scores of so few parts
    # would call a flat
    # board bent six times too often
    moved = []
    for C, m in ((columns[part == p], miss[part == p]) for p in pieces):
        moved.append(bread @ np.linalg.solve(np.eye(unknowns) - C.T @ C @ bread, C.T @ m))
    by_parts = (len(pieces) - 1) / len(pieces) * np.transpose(moved) @ moved
    by_points = bread * (miss @ miss) / (len(miss) - unknowns)
    p_value = 0.0
    for covariance, count in ((by_parts, len(pieces)), (by_points, len(miss))):
        F = q @ np.linalg.solve(covariance[3:, 3:], q) / len(q)
        p_value = max(p_value, float(fdtrc(len(q), count - unknowns, F)))
    size, sigma = _height_range(face, q, by_parts[3:, 3:])
    return Bend(placement, size, sigma, p_value, bool(p_value < LEVEL and size > LEAST_BEND))


def _height_range(face, q, covariance):
    """Greatest difference in height of a quadratic surface (less its plane) over what was
    scanned, with its sigma.
    """
    hull = ConvexHull(face.flat)
    ends = (face.flat.min(axis=0), face.flat.max(axis=0))
    grid = np.stack(np.meshgrid(*np.linspace(*ends, GRID).T), axis=-1).reshape(-1, 2)
    rim = face.flat[hull.vertices]
    within = face.columns(grid[Delaunay(rim).find_simplex(grid) >= 0])
    plane = np.linalg.lstsq(within[:, :3], within[:, 3:], rcond=None)[0]
    columns = np.concatenate([within, face.columns(rim)])
    bent = columns[:, 3:] - columns[:, :3] @ plane
    height = bent @ q
    between = bent[height.argmax()] - bent[height.argmin()]
    return float(np.ptp(height)), float(np.sqrt(between @ covariance @ between))


def sheet_surface(prepared, placement):
    """The bend of the printed sheet at a placement over the waves that it has at all of them, from
    the images.

    Coefficients of x^2, x y, y^2 of the board frame, away from the camera, 1/m, with their
    covariance (3, 3), which grows by what two cameras differ; None without a pattern in an image.
    """
    if prepared.board.pattern is None:
        return None
    points = raised_points(prepared.board.pattern, prepared.relief)
    surfaces = []
    weights = []
    x, y = (points[:, :2] - points[:, :2].mean(axis=0)).T
    for camera, views in prepared.views.items():
        view = views.get(placement)
        if view is None or view.pixels is None or view.T_camera_board is None:
            continue
        if np.isfinite(view.pixels).all(axis=1).sum() >= FEWEST_CORNERS:
            pixels = view.pixels[None, None]
            start = RigidTransform.concatenate([view.T_camera_board])
            basis = np.stack([x * x, x * y, y * y], axis=1)
            found = adjust(
                pixels, points, [prepared.models[camera]], start, intrinsics=False, basis=basis
            )
            away = np.sign(found.poses[0].rotation.as_matrix()[:, 2] @ found.poses[0].translation)
            surfaces.append(away * found.shape)
            weights.append(np.linalg.inv(found.shape_covariance))
    if not weights:
        return None
    surfaces = np.stack(surfaces)
    information = np.sum(weights, axis=0)
    q = np.linalg.solve(information, np.einsum("nij,nj->i", weights, surfaces))
    differ = np.einsum("ni,nij,nj->", surfaces - q, weights, surfaces - q) / max(
        3 * (len(weights) - 1), 1
    )
    return q, np.linalg.inv(information) * max(1.0, differ)
