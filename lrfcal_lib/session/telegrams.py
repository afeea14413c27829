"""Scan lines out of lrf/telegrams.bin (bytes as the device sent them) and lrf/index.csv."""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from lrfcal_lib.session import lms2xx_codec as codec
from lrfcal_lib.session.stated import (
    LARGEST_FILE,
    LrfInfo,
    SessionError,
    check_amount,
    naming,
    read_bytes,
    short,
)
from lrfcal_lib.session.tables import read_table, whole_number

INDEX_COLUMNS = ("t_s", "offset", "length", "placement", "pitch_deg")
OUTCOMES = ("scan", "other", "wrong CRC", "truncated")
SCANNED, OTHER, WRONG, TRUNCATED = range(4)
LONGEST = codec.OVERHEAD + 0xFFFF  # bytes of a telegram
FACTORY_MODE = 0


@dataclass(frozen=True)
class TelegramLog:
    """What became of every telegram of a recording.

    Attributes
    ----------
    file : Path
    offset, placement : ndarray of int, shape (n,)
        In the file; -1 for no placement.
    outcome : ndarray of uint8, shape (n,)
        Index into `OUTCOMES`; 'other' is every sound telegram that holds no whole or partial scan.
    values : ndarray of int, shape (n, len(REASONS))
        How many values of a scan had each reason, see ``lrfcal_lib.session.lms2xx_codec.REASONS``.
    problems : tuple of str
    """

    file: Path
    offset: np.ndarray
    placement: np.ndarray
    outcome: np.ndarray
    values: np.ndarray
    problems: tuple[str, ...]

    def report(self) -> dict:
        """What became of the recorded telegrams.

        Returns
        -------
        dict
            'telegrams' : int; 'outcomes' : dict of str to int; 'values' : dict of str to int, by
            reason; 'wrong_crc_offsets' : tuple of int.
        """
        outcomes = np.bincount(self.outcome, minlength=len(OUTCOMES)).tolist()
        return {
            "telegrams": len(self.offset),
            "outcomes": dict(zip(OUTCOMES, outcomes, strict=True)),
            "values": dict(
                zip(codec.REASONS, self.values.sum(axis=0).tolist(), strict=True)
            ),
            "wrong_crc_offsets": tuple(self.offset[self.outcome == WRONG].tolist()),
        }


@dataclass(frozen=True)
class Index:
    """Where telegrams are in their file, and what is known of each; all of shape (n,).

    `time_s` is NaN where unknown, `placement` -1 for none, `pitch` in radians.
    """

    time_s: np.ndarray
    offset: np.ndarray
    length: np.ndarray
    placement: np.ndarray
    pitch: np.ndarray

    @cached_property
    def end(self) -> np.ndarray:
        """Behind the last byte of each telegram."""
        return self.offset + self.length

    def place(self, row: int | np.intp) -> str:
        """Where a telegram is, as text."""
        return f"line {row + 2}, offset {self.offset[row]}, length {self.length[row]}"


