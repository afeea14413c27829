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


@pytest.fixture(scope="module")
def rig():
    """A quick rig with one placement of five stops and one image of 64 x 48 pixels."""
    setup, placements = practice_setup()
    low = float(np.mean(placements[0].sweep))
    short = [replace(placements[0], sweep=(low, low + np.radians(4.0)), image_pitch=(low,))]
    setup = replace(setup, rig=replace(setup.rig, cameras=setup.rig.cameras[:1]))
    head = {"baudrate": 38400, "go_speed": 60.0}
    quick = {"image_width": 64, "platform": {"settle": 0.0}, "head_options": head, "rest_s": 0.1}
    with EmulatedRig(setup, placements=short, **quick) as rig:
        yield rig


@pytest.fixture
def stated(rig):
    """Its rig file, to be spoilt."""
    return quick_file(rig)


class Program:
    """`record`, running."""

    def __init__(self, folder, data, rig, *options):
        (folder / "rig.json").write_text(json.dumps(data))
        call = [sys.executable, "-m", "lrfcal_lib", "record", str(folder / "rig.json"), str(folder / "s"), *options]
        pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        self.session, self.rig = folder / "s", rig
        self.frames, self.requests = len(rig.pan_tilt.frames), len(rig.lrf.requests)
        self.run = subprocess.Popen(call, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"}, **pipes)

    def moves(self):
        """Whether the head was at two stops."""
        file = self.session / "platform.csv"
        return file.exists() and len(file.read_text().splitlines()) > 2

    def end(self):
        """Exit code, what it said, what it complained about; the head then rests, if not in a last reaction."""
        try:
            out, err = self.run.communicate(timeout=DEADLINE)
        finally:
            self.run.kill()
        time.sleep(0.2)
        assert not self.rig.world.head.moving(self.rig.clock.now()) and "Traceback" not in err
        return self.run.returncode, out, err.strip()


SPOILT = {  # what is changed, by the path of its key
    "error: lrf: there is no port /dev/no_such_port: check cable and power": {"lrf.port": "/dev/no_such_port"},
    "error: head: ": {"lrf.port": "{head}", "head.port": "{lrf}"},
    "lrf.port and head.port are both": {"lrf.port": "{head}"},
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
    code, _, err = Program(tmp_path, stated, rig).end()
    assert code == 2 and message in err.splitlines()[-1]


def test_a_camera_without_exposure_control_is_used_as_it_is(tmp_path, rig, stated):
    stated["devices"]["cameras"]["left"] |= {"exposure": 0.005, "fps": 10}
    code, out, err = Program(tmp_path, stated, rig).end()
    assert code == 0 and err.splitlines() == [
        "camera left: exposure cannot be set, asked 0.005",
        "camera left: fps cannot be set, asked 10",
    ]
    assert "placements 1 are safe" in out
    session = open_session(tmp_path / "s")
    assert len(session.sweep(1).pitch) == 5 and len(list(session.images(placement=1))) == 1


def test_a_head_at_its_end_stop_ends_the_recording(tmp_path, rig, stated, monkeypatch):
    first, last, _ = stated["plan"]["placements"][0]["pitch_deg"]
    monkeypatch.setattr(rig.world.head, "limits", (-1.0, np.radians((first + last) / 2)))
    code, _, err = Program(tmp_path, stated, rig).end()
    assert code == 2 and "no placement was finished; --resume goes on from there" in err
    assert "end stop" in err or "limit" in err


PHASES = {
    "modules are imported": lambda program: True,
    "the head is looked for": lambda program: len(program.rig.pan_tilt.frames) > program.frames,
    "the laser range finder is set": lambda program: len(program.rig.lrf.requests) > program.requests,
    "a session is begun": lambda program: (program.session / "session.json").exists(),
    "the head moves from stop to stop": Program.moves,
}


@pytest.mark.parametrize("phase", PHASES)
def test_ctrl_c_at_any_time(tmp_path, rig, stated, phase):
    program, limit = Program(tmp_path, stated, rig), time.monotonic() + DEADLINE
    while not PHASES[phase](program) and program.run.poll() is None:
        assert time.monotonic() < limit
        time.sleep(0.005)
    program.run.send_signal(signal.SIGINT)
    code, out, err = program.end()
    if len(rig.pan_tilt.frames) > program.frames and "are safe; 'python" not in out:
        assert code == 130 and "stopped by Ctrl-C" in err
    if (program.session / "session.json").exists():
        code, _, err = Program(tmp_path, stated, rig, "--resume").end()
        assert code == 0, err
        assert validate(program.session) == [] and open_session(program.session).placements == (1,)
