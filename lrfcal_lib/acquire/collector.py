"""What the panel does, without any widget: one rig, one recording, one thing at a time."""

import contextlib
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lrfcal_lib.acquire.checks import Light, check_placement
from lrfcal_lib.acquire.record import Recording, RecordingError, View
from lrfcal_lib.calibrate.pipeline import (
    Calibration,
    calibrate,
    calibrate_jointly,
    handed_over,
    prepare,
)
from lrfcal_lib.calibrate.rig import joint_rig
from lrfcal_lib.drivers.port import Closed, DeviceError, LineLost
from lrfcal_lib.drivers.rig import Rig
from lrfcal_lib.drivers.rig_file import Placement, read_rig_file, rig_of
from lrfcal_lib.evaluate.export import calibration_record, write_calibration
from lrfcal_lib.judge.verdict import YES, judge, verdict
from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.session.read import Session, open_session
from lrfcal_lib.solvers import CANDIDATES

PRACTICE_RIGS = ("practice", "sim_quick", "sim_lms221")
ADVICE_FROM = 3  # placements, below which every other one helps
WAIT_S = 3.0  # for a look at the rig to end
AGAIN_S = 0.1  # between stops, until whoever moves the head has noticed
RECONNECT_S = 2.0
GUIDE_CLOSE = (
    "hold the board close, tilted otherwise than before, all of its pattern in the image"
)
GUIDE = (
    "about 1.5 m ahead, turned in its plane so that no edge is upright or level",
    "about 1.2 m ahead, a little to the left, turned by a third of a turn, "
    "facing left by 30 degrees",
    "about 2 m ahead, a little to the right, turned by another third of a turn, "
    "facing right by 30 degrees",
    "about 2.5 m ahead, higher or lower than before, leaning back by 30 degrees",
    "about 1 m ahead, turned by half a turn, leaning forward by 30 degrees",
    "about 1.7 m ahead, at the edge of what all cameras see",
)


@dataclass(frozen=True)
class Task:
    """What is recorded next."""

    title: str
    guidance: str  # where to put the board
    placement: Placement | None = None
    # without a placement: camera of a close view, its number
    close: tuple[str, int] = ("", 0)


@dataclass(frozen=True)
class Result:
    """A calibration."""

    answer: str  # whether to trust it: yes, with care, no
    sentences: list[str]
    method: str  # whose poses are handed over; '' where none is
    # by camera: rotation vector (degrees) and translation (mm), each with its sigma
    poses: dict[str, tuple[str, ...]]
    file: Path | None  # calibration.json
    calibration: Calibration


def advise(session: Session) -> str:
    """What the next placement should add, in a sentence.

    Parameters
    ----------
    session
        With what was recorded so far.

    Returns
    -------
    str
        '' where all is known well enough.
    """
    prepared = prepare(session)
    try:
        solution = calibrate_jointly(prepared).solution
    except DegenerateGeometry as error:
        return f"not determined yet: {error}"
    rig = replace(joint_rig(solution, prepared.models), lrf=session.lrf)
    judged = verdict(solution, rig)
    if judged.answer == YES:
        return ""
    return judged.advice


class Busy(RuntimeError):
    """Something else is under way with the rig."""


class Interrupted(RuntimeError):
    """The user stopped what was under way."""


