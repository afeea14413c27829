"""A session after preprocessing: the board in every sweep and image, and what could not be used."""

from dataclasses import dataclass, field
from functools import partial

import numpy as np

from lrfcal_lib.model.board import Board
from lrfcal_lib.model.problem import LEAVES_OUT, Problem, ProblemKind, Stage
from lrfcal_lib.preprocess.board_in_image import BoardView
from lrfcal_lib.preprocess.board_in_scan import BoardNotFound, find_board
from lrfcal_lib.preprocess.edges_in_scan import with_edges
from lrfcal_lib.preprocess.intrinsics import raised_points
from lrfcal_lib.preprocess.outline_in_images import Outline
from lrfcal_lib.session.cache import cached
from lrfcal_lib.session.files import SessionError
from lrfcal_lib.session.read import Session
from lrfcal_lib.session.workers import spread


@dataclass(frozen=True)
class PitchNoise:
    """How far the recorded pitch of a sweep is off.

    Attributes
    ----------
    offset : float
        Standard deviation of the whole sweep, radians.
    stretch : float
        Standard deviation of its scale, a fraction of the angle from the middle of the sweep.
    """

    offset: float = 0.0
    stretch: float = 0.0

    def sigma(self, pitch: np.ndarray, middle: float) -> np.ndarray:
        """Standard deviation of recorded pitch angles.

        Parameters
        ----------
        pitch : ndarray
            Recorded, radians.
        middle : float
            Of the sweep, radians.

        Returns
        -------
        ndarray
            Radians.
        """
        return np.hypot(self.offset, self.stretch * (pitch - middle))


@dataclass(frozen=True)
class DroppedSide:
    """A side of a scan that lies elsewhere than the board's edge next to it, and is not used.

    Attributes
    ----------
    edge : str
    distance, turn : float
        Between them: metres, radians. Where the distance is too large already, the turn is 0.
    """

    edge: str
    distance: float
    turn: float = 0.0

    @property
    def words(self):
        """Why it is not used."""
        if self.turn:
            return (
                f"the scan's side '{self.edge}' is turned by {np.rad2deg(self.turn):.1f} deg "
                "against the board: not used"
            )
        return (
            f"a side of the scan is {1000 * self.distance:.0f} mm from the edge '{self.edge}': "
            "not used"
        )


@dataclass(frozen=True)
class Prepared:
    """A session after preprocessing.

    Attributes
    ----------
    session : Session
    board : Board
        With its outline, measured from the images where the session does not state it and they show
        it.
    scans : dict of int to BoardScan
        By placement, with their edges and the names of these.
    models : dict of str to CameraModel
    views : dict of str to dict of int to BoardView
        By camera and placement; where there are images at several pitch angles, the one with most
        edges.
    outline : Outline or None
    relief : ndarray, shape (k,), or 0.0
        Heights of the pattern's corners over the sheet's mean plane, metres (see the survey of the
        images).
    pitch_noise : PitchNoise
        What the recordings themselves tell about it.
    problems : tuple of Problem
        What cannot be used and why.
    """

    session: Session
    board: Board
    scans: dict
    models: dict = field(default_factory=dict)
    views: dict = field(default_factory=dict)
    outline: Outline | None = None
    relief: np.ndarray | float = 0.0
    pitch_noise: PitchNoise = PitchNoise()
    problems: tuple[Problem, ...] = ()

    @property
    def left_out(self) -> dict[int | None, str]:
        """Why whole placements are left out, by placement."""
        return {p.placement: p.words for p in self.problems if p.kind in LEAVES_OUT}

    def problems_of(self, kind: ProblemKind) -> list[Problem]:
        """Those of one kind.

        Parameters
        ----------
        kind : ProblemKind

        Returns
        -------
        list of Problem
        """
        return [problem for problem in self.problems if problem.kind == kind]

    @property
    def pattern_points(self) -> np.ndarray:
        """Corners of the printed pattern as they lie on the sheet, board frame, metres, shape
        (k, 3); none without a pattern.
        """
        if self.board.pattern is None:
            return np.zeros((0, 3))
        return raised_points(self.board.pattern, self.relief)

    def posed(self, camera: str) -> dict[int, BoardView]:
        """The views of a camera that know where the board is, by placement."""
        views = self.views[camera].items()
        return {p: view for p, view in views if view.T_camera_board is not None}

    def patterned(self, camera: str) -> dict[int, BoardView]:
        """The usable views of a camera that show the printed pattern, by placement."""
        views = self.views[camera].items()
        return {p: view for p, view in views if view.pixels is not None}

    def seen(self, camera, placement):
        """The board in an image of a placement, and the very image that it was found in: there may
        be several.

        Parameters
        ----------
        camera : str
        placement : int

        Returns
        -------
        view : BoardView
        image : ndarray of uint8, shape (h, w, 3)
        """
        view = self.views[camera][placement]
        records = self.session.images(camera, placement=placement)
        (record,) = (r for r in records if r.file.name == view.file)
        return view, self.session.read_image(record)


@cached
def prepare_scans(session: Session) -> Prepared:
    """The board in every sweep of a session, and its edge points in both variants.

    Parameters
    ----------
    session : Session

    Returns
    -------
    Prepared
        Without cameras.
    """
    results = list(spread(partial(_board_in, session), session.board_placements))
    problems = tuple(result for result in results if isinstance(result, Problem))
    scans = {result.placement: result for result in results if result not in problems}
    return Prepared(session, session.board, scans, problems=problems)


def _board_in(session, placement):
    """The board in one sweep with its edges, or why not."""
    try:
        return with_edges(find_board(session.sweep(placement), session))
    except SessionError:
        words = "no range in any scan line"
    except BoardNotFound as error:
        words = str(error)
    return Problem(Stage.SCANS, ProblemKind.NO_BOARD, words, placement)
