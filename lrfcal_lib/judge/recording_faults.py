"""What went wrong with a recording, as far as its files and the estimates show."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.spatial.transform import RigidTransform
from scipy.special import fdtri

from lrfcal_lib.calibrate.observe import observe
from lrfcal_lib.calibrate.pipeline import Calibration
from lrfcal_lib.fit.residuals import plane_residuals_m
from lrfcal_lib.judge.alternatives import distance, far_axis, guesses_of
from lrfcal_lib.judge.camera_changes import camera_changes, explains
from lrfcal_lib.judge.findings import by_sign
from lrfcal_lib.model.geometry import (
    POSE,
    DegenerateGeometry,
    length_of,
    lrf_to_platform,
)
from lrfcal_lib.model.observations import thin
from lrfcal_lib.model.problem import ProblemKind
from lrfcal_lib.preprocess.board_in_scan import BoardNotFound, face_points, find_board
from lrfcal_lib.preprocess.prepared import Prepared
from lrfcal_lib.session.faults import Fault, dark_images, faults_of_files
from lrfcal_lib.session.files import SessionError
from lrfcal_lib.solvers import solve_camera

EXPLAINING = (
    "sense",
    "unit",
    "numbers",
)  # kinds that everything else which looks wrong follows from
SEVERE_PX = 5.0  # a camera that moves images by more is two cameras
# times nearer to the boards in the images, with what was recorded read otherwise
BETTER = 3.0
MISREAD = 0.005  # metres; what is misread lies off by more than that
GOOD = 0.05  # metres; boards and scans that belong together lie nearer than that
AS_GOOD = 2.0  # times the miss of the best reading: another one that may be meant as well
POINTS = 60  # of a placement's face
CHANCE = 0.9999  # a reading that fits better by chance alone does so less often than once in 10 000
LOOKED_AT = 4  # placements in which a board is searched for again
PLANE = 3  # numbers of a plane
HALF = 0.6745  # standard deviations of normal noise that half of all values stay below
LEAST_MISS = 0.001  # metres; paper is no flatter
MOST_LOST = 8  # placements; where more are left out, something else is wrong
# metres between the middles of a board in a scan, which may be cut, and in images
BESIDE = 0.15


@dataclass(frozen=True)
class Reading:
    """A way to read a recording otherwise than it is stated.

    Attributes
    ----------
    kind : {'sense', 'unit', 'numbers'}
    words : str
        What is wrong if this way is right, and what to do about it.
    length, turn, image_turn : float
        Factors on ranges, on the pitch of scans and images, and on that of images.
    across, image_across : float
        -1 where bearings count the other way, and where images are mirrored.
    ahead : int
        By how much the placement numbers of images are ahead of those of scans.
    """

    kind: str
    words: str
    length: float = 1.0
    turn: float = 1.0
    image_turn: float = 1.0
    across: float = 1.0
    image_across: float = 1.0
    ahead: int = 0

    def points(self, p_lrf):
        """Measured points (n, 3), read this way."""
        return self.length * p_lrf * [self.across, 1.0, 1.0]

    def pitch(self, placement, recorded):
        """The recorded pitch of a placement, read this way."""
        return self.turn * recorded


AS_STATED = Reading("", "")
MIRRORED = Reading(
    "sense",
    "the images of all cameras are mirrored (turn mirroring off in the cameras, or flip them)",
    image_across=-1.0,
)
SENSES = (
    MIRRORED,
    Reading(
        "sense",
        "bearings are counted in the opposite direction (reverse the columns of the ranges)",
        across=-1.0,
    ),
    Reading(
        "sense",
        "the pitch has the opposite sign (positive pitch lifts the view: change the sign)",
        turn=-1.0,
    ),
)
IMAGES = (
    Reading(
        "numbers",
        "the images' placement numbers (images.csv) are too large by one: subtract 1",
        ahead=1,
    ),
    Reading(
        "numbers",
        "the images' placement numbers (images.csv) are too small by one: add 1",
        ahead=-1,
    ),
    Reading(
        "unit",
        "pitch_deg in images.csv is in radians: multiply it by 57.29578",
        image_turn=180 / np.pi,
    ),
    Reading(
        "sense",
        "pitch_deg in images.csv has the opposite sign to the pitch of the scans",
        image_turn=-1.0,
    ),
)
UNITS = (
    Reading(
        "unit",
        "the recorded pitch is in radians where degrees are asked for: multiply it by 57.29578",
        turn=180 / np.pi,
    ),
    Reading("unit", "the ranges are in inches: multiply them by 0.0254", length=0.0254),
    Reading("unit", "the ranges are in feet: multiply them by 0.3048", length=0.3048),
    Reading("unit", "the ranges are in centimetres: divide them by 100", length=0.01),
    Reading("unit", "the ranges are in millimetres: divide them by 1000", length=0.001),
)


def recording_faults(calibration: Calibration) -> list[Fault]:
    """What went wrong with the recording behind a calibration.

    Parameters
    ----------
    calibration : Calibration
        Its images lie where they lay when its session was opened: some are looked at again.

    Returns
    -------
    list of Fault
        Those of the files first.
    """
    prepared = calibration.prepared
    joint = calibration.joint
    session = prepared.session
    found = [*faults_of_files(session), *dark_images(session)]
    if hopeless(joint) and (misread := misread_recording(prepared)):
        return found + misread
    if joint is not None:
        found += faults_of_changes(
            camera_changes(joint.solution, prepared, joint.settings), prepared.views
        )
        found += exchanged_placements(joint)
    return found


def explained(faults: list[Fault]) -> bool:
    """Whether one of these is a cause that everything else which looks wrong follows from."""
    return any(fault.kind in EXPLAINING for fault in faults)


def hopeless(joint):
    """Whether a JointCalibration (or None) explains so little, or only by an axis that points
    backwards, that something may be misread.
    """
    return (
        joint is None
        or not explains(joint.solution)
        or joint.solution.unobservable
        or any(far.severe for far in far_axis(joint))
    )


def misread_recording(prepared: Prepared) -> list[Fault]:
    """Units and senses that are not as stated: read otherwise, scans and images agree.

    Parameters
    ----------
    prepared
    """
    session = prepared.session
    numbers = np.array(session.board_placements)
    # also placements that images contradict are left out, of which scans show the board
    if 2 * len(prepared.problems_of(ProblemKind.NO_BOARD)) >= len(numbers):
        looked_at = thin(numbers, LOOKED_AT)
        for reading in UNITS:
            if len(boards_in(session, looked_at, reading)) > len(looked_at) / 2:
                return [Fault(reading.kind, reading.words, severe=True)]
        return []

    stated = board_misses(prepared, AS_STATED)
    if not stated or _worst(stated) < MISREAD:
        return []
    mirrored = []
    for camera, miss in board_misses(prepared, MIRRORED).items():
        if camera in stated and _fits({camera: miss}, {camera: stated[camera]}):
            mirrored.append(
                Fault(
                    "sense",
                    f"the images of camera '{camera}' are mirrored: the mirror images of its "
                    f"boards lie {1000 * miss.size:.0f} mm from the scans, the images as recorded "
                    f"{1000 * stated[camera].size:.0f} mm; turn mirroring off in the camera, or "
                    "flip the images",
                    severe=True,
                    camera=camera,
                )
            )
    if 0 < len(mirrored) < len(stated):
        return mirrored

    for group in (SENSES, IMAGES, UNITS):
        fitting = {
            reading: misses
            for reading in group
            if _fits(misses := board_misses(prepared, reading), stated)
        }
        if fitting:
            return [_misread(prepared, fitting, stated)]
    return []


class BoardMiss(NamedTuple):
    """How far scans lie off boards in images at a camera's best pose: metres, without noise.

    `planes` is the number of placements that tell it.
    """

    size: float
    transform: RigidTransform
    planes: int


def _fits(found, stated):
    """Whether the BoardMisses of all cameras are good, and far better than as stated."""
    if found.keys() != stated.keys():
        return False
    fewest = min(miss.planes for miss in found.values())  # few fit whatever is read
    freedom = max(PLANE * fewest - POSE, 1)
    much_better = max(BETTER, np.sqrt(fdtri(freedom, freedom, CHANCE)))
    return _worst(found) < GOOD and much_better * _worst(found) < _worst(stated)


def _worst(misses):
    """The largest BoardMiss of all cameras, metres."""
    return max(miss.size for miss in misses.values())


def board_misses(prepared, reading):
    """The BoardMiss of every camera that has one, with the recording read in some way."""
    misses = {}
    noise = np.median([scan.sigma_range for scan in prepared.scans.values()])
    for camera in prepared.views:
        views = {
            placement - reading.ahead: replace(view, pitch=reading.image_turn * view.pitch)
            for placement, view in prepared.posed(camera).items()
        }
        read = replace(prepared, views={camera: views})
        obs = observe(read, camera, corrections=reading, crossings=0, faces=POINTS)
        # the mirror image of a chessboard is one
        mirror = np.diag([reading.image_across, 1.0, 1.0, 1.0])
        obs = replace(obs, board_poses=mirror @ obs.board_poses @ mirror)
        with suppress(DegenerateGeometry, np.linalg.LinAlgError):
            transform = solve_camera(obs, "zhang_pless_printed").transform
            residuals = pd.Series(np.abs(plane_residuals_m(obs, transform)))
            each = residuals.groupby(obs.plane_placement).median()
            square = each.median() ** 2 - (HALF * reading.length * noise) ** 2
            misses[camera] = BoardMiss(
                np.sqrt(max(square, LEAST_MISS**2)), transform, planes=len(each)
            )
    return misses


def boards_in(session, placements, reading):
    """The BoardScan of every placement, of some, whose sweep shows the board, read in some way."""
    scans = {}
    for placement in placements:
        with suppress(BoardNotFound, SessionError):
            sweep = session.sweep(placement)
            read = replace(
                sweep,
                ranges=reading.length * sweep.ranges,
                pitch=reading.turn * sweep.pitch,
            )
            scans[placement] = find_board(read, session)
    return scans


def _misread(prepared, fitting, stated):
    """The Fault of a recording that fits with some Readings (BoardMisses of each), likely first."""
    worst = pd.Series({reading: _worst(misses) for reading, misses in fitting.items()})
    likely = sorted(
        worst.index[worst < AS_GOOD * worst.min()],
        # a mirrored cloud fits mirrored images: only where the cameras are said to be can tell
        key=lambda reading: (_far_from_guess(prepared, fitting[reading]), worst[reading]),
    )
    causes = "; or ".join(reading.words for reading in likely)
    return Fault(
        likely[0].kind,
        f"{causes}; once this is corrected, scans lie {1000 * worst[likely[0]]:.0f} mm "
        f"from the boards in the images, as recorded {1000 * _worst(stated):.0f} mm",
        severe=True,
    )


def _far_from_guess(prepared, found):
    """How far cameras stand from where session.json guesses them, metres; 0 without guesses."""
    guesses = guesses_of(prepared.session)
    return sum(
        distance(found[camera].transform, guesses[camera])
        for camera in guesses.keys() & found.keys()
    )


def faults_of_changes(changes, cameras) -> Iterator[Fault]:
    """The Faults of CameraChanges; `cameras` are the names of all of them."""
    steps = [change.after for change in changes]
    for change in changes:
        kind = "camera moved"
        size_px = change.motion_px
        words = (
            f"camera '{change.camera}' was moved before placement {change.after}: turned by "
            f"{np.degrees(change.turn):.2f} deg and shifted by {1000 * change.shift:.1f} mm, which "
            f"moves the board by {change.motion_px:.1f} px in its images"
        )
        if change.zoomed:
            kind = "camera zoomed"
            size_px = change.corner_px
            words = (
                f"the images of camera '{change.camera}' are {100 * abs(change.zoom):.2f} +- "
                f"{100 * change.zoom_sigma:.2f} % {by_sign(change.zoom, 'larger', 'smaller')} "
                f"from placement {change.after} on, {change.corner_px:.1f} px at their corners: "
                "zoom, focus or image size were changed"
            )
        elif steps.count(change.after) == len(cameras):
            words += " (or the range finder was: all cameras changed at once)"
        yield Fault(
            kind,
            f"{words}; fix what is loose and record anew, or make two sessions: one of the "
            f"placements before {change.after}, one of the others",
            severe=size_px > SEVERE_PX,
            camera=change.camera,
            placements=(change.after,),
        )


def exchanged_placements(joint) -> Iterator[Fault]:
    """Pairs of placements that are left out, and whose images fit the scans of each other."""
    prepared = joint.prepared
    lost = sorted(prepared.left_out | joint.solution.excluded_placements)
    scans = boards_in(prepared.session, lost[:MOST_LOST], AS_STATED)

    strange = [p for p, scan in scans.items() if not _same_board(joint, scan, p)]
    for first, second in combinations(strange, 2):
        if _same_board(joint, scans[first], second) and _same_board(
            joint, scans[second], first
        ):
            yield Fault(
                "exchanged",
                f"the images of placement {first} fit the scans of placement {second}, and those "
                f"of {second} the scans of {first}: their numbers are exchanged; exchange them "
                "back in images.csv",
                placements=(first, second),
            )


def _same_board(joint, scan, placement):
    """Whether a BoardScan shows the board where all images of a placement put it."""
    solution = joint.solution
    middle = solution.observations.corners.mean(axis=0)
    p_lrf, pitch, _ = face_points(scan, POINTS)
    p_platform = lrf_to_platform(p_lrf, pitch, solution.T_head_lrf)
    agree = []
    for camera in solution.transforms:
        view = joint.prepared.posed(camera).get(placement)
        if view is not None:
            p_camera = solution.camera_at(camera, view.pitch).apply(p_platform)
            on_board = view.T_camera_board.inv().apply(p_camera)
            beside = length_of(on_board[:, :2].mean(axis=0) - middle)
            away = np.median(np.abs(on_board[:, 2]))
            agree.append(away < GOOD and beside < BESIDE)
    return bool(agree) and all(agree)
