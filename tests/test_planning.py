"""Where images are taken so that a cloud gets its colours."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.calibrate.rig import CalibratedCamera
from lrfcal_lib.measure.planning import plan_images, seen_at
from lrfcal_lib.measure.scene import station_cloud

LIMITS = tuple(np.radians([-45, 30]))


@pytest.fixture(scope="module")
def rig(quick):
    return quick.rig("joint")


@pytest.fixture(scope="module")
def sweep(quick):
    session = quick.prepared.session
    pitch = session.sweep(session.scene_placements[0]).pitch
    return float(pitch[0]), float(pitch[-1])


def test_the_share_that_is_promised_is_kept(quick, rig, sweep):
    session = quick.prepared.session
    number = session.scene_placements[0]
    pitches = sorted({image.pitch for image in session.images(placement=number)})
    promised = seen_at(rig, sweep, np.array(pitches)).any(axis=0).mean()
    kept = station_cloud(session, rig, number).seen.mean()
    assert abs(promised - kept) < 0.05


def test_fewer_images_color_less_and_more_next_to_nothing_more(rig, sweep):
    pitch, share = plan_images(rig, sweep, LIMITS)
    assert list(pitch) == sorted(pitch) and len(pitch) > 1
    visible = seen_at(rig, sweep, pitch)
    assert visible.any(axis=0).mean() == pytest.approx(share)
    for left_out in range(len(visible)):
        assert np.delete(visible, left_out, axis=0).any(axis=0).mean() < share
    everywhere = seen_at(rig, sweep, np.linspace(*LIMITS, 100)).any(axis=0).mean()
    assert share > everywhere - 0.03


def test_cameras_on_the_base_need_one_pitch(rig, sweep):
    fixed = {
        name: CalibratedCamera(rig.camera_at(name, 0.0), "platform", camera.model)
        for name, camera in rig.cameras.items()
    }
    pitch, _ = plan_images(replace(rig, cameras=fixed), sweep, LIMITS)
    assert len(pitch) == 1


def test_a_camera_that_looks_away_colors_nothing(rig, sweep):
    behind = RigidTransform.from_rotation(Rotation.from_euler("y", 180, degrees=True))
    cameras = {
        name: replace(camera, T_camera=behind * camera.T_camera)
        for name, camera in rig.cameras.items()
    }
    pitch, share = plan_images(replace(rig, cameras=cameras), sweep, LIMITS)
    assert not len(pitch) and share == 0
