"""Other people's programs at the emulated head, in virtual time: what they send, and what it does.

Peltrack (genepool99, ``tools/pelco_query_test.py``) asks for pan and tilt and looks for the wanted opcode in
what comes back within 0.35 s. python-pelco-lib (``send_for``) and pypelcod (``left(.5)``) only write: a motion,
a stop after a while. ``PelcoD.cpp`` and the MATLAB script (``SetPanTiltPosition.m``) send absolute positions.
"""

import math

import pytest
from virtual import head

PAN = "FF 01 00 51 00 00 52"
TILT = "FF 01 00 53 00 00 54"
STOP = "FF 01 00 00 00 00 01"
REPLY_S = 0.35


class Client:
    """A program at the line of a head."""

    def __init__(self, **habits):
        self.device = head(**{"speeds": (0.0, 10.0)} | habits)
        self.host = self.device.host
        self.port = self.host.port(self.device.path, self.device.baudrate, timeout=0.02)

    def send(self, frame):
        self.port.write(bytes.fromhex(frame))

    def query(self, frame, opcode):
        """The value of the reply with an opcode, None where it does not come in time."""
        self.port.reset_input_buffer()
        self.send(frame)
        end = self.host.now() + REPLY_S
        data = b""
        while self.host.now() < end:
            data += self.port.read(64)
            at = data.find(bytes([0xFF, 1, 0, opcode]))
            if at >= 0 and len(data) >= at + 7:
                reply = data[at : at + 7]
                assert reply[6] == sum(reply[1:6]) % 256
                return int.from_bytes(reply[4:6], "big")
        return None

    def elevation(self):
        return math.degrees(self.device.pitch())


@pytest.mark.parametrize(
    "habits", [{}, {"echo": True}, {"confirms": True}, {"baudrate": 9600}]
)
def test_peltrack_reads_pan_and_tilt(habits):
    client = Client(**habits)
    assert client.query(PAN, 0x59) == 0 and client.query(TILT, 0x5B) == 0
    client.device.head.move(client.host.now(), math.radians(30), 10.0)
    client.host.sleep(1)
    assert client.query(TILT, 0x5B) == 33000


@pytest.mark.parametrize("fault", ["none", "rate"])
def test_peltrack_hears_nothing_of_a_head_that_does_not_answer(fault):
    client = Client(feedback="none" if fault == "none" else "full")
    if fault == "rate":
        client.port.baudrate = 9600
    assert client.query(PAN, 0x59) is None


@pytest.mark.parametrize(("motion", "seconds", "degrees"), [
    ("FF 01 00 08 00 3F 48", 0.5, 5.0),  # up, the fastest
    ("FF 01 00 10 00 20 31", 1.0, -10 * 0x20 / 0x3F),  # down
    ("FF 01 00 02 3F 00 42", 1.0, 0.0),  # right: the pan does not turn
    ("FF 01 08 08 00 3F 50", 0.5, 5.0),  # with a bit that it does not know
])  # fmt: skip
def test_programs_that_only_write_move_and_stop_it(motion, seconds, degrees):
    client = Client()
    client.send(motion)
    client.host.sleep(seconds)
    client.send(STOP)
    client.host.sleep(1.0)
    assert client.elevation() == pytest.approx(degrees, abs=0.15)
    assert client.query(TILT, 0x5B) == round(-100 * client.elevation()) % 36000


@pytest.mark.parametrize(("frame", "degrees"), [
    ("FF 01 00 4D 11 94 F3", -45.0), ("FF 01 00 4D 80 E8 B6", 30.0), ("FF 01 00 4D 00 00 4E", 0.0),
])  # fmt: skip
def test_programs_that_send_positions_get_there(frame, degrees):
    client = Client(go_speed=20.0)
    client.send("FF 01 00 4B 11 94 F1")  # pan, which it does not have
    client.send(frame)
    client.host.sleep(5.0)
    assert client.elevation() == pytest.approx(degrees, abs=1e-6)
