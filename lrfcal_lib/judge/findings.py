"""What is found about a calibration and the recording behind it, and what that makes of it."""

from enum import StrEnum


class Answer(StrEnum):
    """Whether a calibration can be trusted."""

    YES = "yes"
    CARE = "with care"
    NO = "no"


YES, CARE, NO = Answer
ANSWERS = {False: CARE, True: NO}  # by whether the worst Fault is severe


class Kind(StrEnum):
    """What a :class:`lrfcal_lib.session.faults.Fault` of a calibration is about."""

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


def brief(value: float) -> str:
    """A number with two digits, or more before the point."""
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.2g}"


def by_sign(value: float, positive: str, negative: str) -> str:
    """One of two words by the sign of a value."""
    return positive if value > 0 else negative