def read_telegrams(file: Path, within: Path) -> tuple[dict[str, np.ndarray], TelegramLog]:
    """Decode a recording.

    Parameters
    ----------
    file
        telegrams.bin; index.csv lies beside it.
    within
        The session's folder.

    Returns
    -------
    scans : dict of ndarray
        As in scans.npz.
    log : TelegramLog

    Raises
    ------
    SessionError
        If the two files do not belong together, or scans of different variants of the device are
        mixed.

    Notes
    -----
    The measuring mode, which a scan does not tell, is taken from the last status or configuration
    reply before it. Interlaced scans of 1 deg steps, each turned by quarters of a degree, become
    one line where they follow each other in rising order at the same placement and the same pitch;
    a part that is missing stays NaN. What the device calls larger than its maximum is NaN here.
    """
    data = np.frombuffer(read_bytes(file, within), np.uint8)
    path = file.with_name("index.csv")
    rows, torn = read_table(path, INDEX_COLUMNS, within, torn=True)
    with naming(path):
        index = _index(rows)
        _check_index(index, len(data), file)
        check_amount(len(data) // 2)

    outcome = np.where(index.end > len(data), TRUNCATED, WRONG).astype(np.uint8)
    whole = np.flatnonzero(outcome == WRONG)
    sound = whole[_is_sound(data, index.offset[whole], index.length[whole])]
    outcome[sound] = OTHER
    if len(sound) < len(whole) / 2:
        bad = f"{len(whole) - len(sound)} of {len(whole)} telegrams have a wrong CRC in {file.name}"
        raise SessionError(
            f"{path}: {bad}; the two files are not of one recording, restore both"
        )

    with naming(file):
        mode, notes = _modes(data, index, sound)
        groups = []
        for number in np.unique(mode):
            rows = sound[mode == number]
            groups += codec.decode_scans(
                data, index.offset, index.length, int(number), rows
            )
        scans = _lines(groups, index)

    values = np.zeros((len(outcome), len(codec.REASONS)), int)
    for group in groups:
        outcome[group.rows] = SCANNED
        reasons = group.reasons
        row, column = np.nonzero(reasons)  # nearly all values are valid
        np.add.at(values, (group.rows[row], reasons[row, column]), 1)
        values[group.rows, 0] = reasons.shape[1] - values[group.rows].sum(axis=1)
    problems = []
    if torn:
        problems.append(f"{path}: the last row is cut off, its telegram is left out")
    for note in [*notes, *_damage(index, outcome, len(data))]:
        problems.append(f"{file}: {note}")
    log = TelegramLog(file, index.offset, index.placement, outcome, values, tuple(problems))
    return scans, log


def _index(rows):
    """The Index in rows of index.csv."""
    numbers = {}
    for key in ("offset", "length", "placement"):
        cells = [
            whole_number(row[key], f"line {n}: {key}")
            for n, row in enumerate(rows, start=2)
        ]
        numbers[key] = np.array(cells, int)
    time_s = np.array([float(row["t_s"] or "nan") for row in rows])
    pitch_deg = np.array([float(row["pitch_deg"] or "nan") for row in rows])
    return Index(time_s=time_s, pitch=np.radians(pitch_deg), **numbers)


def _is_sound(data, offset, length):
    """Which telegrams begin as they should, have the length that they state, and a right CRC."""
    begins = data[offset] == codec.STX
    stated = codec.word(data, offset + 2) + codec.OVERHEAD
    return begins & (stated == length) & codec.check_crc(data, offset, length)


def _check_index(index, size, file):
    """Telegrams lie one after the other in the file, but for a last one that is cut off, and every
    scan has a pitch.
    """
    if len(index.offset) == 0:
        raise ValueError(
            f"no telegram in the index, {size} bytes in {file.name}: nothing was recorded"
        )
    absurd = (index.length < 7) | (index.length > LONGEST) | (index.offset > LARGEST_FILE)
    absurd |= index.offset < np.r_[0, index.end[:-1]]
    if absurd.any():
        where = index.place(absurd.argmax())
        raise ValueError(
            f"{where}: telegrams of 7 to {LONGEST} bytes lie one after the other; restore the file"
        )
    missing = index.end > size
    if missing[:-1].any():
        where = index.place(missing.argmax())
        raise ValueError(
            f"{where}, but {file.name} has {size} bytes: restore it, or remove the rows from this "
            "one on"
        )
    blind = (index.placement >= 0) & ~np.isfinite(index.pitch)
    if blind.any():
        where = f"{index.place(blind.argmax())}, placement {index.placement[blind][0]}"
        raise ValueError(
            f"{where}: pitch_deg is missing; "
            "fill it in, or empty the placement to ignore the telegram"
        )


def _modes(data, index, rows):
    """Measuring mode at each row: that of the last telegram that states it, before it the first.
    Also notes.
    """
    parse = dict.fromkeys(
        (codec.CONFIGURATION, codec.CONFIGURED), codec.parse_configuration
    )
    parse[codec.STATUS] = codec.parse_status
    codes = data[index.offset[rows] + 4]
    telling = []
    stated = []
    notes = []
    for at in np.flatnonzero(np.isin(codes, list(parse))):
        row = rows[at]
        raw = data[index.offset[row] : index.end[row]].tobytes()
        try:
            stated.append(parse[codes[at]](raw).measuring_mode)
            telling.append(at)
        except codec.TelegramError as error:
            notes.append(f"{index.place(row)}: {error}; ignored")
    if not telling:
        notes.append(
            f"no status or configuration telegram: measuring mode {FACTORY_MODE:02X} (factory) "
            "assumed"
        )
        return np.full(len(rows), FACTORY_MODE), notes
    last = np.searchsorted(telling, np.arange(len(rows)), side="right") - 1
    return np.array(stated)[np.maximum(last, 0)], notes


def _lines(groups, index):
    """Scan lines on one grid of bearings; refuses a mixture of variants."""
    n = len(index.offset)
    placed = index.placement >= 0
    kinds = sorted({kind for group in groups for kind in _kinds(group, placed)})
    if not kinds:
        raise ValueError(
            "no telegram with a scan belongs to a placement: was the device streaming?"
        )
    if len(kinds) > 1 and min(part for _, part in kinds) < 0:
        counts = short(sorted({values for values, _ in kinds}))
        raise ValueError(
            f"scans of {counts} values are mixed: a session holds one variant, split the recording"
        )
    # which quarter of a degree the scan is turned by; -1 a whole scan, -2 no scan
    partial = np.full(n, -2)
    number = np.full(n, -2)  # of the scan, as the device counts; -1 where it does not
    for group in groups:
        partial[group.rows] = group.partial
        number[group.rows] = group.telegram_index
    rows = np.flatnonzero((partial > -2) & placed)
    begins = np.r_[True, ~_goes_on(partial[rows], number[rows], index, rows)]
    line = np.full(n, -1)
    line[rows] = np.cumsum(begins) - 1

    quarters = np.unique(np.concatenate([codec.scan_quarters(*kind) for kind in kinds]))
    first = rows[begins]
    check_amount(len(first) * len(quarters))
    ranges = np.full((len(first), len(quarters)), np.nan)
    for group in groups:
        for values, part in _kinds(group, placed):
            turned = (group.partial == part) & placed[group.rows]
            columns = np.searchsorted(quarters, codec.scan_quarters(values, part))
            ranges[line[group.rows[turned]][:, None], columns] = group.ranges[turned]
    return {
        "ranges": ranges,
        "bearings": np.radians(quarters / 4),
        "time_s": np.bincount(line[rows], index.time_s[rows]) / np.bincount(line[rows]),
        "placement": index.placement[first],
        "pitch": index.pitch[first],
    }


def _kinds(group, placed):
    """Number of values, and quarters that scans are turned by, of those that have a placement."""
    parts = np.unique(group.partial[placed[group.rows]])
    return [(group.words.shape[1], int(part)) for part in parts]


def _goes_on(partial, number, index, rows):
    """Whether each scan but the first goes on with the line of the one before, shape (n - 1,)."""
    step = np.diff(partial)
    rises = (partial[:-1] >= 0) & (step > 0)
    stays = (np.diff(index.placement[rows]) == 0) & (np.diff(index.pitch[rows]) == 0)
    uncounted = (number[1:] < 0) | (number[:-1] < 0)
    return rises & stays & (uncounted | (np.diff(number) % 256 == step))


def _damage(index, outcome, size):
    """Sentences about telegrams that could not be used."""
    wrong = index.offset[outcome == WRONG].tolist()
    last = int(index.offset[-1])
    tail = size - int(index.end[-1])
    if wrong:
        yield (
            f"{len(wrong)} of {len(outcome)} telegrams have a wrong CRC, left out, at "
            f"{short(wrong)}"
        )
    if outcome[-1] == TRUNCATED:
        yield (
            f"the last telegram, at {last}, is cut off after {max(size - last, 0)} bytes and "
            "left out"
        )
    if tail > 0:
        yield (
            f"{tail} bytes after the last telegram in index.csv are not used; was the recording "
            "killed?"
        )


def other_than_stated(scans: dict[str, np.ndarray], lrf: LrfInfo) -> tuple[str, ...]:
    """A sentence if telegrams cover other bearings than is stated; they count, not session.json."""
    bearings = scans["bearings"]
    step = (bearings[-1] - bearings[0]) / (len(bearings) - 1)
    seen = (*np.degrees(bearings[[0, -1]]), math.degrees(step))
    stated = (*np.degrees(lrf.field_of_view), math.degrees(lrf.bearing_step))
    if np.abs(np.subtract(seen, stated)).max() <= stated[2] / 2:
        return ()
    texts = [
        "{:g} to {:g} deg in steps of {:g} deg".format(*values) for values in (seen, stated)
    ]
    remedy = "the telegrams count; correct field_of_view_deg and bearing_step_deg"
    return (f"the telegrams cover {texts[0]}, session.json states {texts[1]}: {remedy}",)
