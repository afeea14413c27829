"""What is found about a calibration and the recording behind it."""

from dataclasses import dataclass
from enum import StrEnum


class Answer(StrEnum):
    """Whether a calibration can be trusted."""

    YES = "yes"
    CARE = "with care"
    NO = "no"


YES, CARE, NO = Answer


class Kind(StrEnum):
    """What a finding is about, beside the kinds of :class:`lrfcal_lib.session.faults.Fault`."""

    # the result
    HANDED_OVER = "handed over"
    CONVERGENCE = "convergence"
    UNOBSERVABLE = "unobservable"
    SECOND_MINIMUM = "second minimum"
    ERROR = "error"
    # the recorded placements
    PLACEMENTS = "placements"
    CAMERAS = "cameras"
    LEFT_OUT = "left out"
    EXCLUDED = "excluded"
    DISTANCE = "distance"
    PITCH = "pitch"
    IMAGE_PITCH = "image pitch"
    # residuals
    MISFIT = "misfit"
    MODEL_ERROR = "model error"
    NOISE = "noise"
    DEPENDENT = "dependent"
    # what is stated
    SQUARES = "squares"
    OUTLINE = "outline"
    RANGES = "ranges"
    BEARINGS = "bearings"
    SPOT = "spot"
    LAG = "lag"
    RANGE_OFFSET = "range offset"
    PITCH_SCALE = "pitch scale"
    FAR_FROM_STATED = "far from stated"
    NOT_WEIGHED = "not weighed"
    LENS = "lens"


@dataclass(frozen=True)
class Finding:
    """Why a calibration is not simply to be trusted.

    Attributes
    ----------
    answer : {'with care', 'no'}
        What it alone would make of the verdict.
    kind : str
        Of :class:`Kind` or of :class:`lrfcal_lib.session.faults.Fault`.
    words : str
        What is found, and what to do about it.
    """

    answer: Answer
    kind: str
    words: str


def brief(value: float) -> str:
    """A number with two digits, or more before the point."""
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.2g}"


def no_if(severe: bool) -> Answer:
    """What a finding makes of the verdict: 'no' where it is severe, else 'with care'."""
    return NO if severe else CARE


def by_sign(value: float, positive: str, negative: str) -> str:
    """One of two words by the sign of a value."""
    return positive if value > 0 else negative
