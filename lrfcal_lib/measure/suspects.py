"""What may have moved since a calibration: each suspect alone, by creases and by pairs of images.

Where a crease has its edge depends on what has moved: each suspect is asked with edges of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.fit.covariance import sigma_of
from lrfcal_lib.measure.creases import Sights
from lrfcal_lib.measure.pulls import PITCH_NOISE, SPREAD, Pull, poses_of
from lrfcal_lib.model.camera import pinhole_jacobian
from lrfcal_lib.model.geometry import gradient_by_pose

# what no covariance of a calibration knows, radians and metres of a camera's pose: lens and light,
# of one camera; and what all on the head have in common, whose pitch is never quite what is
# recorded (true rigs in three simulated rooms: 0.02 deg, 1 mm)
OWN = np.repeat([np.radians(0.02), 0.0005], 3)
COMMON = np.repeat([np.radians(0.02), 0.001], 3)
SURE = np.log(20.0)  # of odds: below, nothing may have moved, or the other suspect
IN_9_OF_10 = 1.28  # standard deviations
SLIP = np.radians([1.0])  # a likely one of the head
# a turn and a move that must not pass unseen, radians and metres
WANTED = np.radians(0.3)
WANTED_MOVE = 0.008
AWAY = 3.0  # metres, where shifts are stated
# of the range in which an edge is sought, while a change is found
WIDTHS = np.append(np.geomspace(0.3, 0.01, 20), np.zeros(8))
LIKELIHOOD = attrgetter("evidence")  # of a Fit


@dataclass(frozen=True)
class Shift:
    """What a recording says about one camera, or about the head under cameras on the base.

    Attributes
    ----------
    camera : str or None
        None for the head.
    change : ndarray, shape (6,) or (1,)
        Of the camera's pose ``[w, v]`` (radians, metres) or of the pitch (radians), beside what the
        calibration errs by, if nothing else has moved.
    covariance : ndarray, shape (6, 6) or (1, 1)
        Of the change.
    motion : ndarray, shape (2, 6), or None
        Pixels to the right and down by the change, in the middle of the image, 3 m away; None for
        the head.
    evidence : float
        Logarithm of the odds that it turned, moved or both against that nothing has moved, where
        either was as likely before.
    shows : list of float
        The least turn (radians), and the least move of a camera (metres), that raise an alarm in 9
        of 10 cases, whichever way they go.
    """

    camera: str | None
    change: np.ndarray
    covariance: np.ndarray
    motion: np.ndarray | None
    evidence: float
    shows: list[float]

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
    def odds(self) -> float:
        """Logarithm of the odds that it has moved by more than nothing."""
        if self.camera is None and abs(self.change[0]) < WANTED / 4:
            return -np.inf
        return self.evidence

    def __str__(self):
        odds = f"odds of 10^{self.evidence / np.log(10):+.1f} that it has"
        turn, sigma = np.degrees([self.change, sigma_of(self.covariance)])
        if self.camera is None:
            return (
                f"{self.name}, if only it slipped: by {turn[0]:+.2f} +- {sigma[0]:.2f} deg; "
                f"{odds}; slips from {np.degrees(self.shows[0]):.2f} deg on show"
            )
        right, down = self.motion @ self.change
        of_right, of_down = sigma_of(self.motion @ self.covariance @ self.motion.T)
        return (
            f"{self.name}, if only it moved: image {right:+.2f} +- {of_right:.2f} px to the right, "
            f"{down:+.2f} +- {of_down:.2f} px down (3 m away), turned by {turn[2]:+.2f} +- "
            f"{sigma[2]:.2f} deg; {odds}; turns from {np.degrees(self.shows[0]):.2f} deg and "
            f"moves from {1000 * self.shows[1]:.0f} mm on show"
        )


def most_likely(shifts: list[Shift]) -> list[Shift]:
    """Those of some suspects that may have moved, the most likely first.

    Parameters
    ----------
    shifts : list of Shift
    """
    alarms = [shift for shift in shifts if shift.odds > SURE]
    likely = sorted(alarms, key=lambda s: -s.evidence)
    return [s for s in likely if s.evidence > likely[0].evidence - SURE]


@dataclass(frozen=True)
class _Fit:
    """What observations ask for if one suspect moved, None for the head: a change of the unknowns
    (c,) and the logarithm of its evidence. Of the k that the suspect moves by, their information
    (k, k) and slope (k,) where the calibration errs as it may.
    """

    camera: str | None
    change: np.ndarray
    evidence: float
    information: np.ndarray
    slope: np.ndarray


def suspects(seen: Sequence[Sights | Pull], rig: CalibratedRig) -> list[Shift]:
    """What each camera, and the head under cameras on the base, would have to have done.

    Each alone, of a calibration that else errs as its covariance allows.

    Parameters
    ----------
    seen : sequence of Sights and Pull
        Of images, and of pairs of images.
    rig : CalibratedRig

    Returns
    -------
    list of Shift
        Empty where nothing was observed.
    """
    nothing, *moved = _asked(seen, rig)
    if not any(fit.information.any() for fit in moved):
        return []
    return [_shift(fit, nothing, rig) for fit in moved]


def likeliest_change(seen: Sequence[Sights], rig: CalibratedRig) -> np.ndarray:
    """The change of the unknowns, shape (c,), by which creases alone are explained best.

    Parameters
    ----------
    seen : sequence of Sights
        Of all images.
    rig : CalibratedRig
    """
    return max(_asked(seen, rig), key=LIKELIHOOD).change


def _asked(seen, rig):
    """The Fit where nothing has moved, and the likeliest of each suspect."""
    turns = np.arange(6) < 3
    ways = [SPREAD * turns, SPREAD * ~turns, SPREAD]
    moves = [(None, [], [0.0])]
    moves += [(camera, poses_of(rig, camera), ways) for camera in rig.cameras]
    if any(camera.mount == "platform" for camera in rig.cameras.values()):
        moves.append((None, [-1], [SLIP]))
    C = _allowed(rig)
    return [
        max((_fitted(seen, C, *suspect, likely) for likely in ways), key=LIKELIHOOD)
        for *suspect, ways in moves
    ]


def _fitted(seen, C, camera, columns, likely):
    """The Fit of changes that are likely to a covariance C (c, c), and in the columns of a suspect
    to standard deviations besides: expectation and maximisation, with edges that are sought nearer
    and nearer, and Laplace's approximation of the evidence.
    """
    wider = C.copy()
    wider[columns, columns] += likely**2
    change = np.zeros(len(C))
    for width in WIDTHS:
        information = np.zeros_like(C)
        slope = np.zeros(len(C))
        for each in seen:
            pull = each.pull(change, width)
            information += pull.information
            slope += pull.slope
        shares = np.eye(len(C)) + wider @ information
        change = np.linalg.solve(shares, wider @ slope)
    evidence = sum(each.explained(change) for each in seen)
    cost = change @ (slope - information @ change) + np.linalg.slogdet(shares)[1]
    both = np.eye(len(C)) + information @ C
    return _Fit(
        camera=camera,
        change=change,
        evidence=evidence - cost / 2,
        information=np.linalg.solve(both, information)[np.ix_(columns, columns)],
        slope=np.linalg.solve(both, slope)[columns],
    )


def _allowed(rig):
    """Covariance (c, c) of the unknowns where nothing has moved, the pitch of sweeps last."""
    known = rig.known
    C = np.pad(np.nan_to_num(known.trusted, posinf=0.0, neginf=0.0), (0, 1))
    common = np.zeros((len(C), 6))
    for name, camera in rig.cameras.items():
        columns = poses_of(rig, name)
        C[columns, columns] += OWN**2
        if camera.mount == "head":
            common[columns] = np.diag(COMMON)
    C[-1, -1] = known.sweep_sigma[0] ** 2 + PITCH_NOISE**2
    return C + common @ common.T


def _shift(fit, nothing, rig):
    """The Shift of a suspect, beside the Fit where nothing has moved."""
    likely = SPREAD if fit.camera else SLIP
    # a turn, a move: the first three unknowns, and the others
    shows = []
    for part in (slice(3), slice(3, None)):
        if likely[part].size:
            information = fit.information[part, part]
            shares = np.eye(len(information)) + information * likely[part] ** 2
            sigma = max(np.linalg.eigvalsh(information)[0], 1e-12) ** -0.5
            wanted = np.sqrt(2 * SURE + np.linalg.slogdet(shares)[1])
            shows.append((wanted + IN_9_OF_10) * sigma)
    covariance = np.linalg.inv(fit.information + np.diag(likely**-2.0))
    motion = None
    if fit.camera:
        ahead = np.array([0.0, 0.0, AWAY])
        by_point = pinhole_jacobian(ahead, rig.cameras[fit.camera].model)
        motion = gradient_by_pose(ahead, by_point)
    return Shift(
        camera=fit.camera,
        change=covariance @ fit.slope,
        covariance=covariance,
        motion=motion,
        evidence=fit.evidence - nothing.evidence,
        shows=shows,
    )
