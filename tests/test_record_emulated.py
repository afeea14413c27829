"""From the emulated devices to a calibration that agrees with their truth."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.stats import chi2
from virtual import VirtualHost

from lrfcal_lib.acquire.record import record_session
from lrfcal_lib.calibrate.pipeline import calibrate_jointly, prepare
from lrfcal_lib.drivers.rig import Rig
from lrfcal_lib.drivers.rig_file import read_rig_file
from lrfcal_lib.drivers.video import Frame
from lrfcal_lib.emulators.rig import EmulatedRig
from lrfcal_lib.emulators.world import scaled
from lrfcal_lib.fit.axis_chart import chart_parameters
from lrfcal_lib.model.geometry import pose_array
from lrfcal_lib.session.read import open_session
from lrfcal_lib.session.stated import model_to_json
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
        setup.rig, setup.pairs, setup.distances, random(setup, PLACES), np.radians(1.0)
    )
    return setup, [
        replace(p, image_pitch=p.image_pitch[len(p.image_pitch) // 2 :][:1]) for p in found
    ]


def state_intrinsics(data, setup):
    for camera in setup.rig.cameras:
        data["rig"]["cameras"][camera.name]["intrinsics"] = model_to_json(camera.model)
    return data


@pytest.fixture(scope="module")
def setup():
    return small_setup()


class Still:
    """A camera in virtual time, which stands still while an image is drawn."""

    def __init__(self, rig, name):
        self.rig, self.name, self.count = rig, name, 0

    def newest(self, after=None, timeout=None):
        self.rig.host.sleep(0.5)
        _, data = self.rig.camera_server.image(self.name, timeout=DEADLINE)
        self.count += 1
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        return Frame(image, self.rig.host.time(), self.count)

    def close(self):
        pass


@pytest.fixture(scope="module")
def recorded_session(setup, tmp_path_factory):
    """What `record` makes of the emulated devices."""
    folder = tmp_path_factory.mktemp("recorded")
    host = VirtualHost()
    with EmulatedRig(
        setup[0], placements=setup[1], host=host, rest_s=0.0,
        head_options={"baudrate": 9600, "go_speed": 20.0},
    ) as emulated:  # fmt: skip
        data = state_intrinsics(emulated.rig_file(), setup[0])
        data["devices"]["head"] |= {
            "settle_s": 0.25,
            "poll_s": 0.05,
            "gap_s": 0.025,
        }  # the head wobbles for 0.2 s
        (folder / "rig.json").write_text(json.dumps(data))
        stated = read_rig_file(folder / "rig.json")
        with Rig.open(stated, host=host, camera=lambda name: Still(emulated, name)) as rig:
            record_session(
                rig, folder / "s"
            )  # nobody is asked for anything: the board moves by itself
    return open_session(folder / "s")


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
    assert nees(axis - true, solution.covariance("axis_", "offset_")) < chi2.ppf(0.999, 4)


def nees(miss, covariance):
    """Squared error in units of its covariance: chi-square distributed where that is right."""
    return miss @ np.linalg.solve(covariance, miss)
