"""Damaged and hostile sessions and rig files, one after the other: ``python tests/fuzz.py`` (or ``make fuzz``).

A case is a number: it seeds what is damaged and what is done with it, so ``--case N`` repeats it. Cases run in
processes that may take 500 MB and, for each case, 20 s of a processor. Whatever comes out has to be an error of ours;
nothing outside of the session's folder is to be opened, which the times of a folder that links and names lead to and
Python's audit events (for all absolute paths) tell.
"""

import argparse
import io
import json
import multiprocessing
import os
import resource
import shutil
import signal
import struct
import sys
import tempfile
import traceback
import zipfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from fake_rig import rig_data
from scipy.spatial.transform import RigidTransform, Rotation
from telegrams import encode_scan
from tiny_import import write_source

from lrfcal_lib.drivers.port import PortError, open_port
from lrfcal_lib.drivers.rig_file import HeadSettings, RigFileError, read_rig_file
from lrfcal_lib.evaluate.export import file_hashes
from lrfcal_lib.evaluate.truth import read_truth
from lrfcal_lib.model.board import Board, Chessboard, triangle_board
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.preprocess.prepared import Prepared
from lrfcal_lib.preprocess.survey import survey
from lrfcal_lib.session.files import SessionError
from lrfcal_lib.session.importers import import_lasersetero
from lrfcal_lib.session.read import open_session, validate
from lrfcal_lib.session.recorder import SessionRecorder
from lrfcal_lib.session.stated import CameraInfo, LrfInfo, transform_to_json
from lrfcal_lib.session.write import SessionWriter, finish

SEED = 11
MEMORY = 500_000_000
LONGEST_S = 20.0
LIBRARY = str(Path(read_rig_file.__code__.co_filename).parents[1])
READ = (
    sys.prefix,
    sys.base_prefix,
    LIBRARY,
    __file__,
    "/proc/self",
    "/proc/cpuinfo",
)  # by Python itself
BATCH = 2000
SURVEYED = 0.02  # cases of a process; share of the cases in which the images are looked at, which is slow
BOMBED = 0.0005  # share of the damages that unpack to much or take long to read; they take seconds to make
MODEL = CameraModel(160, 120, 150.0, 150.0, 79.5, 59.5, np.zeros(5))
LRF = LrfInfo("made up", (0.0, np.pi), np.radians(1.0), 0.005)
HEAD = RigidTransform.from_components(
    [0.01, 0.02, -0.03], Rotation.from_rotvec([0.1, -0.2, 0.3])
)
PATTERN = Chessboard(5, 4, 0.05, (0.05, 0.05))
SQUARE = Board(
    "square",
    ("ab", "bc", "cd", "da"),
    [[0, 0], [0.3, 0], [0.3, 0.25], [0, 0.25]],
    PATTERN,
    ("ab", "da"),
)
NASTY = [
    "", "0", "-1", "1e999", "-1e308", "nan", "NaN", "Infinity", "null", "true", '""', "[]", "{}", "0.5", "65536",
    "1e-300", str(2**31), str(2**63 - 1), str(2**63), str(-(2**63)), str(2**64), "9" * 5000, "1" + "0" * 400,
    "[" * 100_000, "[" * 200, "[[]]", "[1e308, 1e308, 1e308]",
    '{"a":' * 5000, "\x00", "\xed\xa0\x80", "\u2028", '"', ",", "\r", "x" * 200_000,
    '"../outside/secret"', "../outside/secret", "../outside/secret.png", "outside/secret.png", "/etc/passwd",
    "/dev/zero", "session.json", "lrf/scans.npz", "..", ".", "~", "file:///etc/passwd", "images", "30000",
]  # fmt: skip


# ------------------------------------------------------------------------------------ sound sessions to begin with


