"""What is assumed about a pan-tilt head: every assumption is a setting."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lrfcal_lib.drivers.pelco_d import FASTEST
from lrfcal_lib.drivers.stated import FLAG, check, either, listed, number, one_of, whole

PERHAPS = one_of("auto", True, False)
ANGLE, SPEED, SECONDS = number(-180, 180, "deg"), number(0.01, 360, "deg/s"), number(0, 60, "s")
HEAD = {
    "address": whole(0, 255), "baudrate": whole(50, 4_000_000), "feedback": PERHAPS, "absolute": PERHAPS,
    "echo": PERHAPS, "pitch_limits_deg": listed(ANGLE, 2), "position_zero_deg": number(-360, 360, "deg"),
    "invert": FLAG, "tilt_speed": whole(0, FASTEST), "degrees_per_second": either(SPEED, listed(SPEED, 2)),
    "start_delay_s": number(-10, 10, "s"), "start_pitch_deg": ANGLE, "tolerance_deg": number(1e-4, 45, "deg"),
    "arrival_deg": number(1e-4, 45, "deg"), "settle_s": SECONDS, "stall_s": SECONDS, "poll_s": SECONDS,
    "reply_s": number(1e-3, 10, "s"), "gap_s": number(0, 10, "s"), "retries": whole(0, 20), "sends": whole(1, 20),
    "repeat_s": number(1e-3, 60, "s"), "reconnect_s": number(0, 3600, "s"),
}  # fmt: skip


@dataclass(frozen=True)
class HeadSettings:
    """Settings of a Pelco-D head. Nothing is published about the Ya An YA3050, so all defaults are assumptions.

    Attributes
    ----------
    address : int
        1, the usual factory setting of the DIP switches.
    baudrate : int
        2400, the most common default; 9600 is the next.
    feedback : "auto" or bool
        Whether it tells its tilt (query 53). "auto" asks; most cheap heads never answer. A rig file that does not
        state it means true: a silent head may as well be one with another address or rate.
    absolute : "auto" or bool
        Whether it obeys set-tilt (4D). "auto" tries where there is feedback; else up and down are used.
    echo : "auto" or bool
        Whether the adapter hands sent bytes back, as two-wire RS-485 may. Echoes are always removed; True makes a
        missing one an error (the adapter is dead), False makes one a warning.
    pitch_limits_deg : (float, float)
        Asking for more is an error. The protocol knows no limits; typical heads tilt by -90 to 90.
    position_zero_deg : float
        Elevation that the head tells at pitch 0.
    invert : bool
        The head hangs upside down, or counts its tilt the other way: its "up" lowers the view.
    tilt_speed : int
        Speed byte, 0 (very slow) to 0x3F; 0x20 is half of it.
    degrees_per_second : float, (float, float) or None
        Speed at `tilt_speed`, both ways or (up, down). None: 4 is assumed, as of constant-speed heads, until it was
        calibrated or learnt, and the log says so.
    start_delay_s : float
        From the motion frame to the movement, less what it runs on after the stop; calibrated together with the speed.
    start_pitch_deg : float
        Where a head without feedback stands when it is opened: 0, levelled by hand.
    tolerance_deg : float
        Readings that differ by less are the same: heads tell 0.01, cheap encoders jitter by more.
    arrival_deg : float
        A move that ends this near has arrived; its settled pitch is returned and counts.
    settle_s : float
        The head rests when its readings stay the same for this long.
    stall_s : float
        Rest away from where it was sent for this long means that it does not get there.
    poll_s : float
        Between queries while it moves.
    reply_s : float
        A reply begins within this time after the query was sent (0.35 in use elsewhere, 1 by slow heads).
    gap_s : float
        Silence kept between frames, and time left for an acknowledgement (0.05 in use elsewhere).
    retries : int
        Queries repeated when no reply came.
    sends : int
        Motion frames are sent this often in a row: 2 on weak lines. Stops are sent twice or more in any case.
    repeat_s : float or None
        Motion frames are repeated at this interval: below 1 for heads that stop by themselves without.
    reconnect_s : float
        A call waits this long for a vanished port to come back.

    Raises
    ------
    ValueError
        For values that no head can have.
    """

    address: int = 1
    baudrate: int = 2400
    feedback: str | bool = "auto"
    absolute: str | bool = "auto"
    echo: str | bool = "auto"
    pitch_limits_deg: tuple[float, float] = (-60.0, 60.0)
    position_zero_deg: float = 0.0
    invert: bool = False
    tilt_speed: int = 0x20
    degrees_per_second: float | tuple[float, float] | None = None
    start_delay_s: float = 0.0
    start_pitch_deg: float = 0.0
    tolerance_deg: float = 0.1
    arrival_deg: float = 0.5
    settle_s: float = 0.3
    stall_s: float = 1.5
    poll_s: float = 0.1
    reply_s: float = 0.35
    gap_s: float = 0.05
    retries: int = 3
    sends: int = 1
    repeat_s: float | None = None
    reconnect_s: float = 3.0

    def __post_init__(self):
        check(vars(self), HEAD, "head")
        low, high = self.pitch_limits_deg
        if low >= high:
            raise ValueError(f"head.pitch_limits_deg is {low:g} to {high:g}: the lower one comes first")

    @property
    def speeds_deg(self):
        """Degrees per second (up, down) at `tilt_speed`; 4 where none is stated."""
        speed = 4.0 if self.degrees_per_second is None else self.degrees_per_second
        return tuple(speed) if isinstance(speed, (tuple, list)) else (speed, speed)

    def elevation(self, pitch):
        """What the head calls a pitch, rad."""
        return math.radians(self.position_zero_deg) + (-pitch if self.invert else pitch)

    def pitch(self, elevation):
        """The pitch of an elevation that the head tells, rad, in [-pi, pi)."""
        turn = elevation - math.radians(self.position_zero_deg)
        turn = (turn + math.pi) % (2 * math.pi) - math.pi
        return -turn if self.invert else turn
