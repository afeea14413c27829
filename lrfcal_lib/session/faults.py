"""What cannot be right about a recording, as far as its files alone show it."""

import hashlib
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from lrfcal_lib.session import stated
from lrfcal_lib.session.telegrams import other_than_stated

MANY = 0.2  # share of a camera's images: where more are wrong nothing can rest on them
# quantile of the grey levels that the brightest surface of an image has at least
WHITE = 0.995
# grey levels of 255; a white square of a chessboard has more in every image that is of use
DARK = 30
BEYOND = 0.001  # share of ranges beyond the largest one: single readings may be mirrors or the sun
SHOWN = 3  # examples in a sentence


@dataclass(frozen=True)
class Fault:
    """Something about a recording that cannot be right.

    Attributes
    ----------
    kind : str
        'repeated image', 'repeated scan', 'beyond range', 'field of view', 'dark', 'clock'; of
        :mod:`lrfcal_lib.judge.recording_faults` also 'camera moved', 'camera zoomed',
        'exchanged', 'numbers', 'sense', 'unit'.
    words : str
        What was found, where, and what to do about it.
    severe : bool
        Nothing that rests on it can be trusted.
    harmless : bool
        No estimate rests on it.
    camera : str or None
    placements : tuple of int
        Those concerned, where it is not the whole recording.
    """

    kind: str
    words: str
    severe: bool = False
    harmless: bool = False
    camera: str | None = None
    placements: tuple[int, ...] = ()


def faults_of_files(session) -> list[Fault]:
    """What cannot be right about a session: repetitions, ranges, bearings and times.

    Parameters
    ----------
    session : Session
        Opened; its images are read again where two files are of the same size.

    Returns
    -------
    list of Fault
        Harmless ones included.
    """
    found = repeated_images(session) + repeated_scans(session)
    return found + ranges_beyond(session) + bearings_beyond(session) + other_clocks(session)


def repeated_images(session) -> list[Fault]:
    """Images whose files are the same to the byte; one Fault a pair of cameras."""
    by_size = defaultdict(list)
    for record in session.image_records:
        by_size[record.file.stat().st_size].append(record)

    groups = defaultdict(list)
    for records in by_size.values():
        for record in records if len(records) > 1 else ():
            content = stated.read_bytes(record.file, session.path)
            groups[hashlib.blake2b(content).digest()].append(record)

    pairs = defaultdict(list)
    for first, *others in groups.values():
        for other in others:
            pairs[first.camera, other.camera].append((first, other))
    return [_repeated(session, *cameras, both) for cameras, both in pairs.items()]


def _repeated(session, first_camera, camera, pairs):
    """The Fault of images of one camera that are images of another one, or of itself, again."""
    count = len(session.images(camera))
    examples = [
        f"{other.file.relative_to(session.path)} is {first.file.relative_to(session.path)}"
        for first, other in pairs[:SHOWN]
    ]
    more = f" and {len(pairs) - SHOWN} more" if len(pairs) > SHOWN else ""
    placements = sorted({other.placement for _, other in pairs} - {-1})
    where = f" (in placements: {stated.short(placements)})" if placements else ""
    cause = "a camera that stood still, or a copy"
    if first_camera != camera:
        cause = f"was the folder of camera '{first_camera}' copied?"
    words = (
        f"{len(pairs)} of {count} images of camera '{camera}'{where} are identical to "
        f"others: {', '.join(examples)}{more}: {cause}; put the right images there or remove their "
        "rows from images.csv"
    )
    severe = len(pairs) > MANY * count
    return Fault(
        "repeated image", words, severe, camera=camera, placements=tuple(placements)
    )


def repeated_scans(session) -> list[Fault]:
    """Placements whose ranges are the same to the last digit: noise never repeats itself."""
    same_ranges = defaultdict(list)
    placement = session.scans["placement"]
    for number in session.placements:
        ranges = session.scans["ranges"][placement == number]
        if np.isfinite(ranges).any():
            same_ranges[ranges.shape, hashlib.blake2b(ranges.tobytes()).digest()].append(
                number
            )

    found = []
    for ((lines, _), _), numbers in same_ranges.items():
        if len(numbers) > 1:
            words = (
                f"the scans of placements {' and '.join(map(str, numbers))} are the same to the "
                f"last digit ({lines} scan lines): a copy; record one of them again or remove it "
                "from placements in session.json"
            )
            found.append(Fault("repeated scan", words, placements=tuple(numbers)))
    return found


def ranges_beyond(session) -> list[Fault]:
    """Ranges that the range finder cannot have measured, as session.json states it."""
    ranges = session.scans["ranges"]
    known = ranges[np.isfinite(ranges)]
    limit = session.lrf.max_range
    share = float(np.mean(known > limit))
    if share <= BEYOND:
        return []
    words = (
        f"{100 * share:.3g} % of the ranges exceed the max_range_m of {limit:g} m that "
        f"session.json states (half of all ranges: {np.median(known):.3g} m or more, largest: "
        f"{known.max():.3g} m): state the range finder's own max_range_m, or convert the ranges "
        "to metres"
    )
    return [Fault("beyond range", words)]


