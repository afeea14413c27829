"""The one place that opens files of a session: inside its folder, plain files only, none too large; and its lock."""

from __future__ import annotations

import fcntl
import os
import socket
import stat
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

LARGEST_FILE = 64_000_000  # bytes of any file of a session
SPLIT = "split the recording into several sessions"
LOCK = "writer.lock"
FILES = (  # of any session, besides its images
    "session.json", "lrf/scans.npz", "lrf/telegrams.bin", "lrf/index.csv", "images.csv", "edges.csv", "platform.csv",
    "truth.json",
)  # fmt: skip
KINDS = {"l": "a link", "d": "a folder", "p": "a named pipe", "s": "a socket", "b": "a device", "c": "a device"}


class SessionError(ValueError):
    """A session on disk that cannot be used: the message names the file, the value and what to do about it."""

    def __init__(self, text):
        super().__init__(text if len(text) < 2000 else f"{text[:1000]} [...] {text[-500:]}")


@contextmanager
def folder(file, within, make=False):
    """Descriptor of the folder that holds a file of a session, reached without following a link."""
    where, handle = Path(within), os.open(within, os.O_RDONLY | os.O_DIRECTORY)
    try:
        for part in Path(file).relative_to(within).parts[:-1]:
            where /= part
            if make:
                with suppress(FileExistsError):
                    os.mkdir(part, dir_fd=handle)
            _refuse_other(where, os.stat(part, dir_fd=handle, follow_symlinks=False), "d", "a folder")
            outer, handle = handle, os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=handle)
            os.close(outer)
        yield handle
    finally:
        os.close(handle)


def listed(path, within):
    """Names in a folder of a session."""
    with folder(Path(path) / "any", within) as handle:
        return sorted(os.listdir(handle))


def opened(file, within=None, flags=os.O_RDONLY, most=LARGEST_FILE):
    """Binary stream of a file in a session.

    Parameters
    ----------
    file : path-like
    within : path-like, optional
        The session's folder; without, the file is somebody else's, who may have links to it.
    flags : int
        Of ``os.open``; any but O_RDONLY writes.
    most : int
        Bytes that are read.

    Returns
    -------
    file object

    Raises
    ------
    SessionError
        If the file, or a folder between it and the session's, is a link, or the file is none (a pipe, a device) or too
        large to be read.
    OSError
        If it cannot be opened.
    """
    file = Path(file).resolve() if within is None else Path(file)
    with folder(file, within or file.parent) as handle:
        with suppress(FileNotFoundError):  # a device is not even opened
            _refuse_other(file, os.stat(file.name, dir_fd=handle, follow_symlinks=False), "-", "a file")
        inner = os.open(file.name, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666, dir_fd=handle)
    stream = os.fdopen(inner, "rb" if flags == os.O_RDONLY else "r+b" if flags & os.O_RDWR else "wb")
    try:
        status = os.fstat(inner)
        _refuse_other(file, status, "-", "a file")
        if flags == os.O_RDONLY and status.st_size > most:
            raise SessionError(f"{file}: {status.st_size / 1e6:.0f} MB, more than {most / 1e6:.0f} MB; {SPLIT}")
    except BaseException:
        stream.close()
        raise
    return stream


def _refuse_other(file, status, kind, wanted):
    """Refuse what is no plain file (or folder), such as a link."""
    found = stat.filemode(status.st_mode)[0]
    if found != kind:
        what = KINDS.get(found, "a file")
        raise SessionError(f"{file}: is {what}, not {wanted}: a session holds plain files; put {wanted} in its place")


@contextmanager
def alone(path):
    """Keep other writers out of a session as long as this lasts; a process that is killed lets go of it as well."""
    with _locked(Path(path)) as stream:
        stream.truncate()
        stream.write(f"process {os.getpid()} on {socket.gethostname()} since {datetime.now():%Y-%m-%d %H:%M}".encode())
        stream.flush()
        try:
            yield
        finally:
            with suppress(OSError), folder(Path(path) / LOCK, path) as handle:  # gone with its session?
                os.unlink(LOCK, dir_fd=handle)


def _locked(path):
    """The lock file, locked; who removes one holds its lock, so one that was removed meanwhile is opened anew."""
    while True:
        stream = opened(path / LOCK, path, os.O_RDWR | os.O_CREAT)
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            with stream:
                holder = stream.read(200).decode(errors="replace") or "another process"
            raise SessionError(f"{path}: {holder} writes this session: end that first, or choose another one") from None
        except BaseException:
            stream.close()
            raise
        if os.fstat(stream.fileno()).st_nlink:
            return stream
        stream.close()
