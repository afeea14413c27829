"""Does a calibration still hold? What a new recording of any scene says, as numbers."""

from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise

import numpy as np
from scipy.special import chdtrc

from lrfcal_lib.calibrate.calibration_file import require_same_rig
from lrfcal_lib.calibrate.cloud import join as join_clouds
from lrfcal_lib.calibrate.reconstruct import reconstruct
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.calibrate.rig_uncertainty import columns_of
from lrfcal_lib.judge.uncertainty import carried, chain_of, uncertainty_of
from lrfcal_lib.measure.depth_jumps import depth_jumps
from lrfcal_lib.measure.edge_shift import edges_pull, join, sights
from lrfcal_lib.measure.features import flatness, largest_plane
from lrfcal_lib.measure.image_pairs import STIFF, pairs_pull, patches_of
from lrfcal_lib.measure.pulls import Pull, views_of_station
from lrfcal_lib.model.camera import pinhole_jacobian
from lrfcal_lib.model.geometry import fit_plane, hat
from lrfcal_lib.session.read import Session

# what no covariance of a calibration knows, radians and metres of a camera's pose: lens and light,
# of one camera; and what all on the head have in common, whose pitch is never quite what is
# recorded (both found from honest simulated rooms)
OWN = np.array([*np.radians([0.03, 0.03, 0.03]), 0.001, 0.001, 0.001])
COMMON = np.array([*np.radians([0.12, 0.04, 0.04]), 0.002, 0.002, 0.002])
# of the variance of rims: reflectivities bias all those of one side alike, by 0.1 deg of the pitch
# in honest simulated rooms
RIM_DOUBT = 20.0
PITCH_NOISE = np.radians(0.01)  # of a head at rest: what encoders resolve
LEVEL = 0.01  # probability of an alarm for nothing, of a recording; 0.05 is asked for
UNEVEN = 0.003  # metres, of real walls
FEWEST_POINTS = 200  # of a wall, or of two passes
STEEP = 3.0  # metres a radian, by which ranges grow with the pitch on a smooth surface
SAME_PLACE = 0.5  # of the readings agree where two sweeps are of one place
FEWEST_GROUPS = 8  # rims, or regions of patches, that must speak
WANTED = np.radians(0.3)  # a turn that must not pass unseen
AWAY = 3.0  # metres, where shifts are stated


class Answer(Enum):
    """What can be said about a camera, or a rig."""

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
    pixels, pixels_sigma : ndarray, shape (3,)
        To the right, down (pixels) and a turn (radians) in the middle of the image, 3 m away; NaN
        for the head.
    p_value : float
        Probability of as much where nothing has moved.
    told : bool
        Whether a turn of 0.3 deg would show.
    """

    camera: str | None
    change: np.ndarray
    sigma: np.ndarray
    pixels: np.ndarray
    pixels_sigma: np.ndarray
    p_value: float
    told: bool


@dataclass(frozen=True)
class Wall:
    """The largest plane of a scene: how flat it is, and how flat the calibration would have it,
    metres.
    """

    placement: int
    bend: float
    allowed: float


@dataclass(frozen=True)
class Passes:
    """Two passes of the head over one place: the pitch that the second shows more, radians."""

    placements: tuple[int, int]
    slip: float
    sigma: float


@dataclass(frozen=True)
class Held:
    """Whether a calibration still holds, and by what.

    Attributes
    ----------
    answer : Answer
    culprit : Shift or None
        What has moved.
    shifts : tuple of Shift
        Of all cameras, and of the head where cameras stand on the base.
    walls : tuple of Wall
    passes : tuple of Passes
    rims, regions : float
        That told it: rims of depth against edges, and regions of surfaces that two images show.
    all_on_head : bool
        A slip of the head would only turn the whole cloud.
    """

    answer: Answer
    culprit: Shift | None
    shifts: tuple[Shift, ...]
    walls: tuple[Wall, ...]
    passes: tuple[Passes, ...]
    rims: float
    regions: float
    all_on_head: bool


def holds(session: Session, rig: CalibratedRig) -> Held:
    """Ask a recording of any scene whether a calibration still holds.

    Rims, where the depth of a sweep jumps, against edges of images; surfaces that two images show
    against each other; flatness of walls; passes of the head over one place.

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
    stations = _stations(session, rig)
    pulls = []
    rims = 0.0
    regions = 0.0
    for placement in stations:
        of_edges, of_pairs = _station_pulls(session, rig, placement)
        pulls += [*of_edges, *of_pairs]
        rims += sum(pull.groups for pull in of_edges)
        regions += sum(pull.groups for pull in of_pairs)
    shifts = []
    if pulls:
        shifts = suspects(pulls, rig)
    alarms = [s for s in shifts if s.p_value < LEVEL / len(shifts) and _matters(s)]
    culprit = min(alarms, key=lambda s: s.p_value, default=None)
    answer = Answer.UNKNOWN
    if culprit is not None:
        answer = Answer.MOVED
    elif shifts and max(rims, regions) >= FEWEST_GROUPS and all(s.told for s in shifts):
        answer = Answer.HOLDS
    return Held(
        answer=answer,
        culprit=culprit,
        shifts=tuple(shifts),
        walls=tuple(wall_of(session, rig, placement) for placement in stations),
        passes=tuple(passes_of(session)),
        rims=rims,
        regions=regions,
        all_on_head=all(c.mount == "head" for c in rig.cameras.values()),
    )


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


