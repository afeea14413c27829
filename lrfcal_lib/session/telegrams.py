"""Scan lines out of lrf/telegrams.bin (bytes as the device sent them) and lrf/index.csv."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from lrfcal_lib.session import lms2xx_codec as codec
from lrfcal_lib.session.files import (
    LARGEST_FILE,
    SessionError,
    check_amount,
    naming,
    read_bytes,
    short,
)
from lrfcal_lib.session.lms2xx_frame import OVERHEAD, STX, TelegramError, check_crc, word
from lrfcal_lib.session.tables import read_table, whole_number

INDEX_COLUMNS = ("t_s", "offset", "length", "placement", "pitch_deg")
OUTCOMES = ("scan", "other", "wrong CRC", "truncated")
SCANNED, OTHER, WRONG, TRUNCATED = range(4)
LONGEST = OVERHEAD + 0xFFFF  # bytes of a telegram
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
        return (
            f"line {row + 2}, offset {self.offset[row]}, length {self.length[row]}, placement "
            f"{self.placement[row]}"
        )


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
    offset = index.offset[whole]
    length = index.length[whole]
    good = (data[offset] == STX) & (word(data, offset + 2) + OVERHEAD == length)
    sound = whole[good & check_crc(data, offset, length)]
    outcome[sound] = OTHER
    if len(sound) < len(whole) / 2:
        raise SessionError(
            f"{path}: {len(whole) - len(sound)} of {len(whole)} telegrams have a wrong CRC in "
            f"{file.name}; the two files are not of one recording, restore both"
        )

    with naming(file):
        mode, notes = _modes(data, index, sound)
        groups = []
        for number in np.unique(mode).tolist():
            rows = sound[mode == number]
            groups += codec.decode_scans(data, index.offset, index.length, number, rows)
        scans = _lines(groups, index)

    values = np.zeros((len(outcome), len(codec.REASONS)), int)
    for group in groups:
        outcome[group.rows] = SCANNED
        reasons = group.reasons
        row, column = np.nonzero(reasons)  # nearly all values are valid
        np.add.at(values, (group.rows[row], reasons[row, column]), 1)
        values[group.rows, 0] = reasons.shape[1] - values[group.rows].sum(axis=1)
    problems = [f"{file}: {note}" for note in (*notes, *_damage(index, outcome, len(data)))]
    if torn:
        problems.append(f"{path}: the last row is cut off, its telegram is left out")
    log = TelegramLog(file, index.offset, index.placement, outcome, values, tuple(problems))
    return scans, log


def _index(rows):
    """The Index in rows of index.csv."""
    numbers = {}
    for key in ("offset", "length", "placement"):
        cells = [
            whole_number(row[key], f"line {line}: {key}")
            for line, row in enumerate(rows, start=2)
        ]
        numbers[key] = np.array(cells, int)
    time_s = np.array([float(row["t_s"] or "nan") for row in rows])
    pitch_deg = np.array([float(row["pitch_deg"] or "nan") for row in rows])
    return Index(time_s=time_s, pitch=np.radians(pitch_deg), **numbers)


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
    missing = index.end > size
    missing[-1] = False
    blind = (index.placement >= 0) & ~np.isfinite(index.pitch)
    for wrong, words in (
        (
            absurd,
            f"telegrams of 7 to {LONGEST} bytes lie one after the other; restore the file",
        ),
        (
            missing,
            f"{file.name} has {size} bytes: restore it, or remove the rows from this one on",
        ),
        (
            blind,
            "pitch_deg is missing; fill it in, or empty the placement to ignore the telegram",
        ),
    ):
        if wrong.any():
            raise ValueError(f"{index.place(wrong.argmax())}: {words}")


def _modes(data, index, rows):
    """Measuring mode at each row: that of the last telegram that states it, before it the first.
    Also notes.
    """
    modes = np.full(len(rows), -1)
    notes = []
    stating = np.isin(data[index.offset[rows] + 4], codec.STATE_MODE)
    for at in np.flatnonzero(stating):
        row = rows[at]
        try:
            raw = data[index.offset[row] : index.end[row]].tobytes()
            modes[at:] = codec.parse_mode(raw)
        except TelegramError as error:
            notes.append(f"{index.place(row)}: {error}; ignored")
    stated = modes[modes >= 0]
    if len(stated) == 0:
        notes.append(
            f"no status or configuration telegram: measuring mode {FACTORY_MODE:02X} (factory) "
            "assumed"
        )
        stated = [FACTORY_MODE]
    modes[modes < 0] = stated[0]
    return modes, notes


def _lines(groups, index):
    """Scan lines on one grid of bearings; refuses a mixture of variants."""
    placed = index.placement >= 0
    groups = [group for group in groups if placed[group.rows].any()]
    if not groups:
        raise ValueError(
            "no telegram with a scan belongs to a placement: was the device streaming?"
        )
    grids = [codec.scan_quarters(group.words.shape[1], group.partial) for group in groups]
    counts = {len(grid) for grid in grids}
    kinds = {(len(grid), group.partial) for grid, group in zip(grids, groups, strict=True)}
    if len(kinds) > 1 and min(group.partial for group in groups) < 0:
        raise ValueError(
            f"scans of {short(sorted(counts))} values are mixed: a session holds one variant, "
            "split the recording"
        )
    # which quarter of a degree the scan is turned by; -1 a whole scan, -2 no scan
    partial = np.full(len(placed), -2)
    number = np.full(
        len(placed), -2
    )  # of the scan, as the device counts; -1 where it does not
    for group in groups:
        partial[group.rows] = group.partial
        number[group.rows] = group.telegram_index
    rows = np.flatnonzero((partial > -2) & placed)
    begins = np.r_[True, ~_goes_on(partial[rows], number[rows], index, rows)]
    line = np.full(len(placed), -1)
    line[rows] = np.cumsum(begins) - 1

    quarters = np.unique(np.concatenate(grids))
    first = rows[begins]
    check_amount(len(first) * len(quarters))
    ranges = np.full((len(first), len(quarters)), np.nan)
    for grid, group in zip(grids, groups, strict=True):
        kept = placed[group.rows]
        columns = np.searchsorted(quarters, grid)
        ranges[line[group.rows[kept]][:, None], columns] = group.ranges[kept]
    return {
        "ranges": ranges,
        "bearings": np.radians(quarters / 4),
        "time_s": np.bincount(line[rows], index.time_s[rows]) / np.bincount(line[rows]),
        "placement": index.placement[first],
        "pitch": index.pitch[first],
    }


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
