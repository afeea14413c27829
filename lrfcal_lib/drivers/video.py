"""Colour cameras: devices, streams and files; the newest frame with the time at which it was
grabbed.
"""

import contextlib
import glob
import logging
import os
import re
import select
import threading
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import requests
from urllib3.exceptions import HTTPError

from lrfcal_lib.drivers.port import REAL, Closed, DeviceError, LineLost, NoReply, PortError

LOG = logging.getLogger(__name__)
# of a JPEG file; inside of its image data they cannot occur
BEGIN = b"\xff\xd8"
END = b"\xff\xd9"
LENGTH = re.compile(rb"content-length:\s*(\d+)", re.IGNORECASE)
CHUNK = 1 << 16
LONGEST = 1 << 26
EXPOSURE_UNIT_S = 1e-4  # of V4L2
MANUAL = 1  # exposure mode of V4L2
WIDTH = cv2.CAP_PROP_FRAME_WIDTH
HEIGHT = cv2.CAP_PROP_FRAME_HEIGHT
FPS = cv2.CAP_PROP_FPS
IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm", ".pgm"}
AGAIN_S = 0.25  # between attempts to find a lost device
CLOSE_S = 2.0  # longest wait for a frame that is being grabbed
# A camera that is lost is told once, by us: FFmpeg and OpenCV would say so at every attempt to find
# it.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # quiet
if "OPENCV_LOG_LEVEL" not in os.environ:
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)


class Images:
    """Encoded images that are read like cv2.VideoCapture; ``take()`` gives the next one, None at
    the end.
    """

    def __init__(self):
        self._image = b""
        self._held = False

    def grab(self):
        """Take the next image, if there is one."""
        if not self._held:
            self._image = self.take()
        self._held = False
        return self._image is not None

    def retrieve(self):
        """Decode the image grabbed last: (True, image) or (False, None)."""
        image = (
            cv2.imdecode(np.frombuffer(self._image, np.uint8), cv2.IMREAD_COLOR)
            if self._image
            else None
        )
        return image is not None, image

    def get(self, key):
        """Size of the image grabbed last, or of the first, which is kept for the next grab; 0 for
        what is unknown.
        """
        if self._image == b"":
            self._held = self.grab()
        done, image = self.retrieve()
        height, width = image.shape[:2] if done else (0, 0)
        return float({WIDTH: width, HEIGHT: height}.get(key, 0))


class MjpegStream(Images):
    """Images of an MJPEG stream; `timeout` in s, to connect and between any two bytes.

    `multipart`: the answer is a stream of images; anything else is not read. `waited`: the frame
    grabbed last was waited for; otherwise it came at some time since the one before. OSError if
    nothing answers, or the URL names none.
    """

    def __init__(self, url, timeout):
        super().__init__()
        self._buffer = b""
        self.waited = False
        session = requests.Session()
        session.trust_env = False  # no proxy: cameras are near
        try:
            self._answer = session.get(url, stream=True, timeout=timeout).raw
        except ValueError as error:  # names that no host can have
            raise OSError(f"no address of a stream: {error}") from error
        kind = self._answer.headers.get("Content-Type", "")
        self.multipart = self._answer.status == 200 and kind.lower().startswith("multipart/")
        self.release = self._answer.close

    def grab(self):
        """Take the next image; False at the end of the stream, or after a silence."""
        self.waited = False
        return super().grab()

    def take(self):
        """The next whole image: as long as is stated before it (it may hold another one), else up
        to its end.
        """
        while True:
            begin = self._buffer.find(BEGIN)
            stated = LENGTH.findall(self._buffer[: max(begin, 0)])
            end = begin + int(stated[-1]) if stated else self._buffer.find(END, begin) + len(END)
            if begin >= 0 and len(END) <= end <= len(self._buffer):
                image = self._buffer[begin:end]
                self._buffer = self._buffer[end:]
                return image
            if self._answer.closed or len(self._buffer) > LONGEST:  # at its end or after a silence
                return None
            try:
                self.waited |= not select.select([self._answer], [], [], 0)[0]
                some = self._answer.read1(CHUNK)
            except (OSError, ValueError, HTTPError):  # ValueError: the answer was closed
                return None
            if not some:
                return None
            self._buffer += some


