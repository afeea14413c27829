"""Notebooks are stored as run from top to bottom, kept readable, and still run."""

import ast
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
SHIPPED = ROOT / "data" / "sim_lms221" / "session.json"
LONGEST_CELL, LONGEST_FUNCTION = 15, 10
CELL_SECONDS = 600


def read(path):
    return nbformat.read(path, as_version=4)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code" and cell.source.strip()]


def asks_for_session(path):
    return any("notebook.start(" in cell.source for cell in code_cells(read(path)))


def has_outputs(path):
    return any(cell.outputs for cell in code_cells(read(path)))


WITH_SESSION = [path for path in NOTEBOOKS if asks_for_session(path)]
WITHOUT_SESSION = [path for path in NOTEBOOKS if path not in WITH_SESSION]
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)


@each_notebook
def test_stored_as_run_from_top_to_bottom(path):
    notebook = read(path)
    nbformat.validate(notebook)
    run = [cell for cell in code_cells(notebook) if "nbval-skip" not in cell.metadata.get("tags", [])]
    assert [cell.execution_count for cell in run] == list(range(1, len(run) + 1))
    assert notebook.metadata.kernelspec.name == "python3"


@each_notebook
def test_begins_with_title_and_thesis(path):
    first = read(path).cells[0]
    assert first.cell_type == "markdown"
    assert first.source.startswith("# ")
    assert "\n> " in first.source, "the sentence after the title says what the notebook shows"
    assert "Reads:" in first.source and "Writes:" in first.source


@each_notebook
def test_cells_are_short_and_plain(path):
    for cell in code_cells(read(path)):
        lines = cell.source.strip().splitlines()
        assert len(lines) <= LONGEST_CELL, f"{len(lines)} lines: {lines[0]}"
        assert not any(line.rstrip().endswith(";") for line in lines), "nbval runs cells so that ';' hides nothing"
        for node in ast.walk(ast.parse(cell.source)):
            assert not isinstance(node, ast.ClassDef | ast.Try), f"belongs in lrfcal_lib, with a test: {lines[0]}"
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno - node.lineno < LONGEST_FUNCTION, f"{node.name} belongs in lrfcal_lib"


@each_notebook
def test_text_stands_before_code(path):
    kinds = [cell.cell_type for cell in read(path).cells]
    assert kinds.count("markdown") * 2.5 >= kinds.count("code")


@each_notebook
def test_outputs_show_no_errors_and_no_machine(path):
    for cell in code_cells(read(path)):
        for output in cell.outputs:
            assert output.output_type != "error"
            assert output.get("name") != "stderr", f"a warning is stored under: {cell.source.splitlines()[0]}"
            text = str(output.get("text", "")) + str(output.get("data", {}).get("text/plain", ""))
            assert "/home/" not in text and "/tmp/" not in text and " at 0x" not in text


@pytest.mark.skipif(SHIPPED.is_file(), reason="outputs of the shipped session are stored")
@pytest.mark.parametrize("path", WITH_SESSION, ids=lambda p: p.stem)
def test_no_output_of_a_recording_is_stored(path):
    """Recordings of other people carry no licence; outputs wait for the simulated session."""
    assert not has_outputs(path)


def run_nbval(path, session=None):
    """Run a notebook under nbval, comparing outputs where there are any and no other session is asked for."""
    strict = has_outputs(path) and session is None
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:dash", "-p", "no:cacheprovider", "--tb=short"]
    command += ["--nbval" if strict else "--nbval-lax", "--nbval-current-env", f"--nbval-cell-timeout={CELL_SECONDS}"]
    command += ["--nbval-sanitize-with", "tests/nbval_sanitize.cfg", str(path)]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("LRFCAL_")}
    environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment |= {} if session is None else {"LRFCAL_SESSION": str(session)}
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)


def check(done):
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert " passed" in done.stdout


@pytest.mark.parametrize("path", WITHOUT_SESSION, ids=lambda p: p.stem)
def test_runs_alone(path):
    check(run_nbval(path))


@pytest.fixture(scope="module")
def runs_on_the_recording(lms400_session):
    """All notebooks on the imported recording, two at a time; results as futures by path."""
    with ThreadPoolExecutor(max_workers=2) as pool:
        # later notebooks take longer, so they start first
        yield {path: pool.submit(run_nbval, path, lms400_session) for path in reversed(WITH_SESSION)}


@pytest.mark.parametrize("path", WITH_SESSION, ids=lambda p: p.stem)
def test_runs_on_the_recording(path, runs_on_the_recording):
    check(runs_on_the_recording[path].result())


@pytest.mark.skipif(not SHIPPED.is_file(), reason="no simulated session ships yet")
@pytest.mark.parametrize("path", WITH_SESSION, ids=lambda p: p.stem)
def test_stored_outputs_are_those_of_the_shipped_session(path):
    assert has_outputs(path)
    check(run_nbval(path))


def test_falsified_output_is_caught(tmp_path):
    """The strict comparison really compares: without it the guards above would mean little."""
    path = tmp_path / "x.ipynb"
    cell = nbformat.v4.new_code_cell("print(1 + 1)", execution_count=1)
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    for text, code in (("2\n", 0), ("3\n", 1)):
        cell.outputs = [nbformat.v4.new_output("stream", name="stdout", text=text)]
        nbformat.write(nbformat.v4.new_notebook(cells=[cell], metadata={"kernelspec": kernel}), path)
        assert run_nbval(path).returncode == code
