"""What the cameras of a session see of the board: intrinsics, poses, turns, edges, the outline
that nobody measured.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import PurePath

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.fit.robust import robust_sigma
from lrfcal_lib.model.board import Board, corners_of_lines
from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.preprocess.board_in_image import BoardView, order_scores, view_board
from lrfcal_lib.preprocess.edges_in_image import (
    OutlineNotSeen,
    board_line,
    common_lines,
    edge_votes,
    outward_line,
)
from lrfcal_lib.preprocess.intrinsics import (
    board_pose,
    estimate_intrinsics,
    estimate_relief,
    first_pose,
)
from lrfcal_lib.preprocess.kept_images import KeptImages
from lrfcal_lib.preprocess.pattern_in_image import (
    SMALL_SQUARE_PX,
    PatternFinder,
    PatternNotFound,
    pattern_orders,
    scale_error,
    spread_views,
    square_px,
)
from lrfcal_lib.session.cache import spread
from lrfcal_lib.session.stated import short

# weight of the turn between two cameras where few placements tell: most look the same way, head up
UPRIGHT = 0.05
# a board frame whose z points into the board is believed when the other explains less than this
# share
CLEARLY = 0.95
LEAST_VIEWS_FOR_RELIEF = 8
# of a camera with images taken for the intrinsics; more cost time and tell little
VIEWS_FOR_INTRINSICS = 25
# cosine between the normals of poses of which one is the other turned in its plane
SAME_PLANE = 0.9999


@dataclass(frozen=True)
class Outline:
    """The outer edges of a board, measured in the scale of its pattern.

    Attributes
    ----------
    board : Board
        With its corners filled in.
    lines : ndarray, shape (E, 3)
        Board-frame lines ``a x + b y + c = 0``, unit normals out of the board, in the order of
        ``board.edges``.
    line_sd : ndarray, shape (E,)
        Standard deviation over the views of an edge's offset at its middle, metres.
    length_sd : dict of str to float
        Standard deviation of an edge's length over the views that show it with both neighbours (NaN
        below two), metres.
    n_lengths : dict of str to int
        Views that show the edge with both neighbours.
    """

    board: Board
    lines: np.ndarray
    line_sd: np.ndarray
    length_sd: dict
    n_lengths: dict


@dataclass(frozen=True)
class Survey:
    """The board in all images of a session.

    `views` (lists of BoardView) and `models` are by camera. `outline` is None where the board is
    known or has no pattern; `board` has corners, unless the images do not show them. `relief` (k,)
    are the heights of the pattern's corners over the sheet's mean plane, metres. `unseen` tells why
    the outline of the board is not known; its views have poses then and no edges.
    """

    views: dict
    models: dict
    outline: Outline | None
    board: Board
    relief: np.ndarray | None = field(default=None, repr=False)
    unseen: str = ""


def views_of(session, models=None, *, one_per_placement=False):
    """:func:`survey` of a session's images.

    `models` by camera replace its intrinsics, missing ones are estimated.
    """
    known = {name: info.model for name, info in session.cameras.items()} | dict(models or {})
    records = [r for r in session.images() if r.purpose in ("board", "intrinsics")]
    return survey(
        records,
        session.read_image,
        session.board,
        known,
        session.picks,
        one_per_placement=one_per_placement,
    )


def survey(records, read, board, models, picks=(), *, one_per_placement=False):
    """See the board in all images: corners, intrinsics where they are missing, turns, outline,
    edges.

    Parameters
    ----------
    records : sequence of ImageRecord
        With ``camera, file, placement, pitch, purpose``.
    read : callable
        ``read(record)`` gives the image, uint8.
    board : Board
    models : dict of str to (CameraModel or None)
        By camera; None asks for an estimate from these images.
    picks : sequence of EdgePick
    one_per_placement : bool
        Use one image of each camera and placement: of those that show the board the one whose pitch
        is nearest to the middle of the placement's images. Images of no placement are all used.

    Returns
    -------
    Survey

    Raises
    ------
    ValueError
        If a camera has no intrinsics and the board no pattern, or too few images show it; if a pick
        names an edge that the board does not have.
    """
    marks = _marks(picks, board)
    plain = board.pattern is None
    unknown = [c for c, m in models.items() if m is None]
    if plain and unknown:
        lost = (
            f"camera '{unknown[0]}' has no intrinsics and board '{board.name}' no pattern to "
            "find them with"
        )
        raise ValueError(f"{lost}: state them")
    finder = None if plain else PatternFinder(board.pattern)
    kept = None if plain else KeptImages(read, board)

    def look(r, view, models, **options):
        """The board in one image, with what was picked in it by hand."""
        image = read(r) if plain else kept.around_board(r)
        return view_board(
            image, board, models[r.camera], view, marks.get((r.camera, r.file)), **options
        )

    def begin(r):
        """The corners of the pattern in one image, in any order; all of a board that has none."""
        if plain:
            return look(r, _view(r), models)
        image = read(r)
        view = _corners(_view(r), image, finder)
        if not view.reason:
            kept.keep(r, image, view.pixels)
        return view

    usable = [r for r in records if not plain or r.purpose != "intrinsics"]
    groups = [group for c in models for group in _choices(usable, c, one_per_placement)]
    if kept is not None and groups:
        kept.make_room([r for group in groups for r in group], read(groups[0][0]))
    images = [_first(group, begin) for group in groups[:1]]  # tells the finder what to look for
    images += spread(lambda group: _first(group, begin), groups[1:])
    if plain:
        return Survey(
            _by_camera(models, _turned_alike([view for _, view in images])),
            dict(models),
            None,
            board,
        )
    flat = spread(lambda c: models[c] or _intrinsics(c, images, board, read), models)
    flat = dict(zip(models, flat, strict=True))
    images, lines, unseen = _ordered(images, kept.around_board, board, flat)
    models, relief = _with_relief(images, board, models, flat)
    images = [(r, view) for r, view in images if r.purpose != "intrinsics"]
    known = board.corners is not None or unseen
    outline = None
    for _ in range(1 if known else 2):
        again = partial(look, models=models, lines=lines, relief=relief)
        views = spread(lambda own: own[1] if own[1].reason else again(*own), images)  # noqa: B023
        if not known:
            outline = measure_outline(views, board, models)
            lines = outline.lines
    board = board if outline is None else outline.board
    return Survey(_by_camera(models, views), models, outline, board, relief, unseen)


def all_views(prepared):
    """The board in all images of a prepared session, by camera, with its intrinsics, outline and
    relief.

    Images of no placement are left out. Which way round the board is remains as the prepared views
    have it: sides of scans bear the names of that turn. Where every placement has one image these
    are the prepared views.
    """
    session = prepared.session
    board = prepared.board
    views = {camera: [] for camera in prepared.views}
    records = [
        r
        for r in session.images(purpose="board")
        if r.placement in prepared.views.get(r.camera, {})
    ]
    if len(records) <= sum(map(len, prepared.views.values())) or board.pattern is None:
        return {camera: list(found.values()) for camera, found in prepared.views.items()}
    marks = _marks(session.picks, board)
    finder = PatternFinder(board.pattern)
    orders = pattern_orders(board.pattern)
    options = {"lines": None if board.corners is None else board.lines(), "relief": prepared.relief}

    def look(r):
        """The board in one image.

        None where the prepared view says it: the same image, or none shows the board.
        """
        view = _view(r)
        seen = prepared.views[r.camera][r.placement]
        if seen.file == view.file or seen.pixels is None:
            return None
        image = session.read_image(r)
        view = _corners(view, image, finder)
        if view.reason:
            return view
        off = [np.nanstd(view.pixels[order] - seen.pixels, axis=0).sum() for order in orders]
        view = replace(view, pixels=view.pixels[orders[int(np.argmin(off))]])
        picked = marks.get((r.camera, r.file))
        return view_board(image, board, prepared.models[r.camera], view, picked, **options)

    for r, view in zip(records, spread(look, records), strict=True):
        same = replace(prepared.views[r.camera][r.placement], file=_view(r).file, pitch=r.pitch)
        views[r.camera].append(same if view is None else view)
    return views


def small_squares(views, pattern):
    """In words, by camera, in which images squares are so small that corners may be biased.

    `views` (dict of BoardView by placement) are by camera, `pattern` is None for a board without.
    """
    words = {}
    if pattern is None:
        return words
    size = (pattern.columns, pattern.rows)
    for camera, seen in views.items():
        sides = {p: square_px(v.pixels, size) for p, v in seen.items() if v.pixels is not None}
        small = {p: side for p, side in sides.items() if side < SMALL_SQUARE_PX}
        if not small:
            continue
        least = min(small.values())
        words[camera] = (
            f"squares are less than {SMALL_SQUARE_PX:.0f} px wide in {len(small)} of {len(sides)} "
            f"images (placements {short(list(small))}), {least:.1f} px at least: distances may be "
            f"off by {100 * scale_error(least):.2g} %, more if the image is blurred; go nearer, or "
            "print larger squares"
        )
    return words


def _marks(picks, board):
    """Ends of edges picked by hand, by camera and file, then by edge."""
    marks = {}
    for pick in picks:
        if pick.edge not in board.edges:
            raise ValueError(
                f"{pick.file}: picked edge '{pick.edge}' is not one of the board's edges "
                f"{board.edges}"
            )
        marks.setdefault((pick.camera, pick.file), {})[pick.edge] = np.asarray(pick.ends, float)
    return marks


def _view(record):
    return BoardView(record.camera, PurePath(record.file).name, record.placement, record.pitch)


def _corners(view, image, finder):
    try:
        return replace(view, pixels=finder(image))
    except PatternNotFound as error:
        return replace(view, reason=str(error))


def _by_camera(cameras, views):
    return {camera: [view for view in views if view.camera == camera] for camera in cameras}


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


def _first(group, begin):
    """The first image of a list that shows the board, as (record, view).

    The first one if none does.
    """
    tried = ((record, begin(record)) for record in group)
    first = next(tried)
    return next((pair for pair in tried if not pair[1].reason), first) if first[1].reason else first


def _for_intrinsics(images, camera):
    """Corners to estimate intrinsics with: the images taken for that, and the most different others
    up to a number.

    Without images taken for the intrinsics all are used.
    """
    seen = [
        (r.purpose == "intrinsics", v.pixels)
        for r, v in images
        if r.camera == camera and v.pixels is not None
    ]
    own, others = (
        [pixels for meant, pixels in seen if meant is wanted] for wanted in (True, False)
    )
    if not own:
        return others
    own = [own[i] for i in spread_views(own, VIEWS_FOR_INTRINSICS)]
    return own + [others[i] for i in spread_views(others, VIEWS_FOR_INTRINSICS - len(own))]


def _intrinsics(camera, images, board, read):
    size = next((read(r).shape[1::-1] for r, _ in images if r.camera == camera), (0, 0))
    try:
        return estimate_intrinsics(_for_intrinsics(images, camera), board.pattern, size).models[0]
    except ValueError as error:
        raise DegenerateGeometry(f"camera '{camera}': {error}") from error


def _with_relief(images, board, models, flat):
    """Intrinsics and the shape of the sheet, now that the corners of all images are in one
    order.
    """

    def estimate(camera):
        """The Adjustment of a camera that sees the pattern often enough."""
        pixels = _for_intrinsics(images, camera)
        model = flat[camera]
        if len(pixels) < LEAST_VIEWS_FOR_RELIEF:
            return None
        if models[camera] is None:
            return estimate_intrinsics(
                pixels, board.pattern, (model.width, model.height), relief=True
            )
        return estimate_relief(pixels, board.pattern, model)

    found = {
        c: result
        for c, result in zip(flat, spread(estimate, flat), strict=True)
        if result is not None
    }
    reliefs = [result.relief for result in found.values()] or np.zeros(
        (1, len(board.pattern.points()))
    )
    return flat | {c: result.models[0] for c, result in found.items()}, np.mean(reliefs, axis=0)


def _ordered(images, read, board, models):
    """Images with the pattern's corners in the order that the outline asks for, the same in all of
    a placement.

    Also the lines of the outline: rough ones where it is not known, or None and why they are not
    seen.
    """
    known = board.corners is not None
    if not known and len(board.edges) != 4:
        raise ValueError(
            f"board '{board.name}' has {len(board.edges)} edges and no known corners: only four "
            "edges around a pattern "
            "can be measured from images, give the corners"
        )
    seen = [(r, v, models[v.camera]) for r, v in images if v.pixels is not None]
    if not known and not seen:
        raise DegenerateGeometry(
            f"none of {len(images)} images shows the pattern of board '{board.name}'"
        )
    points = board.pattern.points()
    orders = pattern_orders(board.pattern, mirrored=known)
    middle = points.mean(axis=0)
    turns = [Rotation.align_vectors(points[order] - middle, points - middle)[0] for order in orders]
    turns = RigidTransform.concatenate(
        [RigidTransform.from_components(middle - t.apply(middle), t) for t in turns]
    )
    # rough poses in every image for every order of its corners: that of one order, turned in the
    # board
    poses = [first_pose(points, v.pixels, model) * turns for _, v, model in seen]
    placements = [-1 if r.purpose == "intrinsics" else v.placement for r, v, _ in seen]
    first, partner = alike(
        [pose.rotation for pose in poses], placements, [v.camera for _, v, _ in seen]
    )
    if known:

        def score(number):
            """Of one image in every order."""
            (r, v, model) = seen[number]
            own = partner[number]
            return order_scores(read(r), board, model, v.pixels[orders[own]], poses[number][own])

        scores = spread(score, range(len(seen)))
        chosen = decide(scores, first)
        lines = board.lines()
        unseen = ""
    else:
        votes = []
        up = []
        for (r, v, model), own in zip(seen, partner, strict=True):
            pose = board_pose(v.pixels[orders[own[0]]], board.pattern, model)[0]
            votes.append(edge_votes(read(r), board, model, pose))
            up.append(pose.rotation.as_matrix()[1, 1])
        chosen, lines, unseen = _by_votes(np.stack(votes), np.array(up), first, board)
    corners = iter(
        [v.pixels[orders[own[k]]] for (_, v, _), own, k in zip(seen, partner, chosen, strict=True)]
    )
    return (
        [(r, v if v.reason else replace(v, pixels=next(corners))) for r, v in images],
        lines,
        unseen,
    )


def _by_votes(votes, up, first, board):
    """Which views see the pattern turned by 180 deg against the others, (v,), and the lines that
    all then agree on.

    `votes` (v, 4, n) are those of :func:`edge_votes`, `up` is the component of the board's y axis
    down the image (most views keep y down), `first` the first of the views that are turned alike,
    see :func:`alike`. The lines are None where there are none, with the reason.
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
    turned = turned if np.mean(np.where(turned, -up, up) > 0) >= 0.5 else ~turned
    try:
        lines = common_lines(np.where(turned[:, None, None], votes[:, [2, 3, 0, 1]], votes), board)
        why = ""
    except OutlineNotSeen as error:
        lines = None
        why = str(error)
    return turned.astype(int), lines, why


