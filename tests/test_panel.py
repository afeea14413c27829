"""The data collection panel without a browser: its logic on a fake rig, its pictures, its words, its buttons."""

import json
import logging
import threading
import time

import numpy as np
import pytest
from fake_rig import SIZE, make_rig, opened, raising, rig_data

from lrfcal_lib.acquire import collector
from lrfcal_lib.acquire import panel as page
from lrfcal_lib.acquire.checks import Light
from lrfcal_lib.acquire.collector import Busy, Collector, Interrupted
from lrfcal_lib.acquire.record import RecordingError
from lrfcal_lib.drivers.port import DeviceError, LineLost, OutOfRange, PortError
from lrfcal_lib.drivers.rig_file import RigFileError
from lrfcal_lib.emulators import rig as practice
from lrfcal_lib.session.read import open_session, validate
from lrfcal_lib.session.stated import SessionError
from lrfcal_lib.simulate.rig import SETUPS

WAIT_S = 20  # guards against hanging
VIEW = np.radians([40.0, 140.0])


@pytest.fixture
def fake(monkeypatch, tmp_path):
    """Makes a rig file, to whose plan keywords go, and the fake rig that opens for it."""

    def fake(board=None, **plan):
        data, path = rig_data(**plan), tmp_path / "rig.json"
        data["board"]["corners_m"][1] = board or data["board"]["corners_m"][1]
        path.write_text(json.dumps(data))
        rig = make_rig(data)
        rig.head.emergency_stop = rig.head.stop
        rig.head.pitch = lambda: (rig.head.at, True)
        monkeypatch.setattr(collector, "Rig", opened(rig))
        monkeypatch.setattr(collector, "advise", lambda session: "put it there")
        return path

    return fake


@pytest.fixture
def connect(fake, tmp_path):
    """Connects a collector, anew each time, to a fake rig."""
    with Collector() as made:

        def connect(**plan):
            made.connect(fake(**plan), tmp_path / "s")
            return made

        yield connect


@pytest.fixture
def connected(connect):
    return connect()


def in_background(call):
    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    return thread


# -------------------------------------------------------------------------------------------------- recording


def test_placements_are_recorded_one_by_one(connected, tmp_path):
    shares = []
    assert connected.task().title == "Placement 1 of 3" and connected.task().guidance.startswith("put the board")
    lights = connected.capture(lambda share, text: shares.append(share))
    assert connected.finished == (1,) and connected.task().title == "Placement 2 of 3"
    assert lights[0].name == "scan" and connected.lights[1] == lights
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] == 1
    assert sorted(np.degrees(list(connected.view.rows)).round()) == list(range(-4, 5))
    assert connected.view.frames["left"].image.shape == (SIZE[1], SIZE[0], 3)
    connected.close()
    assert validate(tmp_path / "s") == [] and open_session(tmp_path / "s").placements == (1,)
    assert "unfinished" not in json.loads((tmp_path / "s" / "session.json").read_text())


def test_a_session_goes_on_and_may_be_longer_than_planned(connect, tmp_path):
    for number in (1, 2, 3):
        made = connect(count=2)
        assert made.finished == tuple(range(1, number))
        made.capture()
    made.close()
    assert open_session(tmp_path / "s").placements == (1, 2, 3)


def test_a_list_of_placements_has_an_end(connect):
    made = connect(placements=[{"number": 4, "board": False}])
    assert made.task().guidance.startswith("take the board away")
    made.capture()
    assert made.task() is None
    with pytest.raises(RecordingError, match="plan of this rig is done"):
        made.capture()


def test_views_held_close_come_first(connect):
    made = connect(intrinsics_images=2)
    assert made.task().close == ("left", 0) and "hold the board close" in made.task().guidance
    (light,) = made.capture()  # noise shows no board: the view is still to be taken
    assert light.state == "bad" and made.task().close == ("left", 0)


def test_the_last_placement_can_be_recorded_again(connected):
    with pytest.raises(RecordingError, match="at least three placements"):
        connected.calibrate()
    with pytest.raises(RecordingError, match="no placement to record again"):
        connected.again()
    connected.capture()
    connected.capture()
    assert connected.again() == 2 and connected.finished == (1,) and 2 not in connected.lights
    assert connected.task().placement.number == 2
    connected.capture()
    assert connected.finished == (1, 2)


def test_stop_ends_a_capture_and_nothing_of_it_counts(connected):
    def stop_at_third(share, text):
        if text.startswith("stop 3"):
            threads.append(in_background(connected.stop))
            connected.stopped.wait(WAIT_S)

    threads, head = [], connected.rig.head
    with pytest.raises(Interrupted, match="placement 1 does not count"):
        connected.capture(stop_at_third)
    threads[0].join(WAIT_S)
    assert not threads[0].is_alive() and head.stops and connected.finished == ()
    assert len(connected.view.rows) <= 3
    connected.capture()
    assert connected.finished == (1,)


