"""Where images come from: V4L2 devices, network streams, video files, image files.

Every kind opens something that reads like cv2.VideoCapture, sets what can be set, and reads back what there is.
"""

from __future__ import annotations

import contextlib
import glob
import os
from pathlib import Path

import cv2

from lrfcal_lib.drivers.errors import PortError
from lrfcal_lib.drivers.mjpeg import MjpegStream

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
