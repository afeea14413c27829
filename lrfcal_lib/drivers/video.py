"""Colour cameras: devices, streams and files; the newest frame with the time at which it was grabbed."""

from __future__ import annotations

import base64
import contextlib
import glob
import http.client
import logging
import os
import re
import select
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote, urlsplit

import cv2
import numpy as np

from lrfcal_lib.drivers.port import DeviceError, LineLost, NoReply, PortError

END = b"\xff\xd9"  # of a JPEG file; inside of its image data it cannot occur
CHUNK, LONGEST = 1 << 16, 1 << 26
LENGTH = re.compile(rb"content-length:\s*(\d+)", re.IGNORECASE)


class MjpegStream:
    """Reads like cv2.VideoCapture.

    Parameters
    ----------
    url : str
        http or https, a user and password may stand before the host.
    timeout : float
        s, to connect and between any two bytes.

    Attributes
    ----------
    multipart : bool
        The answer is a stream of images; anything else is not read.
    waited : bool
        The frame grabbed last was waited for; otherwise it came at some time since the one before.

    Raises
    ------
    OSError
        If nothing answers, or the URL names no host.
    """

    def __init__(self, url, timeout):
        self._buffer, self._image, self._held, self.waited = b"", None, False, False
        try:
            parts = urlsplit(url)
            kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
            self._connection = kind(parts.hostname or "", parts.port, timeout=timeout)
        except (ValueError, http.client.HTTPException) as error:
            raise OSError(f"no address of a stream: {error}") from error
        try:
            self._connection.connect()
            self._socket = self._connection.sock
            target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
            self._connection.request("GET", target, headers=_authorisation(parts))
            self._answer = self._connection.getresponse()
        except (OSError, ValueError, http.client.HTTPException) as error:  # ValueError: names that no host can have
            self._connection.close()
            raise OSError(f"no answer: {error}") from error
        self.status = self._answer.status
        self.multipart = self.status == 200 and self._answer.headers.get_content_maintype() == "multipart"

    def grab(self):
        """Read one whole image; False at the end of the stream, or after a silence."""
        self.waited = False
        if self._held:
            self._held = False
            return True
        try:
            head = self._upto(b"\r\n\r\n")
            while not (fields := head.strip(b"\r\n")) or b":" not in fields:
                head = self._upto(b"\r\n\r\n")
            stated = LENGTH.search(fields)
            self._image = self._count(int(stated[1])) if stated else self._upto(END)
        except (OSError, EOFError, ValueError, http.client.HTTPException):  # ValueError: the answer was closed
            return False
        return True

    def retrieve(self):
        """Decode the image grabbed last: (True, image) or (False, None)."""
        image = cv2.imdecode(np.frombuffer(self._image, np.uint8), cv2.IMREAD_COLOR) if self._image else None
        return image is not None, image

    def get(self, key):
        """Size of the image grabbed last, or of the first, which is kept for the next grab; 0 for what is unknown."""
        if self._image is None:
            self._held = self.grab()
        done, image = self.retrieve()
        height, width = image.shape[:2] if done else (0, 0)
        return float({cv2.CAP_PROP_FRAME_WIDTH: width, cv2.CAP_PROP_FRAME_HEIGHT: height}.get(key, 0))

    def release(self):
        """Close the connection."""
        with contextlib.suppress(OSError):
            self._socket.close()
        self._connection.close()

    def _fill(self):
        if self._socket.fileno() < 0:  # the answer closed it, at its end or after a silence
            raise EOFError
        self.waited |= not select.select([self._socket], [], [], 0)[0]
        if not (some := self._answer.read1(CHUNK)) or len(self._buffer) > LONGEST:
            raise EOFError
        self._buffer += some

    def _upto(self, mark):
        """Bytes up to a mark and with it."""
        seen = 0
        while (end := self._buffer.find(mark, seen)) < 0:
            seen = max(0, len(self._buffer) - len(mark) + 1)
            self._fill()
        return self._count(end + len(mark))

    def _count(self, count):
        while len(self._buffer) < count:
            self._fill()
        taken, self._buffer = self._buffer[:count], self._buffer[count:]
        return taken


def _authorisation(parts):
    if parts.username is None:
        return {}
    words = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
    return {"Authorization": "Basic " + base64.b64encode(words.encode()).decode()}


EXPOSURE_UNIT_S = 1e-4  # of V4L2
MANUAL = 1  # exposure mode of V4L2
IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm", ".pgm"}


def find_source(source, silence_s):
    """What kind of source is meant.

    Parameters
    ----------
    source : int, str or Path
        As of :meth:`lrfcal_lib.drivers.video.Camera.open`.
    silence_s : float
        Longest wait for a stream to open, and for its next frame.

    Returns
    -------
    object
        Has ``path``, ``live``, ``remedy`` and the methods ``open()``, ``set(capture, asked)`` and
        ``got(capture)``.
    """
    text = os.fspath(source) if not isinstance(source, int) else str(source)
    if text.isdigit():
        text = f"/dev/video{text}"
    if "://" in text:
        return _Stream(text, silence_s)
    if text.startswith("/dev/"):
        return _Device(text)
    if os.path.isdir(text) or glob.has_magic(text) and not os.path.exists(text) or _is_image(text):
        return _Images(text)
    return _Video(text)


