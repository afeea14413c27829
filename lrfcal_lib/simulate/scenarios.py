"""Set-ups by name to compare methods on, some of them published (``scenarios.json``)."""

import json
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.fit.edge_likelihood import LEAST_STEP
from lrfcal_lib.model.board import Board, Chessboard, triangle_board
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.geometry import AHEAD
from lrfcal_lib.simulate.corner import corner_shots
from lrfcal_lib.simulate.draw import ShotSetup

FORWARD_X = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]  # camera from an LRF that looks along x
FACING = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))  # camera from a board before it
TARGET = Rotation.from_euler("ZY", [45, 45], degrees=True)  # world from the board, 'around'
# as in `triangle_board` of shots: 23 corners or so, away from the edges
PATTERN = Chessboard(4, 5, 0.029, (0.03885, 0.03885))


@dataclass(frozen=True, kw_only=True)
class Scenario(ShotSetup):
    """What the single shots of a study are drawn from; see also
    :class:`lrfcal_lib.simulate.draw.ShotSetup`.
    """

    name: str = "own"
    varied: dict[str, float] = field(
        default_factory=dict
    )  # settings that differ from its file
    about: str = ""
    softness: float = 0.1
    floor: float = LEAST_STEP
    # standard deviations of what iterative methods start with, radians and metres
    start: tuple[float, float] = (0.05, 0.05)
    # what the joint estimate does not know of the sensor; published simulations know it all
    sensor: tuple[str, ...] = ("range_offset", "edge_log_odds", "edge_log_softness")
    T_camera_lrf: RigidTransform | None = (
        None  # drawn anew for every trial where it is None
    )
    roll: float = 0.0  # of the scan plane about the viewing direction, radians
    poses: str = "ahead"  # of the boards: ahead, tilted or around
    tilt: float = 0.0  # of boards from the image plane, radians ('tilted')
    least_angle: float = 0.0  # between the LRF's place and the target's planes ('around')
    extra: tuple[float, float, float] = (0.0, 0.0, 0.0)  # turns about z, x, y ('around')
    corner_edges: int = 0  # seen of a corner of two plates, which takes the place of boards

    def rigs(self, rng, trials):
        """True poses ``T_camera_lrf``, one a trial."""
        if self.T_camera_lrf is None:
            roll = Rotation.from_rotvec([0.0, 0.0, self.roll])
            return RigidTransform.from_rotation(roll) * super().rigs(rng, trials)
        matrix = np.broadcast_to(self.T_camera_lrf.as_matrix(), (trials, 4, 4))
        return RigidTransform.from_matrix(matrix)

    def boards(self, rng, T_camera_lrf):
        """Poses ``T_lrf_board``, one for each rig."""
        if self.poses == "tilted":
            return T_camera_lrf.inv() * self._tilted(rng, len(T_camera_lrf))
        if self.poses == "around":
            T_world_lrf = self._around(rng, len(T_camera_lrf))
            if self.corner_edges:
                return T_world_lrf.inv()
            centred = RigidTransform.from_translation(-self._middle())
            return T_world_lrf.inv() * RigidTransform.from_rotation(TARGET) * centred
        return super().boards(rng, T_camera_lrf)

    def _middle(self):
        return np.append(self.board.corners.mean(axis=0), 0.0)

    def _tilted(self, rng, count):
        """Poses ``T_camera_board`` of boards parallel to the image but for a turn about a random
        axis in the board, anywhere in the image.
        """
        angle = rng.uniform(0, 2 * np.pi, count)
        axis = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
        rotation = Rotation.from_rotvec(self.tilt * axis) * FACING
        away = rng.uniform(*self.distances, count)
        pixels = rng.uniform(0, [self.model.width, self.model.height], (count, 2))
        ray = np.column_stack([pixels, np.ones(count)]) @ np.linalg.inv(self.model.matrix).T
        centre = away[:, None] * ray
        return RigidTransform.from_components(
            centre - rotation.apply(self._middle()), rotation
        )

    def shots(self, rng, T_camera_lrf):
        """One of each rig, see :meth:`lrfcal_lib.simulate.draw.ShotSetup.shots`."""
        if self.corner_edges:
            return corner_shots(self, rng, T_camera_lrf)
        return super().shots(rng, T_camera_lrf)

    def _around(self, rng, count):
        """Poses ``T_world_lrf`` of an LRF that looks at the origin but for turns."""
        direction = np.zeros((count, 3))
        open_ = np.ones(count, bool)
        while open_.any():
            v = rng.uniform(0, 1, (open_.sum(), 3))
            direction[open_] = v / np.linalg.norm(v, axis=1, keepdims=True)
            open_ = direction.min(axis=1) < np.sin(self.least_angle)
        z = -direction
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        looking = np.stack([x, np.cross(z, x), z], axis=-1)
        turns = rng.uniform(-1, 1, (count, 3)) * self.extra
        turned = Rotation.from_matrix(looking) * Rotation.from_euler("ZXY", turns)
        away = rng.uniform(*self.distances, (count, 1))
        return RigidTransform.from_components(
            away * direction, turned * Rotation.from_matrix(FORWARD_X)
        )


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
