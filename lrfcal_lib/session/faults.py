"""What cannot be right about a recording, as far as its files alone show it."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import compress

import numpy as np

from lrfcal_lib.session.files import read_bytes, short

MANY = 0.2  # share of a camera's images: where more are wrong nothing can rest on them
# quantile of the grey levels that the brightest surface of an image has at least
WHITE = 0.995
# grey levels of 255; a white square of a chessboard has more in every image that is of use
DARK = 30
BEYOND = 0.001  # share of ranges beyond the largest one: single readings may be mirrors or the sun
SHOWN = 3  # images of a camera that are looked at


@dataclass(frozen=True)
class Fault:
    """Something about a recording, or about a calibration that rests on it, that is not right.

    Attributes
    ----------
    kind : str
        'repeated image', 'repeated scan', 'beyond range', 'field of view', 'dark'; of
        :mod:`lrfcal_lib.judge.recording_faults` also 'camera moved', 'camera zoomed',
        'exchanged', 'numbers', 'sense', 'unit'; and :class:`lrfcal_lib.judge.findings.Kind`.
    words : str
        What was found, where, and what to do about it.
    severe : bool
        Nothing that rests on it can be trusted; else it is to be used with care.
    camera : str or None
    placements : tuple of int
        Those concerned, where it is not the whole recording.
    """

    kind: str
    words: str
    severe: bool = False
    camera: str | None = None
    placements: tuple[int, ...] = ()


def faults_of_files(session) -> list[Fault]:
    """What cannot be right about a session: repetitions, ranges and bearings.

    Parameters
    ----------
    session : Session
        Opened; its images are read again.

    Returns
    -------
    list of Fault
    """
    return [
        fault
        for find in (repeated_images, repeated_scans, ranges_beyond, bearings_beyond)
        for fault in find(session)
    ]


def repeated_images(session) -> Iterator[Fault]:
    """Images whose files are the same to the byte; one Fault a pair of cameras."""
    firsts = {}  # by the hash of their content
    pairs = defaultdict(dict)  # placements by words
    for record in session.image_records:
        first = firsts.setdefault(hash(read_bytes(record.file, session.path)), record)
        if first is not record:
            names = [one.file.relative_to(session.path) for one in (record, first)]
            words = "{} is {}".format(*names)
            pairs[first.camera, record.camera][words] = record.placement
    for (first_camera, camera), same in pairs.items():
        count = len(session.images(camera))
        placements = tuple(sorted({*same.values()} - {-1}))
        cause = "a camera that stood still, or a copy"
        if first_camera != camera:
            cause = f"was the folder of camera '{first_camera}' copied?"
        yield Fault(
            "repeated image",
            f"{len(same)} of {count} images of camera '{camera}' (in placements: "
            f"{short(placements)}) are identical to others: {short(same)}: {cause}; put the right "
            "images there or remove their rows from images.csv",
            severe=len(same) > MANY * count,
            camera=camera,
            placements=placements,
        )


def repeated_scans(session) -> Iterator[Fault]:
    """Placements whose ranges are the same to the last digit: noise never repeats itself."""
    same_ranges = defaultdict(list)
    placement = session.scans["placement"]
    for number in session.placements:
        ranges = session.scans["ranges"][placement == number]
        if np.isfinite(ranges).any():
            same_ranges[len(ranges), hash(ranges.tobytes())].append(number)

    for (lines, _), numbers in same_ranges.items():
        if len(numbers) > 1:
            yield Fault(
                "repeated scan",
                f"the scans of placements {' and '.join(map(str, numbers))} are the same to the "
                f"last digit ({lines} scan lines): a copy; record one of them again or remove it "
                "from placements in session.json",
                placements=tuple(numbers),
            )


def ranges_beyond(session) -> Iterator[Fault]:
    """Ranges that the range finder cannot have measured, as session.json states it."""
    ranges = session.scans["ranges"]
    known = ranges[np.isfinite(ranges)]
    limit = session.lrf.max_range
    share = (known > limit).mean()
    if share > BEYOND:
        yield Fault(
            "beyond range",
            f"{100 * share:.3g} % of the ranges exceed the max_range_m of {limit:g} m that "
            f"session.json states (half of all ranges: {np.median(known):.3g} m or more, largest: "
            f"{known.max():.3g} m): state the range finder's own max_range_m, or convert the "
            "ranges to metres",
        )


def bearings_beyond(session) -> Iterator[Fault]:
    """Bearings, or steps between them, that are not those which session.json states."""
    lrf = session.lrf
    bearings = session.scans["bearings"]
    gaps = len(bearings) - 1
    if gaps == 0:
        return
    first, *_, last = bearings
    step = (last - first) / gaps
    low, high = lrf.field_of_view
    drift = abs(step - lrf.bearing_step) * gaps
    if max(low - first, last - high, drift) <= lrf.bearing_step / 2:
        return
    has, says = (
        "{:.5g} to {:.5g} deg in steps of {:.4g} deg".format(*np.degrees(values))
        for values in ((first, last, step), (low, high, lrf.bearing_step))
    )
    yield Fault(
        "field of view",
        f"the bearings of the scan lines (lrf) cover {has}, session.json states field_of_view_deg "
        f"and bearing_step_deg as {says}: the scan lines count; correct session.json, or the "
        "bearings if they are wrong",
    )


def brightness(image: np.ndarray) -> int:
    """Grey level of the brightest surface in an image, of every fourth pixel.

    Parameters
    ----------
    image
        Of uint8, shape (h, w, 3).
    """
    return int(np.quantile(image[::4, ::4].max(axis=2), WHITE))


def dark_images(session) -> Iterator[Fault]:
    """Cameras whose images of the board are too dark; SHOWN of each are looked at.

    Parameters
    ----------
    session : Session
    """
    for camera in session.cameras:
        records = session.images(camera, purpose="board")
        records = records[:: max(len(records) // SHOWN, 1)][:SHOWN]
        levels = [brightness(session.read_image(record)) for record in records]
        dark = [*compress(records, np.less(levels, DARK))]
        if len(dark) > len(records) / 2:
            yield Fault(
                "dark",
                f"images of camera '{camera}' are too dark ({len(dark)} of {len(records)} looked "
                f"at): the brightest surfaces of {dark[0].file.relative_to(session.path)} have "
                f"{min(levels)} of 255 grey levels, a white square needs {DARK} and more; more "
                "light, a longer exposure, or, where other values were stored (10 or 12 bits), "
                "convert the images",
                camera=camera,
                placements=tuple(sorted({record.placement for record in dark})),
            )
