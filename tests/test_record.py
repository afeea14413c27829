"""Recording: what is finished stays, the head stops whatever happens, and the checks see what is wrong."""

import contextlib
import errno
import io
import json
import os
import resource
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_rig import SIZE, make_rig, opened, picture, rig_data, telegram

from lrfcal_lib import __main__ as command_line
from lrfcal_lib.acquire import record
from lrfcal_lib.acquire.checks import Light, check_image, check_placement, check_scan, edge_rise
from lrfcal_lib.acquire.record import Recording, RecordingError, Terminal, main, record_session
from lrfcal_lib.drivers import port
from lrfcal_lib.drivers.port import DeviceError, NoReply, PortError
from lrfcal_lib.drivers.rig import Moved, Scanned
from lrfcal_lib.model.board import Chessboard
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.session.read import open_session, validate
from lrfcal_lib.session.stated import SessionError
from lrfcal_lib.session.write import SessionRecorder, finish

QUICK = Path(__file__).resolve().parents[1] / "data" / "sim_quick"


def write(rig, path, **options):
    """Record all placements of a rig's plan without anybody at the terminal."""
    recording = Recording(rig, path, **options)
    for placement in recording.to_do():
        for _ in recording.run(placement):
            pass
    return recording


def contents(path, number, session=None):
    """Telegrams and images of a placement with all that the tables say about them, byte for byte."""
    session = session or open_session(path)
    data, rows = (path / "lrf" / "telegrams.bin").read_bytes(), (path / "lrf" / "index.csv").read_text().splitlines()
    rows = [row.split(",") for row in rows[1:]]
    telegrams = [(data[int(r[1]) : int(r[1]) + int(r[2])], float(r[4])) for r in rows if r[3] == str(number)]
    images = [(r.camera, r.pitch, r.purpose, session.read_image(r).tobytes()) for r in session.images(placement=number)]
    return telegrams, images


def expected(rig, placement):
    """What :func:`contents` must be."""
    ways = np.degrees(placement.pitch)
    telegrams = [(telegram(np.radians(p)), pytest.approx(p, abs=1e-6)) for p in ways]
    images = [(c, pytest.approx(p, abs=1e-9), "board", picture(p, c).tobytes())
              for p in placement.image_pitch for c in rig.cameras]  # fmt: skip
    return telegrams, images


def listed(*firsts, cameras=("left",)):
    """A rig file with placements that differ in their pitch, three stops each."""
    plans = [{"number": n, "pitch_deg": [p, p + 2, 1], "image_pitch_deg": [p]} for n, p in enumerate(firsts, 1)]
    return rig_data(cameras, placements=plans)


# --------------------------------------------------------------------------------------------------- what is written


@pytest.mark.parametrize("cameras", [("left", "right"), ()])
def test_a_session_holds_what_the_devices_gave(tmp_path, cameras):
    rig = make_rig(listed(-4, 0, 4, cameras=cameras))
    recording = write(rig, tmp_path / "s")
    recording.finish()
    assert validate(tmp_path / "s") == []
    session = open_session(tmp_path / "s")
    assert session.placements == (1, 2, 3) and "unfinished" not in (tmp_path / "s" / "session.json").read_text()
    for placement in rig.stated.plan.to_do():
        assert contents(tmp_path / "s", placement.number) == expected(rig, placement)
    assert session.reference["pitch"] == "told by the head" and "stop-and-go" in session.reference["recording"]
    assert session.telegram_report()["outcomes"] == {"scan": 9, "other": 1, "wrong CRC": 0, "truncated": 0}


@pytest.mark.parametrize("feedback", [True, False])
def test_the_platform_log_tells_commanded_and_measured_pitch(tmp_path, feedback):
    write(make_rig(listed(-4), feedback=feedback), tmp_path / "s")
    header, *rows = (tmp_path / "s" / "platform.csv").read_text().splitlines()
    assert header == "t_s,commanded_deg,measured_deg"
    rows = [row.split(",") for row in rows]
    assert [float(r[1]) for r in rows] == pytest.approx([-4, -3, -2])
    assert [r[2] for r in rows] == ([r[1] for r in rows] if feedback else ["", "", ""])
    assert open_session(tmp_path / "s").reference["pitch"].startswith("told" if feedback else "dead reckoning")


