"""Notebooks are stored as run from top to bottom, kept readable, and still run."""

import ast
import re
import shutil
import subprocess
import sys

import nbformat
import pytest
from notebook_runs import NOTEBOOKS, check_tables, code_cells, read, run_nbval
from shared import ROOT

LONGEST_FUNCTION = 11  # lines
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)


@each_notebook
def test_stored_as_run_from_top_to_bottom_without_errors_and_traces_of_the_machine(path):
    notebook = read(path)
    nbformat.validate(notebook)
    assert len({cell.id for cell in notebook.cells}) == len(notebook.cells)
    run = [
        cell
        for cell in code_cells(notebook)
        if "nbval-skip" not in cell.metadata.get("tags", [])
    ]
    assert [cell.execution_count for cell in run] == list(range(1, len(run) + 1))
    assert notebook.metadata.kernelspec.name == "python3"
    for cell in code_cells(notebook):
        shows = any("image/png" in output.get("data", {}) for output in cell.outputs)
        assert "notebook.save(" in cell.source or not shows, (
            f"no figure is shown before it is complete: {cell.source}"
        )
        for output in cell.outputs:
            assert output.output_type != "error"
            assert output.get("name") != "stderr", (
                f"a warning is stored under: {cell.source.splitlines()[0]}"
            )
            text = str(output.get("text", "")) + str(
                output.get("data", {}).get("text/plain", "")
            )
            assert "/home/" not in text and "/tmp/" not in text and " at 0x" not in text


@each_notebook
def test_text_begins_with_title_and_thesis_and_stands_before_code(path):
    notebook = read(path)
    formulas = []
    first = notebook.cells[0]
    kinds = [cell.cell_type for cell in notebook.cells]
    assert first.cell_type == "markdown" and first.source.startswith("# ")
    assert "\n> " in first.source, (
        "the sentence after the title says what the notebook shows"
    )
    assert "Reads:" in first.source and "Writes:" in first.source
    assert kinds.count("markdown") * 2.5 >= kinds.count("code")
    for cell in notebook.cells:
        formulas += (
            re.findall(r"\$[^$\n]+\$", cell.source) if cell.cell_type == "markdown" else []
        )
    assert not [f for f in formulas if re.search(r"\\\\[A-Za-z]", f)], (
        "a doubled backslash shows as text"
    )


@each_notebook
def test_cells_are_short_and_plain(path):
    for cell in code_cells(read(path)):
        lines = [line for line in cell.source.splitlines() if line]
        lines = [line for line in lines if not line.startswith(("import ", "from "))]
        assert len(lines) <= (12 if path.stem < "06" else 15), (
            f"{len(lines)} lines: {lines[0]}"
        )  # 00 to 05: a lecture
        assert not any(line.rstrip().endswith(";") for line in lines), (
            "nbval runs cells so that ';' hides nothing"
        )
        for node in ast.walk(ast.parse(cell.source)):
            assert not isinstance(node, ast.ClassDef | ast.Try), (
                f"belongs in lrfcal_lib, with a test: {lines[0]}"
            )
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno - node.lineno < LONGEST_FUNCTION, (
                    f"{node.name} belongs in lrfcal_lib"
                )


@each_notebook
def test_stored_outputs_and_golden_tables_are_those_of_the_shipped_session(path, tmp_path):
    done = run_nbval(path, tmp_path)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert " passed" in done.stdout and any(cell.outputs for cell in code_cells(read(path)))
    check_tables(tmp_path, "sim_lms221", path)


def write_notebook(path, source, printed):
    """A notebook of one cell, stored with what it is said to have printed."""
    cell = nbformat.v4.new_code_cell(source, execution_count=1)
    cell.outputs = [nbformat.v4.new_output("stream", name="stdout", text=printed)]
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    nbformat.write(
        nbformat.v4.new_notebook(cells=[cell], metadata={"kernelspec": kernel}), path
    )


def test_falsified_output_is_caught(tmp_path):
    """The strict comparison really compares: without it the guards above would mean little."""
    write_notebook(tmp_path / "x.ipynb", "print(1 + 1)", "3\n")
    done = run_nbval(tmp_path / "x.ipynb", tmp_path)
    assert done.returncode == 1 and "1 failed" in done.stdout


def test_what_everyone_types_compares_strictly_and_knows_the_sanitiser(tmp_path):
    """``pytest --nbval notebooks/``, without an option; the notebooks themselves are compared above."""
    folder = tmp_path / "notebooks"
    folder.mkdir()
    for file in ("notebooks/conftest.py", "tests/nbval_sanitize.cfg", "pyproject.toml"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / file, tmp_path / file)
    write_notebook(
        folder / "right.ipynb", "print(object())", "<object object at 0x7f0123456789>\n"
    )
    write_notebook(folder / "falsified.ipynb", "print(1 + 1)", "3\n")
    command = [sys.executable, "-m", "pytest", "--nbval", "notebooks/"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1 and "1 failed, 1 passed" in done.stdout, (
        done.stdout + done.stderr
    )
    assert "falsified.ipynb" in done.stdout.split("short test summary")[1]
