"""Scans out of the telegrams of an LMS2xx, with the instants of their beams."""

import math
from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.drivers.lms2xx_link import FASTEST
from lrfcal_lib.model.kinematics import MIRROR_TURN
from lrfcal_lib.session import lms2xx_codec as codec

BURST = 508  # bytes that leave in a turn of the mirror at 500 kBd
# arrivals in the last so many turns, 2 s, tell the host's clock from the device's
WINDOW = 2.0 / MIRROR_TURN
OFF_S = 1.2  # how far a scan may arrive off its expected instant
JITTER_S = 0.05  # larger corrections of the clock leave scans out, smaller ones are spread
LEAST_S = MIRROR_TURN / 100  # between two instants told; far less than between two scans
FORGET = 30.0 / MIRROR_TURN  # turns; after such a pause their number is not known
STUBBORN = 5  # so many implausible scan indices in a row: the device counts anew


def transfer_s(size: int, baudrate: int) -> float:
    """Seconds from the first byte of a scan to its last (manual, 10.10.2).

    Parameters
    ----------
    size
        Bytes; at 500 kBd bursts of 508 leave in a turn of the mirror.
    baudrate
        Bits a second.
    """
    turns = 0
    if baudrate == FASTEST:
        turns = (size - 1) // BURST
    return turns * MIRROR_TURN + (size - turns * BURST) * 10 / baudrate


def interval_s(size: int, baudrate: int, scan_s: float) -> float:
    """Seconds between two scans of a stream: whole scans pass while one is sent (table 10-17).

    Parameters
    ----------
    size
        Bytes of a scan.
    baudrate
        Bits a second.
    scan_s
        Seconds in which one is measured.
    """
    return math.ceil(size * 10 / baudrate / scan_s - 1e-9) * scan_s


@dataclass(frozen=True)
class Reading:
    """A scan with the instants of its beams; neighbours of fine scans are 13.32 ms apart."""

    telegrams: tuple[bytes, ...]  # as sent: one, or the four of a set of interlaced scans
    ranges: np.ndarray  # (B,), metres, NaN where there is no range
    bearings: np.ndarray  # (B,), radians in the LRF frame, ascending
    time_s: float  # clock of the host at the first beam
    beam_times_s: np.ndarray  # (B,), the same for every beam
    # of the (first) telegram, modulo 256; -1 where the device does not count
    telegram_index: int


class ScanClock:
    """Instants of scans: arrivals jitter late, the device's index of turns does not.

    Without indices an arrival counts as it is. With them, the earliest of the arrivals of the last
    two seconds ties the count of turns to the host's clock, so that a busy host or a late telegram
    does not shift a scan. A mirror that is off its nominal speed by a part e shifts it by up to 2 e
    seconds.
    """

    def __init__(self):
        # of turn 0, as each turn, counted on, tells its instant
        self._zeros: dict[int, float] = {}
        self._refused = 0
        self._told = -np.inf

    def place(self, index: int, time_s: float) -> float | None:
        """Instant of a scan, s; it rises from scan to scan. None for a scan that is not newer.

        Parameters
        ----------
        index
            Counts the turns of the mirror modulo 256; -1 where the device does not send it.
        time_s
            Instant as of its arrival, s.
        """
        if index < 0:
            return time_s
        turn = index
        if self._zeros:
            last = max(self._zeros)
            expected = (time_s - min(self._zeros.values())) / MIRROR_TURN
            if expected - last > FORGET or self._refused >= STUBBORN:
                self._zeros.clear()
            else:
                turn += 256 * round((expected - turn) / 256)
                if turn <= last or abs(expected - turn) * MIRROR_TURN >= OFF_S:
                    self._refused += 1
                    return None
        self._refused = 0
        self._zeros[turn] = time_s - turn * MIRROR_TURN
        self._zeros = {t: zero for t, zero in self._zeros.items() if t > turn - WINDOW}
        instant = turn * MIRROR_TURN + min(self._zeros.values())
        if instant < self._told - JITTER_S:  # the clock was found to be far ahead
            return None
        self._told = max(instant, self._told + LEAST_S)
        return self._told