def test_a_continuous_sweep_is_written_with_its_track(tmp_path):
    rig = make_rig(rig_data(mode="continuous", pitch_deg=[-4, 8, 1], count=1))
    write(rig, tmp_path / "s").finish()
    sweep = open_session(tmp_path / "s").sweep(1)
    assert len(sweep.pitch) > 5 and np.all(np.diff(sweep.pitch) >= 0) and np.ptp(np.degrees(sweep.pitch)) > 10
    rows = [row.split(",") for row in (tmp_path / "s" / "platform.csv").read_text().splitlines()[1:]]
    assert all(float(row[1]) == 8 for row in rows[2:]) and len(rows) == 2 + len(rig.head.track)


def test_a_scene_has_images_of_a_scene(tmp_path):
    data = rig_data(placements=[{"number": 1}, {"number": 2, "board": False}])
    write(make_rig(data), tmp_path / "s")
    assert open_session(tmp_path / "s").scene_placements == (2,)


def test_every_event_is_on_the_disk_when_it_is_seen(tmp_path):
    recording = Recording(make_rig(listed(-4)), tmp_path / "s")
    telegrams = tmp_path / "s" / "lrf" / "telegrams.bin"
    for event in recording.run(recording.to_do()[0]):
        if isinstance(event, Scanned):
            assert telegrams.read_bytes().endswith(event.readings[0].telegrams[0])
        elif isinstance(event, Moved):
            last = (tmp_path / "s" / "platform.csv").read_text().splitlines()[-1]
            assert float(last.split(",")[0]) == pytest.approx(event.time_s)


def test_interlaced_telegrams_share_their_pitch(tmp_path):
    rig = make_rig(listed(-4, cameras=()))
    recording = Recording(rig, tmp_path / "s")
    reading = rig.lrf.request()
    event = Scanned(1, (replace(reading, telegrams=reading.telegrams * 4),), np.array([0.1]))
    recording.writer.begin_placement(1)
    recording.write(event)
    rows = (tmp_path / "s" / "lrf" / "index.csv").read_text().splitlines()[2:]
    assert len(rows) == 4 and len({row.split(",")[4] for row in rows}) == 1


# ---------------------------------------------------------------------------------------- interrupted and gone on


def broken_off(rig, path, events, number=0):
    """Begin a placement and leave it after some events."""
    recording = Recording(rig, path, resume=True)
    running = recording.run(recording.to_do()[number])
    for _ in range(events):
        next(running)
    running.close()
    return recording


@pytest.mark.parametrize("events", range(1, 8))
def test_the_placement_that_was_running_is_no_part_of_the_session(tmp_path, events):
    rig = make_rig(listed(-4, 0, 4))
    write(rig, tmp_path / "s", count=1)
    broken_off(rig, tmp_path / "s", events)
    assert rig.head.stops == 1
    session = open_session(tmp_path / "s")
    assert session.placements == (1,) and {r.placement for r in session.image_records} == {1}
    assert any("placement 2: its recording was not finished" in text for text in session.problems)
    assert contents(tmp_path / "s", 1) == expected(rig, rig.stated.plan.to_do()[0])
    write(rig, tmp_path / "s", resume=True).finish()
    assert validate(tmp_path / "s") == []
    for placement in rig.stated.plan.to_do():
        assert contents(tmp_path / "s", placement.number) == expected(rig, placement)


def test_dropped_telegrams_and_images_stay_on_the_disk(tmp_path):
    rig = make_rig(listed(-4, 0))
    broken_off(rig, tmp_path / "s", 6)
    before = (tmp_path / "s" / "lrf" / "telegrams.bin").read_bytes()
    shots = sorted((tmp_path / "s" / "images" / "left").iterdir())
    assert len(shots) == 1
    write(rig, tmp_path / "s", resume=True).finish()
    assert (tmp_path / "s" / "lrf" / "telegrams.bin").read_bytes().startswith(before)
    assert shots[0].exists() and ",dropped\n" in (tmp_path / "s" / "images.csv").read_text()
    assert len(sorted((tmp_path / "s" / "images" / "left").iterdir())) == 3
    assert len(contents(tmp_path / "s", 1)[1]) == 1


