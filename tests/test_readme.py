"""What README.md says is so: its commands and links, its example, its numbers and its tables of keys."""

import importlib
import inspect
import json
import re
import shlex
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from notebook_runs import GOLDEN
from shared import ROOT, stages
from test_skeleton import git

from lrfcal_lib import __main__ as command_line
from lrfcal_lib.calibrate.calibration_file import rig_record
from lrfcal_lib.drivers import rig_file
from lrfcal_lib.drivers.lms2xx import LMS2xx
from lrfcal_lib.drivers.video import Camera
from lrfcal_lib.evaluate.export import write_calibration
from lrfcal_lib.model.camera import project
from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points
from lrfcal_lib.model.kinematics import Corrections
from lrfcal_lib.session import cache
from lrfcal_lib.session.read import open_session, validate
from lrfcal_lib.solvers import METHODS

README = (ROOT / "README.md").read_text()
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text()
METHODS_PAGE = (ROOT / "notebooks" / "METHODS.md").read_text()
RIG_PAGE = (ROOT / "notebooks" / "RIG_FILE.md").read_text()
RESULTS_PAGE = (ROOT / "notebooks" / "RESULTS.md").read_text()
FILE_PAGE = (ROOT / "notebooks" / "CALIBRATION_FILE.md").read_text()
STUDIES_PAGE = (ROOT / "notebooks" / "STUDIES.md").read_text()
SENSORS_PAGE = (ROOT / "notebooks" / "OTHER_SENSORS.md").read_text()
WORKFLOW = (ROOT / ".github" / "workflows" / "test.yml").read_text()


def test_a_visitor_reads_it_in_one_go():
    assert len(README.splitlines()) <= 130


def blocks(kind, page=README):
    return re.findall(rf"```{kind}\n(.*?)```", page, re.S)


def test_notebooks_methods_functions_and_files_are_all_there():
    assert [
        p.name
        for p in (ROOT / "notebooks").glob("*.ipynb")
        if f"(notebooks/{p.name})" not in README
    ] == []
    assert [method for method in METHODS if f"| `{method}` |" not in METHODS_PAGE] == []
    links = re.findall(r"\]\(([^)#:]+)\)", README + CONTRIBUTING)
    pages = "".join(
        [
            README,
            CONTRIBUTING,
            METHODS_PAGE,
            RIG_PAGE,
            RESULTS_PAGE,
            SENSORS_PAGE,
            STUDIES_PAGE,
        ]
    )
    files = re.findall(r"`((?:lrfcal_lib|tests|data|notebooks)/[\w/.]+)`", pages)
    assert (
        len(files) > 4
        and [name for name in [*links, *files] if not (ROOT / name).exists()] == []
    )
    assert (
        "reports/readme.jpg" in links
        and (ROOT / "reports" / "readme.jpg").stat().st_size < 200_000
    )
    names = re.findall(r"^\| `([a-z_.]+)\.([a-z_]+)\(", METHODS_PAGE, re.M)
    assert len(names) == 10
    for module, function in names:
        assert callable(getattr(importlib.import_module(f"lrfcal_lib.{module}"), function))


def commands():
    """Every command of README, CONTRIBUTING and the workflow, a list of words each."""
    lines = "\n".join(
        [
            *blocks("sh"),
            *blocks("sh", SENSORS_PAGE),
            *blocks("sh", STUDIES_PAGE),
            re.sub(r"- run: |run: ", "", WORKFLOW),
        ]
    ).splitlines()
    lines += re.findall(
        r"`((?:make|\.venv/bin/python|python -m) [^`]+)`", README + CONTRIBUTING
    )
    parts = [part.strip() for line in lines for part in re.split("&&|;", line)]
    return [
        shlex.split(part)
        for part in parts
        if re.match(r"make |\.venv/bin/python|python -m ", part)
    ]


def test_every_command_is_understood():
    assert len(commands()) > 14
    for words in commands():
        if words[0] == "make":
            asked = [
                "make",
                "-n",
                *(word for word in words[1:] if word not in ("-C", "lrfcal")),
            ]
            done = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True)
            assert done.returncode == 0, (words, done.stderr)
        else:
            assert words[1:3] == ["-m", "lrfcal_lib"]
            command_line.parser().parse_args(words[3:])  # exits where it is not


