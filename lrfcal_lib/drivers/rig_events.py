"""What happens while a rig records, one event after the other."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Moved:
    """The head rests at a stop.

    Attributes
    ----------
    placement : int
    time_s : float
        Host clock; what is recorded at this stop is later.
    commanded, pitch : float
        Radians.
    measured : bool
        False where the head does not tell its pitch: dead reckoning.
    number, of : int
        This stop and how many there are.
    """

    placement: int
    time_s: float
    commanded: float
    pitch: float
    measured: bool
    number: int
    of: int


@dataclass(frozen=True, eq=False)
class Scanned:
    """Scans, each with its pitch.

    Attributes
    ----------
    placement : int
    readings : tuple of Reading
    pitch : ndarray, shape (len(readings),)
        Radians.
    share : float
        Of a continuous sweep that is done, 0 to 1; NaN at a stop.
    """

    placement: int
    readings: tuple
    pitch: np.ndarray
    share: float = math.nan


@dataclass(frozen=True, eq=False)
class Photographed:
    """An image.

    Attributes
    ----------
    placement : int
        -1 for the board held close.
    camera : str
    frame : Frame
    pitch : float
        Radians.
    purpose : {'board', 'scene', 'intrinsics'}
    """

    placement: int
    camera: str
    frame: object
    pitch: float
    purpose: str


@dataclass(frozen=True)
class Tracked:
    """The pitch over a continuous sweep.

    Attributes
    ----------
    placement : int
    commanded : float
        Where the sweep was sent, radians.
    track : tuple of (float, float, bool)
        Host time, pitch in radians, measured.
    """

    placement: int
    commanded: float
    track: tuple
