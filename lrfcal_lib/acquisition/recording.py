"""A recording: the events of a rig written to a session, one placement after the other."""

from __future__ import annotations

import contextlib
import errno
import math
from pathlib import Path

import numpy as np

from lrfcal_lib.acquisition.checks import check_image, check_placement
from lrfcal_lib.drivers.rig import Moved, Photographed, Scanned, Tracked
from lrfcal_lib.session import SessionError, SessionRecorder, open_session

HOW = {
    "stop-and-go": "stop-and-go: the head rests at every pitch step, scans and images are taken at rest",
    "continuous": "continuous: scans are taken while the head moves, each with the pitch at its middle beam",
}


class RecordingError(RuntimeError):
    """A recording that cannot go on; the message says what is safe and what to do."""


class Recording:
    """Writes what a rig records to a session; a context manager.

    Parameters
    ----------
    rig : Rig
        Open.
    path : path-like
        Folder of the session.
    resume : bool
        Go on with the recording in `path` if there is one: its finished placements stay.
    count : int, optional
        Record only so many placements of the plan.

    Raises
    ------
    SessionError
        If `path` exists (without `resume`), or states another rig.
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
    ...         print(recording.check(placement.number))
    ...     recording.finish()
    """

    def __init__(self, rig, path, *, resume=False, count=None):
        self.rig, self.path, self.plan = rig, Path(path), rig.stated.plan.to_do(count)
        stated, writer = rig.stated, None
        about = {**stated.about, "source": stated.about["source"] or f"recorded with {stated.path.name}"}
        about |= {"reference": _reference(rig, self.plan), "platform_sigma": stated.platform_sigma}
        with self._safely():
            writer = SessionRecorder(self.path, stated.board, rig.lrf_info, stated.cameras.values(), stated.T_head_lrf,
                                     resume=resume, **about)  # fmt: skip
            writer.add_telegrams(-1, rig.begin_telegrams(), time_s=rig.clock())
        self.writer = writer

    @property
    def finished(self):
        """Numbers of the placements that are complete and safe."""
        return self.writer.finished

    def to_do(self):
        """The placements of the plan that are not finished, in order.

        Returns
        -------
        list of Placement
        """
        return [placement for placement in self.plan if placement.number not in self.finished]

    def close_views_to_do(self):
        """Images of the board held close that are still to be taken.

        Returns
        -------
        list of (str, int)
            Camera and number of the view, counted from 0.
        """
        wanted, taken = self.rig.stated.plan.intrinsics_images, self.writer.shots_of("intrinsics")
        return [(camera, view) for camera in self.rig.stated.cameras for view in range(taken[camera], wanted)]

    def run(self, placement):
        """Record a placement: a generator that yields every event of the rig once it is on the disk.

        Parameters
        ----------
        placement : Placement
            Of :meth:`to_do`.

        Yields
        ------
        Moved, Scanned, Photographed or Tracked
            When the generator ends the placement is finished. When it is closed or raises, the head is stopped and
            the placement is not part of the session.

        Raises
        ------
        DeviceError
        RecordingError
            If the disk is full or gone.
        """
        if placement.number in self.writer.data["unfinished"]:  # an earlier run of it was broken off
            self.drop(placement.number)
        with self._safely():
            self.writer.begin_placement(placement.number)
        with contextlib.closing(self.rig.acquire(placement)) as events:
            for event in events:
                with self._safely():
                    self._write(event)
                yield event
        with self._safely():
            self.writer.finish_placement()

    def run_close(self, camera):
        """Take an image of the board held close to a camera, and keep it if it shows the pattern.

        Parameters
        ----------
        camera : str

        Returns
        -------
        Light
            'bad' where the image was not kept.
        """
        with contextlib.closing(self.rig.acquire_close(camera)) as events:
            *_, event = events
        info = self.rig.stated.cameras[camera]
        light = check_image(event.frame.image, self.rig.stated.board, info.model, f"camera {camera}")
        if light.state != "bad":
            with self._safely():
                self._write(event)
        return light

    def check(self, number, advice=None):
        """Lights of a finished placement, see :func:`~lrfcal_lib.acquisition.check_placement`."""
        return check_placement(open_session(self.path), number, advice)

    def drop(self, number):
        """Take a placement out of the session, to record it again; its bytes stay on the disk."""
        with self._safely():
            self.writer.drop_placement(number)

    def finish(self):
        """Close the session; without this it can still be opened, and the recording can go on.

        Raises
        ------
        RecordingError
            If the session on the disk does not hold what was finished.
        """
        with self._safely():
            self.writer.finish()
        if self._readable() != set(self.finished):
            raise RecordingError(f"{self.path}: {self.safe()}")

    def safe(self, resume=False):
        """What is safe on the disk and, if asked for, how to go on; half a sentence."""
        there = self._readable()
        if there is None or set(self.finished) - there:
            return "the session was removed or damaged while it was recorded: record again, to another folder"
        numbers = ", ".join(map(str, self.finished))
        safe = f"placements {numbers} are safe" if numbers else "no placement was finished"
        return f"{safe}; --resume goes on from there" if resume else safe

    def _readable(self):
        """Numbers of the finished placements that a reader finds with their scans; None where there is no session."""
        try:
            return set(open_session(self.path).scans["placement"].tolist()) & set(self.finished)
        except (SessionError, OSError):
            return None if self.finished or not self.path.exists() else set()

    def _write(self, event):
        writer = self.writer
        if isinstance(event, Moved):
            writer.add_platform([(event.time_s, event.commanded, event.pitch if event.measured else math.nan)])
        elif isinstance(event, Scanned):
            _add_scans(writer, event)
        elif isinstance(event, Photographed):
            about = {"pitch": event.pitch, "time_s": event.frame.time_s, "purpose": event.purpose}
            writer.add_image(event.camera, event.frame.image, event.placement, **about)
        elif isinstance(event, Tracked):
            writer.add_platform([(t, event.commanded, pitch) for t, pitch, measured in event.track if measured])

    @contextlib.contextmanager
    def _safely(self):
        """Say of a disk that fails what to do about it."""
        try:
            yield
        except OSError as error:
            full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
            remedy = "free some space" if full else "check the disk and its permissions"
            safe = self.safe(resume=True) if hasattr(self, "writer") else "then record again"
            raise RecordingError(f"{self.path}: cannot be written ({error.strerror}): {remedy}; {safe}") from error


def _add_scans(writer, event):
    """All telegrams of an event; the parts of an interlaced scan share its pitch."""
    telegrams = [raw for reading in event.readings for raw in reading.telegrams]
    count = [len(reading.telegrams) for reading in event.readings]
    times = [reading.time_s for reading in event.readings]
    writer.add_telegrams(event.placement, telegrams, np.repeat(event.pitch, count), np.repeat(times, count))


def _reference(rig, plan):
    """What the session says about how it was recorded."""
    pitch = "told by the head" if rig.head.has_feedback else "dead reckoning: the head does not tell it"
    scenes = [placement.number for placement in plan if placement.purpose == "scene"]
    return {"recording": HOW[rig.stated.plan.mode], "pitch": pitch, "scene_placements": scenes}
