"""Does a calibration still hold? What a new recording of any scene says, as numbers and words."""

from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise

import numpy as np
from scipy.interpolate import interp1d
from scipy.special import chdtrc

from lrfcal_lib.calibrate.calibration_file import require_same_rig
from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.cloud import join as join_clouds
from lrfcal_lib.calibrate.clouds import sweep_blocks
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.fit.covariance import sigma_of
from lrfcal_lib.judge.uncertainty import carried, chain_of, uncertainty_of
from lrfcal_lib.measure.creases import Sights, creases_of, creases_pulls, sights
from lrfcal_lib.measure.features import flatness, largest_plane
from lrfcal_lib.measure.image_pairs import pairs_pull
from lrfcal_lib.measure.pulls import PITCH_NOISE, SPREAD, Pull, poses_of, views_of_station
from lrfcal_lib.measure.surfaces import planes_of
from lrfcal_lib.model.camera import pinhole_jacobian
from lrfcal_lib.model.geometry import fit_plane, hat
from lrfcal_lib.session.read import Session

# what no covariance of a calibration knows, radians and metres of a camera's pose: lens and light,
# of one camera; and what all on the head have in common, whose pitch is never quite what is
# recorded (true rigs in three simulated rooms: 0.016 deg, 1 mm; 0.03 deg)
OWN = np.array([*np.radians([0.02, 0.02, 0.02]), 0.0005, 0.0005, 0.0005])
COMMON = np.array([*np.radians([0.04, 0.04, 0.04]), 0.001, 0.001, 0.001])
LEVEL = 0.01  # probability of an alarm for nothing, of a recording; 0.05 is asked for
# of the odds between two suspects: below it either may be it. A camera that moved to one side, and
# the other one to the other, look much alike
AS_LIKELY = np.log(100.0)
UNEVEN = 0.003  # metres, of real walls
BENT = 3.0  # times what is allowed, of a wall
FEWEST_POINTS = 200  # of a wall, or of two passes
STEEP = 3.0  # metres a radian, by which ranges grow with the pitch on a smooth surface
SAME_PLACE = 0.5  # of the readings agree where two sweeps are of one place
# of the places that two images show: honest rigs had 0.6 and more in seven simulated rooms, cameras
# on the base that were turned by 4 deg 0.1
LEAST_ALIKE = 0.5
FEWEST_GROUPS = 8  # creases, or regions of patches, that must speak
# a turn and a move that must not pass unseen, radians and metres
WANTED = np.radians(0.3)
WANTED_MOVE = 0.008
SURE = 3.0  # sigma, of two passes
# sigma of a change of one unknown and of six that raises an alarm in 9 of 10 cases (noncentral chi
# squared at a third of LEVEL)
SHOWS = {1: 4.2, 6: 5.2}
AWAY = 3.0  # metres, where shifts are stated
FURNITURE = "record a room with furniture and pictures, 1 to 4 m away"


class Answer(Enum):
    """What can be said about a rig."""

    HOLDS = "holds"
    MOVED = "has moved"
    UNKNOWN = "cannot be told here"


