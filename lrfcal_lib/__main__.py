"""``python -m lrfcal_lib VERB``: the work outside notebooks."""

import argparse
import gc
import sys

# objects made between two searches for garbage: what is imported is none
MADE_BETWEEN_SEARCHES = 100_000
FEW = 6  # placements, with fewer of which no error of the model shows
INTERRUPTED = 130  # exit code after Ctrl-C
SCENE = "as 'record --scene' recorded it"


def compare(calibrations, figure):
    """Say how far calibrations of one rig differ."""
    from lrfcal_lib.report.compare import compare_files

    return compare_files(calibrations, figure)


def simulate(setup, dst):
    """Record a session with a simulated rig."""
    from lrfcal_lib.session.workers import side_by_side
    from lrfcal_lib.simulate.record import simulate
    from lrfcal_lib.simulate.rig import load_setup

    with side_by_side():
        simulate(dst, load_setup(setup))
    print(f"{dst}: simulated")


def report(sessions, out, scheduler, jobs, store):
    """Execute the notebooks on sessions, here or on a cluster."""
    if scheduler is not None:
        from lrfcal_lib.report.many import each_session
        from lrfcal_lib.report.report import report_session

        return each_session(report_session, sessions, out, scheduler)
    from lrfcal_lib.report.report import main

    return main(sessions, out, jobs, store)


def study(scenarios, methods, poses, trials, seed, vary, out, scheduler):
    """Compare methods on scenarios and write the table."""
    from tqdm import tqdm

    from lrfcal_lib.evaluate.study import COUNTS, study_to_file, tasks_of, variations
    from lrfcal_lib.evaluate.study_trials import STUDIED
    from lrfcal_lib.session.cluster import workers_at

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


def emulate(setup, rig_file, feedback):
    """Emulate the devices of a rig."""
    from lrfcal_lib.emulators.rig import main

    return main(setup, rig_file, feedback)


def measure(session, **options):
    """Measure lengths between picked places."""
    from lrfcal_lib.report.measure import measure_session

    return measure_session(session, **options)


def print_board(columns, rows, square, out):
    """Write a board to print, and what session.json and rig files say about it."""
    from json import dumps

    from lrfcal_lib.plots.sheet import print_sheet, sheet
    from lrfcal_lib.session.stated import board_to_json
    from lrfcal_lib.session.write import whole

    board = sheet(columns, rows, square)
    with whole(out) as file:
        print_sheet(file, board)
    width, height = 1000 * board.known_corners()[2]
    print(
        f"{out}: print at 100 %, glue on a flat plate, cut to {width:.0f} x {height:.0f} mm"
    )
    print("state it as:", dumps(board_to_json(board)))


def import_recording(src, dst):
    """Make a session of a recording by other people."""
    from lrfcal_lib.session.importers import import_lasersetero

    miss = import_lasersetero(src, dst)
    print(f"{dst}: imported; the points rebuild to {1000 * miss:.4f} mm")


def calibrate(**options):
    """Calibrate the rigs of sessions."""
    from lrfcal_lib.report.calibrate import calibrate_session
    from lrfcal_lib.report.many import each_session

    return each_session(calibrate_session, **options)


def reconstruct(**options):
    """Make coloured clouds of scenes."""
    from lrfcal_lib.report.many import each_session
    from lrfcal_lib.report.reconstruct import reconstruct_session

    return each_session(reconstruct_session, **options)


def merge(**options):
    """Join the stations of scenes."""
    from lrfcal_lib.report.many import each_session
    from lrfcal_lib.report.merge import merge_session

    return each_session(merge_session, **options)


def check(session, calibration):
    """Say what is wrong with a session: 0 where nothing is, else 1. With a calibration 3 where that
    has moved, 2 where it cannot be told.
    """
    from lrfcal_lib.session.read import open_session, validate
    from lrfcal_lib.session.shown import printable

    problems = validate(session)
    if problems:
        print("\n".join(problems))
        return 1
    print(f"{printable(session)}: nothing to complain about")
    recorded = open_session(session)
    count = len(recorded.board_placements)
    if count == 0 and recorded.scene_placements:
        print("no placement of the board: a scene, for a calibration made elsewhere")
    elif count < FEW:
        print(
            f"warning: {count} placements of the board; {FEW} or more are needed to see errors of "
            "the model"
        )
    if calibration is not None:
        from lrfcal_lib.calibrate.calibration_file import load_calibration
        from lrfcal_lib.measure.holds import Answer, holds

        held = holds(recorded, load_calibration(calibration))
        print(*held.sentences(printable(calibration)), sep="\n")
        return {Answer.HOLDS: 0, Answer.UNKNOWN: 2, Answer.MOVED: 3}[held.answer]
    return 0