def picture(seed):
    """The chessboard as a camera sees it, shape (120, 160, 3)."""
    flat = np.full((250, 300), 255, np.uint8)
    for row, column in np.argwhere(np.indices((5, 6)).sum(axis=0) % 2 == 0):
        flat[50 * row : 50 * row + 50, 50 * column : 50 * column + 50] = 0
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix()
    pose = np.column_stack([turn[:, :2], [-0.15, -0.12, rng.uniform(0.45, 0.6)]])
    image = cv2.warpPerspective(
        flat, MODEL.matrix @ pose @ np.diag([1e-3, 1e-3, 1.0]), (160, 120), borderValue=128
    )
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)


def make_sessions(folder):
    """Scan lines, and telegrams of a recording that was interrupted; each with images; and a rig file."""
    make_scans(folder / "scans")
    with recorder(folder / "telegrams") as writer:
        add(writer, 1)
        writer.begin_placement(2)
        record(writer, 2)
    make_rig_file(folder / "rig")
    write_source(folder / "import", np.random.default_rng(0))
    (folder / "outside").mkdir()
    png = cv2.imencode(".png", picture(0))[1].tobytes()
    for name in ("secret", "secret.png"):
        (folder / "outside" / name).write_bytes(png)


def make_scans(folder):
    """A session of scan lines, images, drawn edges and a truth."""
    cameras = [
        CameraInfo("left", "head", 160, 120, None, HEAD),
        CameraInfo("right", "platform", 160, 120, MODEL),
    ]
    bearings = np.radians(np.arange(60.0, 121.0))
    pitch = np.radians([-1.0, 0.0, 1.0])
    with SessionWriter(folder, SQUARE, LRF, cameras, HEAD) as writer:
        for placement in (1, 2):
            writer.add_sweep(
                placement,
                np.full((3, 61), 1.9 + 0.1 * placement),
                bearings,
                pitch,
                [0.0, 1, 2],
                np.ones((3, 61)),
            )
            writer.add_image(
                "right", picture(placement), placement, pitch=0.1, time_s=placement
            )
        for view in range(3):
            writer.add_image(
                "left", picture(3 + view), 1 + view % 2, pitch=0.1, purpose="intrinsics"
            )
    rows = (
        "left,images/left/0001.png,ab,1,2,20,3\nright,images/right/0001.png,bc,1,2,30,3\n"
    )
    (folder / "edges.csv").write_text("camera,file,edge,u1,v1,u2,v2\n" + rows)
    stated = json.loads((folder / "session.json").read_text())
    head = transform_to_json(HEAD)
    truth = {
        "T_head_lrf": head,
        "board": stated["board"],
        "boards": {"1": {"T_platform_board": head}},
    }
    truth |= {
        "cameras": {c: {"T_camera_lrf": head} for c in ("left", "right")},
        "sweeps": {"1": {"pitch_rad": [0.1]}},
    }
    (folder / "truth.json").write_text(json.dumps(truth))


def make_rig_file(folder):
    """A folder with ``rig.json``."""
    folder.mkdir()
    rig = rig_data(
        placements=[
            {"number": 1, "pitch_deg": [-4, 4, 1], "image_pitch_deg": [0], "board": True}
        ]
    )
    rig["devices"]["head"] |= HeadSettings(degrees_per_second=4.0, repeat_s=0.5).model_dump(
        mode="json"
    )
    rig["devices"]["cameras"]["left"] |= {"exposure": 0.01, "silence_s": 10}
    (folder / "rig.json").write_text(json.dumps(rig))


def recorder(path):
    """Goes on with the session of telegrams."""
    return SessionRecorder(
        path,
        triangle_board(),
        LRF,
        [CameraInfo("left", "head", 160, 120, MODEL)],
        resume=True,
    )


def add(writer, placement):
    """Record a whole placement."""
    writer.begin_placement(placement)
    record(writer, placement)
    writer.finish_placement()


def record(writer, placement):
    """What a placement adds to it."""
    writer.add_telegrams(
        placement,
        [encode_scan(np.full(181, 2.0))] * 2,
        [0.0, 0.1],
        [placement, placement + 0.5],
    )
    writer.add_image("left", picture(placement), placement, pitch=0.1, time_s=placement)
    writer.add_platform([(placement, 0.1, np.nan)])


