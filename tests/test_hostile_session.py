"""Sessions of strangers: what they name is not followed out of their folder, and what they promise is not unpacked."""

import contextlib
import fcntl
import json
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import fuzz
import numpy as np
import pytest
from shared import DATA, campaign

from lrfcal_lib.__main__ import main
from lrfcal_lib.preprocess.intrinsics import estimate_intrinsics, first_pose
from lrfcal_lib.session.files import SessionError
from lrfcal_lib.session.lock import alone
from lrfcal_lib.session.read import open_session, validate

SCANS = [
    "session.json",
    "lrf/scans.npz",
    "images.csv",
    "edges.csv",
    "images/left/0001.png",
    "truth.json",
]
FILES = [f"scans/{name}" for name in SCANS]
FILES += [
    f"telegrams/{name}" for name in ("lrf/telegrams.bin", "lrf/index.csv", "platform.csv")
]


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


LINKS = {
    "is a link": Path.symlink_to,
    r"has another name elsewhere \(a hard link\); copy": Path.hardlink_to,
}


WRITTEN_ANEW = (
    "images.csv",
    "lrf/index.csv",
)  # as a draft, when a recording goes on, without what was broken off


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("name", ["session.json.draft", "images.csv.draft", "lrf/index.csv.draft", "writer.lock",
                                  "platform.csv", "images.csv", "lrf/index.csv", "lrf/telegrams.bin"])  # fmt: skip
def test_nothing_is_written_behind_a_link(folder, name, link):
    path = folder / "telegrams"
    secret = folder / "outside" / "secret"
    if (path / name).exists():
        (path / name).replace(secret)  # so that it can be read, and would be written to
    LINKS[link](path / name, secret)
    before = secret.read_bytes()
    told = contextlib.nullcontext()
    anew = LINKS[link] is Path.hardlink_to and name in WRITTEN_ANEW
    if not anew and not name.endswith(".draft"):  # drafts are replaced
        told = pytest.raises(SessionError, match=rf"{re.escape(name)}: {link}")
    with told, fuzz.recorder(path) as writer:
        fuzz.add(writer, 7)
    assert secret.read_bytes() == before


# ------------------------------------------------------------------------------------------------- promises, values


def lying(path, shape, kind="<f8"):
    """An archive whose ranges state a shape, and are few bytes."""
    with zipfile.ZipFile(path / "lrf" / "scans.npz", "w") as archive:
        archive.writestr("ranges.npy", fuzz.array_of(fuzz.header_of(shape, kind)))


def stated_header(path):
    """Ranges whose header would be 896 MB long, of which a few are there."""
    with zipfile.ZipFile(path / "lrf" / "scans.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(
            "ranges.npy",
            b"\x93NUMPY\2\0" + (896_000_000).to_bytes(4, "little") + b" " * 1_000_000,
        )


def many_members(path):
    """An archive with more files than a session has arrays."""
    with zipfile.ZipFile(path / "lrf" / "scans.npz", "a") as archive:
        for number in range(200):
            archive.writestr(f"{number}", b"")


def repacked(path):
    """The arrays packed by LZMA, which is not unpacked in steps."""
    file = path / "lrf" / "scans.npz"
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(file, "w", zipfile.ZIP_LZMA) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def jpeg(change, **options):
    """A JPEG as first image, with other bytes."""
    return lambda path: fuzz.as_jpeg(path, (160, 120), change, **options)


def scans_again(data):
    """The last scan of a JPEG a hundred times more."""
    return data[:-2] + 100 * data[data.rindex(b"\xff\xda") : -2] + data[-2:]


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


def named_again(path):
    """An image that the table names a second time, in other words."""
    with (path / "images.csv").open("a") as table:
        table.write(",left,images//left/./0001.png,2,,board\n")


