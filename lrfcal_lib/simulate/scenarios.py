"""Set-ups by name to compare methods on, some of them published (``scenarios.json``)."""

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import Board, Chessboard, triangle_board
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.geometry import AHEAD
from lrfcal_lib.simulate.shots import FORWARD_X, PATTERN, Scenario

FILE = json.loads(Path(__file__).with_name("scenarios.json").read_text())


def load_scenario(name: str) -> Scenario:
    """A scenario of ``scenarios.json``; ValueError names those that there are."""
    if name not in FILE:
        raise ValueError(f"unknown scenario {name!r}: use one of {', '.join(FILE)}")
    facts = FILE[name]
    settings: dict[str, Any] = {
        "name": name,
        "model": _camera(*facts["camera"]),
        "board": _board(facts),
        "T_camera_lrf": _mount(facts),
    }
    others = {f.name for f in fields(Scenario)} - settings.keys()
    for key, value in facts.items():
        if key not in others and key.endswith("_deg"):
            key = key.removesuffix("_deg")
            value = np.radians(value).tolist()
        if key in others:
            settings[key] = tuple(value) if isinstance(value, list) else value
    return Scenario(**settings)


def varied(scenario: Scenario, key: str, value: float) -> Scenario:
    """A scenario with one thing changed, which it then tells.

    Parameters
    ----------
    scenario : Scenario
    key : str
        Of `VARIED`.
    value : float
        Positive but for the bias and its spread.

    Raises
    ------
    ValueError
        For an unknown key or a value that is not positive.
    """
    if key not in VARIED:
        known = ", ".join(VARIED)
        raise ValueError(f"nothing called {key!r} can be varied: use one of {known}")
    if not value > 0 and key not in ("bias", "spread"):
        raise ValueError(f"{key}={value:g}: a positive number is needed")
    changed = VARIED[key](scenario, value)
    return replace(scenario, varied=scenario.varied | {key: value}, **changed)


def _spot(scenario, value):
    """Diameter 2 m away; it grows in proportion."""
    scale = value / 2000 / scenario.radius(2.0)
    return {"spot": tuple(scale * part for part in scenario.spot)}


VARIED = {
    "range_noise_mm": lambda scenario, value: {"sigma_range": value / 1000},
    "pixel_noise_px": lambda scenario, value: {"sigma_px": value},
    "step_deg": lambda scenario, value: {"step": np.radians(value)},
    "spot_mm": _spot,
    "bias": lambda scenario, value: {"bias": value},  # spot radii
    "spread": lambda scenario, value: {"spread": value},  # of the bias, spot radii
    "board_scale": lambda scenario, value: {"board": _scaled(scenario.board, value)},
    "lean_deg": lambda scenario, value: {"lean": np.radians(value)},  # at most
    # standard deviation; a degree comes with 17 mm
    "start_deg": lambda scenario, value: {"start": (np.radians(value), np.radians(value))},
}


def _scaled(board, scale):
    """A board of another size, its pattern too."""
    pattern = board.pattern
    x, y = pattern.origin
    pattern = replace(pattern, square=scale * pattern.square, origin=(scale * x, scale * y))
    return replace(board, corners=scale * board.corners, pattern=pattern)


def _camera(width, height, focal, cx=None, cy=None):
    """Without distortion; the principal point in the middle where it is not told."""
    cx = width / 2 if cx is None else cx
    cy = height / 2 if cy is None else cy
    return CameraModel(width, height, focal, focal, cx, cy, np.zeros(5))


def _board(facts):
    """A triangle with short sides of two lengths, or a square with a chessboard of c x c corners
    and sides of n squares.
    """
    if "triangle" in facts:
        pattern = PATTERN
        if "pattern" in facts:
            columns, rows, square, first = facts["pattern"]
            pattern = Chessboard(columns, rows, square, (first, first))
        return triangle_board(*facts["triangle"], pattern=pattern)
    if "square" not in facts:
        return triangle_board(pattern=PATTERN)  # a corner is looked at instead
    corners, square, squares = facts["square"]
    side = squares * square
    border = (side - (corners - 1) * square) / 2
    return Board(
        "square",
        ("ab", "bc", "cd", "da"),
        side * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        Chessboard(corners, corners, square, (border, border)),
    )


def _mount(facts):
    """``T_camera_lrf`` as published, in our frames, or None."""
    if "T_lrf_camera" in facts:  # Zhang and Pless: scan plane y = 0, z ahead, y down
        stated = facts["T_lrf_camera"]
        T_zhang_camera = RigidTransform.from_components(
            stated["zhang_shift"], Rotation.from_rotvec(stated["zhang_rotvec"])
        )
        return T_zhang_camera.inv() * RigidTransform.from_rotation(AHEAD)
    if "T_camera_lrf" in facts:
        stated = facts["T_camera_lrf"]
        turn = Rotation.from_euler("XYZ", stated["turn_deg"], degrees=True)
        rotation = turn * Rotation.from_matrix(FORWARD_X)
        return RigidTransform.from_components(stated["shift"], rotation)
    return None
