"""Pelco-D: frames, angles and answers, and the half-duplex line to a head."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass

from lrfcal_lib.drivers.host import REAL
from lrfcal_lib.drivers.port import LineLost, PortError, line_lost

SYNC = 0xFF
FRAME, GENERAL, SHORT, PART_NUMBER_REPLY = 7, 4, 5, 18  # bytes of a frame and of the kinds of reply
RIGHT, LEFT, UP, DOWN = 0x02, 0x04, 0x08, 0x10  # bits of command 2
FASTEST, TURBO = 0x3F, 0x40  # speed bytes; turbo is for pan alone, and 0 is very slow, not stop
SET_PRESET, CLEAR_PRESET, GO_PRESET, RESET = 0x03, 0x05, 0x07, 0x0F
PART_NUMBER, ZERO_PAN, SET_PAN, SET_TILT = 0x45, 0x49, 0x4B, 0x4D
QUERY_PAN, QUERY_TILT, QUERY_ZOOM, QUERY_MAGNIFICATION = 0x51, 0x53, 0x55, 0x61
PAN, TILT, ZOOM, MAGNIFICATION = 0x59, 0x5B, 0x5D, 0x63  # replies
ANSWER = {QUERY_PAN: PAN, QUERY_TILT: TILT, QUERY_ZOOM: ZOOM, QUERY_MAGNIFICATION: MAGNIFICATION}
ANSWERS = frozenset(ANSWER.values())
TURN = 36000  # hundredths of a degree


class FrameError(ValueError):
    """Bytes that are no frame, or a number that no frame can carry."""


@dataclass(frozen=True)
class Frame:
    """A frame without sync byte and checksum.

    Attributes
    ----------
    address, command1, command2, data1, data2 : int
        Bytes. An odd `command2` is the opcode of an extended command or reply.
    """

    address: int
    command1: int = 0
    command2: int = 0
    data1: int = 0
    data2: int = 0

    @property
    def value(self):
        """Number of both data bytes."""
        return self.data1 << 8 | self.data2


@dataclass(frozen=True)
class Reply:
    """One reply of a head.

    Attributes
    ----------
    kind : str
        "extended" (7 bytes), "short" (the same without sync and address, 5 bytes), "general" (4 bytes),
        "part number" (18 bytes) or "success" (the one byte 0x01 that some heads send).
    raw : bytes
        As received.
    address : int or None
        None where the reply has none.
    opcode, value : int or None
        Of "extended" and "short"; the value of "general" is its byte of alarm bits.
    text : str
        Of "part number".
    """

    kind: str
    raw: bytes
    address: int | None = None
    opcode: int | None = None
    value: int | None = None
    text: str = ""


@dataclass(frozen=True)
class Received:
    """What lies in the bytes that came back after a frame was sent.

    Attributes
    ----------
    replies : tuple of Reply
    echoed : int
        Bytes of the own frame that a two-wire adapter handed back.
    skipped : int
        Bytes that belong to nothing.
    """

    replies: tuple
    echoed: int
    skipped: int


def encode_frame(address, command1=0, command2=0, data1=0, data2=0):
    """Bytes of a frame.

    Parameters
    ----------
    address, command1, command2, data1, data2 : int

    Returns
    -------
    bytes, length 7

    Raises
    ------
    FrameError
        For numbers that are no bytes.
    """
    body = pack_bytes(address=address, command1=command1, command2=command2, data1=data1, data2=data2)
    return bytes([SYNC]) + body + bytes([sum(body) & 0xFF])


def pack_bytes(**numbers):
    """Named numbers as bytes; FrameError names the one that is none."""
    for name, number in numbers.items():
        if not 0 <= number <= 0xFF:
            raise FrameError(f"{name} must be a byte, 0 to 255, got {number}")
    return bytes(numbers.values())


def encode_motion(address, *, pan=0, tilt=0, pan_speed=0x20, tilt_speed=0x20):
    """Bytes of a motion frame, obeyed until the next one, a stop, or the head's limit.

    Parameters
    ----------
    address : int
    pan : int
        Only the sign counts: > 0 right, < 0 left, 0 no pan.
    tilt : int
        > 0 up, < 0 down, 0 no tilt. Both 0 is the stop, whatever the speeds are.
    pan_speed, tilt_speed : int
        0 (very slow, but moving) to 0x3F; 0x40 is turbo, for pan alone.

    Returns
    -------
    bytes, length 7

    Raises
    ------
    FrameError
        For a speed or an address that no frame can carry.
    """
    for speed, top, name in ((pan_speed, TURBO, "pan_speed"), (tilt_speed, FASTEST, "tilt_speed")):
        if not 0 <= speed <= top:
            raise FrameError(f"{name} must be 0 to {top}, got {speed}")
    bits = (RIGHT if pan > 0 else LEFT if pan < 0 else 0) | (UP if tilt > 0 else DOWN if tilt < 0 else 0)
    return encode_frame(address, 0, bits, pan_speed if pan else 0, tilt_speed if tilt else 0)


def encode_stop(address):
    """Bytes of the frame that stops all motion."""
    return encode_frame(address)


def encode_extended(address, opcode, value=0):
    """Bytes of an extended command: a preset, a position, a query.

    Parameters
    ----------
    address, opcode : int
    value : int
        0 to 65535, big-endian in the frame.

    Returns
    -------
    bytes, length 7

    Raises
    ------
    FrameError
        If `opcode` is even (then it would be a motion), or a number does not fit.
    """
    if not opcode & 1:
        raise FrameError(f"extended commands have odd opcodes, got {opcode:#04x}")
    if not 0 <= value <= 0xFFFF:
        raise FrameError(f"the value of an extended command is 0 to 65535, got {value}")
    return encode_frame(address, 0, opcode, *value.to_bytes(2, "big"))


def parse_frame(raw):
    """Take sync byte and checksum off one frame.

    Parameters
    ----------
    raw : bytes-like, length 7

    Returns
    -------
    Frame

    Raises
    ------
    FrameError
        If length, sync byte or checksum is wrong.
    """
    raw = bytes(raw)
    if len(raw) != FRAME or raw[0] != SYNC:
        raise FrameError(f"a frame is FF and 6 more bytes, got {raw[:8].hex(' ') or 'none'}")
    if raw[6] != sum(raw[1:6]) & 0xFF:
        raise FrameError(f"checksum {raw[6]:02X} sent, {sum(raw[1:6]) & 0xFF:02X} computed: damaged on the line")
    return Frame(*raw[1:6])


def split_frames(data):
    """Find the frames in a stream of commands, whatever lies between them.

    Parameters
    ----------
    data : bytes-like

    Returns
    -------
    frames : tuple of Frame
        Of any address and opcode; of overlapping ones the first.
    pending : int
        Bytes from here on must be kept: a frame may begin there whose end has not come yet.
    """
    data, frames, at = bytes(data), [], 0
    while (at := data.find(SYNC, at)) >= 0 and at + FRAME <= len(data):
        good = data[at + 6] == sum(data[at + 1 : at + 6]) & 0xFF
        if good:
            frames.append(Frame(*data[at + 1 : at + 6]))
        at += FRAME if good else 1
    return tuple(frames), at if at >= 0 else len(data)


def encode_tilt(elevation):
    """Number of the set-tilt command: hundredths of a degree, 0 level, 9000 straight down, 33000 30 deg up.

    Parameters
    ----------
    elevation : float
        rad, up positive.

    Returns
    -------
    int, 0 to 35999

    Raises
    ------
    FrameError
        If it is no finite angle.
    """
    if not math.isfinite(elevation):
        raise FrameError(f"the elevation must be a finite angle, got {elevation}")
    return round(-math.degrees(elevation) * 100) % TURN


def decode_tilt(value):
    """Elevation of a head's tilt reply, the inverse of :func:`encode_tilt`.

    Parameters
    ----------
    value : int
        0 to 35999.

    Returns
    -------
    float
        rad, up positive, [-pi, pi).

    Raises
    ------
    FrameError
        If the number is no angle.
    """
    if not 0 <= value < TURN:
        raise FrameError(f"a tilt is 0 to {TURN - 1} hundredths of a degree, got {value}")
    return -math.radians((value if value <= TURN // 2 else value - TURN) / 100)


def split_replies(data, sent=b"", *, complete=False):
    """Find the replies in what a head, and an adapter that echoes, sent back after one frame.

    Parameters
    ----------
    data : bytes-like
        All bytes since the frame was sent, in order.
    sent : bytes-like
        The frame, length 7. The checksums of "general" and "part number" replies continue its checksum, and its echo,
        whole or one end of it, is told from replies by comparison with it. Without it none of these is found.
    complete : bool
        Nothing more will come: what could still grow is decided now. Otherwise it is left out.

    Returns
    -------
    Received

    Notes
    -----
    Every place is tried by length and checksum, the longer kinds first; a place that fits none is skipped. Frames of
    other senders count as skipped.
    """
    data, sent = bytes(data), bytes(sent)
    replies, echoed, skipped, at = [], 0, 0, 0
    while at < len(data):
        if not complete and len(data) - at < PART_NUMBER_REPLY and _may_grow(data[at:], sent):
            break
        echo = _echo_at(data, at, sent, first=not replies and not echoed)
        reply = None if echo else _reply_at(data, at, sent)
        if reply:
            replies.append(reply)
        echoed += echo
        skipped += not echo and not reply
        at += echo or (len(reply.raw) if reply else 1)
    return Received(tuple(replies), echoed, skipped)


def _may_grow(rest, sent):
    """Whether the last bytes are the beginning of something longer."""
    if sent.startswith(rest) and len(rest) < len(sent):
        return True
    if rest[0] == SYNC and sent[3:4] == bytes([PART_NUMBER]):
        return not sent.startswith(rest[:FRAME])
    if rest[0] == SYNC:
        return len(rest) < GENERAL or len(rest) < FRAME and rest[2] == 0 and rest[3] in ANSWERS
    return rest == b"\x01"


def _echo_at(data, at, sent, first):
    """Number of bytes of the own frame here: all of it, or one end of it where only noise came before."""
    if not sent or data.startswith(sent, at):
        return len(sent)
    if first and sent.startswith(data[at : at + FRAME]):
        return len(data) - at
    if not first or _reply_at(data, at, sent, alone=False):
        return 0
    return next((n for n in range(len(sent) - 1, 0, -1) if data.startswith(sent[-n:], at)), 0)


def _reply_at(data, at, sent, alone=True):
    """The reply that begins here, or None."""
    left = len(data) - at
    if data[at] == SYNC:
        if left >= PART_NUMBER_REPLY and len(sent) == FRAME and sent[3] == PART_NUMBER:
            if reply := _part_number(data[at : at + PART_NUMBER_REPLY], sent[6]):
                return reply
        if left >= FRAME and (reply := _extended(data[at : at + FRAME])):
            return reply
        if left >= GENERAL and len(sent) == FRAME and data[at + 3] == (sent[6] + data[at + 2]) & 0xFF:
            return Reply("general", data[at : at + GENERAL], data[at + 1], value=data[at + 2])
    if left >= SHORT and data[at] == 0 and (reply := _short(data[at : at + SHORT])):
        return reply
    return Reply("success", b"\x01") if alone and left == 1 and data[at] == 1 else None


def _part_number(raw, sent_sum):
    good = raw[17] == (sent_sum + sum(raw[1:17])) & 0xFF and raw[2:17].isascii()
    return Reply("part number", raw, raw[1], text=raw[2:17].decode("ascii").strip("\0 ")) if good else None


def _extended(raw):
    if raw[2] or raw[6] != sum(raw[1:6]) & 0xFF or not _sensible(raw[3], raw[4:6]):
        return None
    return Reply("extended", raw, raw[1], raw[3], int.from_bytes(raw[4:6], "big"))


def _short(raw):
    if raw[4] != sum(raw[:4]) & 0xFF or not _sensible(raw[1], raw[2:4]):
        return None
    return Reply("short", raw, None, raw[1], int.from_bytes(raw[2:4], "big"))


def _sensible(opcode, number):
    """Angles end at 359.99 deg: more is noise."""
    return opcode in ANSWERS and (opcode in (ZOOM, MAGNIFICATION) or int.from_bytes(number, "big") < TURN)


READ_S = 0.02  # longest wait for single bytes, so that no read overshoots a deadline by more
MOST = 512  # bytes looked at after a frame: a head sends up to 18, the rest is another device


class HeadLine:
    """Line to one head.

    Parameters
    ----------
    path : str or Path
    settings : HeadSettings
    log : logging.Logger
    host : Host

    Attributes
    ----------
    counts : dict
        'frames' sent, 'replies', 'echoed' and 'skipped' bytes, 'timeouts' of queries, 'reconnects'.
    """

    def __init__(self, path, settings, log, host=REAL):
        self.path, self.settings, self.log, self.host = path, settings, log, host
        self.counts = dict.fromkeys(("frames", "replies", "echoed", "skipped", "timeouts", "reconnects"), 0)
        self.lock = host.lock()
        self.acknowledges = False  # until a stop was acknowledged
        self._free, self._sent, self._late = 0.0, 0.0, False
        self._port = host.port(path, settings.baudrate, timeout=READ_S)

    def wire_s(self, count=FRAME):
        """Seconds that bytes take on the line."""
        return count * 10 / self.settings.baudrate

    @property
    def round_trip_s(self):
        """Longest time of a query that is answered or not."""
        return 2 * self.wire_s() + self.settings.reply_s + self.settings.gap_s + READ_S

    # -------------------------------------------------------------------------------------------------- frames

    def tilt(self, retries=None):
        """Elevation that the head tells.

        Parameters
        ----------
        retries : int, optional
            By default as set.

        Returns
        -------
        (float, float) or None
            Instant of the host of the reading and elevation, rad; None if no reply came.

        Raises
        ------
        LineLost
            If the port vanished and did not come back.

        Notes
        -----
        After a time-out the next reply may be the late one, so it is thrown away and the head asked again.
        The head looks at its encoder about half-way between the beginning of the query and the end of the reply.
        """
        for _ in range(1 + (self.settings.retries if retries is None else retries)):
            with self.lock:
                if self._late and self._ask_tilt() is None:
                    continue
                if (reading := self._ask_tilt()) is not None:
                    return reading
        return None

    def _ask_tilt(self):
        frame, begun = encode_extended(self.settings.address, QUERY_TILT), self.host.now()
        value = self._tilt_of(self.exchange(frame, self._answered, self.settings.reply_s, again=True))
        self._late = value is None
        self.counts["timeouts"] += self._late
        return None if self._late else ((begun + self.host.now()) / 2, decode_tilt(value))

    def _answered(self, received):
        return self._tilt_of(received) is not None

    def _tilt_of(self, received):
        """Number of the tilt reply among others; 5-byte replies carry no address."""
        mine = (None, self.settings.address)
        found = [one.value for one in received.replies if one.opcode == TILT and one.address in mine]
        return found[-1] if found else None

    def command(self, frame):
        """Send a frame that a head may acknowledge.

        Returns
        -------
        (float, bool)
            Instant of the host at which it was sent, and whether it was acknowledged.

        Raises
        ------
        LineLost
            If the port vanished; it is not sent again, because its time has passed.
        """
        with self.lock:
            received = self.exchange(frame * self.settings.sends, lambda found: found.replies, self.settings.gap_s)
            return self._sent, bool(received.replies)

    def stop(self):
        """Send the stop until it is acknowledged, at least twice by heads that acknowledge nothing.

        Returns
        -------
        float
            Instant of the host at which it was first sent.

        Raises
        ------
        LineLost
            If the port vanished and did not come back.
        """
        frame, first = encode_stop(self.settings.address), None
        for _ in range(2 + self.settings.retries * self.acknowledges):
            with self.lock:
                done = self.exchange(frame, lambda found: found.replies, self.settings.gap_s, again=True).replies
                first = first or self._sent
            if done:
                self.acknowledges = True
                break
        return first

    def blurt_stop(self):
        """Send the stop at once, whatever another thread is doing on the line; errors are logged, not raised."""
        held = self.lock.acquire(timeout=0.5)
        try:
            with line_lost(self.path):
                for _ in range(2):
                    self._open().write(encode_stop(self.settings.address))
                    self.host.sleep(self.wire_s() + self.settings.gap_s)
        except Exception as error:  # on the way out nothing else can be done
            self.log.error("the head could not be stopped (%s): cut its power if it moves", error)
        finally:
            if held:
                self.lock.release()

    def exchange(self, frame, found, wait_s, *, again=False):
        """Send a frame and collect what comes back.

        Parameters
        ----------
        frame : bytes
        found : callable
            Told what was received; true ends the wait.
        wait_s : float
            Counted from the end of the transmission of the frame, and of the reply.
        again : bool
            Send it again when the port was lost and came back.

        Returns
        -------
        Received

        Raises
        ------
        LineLost
            If the port vanished.
        """
        with self.lock:
            try:
                return self._exchange(frame, found, wait_s)
            except LineLost:
                self._drop()
                if not again:
                    raise
                self.reopen()
                return self._exchange(frame, found, wait_s)

    def _exchange(self, frame, found, wait_s):
        self.host.sleep(max(0.0, self._free - self.host.now()))
        with line_lost(self.path):
            port = self._open()
            port.reset_input_buffer()
            port.write(frame)
            self._sent = self.host.now()
            deadline = self._sent + self.wire_s(len(frame) + FRAME) + wait_s
            received = self._collect(port, frame[: FRAME], found, deadline)
        self._free = max(self.host.now(), self._sent + self.wire_s(len(frame))) + self.settings.gap_s
        self.counts["frames"] += 1
        self.counts["replies"] += len(received.replies)
        self.counts["echoed"] += received.echoed
        self.counts["skipped"] += received.skipped
        return received

    def _collect(self, port, sent, found, deadline):
        data = b""
        while True:
            over = self.host.now() >= deadline or len(data) >= MOST
            received = split_replies(data, sent, complete=over)
            if over or found(received):
                return received
            data += port.read(max(1, min(port.in_waiting, MOST)))

    # ---------------------------------------------------------------------------------------------------- port

    def _open(self):
        if self._port is None:
            self.reopen()
        return self._port

    def _drop(self):
        """Close the port after its line was lost."""
        if self._port is not None:
            self.log.warning("the line %s to the head is lost", self.path)
            with contextlib.suppress(Exception):
                self._port.close()
        self._port = None

    def reopen(self):
        """Wait for the port to come back, and stop the head, which went on with what it was told last.

        Raises
        ------
        LineLost
            If it does not come back in time.
        """
        with self.lock:
            self._drop()
            deadline = self.host.now() + self.settings.reconnect_s
            while self._port is None:
                try:
                    self._port = self.host.port(self.path, self.settings.baudrate, timeout=READ_S)
                except PortError as error:
                    if self.host.now() >= deadline:
                        raise LineLost(f"the head's line is lost: {error}") from error
                    self.host.sleep(0.05)
            self.counts["reconnects"] += 1
            self.log.warning("the line %s to the head is back", self.path)
            with line_lost(self.path):
                self._port.write(encode_stop(self.settings.address) * 2)
            self._free = self.host.now() + self.wire_s(2 * FRAME) + self.settings.gap_s

    def close(self):
        """Close the port; nothing is sent."""
        with self.lock:
            port, self._port = self._port, None
            if port is not None:
                with contextlib.suppress(Exception):
                    port.close()
