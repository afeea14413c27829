"""Damaged and hostile sessions and rig files, one after the other: ``python tests/fuzz.py`` (or ``make fuzz``).

A case is a number: it seeds what is damaged and what is done with it, so ``--case N`` repeats it. Cases run in
processes that may take 500 MB and, for each case, 20 s of a processor. Whatever comes out has to be an error of ours;
nothing outside of the session's folder is to be opened, which the kernel (inotify, for a folder that links and names
lead to) and Python's audit events (for all absolute paths) tell.
"""

import argparse
import ctypes
import io
import json
import multiprocessing.connection
import os
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import zipfile
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from fake_rig import rig_data
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.drivers.rig_file import RigFileError, read_rig_file
from lrfcal_lib.evaluate.export import file_hashes
from lrfcal_lib.evaluate.tables import read_truth
from lrfcal_lib.model.board import Board, Chessboard, triangle_board
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.preprocess.survey import views_of
from lrfcal_lib.session.lms2xx_codec import check_crc, crc16, encode_scan
from lrfcal_lib.session.read import open_session, validate
from lrfcal_lib.session.stated import CameraInfo, LrfInfo, SessionError, transform_to_json
from lrfcal_lib.session.write import SessionRecorder, SessionWriter, finish

SEED, MEMORY, LONGEST_S = 11, 500_000_000, 20.0
LIBRARY = str(Path(read_rig_file.__code__.co_filename).parents[1])
READ = (sys.prefix, sys.base_prefix, LIBRARY, __file__, "/proc/self")  # by Python itself
BATCH, SURVEYED = 500, 0.02  # cases of a process; share of the cases in which the images are looked at, which is slow
MODEL = CameraModel(160, 120, 150.0, 150.0, 79.5, 59.5, np.zeros(5))
LRF = LrfInfo("made up", (0.0, np.pi), np.radians(1.0), 0.005)
HEAD = RigidTransform.from_components([0.01, 0.02, -0.03], Rotation.from_rotvec([0.1, -0.2, 0.3]))
PATTERN = Chessboard(5, 4, 0.05, (0.05, 0.05))
SQUARE = Board("square", ("ab", "bc", "cd", "da"), [[0, 0], [0.3, 0], [0.3, 0.25], [0, 0.25]], PATTERN, ("ab", "da"))
NASTY = [
    "", "0", "-1", "1e999", "-1e308", "nan", "NaN", "Infinity", "null", "true", '""', "[]", "{}", "0.5", "65536",
    "1e-300", str(2**31), str(2**63 - 1), str(2**63), str(-(2**63)), str(2**64), "9" * 5000, "1" + "0" * 400,
    "[" * 100_000, "[" * 200,
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
    image = cv2.warpPerspective(flat, MODEL.matrix @ pose @ np.diag([1e-3, 1e-3, 1.0]), (160, 120), borderValue=128)
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)


def make_sessions(folder):
    """Scan lines, and telegrams of a recording that was interrupted; each with images; and a rig file."""
    cameras = [CameraInfo("left", "head", 160, 120, None, HEAD), CameraInfo("right", "platform", 160, 120, MODEL)]
    bearings, pitch = np.radians(np.arange(60.0, 121.0)), np.radians([-1.0, 0.0, 1.0])
    with SessionWriter(folder / "scans", SQUARE, LRF, cameras, HEAD) as writer:
        for placement in (1, 2):
            writer.add_sweep(placement, np.full((3, 61), 2.0), bearings, pitch, [0.0, 1, 2], np.ones((3, 61)))
            writer.add_image("right", picture(placement), placement, pitch=0.1, time_s=placement)
        for view in range(3):
            writer.add_image("left", picture(3 + view), 1 + view % 2, pitch=0.1, purpose="intrinsics")
    rows = "left,images/left/0001.png,ab,1,2,20,3\nright,images/right/0001.png,bc,1,2,30,3\n"
    (folder / "scans" / "edges.csv").write_text("camera,file,edge,u1,v1,u2,v2\n" + rows)
    stated = json.loads((folder / "scans" / "session.json").read_text())
    truth = {"T_head_lrf": transform_to_json(HEAD), "board": stated["board"]}
    truth |= {"cameras": {c: {"T_camera_lrf": transform_to_json(HEAD)} for c in ("left", "right")}}
    truth |= {"boards": {"1": {"T_platform_board": transform_to_json(HEAD)}}, "sweeps": {"1": {"pitch_rad": [0.1]}}}
    (folder / "scans" / "truth.json").write_text(json.dumps(truth))
    with recorder(folder / "telegrams") as writer:
        add(writer, 1)
        writer.begin_placement(2)
        record(writer, 2)
    (folder / "rig").mkdir()
    (folder / "rig" / "rig.json").write_text(json.dumps(rig_data()))
    (folder / "outside").mkdir()
    for name in ("secret", "secret.png"):
        (folder / "outside" / name).write_bytes(cv2.imencode(".png", picture(0))[1].tobytes())


