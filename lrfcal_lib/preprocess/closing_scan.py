"""The scan that closes a sweep, back in its first half: whether the rig stood still meanwhile.

It shows what changes the ranges at that pitch: a shift along a wall that fills the scan does not.
"""

from dataclasses import dataclass

import numpy as np

from lrfcal_lib.session.read import Sweep

FIRST = 0.6  # share of the way, up to which a scan closes a sweep
FEW = 0.1  # share of a sweep's scan lines, above which it was swept both ways instead
PLAY = np.radians(1.0)  # by which a head may come back wrong: backlash
# times the scatter between neighbouring scan lines; a rig that stands still has 0.4 to 1.0
MOVED = 1.6
LINES = 4  # of a sweep that its closing scan is compared with, or more
FINEST = 0.002  # metres; below it no two readings differ for sure
# of the beams; more than a median shows, since not all of them meet what comes nearer
QUANTILE = 0.8
LEAST = 20  # beams that must be there to compare


@dataclass(frozen=True)
class Closing:
    """How the last scan of a sweep agrees with those of about its pitch.

    Attributes
    ----------
    apart : float
        By which most ranges differ at most, the head's play aside, metres.
    expected : float
        The same between neighbouring scan lines of the sweep.
    """

    apart: float
    expected: float

    @property
    def moved(self) -> bool:
        """Whether the rig, or the head beyond its play, was elsewhere at the end."""
        return self.apart > MOVED * max(self.expected, FINEST)

    def __str__(self):
        return (
            f"back at a pitch that it had, ranges differ by {1000 * self.apart:.0f} mm, by "
            f"{1000 * self.expected:.0f} mm between neighbouring scan lines"
        )


def without_closing(sweep: Sweep) -> tuple[Sweep, Sweep | None]:
    """A sweep on its way, and the scan lines that close it where there are any.

    Parameters
    ----------
    sweep : Sweep

    Returns
    -------
    sweep, closing : Sweep, Sweep or None
    """
    pitch = sweep.pitch
    turn = np.argmax(sweep.direction * pitch) + 1
    far = np.abs(pitch[turn:] - pitch[0]) < FIRST * np.ptp(pitch)
    if not far.any() or len(far) > max(1, FEW * len(pitch)):
        return sweep, None
    return sweep.part(slice(0, turn)), sweep.part(turn + np.flatnonzero(far))


def closing_of(sweep: Sweep) -> Closing | None:
    """What the scan that closes a sweep tells.

    Parameters
    ----------
    sweep : Sweep

    Returns
    -------
    Closing or None
        None where nothing closes the sweep, or too few beams came back.
    """
    sweep, closing = without_closing(sweep)
    if closing is None:
        return None
    away = np.abs(sweep.pitch - closing.pitch.mean())
    near = np.argsort(away, kind="stable")[: max(LINES, np.sum(away <= PLAY))]
    _, stops = np.unique(sweep.pitch[near], return_index=True)
    lines = sweep.ranges[near[stops]]
    apart = _apart(lines - closing.ranges[-1])
    expected = _apart(np.diff(lines, axis=0))
    if not (len(apart) and len(expected)):
        return None
    return Closing(apart.min(), np.median(expected))


def _apart(changes):
    """By which most ranges of lines (n, B) differ at most, metres, of those of which enough came
    back both times.
    """
    apart = np.abs(changes)
    enough = np.isfinite(apart).sum(axis=1) >= LEAST
    return np.nanquantile(apart[enough], QUANTILE, axis=1)
