"""What an emulated LMS2xx remembers: variant, configuration, rate; and the replies that state it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from lrfcal_lib.drivers.lms2xx import MODES, UNITS, encode_telegram
from lrfcal_lib.drivers.lms2xx_replies import BAUD, CONFIGURATION_BYTES, Configuration

VARIANTS = ((100, 100), (100, 50), (100, 25), (180, 100), (180, 50))  # degrees, 1/100 degree
BAUD_WORD = {rate: word for word, rate in BAUD.items()}
STATUS_BYTES = 152
SECOND_BYTES = 84  # of configuration part 2
TURN_US_90 = 148  # a ninetieth of a turn of the mirror, microseconds
BOOT_VERSION = "V02.02 "
# offsets within the status reply, its code being 0
_WORDS = {19: 95, 21: 97, 23: 96, 25: 94, 27: 96, 29: 95, 31: 97, 33: 95, 35: 90, 37: 91, 39: 90, 41: 92,
          43: 100, 45: 100, 47: 100, 49: 100, 51: 100, 53: 100, 55: 100, 57: 100, 59: 95, 61: 95, 63: 95, 65: 95,
          71: 17, 75: 18, 77: 16, 81: 17, 83: 71, 85: 120, 87: 33, 89: 140, 91: 60, 93: 921, 95: 921, 97: 921, 99: 921,
          103: 20, 105: 20}  # fmt: skip


@dataclass
class Memory:
    """Settings of the device.

    Attributes
    ----------
    model : str
        21 characters, the answer to the type request.
    variant : tuple of int
        Degrees and 1/100 degree.
    configuration : Configuration
    baudrate : int
    mode : int
        Operating mode, the sub-command of 0x20.
    address : int
    permanent_baud : bool
        Keep the rate over a restart.
    password : bytes
    serial : str
    errors : list of tuple
        Kind and number, the error list.
    flash_writes : int
        Since the device was made; the flash endures a few thousand.
    """

    model: str = "LMS221;302063;X01.27 "
    variant: tuple[int, int] = (180, 50)
    configuration: Configuration = field(default_factory=Configuration)
    baudrate: int = 9600
    mode: int = 0x25
    address: int = 0
    permanent_baud: bool = False
    password: bytes = b"SICK_LMS"
    serial: str = "05270497"
    errors: list = field(default_factory=list)
    flash_writes: int = 0

    def __post_init__(self):
        if len(self.model) != 21 or not self.model.isascii():
            raise ValueError(f"a type has 21 ASCII characters, got {self.model!r}")
        if not self.takes_variant(self.variant):
            raise ValueError(f"{self.model[:6]} has no variant {self.variant}; variants are {VARIANTS}")
        if self.baudrate not in BAUD_WORD or len(self.password) != 8:
            raise ValueError(f"rate {self.baudrate} Bd, password {self.password!r}: no LMS2xx has that")

    @property
    def firmware(self):
        """Seven characters."""
        return self.model[14:21]

    @property
    def turns(self):
        """Mirror turns of a whole scan."""
        return 100 // self.variant[1]

    def takes_variant(self, variant):
        """Whether the device offers a variant; the LMS211 sees 100 deg only."""
        return variant in VARIANTS and not (self.model.startswith("LMS211") and variant[0] == 180)

    def quarters(self, partial=-1):
        """Bearings of the values of a scan, quarters of a degree, a list."""
        if partial >= 0:
            return list(range(partial, 721, 4))
        angle, step = self.variant
        first = 4 * (90 - angle // 2)
        return list(range(first, first + 4 * angle + 1, step // 25))

    def beam_times(self, turn_s, partial=-1):
        """Seconds from the start of a scan to each beam, a list; fine scans take several turns of the mirror."""
        quarters = self.quarters(partial)
        turns = 1 if partial >= 0 else self.turns
        return [(i % turns + math.radians(q / 4) / math.tau) * turn_s for i, q in enumerate(quarters)]

    def write_configuration(self, block):
        """Take a configuration of 32 to 34 bytes; whether its values are possible."""
        block = bytes(block) + self.configuration.block[len(block) : CONFIGURATION_BYTES]
        if block[5] not in MODES or block[6] >= len(UNITS):
            return False
        self.configuration = Configuration(block)
        self.flash_writes += 1
        return True

    def reply(self, code, data=b""):
        """Telegram of a reply from this address."""
        return encode_telegram(code, data, status=0x10, address=0x80 | self.address)

    def status_data(self):
        """Data of the status reply 0xB1."""
        c, data = self.configuration, bytearray(STATUS_BYTES + 1)
        words = {**_WORDS, 67: TURN_US_90, 107: self.variant[0], 109: self.variant[1]}
        words |= {112: c.block[11], 116: BAUD_WORD[self.baudrate]}
        for at, value in words.items():
            data[at : at + 2] = value.to_bytes(2, "little")
        texts = {1: self.firmware, 10: f"{self.serial:8.8}", 124: BOOT_VERSION}
        for at, text in texts.items():
            data[at : at + len(text)] = text.encode()
        single = {8: self.mode, 102: c.measuring_mode, 111: c.block[10], 118: c.block[9], 119: self.permanent_baud}
        single |= {120: self.address, 121: 1, 122: UNITS.index(c.unit), 123: 1}
        for at, value in single.items():
            data[at] = value
        return bytes(data[1:])

    def restart(self):
        """What a restart does: the variant is that of the factory, the rate too unless it is kept; streaming ends."""
        self.mode = 0x25
        self.variant = (100, 50) if self.model.startswith("LMS211") else (180, 50)
        if not self.permanent_baud:
            self.baudrate = 9600
