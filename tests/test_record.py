"""Recording: what is finished stays, the head stops whatever happens, and the checks see what is wrong."""

import json
import os
import re
import shutil
import signal

import numpy as np
import pytest
from fake_rig import SIZE, make_rig, opened, picture, rig_data, telegram
from shared import at_write, campaign, disk_full

from lrfcal_lib import __main__ as command_line
from lrfcal_lib.acquire import record
from lrfcal_lib.acquire.record import Recording, RecordingError, main, record_session
from lrfcal_lib.drivers import port
from lrfcal_lib.drivers.port import DeviceError
from lrfcal_lib.session.files import SessionError
from lrfcal_lib.session.read import open_session, validate
from lrfcal_lib.session.recorder import SessionRecorder


def write(rig, path, count=None, **options):
    """Record placements of a rig's plan, so many of them, without anybody at the terminal."""
    recording = Recording(rig, path, **options)
    for placement in recording.to_do()[:count]:
        for _ in recording.run(placement):
            pass
    return recording


def contents(path, number, session=None):
    """Telegrams and images of a placement with all that the tables say about them, byte for byte."""
    session = session or open_session(path)
    data = (path / "lrf" / "telegrams.bin").read_bytes()
    rows = (path / "lrf" / "index.csv").read_text().splitlines()
    rows = [row.split(",") for row in rows[1:]]
    telegrams = [
        (data[int(r[1]) : int(r[1]) + int(r[2])], float(r[4]))
        for r in rows
        if r[3] == str(number)
    ]
    images = [
        (r.camera, r.pitch, r.purpose, session.read_image(r).tobytes())
        for r in session.images(placement=number)
    ]
    return telegrams, images


def expected(rig, number):
    """What :func:`contents` must be."""
    placement = next(p for p in rig.stated.plan.to_do() if p.number == number)
    ways = np.degrees(placement.pitch)
    telegrams = [(telegram(np.radians(p)), pytest.approx(p, abs=1e-6)) for p in ways]
    images = [(c, pytest.approx(p, abs=1e-9), "board", picture(p, c).tobytes())
              for p in placement.image_pitch for c in rig.cameras]  # fmt: skip
    return telegrams, images


def complete(rig, path):
    """Go on to the end of the plan; all of it must then be there, as the devices gave it."""
    write(rig, path, resume=True).finish()
    assert validate(path) == [] and "unfinished" not in (path / "session.json").read_text()
    for placement in rig.stated.plan.to_do():
        assert contents(path, placement.number) == expected(rig, placement.number)


def listed(*firsts, cameras=("left",)):
    """A rig file with placements that differ in their pitch, three stops each."""
    plans = [
        {"number": n, "pitch_deg": [p, p + 2, 1], "image_pitch_deg": [p]}
        for n, p in enumerate(firsts, 1)
    ]
    return rig_data(cameras, placements=plans)


def rows(path, name):
    """Cells of a table of a session."""
    return [row.split(",") for row in (path / name).read_text().splitlines()]


@pytest.fixture
def path(tmp_path):
    """Of the session to be recorded."""
    return tmp_path / "s"


@pytest.fixture
def rig():
    """With three placements."""
    return make_rig(listed(-4, 0, 4))


# --------------------------------------------------------------------------------------------------- what is written


@pytest.mark.parametrize("cameras", [("left", "right"), ()])
def test_a_session_holds_what_the_devices_gave(path, cameras):
    complete(make_rig(listed(-4, 0, 4, cameras=cameras)), path)
    session = open_session(path)
    assert (
        session.placements == (1, 2, 3) and "stop-and-go" in session.reference["recording"]
    )
    assert not session.continuous
    assert np.bincount(session.telegrams.outcome).tolist() == [9, 1]


@pytest.mark.parametrize("feedback", [True, False])
def test_the_platform_log_tells_commanded_and_measured_pitch(path, feedback):
    write(make_rig(listed(-4), feedback=feedback), path)
    header, *told = rows(path, "platform.csv")
    assert header == ["t_s", "commanded_deg", "measured_deg"]
    assert [float(r[1]) for r in told] == pytest.approx([-4, -3, -2])
    assert [r[2] for r in told] == ([r[1] for r in told] if feedback else ["", "", ""])
    assert (
        open_session(path)
        .reference["pitch"]
        .startswith("told by the head" if feedback else "dead reckoning")
    )


