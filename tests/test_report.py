"""The report: notebooks run, what they found arrives, what fails is said and spoils nothing else."""

import html
import json
import multiprocessing
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pandas as pd
import pytest
from jupyter_client import AsyncKernelClient
from shared import ROOT, campaign, until
from test_session import CAMERAS, HEAD, LRF, wall

from lrfcal_lib.model.board import triangle_board
from lrfcal_lib.report import notebook, report
from lrfcal_lib.session.write import SessionWriter

KERNEL = {
    "kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}
}
GOOD = """
import json
import matplotlib.pyplot as plt
import pandas as pd
from lrfcal_lib.report import notebook
session = notebook.start()
"""
RESULTS = """
fig, ax = plt.subplots()
ax.plot(session.sweep(1).ranges[0])
notebook.save(fig, "ranges", "One scan line <of many>.")
notebook.finding("mean_range", 2.0, "Mean range", "m", digits=1)
notebook.table(pd.DataFrame({"method": ["joint", "line"], "error_mm": [-2.0, float("nan")]}), "errors", digits=1)
"""
JUDGED = """
record = {"answer": "yes", "expected_error_at_m": {"1": {"cloud_mm": 2.0, "left_px": 1.0},
                                                   "2": {"cloud_mm": 3.0, "left_px": 1.5}}}
said = ["this can be trusted", "expected error at 1 m: 2 mm", "expected error at 2 m: 3 mm", "handed over: 'joint'",
        "rest", "record next: nothing"]
notebook.verdict("Can it be trusted?", said, record)
notebook.table(pd.DataFrame({"placement": range(3), "used": True}), "placements")
lengths = {"source": ["wall"] * 4 + ["paper"], "placement": [1, 1, 2, 2, None],
           "error_mm": [1.0, -3.0, 3.0, -5.0, 8.84], "variant": ["half_step"] * 4 + ["last_beam"]}
lengths["ends"] = ["scan"] * 5
notebook.table(pd.DataFrame(lengths), "edge_lengths")
pose = {"maps": "lrf to left", "rotvec_rad": [0.1, 0.2, 0.3], "translation_m": [0.119, 0.0, -0.05]}
pose["sigma"] = dict(zip(("rx", "ry", "rz", "tx", "ty", "tz"), [0.001] * 6))
notebook.report_file("calibration.json").write_text(json.dumps({"method": "joint", "cameras": {"left": pose}}))
wide = pd.DataFrame({f"a_rather_long_heading_{n}_mm": [1234.5678] for n in range(14)})
display(wide)
_ = notebook.table(wide, "wide")
print("x" * 300)
"""


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A recording of one flat wall."""
    path = tmp_path_factory.mktemp("sessions") / "wall"
    about = {"licence": "CC0", "source": "a test"}
    with SessionWriter(
        path, triangle_board(), LRF, CAMERAS, HEAD, simulated=True, **about
    ) as writer:
        writer.add_sweep(1, *wall())
    return path


def write_notebook(path, *cells):
    title = nbformat.v4.new_markdown_cell(
        "# A wall\n\n> Walls are **flat**.\n\nReads: a session. Writes: nothing."
    )
    codes = [nbformat.v4.new_code_cell(cell.strip()) for cell in cells]
    nbformat.write(nbformat.v4.new_notebook(cells=[title, *codes], metadata=KERNEL), path)
    return path


@pytest.fixture(scope="module")
def finished(session, tmp_path_factory):
    """A report of one notebook that works and one that fails after its first finding."""
    folder = tmp_path_factory.mktemp("notebooks")
    good = write_notebook(folder / "00_good.ipynb", GOOD, RESULTS)
    early = 'notebook.finding("early", "found before the failure", "Verdict")'
    cells = nbformat.read(good, 4)
    cells.cells += [nbformat.v4.new_markdown_cell("Of $t_y$ and\n\n$$\\mathbf y = \\left(a + b\\right) \\tag{3}$$"),
                    nbformat.v4.new_code_cell(JUDGED)]  # fmt: skip
    nbformat.write(cells, good)
    bad = write_notebook(
        folder / "01_bad.ipynb", GOOD, early, "raise ValueError('board 7 is <missing>')"
    )
    out = tmp_path_factory.mktemp("reports") / "wall"
    (out / "figures").mkdir(parents=True)
    (out / "figures" / "stale.png").write_bytes(b"old")
    (out / "notes.txt").write_text("mine")
    return out, report.make_report(session, out, notebooks=[good, bad])


def test_a_failing_notebook_is_told_and_the_rest_delivered(finished):
    out, (good, bad) = finished
    assert (
        good.error == ""
        and "ValueError" in bad.error
        and "board 7 is <missing>" in bad.error
    )
    assert "\x1b" not in bad.error, "no colours of a terminal"
    assert (out / "01_bad.html").is_file()
    page = (out / "index.html").read_text()
    assert "01_bad failed" in page and "board 7 is &lt;missing&gt;" in page
    page = (out / "00_good.html").read_text()
    assert (
        "Walls are" in page
        and "data:image/png;base64," in page
        and 'href="index.html"' in page
    )
    assert page.count('<details class="code"><summary>') == 3, "code is folded, and there"
    assert re.sub("<[^>]+>", "", page).count("fig, ax = plt.subplots()") == 1
    assert 'rel="next" href="01_bad.html"' in page and 'rel="prev"' not in page
    assert (
        '<mi mathvariant="bold">y</mi>' in page
        and "<span>(3)</span>" in page
        and "$" not in page
    )


@pytest.mark.parametrize("failures", [1, 2])
def test_a_kernel_that_does_not_start_has_a_second_chance(tmp_path, monkeypatch, failures):
    """Its ports may be taken by another program in between; what fails twice is said of its notebook."""
    start = AsyncKernelClient.wait_for_ready
    tried = []

    async def once(self, timeout=None):
        tried.append(self)
        if len(tried) <= failures:
            raise RuntimeError("Kernel died before replying to kernel_info")
        await start(self, timeout)

    monkeypatch.setattr(AsyncKernelClient, "wait_for_ready", once)
    path = tmp_path / "00_short.ipynb"
    cells = [nbformat.v4.new_code_cell("print(6 * 7)")]
    nbformat.write(nbformat.v4.new_notebook(cells=cells, metadata=KERNEL), path)
    done, error = report.execute(path, {})
    assert len(tried) == 2
    if failures == 1:
        assert error == "" and done.cells[0].outputs[0].text == "42\n"
    else:
        assert "Kernel died" in error


def test_index_states_what_was_found_and_needs_no_other_file(finished, session):
    page = (finished[0] / "index.html").read_text()
    digest = report.hashlib.sha256((session / "session.json").read_bytes()).hexdigest()
    told = [
        "A wall",
        "Walls are flat.",
        "2.0 m",
        "Mean range",
        "<b>Figure 0.1.</b> One scan line &lt;of many&gt;.",
    ]
    told += [
        digest,
        np.__version__,
        "<b>Table 0.1.</b> Errors",
        '<td data-label="method">lines, half step</td>',
    ]
    told += [
        f'<td class="number" data-label="error [mm]">{cell}</td>' for cell in ("-2.0", "–")
    ]
    assert [words for words in told if words not in page] == []
    assert "found before the failure" in page, (
        "a notebook that fails has told what it found until then"
    )
    assert set(re.findall(r'<img [^>]*src="(.{22})', page)) == {"data:image/png;base64,"}
    assert "<script" not in page and "<link" not in page


def test_the_first_screen_has_the_verdict_and_its_numbers(finished):
    page = (finished[0] / "index.html").read_text()
    first = re.sub("<[^>]+>", "", page.split("</header>")[1].split('id="verdict"')[0])
    first = re.sub(r"\s+", " ", html.unescape(first))
    told = ["This can be trusted.", "Handed over: 'joint estimate'.", "Record next: nothing.", "3.0 ± 1.5 mm",
            "2.0 mm at 1 m", "1.5 ± 0.8 px", "3.0 ± 1.0 mm", "of 4 edge lengths", "8.84 mm",
            "Use this: calibration.json, poses by joint estimate", "11.46 ± 0.06", "119.0 ± 1.0"]  # fmt: skip
    assert [words for words in told if words not in first] == []
    assert "Rest." not in first and "Expected error at 2 m" not in first
    assert "Rest." in page and "Expected error at 2 m" in page, "below"


OVER = """() => {
    for (const part of document.querySelectorAll("details")) part.open = true;
    const width = document.documentElement.clientWidth, over = [];
    for (const part of document.querySelectorAll("body, body *")) {
        const formula = width < 500 && part.closest(".formula div");  // scrolls on a telephone
        if (formula && formula !== part) continue;
        const inline = getComputedStyle(part).display.startsWith("inline");
        const wide = !inline && !formula && part.scrollWidth > part.clientWidth + 1;
        if (part.getBoundingClientRect().right > width + 1 || wide)
            over.push([part.tagName, part.textContent.slice(0, 80)]);
    }
    return over;
}"""


WITHOUT_CODE = "for (const part of document.querySelectorAll('details.code')) part.remove()"


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Pages of the notebooks as they are stored."""
    folder = tmp_path_factory.mktemp("stored")
    names = sorted((ROOT / "notebooks").glob("*.ipynb"))
    nothing = {"figures": [], "tables": [], "findings": [], "verdicts": []}
    runs = [
        report.Run(path.stem, path.stem, "", 0.0, "", nbformat.read(path, 4), nothing)
        for path in names
    ]
    report.write_pages(folder, report.open_session(report.SHIPPED), runs, 0.0)
    return folder