def _station_pulls(session, rig, placement):
    """What a station says, by rims and edges, and by pairs of images: two lists of Pull."""
    sweep = session.sweep(placement)
    views = views_of_station(session, rig, placement)
    jumps = depth_jumps(sweep, rig, session.lrf, session.continuous)
    of_edges = []
    for camera in dict.fromkeys(view.camera for view in views):
        mine = [view for view in views if view.camera == camera]
        seen = join([sights(jumps, view) for view in mine])
        if len(seen.rim):
            pull = edges_pull(seen, mine[0].pose_columns, mine[0].model.width)
            weaker = replace(pull, information=pull.information / RIM_DOUBT)
            of_edges.append(weaker)
    of_pairs = []
    if len(views) > 1:
        patches = patches_of(sweep, rig, session.lrf, session.continuous)
        pair = pairs_pull(patches, views)
        if pair is not None:
            of_pairs.append(pair)
    return of_edges, of_pairs


def wall_of(session: Session, rig: CalibratedRig, placement: int) -> Wall:
    """How flat the largest plane of a station is, beside what the calibration's errors do to it.

    Parameters
    ----------
    session : Session
    rig : CalibratedRig
    placement : int
    """
    sweep = session.sweep(placement)
    clean = replace(rig.corrections, sweeps={})
    blocks = reconstruct(
        sweep, [], rig.T_head_lrf, clean, lrf=session.lrf, continuous=session.continuous
    )
    cloud = join_clouds(blocks)
    wall = cloud.rows(largest_plane(cloud))
    if len(wall.points) < FEWEST_POINTS:
        return Wall(placement, np.nan, np.nan)
    _, bend = flatness(wall.points)
    normal, _, _ = fit_plane(wall.points)
    chain = chain_of(rig)
    pitch = clean.pitch(placement, wall.pitch)
    _, J, _ = carried(chain, wall.bearing, pitch, wall.range)
    by_link = np.einsum("i,nij->nj", normal @ chain.head[:, :3], J)
    # a plane turns and shifts with the errors: only what bends it shows
    plane = np.column_stack([np.ones(len(by_link)), wall.points - wall.points.mean(axis=0)])
    by_link -= plane @ np.linalg.lstsq(plane, by_link, rcond=None)[0]
    variance = max(
        np.mean(np.sum(by_link @ C * by_link, axis=1)) for C in chain.covariances
    )
    return Wall(placement, bend, float(np.sqrt(variance + UNEVEN**2)))


def passes_of(session: Session) -> list[Passes]:
    """What two sweeps of one place, one up and one down, show shifted against each other.

    Placements in turn whose ranges agree but for the noise and for a shift of the pitch.

    Parameters
    ----------
    session : Session
    """
    found = []
    swept = [p for p in session.placements if (session.scans["placement"] == p).any()]
    for first, second in pairwise(swept):
        ways = [session.sweep_direction(placement) for placement in (first, second)]
        if ways[0] * ways[1] < 0:
            one, other = session.sweep(first), session.sweep(second)
            slip = _slip_between(one, other, session.lrf.sigma_range)
            if slip is not None:
                found.append(Passes((first, second), *slip))
    return found


