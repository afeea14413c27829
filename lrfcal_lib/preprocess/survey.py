"""What the cameras of a session see of the board: intrinsics, poses, turns, edges, the outline that nobody measured."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import PurePath

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, uniform_filter1d
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import Board, corners_of_lines
from lrfcal_lib.preprocess.board_in_image import BoardView, order_scores, view_board
from lrfcal_lib.preprocess.edges_in_image import (
    SIDES,
    board_line,
    edge_votes,
    outer_peak,
    outward_line,
    side_lines,
    wide_distances,
)
from lrfcal_lib.preprocess.intrinsics import (
    adjust_robust,
    board_pose,
    estimate_intrinsics,
    estimate_relief,
    first_pose,
)
from lrfcal_lib.preprocess.pattern_in_image import PatternFinder, PatternNotFound, pattern_orders, spread_views

UPRIGHT = 0.05  # weight of the turn between two cameras where few placements tell: most look the same way, head up
CLEARLY = 0.95  # a board frame whose z points into the board is believed when the other explains less than this share
LEAST_VIEWS_FOR_RELIEF = 8
VIEWS_FOR_INTRINSICS = 25  # of a camera with images taken for the intrinsics; more cost time and tell little
REMEMBERED_IMAGES = 128
SAME_PLANE = 0.9999  # cosine between the normals of poses of which one is the other turned in its plane
SETTLED = 100.0  # weight of a turn that was decided before against the edges of an image, of which a board has a few


@dataclass(frozen=True)
class Survey:
    """The board in all images of a session.

    `views` (lists of BoardView) and `models` are by camera. `outline` is None where the board is known or has no
    pattern; `board` has corners, unless the images do not show them. `relief` (k,) are the heights of the pattern's
    corners over the sheet's mean plane, metres. `unseen` tells why the outline of the board is not known; its views
    have poses then and no edges.
    """

    views: dict
    models: dict
    outline: Outline | None
    board: Board
    relief: np.ndarray | None = field(default=None, repr=False)
    unseen: str = ""


@dataclass(frozen=True)
class Outline:
    """The outer edges of a board, measured in the scale of its pattern.

    Attributes
    ----------
    lines : ndarray, shape (E, 3)
        Board-frame lines ``a x + b y + c = 0``, unit normals out of the board, in the order of ``board.edges``.
    line_sd : ndarray, shape (E,)
        Standard deviation over the views of an edge's offset at its middle, metres.
    lengths, length_sd : dict of str to float
        Edge lengths of the outline and their standard deviation over the views that show the edge with both neighbours
        (NaN below two), metres.
    n_views, n_lengths : dict of str to int
        Views that show the edge, and those that show it with both neighbours.
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


class OutlineNotSeen(ValueError):
    """The images do not show where a board ends (a sheet on a wall, a background as bright as the board)."""


@dataclass(frozen=True)
class Shown:
    """An image that was chosen: its record, and the pattern's corners as found (k, 2), or the reason why not."""

    record: object
    corners: np.ndarray | str

    @property
    def found(self):
        """Whether the image shows the pattern."""
        return not isinstance(self.corners, str)


