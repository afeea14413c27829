"""Imports go one way, and the light half of the library stays light."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

LIBRARY = Path(__file__).resolve().parents[1] / "lrfcal_lib"
# a module may import from its own rank and below
RANKS = [
    {"geometry", "board", "features", "codecs", "cache"},
    {"camera"},
    {"session"},
    {"preprocess", "importers"},
    {"solvers"},
    {"uncertainty", "candidates", "forecast", "advice", "residuals"},
    {"reconstruct", "prepared"},
    {"pairing"},
    {"joint_pairing"},
    {"joint_calibration"},
    {"fused_outline"},
    {"pipeline"},
    {"evaluate"},
    {"verdict"},
    {"notebook", "plots", "export", "report", "acquisition", "panel", "drivers", "emulators"},  # see APART
    {"__main__"},
]
RANK = {name: rank for rank, names in enumerate(RANKS) for name in names}
# what knows the geometry of a rig and its session only, so that it can judge or feed the rest
APART = dict.fromkeys(("simulate", "drivers"), {"geometry", "board", "camera", "session", "codecs"})
# emulated devices stand between the two: they look at the simulated world and speak as the drivers expect
APART["emulators"] = APART["drivers"] | {"simulate", "drivers"}
CODECS = {"lms2xx", "lms2xx_frame", "lms2xx_replies"}
MODULES = sorted(LIBRARY.rglob("*.py"))


def part_of(names):
    """First name below the library; of the drivers, codecs (sessions are read with them) count apart."""
    return "codecs" if names[0] == "drivers" and CODECS.intersection(names[1:2]) else names[0]


def imported_parts(path):
    """First name after ``lrfcal_lib`` of everything a file imports from the library."""
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports relatively: the direction could not be seen"
            deeper = node.module == "lrfcal_lib"
            names += [f"lrfcal_lib.{alias.name}" for alias in node.names] if deeper else [node.module]
    parts = [part_of(name.split(".")[1:]) for name in names if name.startswith("lrfcal_lib.")]
    return [part for part in parts if part != "__version__"]


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(LIBRARY)))
def test_imports_point_down(path):
    part = part_of(path.relative_to(LIBRARY).with_suffix("").parts)
    imported = set(imported_parts(path)) - {part}
    if part == "__init__":
        assert not imported
    elif part in APART:
        assert imported <= APART[part]
    elif part != "__main__":
        assert part in RANK, f"{part} has no place in RANKS yet"
        assert not {other for other in imported if RANK.get(other, len(RANKS)) > RANK[part]}


def test_the_walk_sees_imports(tmp_path):
    source = tmp_path / "x.py"
    source.write_text("def f():\n    from lrfcal_lib import plots\n    import lrfcal_lib.solvers.camera\n")
    assert imported_parts(source) == ["plots", "solvers"]


def test_solvers_and_preprocessing_need_no_heavy_library():
    code = """
import importlib, pkgutil, sys
import lrfcal_lib
for name in ("geometry", "board", "camera", "session", "preprocess", "solvers"):
    module = importlib.import_module("lrfcal_lib." + name)
    for found in pkgutil.walk_packages(getattr(module, "__path__", []), module.__name__ + "."):
        importlib.import_module(found.name)
print(*sorted({"open3d", "pandas", "matplotlib", "serial", "IPython"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == ""


def test_importing_the_package_loads_nothing():
    code = "import sys, lrfcal_lib; print('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"