@dataclass(frozen=True)
class Shift:
    """What a recording says about one camera, or about the head under cameras on the base.

    Attributes
    ----------
    camera : str or None
        None for the head.
    change, sigma : ndarray, shape (6,) or (1,)
        Of the camera's pose ``[w, v]`` (radians, metres) or of the pitch (radians), if nothing else
        has moved.
    pixels, pixels_sigma : ndarray, shape (2,)
        To the right and down in the middle of the image, 3 m away; NaN for the head.
    p_value : float
        Probability of as much where nothing has moved.
    evidence : float
        Logarithm of the odds that it turned, moved or both against that nothing has moved, where
        either was as likely before.
    shows : tuple of float
        The least turn (radians), and the least move of a camera (metres), that raise an alarm in 9
        of 10 cases, whichever way they go.
    """

    camera: str | None
    change: np.ndarray
    sigma: np.ndarray
    pixels: np.ndarray
    pixels_sigma: np.ndarray
    p_value: float
    evidence: float
    shows: tuple[float, ...]

    @property
    def name(self) -> str:
        """Of the suspect."""
        return "the head" if self.camera is None else f"camera '{self.camera}'"

    def unseen(self) -> str:
        """What would not show though it must; '' for nothing."""
        turn, *move = self.shows
        if turn > WANTED:
            return f"a turn of 0.3 deg of {self.name} ({np.degrees(turn):.1f} deg would)"
        if move and move[0] > WANTED_MOVE:
            return f"a move of 8 mm of {self.name} ({1000 * move[0]:.0f} mm would)"
        return ""

    @property
    def matters(self) -> bool:
        """Whether it is more than nothing."""
        return self.camera is not None or bool(abs(self.change[0]) > WANTED / 4)

    def sentence(self) -> str:
        """What was found."""
        chance = f"by chance with a probability of {self.p_value:.2g}"
        turn, sigma = np.degrees([self.change, self.sigma])
        if self.camera is None:
            amount = f"by {turn[0]:+.2f} +- {sigma[0]:.2f} deg"
            least = f"slips from {np.degrees(self.shows[0]):.2f} deg on show"
            return f"{self.name}, if only it slipped: {amount}; {chance}; {least}"
        (right, down), (of_right, of_down) = self.pixels, self.pixels_sigma
        return (
            f"{self.name}, if only it moved: image {right:+.2f} +- {of_right:.2f} px to the right, "
            f"{down:+.2f} +- {of_down:.2f} px down (3 m away), turned by {turn[2]:+.2f} +- "
            f"{sigma[2]:.2f} deg; {chance}; turns from {np.degrees(self.shows[0]):.2f} deg and "
            f"moves from {1000 * self.shows[1]:.0f} mm on show"
        )


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

    def sentence(self) -> str:
        """What was found."""
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

    def sentence(self) -> str:
        """What was found."""
        first, second = self.placements
        slip, sigma = np.degrees([self.slip, self.sigma])
        return f"placements {first} and {second}, up and down: {slip:+.3f} +- {sigma:.3f} deg apart"


@dataclass(frozen=True)
class Held:
    """Whether a calibration still holds, and by what.

    Attributes
    ----------
    culprits : tuple of Shift
        The camera, or the head under cameras on the base, that has moved, the most likely first;
        several where any of them explains what is seen.
    shifts : tuple of Shift
        Of all cameras, and of the head where cameras stand on the base.
    walls : tuple of Wall
        Of stations with one.
    passes : tuple of Passes
    creases, regions : float
        That told it: creases against edges, and regions of surfaces that two images show.
    alike : float
        Share of the places in two images that show the same, of the station with the least.
    all_on_head : bool
        A slip of the head would only turn the whole cloud.
    """

    culprits: tuple[Shift, ...]
    shifts: tuple[Shift, ...]
    walls: tuple[Wall, ...]
    passes: tuple[Passes, ...]
    creases: float
    regions: float
    alike: float
    all_on_head: bool

    @property
    def moved(self) -> tuple[str, ...]:
        """What is no longer where the calibration has it."""
        moved = []
        if self.culprits:
            moved.append(" or ".join(shift.name for shift in self.culprits))
        elif any(passes.slipped for passes in self.passes):
            moved.append("the head, between two passes,")
        # one wall alone may bend
        if self.walls and all(wall.bent for wall in self.walls):
            moved.append("the range finder on the axis of the head (or no wall is flat)")
        return tuple(moved)

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
        if unseen:
            more = f"{FURNITURE}, from two places or more"
            return f"{' or '.join(unseen)} would not show in every direction; {more}"
        if max(self.creases, self.regions) < FEWEST_GROUPS:
            number = f"{self.creases:.0f} creases and {self.regions:.0f} regions"
            return f"{number} are too few; {FURNITURE}"
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
        basis = (
            f"from {self.creases:.0f} creases, where surfaces meet, against edges of images, and "
            f"{self.regions:.0f} regions of surfaces that two images show{on_head}"
        )
        lines = [f"{name}: {first[self.answer]}"]
        lines += [shift.sentence() for shift in self.shifts]
        lines += [wall.sentence() for wall in self.walls]
        lines += [passes.sentence() for passes in self.passes]
        return [*lines, basis]


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
        camera of the rig, or images of another size.
    """
    uncertainty_of(rig)
    of_creases: dict[str, list[Sights]] = {camera: [] for camera in rig.cameras}
    stations = []
    walls = []
    for placement in _stations(session, rig):
        cloud = _cloud(session, rig, placement)
        planes, of_point = planes_of(cloud, rig)
        wall = cloud.rows(largest_plane(cloud))
        if len(wall.points) > FEWEST_POINTS:
            walls.append(wall_of(wall, rig, placement))
        views = views_of_station(session, rig, placement)
        creases = creases_of(cloud, planes, of_point, placement)
        for view in views:
            of_creases[view.camera].append(sights(creases, view))
        stations.append((flattened(cloud, planes, of_point), of_point >= 0, views))
    by_camera = creases_pulls(of_creases, rig)
    of_pairs = [pairs_pull(*station, by_camera) for station in stations]
    of_pairs = [pull for pull in of_pairs if pull is not None]
    pulls = [*by_camera, *of_pairs]
    shifts = []
    if pulls:
        shifts = suspects(pulls, rig)
    alarms = [s for s in shifts if s.p_value < LEVEL / len(shifts) and s.matters]
    return Held(
        culprits=tuple(most_likely(alarms)),
        shifts=tuple(shifts),
        walls=tuple(walls),
        passes=tuple(passes_of(session)),
        creases=sum(pull.groups for pull in by_camera),
        regions=sum(pull.groups for pull in of_pairs),
        alike=min((pull.alike for pull in of_pairs), default=1.0),
        all_on_head=all(c.mount == "head" for c in rig.cameras.values()),
    )


def most_likely(alarms: list[Shift]) -> list[Shift]:
    """Those of some suspects that may have moved, the most likely first.

    Parameters
    ----------
    alarms : list of Shift
    """
    likely = sorted(alarms, key=lambda s: -s.evidence)
    return [s for s in likely if s.evidence > likely[0].evidence - AS_LIKELY]


def _stations(session, rig):
    """Placements with a sweep and images of the rig's cameras."""
    require_same_rig(rig, session)
    shown = {r.placement for r in session.image_records if r.camera in rig.cameras}
    swept = set(
        session.scans["placement"][np.isfinite(session.scans["ranges"]).any(axis=1)]
    )
    stations = [p for p in session.placements if p in shown & swept]
    if not stations:
        raise ValueError(
            f"{session.name}: no placement has both a sweep and an image of "
            f"{', '.join(rig.cameras) or 'a calibrated camera'}"
        )
    return stations