def views_of(session, models=None, *, one_per_placement=False):
    """The board in all images of a session: :func:`survey` of its records.

    `models` (by camera) replace the session's intrinsics; a camera without any gets an estimate from its images.
    """
    known = {name: info.model for name, info in session.cameras.items()} | dict(models or {})
    records = [r for r in session.images() if r.purpose in ("board", "intrinsics")]
    return survey(records, session.read_image, session.board, known, session.picks, one_per_placement=one_per_placement)


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
        If a camera has no intrinsics and the board no pattern, or too few images show it; if a pick names an edge that
        the board does not have.
    """
    read = lru_cache(maxsize=REMEMBERED_IMAGES)(read)
    marks = {}
    for pick in picks:
        if pick.edge not in board.edges:
            raise ValueError(f"{pick.file}: picked edge '{pick.edge}' is not one of the board's edges {board.edges}")
        marks.setdefault((pick.camera, pick.file), {})[pick.edge] = np.asarray(pick.ends, float)
    view = partial(_view, read, marks)
    choices = [group for camera in models for group in _choices(records, camera, one_per_placement)]
    if board.pattern is None:
        return _survey_plain(choices, view, board, models)
    finder = PatternFinder(board.pattern)
    images = [_with_corners(group, read, finder) for group in choices]
    flat = {c: m or _intrinsics(c, images, board, read) for c, m in models.items()}
    if board.corners is not None:
        images, lines, unseen = _ordered_by_outline(images, read, board, flat, settled or {}), board.lines(), ""
    else:
        images, lines, unseen = _ordered_by_votes(images, read, board, flat)
    models, relief = _with_relief(images, board, models, flat)
    outline = None
    for _ in range(1 if board.corners is not None or unseen else 2):
        views = {camera: [] for camera in models}
        for image in (image for image in images if image.record.purpose != "intrinsics"):
            views[image.record.camera].append(view(image, board, models, lines=lines, relief=relief))
        if board.corners is None and not unseen:
            outline = measure_outline(views, board, models)
            lines = outline.lines
    return Survey(views, models, outline, board if outline is None else outline.board, relief, unseen)


def _view(read, marks, image, board, models, **options):
    """The board in one image that was chosen, with what was picked in it by hand."""
    r = image.record
    view = BoardView(r.camera, PurePath(r.file).name, r.placement, r.pitch)
    if board.pattern is not None:
        if not image.found:
            return replace(view, reason=image.corners)
        options["pixels"] = image.corners
    return view_board(read(r), board, models[r.camera], view, marks.get((r.camera, r.file)), **options)


def _choices(records, camera, one_per_placement):
    """Records of one camera, in lists of those of which one is to be used, the best first."""
    groups = {}
    for i, r in enumerate(r for r in records if r.camera == camera):
        alone = not one_per_placement or r.placement < 0 or r.purpose == "intrinsics"
        groups.setdefault(("image", i) if alone else r.placement, []).append(r)
    for group in groups.values():
        pitch = np.array([r.pitch for r in group], float)
        if len(group) > 1 and np.isfinite(pitch).any():
            middle = (np.nanmin(pitch) + np.nanmax(pitch)) / 2
            group[:] = [group[i] for i in np.argsort(np.abs(pitch - middle), kind="stable")]
    return list(groups.values())


def _with_corners(group, read, finder):
    """The first image of a list that shows the pattern; the first one if none does."""
    first = None
    for record in group:
        try:
            return Shown(record, finder(read(record)))
        except PatternNotFound as error:
            first = first or Shown(record, str(error))
    return first


def _for_intrinsics(images):
    """Corners to estimate intrinsics with: the images taken for that, and the most different others up to a number.

    Without images taken for the intrinsics all are used.
    """
    own, others = (
        [image.corners for image in images if image.found and (image.record.purpose == "intrinsics") is wanted]
        for wanted in (True, False)
    )
    if not own:
        return others
    own = [own[i] for i in spread_views(own, VIEWS_FOR_INTRINSICS)]
    return own + [others[i] for i in spread_views(others, VIEWS_FOR_INTRINSICS - len(own))]


def _intrinsics(camera, images, board, read):
    mine = [image for image in images if image.record.camera == camera]
    size = read(mine[0].record).shape[1::-1] if mine else (0, 0)
    try:
        return estimate_intrinsics(_for_intrinsics(mine), board.pattern, size).model
    except ValueError as error:
        raise ValueError(f"camera '{camera}': {error}") from error


def _with_relief(images, board, models, flat):
    """Intrinsics and the shape of the sheet, now that the corners of all images are in one order."""
    out, reliefs = {}, []
    for camera, model in models.items():
        pixels = _for_intrinsics([image for image in images if image.record.camera == camera])
        if len(pixels) < LEAST_VIEWS_FOR_RELIEF:
            out[camera] = flat[camera]
            continue
        if model is None:
            size = (flat[camera].width, flat[camera].height)
            result = estimate_intrinsics(pixels, board.pattern, size, relief=True)
        else:
            result = estimate_relief(pixels, board.pattern, model)
        out[camera] = result.model
        reliefs.append(result.relief)
    return out, np.mean(reliefs, axis=0) if reliefs else np.zeros(len(board.pattern.points()))


def _poses_and_partners(images, board, models, orders):
    """Rough poses of the board in every image for every order of its corners; which belong together (:func:`alike`).

    The poses of an image are that of one order, turned in the board.
    """
    points = board.pattern.points()
    middle = points.mean(axis=0)
    turns = [Rotation.align_vectors(points[order] - middle, points - middle)[0] for order in orders]
    turns = RigidTransform.concatenate([RigidTransform.from_components(middle - t.apply(middle), t) for t in turns])
    poses = [first_pose(points, image.corners, models[image.record.camera]) * turns for image in images]
    placements = [-1 if i.record.purpose == "intrinsics" else i.record.placement for i in images]
    return poses, *alike([pose.rotation for pose in poses], placements, [i.record.camera for i in images])


def _in_order(images, orders):
    """All images, those with corners in an order of their own."""
    orders = iter(orders)
    return [replace(i, corners=i.corners[next(orders)]) if i.found else i for i in images]


def _ordered_by_outline(images, read, board, models, settled):
    """Corners of every image in the order that the known outline asks for, the same at all images of a placement."""
    seen, orders, scores = [image for image in images if image.found], pattern_orders(board.pattern), []
    poses, first, partner = _poses_and_partners(seen, board, models, orders)
    for image, own, pose in zip(seen, partner, poses, strict=True):
        pixels, camera = image.corners[orders[own]], image.record.camera
        view = settled.get(camera, {}).get(image.record.placement)
        if view is None or view.pixels is None:
            scores.append(order_scores(read(image.record), board, models[camera], pixels, pose[own]))
        else:
            off = np.nanstd(pixels - view.pixels, axis=1).sum(axis=1)
            scores.append(SETTLED * (off == off.min()))
    chosen = decide(scores, first)
    return _in_order(images, [orders[own[k]] for own, k in zip(partner, chosen, strict=True)])


def _ordered_by_votes(images, read, board, models):
    """Images with corners turned alike, and rough lines of the outline, or None and why they are not seen."""
    if len(board.edges) != 4:
        raise ValueError(
            f"board '{board.name}' has {len(board.edges)} edges and no known corners: only four edges around a pattern "
            "can be measured from images, give the corners"
        )
    seen, orders = [image for image in images if image.found], pattern_orders(board.pattern, mirrored=False)
    if not seen:
        raise ValueError(f"none of {len(images)} images shows the pattern of board '{board.name}'")
    _, first, partner = _poses_and_partners(seen, board, models, orders)
    votes, up = [], []
    for image, own in zip(seen, partner, strict=True):
        model = models[image.record.camera]
        pose = board_pose(image.corners[orders[own[0]]], board.pattern, model)[0]
        votes.append(edge_votes(read(image.record), board, model, pose))
        up.append(pose.rotation.as_matrix()[1, 1])
    votes = np.stack(votes)
    turned = resolve_turns(votes, np.array(up), first).astype(int)
    votes = np.where(turned[:, None, None], votes[:, [2, 3, 0, 1]], votes)
    images = _in_order(images, [orders[own[k]] for own, k in zip(partner, turned, strict=True)])
    try:
        return images, common_lines(votes, board), ""
    except OutlineNotSeen as error:
        return images, None, str(error)


def resolve_turns(votes, up, first):
    """Which views see the pattern turned by 180 deg against the others, shape (v,).

    `votes` (v, 4, n) are those of :func:`edge_votes`, `up` is the component of the board's y axis down the image (most
    views keep y down), `first` the first of the views that are turned alike, see :func:`alike`.
    """
    # edges move by a few millimetres from view to view: widen the peaks before comparing
    wide = uniform_filter1d(np.nan_to_num(votes), 9, axis=-1)
    both = np.stack([wide, wide[:, [2, 3, 0, 1]]])
    turned = np.bincount(first, up)[first] < 0
    for _ in range(50):
        mean = both[turned.astype(int), np.arange(len(votes))].mean(axis=0)
        score = np.sum(both * mean, axis=(2, 3))
        new = np.bincount(first, score[1] - score[0])[first] > 0
        if np.array_equal(new, turned):
            break
        turned = new
    return turned if np.mean(np.where(turned, -up, up) > 0) >= 0.5 else ~turned


def common_lines(votes, board):
    """Board lines (4, 3) of the edges that many views agree on, from votes (v, 4, n) that are turned alike."""
    # an edge moves by a few millimetres between placements
    wide = maximum_filter1d(np.nan_to_num(votes, nan=-1.0), 7, axis=-1)
    wide[wide < 0] = np.nan
    distances, places = wide_distances(board.pattern), []
    for name, own in zip(SIDES, np.moveaxis(wide, 1, 0), strict=True):
        enough = np.isfinite(own).sum(axis=0) >= min(3, len(votes))
        mean = np.zeros(len(distances))
        mean[enough] = np.nanmean(own[:, enough], axis=0)
        places.append(outer_peak(gaussian_filter1d(mean, 1.0)))
        if places[-1] < 0:
            raise OutlineNotSeen(
                f"the images do not agree on the {name} edge of board '{board.name}': give the corners of the board or "
                "pick edges by hand"
            )
    return side_lines(board.pattern, distances[places])


def alike(rotations, placements, cameras):
    """Which orders of a pattern's corners belong together in the images of one placement.

    `rotations` (m, with n in each) are from the board to the camera, for every order that the corners may have, the
    same orders in all images; placements are negative for an image of none, which stands alone. Returns the first image
    of the same placement (m,), and the order in the image that goes with each order in the first one (m, n).

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
    images = list(zip(rotations, placements, cameras, strict=True))[::-1]  # the first of a placement counts
    seen = [{p: r for r, p, c in images if c == name and p >= 0} for name in (base, camera)]
    found = [seen[1][p] * seen[0][p][0].inv() for p in sorted(seen[0]) if p in seen[1]]
    if base == camera or not found:
        return Rotation.identity()
    every = Rotation.concatenate(found)
    cost = [sum((f * q.inv()).magnitude().min() for f in found) + UPRIGHT * q.magnitude() for q in every]
    return every[int(np.argmin(cost))]