# ------------------------------------------------------------------------------------------------------ damage


def any_of(rng, *values):
    """One of some values."""
    return values[rng.integers(len(values))]


def header_bomb(path):
    """An array whose header is 900 MB of blanks."""
    with zipfile.ZipFile(
        path / "lrf" / "scans.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1
    ) as archive:
        with archive.open("ranges.npy", "w", force_zip64=True) as member:
            member.write(b"\x93NUMPY\2\0" + struct.pack("<I", 900_000_000))
            for _ in range(45):
                member.write(b" " * 20_000_000)


def packed_bomb(path):
    """An array and 600 MB of zeros, packed as numpy does not."""
    with zipfile.ZipFile(
        path / "lrf" / "scans.npz", "w", zipfile.ZIP_BZIP2, compresslevel=1
    ) as archive:
        with archive.open("ranges.npy", "w", force_zip64=True) as member:
            member.write(array_of(header_of("(6, 61)", "<f8")))
            for _ in range(30):
                member.write(bytes(20_000_000))


def directory_bomb(path):
    """An archive with a million entries of no content behind those of a session."""
    file = path / "lrf" / "scans.npz"
    data = file.read_bytes()
    entries = 1_000_000
    end = data.rfind(b"PK\5\6")
    (first,) = struct.unpack("<I", data[end + 16 : end + 20])
    entry = b"PK\1\2" + bytes(24) + struct.pack("<H", 7) + bytes(16)
    table = data[first:end] + b"".join(
        entry + b"%07d" % number for number in range(entries)
    )
    large = b"PK\6\6" + struct.pack(
        "<Q2H2L4Q", 44, 45, 45, 0, 0, entries + 6, entries + 6, len(table), first
    )
    where = b"PK\6\7" + struct.pack("<LQL", 0, first + len(table), 1)
    file.write_bytes(
        data[:first] + table + large + where + b"PK\5\6" + struct.pack("<4H2LH", *OVER)
    )


OVER = (
    0,
    0,
    2**16 - 1,
    2**16 - 1,
    2**32 - 1,
    2**32 - 1,
    0,
)  # end of an archive: larger numbers stand before it


def as_jpeg(path, size, change, **options):
    """A black JPEG of a size instead of the first image of the left camera, changed, and all that names it."""
    old = path / "images" / "left" / "0001.png"
    new = old.with_suffix(".jpg")
    old.unlink()
    black = np.zeros((size[1], size[0], 3), np.uint8)
    data = cv2.imencode(
        ".jpg",
        black,
        [x for pair in options.items() for x in (getattr(cv2, pair[0]), pair[1])],
    )[1]
    new.write_bytes(change(data.tobytes()))
    for table in (path / "images.csv", path / "edges.csv"):
        table.write_text(table.read_text().replace("left/0001.png", "left/0001.jpg"))
    state_size(new, size)
    first = next(
        line
        for line in (path / "images.csv").read_text().splitlines()
        if "0001.jpg" in line
    )
    others = [
        line
        for line in (path / "images.csv").read_text().splitlines()
        if "left/" not in line
    ]
    (path / "images.csv").write_text("\n".join([*others, first]) + "\n")


def segments_bomb(path, mark=b"\xff\xe5"):
    """A JPEG with twelve million empty segments before its size."""
    as_jpeg(
        path, (160, 120), lambda data: data[:2] + 12_000_000 * (mark + b"\0\2") + data[2:]
    )


def remarks_bomb(path):
    """The same with segments of the kind that OpenCV keeps."""
    segments_bomb(path, b"\xff\xe1")


def scans_bomb(path):
    """A JPEG of 30 megapixels whose last scan stands there 5000 times."""

    def repeat(data):
        last = data[data.rindex(b"\xff\xda") : -2]
        return data[:-2] + 5000 * last + data[-2:]

    as_jpeg(path, (6000, 5000), repeat, IMWRITE_JPEG_PROGRESSIVE=1)


