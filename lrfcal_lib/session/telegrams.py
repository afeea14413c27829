"""Scan lines out of lrf/telegrams.bin (bytes as the device sent them) and lrf/index.csv."""

from dataclasses import dataclass
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
from lrfcal_lib.session.lms2xx_frame import OVERHEAD, TelegramError, are_sound
from lrfcal_lib.session.scans import check_scans
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
    offset, placement : ndarray of int, shape (n,)
        In the file; -1 for no placement.
    outcome : ndarray of int, shape (n,)
        Index into `OUTCOMES`; 'other' is every sound telegram that holds no whole or partial scan.
    values : ndarray of int, shape (len(REASONS),)
        How many values of all scans had each reason, see
        ``lrfcal_lib.session.lms2xx_codec.REASONS``.
    """

    offset: np.ndarray
    placement: np.ndarray
    outcome: np.ndarray
    values: np.ndarray


def read_telegrams(
    file: Path, within: Path
) -> tuple[dict[str, np.ndarray], TelegramLog, list[str]]:
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
        As in scans.npz, see :func:`lrfcal_lib.session.scans.check_scans`.
    log : TelegramLog
    problems : list of str
        What is not used, and why.

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
    with naming(path):
        index = _index(read_table(path, INDEX_COLUMNS, within, torn=True), len(data), file)
        check_amount(len(data) // 2)

    sound = are_sound(data, index.offset, index.length)
    whole = index.offset + index.length <= len(data)
    outcome = np.select([sound, whole], [OTHER, WRONG], TRUNCATED)
    wrong = (outcome == WRONG).sum()
    if wrong > whole.sum() / 2:
        raise SessionError(
            f"{path}: {wrong} of {whole.sum()} telegrams have a wrong CRC in {file.name}; the two "
            "files are not of one recording, restore both"
        )

    with naming(file):
        modes, notes = _modes(data, index, np.flatnonzero(sound))
        # what is damaged holds no scan
        scans = codec.decode_scans(
            data, index.offset, np.where(sound, index.length, 0), modes
        )
        lines = check_scans(_lines(scans, index))

    outcome[scans.rows] = SCANNED
    sent = np.arange(scans.words.shape[1]) < scans.count[:, None]
    values = np.bincount(scans.reasons[sent], minlength=len(codec.REASONS))
    problems = [f"{file}: {note}" for note in (*notes, *_damage(index, outcome, len(data)))]
    if not read_bytes(path, within).endswith(b"\n"):
        problems.append(f"{path}: the last row is cut off, its telegram is left out")
    return lines, TelegramLog(index.offset, index.placement, outcome, values), problems


def _index(rows, size, file):
    """The rows of index.csv as an array: NaN for no time or pitch, -1 for no placement.

    Telegrams lie one after the other in the file, but for a last one that is cut off, and every
    scan has a pitch.
    """
    index = np.recarray(len(rows), formats="f8, i8, i8, i8, f8", names=INDEX_COLUMNS)
    for at, row in enumerate(rows):
        for key, cell in row.items():
            if index.dtype[key].kind == "f":
                index[key][at] = cell or np.nan
            else:
                index[key][at] = whole_number(cell, f"line {at + 2}: {key}")
    if len(index) == 0:
        raise ValueError(
            f"no telegram in the index, {size} bytes in {file.name}: nothing was recorded"
        )
    ends = (index.offset + index.length)[:-1]
    absurd = (index.length < 7) | (index.length > LONGEST) | (index.offset > LARGEST_FILE)
    absurd |= index.offset < np.r_[0, ends]
    blind = (index.placement >= 0) & ~np.isfinite(index.pitch_deg)
    for wrong, words in (
        (
            absurd,
            f"telegrams of 7 to {LONGEST} bytes lie one after the other; restore the file",
        ),
        (
            ends > size,
            f"{file.name} has {size} bytes: restore it, or remove the rows from this one on",
        ),
        (
            blind,
            "pitch_deg is missing; fill it in, or empty the placement to ignore the telegram",
        ),
    ):
        if wrong.any():
            raise ValueError(f"{_place(index, wrong.argmax())}: {words}")
    return index


def _place(index, row):
    """Where a telegram is, as text."""
    where = "line {}, offset {}, length {}, placement {}"
    return where.format(row + 2, *index[row].tolist()[1:4])


def _modes(data, index, sound):
    """Measuring mode at each telegram: that of the last sound one that states it, before it the
    first. Also notes.
    """
    modes = np.full(len(index), -1)
    notes = []
    for row in sound[np.isin(data[index.offset[sound] + 4], [*codec.STATE_MODE])]:
        raw = data[index.offset[row] :][: index.length[row]]
        try:
            modes[row:] = codec.STATE_MODE[raw[4]](raw.tobytes()).measuring_mode
        except TelegramError as error:
            notes.append(f"{_place(index, row)}: {error}; ignored")
    stated = modes[modes >= 0]
    if len(stated) == 0:
        notes.append(
            f"no status or configuration telegram: measuring mode {FACTORY_MODE:02X} (factory) "
            "assumed"
        )
        stated = [FACTORY_MODE]
    modes[modes < 0] = stated[0]
    return modes, notes


def _lines(scans, index):
    """Scan lines on one grid of bearings; refuses a mixture of variants."""
    placed = index.placement[scans.rows] >= 0
    rows = scans.rows[placed]
    partial = scans.partial[placed]
    variants = {*zip(scans.count[placed].tolist(), partial.tolist(), strict=True)}
    if not variants:
        raise ValueError(
            "no telegram with a scan belongs to a placement: was the device streaming?"
        )
    grids = [codec.scan_quarters(*variant) for variant in variants]
    parts, part = np.unique(partial, return_inverse=True)
    if parts[0] < 0 and len(variants) > 1:
        counts = sorted({count for count, _ in variants})
        raise ValueError(
            f"scans of {short(counts)} values are mixed: a session holds one variant, "
            "split the recording"
        )
    scanned = index[rows]
    step = np.diff(partial)
    number = scans.telegram_index[placed]
    # a scan goes on with the line of the one before
    goes_on = (partial[:-1] >= 0) & (step > 0)
    goes_on &= (np.diff(scanned.placement) == 0) & (np.diff(scanned.pitch_deg) == 0)
    goes_on &= (number[1:] < 0) | (np.diff(number) % 256 == step)
    begins = np.r_[True, ~goes_on]
    first = scanned[begins]
    line = begins.cumsum() - 1

    quarters = np.unique(np.concatenate(grids))
    check_amount(len(first) * len(quarters))
    # the parts of an interlaced line are its columns by turns
    ranges = np.full((len(first), scans.words.shape[1], len(parts)), np.nan)
    ranges[line, :, part] = scans.ranges[placed]
    return {
        "ranges": ranges.reshape(len(first), -1)[:, : len(quarters)],
        "bearings": np.radians(quarters / 4),
        "time_s": np.bincount(line, scanned.t_s) / np.bincount(line),
        "placement": first.placement,
        "pitch": np.radians(first.pitch_deg),
    }


def _damage(index, outcome, size):
    """Sentences about telegrams that could not be used."""
    wrong = index.offset[outcome == WRONG]
    last = index.offset[-1]
    tail = size - last - index.length[-1]
    if len(wrong):
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