def _cloud(session, rig, placement) -> Cloud:
    """The points of a station."""
    return join_clouds(sweep_blocks(session, rig.for_scenes, session.sweep(placement), []))


def flattened(cloud, planes, of_point):
    """A cloud whose points of flat surfaces are moved onto them: single readings are noisy."""
    flat = of_point >= 0
    plane = of_point[flat]
    normal = np.reshape([plane.axis for plane in planes], (-1, 3))[plane]
    centre = np.reshape([plane.centre for plane in planes], (-1, 3))[plane]
    points = cloud.points.copy()
    points[flat] -= np.vecdot(points[flat] - centre, normal)[:, None] * normal
    return replace(cloud, points=points)


def wall_of(wall: Cloud, rig: CalibratedRig, placement: int) -> Wall:
    """How flat a wall is, beside what the calibration's errors do to it.

    Parameters
    ----------
    wall : Cloud
    rig : CalibratedRig
    placement : int
    """
    normal, _, _ = fit_plane(wall.points)
    chain = chain_of(rig)
    _, J, _ = carried(
        chain, wall.bearing, rig.corrections.pitch(-1, wall.pitch), wall.range
    )
    by_link = np.einsum("i,nij->nj", normal @ chain.head[:, :3], J)
    # a plane turns and shifts with the errors: only what bends it shows
    plane = np.column_stack([np.ones(len(by_link)), wall.points - wall.points.mean(axis=0)])
    by_link -= plane @ np.linalg.lstsq(plane, by_link, rcond=None)[0]
    squares = [np.mean(np.sum(by_link @ C * by_link, axis=1)) for C in chain.covariances]
    allowed = np.sqrt(max(squares) + UNEVEN**2)
    return Wall(placement, flatness(wall.points)[1], float(allowed))


def passes_of(session: Session) -> list[Passes]:
    """What two sweeps of one place, one up and one down, show shifted against each other.

    Placements in turn whose ranges agree but for the noise and for a shift of the pitch.

    Parameters
    ----------
    session : Session
    """
    passes = []
    swept = [p for p in session.placements if (session.scans["placement"] == p).any()]
    for pair in pairwise(swept):
        one, other = (session.sweep(placement) for placement in pair)
        if session.sweep_direction(pair[0]) * session.sweep_direction(pair[1]) < 0:
            slip = _slip_between(one, other, session.lrf.sigma_range)
            if slip is not None:
                passes.append(Passes(pair, *slip))
    return passes


