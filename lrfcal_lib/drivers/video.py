"""Colour cameras: the newest frame of a device or stream with the time at which it was grabbed, or recorded images."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from dataclasses import dataclass

import cv2
import numpy as np

from lrfcal_lib.drivers.errors import DeviceError, LineLost, NoReply, PortError
from lrfcal_lib.drivers.video_sources import find_source

LOG = logging.getLogger(__name__)
AGAIN_S = 0.25  # between attempts to find a lost device
CLOSE_S = 2.0  # longest wait for a frame that is being grabbed


@dataclass(frozen=True)
class Frame:
    """One image.

    Attributes
    ----------
    image : ndarray of uint8, shape (height, width, 3)
        BGR.
    time_s : float
        Host time at which it was grabbed; the exposure was before it.
    index : int
        Frames grabbed before it; gaps are frames that nobody asked for in time.
    """

    image: np.ndarray
    time_s: float
    index: int


class Camera:
    """A camera; a context manager.

    A live source (V4L2 device, URL) is grabbed by a thread that keeps the newest frame only, and that looks for the
    source again when it is lost. A recorded one (video file, images) gives its next image each time it is asked.

    Attributes
    ----------
    name : str
    settings : dict
        'size' (width, height) in pixels, 'exposure' in s and 'fps', each a dict of 'asked' and 'got' (None where it is
        unknown), and 'warnings', a list of str.
    lost : bool
        A live source gave no frame when it should have, and was not found again yet; a recorded one is at its end.
    """

    def __init__(self, source, name, asked, log, clock):
        self.name, self.lost = name, False
        self.settings = {key: {"asked": value, "got": None} for key, value in asked.items()} | {"warnings": []}
        self._source, self._log, self._clock = source, log, clock
        self._frame, self._count, self._new, self._quit = None, 0, threading.Condition(), threading.Event()
        self._capture = source.open()
        self._apply()
        self._thread = threading.Thread(target=self._grab, name=f"camera {name}", daemon=True) if source.live else None
        if self._thread:
            self._thread.start()

    @classmethod
    def open(cls, source, *, name, size=None, exposure=None, fps=None, silence_s=10.0, log=LOG, clock=time.time):
        """Open a camera, set what is asked for, and read back what became of it.

        Parameters
        ----------
        source : int, str or Path
            V4L2 index or path (/dev/video0), URL, video file, image, folder of images, or pattern such as
            ``"images/*.png"``.
        name : str
        size : (int, int), optional
            Width and height, pixels.
        exposure : float, optional
            s; by default the camera's automatic exposure is left alone.
        fps : float, optional
        silence_s : float
            A stream that sends nothing for so long is taken for lost and opened again.
        log : logging.Logger
        clock : callable
            Host clock, s.

        Returns
        -------
        Camera
            What could not be set is a warning in the log and in :attr:`settings`.

        Raises
        ------
        PortError
            If the source is missing, forbidden, busy, or no camera.
        """
        asked = {"size": None if size is None else tuple(size), "exposure": exposure, "fps": fps}
        return cls(find_source(source, silence_s), name, asked, log, clock)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def newest(self, after=None, timeout=5.0):
        """The newest frame.

        Parameters
        ----------
        after : float, optional
            Host time, s: a frame grabbed later, which is waited for. A recorded source gives its next image.
        timeout : float
            s.

        Returns
        -------
        Frame

        Raises
        ------
        LineLost
            If the source is lost and did not come back in time, or a recorded one is at its end.
        NoReply
            If no such frame came in time.
        DeviceError
            If the camera was closed.
        """
        if self._thread is None:
            return self._next()
        with self._new:
            self._new.wait_for(lambda: self._quit.is_set() or self._later(after), timeout)
            if self._quit.is_set():
                raise DeviceError(f"camera {self.name} is closed: open it again")
            if self._later(after):
                return self._frame
        if self.lost:
            raise LineLost(f"camera {self.name} is lost: {self._source.remedy}")
        raise NoReply(f"camera {self.name} gave no new frame in {timeout:g} s: {self._source.remedy}")

    def close(self):
        """Close the source; a second call does nothing."""
        self._quit.set()
        with self._new:
            self._new.notify_all()
        if self._thread is not None:
            self._thread.join(CLOSE_S)
        elif self._capture is not None:
            self._capture.release()
            self._capture = None

    # ------------------------------------------------------------------------------------------------- grabbing

    def _later(self, after):
        return self._frame is not None and (after is None or self._frame.time_s > after)

    def _grab(self):
        """Keep the newest frame; this thread alone touches the source."""
        while not self._quit.is_set():
            if self._capture is None or not self._capture.grab():
                self._lose()
                continue
            now = self._clock()
            done, image = self._capture.retrieve()
            if done:  # what was there at once may have come at any time since the frame before
                self._put(image, now if getattr(self._capture, "waited", True) else self._before)
            self._before = now
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _put(self, image, instant):
        with self._new:
            self._frame = Frame(_colour(image), instant, self._count)
            self._count += 1
            if self.lost:
                self._log.warning("camera %s is back", self.name)
            self.lost = False
            self._new.notify_all()

    def _lose(self):
        """Forget the last frame, and look for the source."""
        with self._new:
            if not self.lost:
                self._log.warning("camera %s is lost: %s", self.name, self._source.remedy)
            self.lost, self._frame = True, None
        if self._capture is not None:
            self._capture.release()
            self._capture = None
        if self._quit.wait(AGAIN_S):
            return
        with contextlib.suppress(PortError):
            self._capture = self._source.open()
            self._apply()

    def _next(self):
        if self._capture is None:
            raise DeviceError(f"camera {self.name} is closed: open it again")
        done, image = self._capture.read()
        if not done:
            self.lost = True
            raise LineLost(f"camera {self.name} is at the end of its {self._count} recorded images: open it again")
        self._count += 1
        return Frame(_colour(image), self._clock(), self._count - 1)

    # ------------------------------------------------------------------------------------------------- settings

    def _apply(self):
        """Set what was asked for, read it back, and say what is different."""
        self._before = self._clock()
        asked = {key: value["asked"] for key, value in self.settings.items() if key != "warnings"}
        self._source.set(self._capture, asked)
        warnings = []
        for key, got in self._source.got(self._capture).items():
            self.settings[key]["got"] = got
            if asked[key] is not None and not _same(asked[key], got):
                told = "cannot be set" if got is None else f"is {got}"
                warnings.append(f"camera {self.name}: {key} {told}, asked {asked[key]}")
        for text in warnings:
            if text not in self.settings["warnings"]:
                self._log.warning(text)
        self.settings["warnings"] = warnings


def _same(asked, got):
    return got is not None and bool(np.allclose(asked, got, rtol=0.05, atol=0))


def _colour(image):
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 or image.shape[2] == 1 else image
