"""What README.md says is so: its commands and links, its example, its numbers and its tables of keys."""

import importlib
import inspect
import json
import re
import shlex
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from notebook_runs import GOLDEN
from shared import ROOT, stages
from test_skeleton import git

from lrfcal_lib import __main__ as command_line
from lrfcal_lib.drivers import rig_file
from lrfcal_lib.drivers.lms2xx import LMS2xx
from lrfcal_lib.drivers.video import Camera
from lrfcal_lib.session import cache
from lrfcal_lib.solvers import METHODS

README, CONTRIBUTING = ((ROOT / name).read_text() for name in ("README.md", "CONTRIBUTING.md"))
WORKFLOW = (ROOT / ".github" / "workflows" / "test.yml").read_text()


def blocks(kind):
    return re.findall(rf"```{kind}\n(.*?)```", README, re.S)


def test_notebooks_methods_functions_and_files_are_all_there():
    assert [p.name for p in (ROOT / "notebooks").glob("*.ipynb") if f"(notebooks/{p.name})" not in README] == []
    assert [method for method in METHODS if f"| `{method}` |" not in README] == []
    links = re.findall(r"\]\(([^)#:]+)\)", README + CONTRIBUTING)
    files = re.findall(r"`((?:lrfcal_lib|tests|data|notebooks)/[\w/.]+)`", README + CONTRIBUTING)
    assert len(files) > 4 and [name for name in [*links, *files] if not (ROOT / name).exists()] == []
    assert "reports/readme.jpg" in links and (ROOT / "reports" / "readme.jpg").stat().st_size < 200_000
    names = re.findall(r"^\| `([a-z_.]+)\.([a-z_]+)\(", README, re.M)
    assert len(names) == 10
    for module, function in names:
        assert callable(getattr(importlib.import_module(f"lrfcal_lib.{module}"), function))


def commands():
    """Every command of README, CONTRIBUTING and the workflow, a list of words each."""
    lines = "\n".join([*blocks("sh"), re.sub(r"- run: |run: ", "", WORKFLOW)]).splitlines()
    lines += re.findall(r"`((?:make|\.venv/bin/python|python -m) [^`]+)`", README + CONTRIBUTING)
    parts = [part.strip() for line in lines for part in re.split("&&|;", line)]
    return [shlex.split(part) for part in parts if re.match(r"make |\.venv/bin/python|python -m ", part)]


def test_every_command_is_understood():
    assert len(commands()) > 14
    for words in commands():
        if words[0] == "make":
            asked = ["make", "-n", *(word for word in words[1:] if word not in ("-C", "lrfcal"))]
            done = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True)
            assert done.returncode == 0, (words, done.stderr)
        else:
            assert words[1:3] == ["-m", "lrfcal_lib"]
            known, rest = command_line.parser().parse_known_args(words[3:])
            assert not rest or known.verb == "emulate" and rest == ["sim_quick", "--rig-file", "emulated.json"]


