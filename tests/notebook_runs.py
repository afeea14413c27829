"""The notebooks, and how tests run them under nbval."""

import ast
import contextlib
import io
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import figure_checks
import matplotlib
import matplotlib.pyplot as plt
import nbformat
import pandas as pd
import pytest
from shared import ROOT, stages

from lrfcal_lib.report import notebook
from lrfcal_lib.report.notebook import report_file, save
from lrfcal_lib.session import cache
from lrfcal_lib.session.write import RECORDINGS

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
CELL_SECONDS = 600
LOST_AXIS = 60.0  # degrees from the truth
GOLDEN = Path(__file__).parent / "golden"
# without a grammar of internet addresses, which takes 3 s to load
NBVAL = "import sys; sys.modules['rfc3987_syntax'] = None; import pytest; sys.exit(pytest.main(sys.argv[1:]))"


def read(path):
    return nbformat.read(path, as_version=4)


def code_cells(notebook):
    return [
        cell for cell in notebook.cells if cell.cell_type == "code" and cell.source.strip()
    ]


WITH_SESSION = [
    p
    for p in NOTEBOOKS
    if any("notebook.start(" in cell.source for cell in code_cells(read(p)))
]


def solutions(path):
    """Code of the exercises' solutions, folded away in the text of a notebook."""
    texts = [cell.source for cell in read(path).cells if cell.cell_type == "markdown"]
    return [
        code
        for text in texts
        for code in re.findall(r"<details>.*?```python\n(.*?)```", text, re.S)
    ]


def run_nbval(path, report):
    """Run a notebook under nbval, which compares its outputs. Its tables go to the folder `report`."""
    command = [
        sys.executable,
        "-c",
        NBVAL,
        "-q",
        "-p",
        "nbval.plugin",
        "-p",
        "no:cacheprovider",
        "--tb=short",
    ]
    command += ["--nbval", "--nbval-current-env", f"--nbval-cell-timeout={CELL_SECONDS}"]
    command += ["--nbval-sanitize-with", "tests/nbval_sanitize.cfg", str(path)]
    environment = {
        key: value for key, value in os.environ.items() if not key.startswith("LRFCAL_")
    }
    environment |= {
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        cache.VARIABLE: str(stages()),
    }
    environment |= {
        "LRFCAL_REPORT": str(report),
        "LRFCAL_NOTEBOOK": path.stem,
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
    }
    environment[RECORDINGS] = str(report / "recordings")
    tests = Path(__file__).parent
    environment["PYTHONPATH"] = os.pathsep.join(
        [str(tests), *filter(None, [environment.get("PYTHONPATH")])]
    )
    environment["PYTHONSTARTUP"] = str(tests / "kernel_start.py")
    return subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True
    )


def run_plainly(path, session, folder, report, *, drawn=True):
    """Run the cells of a notebook on a session in this process, without a kernel; what it printed.

    After them the solutions of its exercises. Its figures, if they are
    drawn, must be legible, with titles and units. All its files but the figures are written.
    """
    complaints = []

    def without_figures(name):
        return None if name.startswith("figures/") else report_file(name)

    told, names = io.StringIO(), {"display": lambda shown: None}
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(told),
        matplotlib.rc_context(),
    ):
        variables = {
            "LRFCAL_SESSION": session,
            cache.VARIABLE: folder,
            "LRFCAL_REPORT": report,
        }
        for name, value in (variables | {"LRFCAL_NOTEBOOK": path.stem}).items():
            patch.setenv(name, str(value))
        shown = (
            figure_checks.checked(save, complaints)
            if drawn
            else lambda fig, *args, **options: plt.close(fig)
        )
        patch.setattr("lrfcal_lib.report.notebook._lacking", set())
        patch.setattr("lrfcal_lib.report.notebook.save", shown)
        patch.setattr("lrfcal_lib.report.notebook.report_file", without_figures)
        codes = {
            f"code cell {n}": cell.source for n, cell in enumerate(code_cells(read(path)))
        }
        codes |= {f"solution {n}": code for n, code in enumerate(solutions(path), start=1)}
        sections = notebook.Sections()
        for name, code in codes.items():
            tree = sections.visit(ast.parse(code))
            exec(compile(tree, f"{path.stem}, {name}", "exec"), names)
    assert not complaints, "\n".join(complaints)
    return told.getvalue()


def tables_of(path):
    """Names of the tables that a notebook may write."""
    return re.findall(
        r'notebook\.table\([^"]*, "(\w+)"',
        "\n".join(cell.source for cell in code_cells(read(path))),
    )


def comparable(table):
    """Without the axes of fits that are lost: where these end, rounding decides, which differs from machine to machine."""
    if "axis_direction_error_deg" in table:
        return table[~(table.axis_direction_error_deg > LOST_AXIS)].reset_index(drop=True)
    return table


def check_tables(report, name, path):
    """The tables that a notebook wrote for a session are those of ``tests/golden``, numbers to the sixth digit.

    That is 3e-6, or 2e-5 mm, deg or px: solvers stop within some 1e-5 of their standard deviations.
    """
    folders = (report / "tables", GOLDEN / name)
    own = tables_of(path)
    found, stored = (
        {p.name: p for p in folder.glob("*.csv") if p.stem in own} for folder in folders
    )
    if os.environ.get("STORE_GOLDEN"):  # make golden
        for file in stored.values():
            file.unlink()
        stored = {file: Path(shutil.copy(found[file], folders[1] / file)) for file in found}
    assert found.keys() == stored.keys(), (
        "make golden stores the tables of all sessions anew"
    )
    for file in sorted(stored):
        tables = (comparable(pd.read_csv(folder[file])) for folder in (found, stored))
        pd.testing.assert_frame_equal(
            *tables, check_exact=False, rtol=3e-6, atol=2e-5, obj=f"{name}/{file}"
        )