def recorder(path):
    """Goes on with the session of telegrams."""
    return SessionRecorder(path, triangle_board(), LRF, [CameraInfo("left", "head", 160, 120, MODEL)], resume=True)


def add(writer, placement):
    """Record a whole placement."""
    writer.begin_placement(placement)
    record(writer, placement)
    writer.finish_placement()


def record(writer, placement):
    """What a placement adds to it."""
    writer.add_telegrams(placement, [encode_scan(np.full(181, 2.0))] * 2, [0.0, 0.1], [placement, placement + 0.5])
    writer.add_image("left", picture(placement), placement, pitch=0.1, time_s=placement)
    writer.add_platform([(placement, 0.1, np.nan)])


# ------------------------------------------------------------------------------------------------------ damage


def damage(rng, path):
    """Damage one file of a session."""
    files = sorted(p for p in path.rglob("*") if not p.is_symlink() and p.is_file() and p.stat().st_size < 100_000_000)
    if not files:
        return
    # small tables and statements matter as much as many images do
    file = files[rng.integers(len(files))] if rng.random() < 0.6 else min(files, key=lambda f: (rng.random(), f))
    kinds = {".json": (text, text, members, raw), ".csv": (text, rows, rows, raw), ".npz": (arrays, arrays, raw),
             ".bin": (telegrams, telegrams, raw)}.get(file.suffix, (pixels, raw))  # fmt: skip
    kind = other if rng.random() < 0.15 else kinds[rng.integers(len(kinds))]
    try:
        kind(rng, file)
    except Exception:
        raw(rng, file)  # damaged too much for its own kind of damage


def raw(rng, file):
    """Any bytes."""
    data = file.read_bytes()[:1_000_000]
    at, n = int(rng.integers(len(data) + 1)), int(rng.choice([1, 2, 4, 16, 100, 1000]))
    flipped = bytearray(data)
    for place in rng.integers(max(len(data), 1), size=min(n, len(data))):
        flipped[place] ^= 1 << rng.integers(8)
    middle = [b"", rng.bytes(n) + data[at : at + n], bytes(n), 2 * data[at : at + n]]
    ways = [data[:at], flipped, data + data[:n], *(data[:at] + part + data[at + n :] for part in middle)]
    file.write_bytes(ways[rng.integers(len(ways))])


def text(rng, file):
    """Another word in place of a number or a text."""
    words = file.read_text()
    ends = [i for i, c in enumerate(words) if c in ",:[]{}\n "]
    first = int(rng.integers(len(ends) - 1))
    last = int(rng.integers(first + 1, len(ends))) if rng.random() < 0.2 else first + 1
    nasty = NASTY[rng.integers(len(NASTY))]
    file.write_bytes((words[: ends[first] + 1] + nasty + words[ends[last] :]).encode("utf-8", "replace"))


def members(rng, file):
    """A value of JSON that is gone, of another kind, or a value of elsewhere."""
    data = json.loads(file.read_text())
    nasty = [None, [], {}, "", "x", 0, -1, 1e308, 2**70, True, [[]], [1e308] * 3, [[0] * 9] * 9, 0.5]
    holders = [data]
    for holder in holders:
        values = holder.values() if isinstance(holder, dict) else holder
        holders += [value for value in values if isinstance(value, dict | list) and value]
    holder = holders[rng.integers(len(holders))]
    keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
    key = keys[rng.integers(len(keys))]
    if rng.random() < 0.2:
        del holder[key]
    elif rng.random() < 0.3 and isinstance(holder[key], int | float):
        holder[key] *= float(rng.choice([-1, 1e-9, 1000, 1e9]))
    else:
        holder[key] = json.loads(json.dumps([*nasty, *holders][rng.integers(len(nasty) + len(holders))]))
    file.write_text(json.dumps(data))