def test_a_placement_can_be_recorded_again(tmp_path):
    rig = make_rig(listed(-4, 0))
    recording = write(rig, tmp_path / "s")
    recording.drop(1)
    assert recording.finished == (2,) and [p.number for p in recording.to_do()] == [1]
    list(recording.run(recording.to_do()[0]))
    recording.finish()
    assert validate(tmp_path / "s") == []
    assert contents(tmp_path / "s", 1) == expected(rig, rig.stated.plan.to_do()[0])


def test_a_panel_may_begin_again_after_a_fault(tmp_path):
    rig = make_rig(listed(-4, 0))
    recording = broken_off(rig, tmp_path / "s", 4)
    list(recording.run(recording.to_do()[0]))
    assert recording.finished == (1,)


def test_a_finished_session_can_be_extended(tmp_path):
    rig = make_rig(listed(-4, 0))
    write(rig, tmp_path / "s", count=1).finish()
    write(rig, tmp_path / "s", resume=True).finish()
    assert open_session(tmp_path / "s").placements == (1, 2)


@pytest.mark.parametrize("file", ["images.csv", "platform.csv", "lrf/index.csv"])
def test_a_row_that_was_cut_off_does_no_harm(tmp_path, file):
    rig = make_rig(listed(-4, 0))
    write(rig, tmp_path / "s", count=1)
    broken_off(rig, tmp_path / "s", 6)
    os.truncate(tmp_path / "s" / file, (tmp_path / "s" / file).stat().st_size - 3)
    assert contents(tmp_path / "s", 1) == expected(rig, rig.stated.plan.to_do()[0])
    write(rig, tmp_path / "s", resume=True).finish()
    assert validate(tmp_path / "s") == []
    for placement in rig.stated.plan.to_do():
        assert contents(tmp_path / "s", placement.number) == expected(rig, placement)


def test_only_the_same_rig_goes_on(tmp_path):
    write(make_rig(listed(-4, 0)), tmp_path / "s", count=1)
    other = listed(-4, 0)
    other["rig"]["lrf"]["sigma_range_m"] = 0.02
    with pytest.raises(SessionError, match=r"rig\.lrf\.sigma_range_m is 0\.01, not 0\.02, unlike the rig now"):
        Recording(make_rig(other), tmp_path / "s", resume=True)
    with pytest.raises(SessionError, match="board.corners_m"):
        other = listed(-4, 0)
        other["board"]["corners_m"][1][0] = 0.5
        Recording(make_rig(other), tmp_path / "s", resume=True)


def test_a_session_is_never_written_over(tmp_path):
    write(make_rig(listed(-4)), tmp_path / "s")
    with pytest.raises(SessionError, match="exists already; record with --resume"):
        Recording(make_rig(listed(-4)), tmp_path / "s")
    (tmp_path / "t").mkdir()
    (tmp_path / "t" / "notes.txt").write_text("mine")
    with pytest.raises(SessionError, match="exists already; choose another name"):
        Recording(make_rig(listed(-4)), tmp_path / "t", resume=True)


@pytest.fixture
def recorder(tmp_path):
    stated = make_rig(listed(-4)).stated
    return SessionRecorder(tmp_path / "r", stated.board, stated.lrf, stated.cameras.values())


def test_placements_are_begun_and_finished_one_by_one(recorder):
    with pytest.raises(SessionError, match="placement 1 was not begun"):
        recorder.add_telegrams(1, [telegram(0.0)], 0.0)
    with pytest.raises(SessionError, match="no placement is being recorded"):
        recorder.finish_placement()
    recorder.begin_placement(1)
    with pytest.raises(SessionError, match="placement 1 is being recorded"):
        recorder.begin_placement(2)
    recorder.add_telegrams(1, [telegram(0.0)], 0.0)
    recorder.finish_placement()
    with pytest.raises(SessionError, match="placement 1 cannot be begun; recorded: 1"):
        recorder.begin_placement(1)
    with pytest.raises(SessionError, match="no placement 4 to drop; recorded: 1"):
        recorder.drop_placement(4)
    recorder.begin_placement(2)
    recorder.finish()
    assert open_session(recorder.path).placements == (1,)


def test_a_recording_that_was_left_is_finished_from_outside(tmp_path):
    rig = make_rig(listed(-4, 0))
    write(rig, tmp_path / "s", count=1)
    finish(tmp_path / "s")
    assert open_session(tmp_path / "s").placements == (1,)


