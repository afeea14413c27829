"""What the cameras of a session see of the board: intrinsics, poses, turns, edges, its outline."""

from dataclasses import dataclass, replace
from functools import partial
from itertools import compress

import numpy as np
from scipy.spatial.transform import Rotation

from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.model.problem import Problem, ProblemKind, Stage
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
from lrfcal_lib.preprocess.prepared import Prepared
from lrfcal_lib.preprocess.turns import alike, decide, turned_boards
from lrfcal_lib.session.files import short
from lrfcal_lib.session.read import ImageRecord
from lrfcal_lib.session.workers import spread

LEAST_VIEWS_FOR_RELIEF = 8
# of a camera with images taken for the intrinsics; more cost time and tell little
VIEWS_FOR_INTRINSICS = 25
# cosine between the normals of poses of which one is the other turned in its plane
SAME_PLANE = 0.9999
KEPT_BYTES = 800_000_000  # of all images: half of each of 40 with 12 megapixels


@dataclass(frozen=True)
class Shot:
    """An image, what was found in it, and the part of it that is kept."""

    record: ImageRecord
    view: BoardView
    part: Part | None = None

    @property
    def reason(self):
        """Why it cannot be used."""
        return self.view.reason

    def image(self, session):
        """The image; black away from the board where a part is kept."""
        return session.read_image(self.record) if self.part is None else self.part.image()


def prepare_images(prepared: Prepared) -> Prepared:
    """The same with the cameras of the session.

    Parameters
    ----------
    prepared : Prepared
        Of :func:`lrfcal_lib.preprocess.prepared.prepare_scans`.

    Returns
    -------
    Prepared
        With the board in every image, the cameras' intrinsics, and the board's outline; as it was,
        with a problem more, where no image can be used.
    """
    try:
        return survey(prepared)
    except DegenerateGeometry as error:  # what remains is a session without cameras
        words = f"no image can be used: {error}"
        lost = Problem(Stage.IMAGES, ProblemKind.NO_IMAGES, words)
        return replace(prepared, problems=(*prepared.problems, lost))


def survey(prepared: Prepared) -> Prepared:
    """Find the board in the images of all cameras, one of each camera and placement.

    Of those that show the board it is the one whose pitch is nearest to the middle of the
    placement's images. Images of no placement are all used, those of a scene are not.

    Parameters
    ----------
    prepared : Prepared
        A camera of its session without a model asks for an estimate from these images.

    Returns
    -------
    Prepared

    Raises
    ------
    ValueError
        If a camera has no intrinsics and the board no pattern, or too few images show it.
    """
    session = prepared.session
    board = session.board
    stated = {name: camera.model for name, camera in session.cameras.items()}
    unknown = [name for name, model in stated.items() if model is None]
    look = partial(_look, session=session, board=board)
    if board.pattern is None:
        return _survey_plain(prepared, look, stated, unknown)

    groups = _choices(session, {"board", "intrinsics"})
    finder = PatternFinder(board.pattern)
    begin = partial(_begin, session=session, board=board, finder=finder, count=len(groups))
    begun = spread(partial(_first, begin=begin), groups)
    shots = [shot for shot in begun if not shot.reason]
    rough, _ = _adjusted(unknown, stated, shots, session)
    if board.corners is None:
        _check_measurable(board, begun)
    shots, lines, unseen = _ordered(shots, session, board, rough)
    often = [name for name in rough if len(_corners(shots, name)) >= LEAST_VIEWS_FOR_RELIEF]
    models, relief = _adjusted(often, rough, shots, session, relief=True)
    shots = [shot for shot in shots if shot.record.purpose != "intrinsics"]

    def see(lines):
        return spread(partial(look, models=models, lines=lines, relief=relief), shots)

    views = see(lines)
    outline = None
    if board.corners is None and not unseen:
        views = see(measure_outline(views, board, models).board.lines())
        outline = measure_outline(views, board, models)
        board = outline.board
    lost = [shot.view for shot in begun if shot.reason]
    surveyed = replace(prepared, models=models, board=board, outline=outline, relief=relief)
    return _with_views(surveyed, views + lost, unseen)


def _with_views(prepared, views, unseen=""):
    """With the views of placements, and with what may be wrong with them: small squares; `unseen`,
    why the outline of the board is not known.
    """
    by_camera: dict = {camera: {} for camera in prepared.models}
    for view in sorted(views, key=lambda view: view.placement):
        if view.placement >= 0:
            by_camera[view.camera][view.placement] = view
    problems = list(prepared.problems)
    if unseen:
        words = f"faces of the board only: {unseen}"
        problems.append(Problem(Stage.IMAGES, ProblemKind.NO_OUTLINE, words))
    problems += small_squares(by_camera, prepared.board.pattern)
    return replace(prepared, views=by_camera, problems=tuple(problems))


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
    if prepared.board.pattern is None:
        return {camera: list(views.values()) for camera, views in known.items()}
    finder = PatternFinder(prepared.board.pattern)
    look = partial(_like_prepared, prepared=prepared, finder=finder)
    views = spread(look, records)
    return {camera: [view for view in views if view.camera == camera] for camera in known}


