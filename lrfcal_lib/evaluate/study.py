"""Studies: methods beside one another and beside the Cramer-Rao bound, on set-ups by name."""

import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, as_completed
from contextlib import suppress
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

from lrfcal_lib.evaluate.study_trials import BATCHED, STUDIED, Task, run_task
from lrfcal_lib.fit.robust import rms
from lrfcal_lib.session.write import whole
from lrfcal_lib.simulate.scenarios import load_scenario, varied
from lrfcal_lib.simulate.shots import Scenario

COUNTS = (5, 10, 20, 50, 100)  # placements
CHUNK = 10  # trials of a task: some seconds, of which handing it over takes a thousandth
RESAMPLES = 1000
ERRORS = ("rotation_deg", "translation_mm")
NUMBERS = (
    *ERRORS,
    "rotation_deg_bound",
    "translation_mm_bound",
    "rotation_deg_known",
    "translation_mm_known",
    "over_bound",
    "nees",
    "covered",
)  # of a trial, where there is an estimate and a bound


def run_study(
    scenario: str | Scenario,
    methods: Sequence[str] = STUDIED,
    n_poses: Sequence[int] = COUNTS,
    trials: int = 100,
    seed: int = 0,
    executor: Executor | None = None,
) -> pd.DataFrame:
    """Draw many sessions of single shots of a scenario and solve each by every method.

    Parameters
    ----------
    scenario : str or Scenario
        Name in ``scenarios.json``, or one of your own.
    methods : sequence of str
        Of :data:`lrfcal_lib.evaluate.study_trials.STUDIED`. Each sees the same draws, whichever
        others there are.
    n_poses : sequence of int
        Placements of a session.
    trials, seed : int
    executor : concurrent.futures.Executor, optional
        Whose workers take part, e.g. ``distributed.Client(address).get_executor()``; without it
        everything is done here. The numbers are the same.

    Returns
    -------
    DataFrame
        See :func:`summary`.

    Raises
    ------
    ValueError
        For an unknown scenario or method, no trials, poses that cannot be drawn, or workers that
        have another version of this library or are lost.
    """
    tasks = tasks_of([scenario], methods, n_poses, trials, seed)
    rows = [row for _, part in finished(tasks, executor) for row in part]
    return summary(pd.DataFrame(rows))


def tasks_of(scenarios, methods, n_poses, trials, seed=0) -> list[Task]:
    """A study in units of work; ValueError for what is not known or too few.

    Parameters
    ----------
    scenarios : sequence of str or Scenario
    methods : sequence of str
    n_poses : sequence of int
    trials, seed : int
    """
    for method in methods:
        if method not in STUDIED:
            raise ValueError(
                f"unknown method {method!r}: studies of single shots know {', '.join(STUDIED)}"
            )
    if not methods:
        raise ValueError(f"no method: name some of {', '.join(STUDIED)}")
    if trials < 1:
        raise ValueError(f"{trials} trials: 1 or more are needed")
    if min(n_poses, default=0) < 3:
        raise ValueError(f"{list(n_poses)} placements: 3 or more are needed for a camera")
    known = [s if isinstance(s, Scenario) else load_scenario(s) for s in scenarios]
    for scenario in known:
        if scenario.corner and not set(methods).issubset(BATCHED):
            raise ValueError(f"{scenario.name} shows no board: use {', '.join(BATCHED)}")
    return [
        Task(scenario, tuple(methods), count, seed, first, min(CHUNK, trials - first))
        for first in range(0, trials, CHUNK)
        for scenario, count in product(
            known, sorted(n_poses, reverse=True)
        )  # longest first
    ]


def finished(
    tasks: Sequence[Task], executor: Executor | None = None
) -> Iterator[tuple[Task, list[dict]]]:
    """Tasks with their rows: in order, or as the workers of an executor finish them."""
    if executor is None:
        for task in tasks:
            yield task, run_task(task)
        return
    futures = {executor.submit(run_task, task): task for task in tasks}
    try:
        for future in as_completed(futures):
            yield futures[future], future.result()
    except (BrokenExecutor, CancelledError, OSError) as error:
        raise ValueError(
            f"the workers are lost ({type(error).__name__} {error}): start them again; a study "
            "that writes a file goes on where it was"
        ) from error
    finally:
        for future in futures:
            future.cancel()


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """Errors by scenario, number of placements and method.

    Parameters
    ----------
    rows : DataFrame
        Of :func:`lrfcal_lib.evaluate.study_trials.run_task`, in any order.

    Returns
    -------
    DataFrame
        Columns scenario, what was varied of it, n_poses, method, trials, failed, failures (why,
        how often); of rotation (deg) and translation (mm) the median with its 90 % bootstrap
        interval (``_low``, ``_high``) and the mean over all trials that gave an estimate, the root
        mean square (``_rmse``) over those that did not fail, and Cramer-Rao bounds with unknown
        (``_bound``) and known (``_known``) sensor; of trials that did not fail rmse_over_bound,
        with its interval, nees and coverage of the six numbers of the pose.
    """
    keys = [*rows.loc[:, :"n_poses"], "method"]
    rows = rows.reindex(columns=rows.columns.union(NUMBERS, sort=False))
    rows = rows.assign(
        method=pd.Categorical(rows.method, STUDIED), failed=rows.outcome != "ok"
    ).sort_values("trial")
    every = rows.groupby(keys, observed=True)
    good = rows[~rows.failed].groupby(keys, observed=True)
    table = every.agg(
        trials=("trial", "size"), failed=("failed", "sum"), failures=("outcome", _reasons)
    )
    for name in ERRORS:
        for end, statistic in OF_ERRORS.items():
            table[name + end] = every[name].agg(statistic)
        table[f"{name}_rmse"] = good[name].agg(rms)
        for bound in (f"{name}_bound", f"{name}_known"):
            table[bound] = good[bound].agg(rms)
    for end, statistic in OF_SQUARES.items():
        table[f"rmse_over_bound{end}"] = np.sqrt(good.over_bound.agg(statistic))
    table["nees"] = good.nees.mean()
    table["coverage"] = good.covered.mean()
    return table.reset_index().astype({"method": str})


