"""Emulated rigs for practice: one by its name, ready to be recorded with; the smallest takes seconds a placement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lrfcal_lib.drivers.emulators.camera import scaled
from lrfcal_lib.drivers.emulators.rig import EmulatedRig
from lrfcal_lib.drivers.rig import host_clock
from lrfcal_lib.session import model_to_json
from lrfcal_lib.simulate.rig import PLACES, SETUPS, pairs, random, sim_quick

PRACTICE = "practice"
NAMES = (PRACTICE, *SETUPS)
SMALL = 400  # pixels of an image's width: its chessboard is still found at 2 m
FAST = 2.0  # times as fast as real devices
MARGIN = np.radians(1.0)  # of a sweep beyond the board


def practice_setup():
    """A rig and placements that are recorded in a minute: coarse sweeps, small images, intrinsics stated.

    Returns
    -------
    setup : Setup
    placements : list of Placement
    """
    rig = scaled(sim_quick().rig, SMALL)
    rig = replace(rig, cameras=tuple(replace(c, exposure=replace(c.exposure, samples=2)) for c in rig.cameras))
    setup = replace(sim_quick(), name=PRACTICE, rig=rig, pairs=3, distances=(1.3, 1.7), step=np.radians(1.0),
                    intrinsics_views=0, room_sweep=(), room_images=())  # fmt: skip
    found = pairs(setup.rig, setup.pairs, setup.distances, random(setup, PLACES), MARGIN)
    return setup, [replace(p, image_pitch=(p.image_pitch[0], p.image_pitch[-1])) for p in found]


def emulated(name):
    """An emulated rig that is not started yet, what recording needs to know of it, and the host clock of its devices.

    Parameters
    ----------
    name : str
        Of :data:`NAMES`. 'practice' runs twice as fast as real devices, the others as slow.

    Returns
    -------
    rig : EmulatedRig
    data : callable
        Gives the rig file, parsed, once the rig is started.
    clock : callable
        For :meth:`lrfcal_lib.drivers.rig.Rig.open`.

    Raises
    ------
    ValueError
        For another name.
    """
    clock = host_clock()
    if name != PRACTICE:
        rig = EmulatedRig(name)
        return rig, rig.rig_file, clock
    begun, (setup, placements) = clock(), practice_setup()
    rig = EmulatedRig(setup, placements=placements, time_scale=FAST, platform={"settle": 0.0},
                      head_options={"baudrate": 38400, "go_speed": 60.0})  # fmt: skip
    return rig, lambda: _quick(rig), lambda: begun + FAST * (clock() - begun)


def _quick(rig):
    """The rig file of the practice rig: its head is quick and told to be, its cameras are known."""
    data = rig.rig_file()
    data["devices"]["head"] |= {"settle_s": 0.05, "poll_s": 0.01, "gap_s": 0.005}
    for camera in rig.setup.rig.cameras:
        data["rig"]["cameras"][camera.name]["intrinsics"] = model_to_json(camera.model)
    return data
