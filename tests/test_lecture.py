"""The notebooks as a lecture: every equation of the paper once; that exercises run is seen in test_golden.py."""

import re

import pandas as pd
import pytest
from notebook_runs import GOLDEN, NOTEBOOKS, read, run_plainly
from shared import ROOT, campaign, stages

LECTURE = [
    path for path in NOTEBOOKS if path.stem[:2] in ("00", "01", "02", "03", "04", "05")
]


def texts(path):
    return [cell.source for cell in read(path).cells if cell.cell_type == "markdown"]


def test_every_equation_of_the_paper_stands_once():
    tags = [
        int(n)
        for path in LECTURE
        for text in texts(path)
        for n in re.findall(r"\\tag\{(\d+)\}", text)
    ]
    assert sorted(tags) == list(range(1, 22))


def stored(name):
    return pd.read_csv(GOLDEN / "sim_lms221" / f"{name}.csv")


def test_lines_leave_less_of_a_large_workspace_than_planes():
    shares = stored("feature_shares").set_index("workspace_radius_m").round(1)
    expected = {
        3: (58.6, 42.6),
        4: (35.0, 34.4),
        5: (23.0, 28.4),
        6: (16.2, 24.1),
        10: (5.9, 14.8),
    }
    assert {
        radius: (row.line_percent, row.plane_percent) for radius, row in shares.iterrows()
    } == expected


def test_the_cost_as_printed_is_not_normalised_and_true_edges_give_the_true_axis():
    choices = stored("axis_choices").set_index("cost")
    printed = choices.loc["as printed"]
    assert (
        round(printed.axis_direction_error_deg, 1) == 7.1
        and round(printed.axis_offset_error_mm) == 39
    )
    assert choices.loc["(13) normalised"].axis_offset_error_mm > 90
    assert (
        choices.loc["and on the true edges"].max() < 50
        and choices.loc["and on the true edges"][1:].max() < 1e-6
    )


def test_only_the_joint_estimate_states_its_errors_rightly():
    pulls = stored("method_comparison").groupby("method").translation_pull.max()
    assert (
        pulls["joint"] < 1
        and pulls[["line", "line_last_beam", "zhang_pless_printed"]].min() > 3
    )


def outputs(path):
    """What the solutions of a notebook's exercises are said to print."""
    said = [part for text in texts(path) for part in re.findall(r"Output: (.*)", text)]
    return [output for part in said for output in re.findall(r"`([^`]+)`", part)]


SHOWN = [path for path in LECTURE if outputs(path)]


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=campaign if path.stem[:2] == "03" else ())
        for path in SHOWN
    ],
)
def test_solutions_print_what_is_said(path, tmp_path):
    printed = run_plainly(
        path, ROOT / "data" / "sim_lms221", stages(), tmp_path, drawn=False
    )
    missing = [output for output in outputs(path) if output not in printed]
    assert len(outputs(path)) >= 2 and not missing