DEEP = "[" * 100_000
LONG = "9" * 5000
DAMAGE = {
    "scans.npz: 10000000000 values of scan lines, more than": lambda p: lying(
        p, "(100000, 100000)"
    ),
    "scans.npz: ranges cannot be read: it holds [|]V1000000": lambda p: lying(
        p, "(6, 61)", "|V1000000"
    ),
    "scans.npz: cannot be read .*; truncated": lambda p: lying(p, "(6, 61"),
    "scans.npz: cannot be read .*expected 896000000 bytes got 9988": stated_header,
    "scans.npz: holds 206 files, more than 100; write it again": many_members,
    "scans.npz: ranges is packed in another way than numpy does; write it again": repacked,
    "0001.jpg: a JPEG of 110 scans, more than 100; write": jpeg(
        scans_again, IMWRITE_JPEG_PROGRESSIVE=1
    ),
    "0001.jpg: a JPEG of 11000 segments of remarks, more than 10000": jpeg(
        lambda data: data[:2] + 11_000 * b"\xff\xe1\0\2" + data[2:]
    ),
    "0001.jpg: the image is truncated after": jpeg(
        lambda data: data[:2] + 150_000 * b"\xff\xe5\0\2" + data[2:]
    ),
    "images.csv line 7: .*images/left/0001.png stands in line 4 already; remove one": lambda p: (
        named_again(p)
    ),
    "left.height is 30000: at most 30000000 pixels": bomb,
    "session.json: not JSON .*recursion": replaced(
        "session.json", '"source": ""', f'"source": {DEEP}'
    ),
    "session.json: not JSON .*integer": replaced(
        "session.json", '"source": ""', f'"source": {LONG}'
    ),
    "session.json: nested deeper": replaced(
        "session.json", '"source": ""', '"source": ' + "[" * 90 + "]" * 90
    ),
    "placements.0 is inf: a finite number": replaced(
        "session.json", '"placements": [\n  1', '"placements": [1e999'
    ),
    "left.width is inf: a finite number": replaced("session.json", "160", "1e999"),
    "truth.json .*simulate the session again.* 'items'": lambda p: (
        p / "truth.json"
    ).write_text(json.dumps(json.loads((p / "truth.json").read_text()) | {"cameras": []})),
    "truth.json .*key 'T_camera_platform' is missing": replaced(
        "truth.json", '{"T_camera_lrf"', '{"pose"'
    ),
    "truth.json .*it is None: an object is needed": lambda p: (p / "truth.json").write_text(
        json.dumps(json.loads((p / "truth.json").read_text()) | {"T_head_lrf": None})
    ),
    "truth.json: not JSON": lambda p: (p / "truth.json").write_text(DEEP),
    "index.csv: line 2, offset 9223372036854775803.*restore the file": replaced(
        "../telegrams/lrf/index.csv", ",0,", f",{2**63 - 5},"
    ),
}


LIMITED = """import resource, sys
import fuzz
from lrfcal_lib.calibrate.pipeline import prepare
from lrfcal_lib.session.read import open_session, validate
resource.setrlimit(resource.RLIMIT_DATA, (fuzz.MEMORY, fuzz.MEMORY))
resource.setrlimit(resource.RLIMIT_CPU, (int(fuzz.LONGEST_S), int(fuzz.LONGEST_S)))
print(*eval(sys.argv[1]))"""
BOMBS = dict(zip(fuzz.BOMBS, (
    "cannot be read .*expected 900000000 bytes", "packed in another way", "holds 1000006 files", "truncated after 48",
    "12000000 segments of remarks", "JPEG of 5010 scans", "^$", "stands in line .* already",
), strict=True))  # fmt: skip


def limited(call):
    """What a call yields, as text, in a process with the memory and the time of `make fuzz`."""
    same = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", LIMITED, call]
    return subprocess.run(
        command, env=same, stdout=subprocess.PIPE, text=True, check=True
    ).stdout.strip()


@campaign
@pytest.mark.parametrize("bomb", BOMBS)
def test_little_becomes_neither_much_nor_long(folder, bomb):
    bomb(folder / "scans")
    told = limited(f"validate({str(folder / 'scans')!r})")
    assert re.search(BOMBS[bomb], told), told


@campaign
def test_many_images_are_not_all_in_memory():
    """The shipped session has 148; each is looked at several times."""
    assert limited(f"prepare(open_session({str(DATA / 'sim_lms221')!r})).problems") == ""


