"""`python -m lrfcal_lib record` in a process of its own, against emulated devices: what goes wrong ends with one line
that says what to do, an exit code, a head that stands still and a session that can be gone on with.
"""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import reduce

import numpy as np
import pytest

from lrfcal_lib.emulators.rig import EmulatedRig, practice_setup, quick_file
from lrfcal_lib.session.read import open_session, validate

DEADLINE = 120.0  # s, against hanging
FORBIDDEN = """
import errno, sys, serial
class Forbidden(serial.Serial):
    def open(self):
        raise serial.SerialException(errno.EACCES, "could not open port: Permission denied")
serial.Serial = Forbidden
from lrfcal_lib.__main__ import main
sys.exit(main(sys.argv[1:]))
"""
FULL = """
import errno, os, sys
from pathlib import Path
from lrfcal_lib.__main__ import main
fsync, table, over = os.fsync, Path(sys.argv[3]) / "lrf" / "index.csv", []
def full(handle):
    if over or table.exists() and len(table.read_text().splitlines()) > 7:
        over.append(True)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    fsync(handle)
os.fsync = full
sys.exit(main(sys.argv[1:]))
"""  # with the seventh scan of the session


def emulated(count):
    """A quick rig with placements of five stops and one image of 64 x 48 pixels."""
    setup, placements = practice_setup()
    low = float(np.mean(placements[0].sweep))
    short = [replace(p, sweep=(low, low + np.radians(4.0)), image_pitch=(low,)) for p in placements[:count]]
    setup = replace(setup, rig=replace(setup.rig, cameras=setup.rig.cameras[:1]))
    head = {"baudrate": 38400, "go_speed": 60.0}
    return EmulatedRig(setup, placements=short, image_width=64, platform={"settle": 0.0}, head_options=head, rest_s=0.1)


@pytest.fixture(scope="module")
def rig():
    """With one placement."""
    with emulated(1) as rig:
        yield rig


@pytest.fixture
def stated(rig):
    """Its rig file, to be spoilt."""
    return quick_file(rig)


class Program:
    """`record`, running."""

    def __init__(self, folder, data, *options, code=None, rig=None):
        (folder / "rig.json").write_text(json.dumps(data))
        start = ["-m", "lrfcal_lib"] if code is None else ["-c", code]
        call = [sys.executable, *start, "record", str(folder / "rig.json"), str(folder / "s"), *options]
        pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        env = os.environ | {"PYTHONUNBUFFERED": "1"}
        self.folder, self.rig = folder, rig
        if rig is not None:
            self.frames, self.requests = len(rig.pan_tilt.frames), len(rig.lrf.requests)
        self.run = subprocess.Popen(call, text=True, env=env, **pipes)

    def rows(self, name):
        """Lines of a table of the session."""
        file = self.folder / "s" / name
        return len(file.read_text().splitlines()) if file.exists() else 0

    def wait(self, condition):
        """Until the program got so far."""
        end = time.monotonic() + DEADLINE
        while not condition(self) and self.run.poll() is None:
            assert time.monotonic() < end
            time.sleep(0.005)

    def end(self):
        """Exit code, what it said, and what it complained about."""
        try:
            out, err = self.run.communicate(timeout=DEADLINE)
        finally:
            self.run.kill()
        return self.run.returncode, out, err.strip()


def stands_still(rig):
    """Whether the head rests: it may still react to a last stop."""
    time.sleep(0.2)
    return not rig.world.head.tilt.moving(rig.clock.now())


SPOILT = {  # what is changed, by the path of its key
    "error: lrf: there is no port /dev/no_such_port: check cable and power": {"lrf.port": "/dev/no_such_port"},
    "error: head: ": {"lrf.port": "{head}", "head.port": "{lrf}"},
    "devices.lrf.port and devices.head.port are both": {"lrf.port": "{head}"},
    "pitch_limits_deg are -1 to 1: ask for less": {"head.pitch_limits_deg": [-1.0, 1.0]},
    "error: camera 'left': http://127.0.0.1:9/left.mjpg gives no video: open http":
        {"cameras.left.source": "http://127.0.0.1:9/left.mjpg"},
    "is 'python -m lrfcal_lib emulate' still running?": {"control": "/tmp/no_such_socket"},
}  # fmt: skip


