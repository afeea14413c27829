"""Is what was just recorded any good? Lights for one placement of the board, from what is on the disk."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lrfcal_lib.preprocess import board_in_scan, edges_in_scan
from lrfcal_lib.preprocess.board_in_image import view_board
from lrfcal_lib.preprocess.pattern_in_image import PatternFinder, PatternNotFound, grey
from lrfcal_lib.session.stated import SessionError

STATES = ("ok", "warn", "bad")
FEWEST_CROSSINGS = 6  # of a side, below which a straight line says little about it
PARALLEL = np.cos(np.radians(20))  # two sides that include less give one constraint, not two
FEWEST_LINES = 8  # scan lines on the board
BLURRED_PX = 3.5  # rise of a chessboard's edges from 10 to 90 %; about 2 in a sharp image
DARK, CLIPPED = 30, 250  # grey levels of a white square
LOW_CONTRAST = 25  # grey levels between white and dark squares


@dataclass(frozen=True)
class Light:
    """One check.

    Attributes
    ----------
    name : str
    state : {'ok', 'warn', 'bad'}
    text : str
        What was seen, and what to do where it is not good.
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
        ``advice(session)`` says in a sentence what the next placement should add; '' if all is known well enough.

    Returns
    -------
    list of Light
        'scan', 'edges', one for each camera, and 'information' where there is advice. Nothing is raised for data that
        cannot be used: that is what the lights are for.
    """
    if placement in session.scene_placements:
        return [_scene(session, placement)]
    lights = check_scan(_sweep(session, placement), session.board, session.T_head_lrf)
    lights += [_camera(session, placement, camera) for camera in session.cameras]
    if advice is not None:
        text = advice(session)
        lights.append(Light("information", "warn" if text else "ok", text or "every direction is well determined"))
    return lights


def check_scan(sweep, board, T_head_lrf=None):
    """Check the scans of a placement.

    Parameters
    ----------
    sweep : Sweep or None
        None where there is no range at all.
    board : Board
    T_head_lrf : RigidTransform, optional

    Returns
    -------
    list of Light
        'scan' and, where the board was found, 'edges'.
    """
    if sweep is None:
        return [Light("scan", "bad", "no scan line with a range: is something close before the window?")]
    try:
        found = board_in_scan.find_board(sweep, board, T_head_lrf)
    except board_in_scan.BoardNotFound as error:
        return [Light("scan", "bad", f"no board: {str(error).partition(': ')[2]}; sweep over all of it, free of walls")]
    rows = np.flatnonzero(found.mask.any(axis=1))
    text = f"board on {len(rows)} scan lines at {abs(found.distance):.2f} m, {1000 * found.sigma_range:.1f} mm rms"
    if len(rows) < FEWEST_LINES:
        return [Light("scan", "warn", f"{text}: take a smaller step, or go nearer"), _edges(found)]
    cut = [end for end, row in (("first", 0), ("last", len(sweep.pitch) - 1)) if row in rows]
    if cut and np.ptp(sweep.pitch) > 0:
        return [Light("scan", "warn", f"{text}; the {' and '.join(cut)} line hits it: sweep farther"), _edges(found)]
    return [Light("scan", "ok", text), _edges(found)]


def _edges(found):
    """How many straight sides of the board the scans cross, and how."""
    sides = list(edges_in_scan.edge_points(found).sides)
    known = {side.side for side in sides}
    if np.ptp(found.sweep.pitch) > 0:
        sides += [side for side in edges_in_scan.sweep_edges(found).sides if side.side not in known]
    good = [side for side in sides if side.n_points >= FEWEST_CROSSINGS]
    told = ", ".join(f"{s.n_points} crossings at {np.degrees(s.angle):.0f} deg" for s in good)
    if not good:
        return Light("edges", "bad", "no straight side: turn the board so that scan lines cross its edges")
    if len(good) >= 2 and _turned(good):
        return Light("edges", "ok", f"{len(good)} sides: {told}")
    return Light("edges", "warn", f"{len(good)} sides: {told}; turn the board to show another side")


def _turned(sides):
    """Whether two of the sides are not parallel."""
    ways = np.array([np.subtract(*side.ends) for side in sides])
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return bool(np.abs(ways @ ways.T).min() < PARALLEL)


def check_image(image, board, model=None, name="image"):
    """Check an image of the board.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    board : Board
    model : CameraModel, optional
        Needed for a board without a pattern.
    name : str
        Of the light.

    Returns
    -------
    Light
    """
    if board.pattern is None:
        if model is None:
            return Light(name, "warn", "not checked: the board has no pattern, and the camera no intrinsics yet")
        view = view_board(image, board, model)
        return Light(name, "bad", view.reason) if view.reason else Light(name, "ok", f"{len(view.edges)} edges")
    try:
        corners = PatternFinder(board.pattern)(image)
    except PatternNotFound as error:
        return Light(name, "bad", str(error))
    return _quality(grey(image), corners, board.pattern, name)


def _quality(picture, corners, pattern, name):
    """Sharpness and exposure at the pattern."""
    grid = corners.reshape(pattern.rows, pattern.columns, 2)
    rise, (dark, white) = edge_rise(picture, grid), square_levels(picture, grid)
    text = f"pattern found, edges rise in {rise:.1f} px, squares {dark:.0f} and {white:.0f} of 255"
    faults = {
        "blurred, hold the board still and focus": rise > BLURRED_PX,
        "too dark, more light or a longer exposure": white < DARK,
        "overexposed, less light or a shorter exposure": white > CLIPPED,
        "little contrast, avoid glare": white - dark < LOW_CONTRAST,
    }
    wrong = [fault for fault, holds in faults.items() if holds]
    return Light(name, "warn" if wrong else "ok", "; ".join([text, *wrong]))


def edge_rise(picture, grid):
    """Median distance in which the edges between squares rise from 10 to 90 %, pixels: 2.6 sigma of a Gaussian blur.

    Parameters
    ----------
    picture : ndarray of uint8, shape (h, w)
    grid : ndarray, shape (rows, columns, 2)
        Inner corners of a chessboard, pixels.

    Returns
    -------
    float
        At most 0.7 of a square.
    """
    pairs = [(grid[:, :-1], grid[:, 1:]), (grid[:-1], grid[1:])]
    ends = np.stack([np.concatenate([pair[i].reshape(-1, 2) for pair in pairs]) for i in (0, 1)])
    along, middle = ends[1] - ends[0], ends.mean(axis=0)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    share = np.linspace(-0.35, 0.35, 57)
    values = _at(picture, middle[:, None] + share[:, None] * across[:, None])
    low, high = values[:, :12].mean(axis=1), values[:, -12:].mean(axis=1)
    height = (values - low[:, None]) / np.where(high == low, np.nan, high - low)[:, None]
    between = np.mean((height > 0.1) & (height < 0.9), axis=1)
    return float(np.median(between * np.ptp(share) * np.linalg.norm(along, axis=1)))


def square_levels(picture, grid):
    """Grey levels of the dark and of the light squares of a chessboard, medians; see :func:`edge_rise`."""
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    values, odd = _at(picture, centres), np.indices(centres.shape[:2]).sum(axis=0) % 2
    return sorted(float(np.median(values[odd == i])) for i in (0, 1))


def _at(picture, pixels):
    """Grey levels at pixels of any shape (..., 2), bilinear."""
    u, v = (np.ascontiguousarray(pixels[..., i].reshape(1, -1), np.float32) for i in (0, 1))
    return cv2.remap(picture, u, v, cv2.INTER_LINEAR).reshape(pixels.shape[:-1]).astype(float)


def _sweep(session, placement):
    try:
        return session.sweep(placement)
    except SessionError:
        return None


def _camera(session, placement, camera):
    """The worst of a camera's images of a placement."""
    name, records = f"camera {camera}", session.images(camera, placement)
    if not records:
        return Light(name, "bad", "no image")
    model = session.cameras[camera].model
    lights = [check_image(session.read_image(record), session.board, model, name) for record in records]
    good = [light for light in lights if light.state != "bad"]
    worst = max(good or lights, key=lambda light: STATES.index(light.state))
    state = "warn" if good and len(good) < len(lights) else worst.state
    return Light(name, state, f"{len(good)} of {len(lights)} images: {worst.text}")


def _scene(session, placement):
    sweep = _sweep(session, placement)
    if sweep is None:
        return Light("scan", "bad", "no scan line with a range")
    share = np.isfinite(sweep.ranges).mean()
    state = "ok" if share > 0.2 else "warn"
    return Light("scan", state, f"scene: {len(sweep.pitch)} scan lines, {100 * share:.0f} % of the beams came back")