def rows(rng, file):
    """Lines doubled, gone, moved, or many."""
    lines, how = file.read_text().splitlines(), rng.integers(5)
    at, to = rng.integers(len(lines), size=2)
    cells = lines[at].split(",")
    cells[rng.integers(len(cells))] = NASTY[rng.integers(len(NASTY))]
    many = int(rng.choice([3, 1000, 300_000])) if rng.random() < 0.05 else 3
    moved = [lines[{at: to, to: at}.get(i, i)] for i in range(len(lines))]
    lines = [
        [*lines[:to], lines[at], *lines[to:]], lines[:at] + lines[at + 1 :], moved, lines + [lines[at]] * many,
        [*lines[:at], ",".join(cells), *lines[at + 1 :]],
    ][how]  # fmt: skip
    file.write_bytes(("\n".join(lines) + "\n").encode("utf-8", "replace"))


def header_of(shape, kind, turned=False):
    """A header of an array that states what need not follow."""
    return f"{{'descr': '{kind}', 'fortran_order': {turned}, 'shape': {shape}, }}\n".encode()


def array_of(header, version=1):
    """What comes before the values of an array."""
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H", len(header)) + header


def pixels_of(png, size, kind=(8, 2, 0, 0, 0)):
    """A PNG image that states another size."""
    body = b"IHDR" + struct.pack(">II5B", *size, *kind)
    return png[:12] + body + zipfile.crc32(body).to_bytes(4, "big") + png[33:]


def arrays(rng, file):
    """Other arrays than a session's, headers that lie, and archives that unpack to much."""
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name, how = sorted(members)[rng.integers(len(members))], rng.integers(4)
    if how == 0:
        shape = rng.choice("(100000, 100000);(-1, 61);();(6,);(2**40,);(6, 61;6;(6, 61, 1);(True, 61)".split(";"))
        kind = rng.choice("<f8 <f4 |O <U9 |b1 <c16 |V1000000 <i8 <f16 <M8[s] >f8 x |S0".split())
        header = header_of(shape, kind, rng.random() < 0.2)
        if rng.random() < 0.2:
            header = rng.choice([b"(" * 9000, b"{'descr':", b"\xff" * 50, b"1 +\n", header * 40])
        members[name] = array_of(header, rng.choice([1, 1, 1, 2, 3, 9])) + bytes(1000)
    elif how == 1:
        values = rng.choice([0.0, np.nan, np.inf, -1.0, 1e300, 1e-300, 1000.0])
        shape = [(6, 61), (0, 61), (6, 0), (6,), (61,), (1, 1), (3, 3000), ()][rng.integers(8)]
        stream = io.BytesIO()
        np.save(stream, np.full(shape, values, [float, np.float32, np.complex128, ">f8"][rng.integers(4)]))
        members[name] = stream.getvalue()
    elif how == 2:
        members[rng.choice(["extra.npy", "../outside/secret", name[:-4], "ranges.npy/"])] = members.pop(name)
    else:
        members[name] += bytes(int(rng.choice([10, 100_000, 30_000_000])))
    with zipfile.ZipFile(file, "w", int(rng.choice([0, 8, 12, 14])), compresslevel=1) as archive:
        for key, data in members.items():
            archive.writestr(key, data)
    if rng.random() < 0.1:
        raw(rng, file)


def telegrams(rng, file):
    """Damaged telegrams with a sound checksum, as index.csv lists them."""
    data, index = bytearray(file.read_bytes()), file.parent / "index.csv"
    assert index.is_file() and not index.is_symlink() and index.stat().st_size < 1_000_000
    table = index.read_text().splitlines()[1:]
    offset, length = (int(v) for v in table[rng.integers(len(table))].split(",")[1:3])
    for _ in range(rng.integers(1, 4)):
        at = offset + 4 + min(int(rng.integers(length - 6)), int(rng.choice([3, length])))
        data[at] = int(rng.choice([0, 255, 0xB0, 0xB1, 0xF4, 0x77, rng.integers(256)]))
    words = np.frombuffer(bytes(data), np.uint8)[None, offset : offset + length - 2]
    data[offset + length - 2 : offset + length] = int(crc16(words)[0]).to_bytes(2, "little")
    assert check_crc(np.frombuffer(bytes(data), np.uint8), np.array([offset]), np.array([length]))[0]
    file.write_bytes(data)


def pixels(rng, file):
    """Other images: another kind or size, and headers that promise many pixels, which the session may state too."""
    size = [(160, 120), (120, 160), (1, 1), (5000, 1), (30000, 30000), (5000, 4000)][rng.integers(6)]
    image, suffix = np.zeros((120, 160, int(rng.choice([1, 3, 4]))), np.uint8), str(rng.choice([".png", ".jpg"]))
    data = cv2.imencode(suffix, image)[1].tobytes()
    if data[:4] == b"\x89PNG":
        data = pixels_of(data, size, (rng.choice([8, 16]), rng.choice([0, 2, 3, 6]), 0, 0, rng.choice([0, 1])))
    elif (at := data.find(b"\xff\xc0")) > 0:
        data = data[: at + 5] + struct.pack(">HH", size[1] % 65536, size[0] % 65536) + data[at + 9 :]
        if rng.random() < 0.3:
            data = data[:at] + rng.choice([b"\xff", b"\xff\xff", b"\xff\x01", b"\xff\xd0", b"\x00"]) + data[at:]
    file.write_bytes(data)
    stated = file.parents[2] / "session.json"
    if rng.random() < 0.5 and stated.is_file() and not stated.is_symlink():  # no pipe by an earlier damage
        state_size(file, size)


