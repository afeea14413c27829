"""What else could be wrong: statements tested one by one against the data, with words that name
cause and remedy.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.special import ndtri, stdtr

from lrfcal_lib.fit.covariance import sigma_turn_shift
from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.judge.findings import Kind, by_sign
from lrfcal_lib.model.geometry import (
    axis_difference,
    axis_of,
    transform_difference,
)
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.session.faults import Fault
from lrfcal_lib.session.read import Session
from lrfcal_lib.solvers.joint_model import SENSOR
from lrfcal_lib.solvers.joint_solution import JointSolution

STEP = 1e-4  # of the numeric derivative, in the unit of an alternative
ADMITTED = 0.5  # the range offset that a maker admits is two standard deviations
ASKED = 4.0  # standard deviations beyond which the data contradict a statement, whatever it does
# so many are exceeded by chance once in 20 times; enough where it does harm:
PREFERRED = 2.0
MOVED = 2.0  # standard deviations by which what is handed over would move
LARGE_SHARE = 0.9  # of a standard deviation, due to the angular step
UNKNOWN = 100.0  # times what is worth a word: so large a standard deviation says nothing
FAR = 4.0  # standard deviations of the stated axis and its own
# of a camera from its guess
FAR_TURN = np.radians(30.0)
FAR_SHIFT = 0.3
# log odds; sides are expected to deviate no more than this while statements are weighed
ALIKE = 0.15
LEVER = 0.2  # metres, weighs turns against shifts
CHECK = (
    "check what session.json states; reversed bearings or pitch, or exchanged camera folders, "
    "look the same"
)
# of the best alternative's likelihood ratio: another one explains the data nearly as well
AS_GOOD = 0.6


@dataclass(frozen=True)
class Alternative:
    """A statement that may be wrong.

    Attributes
    ----------
    change : callable
        Of observations and a value s: the observations as they would be if the truth were off by s.
    worth : float
        Smaller values of s are not worth a word.
    reach : float
        Larger values of s are more than a test at the solution can tell.
    unit : float
        What s is multiplied by for the words.
    words : str
        With the remedy; with ``{size}`` and ``{sigma}`` of s, and ``{sign}``: the first of `signs`
        where s is positive.
    """

    change: Callable
    words: str
    signs: tuple = ("larger", "smaller")
    worth: float = 0.004
    reach: float = 0.3
    unit: float = 100.0


def _views(obs, s, origin=(0.0, 0.0)):
    """Squares larger by s about the pattern's first corner (`origin`, metres, board frame)."""
    pose = obs.view_pose.copy()
    pose[:, :3, 3] += s * pose[:, :3] @ [*origin, 0.0, 1.0]
    return replace(obs, view_pose=pose)


def _outline(obs, s):
    """The board larger by s."""
    return replace(obs, corners=obs.corners * (1 + s))


def _views_and_outline(obs, s):
    """Squares larger by s where the outline was measured in their scale."""
    return _outline(_views(obs, s), s)


def _lag(obs, s):
    """The pitch of scan lines later by s (radians) in the sense of the sweep."""
    return replace(
        obs,
        face_pitch=obs.face_pitch + s * obs.direction[obs.face_placement],
        beam_pitch=obs.beam_pitch + s * obs.direction[obs.beam_placement],
    )


ALTERNATIVES = {
    Kind.SQUARES: Alternative(
        _views,
        "the chessboard's squares are {size} +- {sigma} % {sign} than stated: measure a square "
        "over many of them",
    ),
    Kind.OUTLINE: Alternative(
        _outline,
        "the board's outline is {size} +- {sigma} % {sign} than stated: measure the board's edges",
    ),
    Kind.RANGES: Alternative(
        lambda obs, s: replace(obs, face_range=obs.face_range * (1 + s)),
        "all ranges are {size} +- {sigma} % {sign}: measure a square and an edge of the board, "
        "check the unit of the ranges",
        (
            "too short, or board and squares smaller than stated",
            "too long, or board and squares larger than stated",
        ),
    ),
    Kind.BEARINGS: Alternative(
        JointObservations.stretched,
        "bearings are {size} +- {sigma} % too {sign}: check the angular step that session.json "
        "states",
        ("small", "large"),
    ),
    Kind.SPOT: Alternative(
        lambda obs, s: replace(obs, beam_radius=obs.beam_radius * (1 + s)),
        "the spot of the range finder is {size} +- {sigma} % {sign} than stated: state spot_exit_m "
        "and spot_divergence_rad as its maker does",
        worth=0.2,
        reach=5.0,
    ),
    Kind.LAG: Alternative(
        _lag,
        "the recorded pitch of scan lines is {size} +- {sigma} deg {sign} the sweep: check the "
        "time stamps of pitch and scans, sweep slower or stop for every scan",
        ("behind", "ahead of"),
        worth=np.radians(0.05),
        unit=np.degrees(1.0),
    ),
}


