"""The simulated rig, the set-ups by name (``setups.json``), and where the board is put."""

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import pydantic
from numpy.typing import ArrayLike
from pydantic import (
    Field,
    InstanceOf,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
)
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import Board, triangle_board
from lrfcal_lib.model.camera import CameraModel, project
from lrfcal_lib.model.geometry import AHEAD, apply_pose, carry, pose_array
from lrfcal_lib.model.kinematics import beams_to, camera_at
from lrfcal_lib.session.stated import (
    CameraInfo,
)
from lrfcal_lib.simulate.beam import LMS221, Beam
from lrfcal_lib.simulate.scenarios import read_json
from lrfcal_lib.simulate.scene import Exposure, Imager, need
from lrfcal_lib.simulate.shots import PATTERN

MOST_TRIES = 4000
PITCH_GRID = np.radians(
    np.arange(-30.0, 30.1, 0.5)
)  # pitch angles at which an image may be taken
LEAST_SPAN = np.radians(4.0)  # of the pitch angles at which all cameras see the board
CLOSE = -1  # number of a placement that is held close to a camera,
NEAR = (0.22, 0.45)  # so many metres away
PLACES = 3  # stream of random numbers


@pydantic.dataclasses.dataclass(frozen=True)
class Platform:
    """A pitching platform that lies a little about its pitch.

    ValueError for impossible settings.
    """

    # play of the gear, radians: the head hangs back by half of it against the direction of motion
    backlash: NonNegativeFloat = 0.0
    stretch: Annotated[float, Field(gt=-0.5, lt=0.5)] = (
        0.0  # the head turns 1 + stretch times as far as the platform says
    )
    # seconds by which the measured pitch is older than its time stamp
    latency: NonNegativeFloat = 0.0
    # standard deviation of where the head comes to rest about where it should, radians
    noise: NonNegativeFloat = 0.0
    encoder_step: NonNegativeFloat = 0.0  # of the measured pitch, radians; 0 for none
    speed: PositiveFloat = math.radians(5.0)  # of continuous motion, radians a second
    settle: NonNegativeFloat = 0.4  # seconds from a command to rest in stop-and-go
    # least and greatest pitch, radians
    limits: tuple[float, float] = (-math.radians(60), math.radians(60))

    def stop(
        self, commanded: np.ndarray, direction: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Where the head comes to rest.

        The encoder sits on the motor: it sees neither backlash nor stretch.

        Parameters
        ----------
        commanded
            Pitch, radians, shape (n,).
        direction
            From below (+1) or from above (-1).
        rng

        Returns
        -------
        true, measured : ndarray, shape (n,)
            Pitch, radians.

        Raises
        ------
        ValueError
            For angles beyond the limits.
        """
        angles = np.degrees(commanded)
        low, high = np.degrees(self.limits)
        first = angles.min(initial=0.0)
        last = angles.max(initial=0.0)
        need(
            low <= first and last <= high,
            f"platform: pitch {first:.2f} to {last:.2f} deg is asked for, it turns {low:.2f} to "
            f"{high:.2f} deg",
        )
        motor = rng.normal(commanded, self.noise)
        head = (1 + self.stretch) * motor - direction * self.backlash / 2
        return head, self.encoded(motor)

    def encoded(self, motor: np.ndarray) -> np.ndarray:
        """What the encoder says of angles of the motor, radians."""
        step = self.encoder_step
        return np.rint(motor / step) * step if step else motor


@dataclass(frozen=True, kw_only=True)
class RigCamera(Imager):
    """A camera on the head of the rig."""

    name: str
    mounting: RigidTransform  # T_camera_lrf
    guess: RigidTransform  # the same as a tape measure gives it


@dataclass(frozen=True)
class Rig:
    """Everything that stays the same over a recording."""

    beam: Beam
    platform: Platform
    # the truth, and as a tape measure gives it
    T_head_lrf: RigidTransform
    T_head_lrf_stated: RigidTransform
    cameras: tuple[RigCamera, ...]
    board: Board  # with corners

    def camera_pose(self, camera: RigCamera, pitch: ArrayLike) -> RigidTransform:
        """``T_camera_platform`` of a camera.

        Parameters
        ----------
        camera
        pitch
            True one of the head, or many, radians.
        """
        return camera_at(camera.mounting, "head", self.T_head_lrf, pitch)

    def camera_infos(self, known: bool = False) -> dict[str, CameraInfo]:
        """What a session states of the cameras, by name; the intrinsics where they are known."""
        return {
            c.name: CameraInfo(
                c.name,
                "head",
                c.model.width,
                c.model.height,
                c.model if known else None,
                c.guess,
            )
            for c in self.cameras
        }


def shows(model, T_camera_board, points, margin):
    """Whether a camera sees points of a board well inside the image: by a margin, pixels.

    For a pose, or each of a stack of poses.
    """
    p = apply_pose(pose_array(T_camera_board), points)
    # within 45 deg of the axis, and no nearer than 0.1 m
    ahead = p[..., 2] >= np.abs(p[..., :2]).max(axis=-1, initial=0.1)
    return np.all(ahead & model.shows(project(p, model), margin), axis=-1)


@pydantic.dataclasses.dataclass(frozen=True)
class Setup:
    """A recording to simulate; everything follows from it."""

    name: str
    seed: int
    rig: InstanceOf[Rig]
    pairs: NonNegativeInt  # pairs of board placements; none in a recording of the room only
    distances: tuple[float, float]  # of the board, metres
    step: PositiveFloat  # between the stops of a sweep, radians
    margin: PositiveFloat  # of a sweep beyond the board, radians
    intrinsics_views: NonNegativeInt  # images of the board held close, a camera
    # first pitch, last pitch and step of the sweep of the room, radians; empty for none
    room_sweep: tuple[()] | tuple[float, float, float]
    room_images: tuple[float, ...]  # pitch angles of the images of the room, radians
    # T_room_platform of each sweep of the room; empty for one sweep from where the boards are seen
    stations: tuple[InstanceOf[RigidTransform], ...]
    quality: Annotated[int, Field(ge=1, le=100)]  # of JPEG


def printed_triangle() -> Board:
    """The paper's triangle (315 and 380 mm, a right angle) with 4 x 5 inner corners beside it."""
    return triangle_board(name="triangle_315_380", pattern=PATTERN)


SETUPS = read_json("setups.json")


def load_setup(name: str) -> Setup:
    """A set-up of ``setups.json``; what it does not say is taken from the one that it is like.

    Parameters
    ----------
    name

    Raises
    ------
    ValueError
        For a name that is not there.
    """
    need(name in SETUPS, f"no set-up '{name}'; there are {', '.join(SETUPS)}")
    row = SETUPS[SETUPS[name].get("like", name)] | SETUPS[name]
    rig = Rig(
        beam=replace(LMS221, **row["beam"]),
        platform=Platform(**row["platform"]),
        T_head_lrf=row["head"],
        T_head_lrf_stated=row["head_stated"],
        cameras=tuple(
            _camera(key, camera, row["image_width"], row["exposure"])
            for key, camera in row["cameras"].items()
        ),
        board=printed_triangle(),
    )
    # what else is in the row the Setup ignores
    return Setup(**row | {"name": name, "rig": rig})


def _camera(name, row, width, exposure):
    """A camera with images so many pixels wide, and settings of the exposure of all cameras."""
    scale = width / row["size"][0]
    turn = Rotation.from_rotvec(row["turn"], degrees=True) * AHEAD
    mounting = carry(turn, row["centre"])
    off = Rotation.from_rotvec(row["guess_turn"], degrees=True)
    shift = mounting.translation + row["guess_shift"]
    guess = RigidTransform.from_components(shift, off * mounting.rotation)
    size = [round(v * scale) for v in row["size"]]
    pinhole = [v * scale for v in row["pinhole"]]
    model = CameraModel(*size, *pinhole, np.array(row["distortion"]))
    light = Exposure(**exposure | row["exposure"])
    return RigCamera(model, light, name=name, mounting=mounting, guess=guess)


@dataclass(frozen=True)
class Placement:
    """The board at one place, and what is recorded of it."""

    number: int  # CLOSE for a board that is held before a camera
    # None for a sweep of the room, with a laid table near the rig
    T_platform_board: RigidTransform | None = None
    # pitch commands of the first and the last scan line, and the step between lines, radians
    sweep: tuple[float, float, float] = (0.0, 0.0, 1.0)
    # pitch commands of the images in the order in which they are taken, radians
    image_pitch: tuple[float, ...] = (0.0,)
    T_room_platform: RigidTransform | None = None  # of a station; room is room.json's frame

    @property
    def purpose(self) -> str:
        """What its images are for, as a session names it."""
        if self.number == CLOSE:
            return "intrinsics"
        return "scene" if self.T_platform_board is None else "board"


def random(setup: Setup, *key: int) -> np.random.Generator:
    """Random numbers that depend on a setup's seed and a key, whatever else is simulated."""
    return np.random.default_rng([setup.seed, *key])


def placements_of(setup: Setup) -> list[Placement]:
    """The placements of a setup: those of the board, then the sweeps of the room if there are any.

    Parameters
    ----------
    setup
    """
    out = []
    if setup.pairs:
        out = pairs(
            setup.rig,
            setup.pairs,
            setup.distances,
            random(setup, PLACES),
            setup.margin,
            setup.step,
        )
    if setup.room_sweep:
        for station in setup.stations or (None,):
            number = len(out) + 1
            out.append(
                Placement(number, None, setup.room_sweep, setup.room_images, station)
            )
    return out


def pairs(
    rig: Rig,
    count: int,
    distances: tuple[float, float],
    rng: np.random.Generator,
    margin: float,
    step: float,
) -> list[Placement]:
    """Placements in pairs: at one place, turned by about a right angle and tilted otherwise.

    Placements are numbered from 1. The first of each pair has images at three pitch angles, the
    second at one. Sweeps go upwards at odd placements and downwards at even ones.

    Parameters
    ----------
    rig
    count
        Of pairs.
    distances
        Least and greatest of the boards from the platform, metres.
    rng
    margin
        By which a sweep begins and ends outside of the board, radians.
    step
        Between the stops of a sweep, radians.

    Raises
    ------
    ValueError
        If the board does not fit into a view, or no place is found that everything sees.
    """
    need(
        count >= 1 and 0.3 <= distances[0] <= distances[1],
        f"{count} pairs at {distances} m: at least one pair, at 0.3 m or more, is needed",
    )
    out = []
    for distance in rng.permutation(np.linspace(*distances, count)):
        for _ in range(MOST_TRIES):
            both = _pair(rig, len(out) + 1, distance, rng, margin, step)
            if all(both):
                break
        else:
            raise ValueError(
                f"no place at {distance:.2f} m where the LRF and all cameras see board "
                f"'{rig.board.name}'"
            )
        out += both
    return out


def _pair(rig, first, distance, rng, margin, step):
    """Two placements about one middle, by the number of the first; boards face the rig up to 35
    deg.
    """
    azimuth = np.radians(rng.uniform(-24, 24))
    height = rng.uniform(-0.22, 0.28) * distance / 1.6
    middle = np.array([distance * np.sin(azimuth), distance * np.cos(azimuth), height])
    angles = rng.uniform([-35, -28, -12], [35, 28, 12], (2, 3))
    # which way the right angle points: up, left, down, right; then a right angle on
    angles[:, 2] += 90 * (first // 2 % 4) + np.array([-135.0, -45.0])
    leant = Rotation.from_euler("YXZ", angles, degrees=True)
    turned = Rotation.from_euler("z", -azimuth) * AHEAD * leant
    centre = rig.board.points().mean(axis=0)
    return [
        _placement(rig, number, carry(rotation, centre, middle), margin, step)
        for number, rotation in enumerate(turned, first)
    ]


def _placement(rig, number, pose, margin, step):
    """A Placement swept over the whole board, with images where all cameras see it.

    None where that is too little.
    """
    points = rig.board.points()
    shown = [
        shows(camera.model, rig.camera_pose(camera, PITCH_GRID) * pose, points, margin=12.0)
        for camera in rig.cameras
    ]
    seen = PITCH_GRID[np.all(shown, axis=0)]
    bearing, pitch, _ = beams_to(pose.apply(points), rig.T_head_lrf)
    reach = np.radians(rig.beam.field_of_view / 2) - 2 * margin
    outside = np.abs(bearing - np.pi / 2).max() >= reach
    if outside or len(seen) < 2 or np.ptp(seen) <= LEAST_SPAN:
        return None
    sweep = (pitch.min() - margin, pitch.max() + margin)
    shares = [-1.0, 0.0, 1.0]
    if number % 2 == 0:
        sweep = sweep[::-1]
        shares = [0.0]
    half = min(np.ptp(seen) * 0.4, np.radians(9.0))
    angles = np.degrees(np.mean(seen[[0, -1]]) + half * np.array(shares))
    return Placement(number, pose, (*sweep, step), tuple(np.radians(np.round(angles, 2))))


def held_close(
    rig: Rig, camera: RigCamera, count: int, rng: np.random.Generator
) -> list[RigidTransform]:
    """Poses of the board held in front of a camera, tilted every way.

    Parameters
    ----------
    rig
    camera
    count
    rng

    Returns
    -------
    list of RigidTransform
        ``T_camera_board``: the whole pattern is inside the image, spread over all of it by the
        poses together.

    Raises
    ------
    ValueError
        If it does not fit.
    """
    m = camera.model
    points = rig.board.pattern.points()
    columns = math.ceil(math.sqrt(count * 4 / 3)) or 1
    rows = math.ceil(count / columns)
    to_camera = Rotation.from_euler("x", 180, degrees=True)
    out = []
    for i in range(count):
        row, column = divmod(i, columns)
        pixel = (np.array([column, row]) + 0.5) / [columns, rows] * m.size
        # towards the middle of the image first, then away from the camera
        for tried in np.arange(2 * MOST_TRIES) / MOST_TRIES:
            inwards = (m.size / 2 - pixel) * min(tried, 1.0)
            shown = rng.normal(pixel + inwards, 15)
            z = rng.uniform(*NEAR) * max(tried, 1.0)
            angles = rng.uniform([-42, -42, -180], [42, 42, 180])
            turn = to_camera * Rotation.from_euler("YXZ", angles, degrees=True)
            place = z * m.sights(shown)
            pose = carry(turn, points.mean(axis=0), place)
            if shows(m, pose, points, margin=18.0):
                out.append(pose)
                break
        else:
            raise ValueError(f"the pattern does not fit into the image of '{camera.name}'")
    return out