class Files(Images):
    """Image files in the order of their names."""

    def __init__(self, path):
        super().__init__()
        paths = Path(path).iterdir() if os.path.isdir(path) else map(Path, glob.glob(path))
        self._left = sorted(one for one in paths if one.suffix.lower() in IMAGES)
        if not self._left:
            raise PortError(f"there are no images in {path}: name a folder or pattern with some")

    def take(self):
        """Content of the next file."""
        self._path, *self._left = self._left or [None]
        return self._path and self._path.read_bytes()

    def retrieve(self):
        """Decode it: (True, image)."""
        done, image = super().retrieve()
        if not done:
            raise PortError(f"{self._path} is no image that OpenCV can read")
        return done, image

    def release(self):
        """Nothing is open."""


def _opened(message, *arguments):
    """An OpenCV capture; a PortError with the message if it cannot be opened."""
    capture = cv2.VideoCapture(*arguments)
    if not capture.isOpened():
        capture.release()
        raise PortError(message)
    return capture


def _open_device(path):
    if not os.path.exists(path):
        there = ", ".join(sorted(glob.glob("/dev/video*"))) or "none"
        raise PortError(f"there is no camera {path}: check its plug; present are {there}")
    if not os.access(path, os.R_OK | os.W_OK):
        raise PortError(
            f"no permission for {path}: run 'sudo usermod -aG video $USER', then log in again"
        )
    busy = f"{path} gives no video: close other programs that use it, or name another device"
    return _opened(busy, path, cv2.CAP_V4L2)


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


def remedy_of(path):
    """What to do about a live source that is lost; '' for files, which cannot be lost."""
    if "://" in path:
        return f"open {path} in a browser, and check network and power of the camera"
    is_device = path.startswith("/dev/")
    return (
        f"check the plug of {path}, and what 'v4l2-ctl --list-devices' shows" if is_device else ""
    )


def open_source(path, silence_s):
    """What a path names, see :class:`Camera`: it reads like cv2.VideoCapture."""
    if "://" in path:
        return _open_stream(path, silence_s)
    if path.startswith("/dev/"):
        return _open_device(path)
    pattern = glob.has_magic(path) and not os.path.exists(path)
    if os.path.isdir(path) or pattern or Path(path).suffix.lower() in IMAGES:
        return Files(path)
    if not os.path.exists(path):
        raise PortError(
            f"there is no video {path}: name a file, a device, a folder of images or a URL"
        )
    return _opened(f"{path} is no video that OpenCV can read", path)


@dataclass(frozen=True)
class Frame:
    """One image."""

    image: np.ndarray  # (height, width, 3) of uint8, BGR
    time_s: float  # host time at which it was grabbed; the exposure was before it
    index: int  # frames grabbed before it; gaps are frames that nobody asked for in time


