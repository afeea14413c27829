"""What a command does with sessions, here or on a cluster."""

import io
import os
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any

from lrfcal_lib.session.cluster import workers_at
from lrfcal_lib.session.workers import side_by_side


def each_session(
    work: Callable[..., int],
    sessions: Sequence[str],
    out: str | None,
    scheduler: str | None,
    **options: Any,
) -> int:
    """Do something with sessions: one after the other on all cores of this machine, or each on a
    worker of a cluster, which gives the same files.

    Parameters
    ----------
    work : callable
        ``work(session, out=folder, **options)``, an exit code.
    sessions : sequence of path-like
        Workers of a cluster see them, and write, under the same path as this machine.
    out : path-like or None
        Folder of the files of a single session.
    scheduler : str or None
        See :func:`lrfcal_lib.session.cluster.workers_at`.
    **options
        Of the work.

    Returns
    -------
    int
        The worst exit code; 1 for a session that a worker could not use, which it says.

    Raises
    ------
    ValueError
        For one folder of several sessions, a cluster that cannot be had, or here a session that
        cannot be used.
    """
    if out is not None and len(sessions) > 1:
        raise ValueError("--out names the folder of one session: leave it out for several")
    job = partial(work, out=out, **options)
    if scheduler is None:
        with side_by_side():
            return max(map(job, sessions))
    if not sessions:
        raise ValueError("name the sessions that the cluster works on")
    worst = 0
    with workers_at(scheduler) as executor:
        there = partial(_said, job, Path.cwd())
        for code, words in executor.map(there, sessions):
            print(words, end="", flush=True)
            worst = max(worst, code)
    return worst


def _said(work, folder, session):
    """The exit code of a session and what was printed, as in a folder."""
    os.chdir(folder)
    with redirect_stdout(io.StringIO()) as words:
        print(f"{session}:")
        try:
            code = work(session)
        except ValueError as error:
            print(f"error: {error}")
            code = 1
    return code, words.getvalue()
