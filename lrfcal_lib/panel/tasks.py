"""What to record next, and where to put the board for it."""

from __future__ import annotations

from dataclasses import dataclass

GUIDE = (
    "about 1.5 m ahead, turned in its plane so that no edge is upright or level",
    "about 1.2 m ahead, a little to the left, turned by a third of a turn, facing left by 30 degrees",
    "about 2 m ahead, a little to the right, turned by another third of a turn, facing right by 30 degrees",
    "about 2.5 m ahead, higher or lower than before, leaning back by 30 degrees",
    "about 1 m ahead, turned by half a turn, leaning forward by 30 degrees",
    "about 1.7 m ahead, at the edge of what all cameras see",
)


@dataclass(frozen=True)
class Task:
    """What is recorded next.

    Attributes
    ----------
    title : str
    guidance : str
        Where to put the board.
    placement : Placement or None
    close : (str, int) or None
        Camera and number of a view of the board held close, for its intrinsics.
    """

    title: str
    guidance: str
    placement: object = None
    close: tuple | None = None


def next_task(recording, advice=""):
    """What to record next.

    Parameters
    ----------
    recording : Recording
    advice : str
        Where to put the board, as far as that was computed.

    Returns
    -------
    Task or None
        None where the plan is done.
    """
    views = recording.close_views_to_do()
    return _close_task(recording, *views[0]) if views else _placement_task(recording, advice)


def _close_task(recording, camera, view):
    wanted = recording.rig.stated.plan.intrinsics_images
    title = f"Close view {view + 1} of {wanted}, camera '{camera}'"
    guidance = "hold the board close, tilted otherwise than before, all of its pattern in the image"
    return Task(title, guidance, close=(camera, view))


def _placement_task(recording, advice):
    left, plan, finished = recording.to_do(), recording.rig.stated.plan, recording.finished
    if not left and not plan.placements:  # nothing is listed: one more can always be had
        left = [p for p in plan.to_do(max(finished) + 1) if p.number not in finished][:1]
    if not left:
        return None
    of, done = max(len(recording.plan), left[0].number), sum(p.number in finished for p in recording.plan)
    return Task(f"Placement {done + 1} of {of}", _where(left[0], done, advice), left[0])


def _where(placement, done, advice):
    """Where to put the board, in words."""
    if placement.purpose == "scene":
        return "take the board away: this sweep shows the room"
    return advice or f"put the board {GUIDE[done % len(GUIDE)]}"
