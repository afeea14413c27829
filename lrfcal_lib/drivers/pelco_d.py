"""Pelco-D: frames, angles and answers, and the half-duplex line to a head."""

import contextlib
import logging
import math
from dataclasses import dataclass

from lrfcal_lib.drivers.port import REAL, LineLost, PortError, line_lost

LOG = logging.getLogger(__name__)
SYNC = 0xFF
FRAME, SHORT, GENERAL = 7, 5, 4  # bytes of a frame, of a short reply, of a confirmation
UP, DOWN = 0x08, 0x10  # bits of command 2; without them, and those of the pan, it is a stop
FASTEST = 0x3F  # speed byte; 0 is very slow, not stop
SET_TILT = 0x4D
QUERY_TILT, TILT = 0x53, 0x5B  # and its reply
TURN = 36000  # hundredths of a degree


@dataclass(frozen=True)
class Frame:
    """A frame without sync byte and checksum. An odd `command2` is the opcode of an extended command or reply."""

    address: int
    command1: int = 0
    command2: int = 0
    data1: int = 0
    data2: int = 0

    value = property(lambda self: self.data1 << 8 | self.data2, doc="Number of both data bytes.")


@dataclass(frozen=True)
class Received:
    """What came back after a frame was sent."""

    tilts: tuple = ()  # numbers of the replies that tell the tilt
    acknowledged: bool = False
    echoed: int = 0  # bytes of the own frame that a two-wire adapter handed back
    skipped: int = 0  # bytes that belong to nothing


def encode_frame(address, command1=0, command2=0, data1=0, data2=0):
    """The 7 bytes of a frame, all 0 that of a stop; a motion is obeyed until the next one, a stop, or the head's limit.

    ValueError for numbers that are no bytes.
    """
    body = bytes([address, command1, command2, data1, data2])
    return bytes([SYNC, *body, sum(body) & 0xFF])


def encode_extended(address, opcode, value=0):
    """Bytes of an extended command, whose opcode is odd: a preset, a position, a query."""
    return encode_frame(address, 0, opcode, *value.to_bytes(2, "big"))


def split_frames(data):
    """The Frames in a stream of commands, of overlapping ones the first, and from where on bytes must be kept.

    A frame may begin there whose end has not come yet.
    """
    data, frames, at = bytes(data), [], 0
    while (at := data.find(SYNC, at)) >= 0 and at + FRAME <= len(data):
        good = data[at + 6] == sum(data[at + 1 : at + 6]) & 0xFF
        if good:
            frames.append(Frame(*data[at + 1 : at + 6]))
        at += FRAME if good else 1
    return tuple(frames), at if at >= 0 else len(data)


def encode_tilt(elevation):
    """Number of the set-tilt command for finite radians, up positive.

    Hundredths of a degree, 0 to 35999: 0 level, 9000 straight down, 33000 30 deg up.
    """
    return round(-math.degrees(elevation) * 100) % TURN