# ------------------------------------------------------------------------------------------------ killed, disk full


def in_child(work, *arguments):
    """Process id of a child that does some work and ends without Python's leave."""
    child = os.fork()
    if child:
        return child
    with contextlib.suppress(BaseException):
        work(*arguments)
        os._exit(0)
    os._exit(1)


def record_and_die(data, path, told, writes):
    """What a child does; `told` is a pipe that hears of every finished placement, `writes` how many are safe."""
    rig, fsync, left, recording = make_rig(data), os.fsync, iter(range(writes)), None

    def dying(handle):
        if next(left, None) is None:
            os.kill(os.getpid(), signal.SIGKILL)
        fsync(handle)

    until = time.monotonic() + 60.0  # against hanging
    while recording is None and time.monotonic() < until:  # while somebody else records
        with contextlib.suppress(SessionError):
            recording = Recording(rig, path, resume=True)
        time.sleep(0.001)
    os.fsync = dying
    for placement in recording.to_do():
        for _ in recording.run(placement):
            pass
        os.write(told, bytes([placement.number]))


def test_twenty_kills_of_two_writers_lose_nothing_that_was_finished(tmp_path):
    data = listed(*np.linspace(-50, 40, 120).round(1).tolist(), cameras=("left", "right"))
    rng, rig, path, known, lost = np.random.default_rng(5), make_rig(data), tmp_path / "s", set(), 0
    plan = {placement.number: placement for placement in rig.stated.plan.to_do()}
    for _ in range(20):
        read_end, write_end = os.pipe()
        children = [in_child(record_and_die, data, path, write_end, int(n)) for n in rng.integers(60, size=2)]
        os.close(write_end)
        with os.fdopen(read_end, "rb", buffering=0) as stream:
            known |= set(stream.read())
        ends = {os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children}
        assert ends == {-signal.SIGKILL}, "one ended before it was killed"
        if not known:
            continue
        session = open_session(path)
        finished = set(session.placements)
        assert known <= finished and len(finished - known) <= 2  # one each was finished and not told
        lost += len(json.loads((path / "session.json").read_text())["unfinished"])
        known = finished
        for number in finished:
            assert contents(path, number, session) == expected(rig, plan[number])
    assert 5 < len(known) < len(plan) and lost > 3
    recording = write(rig, path, resume=True, count=max(known) + 1)
    recording.finish()
    assert validate(path) == [] and len(recording.finished) == max(known) + 1


class Full:
    """A disk that is full from the n-th write on."""

    def __init__(self, monkeypatch, free):
        self.free, self.fsync = free, os.fsync
        monkeypatch.setattr(os, "fsync", self)

    def __call__(self, handle):
        self.free -= 1
        if self.free < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.fsync(handle)


@pytest.mark.parametrize("free", range(0, 26, 3))
def test_a_full_disk_stops_the_head_and_keeps_what_is_finished(tmp_path, monkeypatch, free):
    rig = make_rig(listed(-4, 0, 4))
    write(rig, tmp_path / "s", count=1)
    recording = Recording(rig, tmp_path / "s", resume=True)
    with monkeypatch.context() as patch:
        Full(patch, free)
        with pytest.raises(RecordingError, match="No space left.*free some space; placements 1.*--resume goes on"):
            while True:
                list(recording.run(recording.to_do()[0]))
    recording.close()
    assert rig.head.stops == 1 or free in (0, 15)  # between two placements the head rests
    assert contents(tmp_path / "s", 1) == expected(rig, rig.stated.plan.to_do()[0])
    again = write(rig, tmp_path / "s", resume=True)
    again.finish()
    assert validate(tmp_path / "s") == [] and again.finished == (1, 2, 3)
    for placement in rig.stated.plan.to_do():
        assert contents(tmp_path / "s", placement.number) == expected(rig, placement)


