"""Imports go one way: folders stand on floors, and the light half of the library stays light."""

import ast
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from syntax import count_nodes

LIBRARY = Path(__file__).resolve().parents[1] / "lrfcal_lib"
# a folder imports from the floors below it, never from another folder on its own floor; the commands stand on the roof
FLOORS = [
    {"model"},
    {"fit", "session", "plots"},
    {"preprocess", "solvers", "drivers", "simulate"},
    {"calibrate", "emulators"},
    {"judge"},
    {"evaluate", "measure"},
    {"acquire", "report"},
]
FLOOR = {name: floor for floor, names in enumerate(FLOORS) for name in names} | {
    "__main__": len(FLOORS),
    "api": len(FLOORS),
}
MODULES = sorted(LIBRARY.rglob("*.py"))


def name_of(path):
    parts = path.relative_to(LIBRARY.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


NAMES = {name_of(path) for path in MODULES}


def imported(path, *, lazily=True):
    """Modules of the library that a file imports; without those that functions import when they are called."""
    tree = ast.parse(path.read_text())
    found = set()
    for node in ast.walk(tree) if lazily else tree.body:
        if isinstance(node, ast.Import):
            found |= {
                alias.name for alias in node.names if alias.name.startswith("lrfcal_lib")
            }
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, (
                f"{path.name} imports relatively: the direction could not be seen"
            )
            longer = {f"{node.module}.{alias.name}" for alias in node.names} & NAMES
            found |= longer or ({node.module} if node.module in NAMES else set())
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(LIBRARY)))
def test_imports_point_down(path):
    part = path.relative_to(LIBRARY).with_suffix("").parts[0]
    others = {name.split(".")[1] for name in imported(path) if "." in name} - {part}
    assert part == "__init__" and not others or part in FLOOR, (
        f"{part} stands on no floor yet"
    )
    assert not {other for other in others if FLOOR[other] >= FLOOR[part]}


def test_no_circle_among_modules():
    graph = {
        name_of(path): imported(path, lazily=False) - {name_of(path)} for path in MODULES
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"modules import each other in a circle: {' <- '.join(error.args[1])}")


WALK = """
import importlib, pkgutil, lrfcal_lib
for name in ("model", "fit", "session", "preprocess", "solvers"):
    module = importlib.import_module("lrfcal_lib." + name)
    for found in pkgutil.walk_packages(getattr(module, "__path__", []), module.__name__ + "."):
        importlib.import_module(found.name)
"""
LIGHT = {  # code, what it must not load
    "solvers and preprocessing": (
        WALK,
        {"open3d", "pandas", "matplotlib", "serial", "IPython", "scipy.stats"},
    ),
    "the package": ("import lrfcal_lib", {"numpy"}),
    "help": ("from lrfcal_lib.__main__ import parser; parser()", {"numpy"}),
}


@pytest.mark.parametrize("what", LIGHT)
def test_no_heavy_library_is_loaded_by(what):
    code, heavy = LIGHT[what]
    shown = f"{code}\nimport sys\nprint(*{heavy} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", shown], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr


# Parts that can be had alone: what they load, and how much of the library that is at most.
CAMERA = """
import numpy as np
from lrfcal_lib.model.board import triangle_board
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.observations import CameraObservations
from lrfcal_lib.solvers import METHODS, best_method, solve_camera
from lrfcal_lib.solvers.platform import solve_platform
"""
ALONE = {  # code; modules and nodes at most; what it must not load
    "one camera and the platform from arrays": (
        CAMERA, 20, 30_000,
        ("session", "preprocess", "calibrate", "judge", "evaluate", "solvers.joint", "solvers.pitch"),
    ),
    "platform and cameras": (
        "import lrfcal_lib.calibrate.cameras", 20, 30_000,
        ("session", "preprocess", "judge", "evaluate", "solvers.joint", "solvers.pitch", "calibrate.reconstruct"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", ALONE)
def test_a_part_can_be_had_alone(what):
    code, modules, nodes, others = ALONE[what]
    shown = f"{code}\nimport sys\nprint(*(name for name in sys.modules if name.split('.')[0] == 'lrfcal_lib'))"
    done = subprocess.run([sys.executable, "-c", shown], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    loaded = {path for path in MODULES if name_of(path) in done.stdout.split()}
    loaded = {
        path for path in loaded if count_nodes(path) > 1
    }  # a folder's __init__ may hold its docstring only
    names = {name_of(path) for path in loaded}
    assert not {
        name for name in names if name.removeprefix("lrfcal_lib.").startswith(others)
    }
    assert len(loaded) <= modules, sorted(names)
    assert sum(map(count_nodes, loaded)) <= nodes