def decode_tilt(value):
    """Elevation of a head's tilt reply, radians in [-pi, pi): the inverse of :func:`encode_tilt`."""
    return -math.radians((value if value <= TURN // 2 else value - TURN) / 100)


def tilt_in(raw, address):
    """Number of the frame with which the head of an address tells its tilt, in a tuple; angles end at 359.99 deg."""
    return tuple(
        frame.value for frame in split_frames(raw)[0]
        if (frame.address, frame.command1, frame.command2) == (address, 0, TILT) and frame.value < TURN
    )  # fmt: skip


def split_replies(data, sent):
    """What a head, and an adapter that echoes, sent back after one frame, as Received.

    7 bytes answer a query, so do 5 bytes, the same without sync and address; 4 bytes confirm a command: a byte of alarm
    bits, and a checksum that continues that of the command. Every place is tried, and one that fits nothing is skipped;
    so are frames of other senders, and the single byte 01 of some heads. What looks like a confirmation may as well be
    the beginning of an echo, and is none then; of echoes the beginning may be lost.
    """
    tilts, acknowledged, echoed, skipped = [], False, 0, 0
    while data:
        short, size, fresh = data[:GENERAL], 1, not (tilts or acknowledged or echoed or skipped)
        if data.startswith(sent):
            echoed += (size := FRAME)
        elif found := tilt_in(data[:FRAME], sent[1]) or tilt_in(bytes([SYNC, 0]) + data[:SHORT], 0):
            tilts, size = [*tilts, *found], FRAME if data[0] else SHORT
        elif (len(short) == GENERAL and sent[3] != QUERY_TILT and not sent.startswith(short)
              and short[0] == SYNC and short[3] == (sent[6] + short[2]) & 0xFF):  # fmt: skip
            acknowledged, size = True, GENERAL
        elif fresh and (end := next((n for n in range(FRAME - 1, 0, -1) if data.startswith(sent[-n:])), 0)):
            echoed += (size := end)
        else:
            skipped += 1
        data = data[size:]
    return Received(tuple(tilts), acknowledged, echoed, skipped)


READ_S = 0.02  # longest wait for single bytes, so that no read overshoots a deadline by more
MOST = 512  # bytes looked at after a frame: a head sends up to 18, the rest is another device


class HeadLine:
    """Line to one head; a lock keeps threads apart. Calls raise LineLost if the port vanished and did not come back.

    `counts` has frames sent, bytes echoed and skipped, and reconnects.
    """

    def __init__(self, path, settings, host=REAL):
        self.path, self.settings, self.host = path, settings, host
        self.counts = dict.fromkeys(("frames", "echoed", "skipped", "reconnects"), 0)
        self.lock, self._stop, self._port = host.lock(), encode_frame(settings.address), None
        self._free, self._sent, self._late, self._acknowledges = 0.0, 0.0, False, False
        self._open()

    def _open(self):
        self._port = self.host.port(self.path, self.settings.baudrate, timeout=READ_S)

    def wire_s(self, count=FRAME):
        """Seconds that bytes take on the line."""
        return count * 10 / self.settings.baudrate

    # -------------------------------------------------------------------------------------------------- frames

    def pitch(self, retries):
        """Instant of the host and pitch that the head tells, rad; None if no reply came.

        After a time-out the next reply may be the late one, so it is thrown away and the head asked again. The head
        looks at its encoder about half-way between the beginning of the query and the end of the reply.
        """
        frame = encode_extended(self.settings.address, QUERY_TILT)
        for _ in range(1 + retries + self._late):
            with self.lock:
                suspect, begun = self._late, self.host.now()
                told = self._exchange(frame, self.settings.reply_s, again=True).tilts
                self._late = not told
            if told and not suspect:
                return (begun + self.host.now()) / 2, self.settings.pitch(decode_tilt(told[-1]))
        return None

    def command(self, frame):
        """Send a frame that a head may acknowledge; the host's instant at which it was sent.

        If the port vanished it is not sent again, because its time has passed.
        """
        with self.lock:
            self._exchange(frame * self.settings.sends)
            return self._sent

    def stop(self):
        """Send the stop until it is acknowledged, at least twice by heads that acknowledge nothing; its instant."""
        instants = []
        for _ in range(2 + self.settings.retries * self._acknowledges):
            with self.lock:
                acknowledged = self._exchange(self._stop, again=True).acknowledged
                instants.append(self._sent)
            if acknowledged:
                self._acknowledges = True
                break
        return instants[0]

    def blurt_stop(self):
        """Send the stop at once, whatever another thread is doing on the line; errors are logged, not raised."""
        held = self.lock.acquire(timeout=0.5)
        try:
            with line_lost(self.path):
                for _ in range(2):
                    self.opened().write(self._stop)
                    self.host.sleep(self.wire_s() + self.settings.gap_s)
        except Exception as error:  # on the way out nothing else can be done
            LOG.error("the head could not be stopped (%s): cut its power if it moves", error)
        finally:
            if held:
                self.lock.release()

    def _exchange(self, frame, wait_s=None, *, again=False):
        """Send a frame, `again` where the port was lost and came back, and collect what is Received until a reply.

        The wait (by default that of an acknowledgement) counts from the end of the transmission of frame and reply.
        """
        with self.lock:
            self.host.sleep(max(0.0, self._free - self.host.now()))
            data, received = b"", Received()
            try:
                with line_lost(self.path):
                    port = self.opened()
                    port.reset_input_buffer()
                    port.write(frame)
                    self._sent = self.host.now()
                    end = self._sent + self.wire_s(len(frame) + FRAME) + (wait_s or self.settings.gap_s)
                    while not (received.tilts or received.acknowledged or self.host.now() >= end or len(data) >= MOST):
                        data += port.read(max(1, min(port.in_waiting, MOST)))
                        received = split_replies(data, frame[:FRAME])
            except LineLost:
                LOG.warning("the line %s to the head is lost", self.path)
                there = self._port is not None  # else it did not come back
                self.close()
                if not (again and there):
                    raise
                return self._exchange(frame, wait_s)
            self._free = max(self.host.now(), self._sent + self.wire_s(len(frame))) + self.settings.gap_s
            for name, count in (("frames", 1), ("echoed", received.echoed), ("skipped", received.skipped)):
                self.counts[name] += count
            return received

    # ---------------------------------------------------------------------------------------------------- port

    def opened(self):
        """The port; after it was lost it is waited for, and the head, which went on with what it was told, stopped."""
        with self.lock, line_lost(self.path):
            deadline = self.host.now() + self.settings.reconnect_s
            while self._port is None:
                try:
                    self._open()
                except PortError as error:
                    if self.host.now() >= deadline:
                        raise LineLost(f"the head's line is lost: {error}") from error
                    self.host.sleep(0.05)
                    continue
                self.counts["reconnects"] += 1
                LOG.warning("the line %s to the head is back", self.path)
                self._port.write(self._stop * 2)
                self.host.sleep(self.wire_s(2 * FRAME) + self.settings.gap_s)
            return self._port

    def close(self):
        """Close the port; nothing is sent."""
        with self.lock, contextlib.suppress(Exception):
            port, self._port = self._port, None
            port.close()
