"""Lengths that a simulated room states, as places to pick in the clouds of its stations."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from scipy.spatial import KDTree
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.evaluate.truth import read_truth
from lrfcal_lib.measure.features import SYSTEMATIC
from lrfcal_lib.measure.lengths import IN_PLACE, ON_IT, PICKED, SceneFeatures
from lrfcal_lib.model.geometry import length_of, unit_vector
from lrfcal_lib.session.read import Session

NEAR = 0.03  # metres from a true face to a point of the cloud that shows it
INSIDE = 0.9  # of a face: what is near its rim is not picked
FEWEST = 60  # points about a place, which must show the face
MEAN = 0.006  # metres by which these may be off it on average
PARALLEL = np.cos(np.radians(3.0))  # between an edge and the one that is stated


def true_picks(
    session: Session,
    rig: CalibratedRig,
    scenes: Mapping[int, SceneFeatures],
    poses: Mapping[int, RigidTransform] | None = None,
) -> pd.DataFrame:
    """The stated lengths as somebody picks them who looks at the clouds.

    Parameters
    ----------
    session : Session
    rig : CalibratedRig
        That made the clouds. Places are in its gauge: a turn about the tilt axis and a shift along
        it, which no data can show, are taken off.
    scenes : dict of int to SceneFeatures
        By station.
    poses : dict of int to RigidTransform, optional
        As for :func:`lrfcal_lib.measure.lengths.measure`.

    Returns
    -------
    DataFrame
        A row a length: name, kind, x_m, y_m and z_m of both ends with _1 and _2 (the middle of what
        stations show of it, of those that show both ends where there are such, or of the face or
        edge itself where none shows it; metres, frame of `poses`), and true_m. Empty where no
        lengths are stated, as in a recording.
    """
    truth = read_truth(session)
    if truth is None:
        return pd.DataFrame()
    poses = poses or dict.fromkeys(scenes, IN_PLACE)
    rows = []
    for length in truth.lengths:
        row = {"name": length["name"], "true_m": length["metres"]}
        kinds = length["kind"].split("-")
        shown = []
        for kind, end in zip(kinds, length["ends"], strict=True):
            look = _on_face if kind == "plane" else _on_edge
            by_station = {}
            for station, scene in scenes.items():
                gauge = truth.gauge(rig, station, session.sweep(station).pitch)
                in_room = truth.stations[station] * gauge
                corners = in_room.inv().apply(end)
                by_station[station] = poses[station].apply(look(scene, corners))
            nothing = poses[station].apply(corners.mean(axis=0))
            shown.append((by_station, nothing))
        both = [s for s in scenes if all(len(places[s]) for places, _ in shown)]
        ends = []
        for kind, (places, place) in zip(kinds, shown, strict=True):
            picked = np.concatenate([places[station] for station in both or scenes])
            if len(picked):
                away = length_of(picked - picked.mean(axis=0))
                place = picked[np.argmin(away)]
            ends += [kind, *place]
        rows.append(row | dict(zip(PICKED, ends, strict=True)))
    return pd.DataFrame(rows)


def _on_face(scene, corners):
    """Points about which a station shows a face with these corners (4, 3)."""
    cloud = scene.cloud
    middle = corners.mean(axis=0)
    axes = np.linalg.svd(corners - middle)[2]
    half = np.abs((corners - middle) @ axes.T).max(axis=0) * INSIDE + [0.0, 0.0, NEAR]
    off = (cloud.points - middle) @ axes.T
    near = (np.abs(off) < half).all(axis=1) & (np.abs(cloud.normals @ axes[2]) > INSIDE)
    shown = cloud.points[near & (scene.of_point >= 0)]
    _, about = KDTree(cloud.points).query(shown, FEWEST)
    return shown[np.abs(off[about, 2].mean(axis=1)) < MEAN]


def _on_edge(scene, ends):
    """Middles of the edges that a station shows along one with these ends (2, 3)."""
    way = unit_vector(ends[1] - ends[0])
    shown = []
    for edge in scene.edges:
        off = edge.centre - ends
        along = off @ way
        miss = off[0] - along[0] * way
        away = length_of(miss)
        by_surface = SYSTEMATIC * miss @ edge.jacobian[:3, -1]
        sigma = np.sqrt(miss @ edge.noise[:3, :3] @ miss + by_surface**2) / away
        same = abs(edge.axis @ way) > PARALLEL and along[0] > 0 > along[1]
        if same and away < max(ON_IT, 3 * sigma):
            shown.append(edge.centre)
    return np.array(shown).reshape(-1, 3)