def test_one_thing_at_a_time(connected, monkeypatch):
    monkeypatch.setattr(collector, "WAIT_S", 0.05)
    begun, go_on = threading.Event(), threading.Event()
    thread = in_background(lambda: connected.capture(lambda *_: (begun.set(), go_on.wait(WAIT_S))))
    assert begun.wait(WAIT_S)
    with pytest.raises(Busy, match="wait until it is done, or press stop"):
        connected.move_to(0.1)
    assert connected.look().ranges is None  # the devices are left alone
    go_on.set()
    thread.join(WAIT_S)
    assert connected.finished == (1,)


def test_advice_is_asked_from_the_third_placement_on(connect):
    made = connect(count=9)
    lights = [made.capture() for _ in range(4)]
    assert made.task().guidance == "put it there"
    assert [found[-1].name for found in lights] == ["camera left"] * 2 + ["information"] * 2


# ----------------------------------------------------------------------------------------------- the live view


def test_a_lost_line_is_looked_for(connected):
    connected.rig.lrf.lost = 1
    connected.look()
    assert connected.rig.lrf.reconnects == 1 and connected.view.trouble == ""
    connected.rig.lrf.lost = 2
    assert "line is lost" in connected.look().trouble


# --------------------------------------------------------------------------------------------------- bad input


def test_nothing_works_without_a_rig():
    made = Collector()
    for call in (made.capture, made.again, made.calibrate, lambda: made.move_to(0.0)):
        with pytest.raises(DeviceError, match="press connect"):
            call()
    made.stop()
    assert made.look().ranges is None and made.task() is None


@pytest.mark.parametrize(("rig", "error", "said"), [
    ("practise", RigFileError, "emulated are practice, sim_quick, sim_lms221"),
    ("missing.json", RigFileError, "No such file.*emulate"),
    ("rig.json", PortError, "head: .*fake_head"),
])  # fmt: skip


