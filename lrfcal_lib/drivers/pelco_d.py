"""Pelco-D: frames, angles and answers, and the half-duplex line to a head."""

import contextlib
import logging
import math
import os
from dataclasses import dataclass

from lrfcal_lib.drivers.port import Host, LineLost, PortError, line_lost, stopping

LOG = logging.getLogger(__name__)
SYNC = 0xFF
FRAME = 7  # bytes
GENERAL = 4  # bytes of a confirmation
# bits of command 2; without them, and those of the pan, it is a stop
UP = 0x08
DOWN = 0x10
FASTEST = 0x3F  # speed byte; 0 is very slow, not stop
SET_TILT = 0x4D
QUERY_TILT = 0x53
TILT = 0x5B  # its reply
TURN = 36000  # hundredths of a degree
# longest wait for single bytes, so that no read overshoots a deadline by more
READ_S = 0.02
# bytes looked at after a frame: a head sends up to 18, the rest is another device
MOST = 512
RECONNECT_S = 3.0  # that a call waits for a port that vanished
AGAIN_S = 0.05  # between looks for it


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
    def value(self) -> int:
        """Number of both data bytes."""
        return self.data1 << 8 | self.data2


@dataclass
class Received:
    """What came back after a frame was sent."""

    tilts: tuple[int, ...] = ()  # numbers of the replies that tell the tilt
    acknowledged: bool = False
    echoed: int = 0  # bytes of the own frame that a two-wire adapter handed back
    skipped: int = 0  # bytes that belong to nothing
    sent: float = 0.0  # instant of the host at which the frame was sent


def encode_frame(
    address: int, command1: int = 0, command2: int = 0, data1: int = 0, data2: int = 0
) -> bytes:
    """The 7 bytes of a frame.

    A motion is obeyed until the next one, a stop, or the head's limit.

    Parameters
    ----------
    address
        Of the head.
    command1, command2, data1, data2
        Bytes; all 0 are those of a stop.

    Raises
    ------
    ValueError
        For numbers that are no bytes.
    """
    body = bytes([address, command1, command2, data1, data2])
    return bytes([SYNC, *body, sum(body) & 0xFF])


def encode_extended(address: int, opcode: int, value: int = 0) -> bytes:
    """Bytes of an extended command: a preset, a position, a query.

    Parameters
    ----------
    address
        Of the head.
    opcode
        Odd.
    value
        Number of both data bytes.
    """
    return encode_frame(address, 0, opcode, *value.to_bytes(2, "big"))


def split_frames(data: bytes) -> tuple[list[Frame], int]:
    """The frames in a stream of commands, of overlapping ones the first.

    Parameters
    ----------
    data
        Of the stream.

    Returns
    -------
    frames : list of Frame
    pending : int
        From where on bytes must be kept: a frame may begin there whose end has not come yet.
    """
    frames: list[Frame] = []
    at = 0
    while (at := data.find(SYNC, at)) >= 0:
        raw = data[at : at + FRAME]
        if len(raw) < FRAME:
            return frames, at
        if encode_frame(*raw[1:6]) == raw:
            frames.append(Frame(*raw[1:6]))
            at += FRAME
        else:
            at += 1
    return frames, len(data)


def encode_tilt(elevation: float) -> int:
    """Number of the set-tilt command.

    Parameters
    ----------
    elevation
        Radians, up positive, finite.

    Returns
    -------
    int
        Hundredths of a degree, 0 to 35999: 0 level, 9000 straight down, 33000 30 deg up.
    """
    return round(-math.degrees(elevation) * 100) % TURN


def decode_tilt(value: int) -> float:
    """Elevation that a head tells, the inverse of :func:`encode_tilt`.

    Parameters
    ----------
    value
        Hundredths of a degree, 0 to 35999.

    Returns
    -------
    float
        Radians in [-pi, pi), up positive.
    """
    return math.remainder(-math.radians(value / 100), math.tau)


# ---------------------------------------------------------------------------------------- replies


def split_replies(data: bytes, sent: bytes) -> Received:
    """What a head, and an adapter that echoes, sent back after one frame.

    7 bytes answer a query, so do 5 bytes, the same without sync and address; 4 bytes confirm a
    command. Every place is tried, and one that fits nothing is skipped; so are frames of other
    senders, and the single byte 01 of some heads. What looks like a confirmation may as well be the
    beginning of an echo, and is none then.

    Parameters
    ----------
    data
        All that came back.
    sent
        The frame.
    """
    received = Received()
    while data:
        tilt, size = _tilt_reply(data, sent[1])
        if data.startswith(sent):
            size = FRAME
            received.echoed += size
        elif size:
            received.tilts += (tilt,)
        elif _confirms(data, sent):
            size = GENERAL
            received.acknowledged = True
        else:
            size = 1
            received.skipped += size
        data = data[size:]
    return received


def _tilt_reply(data, address):
    """Number of the tilt reply that bytes begin with, and its size; size 0 if it is none."""
    for sender, missing in ((address, 0), (0, 2)):  # whole, or without sync and address
        value = int.from_bytes(data[4 - missing : 6 - missing], "big")
        reply = encode_extended(sender, TILT, value)[missing:]
        if value < TURN and data.startswith(reply):
            return value, len(reply)
    return 0, 0


