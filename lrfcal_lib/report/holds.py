"""The command ``check --calibration``: does a calibration still hold, in words."""

from pathlib import Path

import numpy as np

from lrfcal_lib.calibrate.calibration_file import load_calibration
from lrfcal_lib.measure.holds import Answer, Held, Passes, Shift, Wall, holds
from lrfcal_lib.session.read import Session
from lrfcal_lib.session.shown import printable

EXIT = {Answer.HOLDS: 0, Answer.UNKNOWN: 2, Answer.MOVED: 3}
BENT = 3.0  # times what is allowed, of a wall
SURE = 3.0  # sigma, of two passes


def check_calibration(session: Session, calibration: str | Path) -> int:
    """Print whether a calibration still holds for the rig that recorded a session.

    Parameters
    ----------
    session : Session
    calibration : path-like
        ``calibration.json`` of the same rig.

    Returns
    -------
    int
        0 where it holds, 3 where something has moved, 2 where that cannot be told.

    Raises
    ------
    ValueError
        For a calibration or a session that cannot be used.
    """
    held = holds(session, load_calibration(calibration))
    print("\n".join(held_in_words(held, printable(str(calibration)))))
    return EXIT[held.answer]


def held_in_words(held: Held, name: str = "the calibration") -> list[str]:
    """The verdict first, then what it rests on, a sentence each.

    Parameters
    ----------
    held : Held
    name : str
        Of the calibration.
    """
    first = {
        Answer.HOLDS: f"{name}: holds",
        Answer.MOVED: f"{name}: {_who(held.culprit)} has moved: recalibrate",
        Answer.UNKNOWN: f"{name}: cannot be told here: {_why_not(held)}",
    }
    lines = [first[held.answer]]
    lines += [_shift_in_words(shift) for shift in held.shifts]
    lines.append(
        f"from {held.rims:.0f} rims of depth against edges of images, and {held.regions:.0f} "
        "regions of surfaces that two images show"
    )
    if held.all_on_head:
        lines.append(
            "all cameras are on the head: a slip of the head only turns the whole cloud, nothing "
            "here can show it"
        )
    lines += [_wall_in_words(wall) for wall in held.walls if np.isfinite(wall.bend)]
    lines += [_passes_in_words(passes) for passes in held.passes]
    return lines


def _who(culprit: Shift | None):
    """The name of what has moved."""
    return "nothing" if culprit is None else _name(culprit)


def _name(shift):
    """Of a suspect."""
    return "the head" if shift.camera is None else f"camera '{shift.camera}'"


def _why_not(held):
    """What a scene lacks."""
    unsure = [_name(shift) for shift in held.shifts if not shift.told]
    if not held.shifts:
        return "no image shows an edge near a jump of depth, or a surface that another image shows"
    if unsure:
        return (
            f"a turn of 0.3 deg of {' or '.join(unsure)} would not show; record a room with "
            "furniture and pictures, 1 to 4 m away, from two places or more"
        )
    return (
        f"{held.rims:.0f} rims and {held.regions:.0f} regions are too few; record a room with "
        "furniture and pictures, 1 to 4 m away"
    )


def _shift_in_words(shift):
    """What was found about a camera, or the head."""
    chance = f"by chance with a probability of {shift.p_value:.2g}"
    if shift.camera is None:
        turn, sigma = np.degrees([shift.change[0], shift.sigma[0]])
        return f"the head, if only it slipped: by {turn:+.2f} +- {sigma:.2f} deg; {chance}"
    right, down, _ = shift.pixels
    turn = np.degrees(shift.pixels[2])
    sigma = shift.pixels_sigma
    return (
        f"camera '{shift.camera}', if only it moved: image {right:+.2f} +- {sigma[0]:.2f} px to "
        f"the right, {down:+.2f} +- {sigma[1]:.2f} px down (3 m away), turned by {turn:+.2f} +- "
        f"{np.degrees(sigma[2]):.2f} deg; {chance}"
    )


def _wall_in_words(wall: Wall):
    """How flat a wall is."""
    bend = 1000 * wall.bend
    allowed = 1000 * wall.allowed
    words = f"placement {wall.placement}: the largest plane is flat to {bend:.1f} mm"
    if wall.bend > BENT * wall.allowed:
        return (
            f"{words}, where {allowed:.1f} mm are allowed: the axis, the ranges or the wall"
        )
    return f"{words} ({allowed:.1f} mm are allowed)"


def _passes_in_words(passes: Passes):
    """What two sweeps of one place say."""
    slip, sigma = np.degrees([passes.slip, passes.sigma])
    words = (
        "the head hangs back or slips"
        if abs(slip) > SURE * sigma
        else "no more than chance"
    )
    first, second = passes.placements
    return f"placements {first} and {second}, up and down: {slip:+.3f} +- {sigma:.3f} deg, {words}"