def test_a_rig_or_port_that_is_not_there(rig, error, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.json").write_text(json.dumps(rig_data(cameras=())))
    made = Collector()
    with pytest.raises(error, match=said):
        made.connect(rig, tmp_path / "s")
    assert not made.connected and not (tmp_path / "s").exists()


def test_a_session_of_another_rig(connected, fake, tmp_path):
    connected.capture()
    with pytest.raises(SessionError, match="board.corners_m"):
        connected.connect(fake(board=[0.5, 0]), tmp_path / "s")
    assert not connected.connected


def test_data_without_a_board_give_no_calibration(connected):
    connected.capture()
    found = connected.calibrate()
    assert found.answer == "no" and not found.poses and found.file is None
    assert "no image can be used" in found.sentences[0] and found.sentences[-1] == "Nothing is written."


# ---------------------------------------------------------------------------------------------------- pictures


def test_a_scan_from_above_is_drawn_where_it_is():
    bearings = np.radians([60.0, 90.0, 120.0])
    empty, middle, right = (page.scan_picture(ranges, bearings, VIEW) for ranges in np.where(
        [[0, 0, 0], [0, 1, 0], [1, 0, 0]], 1.5, np.nan))  # fmt: skip
    painted = [np.argwhere((image != empty).any(axis=2)).mean(axis=0) for image in (middle, right)]
    assert painted[0][1] == pytest.approx(199.5, abs=1.5) and painted[1][1] > 240  # bearing 60 deg is to the right
    assert painted[0][0] < painted[1][0]  # straight ahead is up


def test_a_sweep_grows_line_by_line():
    bearings, ranges = np.linspace(*VIEW, 101), np.full(101, 4.0)
    ranges[80:] = 1.0  # near at the large bearings, which are on the left

    def drawn(rows):
        return page.sweep_picture(rows, bearings, VIEW, np.radians([-10.0, 10.0]), np.radians(1.0))

    empty, high, low = drawn({}), drawn({np.radians(9.0): ranges}), drawn({np.radians(-9.0): ranges})
    rows, columns = np.nonzero((high != empty).any(axis=2))
    assert rows.max() < 75 and columns.min() < 50 and columns.max() > 380
    left, right = high[rows[0] + 2, 60].astype(int), high[rows[0] + 2, 350].astype(int)
    assert left.sum() > right.sum() + 100  # near is bright
    assert np.nonzero((low != empty).any(axis=2))[0].min() > 200
    nothing = drawn({0.0: np.full(101, np.nan)})
    assert (np.ptp(nothing[(nothing != empty).any(axis=2)], axis=1) == 0).all()  # grey


# ------------------------------------------------------------------------------------------------------- words


def test_lights_and_errors_say_their_state_in_signs_and_words():
    found = [Light("scan", state, "<b>text") for state in ("ok", "warn", "bad")]
    said = page.HTML.lights("Quality", found)
    for sign in ("✓ good", "! check", "✕ bad", "&lt;b&gt;text"):
        assert sign in said
    assert "→ next" in page.HTML.lights("", [Light("information", "warn", "put it there")])
    assert "as soon as a placement is recorded" in page.HTML.lights("Quality", ())
    assert page.HTML.error("failed", "") == ""
    assert "✕" in page.HTML.error("a", "b") and "check the plug" in page.HTML.error("a", "check the plug")


@pytest.mark.parametrize("answer, said", [("yes", "✓ can be trusted"), ("with care", "! use"), ("no", "✕ cannot be")])
def test_a_result_says_whether_to_trust_it(answer, said):
    sigma = np.full(3, 0.5)
    poses = {"left": (np.array([90.0, 1.0, -2.0]), np.array([120.0, 30.0, -4.0]), sigma, sigma)}
    sentences = ("Use this calibration with care: few placements.", "Record next: there.")
    shown = page.HTML.result(collector.Result(answer, sentences, "joint", poses, None, None))
    for text in (said, "Few placements.", "Record next", "90.00 ± 0.50", "-4.0 ± 0.5", "left"):
        assert text in shown
    assert "<table" not in page.HTML.result(collector.Result("no", sentences, "", {}, None, None))


def test_advice_where_nothing_is_determined_yet(monkeypatch):
    monkeypatch.setattr(collector, "prepare", lambda session: session)
    monkeypatch.setattr(collector, "calibrate_jointly", raising(collector.DegenerateGeometry("one placement only")))
    assert collector.advise(None) == "not determined yet: one placement only"


# ------------------------------------------------------------------------------------------------- the buttons


@pytest.fixture
def panel(fake, tmp_path):
    with page.Panel(fake(), tmp_path / "s") as made:
        yield made


def pressed(panel, name):
    """Press a button and wait until its work is done."""
    getattr(panel.parts, name).click()
    panel.job.result(WAIT_S)
    return panel.parts


def wait_until(holds):
    end = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < end, "it does not happen"
        time.sleep(0.05)


def test_buttons_do_it_all(panel):
    parts = panel.parts
    assert parts.capture.disabled and parts.close.disabled and not parts.connect.disabled and not parts.stop.disabled
    pressed(panel, "connect")
    assert "ready" in parts.state.value and not parts.capture.disabled and parts.calibrate.disabled
    wait_until(lambda: all(picture.image.value for picture in parts.pictures.values()))
    assert set(parts.pictures) == {"scan", "sweep", "left"}
    before = parts.pictures["sweep"].image.value
    pressed(panel, "capture")
    assert "scan" in parts.lights.value and "recorded: 1" in parts.task.value and not parts.calibrate.disabled
    wait_until(lambda: parts.pictures["sweep"].image.value != before)
    pressed(panel, "again")
    assert "nothing is recorded yet" in parts.task.value
    parts.slider.value = 3.0
    pressed(panel, "go")
    wait_until(lambda: "+3.00°" in parts.pitch.value)
    pressed(panel, "close")
    assert "not connected" in parts.state.value and parts.capture.disabled and parts.error.value == ""


def test_errors_appear_in_the_panel(panel, tmp_path):
    panel.parts.rig.value = str(tmp_path / "missing.json")
    parts = pressed(panel, "connect")
    assert "connecting failed" in parts.error.value and "missing.json" in parts.error.value
    assert "not connected" in parts.state.value and not parts.connect.disabled
    with pytest.raises(RigFileError):
        panel.connect()
    panel.parts.rig.value = str(tmp_path / "rig.json")
    assert pressed(panel, "connect").error.value == ""
    panel.collector.rig.head.fail = OutOfRange("pitch 80 deg is beyond the head's limits: ask for less")
    assert "ask for less" in pressed(panel, "go").error.value
    panel.collector.rig.head.fail = None
    pressed(panel, "capture")
    refused = pressed(panel, "calibrate").result.value
    assert "cannot be trusted" in refused and "no image can be used" in refused and "ready" in parts.state.value


def test_a_lost_camera_is_said_until_it_is_back(panel):
    panel.connect()
    camera, parts = panel.collector.rig.cameras["left"], panel.parts
    newest, camera.newest = camera.newest, raising(LineLost("camera left is lost: its plug"))
    wait_until(lambda: "camera left is lost: its plug" in parts.error.value)
    assert "left" not in panel.collector.view.frames
    with pytest.raises(LineLost, match="its plug"):
        panel.collector.capture()
    camera.newest = newest
    wait_until(lambda: parts.error.value == "" and "left" in panel.collector.view.frames)


def test_what_nobody_expects_and_what_drivers_report_is_said_too(panel, monkeypatch, caplog):
    panel.connect()
    monkeypatch.setattr(panel.collector, "move_to", lambda pitch: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        panel.go()
    assert "ZeroDivisionError" in panel.parts.error.value and "failed while" in caplog.text
    logging.getLogger("lrfcal_lib.drivers").warning("the head does not tell its tilt")
    assert "does not tell its tilt" in panel.parts.notes.value
    panel.close()
    assert panel.notes not in logging.getLogger("lrfcal_lib").handlers


def test_the_emulated_rigs_are_those_that_there_are():
    assert sorted(collector.PRACTICE_RIGS) == sorted([practice.PRACTICE, *SETUPS])
    with pytest.raises(ValueError, match="no set-up 'nowhere'"):
        practice.emulated("nowhere")