def test_the_clone_line_gives_a_checkout_that_checks_its_session(tmp_path):
    git("rev-parse")
    line = blocks("sh")[0].splitlines()[0].replace("ADDRESS_OF_THIS_REPOSITORY", f"--quiet {shlex.quote(str(ROOT))}")
    check = next(words for words in commands() if "check" in words and "data/sim_quick" in words)
    line += f" && {shlex.join([sys.executable, *check[1:]])}"
    done = subprocess.run(["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.startswith("data/sim_quick: nothing to complain about\n"), done.stderr
    assert done.returncode == 0


def test_the_example_projects_a_scan_line_into_the_image(monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, str(stages()))
    monkeypatch.chdir(ROOT)
    exec(*blocks("python"), names := {})
    u, v = names["pixels"][np.isfinite(names["pixels"]).all(axis=1)].T
    inside = (u > 0) & (u < names["lens"].width - 1)
    assert inside.sum() > 100 and np.all((v[inside] > 0) & (v[inside] < names["lens"].height - 1))
    assert np.ptp(v[inside]) < 60 < np.ptp(u[inside]), "a scan line is nearly level"


ROWS = {
    "joint estimate (this repository)": "joint", "planes (Zhang and Pless), weighted": "zhang_pless",
    "lines, half step": "line", "lines as the paper prints them": "line_printed",
}  # fmt: skip
WORDS = {"sim_lms221": "simulated", "lms400_zed": "real"}
ERRORS = {"rotation_error_deg": "deg", "translation_error_mm": "mm"}


def golden(session, name):
    return pd.read_csv(GOLDEN / session / f"{name}.csv")


@pytest.mark.parametrize("row", ROWS)
def test_results_are_those_of_the_stored_tables(row):
    (cells,) = (line.split("|")[2:-1] for line in README.splitlines() if line.startswith(f"| {row} |"))
    worst = golden("sim_lms221", "method_comparison").groupby("method")[[*ERRORS]].max()
    stereo = golden("lms400_zed", "stereo_check").set_index("method").reindex([*ROWS.values()])[[*ERRORS]]
    found = [*worst.loc[ROWS[row]], *stereo.loc[ROWS[row]]]
    for cell, value, unit in zip(cells, found, [*ERRORS.values()] * 2, strict=True):
        number, _, stated = cell.strip().partition(" ")
        assert stated == ("" if np.isnan(value) else unit) and (number == "-") == np.isnan(value)
        assert np.isnan(value) or float(number) == pytest.approx(value, rel=0.05, abs=0.006)


def test_edge_lengths_are_those_of_the_stored_tables():
    tables = {name: golden(name, "edge_summary").set_index(["source", "variant", "ends"]) for name in WORDS}
    text, shares = " ".join(README.split()), []
    for name, words in WORDS.items():
        found = tables[name].loc[name, "combined", "image"]
        shown, count = re.search(rf"([\d.]+) mm \((\d+) edges, {words}\)", text).groups()
        assert float(shown) == pytest.approx(found.mean_abs_error_mm, abs=0.06) and int(count) == found.n
        shares.append(f"{found.within_90_percent:.0f} %")
    assert f"{' and '.join(shares)} of them within the 90 % intervals" in text
    assert f"reports {tables['sim_lms221'].loc['paper'].squeeze().mean_abs_error_mm:.2f} mm" in text


MODELS = {
    "lrf.": rig_file.LrfDevice, "head.": rig_file.HeadDevice, "cameras.NAME.": rig_file.CameraDevice,
    "plan.": rig_file.Plan, "plan.placements[].": rig_file.ListedPlacement, "": rig_file.Devices,
}  # fmt: skip


def test_every_key_of_a_rig_file_stands_there_with_its_default():
    stated = dict(re.findall(r"^\| `([\w.\[\]]+)` \| ([^|]+) \| [^|]+ \|$", README.split("Every key of")[1], re.M))
    fields = {prefix + name: field for prefix, model in MODELS.items() for name, field in model.model_fields.items()}
    fields = {name: field for name, field in fields.items() if name not in ("lrf", "head", "cameras")}
    assert stated.keys() == fields.keys()
    inner = inspect.signature(LMS2xx).parameters | inspect.signature(Camera).parameters
    for name, field in fields.items():
        if field.is_required():
            assert stated[name] == "needed", name
        elif field.default not in (None, ()):
            assert json.loads(stated[name]) == json.loads(json.dumps(field.default)), name
        elif re.match(r"[\d\[\"]|SICK", stated[name]):  # a default of the driver's own
            default = inner[name.rpartition(".")[2]].default
            assert stated[name] == (default.decode() if isinstance(default, bytes) else f"{default:g}"), name


def test_the_rig_file_shown_is_complete():
    (example,) = blocks("json")
    rig = rig_file.rig_of(json.loads(example))
    assert len(rig.plan.to_do()) == 20 and rig.devices.cameras.keys() == rig.cameras.keys() == {"left"}
