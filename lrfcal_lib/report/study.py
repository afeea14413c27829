"""What the verb ``study`` does."""

from tqdm import tqdm

from lrfcal_lib.evaluate.study import COUNTS, study_to_file, tasks_of, variations
from lrfcal_lib.evaluate.study_trials import STUDIED
from lrfcal_lib.session.cluster import workers_at


def study(scenarios, methods, poses, trials, seed, vary, out, scheduler):
    """Compare methods on scenarios and write the table."""
    tasks = tasks_of(
        variations(scenarios, vary),
        methods or STUDIED,
        poses or COUNTS,
        trials,
        seed,
    )
    with (
        workers_at(scheduler) as executor,
        tqdm(total=len(tasks), desc="tasks", disable=None) as bar,
    ):
        table = study_to_file(tasks, out, executor, bar.update)
    print(
        f"{out}: {len(table)} rows; {table.failed.sum()} of {table.trials.sum()} estimates "
        "failed"
    )
