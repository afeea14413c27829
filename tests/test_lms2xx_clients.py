"""Other people's programs at the emulated LMS2xx, in virtual time: what they send and wait for.

Those of the C++ toolbox (sicktoolbox, ``c++/examples/lms2xx``) pass over what comes before a reply,
and give up a telegram whose bytes are more than 35 ms apart; here they ask once, not up to three
times. CARMEN (``laser-new/sick_laser.c``) wants an ACK as the next byte, waits 250 ms for any byte,
and forgets nothing that came before. The Python client of AtlasBuggy (``lms200/sicklms``) wants an ACK
within 250 ms and the reply within 1.5 s; its bytes are those of a recording. Player
(``laser/sicklms200.cc``) looks for replies only, at 38400 and 9600 Bd.
"""

import struct

import numpy as np
import pytest
from telegrams import parse_telegram
from virtual import INDEXED, Source, lms

from lrfcal_lib.session.lms2xx_codec import (
    Configuration,
)
from lrfcal_lib.session.lms2xx_frame import (
    crc16,
    encode_telegram,
)

BAUD = {9600: "20 42", 19200: "20 41", 38400: "20 40", 500000: "20 48"}
STOP = "20 25"
PASSWORD = "20 00" + b"SICK_LMS".hex()
STATUS = "31"
SYNC = [
    STOP,
    "3A",
    STATUS,
    "74",
]  # with which every program of the toolbox begins, once the rate is set
DONE = {
    0x20: "A0 00",
    0x31: "B1",
    0x3A: "BA",
    0x3B: "BB 01",
    0x74: "F4",
    0x77: "F7 01",
}  # begin of the reply
MILLIMETRES = Configuration().changed(unit="mm")


def telegram_of(payload):
    """The telegram of hexadecimal digits of a command and its data."""
    data = bytes.fromhex(payload)
    return encode_telegram(data[0], data[1:])


class Client:
    """A program at the line of a device; it gives up where no byte comes for so many seconds."""

    def __init__(self, device, gap_s):
        self.host = device.host
        self.port = self.host.port(device.path, 9600, timeout=gap_s)

    def read(self, count):
        """So many bytes, fewer after a gap."""
        data = b""
        while len(data) < count and (more := self.port.read(1)):
            data += more
        return data

    def rest_of(self, head):
        """The sound telegram that begins with its first two bytes, or None."""
        head += self.read(2)
        body = self.read(int.from_bytes(head[2:], "little"))
        checksum = self.read(2)
        sound = len(checksum) == 2 and crc16(head + body) == int.from_bytes(
            checksum, "little"
        )
        return head + body + checksum if sound else None


# ----------------------------------------------------------------------------- the C++ toolbox


class Toolbox(Client):
    """A program of the toolbox."""

    def __init__(self, device):
        super().__init__(device, gap_s=0.035)

    def receive(self, limit_s):
        """The next telegram; it has to be whole in so many seconds."""
        end = self.host.now() + limit_s
        window = b""
        while self.host.now() < end:
            window = (window + self.port.read(1))[-2:]
            if window == b"\x02\x80":
                raw = self.rest_of(window)
                if raw is not None:
                    assert self.host.now() < end
                    return raw
        raise AssertionError(f"nothing in {limit_s} s")

    def ask(self, payload):
        """Send a request byte by byte; its reply says that it was done."""
        limit_s = {"20": 3.0, "77": 15.0}.get(payload[:2], 1.0)
        self.port.reset_input_buffer()
        for byte in telegram_of(payload):
            self.port.write(bytes([byte]))
            self.host.sleep(55e-6)
        expected = bytes.fromhex(DONE[int(payload[:2], 16)])
        while (reply := self.receive(1.0 if payload in BAUD.values() else limit_s))[
            4
        ] != expected[0]:
            pass
        assert reply[4:].startswith(expected), payload

    def set_rate(self, rate):
        """As it does whenever it begins or ends."""
        self.ask(BAUD[rate])
        self.port.baudrate = rate
        self.host.sleep(0.25)

    def run(self, steps, rate):
        """Begin, do the steps (requests, and numbers of scans to be read), end; the scans."""
        self.set_rate(rate)
        scans = []
        for step in [*SYNC, *steps]:
            if isinstance(step, str):
                self.ask(step)
            else:
                scans += [
                    self.receive(15.0 if "20 26 05" in steps else 1.0) for _ in range(step)
                ]
        self.set_rate(9600)
        return scans