def decide(scores, first):
    """One order for all images of a placement, shape (m,).

    `scores` (m, n) tell how well each order explains each image, those that belong together in one column; orders of a
    mirrored board frame are the second half. `first` (m,) is that of :func:`alike`.
    """
    if not len(scores):
        return np.zeros(0, int)
    total = np.zeros(np.shape(scores))
    np.add.at(total, first, scores)
    half = total.shape[1] // 2
    usual, mirrored = (part.max(axis=1).sum() for part in (total[:, :half], total[:, half:]))
    side = slice(0, half) if mirrored < CLEARLY * usual else slice(half, None)
    return (total[:, side].argmax(axis=1) + side.start)[first]


def _survey_plain(choices, view, board, models):
    """The same for a board without pattern; one that looks the same when turned is turned alike in a placement."""
    unknown = [c for c, m in models.items() if m is None]
    if unknown:
        raise ValueError(
            f"camera '{unknown[0]}' has no intrinsics and board '{board.name}' no pattern to find them with: state them"
        )
    found = []
    for group in choices:
        tried = []
        for record in (r for r in group if r.purpose != "intrinsics"):
            tried.append((record, view(Shown(record, ""), board, models)))
            if not tried[-1][1].reason:
                break
        found += sorted(tried, key=lambda item: item[1].reason != "")[:1]
    seen = [v for _, v in found if v.T_camera_board is not None]
    own = []
    for v in seen:
        normal = v.T_camera_board.rotation.as_matrix()[:, 2]
        same = [p for p in v.alternatives if p.rotation.as_matrix()[:, 2] @ normal > SAME_PLANE]
        own.append([v.T_camera_board, *same])
    most = max(map(len, own), default=0)
    turns = [Rotation.concatenate([p.rotation for p in poses + poses[:1] * (most - len(poses))]) for poses in own]
    partner = alike(turns, [v.placement for v in seen], [v.camera for v in seen])[1]
    chosen = iter([poses[mine[0]] for poses, mine in zip(own, partner, strict=True)])
    views = {camera: [] for camera in models}
    for record, v in found:
        pose = None if v.T_camera_board is None else next(chosen)
        views[v.camera].append(v if pose is v.T_camera_board else view(Shown(record, ""), board, models, guess=pose))
    return Survey(views, dict(models), None, board)