def alike(rotations, placements, cameras):
    """Which orders of a pattern's corners belong together in the images of one placement.

    `rotations` (m, with n in each) are from the board to the camera, for every order that the
    corners may have, the same orders in all images; placements are negative for an image of none,
    which stands alone. Returns the first image of the same placement (m,), and the order in the
    image that goes with each order in the first one (m, n).

    Between two images of one camera the head turns by less than any two orders differ. How a camera
    is turned against another is the same at all placements, which is true for one choice of the
    orders only.
    """
    leader = {}
    first = np.array(
        [leader.setdefault(p if p >= 0 else (i,), i) for i, p in enumerate(placements)], int
    )
    names = list(dict.fromkeys(cameras))
    turn = {c: _between(rotations, placements, cameras, names[0], c) for c in names}
    expected = [
        turn[cameras[i]] * turn[cameras[j]].inv() * rotations[j] for i, j in enumerate(first)
    ]
    off = [
        [(r * e.inv()).magnitude() for e in ahead]
        for r, ahead in zip(rotations, expected, strict=True)
    ]
    return first, np.argmin(off, axis=2) if off else np.zeros((0, 0), int)


def _between(rotations, placements, cameras, base, camera):
    """Rotation from one camera to another on which most placements agree."""
    # the first of a placement counts
    images = list(zip(rotations, placements, cameras, strict=True))[::-1]
    seen = [{p: r for r, p, c in images if c == name and p >= 0} for name in (base, camera)]
    found = [seen[1][p] * seen[0][p][0].inv() for p in sorted(seen[0]) if p in seen[1]]
    if base == camera or not found:
        return Rotation.identity()
    every = Rotation.concatenate(found)
    cost = [
        sum((f * q.inv()).magnitude().min() for f in found) + UPRIGHT * q.magnitude() for q in every
    ]
    return every[int(np.argmin(cost))]


