"""Recordings of the simulated room and calibrations of its rig that err as they say, for tests of measure.holds."""

from dataclasses import replace

import numpy as np
from shared import ROOT

from lrfcal_lib.calibrate.cameras import KnownAxis
from lrfcal_lib.calibrate.rig import CalibratedCamera, CalibratedRig
from lrfcal_lib.calibrate.rig_uncertainty import RigUncertainty
from lrfcal_lib.model.geometry import POSE_NAMES, move_pose, pose_array, pose_transform
from lrfcal_lib.model.kinematics import Corrections
from lrfcal_lib.session.read import open_session
from lrfcal_lib.simulate.rig import load_setup

ROOM = ROOT / "data" / "room_lms221"
# radians and metres, as the calibration of sim_lms221 says of itself: what the LRF leaves open errs alike in both cameras
AXIS_SIGMA = [0.001, 0.0005, 0.002, 0.001]
SHARED = np.array([0.0005, 0.0005, 0.0011, 0.0009, 0.0009, 0.002])
OWN = np.array([0.0003, 0.0003, 0.0001, 0.0002, 0.0002, 0.0005])


def room(stations, pitches=(), slip=0.0, mount="head"):
    """The shipped room from some of its stations, images at some pitch angles (deg); the head slipped by so much."""
    session = open_session(ROOM)
    chosen = []
    for record in session.image_records:
        near = [abs(np.degrees(record.pitch) - pitch) < 1 for pitch in pitches]
        if record.placement in stations and (any(near) or not pitches):
            chosen.append(record)
    scans = session.scans | {"pitch": session.scans["pitch"] - slip}
    cameras = {
        name: replace(camera, mount=mount) for name, camera in session.cameras.items()
    }
    return replace(session, image_records=tuple(chosen), scans=scans, cameras=cameras)


def true_rig(session):
    """The rig as it is, with the uncertainty that a good calibration states."""
    truth = load_setup("room_lms221").rig
    names = [
        "axis_out_of_scan_plane",
        "axis_in_scan_plane",
        "offset_in_scan_plane",
        "offset_across_scan_plane",
    ]
    sigma = [*AXIS_SIGMA]
    cameras = {}
    for camera in truth.cameras:
        names += [f"{camera.name}_{part}" for part in POSE_NAMES]
        sigma += list(OWN)
        cameras[camera.name] = CalibratedCamera(camera.mounting, "head", camera.model)
    covariance = np.diag(np.square(sigma))
    together = np.zeros((len(sigma), 6))
    together[4:] = np.tile(np.diag(SHARED), (len(cameras), 1))
    covariance += together @ together.T
    nothing = np.zeros((0, 13))
    uncertainty = RigUncertainty(
        names=tuple(names),
        covariance=covariance,
        trusted=covariance,
        lens=np.zeros_like(covariance),
        unseen_of_cloud=nothing,
        unseen_of_cameras=dict.fromkeys(cameras, nothing),
        sweep_sigma=(0.0, 0.0),
        range_noise=0.01,
    )
    axis = KnownAxis(truth.T_head_lrf, covariance[:4, :4])
    corrections = Corrections(range_offset=0.005, pitch_scale=0.003)
    return CalibratedRig(
        "joint", axis, corrections, cameras, session.lrf, uncertainty, session="truth"
    )


def on_base(rig, pitch):
    """The same cameras, fixed to the base where they are at a pitch of the head."""
    cameras = {}
    for name, camera in rig.cameras.items():
        cameras[name] = CalibratedCamera(
            rig.camera_at(name, pitch), "platform", camera.model
        )
    return replace(rig, cameras=cameras)


def changed(rig, camera, increments):
    """A calibration from before a camera moved by pose increments ``[w, v]``."""
    known = rig.cameras[camera]
    pose = pose_transform(move_pose(pose_array(known.T_camera), -np.asarray(increments)))
    return replace(rig, cameras=rig.cameras | {camera: replace(known, T_camera=pose)})


def erring(rig, rng):
    """A calibration whose cameras are off as far as it says."""
    shared = rng.normal(0, SHARED)
    for camera in rig.cameras:
        rig = changed(rig, camera, shared + rng.normal(0, OWN))
    return rig


def any_way(rng, size):
    """A vector of some length in any direction."""
    way = rng.normal(size=3)
    return size * way / np.linalg.norm(way)
