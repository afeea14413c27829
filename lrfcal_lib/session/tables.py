"""Tables of a session: CSV files with given columns."""

import csv
import os
from os import PathLike
from pathlib import Path

from lrfcal_lib.session.files import (
    LARGEST_TEXT,
    SPLIT,
    SessionError,
    read_bytes,
    reading,
    short,
)

MOST_ROWS = 200_000


def read_table(
    file: Path,
    columns: tuple[str, ...],
    within: str | PathLike,
    torn: bool = False,
    needed: bool = True,
) -> list[dict[str, str]]:
    """Rows of a CSV file with exactly these columns.

    Parameters
    ----------
    file
    columns
    within
        The session's folder.
    torn
        A last row without its line end (cut off by a crash) is left out.
    needed
        Otherwise a file that is not there has no rows.

    Raises
    ------
    SessionError
        For other columns, rows of other lengths, or too many.
    """
    if not needed and not os.path.lexists(file):
        return []
    data = read_bytes(file, within, LARGEST_TEXT)
    with reading(file, "not a CSV file in UTF-8 ({})"):
        text = data.decode()
        if torn:
            text = text[: text.rfind("\n") + 1]
        lines = text.splitlines()
        if len(lines) > MOST_ROWS:
            raise SessionError(
                f"{file}: {len(lines)} lines, more than {MOST_ROWS}; {SPLIT}"
            )
        header, *rows = list(csv.reader(lines)) or [["an empty file"]]
    if header != [*columns]:
        got = short(header)
        if header == ["", *columns]:
            got = (
                "a first column without a name: write the table without row numbers (index=False "
                "in pandas)"
            )
        raise SessionError(f"{file}: columns must be {short(columns)}; got {got}")
    table = []
    for number, row in enumerate(rows, start=2):
        if len(row) != len(columns):
            raise SessionError(
                f"{file} line {number}: {len(row)} values for {len(columns)} columns; truncated?"
            )
        table.append(dict(zip(columns, row, strict=True)))
    return table


def whole_number(text, name):
    """A whole number in a table, -1 where the cell is empty; ValueError in words for other text.

    Programs write whole numbers beside empty cells as 1.0.
    """
    try:
        return int(text.removesuffix(".0") or -1)
    except ValueError:
        raise ValueError(f"{name} is '{text}': a whole number is needed") from None
