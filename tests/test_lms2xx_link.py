"""The line to an LMS2xx: pace, silence, and bytes of somebody else, in virtual time."""

import numpy as np
import pytest
from virtual import VirtualHost

from lrfcal_lib.drivers.lms2xx import LMS2xx
from lrfcal_lib.drivers.lms2xx_link import Link
from lrfcal_lib.drivers.port import NoReply, WrongDevice
from lrfcal_lib.emulators.line import SerialDevice
from lrfcal_lib.session.lms2xx_frame import (
    encode_telegram,
)


class Far(SerialDevice):
    """A device that hears, and says what a test lets it say."""

    baudrate = None

    def __init__(self, baudrate=38400):
        super().__init__("far", VirtualHost())
        self.heard, self.baudrate = [], baudrate
        self.start()

    def take(self, raw, at):
        self.heard.append((at, raw))
        return len(raw)


@pytest.mark.parametrize(("rate", "writes"), [(38400, 1), (500000, 8)])
def test_bytes_are_paced_at_500000_baud_only(rate, writes):
    far = Far(rate)
    Link(far.path, rate, interrupted=far.host.event(), host=far.host).send(0x20, b"\x25")
    times, pieces = zip(*far.heard, strict=True)
    assert b"".join(pieces) == encode_telegram(0x20, b"\x25") and len(pieces) == writes
    assert np.all(np.diff(times) >= 75e-6 - 1e-9)


def test_nobody_there_and_somebody_else_are_told_apart():
    far = Far()
    with pytest.raises(
        NoReply,
        match="19200, 500000 Bd, address 5: check power.*address, .*crossed.*RS-422",
    ):
        LMS2xx(far.path, host=far.host, find_s=1.2, address=5)
    assert far.host.now() < 2.5

    def talk(instant):
        far.write(b"$GPGGA,12,,*4A\r\n", instant)
        far.at(instant + 0.05, talk)

    talk(far.host.now())
    with pytest.raises(
        WrongDevice,
        match=r"bytes arrive, but no telegram of an LMS2xx at .* Bd, address 0 \(any\)",
    ):
        LMS2xx(far.path, host=far.host, find_s=1.2)