def writing(**changes):
    """What `config` sends for a change of the configuration, one after the other."""
    steps = []
    configuration = MILLIMETRES
    for name, value in changes.items():
        configuration = configuration.changed(**{name: value})
        steps += [PASSWORD, "77" + configuration.block.hex(), STOP, STATUS]
    return steps


FINE = "3B 64 00 19 00"  # 100 deg in steps of 0.25 deg
USUAL = "3B B4 00 32 00"
PROGRAMS = {  # steps, and number of values of their scans
    "simple": (["20 24", 10, STOP], [361] * 10),
    "set variant": (
        [FINE, "20 24", 10, STOP, USUAL, "20 24", 10, STOP],
        [401] * 10 + [361] * 10,
    ),
    "config": (writing(unit="cm", measuring_mode=4, realtime_indices=True), []),
    "indices": (["20 24", 10, STOP], [361] * 10),
    "partial scan": ([FINE, "20 2A", 12, STOP], [181, 180, 180, 180] * 3),
    "mean values": (["20 26 05", 10, STOP], [361] * 10),
    "subrange": (["20 27 01 00 0A 00", 10, STOP], [10] * 10),
    "stream": (
        [],
        [],
    ),  # of range and reflectivity: it sees that this is no LMS Fast, and ends
}
HEADS = {0xB0: 0, 0xB6: 1, 0xB7: 4}  # bytes before the number of values


def values_of(raw):
    """Number of the partial scan and values, as the toolbox reads them; and what follows them."""
    telegram = parse_telegram(raw)
    data = telegram.data[HEADS[telegram.code] :]
    count = data[0] + 256 * (data[1] & 3)
    return (
        (data[1] & 0x18) >> 3,
        np.frombuffer(data[2 : 2 + 2 * count], "<u2"),
        data[2 + 2 * count :],
    )


@pytest.mark.parametrize("rate", [9600, 19200, 38400])
@pytest.mark.parametrize("name", PROGRAMS)
def test_programs_of_the_toolbox_run_to_their_end(name, rate):
    steps, counts = PROGRAMS[name]
    indexed = name in ("indices", "partial scan")
    device = lms(configuration=INDEXED if indexed else MILLIMETRES)
    scans = [values_of(raw) for raw in Toolbox(device).run(steps, rate)]
    assert [len(values) for _, values, _ in scans] == counts
    told = (
        list(device.scans)[: len(scans)] if name != "set variant" else sent_twenty(device)
    )
    for (partial, values, indices), record in zip(scans, told, strict=True):
        assert values.tolist() == record.words[: len(values)].tolist() and partial == max(
            record.partial, 0
        )
        assert indices == (
            bytes([record.turn % 256, record.telegram_index]) if indexed else b""
        )
    # nothing was asked twice, and the device is left as it was found
    asked = [step for step in steps if isinstance(step, str)]
    order = [BAUD[rate], *SYNC, *asked, BAUD[9600]]
    assert [raw for _, raw in device.requests] == [telegram_of(step) for step in order]
    assert device.baudrate == 9600 and not device.streaming
    if name == "config":
        now = device.memory.configuration
        assert (now.unit, now.measuring_mode, now.realtime_indices) == ("cm", 4, True)


def sent_twenty(device):
    """The first ten scans of either variant."""
    fine = [record for record in device.scans if len(record.words) == 401]
    usual = [record for record in device.scans if len(record.words) == 361]
    return fine[:10] + usual[:10]


def test_a_mean_is_that_of_its_scans_and_one_without_a_range_leaves_none():
    device = lms()
    raw = Toolbox(device).run(["20 26 05", 1, STOP], 38400)[0]
    values = values_of(raw)[1]
    assert parse_telegram(raw).code == 0xB6 and parse_telegram(raw).data[0] == 5
    turn = device.scans[0].turn
    quarters = 2 * np.arange(361)
    ranges, reasons = zip(
        *(Source().scan(turn + 2 * k, quarters, None) for k in range(5)), strict=True
    )
    ranged = np.all(np.array(reasons) == 0, axis=0)
    assert (
        values[ranged].tolist() == np.rint(np.mean(ranges, axis=0)[ranged] * 100).tolist()
    )
    assert ranged.any() and (values[~ranged] > 8182).all() and not ranged.all()


# -------------------------------------------------------------------------------------- CARMEN