def test_a_continuous_sweep_is_written_with_its_track_and_a_scene_as_one(path):
    rig = make_rig(
        rig_data(
            mode="continuous",
            pitch_deg=[-4, 8, 1],
            placements=[{"number": 1, "board": False}],
        )
    )
    write(rig, path).finish()
    assert open_session(path).continuous
    sweep = open_session(path).sweep(1)
    scenes = open_session(path).scene_placements
    assert (
        len(sweep.pitch) > 5
        and np.all(np.diff(sweep.pitch) >= 0)
        and np.ptp(np.degrees(sweep.pitch)) > 10
    )
    told = rows(path, "platform.csv")[1:]
    assert (
        all(float(row[1]) == 8 for row in told[2:])
        and len(told) == 2 + len(rig.head.track)
        and scenes == (1,)
    )


# ---------------------------------------------------------------------------------------- interrupted and gone on


def broken_off(rig, path, events):
    """Begin a placement and leave it after some events."""
    recording = Recording(rig, path, resume=True)
    running = recording.run(recording.to_do()[0])
    for _ in range(events):
        next(running)
    running.close()
    return recording


@pytest.mark.parametrize("events", range(1, 8))
def test_the_placement_that_was_running_is_no_part_of_the_session(path, rig, events):
    write(rig, path, count=1)
    broken_off(rig, path, events)
    assert rig.head.stops == 1
    session = open_session(path)
    assert session.placements == (1,) and {r.placement for r in session.image_records} == {
        1
    }
    assert any(
        "placement 2: its recording was not finished" in text for text in session.problems
    )
    assert contents(path, 1) == expected(rig, 1)
    complete(rig, path)


def test_placements_can_be_recorded_again_and_a_finished_session_goes_on(path, rig):
    recording = broken_off(
        rig, path, 4
    )  # as a panel after a fault, with the same recording
    list(recording.run(recording.to_do()[0]))
    assert recording.finished == (1,)
    list(recording.run(recording.to_do()[0]))
    recording.drop(1)
    assert recording.finished == (2,) and [p.number for p in recording.to_do()] == [1, 3]
    recording.finish()
    complete(rig, path)


@pytest.mark.parametrize("file", ["images.csv", "platform.csv", "lrf/index.csv"])
def test_a_row_that_was_cut_off_does_no_harm(path, rig, file):
    write(rig, path, count=1)
    broken_off(rig, path, 6)
    os.truncate(path / file, (path / file).stat().st_size - 3)
    assert contents(path, 1) == expected(rig, 1)
    complete(rig, path)


@pytest.mark.parametrize(("way", "value", "message"), [
    (("rig", "lrf", "sigma_range_m"), 0.02, r"rig\.lrf\.sigma_range_m is 0\.01, not 0\.02, unlike the rig now"),
    (("board", "corners_m", 1), [0.5, 0], "board.corners_m"),
])  # fmt: skip
def test_only_the_same_rig_goes_on(path, rig, way, value, message):
    write(rig, path, count=1)
    other, (part, key, at) = listed(-4, 0, 4), way
    other[part][key][at] = value
    with pytest.raises(SessionError, match=message):
        Recording(make_rig(other), path, resume=True)


def test_a_session_is_never_written_over(path, rig):
    path.mkdir()
    (path / "notes.txt").write_text("mine")
    with pytest.raises(SessionError, match="exists already; choose another name"):
        Recording(rig, path, resume=True)
    (path / "notes.txt").unlink()
    write(rig, path)
    with pytest.raises(SessionError, match="exists already; record with --resume"):
        Recording(rig, path)


def test_placements_are_begun_and_finished_one_by_one(path, rig):
    recorder = SessionRecorder(
        path, rig.stated.board, rig.stated.lrf, rig.stated.cameras.values()
    )
    with pytest.raises(SessionError, match="placement 1 was not begun"):
        recorder.add_telegrams(1, [telegram(0.0)], 0.0)
    recorder.begin_placement(1)
    recorder.finish_placement()
    with pytest.raises(SessionError, match="placement 1 cannot be begun; recorded: 1"):
        recorder.begin_placement(1)
    with pytest.raises(SessionError, match="no placement 4 to drop; recorded: 1"):
        recorder.drop_placement(4)


# ------------------------------------------------------------------------------------------------ killed, disk full