def state_size(file, size):
    """Another size of the images of a camera in session.json."""
    stated = file.parents[2] / "session.json"
    session = json.loads(stated.read_text())
    session["rig"]["cameras"][file.parent.name] |= {"width": size[0], "height": size[1]}
    stated.write_text(json.dumps(session))


def other(rng, file):
    """No plain file at all, or none, or a large one; also beside a file, where one is going to be written."""
    how = rng.integers(9)
    root = next(p for p in file.parents if p.name == "case")
    outside = root.parent / "outside" / ("secret" if rng.random() < 0.5 else "secret.png")
    if how == 0:  # where a draft or the lock is going to be
        file = file.with_name(file.name + ".draft") if rng.random() < 0.7 else root / "writer.lock"
        return os.symlink(outside, file) if rng.random() < 0.8 else os.mkfifo(file)
    if how == 1 and file.parent != root:
        shutil.rmtree(file.parent)
        return os.symlink(outside.parent, file.parent)
    content = file.read_bytes()
    file.unlink()
    ways = [
        lambda: os.mkfifo(file), lambda: os.symlink("/dev/zero", file), lambda: os.symlink(outside, file),
        lambda: os.symlink(outside.parent, file), file.mkdir, lambda: None,
        lambda: (file.write_bytes(content), os.truncate(file, 3_000_000_000)),
    ]  # fmt: skip
    return ways[how - 2]()


# ---------------------------------------------------------------------------------------------- what is done with it


def use(rng, path):
    """Everything that reads a session, and some that writes; the errors that came out."""
    if (path / "rig.json").exists():
        return [_caught(read_rig_file, path / "rig.json")]  # what it names belongs to who wrote it
    surveyed = rng.random() < SURVEYED
    read = [validate, _survey if surveyed else read_all][rng.integers(2)]
    writing = [_go_on if rng.random() < 0.7 else finish] * (rng.random() < 0.3)
    return [_caught(work, path) for work in (read, *writing)]


def _survey(path):
    views_of(read_all(path))


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
    except Exception as error:
        trace, frames = traceback.format_exc(), traceback.extract_tb(error.__traceback__)
        if "MemoryError" in trace or "nsufficient memory" in trace:
            return "memory", repr(error)[:300], trace
        ours = [SessionError, RigFileError] + [OSError] * (work in (_go_on, finish))
        if work in (read_all, _survey) and frames[-1].filename.startswith(LIBRARY):
            ours.append(ValueError)  # what the preprocessing raises itself is documented as ValueError
        if not isinstance(error, tuple(ours)):
            place = next(f for f in reversed(frames) if f.filename.startswith(LIBRARY) or f is frames[0])
            where = f"{Path(place.filename).name}:{place.lineno}"
            return "foreign", f"{type(error).__name__} at {where}: {str(error)[:200]}", trace
    return None


# -------------------------------------------------------------------------------------------------- the machinery


class Watch:
    """Tells of files that are opened outside of a case's folder."""

    def __init__(self, folder):
        self.libc, self.case, self.seen, self.on = ctypes.CDLL(None, use_errno=True), str(folder / "case"), [], False
        self.handle = self.libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        everything = 0x3EF & ~0x10  # access, modify, attrib, close-write, open, moves, create, delete
        for path in (folder / "outside", *(folder / "outside").iterdir()):
            assert self.libc.inotify_add_watch(self.handle, os.fsencode(path), everything) >= 0
        sys.addaudithook(self._heard)

    def _heard(self, event, arguments):
        if not self.on or event not in ("open", "os.listdir", "os.mkdir", "os.remove", "os.rename", "os.truncate"):
            return
        if isinstance(arguments[0], str | bytes | os.PathLike):
            name = os.fsdecode(arguments[0])
            inside = name == self.case or name.startswith((self.case + "/", *READ))
            if os.path.isabs(name) and (not inside or ".." in name.split("/")):
                self.seen.append(f"{event} {name}")

    def outside(self):
        """What was opened there since the last call."""
        found, self.seen = self.seen, []
        try:  # events: what was opened, and whether it was changed
            while data := os.read(self.handle, 65536):
                while data:
                    _, mask, _, length = struct.unpack_from("<iIII", data)
                    found.append(f"inotify {mask:x} {data[16 : 16 + length].rstrip(bytes(1)).decode()}")
                    data = data[16 + length :]
        except BlockingIOError:
            return found


