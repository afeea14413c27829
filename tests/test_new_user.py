"""As a new user, by README's own commands: a rig is recorded, calibrated, and a room measured with two clicks."""

import re
import shlex
import shutil
import signal
import subprocess
import sys

import pandas as pd
import pytest
from shared import ROOT, campaign, until
from test_readme import README, blocks
from test_scene_page import BY_THE_PROCESSOR, click_twice

PROGRAM = ".venv/bin/python -m lrfcal_lib"
LONGEST_S = 1800  # guards against hanging


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty one where README's commands work as in the checkout."""
    (tmp_path / ".venv").symlink_to(sys.prefix)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return tmp_path


@pytest.fixture
def emulated(folder):
    """The emulated rig of README, running."""
    (command,) = re.findall(rf"`({PROGRAM} emulate [^`]+)`", README)
    running = subprocess.Popen(shlex.split(command), cwd=folder, stdout=subprocess.DEVNULL)
    until((folder / "rig.json").exists)
    yield
    running.send_signal(signal.SIGINT)
    assert running.wait(LONGEST_S) == 0


def words_of(verb, *more):
    """The command of README's blocks that runs a verb, with what else stands in it, word by word."""
    lines = "".join(blocks("sh")).splitlines()
    (line,) = (
        line
        for line in lines
        if line.startswith(f"{PROGRAM} {verb} ") and all(text in line for text in more)
    )
    return shlex.split(line)


def typed(*command):
    """What a command of README's blocks prints; it must succeed."""
    done = subprocess.run(
        words_of(*command),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
    )
    assert done.returncode == 0, (command, done.stdout, done.stderr)
    return done.stdout


@campaign
@pytest.mark.parametrize("browser", [BY_THE_PROCESSOR], indirect=True, ids=["webgl"])
def test_a_room_is_measured_by_the_readme_alone(folder, emulated, browser):
    typed("record", "my_session")
    assert "Handed over" in typed("calibrate")
    assert typed("record", "--scene").count("ok    stood still") == 3
    typed("reconstruct")
    typed("merge")
    shutil.copytree("my_rig", "later")
    typed("compare")

    view = browser.new_page(viewport={"width": 900, "height": 700})
    view.set_default_timeout(280_000)
    view.goto((folder / "reports" / "my_room" / "station_1" / "scene.html").as_uri())
    view.wait_for_selector("canvas", state="attached")
    length, low, high = click_twice(view)
    with view.expect_download() as saved:
        view.click("#save")
    saved.value.save_as(folder / saved.value.suggested_filename)
    view.close()
    assert low < length < high < low + 150

    typed("measure")
    (told,) = pd.read_csv(folder / "reports" / "my_room" / "lengths.csv").itertuples()
    for mm, metres in ((length, told.length_m), (low, told.low_m), (high, told.high_m)):
        assert mm == pytest.approx(1000 * metres, abs=0.5)