def bearings_beyond(session) -> list[Fault]:
    """Bearings, or steps between them, that are not those which session.json states."""
    lrf = session.lrf
    bearings = session.scans["bearings"]
    if session.telegrams is not None:
        return [
            Fault("field of view", words) for words in other_than_stated(session.scans, lrf)
        ]
    if len(bearings) < 2:
        return []
    step = (bearings[-1] - bearings[0]) / (len(bearings) - 1)
    first, last = sorted(lrf.field_of_view)
    half = lrf.bearing_step / 2
    inside = first - half <= bearings[0] and bearings[-1] <= last + half
    same_step = abs(step - lrf.bearing_step) * (len(bearings) - 1) <= half
    if inside and same_step:
        return []
    has, says = (
        "{:.5g} to {:.5g} deg in steps of {:.4g} deg".format(*np.degrees(values))
        for values in ((bearings[0], bearings[-1], step), (first, last, lrf.bearing_step))
    )
    words = (
        f"the bearings of the scan lines (lrf/scans.npz) cover {has}, session.json states "
        f"field_of_view_deg and bearing_step_deg as {says}: the scan lines count; correct "
        "session.json, or the bearings if they are wrong"
    )
    return [Fault("field of view", words)]


def other_clocks(session) -> list[Fault]:
    """Cameras whose times put most images beside the scans of other placements."""
    ends = {}
    for number in session.placements:
        time = session.scans["time_s"][session.scans["placement"] == number]
        if np.isfinite(time).any():
            ends[number] = (np.nanmin(time), np.nanmax(time))
    if len(ends) < 2:
        return []

    found = []
    first, last = np.array(list(ends.values())).T
    numbers = np.array(list(ends))
    for camera in session.cameras:
        records = [
            r
            for r in session.images(camera)
            if r.placement in ends and np.isfinite(r.time_s)
        ]
        away = []
        for record in records:
            outside = np.maximum(
                np.maximum(first - record.time_s, record.time_s - last), 0.0
            )
            own = numbers == record.placement
            if outside[own][0] > outside[~own].min():
                begin, end = ends[record.placement]
                away.append(record.time_s - (begin if record.time_s < begin else end))
        if len(away) > len(records) / 2:
            words = (
                f"the times (t_s in images.csv) of {len(away)} of {len(records)} images of camera "
                f"'{camera}' lie beside the scans of other placements, {np.median(away):+.6g} s "
                "from their own: another clock? Placement numbers count, not these times; leave "
                "t_s empty or synchronise the clocks"
            )
            found.append(Fault("clock", words, harmless=True, camera=camera))
    return found


def brightness(image: np.ndarray) -> int:
    """Grey level of the brightest surface in an image, of every fourth pixel.

    Parameters
    ----------
    image
        Of uint8, shape (h, w, 3).
    """
    return int(np.quantile(image[::4, ::4].max(axis=2), WHITE))


def dark_image(image: np.ndarray) -> bool:
    """Whether the brightest surface of an image is darker than a white square may be.

    Parameters
    ----------
    image
        Of uint8, shape (h, w, 3).
    """
    return brightness(image) < DARK


def dark_images(session) -> list[Fault]:
    """Cameras whose images of the board are too dark; SHOWN of each are looked at.

    Parameters
    ----------
    session : Session
    """
    found = []
    for camera in session.cameras:
        records = session.images(camera, purpose="board")
        looked_at = records[:: max(len(records) // SHOWN, 1)][:SHOWN]
        dark = [record for record in looked_at if dark_image(session.read_image(record))]
        if len(dark) > len(looked_at) / 2:
            found.append(
                too_dark(session, dark, f"{len(dark)} of {len(looked_at)} looked at")
            )
    return found


def faults_of_dark(session, dark) -> list[Fault]:
    """The Faults of all dark images (ImageRecords) of a session, one a camera."""
    found = []
    for camera in session.cameras:
        records = [record for record in dark if record.camera == camera]
        if records:
            count = f"{len(records)} of {len(session.images(camera))}"
            found.append(too_dark(session, records, count))
    return found


def too_dark(session, records, how_many: str) -> Fault:
    """The Fault of dark images of one camera."""
    first = records[0]
    name = first.file.relative_to(session.path)
    brightest = brightness(session.read_image(first))
    words = (
        f"images of camera '{first.camera}' are too dark ({how_many}): the brightest surfaces of "
        f"{name} have {brightest} of 255 grey levels, a white square needs {DARK} and more; more "
        "light, a longer exposure, or, where other values were stored (10 or 12 bits), convert "
        "the images"
    )
    placements = tuple(sorted({record.placement for record in records} - {-1}))
    return Fault("dark", words, camera=first.camera, placements=placements)
