"""Execute the notebooks on a session and write what they found to ``reports/<session>/``."""

import ctypes
import hashlib
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import date
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellControlSignal, DeadKernelError
from nbconvert.filters import strip_ansi
from tqdm import tqdm

from lrfcal_lib.report.first_screen import first_screen
from lrfcal_lib.report.notebook import ROOT, SHIPPED
from lrfcal_lib.report.page import TEMPLATES, figure_of, render, table_of
from lrfcal_lib.session.cache import VARIABLE as CACHE
from lrfcal_lib.session.files import SessionError
from lrfcal_lib.session.read import open_session
from lrfcal_lib.session.write import RECORDINGS

NOTEBOOKS = ROOT / "notebooks"
NUMBERED = "[0-9][0-9]_*"
PACKAGES = (
    "lrfcal",
    "numpy",
    "scipy",
    "opencv-python-headless",
    "open3d",
    "pandas",
    "matplotlib",
)
OWN_FILES = (  # folders, files to link to, the page itself
    "figures",
    "tables",
    "parts",
    "calibration.json",
    "scene.html",
    "room.html",
    "cloud.ply",
    "scene.ply",
    "scene.pcd",
    "findings.json",
    "index.html",
)
AT_WORKING_FOLDER = -100  # AT_FDCWD, see renameat2(2)
EXCHANGE = 2  # RENAME_EXCHANGE of Linux
PART = ".report-"  # begins the names of folders in which a report is being written
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
CELL_SECONDS = 600
_CLIENTS: set[NotebookClient] = set()  # of the notebooks that are being executed


@dataclass(frozen=True)
class Run:
    """One executed notebook: file name without suffix, first heading, first paragraph; `error` is a
    traceback or ''; `found` are its figures, tables, findings and verdicts.
    """

    name: str
    title: str
    thesis: str
    seconds: float
    error: str
    notebook: nbformat.NotebookNode
    found: Mapping[str, list]

    @property
    def number(self) -> str:
        """Of the notebook, which begins its name."""
        return self.name[:2].removeprefix("0")


def make_report(session_path, out, jobs=2, notebooks=None):
    """Execute the notebooks on a session and write the report.

    Parameters
    ----------
    session_path : path
        Folder of a session.
    out : path
        Folder of the report. It is written beside it and takes its place when it is whole, by one
        rename: until then an earlier report stays as it is. Files in it that are no report's are
        kept.
    jobs : int
        Notebooks executed at the same time.
    notebooks : sequence of path, optional
        All of ``notebooks/`` unless given.

    Returns
    -------
    list of Run
        In the order of the notebooks. A notebook that fails is reported, the others still run. A
        SessionError if the session is not sound, or the folder of the report cannot be written.
    """
    begin = time.monotonic()
    session = open_session(Path(session_path).resolve())
    out = Path(out).resolve()
    paths = sorted(
        NOTEBOOKS.glob(f"{NUMBERED}.ipynb") if notebooks is None else map(Path, notebooks)
    )
    # a fresh cache: a report stands for its session
    with in_place_of(out) as new, TemporaryDirectory(prefix="lrfcal-") as cache:
        environment = {
            "LRFCAL_SESSION": str(session.path),
            "LRFCAL_REPORT": str(new),
            CACHE: cache,
            # what notebook 09 records with the emulated rig goes with the report's cache
            RECORDINGS: cache,
        }
        runs = _execute_all(paths, environment, jobs)
        shutil.rmtree(new / "parts", ignore_errors=True)
        write_pages(new, session, runs, time.monotonic() - begin)
    return runs


def execute(path, environment):
    """Execute a notebook in a fresh kernel with variables on top of this process's own.

    Returns the NotebookNode with outputs, up to the cell that failed if one did, and the traceback
    of that cell or ''.
    """
    notebook = nbformat.read(path, as_version=4)
    error = ""
    client = NotebookClient(
        notebook,
        timeout=CELL_SECONDS,
        resources={"metadata": {"path": str(Path(path).parent)}},
        kernel_name="python3",
        record_timing=False,
        extra_arguments=["--log-level=ERROR"],
    )
    _CLIENTS.add(client)
    try:
        _execute_in(client, {**os.environ, "MPLBACKEND": "", **environment})
    except (CellControlSignal, RuntimeError) as problem:
        # no colours of a terminal
        error = strip_ansi(str(problem)) or type(problem).__name__
    finally:
        _CLIENTS.discard(client)
    # without their kernel live widgets show an error, and pages would load them from elsewhere
    notebook.metadata.pop("widgets", None)
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            output.get("data", {}).pop("application/vnd.jupyter.widget-view+json", None)
    return notebook, error


def _execute_in(client, variables):
    """Execute with environment variables, among them the backend of notebooks."""
    try:
        client.execute(env=variables)
    except DeadKernelError:
        raise
    except RuntimeError:  # it did not start: another program took a port that it had chosen
        client.execute(env=variables)


