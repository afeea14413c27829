"""What the verb ``study`` does."""

from tqdm import tqdm

from lrfcal_lib.evaluate.study import COUNTS, study_to_file, tasks_of, variations
from lrfcal_lib.evaluate.study_trials import STUDIED
from lrfcal_lib.session.cluster import workers_at


def study(args):
    """Compare methods on scenarios and write the table."""
    tasks = tasks_of(
        variations(args.scenarios, args.vary),
        args.methods or STUDIED,
        args.poses or COUNTS,
        args.trials,
        args.seed,
    )
    with (
        workers_at(args.scheduler) as executor,
        tqdm(total=len(tasks), desc="tasks", disable=None) as bar,
    ):
        table = study_to_file(tasks, args.out, executor, bar.update)
    print(
        f"{args.out}: {len(table)} rows; {table.failed.sum()} of {table.trials.sum()} estimates "
        "failed"
    )