def decide(scores, first):
    """One order for all images of a placement, shape (m,).

    `scores` (m, n) tell how well each order explains each image, those that belong together in one
    column; orders of a mirrored board frame are the second half. `first` (m,) is that of
    :func:`alike`.
    """
    if not len(scores):
        return np.zeros(0, int)
    total = np.zeros(np.shape(scores))
    np.add.at(total, first, scores)
    half = total.shape[1] // 2
    usual, mirrored = (part.max(axis=1).sum() for part in (total[:, :half], total[:, half:]))
    side = slice(0, half) if mirrored < CLEARLY * usual else slice(half, None)
    return (total[:, side].argmax(axis=1) + side.start)[first]


def _turned_alike(views):
    """Views of a plain board, of which one that looks the same when turned is turned alike in a
    placement.
    """
    seen = [v for v in views if v.T_camera_board is not None]
    own = []
    for v in seen:
        normals = [a.T_camera_board.rotation.as_matrix()[:, 2] for a in (v, *v.alternatives)]
        own.append(
            [
                v,
                *(
                    a
                    for a, n in zip(v.alternatives, normals[1:], strict=True)
                    if n @ normals[0] > SAME_PLANE
                ),
            ]
        )
    most = max(map(len, own), default=0)
    own = [same + same[:1] * (most - len(same)) for same in own]
    turns = [Rotation.concatenate([v.T_camera_board.rotation for v in same]) for same in own]
    partner = alike(turns, [v.placement for v in seen], [v.camera for v in seen])[1]
    chosen = iter([same[mine[0]] for same, mine in zip(own, partner, strict=True)])
    return [v if v.T_camera_board is None else next(chosen) for v in views]