class Carmen(Client):
    """CARMEN's driver; an answer that nobody waited for comes before the next one."""

    def __init__(self, device):
        super().__init__(device, gap_s=0.25)

    def packet(self):
        """The next telegram, b'' where none comes."""
        while byte := self.read(1):
            if byte == b"\x02":
                return self.rest_of(byte + self.read(1)) or b""
        return b""

    def send(self, payload, acknowledged=True):
        """What comes back for a request, after an ACK if that is waited for."""
        self.port.write(telegram_of(payload))
        return b"" if acknowledged and self.read(1) != b"\x06" else self.packet()

    def find(self):
        """The first rate at which two stops in a row are answered."""
        for rate in BAUD:
            self.port.baudrate = rate
            for _ in range(8):
                if self.send(STOP, acknowledged=False):
                    self.host.sleep(0.01)
                    if self.send(STOP):
                        return rate
        raise AssertionError("no rate")

    def connect(self, wanted):
        """Find the device; set its rate and, at once, ask for its status, then find it again."""
        if self.find() != wanted:
            self.port.write(telegram_of(BAUD[wanted]))
            assert any(self.send(STATUS, acknowledged=False) for _ in range(5))
            assert self.find() == wanted

    def configure(self, unit, mode, variant):
        """Write 32 bytes of configuration, set the variant, leave the installation mode."""
        conf = self.retried("74")[4:37]
        block = bytearray(conf[1:])
        block[4] |= 1
        block[5] = mode
        block[6] = unit
        for payload in (PASSWORD, "77" + block.hex(), variant, STOP):
            self.host.sleep(1.0)
            code = int(payload[:2], 16)
            assert self.retried(payload)[4:].startswith(bytes.fromhex(DONE[code])), payload

    def retried(self, payload):
        """The answer to a request that is sent up to ten times."""
        return next(filter(None, (self.send(payload) for _ in range(10))))

    def measured(self):
        """Offset, ranges and reflectivities of the next scan, in millimetres, as it reads them."""
        packet = self.packet()[4:]
        if packet[0] == 0xB0:
            count = struct.unpack("<H", packet[1:3])[0] & 0x1FF
            values = np.frombuffer(packet[3 : 3 + 2 * count], "<u2") & 0x1FFF
            return packet[2] >> 3 & 3, values * (1 if packet[2] & 0x40 else 10), None
        parts, first, last, head = struct.unpack("<HHHH", packet[1:9])
        assert packet[0] == 0xF5 and parts == 1 and (first, last) == (1, 181)
        values = np.frombuffer(packet[9 : 9 + 4 * (head & 0x3FFF)], "<u2").reshape(-1, 2)
        return 0, values[:, 0] * (1 if head & 0x4000 else 10), values[:, 1]


STREAMS = {  # start, unit, measuring mode, variant, values of the scans
    "normal": ("20 24", 1, 1, USUAL, [361] * 4),
    "interlaced": ("20 2A", 1, 1, FINE, [181, 180, 180, 180]),
    "remission": ("20 2B 01 00 01 00 B5 00", 0, 13, "3B B4 00 64 00", [181] * 4),
}


@pytest.mark.parametrize("rate", BAUD)
@pytest.mark.parametrize("name", STREAMS)
def test_carmen_connects_configures_and_reads_scans(name, rate):
    start, unit, mode, variant, counts = STREAMS[name]
    device = lms(baudrate=38400 if rate == 9600 else 9600)
    client = Carmen(device)
    client.connect(rate)
    assert device.baudrate == rate
    client.configure(unit, mode, variant)
    assert client.retried(start)[4:6] == b"\xa0\0"
    scans = [client.measured() for _ in counts]
    assert [len(ranges) for _, ranges, _ in scans] == counts
    for (offset, ranges, bright), record in zip(
        scans, list(device.scans)[: len(scans)], strict=True
    ):
        assert offset == max(record.partial, 0)
        assert ranges.tolist() == (record.words * (1 if unit else 10)).tolist()
        answered = record.words < 8183
        assert bright is None or np.array_equal(bright > 0, answered)
    while not client.send(STOP):
        pass
    assert not device.streaming and device.memory.flash_writes == 1


# ------------------------------------------------------------------------------------ AtlasBuggy