class Assembler:
    """Readings out of the telegrams of a device, one by one.

    Parameters
    ----------
    variant
        Field of view and resolution, degrees.
    configuration : lms2xx_codec.Configuration
    baudrate
        Bits a second.
    interlaced
        Four partial scans of 180 deg are merged into one of 721 values.
    clock
        Of the scans before, where the mirror went on turning: an old telegram that comes first is
        then known as such.

    Attributes
    ----------
    turns : int
        Of the mirror, of which one begins a telegram.
    duration_s, interval_s : float
        From the beginning of a telegram to its last byte, and between two readings of a stream.
    """

    def __init__(
        self,
        variant: tuple[float, float],
        configuration: codec.Configuration,
        baudrate: int,
        interlaced: bool,
        clock: ScanClock,
    ):
        self.configuration = configuration
        self.baudrate = baudrate
        self.interlaced = interlaced
        self._clock = clock
        self._parts: list[Reading] = []
        if interlaced:
            variant = (180, 1.0)  # as each part is
        view, resolution = variant
        values = round(view / resolution) + 1
        self.turns = round(1 / resolution)
        # number of values, unit, and whether there are indices and parts
        self._kind = (
            values,
            codec.UNITS.index(configuration.unit),
            configuration.realtime_indices,
            interlaced,
        )
        size = 10 + 2 * values + 2 * configuration.realtime_indices
        scan_s = self.turns * MIRROR_TURN
        self.duration_s = scan_s + transfer_s(size, baudrate)
        self.interval_s = interval_s(size, baudrate, scan_s)
        if interlaced:
            self.interval_s *= 4

    def feed(self, raw: bytes, arrival_s: float) -> Reading | None:
        """The Reading that a telegram completes.

        Parameters
        ----------
        raw
            With a sound checksum.
        arrival_s
            Instant of its last byte, s.

        Returns
        -------
        Reading or None
            None for a part of a set, and for what is no scan of this variant, unit and kind or is
            not new.
        """
        mode = self.configuration.measuring_mode
        scans = codec.decode_scans(raw, np.array([0]), np.array([len(raw)]), mode)
        if not len(scans.rows):
            return None
        count = scans.words.shape[1]
        (partial,) = scans.partial.tolist()
        (index,) = scans.scan_index.tolist()
        kind = (count + (partial > 0), *scans.unit, index >= 0, partial >= 0)
        if kind != self._kind:
            return None
        begun = arrival_s - transfer_s(len(raw), self.baudrate) - self.turns * MIRROR_TURN
        start_s = self._clock.place(index, begun)
        if start_s is None:
            return None
        quarters = codec.scan_quarters(count, partial)
        # the first turn begins at 0 deg
        times = start_s + (np.arange(count) % self.turns + quarters / 1440) * MIRROR_TURN
        reading = Reading(
            telegrams=(raw,),
            ranges=np.nan_to_num(scans.ranges[0], nan=np.nan, posinf=np.nan),
            bearings=np.radians(quarters / 4),
            time_s=times[0],
            beam_times_s=times,
            telegram_index=scans.telegram_index[0],
        )
        if self.interlaced:
            return self._merged(partial, reading)
        return reading

    def _merged(self, partial, part):
        """The set of four that a part completes, or None; a missing telegram ends a set.

        The device's own counting tells which parts belong together: the number of the partial scan,
        and the telegram index where it is sent (without it, four that are missing in a row are not
        seen). The instant of arrival tells nothing: a busy machine reads late.
        """
        missing = partial != len(self._parts)
        if self._parts and part.telegram_index >= 0:
            missing |= (part.telegram_index - self._parts[-1].telegram_index) % 256 != 1
        if missing:
            self._parts = []
        if partial == len(self._parts):
            self._parts.append(part)
        if len(self._parts) < 4:
            return None
        parts = self._parts
        self._parts = []
        beams = np.concatenate(
            [[part.bearings, part.ranges, part.beam_times_s] for part in parts], axis=1
        )
        bearings, ranges, times = beams[:, beams[0].argsort()]
        return replace(
            parts[0],
            telegrams=sum((part.telegrams for part in parts), ()),
            ranges=ranges,
            bearings=bearings,
            beam_times_s=times,
        )
