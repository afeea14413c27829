"""What the cameras of a session see of the board: intrinsics, poses, turns, edges, the outline that nobody measured."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import PurePath

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, uniform_filter1d
from scipy.spatial.transform import Rotation

from lrfcal_lib.model.board import Board, corners_of_lines
from lrfcal_lib.preprocess.board_in_image import BoardView, order_scores, pattern_orders, view_board
from lrfcal_lib.preprocess.edges_in_image import (
    SIDES,
    _median_line,
    _spread,
    board_line,
    edge_votes,
    outer_peak,
    side_lines,
    wide_distances,
)
from lrfcal_lib.preprocess.pattern_in_image import (
    PatternFinder,
    PatternNotFound,
    board_pose,
    estimate_intrinsics,
    estimate_relief,
    first_pose,
    spread_views,
    stereo_transform,
    turn_pattern,
)


@dataclass(frozen=True)
class Outline:
    """The outer edges of a board, measured in the scale of its pattern.

    Attributes
    ----------
    lines : ndarray, shape (E, 3)
        Board-frame lines ``a x + b y + c = 0``, unit normals out of the board, in the order of ``board.edges``.
    line_sd : ndarray, shape (E,)
        Standard deviation over the views of an edge's offset at its middle, metres.
    lengths : dict of str to float
        Edge lengths of the outline, metres.
    length_sd : dict of str to float
        Standard deviation of the length over the views that show the edge with both neighbours; NaN below two.
    n_views : dict of str to int
        Views that show the edge.
    n_lengths : dict of str to int
        Views that show it with both neighbours.
    board : Board
        With its corners filled in.
    """

    lines: np.ndarray
    line_sd: np.ndarray
    lengths: dict
    length_sd: dict
    n_views: dict
    n_lengths: dict
    board: Board


def measure_outline(views, board, models):
    """Outer edges of the board from all images of all cameras.

    Parameters
    ----------
    views : dict of str to sequence of BoardView
        By camera. Views of the wide search (with `votes`) must have their patterns turned alike, see
        :func:`resolve_turns`.
    board : Board
        With a pattern (or with known corners, and poses in the views).
    models : dict of str to CameraModel

    Returns
    -------
    Outline

    Raises
    ------
    ValueError
        If an edge was seen in no image, naming it.

    Notes
    -----
    Median over the views of the edge's offset at two places; the spread is 1.4826 times the median deviation. A board
    bends between placements, so the spread is its own, not the noise of the images.
    """
    usable = [(v, models[camera]) for camera, group in views.items() for v in group if not v.reason]
    seen = {n: [board_line(v, v.edge(n), m) for v, m in usable if v.edge(n) is not None] for n in board.edges}
    missing = [name for name, found in seen.items() if not found]
    if missing:
        raise ValueError(
            f"edge '{missing[0]}' of board '{board.name}' was found in none of {len(usable)} images: pick it by hand "
            "in edges.csv or give the corners of the board"
        )
    rough = np.stack([np.median(seen[name], axis=0) for name in board.edges])
    corners = corners_of_lines(rough / np.linalg.norm(rough[:, :2], axis=1, keepdims=True))
    fitted = [_median_line(seen[n], corners[[i, (i + 1) % len(corners)]]) for i, n in enumerate(board.edges)]
    lines = np.stack([line for line, _ in fitted])
    measured = Board(board.name, board.edges, corners_of_lines(lines), board.pattern, board.features)
    per_view = [edge_lengths(v, measured, m) for v, m in usable]
    lengths = {n: np.array([row[n] for row in per_view if n in row]) for n in board.edges}
    return Outline(
        lines,
        np.array([sd for _, sd in fitted]),
        {n: float(x) for n, x in measured.lengths().items()},
        {n: _spread(x) for n, x in lengths.items()},
        {n: len(seen[n]) for n in board.edges},
        {n: len(x) for n, x in lengths.items()},
        measured,
    )


def edge_lengths(view, board, model):
    """Lengths of the edges whose two corners can be seen in one view.

    Parameters
    ----------
    view : BoardView
    board : Board
    model : CameraModel

    Returns
    -------
    dict of str to float
        Metres, in the scale of the board; only edges found together with both neighbours.
    """
    if view.reason:
        return {}
    lines = {e.name: board_line(view, e, model) for e in view.edges}
    out = {}
    for i, name in enumerate(board.edges):
        around = [board.edges[i - 1], name, board.edges[(i + 1) % len(board.edges)]]
        if all(n in lines for n in around):
            corners = corners_of_lines(np.stack([lines[n] for n in around]))
            out[name] = float(np.linalg.norm(corners[2] - corners[1]))
    return out


def rough_outline(lines, board):
    """An outline to predict edges with: lines without any spread."""
    corners = corners_of_lines(lines)
    rough = Board(board.name, board.edges, corners, board.pattern, board.features)
    none, unknown = dict.fromkeys(board.edges, 0), dict.fromkeys(board.edges, np.nan)
    return Outline(lines, np.full(len(lines), np.nan), rough.lengths(), unknown, none, none, rough)


class OutlineNotSeen(ValueError):
    """The images do not show where a board ends (a sheet on a wall, a background as bright as the board)."""


def resolve_turns(votes, up, first):
    """Which views see the pattern turned by 180 deg against the others.

    Parameters
    ----------
    votes : ndarray, shape (v, 4, n)
        Of :func:`edge_votes`, one row a view.
    up : ndarray, shape (v,)
        Component of the board's y axis down the image: most views keep y down.
    first : ndarray of int, shape (v,)
        The first of the views that are turned alike, see :func:`lrfcal_lib.preprocess.survey.alike`.

    Returns
    -------
    ndarray of bool, shape (v,)
    """
    up = np.asarray(up)
    # edges move by a few millimetres from view to view: widen the peaks before comparing
    wide = uniform_filter1d(np.nan_to_num(np.asarray(votes, float)), 9, axis=-1)
    both = np.stack([wide, wide[:, [2, 3, 0, 1]]])
    turned = np.bincount(first, up)[first] < 0
    rows = np.arange(len(votes))
    for _ in range(50):
        mean = both[turned.astype(int), rows].mean(axis=0)
        score = np.sum(both * mean, axis=(2, 3))
        new = np.bincount(first, score[1] - score[0])[first] > 0
        if np.array_equal(new, turned):
            break
        turned = new
    kept_down = np.where(turned, -up, up)
    return turned if np.mean(kept_down > 0) >= 0.5 else ~turned


def common_lines(votes, board):
    """Board lines of the edges that many views agree on.

    Parameters
    ----------
    votes : ndarray, shape (v, 4, n)
        Turned alike.
    board : Board

    Returns
    -------
    ndarray, shape (4, 3)

    Raises
    ------
    OutlineNotSeen
        If the views do not agree on a side.
    """
    distances = wide_distances(board.pattern)
    # an edge moves by a few millimetres between placements
    wide = maximum_filter1d(np.nan_to_num(votes, nan=-1.0), 7, axis=-1)
    wide[wide < 0] = np.nan
    places = []
    for side in range(4):
        enough = np.isfinite(wide[:, side]).sum(axis=0) >= min(3, len(votes))
        mean = np.full(len(distances), np.nan)
        mean[enough] = np.nanmean(wide[:, side][:, enough], axis=0)
        smooth = gaussian_filter1d(np.nan_to_num(mean), 1.0)
        places.append(outer_peak(smooth, least=0.5, quiet=0.2, width=6))
        if places[-1] < 0:
            raise OutlineNotSeen(
                f"the images do not agree on the {SIDES[side]} edge of board '{board.name}': give the corners of the "
                "board or pick edges by hand"
            )
    return side_lines(board.pattern, distances[places])


UPRIGHT = 0.05  # weight of the turn between two cameras where few placements tell: most look the same way, head up
CLEARLY = 0.95  # a board frame whose z points into the board is believed when the other explains less than this share


def alike(rotations, placements, cameras):
    """Which orders of a pattern's corners belong together in the images of one placement.

    Parameters
    ----------
    rotations : sequence of m Rotation, n in each
        From the board to the camera, for every order that the corners may have; the same orders in all images.
    placements : sequence of m int
        Negative for an image of none, which stands alone.
    cameras : sequence of m str

    Returns
    -------
    first : ndarray of int, shape (m,)
        The first image of the same placement.
    partner : ndarray of int, shape (m, n)
        The order in the image that goes with each order in the first one.

    Notes
    -----
    Between two images of one camera the head turns by less than any two orders differ. How a camera is turned against
    another is the same at all placements, which is true for one choice of the orders only.
    """
    leader = {}
    first = np.array([leader.setdefault(p if p >= 0 else (i,), i) for i, p in enumerate(placements)], int)
    names = list(dict.fromkeys(cameras))
    turn = {c: _between(rotations, placements, cameras, names[0], c) for c in names}
    expected = [turn[cameras[i]] * turn[cameras[j]].inv() * rotations[j] for i, j in enumerate(first)]
    off = [[(r * e.inv()).magnitude() for e in ahead] for r, ahead in zip(rotations, expected, strict=True)]
    return first, np.argmin(off, axis=2) if off else np.zeros((0, 0), int)


def _between(rotations, placements, cameras, base, camera):
    """Rotation from one camera to another on which most placements agree."""
    seen = [{p: rotations[i] for i, p in reversed(list(enumerate(placements))) if cameras[i] == c and p >= 0} for c in
            (base, camera)]  # fmt: skip
    found = [seen[1][p] * seen[0][p][0].inv() for p in seen[0] if p in seen[1]]
    if base == camera or not found:
        return Rotation.identity()
    every = Rotation.concatenate(found)
    cost = [sum((f * q.inv()).magnitude().min() for f in found) + UPRIGHT * q.magnitude() for q in every]
    return every[int(np.argmin(cost))]


def decide(scores, first):
    """One order for all images of a placement.

    Parameters
    ----------
    scores : array_like, shape (m, n)
        How well each order explains each image, those that belong together in one column; orders of a mirrored board
        frame are the second half.
    first : ndarray of int, shape (m,)
        Of :func:`alike`.

    Returns
    -------
    ndarray of int, shape (m,)
    """
    if not len(scores):
        return np.zeros(0, int)
    total = np.zeros(np.shape(scores))
    np.add.at(total, first, scores)
    half = total.shape[1] // 2
    usual, mirrored = (part.max(axis=1).sum() for part in (total[:, :half], total[:, half:]))
    side = slice(0, half) if mirrored < CLEARLY * usual else slice(half, None)
    return (total[:, side].argmax(axis=1) + side.start)[first]


LEAST_VIEWS_FOR_RELIEF = 8
VIEWS_FOR_INTRINSICS = 25  # of a camera with images taken for the intrinsics; more cost time and tell little
REMEMBERED_IMAGES = 128
SAME_PLANE = 0.9999  # cosine between the normals of poses of which one is the other turned in its plane
SETTLED = 100.0  # weight of a turn that was decided before against the edges of an image, of which a board has a few


@dataclass(frozen=True)
class Survey:
    """The board in all images of a session.

    Attributes
    ----------
    views : dict of str to list of BoardView
        By camera.
    models : dict of str to CameraModel
    outline : Outline or None
        None where the board is known and has no pattern.
    board : Board
        With corners, unless the images do not show them.
    relief : ndarray, shape (k,), or None
        Heights of the pattern's corners over the sheet's mean plane, metres (zero for a flat sheet).
    unseen : str
        Why the outline of the board is not known; its views have poses then and no edges.
    """

    views: dict
    models: dict
    outline: Outline | None
    board: Board
    relief: np.ndarray | None = field(default=None, repr=False)
    unseen: str = ""


def survey(records, read, board, models, picks=(), *, one_per_placement=False, settled=None):
    """See the board in all images: corners, intrinsics where they are missing, turns, outline, edges.

    Parameters
    ----------
    records : sequence of ImageRecord
        With ``camera, file, placement, pitch``.
    read : callable
        ``read(record)`` gives the image, uint8.
    board : Board
    models : dict of str to (CameraModel or None)
        By camera; None asks for an estimate from these images.
    picks : sequence of EdgePick
    one_per_placement : bool
        Use one image of each camera and placement: of those that show the pattern the one whose pitch is nearest to
        the middle of the placement's images. Images of no placement are all used.
    settled : dict of str to dict of int to BoardView, optional
        By camera and placement: views of an earlier survey. Which way round the board is remains as it was there.

    Returns
    -------
    Survey

    Raises
    ------
    ValueError
        If a camera has no intrinsics and the board no pattern, or too few images show it.
    """
    read = lru_cache(maxsize=REMEMBERED_IMAGES)(read)
    choices = {c: _choices([r for r in records if r.camera == c], one_per_placement) for c in models}
    if board.pattern is None:
        return _survey_plain(choices, read, board, models, picks)
    cameras, found = _find_all(choices, read, PatternFinder(board.pattern))
    flat = {c: m or _intrinsics(c, found[c], board, cameras[c], read) for c, m in models.items()}
    if board.corners is not None:
        ordered, lines, unseen = _ordered_by_outline(cameras, read, board, flat, found, settled or {}), None, ""
    else:
        ordered, lines, unseen = _ordered_by_votes(cameras, read, board, flat, found)
    models, relief = _with_relief(ordered, cameras, board, models, flat)
    outline = None if lines is None else rough_outline(lines, board)
    for _ in range(1 if lines is None else 2):
        views = _view_all(cameras, read, board, models, outline, picks, ordered, relief)
        outline = measure_outline(views, board, models) if lines is not None else None
    if unseen:
        gone = tuple((name, "the outline of the board is not known") for name in board.edges)
        views = {c: [replace(v, edges=(), rejected=gone) for v in group] for c, group in views.items()}
    return Survey(views, models, outline, board if outline is None else outline.board, relief, unseen)


def _choices(group, one_per_placement):
    """Records of one camera, in lists of those of which one is to be used, the best first."""
    if not one_per_placement:
        return [[r] for r in group]
    out = {}
    for i, record in enumerate(group):
        alone = record.placement < 0 or record.purpose == "intrinsics"
        out.setdefault(("image", i) if alone else ("placement", record.placement), []).append(record)
    return [_from_the_middle(records) for records in out.values()]


def _from_the_middle(records):
    pitch = np.array([r.pitch for r in records], float)
    if len(records) < 2 or not np.isfinite(pitch).any():
        return records
    middle = (np.nanmin(pitch) + np.nanmax(pitch)) / 2
    return [records[i] for i in np.argsort(np.abs(pitch - middle), kind="stable")]


def _first_usable(records, attempt, failed):
    """The first record whose result is usable, and the result; those of the first record if none is."""
    first = None
    for record in records:
        result = attempt(record)
        if not failed(result):
            return record, result
        first = first or (record, result)
    return first


def _find_all(choices, read, finder):
    """By camera: the records to use, and the corners in each (or the reason why there are none)."""
    cameras, found = {}, {}
    for camera, lists in choices.items():
        pairs = [_first_usable(records, lambda r: _try_pattern(read(r), finder), _is_reason) for records in lists]
        cameras[camera], found[camera] = [r for r, _ in pairs], [p for _, p in pairs]
    return cameras, found


def _is_reason(found):
    return isinstance(found, str)


def _survey_plain(choices, read, board, models, picks):
    unknown = [c for c, m in models.items() if m is None]
    if unknown:
        raise ValueError(
            f"camera '{unknown[0]}' has no intrinsics and board '{board.name}' no pattern to find them with: state them"
        )
    found = []
    for camera, lists in choices.items():

        def view(record, model=models[camera]):
            return view_board(read(record), board, model, None, _of(record, picks), **_names(record))

        shown = [records for records in map(_shown, lists) if records]
        found += [_first_usable(records, view, lambda v: bool(v.reason)) for records in shown]
    views = {camera: [] for camera in choices}
    for (record, view), pose in zip(found, _turned_alike([v for _, v in found]), strict=True):
        if pose is not view.T_camera_board:
            options = {"guess": pose, **_names(record)}
            view = view_board(read(record), board, models[view.camera], None, _of(record, picks), **options)
        views[view.camera].append(view)
    return Survey(views, dict(models), None, board)


def _turned_alike(views):
    """Poses of plain boards; one that looks the same when turned in its plane is turned alike in a whole placement."""
    seen = [v for v in views if v.T_camera_board is not None]
    own = [[v.T_camera_board, *filter(partial(_same_plane, v.T_camera_board), v.alternatives)] for v in seen]
    most = max(map(len, own), default=0)
    turns = [Rotation.concatenate([p.rotation for p in poses + poses[:1] * (most - len(poses))]) for poses in own]
    partner = alike(turns, [v.placement for v in seen], [v.camera for v in seen])[1]
    chosen = iter([poses[mine[0]] for poses, mine in zip(own, partner, strict=True)])
    return [v.T_camera_board if v.T_camera_board is None else next(chosen) for v in views]


def _same_plane(pose, other):
    return pose.rotation.as_matrix()[:, 2] @ other.rotation.as_matrix()[:, 2] > SAME_PLANE


def _shown(group):
    """Images taken for the intrinsics only belong to no placement and make no view."""
    return [r for r in group if r.purpose != "intrinsics"]


def _of(record, picks):
    return [p for p in picks if p.camera == record.camera and p.file == record.file]


def _names(record):
    name = PurePath(record.file).name
    return {"camera": record.camera, "file": name, "placement": record.placement, "pitch": record.pitch}


def _try_pattern(image, finder):
    """Corners, or the reason why there are none."""
    try:
        return finder(image)
    except PatternNotFound as error:
        return str(error)


def _for_intrinsics(found, group):
    """Corners to estimate intrinsics with: the images taken for that, and the most different others up to a number.

    Without images taken for the intrinsics all are used.
    """
    seen = [(p, r.purpose == "intrinsics") for p, r in zip(found, group, strict=True) if not _is_reason(p)]
    own, others = ([p for p, mine in seen if mine is wanted] for wanted in (True, False))
    if not own:
        return others
    own = [own[i] for i in spread_views(own, VIEWS_FOR_INTRINSICS)]
    return own + [others[i] for i in spread_views(others, VIEWS_FOR_INTRINSICS - len(own))]


def _intrinsics(camera, found, board, group, read):
    try:
        size = read(group[0]).shape[1::-1] if group else (0, 0)
        return estimate_intrinsics(_for_intrinsics(found, group), board.pattern, size).model
    except ValueError as error:
        raise ValueError(f"camera '{camera}': {error}") from error


def _ordered_by_outline(cameras, read, board, models, found, settled):
    """Corners of every image in the order that the known outline asks for, the same at all images of a placement."""
    at = _with_pattern(cameras, found)
    orders = [pattern_orders(found[c][i], board, board.lines()) for c, i, _ in at]
    first, orders = _alike(at, orders, board, models)
    scores = []
    for (c, _, r), own in zip(at, orders, strict=True):
        view = settled.get(c, {}).get(r.placement)
        if view is None or view.pixels is None:
            scores.append(order_scores(read(r), board, models[c], own))
        else:
            off = np.array([np.nanstd(pixels - view.pixels, axis=0).sum() for pixels in own])
            scores.append(SETTLED * (off == off.min()))
    return _in_order(found, at, orders, decide(scores, first))


def _with_pattern(cameras, found):
    """Camera, number and record of every image in which the pattern was found."""
    pairs = ((c, i, r, p) for c, group in cameras.items() for i, (r, p) in enumerate(zip(group, found[c], strict=True)))
    return [(c, i, r) for c, i, r, p in pairs if not _is_reason(p)]


def _alike(at, orders, board, models):
    """The first image of the same placement, and the orders of the corners, those that belong together side by side."""
    points, rotations = board.pattern.points(), []
    for (c, _, _), own in zip(at, orders, strict=True):
        rotations.append(Rotation.concatenate([first_pose(points, pixels, models[c]).rotation for pixels in own]))
    placements = [-1 if r.purpose == "intrinsics" else r.placement for _, _, r in at]
    first, partner = alike(rotations, placements, [c for c, _, _ in at])
    return first, [[own[k] for k in mine] for own, mine in zip(orders, partner, strict=True)]


def _in_order(found, at, orders, chosen):
    ordered = {c: list(f) for c, f in found.items()}
    for (c, i, _), own, k in zip(at, orders, chosen, strict=True):
        ordered[c][i] = own[int(k)]
    return ordered


def _ordered_by_votes(cameras, read, board, models, found):
    """The corners of every image turned alike, and rough lines of the outline, or None and why they are not seen."""
    if len(board.edges) != 4:
        raise ValueError(
            f"board '{board.name}' has {len(board.edges)} edges and no known corners: only four edges around a pattern "
            "can be measured from images, give the corners"
        )
    at = _with_pattern(cameras, found)
    if not at:
        raise ValueError(f"none of {sum(map(len, cameras.values()))} images shows the pattern of board '{board.name}'")
    first, orders = _alike(at, [(found[c][i], turn_pattern(found[c][i])) for c, i, _ in at], board, models)
    poses = [board_pose(own[0], board.pattern, models[c])[0] for (c, _, _), own in zip(at, orders, strict=True)]
    votes = np.stack([edge_votes(read(r), board, models[c], pose) for (c, _, r), pose in zip(at, poses, strict=True)])
    turned = resolve_turns(votes, [pose.rotation.as_matrix()[1, 1] for pose in poses], first)
    votes[turned] = votes[turned][:, [2, 3, 0, 1]]
    ordered = _in_order(found, at, orders, turned)
    try:
        return ordered, common_lines(votes, board), ""
    except OutlineNotSeen as error:
        return ordered, None, str(error)


def _with_relief(ordered, cameras, board, models, flat):
    """Intrinsics and the shape of the sheet, now that the corners of all images are in one order."""
    out, reliefs = {}, []
    for camera, found in ordered.items():
        pixels = _for_intrinsics(found, cameras[camera])
        if len(pixels) < LEAST_VIEWS_FOR_RELIEF:
            out[camera] = flat[camera]
            continue
        if models[camera] is None:
            size = (flat[camera].width, flat[camera].height)
            result = estimate_intrinsics(pixels, board.pattern, size, relief=True)
            out[camera] = result.model
        else:
            out[camera] = models[camera]
            result = estimate_relief(pixels, board.pattern, models[camera])
        reliefs.append(result.relief)
    return out, np.mean(reliefs, axis=0) if reliefs else np.zeros(len(board.pattern.points()))


def _view_all(cameras, read, board, models, outline, picks, ordered, relief):
    views = {camera: [] for camera in cameras}
    for camera, group in cameras.items():
        for record, pixels in zip(group, ordered[camera], strict=True):
            options = {"pixels": pixels, "relief": relief, **_names(record)}
            if record.purpose == "intrinsics":
                continue
            if isinstance(pixels, str):
                views[camera].append(BoardView(**_names(record), reason=pixels))
            else:
                seen = view_board(read(record), board, models[camera], outline, _of(record, picks), **options)
                views[camera].append(seen)
    return views


def views_of(session, models=None, *, one_per_placement=False):
    """The board in all images of a session: :func:`survey` of its records.

    Parameters
    ----------
    session : Session
    models : dict of str to CameraModel, optional
        Replace the session's intrinsics. A camera without any gets an estimate from its images of the pattern.
    one_per_placement : bool
        See :func:`survey`.

    Returns
    -------
    Survey
    """
    known = {name: info.model for name, info in session.cameras.items()} | dict(models or {})
    records = [r for r in session.images() if r.purpose in ("board", "intrinsics")]
    return survey(records, session.read_image, session.board, known, session.picks, one_per_placement=one_per_placement)


def stereo_check(first, second, pattern, models, *, relief=None, refine=False):
    """Relative pose of two cameras from the pattern's corners in views of the same placements.

    Parameters
    ----------
    first, second : sequence of BoardView
        Of two cameras; views with the same placement belong together.
    pattern : Chessboard
    models : pair of CameraModel
        Intrinsics.
    relief : ndarray, shape (k,), optional
        Non-zero heights: the sheet is wavy, its shape is estimated along.
    refine : bool
        Estimate the intrinsics of both cameras along: the best knowledge of the mounting. Without, the result goes with
        the given intrinsics (so does a calibration that uses them), and the covariance leaves their errors out.

    Returns
    -------
    T_second_first : RigidTransform
    covariance : ndarray, shape (6, 6)
        Of ``[w, v]``.
    adjustment : Adjustment

    Raises
    ------
    ValueError
        If no placement is seen by both cameras.
    """
    corners = [
        {v.placement: v.pixels for v in views if v.pixels is not None and v.placement >= 0} for views in (first, second)
    ]
    wavy = relief is not None and bool(np.any(relief))
    result = stereo_transform(*corners, pattern, models, intrinsics=refine, relief=wavy)
    return result.mounting[1], result.mounting_covariance[0], result
