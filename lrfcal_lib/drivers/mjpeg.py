"""Motion JPEG over HTTP, read without the buffers that make a general video reader hand out frames late."""

from __future__ import annotations

import base64
import contextlib
import http.client
import re
import select
from urllib.parse import unquote, urlsplit

import cv2
import numpy as np

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