def alternatives_of(prepared):
    """Those of `ALTERNATIVES` that are there to be wrong in a session (Prepared), by kind.

    A plain board has no squares. An outline that the images measured is not stated, and scales with
    the squares; one that is stated stays as it is, and squares that are larger reach farther from
    the pattern's first corner.
    """
    stated = dict(ALTERNATIVES)
    squares = stated.pop(Kind.SQUARES)
    pattern = prepared.board.pattern
    if pattern is not None:
        change = partial(_views, origin=pattern.origin)
        if prepared.session.board.corners is None:
            del stated[Kind.OUTLINE]
            change = _views_and_outline
        stated[Kind.SQUARES] = replace(squares, change=change)
    if prepared.session.lrf.spot_exit is None:
        del stated[Kind.SPOT]
    return stated


@dataclass(frozen=True)
class Doubt:
    """What the data say of one alternative.

    Attributes
    ----------
    kind : Kind
        Of `ALTERNATIVES`.
    value, sigma : float
        As the data have it, with its standard deviation.
    ratio : float
        Likelihood ratio (squared score).
    deviations : float
        Chance alone goes so far as seldom as a normal variable goes beyond so many.
    moved : float
        By how many of its standard deviations the axis or a camera would move at most, were it so.
    words : str
    """

    kind: Kind
    value: float
    sigma: float
    ratio: float
    deviations: float
    moved: float
    words: str


def weigh(
    solution: JointSolution,
    admitted_offset: float,
    stated: Mapping[Kind, Alternative] = ALTERNATIVES,
) -> list[Doubt]:
    """Every alternative tested by itself, all that was estimated free, the likeliest first.

    A score test at the solution: no estimate is repeated. A range offset takes up what a wrong size
    does to ranges; it is expected to be what the maker admits.

    Parameters
    ----------
    solution
    admitted_offset
        Of the range finder's maker, metres.
    stated
        What may be wrong.
    """
    # sides that may deviate, and beams that may say nothing, would take up what a wrong statement
    # does to edges
    tested = solution.with_levels(
        side_sigma=min(solution.noise["side_sigma"], ALIKE),
        background_sigma=min(solution.noise["background_sigma"], ALIKE),
        lapse=0.0,
    )
    doubts = []
    for kind, alternative in stated.items():
        doubt = doubt_about(kind, alternative, tested, admitted_offset)
        if 0 < doubt.sigma < UNKNOWN * alternative.worth:
            doubts.append(doubt)
    return sorted(doubts, key=lambda doubt: -doubt.ratio)


def doubt_about(kind, alternative, solution, admitted_offset):
    """What the data say of an alternative, a Doubt.

    The standard deviation is the larger one of noise and scatter over placements.
    """
    names = np.array(solution.solution.names)
    score = solution.score(alternative.change(solution.observations, STEP), STEP)
    expected = np.append(names == "range_offset", 0) / (ADMITTED * admitted_offset) ** 2
    covariance, step, pulls = score.solved(expected, solution.sensor["range_offset"])
    value = step[-1]
    freedom = max(len(pulls) - 1, 1)
    noise = covariance[-1, -1]
    scatter = np.sum(pulls[:, -1] ** 2) * len(pulls) / freedom
    sigma = np.sqrt(max(noise, scatter))
    pull = abs(value) / max(sigma, 1e-300)
    # what the noise explains is known without limit, scatter by the placements less one
    chance = stdtr(freedom if scatter > noise else np.inf, -pull)

    handed = np.flatnonzero(~np.isin(names, SENSOR))
    # what the accuracy of the angular step may do must not hide that it is wrong
    spread = np.sqrt(solution.solution.trusted_sigma**2 - solution.step**2)[handed]
    moves = covariance[handed, -1] / max(noise, 1e-300) * value / spread
    return Doubt(
        kind=kind,
        value=value,
        sigma=sigma,
        ratio=pull**2,
        deviations=-ndtri(chance),
        moved=np.max(np.abs(moves), initial=0.0),
        words=alternative.words.format(
            size=f"{abs(value) * alternative.unit:.2g}",
            sigma=f"{sigma * alternative.unit:.2g}",
            sign=by_sign(value, *alternative.signs),
        ),
    )