def chunks_bomb(path):
    """A PNG with four million empty chunks before its pixels."""
    file = path / "images" / "left" / "0001.png"
    data = file.read_bytes()
    chunk = b"abCd"
    chunk = bytes(4) + chunk + struct.pack(">I", zipfile.crc32(chunk))
    file.write_bytes(data[:33] + 4_000_000 * chunk + data[33:])


def rows_bomb(path):
    """One image of 30 megapixels, named 10 000 times."""
    as_jpeg(path, (6000, 5000), lambda data: data)
    with (path / "images.csv").open("r+") as table:
        table.write(10_000 * table.readlines()[-1])


BOMBS = (
    header_bomb, packed_bomb, directory_bomb, segments_bomb, remarks_bomb, scans_bomb, chunks_bomb, rows_bomb,
)  # fmt: skip


def damage(rng, path):
    """Damage one file of a session."""
    if rng.random() < BOMBED and (path / "edges.csv").is_file():
        with suppress(Exception):  # another damage was there before
            return any_of(rng, *BOMBS)(path)
    files = sorted(
        p
        for p in path.rglob("*")
        if not p.is_symlink() and p.is_file() and p.stat().st_size < 100_000_000
    )
    if not files:
        return
    file = any_of(rng, *files)
    if file.suffix in (".png", ".jpg") and rng.random() < 0.6:
        # small tables and statements matter as much
        file = any_of(rng, *files)
    kinds = {
        ".json": text,
        ".csv": any_of(rng, text, rows),
        ".npz": arrays,
        ".bin": raw,
        ".pcd": points,
        ".m": text,
    }
    kind = kinds.get(file.suffix, pixels)
    try:
        any_of(rng, kind, kind, kind, kind, raw, other)(rng, file)
    except Exception:
        raw(rng, file)  # damaged too much for its own kind of damage


def raw(rng, file):
    """Any bytes."""
    data = file.read_bytes()[:1_000_000]
    at = int(rng.integers(len(data) + 1))
    n = any_of(rng, 1, 4, 100)
    middle = any_of(
        rng,
        b"",
        bytes(n),
        rng.bytes(n),
        rng.bytes(n) + data[at : at + n],
        2 * data[at : at + n],
    )
    file.write_bytes(any_of(rng, data[:at], data[:at] + middle + data[at + n :]))


def text(rng, file):
    """Another word in place of a number, a text or a whole part."""
    words = file.read_text()
    ends = [i for i, c in enumerate(words) if c in ",:[]{}\n "]
    first = int(rng.integers(len(ends) - 1))
    last = int(rng.integers(first + 1, len(ends))) if rng.random() < 0.2 else first + 1
    file.write_bytes(
        (words[: ends[first] + 1] + any_of(rng, *NASTY) + words[ends[last] :]).encode(
            "utf-8", "replace"
        )
    )


def points(rng, file):
    """Another word somewhere in a cloud, or as many scan lines as there is room for."""
    if rng.random() < 0.98:
        return text(rng, file)
    n = 200_000
    rows = "".join(f"0 {1 + k % 2} 0.5\n" for k in range(n))
    file.write_text(f"FIELDS x y z\nPOINTS {n}\nDATA ascii\n{rows}")


def rows(rng, file):
    """Lines that are gone, doubled, many, or have another cell."""
    lines = file.read_text().splitlines()
    at = int(rng.integers(len(lines)))
    many = 300_000 if rng.random() < 0.01 else 1
    cells = lines[at].split(",")
    cells[rng.integers(len(cells))] = any_of(rng, *NASTY)
    lines[at : at + 1] = any_of(rng, [], lines[at : at + 1] * (1 + many), [",".join(cells)])
    file.write_bytes(("\n".join(lines) + "\n").encode("utf-8", "replace"))