@pytest.mark.parametrize("kills", [8, pytest.param(25, marks=campaign)])
def test_kill_9_loses_nothing_that_was_finished(path, tmp_path, monkeypatch, kills):
    data = listed(*np.linspace(-50, 40, 60).round(1).tolist(), cameras=("left", "right"))
    rig = make_rig(data)
    told = tmp_path / "told"
    unfinished = 0
    for writes in np.random.default_rng(5).integers(80, size=kills).tolist():
        if not (child := os.fork()):
            try:
                with at_write(
                    monkeypatch, writes, lambda: os.kill(os.getpid(), signal.SIGKILL)
                ):
                    recording = Recording(rig, path, resume=True)
                    for placement in recording.to_do():
                        list(recording.run(placement))
                        with told.open("ab") as stream:
                            stream.write(bytes([placement.number]))
            finally:
                os._exit(1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
        if told.exists():
            session = open_session(path)
            assert set(told.read_bytes()) <= set(session.placements)
            unfinished += len(json.loads((path / "session.json").read_text())["unfinished"])
            for number in session.placements:
                assert contents(path, number, session) == expected(rig, number)
    assert len(told.read_bytes()) > kills // 3 and unfinished > kills // 3
    complete(rig, path)


@pytest.mark.parametrize("free", range(0, 26, 3))
def test_a_full_disk_stops_the_head_and_keeps_what_is_finished(
    path, rig, monkeypatch, free
):
    write(rig, path, count=1)
    recording = Recording(rig, path, resume=True)
    with at_write(monkeypatch, free, disk_full):
        with pytest.raises(
            RecordingError,
            match="No space left.*free some space; placements 1.*--resume goes on",
        ):
            while True:
                list(recording.run(recording.to_do()[0]))
    recording.close()
    assert rig.head.stops == 1 or free in (0, 15)  # between two placements the head rests
    assert contents(path, 1) == expected(rig, 1)
    complete(rig, path)


def test_a_disk_that_is_full_at_once(path, rig, monkeypatch):
    with (
        at_write(monkeypatch, 0, disk_full),
        pytest.raises(RecordingError, match="free some space; then record again"),
    ):
        Recording(rig, path)
    complete(rig, path)
    with pytest.raises(
        RecordingError, match=r"cannot be written \(Not a directory\): check the disk"
    ):
        Recording(rig, path / "session.json" / "t")


# ------------------------------------------------------------------------------------------------- at the terminal


@pytest.fixture
def answered(monkeypatch):
    """Stands in for `input`: gives answers one after the other, raises those that are errors; what was asked."""

    def answered(*texts):
        asked = []
        left = [*texts, EOFError()]

        def ask(text):
            asked.append(text)
            if isinstance(left[0], BaseException):
                raise left[0]
            return left.pop(0)

        monkeypatch.setattr("builtins.input", ask)
        return asked

    return answered


def test_the_last_placement_can_be_asked_for_again(answered, path, rig):
    asked = answered("", "what?", "R", "", "q")
    record_session(rig, path)
    assert "dropped" in (path / "images.csv").read_text()
    assert "r: placement 1 again" in asked[1] and "again" not in asked[0]
    assert open_session(path).placements == (1,)
    answered()
    with pytest.raises(RecordingError, match="nobody is there to move the board"):
        record_session(rig, path.with_name("t"))


PATTERN = np.full((SIZE[1] * 8, SIZE[0] * 8, 3), 200, np.uint8)  # the fake board's, small
for i, k in zip(*np.nonzero(np.indices((6, 5)).sum(axis=0) % 2), strict=True):
    PATTERN[20 + 24 * i : 44 + 24 * i, 30 + 24 * k : 54 + 24 * k] = 30


@pytest.fixture
def close_rig():
    """Whose camera is to take two images of the board held close."""
    data = listed(-4)
    data["plan"]["intrinsics_images"] = 2
    data["rig"]["cameras"]["left"] |= {"width": SIZE[0] * 8, "height": SIZE[1] * 8}
    return make_rig(data)


def test_images_for_the_intrinsics_are_repeated_until_they_show_the_pattern(
    answered, path, close_rig
):
    shown = [
        PATTERN,
        np.zeros_like(PATTERN),
        PATTERN,
        PATTERN,
    ]  # one is bad, one is of the placement
    close_rig.cameras["left"].show = lambda pitch, name: shown.pop(0)
    asked = answered("", "", "", "")
    record_session(close_rig, path)
    session = open_session(path)
    assert len(session.images(purpose="intrinsics")) == 2 and all(
        r.placement == -1 for r in session.images()[:2]
    )
    assert [text[15:26] for text in asked[:3]] == [
        "view 1 of 2",
        "view 2 of 2",
        "view 2 of 2",
    ] and not shown


# -------------------------------------------------------------------------------------------------- command line


@pytest.fixture
def run(tmp_path, path, rig, monkeypatch, answered, capsys):
    """Runs the program with the fake rig: exit code, what it says, what it complains about."""
    file = tmp_path / "rig.json"
    file.write_text(json.dumps(listed(-4, 0, 4)))

    def run(*texts, **options):
        monkeypatch.setattr(record, "Rig", opened(rig))
        answered(*texts)
        code = main(file, path, **options)
        said = capsys.readouterr()
        return code, said.out, said.err.strip()

    return run


def at_scan(rig, number, action):
    """Let something happen with a scan, counted from 1."""
    seen = []
    rig.lrf.wait = lambda: (seen.append(1), len(seen) == number and action())


def test_a_recording_by_command(run, path):
    code, said, _ = run("", "", count=2)
    assert code == 0 and "placements 1, 2 are safe; 'python -m lrfcal_lib calibrate" in said
    assert run("", resume=True)[0] == 0 and open_session(path).placements == (1, 2, 3)


def test_a_recording_into_a_file_tells_how_far_it_is(run, rig, monkeypatch):
    """Nothing is a terminal here: lines come now and then, at each stop where time between them is none."""
    monkeypatch.setattr(record, "LINE_S", {False: 0.0})
    _, said, _ = run("", "", "")
    lines = [line.rstrip() for line in re.split("[\r\n]+", said)]
    assert lines[0].endswith("rig.json: opening the devices")
    begun = lines.index("placement 2 (2 of 3): board, pitch 0.00 to 2.00 deg")
    stop = r"  stop 2 of 3, \+1\.00 deg, 2 scans, 1 images, \d\d:\d\d left"
    assert any(re.fullmatch(stop, line) for line in lines[begun:])
    assert lines.index("  2 of 3 placements left") < begun
    assert lines.index("  1 of 3 placements left") > begun


def test_a_recording_of_scenes_is_not_told_to_calibrate(run, rig):
    rig.stated = make_rig(rig_data(placements=[{"number": 1, "board": False}])).stated
    code, said, _ = run("")
    assert code == 0 and "placements 1 are safe; all of them show scenes" in said
    assert "record placements of the board" in said and "lrfcal_lib calibrate" not in said


def interrupt():
    raise KeyboardInterrupt


def fail():
    raise DeviceError("the head does not tell its tilt: check its power")


DEVICE = "error: the head does not tell its tilt: check its power"
ENDS = [  # at which scan of three placements of three stops what happens; exit code and what is said
    *((scan, interrupt, 130, "stopped by Ctrl-C") for scan in range(1, 7)),
    (0, interrupt, 130, "stopped by Ctrl-C"),  # at the second prompt
    (5, lambda: signal.raise_signal(signal.SIGTERM), 143, "stopped by SIGTERM"),
    (5, lambda: signal.raise_signal(signal.SIGHUP), 129, "stopped by SIGHUP"),
    (1, fail, 2, DEVICE), (6, fail, 2, DEVICE),
]  # fmt: skip


@pytest.mark.parametrize(("scan", "end", "code", "said"), ENDS)
def test_what_ends_a_recording_is_one_line_and_another_goes_on(
    run, rig, path, scan, end, code, said, request
):
    as_found = signal.signal(
        signal.SIGHUP, signal.SIG_DFL
    )  # nohup, which may run these tests, ignores it
    request.addfinalizer(lambda: signal.signal(signal.SIGHUP, as_found))
    port.guard(rig.head)  # signals become an exit
    rig.head.emergency_stop = rig.head.stop
    at_scan(rig, scan, end)
    safe = "no placement was finished" if 0 < scan <= 3 else "placements 1 are safe"
    assert run("", "" if scan else KeyboardInterrupt(), "")[::2] == (
        code, f"{said}; {safe}; --resume goes on from there")  # fmt: skip
    assert rig.head.stops >= 1 and not rig.lrf.streaming
    port.release(rig.head)
    complete(rig, path)


@pytest.mark.parametrize(
    "removed", ["", "session.json", "lrf", "lrf/index.csv", "lrf/telegrams.bin"]
)
@pytest.mark.parametrize("scan", [5, 9])
def test_a_session_removed_amid_a_recording_is_not_called_safe(
    run, rig, path, removed, scan
):
    """While the second or the last placement is recorded."""
    target = path / removed
    at_scan(
        rig, scan, lambda: shutil.rmtree(target) if target.is_dir() else target.unlink()
    )
    code, out, err = run("", "", "")
    if removed == "session.json":  # written anew, with all that it stated
        assert validate(path) == [] and code == 0
    else:
        assert (
            code == 2
            and "was removed or damaged while it was recorded: record again" in err
        )
        assert "are safe" not in out + err


def test_what_cannot_be_recorded_is_exit_code_2(tmp_path, path, capsys):
    data = listed(-4)
    data["devices"]["head"]["port"] = "/dev/no_such_port"
    (tmp_path / "rig.json").write_text(json.dumps(data))
    assert command_line.main(["record", str(tmp_path / "rig.json"), str(path)]) == 2
    text = capsys.readouterr().err
    assert (
        "error: head: there is no port /dev/no_such_port" in text
        and text.count("\n") == 1
        and not path.exists()
    )
    with pytest.raises(SystemExit):
        command_line.main(["record", "rig.json", "s", "--placements", "0"])
    assert "1 to 1000 are possible" in capsys.readouterr().err
