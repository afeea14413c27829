"""Colour cameras: devices, streams and files; the newest frame with the time of its grab."""

import contextlib
import glob
import logging
import math
import os
import re
import select
import threading
from dataclasses import dataclass

import cv2
import numpy as np
import requests
from urllib3.exceptions import HTTPError

from lrfcal_lib.drivers.port import REAL, Closed, DeviceError, LineLost, NoReply, PortError
from lrfcal_lib.session.files import short

LOG = logging.getLogger(__name__)
# of a JPEG file; inside of its image data they cannot occur
BEGIN = b"\xff\xd8"
END = b"\xff\xd9"
LENGTH = re.compile(rb"content-length:\s*(\d+)", re.IGNORECASE)
CHUNK = 1 << 16  # bytes that are read at once
LONGEST = 1 << 26  # bytes of an image of a stream
EXPOSURE_UNIT_S = 1e-4  # of V4L2
MANUAL = 1  # exposure mode of V4L2
SAME_EXPOSURE = 0.05  # share by which that of a camera may differ from what was asked for
WIDTH = cv2.CAP_PROP_FRAME_WIDTH
HEIGHT = cv2.CAP_PROP_FRAME_HEIGHT
AGAIN_S = 0.25  # between attempts to find a lost device
CLOSE_S = 2.0  # longest wait for a frame that is being grabbed
# We say once that a camera is lost: FFmpeg and OpenCV would at every attempt to find it.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # quiet
if "OPENCV_LOG_LEVEL" not in os.environ:
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)


@dataclass(frozen=True)
class Frame:
    """One image."""

    image: np.ndarray  # (height, width, 3) of uint8, BGR
    time_s: float  # host time at which it was grabbed; the exposure was before it
    index: int  # frames grabbed before it; gaps are frames that nobody asked for in time


