"""A recording: the events of a rig written to a session; ``record`` asks for the board."""

import contextlib
import logging
import math
import os
import signal
import sys
from collections.abc import Generator, Iterable
from dataclasses import dataclass, field

import numpy as np
from tqdm import tqdm

from lrfcal_lib.acquire.checks import Light, check_image, check_placement
from lrfcal_lib.drivers.lms2xx_scans import Reading
from lrfcal_lib.drivers.port import DeviceError
from lrfcal_lib.drivers.rig import Event, Moved, Photographed, Rig, Scanned, Tracked
from lrfcal_lib.drivers.rig_file import Placement, RigFile, read_rig_file
from lrfcal_lib.drivers.video import Frame
from lrfcal_lib.session.files import SessionError
from lrfcal_lib.session.lms2xx_codec import encode_configuration
from lrfcal_lib.session.read import Session, open_session
from lrfcal_lib.session.recorder import SessionRecorder
from lrfcal_lib.session.write import not_written

FAILED = 2
INTERRUPTED = 130  # exit codes
LINE = "  {desc}, {remaining} left"  # of tqdm
LINE_S = {True: 0.1, False: 10.0}  # between two of them, on a terminal and elsewhere
MARKS = {"ok": "  ok  ", "warn": "  WARN", "bad": "  BAD "}
HOW = {  # a session was recorded, by the mode of the plan
    "stop-and-go": (
        "stop-and-go: the head rests at every pitch step, scans and images are taken at rest"
    ),
    "continuous": (
        "continuous: scans are taken while the head moves, each with the pitch at its middle beam"
    ),
}
PITCH = {True: "told by the head", False: "dead reckoning: the head does not tell it"}


class RecordingError(RuntimeError):
    """A recording that cannot go on; the message says what is safe and what to do."""


