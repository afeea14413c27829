"""The code stays as easy to read as it is: nodes a line, habits that hide thoughts, sizes of files and functions."""

import ast

import pytest
from shared import ROOT
from syntax import FUNCTIONS, density

LIBRARY = sorted((ROOT / "lrfcal_lib").rglob("*.py"))
TESTS = sorted((ROOT / "tests").glob("*.py"))
MOST = {  # see CONTRIBUTING.md
    "library": {
        "nodes": 129_500,
        "median": 5,
        "densest tenth": 13,
        "parallel": 8,
        "ternary": 15,
    }
    | {"comprehensions": 45, "long": 0, "skips": 0},
    "tests": {"median": 6, "parallel": 12},
}
LONGEST_FILE = 600
LONGEST_FUNCTION = 45  # lines without the docstring
PARAMETERS = 8
LEAST_DOCUMENTED = 250  # functions whose docstring says what goes in


@pytest.mark.parametrize("what", MOST)
def test_code_is_not_packed(what):
    figures = density(LIBRARY if what == "library" else TESTS)
    too_much = {
        name: figures[name] for name, most in MOST[what].items() if figures[name] > most
    }
    assert not too_much


def functions(path):
    return [
        node
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, FUNCTIONS)
    ]


def code_lines(function):
    docstring = ast.get_docstring(function, clean=False) or ""
    return function.end_lineno - function.lineno + 1 - len(docstring.splitlines())


def parameters(function):
    given = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    return [argument for argument in given if argument.arg not in ("self", "cls")]


@pytest.mark.parametrize("path", LIBRARY, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_and_functions_are_short(path):
    assert len(path.read_text().splitlines()) <= LONGEST_FILE
    for function in functions(path):
        assert code_lines(function) <= LONGEST_FUNCTION, function.name
        assert len(parameters(function)) <= PARAMETERS, function.name


def test_what_goes_in_is_documented():
    every = [function for path in LIBRARY for function in functions(path)]
    public = [function for function in every if not function.name.startswith("_")]
    assert (
        sum("Parameters\n" in (ast.get_docstring(f) or "") for f in public)
        >= LEAST_DOCUMENTED
    )


def test_a_packed_line_is_counted(tmp_path):
    packed = tmp_path / "packed.py"
    packed.write_text(
        '"""Words do not count."""\na, b = [x for x in (1, 2)], 3 if True else 4\n'
    )
    figures = density([packed])
    assert (figures["parallel"], figures["ternary"], figures["comprehensions"]) == (
        1000,
        1000,
        1000,
    )
    assert figures["nodes"] == 17 and figures["median"] == figures["densest tenth"] > 13