def _is_image(path):
    return Path(path).suffix.lower() in IMAGES


class _Source:
    """What the kinds of source have in common."""

    live = False
    remedy = "look at its file"

    def __init__(self, path):
        self.path = path

    def set(self, capture, asked):
        """Nothing can be set."""

    def got(self, capture):
        size = tuple(int(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        return {"size": size if all(size) else None, "exposure": None, "fps": capture.get(cv2.CAP_PROP_FPS) or None}


class _Device(_Source):
    """A V4L2 device."""

    live = True

    @property
    def remedy(self):
        return f"check the plug of {self.path}, and what 'v4l2-ctl --list-devices' shows"

    def open(self):
        """Open the device; a PortError says what is in the way."""
        if not os.path.exists(self.path):
            there = ", ".join(sorted(glob.glob("/dev/video*"))) or "none"
            raise PortError(f"there is no camera {self.path}: check its plug; present are {there}")
        if not os.access(self.path, os.R_OK | os.W_OK):
            raise PortError(f"no permission for {self.path}: run 'sudo usermod -aG video $USER', then log in again")
        capture = cv2.VideoCapture(self.path, cv2.CAP_V4L2)
        if not capture.isOpened():
            capture.release()
            raise PortError(f"{self.path} gives no video: close other programs that use it, or name another device")
        return capture

    def set(self, capture, asked):
        """Ask for size, frames a second and exposure; what came of it is read back by `got`."""
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        if asked["size"] is not None:
            for key, value in zip((cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT), asked["size"], strict=True):
                capture.set(key, value)
        if asked["fps"] is not None:
            capture.set(cv2.CAP_PROP_FPS, asked["fps"])
        self.exposure_set = True
        if asked["exposure"] is not None:
            capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL)
            self.exposure_set = capture.set(cv2.CAP_PROP_EXPOSURE, round(asked["exposure"] / EXPOSURE_UNIT_S))

    def got(self, capture):
        ticks = capture.get(cv2.CAP_PROP_EXPOSURE) if self.exposure_set else 0
        return super().got(capture) | {"exposure": ticks * EXPOSURE_UNIT_S if ticks > 0 else None}


class _Stream(_Source):
    """A stream from the network."""

    live = True

    def __init__(self, path, silence_s):
        super().__init__(path)
        self.silence_s = silence_s

    @property
    def remedy(self):
        return f"open {self.path} in a browser, and check network and power of the camera"

    def open(self):
        """Connect: MJPEG over HTTP with our own reader, anything else with FFmpeg."""
        if self.path.startswith("http"):
            with contextlib.suppress(OSError):
                stream = MjpegStream(self.path, self.silence_s)
                if stream.multipart:
                    return stream
                stream.release()
        wait = round(1000 * self.silence_s)
        waits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, wait, cv2.CAP_PROP_READ_TIMEOUT_MSEC, wait]
        capture = cv2.VideoCapture(self.path, cv2.CAP_FFMPEG, waits)
        if not capture.isOpened():
            capture.release()
            raise PortError(f"{self.path} gives no video: {self.remedy}")
        return capture


class _Video(_Source):
    """A video file."""

    def open(self):
        """Open the file; a PortError says what is wrong with it."""
        if not os.path.exists(self.path):
            raise PortError(f"there is no video {self.path}: name a file, a device, a folder of images or a URL")
        capture = cv2.VideoCapture(self.path)
        if not capture.isOpened():
            capture.release()
            raise PortError(f"{self.path} is no video that OpenCV can read")
        return capture


class _Images(_Source):
    """Images in the order of their names."""

    def open(self):
        paths = sorted(Path(self.path).iterdir()) if os.path.isdir(self.path) else map(Path, glob.glob(self.path))
        paths = sorted(path for path in paths if _is_image(path))
        if not paths:
            raise PortError(f"there are no images in {self.path}: name a folder or pattern with some")
        return _Files(paths)

    def got(self, capture):
        return {"size": capture.size(), "exposure": None, "fps": None}


class _Files:
    """Image files that are read like a video."""

    def __init__(self, paths):
        self.paths, self.row = paths, 0

    def read(self):
        """Next image, as VideoCapture.read."""
        if self.row == len(self.paths):
            return False, None
        image = cv2.imread(os.fspath(self.paths[self.row]))
        if image is None:
            raise PortError(f"{self.paths[self.row]} is no image that OpenCV can read")
        self.row += 1
        return True, image

    def size(self):
        """Width and height of the first one."""
        image = cv2.imread(os.fspath(self.paths[0]))
        return None if image is None else (image.shape[1], image.shape[0])

    def release(self):
        """Nothing is open."""
        self.row = len(self.paths)


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