class Recording(SessionRecorder):
    """Writes what a rig records to a session; a context manager.

    Parameters
    ----------
    rig
        Open.
    path
        Folder of the session.
    resume
        Go on with the recording in `path` if there is one: its finished placements stay.
    count
        Record only so many placements of the plan.

    Raises
    ------
    SessionError
        If `path` exists (without `resume`), states another rig, or is recorded by somebody else.
    RecordingError
        If the session cannot be written.

    Examples
    --------
    >>> with Rig.open(read_rig_file("rig.json")) as rig:  # doctest: +SKIP
    ...     recording = Recording(rig, "session")
    ...     for placement in recording.to_do():
    ...         input("move the board, press Enter")
    ...         for event in recording.run(placement):
    ...             print(event)
    ...         print(check_placement(open_session("session"), placement.number))
    ...     recording.finish()
    """

    def __init__(
        self,
        rig: Rig,
        path: str | os.PathLike,
        *,
        resume: bool = False,
        count: int | None = None,
    ):
        stated = rig.stated
        self.plan = stated.plan.to_do(count)
        with self._safely():
            super().__init__(
                path,
                stated.board,
                rig.lrf_info,
                stated.cameras.values(),
                stated.T_head_lrf,
                platform_sigma=stated.platform_sigma,
                reference={
                    "recording": HOW[stated.plan.mode],
                    "pitch": PITCH[rig.head.has_feedback],
                    "scene_placements": [
                        p.number for p in self.plan if p.purpose == "scene"
                    ],
                },
                continuous=stated.plan.mode == "continuous",
                resume=resume,
                **stated.about,
            )
            self.rig = rig
            try:
                # a scan does not tell its measuring mode, this does
                self.add_telegrams(
                    -1, [encode_configuration(rig.lrf.configuration)], time_s=rig.clock()
                )
            except BaseException:
                self.close()
                raise

    def to_do(self) -> list[Placement]:
        """The placements of the plan that are not finished, in order."""
        return [
            placement for placement in self.plan if placement.number not in self.finished
        ]

    def close_views_to_do(self) -> list[tuple[str, int]]:
        """Images of the board held close still to be taken: camera, number of the view from 0."""
        return [
            (camera, view)
            for camera, taken in self.close_views().items()
            for view in range(taken, self.rig.stated.plan.intrinsics_images)
        ]

    def run(self, placement: Placement) -> Generator[Event, None, None]:
        """Record a placement, and yield every event once it is on the disk.

        When the generator ends the placement is finished. When it is closed or raises, the head is
        stopped and the placement is not part of the session.

        Parameters
        ----------
        placement
            Of :meth:`to_do`.

        Raises
        ------
        DeviceError
            If the rig fails.
        RecordingError
            If the disk is full or gone.
        """
        with self._safely():
            self.begin_placement(placement.number)
            with contextlib.closing(self.rig.acquire(placement)) as events:
                for event in events:
                    self.write(event, placement.number, placement.purpose)
                    yield event
            self.finish_placement()

    def run_close(self, camera: str) -> Light:
        """Take an image of the board held close to a camera.

        Parameters
        ----------
        camera
            Its name.

        Returns
        -------
        Light
            'bad' where the image shows no pattern and was not kept.
        """
        photo = self.rig.acquire_close(camera)
        stated = self.rig.stated
        light = check_image(
            photo.frame.image,
            stated.board,
            stated.cameras[camera].model,
            f"camera {camera}",
        )
        if light.state != "bad":
            with self._safely():
                self.write(photo)
        return light

    def drop(self, number: int) -> None:
        """Take a placement out of the session, to record it again; its bytes stay on the disk.

        Parameters
        ----------
        number
            Of the placement.
        """
        with self._safely():
            self.drop_placement(number)

    def finish(self) -> None:
        """Close the session; without this it can still be opened, and the recording can go on.

        Raises
        ------
        RecordingError
            If the session on the disk does not hold what was finished.
        """
        with self._safely():
            super().finish()
        if self._lost():
            raise RecordingError(f"{self.path}: {self.safe()}")

    def safe(self, resume: bool = False) -> str:
        """What is safe on the disk, half a sentence.

        Parameters
        ----------
        resume
            Say how to go on, too.
        """
        if self._lost():
            return (
                "the session was removed or damaged while it was recorded: record again, to "
                "another folder"
            )
        safe = "no placement was finished"
        if self.finished:
            safe = f"placements {', '.join(map(str, self.finished))} are safe"
        return f"{safe}; --resume goes on from there" if resume else safe

    def _lost(self):
        """Whether a reader does not find all that was finished, with its scans."""
        try:
            recorded = open_session(self.path).scans["placement"]
        except (SessionError, OSError):
            return bool(self.finished) or not self.path.exists()
        return not set(self.finished) <= set(recorded.tolist())

    def write(self, event: Event, number: int = -1, purpose: str = "intrinsics") -> None:
        """Put an event on the disk; the parts of an interlaced scan share its pitch.

        Parameters
        ----------
        event
            Of the rig.
        number, purpose
            Of its placement; by default the board is held close.

        Raises
        ------
        OSError
            If the disk is full or gone.
        """
        match event:
            case Moved():
                measured = event.pitch if event.measured else math.nan
                self.add_platform([(event.time_s, event.commanded, measured)])
            case Scanned():
                scans = zip(event.readings, event.pitch, strict=True)
                rows = [(raw, p, one.time_s) for one, p in scans for raw in one.telegrams]
                self.add_telegrams(number, *zip(*rows, strict=True))
            case Photographed():
                self.add_image(
                    event.camera,
                    event.frame.image,
                    number,
                    pitch=event.pitch,
                    time_s=event.frame.time_s,
                    purpose=purpose,
                )
            case Tracked():
                self.add_platform(
                    (t, event.commanded, pitch)
                    for t, pitch, measured in event.track
                    if measured
                )

    @contextlib.contextmanager
    def _safely(self):
        """Say of a disk that fails what to do about it."""
        try:
            yield
        except OSError as error:
            safe = "then record again"
            if hasattr(self, "rig"):  # the session was begun
                safe = self.safe(resume=True)
            raise RecordingError(f"{self.path}: {not_written(error)}; {safe}") from error