# Recorded with an LMS200 (S18063, V02.19) at 38400 Bd: what was sent, and how its reply begins.
RECORDED = [
    ("02 00 02 00 20 25 35 08", "A0 00"),
    ("02 00 02 00 20 40 50 08", "A0 00"),
    ("02 00 01 00 3A 1E 12", "BA 4C 4D 53 32 30 30 3B 53 31 38 30 36 33"),
    ("02 00 01 00 31 15 12", "B1 56 30 32 2E 31 39 20"),
    ("02 00 01 00 74 50 12", "F4"),
    ("02 00 0A 00 20 00 53 49 43 4B 5F 4C 4D 53 BE C5", "A0 00"),
    (
        f"02 00 23 00 77 00 00 70 00 00 04 01 00 00 02 02 {'00 ' * 21} 02 00 94 8A",
        "F7 01 00 00 70 00 00 04 01",
    ),
    ("02 00 02 00 20 25 35 08", "A0 00"),
    ("02 00 02 00 20 24 34 08", "A0 00"),
]


def test_the_recorded_bytes_of_a_python_client_are_acknowledged_and_answered_in_time():
    device = lms(model="LMS200;S18063;V02.19 ", baudrate=9600)
    client = Client(device, gap_s=0.25)
    for sent, begin in RECORDED:
        client.port.write(bytes.fromhex(sent))
        asked = client.host.now()
        assert client.read(1) == b"\x06" and client.host.now() < asked + 0.25
        reply = client.rest_of(client.read(2))
        assert (
            reply[4:].startswith(bytes.fromhex(begin)) and client.host.now() < asked + 1.5
        )
        if sent.startswith("02 00 02 00 20 40"):
            client.port.baudrate = 38400
    heads = [client.rest_of(client.read(2))[4:7] for _ in range(20)]
    assert set(heads) == {
        bytes.fromhex("B0 69 41")
    }  # 361 values, millimetres, as in 892 real scans
    assert (
        device.memory.flash_writes == 1 and device.memory.configuration.measuring_mode == 4
    )
    every = np.diff([record.time_s for record in list(device.scans)[:20]])
    np.testing.assert_allclose(every, 8 * 2 / 75.08, atol=1e-6)  # 213 ms, as recorded


# ------------------------------------------------------------------------------------------ Player


class Player(Client):
    """Player's driver: what is no telegram with the wanted code is passed over."""

    def __init__(self, device):
        super().__init__(device, gap_s=0.1)

    def ask(self, payload, limit_s=1.0):
        """The data of the reply, None where none comes in time."""
        self.port.reset_input_buffer()
        self.port.write(telegram_of(payload))
        end = self.host.now() + limit_s
        window = b""
        while self.host.now() < end:
            window = (window + self.port.read(1))[-2:]
            if window == b"\x02\x80" and (raw := self.rest_of(window)) is not None:
                if raw[4] == int(payload[:2], 16) | 0x80:
                    return raw[5:-3]
                window = b""
        return None

    def find(self):
        """Stop whatever streams, at the rates of RS-232 that it knows."""
        for rate in (38400, 9600):
            self.port.baudrate = rate
            if self.ask(STOP) is not None:
                return rate
        raise AssertionError("no rate")


@pytest.mark.parametrize("streaming", [False, True])
@pytest.mark.parametrize("rate", [9600, 38400])
def test_player_finds_sets_up_and_streams(rate, streaming):
    device = lms(baudrate=rate)
    client = Player(device)
    if streaming:  # left by a program that crashed
        client.port.baudrate = rate
        client.ask("20 24")
        assert device.streaming
    assert client.find() == rate and not device.streaming
    if rate != 38400:
        assert client.ask(BAUD[38400]) == b"\0"
        client.port.baudrate = 38400
    assert client.ask("3A").startswith(b"LMS221")
    assert client.ask(PASSWORD, 3.0) == b"\0"
    block = client.ask("74")
    taken = client.ask("77" + MILLIMETRES.block.hex(), 3.0)
    assert len(block) == 34 and taken[:1] == b"\1"
    assert client.ask("3B 64 00 32 00")[:1] == b"\1" and client.ask("20 24", 3.0) == b"\0"
    window = b""
    scans = []
    while len(scans) < 5:
        window = (window + client.read(1))[-2:]
        if window == b"\x02\x80":
            scans.append(values_of(client.rest_of(window))[1])
            window = b""
    sent = [record.words for record in list(device.scans)[-len(scans) - 1 :]]
    assert all(any(np.array_equal(scan, words) for words in sent) for scan in scans)
    assert {len(scan) for scan in scans} == {201}