def header_of(shape, kind):
    """A header of an array that states what need not follow."""
    return f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()


def array_of(header, version=1):
    """What comes before the values of an array."""
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H", len(header)) + header


# what headers of arrays state: too much, nothing, no numbers, not even a shape
STATED_SHAPES = "(100000, 100000)|(-1, 61)|()|(6,)|(2**40,)|(6, 61|(6, 61, 1)".split("|")
STATED_KINDS = "<f8 <f4 |O <U9 |b1 <c16 |V1000000 <i8 <M8[s] >f8 x |S0".split()


def arrays(rng, file):
    """Other arrays than a session's, headers that lie, and archives that unpack to much."""
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = any_of(rng, *sorted(members))
    how = rng.integers(4)
    if how == 0:
        header = header_of(any_of(rng, *STATED_SHAPES), any_of(rng, *STATED_KINDS))
        members[name] = array_of(header, any_of(rng, 1, 1, 2, 9)) + bytes(1000)
    elif how == 1:
        value = any_of(rng, 0.0, np.nan, np.inf, -1.0, 1e300)
        shape = any_of(rng, (6, 61), (0, 61), (61,), (3, 3000))
        np.save(
            stream := io.BytesIO(),
            np.full(shape, value, any_of(rng, float, np.float32, np.complex128, ">f8")),
        )
        members[name] = stream.getvalue()
    elif how == 2:
        members[any_of(rng, "extra.npy", "../outside/secret", name[:-4], "ranges.npy/")] = (
            members.pop(name)
        )
    else:
        members[name] += bytes(any_of(rng, 10, 100_000, 30_000_000))
    with zipfile.ZipFile(file, "w", any_of(rng, 0, 8, 12, 14), compresslevel=1) as archive:
        for key, data in members.items():
            archive.writestr(key, data)


def pixels_of(png, size, kind=(8, 2, 0, 0, 0)):
    """A PNG image that states another size."""
    body = b"IHDR" + struct.pack(">II5B", *size, *kind)
    return png[:12] + body + zipfile.crc32(body).to_bytes(4, "big") + png[33:]


def pixels(rng, file):
    """Other images: another kind or size, and headers that promise many pixels, which the session may state too."""
    size = any_of(
        rng, (160, 120), (120, 160), (1, 1), (5000, 1), (30000, 30000), (5000, 4000)
    )
    data = cv2.imencode(
        any_of(rng, ".png", ".jpg"), np.zeros((120, 160, any_of(rng, 1, 3, 4)), np.uint8)
    )[1].tobytes()
    if data[:4] == b"\x89PNG":
        data = pixels_of(
            data,
            size,
            (any_of(rng, 8, 16), any_of(rng, 0, 2, 3, 6), 0, 0, any_of(rng, 0, 1)),
        )
    else:
        at = data.find(b"\xff\xc0") + 5
        data = data[:at] + struct.pack(">HH", *size[::-1]) + data[at + 4 :]
    file.write_bytes(data)
    if rng.random() < 0.5:
        state_size(file, size)


def state_size(file, size):
    """Another size of the images of a camera in session.json, unless an earlier damage left no file there."""
    stated = file.parents[2] / "session.json"
    if stated.is_file() and not stated.is_symlink():
        session = json.loads(stated.read_text())
        session["rig"]["cameras"][file.parent.name] |= {"width": size[0], "height": size[1]}
        stated.write_text(json.dumps(session))


def other(rng, file):
    """No plain file at all, or none, or a large one; also beside a file, where a draft or the lock is going to be."""
    root = next(p for p in file.parents if p.name == "case")
    outside = any_of(rng, *sorted((root.parent / "outside").iterdir()))
    if rng.random() < 0.2 and file.parent != root:
        shutil.rmtree(file.parent)
        return os.symlink(outside.parent, file.parent)
    file = any_of(
        rng, file, file, file, file.with_name(file.name + ".draft"), root / "writer.lock"
    )
    file.unlink(missing_ok=True)
    if (how := rng.integers(6)) == 0:
        file.touch()
        return os.truncate(file, 3_000_000_000)
    targets = "/dev/zero", outside, outside.parent
    return (
        os.symlink(targets[how - 1], file)
        if how < 4
        else os.mkfifo(file)
        if how == 4
        else None
    )


