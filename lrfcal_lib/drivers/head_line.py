"""The half-duplex line to a Pelco-D head: one frame out, its replies in, and the port found again when it was lost."""

from __future__ import annotations

import contextlib

from lrfcal_lib.drivers import pelco_d
from lrfcal_lib.drivers.errors import LineLost, PortError
from lrfcal_lib.drivers.host import REAL
from lrfcal_lib.drivers.serial_port import line_lost

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

    def wire_s(self, count=pelco_d.FRAME):
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
        frame, begun = pelco_d.encode_extended(self.settings.address, pelco_d.QUERY_TILT), self.host.now()
        value = self._tilt_of(self.exchange(frame, self._answered, self.settings.reply_s, again=True))
        self._late = value is None
        self.counts["timeouts"] += self._late
        return None if self._late else ((begun + self.host.now()) / 2, pelco_d.decode_tilt(value))

    def _answered(self, received):
        return self._tilt_of(received) is not None

    def _tilt_of(self, received):
        """Number of the tilt reply among others; 5-byte replies carry no address."""
        mine = (None, self.settings.address)
        found = [one.value for one in received.replies if one.opcode == pelco_d.TILT and one.address in mine]
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
        frame, first = pelco_d.encode_stop(self.settings.address), None
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
                    self._open().write(pelco_d.encode_stop(self.settings.address))
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
            deadline = self._sent + self.wire_s(len(frame) + pelco_d.FRAME) + wait_s
            received = self._collect(port, frame[: pelco_d.FRAME], found, deadline)
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
            received = pelco_d.split_replies(data, sent, complete=over)
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
                self._port.write(pelco_d.encode_stop(self.settings.address) * 2)
            self._free = self.host.now() + self.wire_s(2 * pelco_d.FRAME) + self.settings.gap_s

    def close(self):
        """Close the port; nothing is sent."""
        with self.lock:
            port, self._port = self._port, None
            if port is not None:
                with contextlib.suppress(Exception):
                    port.close()