def measure_outline(views, board, models):
    """Outer edges of the board (an Outline) from all images of all cameras.

    Median over the views of the edge's offset at two places; the spread is 1.4826 times the median
    deviation. A board bends between placements, so the spread is its own, not the noise of the
    images. ValueError names an edge that was seen in no image.
    """
    usable = [v for v in views if not v.reason]
    lines = []
    lengths = {}
    seen = [{e.name: board_line(v, e, models[v.camera]) for e in v.edges} for v in usable]
    for name in board.edges:
        lines.append(np.array([own[name] for own in seen if name in own]))
        if not len(lines[-1]):
            raise DegenerateGeometry(
                f"edge '{name}' of board '{board.name}' was found in none of {len(usable)} "
                "images: pick it by hand "
                "in edges.csv or give the corners of the board"
            )
    rough = corners_of_lines([np.median(found, axis=0) for found in lines])
    ends = np.stack([rough, np.roll(rough, -1, axis=0)], axis=1)
    fitted, line_sd = map(np.array, zip(*map(_median_line, lines, ends), strict=True))
    for trio in zip(np.roll(board.edges, 1), board.edges, np.roll(board.edges, -1), strict=True):
        corners = [
            corners_of_lines([own[name] for name in trio]) for own in seen if own.keys() >= {*trio}
        ]
        lengths[trio[1]] = np.array([np.linalg.norm(c[2] - c[1]) for c in corners])
    spread, count = ({n: f(x) for n, x in lengths.items()} for f in (_spread, len))
    return Outline(replace(board, corners=corners_of_lines(fitted)), fitted, line_sd, spread, count)


def _spread(values):
    return robust_sigma(values - np.median(values)) if len(values) > 1 else float("nan")


def _median_line(lines, ends):
    """Median line (of n, 3) from its offsets at two ends, and the spread at the middle."""
    normal = np.median(lines[:, :2], axis=0)
    normal /= np.linalg.norm(normal)
    # where every line crosses the normals raised at the two ends
    offsets = -(lines[:, :2] @ ends.T + lines[:, 2:]) / (lines[:, :2] @ normal)[:, None]
    a, b = ends + np.median(offsets, axis=0)[:, None] * normal
    return outward_line(a, b, normal), _spread(offsets.mean(axis=1))
