"""Studies: methods beside one another and beside the Cramer-Rao bound, on set-ups by name."""

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, as_completed
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from lrfcal_lib.evaluate.study_trials import STUDIED, Task, run_task
from lrfcal_lib.session.cluster import checked, source_digest
from lrfcal_lib.session.write import whole
from lrfcal_lib.simulate.scenarios import Scenario, load_scenario, varied

COUNTS = (5, 10, 20, 50, 100)  # placements
CHUNK = 10  # trials of a task: some seconds, of which handing it over takes a thousandth
INTERVAL = (0.05, 0.95)  # of the bootstrap
RESAMPLES = 1000
UNITS = {"rotation": ("deg", 180 / np.pi), "translation": ("mm", 1000.0)}


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
    if not n_poses or min(n_poses) < 3:
        raise ValueError(f"{list(n_poses)} placements: 3 or more are needed for a camera")
    tasks = []
    for given in scenarios:
        scenario = given if isinstance(given, Scenario) else load_scenario(given)
        for count in n_poses:
            for first in range(0, trials, CHUNK):
                number = min(CHUNK, trials - first)
                tasks.append(Task(scenario, tuple(methods), count, seed, first, number))
    return tasks


def finished(
    tasks: Sequence[Task], executor: Executor | None = None
) -> Iterator[tuple[Task, list[dict]]]:
    """Tasks with their rows: in order, or as the workers of an executor finish them."""
    if executor is None:
        for task in tasks:
            yield task, run_task(task)
        return
    work = partial(checked, source_digest(), run_task)
    futures = {executor.submit(work, task): task for task in tasks}
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
        nees and coverage of the six numbers of the pose.
    """
    keys = ["scenario", "n_poses", "method"]
    rows = rows.reindex(
        columns=list(dict.fromkeys([*rows.columns, "rotation", "translation"]))
    )
    rows = rows.sort_values([*keys, "trial"])
    parts = []
    for key, part in rows.groupby(keys, sort=True):
        parts.append(dict(zip(keys, key, strict=True)) | _summed_up(part))
    table = pd.DataFrame(parts)
    order = {method: number for number, method in enumerate(STUDIED)}
    table = table.assign(order=table.method.map(order))
    table = table.sort_values(["scenario", "n_poses", "order"]).drop(columns="order")
    settings = table.scenario.str.findall(r"(\w+)=(\S+)").map(dict)
    table["scenario"] = table.scenario.str.replace(r" \w+=\S+", "", regex=True)
    for key in sorted({key for row in settings for key in row}, reverse=True):
        table.insert(
            1, key, [float(row[key]) if key in row else np.nan for row in settings]
        )
    settings_and_keys = [*table.columns[: table.columns.get_loc("n_poses") + 1]]
    return table.sort_values(settings_and_keys, kind="stable").reset_index(drop=True)


def _summed_up(part):
    """One row of the table."""
    bad = part.outcome[part.outcome != "ok"].value_counts().sort_index()
    good = part[part.outcome == "ok"]
    row = {"trials": len(part), "failed": int(bad.sum())}
    row["failures"] = "; ".join(f"{count} {words}" for words, count in bad.items())
    for name, (unit, factor) in UNITS.items():
        errors = part[name].dropna().to_numpy() * factor
        low, high = median_interval(errors)
        column = f"{name}_{unit}"
        row[column] = np.median(errors) if len(errors) else np.nan
        row[f"{column}_mean"] = np.mean(errors) if len(errors) else np.nan
        row[f"{column}_low"] = low
        row[f"{column}_high"] = high
        if len(good):
            row[f"{column}_rmse"] = factor * _root_mean_square(good[name])
            row[f"{column}_bound"] = factor * _root_mean_square(good[f"bound_{name}"])
            row[f"{column}_known"] = factor * _root_mean_square(good[f"known_{name}"])
    if len(good):
        row["rmse_over_bound"] = np.sqrt(good.over_bound.mean())
        row["nees"] = good.nees.mean()
        row["coverage"] = good.covered.mean()
    return row


def _root_mean_square(values):
    return float(np.sqrt(np.mean(np.square(values))))


def median_interval(values: np.ndarray) -> tuple[float, float]:
    """90 % bootstrap interval of the median, the same for the same values; NaN for none.

    Parameters
    ----------
    values : ndarray, shape (n,)
    """
    if len(values) == 0:
        return np.nan, np.nan
    rng = np.random.default_rng(0)
    drawn = rng.choice(np.sort(values), (RESAMPLES, len(values)))
    low, high = np.quantile(np.median(drawn, axis=1), INTERVAL)
    return float(low), float(high)


def study_to_file(tasks: Sequence[Task], out: str | os.PathLike, executor=None, bar=None):
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
    header = {"study": [_stated(task) for task in tasks], "source": source_digest()}
    kept = _read_part(part, header)
    bar = bar or (lambda count: None)
    bar(len(kept))
    missing = [task for task in tasks if task.key not in kept]
    with part.open("a") as file:
        for task, rows in finished(missing, executor):
            file.write(json.dumps({"task": task.key, "rows": rows}) + "\n")
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


def _stated(task):
    """What a task is, in JSON: two studies are one if all of theirs are alike."""
    words = repr(asdict(task.scenario)).encode()
    return [task.key, list(task.methods), task.seed, task.trials, _digest(words)]


def _digest(data):
    return hashlib.sha256(data).hexdigest()[:16]


def _read_part(part, header):
    """Rows of the finished tasks by key; a line that was being written is cut off."""
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        lines = part.read_bytes().splitlines(keepends=True) if part.exists() else []
        complete = [line for line in lines if line.endswith(b"\n")]
        if not complete:
            part.write_text(json.dumps(header) + "\n")
            return {}
        found = json.loads(complete[0])
        rows = [json.loads(line) for line in complete[1:]]
        if len(complete) < len(lines):
            part.write_bytes(b"".join(complete))
    except ValueError as error:
        raise ValueError(f"{part} is no part of a study: remove it ({error})") from error
    except OSError as error:
        raise ValueError(f"{part}: {error.strerror}; name another file") from error
    if found != header:
        raise ValueError(
            f"{part} belongs to another study, or to another version of this library: remove it, "
            "or name another file"
        )
    return {line["task"]: line["rows"] for line in rows}
