"""Is what was just recorded any good? Lights for one placement, from what is on the disk."""

import math
from dataclasses import dataclass
from itertools import compress
from typing import Any

import cv2
import numpy as np

from lrfcal_lib.model.board import Board
from lrfcal_lib.model.geometry import length_of
from lrfcal_lib.preprocess.board_in_image import view_board
from lrfcal_lib.preprocess.board_in_scan import BoardNotFound, find_board
from lrfcal_lib.preprocess.edges_in_scan import with_edges
from lrfcal_lib.preprocess.pattern_in_image import PatternFinder, PatternNotFound, grey
from lrfcal_lib.session.faults import DARK, brightness, repeated_images, repeated_scans
from lrfcal_lib.session.files import SessionError
from lrfcal_lib.session.read import Session, Sweep
from lrfcal_lib.session.stated import StatedRig

STATES = ("ok", "warn", "bad")
FEWEST_CROSSINGS = 6  # of a side, below which a straight line says little about it
# two sides that include less give one constraint, not two
PARALLEL = np.cos(np.radians(20))
FEWEST_LINES = 8  # scan lines on the board
LEAST_SCENE = 0.2  # share of the beams of a scene that come back
BLURRED_PX = 3.5  # rise of a chessboard's edges from 10 to 90 %; 2 to 3 in a sharp image
LEAST_SQUARE_PX = 24  # with fewer OpenCV finds no edges; smaller ones are enlarged
CLIPPED = 250  # grey levels of a white square
LOW_CONTRAST = 25  # grey levels between white and dark squares
NO_RANGE = "no scan line with a range: is something close before the window?"
NO_SIDE = "no straight side: turn the board so that scan lines cross its edges"
NOT_CHECKED = "not checked: the board has no pattern, and the camera no intrinsics yet"
DARKNESS = "too dark: use more light or a longer exposure"


@dataclass(frozen=True)
class Light:
    """One check; its text says what was seen, and what to do where the state is not 'ok' but 'warn'
    or 'bad'.
    """

    name: str
    state: str
    text: str


def check_placement(session: Session, placement: int) -> list[Light]:
    """Check a placement that was just recorded.

    Nothing is raised for data that cannot be used: that is what the lights are for.

    Parameters
    ----------
    session
        Opened after the placement was finished.
    placement
        Its number.

    Returns
    -------
    list of Light
        'scan', 'edges', 'recording' for each of its scans and images that another placement has,
        too, and one for each camera.
    """
    try:
        sweep = session.sweep(placement)
    except SessionError:
        sweep = None
    scene = placement in session.scene_placements
    if scene and sweep is not None:
        return [check_scene(sweep)]
    lights = check_scan(sweep, session)
    lights += [
        Light("recording", "bad", fault.words)
        for fault in (*repeated_images(session), *repeated_scans(session))
        if placement in fault.placements
    ]
    if scene:
        return lights
    for name, camera in session.cameras.items():
        images = [
            check_image(session.read_image(record), session.board, camera.model)
            for record in session.images(name, placement)
        ]
        lights.append(_together(f"camera {name}", images))
    return lights


def check_scene(sweep: Sweep) -> Light:
    """The Light of a sweep over a scene: how much of it came back.

    Parameters
    ----------
    sweep
    """
    share = np.isfinite(sweep.ranges).mean()
    return Light(
        name="scan",
        state="ok" if share > LEAST_SCENE else "warn",
        text=f"scene: {len(sweep.pitch)} scan lines, {100 * share:.0f} % of the beams came back",
    )


def _together(name, lights):
    """The Light of all images of a camera: the worst of those that can be used."""
    if not lights:
        return Light(name, "bad", "no image")
    good = [light for light in lights if light.state != "bad"]
    worst = max(good or lights, key=lambda light: STATES.index(light.state))
    return Light(
        name=name,
        state="warn" if good and good != lights else worst.state,
        text=f"{len(good)} of {len(lights)} images: {worst.text}",
    )