def ask(text: str) -> str:
    """Ask the user at the terminal.

    Parameters
    ----------
    text
        The question.

    Raises
    ------
    RecordingError
        If nobody answers.
    """
    try:
        return input(text).strip().lower()
    except EOFError:
        raise RecordingError(
            "nobody is there to move the board: run record in a terminal, or with an emulated rig"
        ) from None


@dataclass
class View:
    """What the rig sees, and how far the placement recorded last is."""

    scans: int = 0
    images: int = 0
    pitch: float = 0.0  # radians
    measured: bool = False  # the head tells its pitch
    stop: str = ""
    share: float = 0.0  # of the sweep
    sweep: np.ndarray = None  # pitch of the placement recorded last, or next, radians
    reading: Reading | None = None  # the newest
    frames: dict[str, Frame] = field(default_factory=dict)  # the newest by camera
    # by pitch, of the placement recorded last
    rows: dict[float, Reading] = field(default_factory=dict)
    trouble: str = ""  # what cannot be seen, and why

    def note(self, event: Event) -> None:
        """Take an event of the placement into account."""
        match event:
            case Moved():
                self.stop = f"stop {event.number} of {event.of}, "
                self.pitch = event.pitch
                self.measured = event.measured
                self.share = (event.number - 1) / event.of
            case Scanned():
                self.scans += len(event.readings)
                self.rows |= zip(event.pitch, event.readings, strict=True)
                self.pitch = event.pitch[-1]
                self.reading = event.readings[-1]
                self.share = event.share
            case Photographed():
                self.images += 1
                self.frames[event.camera] = event.frame

    def counts(self):
        """What was recorded, as text."""
        return f"{self.scans} scans, {self.images} images"


def follow(placement: Placement, number: int, of: int, events: Iterable[Event]) -> None:
    """Show the recording of a placement while it runs, and how long it will still take.

    One line is written over and over, in a file now and then.

    Parameters
    ----------
    placement
        That is recorded.
    number, of
        It is the so-manieth of so many.
    events
        Of its recording.
    """
    first, last = map(math.degrees, placement.pitch[[0, -1]])
    print(
        f"placement {placement.number} ({number} of {of}): {placement.purpose}, pitch "
        f"{first:.2f} to {last:.2f} deg",
        flush=True,
    )
    view = View()
    with tqdm(
        total=1,
        bar_format=LINE,
        file=sys.stdout,
        leave=False,
        mininterval=LINE_S[sys.stdout.isatty()],
    ) as line:
        for event in events:
            view.note(event)
            words = f"{view.stop}{math.degrees(view.pitch):+.2f} deg, {view.counts()}"
            line.set_description_str(words, refresh=False)
            line.update(view.share - line.n)
    print(f"  {view.counts()}", flush=True)


def show(light: Light, name: str) -> None:
    """Print what a check found of something with a name."""
    print(f"{MARKS[light.state]}  {name}: {light.text}", flush=True)


class Boards:
    """Recording what the plan lists."""

    kind = "placement"  # what the user is asked for

    def planned(self, stated: RigFile) -> RigFile:
        """The rig file with what is to be recorded."""
        return stated

    def ready(self, rig: Rig, placement: Placement, before: int | None) -> str:
        """Wait until a placement can be recorded: '', or what else the user wants, 'q' or 'r'."""
        if rig.move_board(self.place_of(placement)):
            return ""
        possible = ["", "q"]
        again = ""
        if before is not None:
            possible.append("r")
            again = f", r: {self.kind} {before} again"
        text = (
            f"{self.kind} {placement.number}: {self.to_prepare(placement)}, then press Enter"
            f"{again} (q: end here) "
        )
        while (answer := ask(text)) not in possible:
            pass
        return answer

    def place_of(self, placement: Placement) -> int | str:
        """Where the board of an emulated rig belongs."""
        return placement.number

    def to_prepare(self, placement: Placement) -> str:
        """What the user does before a placement."""
        return "take the board away" if placement.purpose == "scene" else "put the board"

    def check(self, session: Session, number: int) -> list[Light]:
        """Lights of a finished placement."""
        return check_placement(session, number)

    def next_step(self, recording: Recording) -> str:
        """What can be done with a finished recording, half a sentence."""
        boards = {p.number for p in recording.plan if p.purpose == "board"}
        if boards & set(recording.finished):
            return f"'python -m lrfcal_lib calibrate {recording.path}' calibrates the rig"
        return (
            "all of them show scenes, which a calibration of the same rig can colour ('python -m "
            f"lrfcal_lib reconstruct {recording.path}'): to calibrate, record placements of the "
            "board"
        )


