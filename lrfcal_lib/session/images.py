"""Sizes of PNG and JPEG images by their headers, without decoding what may be made to take long."""

import struct
from os import PathLike

from lrfcal_lib.session.files import SessionError
from lrfcal_lib.session.stated import CameraInfo

PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8"
FRAMES = {*range(0xC0, 0xD0)} - {
    0xC4,
    0xC8,
    0xCC,
}  # second bytes of the markers of frame headers
# of a JPEG; programs write about twenty, and large remarks may hold the marker by chance
MOST_SEGMENTS = 10_000
# by marker, which does not occur within coded pixels; each scan takes up to 30 ms at 30 megapixels,
# programs write about ten
LIMITS = {b"\xff\xda": (100, "scans"), b"\xff\xe1": (MOST_SEGMENTS, "segments of remarks")}


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
    size = None
    if data.startswith(PNG):
        if data[12:16] == b"IHDR" and len(data) >= 24:
            size = struct.unpack(">II", data[16:24])
        end = b"IEND"
    elif data.startswith(JPEG):
        for mark, (most, things) in LIMITS.items():
            count = data.count(mark)
            if count > most:
                raise SessionError(
                    f"{file}: a JPEG of {count} {things}, more than {most}; write the image again"
                )
        size = _jpeg_size(data)
        end = b"\xff\xd9"
    else:
        raise SessionError(f"{file}: neither PNG nor JPEG; convert the image")
    if size is None or end not in data[-64:]:
        raise SessionError(
            f"{file}: the image is truncated after {len(data)} bytes; restore it or remove its row"
        )
    return size


def _jpeg_size(data):
    """Width and height from the frame header of a JPEG, None where it does not come soon."""
    at = len(JPEG)
    for _ in range(MOST_SEGMENTS):
        if len(data) < at + 9 or data[at] != 0xFF:
            return None
        if data[at + 1] in FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        if data[at + 1] == 0xFF:  # a byte that fills up
            at += 1
        else:
            (length,) = struct.unpack_from(">H", data, at + 2)
            at += 2 + length
    return None


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
