"""The notebooks, and how tests run them under nbval."""

import contextlib
import io
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import matplotlib
import nbformat
import pandas as pd
import pytest
from shared import stages

from lrfcal_lib.session import cache

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
CELL_SECONDS = 600
GOLDEN = Path(__file__).parent / "golden"


def read(path):
    return nbformat.read(path, as_version=4)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code" and cell.source.strip()]


def asks_for_session(path):
    return any("notebook.start(" in cell.source for cell in code_cells(read(path)))


def solutions(path):
    """Code of the exercises' solutions, folded away in the text of a notebook."""
    texts = [cell.source for cell in read(path).cells if cell.cell_type == "markdown"]
    return [code for text in texts for code in re.findall(r"<details>.*?```python\n(.*?)```", text, re.S)]


def has_outputs(path):
    return any(cell.outputs for cell in code_cells(read(path)))


WITH_SESSION = [path for path in NOTEBOOKS if asks_for_session(path)]
WITHOUT_SESSION = [path for path in NOTEBOOKS if path not in WITH_SESSION]


def run_nbval(path, session=None, report=None):
    """Run a notebook under nbval, comparing outputs where there are any and no other session is asked for.

    Its tables go to the folder `report`.
    """
    strict = has_outputs(path) and session is None
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:dash", "-p", "no:cacheprovider", "--tb=short"]
    command += ["--nbval" if strict else "--nbval-lax", "--nbval-current-env", f"--nbval-cell-timeout={CELL_SECONDS}"]
    command += ["--nbval-sanitize-with", "tests/nbval_sanitize.cfg", str(path)]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("LRFCAL_")}
    environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", cache.VARIABLE: str(stages())}
    environment |= {} if session is None else {"LRFCAL_SESSION": str(session)}
    environment |= {} if report is None else {"LRFCAL_REPORT": str(report), "LRFCAL_NOTEBOOK": path.stem}
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)


def run_plainly(path, session, folder, report=None):
    """Run the cells of a notebook on a session in this process, without a kernel; what it printed.

    After them the solutions of its exercises.
    """
    told, names = io.StringIO(), {"display": lambda shown: None}
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(told), matplotlib.rc_context():
        patch.setenv("LRFCAL_SESSION", str(session))
        patch.setenv(cache.VARIABLE, str(folder))
        if report is not None:
            patch.setenv("LRFCAL_REPORT", str(report))
            patch.setenv("LRFCAL_NOTEBOOK", path.stem)
        for number, cell in enumerate(code_cells(read(path))):
            exec(compile(cell.source, f"{path.stem}, code cell {number}", "exec"), names)
        for number, code in enumerate(solutions(path), start=1):
            exec(compile(code, f"{path.stem}, solution {number}", "exec"), names)
    return told.getvalue()


def check(done):
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert " passed" in done.stdout


def check_tables(report, name):
    """The tables that notebooks wrote for a session are those of ``tests/golden``: words, and numbers within 1e-6.

    Relative, or of a millimetre, degree or pixel: an error is a small difference of large numbers.
    """
    if os.environ.get("STORE_GOLDEN"):  # make golden
        shutil.rmtree(GOLDEN / name, ignore_errors=True)
        shutil.copytree(report / "tables", GOLDEN / name)
    found, stored = ({p.name: p for p in folder.glob("*.csv")} for folder in (report / "tables", GOLDEN / name))
    assert found.keys() == stored.keys(), "make golden stores the tables of all sessions anew"
    for file in sorted(stored):
        tables = (pd.read_csv(folder[file]) for folder in (found, stored))
        pd.testing.assert_frame_equal(*tables, check_exact=False, rtol=1e-6, atol=1e-6, obj=f"{name}/{file}")
