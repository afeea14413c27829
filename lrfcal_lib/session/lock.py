"""One writer at a time for a session."""

import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from lrfcal_lib.session.files import SessionError, opened

LOCK = "writer.lock"


@contextmanager
def alone(path: str | os.PathLike) -> Iterator[None]:
    """Keep other writers out of a session; a process that is killed lets go of it as well.

    Parameters
    ----------
    path
        The session's folder.

    Raises
    ------
    SessionError
        Where another process writes it.
    """
    file = Path(path) / LOCK
    with _locked(file, path) as stream:
        stream.truncate()
        stream.write(
            f"process {os.getpid()} on {socket.gethostname()} since "
            f"{datetime.now():%Y-%m-%d %H:%M}".encode()
        )
        stream.flush()
        try:
            yield
        finally:
            with suppress(OSError):  # gone with its session?
                os.unlink(file)


def _locked(file, path):
    """The open lock of a session, which nobody else holds."""
    while True:
        stream = opened(file, path, os.O_RDWR | os.O_CREAT)
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            with stream:
                holder = stream.read(200).decode(errors="replace") or "another process"
            raise SessionError(
                f"{path}: {holder} writes this session: end that first, or choose another one"
            ) from None
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(stream.fileno()), os.lstat(file)):
                return stream
        stream.close()  # its holder removed the file after we had opened it