def _like_prepared(record, prepared, finder):
    """The board in one image: that of the placement where it is the same, or none shows it."""
    board = prepared.board
    known = prepared.views[record.camera][record.placement]
    view = _view(record)
    if known.file == view.file or known.pixels is None:
        return replace(known, file=view.file, pitch=record.pitch)
    session = prepared.session
    shot = _begin(Shot(record, view), session, board, finder, 1)
    if shot.reason:
        return shot.view
    corners = shot.view.pixels[pattern_orders(board.pattern)]
    order = np.nanstd(corners - known.pixels, axis=1).sum(axis=1).argmin()
    return _look(
        _with_pixels(shot, corners[order]),
        prepared.models,
        session=session,
        board=board,
        lines=None if board.corners is None else board.lines(),
        relief=prepared.relief,
    )


def small_squares(views, pattern) -> list[Problem]:
    """In which images squares are so small that corners may be biased.

    Parameters
    ----------
    views : dict of str to dict of int to BoardView
        By camera and placement.
    pattern : Chessboard or None

    Returns
    -------
    list of Problem
        One a camera that has such images.
    """
    problems = []
    for camera, of_camera in views.items():
        sides = {
            placement: square_px(pattern.grid(view.pixels))
            for placement, view in of_camera.items()
            if view.pixels is not None
        }
        small = [p for p, side in sides.items() if side < SMALL_SQUARE_PX]
        if small:
            least = min(sides.values())
            words = (
                f"squares are less than {SMALL_SQUARE_PX:.0f} px wide in {len(small)} of "
                f"{len(sides)} images (placements {short(small)}), {least:.1f} px at least: "
                f"distances may be off by {100 * scale_error(least):.2g} %, more if the image is "
                "blurred; go nearer, or print larger squares"
            )
            problems.append(
                Problem(Stage.IMAGES, ProblemKind.SMALL_SQUARES, words, camera=camera)
            )
    return problems


def _view(record):
    """The view of an image in which nothing was looked for yet; of no placement where it was
    taken for the intrinsics.
    """
    placement = -1 if record.purpose == "intrinsics" else record.placement
    return BoardView(record.camera, record.file.name, placement, record.pitch)


def _look(shot, models, *, session, board, lines=None, relief=0.0):
    """The board in one image, with what was picked in it by hand."""
    record = shot.record
    ends = {
        pick.edge: pick.ends
        for pick in session.picks
        if (pick.camera, pick.file) == (record.camera, record.file)
    }
    return view_board(
        shot.image(session),
        board,
        models[record.camera],
        shot.view,
        ends,
        lines=lines,
        relief=relief,
    )


def _with_pixels(shot, pixels):
    """The shot with corners of the pattern."""
    return replace(shot, view=replace(shot.view, pixels=pixels))


def _choices(session, purposes):
    """Shots in lists of those of which one is to be used, the best first."""
    groups = {}
    for record in session.image_records:
        if record.purpose in purposes:
            view = _view(record)
            of = (view.camera, view.placement) if view.placement >= 0 else record.file
            groups.setdefault(of, []).append(Shot(record, view))
    for group in groups.values():
        pitch = [shot.view.pitch for shot in group]
        middle = (min(pitch) + max(pitch)) / 2
        group.sort(key=lambda shot: abs(shot.view.pitch - middle))
    return groups.values()


def _first(group, begin):
    """What begins with the first image of a list that shows the board; the first one if none
    does.
    """
    first = None
    for shot in group:
        begun = begin(shot)
        if not begun.reason:
            return begun
        first = first or begun
    return first


def _survey_plain(prepared, look, models, unknown):
    """The survey of a board without pattern."""
    session = prepared.session
    if unknown:
        raise ValueError(
            f"camera '{unknown[0]}' has no intrinsics and board '{session.board.name}' no pattern "
            "to find them with: state them"
        )
    first = partial(_first, begin=partial(look, models=models))
    views = _turned_alike(spread(first, _choices(session, {"board"})))
    return _with_views(replace(prepared, models=models), views)


def _begin(shot, session, board, finder, count):
    """A shot with the corners of the pattern in any order, or with the reason why not.

    With the part of the image that is looked at again, where there is room for so many.
    """
    image = session.read_image(shot.record)
    try:
        corners = finder(image)
    except PatternNotFound as error:
        return replace(shot, view=replace(shot.view, reason=str(error)))
    part = part_around(image, corners, board)
    if part.pixels.nbytes * count <= KEPT_BYTES:
        shot = replace(shot, part=part)
    return _with_pixels(shot, corners)


