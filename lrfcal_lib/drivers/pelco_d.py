"""Pelco-D: frames, angles and answers, and the half-duplex line to a head."""

import contextlib
import logging
import math
from dataclasses import dataclass

from lrfcal_lib.drivers.port import REAL, LineLost, PortError, line_lost

LOG = logging.getLogger(__name__)
SYNC = 0xFF
FRAME, GENERAL, SHORT = 7, 4, 5  # bytes of a frame and of the kinds of reply
UP, DOWN = 0x08, 0x10  # bits of command 2; without them, and those of the pan, it is a stop
FASTEST = 0x3F  # speed byte; 0 is very slow, not stop
SET_TILT = 0x4D
QUERY_PAN, QUERY_TILT, QUERY_ZOOM, QUERY_MAGNIFICATION = 0x51, 0x53, 0x55, 0x61
PAN, TILT, ZOOM, MAGNIFICATION = 0x59, 0x5B, 0x5D, 0x63  # replies
ANSWER = {QUERY_PAN: PAN, QUERY_TILT: TILT, QUERY_ZOOM: ZOOM, QUERY_MAGNIFICATION: MAGNIFICATION}
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
class Reply:
    """One reply of a head, by the length of what was received.

    7 bytes answer a query, so do 5 bytes, the same without sync and address; 4 bytes confirm a command, their value is
    a byte of alarm bits; some heads send the one byte 0x01.
    """

    raw: bytes
    address: int | None = None
    opcode: int | None = None
    value: int | None = None


@dataclass(frozen=True)
class Received:
    """What came back after a frame was sent."""

    replies: tuple
    echoed: int  # bytes of the own frame that a two-wire adapter handed back
    skipped: int  # bytes that belong to nothing


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


def split_replies(data, sent=b"", *, complete=False):
    """What a head, and an adapter that echoes, sent back after one frame, as Received.

    Every place is tried by length and checksum, the longer kinds first; a place that fits none is skipped. Frames of
    other senders count as skipped. The checksum of 4-byte replies continues that of the frame `sent`, and its echo,
    whole or one end of it, is told from replies by comparison with it. `complete`: nothing more will come, so that what
    could still grow is decided now; otherwise it is left out.
    """
    data, sent = bytes(data), bytes(sent)
    replies, echoed, skipped = [], 0, 0
    while data and (complete or not _may_grow(data, sent)):
        echo = _echo(data, sent, first=not replies and not echoed)
        reply = None if echo else _reply(data, sent)
        replies += [reply] if reply else []
        echoed += echo
        skipped += not echo and not reply
        data = data[echo or (len(reply.raw) if reply else 1) :]
    return Received(tuple(replies), echoed, skipped)


def _may_grow(data, sent):
    """Whether the last bytes are the beginning of something longer."""
    if sent.startswith(data) and len(data) < len(sent):
        return True
    if data[0] == SYNC:
        return len(data) < GENERAL or len(data) < FRAME and data[2] == 0 and data[3] in ANSWER.values()
    return data == b"\x01"


def _echo(data, sent, first):
    """Number of bytes of the own frame here: all of it, or one end of it where only noise came before."""
    if data.startswith(sent):
        return len(sent)
    if first and sent.startswith(data):
        return len(data)
    if not first or _reply(data, sent, alone=False):
        return 0
    return next((n for n in range(len(sent) - 1, 0, -1) if data.startswith(sent[-n:])), 0)


def _reply(data, sent, alone=True):
    """The reply that begins here, or None."""
    if data[0] == SYNC and len(data) >= FRAME and (answer := _answer(data[1:FRAME])):
        return Reply(data[:FRAME], data[1], *answer)
    if data[0] == SYNC and len(data) >= GENERAL and len(sent) == FRAME and data[3] == (sent[6] + data[2]) & 0xFF:
        return Reply(data[:GENERAL], data[1], value=data[2])
    if len(data) >= SHORT and (answer := _answer(data[:SHORT])):
        return Reply(data[:SHORT], None, *answer)
    return Reply(data) if alone and data == b"\x01" else None


def _answer(raw):
    """Opcode and value of an answer that ends in 0, opcode, value, checksum, else None; angles end at 359.99 deg."""
    opcode, value = raw[-4], int.from_bytes(raw[-3:-1], "big")
    sensible = opcode in (ZOOM, MAGNIFICATION) or opcode in (PAN, TILT) and value < TURN
    return (opcode, value) if sensible and raw[-5] == 0 and raw[-1] == sum(raw[:-1]) & 0xFF else None


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
        frame, mine = encode_extended(self.settings.address, QUERY_TILT), (None, self.settings.address)

        def tilts(received):
            """Numbers of the tilt replies among others; 5-byte replies carry no address."""
            return [one.value for one in received.replies if one.opcode == TILT and one.address in mine]

        for _ in range(1 + retries + self._late):
            with self.lock:
                suspect, begun = self._late, self.host.now()
                told = tilts(self._exchange(frame, tilts, self.settings.reply_s, again=True))
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
                acknowledged = self._exchange(self._stop, again=True).replies
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

    def _exchange(self, frame, found=lambda received: received.replies, wait_s=None, *, again=False):
        """Send a frame, `again` where the port was lost and came back, and collect what is Received.

        The wait (by default that of an acknowledgement) counts from the end of the transmission of the frame, and of
        the reply; ``found(received)`` ends it.
        """
        with self.lock:
            self.host.sleep(max(0.0, self._free - self.host.now()))
            data, over, received = b"", False, Received((), 0, 0)
            try:
                with line_lost(self.path):
                    port = self.opened()
                    port.reset_input_buffer()
                    port.write(frame)
                    self._sent = self.host.now()
                    end = self._sent + self.wire_s(len(frame) + FRAME) + (wait_s or self.settings.gap_s)
                    while not over and not found(received):
                        data += port.read(max(1, min(port.in_waiting, MOST)))
                        over = self.host.now() >= end or len(data) >= MOST
                        received = split_replies(data, frame[:FRAME], complete=over)
            except LineLost:
                LOG.warning("the line %s to the head is lost", self.path)
                there = self._port is not None  # else it did not come back
                self.close()
                if not (again and there):
                    raise
                return self._exchange(frame, found, wait_s)
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