def store(path, session_path, cache=""):
    """Execute a notebook and store it in place as run from top to bottom; the traceback of a cell
    that failed, or ''.

    A notebook that fails is left alone. Outputs made from a recording that is not simulated are
    dropped (its pictures may carry no licence), execution counts are kept. `cache` is the folder of
    stages that other notebooks have worked out.
    """
    with TemporaryDirectory(prefix="lrfcal-") as recordings:
        environment = {
            "LRFCAL_SESSION": str(session_path or ""),
            CACHE: cache,
            RECORDINGS: recordings,
        }
        notebook, error = execute(path, environment)
    if error:
        return error
    codes = [cell for cell in notebook.cells if cell.cell_type == "code"]
    if (
        any("notebook.start(" in cell.source for cell in codes)
        and not open_session(session_path).simulated
    ):
        for cell in codes:
            cell.outputs = []
    notebook.metadata = {
        "kernelspec": {
            "display_name": "Python 3 (ipykernel)",
            "language": "python",
            "name": "python3",
        },
        "language_info": {"name": "python"},
    }
    nbformat.write(notebook, path)
    return ""


def main(sessions=(), out=None, jobs=2, stored=False):
    """Report on sessions, or store the notebooks as run on them; the shipped one where none is
    named.

    0, 1 if a notebook failed, 2 without a sound session, 128 + a signal that ended it.
    """
    # nohup ignores SIGHUP
    before = [
        (n, signal.signal(n, _stop))
        for n in ENDING
        if signal.getsignal(n) != signal.SIG_IGN
    ]
    try:
        return max(
            _store_all(session) if stored else report_session(session, out, jobs)
            for session in sessions or [SHIPPED]
        )
    except SessionError as problem:
        print(f"lrfcal: {problem}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stopped:
        number = signal.Signals(*stopped.args)
        print(
            f"\nlrfcal: stopped by {number.name}; an earlier report stays as it was",
            file=sys.stderr,
        )
        return 128 + number
    finally:
        for pair in before:
            signal.signal(*pair)


def _stop(number, frame):
    """End in order; from here on there is only cleaning up, which nothing should interrupt."""
    for other in ENDING:
        signal.signal(other, signal.SIG_IGN)
    raise KeyboardInterrupt(number)


def report_session(session: str | Path, out: str | Path | None, jobs: int = 2) -> int:
    """Write the report of a session and say so: 0, or 1 if a notebook failed."""
    begin = time.monotonic()
    out = Path(out or ROOT / "reports" / Path(session).resolve().name).resolve()
    runs = make_report(session, out, jobs)
    failed = [run for run in runs if run.error]
    for run in failed:
        print(f"{run.name} failed:", run.error.strip().splitlines()[-1], file=sys.stderr)
    good = len(runs) - len(failed)
    seconds = time.monotonic() - begin
    print(f"{good} of {len(runs)} notebooks in {seconds:.0f} s: {out / 'index.html'}")
    return int(bool(failed))


def _store_all(session):
    open_session(session)
    failed = 0
    with TemporaryDirectory(prefix="lrfcal-") as cache:
        for path in sorted(NOTEBOOKS.glob(f"{NUMBERED}.ipynb")):
            error = store(path, Path(session).resolve(), cache)
            failed |= bool(error)
            print(
                f"{path.name}: {error or 'stored'}",
                file=sys.stderr if error else sys.stdout,
                flush=True,
            )
    return failed


@contextmanager
def in_place_of(out):
    """A new folder of one's own that takes the place of `out` at the end, unless something is
    raised before.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(
            prefix=PART, dir=out.parent, ignore_cleanup_errors=True
        ) as box:
            new = Path(box) / "report"
            new.mkdir()
            yield new
            _take_place(new, out)
    except OSError as error:
        raise SessionError(
            f"{out}: cannot write the report ({error}); --out names another folder"
        ) from error


def _take_place(new, out):
    """Exchange two folders; files in the old one that are no report's come along.

    At every moment, also that of a kill, there is a report: the old one or the new one. Where the
    system cannot exchange folders (file systems over a network, macOS), there is none for the
    moment between two renames, and a kill in that moment leaves the old one beside it.
    """

    of_a_report = shutil.ignore_patterns(*OWN_FILES, f"{NUMBERED}.html")

    def ours(folder, names):
        return of_a_report(folder, names) if folder == str(out) else ()

    out.mkdir(exist_ok=True)
    shutil.copytree(out, new, symlinks=True, ignore=ours, dirs_exist_ok=True)
    exchange = getattr(ctypes.CDLL(None), "renameat2", None)
    places = AT_WORKING_FOLDER, os.fsencode(new), AT_WORKING_FOLDER, os.fsencode(out)
    if exchange is None or exchange(*places, EXCHANGE) != 0:
        old = new.with_name("old")
        try:
            out.replace(old)
            new.replace(out)
        finally:
            if not out.exists():  # interrupted in between
                old.replace(out)


def _execute_all(paths, environment, jobs):
    """Execute notebooks side by side."""
    with ThreadPoolExecutor(max(1, jobs)) as pool:
        # later notebooks go through more stages and take longer, so they start first
        futures = {pool.submit(_run, path, environment): path for path in reversed(paths)}
        try:
            _show_progress(futures)
        finally:  # end the notebooks that are being executed and leave out the others
            for future in futures:
                future.cancel()
            while wait(futures, timeout=0.05).not_done:
                for client in list(_CLIENTS):
                    with suppress(AttributeError):  # its kernel is just starting
                        client.km.provisioner.process.kill()
    return sorted((future.result() for future in futures), key=lambda run: run.name)


def _show_progress(futures):
    """Wait for notebooks (paths by future) with a bar, or without a terminal a line for each."""
    begin = time.monotonic()
    count = len(futures)
    with tqdm(as_completed(futures), total=count, desc="notebooks", disable=None) as bar:
        if bar.disable:
            print(f"lrfcal: {count} notebooks begun", file=sys.stderr, flush=True)
        for done, future in enumerate(bar, start=1):
            name = futures[future].stem
            bar.set_postfix_str(name)
            if bar.disable:
                seconds = time.monotonic() - begin
                print(
                    f"lrfcal: {done} of {count} done after {seconds:.0f} s ({name})",
                    file=sys.stderr,
                    flush=True,
                )


def _run(path, environment):
    """Execute one notebook."""
    begin = time.monotonic()
    notebook, error = execute(path, environment | {"LRFCAL_NOTEBOOK": path.stem})
    text = "\n".join(
        cell.source for cell in notebook.cells[:2] if cell.cell_type == "markdown"
    )
    # by their marks the first lines of each kind: title and thesis
    first = dict(reversed(re.findall("^([#>]) (.*)$", text, re.MULTILINE)))
    thesis = re.sub(r"[*`]", "", first.get(">", ""))
    title = first.get("#") or path.stem
    found = defaultdict(list)
    with suppress(FileNotFoundError):
        part = Path(environment["LRFCAL_REPORT"], "parts", f"{path.stem}.json")
        found |= json.loads(part.read_text())
    return Run(path.stem, title, thesis, time.monotonic() - begin, error, notebook, found)


def write_pages(out, session, runs, seconds):
    """The pages and the findings of notebooks, of what is in the report's folder.

    Parameters
    ----------
    out : Path
        Folder of the report.
    session : Session
    runs : list of Run
    seconds : float
        That the notebooks took.
    """
    figures = {
        entry["name"]: figure_of(out, entry, f"Figure {run.number}.{n}")
        for run in runs
        for n, entry in enumerate(run.found["figures"], start=1)
    }
    tables = {
        entry["name"]: table_of(entry, f"Table {run.number}.{n}")
        for run in runs
        for n, entry in enumerate(run.found["tables"], start=1)
    }
    for before, run, after in zip([None, *runs], runs, [*runs[1:], None], strict=False):
        _write_page(
            out / f"{run.name}.html",
            "notebook.html.jinja",
            session=session,
            run=run,
            body=render(run.notebook, figures, tables),
            before=before,
            after=after,
        )

    findings = [
        {"notebook": run.name, **entry} for run in runs for entry in run.found["findings"]
    ]
    (out / "findings.json").write_text(json.dumps(findings, indent=1) + "\n")
    verdicts = [entry for run in runs for entry in run.found["verdicts"]]
    _write_page(
        out / "index.html",
        "report.html.jinja",
        session=session,
        runs=runs,
        seconds=seconds,
        figures=figures,
        tables=tables,
        verdicts=verdicts,
        told={entry["key"]: entry for entry in findings},
        files=[name for name in OWN_FILES[3:-1] if (out / name).is_file()],
        provenance=_provenance(session),
        **first_screen(out, verdicts, figures),
    )


def _write_page(file, template, **values):
    """Write a page made by a template."""
    file.write_text(TEMPLATES.get_template(template).render(**values), encoding="utf-8")


def _provenance(session):
    """What the report was made from, by name; the commit is '' where git knows none."""
    digest = hashlib.sha256((session.path / "session.json").read_bytes()).hexdigest()
    try:
        commit = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"],
            cwd=ROOT,
            capture_output=True,
            text=True,
        ).stdout.strip()
    except FileNotFoundError:
        commit = ""
    return {
        "session.json (SHA-256)": digest,
        "date": date.today().isoformat(),
        "commit": commit,
        "Python": platform.python_version(),
        **{name: version(name) for name in PACKAGES},
    }
