"""From the emulated devices to a calibration: the same as the simulator's own session of the same placements gives."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from lrfcal_lib.acquisition import Terminal, check_placement, record
from lrfcal_lib.drivers.emulators import EmulatedRig
from lrfcal_lib.drivers.emulators.camera import scaled
from lrfcal_lib.drivers.rig import Rig
from lrfcal_lib.drivers.rig_file import read_rig_file
from lrfcal_lib.evaluate import trusted_sigma
from lrfcal_lib.geometry import transform_difference
from lrfcal_lib.pipeline import calibrate
from lrfcal_lib.session import model_to_json, open_session, validate
from lrfcal_lib.simulate import record as simulated
from lrfcal_lib.simulate.placements import pairs
from lrfcal_lib.simulate.setups import sim_quick

METHOD = "line"
STEP = np.radians(1.0)
QUICKLY = 5.0  # times as fast as real devices


def small_setup():
    """Six placements, coarse sweeps, one camera with known intrinsics and one small image a placement."""
    rig = scaled(sim_quick().rig, 480)
    setup = replace(sim_quick(), rig=replace(rig, cameras=rig.cameras[:1]), pairs=3, distances=(1.3, 1.7), step=STEP,
                    intrinsics_views=0, room_sweep=(), room_images=())  # fmt: skip
    found = pairs(setup.rig, setup.pairs, setup.distances, simulated.random(setup, simulated.PLACES), np.radians(1.0))
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
    path, patch = tmp_path_factory.mktemp("simulated") / "s", pytest.MonkeyPatch()
    with patch.context() as context:
        context.setattr(simulated, "placements_of", lambda _: setup[1])
        simulated.simulate(path, setup[0])
    file = path / "session.json"
    file.write_text(json.dumps(state_intrinsics(json.loads(file.read_text()), setup[0])))
    return open_session(path)


@pytest.fixture(scope="module")
def recorded_session(setup, tmp_path_factory):
    """What `record` makes of the emulated devices."""
    folder = tmp_path_factory.mktemp("recorded")
    begun = time.time()
    with EmulatedRig(
        setup[0], placements=setup[1], time_scale=QUICKLY, platform={"settle": 0.2},
        head_options={"baudrate": 9600, "go_speed": 20.0},
    ) as emulated:  # fmt: skip
        data = state_intrinsics(emulated.rig_file(), setup[0])
        data["devices"]["head"] |= {"settle_s": 0.05, "poll_s": 0.01, "gap_s": 0.005}
        (folder / "rig.json").write_text(json.dumps(data))
        stated = read_rig_file(folder / "rig.json")
        with Rig.open(stated, clock=lambda: begun + QUICKLY * (time.time() - begun)) as rig:
            record(rig, folder / "s", terminal=Terminal(ask=lambda text: pytest.fail("the board moves by itself")))
    return open_session(folder / "s")


def covariance_of(solution):
    """Of the pose: what noise says, scaled to the larger of noise and spread over placements."""
    scale = trusted_sigma(solution)[:6] / solution.sigma[:6]
    return solution.covariance[:6, :6] * np.outer(scale, scale)


def difference(a, b):
    """Increments [w, v] from one pose to another."""
    turn = (b.rotation * a.rotation.inv()).as_rotvec()
    return np.concatenate([turn, b.translation - a.translation])


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


def test_the_recording_calibrates_as_the_simulated_session(recorded_session, simulated_session, setup):
    found = [calibrate(session, [METHOD]) for session in (recorded_session, simulated_session)]
    for key in found[0].solutions:
        recorded, expected = (one.solutions[key] for one in found)
        miss = difference(recorded.transform, expected.transform)
        nees = miss @ np.linalg.solve(covariance_of(recorded) + covariance_of(expected), miss)
        print(f"{key}: {1000 * miss[3:]} mm, {np.degrees(miss[:3])} deg, NEES {nees:.1f}")
        assert nees < chi2.ppf(0.999, 6)
        angle, distance = transform_difference(recorded.transform, setup[0].rig.cameras[0].mounting)
        assert np.degrees(angle) < 1.0 and distance < 0.03  # a far too large covariance would hide a wrong pose
    axes = [one.platform for one in found]
    miss = np.subtract(*(one.parameters()["combined"][0] for one in axes))
    assert miss @ np.linalg.solve(axes[0].covariance + axes[1].covariance, miss) < chi2.ppf(0.999, 4)
    assert len(found[0].solutions) == 1 and found[0].prepared.problems == {}
