"""How files of a session are opened: within its folder, and bounded."""

import json
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path
from typing import Any

from lrfcal_lib.session.shown import printable

LARGEST_FILE = 64_000_000  # bytes of any file of a session
SPLIT = "split the recording into several sessions"
KINDS = {"l": "a link", "d": "a folder", "-": "a file", "p": "a named pipe"}


class SessionError(ValueError):
    """A session on disk that cannot be used: the message names the file, the value and what to do
    about it.
    """

    def __init__(self, text):
        text = printable(text)
        super().__init__(text if len(text) < 2000 else f"{text[:1000]} [...] {text[-500:]}")


def checked(folder: Path, within: str | PathLike, make: bool = False) -> Path:
    """A folder in a session's; SessionError where it, or one on the way to it, is none, such as a
    link.
    """
    where = Path(within)
    for part in folder.relative_to(within).parts:
        where /= part
        if make:
            where.mkdir(exist_ok=True)
        _refuse_other(where, where.lstat(), "d")
    return folder


def opened(
    file: str | PathLike,
    within: str | PathLike | None = None,
    flags: int = os.O_RDONLY,
    most: int = LARGEST_FILE,
) -> Any:
    """Binary stream of a file in a session.

    Parameters
    ----------
    file
    within
        The session's folder; without, the file is somebody else's, who may have links to it.
    flags
        Of ``os.open``; any but O_RDONLY writes.
    most
        Bytes that are read.

    Raises
    ------
    SessionError
        If the file, or a folder between it and the session's, is a link, or the file is none (a
        pipe, a device), too large to be read, or to be written and known by another name as well
        (a hard link, maybe outside).
    OSError
        If it cannot be opened.
    """
    file = Path(file)
    writes = flags != os.O_RDONLY
    if within is not None:
        checked(file.parent, within)
        flags |= os.O_NOFOLLOW
    with suppress(FileNotFoundError):  # a device is not even opened
        found = os.stat(file, follow_symlinks=within is None)
        _refuse_other(file, found, "-")
        if not writes and found.st_size > most:
            raise SessionError(
                f"{file}: {found.st_size / 1e6:.0f} MB, more than {most / 1e6:.0f} MB; {SPLIT}"
            )
    inner = os.open(file, flags | os.O_NONBLOCK, 0o666)
    stream = os.fdopen(inner, "r+b" if writes else "rb")
    if writes and os.fstat(inner).st_nlink > 1:
        stream.close()
        raise SessionError(
            f"{file}: has another name elsewhere (a hard link); copy the session's folder and "
            "write to the copy"
        )
    return stream


def _refuse_other(file, status, kind):
    """Refuse what is no plain file (or folder), such as a link."""
    found = stat.filemode(status.st_mode)[0]
    if found != kind:
        raise SessionError(
            f"{file}: is {KINDS.get(found, 'a device')}, not {KINDS[kind]}: a session holds plain "
            f"files; put {KINDS[kind]} in its place"
        )


MOST_VALUES = 12_000_000  # of all scan lines, so that reading them takes less than 500 MB
LARGEST_TEXT = 8_000_000  # bytes of a JSON or CSV file
DEEPEST_JSON = 30  # levels


@contextmanager
def reading(file: str | PathLike, remedy: str) -> Iterator[None]:
    """Turn whatever other people's code says about the content of a file into a SessionError.

    Any exception is meant, so nothing but calls of other people's code belongs inside: ours has to
    show its mistakes.
    """
    try:
        yield
    except SessionError:
        raise
    except Exception as error:
        raise SessionError(
            f"{file}: {remedy.format(str(error) or type(error).__name__)}"
        ) from error


@contextmanager
def naming(file: str | PathLike) -> Iterator[None]:
    """Turn whatever goes wrong with values of a file into a SessionError that begins with the
    file's name.
    """
    try:
        yield
    except SessionError:
        raise
    except KeyError as error:
        raise SessionError(f"{file}: key {error} is missing") from error
    except (TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise SessionError(f"{file}: {error}") from error


def read_bytes(
    file: str | PathLike, within: str | PathLike | None = None, most: int = LARGEST_FILE
) -> bytes:
    """Content of a file of a session.

    Parameters
    ----------
    file, within, most
        See :func:`opened`.

    Raises
    ------
    SessionError
        Where it cannot be read.
    """
    try:
        with opened(file, within, most=most) as stream:
            data = stream.read(most + 1)
    except OSError as error:
        raise SessionError(f"{file}: {error.strerror}; this file is needed") from error
    if len(data) > most:  # files of the system do not tell their size
        raise SessionError(f"{file}: more than {most / 1e6:.0f} MB; {SPLIT}")
    return data


def read_json(file: str | PathLike, within: str | PathLike | None) -> dict:
    """The object in a JSON file of a session.

    Parameters
    ----------
    file, within
        See :func:`opened`.

    Raises
    ------
    SessionError
        Where it is no such file, or nested very deeply.
    """
    text = read_bytes(file, within, LARGEST_TEXT)
    with reading(file, "not JSON ({}); truncated, or edited by hand?"):
        data = json.loads(text.decode())
    if not isinstance(data, dict):
        raise SessionError(f"{file}: holds a {type(data).__name__}, an object is needed")
    inner = [data]
    for _ in range(DEEPEST_JSON):
        inner = [value for outer in inner for value in _inside(outer)]
    if inner:
        raise SessionError(
            f"{file}: nested deeper than {DEEPEST_JSON} levels; was this written by a program?"
        )
    return data


def _inside(value):
    """What an object or a list of JSON holds."""
    match value:
        case dict():
            return value.values()
        case list():
            return value
        case _:
            return ()


def check_amount(values: int) -> None:
    """Refuse more ranges and other values of scan lines than reading has memory for."""
    if values > MOST_VALUES:
        raise ValueError(f"{values} values of scan lines, more than {MOST_VALUES}; {SPLIT}")


def short(values: Iterable) -> str:
    """Values as text for a message, the middle of long lists left out."""
    words = list(map(str, values))
    if len(words) > 12:
        words[6:-3] = ["..."]
    return ", ".join(words) or "none"
