"""Sessions of strangers: what they name is not followed out of their folder, and what they promise is not unpacked."""

import contextlib
import json
import os
import re
import struct
import zipfile
import zlib

import fuzz
import numpy as np
import pytest

from lrfcal_lib.evaluate.export import file_hashes
from lrfcal_lib.evaluate.tables import read_truth
from lrfcal_lib.preprocess.pattern_in_image import estimate_intrinsics, first_pose
from lrfcal_lib.session.read import open_session, validate
from lrfcal_lib.session.stated import SessionError
from lrfcal_lib.session.write import SessionRecorder, finish

SCANS = ["session.json", "lrf/scans.npz", "images.csv", "edges.csv", "images/left/0001.png", "truth.json"]
TELEGRAMS = ["lrf/telegrams.bin", "lrf/index.csv", "platform.csv"]


@pytest.fixture
def folder(tmp_path):
    fuzz.make_sessions(tmp_path)
    return tmp_path


def read_all(path):
    session = open_session(path)
    read_truth(session)
    file_hashes(session)


OTHERS = {"a link": lambda file: file.symlink_to("/dev/zero"), "a named pipe": os.mkfifo, "a folder": os.mkdir}


@pytest.mark.parametrize("kind", OTHERS)
@pytest.mark.parametrize("name", SCANS + TELEGRAMS)
def test_only_plain_files_are_read(folder, name, kind):
    path = folder / ("scans" if name in SCANS else "telegrams")
    (path / name).unlink()
    OTHERS[kind](path / name)
    with pytest.raises(SessionError, match=rf"{re.escape(name)}: is {kind}, not a file"):
        read_all(path)


@pytest.mark.parametrize("name", SCANS + TELEGRAMS)
def test_large_files_are_not_read(folder, name):
    path = folder / ("scans" if name in SCANS else "telegrams")
    os.truncate(path / name, 3_000_000_000)
    (path / "unrelated").touch()
    os.truncate(path / "unrelated", 3_000_000_000)
    with pytest.raises(SessionError, match=rf"{re.escape(name)}: 3000 MB, more than"):
        read_all(path)


@pytest.mark.parametrize("name", ["lrf", "images", "images/left"])
def test_folders_that_are_links_are_not_entered(folder, name):
    for path in (folder / "scans", folder / "telegrams"):
        (path / name).rename(folder / path.name.upper())
        (path / name).symlink_to(folder / path.name.upper())
    with pytest.raises(SessionError, match=rf"{name}: is a link, not a folder"):
        open_session(folder / "scans")
    with pytest.raises(SessionError, match=rf"{name}: is a link, not a folder"):
        fuzz.recorder(folder / "telegrams")


@pytest.mark.parametrize("name", ["session.json.draft", "images.csv.draft", "lrf/index.csv.draft", "writer.lock",
                                  "platform.csv", "images.csv", "lrf/index.csv", "lrf/telegrams.bin"])  # fmt: skip
def test_nothing_is_written_behind_a_link(folder, name):
    secret, path = folder / "outside" / "secret", folder / "telegrams"
    (path / name).unlink(missing_ok=True)
    (path / name).symlink_to(secret)
    before, told = secret.read_bytes(), contextlib.nullcontext()
    if not name.endswith(".draft"):  # drafts are replaced
        told = pytest.raises(SessionError, match=rf"{re.escape(name)}: is a link")
    with told, fuzz.recorder(path) as writer:
        writer.begin_placement(7)
        fuzz.record(writer, 7)
        writer.finish_placement()
    assert secret.read_bytes() == before


# ------------------------------------------------------------------------------------------------- promises, values