def measure_outline(views, board, models):
    """Outer edges of the board (an Outline) from all images of all cameras.

    Median over the views of the edge's offset at two places; the spread is 1.4826 times the median deviation. A board
    bends between placements, so the spread is its own, not the noise of the images. ValueError names an edge that was
    seen in no image.
    """
    usable = [(v, models[camera]) for camera, group in views.items() for v in group if not v.reason]
    seen = [{e.name: board_line(v, e, m) for e in v.edges} for v, m in usable]
    lines = {name: np.array([own[name] for own in seen if name in own]) for name in board.edges}
    missing = [name for name, found in lines.items() if not len(found)]
    if missing:
        raise ValueError(
            f"edge '{missing[0]}' of board '{board.name}' was found in none of {len(usable)} images: pick it by hand "
            "in edges.csv or give the corners of the board"
        )
    rough = corners_of_lines([np.median(found, axis=0) for found in lines.values()])
    fitted = [
        _median_line(found, rough[[i - len(rough), i + 1 - len(rough)]]) for i, found in enumerate(lines.values())
    ]
    measured = replace(board, corners=corners_of_lines([line for line, _ in fitted]))
    lengths = {}
    for before, name, after in zip(np.roll(board.edges, 1), board.edges, np.roll(board.edges, -1), strict=True):
        corners = [
            corners_of_lines([own[n] for n in (before, name, after)])
            for own in seen
            if {before, name, after} <= own.keys()
        ]
        lengths[name] = np.array([np.linalg.norm(c[2] - c[1]) for c in corners])
    return Outline(
        np.stack([line for line, _ in fitted]),
        np.array([sd for _, sd in fitted]),
        {n: float(x) for n, x in measured.lengths().items()},
        {n: _spread(x) for n, x in lengths.items()},
        {n: len(found) for n, found in lines.items()},
        {n: len(x) for n, x in lengths.items()},
        measured,
    )


