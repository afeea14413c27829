"""The data collection panel without a browser: its logic on a fake rig, its pictures, its words, its buttons."""

import json
import logging
import re
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from fake_rig import SIZE, make_rig, opened, raising, rig_data
from scipy.spatial.transform import RigidTransform, Rotation
from shared import until

from lrfcal_lib.acquire import collector
from lrfcal_lib.acquire import panel as page
from lrfcal_lib.acquire.collector import Busy, Collector, Interrupted
from lrfcal_lib.acquire.record import RecordingError
from lrfcal_lib.calibrate.calibration_file import KIND, SCHEMA, rig_record
from lrfcal_lib.calibrate.cameras import KnownAxis
from lrfcal_lib.calibrate.rig import CalibratedCamera, CalibratedRig
from lrfcal_lib.drivers.port import DeviceError, LineLost, OutOfRange, PortError
from lrfcal_lib.drivers.rig_file import RigFileError
from lrfcal_lib.evaluate.export import write_calibration
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.kinematics import Corrections
from lrfcal_lib.session.read import open_session

WAIT_S = 120  # guards against hanging


@pytest.fixture
def fake(monkeypatch, tmp_path):
    """Makes a rig file, to whose plan keywords go, and the fake rig that opens for it."""

    def fake(board=None, **plan):
        data = rig_data(**plan)
        path = tmp_path / "rig.json"
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
def connected(fake, tmp_path):
    """A collector at a fake rig whose plan is one placement."""
    with Collector() as made:
        made.connect(fake(placements=[{"number": 1}]), tmp_path / "s")
        yield made


def in_background(call):
    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    return thread


# -------------------------------------------------------------------------------------------------- recording


def test_stop_ends_a_capture_and_nothing_of_it_counts(connected):
    def stop_at_third(share, text):
        if text.startswith("stop 3"):
            threads.append(in_background(connected.stop))
            connected.stopped.wait(WAIT_S)

    threads = []
    head = connected.rig.head
    with pytest.raises(Interrupted, match="placement 1 does not count"):
        connected.capture(stop_at_third)
    threads[0].join(WAIT_S)
    assert not threads[0].is_alive() and head.stops and connected.finished == ()
    assert len(connected.view.rows) <= 3
    connected.capture()
    assert connected.finished == (1,)


def test_one_thing_at_a_time(connected, monkeypatch):
    monkeypatch.setattr(collector, "WAIT_S", 0.05)
    begun = threading.Event()
    go_on = threading.Event()
    thread = in_background(
        lambda: connected.capture(lambda *_: (begun.set(), go_on.wait(WAIT_S)))
    )
    assert begun.wait(WAIT_S)
    with pytest.raises(Busy, match="wait until it is done, or press stop"):
        connected.move_to(0.1)
    assert connected.look().reading is None  # the devices are left alone
    go_on.set()
    thread.join(WAIT_S)
    assert connected.finished == (1,)


def test_what_cannot_be_done_yet_or_any_more(connected):
    made = Collector()
    for call in (made.capture, made.again, made.calibrate, lambda: made.move_to(0.0)):
        with pytest.raises(DeviceError, match="press connect"):
            call()
    made.stop()
    assert made.look().reading is None and made.task() is None
    with pytest.raises(RecordingError, match="at least three placements"):
        connected.calibrate()
    with pytest.raises(RecordingError, match="no placement to record again"):
        connected.again()
    connected.capture()
    with pytest.raises(RecordingError, match="plan of this rig is done"):
        connected.capture()


def test_advice_is_a_light_and_where_the_board_goes_next(fake, tmp_path):
    with Collector() as made:
        made.connect(fake(), tmp_path / "s")
        *before, lights = [made.capture() for _ in range(collector.ADVICE_FROM)]
        assert "information" not in [light.name for each in before for light in each]
        assert (lights[-1].name, lights[-1].state) == ("information", "warn")
        assert lights[-1].text == made.task().guidance == "put it there"


def test_advice_where_nothing_is_determined_yet(monkeypatch):
    monkeypatch.setattr(collector, "prepare", lambda session: session)
    monkeypatch.setattr(
        collector,
        "calibrate_jointly",
        raising(collector.DegenerateGeometry("one placement only")),
    )
    assert collector.advise(None) == "not determined yet: one placement only"


