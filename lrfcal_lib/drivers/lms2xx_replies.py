"""What an LMS2xx says about itself: status, errors, variant, configuration. Pure, like the codec of telegrams."""

from __future__ import annotations

from dataclasses import dataclass

from lrfcal_lib.drivers.lms2xx import UNITS
from lrfcal_lib.drivers.lms2xx_frame import TelegramError, encode_telegram, parse_telegram

STATUS, ERRORS, TYPE, VARIANT, CONFIGURATION, CONFIGURED = 0xB1, 0xB2, 0xBA, 0xBB, 0xF4, 0xF7
SEVERITIES = ("ok", "info", "warning", "error", "fatal")
BAUD = {0x8067: 9600, 0x8033: 19200, 0x8019: 38400, 0x8001: 500000}
CONFIGURATION_BYTES = 34


@dataclass(frozen=True)
class StatusByte:
    """Last byte of every reply.

    Attributes
    ----------
    severity : str
        One of `SEVERITIES`, or 'unknown'.
    restart_input, implausible, polluted : bool
        Level of the RESTART input; measured values not plausible; window dirty.
    """

    severity: str
    restart_input: bool
    implausible: bool
    polluted: bool


@dataclass(frozen=True)
class DeviceStatus:
    """The parts of the status reply 0xB1 that a recording needs.

    Attributes
    ----------
    firmware, serial : str
    operating_mode : int
        As of command 0x20; 0x24 streams, 0x25 waits for requests.
    fault : int
        0 for a sound device.
    measuring_mode : int
    scan_angle_deg, resolution_deg : float
    baud : int or None
        None for a rate that no manual lists.
    address : int
    unit : {'cm', 'mm'}
    laser_on : bool
    mirror_hz : float
        Turns of the mirror per second; NaN where the motor does not turn.
    """

    firmware: str
    serial: str
    operating_mode: int
    fault: int
    measuring_mode: int
    scan_angle_deg: float
    resolution_deg: float
    baud: int | None
    address: int
    unit: str
    laser_on: bool
    mirror_hz: float


@dataclass(frozen=True)
class Configuration:
    """The 34 bytes of configuration part 1 (0xF4, 0xF7, 0x77); older firmware sends fewer.

    Attributes
    ----------
    block : bytes
    """

    block: bytes = bytes(9) + b"\x02\x02" + bytes(21) + b"\x02\x00"

    @property
    def blanking_m(self):
        """Ranges below are not measured, metres."""
        return int.from_bytes(self.block[:2], "little") / 100

    @property
    def realtime_indices(self):
        """Whether scans carry their indices."""
        return bool(self.block[4] & 2)

    @property
    def measuring_mode(self):
        """Key of `lms2xx.MODES`."""
        return self.block[5]

    @property
    def unit(self):
        """'cm' or 'mm'."""
        return _unit(self.block[6])

    def changed(self, *, measuring_mode=None, unit=None, realtime_indices=None):
        """The same with other values; what is None stays.

        Returns
        -------
        Configuration
        """
        block = bytearray(self.block)
        if realtime_indices is not None:
            block[4] = block[4] & ~2 | 2 * bool(realtime_indices)
        block[5] = block[5] if measuring_mode is None else measuring_mode
        block[6] = block[6] if unit is None else UNITS.index(unit)
        return Configuration(bytes(block))


def encode_configuration(configuration, status=0x10):
    """Reply 0xF4, as a device sends it; a recorded session begins with it (it states the measuring mode)."""
    return encode_telegram(CONFIGURATION, configuration.block, status=status)


def parse_status_byte(status):
    """Meaning of the last byte of a reply.

    Parameters
    ----------
    status : int

    Returns
    -------
    StatusByte
    """
    level = status & 7
    severity = SEVERITIES[level] if level < len(SEVERITIES) else "unknown"
    return StatusByte(severity, bool(status & 0x20), bool(status & 0x40), bool(status & 0x80))


def _data(raw, code, shortest):
    """Data of a telegram that must have a code and a least number of bytes."""
    telegram = parse_telegram(raw)
    if telegram.code != code:
        raise TelegramError(f"code {telegram.code:02X} is not the reply {code:02X} asked for")
    if len(telegram.data) < shortest:
        raise TelegramError(f"reply {code:02X} has {len(telegram.data)} bytes of data, needs {shortest}")
    return telegram.data


def _unit(value):
    if value >= len(UNITS):
        raise TelegramError(f"unit {value} is neither 0 (cm) nor 1 (mm): set one of those (block E, command 77)")
    return UNITS[value]


def parse_status(raw):
    """Status reply 0xB1.

    Parameters
    ----------
    raw : bytes-like
        The whole telegram.

    Returns
    -------
    DeviceStatus

    Raises
    ------
    TelegramError
        If it is damaged, another reply, or too short.
    """
    data = b"\xb1" + _data(raw, STATUS, 123)  # offsets as in the manual, which counts the code as 0
    number = {at: int.from_bytes(data[at : at + 2], "little") for at in (67, 107, 109, 116)}
    return DeviceStatus(
        firmware=_text(data[1:8]),
        serial=_text(data[10:18]),
        operating_mode=data[8],
        fault=data[9],
        measuring_mode=data[102],
        scan_angle_deg=float(number[107]),
        resolution_deg=number[109] / 100,
        baud=BAUD.get(number[116]),
        address=data[120],
        unit=_unit(data[122]),
        laser_on=bool(data[123]),
        mirror_hz=1e6 / (90 * number[67]) if number[67] else float("nan"),
    )


def _text(data):
    return data.decode("ascii", "replace").strip(" \0")


def parse_type(raw):
    """Model, order number and firmware out of the type reply 0xBA, such as ('LMS200', '301063', 'V02.10')."""
    return tuple(part.strip() for part in _text(_data(raw, TYPE, 1)).split(";"))


def parse_errors(raw):
    """Error reply 0xB2.

    Returns
    -------
    list of tuple
        Severity (one of `SEVERITIES`, 'unknown'), whether it is over, number of the error.

    Raises
    ------
    TelegramError
        If it is damaged or another reply.
    """
    data = _data(raw, ERRORS, 0)
    pairs = zip(data[::2], data[1::2], strict=False)
    return [(parse_status_byte(kind).severity, kind >= 0x80, number) for kind, number in pairs]


def parse_variant(raw):
    """Variant reply 0xBB.

    Returns
    -------
    accepted : bool
    scan_angle_deg, resolution_deg : float
        What holds now.

    Raises
    ------
    TelegramError
        If it is damaged, another reply, or too short.
    """
    data = _data(raw, VARIANT, 5)
    return bool(data[0]), float(int.from_bytes(data[1:3], "little")), int.from_bytes(data[3:5], "little") / 100


def parse_configuration(raw):
    """Configuration out of the replies 0xF4 (read) or 0xF7 (written).

    Returns
    -------
    Configuration

    Raises
    ------
    TelegramError
        If it is damaged, another reply, or shorter than the measuring mode and the unit need.
    """
    if bytes(raw[4:5]) == bytes([CONFIGURED]):
        return Configuration(_data(raw, CONFIGURED, 8)[1:])
    return Configuration(_data(raw, CONFIGURATION, 7))
