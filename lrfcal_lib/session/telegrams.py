"""Scan lines out of recorded telegrams: lrf/telegrams.bin (bytes as the device sent them) and
lrf/index.csv.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lrfcal_lib.session import lms2xx_codec as codec
from lrfcal_lib.session.stated import (
    LARGEST_FILE,
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

    def report(self):
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
            "values": dict(zip(codec.REASONS, self.values.sum(axis=0).tolist(), strict=True)),
            "wrong_crc_offsets": tuple(self.offset[self.outcome == WRONG].tolist()),
        }


def read_telegrams(file, within):
    """Decode a recording.

    Parameters
    ----------
    file : Path
        telegrams.bin; index.csv lies beside it.
    within : Path
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
        index = {
            key: np.array([float(row[key] or "nan") for row in rows])
            for key in ("t_s", "pitch_deg")
        }
        for key in INDEX_COLUMNS[1:4]:
            numbers = [
                whole_number(row[key], f"line {n}: {key}") for n, row in enumerate(rows, start=2)
            ]
            index[key] = np.array(numbers, int)
        _check_index(index, len(data), file)
        check_amount(len(data) // 2)
    offset = index["offset"]
    length = index["length"]
    outcome = np.where(offset + length > len(data), TRUNCATED, WRONG).astype(np.uint8)
    whole = np.flatnonzero(outcome == WRONG)
    good = _sound(data, offset[whole], length[whole])
    sound = whole[good]
    outcome[sound] = OTHER
    if len(sound) < len(whole) / 2:
        bad = f"{len(whole) - len(sound)} of {len(whole)} telegrams have a wrong CRC in {file.name}"
        raise SessionError(f"{path}: {bad}; the two files are not of one recording, restore both")
    with naming(file):
        mode, notes = _modes(data, index, sound)
        groups = []
        for number in np.unique(mode):
            rows = sound[mode == number]
            for group in codec.decode_scans(data, offset[rows], length[rows], int(number)):
                groups.append((rows[group.rows], group))
        scans = _lines(groups, index)
    values = np.zeros((len(outcome), len(codec.REASONS)), int)
    for rows, group in groups:
        outcome[rows] = SCANNED
        row, column = np.nonzero(group.reasons)  # nearly all values are valid
        np.add.at(values, (rows[row], group.reasons[row, column]), 1)
        values[rows, 0] = group.reasons.shape[1] - values[rows].sum(axis=1)
    problems = []
    if torn:
        problems.append(f"{path}: the last row is cut off, its telegram is left out")
    for note in [*notes, *_damage(index, outcome, len(data))]:
        problems.append(f"{file}: {note}")
    return scans, TelegramLog(file, offset, index["placement"], outcome, values, tuple(problems))


def _sound(data, offset, length):
    """Which telegrams begin as they should, have the length that they state, and a right CRC."""
    begins = data[offset] == codec.STX
    stated = codec.word(data, offset + 2) + codec.OVERHEAD
    return begins & (stated == length) & codec.check_crc(data, offset, length)


def _check_index(index, size, file):
    """Telegrams lie one after the other in the file, but for a last one that is cut off, and every
    scan has a pitch.
    """
    offset, length, placement = (index[key] for key in ("offset", "length", "placement"))
    ends = offset + length
    if len(offset) == 0:
        raise ValueError(
            f"no telegram in the index, {size} bytes in {file.name}: nothing was recorded"
        )
    bad = (
        (length < 7) | (length > LONGEST) | (offset > LARGEST_FILE) | (offset < np.r_[0, ends[:-1]])
    )
    for row in np.flatnonzero(bad)[:1]:
        where = _place(index, row)
        raise ValueError(
            f"{where}: telegrams of 7 to {LONGEST} bytes lie one after the other; restore the file"
        )
    for row in np.flatnonzero(ends[:-1] > size)[:1]:
        where = _place(index, row)
        raise ValueError(
            f"{where}, but {file.name} has {size} bytes: restore it, or remove the rows from "
            "this one on"
        )
    for row in np.flatnonzero((placement >= 0) & ~np.isfinite(index["pitch_deg"]))[:1]:
        where = f"{_place(index, row)}, placement {placement[row]}"
        raise ValueError(
            f"{where}: pitch_deg is missing; fill it in, or empty the placement to ignore the "
            "telegram"
        )


def _place(index, row):
    return f"line {row + 2}, offset {index['offset'][row]}, length {index['length'][row]}"


def _modes(data, index, rows):
    """Measuring mode at each row: that of the last telegram that states it, before it the first.
    Also notes.
    """
    codes = data[index["offset"][rows] + 4]
    telling = []
    stated = []
    notes = []
    for row in np.flatnonzero(
        np.isin(codes, (codec.CONFIGURATION, codec.CONFIGURED, codec.STATUS))
    ):
        first = index["offset"][rows[row]]
        end = first + index["length"][rows[row]]
        parse = codec.parse_configuration
        if codes[row] == codec.STATUS:
            parse = codec.parse_status
        try:
            stated.append(parse(data[first:end].tobytes()).measuring_mode)
            telling.append(row)
        except codec.TelegramError as error:
            notes.append(f"{_place(index, rows[row])}: {error}; ignored")
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
    n = len(index["offset"])
    # which quarter of a degree the scan is turned by; -1 a whole scan, -2 no scan
    partial = np.full(n, -2)
    number = np.full(n, -2)  # of the scan, as the device counts; -1 where it does not
    for rows, group in groups:
        partial[rows] = group.partial
        number[rows] = group.telegram_index
    rows = np.flatnonzero((partial > -2) & (index["placement"] >= 0))
    if not len(rows):
        raise ValueError(
            "no telegram with a scan belongs to a placement: was the device streaming?"
        )
    line = np.full(n, -1)
    line[rows] = np.cumsum(np.r_[True, ~_goes_on(partial[rows], number[rows], index, rows)]) - 1
    kinds = set()
    for mine, group in groups:
        for part in np.unique(group.partial[line[mine] >= 0]):
            kinds.add((group.words.shape[1], int(part)))
    if len(kinds) > 1 and any(part < 0 for _, part in kinds):
        counts = short(sorted({values for values, _ in kinds}))
        raise ValueError(
            f"scans of {counts} values are mixed: a session holds one variant, split the recording"
        )
    quarters = np.unique(np.concatenate([codec.scan_quarters(*kind) for kind in sorted(kinds)]))
    lines = line.max() + 1
    check_amount(lines * len(quarters))
    ranges = np.full((lines, len(quarters)), np.nan)
    for mine, group in groups:
        used = line[mine] >= 0
        for part in np.unique(group.partial[used]):
            turned = used & (group.partial == part)
            columns = np.searchsorted(quarters, codec.scan_quarters(group.words.shape[1], part))
            ranges[line[mine[turned]][:, None], columns] = group.ranges[turned]
    first = rows[np.searchsorted(line[rows], np.arange(len(ranges)))]
    time = np.bincount(line[rows], index["t_s"][rows]) / np.bincount(line[rows])
    scans = {"ranges": ranges, "bearings": np.radians(quarters / 4), "time_s": time}
    return {
        **scans,
        "placement": index["placement"][first],
        "pitch": np.radians(index["pitch_deg"][first]),
    }


def _goes_on(partial, number, index, rows):
    """Whether each scan but the first goes on with the line of the one before, shape (n - 1,)."""
    step = np.diff(partial)
    rises = (partial[:-1] >= 0) & (step > 0)
    stays = (np.diff(index["placement"][rows]) == 0) & (np.diff(index["pitch_deg"][rows]) == 0)
    uncounted = (number[1:] < 0) | (number[:-1] < 0)
    return rises & stays & (uncounted | (np.diff(number) % 256 == step))


def _damage(index, outcome, size):
    """Sentences about telegrams that could not be used."""
    wrong = index["offset"][outcome == WRONG].tolist()
    last = int(index["offset"][-1])
    tail = size - last - int(index["length"][-1])
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


def other_than_stated(scans, lrf):
    """Sentences about telegrams that cover other bearings than the LrfInfo; they count, not
    session.json.
    """
    bearings = scans["bearings"]
    step = (bearings[-1] - bearings[0]) / (len(bearings) - 1)
    seen = (*np.degrees(bearings[[0, -1]]), math.degrees(step))
    stated = (*np.degrees(lrf.field_of_view), math.degrees(lrf.bearing_step))
    if np.abs(np.subtract(seen, stated)).max() <= stated[2] / 2:
        return ()
    texts = ["{:g} to {:g} deg in steps of {:g} deg".format(*values) for values in (seen, stated)]
    remedy = "the telegrams count; correct field_of_view_deg and bearing_step_deg"
    return (f"the telegrams cover {texts[0]}, session.json states {texts[1]}: {remedy}",)
