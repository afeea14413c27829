"""What the parts of a session share: its error, and reading a file with its name in every message."""

from __future__ import annotations

import csv
import json
from contextlib import contextmanager

from lrfcal_lib.session.opened import LARGEST_FILE, SPLIT, SessionError, opened

MOST_VALUES = 12_000_000  # of all scan lines, so that reading them takes less than 500 MB
LARGEST_TEXT, DEEPEST_JSON, MOST_ROWS = 8_000_000, 30, 200_000  # bytes of a JSON or CSV file, levels


@contextmanager
def reading(file, remedy):
    """Turn whatever other people's code says about the content of a file into a SessionError.

    Any exception is meant, so nothing but calls of other people's code belongs inside: ours has to show its mistakes.
    """
    try:
        yield
    except SessionError:
        raise
    except Exception as error:
        raise SessionError(f"{file}: {remedy.format(str(error) or type(error).__name__)}") from error


@contextmanager
def naming(file):
    """Turn whatever goes wrong with values of a file into a SessionError that begins with the file's name."""
    try:
        yield
    except SessionError:
        raise
    except KeyError as error:
        raise SessionError(f"{file}: key {error} is missing") from error
    except (TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise SessionError(f"{file}: {error}") from error


def read_bytes(file, within=None, most=LARGEST_FILE):
    """Content of a file of a session (see :func:`opened`); a SessionError where it cannot be read."""
    try:
        with opened(file, within, most=most) as stream:
            return stream.read()
    except OSError as error:
        raise SessionError(f"{file}: {error.strerror}; the session needs this file") from error


def read_json(file, within):
    """The object in a JSON file."""
    text = read_bytes(file, within, LARGEST_TEXT)
    with reading(file, "not JSON ({}); truncated, or edited by hand?"):
        data = json.loads(text.decode())
    if not isinstance(data, dict):
        raise SessionError(f"{file}: holds a {type(data).__name__}, expected an object with the key 'schema'")
    inner = [data]
    for _ in range(DEEPEST_JSON):
        inner = [v for x in inner if isinstance(x, dict | list) for v in (x.values() if isinstance(x, dict) else x)]
    if inner:
        raise SessionError(f"{file}: nested deeper than {DEEPEST_JSON} levels; was this written by a program?")
    return data


def read_table(file, columns, within, torn=False):
    """Rows of a CSV file as dicts, and whether one was left out; the columns must be exactly `columns`.

    With `torn`, a last row without its line end (cut off by a crash) is left out.
    """
    data = read_bytes(file, within, LARGEST_TEXT)
    with reading(file, "not a CSV file in UTF-8 ({})"):
        text = data.decode()
        cut = torn and not text.endswith("\n")
        lines = (text.rpartition("\n")[0] if cut else text).splitlines()
        if len(lines) > MOST_ROWS:
            raise SessionError(f"{file}: {len(lines)} lines, more than {MOST_ROWS}; {SPLIT}")
        rows = list(csv.reader(lines))
    if not rows or tuple(rows[0]) != columns:
        got = ", ".join(rows[0]) if rows else "an empty file"
        raise SessionError(f"{file}: columns must be {', '.join(columns)}; got {got}")
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(columns):
            raise SessionError(f"{file} line {number}: {len(row)} values for {len(columns)} columns; truncated?")
    return [dict(zip(columns, row, strict=True)) for row in rows[1:]], cut


def check_amount(values):
    """Refuse more ranges and other values of scan lines than reading has memory for."""
    if values > MOST_VALUES:
        raise ValueError(f"{values} values of scan lines, more than {MOST_VALUES}; {SPLIT}")


def short(values):
    """Values as text for a message, the middle of long lists left out."""
    values = [str(v) for v in values]
    return ", ".join(values if len(values) < 13 else [*values[:6], "...", *values[-3:]]) or "none"
