"""From the emulated devices to a calibration that agrees with their truth."""

import json
import re
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2
from small_rigs import scaled
from test_new_user import words_of
from test_scene_page import said_on_page
from virtual import VirtualHost

from lrfcal_lib import __main__ as command_line
from lrfcal_lib.acquire import record
from lrfcal_lib.acquire.record import record_session
from lrfcal_lib.calibrate.calibration_file import load_calibration
from lrfcal_lib.calibrate.pipeline import calibrate_jointly, prepare
from lrfcal_lib.drivers import rig as rig_module
from lrfcal_lib.drivers.port import Closed
from lrfcal_lib.drivers.rig_file import read_rig_file
from lrfcal_lib.drivers.video import Frame
from lrfcal_lib.emulators.rig import EmulatedRig
from lrfcal_lib.fit.axis_chart import chart_parameters
from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.measure.features import flatness, largest_plane
from lrfcal_lib.measure.scene import station_cloud
from lrfcal_lib.model.geometry import pose_array
from lrfcal_lib.session.read import open_session
from lrfcal_lib.simulate.rig import PLACES, load_setup, pairs, random

DEADLINE = 180.0  # s, against hanging
STEP = np.radians(1.25)


def small_setup():
    """Four placements, coarse sweeps, one camera with known intrinsics and one small image a placement."""
    quick = load_setup("sim_quick")
    rig = scaled(replace(quick.rig, platform=replace(quick.rig.platform, settle=0.2)), 480)
    camera = replace(rig.cameras[0], exposure=replace(rig.cameras[0].exposure, samples=2))
    setup = replace(quick, rig=replace(rig, cameras=(camera,)), pairs=2, distances=(1.3, 1.7), step=STEP,
                    intrinsics_views=0, room_sweep=(), room_images=())  # fmt: skip
    found = pairs(
        setup.rig,
        setup.pairs,
        setup.distances,
        random(setup, PLACES),
        np.radians(1.0),
        STEP,
    )
    return setup, [
        replace(p, image_pitch=p.image_pitch[len(p.image_pitch) // 2 :][:1]) for p in found
    ]


@pytest.fixture(scope="module")
def setup():
    return small_setup()


class Still(Closed):
    """A camera in virtual time, which stands still while an image is drawn."""

    size = None

    def __init__(self, rig, name):
        self.rig, self.name, self.count = rig, name, 0

    def newest(self, after=None, timeout=None):
        self.rig.host.sleep(0.5)
        data = self.rig.camera_server.image(self.name, timeout=DEADLINE)
        self.count += 1
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        return Frame(image, self.rig.host.time(), self.count)

    def close(self):
        pass


@contextmanager
def emulated_rig(setup, file):
    """Opens the emulated devices, each time from a rig file that a guide may have changed."""
    host = VirtualHost()
    with EmulatedRig(
        setup[0], placements=setup[1], host=host, rest_s=0.0,
        baudrate=9600, go_speed=20.0,
    ) as emulated:  # fmt: skip
        data = emulated.rig_file()
        data["devices"]["head"] |= {
            "settle_s": 0.25,
            "poll_s": 0.05,
            "gap_s": 0.025,
        }  # the head settles for 0.2 s
        data["plan"] |= {"pitch_deg": [-20, 8, 2]}  # of the scene
        file.write_text(json.dumps(data))

        def opened(stated):
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(rig_module, "Camera", lambda name, **_: Still(emulated, name))
                return rig_module.Rig.open(stated, host=host)

        yield SimpleNamespace(open=opened)


@pytest.fixture(scope="module")
def devices(setup, tmp_path_factory):
    """The folder of the rig file, and what opens the rig."""
    folder = tmp_path_factory.mktemp("recorded")
    with emulated_rig(setup, folder / "rig.json") as rig:
        yield folder, rig


@pytest.fixture(scope="module")
def recorded_session(devices):
    """What `record` makes of the emulated devices."""
    folder, rig = devices
    with rig.open(read_rig_file(folder / "rig.json")) as opened:
        record_session(
            opened, folder / "my_session"
        )  # nobody is asked: the board moves by itself
    return open_session(folder / "my_session")


def test_the_recording_calibrates_to_the_truth_within_what_it_says(recorded_session, setup):
    """A few coarse sweeps tell little, but not nothing: a wide covariance would hide a wrong pose."""
    rig = setup[0].rig
    solution = calibrate_jointly(prepare(recorded_session)).solution
    found = solution.camera("left")
    truth = rig.cameras[0].mounting
    turn = (truth.rotation * found.transform.rotation.inv()).as_rotvec()
    miss = np.concatenate([turn, truth.translation - found.transform.translation])
    assert nees(miss, found.trusted[:6, :6]) < chi2.ppf(0.999, 6)
    assert np.linalg.norm(miss[:3]) < np.radians(2) and np.linalg.norm(miss[3:]) < 0.06
    axis, true = (
        chart_parameters(pose_array(head)) for head in (solution.T_head_lrf, rig.T_head_lrf)
    )
    assert nees(axis - true, solution.covariance(*AXIS_NAMES)) < chi2.ppf(0.999, 4)


def typed(verb, *more):
    """A command of README's own blocks, in this process."""
    assert command_line.main(words_of(verb, *more)[3:]) == 0


def test_a_scene_is_measured_by_the_readme_alone(
    recorded_session, devices, monkeypatch, capsys, browser
):
    """As a new user does it; test_new_user.py waits for devices in real time, and clicks with the mouse."""
    folder, rig = devices
    monkeypatch.setattr(record, "Rig", rig)
    monkeypatch.chdir(folder)
    typed("calibrate")
    typed("record", "--scene")
    said = capsys.readouterr().out
    planned = float(re.search(r"deg: (\d+) % of the cloud can get a colour", said)[1])
    colored = float(re.search(r"colour: (\d+) % of the points", said)[1])
    # things hide more from a camera than planned, the more the farther apart the beams are
    assert planned - 20 < colored < planned + 5 and said.count("ok    stood still") == 3

    typed("reconstruct")
    out = folder / "reports" / "my_room" / "station_1"
    names = sorted(path.name for path in out.iterdir())
    assert names == ["scene.e57", "scene.html", "scene.pcd", "scene.ply"]
    session = open_session(folder / "my_room")
    cloud = station_cloud(session, load_calibration(folder / "my_rig/calibration.json"), 1)
    wall = cloud.points[largest_plane(cloud)]
    assert len(wall) > 500 and flatness(wall)[1] < 0.02

    view = browser.new_page()
    view.goto((out / "scene.html").as_uri())
    view.wait_for_selector("#measure", state="attached")
    for number, place in enumerate(cloud.points[cloud.seen][[100, -100]].tolist()):
        view.evaluate("([p, n]) => measuring.pick('point', p, 0, n)", [place, number])
    length, low, high = said_on_page(view)
    (folder / "picks.csv").write_text(view.evaluate("measuring.csv()"))
    view.close()
    typed("measure")
    (told,) = pd.read_csv(folder / "reports" / "my_room" / "lengths.csv").itertuples()
    for mm, metres in ((length, told.length_m), (low, told.low_m), (high, told.high_m)):
        assert mm == pytest.approx(1000 * metres, abs=0.5)
    assert low < length < high


def nees(miss, covariance):
    """Squared error in units of its covariance: chi-square distributed where that is right."""
    return miss @ np.linalg.solve(covariance, miss)
