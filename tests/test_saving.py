"""Running the notebook that records leaves its file as it is; JupyterLab of `make lab` saves all others as always."""

import asyncio
import copy
import json
import shutil
import subprocess

import nbformat
import pytest
from shared import ROOT
from traitlets.utils.importstring import import_item

from lrfcal_lib.report.saving import RECORDING, Contents


def option():
    """How `make lab` tells JupyterLab to save, a word of its command line."""
    shown = subprocess.run(
        ["make", "-n", "-o", "setup", "lab"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    (found,) = [word for word in shown.stdout.split() if "contents_manager_class" in word]
    return found


def after_running(notebook):
    """The notebook as JupyterLab saves it when its cells have been run: other outputs, counts and metadata."""
    notebook = json.loads(json.dumps(notebook))
    shown = {
        "output_type": "stream",
        "name": "stdout",
        "text": "safe on the disk: /home/me/lrfcal_sessions\n",
    }
    for count, cell in enumerate(notebook["cells"]):
        if cell["cell_type"] == "code":
            cell |= {"outputs": [copy.deepcopy(shown)], "execution_count": 40 + count}
            cell["metadata"]["execution"] = {"iopub.status.busy": "2026-01-01"}
    notebook["metadata"]["widgets"] = {
        "application/vnd.jupyter.widget-state+json": {"state": {}}
    }
    notebook["metadata"]["language_info"]["version"] = "3.11.7"
    return notebook


@pytest.fixture
def saved(tmp_path):
    """Saves a changed copy of a notebook as JupyterLab does; the file before and after."""

    def saved(name, change):
        file = tmp_path / name
        shutil.copy(ROOT / "notebooks" / name, file)
        before = file.read_bytes()
        contents = import_item(option().partition("=")[2])(root_dir=str(tmp_path))
        model = asyncio.run(contents.get(name))
        model["content"] = change(model["content"])
        asyncio.run(contents.save(model, f"/{name}"))
        return before, file.read_bytes()

    return saved


def test_running_the_notebook_that_records_leaves_its_file_as_it_is(saved):
    before, after = saved(RECORDING, after_running)
    assert after == before
    assert (
        option().endswith("=lrfcal_lib.report.saving.Contents")
        and Contents.__module__ == "lrfcal_lib.report.saving"
    )


def test_a_cell_that_was_changed_is_saved_without_outputs(saved):
    def edited(notebook):
        notebook = after_running(notebook)
        notebook["cells"][1]["source"] += '\nprint("mine")'
        return notebook

    before, after = (nbformat.reads(data.decode(), 4) for data in saved(RECORDING, edited))
    assert after.cells[1].source.endswith('print("mine")') and after.cells[1].outputs == []
    assert after.cells[2:] == before.cells[2:] and after.metadata == before.metadata


def test_other_notebooks_are_saved_as_always(saved):
    _, after = saved("02_median_filtering.ipynb", after_running)
    assert after.decode().count("safe on the disk: /home/me") > 5
