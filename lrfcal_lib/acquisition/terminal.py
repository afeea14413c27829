"""``python -m lrfcal_lib record``: asks for the board, shows the progress and the checks, says what went wrong."""

from __future__ import annotations

import contextlib
import logging
import math
import shutil
import signal
import sys
import time

from lrfcal_lib.acquisition.recording import Recording, RecordingError
from lrfcal_lib.drivers.errors import DeviceError
from lrfcal_lib.drivers.rig import Moved, Photographed, Rig, Scanned
from lrfcal_lib.drivers.rig_file import read_rig_file
from lrfcal_lib.session import SessionError

FAILED, INTERRUPTED = 2, 130  # exit codes
MARKS = {"ok": "  ok  ", "warn": "  WARN", "bad": "  BAD "}


class Terminal:
    """Plain lines; on a terminal one more that is rewritten while the head moves (by carriage returns alone).

    Parameters
    ----------
    out : text stream, optional
        stdout by default.
    ask : callable, optional
        ``ask(text) -> str``; ``input`` by default.
    """

    def __init__(self, out=None, ask=input):
        self.out, self._ask = sys.stdout if out is None else out, ask
        self.live, self._width = self.out.isatty(), 0
        self._begin("", 1)

    def say(self, text):
        """A line of its own."""
        self._wipe()
        print(text, file=self.out, flush=True)

    def ask(self, text):
        """What the user answers.

        Raises
        ------
        RecordingError
            If nobody can answer.
        """
        self._wipe()
        try:
            return self._ask(text).strip().lower()
        except EOFError:
            raise RecordingError(
                "nobody is there to move the board: run record in a terminal, or with an emulated rig"
            ) from None

    def begin(self, placement, number, of):
        """A placement begins."""
        ends = " to ".join(f"{math.degrees(p):.2f}" for p in placement.pitch[[0, -1]])
        self._begin(f"placement {placement.number} ({number} of {of})", 1)
        self.say(f"{self._title}: {placement.purpose}, pitch {ends} deg")

    def _begin(self, title, of):
        self._title, self._stop, self._of, self._scans, self._images, self._pitch = title, 0, of, 0, 0, 0.0
        self._began = time.monotonic()

    def show(self, event):
        """What happened."""
        if isinstance(event, Moved):
            self._stop, self._of, self._pitch = event.number, event.of, event.pitch
        elif isinstance(event, Scanned):
            self._scans, self._pitch = self._scans + len(event.readings), event.pitch[-1]
        elif isinstance(event, Photographed):
            self._images += 1
        if self.live:
            self._rewrite(f"  stop {self._stop} of {self._of}, {math.degrees(self._pitch):+.2f} deg, {self._counted()}")

    def end(self, lights):
        """A placement is finished and checked."""
        self.say(f"  {self._counted()} in {time.monotonic() - self._began:.0f} s")
        for light in lights:
            self.say(f"{MARKS[light.state]}  {light.name}: {light.text}")

    def _counted(self):
        return f"{self._scans} scans, {self._images} images"

    def _rewrite(self, text):
        text = text[: shutil.get_terminal_size().columns - 1]
        print("\r" + text.ljust(self._width), end="", file=self.out, flush=True)
        self._width = len(text)

    def _wipe(self):
        if self._width:
            print("\r" + " " * self._width, end="\r", file=self.out, flush=True)
            self._width = 0


def record(rig, path, *, resume=False, count=None, advice=None, terminal=None):
    """Record a session with an open rig, from the first placement that is missing to the last of the plan.

    Parameters
    ----------
    rig : Rig
    path : path-like
        Folder of the session.
    resume : bool
        Go on with a session that was not finished.
    count : int, optional
        Placements of the plan; all by default.
    advice : callable, optional
        See :func:`~lrfcal_lib.acquisition.check_placement`.
    terminal : Terminal, optional

    Returns
    -------
    Recording
        Finished, with all placements or those that the user wanted.

    Raises
    ------
    DeviceError, SessionError, RecordingError
    """
    terminal = terminal or Terminal()
    recording = Recording(rig, path, resume=resume, count=count)
    if recording.finished:
        terminal.say(f"{path}: going on, {recording.safe()}")
    try:
        _close_views(recording, terminal)
        _placements(recording, terminal, advice)
        recording.finish()
    except (DeviceError, SessionError, KeyboardInterrupt, SystemExit) as error:  # SystemExit: a signal, see `emergency`
        error.add_note(recording.safe(resume=True))
        raise
    return recording


def _close_views(recording, terminal):
    """Images for the intrinsics; by hand each until it shows the pattern."""
    wanted = recording.rig.stated.plan.intrinsics_images
    for camera, view in recording.close_views_to_do():
        while True:
            title = f"camera '{camera}', view {view + 1} of {wanted}"
            emulated = recording.rig.hold_close(camera, view)
            if not emulated:
                terminal.ask(f"{title}: hold the board close, tilted otherwise than before; Enter ")
            light = recording.run_close(camera)
            terminal.say(f"{MARKS[light.state]}  {title}: {light.text}")
            if emulated or light.state != "bad":
                break


def _placements(recording, terminal, advice):
    """Each placement that is missing; the user may have one again, or end."""
    before = None
    while todo := recording.to_do():
        answer = _next_board(recording, terminal, todo[0], before)
        if answer == "q":
            return
        if answer == "r":
            recording.drop(before)
            before = None
            continue
        of = len(recording.plan)
        terminal.begin(todo[0], of - len(todo) + 1, of)
        for event in recording.run(todo[0]):
            terminal.show(event)
        before = todo[0].number
        terminal.end(recording.check(before, advice))


def _next_board(recording, terminal, placement, before):
    """Have the board moved: '' to go on, 'r' to record the placement before again, 'q' to end."""
    if recording.rig.move_board(placement.number):
        return ""
    again = "" if before is None else f", r: placement {before} again"
    what = "take the board away" if placement.purpose == "scene" else "put the board"
    while True:
        answer = terminal.ask(f"placement {placement.number}: {what}, then press Enter{again} (q: end here) ")
        if answer in ("", "q") or answer == "r" and before is not None:
            return answer


def main(rig_file, path, *, resume=False, count=None, mode=None, advice=None, terminal=None):
    """Record from the command line.

    Parameters
    ----------
    rig_file, path : path-like
    resume, count, advice, terminal
        As of :func:`record`.
    mode : {'stop-and-go', 'continuous'}, optional
        Instead of the plan's.

    Returns
    -------
    int
        0; 2 after a message on stderr that says what to do; 130 after Ctrl-C, 128 and its number after a signal.
        The head is stopped in any case.
    """
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    try:
        stated = read_rig_file(rig_file).with_mode(mode)
        with Rig.open(stated) as rig:
            recording = record(rig, path, resume=resume, count=count, advice=advice, terminal=terminal)
    except (DeviceError, RecordingError, ValueError) as error:
        return _failed(f"error: {error}", error, FAILED)
    except KeyboardInterrupt as error:
        return _failed("\nstopped by Ctrl-C", error, INTERRUPTED)
    except SystemExit as error:
        return _failed(f"\nstopped by {signal.Signals(error.code - 128).name}", error, error.code)
    print(f"{path}: {recording.safe()}; 'python -m lrfcal_lib calibrate {path}' calibrates the rig")
    return 0


def _failed(text, error, code):
    """One line on stderr, notes included."""
    with contextlib.suppress(OSError):  # after SIGHUP the terminal may be gone
        print("; ".join([text, *getattr(error, "__notes__", [])]), file=sys.stderr)
    return code
