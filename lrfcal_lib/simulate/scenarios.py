"""Set-ups by name to compare methods on, some of them published (``scenarios.json``)."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.session.stated import BoardStated, TransformStated, from_json
from lrfcal_lib.simulate.shots import Scenario


def _placed(row):
    """The transform of a shift and a turn."""
    turn = Rotation.from_rotvec(row["turn"], degrees=True)
    return RigidTransform.from_components(row["shift"], turn)


MADE = {  # of rows that have this key
    "shift": _placed,
    "fx": lambda row: CameraModel(**row),
    "corners_m": partial(from_json, BoardStated),
    "translation_m": partial(from_json, TransformStated),
}


def load_scenario(name: str) -> Scenario:
    """A scenario of ``scenarios.json``; ValueError names those that there are."""
    if name not in FILE:
        raise ValueError(f"unknown scenario {name!r}: use one of {', '.join(FILE)}")
    return Scenario(name=name, **FILE[name])


def in_radians(row: dict) -> dict[str, Any]:
    """A row of a file with what ends in _deg in radians, and no lists.

    Parameters
    ----------
    row
    """
    turned = {}
    for key, value in row.items():
        if key.endswith("_deg"):
            value = np.radians(value).tolist()
        if isinstance(value, list):
            value = tuple(value)
        turned[key.removesuffix("_deg")] = value
    return turned


def read_json(name: str) -> dict:
    """A file of this folder: what `MADE` knows is made, other rows are as of :func:`in_radians`."""
    text = Path(__file__).with_name(name).read_text()
    return json.loads(text, object_hook=_made)


def _made(row):
    for key, make in MADE.items():
        if key in row:
            return make(row)
    return in_radians(row)


FILE = read_json("scenarios.json")


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
    changed = in_radians(VARIED[key](scenario, value))
    return replace(scenario, varied=scenario.varied | {key: value}, **changed)


def _spot(scenario, value):
    """Diameter 2 m away; it grows in proportion."""
    scale = value / 2000 / scenario.radius(2.0)
    return {"spot": tuple(scale * part for part in scenario.spot)}


VARIED = {
    "range_noise_mm": lambda scenario, value: {"sigma_range": value / 1000},
    "pixel_noise_px": lambda scenario, value: {"sigma_px": value},
    "step_deg": lambda scenario, value: {"step_deg": value},
    "spot_mm": _spot,
    "bias": lambda scenario, value: {"bias": value},  # spot radii
    "spread": lambda scenario, value: {"spread": value},  # of the bias, spot radii
    "board_scale": lambda scenario, value: {"board": _scaled(scenario.board, value)},
    "lean_deg": lambda scenario, value: {"lean_deg": value},  # at most
    # standard deviation; a degree comes with 17 mm
    "start_deg": lambda scenario, value: {"start_deg": [value, value]},
}


def _scaled(board, scale):
    """A board of another size, its pattern too."""
    pattern = board.pattern
    x, y = pattern.origin
    pattern = replace(pattern, square=scale * pattern.square, origin=(scale * x, scale * y))
    return replace(board, corners=scale * board.corners, pattern=pattern)