def _spread(values):
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) if len(values) > 1 else float("nan")


def _median_line(lines, ends):
    """Median line (of n, 3) from its offsets at two ends, and the spread at the middle."""
    normal = np.median(lines[:, :2], axis=0)
    normal /= np.linalg.norm(normal)
    # where every line crosses the normals raised at the two ends
    offsets = -(lines[:, :2] @ ends.T + lines[:, 2:]) / (lines[:, :2] @ normal)[:, None]
    a, b = ends + np.median(offsets, axis=0)[:, None] * normal
    return outward_line(a, b, normal), _spread(offsets.mean(axis=1))


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
    corners = [{v.placement: v.pixels for v in views if v.pixels is not None and v.placement >= 0}
               for views in (first, second)]  # fmt: skip
    common = sorted(corners[0].keys() & corners[1].keys())
    if not common:
        raise ValueError("no placement shows the pattern to both cameras: the stereo check needs at least one")
    pixels = np.array([[own[p] for p in common] for own in corners])
    poses = [
        RigidTransform.concatenate([board_pose(p, pattern, model)[0] for p in own])
        for own, model in zip(pixels, models, strict=True)
    ]
    between = poses[1] * poses[0].inv()
    rough = RigidTransform.from_components(np.median(between.translation, axis=0), between.rotation.mean())
    mounting = RigidTransform.concatenate([RigidTransform.identity(), rough])
    options = {"intrinsics": refine, "relief": relief is not None and bool(np.any(relief))}
    options["fixed"] = (8,) if all(m.distortion[4] == 0 for m in models) else ()
    result = adjust_robust(pixels, pattern.points(), models, poses[0], mounting, **options)
    return result.mounting[1], result.mounting_covariance[0], result
