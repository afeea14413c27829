"""Does a calibration still hold? What a new recording of any scene says, as numbers and words."""

from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise

import numpy as np
from scipy.interpolate import interp1d

from lrfcal_lib.calibrate.calibration_file import require_same_rig
from lrfcal_lib.calibrate.cloud import Cloud, join
from lrfcal_lib.calibrate.clouds import station_of, sweep_blocks
from lrfcal_lib.calibrate.painting import View
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.judge.uncertainty import chain_of
from lrfcal_lib.measure.creases import creases_of, sights
from lrfcal_lib.measure.features import flatness, largest_plane, moved_along
from lrfcal_lib.measure.image_pairs import pairs_pull
from lrfcal_lib.measure.surfaces import planes_of
from lrfcal_lib.measure.suspects import (
    WANTED,
    Shift,
    likeliest_change,
    most_likely,
    suspects,
)
from lrfcal_lib.model.geometry import fit_plane
from lrfcal_lib.session.read import Session
from lrfcal_lib.session.scans import scanned

UNEVEN = 0.003  # metres, of real walls
BENT = 3.0  # times what is allowed, of a wall
# metres by which a column bends more than what is flat: readings lie up to 10 mm off its plane
ROUND = 0.002
FEW = 10  # points of a patch of a narrow surface
USUAL = 0.25  # of the points of a cloud are on surfaces that bend less than most
FEWEST_POINTS = 200  # of a wall, or of two passes
STEEP = 3.0  # metres a radian, by which ranges grow with the pitch on a smooth surface
SAME_PLACE = 0.5  # of the readings agree where two sweeps are of one place
# of the places that two images show: honest rigs had 0.6 and more in seven simulated rooms, cameras
# on the base that were turned by 4 deg 0.1
LEAST_ALIKE = 0.5
NEAR = 0.1  # of creases.REACH, within which an honest calibration finds an edge
FEWEST_GROUPS = 8  # quarter metres of creases, or regions of patches, that must speak
SURE = 3.0  # sigma, of two passes
FURNITURE = "record a room with furniture and pictures, 1 to 4 m away"


class Answer(Enum):
    """What can be said about a rig."""

    HOLDS = "holds"
    MOVED = "has moved"
    UNKNOWN = "cannot be told here"


@dataclass(frozen=True)
class Wall:
    """The largest plane of a station: how flat it is, and how flat the calibration would have it,
    metres.
    """

    placement: int
    bend: float
    allowed: float

    @property
    def bent(self) -> bool:
        """Whether the axis or the ranges are not what the calibration says, or the wall bends."""
        return self.bend > BENT * self.allowed

    def __str__(self):
        return (
            f"placement {self.placement}: the largest plane is flat to {1000 * self.bend:.1f} mm "
            f"({1000 * self.allowed:.1f} mm are allowed)"
        )


@dataclass(frozen=True)
class Passes:
    """Two passes of the head over one place: the pitch that the second shows more, radians."""

    placements: tuple[int, int]
    slip: float
    sigma: float

    @property
    def slipped(self) -> bool:
        """Whether the head hangs back or slips, by more than chance and more than nothing."""
        return abs(self.slip) > max(SURE * self.sigma, WANTED / 2)

    def __str__(self):
        first, second = self.placements
        slip, sigma = np.degrees([self.slip, self.sigma])
        return f"placements {first} and {second}, up and down: {slip:+.3f} +- {sigma:.3f} deg apart"


