"""The notebooks as a lecture: every equation of the paper once, short cells, exercises whose solutions run."""

import ast
import re

import pytest
from notebook_runs import NOTEBOOKS, read, solutions

LECTURE = [path for path in NOTEBOOKS if path.stem[:2] in ("00", "01", "02", "03", "04", "05")]
WITH_EXERCISES = [path for path in NOTEBOOKS if path.stem[:2] in ("02", "03", "04", "05", "06")]


def texts(path):
    return [cell.source for cell in read(path).cells if cell.cell_type == "markdown"]


def test_every_equation_of_the_paper_stands_once():
    tags = [int(n) for path in LECTURE for text in texts(path) for n in re.findall(r"\\tag\{(\d+)\}", text)]
    assert sorted(tags) == list(range(1, 22))


@pytest.mark.parametrize("path", LECTURE, ids=lambda p: p.stem)
def test_equations_stand_before_code_that_checks_them(path):
    """After the last equation of a text, some code asserts that it agrees with the library."""
    cells = read(path).cells
    numbered = [i for i, cell in enumerate(cells) if cell.cell_type == "markdown" and r"\tag{" in cell.source]
    for first in numbered:
        following = [cell.source for cell in cells[first + 1 :] if cell.cell_type == "code"][:12]
        assert any("assert np." in source for source in following), cells[first].source.splitlines()[0]


@pytest.mark.parametrize("path", WITH_EXERCISES, ids=lambda p: p.stem)
def test_exercises_are_folded_and_their_solutions_are_code(path):
    """That they run is shown where the notebooks run on a small session (test_golden.py)."""
    folded = [text for text in texts(path) if "<details>" in text]
    assert folded and all(text.count("<details>") == text.count("</details>") for text in folded)
    assert 2 <= len(solutions(path)) <= 3
    for code in solutions(path):
        ast.parse(code)
