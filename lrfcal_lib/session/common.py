"""What the parts of a session share: its error, and reading a file with its name in every message."""

from __future__ import annotations

import csv
import json
from contextlib import contextmanager
from pathlib import Path


class SessionError(ValueError):
    """A session on disk that cannot be used: the message names the file, the value and what to do about it."""


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


def read_bytes(file):
    """Content of a file; a SessionError where it cannot be read."""
    try:
        return Path(file).read_bytes()
    except OSError as error:
        raise SessionError(f"{file}: {error.strerror}; the session needs this file") from error


def read_json(file):
    """The object in a JSON file."""
    try:
        data = json.loads(read_bytes(file).decode())
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise SessionError(f"{file}: not JSON ({error}); truncated, or edited by hand?") from error
    if not isinstance(data, dict):
        raise SessionError(f"{file}: holds a {type(data).__name__}, expected an object with the key 'schema'")
    return data


def read_table(file, columns, torn=False):
    """Rows of a CSV file as dicts; the columns must be exactly `columns`.

    With `torn`, a last row without its line end (cut off by a crash) is left out, and whether there was one is returned
    as well.
    """
    try:
        text = read_bytes(file).decode()
        cut = torn and not text.endswith("\n")
        rows = list(csv.reader((text.rpartition("\n")[0] if cut else text).splitlines()))
    except (UnicodeDecodeError, csv.Error) as error:
        raise SessionError(f"{file}: not a CSV file in UTF-8 ({error})") from error
    if not rows or tuple(rows[0]) != columns:
        got = ", ".join(rows[0]) if rows else "an empty file"
        raise SessionError(f"{file}: columns must be {', '.join(columns)}; got {got}")
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(columns):
            raise SessionError(f"{file} line {number}: {len(row)} values for {len(columns)} columns; truncated?")
    table = [dict(zip(columns, row, strict=True)) for row in rows[1:]]
    return (table, cut) if torn else table


def short(values):
    """Values as text for a message, the middle of long lists left out."""
    values = [str(v) for v in values]
    return ", ".join(values if len(values) < 13 else [*values[:6], "...", *values[-3:]]) or "none"
