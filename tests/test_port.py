"""Ports whose errors say what to do, against a pseudo-terminal."""

import errno
import os
import termios
import threading
import tty
from contextlib import suppress

import pytest
import serial

from lrfcal_lib.drivers import port
from lrfcal_lib.drivers.lms2xx_link import Link
from lrfcal_lib.drivers.port import LineLost, PortError, open_port, set_rate


@pytest.fixture
def wire():
    """A pseudo-terminal: descriptor of the far end, path of the near one."""
    far, near = os.openpty()
    tty.setraw(near)
    yield far, os.ttyname(near)
    for end in (far, near):
        with suppress(OSError):  # a test closed it
            os.close(end)


def test_ports_that_cannot_be_opened_say_what_to_do(wire, tmp_path, monkeypatch):
    with pytest.raises(
        PortError, match=r"there is no port .*nowhere: check cable and power; present are "
    ):
        open_port(tmp_path / "nowhere", 9600, timeout=0)
    with pytest.raises(PortError, match="/dev/null is no serial line"):
        open_port("/dev/null", 9600, timeout=0)
    held = open_port(wire[1], 9600, timeout=0)
    with pytest.raises(
        PortError, match=f"is busy: close the program that 'fuser -v {wire[1]}' names"
    ):
        open_port(wire[1], 9600, timeout=0)
    held.close()

    def forbidden(*_, **__):
        raise serial.SerialException(errno.EACCES, "could not open port: Permission denied")

    monkeypatch.setattr(port.serial, "Serial", forbidden)
    with pytest.raises(
        PortError, match="no permission for /dev/ttyUSB0: run 'sudo usermod -aG dialout"
    ):
        open_port("/dev/ttyUSB0", 9600, timeout=0)


def test_a_rate_that_the_line_does_not_take_is_refused_and_the_old_one_stays(
    wire, monkeypatch
):
    with open_port(wire[1], 19200, timeout=0) as port:
        for rate in (9600, 38400, 500000, 19200):
            set_rate(port, rate)
        with pytest.raises(PortError, match="does not take 12345 Bd"):
            set_rate(port, 12345)
        with pytest.raises(PortError, match="cannot do -1 Bd"):
            set_rate(port, -1)
        real = termios.tcgetattr
        monkeypatch.setattr(
            termios, "tcgetattr", lambda fd: [*real(fd)[:4], 13, 13, real(fd)[6]]
        )
        with pytest.raises(PortError, match="does not take 500000 Bd.*RS-422 interface"):
            set_rate(port, 500000)
        assert port.baudrate == 19200


def test_a_port_that_vanishes_is_a_lost_line(wire):
    link = Link(wire[1], 38400, interrupted=threading.Event())
    os.close(wire[0])
    for action in (link.receive, lambda: link.send(0x31), lambda: link.set_rate(9600)):
        with pytest.raises(LineLost, match="is lost.*check plug and power"):
            action()
    link.close()