class Camera(Closed):
    """A camera, set to what is asked for; what could not be set is logged. A context manager.

    A live source (V4L2 device, URL) is grabbed by a thread that keeps the newest frame only, and
    that looks for the source again when it is lost. A recorded one (video file, images) gives its
    next image each time it is asked.

    Parameters
    ----------
    source : int, str or Path
        V4L2 index or path (/dev/video0), URL, video file, image, folder of images, or pattern such
        as ``"images/*.png"``.
    name : str
    size : (int, int), optional
        Width and height, pixels.
    exposure : float, optional
        s; by default the camera's automatic exposure is left alone.
    fps : float, optional
    silence_s : float
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

    def __init__(self, source, *, name, size=None, exposure=None, fps=None, silence_s=10.0):
        self._asked = {
            "size": None if size is None else tuple(size),
            "exposure": exposure,
            "fps": fps,
        }
        self.name = name
        self.lost = False
        self._told = set()
        path = os.fspath(source) if not isinstance(source, int) else str(source)
        self._path = f"/dev/video{path}" if path.isdigit() else path
        self._silence_s = silence_s
        self._remedy = remedy_of(self._path)
        self._frame = None
        self._count = 0
        self._new = threading.Condition()
        self._quit = threading.Event()
        self._capture = open_source(self._path, self._silence_s)
        self._apply()
        self._thread = None
        if self._remedy:
            self._thread = threading.Thread(target=self._grab, name=f"camera {name}", daemon=True)
            self._thread.start()

    def newest(self, after=None, timeout=5.0):
        """The newest frame within so many seconds, grabbed later than `after` by the host's clock
        if that is given.

        A recorded source gives its next image.

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

        def there():
            return self._frame is not None and (after is None or self._frame.time_s > after)

        with self._new:
            if self._thread is not None:
                self._new.wait_for(lambda: self._quit.is_set() or there(), timeout)
            if self._quit.is_set():
                raise DeviceError(f"camera {self.name} is closed: open it again")
            if self._thread is None:
                self.lost = not self._capture.grab() or not self._keep(REAL.time())
                if self.lost:
                    raise LineLost(
                        f"camera {self.name} is at the end of its {self._count} recorded images: "
                        "open it again"
                    )
                return self._frame
            if there():
                return self._frame
        if self.lost:
            raise LineLost(f"camera {self.name} is lost: {self._remedy}")
        raise NoReply(f"camera {self.name} gave no new frame in {timeout:g} s: {self._remedy}")

    def close(self):
        """Close the source; a second call does nothing."""
        self._quit.set()
        with self._new:
            self._new.notify_all()
        if self._thread is not None:
            self._thread.join(CLOSE_S)
        else:
            self._release()

    # ---------------------------------------------------------------------------------------------
    # grabbing

    def _release(self):
        if self._capture is not None:
            self._capture.release()
        self._capture = None

    def _grab(self):
        """Keep the newest frame; this thread alone touches the source."""
        while not self._quit.is_set():
            if self._capture is None or not self._capture.grab():
                self._lose()
                continue
            now = REAL.time()
            # what was there at once may have come at any time since the frame before
            self._keep(now if getattr(self._capture, "waited", True) else self._before)
            self._before = now
        self._release()

    def _keep(self, instant):
        """Decode what was grabbed, three channels of it; whether that was an image."""
        done, image = self._capture.retrieve()
        if done:
            grey = image.ndim == 2 or image.shape[2] == 1
            with self._new:
                self._frame = Frame(
                    cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if grey else image, instant, self._count
                )
                self._count += 1
                if self.lost:
                    LOG.warning("camera %s is back", self.name)
                self.lost = False
                self._new.notify_all()
        return done

    def _lose(self):
        """Forget the last frame, and look for the source."""
        with self._new:
            if not self.lost:
                LOG.warning("camera %s is lost: %s", self.name, self._remedy)
            self.lost = True
            self._frame = None
        self._release()
        if not self._quit.wait(AGAIN_S):
            with contextlib.suppress(PortError):
                self._capture = open_source(self._path, self._silence_s)
                self._apply()

    def _apply(self):
        """Set what was asked for, of devices, read it back, and say what is different."""
        self._before = REAL.time()
        capture = self._capture
        asked = self._asked
        ticks = 0
        if self._path.startswith("/dev/"):
            exposure = (
                None if asked["exposure"] is None else round(asked["exposure"] / EXPOSURE_UNIT_S)
            )
            wanted = {
                cv2.CAP_PROP_BUFFERSIZE: 1,
                **dict(zip((WIDTH, HEIGHT), asked["size"] or (), strict=False)),
                FPS: asked["fps"],
                cv2.CAP_PROP_AUTO_EXPOSURE: exposure and MANUAL,
                cv2.CAP_PROP_EXPOSURE: exposure,
            }
            done = {
                key: capture.set(key, value) for key, value in wanted.items() if value is not None
            }
            ticks = capture.get(cv2.CAP_PROP_EXPOSURE) * done.get(cv2.CAP_PROP_EXPOSURE, True)
        size = (int(capture.get(WIDTH)), int(capture.get(HEIGHT)))
        self.size = size if all(size) else None
        found = {
            "size": self.size,
            "exposure": ticks * EXPOSURE_UNIT_S if ticks > 0 else None,
            "fps": capture.get(FPS) or None,
        }
        for key, got in found.items():
            if (
                asked[key] is None
                or got is not None
                and np.allclose(asked[key], got, rtol=0.05, atol=0)
            ):
                continue
            text = (
                f"camera {self.name}: {key} {'cannot be set' if got is None else f'is {got}'}, "
                f"asked {asked[key]}"
            )
            if text not in self._told:  # once, however often it is opened again
                self._told.add(text)
                LOG.warning(text)
