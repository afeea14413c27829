"""Sizes of PNG and JPEG images by their headers, without decoding what may be made to take long."""

import struct
from io import BytesIO
from os import PathLike

import cv2
import numpy as np
from PIL import Image

from lrfcal_lib.session.files import SessionError, reading
from lrfcal_lib.session.stated import CameraInfo

PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8"
HEADER = 1 << 19  # bytes in which the size stands, whatever remarks are before it
# by marker, which does not occur within coded pixels; each scan takes up to 30 ms at 30 megapixels,
# programs write about ten
LIMITS = {b"\xff\xda": (100, "scans"), b"\xff\xe1": (10_000, "segments of remarks")}


def encode_jpeg(image: np.ndarray, quality: int) -> bytes:
    """Content of a JPEG file.

    Parameters
    ----------
    image
        (height, width, 3), blue, green, red.
    quality
        1 to 100.
    """
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def image_size(file: str | PathLike, data: bytes) -> tuple[int, int]:
    """Width and height of a PNG or JPEG image from its header, pixels.

    Parameters
    ----------
    file
        For messages.
    data
        Its content.

    Raises
    ------
    SessionError
        If it is cut off, or neither; also for a JPEG that would take long to decode, or much
        memory, by its number of scans or of segments with remarks.
    """
    end = b"IEND"
    if data.startswith(JPEG):
        end = b"\xff\xd9"
        for mark, (most, things) in LIMITS.items():
            count = data.count(mark)
            if count > most:
                raise SessionError(
                    f"{file}: a JPEG of {count} {things}, more than {most}; write the image again"
                )
    elif not data.startswith(PNG):
        raise SessionError(f"{file}: neither PNG nor JPEG; convert the image")
    cut = f"the image is truncated after {len(data)} bytes; restore it or remove its row"
    if end not in data[-64:]:
        raise SessionError(f"{file}: {cut}")
    with reading(file, cut):
        # of a PNG the size is first; Pillow goes on to the pixels, behind all remarks
        if end == b"IEND":
            return struct.unpack_from(">II", data, len(PNG) + 8)
        with Image.open(BytesIO(data[:HEADER]), formats=["JPEG"]) as image:
            return image.size


def check_image_size(
    file: str | PathLike,
    data: bytes,
    camera: CameraInfo,
    size: tuple[int, int] | None = None,
) -> None:
    """Refuse an image of another size than its camera's.

    Parameters
    ----------
    file
        For messages.
    data
        Its content.
    camera
    size
        That of the decoded image, pixels; by default that of its header.

    Raises
    ------
    SessionError
    """
    width, height = size or image_size(file, data)
    if (width, height) != (camera.width, camera.height):
        raise SessionError(
            f"{file}: {width} x {height} pixels, but camera '{camera.name}' has {camera.width} x "
            f"{camera.height}; intrinsics hold for one image size only"
        )
