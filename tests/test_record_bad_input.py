"""`python -m lrfcal_lib record` in a process of its own, against emulated devices: what goes wrong ends with one line
that says what to do, an exit code, a head that stands still and a session that can be gone on with. What else can be
wrong with rig and rig file is in test_rig, test_rig_file, test_record and test_video.
"""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from shared import until
from small_rigs import scaled

from lrfcal_lib.emulators.rig import EmulatedRig, practice_setup
from lrfcal_lib.session.read import open_session, validate

DEADLINE = 120.0  # s, against hanging


@pytest.fixture(scope="module")
def rig():
    """A quick rig with one placement of five stops and one image of 64 x 48 pixels."""
    setup, placements = practice_setup()
    first, last, step = placements[0].sweep
    low = (first + last) / 2
    sweep = low, low + np.radians(4.0), step
    short = [replace(placements[0], sweep=sweep, image_pitch=(low,))]
    setup = replace(
        setup, rig=scaled(replace(setup.rig, cameras=setup.rig.cameras[:1]), 64)
    )
    with EmulatedRig(setup, placements=short, quick=True, rest_s=0.1) as rig:
        yield rig


@pytest.fixture
def stated(rig):
    """Its rig file, to be spoilt."""
    return rig.rig_file()


class Program:
    """`record`, running."""

    def __init__(self, folder, data, rig, *options):
        (folder / "rig.json").write_text(json.dumps(data))
        call = [
            sys.executable,
            "-m",
            "lrfcal_lib",
            "record",
            str(folder / "rig.json"),
            str(folder / "s"),
            *options,
        ]
        pipes = {
            "stdin": subprocess.DEVNULL,
            "stdout": subprocess.PIPE,
            "stderr": subprocess.PIPE,
        }
        self.session, self.rig = folder / "s", rig
        self.run = subprocess.Popen(
            call, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"}, **pipes
        )

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
        until(lambda: not self.rig.world.head.moving(self.rig.host.now()))
        assert "Traceback" not in err
        return self.run.returncode, out, err.strip()


def test_ctrl_c_while_the_head_moves_and_going_on(tmp_path, rig, stated):
    program = Program(tmp_path, stated, rig)
    until(lambda: program.moves() or program.run.poll() is not None)
    program.run.send_signal(signal.SIGINT)
    code, out, err = program.end()
    assert code == 130 and "stopped by Ctrl-C" in err or "are safe; 'python" in out
    code, _, err = Program(tmp_path, stated, rig, "--resume").end()
    assert code == 0, err
    session = open_session(program.session)
    assert validate(program.session) == [] and session.placements == (1,)
    assert len(session.sweep(1).pitch) == 5 and len(session.images(placement=1)) == 1