def test_a_disk_that_is_full_at_once(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        Full(patch, 0)
        with pytest.raises(RecordingError, match="free some space; then record again"):
            Recording(make_rig(), tmp_path / "s")
    write(make_rig(), tmp_path / "s", resume=True).finish()
    with pytest.raises(RecordingError, match=r"cannot be written \(Not a directory\): check the disk"):
        Recording(make_rig(), tmp_path / "s" / "session.json" / "t")


def test_a_write_that_fails_half_way_leaves_no_half_row(tmp_path):
    """A real limit of the file size: the kernel takes a part of a telegram and refuses the rest."""
    rig, path = make_rig(listed(-4, 0, 4, cameras=())), tmp_path / "s"
    write(rig, path, count=1)
    limit = (path / "lrf" / "telegrams.bin").stat().st_size + 300

    def until_full():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        try:
            write(rig, path, resume=True)
        except RecordingError as error:
            os._exit(7 if "File too large" in str(error) else 8)

    child = in_child(until_full)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    assert (path / "lrf" / "telegrams.bin").stat().st_size < limit
    assert contents(path, 1) == expected(rig, rig.stated.plan.to_do()[0])
    write(rig, path, resume=True).finish()
    assert validate(path) == []


# ------------------------------------------------------------------------------------------------- at the terminal


class Screen(io.StringIO):
    """stdout that is a terminal, or not."""

    def __init__(self, live=False):
        super().__init__()
        self.live = live

    def isatty(self):
        return self.live


def answers(*texts):
    """Stands in for `input`; notes what was asked."""
    todo, asked = list(texts), []

    def ask(text):
        asked.append(text)
        if not todo:
            raise EOFError
        answer = todo.pop(0)
        if isinstance(answer, BaseException):
            raise answer
        return answer

    ask.asked = asked
    return ask


@pytest.mark.parametrize("live", [False, True])
def test_the_display_is_plain_text(tmp_path, live, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    screen, ask = Screen(live), answers("", "", "")
    record_session(make_rig(listed(-4, 0, 4)), tmp_path / "s", terminal=Terminal(screen, ask))
    text = screen.getvalue()
    assert "\x1b" not in text and "\a" not in text and ("\r" in text) == live
    assert "placement 2 (2 of 3): board, pitch 0.00 to 2.00 deg" in text and "3 scans, 1 images" in text
    assert all(len(part) < 60 for part in text.split("\r")[1:-1] if "\n" not in part)
    assert len(ask.asked) == 3 and "put the board, then press Enter (q: end here)" in ask.asked[0]


def test_the_last_placement_can_be_asked_for_again(tmp_path):
    ask = answers("", "what?", "R", "", "q")
    recording = record_session(make_rig(listed(-4, 0)), tmp_path / "s", terminal=Terminal(Screen(), ask))
    assert recording.finished == (1,) and "dropped" in (tmp_path / "s" / "images.csv").read_text()
    assert "r: placement 1 again" in ask.asked[1] and "again" not in ask.asked[0]
    assert open_session(tmp_path / "s").placements == (1,)


def test_without_anybody_to_move_the_board(tmp_path):
    with pytest.raises(RecordingError, match="nobody is there to move the board"):
        record_session(make_rig(listed(-4)), tmp_path / "s", terminal=Terminal(Screen(), answers()))


def test_an_emulated_board_moves_by_itself(tmp_path, monkeypatch):
    rig, moved = make_rig(listed(-4, 0)), []
    monkeypatch.setattr(rig, "move_board", lambda number: moved.append(number) or True)
    record_session(rig, tmp_path / "s", terminal=Terminal(Screen(), answers()))
    assert moved == [1, 2]


def test_lights_are_shown(tmp_path):
    screen = Screen()
    record_session(make_rig(listed(-4)), tmp_path / "s", terminal=Terminal(screen, answers("")))
    assert "BAD   scan: no board" in screen.getvalue() and "BAD   camera left: 0 of 1" in screen.getvalue()


def board_picture(noise=0):
    """The fake board's pattern, small."""
    image = np.full((SIZE[1] * 8, SIZE[0] * 8), 200, np.uint8)
    for i in range(6):
        for k in range(5):
            if (i + k) % 2:
                image[20 + 24 * i : 44 + 24 * i, 30 + 24 * k : 54 + 24 * k] = 30
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)


def close_data():
    data = listed(-4)
    data["plan"]["intrinsics_images"] = 2
    data["rig"]["cameras"]["left"] |= {"width": SIZE[0] * 8, "height": SIZE[1] * 8}
    return data


def test_images_for_the_intrinsics_are_repeated_until_they_show_the_pattern(tmp_path):
    rig, shown = make_rig(close_data()), []

    def show(pitch, name):
        shown.append(pitch)
        return board_picture() if len(shown) != 2 else np.zeros_like(board_picture())

    rig.cameras["left"].show = show
    ask = answers("", "", "", "")
    record_session(rig, tmp_path / "s", terminal=Terminal(Screen(), ask))
    session = open_session(tmp_path / "s")
    assert len(session.images(purpose="intrinsics")) == 2 and all(r.placement == -1 for r in session.images()[:2])
    assert [text[15:26] for text in ask.asked[:3]] == ["view 1 of 2", "view 2 of 2", "view 2 of 2"]
    assert len(shown) == 4  # one was bad, one is of the placement


def test_images_for_the_intrinsics_are_not_taken_twice(tmp_path):
    rig = make_rig(close_data())
    rig.cameras["left"].show = lambda pitch, name: board_picture()
    recording = Recording(rig, tmp_path / "s")
    assert recording.close_views_to_do() == [("left", 0), ("left", 1)]
    recording.run_close("left")
    recording.close()
    assert Recording(rig, tmp_path / "s", resume=True).close_views_to_do() == [("left", 1)]


# -------------------------------------------------------------------------------------------------- command line


@pytest.fixture
def rig_file(tmp_path):
    file = tmp_path / "rig.json"
    file.write_text(json.dumps(listed(-4, 0, 4)))
    return file


def run(rig_file, tmp_path, rig, monkeypatch, ask, **options):
    """Exit code of the program with fakes."""
    monkeypatch.setattr(record, "Rig", opened(rig))
    return main(rig_file, tmp_path / "s", terminal=Terminal(Screen(), ask), **options)


def test_a_recording_by_command(rig_file, tmp_path, monkeypatch, capsys):
    assert run(rig_file, tmp_path, make_rig(listed(-4, 0, 4)), monkeypatch, answers("", ""), count=2) == 0
    assert open_session(tmp_path / "s").placements == (1, 2)
    assert "placements 1, 2 are safe; 'python -m lrfcal_lib calibrate" in capsys.readouterr().out
    assert run(rig_file, tmp_path, make_rig(listed(-4, 0, 4)), monkeypatch, answers(""), resume=True) == 0
    assert open_session(tmp_path / "s").placements == (1, 2, 3)


def test_ctrl_c_at_the_prompt(rig_file, tmp_path, monkeypatch, capsys):
    rig = make_rig(listed(-4, 0, 4))
    assert run(rig_file, tmp_path, rig, monkeypatch, answers("", KeyboardInterrupt())) == 130
    assert rig.head.stops and capsys.readouterr().err.strip() == (
        "stopped by Ctrl-C; placements 1 are safe; --resume goes on from there"
    )


@pytest.mark.parametrize("scans", range(1, 7))
def test_ctrl_c_amid_a_sweep(rig_file, tmp_path, monkeypatch, capsys, scans):
    rig, seen = make_rig(listed(-4, 0, 4)), []

    def interrupt():
        seen.append(1)
        if len(seen) == scans:
            raise KeyboardInterrupt

    rig.lrf.wait = interrupt
    assert run(rig_file, tmp_path, rig, monkeypatch, answers("", "")) == 130
    assert rig.head.stops >= 1 and not rig.lrf.streaming
    assert "stopped by Ctrl-C" in capsys.readouterr().err
    rig.lrf.wait = None
    assert run(rig_file, tmp_path, rig, monkeypatch, answers("", "", ""), resume=True) == 0
    assert validate(tmp_path / "s") == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_signals_say_what_is_safe_and_how_to_go_on(rig_file, tmp_path, monkeypatch, capsys, number):
    """As `emergency` turns them into an exit, amid the second placement."""
    rig, seen = make_rig(listed(-4, 0, 4)), []
    port.guard(rig.head)
    rig.head.emergency_stop = rig.head.stop

    def end():
        seen.append(1)
        if len(seen) == 5:
            signal.raise_signal(number)

    rig.lrf.wait = end
    assert run(rig_file, tmp_path, rig, monkeypatch, answers("", "", "")) == 128 + number
    port.release(rig.head)
    said = f"stopped by {number.name}; placements 1 are safe; --resume goes on from there"
    assert rig.head.stops and capsys.readouterr().err.strip() == said
    rig.lrf.wait = None
    assert run(rig_file, tmp_path, rig, monkeypatch, answers("", ""), resume=True) == 0


@pytest.mark.parametrize("removed", ["", "session.json", "lrf", "lrf/index.csv", "lrf/telegrams.bin"])
@pytest.mark.parametrize("scans", [5, 9, 0])
def test_a_session_removed_amid_a_recording_is_not_called_safe(rig_file, tmp_path, monkeypatch, capsys, removed, scans):
    """While the second or the last placement is recorded, or before the third one is begun."""
    rig, seen, path = make_rig(listed(-4, 0, 4)), [], tmp_path / "s" / removed

    def remove(*_):
        seen.append(1)
        if len(seen) == (scans or 3):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        return ""

    if scans:
        rig.lrf.wait = remove
    code = run(rig_file, tmp_path, rig, monkeypatch, answers("", "", "") if scans else remove)
    said = capsys.readouterr()
    whole = removed == "session.json"  # written anew, with all that it stated
    assert whole or code == 2 and "was removed or damaged while it was recorded: record again" in said.err
    assert whole or "are safe" not in said.out + said.err
    assert not whole or validate(tmp_path / "s") == [] and code == 0


FAULTS = [
    (PortError("lrf: no permission for /dev/ttyUSB0: run 'sudo usermod -aG dialout $USER'"), "usermod"),
    (NoReply("the head does not tell its tilt: check its power"), "check its power"),
]


@pytest.mark.parametrize(("error", "remedy"), FAULTS)
def test_a_device_that_fails_is_one_line(rig_file, tmp_path, monkeypatch, capsys, error, remedy):
    rig = make_rig(listed(-4, 0, 4))
    rig.head.fail = error
    assert run(rig_file, tmp_path, rig, monkeypatch, answers("", "")) == 2
    text = capsys.readouterr().err
    assert remedy in text and text.count("\n") == 1 and "no placement was finished; --resume" in text


def test_a_full_disk_is_one_line(rig_file, tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        Full(patch, 40)
        assert run(rig_file, tmp_path, make_rig(listed(-4, 0, 4)), patch, answers("", "", "")) == 2
    text = capsys.readouterr().err
    assert "free some space; placements 1 are safe" in text and text.count("\n") == 1


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        (("devices", "head", "port"), "/dev/no_such_port", "error: head: there is no port /dev/no_such_port"),
        (("devices", "head", "pitch_limits_deg"), [0, 1], "pitch_limits_deg are 0 to 1: ask for less"),
        (("plan", "mode"), "fast", "plan.mode is 'fast'"),
    ],
)
def test_what_cannot_be_recorded_is_exit_code_2(tmp_path, capsys, key, value, message):
    data = listed(-4)
    data[key[0]] = {**data[key[0]], **({key[1]: value} if len(key) == 2 else {})}
    if len(key) == 3:
        data[key[0]][key[1]][key[2]] = value
    (tmp_path / "rig.json").write_text(json.dumps(data))
    assert command_line.main(["record", str(tmp_path / "rig.json"), str(tmp_path / "s")]) == 2
    text = capsys.readouterr().err
    assert message in text and text.count("\n") == 1 and not (tmp_path / "s").exists()