def run_case(number, seed, sound, folder, watch):
    """One case; the findings as (number, kind, text, traceback)."""
    rng, case = np.random.default_rng([seed, number]), folder / "case"
    shutil.rmtree(case, ignore_errors=True)
    shutil.copytree(sound / ["scans", "telegrams", "telegrams", "scans", "rig"][number % 5], case, symlinks=True)
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        damage(rng, case)
    watch.outside()
    watch.on = True
    found = [f for f in use(rng, case) if f]
    watch.on = False
    found += [("outside", text, "") for text in watch.outside() if not (case / "rig.json").exists()]
    return [(number, *f) for f in found]


def _batch(numbers, seed, base, at):
    """Runs in a process of its own, which a case that takes too long ends; `at` tells which case it is at."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what image libraries say about damaged images
    folder = Path(tempfile.mkdtemp(dir=base))
    shutil.copytree(base / "sound" / "outside", folder / "outside")
    watch = Watch(folder)
    with (base / "findings").open("a", buffering=1) as out:
        for at.value in numbers:
            signal.setitimer(signal.ITIMER_PROF, LONGEST_S)  # of the processor: a busy machine is no hang
            signal.setitimer(signal.ITIMER_REAL, 15 * LONGEST_S)
            try:
                found = run_case(at.value, seed, base / "sound", folder, watch)
            except Exception:
                found = [(at.value, "fuzzer", "it failed itself", traceback.format_exc())]
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
            found += [(at.value, "memory", f"{peak / 1e6:.0f} MB", "")] if peak > MEMORY else []
            out.writelines(json.dumps(finding) + "\n" for finding in found)
            if peak > MEMORY:
                break
    shutil.rmtree(folder)


def run(cases, first, seed, workers, tell):
    """Run cases; the findings as lists [number, kind, text, traceback]."""
    fork, memory = multiprocessing.get_context("fork"), "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    queue = [range(n, min(n + BATCH, first + cases)) for n in range(first, first + cases, BATCH)][::-1]
    with tempfile.TemporaryDirectory(prefix="lrfcal-fuzz-", dir=memory) as base:
        base, findings, running = Path(base), [], {}
        (base / "sound").mkdir()
        make_sessions(base / "sound")
        while queue or running:
            while queue and len(running) < workers:
                at, numbers = fork.RawValue("q", queue[-1][0]), queue.pop()
                child = fork.Process(target=_batch, args=(numbers, seed, base, at))
                child.start()
                running[child.sentinel] = child, numbers, at
            for ended in multiprocessing.connection.wait(running):
                child, numbers, at = running.pop(ended)
                child.join()
                if child.exitcode:
                    kind = "hang" if -child.exitcode in (signal.SIGPROF, signal.SIGALRM) else "crash"
                    findings.append([at.value, kind, f"exit code {child.exitcode}", ""])
                tell(at.value)
                queue += [range(at.value + 1, numbers.stop)] * (at.value + 1 < numbers.stop)
        return findings + [json.loads(line) for line in (base / "findings").read_text().splitlines()]


def main():
    """From the command line."""
    options = argparse.ArgumentParser(description=__doc__)
    for name, value in (("cases", 200_000), ("first", 0), ("seed", SEED), ("workers", os.cpu_count()), ("case", None)):
        options.add_argument(f"--{name}", type=int, default=value)
    options.add_argument("--out", default="reports/fuzz/findings.jsonl", help="file for the findings, one a line")
    asked = options.parse_args()
    if asked.case is not None:
        asked.first, asked.cases = asked.case, 1
    began = time.monotonic()
    tell = partial(print, end=" cases\r", file=sys.stderr, flush=True)
    found = run(asked.cases, asked.first, asked.seed, asked.workers, tell)
    Path(asked.out).parent.mkdir(parents=True, exist_ok=True)
    Path(asked.out).write_text("".join(json.dumps({"seed": asked.seed, "finding": f}) + "\n" for f in found))
    for number, kind, text, trace in found:
        print(f"{kind} {text}: --seed {asked.seed} --case {number}", trace * (asked.case is not None), sep="\n")
    print(f"{asked.cases} cases in {time.monotonic() - began:.0f} s, {len(found)} findings (in {asked.out})")
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