def test_the_clone_line_gives_a_checkout_that_checks_its_session(tmp_path):
    git("rev-parse")
    line = (
        blocks("sh")[0]
        .splitlines()[0]
        .replace("ADDRESS_OF_THIS_REPOSITORY", f"--quiet {shlex.quote(str(ROOT))}")
    )
    check = next(
        words for words in commands() if "check" in words and "data/sim_quick" in words
    )
    line += f" && {shlex.join([sys.executable, *check[1:]])}"
    done = subprocess.run(
        ["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.stdout.startswith("data/sim_quick: nothing to complain about\n"), (
        done.stderr
    )
    assert done.returncode == 0


def test_the_example_projects_a_scan_line_into_the_image(monkeypatch, capsys):
    monkeypatch.setenv(cache.VARIABLE, str(stages()))
    monkeypatch.chdir(ROOT)
    exec(*blocks("python"), names := {})
    shown = blocks("python")[0].splitlines()[-1]
    assert shown == "# " + capsys.readouterr().out.strip(), "the output is what it prints"
    u, v = names["pixels"][np.isfinite(names["pixels"]).all(axis=1)].T
    inside = (u > 0) & (u < names["lens"].width - 1)
    assert inside.sum() > 100 and np.all(
        (v[inside] > 0) & (v[inside] < names["lens"].height - 1)
    )
    assert np.ptp(v[inside]) < 60 < np.ptp(u[inside]), "a scan line is nearly level"


def test_a_session_of_another_sensor_is_written_as_the_page_says(tmp_path, monkeypatch):
    given = open_session(ROOT / "data" / "sim_quick")

    def my_sweep(placement):
        sweep = given.sweep(placement)
        return sweep.ranges, sweep.bearings, sweep.pitch

    def my_images(placement):
        records = given.images("left", placement=placement)
        return [(given.read_image(record), record.pitch) for record in records]

    monkeypatch.chdir(tmp_path)
    exec(*blocks("python", SENSORS_PAGE), {"my_sweep": my_sweep, "my_images": my_images})
    written = open_session(tmp_path / "my_session")
    assert (
        written.board_placements == (1, 2, 3, 4) and validate(tmp_path / "my_session") == []
    )
    assert len(written.images("left")) == sum(len(my_images(p)) for p in (1, 2, 3, 4))
    np.testing.assert_array_equal(written.sweep(3).ranges, given.sweep(3).ranges)


@pytest.mark.parametrize("mount", ["head", "platform"])
def test_twenty_lines_project_a_scan_from_the_file_alone(
    quick, tmp_path, monkeypatch, mount
):
    """The same pixels as ours, for errors of range and pitch that would show."""
    rig = quick.rig("joint")
    left = replace(rig.cameras["left"], mount=mount)
    if mount == "platform":
        left = replace(left, T_camera=left.T_camera * rig.T_head_lrf.inv())
    rig = replace(rig, corrections=Corrections(0.05, 0.03), cameras={"left": left})
    write_calibration(tmp_path / "calibration.json", rig_record(rig))
    monkeypatch.chdir(tmp_path)
    bearings = np.radians(np.linspace(60, 120, 50))
    ranges = np.linspace(1.0, 3.0, 50)
    names = {"bearings": bearings, "ranges": ranges, "pitch_of_scan": 0.1}
    names["pitch_of_image"] = -0.05
    code = blocks("python", FILE_PAGE)[0]
    exec(code, names)
    assert (
        len([line for line in code.splitlines() if line.strip()]) <= 23
    )  # imports are three
    p_lrf = rig.corrections.points(polar_to_points(ranges, bearings))
    p_platform = lrf_to_platform(p_lrf, rig.corrections.pitch(1, 0.1), rig.T_head_lrf)
    T_camera = rig.camera_at("left", float(rig.corrections.pitch(1, -0.05)))
    ours = project(T_camera.apply(p_platform), left.model)
    np.testing.assert_allclose(names["pixels"][:, 0], ours, atol=1e-6)
    assert np.isfinite(ours).all()


def golden(session, name):
    return pd.read_csv(GOLDEN / session / f"{name}.csv")


def cells(row):
    """The cells of a row of a table of README or the page of results, without its first."""
    lines = (README + RESULTS_PAGE).splitlines()
    (line,) = (line for line in lines if line.startswith(f"| {row} |"))
    return [cell.strip() for cell in line.split("|")[2:-1]]


def printed(value, as_printed):
    """A number with as many decimals as the text prints."""
    return f"{value:.{len(as_printed.partition('.')[2])}f}"


def test_a_number_is_compared_to_its_printed_digit():
    assert (
        printed(0.0449, "0.04") == "0.04"
        and printed(0.0451, "0.04") == "0.05"
        and printed(12.5, "13") == "12"
    )


ROWS = {
    "joint estimate (this repository)": "joint",
    "planes (Zhang and Pless), weighted": "zhang_pless",
    "lines, half step": "line",
    "lines as the paper prints them": "line_printed",
}


@pytest.mark.parametrize("row", ROWS)
def test_errors_of_methods_are_those_of_the_stored_tables(row):
    errors = ["rotation_error_deg", "translation_error_mm"]
    worst = (
        golden("sim_lms221", "method_comparison")
        .groupby("method")[errors]
        .max()
        .loc[ROWS[row]]
    )
    for cell, value, unit in zip(cells(row), worst, ["deg", "mm"], strict=True):
        number, stated = cell.split(" ")
        assert (number, stated) == (printed(value, number), unit)


def test_random_halves_are_those_of_the_stored_tables():
    halves = golden("lms400_zed", "random_halves")
    text = " ".join(README.split())
    names = [
        "rotation_deg",
        "translation_mm",
        "predicted_rotation_deg",
        "predicted_translation_mm",
    ]
    found = re.search(
        r"differ by ([\d.]+) deg and ([\d.]+) mm .* (\d+) pairs .* predicts ([\d.]+) deg and ([\d.]+) mm",
        text,
    ).groups()
    numbers = [*found[:2], *found[3:]]
    assert numbers == [
        printed(np.sqrt(np.mean(halves[n] ** 2)), k)
        for n, k in zip(names, numbers, strict=True)
    ]
    assert int(found[2]) == halves.pair.nunique()


def edge_errors(session, variant, ends=None):
    """Absolute errors of the board's edges, by placement and edge."""
    table = golden(session, "edge_lengths").query(
        "source == @session and variant == @variant"
    )
    table = table[(table.ends == ends) if ends else table.error_mm.notna()]
    return table.set_index(["placement", "edge"]).error_mm.abs()


def test_edge_lengths_are_those_of_the_stored_tables():
    for column, session in enumerate(["sim_lms221", "lms400_zed"]):
        last_beam = edge_errors(session, "last_beam", "scan")
        combined = edge_errors(session, "combined")
        rows = {
            "like the paper: last beams of scan lines": last_beam,
            "the same edges, half a step further out": edge_errors(
                session, "half_step", "scan"
            )[last_beam.index],
            "the same edges, by the cloud's plane and the images (`combined`)": combined[
                last_beam.index
            ],
            "all edges, `combined`": combined,
        }
        for row, errors in rows.items():
            number, count = re.fullmatch(
                r"([\d.]+) mm(?: \((\d+) edges\))?", cells(row)[column]
            ).groups()
            assert number == printed(errors.mean(), number), (session, row)
            assert count is None or int(count) == len(errors) == errors.notna().sum()


def test_shares_within_intervals_and_the_papers_figure_are_those_of_the_stored_tables():
    summary = {
        s: golden(s, "edge_summary").set_index(["source", "variant", "ends"])
        for s in ("sim_lms221", "lms400_zed")
    }
    shares = re.search(r"(\d+) % \(simulated\) and (\d+) % \(real\)", RESULTS_PAGE).groups()
    within = [
        table.loc[name, "combined", "image"].within_90_percent
        for name, table in summary.items()
    ]
    assert [*shares] == [f"{share:.0f}" for share in within]
    assert (
        f"error of {summary['sim_lms221'].loc['paper'].squeeze().mean_abs_error_mm:.2f} mm"
        in RESULTS_PAGE
    )


MODELS = {
    "lrf.": rig_file.LrfDevice, "head.": rig_file.HeadDevice, "cameras.NAME.": rig_file.CameraDevice,
    "plan.": rig_file.Plan, "plan.placements[].": rig_file.ListedPlacement, "": rig_file.Devices,
}  # fmt: skip


def test_every_key_of_a_rig_file_stands_there_with_its_default():
    stated = dict(re.findall(r"^\| `([\w.\[\]]+)` \| ([^|]+) \| [^|]+ \|$", RIG_PAGE, re.M))
    fields = {
        prefix + name: field
        for prefix, model in MODELS.items()
        for name, field in model.model_fields.items()
    }
    fields = {
        name: field
        for name, field in fields.items()
        if name not in ("lrf", "head", "cameras")
    }
    assert stated.keys() == fields.keys()
    inner = inspect.signature(LMS2xx).parameters | inspect.signature(Camera).parameters
    for name, field in fields.items():
        if field.is_required():
            assert stated[name] == "needed", name
        elif field.default not in (None, ()):
            assert json.loads(stated[name]) == json.loads(json.dumps(field.default)), name
        elif re.match(r"[\d\[\"]|SICK", stated[name]):  # a default of the driver's own
            default = inner[name.rpartition(".")[2]].default
            assert stated[name] == (
                default.decode() if isinstance(default, bytes) else f"{default:g}"
            ), name


def test_the_rig_file_shown_is_complete():
    (example,) = blocks("json", RIG_PAGE)
    rig = rig_file.rig_of(json.loads(example))
    assert len(
        rig.plan.to_do()
    ) == 20 and rig.devices.cameras.keys() == rig.cameras.keys() == {"left"}