def test_the_command_line_passes_everything_on(monkeypatch, capsys):
    got = {}
    monkeypatch.setattr("lrfcal_lib.acquire.record.main", lambda *args, **options: got.update(options, args=args) or 0)
    line = ["record", "rig.json", "s", "--resume", "--placements", "3", "--mode", "continuous"]
    assert command_line.main(line) == 0
    assert got == {"args": ("rig.json", "s"), "resume": True, "count": 3, "mode": "continuous"}
    with pytest.raises(SystemExit):
        command_line.main(["record", "rig.json", "s", "--placements", "0"])
    assert "1 or more are needed" in capsys.readouterr().err
    monkeypatch.setattr("lrfcal_lib.emulators.rig.main", lambda rest: got.update(rest=rest) or 0)
    assert command_line.main(["emulate", "sim_quick", "--rig-file", "x.json"]) == 0
    assert got["rest"] == ["sim_quick", "--rig-file", "x.json"]


# ---------------------------------------------------------------------------------------------------------- lights


@pytest.fixture(scope="module")
def quick():
    return open_session(QUICK)


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_a_good_placement_is_green(quick, number):
    lights = check_placement(quick, number, advice=lambda session: "")
    assert [light.name for light in lights] == ["scan", "edges", "camera left", "camera right", "information"]
    assert {light.state for light in lights} == {"ok"}
    assert "scan lines at" in lights[0].text and "3 sides:" in lights[1].text


