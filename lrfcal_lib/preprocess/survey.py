"""What the cameras of a session see of the board: intrinsics, poses, turns, edges, its outline."""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import PurePath

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.board import Board
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.preprocess.board_in_image import BoardView, order_scores, view_board
from lrfcal_lib.preprocess.intrinsics import (
    board_pose,
    estimate_intrinsics,
    estimate_relief,
    first_pose,
)
from lrfcal_lib.preprocess.kept_images import Part, part_around
from lrfcal_lib.preprocess.outline_in_images import (
    OPPOSITE,
    Outline,
    OutlineNotSeen,
    common_lines,
    edge_votes,
    measure_outline,
    turned_views,
)
from lrfcal_lib.preprocess.pattern_in_image import (
    SMALL_SQUARE_PX,
    PatternFinder,
    PatternNotFound,
    pattern_orders,
    scale_error,
    spread_views,
    square_px,
)
from lrfcal_lib.preprocess.turns import alike, decide, turned_boards
from lrfcal_lib.session.read import ImageRecord, Session
from lrfcal_lib.session.stated import short
from lrfcal_lib.session.workers import spread

LEAST_VIEWS_FOR_RELIEF = 8
# of a camera with images taken for the intrinsics; more cost time and tell little
VIEWS_FOR_INTRINSICS = 25
# cosine between the normals of poses of which one is the other turned in its plane
SAME_PLANE = 0.9999
KEPT_BYTES = 800_000_000  # of all images: half of each of 40 with 12 megapixels


@dataclass(frozen=True)
class Survey:
    """The board in all images of a session.

    Attributes
    ----------
    views : dict of str to list of BoardView
        By camera.
    models : dict of str to CameraModel
        By camera.
    outline : Outline or None
        None where the board is known, has no pattern, or does not show where it ends.
    board : Board
        With its corners, unless the images do not show them.
    relief : ndarray, shape (k,), or None
        Heights of the pattern's corners over the sheet's mean plane, metres.
    unseen : str
        Why the outline of the board is not known; its views have poses then and no edges.
    """

    views: dict[str, list[BoardView]]
    models: dict[str, CameraModel]
    outline: Outline | None
    board: Board
    relief: np.ndarray | None = field(default=None, repr=False)
    unseen: str = ""


@dataclass(frozen=True)
class Shot:
    """An image, what was found in it, and the part of it that is kept."""

    record: ImageRecord
    view: BoardView
    part: Part | None = field(default=None, repr=False)

    def image(self, read):
        """The image; black away from the board where a part is kept."""
        return read(self.record) if self.part is None else self.part.image()


@dataclass(frozen=True)
class Ordered:
    """Shots whose corners are in the order of the pattern, and the lines of the outline.

    `lines` (E, 3) are rough where the outline is not known; None, and `unseen` says why, where the
    images do not show it.
    """

    shots: list[Shot]
    lines: np.ndarray | None
    unseen: str = ""


def views_of(session: Session, *, one_per_placement: bool = False) -> Survey:
    """:func:`survey` of a session's images.

    Parameters
    ----------
    session : Session
    one_per_placement : bool
        See :func:`survey`.

    Returns
    -------
    Survey
    """
    return survey(
        [
            record
            for record in session.images()
            if record.purpose in ("board", "intrinsics")
        ],
        session.read_image,
        session.board,
        {name: info.model for name, info in session.cameras.items()},
        session.picks,
        one_per_placement=one_per_placement,
    )