def _slip_between(one, other, noise):
    """By how much more the second of two sweeps says its pitch is than the first, and sigma,
    radians; None where they are of different places.
    """
    order = np.argsort(other.pitch)
    inside = (one.pitch >= other.pitch.min()) & (one.pitch <= other.pitch.max())
    if inside.sum() < 3:
        return None
    at = np.interp(one.pitch[inside], other.pitch[order], np.arange(len(order)))
    low = np.clip(at.astype(int), 0, len(order) - 2)
    share = (at - low)[:, None]
    sorted_ranges = other.ranges[order]
    met = (1 - share) * sorted_ranges[low] + share * sorted_ranges[low + 1]
    growth = np.gradient(one.ranges[inside], one.pitch[inside], axis=0)
    miss = met - one.ranges[inside]
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
        Of every station.
    rig : CalibratedRig
    """
    names = rig.uncertainty.names
    slope = 0.0
    information = 0.0
    for pull in pulls:
        of_station, tensor = _without_stops(pull, rig)
        slope = slope + of_station
        information = information + tensor
    C = _allowed(rig)
    both = np.eye(len(C)) + information @ C
    score = np.linalg.solve(both, slope)
    sharp = np.linalg.solve(both, information)
    found = []
    for camera in rig.cameras:
        columns = columns_of(names, camera)[4:10]
        found.append(_shift(camera, columns, score, sharp, rig))
    if any(camera.mount == "platform" for camera in rig.cameras.values()):
        found.append(_shift(None, np.array([len(names)]), score, sharp, rig))
    return found


def _without_stops(pull, rig):
    """Slope (c,) and information (c, c) of a Pull about what stations share: the pitch of an image
    is another one at each.
    """
    kept = len(rig.uncertainty.names) + 1
    L = pull.information
    g = L @ pull.change
    known = L[kept:, kept:] + np.eye(len(g) - kept) / PITCH_NOISE**2
    gain = np.linalg.solve(known, L[kept:, :kept]).T
    return g[:kept] - gain @ g[kept:], L[:kept, :kept] - gain @ L[kept:, :kept]


def _allowed(rig):
    """Covariance (c, c) of the unknowns where nothing has moved, the pitch of sweeps last."""
    known = rig.uncertainty
    count = len(known.names)
    C = np.zeros((count + 1,) * 2)
    C[:count, :count] = np.where(np.isfinite(known.trusted), known.trusted, 0.0)
    common = np.zeros((len(C), 6))
    for name, camera in rig.cameras.items():
        columns = columns_of(known.names, name)[4:10]
        C[columns, columns] += OWN**2
        if camera.mount == "head":
            common[columns, np.arange(6)] = COMMON
    C += common @ common.T
    C[count, count] = known.sweep_sigma[0] ** 2 + PITCH_NOISE**2
    return C


def _shift(camera, columns, score, sharp, rig):
    """The Shift of one suspect, of unknowns in these columns."""
    known = sharp[np.ix_(columns, columns)]
    likely = STIFF if camera else np.array([np.radians(1.0)])
    covariance = np.linalg.inv(known + np.diag(likely**-2.0))
    change = covariance @ score[columns]
    # the score test, of what is known at all
    square = (
        score[columns] @ np.linalg.pinv(known, rcond=1e-6, hermitian=True) @ score[columns]
    )
    pixels = np.full(3, np.nan)
    spread = pixels
    sigma = np.sqrt(np.diag(covariance))
    told = bool(sigma[:3].max() < WANTED / 2)
    if camera:
        model = rig.cameras[camera].model
        motion = np.zeros((3, 6))
        motion[:2] = pinhole_jacobian([0.0, 0.0, AWAY], model) @ np.hstack(
            [-hat([0.0, 0.0, AWAY]), np.eye(3)]
        )
        motion[2, 2] = 1.0
        pixels = motion @ change
        spread = np.sqrt(np.diag(motion @ covariance @ motion.T))
    p_value = float(chdtrc(len(columns), square))
    return Shift(camera, change, sigma, pixels, spread, p_value, told)


def _matters(shift):
    """Whether a shift is more than nothing."""
    if shift.camera is None:
        return bool(abs(shift.change[0]) > WANTED / 4)
    return True