@pytest.mark.parametrize("width", [1280, pytest.param(400, marks=campaign)])
def test_nothing_is_cut_off_and_nothing_fetched(finished, stored, browser, width):
    view = browser.new_page(viewport={"width": width, "height": 800})
    said = []
    view.set_default_timeout(120_000)  # a busy machine takes its time
    view.on("console", lambda message: said.append(message.text))
    view.on("pageerror", lambda error: said.append(str(error)))
    view.on(
        "request",
        lambda request: (
            request.url.startswith(("file:", "data:")) or said.append(request.url)
        ),
    )
    pages = [*finished[0].glob("*.html"), *stored.glob("*.html")]
    assert len(pages) == 4 + len([*(ROOT / "notebooks").glob("*.ipynb")])
    for file in pages:
        view.goto(file.as_uri())
        assert view.evaluate(OVER) == [], file.name
        view.evaluate(WITHOUT_CODE)  # labels of figures are formulas there
        assert not re.search(
            r"\$|\\\\(frac|mathbf|tag)", view.inner_text("body").replace("$HOME", "")
        ), file.name
    assert said == []
    view.goto((finished[0] / "index.html").as_uri())
    numbers = view.locator(".numbers b").last.bounding_box()
    assert width == 400 or numbers["y"] + numbers["height"] < 800, (
        "the numbers are on the first screen"
    )
    view.close()