# ---------------------------------------------------------------------------------------------- what is done with it


def use(rng, path, kind):
    """Everything that reads a session, and some that writes; the errors that came out."""
    if kind in OWN:
        return [_caught(OWN[kind], path)]
    read = any_of(rng, validate, _survey if rng.random() < SURVEYED else read_all)
    return [
        _caught(work, path)
        for work in (read, *[any_of(rng, _go_on, finish)] * (rng.random() < 0.3))
    ]


def _open_rig(path):
    """What is stated can be asked of the drivers, and no time is endless."""
    devices = read_rig_file(path / "rig.json").devices
    for one in (devices.lrf, devices.head, *devices.cameras.values()):
        times = [
            value
            for name, value in vars(one).items()
            if name.endswith("_s") and value is not None
        ]
        assert max(times, default=0) <= 3600
    for one in (devices.lrf, devices.head):
        with suppress(PortError):
            open_port(f"/nowhere{one.port}", devices.head.baudrate, timeout=0.1)


def _import(path):
    """A message names the file that is wrong, be it in the source or in what was made of it."""
    try:
        import_lasersetero(path, path / "made")
    except SessionError as error:
        assert str(path) in str(error), error


OWN = {
    "rig": _open_rig,
    "import": _import,
}  # what these name belongs to who wrote them, and may lie anywhere


def _survey(path):
    session = read_all(path)
    survey(Prepared(session, session.board, {}))


def read_all(path):
    """What `calibrate` reads of a session besides its images."""
    session = open_session(path)
    read_truth(session)
    file_hashes(session)
    return session


def _go_on(path):
    with recorder(path) as writer:
        add(writer, max(writer.finished, default=0) + 1)


def _caught(work, *arguments):
    """None, or (kind, text, traceback) of an error that is not ours."""
    try:
        work(*arguments)
        return None
    except Exception as raised:
        error = raised
        trace = traceback.format_exc()
        last = traceback.extract_tb(raised.__traceback__)[-1]
    if "MemoryError" in trace or "nsufficient memory" in trace:
        return "memory", repr(error)[:200], trace
    ours = [SessionError, RigFileError] + [OSError] * (work in (_go_on, finish))
    if work in (read_all, _survey) and last.filename.startswith(LIBRARY):
        ours.append(
            ValueError
        )  # what the preprocessing raises itself is documented as ValueError
    return None if isinstance(error, tuple(ours)) else ("foreign", repr(error)[:200], trace)


# -------------------------------------------------------------------------------------------------- the machinery


class Watch:
    """Tells of files that are opened outside of a case's folder while it is entered."""

    def __init__(self, folder):
        self.case, self.on = str(folder / "case"), False
        self.baits = [folder / "outside", *(folder / "outside").iterdir()]
        with self:
            self.baits[1].read_bytes()
        assert self.seen == [f"used {self.baits[1]}"], (
            "this file system does not tell what is read"
        )
        sys.addaudithook(self._heard)

    def __enter__(self):
        for path in self.baits:
            os.utime(path, (0, 1))
        self.seen, self.on = [], True

    def __exit__(self, *_):
        self.on = False
        times = [(path, path.stat()) for path in self.baits]
        self.seen += [
            f"used {path}"
            for path, found in times
            if (found.st_atime, found.st_mtime) != (0, 1)
        ]

    def _heard(self, event, arguments):
        if self.on and event in (
            "open",
            "os.listdir",
            "os.mkdir",
            "os.remove",
            "os.rename",
            "os.truncate",
        ):
            name = (
                os.fsdecode(arguments[0])
                if isinstance(arguments[0], str | bytes | os.PathLike)
                else ""
            )
            inside = name == self.case or name.startswith((self.case + "/", *READ))
            if os.path.isabs(name) and (not inside or ".." in name.split("/")):
                self.seen.append(f"{event} {name}")


