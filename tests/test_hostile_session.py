"""Sessions of strangers: what they name is not followed out of their folder, and what they promise is not unpacked."""

import contextlib
import json
import os
import re
import shutil
import zipfile

import fuzz
import numpy as np
import pytest

from lrfcal_lib.preprocess.intrinsics import estimate_intrinsics, first_pose
from lrfcal_lib.session.read import open_session, validate
from lrfcal_lib.session.stated import SessionError

SCANS = ["session.json", "lrf/scans.npz", "images.csv", "edges.csv", "images/left/0001.png", "truth.json"]
FILES = [f"scans/{name}" for name in SCANS]
FILES += [f"telegrams/{name}" for name in ("lrf/telegrams.bin", "lrf/index.csv", "platform.csv")]


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    fuzz.make_sessions(folder := tmp_path_factory.mktemp("sound"))
    return folder


@pytest.fixture
def folder(sound, tmp_path):
    return shutil.copytree(sound, tmp_path, dirs_exist_ok=True)


def large(file):
    for one in (file, file.with_name("unrelated")):
        one.touch()
        os.truncate(one, 3_000_000_000)


OTHERS = {
    "is a link, not a file": lambda file: file.symlink_to("/dev/zero"), "is a named pipe, not a file": os.mkfifo,
    "is a folder, not a file": os.mkdir, "3000 MB, more than": large,
}  # fmt: skip


@pytest.mark.parametrize("told", OTHERS)
@pytest.mark.parametrize("name", FILES)
def test_only_plain_files_of_a_size_are_read(folder, name, told):
    (folder / name).unlink()
    OTHERS[told](folder / name)
    with pytest.raises(SessionError, match=f"{re.escape(name)}: {told}"):
        fuzz.read_all(folder / name.partition("/")[0])


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
        fuzz.add(writer, 7)
    assert secret.read_bytes() == before


# ------------------------------------------------------------------------------------------------- promises, values


def lying(path, shape, kind="<f8"):
    """An archive whose ranges state a shape, and are few bytes."""
    with zipfile.ZipFile(path / "lrf" / "scans.npz", "w") as archive:
        archive.writestr("ranges.npy", fuzz.array_of(fuzz.header_of(shape, kind)))


def bomb(path):
    """A picture of 900 megapixels, which session.json states as well."""
    file = path / "images" / "left" / "0001.png"
    file.write_bytes(fuzz.pixels_of(file.read_bytes(), (30000, 30000)))
    fuzz.state_size(file, (30000, 30000))


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
    "index.csv: line 2, offset 9223372036854775803.*restore the file": replaced(
        "../telegrams/lrf/index.csv", ",0,", f",{2**63 - 5},"
    ),
}


@pytest.mark.parametrize("message", DAMAGE)
def test_what_a_file_promises_is_checked_before_it_is_unpacked(folder, message):
    DAMAGE[message](folder / "scans")
    with pytest.raises(SessionError, match=message):
        fuzz.read_all(folder / ("telegrams" if message.startswith("index") else "scans"))


def test_opencv_s_refusals_are_errors_in_the_values():
    points = fuzz.PATTERN.points()
    with pytest.raises(ValueError, match="20 corners do not determine a pose"):
        first_pose(points, np.full((20, 2), 1e300), fuzz.MODEL)
    with pytest.raises(ValueError, match="3 views of the pattern do not determine the intrinsics"):
        estimate_intrinsics([np.zeros((20, 2))] * 3, fuzz.PATTERN, (0, 0))


# ----------------------------------------------------------------------------------------------- one writer a session


def test_a_second_writer_is_told_who_writes(folder):
    path = folder / "telegrams"
    told = rf"telegrams: process {os.getpid()} on \S+ since 20\S+ \S+ writes"
    with fuzz.recorder(path), pytest.raises(SessionError, match=told):
        fuzz.recorder(path)
    assert not (path / "writer.lock").exists()
    fuzz.recorder(path).finish()
    assert open_session(path).placements == (1,)


def test_check_finds_what_two_writers_or_hands_do_to_tables(folder):
    with (folder / "scans" / "edges.csv").open("a") as table:
        table.write("left,images/left/0001.png,ab,1,2,20,9\n")
    told = "\n".join(validate(folder / "scans"))
    assert "edges.csv line 4: left, images/left/0001.png, ab stands in line 2 already; remove one" in told
    replaced("images.csv", "\n2", "\nnoon")(folder / "telegrams")  # of the placement that was not finished
    replaced("lrf/index.csv", "\n1.5", "\n0.5")(folder / "telegrams")
    told = "\n".join(validate(folder / "telegrams"))
    assert re.search("images.csv line 3: t_s is 'noon.*': a number of seconds is needed", told)
    assert re.search(r"index.csv line 3: t_s runs back from 1 to 0.5: two writers at once\? Record the", told)
