"""What is found about a calibration and the recording behind it, and what that makes of it."""

# whether a calibration can be trusted
YES = "yes"
CARE = "with care"
NO = "no"
ANSWERS = {False: CARE, True: NO}  # by whether the worst Fault is severe


def brief(value: float) -> str:
    """A number with two digits, or more before the point."""
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.2g}"


def by_sign(value: float, positive: str, negative: str) -> str:
    """One of two words by the sign of a value."""
    return positive if value > 0 else negative