def _reasons(outcomes):
    """Why trials failed, and how often."""
    counts = outcomes[outcomes != "ok"].value_counts().sort_index()
    return "; ".join(f"{count} {words}" for words, count in counts.items())


def resampled(values: np.ndarray, share: float, statistic=np.median) -> float:
    """Bound of the bootstrap interval of a statistic, the same for the same values; NaN for none.

    Parameters
    ----------
    values : array_like, shape (n,)
        NaN counts for nothing.
    share : float
        Of the resamples below the bound.
    statistic : callable
    """
    values = np.sort(values)
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return np.nan
    drawn = np.random.default_rng(0).choice(values, (RESAMPLES, len(values)))
    return np.quantile(statistic(drawn, axis=1), share)


# columns of a summary by the end of their names: the interval is that of the bootstrap
OF_ERRORS = {
    "": "median",
    "_mean": "mean",
    "_low": partial(resampled, share=0.05),
    "_high": partial(resampled, share=0.95),
}
OF_SQUARES = {
    "": "mean",
    "_low": partial(resampled, share=0.05, statistic=np.mean),
    "_high": partial(resampled, share=0.95, statistic=np.mean),
}


def study_to_file(
    tasks: Sequence[Task],
    out: str | os.PathLike,
    executor: Executor | None = None,
    bar: Callable[[int], object] = lambda count: None,
) -> pd.DataFrame:
    """Run a study and write its table; a study that was killed goes on.

    Every finished task is a line of ``OUT.part``, which goes when the table is written.

    Parameters
    ----------
    tasks : sequence of Task
    out : path
        Of the table, CSV.
    executor : concurrent.futures.Executor, optional
    bar : callable, optional
        ``bar(tasks)``, called with every number of tasks that are done.

    Returns
    -------
    DataFrame
        See :func:`summary`.

    Raises
    ------
    ValueError
        When what is there is of another study, or cannot be written.
    """
    part = Path(f"{out}.part")
    kept = _kept(part, {task.key for task in tasks})
    bar(len(kept))
    missing = [task for task in tasks if task.key not in kept]
    with part.open("a") as file:
        for task, rows in finished(missing, executor):
            # what was being written when a study was killed ends before the next line
            file.write("\n" + json.dumps({"task": task.key, "rows": rows}))
            file.flush()
            kept[task.key] = rows
            bar(1)
    table = summary(pd.DataFrame([row for task in tasks for row in kept[task.key]]))
    with whole(out) as draft:
        table.to_csv(draft, index=False, float_format="%.6g")
    part.unlink()
    return table


def variations(scenarios: Sequence[str], settings: Sequence[str]) -> list[Scenario]:
    """Scenarios with every combination of settings, each a text ``key=value,value...``.

    Parameters
    ----------
    scenarios, settings : sequence of str
        See :func:`lrfcal_lib.simulate.scenarios.varied`.

    Raises
    ------
    ValueError
        For what is not known or no number.
    """
    out = [load_scenario(name) for name in scenarios]
    for text in settings:
        key, _, values = text.partition("=")
        try:
            numbers = [float(value) for value in values.split(",")]
        except ValueError:
            raise ValueError(f"{text!r}: write key=number,number...") from None
        out = [varied(scenario, key, value) for scenario in out for value in numbers]
    return out


def _kept(part, keys):
    """Rows of the finished tasks by key, of these and no others."""
    kept = {}
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        part.touch()
        text = part.read_text()
    except OSError as error:
        raise ValueError(f"{part}: {error.strerror}; name another file") from error
    for line in text.splitlines():
        with suppress(ValueError, TypeError, KeyError):
            record = json.loads(line)
            kept[record["task"]] = record["rows"]
    if not keys.issuperset(kept) or (text and not kept):
        raise ValueError(
            f"{part} belongs to another study, or to another version of this library: remove it, "
            "or name another file"
        )
    return kept
