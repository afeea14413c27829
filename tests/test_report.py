"""The report: notebooks run, what they found arrives, what fails is said and spoils nothing else."""

import json
import re

import nbformat
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import RigidTransform

from lrfcal_lib import notebook, report
from lrfcal_lib.board import triangle_board
from lrfcal_lib.session import LrfInfo, SessionError, SessionWriter

KERNEL = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
GOOD = """
import matplotlib.pyplot as plt
import pandas as pd
from lrfcal_lib import notebook
session = notebook.start()
"""
RESULTS = """
fig, ax = plt.subplots()
ax.plot(session.sweep(1).ranges[0])
notebook.save(fig, "ranges", "One scan line <of many>.")
notebook.finding("mean_range", 2.0, "Mean range", "m", digits=1)
notebook.table(pd.DataFrame({"edge": ["ab", "ca"], "error_mm": [-2.0, float("nan")]}), "errors", digits=1)
"""


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A recording of one flat wall."""
    path = tmp_path_factory.mktemp("sessions") / "wall"
    bearings = np.radians(np.arange(60.0, 121.0))
    lrf = LrfInfo("made up", (bearings[0], bearings[-1]), np.radians(1.0), 0.005, 0.0, 0.001, 8.0)
    writer = SessionWriter(path, triangle_board(), lrf, (), RigidTransform.identity(), source="a wall", simulated=True)
    with writer:
        ranges = np.full((4, 1), 2.0) / np.sin(bearings)
        writer.add_sweep(1, ranges, bearings, np.radians([-1.0, 0.0, 1.0, 2.0]))
    return path


def write_notebook(path, *cells):
    title = nbformat.v4.new_markdown_cell("# A wall\n\n> Walls are **flat**.\n\nReads: a session. Writes: nothing.")
    codes = [nbformat.v4.new_code_cell(cell.strip()) for cell in cells]
    nbformat.write(nbformat.v4.new_notebook(cells=[title, *codes], metadata=KERNEL), path)
    return path


@pytest.fixture(scope="module")
def finished(session, tmp_path_factory):
    """A report of one notebook that works and one that fails after its first finding."""
    folder = tmp_path_factory.mktemp("notebooks")
    good = write_notebook(folder / "00_good.ipynb", GOOD, RESULTS)
    early = 'notebook.finding("early", "found before the failure", "Verdict")'
    bad = write_notebook(folder / "01_bad.ipynb", GOOD, early, "raise ValueError('board 7 is <missing>')")
    out = tmp_path_factory.mktemp("reports") / "wall"
    (out / "figures").mkdir(parents=True)
    (out / "figures" / "stale.png").write_bytes(b"old")
    (out / "notes.txt").write_text("mine")
    return out, report.make_report(session, out, notebooks=[good, bad])


def test_a_failing_notebook_is_told_and_the_rest_delivered(finished):
    out, (good, bad) = finished
    assert good.error == ""
    assert "ValueError" in bad.error and "board 7 is <missing>" in bad.error
    assert "\x1b" not in bad.error
    assert (out / "00_good.html").is_file() and (out / "01_bad.html").is_file()
    page = (out / "index.html").read_text()
    assert "01_bad failed" in page and "board 7 is &lt;missing&gt;" in page


def test_index_needs_no_other_file_to_be_read(finished):
    out, _ = finished
    page = (out / "index.html").read_text()
    assert re.findall(r'<img src="(.{22})', page) == ["data:image/png;base64,"]
    assert "<script" not in page and "<link" not in page


def test_index_states_what_was_found(finished, session):
    page = (finished[0] / "index.html").read_text()
    assert "A wall" in page and "Walls are flat." in page
    assert "2.0 m" in page and "Mean range" in page
    assert "found before the failure" in page, "a notebook that fails has told what it found until then"
    assert "One scan line &lt;of many&gt;." in page
    assert '<td class="number">-2.0</td>' in page and '<td class="number">–</td>' in page
    digest = report.hashlib.sha256((session / "session.json").read_bytes()).hexdigest()
    assert digest in page and np.__version__ in page


def test_tables_and_findings_are_kept_as_data(finished):
    out, _ = finished
    table = pd.read_csv(out / "tables" / "errors.csv")
    assert list(table.columns) == ["edge", "error_mm"]
    assert table.error_mm[0] == -2.0 and np.isnan(table.error_mm[1])
    found = json.loads((out / "findings.json").read_text())
    assert [(f["notebook"], f["key"], f["value"]) for f in found] == [
        ("00_good", "mean_range", 2.0),
        ("01_bad", "early", "found before the failure"),
    ]
    assert not (out / "parts").exists()


def test_only_what_a_report_wrote_is_removed(finished):
    out, _ = finished
    assert not (out / "figures" / "stale.png").exists()
    assert (out / "figures" / "ranges.png").is_file()
    assert (out / "notes.txt").read_text() == "mine"


def test_pages_of_notebooks_hide_code_and_hold_their_pictures(finished):
    page = (finished[0] / "00_good.html").read_text()
    assert "Walls are" in page and "data:image/png;base64," in page
    assert "plt.subplots" not in page
    assert 'href="index.html"' in page


def test_main_returns_what_a_shell_needs(session, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(report, "NOTEBOOKS", tmp_path)
    write_notebook(tmp_path / "00_good.ipynb", GOOD)
    assert report.main([str(session), "--out", str(tmp_path / "a"), "--jobs", "1"]) == 0
    assert "1 of 1 notebooks" in capsys.readouterr().out
    write_notebook(tmp_path / "00_good.ipynb", "1 / 0")
    assert report.main([str(session), "--out", str(tmp_path / "b")]) == 1
    assert "00_good failed: ZeroDivisionError" in capsys.readouterr().err
    assert report.main([str(tmp_path / "nowhere")]) == 2
    assert "nowhere" in capsys.readouterr().err


def test_without_any_session_it_says_how_to_get_one(tmp_path, monkeypatch):
    monkeypatch.setenv("LRFCAL_REAL_DATA", str(tmp_path))
    monkeypatch.setattr(report, "SHIPPED", tmp_path / "none")
    with pytest.raises(SessionError, match="suijingfeng/LaserSeteroCalibration @ f9a70a9.*ZED_STEREO_LASER_SWEEP"):
        report.default_session()


def test_the_shipped_session_comes_first(session, monkeypatch):
    monkeypatch.setattr(report, "SHIPPED", session)
    assert report.default_session() == session


def test_storing_keeps_outputs_of_simulations_only(session, tmp_path, monkeypatch):
    path = write_notebook(tmp_path / "00_x.ipynb", GOOD, "print(session.name)")
    assert report.store(path, session) == ""
    assert nbformat.read(path, 4).cells[2].outputs[0].text == "wall\n"
    first = path.read_bytes()
    assert report.store(path, session) == "" and path.read_bytes() == first
    index = session / "session.json"
    kept = index.read_text()
    index.write_text(kept.replace('"simulated": true', '"simulated": false'))
    try:
        assert report.store(path, session) == ""
    finally:
        index.write_text(kept)
    cells = [cell for cell in nbformat.read(path, 4).cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == [1, 2]
    assert not any(cell.outputs for cell in cells)


def test_a_notebook_that_fails_is_not_stored(tmp_path):
    path = write_notebook(tmp_path / "00_x.ipynb", "1 / 0")
    before = path.read_bytes()
    assert "ZeroDivisionError" in report.store(path, None)
    assert path.read_bytes() == before


def test_outside_a_report_run_nothing_is_written(monkeypatch, tmp_path):
    import matplotlib.pyplot as plt

    monkeypatch.delenv("LRFCAL_REPORT", raising=False)
    monkeypatch.chdir(tmp_path)
    notebook.save(plt.figure(), "empty", "Nothing.")
    html = notebook.table(pd.DataFrame({"a": [0.12345]}), "numbers", digits=2).data
    assert notebook.report_file("cloud.ply") is None
    assert list(tmp_path.iterdir()) == []
    assert ">0.12<" in html and "numbers" in html


def test_saving_leaves_what_was_placed_by_hand(monkeypatch, tmp_path, recwarn):
    import matplotlib.pyplot as plt

    monkeypatch.setenv("LRFCAL_REPORT", str(tmp_path))
    with plt.rc_context():
        notebook.set_up()
        fig = plt.figure(layout="none")
        fig.add_axes([0.1, -0.5, 0.8, 2.0])
        notebook.save(fig, "by_hand", "Axes larger than the figure.")
        fig.canvas.draw()
    assert (tmp_path / "figures" / "by_hand.png").is_file()
    assert not fig.get_layout_engine()
    assert not [warning for warning in recwarn.list if "layout" in str(warning.message)]


def test_a_table_has_the_same_bytes_every_time():
    df = pd.DataFrame({"method": ["line"], "value": [1.0], "sigma": [np.nan]}, index=[7])
    first, second = (notebook.table(df, "t", digits={"value": 1}).data for _ in range(2))
    assert first == second
    assert ">1.0<" in first and ">–<" in first and ">7<" not in first


def test_an_unknown_number_is_said_to_be_unknown(capsys):
    notebook.finding("x", np.float64("nan"), "Offset", "mm")
    notebook.finding("y", -0.0001, "Offset", "mm")
    assert capsys.readouterr().out == "Offset: unknown mm\nOffset: 0.000 mm\n"


@pytest.mark.parametrize("name", ["../x", "A b", "", "x.png"])
def test_names_become_file_names(name):
    with pytest.raises(ValueError, match="must consist of lower-case letters"):
        notebook.finding(name, 1, "text")


def test_session_path_falls_back_and_explains(monkeypatch, tmp_path):
    monkeypatch.setenv("LRFCAL_SESSION", "somewhere")
    assert str(notebook.session_path()) == "somewhere"
    monkeypatch.delenv("LRFCAL_SESSION")
    monkeypatch.setattr(notebook, "SHIPPED", tmp_path / "none")
    monkeypatch.setattr(notebook, "SCRATCH", tmp_path / "none")
    with pytest.raises(FileNotFoundError, match="make report"):
        notebook.session_path()