def run_case(number, seed, sound, folder, watch):
    """One case; the findings as (kind, text, traceback)."""
    rng = np.random.default_rng([seed, number])
    case = folder / "case"
    shutil.rmtree(case, ignore_errors=True)
    kind = ("scans", "telegrams", "telegrams", "scans", "rig", "import")[number % 6]
    shutil.copytree(sound / kind, case, symlinks=True)
    for _ in range(any_of(rng, 1, 1, 1, 2, 3)):
        damage(rng, case)
    with watch:
        found = [f for f in use(rng, case, kind) if f]
    return found + [("outside", text, "") for text in watch.seen if kind not in OWN]


def _batch(numbers, seed, base, at):
    """Runs in a process of its own, which a case that takes too long ends; `at` tells which case it is at."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if len(numbers) > 1:
        os.dup2(
            os.open(os.devnull, os.O_WRONLY), 2
        )  # what image libraries say about damaged images
    folder = Path(tempfile.mkdtemp(dir=base))
    shutil.copytree(base / "sound" / "outside", folder / "outside")
    watch = Watch(folder)
    with (base / "findings").open("a", buffering=1) as out:
        for at.value in numbers:
            signal.setitimer(
                signal.ITIMER_PROF, LONGEST_S
            )  # of the processor: a busy machine is no hang
            signal.setitimer(signal.ITIMER_REAL, 15 * LONGEST_S)
            for finding in run_case(at.value, seed, base / "sound", folder, watch):
                out.write(json.dumps([at.value, *finding]) + "\n")
    shutil.rmtree(folder)


def _run_batch(numbers, seed, base):
    """Cases in one process after another: what ends one is a finding, and the next one goes on behind it."""
    spawn = multiprocessing.get_context("spawn")
    while numbers:
        at = spawn.RawValue("q", numbers[0])
        child = spawn.Process(target=_batch, args=(numbers, seed, base, at))
        child.start()
        child.join()
        if child.exitcode:
            kind = (
                "hang" if -child.exitcode in (signal.SIGPROF, signal.SIGALRM) else "crash"
            )
            with (base / "findings").open("a") as out:
                out.write(
                    json.dumps([at.value, kind, f"exit code {child.exitcode}", ""]) + "\n"
                )
        numbers = numbers[numbers.index(at.value) + 1 :]


def run(cases, seed, workers):
    """Run numbered cases; the findings as lists [number, kind, text, traceback]."""
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with (
        tempfile.TemporaryDirectory(prefix="lrfcal-fuzz-", dir=memory) as base,
        ThreadPoolExecutor(workers) as pool,
    ):
        base = Path(base)
        (base / "sound").mkdir()
        make_sessions(base / "sound")
        (base / "findings").touch()
        batches = [cases[k : k + BATCH] for k in range(0, len(cases), BATCH)]
        list(pool.map(_run_batch, batches, [seed] * len(batches), [base] * len(batches)))
        return [json.loads(line) for line in (base / "findings").read_text().splitlines()]


def main():
    """From the command line."""
    options = argparse.ArgumentParser(description=__doc__)
    for name, value in (
        ("cases", 200_000),
        ("seed", SEED),
        ("workers", os.cpu_count()),
        ("case", None),
    ):
        options.add_argument(f"--{name}", type=int, default=value)
    asked = options.parse_args()
    found = run(
        range(asked.cases) if asked.case is None else [asked.case],
        asked.seed,
        asked.workers,
    )
    for number, kind, text, trace in found:
        print(
            f"{kind} {text}: --seed {asked.seed} --case {number}",
            trace * (asked.case is not None),
            sep="\n",
        )
    print(len(found), "findings")
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
