"""The emulated rig: its cameras as streams, its rig file, and the command line."""

import json
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import serial
from shared import until
from small_rigs import scaled

from lrfcal_lib import __main__ as command_line
from lrfcal_lib.emulators.rig import EmulatedRig, main, written_rig_file
from lrfcal_lib.simulate.rig import load_setup, placements_of

DEADLINE = 180.0  # s, against hanging
SETUP = load_setup("sim_quick")
SMALL = replace(
    SETUP,
    intrinsics_views=0,  # so few pixels show no board held close
    rig=scaled(replace(SETUP.rig, platform=replace(SETUP.rig.platform, settle=0.1)), 64),
)


@pytest.fixture(scope="module")
def placements():
    return placements_of(SETUP)[:4]


@pytest.fixture(scope="module")
def rig(placements):
    with EmulatedRig(SMALL, placements=placements) as rig:
        yield rig
    assert rig.error() is None and not rig.folder.exists()


def test_cameras_open_as_any_stream_and_show_the_place(rig):
    rig.world.put("place/1")
    video = cv2.VideoCapture(rig.camera_urls["left"])
    assert video.isOpened()
    ok, first = video.read()
    assert ok and first.shape == (48, 64, 3)
    rig.world.put("place/none")
    until(lambda: np.abs(video.read()[1].astype(int) - first).mean() > 3)
    video.release()


def test_a_setup_that_is_not_there():
    with pytest.raises(
        ValueError,
        match="no set-up 'x'; there are sim_lms221, room_lms221, sim_quick, practice",
    ):
        main("x")


class Quiet:
    """An emulated rig without devices."""

    def rig_file(self):
        return {"plan": {}}


TAKEN = {  # what is there already, and what is said of it
    "a file": (
        lambda file: file.write_text("mine"),
        "exists already, and is not written over: name another file",
    ),
    "a folder": (
        lambda file: file.mkdir(),
        "exists already, and is not written over: name another file",
    ),
    "a dangling link": (lambda file: file.symlink_to("nowhere"), "exists already"),
    "no folder": (
        lambda file: file.parent.rmdir(),
        "No such file or directory.*a folder that exists",
    ),
}


@pytest.mark.parametrize("case", TAKEN)
def test_a_rig_file_takes_no_other_file_s_place(tmp_path, case):
    make, words = TAKEN[case]
    file = tmp_path / "rigs" / "rig.json"
    file.parent.mkdir()
    make(file)
    before = file.read_text() if file.is_file() else sorted(tmp_path.rglob("*"))
    with (
        pytest.raises(ValueError, match=f"{file}: .*{words}"),
        written_rig_file(Quiet(), file),
    ):
        pytest.fail("it was written")
    assert (file.read_text() if file.is_file() else sorted(tmp_path.rglob("*"))) == before


def replace_by_another(file):
    file.unlink()
    file.write_text("another")


@pytest.mark.parametrize(
    "change", [lambda file: file.write_text("mine"), replace_by_another]
)
def test_a_rig_file_that_somebody_changed_stays(tmp_path, change, capsys):
    file = tmp_path / "rig.json"
    with written_rig_file(Quiet(), file):
        assert json.loads(file.read_text()) == {"plan": {}}
        change(file)
        changed = file.read_bytes()
    assert (
        file.read_bytes() == changed
        and f"{file}: was changed, so it stays" in capsys.readouterr().out
    )


def test_a_rig_file_on_a_full_disk_leaves_nothing(tmp_path, little_space):
    with (
        little_space(5),
        pytest.raises(
            ValueError, match="rig.json: cannot be written .File too large.: name another"
        ),
    ):
        with written_rig_file(Quiet(), tmp_path / "rig.json"):
            pytest.fail("it was written")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_rig_file_ends_the_command_line_at_once(tmp_path, capsys):
    file = tmp_path / "rig.json"
    file.write_text("mine")
    assert command_line.main(["emulate", "--rig-file", str(file)]) == 1
    assert (
        f"error: {file}: exists already" in capsys.readouterr().err
        and file.read_text() == "mine"
    )


def test_the_command_line_cleans_up(tmp_path):
    file = tmp_path / "rig.json"
    call = [sys.executable, "-m", "lrfcal_lib", "emulate", "--rig-file", str(file)]
    run = subprocess.Popen(call, stdout=subprocess.PIPE, text=True)
    until(lambda: file.exists() or run.poll() is not None)
    said = "".join(
        iter(
            run.stdout.readline, f"  rig file {file}   python -m lrfcal_lib record --help\n"
        )
    )
    assert "place/NUMBER puts it at 1, 2" in said
    devices = json.loads(file.read_text())["devices"]
    folder = Path(devices["lrf"]["port"]).parent
    port = serial.Serial(devices["lrf"]["port"], 9600, timeout=DEADLINE)
    port.write(bytes.fromhex("02 00 01 00 3A 1E 12"))
    assert port.read(30)[5:6] == b"\xba"
    order = urllib.request.Request(f"{devices['control']}/place/1", method="POST")
    assert urllib.request.urlopen(order, timeout=DEADLINE).status == 204
    run.send_signal(signal.SIGTERM)
    assert (
        "the emulated rig is gone" in run.communicate(timeout=DEADLINE)[0]
        and run.returncode == 0
    )
    assert not file.exists() and not folder.exists()
    port.close()