def test_tables_and_findings_are_kept_as_data_and_only_what_a_report_wrote_is_removed(
    finished,
):
    out, _ = finished
    assert (
        out / "tables" / "errors.csv"
    ).read_text() == "method,error_mm\njoint,-2\nline,\n"
    found = [
        (f["notebook"], f["key"], f["value"])
        for f in json.loads((out / "findings.json").read_text())
    ]
    assert found == [
        ("00_good", "mean_range", 2.0),
        ("01_bad", "early", "found before the failure"),
    ]
    assert not (out / "parts").exists() and not (out / "figures" / "stale.png").exists()
    assert (out / "figures" / "ranges.png").is_file() and (
        out / "notes.txt"
    ).read_text() == "mine"


@pytest.fixture
def line(tmp_path):
    """Two pipes to a notebook: it says that it is there, and waits until it is told to go on."""
    ends = []
    for name in ("here", "go"):
        os.mkfifo(tmp_path / name)
        ends.append(os.open(tmp_path / name, os.O_RDWR))  # so that opening never waits
    yield ends
    os.write(ends[1], b".")  # whatever happened, nobody waits any longer
    for end in ends:
        os.close(end)


def waiting(path, tmp_path):
    cell = f"open({str(tmp_path / 'here')!r}, 'w').write('.'); open({str(tmp_path / 'go')!r}).read(1)"
    return write_notebook(path, cell, GOOD, 'notebook.finding("late", 2, "Found late")')