def check_scan(sweep: Sweep | None, rig: StatedRig) -> list[Light]:
    """Lights of a sweep: 'scan' and, where the board was found, 'edges'.

    Parameters
    ----------
    sweep
        None where there is no range at all.
    rig
        As the session states it.
    """
    if sweep is None:
        return [Light("scan", "bad", NO_RANGE)]
    try:
        scan = find_board(sweep, rig)
    except BoardNotFound as error:
        return [
            Light("scan", "bad", f"no board: {error}; sweep over all of it, free of walls")
        ]
    hit = np.any(scan.mask, axis=1)
    text = (
        f"board on {hit.sum()} scan lines at {abs(scan.distance):.2f} m, "
        f"{1000 * scan.sigma_range:.1f} mm rms"
    )
    cut = [*compress(("first", "last"), hit[[0, -1]])]
    fault = ""
    if hit.sum() < FEWEST_LINES:
        fault = ": take a smaller step, or go nearer"
    elif cut and np.ptp(sweep.pitch) > 0:
        fault = f"; the {' and '.join(cut)} line hits it: sweep farther"
    return [Light("scan", "warn" if fault else "ok", text + fault), _check_sides(scan)]


def _check_sides(scan):
    """How many straight sides of the board the scans cross, and how."""
    sides = with_edges(scan).side_of.values()
    good = [side for side in sides if side.n_points >= FEWEST_CROSSINGS]
    if not good:
        return Light("edges", "bad", NO_SIDE)
    each = [
        f"{side.n_points} crossings at {np.degrees(side.angle):.0f} deg" for side in good
    ]
    text = f"{len(good)} sides: {', '.join(each)}"
    directions = np.array([side.direction for side in good])
    if np.abs(directions @ directions.T).min() < PARALLEL:
        return Light("edges", "ok", text)
    return Light("edges", "warn", f"{text}; turn the board to show another side")


def check_image(
    image: np.ndarray, board: Board, model: Any = None, name: str = "image"
) -> Light:
    """The Light of an image of the board.

    Parameters
    ----------
    image
        (height, width, 3), BGR.
    board
        That it should show.
    model : CameraModel or None
        Of the camera; a board without a pattern cannot be checked without.
    name
        Of the Light.
    """
    pattern = board.pattern
    if pattern is None:
        return _check_plain(image, board, model, name)
    try:
        corners = PatternFinder(pattern)(image)
    except PatternNotFound as error:
        text = str(error)
        if brightness(image) < DARK:
            text += f"; {DARKNESS}"
        return Light(name, "bad", text)
    scale = math.ceil(LEAST_SQUARE_PX / length_of(corners[1] - corners[0]))
    large = cv2.resize(
        grey(image), None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR
    )
    enlarged = (scale * corners + (scale - 1) / 2).astype(np.float32)
    (rise, dark, white, _), _ = cv2.estimateChessboardSharpness(
        large, (pattern.columns, pattern.rows), enlarged
    )
    rise /= scale
    faults = {
        "blurred: hold the board still, and focus": rise > BLURRED_PX,
        DARKNESS: white < DARK,
        "overexposed: use less light or a shorter exposure": white > CLIPPED,
        "little contrast: avoid glare": white - dark < LOW_CONTRAST,
    }
    text = f"pattern found, edges rise in {rise:.1f} px, squares {dark:.0f} and {white:.0f} of 255"
    return Light(
        name=name,
        state="warn" if any(faults.values()) else "ok",
        text="; ".join([text, *compress(faults, faults.values())]),
    )


def _check_plain(image, board, model, name):
    """The Light of an image of a board without a pattern."""
    if model is None:
        return Light(name, "warn", NOT_CHECKED)
    view = view_board(image, board, model)
    if view.reason:
        return Light(name, "bad", view.reason)
    return Light(name, "ok", f"{len(view.edges)} edges")