@pytest.mark.parametrize("message", DAMAGE)
def test_what_a_file_promises_is_checked_before_it_is_unpacked(folder, message):
    DAMAGE[message](folder / "scans")
    with pytest.raises(SessionError, match=message):
        fuzz.read_all(folder / ("telegrams" if message.startswith("index") else "scans"))


def test_opencv_s_refusals_are_errors_in_the_values():
    points = fuzz.PATTERN.points()
    with pytest.raises(ValueError, match="20 corners do not determine a pose"):
        first_pose(points, np.full((20, 2), 1e300), fuzz.MODEL)
    with pytest.raises(
        ValueError, match="3 views of the pattern do not determine the intrinsics"
    ):
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


def test_a_lock_whose_file_was_removed_is_not_held(folder, monkeypatch):
    """Who opened the file before its holder let go of it has locked a file that nobody else can see."""
    lock = fcntl.flock
    with contextlib.ExitStack() as first, contextlib.ExitStack() as second:
        first.enter_context(alone(folder / "scans"))

        def late(*arguments):
            monkeypatch.undo()
            first.close()
            second.enter_context(alone(folder / "scans"))
            return lock(*arguments)

        monkeypatch.setattr(fcntl, "flock", late)
        with (
            pytest.raises(SessionError, match="writes this session"),
            alone(folder / "scans"),
        ):
            pytest.fail("two hold it")


def take(path, times, both):
    """Take the lock of a session so many times; `both` counts how often somebody else had it as well."""
    while times:
        with contextlib.suppress(SessionError), alone(path):
            times -= 1
            try:
                os.close(os.open(path / "held", os.O_CREAT | os.O_EXCL))
                os.unlink(path / "held")
            except FileExistsError:
                both.value += 1


@pytest.mark.parametrize("times", [300, pytest.param(100_000, marks=campaign)])
def test_never_two_hold_the_lock(tmp_path, times):
    fork = multiprocessing.get_context("fork")
    both = fork.Value("i", 0)
    takers = [
        fork.Process(target=take, args=(tmp_path, times // 3, both)) for _ in range(3)
    ]
    for taker in takers:
        taker.start()
    for taker in takers:
        taker.join()
    assert [taker.exitcode for taker in takers] == [0, 0, 0] and both.value == 0


def test_names_of_a_stranger_do_not_steer_the_terminal(folder, capsys):
    names = "images/left/\x1b]0;owned\x07.png", "images/left/\u202egnp.png"
    shutil.copytree(folder / "scans", sound := folder / "\x1b[31msound")
    assert (
        main(["check", str(sound)]) == 0
        and "\\x1b[31msound: nothing" in capsys.readouterr().out
    )
    for name in names:
        shutil.copytree(folder / "scans", path := folder / f"\x1b[31m{names.index(name)}")
        replaced("images.csv", "images/left/0001.png", name)(path)
        assert main(["check", str(path)]) == 1
        told = capsys.readouterr()
        assert (told.out + told.err).replace("\n", "").isprintable()
        assert (
            "must be printable" in told.out
            and ascii(name)[1:-1] in told.out
            and "\\x1b[31m" in told.out
        )


def test_check_finds_what_two_writers_or_hands_do_to_tables(folder):
    with (folder / "scans" / "edges.csv").open("a") as table:
        table.write("left,images/left/0001.png,ab,1,2,20,9\n")
    told = "\n".join(validate(folder / "scans"))
    assert (
        "images/left/0001.png, ab stands in line 2 already; remove one" in told
        and "edges.csv line 4: left, " in told
    )
    replaced("images.csv", "\n2", "\nnoon")(
        folder / "telegrams"
    )  # of the placement that was not finished
    replaced("lrf/index.csv", "\n1.5", "\n0.5")(folder / "telegrams")
    told = "\n".join(validate(folder / "telegrams"))
    assert re.search(
        "images.csv line 3: t_s is 'noon.*': a number of seconds is needed", told
    )
    assert re.search(
        r"index.csv line 3: t_s runs back from 1 to 0.5: two writers at once\? Record the",
        told,
    )