def wait_until_there(line):
    assert select.select([line[0]], [], [], 120)[0], "the notebook does not run"


def parts(folder):
    return [*folder.glob(".report-*"), *folder.glob(".lrfcal-*")]


RUN = """import sys, pathlib
sys.modules["rfc3987_syntax"] = None  # see conftest.py
from lrfcal_lib.report import report
report.NOTEBOOKS = pathlib.Path(sys.argv[1])
sys.exit(report.main(sys.argv[2:3], sys.argv[3]))"""
ENDS = {signal.SIGTERM: 143, signal.SIGKILL: -9}


@campaign
@pytest.mark.parametrize("number", ENDS, ids=lambda number: number.name)
def test_an_ended_report_leaves_the_old_one(session, tmp_path, line, number):
    assert {signal.SIGINT, signal.SIGHUP} < set(report.ENDING), "end it as SIGTERM does"
    out = tmp_path / "reports" / "wall"
    report.make_report(session, out, notebooks=[])
    before = {file.name: file.read_bytes() for file in out.glob("*.*")}
    waiting(tmp_path / "00_late.ipynb", tmp_path)
    command = [sys.executable, "-c", RUN, str(tmp_path), str(session), str(out)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        wait_until_there(line)
        report.make_report(session, out.with_name("other"), notebooks=[])
        unfinished = parts(out.parent)
        process.send_signal(number)
        said = process.communicate(timeout=120)[1]
    assert len(unfinished) == 1, "what another report is writing is left alone"
    assert process.returncode == ENDS[number] and "Traceback" not in said
    assert (
        number == signal.SIGKILL
        or f"stopped by {number.name}; an earlier report stays as it was" in said
    )
    assert {file.name: file.read_bytes() for file in out.glob("*.*")} == before
    assert len(parts(out.parent)) == (number == signal.SIGKILL)


def test_a_folder_that_cannot_be_written_is_named(session, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert report.main([session], tmp_path / "file" / "out") == 2
    assert re.search(
        r"file/out: cannot write the report .*--out names another folder",
        capsys.readouterr().err,
    )


NAMES = [
    'a "b c',
    "cost$5",
    "$(shell echo ran >&2)",
    "$(PYTHON)",
    "`echo ran >&2`",
    "${HOME}",
]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("how", ["argument", "environment"])
def test_make_takes_any_name_of_a_session(name, how):
    command = ["make", "-s", "-o", "setup", "report", "RUN=printf '<%s>'"]
    command += [f"SESSION={name}"] if how == "argument" else []
    own = {**os.environ, "SESSION": name} if how == "environment" else None
    shown = subprocess.run(
        command, cwd=report.ROOT, env=own, capture_output=True, text=True, check=True
    )
    assert shown.stdout == f"<-m><lrfcal_lib><report><{name}>" and shown.stderr == ""


def replace(out, until):
    """Put one report after the other in the place of one."""
    while not until.is_set():
        with report.in_place_of(out) as new:
            (new / "index.html").write_text("new")
            (new / "tables").mkdir()
            (new / "tables" / "errors.csv").write_text("new")


@pytest.mark.parametrize("looks", [1000, pytest.param(20_000, marks=campaign)])
def test_a_report_that_is_replaced_is_never_missing(tmp_path, looks):
    (out := tmp_path / "wall").mkdir()
    for name in ("index.html", "notes.txt", "00_old.html"):
        (out / name).write_text("old")
    fork = multiprocessing.get_context("fork")
    end = fork.Event()
    writers = [fork.Process(target=replace, args=(out, end)) for _ in range(2)]
    for writer in writers:
        writer.start()
    until(lambda: not (out / "00_old.html").exists())
    there = 0
    for _ in range(looks):
        there += (out / "index.html").exists()
        time.sleep(1e-4)  # so that the writers get on
    end.set()
    for writer in writers:
        writer.join()
    assert there == looks and [writer.exitcode for writer in writers] == [0, 0]
    found = sorted(
        str(file.relative_to(tmp_path)) for file in tmp_path.rglob("*") if file.is_file()
    )
    assert found == ["wall/index.html", "wall/notes.txt", "wall/tables/errors.csv"]
    assert (out / "notes.txt").read_text() == "old"


@pytest.mark.parametrize("broken", [False, True])
def test_where_folders_cannot_be_exchanged_they_are_renamed(tmp_path, monkeypatch, broken):
    monkeypatch.setattr(report, "EXCHANGE", 1 << 20)  # another flag is refused
    (out := tmp_path / "wall").mkdir()
    for name in ("index.html", "notes.txt", "00_old.html"):
        (out / name).write_text("old")
    before = sorted(tmp_path.rglob("*"))
    rename = Path.replace

    def stopped(file, target):
        """Ctrl-C between the two renames."""
        if target == out and file.name == "report":
            raise KeyboardInterrupt
        return rename(file, target)

    if broken:
        monkeypatch.setattr(Path, "replace", stopped)
        with pytest.raises(KeyboardInterrupt), report.in_place_of(out) as new:
            (new / "index.html").write_text("new")
        assert (
            sorted(tmp_path.rglob("*")) == before
            and (out / "index.html").read_text() == "old"
        )
    else:
        with report.in_place_of(out) as new:
            (new / "index.html").write_text("new")
        assert {file.name: file.read_text() for file in out.glob("*.*")} == {
            "index.html": "new",
            "notes.txt": "old",
        }
        assert list(tmp_path.iterdir()) == [out]


def test_main_returns_what_a_shell_needs(session, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(report, "NOTEBOOKS", tmp_path)
    write_notebook(tmp_path / "00_good.ipynb", GOOD)
    assert report.main([session], tmp_path / "a") == 0
    told = capsys.readouterr()
    assert "1 of 1 notebooks" in told.out
    write_notebook(tmp_path / "01_good.ipynb", GOOD)
    assert report.main([session], tmp_path / "a", jobs=1) == 0
    begun, *done = capsys.readouterr().err.splitlines()
    assert begun == "lrfcal: 2 notebooks begun"
    assert re.fullmatch(r"lrfcal: 1 of 2 done after .* \(01_good\)", done[0])
    assert re.fullmatch(r"lrfcal: 2 of 2 done after .* \(00_good\)", done[1])
    (tmp_path / "01_good.ipynb").unlink()
    write_notebook(tmp_path / "00_good.ipynb", "1 / 0")
    assert report.main([session], tmp_path / "b") == 1
    assert "00_good failed: ZeroDivisionError" in capsys.readouterr().err
    assert report.main([tmp_path / "nowhere"]) == 2
    assert "nowhere" in capsys.readouterr().err


def test_storing_keeps_outputs_of_simulations_only_and_nothing_of_what_fails(
    session, tmp_path
):
    cells = "import os  # for notebook.start()", "print(os.environ['LRFCAL_SESSION'][-4:])"
    path = write_notebook(tmp_path / "00_x.ipynb", *cells)
    assert report.store(path, session) == ""
    assert nbformat.read(path, 4).cells[2].outputs[0].text == "wall\n"
    recording = shutil.copytree(session, tmp_path / "recording")
    index = recording / "session.json"
    index.write_text(index.read_text().replace('"simulated": true', '"simulated": false'))
    assert report.store(path, recording) == ""
    cells = [cell for cell in nbformat.read(path, 4).cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == [1, 2] and not any(
        cell.outputs for cell in cells
    )
    before = write_notebook(path, "1 / 0").read_bytes()
    assert "ZeroDivisionError" in report.store(path, None) and path.read_bytes() == before


def test_outside_a_report_run_nothing_is_written(monkeypatch, tmp_path):
    monkeypatch.delenv("LRFCAL_REPORT", raising=False)
    monkeypatch.chdir(tmp_path)
    notebook.save(plt.figure(), "empty", "Nothing.")
    made = notebook.table(pd.DataFrame({"a": [0.12345]}), "numbers", digits=2).data
    assert notebook.report_file("cloud.ply") is None and list(tmp_path.iterdir()) == []
    assert ">0.12<" in made and "numbers" in made


@pytest.mark.parametrize("name", ["../x", "A b", "", "x.png"])
def test_names_become_file_names(name):
    with pytest.raises(ValueError, match="must consist of lower-case letters"):
        notebook.finding(name, 1, "text")
