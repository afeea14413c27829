"""How good a coloured scene is: errors against a simulated room."""

from dataclasses import dataclass

import numpy as np

from lrfcal_lib.calibrate.cloud import Cloud, join
from lrfcal_lib.calibrate.clouds import views_of
from lrfcal_lib.calibrate.pipeline import Calibration
from lrfcal_lib.calibrate.reconstruct import reconstruct
from lrfcal_lib.evaluate.truth import read_truth
from lrfcal_lib.model.geometry import (
    length_of,
    tilt,
    unit_vector,
)
from lrfcal_lib.model.kinematics import AS_RECORDED

# metres along the beam by which a reading is of another surface than the beam's centre meets
BESIDE = 0.05
CLEAR = 0.02  # metres before a point in which something hides it


@dataclass(frozen=True)
class SceneErrors:
    """What a simulated room says about a Cloud of it, a row a point.

    Attributes
    ----------
    depth : ndarray, shape (n,)
        Signed, along the beam, metres; NaN where the truth shows nothing.
    normal : ndarray, shape (n,)
        The same along the normal of the true surface.
    color : ndarray, shape (n,)
        Mean over red, green, blue of the absolute difference to the true light at one exposure; NaN
        where unseen.
    blocked : ndarray of bool, shape (n,)
        Coloured from an image in which something hides the point.
    """

    depth: np.ndarray
    normal: np.ndarray
    color: np.ndarray
    blocked: np.ndarray


def scene_errors(cloud: Cloud, calibration: Calibration, method: str) -> SceneErrors | None:
    """Errors of the cloud of one scene against the simulator.

    A turn about the tilt axis and a shift along it, which no data can show, do not count.

    Parameters
    ----------
    cloud : Cloud
    calibration : Calibration
        That made it.
    method : str
        That made it.

    Returns
    -------
    SceneErrors or None
        None for a recording.
    """
    session = calibration.prepared.session
    truth = read_truth(session)
    if truth is None:
        return None
    from lrfcal_lib.simulate.record import world_of
    from lrfcal_lib.simulate.rig import Placement, load_setup

    rig = calibration.rig(method)
    placement = cloud.placement[0]
    station = Placement(placement, T_room_platform=truth.stations.get(placement))
    world = world_of(load_setup(truth.setup), station)
    recorded = session.sweep(placement).pitch
    gauge = truth.gauge(rig, placement, recorded)
    order = np.argsort(recorded)
    pitch = np.interp(cloud.pitch, recorded[order], truth.pitch[placement][order])
    points = gauge.apply(cloud.points)
    origins = tilt(truth.T_head_lrf.translation, pitch)
    length = length_of(points - origins)
    directions = unit_vector(points - origins)
    hits = world.cast(origins, directions)
    depth = np.where(np.isfinite(hits.distance), length - hits.distance, np.nan)
    # else the rim of the spot read a surface beside the beam: the point is where it is
    true_length = np.where(np.abs(depth) < BESIDE, hits.distance, length)
    true = origins + true_length[:, None] * directions
    blocked = np.zeros(len(points), bool)
    for view in views_of(session, rig, placement):
        painted = (cloud.image == view.number) & np.isfinite(depth)
        eye = gauge.apply(view.T_camera_platform.inv().translation)
        way = true[painted] - eye
        met = world.cast(eye, unit_vector(way))
        blocked[painted] = met.distance < length_of(way) - CLEAR
    light = 255 * world.radiance(hits)
    ratio = cloud.colors[cloud.seen] / np.maximum(light[cloud.seen], 1e-9)
    exposed = np.clip(light * np.median(ratio), 0, 255)
    return SceneErrors(
        depth=depth,
        normal=depth * hits.cosine,
        color=np.where(cloud.seen, np.abs(cloud.colors - exposed).mean(axis=1), np.nan),
        blocked=blocked,
    )


def as_stated(calibration: Calibration) -> Cloud:
    """The first scene with the platform as it is stated, ranges and pitch as recorded, and no
    colours.

    Parameters
    ----------
    calibration : Calibration

    Returns
    -------
    Cloud
    """
    session = calibration.prepared.session
    sweep = session.sweep(session.scene_placements[0])
    stated = calibration.platform.transform("stated")
    return join(reconstruct(sweep, [], stated, AS_RECORDED, lrf=session.lrf))