def _slip_between(one, other, noise):
    """By how much more the second of two sweeps says its pitch is than the first, and sigma,
    radians; None where they are of different places.
    """
    if min(len(one.pitch), len(other.pitch)) < 2:
        return None
    at_pitch = interp1d(other.pitch, other.ranges, axis=0, bounds_error=False)
    miss = at_pitch(one.pitch) - one.ranges
    growth = np.gradient(one.ranges, one.pitch, axis=0)
    with np.errstate(invalid="ignore"):
        smooth = (np.abs(growth) < STEEP) & (np.abs(miss) < STEEP * WANTED * 3)
    if smooth.sum() < max(FEWEST_POINTS, SAME_PLACE * np.isfinite(miss).sum()):
        return None
    slope = growth[smooth]
    slip = slope @ miss[smooth] / (slope @ slope)
    rough = max(np.std(miss[smooth] - slip * slope), noise)
    return -float(slip), float(rough / np.sqrt(slope @ slope))


def suspects(pulls: list[Pull], rig: CalibratedRig) -> list[Shift]:
    """What each camera, and the head under cameras on the base, would have to have done.

    Score tests: each alone against a calibration that errs as its covariance allows.

    Parameters
    ----------
    pulls : list of Pull
    rig : CalibratedRig
    """
    names = rig.uncertainty.names
    information = np.sum([pull.information for pull in pulls], axis=0)
    slope = np.sum([pull.slope for pull in pulls], axis=0)
    C = _allowed(rig)
    both = np.eye(len(C)) + information @ C
    score = np.linalg.solve(both, slope)
    sharp = np.linalg.solve(both, information)
    shifts = []
    for camera in rig.cameras:
        shifts.append(_shift(camera, poses_of(rig, camera), score, sharp, rig))
    if any(camera.mount == "platform" for camera in rig.cameras.values()):
        shifts.append(_shift(None, np.array([len(names)]), score, sharp, rig))
    return shifts


def _allowed(rig):
    """Covariance (c, c) of the unknowns where nothing has moved, the pitch of sweeps last."""
    known = rig.uncertainty
    count = len(known.names)
    C = np.zeros((count + 1,) * 2)
    C[:count, :count] = np.where(np.isfinite(known.trusted), known.trusted, 0.0)
    common = np.zeros((len(C), 6))
    for name, camera in rig.cameras.items():
        columns = poses_of(rig, name)
        C[columns, columns] += OWN**2
        if camera.mount == "head":
            common[columns, np.arange(6)] = COMMON
    C += common @ common.T
    C[count, count] = known.sweep_sigma[0] ** 2 + PITCH_NOISE**2
    return C


def _shift(camera, columns, score, sharp, rig):
    """The Shift of one suspect, of unknowns in these columns."""
    known = sharp[np.ix_(columns, columns)]
    likely = SPREAD if camera else np.array([np.radians(1.0)])
    covariance = np.linalg.inv(known + np.diag(likely**-2.0))
    change = covariance @ score[columns]
    # a turn, a move: the first three unknowns, and the others
    parts = [part for part in (slice(3), slice(3, None)) if columns[part].size]
    least = [max(np.linalg.eigvalsh(known[part, part])[0], 1e-12) for part in parts]
    odds = []
    for part in (*parts, slice(None)):
        odds.append(_evidence(score[columns][part], known[part, part], likely[part]))
    motion = np.full((2, len(columns)), np.nan)
    if camera:
        by_point = pinhole_jacobian([0.0, 0.0, AWAY], rig.cameras[camera].model)
        motion = by_point @ np.hstack([-hat([0.0, 0.0, AWAY]), np.eye(3)])
    return Shift(
        camera=camera,
        change=change,
        sigma=sigma_of(covariance),
        pixels=motion @ change,
        pixels_sigma=sigma_of(motion @ covariance @ motion.T),
        p_value=_chance(score[columns], known),
        evidence=max(odds),
        shows=tuple(SHOWS[len(columns)] / np.sqrt(least)),
    )


def _evidence(score, known, likely):
    """Logarithm of the odds of a change (k,) that is likely to so much against none."""
    shares = np.eye(len(known)) + known * np.outer(likely, likely)
    score = score * likely
    gain = score @ np.linalg.solve(shares, score)
    return (gain - np.linalg.slogdet(shares)[1]) / 2


def _chance(score, known):
    """Probability of a score (k,) of an information (k, k), of what is known at all."""
    square = score @ np.linalg.pinv(known, rcond=1e-6, hermitian=True) @ score
    return float(chdtrc(len(score), square))