@dataclass(frozen=True)
class Held:
    """Whether a calibration still holds, and by what.

    Attributes
    ----------
    shifts : list of Shift
        Of all cameras, and of the head where cameras stand on the base.
    walls : list of Wall
        Of stations with one.
    passes : list of Passes
    creases, regions : float
        That told it: quarter metres of creases that have an edge, in all images, and regions of
        surfaces that two images show.
    alike : float
        Share of the places in two images that show the same, of the station with the least.
    all_on_head : bool
        A slip of the head would only turn the whole cloud.
    """

    shifts: list[Shift]
    walls: list[Wall]
    passes: list[Passes]
    creases: float
    regions: float
    alike: float
    all_on_head: bool

    @property
    def culprits(self) -> list[Shift]:
        """The camera, or the head under cameras on the base, that has moved, the most likely first;
        several where any of them explains what is seen.
        """
        return most_likely(self.shifts)

    @property
    def moved(self) -> list[str]:
        """What is no longer where the calibration has it."""
        moved = []
        if self.culprits:
            moved.append(" or ".join(shift.name for shift in self.culprits))
        elif any(passes.slipped for passes in self.passes):
            moved.append("the head, between two passes,")
        # one wall alone may bend
        if self.walls and all(wall.bent for wall in self.walls):
            moved.append("the range finder on the axis of the head (or no wall is flat)")
        return moved

    @property
    def answer(self) -> Answer:
        """The verdict."""
        if self.moved:
            return Answer.MOVED
        if self.missing():
            return Answer.UNKNOWN
        return Answer.HOLDS

    def missing(self) -> str:
        """What a scene lacks to tell it; '' where nothing."""
        if not self.shifts:
            return "no image shows without doubt where surfaces meet, or what another one shows"
        if self.alike < LEAST_ALIKE:
            return (
                f"images agree at {100 * self.alike:.0f} % only of the places that they share: a "
                "camera may have moved by far, or the light has changed between images"
            )
        unseen = [shift.unseen() for shift in self.shifts if shift.unseen()]
        more = f"{FURNITURE}, from two places or more"
        if unseen:
            return f"{' or '.join(unseen)} would not show in every direction; {more}"
        doubtful = [shift.name for shift in self.shifts if shift.odds > 0]
        if doubtful:
            return f"{' or '.join(doubtful)} may have moved, or not; {more}"
        if max(self.creases, self.regions) < FEWEST_GROUPS:
            return (
                f"{self.creases / 4:.0f} m of creases and {self.regions:.0f} regions are too few; "
                f"{FURNITURE}"
            )
        return ""

    def sentences(self, name: str = "the calibration") -> list[str]:
        """The verdict first, then what it rests on.

        Parameters
        ----------
        name : str
            Of the calibration.
        """
        first = {
            Answer.HOLDS: "holds",
            Answer.MOVED: f"{' and '.join(self.moved)} has moved: recalibrate",
            Answer.UNKNOWN: f"cannot be told here: {self.missing()}",
        }
        on_head = ""
        if self.all_on_head:
            on_head = (
                "; all cameras are on the head: a slip of the head only turns the whole cloud, "
                "nothing here can show it"
            )
        return [
            f"{name}: {first[self.answer]}",
            *map(str, [*self.shifts, *self.walls, *self.passes]),
            f"from {self.creases / 4:.0f} m of creases, where surfaces meet, against edges of "
            f"images, and {self.regions:.0f} regions of surfaces that two images show{on_head}",
        ]


def holds(session: Session, rig: CalibratedRig) -> Held:
    """Ask a recording of any scene whether a calibration still holds.

    Creases, where flat surfaces of a scan meet, against edges of images; surfaces that two images
    show against each other; flatness of walls; passes of the head over one place.

    Parameters
    ----------
    session : Session
        With sweeps and images of one station or more; a board does no harm.
    rig : CalibratedRig
        Of the joint method.

    Raises
    ------
    ValueError
        If the rig does not say how well it is known, or the session has no sweep, no image, no
        camera of the rig at a known pitch, or images of another size.
    """
    of_creases = []
    stations = []
    walls = []
    for placement in _stations(session, rig):
        sweep, shown = station_of(session, rig, placement)
        cloud = join(sweep_blocks(session, rig.for_scenes, sweep, []))
        surfaces = planes_of(cloud, rig)
        wall = cloud.rows(largest_plane(cloud))
        if len(wall.points) > FEWEST_POINTS:
            walls.append(wall_of(wall, rig, placement))
        views: dict[tuple[str, float], View] = {}
        for view in shown:
            # a camera on the base sees the same again
            views.setdefault((view.camera, view.pitch), view)
        creases = creases_of(cloud, *surfaces)
        of_creases += [sights(creases, view, rig) for view in views.values()]
        moved, of_flat = flattened(cloud, *surfaces)
        stations.append((moved, of_flat, list(views.values())))
    start = likeliest_change(of_creases, rig)
    of_pairs = sum((pairs_pull(*station, rig, start) for station in stations), [])
    nothing = np.zeros_like(start)
    return Held(
        shifts=suspects([*of_creases, *of_pairs], rig),
        walls=walls,
        passes=passes_of(session),
        creases=sum(seen.pull(nothing, NEAR).groups for seen in of_creases),
        regions=sum(pull.groups for pull in of_pairs),
        alike=min((pull.alike for pull in of_pairs), default=1.0),
        all_on_head=all(c.mount == "head" for c in rig.cameras.values()),
    )