class Camera(Closed):
    """A camera, set to what is asked for; a context manager.

    A live source (V4L2 device, URL) is grabbed by a thread that keeps the newest frame only, and
    that looks for the source again when it is lost. A recorded one (video file, images) gives its
    next image each time it is asked.

    Parameters
    ----------
    source
        V4L2 index or path (/dev/video0), URL, video file, or images as OpenCV counts them, such as
        ``"images/%04d.png"``.
    name
        For messages.
    size
        Width and height, pixels; by default as it is. The attribute tells whether it was obeyed.
    exposure
        Seconds; by default the camera's automatic exposure is left alone. Another one is logged.
    silence_s
        A stream that sends nothing for so long is taken for lost and opened again.

    Attributes
    ----------
    size : tuple of int or None
        Width and height that it gives, pixels; None where that is unknown.
    lost : bool
        A live source gave no frame when it should have, and was not found again yet; a recorded one
        is at its end.

    Raises
    ------
    PortError
        If the source is missing, forbidden, busy, or no camera.
    """

    def __init__(
        self,
        source: int | str | os.PathLike,
        *,
        name: str,
        size: tuple[int, int] | None = None,
        exposure: float | None = None,
        silence_s: float = 10.0,
    ):
        self.name = name
        self.lost = False
        self._path = str(source)
        if self._path.isdigit():
            self._path = f"/dev/video{self._path}"
        self._silence_s = silence_s
        self._remedy = remedy_of(self._path)  # of a live source
        self._frame: Frame | None = None
        self._count = 0
        self._new = threading.Condition()
        self._quit = threading.Event()
        self._wanted = {}  # what a device is to be set to, by the keys of OpenCV
        if self._path.startswith("/dev/"):
            self._wanted[cv2.CAP_PROP_BUFFERSIZE] = 1
            if size is not None:
                self._wanted[WIDTH], self._wanted[HEIGHT] = size
            if exposure is not None:
                self._wanted[cv2.CAP_PROP_AUTO_EXPOSURE] = MANUAL
                self._wanted[cv2.CAP_PROP_EXPOSURE] = round(exposure / EXPOSURE_UNIT_S)
        self._open()
        self._read_back(exposure)
        if self._remedy:
            self._thread = threading.Thread(
                target=self._grab, name=f"camera {name}", daemon=True
            )
            self._thread.start()

    def newest(self, after: float = -math.inf, timeout: float = 5.0) -> Frame:
        """The newest frame; of a recorded source the next image.

        Parameters
        ----------
        after
            Date of the host, s, later than which it is grabbed.
        timeout
            Seconds to wait for it.

        Raises
        ------
        LineLost
            If the source is lost and did not come back in time, or a recorded one is at its end.
        NoReply
            If no such frame came in time.
        DeviceError
            If the camera was closed.
        """

        def fresh():
            frame = self._frame
            return frame is not None and frame.time_s > after

        with self._new:
            if self._remedy:
                self._new.wait_for(lambda: self._quit.is_set() or fresh(), timeout)
            if self._quit.is_set():
                raise DeviceError(f"camera {self.name} is closed: open it again")
            if not self._remedy:
                return self._next()
            if fresh():
                return self._frame
        if self.lost:
            raise LineLost(f"camera {self.name} is lost: {self._remedy}")
        raise NoReply(
            f"camera {self.name} gave no new frame in {timeout:g} s: {self._remedy}"
        )

    def close(self) -> None:
        """Close the source; a second call does nothing."""
        self._quit.set()
        with self._new:
            self._new.notify_all()
        if self._remedy:
            self._thread.join(CLOSE_S)
        else:
            self._capture.release()

    # ---------------------------------------------------------------------------------------------
    # settings

    def _open(self):
        self._capture = open_source(self._path, self._silence_s)
        self._before = REAL.time()
        self._taken = {
            key for key, value in self._wanted.items() if self._capture.set(key, value)
        }

    def _read_back(self, exposure):
        """The size that it gives; an exposure that is not as asked for is logged."""
        capture = self._capture
        self.size = (int(capture.get(WIDTH)), int(capture.get(HEIGHT)))
        if min(self.size) <= 0:
            self.size = None
        if exposure is None:
            return
        given_s = 0.0
        if cv2.CAP_PROP_EXPOSURE in self._taken:
            given_s = capture.get(cv2.CAP_PROP_EXPOSURE) * EXPOSURE_UNIT_S
        if given_s <= 0:
            LOG.warning("camera %s: exposure cannot be set, asked %s", self.name, exposure)
        elif abs(given_s - exposure) > SAME_EXPOSURE * exposure:
            LOG.warning("camera %s: exposure is %s, asked %s", self.name, given_s, exposure)

    # ---------------------------------------------------------------------------------------------
    # grabbing

    def _next(self):
        """The next image of a recorded source."""
        self.lost = not self._capture.grab() or not self._keep(REAL.time())
        if self.lost:
            raise LineLost(
                f"camera {self.name} is at the end of its {self._count} recorded images: open it "
                "again"
            )
        return self._frame

    def _grab(self):
        """Keep the newest frame; this thread alone touches the source."""
        while not self._quit.is_set():
            if not self._capture.grab():
                self._lose()
                continue
            now = REAL.time()
            waited = getattr(self._capture, "waited", True)
            # else it may have come at any time since the frame before
            self._keep(now if waited else self._before)
            self._before = now
        self._capture.release()

    def _keep(self, instant):
        """Decode what was grabbed; whether that was an image."""
        done, image = self._capture.retrieve()
        if not done:
            return False
        with self._new:
            self._frame = Frame(image, instant, self._count)
            self._count += 1
            if self.lost:
                LOG.warning("camera %s is back", self.name)
            self.lost = False
            self._new.notify_all()
        return True

    def _lose(self):
        """Forget the last frame, and look for the source."""
        with self._new:
            if not self.lost:
                LOG.warning("camera %s is lost: %s", self.name, self._remedy)
            self.lost = True
            self._frame = None
        self._capture.release()
        if not self._quit.wait(AGAIN_S):
            with contextlib.suppress(PortError):
                self._open()


# ---------------------------------------------------------------------------------------- sources


def remedy_of(path: str) -> str:
    """What to do about a live source that is lost; '' for files, which cannot be lost.

    Parameters
    ----------
    path
        Of the source.
    """
    if "://" in path:
        return f"open {path} in a browser, and check network and power of the camera"
    if path.startswith("/dev/"):
        return f"check the plug of {path}, and what 'v4l2-ctl --list-devices' shows"
    return ""


def open_source(path: str, silence_s: float):
    """Open what a path names.

    Parameters
    ----------
    path
        See :class:`Camera`.
    silence_s
        After which a stream is at its end.

    Returns
    -------
    cv2.VideoCapture or MjpegStream
        Either is read like the first.

    Raises
    ------
    PortError
        If the source is missing, forbidden, busy, or no camera.
    """
    if "://" in path:
        return _open_stream(path, silence_s)
    if path.startswith("/dev/"):
        return _open_device(path)
    return _opened(
        f"{path} is no video that OpenCV can read: name a device, a URL, a video file, or numbered "
        "images such as images/%04d.png",
        path,
    )


