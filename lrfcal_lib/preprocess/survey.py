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
from lrfcal_lib.session.files import short
from lrfcal_lib.session.read import ImageRecord, Session
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


def views_of(session: Session) -> Survey:
    """:func:`survey` of a session's images.

    Parameters
    ----------
    session : Session

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
    )


def survey(records, read, board: Board, models, picks=()) -> Survey:
    """Find the board in the images of several cameras, one of each camera and placement.

    Of those that show the board it is the one whose pitch is nearest to the middle of the
    placement's images. Images of no placement are all used.

    Parameters
    ----------
    records : sequence of ImageRecord
    read : callable
        ``read(record)`` gives the image, uint8.
    board : Board
    models : dict of str to (CameraModel or None)
        By camera; None asks for an estimate from these images.
    picks : sequence of EdgePick

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
    groups = _choices(records, list(models))
    if board.pattern is None:
        return _survey_plain(groups, look, board, models)

    finder = PatternFinder(board.pattern)
    room = KEPT_BYTES // max(len(groups), 1)
    begin = partial(_shot_with_corners, read=read, board=board, finder=finder, room=room)
    shots = spread(partial(_first, begin=begin), groups)
    find = partial(_intrinsics, models=models, shots=shots, board=board, read=read)
    rough = dict(zip(models, spread(find, models), strict=True))
    shots, lines, unseen = _ordered(shots, read, board, rough)
    refined, relief = _with_relief(shots, board, models, rough)
    shots = [shot for shot in shots if shot.record.purpose != "intrinsics"]

    def see(lines):
        again = partial(look, models=refined, lines=lines, relief=relief)
        return spread(partial(_unless_unseen, look=again), shots)

    views = see(lines)
    outline = None
    if board.corners is None and not unseen:
        views = see(measure_outline(views, board, refined).lines)
        outline = measure_outline(views, board, refined)
        board = outline.board
    return Survey(
        views=_by_camera(models, views),
        models=refined,
        outline=outline,
        board=board,
        relief=relief,
        unseen=unseen,
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
    known = prepared.views
    records = [
        record
        for record in prepared.session.images(purpose="board")
        if record.placement in known.get(record.camera, {})
    ]
    if prepared.board.pattern is None or len(records) <= sum(map(len, known.values())):
        return {camera: list(views.values()) for camera, views in known.items()}
    finder = PatternFinder(prepared.board.pattern)
    look = partial(_like_prepared, prepared=prepared, finder=finder)
    return _by_camera(known, spread(look, records))


def _like_prepared(record, prepared, finder):
    """The board in one image: that of the placement where it is the same, or none shows it."""
    board = prepared.board
    known = prepared.views[record.camera][record.placement]
    view = _view(record)
    if known.file == view.file or known.pixels is None:
        return replace(known, file=view.file, pitch=record.pitch)
    image = prepared.session.read_image(record)
    view = _corners(view, image, finder)
    if view.reason:
        return view
    orders = pattern_orders(board.pattern)
    shifts = view.pixels[orders] - known.pixels
    order = orders[np.nanstd(shifts, axis=1).sum(axis=1).argmin()]
    return _look(
        Shot(record, replace(view, pixels=view.pixels[order])),
        prepared.models,
        read=lambda _: image,
        board=board,
        marks=_marks(prepared.session.picks, board),
        lines=None if board.corners is None else board.lines(),
        relief=prepared.relief,
    )


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
    for camera, of_camera in views.items():
        seen = {p: view.pixels for p, view in of_camera.items() if view.pixels is not None}
        sides = {p: square_px(pattern.grid(pixels)) for p, pixels in seen.items()}
        small = [p for p, side in sides.items() if side < SMALL_SQUARE_PX]
        if small:
            least = min(sides.values())
            words[camera] = (
                f"squares are less than {SMALL_SQUARE_PX:.0f} px wide in {len(small)} of "
                f"{len(sides)} images (placements {short(small)}), {least:.1f} px at least: "
                f"distances may be off by {100 * scale_error(least):.2g} %, more if the image is "
                "blurred; go nearer, or print larger squares"
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


def _unless_unseen(shot, look):
    """The view of a shot, looked at again unless it does not show the pattern."""
    return shot.view if shot.view.reason else look(shot)


def _corners(view, image, finder):
    """The view with the corners of the pattern in any order, or with the reason why not."""
    try:
        return replace(view, pixels=finder(image))
    except PatternNotFound as error:
        return replace(view, reason=str(error))


def _by_camera(cameras, views):
    return {camera: [view for view in views if view.camera == camera] for camera in cameras}


def _choices(records, cameras):
    """Records in lists of those of which one is to be used, the best first."""
    groups = {}
    for number, record in enumerate(r for r in records if r.camera in cameras):
        shared = record.placement >= 0 and record.purpose != "intrinsics"
        key = (record.camera, record.placement) if shared else number
        groups.setdefault(key, []).append(record)
    for group in groups.values():
        pitch = [record.pitch for record in group]
        middle = (min(pitch) + max(pitch)) / 2
        group.sort(key=lambda record: abs(record.pitch - middle))
    return sorted(groups.values(), key=lambda group: cameras.index(group[0].camera))


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
    unknown = [camera for camera, model in models.items() if model is None]
    if unknown:
        raise ValueError(
            f"camera '{unknown[0]}' has no intrinsics and board '{board.name}' no pattern to find "
            "them with: state them"
        )
    begin = partial(_plain_shot, look=partial(look, models=models))
    shots = spread(partial(_first, begin=begin), groups)
    views = _turned_alike([shot.view for shot in shots])
    return Survey(_by_camera(models, views), dict(models), None, board)


def _plain_shot(record, look):
    """A shot of a board without pattern, with its view."""
    shot = Shot(record, _view(record))
    return replace(shot, view=look(shot))


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
    chosen = [meant[i] for i in spread_views(meant, VIEWS_FOR_INTRINSICS)]
    more = spread_views(others, VIEWS_FOR_INTRINSICS - len(chosen))
    return chosen + [others[i] for i in more]


def _intrinsics(camera, models, shots, board, read):
    """Intrinsics of a camera as stated, or from the corners in its images, in any order."""
    if models[camera] is not None:
        return models[camera]
    pixels = _for_intrinsics(shots, camera)
    record = next(shot.record for shot in shots if shot.record.camera == camera)
    try:
        size = read(record).shape[1::-1]
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
    return refined, np.mean(reliefs, axis=0) if reliefs else None


def _adjustment(camera, shots, board, models, rough):
    """The Adjustment of a camera that sees the pattern often enough."""
    pixels = _for_intrinsics(shots, camera)
    if len(pixels) < LEAST_VIEWS_FOR_RELIEF:
        return None
    if models[camera] is None:
        size = (rough[camera].width, rough[camera].height)
        return estimate_intrinsics(pixels, board.pattern, size, relief=True)
    return estimate_relief(pixels, board.pattern, models[camera])


def _ordered(shots, read, board, models):
    """Shots with their corners in the order that the outline asks for, alike in a placement.

    And the lines of the outline (E, 3): rough where it is not known; None, and the reason why,
    where the images do not show it.
    """
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
    lines = board.lines() if known else None
    if not visible:
        return shots, lines, ""
    corners, poses, leader = _orders(visible, board.pattern, models, mirrored=known)
    unseen = ""
    if known:
        score = partial(_order_scores, read=read, board=board, models=models)
        scores = spread(score, zip(visible, poses, strict=True))
        chosen = decide(np.array(scores), leader)
    else:
        votes = []
        up = []
        for shot, pixels in zip(visible, corners[:, 0], strict=True):
            model = models[shot.record.camera]
            pose = board_pose(pixels, board.pattern, model)[0]
            votes.append(edge_votes(shot.image(read), board.pattern, model, pose))
            up.append(pose.rotation.as_matrix()[1, 1])
        turned = turned_views(np.stack(votes), np.array(up), leader)
        chosen = turned.astype(int)
        for number in np.flatnonzero(turned):
            votes[number] = votes[number][OPPOSITE]
        try:
            lines = common_lines(np.stack(votes), board)
        except OutlineNotSeen as error:
            unseen = str(error)
    ordered = {id(shot): shot for shot in shots}
    for shot, orders, column in zip(visible, corners, chosen, strict=True):
        view = replace(shot.view, pixels=orders[column])
        ordered[id(shot)] = replace(shot, view=view)
    return list(ordered.values()), lines, unseen


def _orders(shots, pattern, models, mirrored):
    """The orders that the corners of m shots may have, alike in a placement.

    Corners (m, n, k, 2) in n orders, those that belong together in one column, m stacks of the
    rough ``T_camera_board`` that go with them, and the leaders of
    :class:`lrfcal_lib.preprocess.turns.Alike`.
    """
    orders = pattern_orders(pattern, mirrored=mirrored)
    turns = turned_boards(pattern, orders)
    poses = []
    placements = []
    cameras = []
    for shot in shots:
        model = models[shot.record.camera]
        poses.append(first_pose(pattern.points(), shot.view.pixels, model) * turns)
        alone = shot.record.purpose == "intrinsics"
        placements.append(-1 if alone else shot.record.placement)
        cameras.append(shot.record.camera)
    together = alike([pose.rotation for pose in poses], placements, cameras)
    pairs = list(zip(shots, together.order, strict=True))
    corners = np.array([shot.view.pixels[orders[order]] for shot, order in pairs])
    posed = [pose[order] for pose, order in zip(poses, together.order, strict=True)]
    return corners, posed, together.leader


def _order_scores(shot_and_poses, read, board, models):
    """How well each order of the corners puts the known outline onto edges of the image."""
    shot, poses = shot_and_poses
    return order_scores(shot.image(read), board, models[shot.record.camera], poses)


def _turned_alike(views):
    """Views of a plain board, turned alike in a placement where it looks the same when turned."""
    posed = [view for view in views if view.T_camera_board is not None]
    turned = []  # of every view those that differ by a turn in the board's plane
    for view in posed:
        same = [
            each
            for each in (view, *view.alternatives)
            if _normal(each) @ _normal(view) > SAME_PLANE
        ]
        turned.append(same)
    most = max(map(len, turned), default=0)
    stacks = []
    for same in turned:
        same += same[:1] * (most - len(same))
        poses = RigidTransform.concatenate([view.T_camera_board for view in same])
        stacks.append(poses.rotation)
    placements = [view.placement for view in posed]
    together = alike(stacks, placements, [view.camera for view in posed])
    chosen = {}
    for view, same, order in zip(posed, turned, together.order, strict=True):
        chosen[id(view)] = same[order[0]]
    return [chosen.get(id(view), view) for view in views]


def _normal(view):
    """Normal (3,) of the board in a view, camera frame."""
    return view.T_camera_board.rotation.as_matrix()[:, 2]