@pytest.mark.parametrize("message", SPOILT)
def test_what_is_wrong_with_a_rig_file_is_one_line(tmp_path, rig, stated, message):
    for path, value in SPOILT[message].items():
        *way, key = path.split(".")
        at = reduce(lambda at, key: at[key], way, stated["devices"])
        at[key] = value.format(head=rig.pan_tilt.path, lrf=rig.lrf.path) if isinstance(value, str) else value
    code, _, err = Program(tmp_path, stated).end()
    assert code == 2 and message in err.splitlines()[-1] and "Traceback" not in err
    assert stands_still(rig)


def test_no_permission(tmp_path, stated):
    code, _, err = Program(tmp_path, stated, code=FORBIDDEN).end()
    assert code == 2 and "no permission" in err and "sudo usermod -aG dialout $USER" in err and "\n" not in err


def test_a_camera_without_exposure_control_is_used_as_it_is(tmp_path, rig, stated):
    stated["devices"]["cameras"]["left"] |= {"exposure": 0.005, "fps": 10}
    code, out, err = Program(tmp_path, stated).end()
    assert code == 0 and err.splitlines() == [
        "camera left: exposure cannot be set, asked 0.005",
        "camera left: fps cannot be set, asked 10",
    ]
    assert "placements 1 are safe" in out
    session = open_session(tmp_path / "s")
    assert len(session.sweep(1).pitch) == 5 and len(list(session.images(placement=1))) == 1


def test_a_head_at_its_end_stop_ends_the_recording(tmp_path, rig, stated, monkeypatch):
    first, last, _ = stated["plan"]["placements"][0]["pitch_deg"]
    monkeypatch.setattr(rig.world.head.tilt, "limits", (-1.0, np.radians((first + last) / 2)))
    code, _, err = Program(tmp_path, stated).end()
    assert code == 2 and "no placement was finished; --resume goes on from there" in err and "Traceback" not in err
    assert "end stop" in err or "limit" in err
    assert stands_still(rig)


@pytest.fixture(scope="module")
def two():
    """With two placements."""
    with emulated(2) as rig:
        yield rig


def contents(path, number):
    """Telegrams and images of a placement, byte for byte."""
    session = open_session(path)
    data, rows = (path / "lrf" / "telegrams.bin").read_bytes(), (path / "lrf" / "index.csv").read_text().splitlines()
    rows = [row.split(",") for row in rows[1:]]
    telegrams = [data[int(r[1]) : int(r[1]) + int(r[2])] for r in rows if r[3] == str(number)]
    return telegrams, [session.read_image(image).tobytes() for image in session.images(placement=number)]


def test_a_disk_that_is_full_in_a_sweep(tmp_path, two):
    """The second placement breaks off between its stops; the first one stays, and --resume repeats the second."""
    path, data = tmp_path / "s", quick_file(two)
    code, _, err = Program(tmp_path, data, code=FULL).end()
    assert code == 2 and "Traceback" not in err and "\n" not in err
    assert "cannot be written (No space left on device): free some space; placements 1 are safe" in err
    assert "--resume goes on from there" in err and stands_still(two)
    assert open_session(path).placements == (1,)
    assert 2 in json.loads((path / "session.json").read_text())["unfinished"]
    first = contents(path, 1)
    assert len(first[0]) == 5 and len(first[1]) == 1
    code, out, err = Program(tmp_path, data, "--resume").end()
    assert code == 0, err
    assert validate(path) == [] and open_session(path).placements == (1, 2) and "placements 1, 2 are safe" in out
    assert contents(path, 1) == first and [len(part) for part in contents(path, 2)] == [5, 1]


PHASES = {
    "modules are imported": lambda program: True,
    "the head is looked for": lambda program: len(program.rig.pan_tilt.frames) > program.frames,
    "the laser range finder is set": lambda program: len(program.rig.lrf.requests) > program.requests,
    "a session is begun": lambda program: (program.folder / "s" / "session.json").exists(),
    "the head moves from stop to stop": lambda program: program.rows("platform.csv") > 2,
}


@pytest.mark.parametrize("phase", PHASES)
def test_ctrl_c_at_any_time(tmp_path, rig, stated, phase):
    program = Program(tmp_path, stated, rig=rig)
    program.wait(PHASES[phase])
    program.run.send_signal(signal.SIGINT)
    code, out, err = program.end()
    if len(rig.pan_tilt.frames) > program.frames and "are safe; 'python" not in out:
        assert code == 130 and "stopped by Ctrl-C" in err and "Traceback" not in err
    assert stands_still(rig)
    if (tmp_path / "s" / "session.json").exists():
        code, _, err = Program(tmp_path, stated, "--resume").end()
        assert code == 0, err
        assert validate(tmp_path / "s") == [] and open_session(tmp_path / "s").placements == (1,)
