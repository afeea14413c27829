"""Ways to falsify the files of a session, as users do by accident, with the causes to be named."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lrfcal_lib.calibrate.pipeline import calibrate
from lrfcal_lib.judge.verdict import judge
from lrfcal_lib.session.cluster import workers_at
from lrfcal_lib.session.read import IMAGE_COLUMNS, open_session
from lrfcal_lib.session.tables import read_table
from lrfcal_lib.session.write import as_lines

INCH = 0.0254  # metres
LATER = 11  # placement from which on something changes


@dataclass(frozen=True)
class Way:
    """A way to falsify a session.

    Attributes
    ----------
    change : callable
        Of the folder of a copied session, whose files it replaces.
    kinds : tuple of str
        Of the causes of which one has to be named; none where the change does no harm.
    words : str
        That one of the causes has to say.
    sessions : tuple of str
        For which the way makes sense.
    """

    change: Callable
    kinds: tuple
    words: str = ""
    sessions: tuple = ("sim_lms221", "lms400_zed")


def copied(source, target):
    """Copy a session by hard links where the disk allows; files are replaced, never changed."""
    for file in sorted(Path(source).rglob("*")):
        other = Path(target) / file.relative_to(source)
        if file.is_dir():
            continue
        other.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(file, other)
        except OSError:  # another disk
            shutil.copyfile(file, other)
    return Path(target)


def judged(folder):
    """The verdict on a recording, of a worker where LRFCAL_SCHEDULER names a cluster.

    Its workers see the folder under the same path, and have `tests` in their PYTHONPATH. As many recordings are judged
    at a time as pytest has processes: ``pytest -m campaign -n 32 tests/test_falsified_sessions.py``.
    """
    scheduler = os.environ.get("LRFCAL_SCHEDULER")
    if scheduler is None:
        return _judged(folder)
    with workers_at(scheduler) as executor:
        return executor.submit(_judged, folder).result()


def _judged(folder):
    return judge(calibrate(open_session(folder)), suggest=False)


def replaced(file, content):
    """Write a file anew, so that the one it was linked to stays as it is."""
    file.unlink(missing_ok=True)
    file.write_bytes(content)


def change_statements(folder, change):
    """Let a function change what session.json states."""
    data = json.loads((folder / "session.json").read_text())
    change(data)
    replaced(folder / "session.json", json.dumps(data).encode())


def change_rows(folder, change, name="images.csv", columns=IMAGE_COLUMNS):
    """Let a function change the rows of a table, a list of dicts."""
    rows = read_table(folder / name, columns, folder)
    change(rows)
    lines = as_lines([columns, *(row.values() for row in rows)])
    replaced(folder / name, lines)


def change_scans(folder, change):
    """Let a function change the scan lines, a dict of arrays; telegrams become scan lines."""
    scans = dict(open_session(folder).scans)
    change(scans)
    for name in ("telegrams.bin", "index.csv", "scans.npz"):
        (folder / "lrf" / name).unlink(missing_ok=True)
    np.savez_compressed(folder / "lrf" / "scans.npz", **scans)


def change_images(folder, change, cameras=None, first=0):
    """Let a function change pixels of all or some cameras, of all images or from a placement on."""
    for record in open_session(folder).image_records:
        chosen = cameras is None or record.camera in cameras
        if chosen and (first == 0 or record.placement >= first):
            pixels = change(cv2.imread(str(record.file)))
            quality = [cv2.IMWRITE_JPEG_QUALITY, 95] if record.file.suffix == ".jpg" else []
            replaced(
                record.file, cv2.imencode(record.file.suffix, pixels, quality)[1].tobytes()
            )


def copy_images(pairs):
    """Put images in the place of others, by pairs of records (from, to)."""
    content = [(origin.file.read_bytes(), target.file) for origin, target in pairs]
    for data, file in content:
        replaced(file, data)


def two_placements(session):
    """Two placements that are swept the same way."""
    numbers = session.board_placements
    first = len(numbers) // 4
    return numbers[first], numbers[first + 2]


def image_twice(folder):
    session = open_session(folder)
    first, second = two_placements(session)
    pairs = zip(session.images("left", first), session.images("left", second), strict=False)
    copy_images(list(pairs)[:1])


def placement_twice(folder):
    session = open_session(folder)
    first, second = two_placements(session)
    for camera in session.cameras:
        pairs = zip(
            session.images(camera, first), session.images(camera, second), strict=False
        )
        copy_images(list(pairs))

    def copy(scans):
        rows = np.flatnonzero(scans["placement"] == first)
        others = np.flatnonzero(scans["placement"] == second)
        order = np.r_[
            np.arange(others[0]), rows, np.arange(others[-1] + 1, len(scans["pitch"]))
        ]
        per_line = [key for key in scans if key != "bearings"]
        number = scans["placement"]
        for key in per_line:
            scans[key] = scans[key][order]
        scans["placement"] = np.r_[
            number[: others[0]], np.full(len(rows), second), number[others[-1] + 1 :]
        ]

    change_scans(folder, copy)


def one_folder(folder):
    session = open_session(folder)
    copy_images(list(zip(session.images("left"), session.images("right"), strict=False)))


def warped(scale=1.0, shift=0.0):
    """Pixels enlarged about the middle of their image, and moved sideways by a number of pixels."""

    def change(pixels):
        height, width = pixels.shape[:2]
        middle = np.array([width - 1, height - 1]) / 2
        move = (1 - scale) * middle + [shift, 0.0]
        matrix = np.array([[scale, 0, move[0]], [0, scale, move[1]]])
        return cv2.warpAffine(
            pixels,
            matrix,
            (width, height),
            flags=cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )

    return change


def camera_shifted(folder):
    change_images(folder, warped(shift=12.0), ("left",), LATER)


def camera_zoomed(folder):
    change_images(folder, warped(scale=1.02), ("right",), LATER)


def mirrored(folder):
    change_images(folder, lambda pixels: pixels[:, ::-1])


def one_mirrored(folder):
    change_images(folder, lambda pixels: pixels[:, ::-1], ("right",))


def dark(folder):
    change_images(folder, lambda pixels: pixels // 25)


def in_inches(scans):
    scans["ranges"] = scans["ranges"] / INCH


def turned_round(scans):
    scans["ranges"] = scans["ranges"][:, ::-1]


def beyond(data):
    data["rig"]["lrf"]["max_range_m"] = 1.0


def field_stated(folder):
    def change(data):
        low, high = data["rig"]["lrf"]["field_of_view_deg"]
        data["rig"]["lrf"]["field_of_view_deg"] = [low + 20.0, high - 20.0]

    change_statements(folder, change)


def pitch_times(factor):
    """All recorded pitch angles times a factor."""

    def change(scans):
        scans["pitch"] = scans["pitch"] * factor

    def rows_of(rows):
        for row in rows:
            row["pitch_deg"] = row["pitch_deg"] and repr(float(row["pitch_deg"]) * factor)

    def both(folder):
        change_scans(folder, change)
        change_rows(folder, rows_of)

    return both


def exchange_folders(folder):
    left = folder / "images" / "left"
    right = folder / "images" / "right"
    left.rename(folder / "images" / "spare")
    right.rename(left)
    (folder / "images" / "spare").rename(right)


def exchange_rows(folder):
    first, second = map(str, two_placements(open_session(folder)))
    other = {first: second, second: first}

    def change(rows):
        for row in rows:
            row["placement"] = other.get(row["placement"], row["placement"])

    change_rows(folder, change)


def numbers_ahead(folder):
    """Images of boards that carry the number of the next placement."""
    numbers = [str(number) for number in open_session(folder).board_placements]
    following = dict(zip(numbers, numbers[1:] + numbers[:1], strict=True))

    def change(rows):
        for row in rows:
            row["placement"] = following.get(row["placement"], row["placement"])

    change_rows(folder, change)


def image_pitch_in_radians(folder):
    def change(rows):
        for row in rows:
            row["pitch_deg"] = row["pitch_deg"] and repr(
                float(row["pitch_deg"]) * np.pi / 180
            )

    change_rows(folder, change)


def half_size(folder):
    """Images of half the size, with the intrinsics that are true of the full one."""
    truth = json.loads((folder / "truth.json").read_text())
    sizes = {}
    for record in open_session(folder).image_records:
        pixels = cv2.imread(str(record.file))
        small = cv2.resize(pixels, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        sizes[record.camera] = small.shape[1::-1]
        replaced(record.file, cv2.imencode(record.file.suffix, small)[1].tobytes())

    def change(data):
        for name, size in sizes.items():
            camera = data["rig"]["cameras"][name]
            camera["width"], camera["height"] = size
            camera["intrinsics"] = truth["cameras"][name]["intrinsics"]

    change_statements(folder, change)


def pattern_turned(folder):
    def change(data):
        pattern = data["board"]["pattern"]
        pattern["columns"], pattern["rows"] = pattern["rows"], pattern["columns"]

    change_statements(folder, change)


def squares_in_inches(folder):
    def change(data):
        data["board"]["pattern"]["square_m"] /= INCH

    change_statements(folder, change)


WAYS = {
    "an image twice": Way(image_twice, ("repeated image",), "camera 'left'"),
    "a placement twice": Way(placement_twice, ("repeated scan",), "same to the last digit"),
    "one picture in both folders": Way(one_folder, ("repeated image",), "'right'"),
    "camera shifted": Way(camera_shifted, ("camera moved",), "placement 11"),
    "camera zoomed": Way(camera_zoomed, ("camera zoomed",), "placement 11"),
    "images mirrored": Way(mirrored, ("sense",), "mirrored"),
    "images of one camera mirrored": Way(one_mirrored, ("sense",), "mirrored"),
    "ranges in inches": Way(
        lambda folder: change_scans(folder, in_inches), ("unit",), "inches"
    ),
    "max_range_m exceeded": Way(
        lambda folder: change_statements(folder, beyond), ("beyond range",), "max_range_m"
    ),
    "images too dark": Way(dark, ("dark",), "too dark"),
    "field of view": Way(field_stated, ("field of view",), "session.json states"),
    "pitch in radians": Way(pitch_times(np.pi / 180), ("unit",), "radians"),
    "pitch in degrees": Way(pitch_times(180 / np.pi), ("refused",), "degrees"),
    "cameras exchanged": Way(exchange_folders, ("far from stated",), "folders"),
    "bearings reversed": Way(
        lambda folder: change_scans(folder, turned_round),
        ("sense",),
        "bearings are counted in the opposite direction",
    ),
    "pitch reversed": Way(pitch_times(-1.0), ("sense",), "the pitch has the opposite sign"),
    "images of half the size": Way(half_size, ("lens",), "image size", ("sim_lms221",)),
    "pattern stated 6 x 8": Way(pattern_turned, (), sessions=("lms400_zed",)),
    "rows exchanged": Way(exchange_rows, ("exchanged",), "exchange them back"),
    "numbers of images ahead": Way(numbers_ahead, ("numbers",), "too large by one"),
    "pitch of images in radians": Way(
        image_pitch_in_radians, ("unit",), "images.csv is in radians", ("sim_lms221",)
    ),
    "squares in inches": Way(squares_in_inches, ("refused",), "inches"),
}
