"""Is what was just recorded any good? Lights for one placement of the board, from what is on the
disk.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from lrfcal_lib.preprocess import board_in_scan
from lrfcal_lib.preprocess.board_in_image import view_board
from lrfcal_lib.preprocess.edges_in_scan import crossings
from lrfcal_lib.preprocess.pattern_in_image import PatternFinder, PatternNotFound, grey
from lrfcal_lib.session.faults import DARK, dark_image, repeated_images, repeated_scans
from lrfcal_lib.session.stated import SessionError

STATES = ("ok", "warn", "bad")
FEWEST_CROSSINGS = 6  # of a side, below which a straight line says little about it
PARALLEL = np.cos(np.radians(20))  # two sides that include less give one constraint, not two
FEWEST_LINES = 8  # scan lines on the board
BLURRED_PX = 3.5  # rise of a chessboard's edges from 10 to 90 %; about 2 in a sharp image
CLIPPED = 250  # grey levels of a white square
LOW_CONTRAST = 25  # grey levels between white and dark squares


@dataclass(frozen=True)
class Light:
    """One check; its text says what was seen, and what to do where the state is not 'ok' but 'warn'
    or 'bad'.
    """

    name: str
    state: str
    text: str


def check_placement(session, placement, advice=None):
    """Check a placement that was just recorded.

    Parameters
    ----------
    session : Session
        Opened after the placement was finished.
    placement : int
    advice : callable, optional
        ``advice(session)`` says in a sentence what the next placement should add; '' if all is
        known well enough.

    Returns
    -------
    list of Light
        'scan', 'edges', one for each camera, and 'information' where there is advice. Nothing is
        raised for data that cannot be used: that is what the lights are for.
    """
    try:
        sweep = session.sweep(placement)
    except SessionError:
        sweep = None
    if placement in session.scene_placements and sweep is not None:
        share = np.isfinite(sweep.ranges).mean()
        text = f"scene: {len(sweep.pitch)} scan lines, {100 * share:.0f} % of the beams came back"
        return [Light("scan", "ok" if share > 0.2 else "warn", text)]
    lights = check_scan(sweep, session.board, session.T_head_lrf, session.lrf)
    lights += check_repetition(session, placement)
    if placement in session.scene_placements:
        return lights
    for name, camera in session.cameras.items():
        images = [session.read_image(record) for record in session.images(name, placement)]
        found = [check_image(image, session.board, camera.model) for image in images]
        good = [light for light in found if light.state != "bad"]
        worst = max(
            good or found,
            key=lambda light: STATES.index(light.state),
            default=Light("", "bad", "no image"),
        )
        state = "warn" if 0 < len(good) < len(found) else worst.state
        text = f"{len(good)} of {len(found)} images: {worst.text}" if found else worst.text
        lights.append(Light(f"camera {name}", state, text))
    if advice is not None:
        text = advice(session)
        lights.append(
            Light(
                "information",
                "warn" if text else "ok",
                text or "every direction is well determined",
            )
        )
    return lights


def check_repetition(session, placement):
    """A Light 'recording' for each of a placement's scans and images that another one has, too."""
    faults = repeated_images(session) + repeated_scans(session)
    return [Light("recording", "bad", f.words) for f in faults if placement in f.placements]


def check_scan(sweep, board, T_head_lrf=None, lrf=None):
    """Lights of a Sweep (None where there is no range at all): 'scan' and, where the board was
    found, 'edges'.
    """
    if sweep is None:
        return [
            Light("scan", "bad", "no scan line with a range: is something close before the window?")
        ]
    try:
        found = board_in_scan.find_board(sweep, board, T_head_lrf, lrf)
    except board_in_scan.BoardNotFound as error:
        return [
            Light(
                "scan",
                "bad",
                f"no board: {error}; sweep over all of it, free of walls",
            )
        ]
    rows = np.flatnonzero(found.mask.any(axis=1))
    text = (
        f"board on {len(rows)} scan lines at {abs(found.distance):.2f} m, "
        f"{1000 * found.sigma_range:.1f} mm rms"
    )
    cut = [end for end, row in (("first", 0), ("last", len(sweep.pitch) - 1)) if row in rows]
    light = Light("scan", "ok", text)
    if len(rows) < FEWEST_LINES:
        light = Light("scan", "warn", f"{text}: take a smaller step, or go nearer")
    elif cut and np.ptp(sweep.pitch) > 0:
        light = Light(
            "scan", "warn", f"{text}; the {' and '.join(cut)} line hits it: sweep farther"
        )
    return [light, _edges(found)]


