"""Lengths that a simulated room states, as places to pick in the cloud of one of its stations."""

import numpy as np
import pandas as pd
from scipy.spatial import KDTree

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.evaluate.truth import read_truth
from lrfcal_lib.model.geometry import tilt
from lrfcal_lib.session.read import Session

NEAR = 0.03  # metres from a true face or edge to a point of the cloud that shows it
INSIDE = 0.9  # of a face: what is near its rim is not picked
FEWEST = 60  # points about a place, which must show the face
MEAN = 0.006  # metres by which these may be off it on average
PLACES = 41  # along an edge, at which one looks whether it can be seen


def true_picks(session: Session, rig: CalibratedRig, cloud: Cloud) -> pd.DataFrame:
    """The stated lengths of which a station shows both ends.

    Parameters
    ----------
    session : Session
    rig : CalibratedRig
        That made the cloud. Places are in its gauge: a turn about the tilt axis and a shift along
        it, which no data can show, are taken off.
    cloud : Cloud
        Of one station.

    Returns
    -------
    DataFrame
        A row a length: name, kind, x_m, y_m and z_m of both ends with _1 and _2 (the place nearest
        to the middle of each that the cloud shows; platform frame, metres), and true_m. Empty
        where no lengths are stated, as in a recording.
    """
    truth = read_truth(session)
    if truth is None or not truth.lengths:
        return pd.DataFrame()
    station = int(cloud.placement[0])
    gauge = truth.T_head_lrf * rig.T_head_lrf.inv()
    turn = gauge.rotation.as_rotvec()[0]
    recorded = session.sweep(station).pitch
    turn += np.mean(truth.pitch[station] - rig.corrections.pitch(station, recorded))
    shift = np.array([gauge.translation[0], 0.0, 0.0])
    T_platform_room = truth.stations[station].inv()
    tree = KDTree(cloud.points)
    rows = []
    for length in truth.lengths:
        row = {"name": length["name"], "true_m": length["metres"]}
        kinds = length["kind"].split("-")
        for number, (kind, end) in enumerate(zip(kinds, length["ends"], strict=True), 1):
            corners = tilt(T_platform_room.apply(end) - shift, -turn)
            shown = _on_edge(tree, corners)
            if kind == "plane":
                shown = _on_face(cloud, tree, corners)
            if len(shown):
                away = np.linalg.norm(shown - corners.mean(axis=0), axis=1)
                row[f"kind_{number}"] = kind
                for axis, value in zip("xyz", shown[np.argmin(away)], strict=True):
                    row[f"{axis}_m_{number}"] = float(value)
        if "kind_1" in row and "kind_2" in row:
            rows.append(row)
    return pd.DataFrame(rows)


def _on_face(cloud, tree, corners):
    """Points of a Cloud about which it shows a face with these corners (4, 3)."""
    middle = corners.mean(axis=0)
    axes = np.linalg.svd(corners - middle)[2]
    half = np.abs((corners - middle) @ axes.T).max(axis=0) * INSIDE + [0.0, 0.0, NEAR]
    off = (cloud.points - middle) @ axes.T
    near = (np.abs(off) < half).all(axis=1) & (np.abs(cloud.normals @ axes[2]) > INSIDE)
    shown = cloud.points[near]
    _, about = tree.query(shown, FEWEST)
    on_it = np.abs(off[about, 2].mean(axis=1)) < MEAN
    return shown[on_it]


def _on_edge(tree, ends):
    """Places of an edge with these ends (2, 3) that have a point of a cloud close by."""
    share = np.linspace(0, 1, PLACES)[:, None]
    places = ends[0] + share * (ends[1] - ends[0])
    away, _ = tree.query(places)
    return places[away < NEAR]
