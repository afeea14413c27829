"""Workers of a Dask cluster beside those of this machine."""

import hashlib
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from functools import cache
from multiprocessing import get_context
from os import sched_getaffinity
from pathlib import Path

PATIENCE = 10.0  # seconds until a scheduler counts as dead


@contextmanager
def workers_at(scheduler: str | None) -> Iterator[Executor]:
    """An executor of a Dask cluster, or of this machine's cores.

    Parameters
    ----------
    scheduler : str or None
        Its address, such as ``tcp://10.0.0.1:8786``. None: processes of this machine.

    Raises
    ------
    ValueError
        When no scheduler answers there, it has no workers, or one of them has another version of
        this library.
    """
    if scheduler is None:
        with ProcessPoolExecutor(len(sched_getaffinity(0)), get_context("spawn")) as pool:
            yield pool
        return
    from distributed import Client

    try:
        client = Client(scheduler, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:  # a TimeoutError is an OSError
        raise ValueError(
            f"no scheduler answers at {scheduler}: start one with 'dask scheduler', and workers "
            f"with 'dask worker {scheduler}' ({error})"
        ) from error
    with client:
        refuse_others(client)
        yield Checked(client.get_executor(pure=False))


class Checked(Executor):
    """Of a cluster: workers that join after :func:`refuse_others` has looked are caught, too."""

    def __init__(self, executor):
        self.executor = executor

    def submit(self, work, /, *args, **kwargs):
        """See :meth:`concurrent.futures.Executor.submit`."""
        return self.executor.submit(checked, source_digest(), work, *args, **kwargs)


def refuse_others(client):
    """ValueError unless the cluster has workers, all with this version of the library."""

    def digest():
        """Travels by value: a worker need not know this module."""
        try:
            from lrfcal_lib.session.cluster import source_digest as of_worker

            return of_worker()
        except ImportError as error:
            return f"none ({error})"

    digests = client.run(digest)
    if not digests:
        raise ValueError(
            f"the scheduler at {client.scheduler.address} has no workers: start some with "
            f"'dask worker {client.scheduler.address}'"
        )
    for worker, theirs in digests.items():
        if theirs != source_digest():
            raise ValueError(_other_version(worker, theirs))


def checked(digest: str, work: Callable, *args, **kwargs):
    """``work(...)``, unless this process has another version of the library: ValueError.

    Parameters
    ----------
    digest : str
        :func:`source_digest` of who asks.
    work : callable
    """
    if digest != source_digest():
        raise ValueError(_other_version("that joined later", source_digest()))
    return work(*args, **kwargs)


def _other_version(worker, digest):
    return (
        f"the worker {worker} has another version of lrfcal_lib ({digest}, here "
        f"{source_digest()}): install the same one on all machines, and start it again"
    )


@cache
def source_digest() -> str:
    """Of all modules and data of this library, as this process has them."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*")):
        if path.suffix in (".py", ".json"):
            digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()[:12]