def lying(path, shape, descr="<f8"):
    """An archive whose ranges state a shape, and are few bytes."""
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    with zipfile.ZipFile(path / "lrf" / "scans.npz", "w") as archive:
        archive.writestr("ranges.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)


def bomb(path):
    """A picture of 900 megapixels, which session.json states as well."""
    data = b"IHDR" + struct.pack(">II5B", 30000, 30000, 8, 2, 0, 0, 0)
    file = path / "images" / "left" / "0001.png"
    content = file.read_bytes()
    file.write_bytes(content[:12] + data + struct.pack(">I", zlib.crc32(data)) + content[33:])
    stated = json.loads((path / "session.json").read_text())
    stated["rig"]["cameras"]["left"] |= {"width": 30000, "height": 30000}
    (path / "session.json").write_text(json.dumps(stated))


def replaced(name, old, new):
    """Another text in a file."""

    def replace(path):
        text = (path / name).read_text()
        assert old in text
        (path / name).write_text(text.replace(old, new, 1))

    return replace


DEEP, LONG = "[" * 100_000, "9" * 5000
DAMAGE = {
    "scans.npz: 10000000000 values of scan lines, more than": lambda p: lying(p, "(100000, 100000)"),
    "scans.npz: ranges cannot be read: it holds [|]V1000000": lambda p: lying(p, "(6, 61)", "|V1000000"),
    "scans.npz: cannot be read .*; truncated": lambda p: lying(p, "(6, 61"),
    "left.height is 30000: at most 30000000 pixels": bomb,
    "session.json: not JSON .*recursion": replaced("session.json", '"source": ""', f'"source": {DEEP}'),
    "session.json: not JSON .*integer": replaced("session.json", '"source": ""', f'"source": {LONG}'),
    "session.json: nested deeper": replaced("session.json", '"source": ""', '"source": ' + "[" * 90 + "]" * 90),
    "placements.0 is inf: a finite number": replaced("session.json", '"placements": [\n  1', '"placements": [1e999'),
    "left.width is inf: a finite number": replaced("session.json", "160", "1e999"),
    "truth.json .*simulate the session again.* 'items'": lambda p: (p / "truth.json").write_text(
        json.dumps(json.loads((p / "truth.json").read_text()) | {"cameras": []})
    ),
    "truth.json: not JSON": lambda p: (p / "truth.json").write_text(DEEP),
}


@pytest.mark.parametrize("message", DAMAGE)
def test_what_a_file_promises_is_checked_before_it_is_unpacked(folder, message):
    DAMAGE[message](folder / "scans")
    with pytest.raises(SessionError, match=message):
        read_all(folder / "scans")


def test_offsets_that_overflow_are_refused(folder):
    replaced("lrf/index.csv", ",0,", f",{2**63 - 5},")(folder / "telegrams")
    with pytest.raises(SessionError, match=f"index.csv: line 2, offset {2**63 - 5}.*restore the file"):
        open_session(folder / "telegrams")


def test_opencv_s_refusals_are_errors_in_the_values():
    points = fuzz.PATTERN.points()
    with pytest.raises(ValueError, match="20 corners do not determine a pose"):
        first_pose(points, np.full((20, 2), 1e300), fuzz.MODEL)
    with pytest.raises(ValueError, match="3 views of the pattern do not determine the intrinsics"):
        estimate_intrinsics([np.zeros((20, 2))] * 3, fuzz.PATTERN, (0, 0))


def test_mistakes_of_ours_are_not_taken_for_damage(folder, monkeypatch):
    monkeypatch.setattr("lrfcal_lib.session.read.missing_parts", lambda *args: args[99])
    with pytest.raises(IndexError):
        open_session(folder / "scans")


# ----------------------------------------------------------------------------------------------- one writer a session


def test_a_second_writer_is_told_who_writes(folder):
    path = folder / "telegrams"
    for refused in (fuzz.recorder, finish):
        with fuzz.recorder(path):
            with pytest.raises(SessionError, match=rf"telegrams: process {os.getpid()} on \S+ since 20\S+ \S+ writes"):
                refused(path)
    assert not (path / "writer.lock").exists()
    fuzz.recorder(path).finish()
    assert open_session(path).placements == (1,)


def test_placements_that_are_written_as_1_0_stay_whole_numbers(folder):
    replaced("session.json", '"placements": [\n  1', '"placements": [\n  1.0')(folder / "telegrams")
    with fuzz.recorder(folder / "telegrams") as writer:
        assert repr(writer.finished) == "(1,)"


def test_a_session_that_cannot_begin_is_not_kept_from_others(folder):
    with pytest.raises(SessionError, match="exists already"):
        SessionRecorder(folder / "outside", fuzz.SQUARE, fuzz.LRF)
    assert sorted(p.name for p in (folder / "outside").iterdir()) == ["secret", "secret.png"]


def test_check_finds_what_two_writers_left(folder, monkeypatch):
    """Two of them, let in side by side, record the same placement in turns."""
    path = folder / "telegrams"
    fuzz.recorder(path).finish()
    assert not [text for text in validate(path) if " line " in text]
    monkeypatch.setattr("lrfcal_lib.session.stated.alone", lambda path: contextlib.nullcontext())
    both = [fuzz.recorder(path) for _ in range(2)]
    for writer in both:
        writer.begin_placement(5)
    for writer in both:
        fuzz.record(writer, 5)
    both[0].finish_placement()
    found = "\n".join(validate(path))
    assert re.search(r"images.csv line 5: images/left/0003.png stands in line 4 already; remove one", found)
    assert re.search(r"index.csv line 8: t_s runs back from 5.5 to 5: two writers at once\? Record the", found)


def test_check_finds_an_edge_that_is_picked_twice(folder):
    with (folder / "scans" / "edges.csv").open("a") as table:
        table.write("left,images/left/0001.png,ab,1,2,20,9\n")
    assert any(
        "edges.csv line 4: left, images/left/0001.png, ab stands in line 2" in p for p in validate(folder / "scans")
    )
