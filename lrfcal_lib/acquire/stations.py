"""Scenes recorded from one or more stations, for a rig that is calibrated: ``record --scene``."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from lrfcal_lib.acquire.checks import Light, check_scene
from lrfcal_lib.acquire.record import Boards
from lrfcal_lib.calibrate.calibration_file import require_same_rig
from lrfcal_lib.calibrate.cloud import join
from lrfcal_lib.calibrate.clouds import station_of
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.drivers.rig_file import ListedPlacement, Placement, RigFile
from lrfcal_lib.measure.planning import plan_images
from lrfcal_lib.measure.scene import colored_blocks
from lrfcal_lib.preprocess.closing_scan import closing_of
from lrfcal_lib.session.read import Session

EXPECTED = 0.8  # of the share that the plan says will get a colour


class Stations(Boards):
    """Recording stations instead of the placements of the plan.

    Parameters
    ----------
    count
        How many.
    rig
        What is known of the rig; without, images are taken where the plan says.
    """

    kind = "station"

    def __init__(self, count: int, rig: CalibratedRig | None = None):
        self.count = count
        self.rig = rig
        self.share = 0.0  # of the cloud that the planned images color
        self._listed: tuple[int, ...] = ()

    def planned(self, stated: RigFile) -> RigFile:
        """The rig file with a plan of the stations; says how much will get a colour.

        Sweep and numbers are those of the scenes that the plan lists, as far as there are any.
        """
        plan = stated.plan
        numbers = [p.number for p in plan.to_do() if p.purpose == "scene"][: self.count]
        self._listed = tuple(numbers)
        scenes = (entry for entry in plan.placements if not entry.board)
        scene = next(scenes, ListedPlacement())
        sweep = scene.pitch_deg or plan.pitch_deg
        images = scene.image_pitch_deg or plan.image_pitch_deg
        if self.rig is not None:
            # what its range finder is set to shows once it is open
            known: Any = SimpleNamespace(
                name=stated.path, cameras=stated.cameras, lrf=self.rig.lrf
            )
            require_same_rig(self.rig, known)
            images = self._images(sweep, stated.devices.head.pitch_limits_deg)
        while len(numbers) < self.count:
            numbers.append(max(numbers, default=0) + 1)
        placements = tuple(
            ListedPlacement(
                number=number,
                pitch_deg=sweep,
                image_pitch_deg=images,
                board=False,
                closing=True,
            )
            for number in numbers
        )
        plan = plan.model_copy(update={"placements": placements, "intrinsics_images": 0})
        return replace(stated, plan=plan)

    def _images(self, sweep, limits):
        """Pitch angles of the images, degrees; prints them."""
        pitch, share = plan_images(self.rig, np.radians(sweep[:2]), np.radians(limits))
        self.share = share
        images = tuple(np.degrees(pitch).round(2).tolist())
        where = ", ".join(f"{angle:g}" for angle in images)
        print(f"images at {where} deg: {100 * share:.0f} % of the cloud can get a colour")
        return images

    def place_of(self, placement: Placement) -> int | str:
        """As of :class:`Boards`; an emulated rig goes where its plan puts the station."""
        return placement.number if placement.number in self._listed else "none"

    def to_prepare(self, placement: Placement) -> str:
        """As of :class:`Boards`."""
        return "set the rig up, so that nobody moves it or walks by"

    def check(self, session: Session, number: int) -> list[Light]:
        """How good a station is: share of returns, share with a colour, whether it moved."""
        sweep = session.sweep(number)
        lights = [check_scene(sweep)]
        if self.rig is not None:
            require_same_rig(self.rig, session)
            station = station_of(session, self.rig, number)
            seen = join(colored_blocks(session, self.rig, *station)).seen
            share = seen.sum() / max(1, len(seen))
            light = Light(
                name="colour",
                state="ok" if share > EXPECTED * self.share else "warn",
                text=f"{100 * share:.0f} % of the points, {100 * self.share:.0f} % planned",
            )
            lights.append(light)
        return [*lights, _still(sweep)]


def _still(sweep):
    """The Light of whether a station stood still."""
    closing = closing_of(sweep)
    if closing is None:
        return Light("stood still", "warn", "not known: too little came back to compare")
    if closing.moved:
        return Light("stood still", "bad", f"{closing}: it moved, record it again")
    return Light("stood still", "ok", str(closing))
