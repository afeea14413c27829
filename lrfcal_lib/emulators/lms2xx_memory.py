"""What an LMS2xx remembers: its settings, and what its operating mode sends of the scans."""

import struct
from dataclasses import dataclass

from lrfcal_lib.drivers.lms2xx_link import RATES
from lrfcal_lib.session.lms2xx_codec import SCAN, TOP, UNITS, VARIANTS, Configuration

BAUD_WORD = {9600: 0x8067, 19200: 0x8033, 38400: 0x8019, 500000: 0x8001}
BAUD_COMMAND = {command: rate for rate, command in RATES.items()}
# operating modes
INSTALLATION = 0x00
REQUEST = 0x25
MEAN = 0x26
PART = 0x27
INTERLACED = 0x2A
REFLECTIVITY = 0x2B
# code of the telegrams that they send; 0x24: whole scans
STREAMED = {0x24: SCAN, MEAN: 0xB6, PART: 0xB7, INTERLACED: SCAN, REFLECTIVITY: 0xF5}
# bytes of parameters (manual, 7.2): password; scans; first and last value; parts and these; none in
# diagnosis, and where a rate is set
PARAMETERS = dict.fromkeys([0x10, REQUEST, *STREAMED, *BAUD_COMMAND], 0) | {
    INSTALLATION: 8,
    MEAN: 1,
    PART: 4,
    REFLECTIVITY: 6,
}
WRITTEN = (0x3B, 0x77)  # commands that write to flash
SCANS = range(2, 251)  # of a mean
LAST = 401  # value that can be asked for; there may be fewer
# as which mode a measuring mode encodes ranges; 13 and 14, remission, are those that CARMEN sets
ENCODED = {mode: mode for mode in TOP} | {13: 0, 14: 0}


@dataclass(frozen=True)
class Selection:
    """Part of the scans that a mode sends; by default all."""

    head: bytes = b""  # of its telegrams: the parameters of the mode
    first: int = 1  # value that is sent, counted from 1
    last: int = LAST
    scans: int = 1  # whose mean is sent


@dataclass
class Memory:
    """Settings of the device."""

    model: str = "LMS221;302063;X01.27 "  # 21 characters, the answer to the type request
    variant: tuple[int, int] = (180, 50)  # degrees and 1/100 degree
    configuration: Configuration = Configuration()
    baudrate: int = 9600
    baudrates: tuple[int, ...] = (*BAUD_WORD,)  # that the line allows; RS-232 ends at 38400
    mode: int = REQUEST  # operating mode, the sub-command of 0x20
    address: int = 0
    password: bytes = b"SICK_LMS"
    flash_writes: int = 0  # since the device was made; the flash endures a few thousand

    @property
    def widest(self) -> int:
        """Field of view that it can have, degrees."""
        return 100 if self.model.startswith("LMS211") else 180

    @property
    def turns(self) -> int:
        """Of the mirror for a scan."""
        return 100 // self.variant[1]

    def reply(self, code: int, data: bytes) -> bytes | None:
        """Data of the reply to a command that asks for settings, or changes them.

        Parameters
        ----------
        code, data
            Of the command.

        Returns
        -------
        bytes or None
            None for a command that is not understood now. Nothing is streamed while the variant
            changes.
        """
        match code:
            case 0x31:  # what no driver reads is 0
                return struct.pack(
                    "<7sB 93x B 4x 2H 5x H 2x 2B 2B 29x",
                    self.model[14:21].encode(),
                    self.mode,
                    self.configuration.measuring_mode,
                    *self.variant,
                    BAUD_WORD[self.baudrate],
                    self.address,
                    1,
                    UNITS.index(self.configuration.unit),
                    1,
                )
            case 0x32:
                return b""
            case 0x3A:
                return self.model.encode()
            case 0x3B if len(data) == 4:
                view, step = struct.unpack("<2H", data)
                taken = (view, step / 100) in VARIANTS and view <= self.widest
                if taken:
                    self.variant = view, step
                return struct.pack("<?2H", taken, *self.variant)
            case 0x74:
                return self.configuration.block
            case 0x77 if 32 <= len(data) <= 34 and self.mode == INSTALLATION:
                taken = self.write_configuration(data)
                return bytes([taken]) + self.configuration.block
        return None

    def write_configuration(self, block: bytes) -> bool:
        """Take a configuration.

        Parameters
        ----------
        block
            32 to 34 bytes.

        Returns
        -------
        bool
            Whether its values are possible.
        """
        block += self.configuration.block[len(block) :]
        if block[5] not in ENCODED or block[6] >= len(UNITS):
            return False
        self.configuration = Configuration(block)
        self.flash_writes += 1
        return True


def selection_of(mode: int, parameters: bytes) -> Selection | None:
    """What a mode sends of the scans.

    Parameters
    ----------
    mode
        Sub-command of 0x20.
    parameters
        Behind it.

    Returns
    -------
    Selection or None
        None for a mode that there is not, and for parameters that it does not have.
    """
    if len(parameters) != PARAMETERS.get(mode):
        return None
    if mode == MEAN:
        scans = parameters[0]
        return Selection(parameters, scans=scans) if scans in SCANS else None
    if mode in (PART, REFLECTIVITY):
        first, last = struct.unpack("<2H", parameters[-4:])
        return Selection(parameters, first, last) if 1 <= first <= last <= LAST else None
    return Selection()
