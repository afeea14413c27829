"""The one simulated world that all emulated devices look at: the room, the board where it was put, the moving head."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.drivers.emulators.motion import Head
from lrfcal_lib.session import board_to_json, model_to_json, transform_to_json
from lrfcal_lib.simulate import beam as lrf
from lrfcal_lib.simulate.record import VIEWS, world_of
from lrfcal_lib.simulate.rig import held_close, placements_of, random, room_placement

DAZZLED, NOT_VALID, WEAK = 2, 1, 4  # index into lms2xx.REASONS
STILL = 1e-7  # radians within which a scan at rest is cast once


@dataclass(frozen=True, eq=False)
class Place:
    """Where the board is.

    Attributes
    ----------
    key : tuple
        Tells places apart.
    T_platform_board : RigidTransform or None
        None where there is no board but a table with things.
    stand : bool
        On its stand, or held by nothing close to a camera.
    """

    key: tuple
    T_platform_board: RigidTransform | None = None
    stand: bool = True

    def __eq__(self, other):
        return isinstance(other, Place) and self.key == other.key

    def __hash__(self):
        return hash(self.key)


class EmulatedWorld:
    """The world of a simulated setup at the present; the source of the scans of :class:`EmulatedLms`.

    Parameters
    ----------
    setup : Setup
    clock : Clock
    seed : int
    placements : sequence of Placement, optional
        Where the board can be put; those of the setup by default, with the sweep of the room last.

    Attributes
    ----------
    head : Head
    place : Place
    placements : dict of int to Placement
    """

    def __init__(self, setup, clock, seed=0, placements=None):
        self.setup, self.clock = setup, clock
        if placements is None:
            bare = room_placement(setup)
            placements = [*placements_of(setup), *([] if bare is None else [bare])]
        self.placements = {p.number: p for p in placements}
        self.head = Head(setup.rig.platform, seed)
        self._rng, self._still, self._close = np.random.default_rng([seed, 3]), (None, None), {}
        self.put(None)

    def put(self, number):
        """Put the board at a placement; None takes it away.

        Raises
        ------
        ValueError
            For a placement that the setup does not have.
        """
        if number is not None and number not in self.placements:
            known = ", ".join(map(str, self.placements))
            raise ValueError(f"no placement {number}; there are {known}, and none")
        pose = None if number is None else self.placements[number].T_platform_board
        self._set(Place(("placement", number), pose))

    def hold_close(self, camera, view):
        """Hold the board close to a camera, in one of the views for its intrinsics, counted from 0.

        Raises
        ------
        ValueError
            For a camera or a view that the setup does not have.
        """
        names, count = [c.name for c in self.setup.rig.cameras], self.setup.intrinsics_views
        if camera not in names or not 0 <= view < count:
            raise ValueError(f"no view {view} of camera '{camera}'; there are 0 to {count - 1} of {', '.join(names)}")
        if camera not in self._close:
            self._close[camera] = self._views(names.index(camera))
        self._set(Place(("close", camera, view), self._close[camera][view], stand=False))

    def _views(self, number):
        """Poses of the board close to a camera while the head is at pitch 0, as the simulator takes them."""
        rig, count = self.setup.rig, self.setup.intrinsics_views
        poses = held_close(rig, rig.cameras[number], count, random(self.setup, VIEWS, number))
        still = rig.camera_pose(rig.cameras[number], 0.0)
        return [still.inv() * pose for pose in poses]

    def _set(self, place):
        self._scene = place, world_of(self.setup, place.T_platform_board, stand=place.stand)

    @property
    def place(self):
        """Where the board is."""
        return self._scene[0]

    def scan(self, turn, quarters, times):
        """Readings of the laser range finder; see :meth:`SyntheticSource.scan`."""
        rig, pitch = self.setup.rig, np.broadcast_to(self.head.pitch(times), times.shape)
        reading, total, dazzled = self._readings(np.radians(quarters / 4), pitch)
        ranges = reading + rig.beam.systematic + rig.beam.sigma_range * self._rng.standard_normal(len(reading))
        reasons = np.where(np.isfinite(reading), 0, np.where(total > 0, WEAK, NOT_VALID))
        ends = pitch[[np.argmin(times), np.argmax(times)]]
        return np.clip(ranges, 0, None), np.where(dazzled, DAZZLED, reasons), ends

    def _readings(self, bearings, pitch):
        """Readings without noise; a head at rest sees the same again and again."""
        (place, world), rig = self._scene, self.setup.rig
        key = place.key, len(bearings), bearings[0], round(float(pitch[0]) / STILL)
        if np.ptp(pitch) < STILL and self._still[0] == key:
            return self._still[1]
        found = lrf.ideal_readings(rig.beam, world, bearings, pitch, rig.T_head_lrf)
        if np.ptp(pitch) < STILL:
            self._still = key, found
        return found

    def view(self):
        """Place and true pitch that a camera would see now; None while the head moves."""
        now = self.clock.now()
        return (self.place, float(self.head.pitch(now))) if self.head.settled(now) else None

    def truth(self):
        """What only the simulator knows, as JSON."""
        rig, place = self.setup.rig, self.place
        boards = {n: transform_to_json(p.T_platform_board) for n, p in self.placements.items()}
        return {
            "setup": self.setup.name,
            "T_head_lrf": transform_to_json(rig.T_head_lrf),
            "cameras": {c.name: _camera_truth(c) for c in rig.cameras},
            "board": board_to_json(rig.board),
            "boards": boards,
            "place": list(place.key),
            "pitch_deg": math.degrees(float(self.head.pitch(self.clock.now()))),
        }


def _camera_truth(camera):
    key = "T_camera_lrf" if camera.mount == "head" else "T_camera_platform"
    return {key: transform_to_json(camera.mounting), "intrinsics": model_to_json(camera.model)}