def _opened(message, *arguments):
    """An OpenCV capture; a PortError with the message if it cannot be opened."""
    capture = cv2.VideoCapture(*arguments)
    if not capture.isOpened():
        capture.release()
        raise PortError(message)
    return capture


def _open_device(path):
    if not os.path.exists(path):
        present = short(sorted(glob.glob("/dev/video*")))
        raise PortError(f"there is no camera {path}: check its plug; present are {present}")
    if not os.access(path, os.R_OK | os.W_OK):
        raise PortError(
            f"no permission for {path}: run 'sudo usermod -aG video $USER', then log in again"
        )
    return _opened(
        f"{path} gives no video: close other programs that use it, or name another device",
        path,
        cv2.CAP_V4L2,
    )


def _open_stream(path, silence_s):
    """MJPEG over HTTP with our own reader, anything else with FFmpeg."""
    if path.startswith("http"):
        with contextlib.suppress(OSError):
            stream = MjpegStream(path, silence_s)
            if stream.multipart:
                return stream
            stream.release()
    wait = round(1000 * silence_s)
    waits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, wait, cv2.CAP_PROP_READ_TIMEOUT_MSEC, wait]
    return _opened(f"{path} gives no video: {remedy_of(path)}", path, cv2.CAP_FFMPEG, waits)


class MjpegStream:
    """Images of an MJPEG stream, which are read like cv2.VideoCapture.

    Parameters
    ----------
    url
        Of the stream.
    timeout
        To connect and between any two bytes, seconds.

    Attributes
    ----------
    multipart : bool
        The answer is a stream of images; anything else is not read.
    waited : bool
        The frame grabbed last was waited for; otherwise it came at some time since the one before.

    Raises
    ------
    OSError
        If nothing answers, or the URL names none.
    """

    def __init__(self, url: str, timeout: float):
        self._buffer = b""
        self._image = b""
        self._held = False  # the image is the next one
        self.waited = False
        session = requests.Session()
        session.trust_env = False  # no proxy: cameras are near
        try:
            self._answer = session.get(url, stream=True, timeout=timeout).raw
        except ValueError as error:  # names that no host can have
            raise OSError(f"no address of a stream: {error}") from error
        kind = self._answer.headers.get("Content-Type", "").lower()
        self.multipart = self._answer.status == 200 and kind.startswith("multipart/")
        self.release = self._answer.close

    def grab(self) -> bool:
        """Take the next image; False at the end of the stream, or after a silence."""
        if not self._held:
            self.waited = False
            self._image = self._next()
        self._held = False
        return bool(self._image)

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        """Decode the image grabbed last: whether it is one, and its pixels."""
        image = None
        if self._image:
            image = cv2.imdecode(np.frombuffer(self._image, np.uint8), cv2.IMREAD_COLOR)
        return image is not None, image

    def get(self, key: int) -> float:
        """Size of the first image, which is kept for the next grab.

        Parameters
        ----------
        key
            ``cv2.CAP_PROP_FRAME_WIDTH`` or ``cv2.CAP_PROP_FRAME_HEIGHT``.

        Returns
        -------
        float
            Pixels; 0 for what is unknown.
        """
        self._held = self._held or self.grab()
        _, image = self.retrieve()
        if image is None:
            return 0.0
        return image.shape[(HEIGHT, WIDTH).index(key)]

    def _next(self):
        """The next whole image: as long as is stated before it (it may hold another one), else up
        to its end; b'' where there is none any more.
        """
        while True:
            before, begin, rest = self._buffer.partition(BEGIN)
            size = rest.find(END) + len(END)
            if stated := LENGTH.findall(before):
                size = int(stated[-1]) - len(BEGIN)
            if len(END) <= size <= len(rest):
                self._buffer = rest[size:]
                return begin + rest[:size]
            more = b""
            if len(self._buffer) <= LONGEST:
                # ValueError: the answer was closed
                with contextlib.suppress(OSError, ValueError, HTTPError):
                    self.waited |= not select.select([self._answer], [], [], 0)[0]
                    more = self._answer.read1(CHUNK)
            if not more:
                return b""
            self._buffer += more