def test_a_scene_is_checked_for_returns_alone(quick):
    (light,) = check_placement(quick, 5)
    assert light.state == "ok" and "scene: 85 scan lines" in light.text


def test_the_board_missing_cut_off_or_hardly_hit_is_seen(quick):
    sweep = quick.sweep(2)
    none = replace(sweep, ranges=np.random.default_rng(1).uniform(1, 9, sweep.ranges.shape))
    for seen, text in ((none, "no board: "), (None, "no scan line with a range")):
        (light,) = check_scan(seen, quick.board, quick.T_head_lrf)
        assert light.state == "bad" and light.text.startswith(text)
    half = _rows(sweep, slice(None, len(sweep.pitch) // 2))
    first, _ = check_scan(half, quick.board, quick.T_head_lrf)
    assert first.state == "warn" and "line hits it: sweep farther" in first.text
    coarse = check_scan(_rows(sweep, slice(0, None, 10)), quick.board, quick.T_head_lrf)
    assert coarse[0].state == "warn" and "take a smaller step" in coarse[0].text


def _rows(sweep, rows):
    return replace(sweep, ranges=sweep.ranges[rows], pitch=sweep.pitch[rows], time_s=sweep.time_s[rows])


def test_images_that_are_blurred_dark_bright_or_empty_are_seen(quick):
    image = quick.read_image(quick.images("left", 2)[0])
    assert check_image(image, quick.board).state == "ok"
    wrong = {
        "blurred": cv2.GaussianBlur(image, (0, 0), 2.5),
        "too dark": (image * 0.12).astype(np.uint8),
        "overexposed": np.clip(image * 2.5, 0, 255).astype(np.uint8),
        "little contrast": (image * 0.1 + 100).astype(np.uint8),
    }
    for text, other in wrong.items():
        light = check_image(other, quick.board, name="camera left")
        assert light.state == "warn" and text in light.text and light.name == "camera left"
    light = check_image(np.zeros_like(image), quick.board)
    assert light.state == "bad" and "no chessboard with" in light.text


def test_a_board_without_a_pattern_needs_intrinsics(quick):
    bare = replace(quick.board, pattern=None)
    image = quick.read_image(quick.images("left", 2)[0])
    assert check_image(image, bare).state == "warn"
    light = check_image(np.zeros_like(image), bare, CameraModel(640, 480, 670.0, 670.0, 320.0, 240.0, np.zeros(5)))
    assert light.state == "bad" and light.text


@pytest.mark.parametrize("sigma", [0.8, 1.5, 2.5, 4.0])
def test_the_rise_of_edges_is_that_of_a_gaussian(sigma):
    size, pattern = 40, Chessboard(4, 5, 0.03)
    cells = np.indices((pattern.rows + 1, pattern.columns + 1)).sum(axis=0) % 2
    picture = cv2.GaussianBlur(np.kron(cells, np.ones((size, size))).astype(np.float32) * 180 + 40, (0, 0), sigma)
    v, u = np.mgrid[1 : pattern.rows + 1, 1 : pattern.columns + 1] * size - 0.5
    grid = np.stack([u, v], axis=-1).astype(float)
    assert edge_rise(picture.astype(np.uint8), grid) == pytest.approx(2.563 * sigma, abs=0.6)


def test_a_camera_without_images_is_red(tmp_path):
    data = listed(-4)
    data["plan"]["placements"][0]["image_pitch_deg"] = []
    write(make_rig(data), tmp_path / "s")
    last = check_placement(open_session(tmp_path / "s"), 1)[-1]
    assert last == Light("camera left", "bad", "no image")


def test_a_device_error_keeps_its_note(tmp_path):
    rig = make_rig(listed(-4, 0))
    write(rig, tmp_path / "s", count=1)
    rig.head.fail = DeviceError("gone")
    with pytest.raises(DeviceError) as caught:
        record_session(rig, tmp_path / "s", resume=True, terminal=Terminal(Screen(), answers("")))
    assert caught.value.__notes__ == ["placements 1 are safe; --resume goes on from there"]