def record(rig_file, session, scene, stations, calibration, **options):
    """Record placements of the board, or stations of a scene."""
    from lrfcal_lib.acquire.record import main

    if scene:
        from lrfcal_lib.acquire.stations import Stations
        from lrfcal_lib.calibrate.calibration_file import load_calibration

        rig = None
        if calibration is not None:
            rig = load_calibration(calibration)
        options["guide"] = Stations(stations or 1, rig)
    elif stations or calibration:
        raise ValueError("--stations and --calibration are for a scene: add --scene")
    return main(rig_file, session, **options)


# what a verb does with what its parser reads: its exit code or None; what another verb needs is not
# imported
VERBS = {
    "import": import_recording,
    "check": check,
    "simulate": simulate,
    "calibrate": calibrate,
    "compare": compare,
    "reconstruct": reconstruct,
    "merge": merge,
    "measure": measure,
    "record": record,
    "emulate": emulate,
    "board": print_board,
    "report": report,
    "study": study,
}


def between(kind, least, most, what):
    """Reads a number within limits from the command line."""

    def read(text):
        value = kind(text)
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{value}: {least} to {most} {what}")
        return value

    return read


how_many = between(int, 1, 1000, "are possible")
metres = between(float, 0.001, 1, "m are possible")
inner = between(int, 3, 50, "inner corners are possible")


def parser():
    """The command line, an ArgumentParser."""
    top = argparse.ArgumentParser(
        prog="python -m lrfcal_lib", description=__doc__.replace("``", "")
    )
    verbs = top.add_subparsers(title="verbs", metavar="VERB", dest="verb", required=True)
    for add in (
        _add_import,
        _add_sessions,
        _add_measure,
        _add_rigs,
        _add_report,
        _add_study,
    ):
        add(verbs)
    return top


def _add_import(verbs):
    kinds = verbs.add_parser("import", help="make a session of a recording by other people")
    kinds = kinds.add_subparsers(title="recordings", metavar="KIND", required=True)
    add = kinds.add_parser(
        "lasersetero", help="LMS400 on a pitching stage + ZED (LaserSeteroCalibration)"
    )
    add.add_argument(
        "src", help="folder with plane_NN.pcd, left_NN.png, right_NN.png, Calib_Results_*.m"
    )
    add.add_argument("dst", help="folder of the new session")


def _add_sessions(verbs):
    """Verbs that make or use a session without devices."""
    check = verbs.add_parser("check", help="say what is wrong with a session")
    check.add_argument("session")
    check.add_argument(
        "--calibration",
        metavar="JSON",
        help="a calibration.json: does it still hold for the rig that recorded the session?",
    )

    simulate = verbs.add_parser("simulate", help="record a session with a simulated rig")
    simulate.add_argument("setup", help="sim_lms221, sim_quick or room_lms221, as in data/")
    simulate.add_argument("dst", help="folder of the new session")

    calibrate = verbs.add_parser(
        "calibrate", help="calibrate the rig of a session, or of many"
    )
    _add_many(calibrate)

    compare = verbs.add_parser(
        "compare", help="say how far calibrations of one rig differ, beside what they claim"
    )
    compare.add_argument(
        "calibrations",
        nargs="+",
        metavar="calibration.json",
        help="two or more, the earliest first; a session is calibrated",
    )
    compare.add_argument("--figure", metavar="PNG", help="also draw them")

    for name, words in (
        ("reconstruct", "make coloured clouds of a scene with a calibration of its rig"),
        ("merge", "join the stations of a scene in one cloud"),
    ):
        scenes = verbs.add_parser(name, help=words)
        _add_calibration(scenes)
        _add_many(scenes, SCENE)


def _add_many(verb, words=None):
    """What the work on many sessions takes."""
    verb.add_argument("sessions", nargs="+", metavar="session", help=words)
    verb.add_argument(
        "--out", help="folder of its files (default reports/<session> under this folder)"
    )
    _add_scheduler(verb)


def _add_calibration(verb):
    """What the use of a calibration on a scene takes."""
    verb.add_argument("--calibration", required=True, help="calibration.json")
    verb.add_argument(
        "--untrusted",
        action="store_true",
        help="even if the verdict on the calibration is 'no'; every file says so",
    )


def _add_measure(verbs):
    """The verb that measures in a scene."""
    measure = verbs.add_parser(
        "measure", help="measure lengths between places picked in scene.html"
    )
    measure.add_argument("session", help=SCENE)
    measure.add_argument(
        "--out", help="CSV with the lengths (default reports/<session>/lengths.csv)"
    )
    _add_calibration(measure)
    measure.add_argument("--picks", required=True, help="the CSV that scene.html saves")
    measure.add_argument(
        "--station", type=int, help="whose scene.html it was (default: that of 'merge')"
    )