def _stations(session, rig):
    """Placements with a sweep and images of the rig's cameras, of which one can be posed."""
    require_same_rig(rig, session)
    shown = {
        record.placement
        for record in session.image_records
        if record.camera in rig.cameras
        and (rig.cameras[record.camera].mount == "platform" or np.isfinite(record.pitch))
    }
    stations = [p for p in _swept(session) if p in shown]
    if not stations:
        raise ValueError(
            f"{session.name}: no placement has both a sweep and an image of "
            f"{', '.join(rig.cameras) or 'a calibrated camera'} at a known pitch"
        )
    return stations


def _swept(session):
    """Placements of which a range came back, in order."""
    return [p for p in session.placements if p in scanned(session.scans)]


def flattened(cloud, planes, of_point):
    """A cloud whose points of flat surfaces are moved onto them, as single readings are noisy, and
    which surface each is of; -1 also for what only passes for flat, like a column.
    """
    points = cloud.points.copy()
    bend = np.full(len(points), np.inf)
    for number, plane in enumerate(planes):
        rows = of_point == number
        bend[rows] = flatness(points[rows], FEW)[1]
        points[rows] = plane.foot(points[rows])
    bent = bend > np.quantile(bend, USUAL, method="lower") + ROUND
    return replace(cloud, points=points), np.where(bent, -1, of_point)


def wall_of(wall: Cloud, rig: CalibratedRig, placement: int) -> Wall:
    """How flat a wall is, beside what the calibration's errors do to it.

    Parameters
    ----------
    wall : Cloud
    rig : CalibratedRig
    placement : int
    """
    normal, _, _ = fit_plane(wall.points)
    by_rig = moved_along(normal, wall, rig)[:, :-2]
    # a plane turns and shifts with the errors: only what bends it shows
    plane = np.insert(wall.points - wall.points.mean(axis=0), 0, 1.0, axis=1)
    by_rig -= plane @ np.linalg.lstsq(plane, by_rig)[0]
    squares = np.vecdot(by_rig @ chain_of(rig).covariances, by_rig)
    allowed = np.sqrt(squares.mean(axis=1).max() + UNEVEN**2)
    return Wall(placement, flatness(wall.points)[1], allowed)


def passes_of(session: Session) -> list[Passes]:
    """What two sweeps of one place, one up and one down, show shifted against each other.

    Placements in turn whose ranges agree but for the noise and for a shift of the pitch.

    Parameters
    ----------
    session : Session
    """
    passes = []
    for pair in pairwise(_swept(session)):
        one, other = (session.sweep(placement) for placement in pair)
        if one.direction * other.direction >= 0:
            continue
        at_pitch = interp1d(other.pitch, other.ranges, axis=0, bounds_error=False)
        miss = at_pitch(one.pitch) - one.ranges
        growth = np.gradient(one.ranges, one.pitch, axis=0)
        smooth = (np.abs(growth) < STEEP) & (np.abs(miss) < STEEP * WANTED * 3)
        # fewer agree where they are of different places
        if smooth.sum() >= max(FEWEST_POINTS, SAME_PLACE * np.isfinite(miss).sum()):
            slope = growth[smooth]
            slip = slope @ miss[smooth] / (slope @ slope)
            rough = max(np.std(miss[smooth] - slip * slope), session.lrf.sigma_range)
            passes.append(Passes(pair, -slip, rough / np.sqrt(slope @ slope)))
    return passes