def survey(
    records, read, board: Board, models, picks=(), *, one_per_placement=False
) -> Survey:
    """Find the board in all images of several cameras.

    Parameters
    ----------
    records : sequence of ImageRecord
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
    look = partial(_look, read=read, board=board, marks=_marks(picks, board))
    if board.pattern is None:
        records = [record for record in records if record.purpose != "intrinsics"]
    groups = []
    for camera in models:
        groups += _choices(records, camera, one_per_placement)
    if board.pattern is None:
        return _survey_plain(groups, look, board, models)

    shots = _find_corners(groups, read, board)
    find = partial(_intrinsics, models=models, shots=shots, board=board, read=read)
    rough = dict(zip(models, spread(find, models), strict=True))
    ordered = _ordered(shots, read, board, rough)
    refined, relief = _with_relief(ordered.shots, board, models, rough)
    shots = [shot for shot in ordered.shots if shot.record.purpose != "intrinsics"]
    see = partial(_views, shots, look, models=refined, relief=relief)
    views = see(lines=ordered.lines)
    outline = None
    if board.corners is None and not ordered.unseen:
        views = see(lines=measure_outline(views, board, refined).lines)
        outline = measure_outline(views, board, refined)
        board = outline.board
    return Survey(
        views=_by_camera(models, views),
        models=refined,
        outline=outline,
        board=board,
        relief=relief,
        unseen=ordered.unseen,
    )


def all_views(prepared) -> dict[str, list[BoardView]]:
    """The board in all images of a prepared session, with its intrinsics, outline and relief.

    Images of no placement are left out. Which way round the board is remains as the prepared views
    have it: sides of scans bear the names of that turn. Where every placement has one image these
    are the prepared views.

    Parameters
    ----------
    prepared : Prepared

    Returns
    -------
    dict of str to list of BoardView
        By camera.
    """
    session = prepared.session
    board = prepared.board
    known = prepared.views
    records = [
        record
        for record in session.images(purpose="board")
        if record.placement in known.get(record.camera, {})
    ]
    if board.pattern is None or len(records) <= sum(map(len, known.values())):
        return {camera: list(views.values()) for camera, views in known.items()}
    marks = _marks(session.picks, board)
    finder = PatternFinder(board.pattern)
    orders = pattern_orders(board.pattern)
    lines = None if board.corners is None else board.lines()

    def look(record):
        """The board in one image: that of the placement where it is the same, or none shows it."""
        prepared_view = known[record.camera][record.placement]
        view = _view(record)
        if prepared_view.file == view.file or prepared_view.pixels is None:
            return replace(prepared_view, file=view.file, pitch=record.pitch)
        image = session.read_image(record)
        view = _corners(view, image, finder)
        if view.reason:
            return view
        shifts = view.pixels[orders] - prepared_view.pixels
        order = orders[np.nanstd(shifts, axis=1).sum(axis=1).argmin()]
        return view_board(
            image,
            board,
            prepared.models[record.camera],
            replace(view, pixels=view.pixels[order]),
            marks.get((record.camera, record.file)),
            lines=lines,
            relief=prepared.relief,
        )

    return _by_camera(known, spread(look, records))


def small_squares(views, pattern) -> dict[str, str]:
    """In which images squares are so small that corners may be biased, in words.

    Parameters
    ----------
    views : dict of str to dict of int to BoardView
        By camera and placement.
    pattern : Chessboard or None

    Returns
    -------
    dict of str to str
        By camera; those that have such images.
    """
    words: dict[str, str] = {}
    if pattern is None:
        return words
    size = (pattern.columns, pattern.rows)
    for camera, of_camera in views.items():
        sides = {
            p: square_px(v.pixels, size)
            for p, v in of_camera.items()
            if v.pixels is not None
        }
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
        marks.setdefault((pick.camera, pick.file), {})[pick.edge] = np.asarray(
            pick.ends, float
        )
    return marks


def _view(record):
    """The view of an image in which nothing was looked for yet."""
    return BoardView(
        record.camera, PurePath(record.file).name, record.placement, record.pitch
    )


def _look(shot, models, *, read, board, marks, lines=None, relief=None):
    """The board in one image, with what was picked in it by hand."""
    record = shot.record
    return view_board(
        shot.image(read),
        board,
        models[record.camera],
        shot.view,
        marks.get((record.camera, record.file)),
        lines=lines,
        relief=relief,
    )


def _views(shots, look, **options):
    """The views of shots, those that show the corners of the pattern with pose and edges."""
    return spread(partial(_view_again, look=look, options=options), shots)


def _view_again(shot, look, options):
    """The view of a shot with pose and edges, unless it does not show the pattern."""
    return shot.view if shot.view.reason else look(shot, **options)


def _corners(view, image, finder):
    """The view with the corners of the pattern in any order, or with the reason why not."""
    try:
        return replace(view, pixels=finder(image))
    except PatternNotFound as error:
        return replace(view, reason=str(error))


def _by_camera(cameras, views):
    return {camera: [view for view in views if view.camera == camera] for camera in cameras}


def _choices(records, camera, one_per_placement):
    """Records of one camera, in lists of those of which one is to be used, the best first."""
    groups = {}
    for number, record in enumerate(
        record for record in records if record.camera == camera
    ):
        alone = (
            not one_per_placement or record.placement < 0 or record.purpose == "intrinsics"
        )
        key = (number, None) if alone else (None, record.placement)
        groups.setdefault(key, []).append(record)
    for group in groups.values():
        pitch = np.array([record.pitch for record in group], float)
        if np.isfinite(pitch).any():
            middle = (np.nanmin(pitch) + np.nanmax(pitch)) / 2
            group[:] = [group[i] for i in np.argsort(np.abs(pitch - middle), kind="stable")]
    return list(groups.values())


def _first(group, begin):
    """The first image of a list that shows the board; the first one if none does."""
    shots = []
    for record in group:
        shots.append(begin(record))
        if not shots[-1].view.reason:
            return shots[-1]
    return shots[0]


def _survey_plain(groups, look, board, models):
    """The survey of a board without pattern."""
    for camera, model in models.items():
        if model is None:
            raise ValueError(
                f"camera '{camera}' has no intrinsics and board '{board.name}' no pattern to find "
                "them with: state them"
            )

    begin = partial(_plain_shot, look=look, models=models)
    shots = spread(partial(_first, begin=begin), groups)
    views = _turned_alike([shot.view for shot in shots])
    return Survey(_by_camera(models, views), dict(models), None, board)


def _plain_shot(record, look, models):
    """A shot of a board without pattern, with its view."""
    shot = Shot(record, _view(record))
    return replace(shot, view=look(shot, models))


def _find_corners(groups, read, board):
    """Shots with the corners of the pattern, in any order."""
    finder = PatternFinder(board.pattern)
    room = KEPT_BYTES // max(len(groups), 1)

    begin = partial(_shot_with_corners, read=read, board=board, finder=finder, room=room)
    # the first one tells the finder what to look for
    shots = [_first(group, begin) for group in groups[:1]]
    return shots + spread(partial(_first, begin=begin), groups[1:])


def _shot_with_corners(record, read, board, finder, room):
    """A shot with its corners and, within `room` bytes, the part that is looked at again."""
    image = read(record)
    view = _corners(_view(record), image, finder)
    if view.reason:
        return Shot(record, view)
    part = part_around(image, view.pixels, board)
    return Shot(record, view, part if part.pixels.nbytes <= room else None)


def _for_intrinsics(shots, camera):
    """Corners to estimate intrinsics with: the images taken for that, and the most different others
    up to a number.

    Without images taken for the intrinsics all are used.
    """
    meant = []
    others = []
    for shot in shots:
        if shot.record.camera == camera and shot.view.pixels is not None:
            taken = meant if shot.record.purpose == "intrinsics" else others
            taken.append(shot.view.pixels)
    if not meant:
        return others
    meant = [meant[i] for i in spread_views(meant, VIEWS_FOR_INTRINSICS)]
    return meant + [
        others[i] for i in spread_views(others, VIEWS_FOR_INTRINSICS - len(meant))
    ]


def _intrinsics(camera, models, shots, board, read):
    """Intrinsics of a camera as stated, or from the corners in its images, in any order."""
    if models[camera] is not None:
        return models[camera]
    size = (0, 0)
    for shot in shots:
        if shot.record.camera == camera:
            size = read(shot.record).shape[1::-1]
            break
    try:
        pixels = _for_intrinsics(shots, camera)
        return estimate_intrinsics(pixels, board.pattern, size).models[0]
    except ValueError as error:
        raise DegenerateGeometry(f"camera '{camera}': {error}") from error


def _with_relief(shots, board, models, rough):
    """Intrinsics by camera and the heights of the sheet (k,), metres, from corners in one order.

    `models` are those that are stated, `rough` also those estimated of a flat sheet.
    """
    estimate = partial(_adjustment, shots=shots, board=board, models=models, rough=rough)
    refined = dict(rough)
    reliefs = []
    for camera, adjustment in zip(rough, spread(estimate, rough), strict=True):
        if adjustment is not None:
            refined[camera] = adjustment.models[0]
            reliefs.append(adjustment.relief)
    if not reliefs:
        reliefs.append(np.zeros(len(board.pattern.points())))
    return refined, np.mean(reliefs, axis=0)


def _adjustment(camera, shots, board, models, rough):
    """The Adjustment of a camera that sees the pattern often enough."""
    pixels = _for_intrinsics(shots, camera)
    model = rough[camera]
    if len(pixels) < LEAST_VIEWS_FOR_RELIEF:
        return None
    if models[camera] is None:
        size = (model.width, model.height)
        return estimate_intrinsics(pixels, board.pattern, size, relief=True)
    return estimate_relief(pixels, board.pattern, model)


@dataclass(frozen=True)
class _Orders:
    """Orders of the corners that images of a pattern allow.

    `corners` (m, n, k, 2) are those of m images in n orders, those that belong together in one
    column, `poses` (m stacks of n) the rough ``T_camera_board`` that go with them; `leader` is as
    in :class:`lrfcal_lib.preprocess.turns.Alike`.
    """

    corners: np.ndarray
    poses: list[RigidTransform]
    leader: np.ndarray


def _ordered(shots, read, board, models):
    """The corners of all shots in the order that the outline asks for, alike in a placement."""
    known = board.corners is not None
    visible = [shot for shot in shots if shot.view.pixels is not None]
    if not known and len(board.edges) != 4:
        raise ValueError(
            f"board '{board.name}' has {len(board.edges)} edges and no known corners: only four "
            "edges around a pattern can be measured from images, give the corners"
        )
    if not known and not visible:
        raise DegenerateGeometry(
            f"none of {len(shots)} images shows the pattern of board '{board.name}'"
        )
    if not visible:
        return Ordered(shots, board.lines())
    orders = _orders(visible, board.pattern, models, mirrored=known)
    unseen = ""
    if known:
        lines = board.lines()
        chosen = _by_outline(visible, orders, read, board, models)
    else:
        votes, turned = _by_votes(visible, orders, read, board, models)
        chosen = turned.astype(int)
        try:
            lines = common_lines(votes, board)
        except OutlineNotSeen as error:
            lines = None
            unseen = str(error)
    corners = iter(orders.corners[np.arange(len(visible)), chosen])
    ordered = []
    for shot in shots:
        if shot.view.pixels is not None:
            shot = replace(shot, view=replace(shot.view, pixels=next(corners)))
        ordered.append(shot)
    return Ordered(ordered, lines, unseen)


def _orders(shots, pattern, models, mirrored):
    """The orders that the corners of shots may have, alike in a placement."""
    orders = pattern_orders(pattern, mirrored=mirrored)
    turns = turned_boards(pattern, orders)
    poses = []
    placements = []
    for shot in shots:
        model = models[shot.record.camera]
        poses.append(first_pose(pattern.points(), shot.view.pixels, model) * turns)
        alone = shot.record.purpose == "intrinsics"
        placements.append(-1 if alone else shot.record.placement)
    cameras = [shot.record.camera for shot in shots]
    together = alike([pose.rotation for pose in poses], placements, cameras)
    corners = []
    for number, order in enumerate(together.order):
        corners.append(shots[number].view.pixels[orders[order]])
        poses[number] = poses[number][order]
    return _Orders(np.array(corners), poses, together.leader)


def _by_outline(shots, orders, read, board, models):
    """Columns (m,) of the orders that the known outline prefers."""
    score = partial(_order_scores, read=read, board=board, models=models)
    scores = spread(score, zip(shots, orders.poses, strict=True))
    return decide(np.array(scores), orders.leader)


def _order_scores(shot_and_poses, read, board, models):
    """How well each order of the corners puts the known outline onto edges of the image."""
    shot, poses = shot_and_poses
    return order_scores(shot.image(read), board, models[shot.record.camera], poses)


def _by_votes(shots, orders, read, board, models):
    """Votes (m, 4, n) for the sides of the board, all turned alike, and which were turned."""
    votes = []
    up = []
    for shot, corners in zip(shots, orders.corners[:, 0], strict=True):
        model = models[shot.record.camera]
        pose = board_pose(corners, board.pattern, model)[0]
        votes.append(edge_votes(shot.image(read), board.pattern, model, pose))
        up.append(pose.rotation.as_matrix()[1, 1])
    votes = np.stack(votes)
    turned = turned_views(votes, np.array(up), orders.leader)
    return np.where(turned[:, None, None], votes[:, OPPOSITE], votes), turned


def _turned_alike(views):
    """Views of a plain board, turned alike in a placement where it looks the same when turned."""
    posed = [view for view in views if view.T_camera_board is not None]
    turned = []  # of every view those that differ by a turn in the board's plane
    for view in posed:
        normal = view.T_camera_board.rotation.as_matrix()[:, 2]
        same = [view]
        for other in view.alternatives:
            if other.T_camera_board.rotation.as_matrix()[:, 2] @ normal > SAME_PLANE:
                same.append(other)
        turned.append(same)
    most = max(map(len, turned), default=0)
    stacks = []
    for same in turned:
        same += same[:1] * (most - len(same))
        poses = RigidTransform.concatenate([view.T_camera_board for view in same])
        stacks.append(poses.rotation)
    placements = [view.placement for view in posed]
    together = alike(stacks, placements, [view.camera for view in posed])
    chosen = iter(
        [same[order[0]] for same, order in zip(turned, together.order, strict=True)]
    )
    return [view if view.T_camera_board is None else next(chosen) for view in views]
