"""Scan lines out of recorded telegrams: lrf/telegrams.bin (bytes as the device sent them) and lrf/index.csv."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lrfcal_lib.session.lms2xx_codec import (
    CONFIGURATION,
    CONFIGURED,
    OVERHEAD,
    REASONS,
    STATUS,
    STX,
    TelegramError,
    check_crc,
    decode_scans,
    parse_configuration,
    parse_status,
    scan_quarters,
)
from lrfcal_lib.session.stated import LARGEST_FILE, SessionError, check_amount, naming, read_bytes, read_table, short

INDEX_COLUMNS = ("t_s", "offset", "length", "placement", "pitch_deg")
OUTCOMES = ("scan", "other", "wrong CRC", "truncated")
SCANNED, OTHER, WRONG, TRUNCATED = range(len(OUTCOMES))
LONGEST = OVERHEAD + 0xFFFF  # bytes of a telegram
FACTORY_MODE = 0


@dataclass(frozen=True)
class TelegramLog:
    """What became of every telegram of a recording.

    Attributes
    ----------
    file : Path
    offset : ndarray of int, shape (n,)
        In the file.
    placement : ndarray of int, shape (n,)
        -1 for none.
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

    def report(self, placement=None):
        """Counts of telegrams and of their values.

        Parameters
        ----------
        placement : int, optional
            All telegrams, also those of no placement, by default.

        Returns
        -------
        dict
            'telegrams' : int; 'outcomes' : dict of str to int; 'values' : dict of str to int, by reason;
            'wrong_crc_offsets' : tuple of int.
        """
        rows = np.ones(len(self.offset), bool) if placement is None else self.placement == placement
        outcomes = np.bincount(self.outcome[rows], minlength=len(OUTCOMES)).tolist()
        return {
            "telegrams": int(rows.sum()),
            "outcomes": dict(zip(OUTCOMES, outcomes, strict=True)),
            "values": dict(zip(REASONS, self.values[rows].sum(axis=0).tolist(), strict=True)),
            "wrong_crc_offsets": tuple(self.offset[rows & (self.outcome == WRONG)].tolist()),
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
        If the two files do not belong together, or scans of different variants of the device are mixed.

    Notes
    -----
    The measuring mode, which a scan does not tell, is taken from the last status or configuration reply before it.
    Interlaced scans of 1 deg steps, each turned by quarters of a degree, become one line where they follow each other
    in rising order at the same placement and the same pitch; a part that is missing stays NaN. What the device calls
    larger than its maximum is NaN here.
    """
    data, path = np.frombuffer(read_bytes(file, within), np.uint8), file.with_name("index.csv")
    index, problems = _read_index(path, within)
    with naming(path):
        outcome = _check_index(index, len(data), file)
        check_amount(len(data) // 2)
    whole = np.flatnonzero(outcome != TRUNCATED)
    good = _sound(data, index["offset"][whole], index["length"][whole])
    outcome[whole] = np.where(good, OTHER, WRONG)
    if good.sum() < len(good) / 2:
        bad = f"{len(good) - good.sum()} of {len(good)} telegrams have a wrong CRC in {file.name}"
        raise SessionError(f"{path}: {bad}; the two files are not of one recording, restore both")
    with naming(file):
        groups, notes = _decode(data, index, np.flatnonzero(outcome == OTHER))
        scans = _lines(groups, index)
    values = np.zeros((len(outcome), len(REASONS)), int)
    for rows, group in groups:
        outcome[rows] = SCANNED
        values[rows] = _counts(group.reasons)
    problems += [f"{file}: {note}" for note in [*notes, *_damage(index, outcome, len(data))]]
    return scans, TelegramLog(file, index["offset"], index["placement"], outcome, values, tuple(problems))


def _read_index(path, within):
    """Columns of index.csv as arrays, and problems; a row cut off by a crash is left out."""
    rows, cut = read_table(path, INDEX_COLUMNS, within, torn=True)
    index = {}
    with naming(path):
        for key in ("t_s", "pitch_deg"):
            index[key] = np.array([float(row[key] or "nan") for row in rows])
        for key in ("offset", "length", "placement"):
            index[key] = np.array([int(row[key] or -1) for row in rows], int)
    return index, [f"{path}: the last row is cut off, its telegram is left out"] if cut else []


def _sound(data, offset, length):
    """Which telegrams begin, end and check as a telegram does."""
    stated = data[offset + 2] + (data[offset + 3].astype(int) << 8) + OVERHEAD
    return (data[offset] == STX) & (stated == length) & check_crc(data, offset, length)


def _check_index(index, size, file):
    """Outcomes so far: all 'other', the last one 'truncated' where the data end before it does."""
    offset, length = index["offset"], index["length"]
    ends = offset + length
    outcome = np.full(len(offset), OTHER, np.uint8)
    if len(offset) == 0:
        raise ValueError(f"no telegram in the index, {size} bytes in {file.name}: nothing was recorded")
    bad = np.flatnonzero((length < 7) | (length > LONGEST) | (offset > LARGEST_FILE) | (offset < np.r_[0, ends[:-1]]))
    if len(bad):
        where = _place(index, bad[0])
        raise ValueError(f"{where}: telegrams of 7 to {LONGEST} bytes lie one after the other; restore the file")
    if np.any(ends[:-1] > size):
        where = _place(index, np.argmax(ends > size))
        raise ValueError(f"{where}, but {file.name} has {size} bytes: restore it, or remove the rows from this one on")
    outcome[-1] = TRUNCATED if ends[-1] > size else OTHER
    lost = np.flatnonzero((index["placement"] >= 0) & ~np.isfinite(index["pitch_deg"]))
    if len(lost):
        where = f"{_place(index, lost[0])}, placement {index['placement'][lost[0]]}"
        raise ValueError(f"{where}: pitch_deg is missing; fill it in, or empty the placement to ignore the telegram")
    return outcome


def _place(index, row):
    return f"line {row + 2}, offset {index['offset'][row]}, length {index['length'][row]}"


def _counts(reasons):
    """How often each reason occurs in each row, shape (n, len(REASONS)); nearly all values are valid."""
    row, column = np.nonzero(reasons)
    flat = np.bincount(row * len(REASONS) + reasons[row, column], minlength=reasons.shape[0] * len(REASONS))
    out = flat.reshape(-1, len(REASONS))
    out[:, 0] = reasons.shape[1] - out.sum(axis=1)
    return out


def _decode(data, index, rows):
    """Pairs of rows of the index and their Scans, and notes about the measuring mode."""
    mode, notes = _modes(data, index, rows)
    out = []
    for one in np.unique(mode):
        some = rows[mode == one]
        found = decode_scans(data, index["offset"][some], index["length"][some], int(one))
        out += [(some[group.rows], group) for group in found]
    return out, notes


def _modes(data, index, rows):
    """Measuring mode at each row: that of the last telegram that states it, before it the first. Also notes."""
    codes = data[index["offset"][rows] + 4]
    telling, stated, notes = [], [], []
    for row in np.flatnonzero(np.isin(codes, (CONFIGURATION, CONFIGURED, STATUS))):
        first = index["offset"][rows[row]]
        parse = parse_status if codes[row] == STATUS else parse_configuration
        try:
            stated.append(parse(data[first : first + index["length"][rows[row]]].tobytes()).measuring_mode)
            telling.append(row)
        except TelegramError as error:
            notes.append(f"{_place(index, rows[row])}: {error}; ignored")
    if not telling:
        notes.append(f"no status or configuration telegram: measuring mode {FACTORY_MODE:02X} (factory) assumed")
        return np.full(len(rows), FACTORY_MODE), notes
    last = np.searchsorted(telling, np.arange(len(rows)), side="right") - 1
    return np.array(stated)[np.maximum(last, 0)], notes


def _lines(groups, index):
    """Scan lines on one grid of bearings."""
    partial, number = (np.full(len(index["offset"]), -2) for _ in range(2))
    for rows, group in groups:
        partial[rows], number[rows] = group.partial, group.telegram_index
    rows = np.flatnonzero((partial > -2) & (index["placement"] >= 0))
    if not len(rows):
        raise ValueError("no telegram with a scan belongs to a placement: was the device streaming?")
    line = np.full(len(partial), -1)
    line[rows] = np.cumsum(_begins(*(a[rows] for a in (partial, number, index["placement"], index["pitch_deg"])))) - 1
    quarters = _grid(groups, line)
    check_amount((line.max() + 1) * len(quarters))
    ranges = np.full((line.max() + 1, len(quarters)), np.nan)
    for some, group in groups:
        used = line[some] >= 0
        for part in np.unique(group.partial[used]):
            mine = used & (group.partial == part)
            columns = np.searchsorted(quarters, scan_quarters(group.words.shape[1], part))
            ranges[line[some[mine]][:, None], columns] = group.ranges[mine]
    first = rows[np.searchsorted(line[rows], np.arange(len(ranges)))]
    time = np.bincount(line[rows], index["t_s"][rows]) / np.bincount(line[rows])
    scans = {"ranges": ranges, "bearings": np.radians(quarters / 4), "time_s": time}
    return {**scans, "placement": index["placement"][first], "pitch": np.radians(index["pitch_deg"][first])}


def _begins(partial, number, placement, pitch):
    """Which scans begin a line: all but the later parts of a set of interlaced ones."""
    step = np.diff(partial)
    later = (partial[:-1] >= 0) & (step > 0) & (np.diff(placement) == 0) & (np.diff(pitch) == 0)
    later &= (number[1:] < 0) | (number[:-1] < 0) | (np.diff(number) % 256 == step)
    return np.concatenate([[True], ~later])


def _grid(groups, line):
    """All bearings of the lines in quarters of a degree, ascending; refuses a mixture of variants."""
    kinds = {(g.words.shape[1], int(part)) for rows, g in groups for part in np.unique(g.partial[line[rows] >= 0])}
    whole = sorted(count for count, part in kinds if part < 0)
    if len(whole) > 1 or (whole and len(kinds) > 1):
        counts = short(sorted({count for count, _ in kinds}))
        raise ValueError(f"scans of {counts} values are mixed: a session holds one variant, split the recording")
    return np.unique(np.concatenate([scan_quarters(*kind) for kind in sorted(kinds)]))


def _damage(index, outcome, size):
    """Sentences about telegrams that could not be used."""
    wrong, last = index["offset"][outcome == WRONG].tolist(), int(index["offset"][-1])
    tail = size - last - int(index["length"][-1])
    out = []
    if wrong:
        out.append(f"{len(wrong)} of {len(outcome)} telegrams have a wrong CRC, left out, at {short(wrong)}")
    if outcome[-1] == TRUNCATED:
        out.append(f"the last telegram, at {last}, is cut off after {max(size - last, 0)} bytes and left out")
    if tail > 0:
        out.append(f"{tail} bytes after the last telegram in index.csv are not used; was the recording killed?")
    return out


def other_than_stated(scans, lrf):
    """Sentences about telegrams that cover other bearings than session.json states.

    Parameters
    ----------
    scans : dict of ndarray
        Of :func:`read_telegrams`; they count, not session.json.
    lrf : LrfInfo

    Returns
    -------
    tuple of str
    """
    bearings = scans["bearings"]
    step, half = (bearings[-1] - bearings[0]) / (len(bearings) - 1), lrf.bearing_step / 2
    seen = (*np.degrees(bearings[[0, -1]]), math.degrees(step))
    stated = (*np.degrees(lrf.field_of_view), math.degrees(lrf.bearing_step))
    if np.abs(np.subtract(seen, stated)).max() <= math.degrees(half):
        return ()
    texts = ["{:g} to {:g} deg in steps of {:g} deg".format(*values) for values in (seen, stated)]
    return (f"the telegrams cover {texts[0]}, session.json states {texts[1]}: the telegrams count",)
