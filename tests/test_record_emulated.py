"""From the emulated devices to a calibration: the same as the simulator's own session of the same placements gives."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.stats import chi2
from virtual import VirtualHost

from lrfcal_lib.acquire.checks import check_placement
from lrfcal_lib.acquire.record import record_session
from lrfcal_lib.calibrate.observe import observe_all
from lrfcal_lib.calibrate.pipeline import calibrate_cameras, calibrate_jointly, calibrate_platform, prepare
from lrfcal_lib.drivers.rig import Rig
from lrfcal_lib.drivers.rig_file import read_rig_file
from lrfcal_lib.drivers.video import Frame
from lrfcal_lib.emulators.rig import EmulatedRig
from lrfcal_lib.emulators.world import scaled
from lrfcal_lib.fit.residuals import chart_parameters
from lrfcal_lib.model.geometry import pose_array
from lrfcal_lib.session.read import open_session, validate
from lrfcal_lib.session.stated import model_to_json
from lrfcal_lib.simulate import record as simulated
from lrfcal_lib.simulate.rig import PLACES, load_setup, pairs, random

METHOD, DEADLINE = "line", 180.0  # s, against hanging
STEP = np.radians(1.25)


def small_setup():
    """Six placements, coarse sweeps, one camera with known intrinsics and one small image a placement."""
    quick = load_setup("sim_quick")
    rig = scaled(replace(quick.rig, platform=replace(quick.rig.platform, settle=0.2)), 480)
    camera = replace(rig.cameras[0], exposure=replace(rig.cameras[0].exposure, samples=2))
    setup = replace(quick, rig=replace(rig, cameras=(camera,)), pairs=3, distances=(1.3, 1.7), step=STEP,
                    intrinsics_views=0, room_sweep=(), room_images=())  # fmt: skip
    found = pairs(setup.rig, setup.pairs, setup.distances, random(setup, PLACES), np.radians(1.0))
    return setup, [replace(p, image_pitch=p.image_pitch[len(p.image_pitch) // 2 :][:1]) for p in found]


def state_intrinsics(data, setup):
    for camera in setup.rig.cameras:
        data["rig"]["cameras"][camera.name]["intrinsics"] = model_to_json(camera.model)
    return data


@pytest.fixture(scope="module")
def setup():
    return small_setup()


@pytest.fixture(scope="module")
def simulated_session(setup, tmp_path_factory):
    """The simulator's own session."""
    path = tmp_path_factory.mktemp("simulated") / "s"
    with pytest.MonkeyPatch.context() as context:
        context.setattr(simulated, "placements_of", lambda _: setup[1])
        simulated.simulate(path, setup[0])
    file = path / "session.json"
    file.write_text(json.dumps(state_intrinsics(json.loads(file.read_text()), setup[0])))
    return open_session(path)


class Still:
    """A camera in virtual time, which stands still while an image is drawn."""

    def __init__(self, rig, name):
        self.rig, self.name, self.settings, self.count = rig, name, {"warnings": []}, 0

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
    folder, host = tmp_path_factory.mktemp("recorded"), VirtualHost()
    with EmulatedRig(
        setup[0], placements=setup[1], host=host, rest_s=0.0,
        head_options={"baudrate": 9600, "go_speed": 20.0},
    ) as emulated:  # fmt: skip
        data = state_intrinsics(emulated.rig_file(), setup[0])
        data["devices"]["head"] |= {"settle_s": 0.25, "poll_s": 0.05, "gap_s": 0.025}  # the head wobbles for 0.2 s
        (folder / "rig.json").write_text(json.dumps(data))
        stated = read_rig_file(folder / "rig.json")
        with Rig.open(stated, host=host, camera=lambda name: Still(emulated, name)) as rig:
            record_session(rig, folder / "s")  # nobody is asked for anything: the board moves by itself
    return open_session(folder / "s")


def test_the_recording_is_sound(recorded_session, setup):
    assert validate(recorded_session.path) == []
    assert recorded_session.placements == (1, 2, 3, 4, 5, 6) and recorded_session.simulated
    for planned in setup[1]:
        sweep = recorded_session.sweep(planned.number)
        low, high = sorted(planned.sweep)
        assert sweep.pitch.min() == pytest.approx(low, abs=0.01) and sweep.pitch.max() == pytest.approx(high, abs=0.01)
        assert recorded_session.sweep_direction(planned.number) == planned.direction
        (image,) = recorded_session.images(placement=planned.number)
        assert image.pitch == pytest.approx(planned.image_pitch[0], abs=0.01)
        states = {light.name: light.state for light in check_placement(recorded_session, planned.number)}
        assert states["scan"] != "bad" and states["camera left"] == "ok", states


@pytest.fixture(scope="module")
def prepared(recorded_session, simulated_session):
    """Of the recorded session, then of the simulated one."""
    return [prepare(session) for session in (recorded_session, simulated_session)]


def nees(miss, covariance):
    """Squared error in units of its covariance: chi-square distributed where that is right."""
    return miss @ np.linalg.solve(covariance, miss)


def compare(recorded, expected, truth, degrees, metres):
    """Both poses agree within their covariances, and the recorded one with the truth.

    A few coarse sweeps tell little, but not nothing: a wide covariance would hide a wrong pose.
    """
    for other, covariance in ((expected.transform, expected.trusted[:6, :6]), (truth, 0.0)):
        turn = (other.rotation * recorded.transform.rotation.inv()).as_rotvec()
        miss = np.concatenate([turn, other.translation - recorded.transform.translation])
        assert nees(miss, recorded.trusted[:6, :6] + covariance) < chi2.ppf(0.999, 6)
    assert np.linalg.norm(miss[:3]) < np.radians(degrees) and np.linalg.norm(miss[3:]) < metres


def test_the_recording_calibrates_as_the_simulated_session(recorded_session, prepared, setup):
    platforms, cameras = [], []
    for one in prepared:
        platforms.append(calibrate_platform(one, one.pitch_noise.offset))
        solutions, problems = calibrate_cameras(observe_all(one, platforms[-1].transform("combined")), [METHOD])
        assert problems == {}
        cameras.append(solutions["left", METHOD])
    compare(*cameras, setup[0].rig.cameras[0].mounting, 6, 0.15)
    miss = np.subtract(*(one.parameters()["combined"][0] for one in platforms))
    assert nees(miss, platforms[0].covariance + platforms[1].covariance) < chi2.ppf(0.999, 4)
    for placement in recorded_session.placements:  # the plane of the board, which needs no good calibration
        boards = [one.scans[placement] for one in prepared]
        assert boards[0].normal @ boards[1].normal > np.cos(np.radians(5.0))
        assert boards[0].distance == pytest.approx(boards[1].distance, abs=0.04)


def test_the_joint_estimate_is_that_of_the_simulated_session(prepared, setup):
    joints = [calibrate_jointly(one) for one in prepared]
    compare(*(one.solution.camera("left") for one in joints), setup[0].rig.cameras[0].mounting, 2, 0.06)
    axis, other = (chart_parameters(pose_array(one.solution.T_head_lrf)) for one in joints)
    covariance = sum(one.solution.covariance("axis_", "offset_") for one in joints)
    assert nees(axis - other, covariance) < chi2.ppf(0.999, 4)