@pytest.mark.parametrize(("rig", "error", "said"), [
    ("practise", RigFileError, "practise: No such file"),
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


# ------------------------------------------------------------------------------------------------- the buttons


@pytest.fixture
def panel(fake, tmp_path):
    with page.Panel(fake(), tmp_path / "s") as made:
        yield made


def pressed(panel, name):
    """Press a button and wait until its work is done."""
    getattr(panel.parts, name).click()
    panel.job.exception(WAIT_S)  # shown already, where there is one
    return panel.parts


def test_buttons_that_the_browser_does_not_press(panel):
    """Connect, capture, calibrate and close are pressed in test_panel_browser."""
    parts = panel.parts
    assert (
        parts.capture.disabled
        and parts.close.disabled
        and not parts.connect.disabled
        and not parts.stop.disabled
    )
    pressed(panel, "connect")
    assert not parts.capture.disabled and parts.calibrate.disabled
    pressed(panel, "capture")
    assert "recorded: 1" in parts.task.value and not parts.calibrate.disabled
    pressed(panel, "again")
    assert "nothing is recorded yet" in parts.task.value
    parts.slider.value = 3.0
    pressed(panel, "go")
    until(lambda: "+3.00°" in parts.pitch.value)
    assert parts.error.value == ""


def test_what_starts_and_what_stops_a_recording_stand_side_by_side(panel):
    *_, buttons = panel.parts.top.children
    assert {panel.parts.capture, panel.parts.stop} < {*buttons.children}


PLACES = {  # LRFCAL_RECORDINGS, what the field says, and where the recording goes, from the home folder
    "nobody says": ("", None, r"lrfcal_sessions/20\d\d-\d\d-\d\d_\d{6}"),
    "the environment says": ("mine", None, r"mine/20\d\d-\d\d-\d\d_\d{6}"),
    "relative": ("mine", "recordings/monday", "recordings/monday"),
    "of the user": ("", " ~/monday ", "monday"),
}


@pytest.mark.parametrize("case", PLACES)
def test_a_recording_goes_to_a_folder_that_is_shown_in_full_and_stays(
    fake, case, tmp_path, monkeypatch
):
    folder, field, expected = PLACES[case]
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.chdir(home)
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("LRFCAL_RECORDINGS", folder and str(home / folder))
    fake()
    with page.Panel("../rig.json") as made:
        if field is not None:
            made.parts.session.value = field
        assert re.fullmatch(f"{home}/{expected}", str(made.session))
        shown = re.sub("<[^>]+>", "", made.parts.places.value)
        assert (
            f"the recording goes to {made.session}" in shown
            and f"the rig file is {home}/../rig.json" in shown
        )
        pressed(made, "connect")
        assert (
            made.parts.session.value == str(made.session)
            and made.parts.rig.value == f"{home}/../rig.json"
        )
        pressed(made, "capture")
    assert open_session(made.session).placements == (1,)


def test_errors_appear_in_the_panel(panel, tmp_path):
    panel.parts.rig.value = str(tmp_path / "missing.json")
    parts = pressed(panel, "connect")
    assert "connecting failed" in parts.error.value and "missing.json" in parts.error.value
    assert "not connected" in parts.state.value and not parts.connect.disabled
    with pytest.raises(RigFileError):
        panel.connect()
    panel.parts.rig.value = str(tmp_path / "rig.json")
    assert pressed(panel, "connect").error.value == ""
    panel.collector.rig.head.fail = OutOfRange(
        "pitch 80 deg is beyond the head's limits: ask for less"
    )
    assert "ask for less" in pressed(panel, "go").error.value
    panel.collector.rig.head.fail = None
    pressed(panel, "capture")
    refused = pressed(panel, "calibrate").result.value
    assert (
        "cannot be trusted" in refused
        and "no image can be used" in refused
        and "ready" in parts.state.value
    )


def test_a_lost_camera_is_said_until_it_is_back(panel):
    panel.connect()
    camera = panel.collector.rig.cameras["left"]
    parts = panel.parts
    newest, camera.newest = (
        camera.newest,
        raising(LineLost("camera left is lost: its plug")),
    )
    until(lambda: "camera left is lost: its plug" in parts.trouble.value)
    assert "left" not in panel.collector.view.frames
    with pytest.raises(LineLost, match="its plug"):
        panel.collector.capture()
    camera.newest = newest
    until(
        lambda: parts.trouble.value.strip() == "" and "left" in panel.collector.view.frames
    )


def test_what_nobody_expects_and_what_drivers_report_is_said_too(
    panel, monkeypatch, caplog
):
    panel.connect()
    monkeypatch.setattr(panel.collector, "move_to", lambda pitch: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        panel.go()
    assert "ZeroDivisionError" in panel.parts.error.value and "failed while" in caplog.text
    logging.getLogger("lrfcal_lib.drivers").warning("the head does not tell its tilt")
    assert "does not tell its tilt" in panel.parts.notes.value
    panel.close()
    assert panel.notes not in logging.getLogger("lrfcal_lib").handlers


def chosen(panel, path):
    """The panel with a calibration chosen, and what it says about it."""
    panel.parts.calibration.value = str(path)
    return panel.parts.overlay.value


def a_calibration(path, answer="yes", size=SIZE):
    """A file that says of every camera it is where the LRF is, looking along the middle beam."""
    ahead = RigidTransform.from_rotation(Rotation.from_rotvec([np.pi / 2, 0, 0]))
    model = CameraModel(*size, 100.0, 100.0, size[0] / 2, size[1] / 2)
    cameras = {c: CalibratedCamera(ahead, "head", model) for c in ("left", "right")}
    axis = KnownAxis(RigidTransform.identity(), np.eye(4))
    rig = CalibratedRig("joint", axis, Corrections(0.5), cameras)
    verdict = {"answer": answer, "reasons": [{"words": "nobody leaned"}]}
    head = {"schema": SCHEMA, "kind": KIND, "session": "s", "date": "", "method": "joint"}
    write_calibration(path, {**head, "verdict": verdict, **rig_record(rig)})
    return path


def view_of(ranges, bearings, pitch=0.0):
    """What the rig sees where only a scan matters."""
    reading = SimpleNamespace(ranges=ranges, bearings=bearings)
    return SimpleNamespace(reading=reading, pitch=pitch)


def test_the_scan_is_drawn_where_a_calibration_puts_it(panel, tmp_path):
    size = width, height = 320, 240
    image = np.zeros((height, width, 3), np.uint8)
    bearings = np.radians([75.0, 90.0, 105.0, 170.0])
    view = view_of(np.array([1.0, np.nan, 3.0, 2.0]), bearings, pitch=0.2)
    plain, words = panel._overlaid("left", image, view)
    assert plain is image and "dots" not in words
    assert chosen(panel, a_calibration(tmp_path / "c.json", size=size)) == ""
    drawn, words = panel._overlaid("left", image, view)
    assert "dots: the scan" in words and not image.any()
    v, u = np.nonzero(drawn.any(axis=2))
    # a camera at the LRF sees a beam by its bearing, whatever the range; one has no return, one is not seen
    expected = width / 2 + 100.0 / np.tan(bearings[[0, 2]])
    assert np.abs(u[:, None] - expected).min(axis=1).max() < 4
    assert np.abs(v - height / 2).max() < 4
    near, far = (drawn[height // 2, round(at)].astype(int) for at in expected)
    assert near.sum() > far.sum(), "near is bright"


def test_a_calibration_that_does_not_fit_is_said(panel, tmp_path):
    view = view_of(np.ones(3), np.ones(3))
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    (tmp_path / "broken.json").write_text("{")
    assert "not JSON" in chosen(panel, tmp_path / "broken.json")
    assert panel._overlaid("left", image, view)[0] is image
    assert "nobody leaned" in chosen(panel, a_calibration(tmp_path / "no.json", "no"))
    assert chosen(panel, a_calibration(tmp_path / "c.json", size=(100, 80))) == ""
    assert "of 100 x 80" in panel._overlaid("left", image, view)[1]
    assert "does not know" in panel._overlaid("top", image, view)[1]
    assert chosen(panel, "") == ""


def test_what_check_says_of_the_calibration_is_marked(panel, fake, tmp_path, monkeypatch):
    """With a fresh recording, in words and about the image of the camera that has moved."""
    culprits = (SimpleNamespace(camera="left"),)
    words = ["the calibration: camera 'left' has moved: recalibrate", "by 3 px"]
    held = SimpleNamespace(
        answer=page.Answer.MOVED, culprits=culprits, sentences=lambda name: words
    )
    monkeypatch.setattr(page, "holds", lambda session, rig: held)
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    view = view_of(np.ones(3), np.full(3, 1.5))
    scenes = [{"number": number, "board": False} for number in (1, 2)]
    panel.parts.rig.value = str(fake(placements=scenes))
    chosen(panel, a_calibration(tmp_path / "c.json"))
    assert panel.parts.held.value == "", "nothing is recorded yet"
    pressed(panel, "connect")
    pressed(panel, "capture")
    assert "has moved: recalibrate" in panel.parts.held.value
    marked, remark = panel._overlaid("left", image, view)
    assert (marked[0, 0] == page.RED).all() and "has moved" in remark
    other, remark = panel._overlaid("right", image, view)
    assert not other[0, 0].any() and "moved" not in remark

    def refused(session, rig):
        raise ValueError("no placement has a sweep")

    monkeypatch.setattr(page, "holds", refused)
    pressed(panel, "capture")
    assert "cannot be told here: no placement has a sweep" in panel.parts.held.value
    assert chosen(panel, "") == "" == panel.parts.held.value