def doubtful(solution, admitted_offset, stated=ALTERNATIVES):
    """The alternatives that the data ask for: list of Doubt, the best one and those that explain
    them as well.

    Beyond chance whatever they do, or preferred by the data where what is handed over would move by
    more than its standard deviation tells. A spot needs the latter: one that is no evenly lit disc
    looks like one of another size, which does no harm. An angular step that is known needs the
    former.
    """
    asked = []
    for doubt in weigh(solution, admitted_offset, stated):
        size = abs(doubt.value)
        alternative = stated[doubt.kind]
        asks = (
            doubt.deviations > ASKED
            and size > alternative.worth
            and doubt.kind != Kind.SPOT
        )
        # a step that the sensor's disc divides is off for no small reason
        if doubt.kind != Kind.BEARINGS or solution.step.any():
            asks |= doubt.deviations > PREFERRED and doubt.moved > MOVED
        if asks and size < alternative.reach:
            asked.append(doubt)
    return [doubt for doubt in asked if doubt.ratio > AS_GOOD * asked[0].ratio]


def step_words(solution: JointSolution) -> str:
    """In words, where the accuracy of the angular step makes up much of the expected errors; else
    ''.

    Parameters
    ----------
    solution
    """
    if np.max(np.abs(solution.step) / solution.solution.trusted_sigma) < LARGE_SHARE:
        return ""
    return (
        f"The angular step is taken to be known to {100 * solution.data.levels.step_sigma:.2g} %, "
        "which makes up most of the errors of axis or cameras: state angular_step_relative in "
        "session.json where it is known better."
    )


def far_from_stated(joint) -> list[Fault]:
    """What lies far from where session.json puts it.

    A sensor that is mounted upside down sees the mirror image of every scan line, and a pitch of
    the other sense turns the axis about: only the statement of the platform, a camera's guess, or
    its name can tell.

    Parameters
    ----------
    joint : JointCalibration
    """
    return [*far_axis(joint), *far_cameras(joint)] or [*exchanged_sides(joint.solution)]


def _far(words, angle):
    """The Fault of what lies far from where it is stated, turned by an angle (radians)."""
    return Fault(Kind.FAR_FROM_STATED, words, severe=angle > np.pi / 2)


def far_axis(joint) -> Iterator[Fault]:
    """The tilt axis, if it is far from where it is stated."""
    session = joint.prepared.session
    solution = joint.solution
    if session.T_head_lrf is None or not joint.settings["axis"]:
        return
    apart = axis_difference(solution.axis, axis_of(session.T_head_lrf))
    known = sigma_turn_shift(solution.covariance(*AXIS_NAMES))
    if np.any(apart > FAR * np.hypot(session.platform_sigma, known)):
        yield _far(
            f"the tilt axis lies {apart_words(*apart)} from where session.json states it: {CHECK}",
            apart[0],
        )


def guesses_of(session: Session) -> dict[str, RigidTransform]:
    """Where session.json guesses cameras to stand, by name.

    Parameters
    ----------
    session
    """
    return {
        name: camera.guess
        for name, camera in session.cameras.items()
        if camera.guess is not None
    }


def far_cameras(joint) -> Iterator[Fault]:
    """Cameras that are far from where they are guessed, or stand where another one is guessed."""
    guesses = guesses_of(joint.prepared.session)
    for camera, transform in joint.solution.transforms.items():
        if camera not in guesses:
            continue
        turn, shift = transform_difference(transform, guesses[camera])
        nearest = min(guesses, key=lambda name: distance(transform, guesses[name]))
        if turn > FAR_TURN or shift > FAR_SHIFT:
            yield _far(
                f"camera '{camera}' stands {apart_words(turn, shift)} from its guess in "
                f"session.json: {CHECK}",
                turn,
            )
        elif nearest != camera:
            yield _far(
                f"camera '{camera}' stands where camera '{nearest}' is said to stand: were the "
                "folders exchanged?",
                turn,
            )


def distance(a: RigidTransform, b: RigidTransform) -> float:
    """How far two places of a camera are apart, turn and shift in one: metres.

    Parameters
    ----------
    a, b
    """
    turn, shift = transform_difference(a, b)
    return LEVER * turn + shift


def exchanged_sides(solution) -> Iterator[Fault]:
    """Cameras that are called left and right, and stand the other way round."""
    for left, right in permutations(solution.transforms, 2):
        offset = _right_of_lrf(solution, left) - _right_of_lrf(solution, right)
        if "left" in left.lower() and "right" in right.lower() and offset > 0:
            yield _far(
                f"camera '{left}' is {1000 * offset:.0f} mm to the right of camera '{right}': were "
                "the folders exchanged?",
                0.0,
            )


def _right_of_lrf(solution, camera):
    """How far to the right of the range finder a camera sits, metres."""
    return (solution.camera_at(camera, 0.0) * solution.T_head_lrf).inv().translation[0]


def apart_words(angle: float, distance: float) -> str:
    """How far two things are apart, angle (radians) and distance (metres)."""
    return f"{np.degrees(angle):.1f} deg and {1000 * distance:.0f} mm"