def _confirms(data, sent):
    """Whether bytes begin with the confirmation of a command: a byte of alarm bits, and a checksum
    that continues that of the command. A query is not confirmed.
    """
    general = data[:GENERAL]
    if len(general) < GENERAL or sent[3] == QUERY_TILT or sent.startswith(general):
        return False
    return general[0] == SYNC and general[3] == (sent[6] + general[2]) & 0xFF


# ------------------------------------------------------------------------------------------- line


class HeadLine:
    """Line to one head; a lock keeps threads apart.

    Calls raise LineLost if the port vanished and did not come back.

    Parameters
    ----------
    path
        Of the port.
    settings : rig_file.HeadSettings
    host
        Machine that the driver runs on.

    Attributes
    ----------
    frame_s : float
        Seconds that a frame takes on the line.
    received : Received
        After the frame that was sent last.
    """

    def __init__(self, path: str | os.PathLike, settings, host: Host):
        self.path = path
        self.settings = settings
        self.host = host
        self.lock = host.lock()
        self.frame_s = FRAME * 10 / settings.baudrate
        self._stop = encode_frame(settings.address)
        self._free = 0.0  # when the next frame may be sent
        self._late = False  # the reply to the last query did not come in time
        self._acknowledges = False
        self._port = host.port(path, settings.baudrate, timeout=READ_S)

    # ------------------------------------------------------------------------------------- frames

    def pitch(self, patient):
        """Pitch that the head tells, rad, and instant of the host; None if no reply came, for who
        is patient to several queries.

        After a time-out the next reply may be the late one, so it is thrown away and the head is
        asked again. The head looks at its encoder about half-way between the beginning of the query
        and the end of the reply.
        """
        for _ in range(1 + self.settings.retries * patient + self._late):
            with self.lock:
                suspect = self._late
                received = self.exchange(
                    encode_extended(self.settings.address, QUERY_TILT),
                    self.settings.reply_s,
                )
                self._late = not received.tilts
            if received.tilts and not suspect:
                halfway = (received.sent + self.host.now()) / 2
                return self.settings.pitch(decode_tilt(received.tilts[-1])), halfway
        return None

    def stop(self):
        """Send the stop until it is acknowledged; the instant of the first one.

        To heads that acknowledge nothing it is sent at least twice.
        """
        sent = None
        for _ in range(2 + self.settings.retries * self._acknowledges):
            with self.lock:
                received = self.exchange(self._stop)
            sent = sent or received.sent
            if received.acknowledged:
                self._acknowledges = True
                break
        return sent

    def blurt_stop(self):
        """Send the stop at once, whatever another thread does on the line; errors are logged."""
        held = self.lock.acquire(timeout=0.5)
        try:
            # on the way out nothing else can be done
            with stopping("head", Exception), line_lost(self.path):
                self.opened()
                self._send_stop()
        finally:
            if held:
                self.lock.release()

    def _send_stop(self):
        """Send the stop twice, without waiting for what comes back."""
        for _ in range(2):
            self._port.write(self._stop)
            self.host.sleep(self.frame_s + self.settings.gap_s)

    def exchange(self, frame, wait_s=None):
        """Send a frame, and collect what is Received until a reply.

        The wait (by default that of an acknowledgement) counts from the end of the transmission of
        frame and reply. Who calls holds the lock.
        """
        gap_s = self.settings.gap_s
        self.host.sleep(self._free - self.host.now())
        data = b""
        received = Received()
        try:
            with line_lost(self.path):
                port = self.opened()
                port.reset_input_buffer()
                port.write(frame)
                sent = self.host.now()
                end = sent + 2 * self.frame_s + (wait_s or gap_s)
                while self.host.now() < end and len(data) < MOST:
                    data += port.read(max(1, min(port.in_waiting, MOST)))
                    received = split_replies(data, frame)
                    if received.tilts or received.acknowledged:
                        break
        except LineLost:
            self.close()
            raise
        self._free = max(self.host.now(), sent + self.frame_s) + gap_s
        received.sent = sent
        self.received = received
        return received

    # --------------------------------------------------------------------------------------- port

    def opened(self):
        """The port; after it was lost, which ends what was under way, it is waited for.

        The head, which went on with what it was told, is stopped then.
        """
        deadline = self.host.now() + RECONNECT_S
        while self._port is None:
            try:
                self._port = self.host.port(
                    self.path, self.settings.baudrate, timeout=READ_S
                )
            except PortError as error:
                if self.host.now() >= deadline:
                    raise LineLost(f"the head's line is lost: {error}") from error
                self.host.sleep(AGAIN_S)
            else:
                LOG.warning("the line %s to the head is back", self.path)
                self._send_stop()
        return self._port

    def close(self):
        """Close the port; nothing is sent."""
        with self.lock, contextlib.suppress(Exception):
            port = self._port
            self._port = None
            port.close()