def _add_rigs(verbs):
    """Verbs that have to do with devices."""
    record = verbs.add_parser(
        "record", help="record a session with a rig, real or emulated"
    )
    add = record.add_argument
    add(
        "rig_file",
        help="JSON: the rig, its devices and what to record ('emulate' writes one)",
    )
    add("session", help="folder of the new session")
    add(
        "--resume",
        action="store_true",
        help="go on with a session; finished placements stay",
    )
    add(
        "--placements",
        dest="count",
        type=how_many,
        metavar="N",
        help="record N placements of the plan",
    )
    add("--scene", action="store_true", help="record a scene instead of the plan's boards")
    add("--stations", type=how_many, metavar="N", help="of the scene (default 1)")
    add("--calibration", help="calibration.json of the rig: plans the images of the scene")

    emulate = verbs.add_parser("emulate", help="emulate the devices of a rig")
    emulate.add_argument(
        "setup",
        nargs="?",
        default="sim_quick",
        help="practice (recorded in minutes), sim_quick (default) or sim_lms221",
    )
    emulate.add_argument(
        "--rig-file",
        help="write a new file for 'record', removed at the end unless changed",
    )
    emulate.add_argument(
        "--feedback",
        choices=("full", "partial", "none"),
        default="full",
        help="what the head tells of its position",
    )


def _add_report(verbs):
    board = verbs.add_parser("board", help="a board to print at its true size")
    board.add_argument(
        "columns", type=inner, help="inner corners of the chessboard along x"
    )
    board.add_argument(
        "rows", type=inner, help="and along y, odd where the columns are even"
    )
    board.add_argument("square", type=metres, help="side of a square, metres")
    board.add_argument("--out", default="board.pdf", help="PDF, SVG or PNG (board.pdf)")

    report = verbs.add_parser(
        "report", help="execute the notebooks on a session and write what they found"
    )
    report.add_argument(
        "sessions",
        nargs="*",
        metavar="session",
        help="folders of sessions (default: the shipped one)",
    )
    report.add_argument("--out", help="folder of the report (default reports/<session>)")
    report.add_argument(
        "--jobs", type=int, default=2, help="notebooks executed at the same time"
    )
    report.add_argument(
        "--store",
        action="store_true",
        help="store the executed notebooks instead of a report, always here",
    )
    _add_scheduler(report)


def _add_study(verbs):
    study = verbs.add_parser(
        "study",
        help="compare methods on many drawn sessions of published and other set-ups",
    )
    add = study.add_argument
    add("scenarios", nargs="+", metavar="SCENARIO", help="e.g. paper_rig")
    add("--methods", nargs="+", help="default: all that single shots allow")
    add(
        "--poses",
        nargs="+",
        type=int,
        metavar="N",
        help="placements (default 5 10 20 50 100)",
    )
    add("--trials", type=int, default=100, help="of each (default 100)")
    add("--seed", type=int, default=0)
    add(
        "--vary",
        action="append",
        default=[],
        metavar="KEY=V,V,...",
        help="e.g. step_deg=0.25,0.5; several times: every combination",
    )
    add(
        "--out",
        required=True,
        help="the table, CSV; a killed study goes on when asked again",
    )
    _add_scheduler(study)


def _add_scheduler(verb):
    verb.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a Dask cluster, e.g. tcp://10.0.0.1:8786 (default: the cores of this machine)",
    )


def main(argv=None):
    """Run a verb.

    Parameters
    ----------
    argv : list of str, optional
        Without the program's name.

    Returns
    -------
    int
        0, 1 after a message on stderr (a ``ValueError`` is bad input, not a bug), 130 after
        Ctrl-C. ``record`` has its own: 2 after a message that says what to do; ``calibrate`` has 3
        where the verdict is 'no'.
    """
    options = vars(parser().parse_args(argv))
    work = VERBS[options.pop("verb")]
    try:
        return work(**options) or 0
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:  # before a verb that has more to say got so far
        print("\nstopped by Ctrl-C", file=sys.stderr)
        return INTERRUPTED


def program():
    """:func:`main` as a process of its own. Nobody looks for garbage among what it imports, neither
    then nor at its end, which saves a third of a second.
    """
    gc.set_threshold(MADE_BETWEEN_SEARCHES)
    code = main()
    gc.freeze()
    sys.exit(code)


if __name__ == "__main__":
    program()