def _corners(shots, camera):
    """Corners to estimate intrinsics with: the images taken for that, and the most different others
    up to a number.

    Without images taken for the intrinsics all are used.
    """
    meant = []
    others = []
    for shot in shots:
        if shot.record.camera == camera:
            taken = meant if shot.record.purpose == "intrinsics" else others
            taken.append(shot.view.pixels)
    if not meant:
        return others
    chosen = spread_views(meant, VIEWS_FOR_INTRINSICS)
    return chosen + spread_views(others, VIEWS_FOR_INTRINSICS - len(chosen))


def _adjusted(cameras, models, shots, session, relief=False):
    """Models by camera, some of them estimated anew, and the heights of the sheet (k,), metres.

    For the heights the corners are in one order; the sheet is flat without cameras.
    """
    estimate = partial(_adjustment, shots=shots, session=session, relief=relief)
    adjustments = spread(estimate, cameras)
    adjusted = [adjustment.models[0] for adjustment in adjustments]
    reliefs = [adjustment.relief for adjustment in adjustments] or [0.0]
    return models | dict(zip(cameras, adjusted, strict=True)), np.mean(reliefs, axis=0)


def _adjustment(name, shots, session, relief):
    """The Adjustment of a camera: its intrinsics where they are not stated, and the relief."""
    camera = session.cameras[name]
    pattern = session.board.pattern
    corners = _corners(shots, name)
    if camera.model is not None:
        return estimate_relief(corners, pattern, camera.model)
    size = (camera.width, camera.height)
    try:
        return estimate_intrinsics(corners, pattern, size, relief=relief)
    except ValueError as error:
        raise DegenerateGeometry(f"camera '{name}': {error}") from error


def _check_measurable(board, shots):
    """Refuse a board whose outline images cannot tell."""
    if len(board.edges) != 4:
        raise ValueError(
            f"board '{board.name}' has {len(board.edges)} edges and no known corners: only four "
            "edges around a pattern can be measured from images, give the corners"
        )
    if all(shot.reason for shot in shots):
        raise DegenerateGeometry(
            f"none of {len(shots)} images shows the pattern of board '{board.name}'"
        )


def _ordered(shots, session, board, models):
    """Shots with their corners in the order that the outline asks for, alike in a placement.

    And the lines of the outline (E, 3): rough where it is not known; None, and the reason why,
    where the images do not show it.
    """
    if not shots:
        return shots, None, ""
    pattern = board.pattern
    known = board.corners is not None
    orders = pattern_orders(pattern, mirrored=known)
    turns = turned_boards(pattern, orders)
    poses = [
        first_pose(pattern.points(), shot.view.pixels, models[shot.view.camera]) * turns
        for shot in shots
    ]
    leader, together = alike(
        [pose.rotation for pose in poses], [shot.view for shot in shots]
    )
    corners = np.array(
        [
            shot.view.pixels[orders[order]]
            for shot, order in zip(shots, together, strict=True)
        ]
    )
    unseen = ""
    if known:
        lines = board.lines()
        score = partial(_order_scores, session=session, board=board, models=models)
        scores = spread(score, zip(shots, poses, together, strict=True))
        chosen = decide(np.array(scores), leader)
    else:
        votes, up = _votes(shots, corners[:, 0], session, pattern, models)
        turned = turned_views(votes, up, leader)
        votes[turned] = votes[turned][:, OPPOSITE]
        chosen = turned.astype(int)
        lines, unseen = common_lines(votes, board)
    pixels = corners[np.arange(len(shots)), chosen]
    return list(map(_with_pixels, shots, pixels)), lines, unseen


def _votes(shots, corners, session, pattern, models):
    """For edges (m, 4, n) of m shots, see :func:`edge_votes`, and how far y points down in them."""
    votes = []
    up = []
    for shot, pixels in zip(shots, corners, strict=True):
        model = models[shot.record.camera]
        pose = board_pose(pixels, pattern, model)[0]
        votes.append(edge_votes(shot.image(session), pattern, model, pose))
        up.append(pose.rotation.as_matrix()[1, 1])
    return np.array(votes), np.array(up)


def _order_scores(shot_and_orders, session, board, models):
    """How well each order of the corners puts the known outline onto edges of the image."""
    shot, poses, order = shot_and_orders
    model = models[shot.record.camera]
    return order_scores(shot.image(session), board, model, poses[order])


def _turned_alike(views):
    """Views of a plain board, turned alike in a placement where it looks the same when turned."""
    posed = [view for view in views if not view.reason]
    turned = []  # of every view those that differ by a turn in the board's plane
    rotations = []
    for view in posed:
        poses = [view, *view.alternatives]
        rotation = Rotation.concatenate([each.T_camera_board.rotation for each in poses])
        normals = rotation.as_matrix()[:, :, 2]
        same = normals @ normals[0] > SAME_PLANE
        turned.append(list(compress(poses, same)))
        rotations.append(rotation[same])
    _, together = alike(rotations, posed)
    chosen = [same[order[0]] for same, order in zip(turned, together, strict=True)]
    return chosen + [view for view in views if view.reason]