BOARDS = Boards()


def record_session(
    rig: Rig,
    path: str | os.PathLike,
    *,
    guide: Boards = BOARDS,
    **options,
) -> Recording:
    """Record a session with an open rig, from the first placement that is missing to the last.

    Parameters
    ----------
    rig, path, **options
        As of :class:`Recording`.
    guide
        What is asked before a placement, and checked after it.

    Returns
    -------
    Recording
        Finished, with all placements or those that the user wanted.

    Raises
    ------
    DeviceError, SessionError, RecordingError
        With a note that says what is safe.
    """
    with Recording(rig, path, **options) as recording:
        if recording.finished:
            print(f"{path}: going on, {recording.safe()}", flush=True)
        try:
            _close_views(recording)
            _placements(recording, guide)
            recording.finish()
        except (DeviceError, SessionError, KeyboardInterrupt, SystemExit) as error:
            error.add_note(recording.safe(resume=True))
            raise
    return recording


def _close_views(recording):
    """Images for the intrinsics; by hand each until it shows the pattern."""
    wanted = recording.rig.stated.plan.intrinsics_images
    for camera, view in recording.close_views_to_do():
        title = f"camera '{camera}', view {view + 1} of {wanted}"
        while True:
            emulated = recording.rig.hold_close(camera, view)
            if not emulated:
                ask(f"{title}: hold the board close, tilted otherwise than before; Enter ")
            light = recording.run_close(camera)
            show(light, title)
            if emulated or light.state != "bad":
                break


def _placements(recording, guide):
    """Each placement that is missing; the user may have the one before again (r), or end (q)."""
    before = None
    of = len(recording.plan)
    while todo := recording.to_do():
        placement = todo[0]
        answer = guide.ready(recording.rig, placement, before)
        if answer == "q":
            return
        if answer == "r":
            recording.drop(before)
            before = None
            continue
        follow(placement, of - len(todo) + 1, of, recording.run(placement))
        before = placement.number
        for light in guide.check(open_session(recording.path), before):
            show(light, light.name)
        if left := len(todo) - 1:
            print(f"  {left} of {of} placements left", flush=True)


def main(
    rig_file: str | os.PathLike, path: str | os.PathLike, guide: Boards = BOARDS, **options
) -> int:
    """Record from the command line.

    Parameters
    ----------
    rig_file
        Its path.
    path, guide, **options
        As of :func:`record_session`.

    Returns
    -------
    int
        0; 2 after a message on stderr that says what to do; 130 after Ctrl-C, 128 and its number
        after a signal. The head is stopped in any case.
    """
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    try:
        stated = guide.planned(read_rig_file(rig_file))
        print(f"{rig_file}: opening the devices", flush=True)
        with Rig.open(stated) as rig:
            recording = record_session(rig, path, guide=guide, **options)
    except (
        DeviceError,
        RecordingError,
        ValueError,
        KeyboardInterrupt,
        SystemExit,
    ) as error:
        text = f"error: {error}"
        code = FAILED
        match error:
            case KeyboardInterrupt():
                text = "\nstopped by Ctrl-C"
                code = INTERRUPTED
            case SystemExit(code=int(code)):
                text = f"\nstopped by {signal.Signals(code - 128).name}"
        with contextlib.suppress(OSError):  # after SIGHUP the terminal may be gone
            print("; ".join([text, *getattr(error, "__notes__", [])]), file=sys.stderr)
        return code
    print(f"{path}: {recording.safe()}; {guide.next_step(recording)}")
    return 0