def _edges(found):
    """How many straight sides of the board the scans cross, and how."""
    along, known = crossings(found)
    sides = {side.side: side for side in along["half_step"].sides}
    for side in (
        crossings(found, True, known)[0]["half_step"].sides if np.ptp(found.sweep.pitch) > 0 else ()
    ):
        sides.setdefault(side.side, side)
    good = [side for side in sides.values() if side.n_points >= FEWEST_CROSSINGS]
    told = ", ".join(f"{s.n_points} crossings at {np.degrees(s.angle):.0f} deg" for s in good)
    if not good:
        return Light(
            "edges", "bad", "no straight side: turn the board so that scan lines cross its edges"
        )
    ways = np.array([np.subtract(*side.ends) for side in good])
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    if np.abs(ways @ ways.T).min() < PARALLEL:
        return Light("edges", "ok", f"{len(good)} sides: {told}")
    return Light("edges", "warn", f"{len(good)} sides: {told}; turn the board to show another side")


def check_image(image, board, model=None, name="image"):
    """The Light, of this name, of an image of the Board; one without a pattern needs a
    CameraModel.
    """
    if board.pattern is None:
        if model is None:
            return Light(
                name,
                "warn",
                "not checked: the board has no pattern, and the camera no intrinsics yet",
            )
        view = view_board(image, board, model)
        return (
            Light(name, "bad", view.reason)
            if view.reason
            else Light(name, "ok", f"{len(view.edges)} edges")
        )
    try:
        corners = PatternFinder(board.pattern)(image)
    except PatternNotFound as error:
        why = "; too dark, more light or a longer exposure" if dark_image(image) else ""
        return Light(name, "bad", f"{error}{why}")
    picture = grey(image)
    grid = corners.reshape(board.pattern.rows, board.pattern.columns, 2)
    rise = edge_rise(picture, grid)
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    squares = _at(picture, centres)
    odd = np.indices(centres.shape[:2]).sum(axis=0) % 2
    dark, white = sorted(np.median(squares[odd == i]) for i in (0, 1))
    faults = {
        "blurred, hold the board still and focus": rise > BLURRED_PX,
        "too dark, more light or a longer exposure": white < DARK,
        "overexposed, less light or a shorter exposure": white > CLIPPED,
        "little contrast, avoid glare": white - dark < LOW_CONTRAST,
    }
    wrong = [fault for fault, holds in faults.items() if holds]
    text = f"pattern found, edges rise in {rise:.1f} px, squares {dark:.0f} and {white:.0f} of 255"
    return Light(name, "warn" if wrong else "ok", "; ".join([text, *wrong]))


def edge_rise(picture, grid):
    """Median distance in which the edges between squares rise from 10 to 90 %, pixels: 2.6 sigma of
    a Gaussian blur.

    `grid` (rows, columns, 2) has the inner corners of the chessboard in a picture (h, w); at most
    0.7 of a square.
    """
    pairs = [(grid[:, :-1], grid[:, 1:]), (grid[:-1], grid[1:])]
    ends = np.stack([np.concatenate([pair[i].reshape(-1, 2) for pair in pairs]) for i in (0, 1)])
    along = ends[1] - ends[0]
    middle = ends.mean(axis=0)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    share = np.linspace(-0.35, 0.35, 57)
    values = _at(picture, middle[:, None] + share[:, None] * across[:, None])
    low = values[:, :12].mean(axis=1)
    high = values[:, -12:].mean(axis=1)
    height = (values - low[:, None]) / np.where(high == low, np.nan, high - low)[:, None]
    between = np.mean((height > 0.1) & (height < 0.9), axis=1)
    return float(np.median(between * np.ptp(share) * np.linalg.norm(along, axis=1)))


def _at(picture, pixels):
    """Grey levels at pixels of any shape (..., 2), bilinear."""
    u, v = (np.ascontiguousarray(pixels[..., i].reshape(1, -1), np.float32) for i in (0, 1))
    return cv2.remap(picture, u, v, cv2.INTER_LINEAR).reshape(pixels.shape[:-1]).astype(float)
