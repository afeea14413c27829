"""The rigs and recordings that can be simulated by name."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.board import Chessboard, triangle_board
from lrfcal_lib.camera import CameraModel
from lrfcal_lib.simulate.beam import LMS221
from lrfcal_lib.simulate.platform import Platform
from lrfcal_lib.simulate.render import Exposure
from lrfcal_lib.simulate.rig import Rig, RigCamera, camera_mounting, disturbed


@dataclass(frozen=True)
class Setup:
    """A recording to simulate; everything follows from it.

    Attributes
    ----------
    name : str
    seed : int
    rig : Rig
    pairs : int
        Pairs of board placements.
    distances : tuple of float
        Of the board, metres.
    step : float
        Between the stops of a sweep, radians.
    intrinsics_views : int
        Images of the board held close, a camera.
    room_sweep : tuple of float
        First pitch, last pitch and step of the sweep of the room, radians; empty for none.
    room_images : tuple of float
        Pitch angles of the images of the room, radians.
    quality : int
        Of JPEG, 1 to 100.
    """

    name: str
    seed: int
    rig: Rig
    pairs: int
    distances: tuple[float, float]
    step: float = math.radians(0.25)
    intrinsics_views: int = 20
    room_sweep: tuple[float, ...] = ()
    room_images: tuple[float, ...] = ()
    quality: int = 95

    def __post_init__(self):
        if not self.step > 0:
            raise ValueError(f"setup '{self.name}': the pitch step is {self.step} rad, it must be positive")
        if not 1 <= self.quality <= 100:
            raise ValueError(f"setup '{self.name}': JPEG quality is 1 to 100, got {self.quality}")
        if self.intrinsics_views < 0:
            raise ValueError(f"setup '{self.name}': {self.intrinsics_views} intrinsics views; 0 or more are possible")
        if len(self.room_sweep) not in (0, 3):
            raise ValueError(f"setup '{self.name}': room_sweep is (first, last, step) or empty, got {self.room_sweep}")


def printed_triangle(square=0.029, border=0.020, ring=0.65):
    """The paper's triangle (315 and 380 mm at an exact right angle) with 4 x 5 inner corners beside the right angle."""
    origin = border + ring * square
    return triangle_board(name="triangle_315_380", pattern=Chessboard(4, 5, square, (origin, origin)))


def outdoor_rig(width=1024, height=768):
    """An outdoor LMS221 set to 100/0.25 and millimetres, a YA3050-like platform, two cameras on the head.

    Parameters
    ----------
    width, height : int
        Of the images; the field of view stays (51 x 39 deg).
    """
    head = RigidTransform.from_components([0.0, 0.014, 0.061], Rotation.from_rotvec([0.35, 0.9, -1.2], degrees=True))
    cameras = (_left(width, height), _right(width, height))
    beam = LMS221.with_settings(field_of_view=100, resolution=25, systematic=0.005)
    platform = Platform(
        backlash=math.radians(0.08), stretch=0.003, latency=0.06, noise=math.radians(0.004),
        encoder_step=math.radians(0.01), speed=math.radians(4.0), settle=0.4,
        limits=(-math.radians(60), math.radians(45)),
    )  # fmt: skip
    stated = RigidTransform.from_translation([0.0, 0.0, 0.05])
    return Rig(beam, platform, head, stated, cameras, printed_triangle())


def _left(width, height):
    scale, mounting = width / 1024, camera_mounting([-0.121, 0.034, 0.118], [-2.1, 1.6, 0.7])
    lens = np.array([-0.213, 0.094, 0.0006, -0.0004, 0.0])
    model = CameraModel(width, height, 1073.4 * scale, 1071.9 * scale, 517.3 * scale, 379.1 * scale, lens)
    return RigCamera("left", model, mounting, disturbed(mounting, [1.7, -2.2, 1.1], [0.012, -0.009, 0.015]))


def _right(width, height):
    scale, mounting = width / 1024, camera_mounting([0.118, 0.031, 0.121], [-1.8, -1.9, -0.4])
    lens = np.array([-0.207, 0.088, -0.0005, 0.0007, 0.0])
    model = CameraModel(width, height, 1081.6 * scale, 1080.5 * scale, 506.2 * scale, 388.4 * scale, lens)
    guess = disturbed(mounting, [-1.5, 1.4, 2.0], [-0.014, 0.011, 0.008])
    return RigCamera("right", model, mounting, guess, exposure=Exposure(bright=225.0))


def sim_lms221():
    """The session that ships: 12 pairs of placements from 1.2 to 3 m, images of 1024 x 768 pixels."""
    return Setup(
        "sim_lms221", 20091001, outdoor_rig(), 12, (1.25, 2.95),
        room_sweep=(math.radians(-38), math.radians(24), math.radians(0.25)),
        room_images=tuple(np.radians([-24.0, -16.0, -8.0, 0.0, 8.0, 16.0])),
    )  # fmt: skip


def sim_quick():
    """A small one for tests: 2 pairs from 1.3 to 2 m, images of 640 x 480 pixels."""
    full = sim_lms221()
    return replace(
        full, name="sim_quick", seed=20091002, rig=outdoor_rig(640, 480), pairs=2, distances=(1.3, 2.0),
        intrinsics_views=12, room_sweep=(math.radians(-30), math.radians(12), math.radians(0.5)),
        room_images=tuple(np.radians([-14.0, 0.0])), quality=90,
    )  # fmt: skip


SETUPS = {"sim_lms221": sim_lms221, "sim_quick": sim_quick}
