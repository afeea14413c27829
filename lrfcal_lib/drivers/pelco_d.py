"""Pelco-D: frames, angles and answers, and the half-duplex line to a head."""

import contextlib
import logging
import math
from dataclasses import dataclass

from lrfcal_lib.drivers.port import REAL, LineLost, PortError, line_lost

LOG = logging.getLogger(__name__)
SYNC = 0xFF
# bytes
FRAME = 7
SHORT = 5  # a short reply
GENERAL = 4  # a confirmation
# bits of command 2; without them, and those of the pan, it is a stop
UP = 0x08
DOWN = 0x10
FASTEST = 0x3F  # speed byte; 0 is very slow, not stop
SET_TILT = 0x4D
QUERY_TILT = 0x53
TILT = 0x5B  # its reply
TURN = 36000  # hundredths of a degree


@dataclass(frozen=True)
class Frame:
    """A frame without sync byte and checksum.

    An odd `command2` is the opcode of an extended command or reply.
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
class Received:
    """What came back after a frame was sent."""

    tilts: tuple = ()  # numbers of the replies that tell the tilt
    acknowledged: bool = False
    echoed: int = 0  # bytes of the own frame that a two-wire adapter handed back
    skipped: int = 0  # bytes that belong to nothing


def encode_frame(address, command1=0, command2=0, data1=0, data2=0):
    """The 7 bytes of a frame, all 0 that of a stop; ValueError for numbers that are no bytes.

    A motion is obeyed until the next one, a stop, or the head's limit.
    """
    body = bytes([address, command1, command2, data1, data2])
    return bytes([SYNC, *body, sum(body) & 0xFF])


def encode_extended(address, opcode, value=0):
    """Bytes of an extended command, whose opcode is odd: a preset, a position, a query."""
    return encode_frame(address, 0, opcode, *value.to_bytes(2, "big"))


def split_frames(data):
    """The Frames in a stream of commands, of overlapping ones the first.

    Returns
    -------
    frames : tuple of Frame
    pending : int
        From where on bytes must be kept: a frame may begin there whose end has not come yet.
    """
    data = bytes(data)
    frames = []
    at = 0
    while (at := data.find(SYNC, at)) >= 0 and at + FRAME <= len(data):
        body = data[at + 1 : at + 6]
        if data[at + 6] == sum(body) & 0xFF:
            frames.append(Frame(*body))
            at += FRAME
        else:
            at += 1
    return tuple(frames), at if at >= 0 else len(data)


def encode_tilt(elevation):
    """Number of the set-tilt command for finite radians, up positive.

    Hundredths of a degree, 0 to 35999: 0 level, 9000 straight down, 33000 30 deg up.
    """
    return round(-math.degrees(elevation) * 100) % TURN


def decode_tilt(value):
    """Elevation of a head's tilt reply, radians in [-pi, pi): inverse of :func:`encode_tilt`."""
    return -math.radians((value if value <= TURN // 2 else value - TURN) / 100)


def tilt_in(raw, address):
    """Numbers of the frames with which the head of an address tells its tilt, a tuple.

    Angles end at 359.99 deg.
    """
    frames, _ = split_frames(raw)
    wanted = (address, 0, TILT)
    return tuple(
        frame.value
        for frame in frames
        if (frame.address, frame.command1, frame.command2) == wanted and frame.value < TURN
    )


def confirms(data, sent):
    """Whether bytes begin with the confirmation of a command that was sent.

    What may as well be the beginning of an echo is none; a query is not confirmed.
    """
    general = data[:GENERAL]
    if len(general) < GENERAL or sent[3] == QUERY_TILT or sent.startswith(general):
        return False
    return general[0] == SYNC and general[3] == (sent[6] + general[2]) & 0xFF


def echo_in(data, sent):
    """How many bytes in front are the end of the frame that was sent; 0 for none."""
    return next((n for n in range(FRAME - 1, 0, -1) if data.startswith(sent[-n:])), 0)


def split_replies(data, sent):
    """What a head, and an adapter that echoes, sent back after one frame, as Received.

    7 bytes answer a query, so do 5 bytes, the same without sync and address; 4 bytes confirm a
    command: a byte of alarm bits, and a checksum that continues that of the command. Every place is
    tried, and one that fits nothing is skipped; so are frames of other senders, and the single byte
    01 of some heads. What looks like a confirmation may as well be the beginning of an echo, and is
    none then; of echoes the beginning may be lost.
    """
    tilts = []
    acknowledged = False
    echoed = 0
    skipped = 0
    first = True
    while data:
        size = 1
        if data.startswith(sent):
            size = FRAME
            echoed += size
        elif tilt := tilt_in(data[:FRAME], sent[1]) or tilt_in(bytes([SYNC, 0]) + data[:SHORT], 0):
            size = FRAME if data[0] else SHORT
            tilts += tilt
        elif confirms(data, sent):
            size = GENERAL
            acknowledged = True
        elif first and (size_of_end := echo_in(data, sent)):
            size = size_of_end
            echoed += size
        else:
            skipped += 1
        first = False
        data = data[size:]
    return Received(tuple(tilts), acknowledged, echoed, skipped)


READ_S = 0.02  # longest wait for single bytes, so that no read overshoots a deadline by more
MOST = 512  # bytes looked at after a frame: a head sends up to 18, the rest is another device


class HeadLine:
    """Line to one head; a lock keeps threads apart.

    Calls raise LineLost if the port vanished and did not come back. `counts` has frames sent, bytes
    echoed and skipped, and reconnects.
    """

    def __init__(self, path, settings, host=REAL):
        self.path = path
        self.settings = settings
        self.host = host
        self.counts = dict.fromkeys(("frames", "echoed", "skipped", "reconnects"), 0)
        self.lock = host.lock()
        self._stop = encode_frame(settings.address)
        self._port = None
        self._free = 0.0  # when the next frame may be sent
        self._sent = 0.0  # when the last one was
        self._late = False  # the reply to the last query did not come in time
        self._acknowledges = False
        self._open()

    def _open(self):
        self._port = self.host.port(self.path, self.settings.baudrate, timeout=READ_S)

    def wire_s(self, count=FRAME):
        """Seconds that bytes take on the line."""
        return count * 10 / self.settings.baudrate

    # ------------------------------------------------------------------------------------- frames

    def pitch(self, retries):
        """Instant of the host and pitch that the head tells, rad; None if no reply came.

        After a time-out the next reply may be the late one, so it is thrown away and the head asked
        again. The head looks at its encoder about half-way between the beginning of the query and
        the end of the reply.
        """
        frame = encode_extended(self.settings.address, QUERY_TILT)
        for _ in range(1 + retries + self._late):
            with self.lock:
                suspect = self._late
                begun = self.host.now()
                tilts = self._exchange(frame, self.settings.reply_s, again=True).tilts
                self._late = not tilts
            if tilts and not suspect:
                halfway = (begun + self.host.now()) / 2
                return halfway, self.settings.pitch(decode_tilt(tilts[-1]))
        return None

    def command(self, frame):
        """Send a frame that a head may acknowledge; the host's instant at which it was sent.

        If the port vanished it is not sent again, because its time has passed.
        """
        with self.lock:
            self._exchange(frame * self.settings.sends)
            return self._sent

    def stop(self):
        """Send the stop until it is acknowledged; its instant.

        To heads that acknowledge nothing it is sent at least twice.
        """
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
        """Send the stop at once, whatever another thread does on the line; errors are logged."""
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
        """Send a frame, and collect what is Received until a reply.

        With `again` also where the port was lost and came back. The wait (by default that of an
        acknowledgement) counts from the end of the transmission of frame and reply.
        """
        with self.lock:
            self.host.sleep(max(0.0, self._free - self.host.now()))
            data = b""
            received = Received()
            try:
                with line_lost(self.path):
                    port = self.opened()
                    port.reset_input_buffer()
                    port.write(frame)
                    self._sent = self.host.now()
                    end = (
                        self._sent
                        + self.wire_s(len(frame) + FRAME)
                        + (wait_s or self.settings.gap_s)
                    )
                    while not (received.tilts or received.acknowledged):
                        if self.host.now() >= end or len(data) >= MOST:
                            break
                        data += port.read(max(1, min(port.in_waiting, MOST)))
                        received = split_replies(data, frame[:FRAME])
            except LineLost:
                LOG.warning("the line %s to the head is lost", self.path)
                there = self._port is not None  # else it did not come back
                self.close()
                if not (again and there):
                    raise
                return self._exchange(frame, wait_s)
            out = self._sent + self.wire_s(len(frame))
            self._free = max(self.host.now(), out) + self.settings.gap_s
            self.counts["frames"] += 1
            self.counts["echoed"] += received.echoed
            self.counts["skipped"] += received.skipped
            return received

    # --------------------------------------------------------------------------------------- port

    def opened(self):
        """The port; after it was lost it is waited for.

        The head, which went on with what it was told, is stopped then.
        """
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
            port = self._port
            self._port = None
            port.close()