class Collector(Closed):
    """Connects a rig, records with it and calibrates what was recorded; a context manager.

    All methods may be called from any thread; two that need the devices exclude each other (Busy).
    :meth:`stop` works at any time. What needs a rig raises DeviceError without one.

    Attributes
    ----------
    view : View
    lights : dict of int to list of Light
        By placement, of the rig that was connected last.
    recording : Recording or None
    """

    def __init__(self):
        self.recording: Recording | None = None
        self.view = View()
        self.stopped = threading.Event()
        self._devices = threading.Lock()

    @property
    def connected(self) -> bool:
        """Whether a rig is open."""
        return self.recording is not None

    @property
    def rig(self) -> Rig:
        """The rig that is open."""
        return self._needed().rig

    @property
    def emulated(self) -> bool:
        """Whether the board moves by itself."""
        return self.connected and self.rig.stated.devices.control is not None

    @property
    def limits_deg(self) -> Any:
        """Lowest and highest pitch of the head."""
        return self.rig.stated.devices.head.pitch_limits_deg

    @property
    def finished(self) -> tuple[int, ...]:
        """Numbers of the placements that are recorded and safe."""
        return self.recording.finished if self.recording else ()

    def connect(self, rig: str | os.PathLike, session: str | os.PathLike) -> Rig:
        """Open a rig and a session; one that was recorded with the same rig goes on.

        Parameters
        ----------
        rig
            A rig file, or the name of an emulated rig.
        session
            Its folder.

        Raises
        ------
        RigFileError
            If there is no such file or rig, or it cannot be used.
        DeviceError
            If a device does not open; those opened before are closed again.
        SessionError, RecordingError
            If the session states another rig, or cannot be written.
        """
        self.close()
        with self._exclusively(), contextlib.ExitStack() as stack:
            opened = stack.enter_context(Rig.open(_stated(rig, stack)))
            self.recording = stack.enter_context(
                Recording(opened, Path(session), resume=True)
            )
            self._closing = stack.pop_all()
            self.view = View(sweep=self.recording.plan[0].pitch)
            self.lights: dict[int, list[Light]] = {}
            self._advice = ""
        return opened

    def close(self) -> None:
        """Stop the head, finish the session, close all devices; a second call does nothing.

        Raises
        ------
        RecordingError
            If the session cannot be finished; the devices are closed all the same.
        """
        recording = self.recording
        if recording is None:
            return
        self.stop()
        with self._exclusively():
            self.recording = None
            with self._closing:
                recording.rig.halt()
                if recording.finished:
                    recording.finish()

    @contextlib.contextmanager
    def _exclusively(self):
        """The devices for oneself."""
        if not self._devices.acquire(timeout=WAIT_S):
            raise Busy("the rig is busy: wait until it is done, or press stop")
        self.stopped.clear()
        try:
            yield
        finally:
            self._devices.release()

    def _needed(self):
        """The recording."""
        if self.recording is None:
            raise DeviceError(
                "no rig is connected: name a rig file or an emulated rig, and press connect"
            )
        return self.recording

    def move_to(self, pitch: float) -> float:
        """Move the head.

        Parameters
        ----------
        pitch
            Radians, up positive.

        Returns
        -------
        float
            Where it settled, radians.

        Raises
        ------
        OutOfRange
            Beyond its limits.
        Busy
            If something else is under way.
        """
        head = self.rig.head
        with self._exclusively():
            self.view.pitch = head.move_to(pitch)
            self.view.measured = head.has_feedback
        return self.view.pitch

    def stop(self) -> None:
        """Stop the head at once, and whatever was under way; returns when it has ended."""
        recording = self.recording
        end = time.monotonic() + WAIT_S
        self.stopped.set()
        while recording is not None and time.monotonic() < end:
            # again: the next move of a sweep may have begun in between
            recording.rig.head.emergency_stop()
            if self._devices.acquire(timeout=AGAIN_S):
                self._devices.release()
                return

    def look(self) -> View:
        """The View of the rig, unless it is busy: then what it records is in `view` already.

        What could not be read is said in `trouble`; nothing is raised for it.
        """
        view = self.view
        recording = self.recording
        if recording is None:
            return view
        rig = recording.rig
        troubles = []
        for name, camera in rig.cameras.items():
            try:
                view.frames[name] = camera.newest(timeout=0)
            except LineLost as error:
                view.frames.pop(name, None)
                troubles.append(str(error))
            except DeviceError:  # there is none yet
                continue
        if self._devices.acquire(blocking=False):
            try:
                view.pitch, view.measured = rig.head.pitch()
                view.reading = rig.scan(reconnect_s=RECONNECT_S, errors=LineLost)
            except DeviceError as error:
                troubles.append(str(error))
            finally:
                self._devices.release()
        view.trouble = "; ".join(troubles)
        return view

    def task(self) -> Task | None:
        """What to record next; None where the plan is done."""
        recording = self.recording
        if recording is None:
            return None
        plan = recording.rig.stated.plan
        for camera, view in recording.close_views_to_do():
            title = f"Close view {view + 1} of {plan.intrinsics_images}, camera '{camera}'"
            return Task(title, GUIDE_CLOSE, close=(camera, view))

        left = recording.to_do()
        if not (left or plan.placements):  # nothing is listed: one more can always be had
            left = plan.to_do(max([plan.count, *self.finished]) + 1)[-1:]
        if not left:
            return None
        placement = left[0]
        done = len(self.finished)
        guidance = self._advice or f"put the board {GUIDE[done % len(GUIDE)]}"
        if placement.purpose == "scene":
            guidance = "take the board away: this sweep shows the room"
        count = max(len(recording.plan), placement.number)
        return Task(f"Placement {done + 1} of {count}", guidance, placement)

    def capture(
        self, progress: Callable[[float, str], object] = lambda share, text: None
    ) -> list[Light]:
        """Record the next task, the board being where it should; an emulated rig puts it there.

        Parameters
        ----------
        progress
            ``progress(share, text)`` is called after every event.

        Returns
        -------
        list of Light
            What the checks of the placement say.

        Raises
        ------
        DeviceError, RecordingError, Interrupted
            Or if it was stopped: the placement does not count.
        """
        recording = self._needed()
        task = self.task()
        if task is None:
            raise RecordingError(
                "the plan of this rig is done: calibrate, or connect with another session"
            )
        with self._exclusively():
            placement = task.placement
            if placement is None:
                camera, view = task.close
                recording.rig.hold_close(camera, view)
                return [recording.run_close(camera)]
            number = placement.number
            self.view = replace(
                self.view,
                rows={},
                scans=0,
                images=0,
                stop="",
                share=0.0,
                sweep=placement.pitch,
            )
            recording.rig.move_board(number)
            self._record(placement, progress)
        progress(1.0, "checking what was recorded")
        session = open_session(recording.path)
        lights = check_placement(session, number)
        if placement.purpose == "board" and len(session.board_placements) >= ADVICE_FROM:
            self._advice = advise(session)
            light = Light(
                name="information",
                state="warn" if self._advice else "ok",
                text=self._advice or "every direction is well determined",
            )
            lights.append(light)
        self.lights[number] = lights
        return lights

    def _record(self, placement, progress):
        """Record a placement; Interrupted if the user stops it."""
        view = self.view
        with contextlib.closing(self.recording.run(placement)) as events:
            try:
                for event in events:
                    view.note(event)
                    progress(view.share, f"{view.stop}{view.counts()}")
                    if self.stopped.is_set():
                        raise DeviceError("stopped")
            except DeviceError as error:
                if not self.stopped.is_set():
                    raise
                raise Interrupted(
                    f"stopped: placement {placement.number} does not count, record it again"
                ) from error

    def again(self) -> int:
        """Take the placement recorded last out of the session, to record it again; its number.

        Raises
        ------
        RecordingError
            If there is none.
        """
        recording = self._needed()
        if not self.finished:
            raise RecordingError(
                "there is no placement to record again: press capture to record one"
            )
        with self._exclusively():
            number = next(reversed(self.lights), self.finished[-1])
            recording.drop(number)
            self.lights.pop(number, None)
        return number

    def calibrate(self) -> Result:
        """Calibrate what was recorded so far; the recording can go on afterwards.

        ``<session>_calibration/calibration.json`` is written beside the session.

        Raises
        ------
        RecordingError
            If nothing was recorded yet.
        ValueError
            If it determines no calibration.
        """
        path = self._needed().path
        if not self.finished:
            raise RecordingError(
                "nothing was recorded yet: capture at least three placements of the board"
            )
        calibration = calibrate(open_session(path), CANDIDATES)
        judged = judge(calibration)
        sentences = judged.sentences()
        method = ""
        poses = {}
        file = None
        if judged.errors:
            method = handed_over(calibration)
            for camera, solution in calibration.cameras(method).items():
                poses[camera] = tuple(
                    f"{value:.2f} ± {sigma:.2f}" for value, sigma in solution.shown.T
                )
            file = path.with_name(f"{path.name}_calibration") / "calibration.json"
            write_calibration(file, calibration_record(calibration, method, judged))
        else:
            sentences.append("Nothing is written.")
        return Result(judged.answer, sentences, method, poses, file, calibration)


def _stated(rig, stack):
    """The RigFile of a rig file, or of an emulated rig, which lives as long as the stack."""
    if str(rig) in PRACTICE_RIGS:
        from lrfcal_lib.emulators.rig import emulated

        devices = stack.enter_context(emulated(str(rig)))
        return rig_of(devices.rig_file(), Path(f"emulated {rig}"))
    return read_rig_file(rig)
