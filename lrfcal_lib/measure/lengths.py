"""Lengths in a scene between picked places, with their 90 % intervals."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from os import PathLike

import numpy as np
import pandas as pd

from lrfcal_lib.calibrate.cloud import Cloud, join
from lrfcal_lib.calibrate.clouds import views_of
from lrfcal_lib.calibrate.painting import View
from lrfcal_lib.calibrate.reconstruct import reconstruct
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.calibrate.rig_uncertainty import columns_of
from lrfcal_lib.judge.uncertainty import SEEN, chain_of, uncertainty_of
from lrfcal_lib.measure.edges import SceneEdge, edges_of, nearest_edge
from lrfcal_lib.measure.features import (
    ALIKE,
    Feature,
    Kind,
    fit_feature,
    length_between,
    shared_covariances,
    unseen_motions,
)
from lrfcal_lib.measure.surfaces import planes_of
from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.preprocess.closing_scan import without_closing
from lrfcal_lib.session.cache import cached
from lrfcal_lib.session.read import Session

REACH = 0.1  # metres from a picked place to its plane, and from a click to its edge
ON_EDGE = 0.01  # metres from a picked place to its edge: a click moves onto it
ABOUT = 9  # points whose middle a picked point is
NINETY = 1.645  # standard deviations to either side that hold 90 %
PLACE = ("x", "y", "z")
PICKED = tuple(
    f"{what}_{number}" for number in (1, 2) for what in ("kind", "x_m", "y_m", "z_m")
)


@dataclass(frozen=True)
class SceneFeatures:
    """What can be measured in the cloud of a station.

    Attributes
    ----------
    cloud : Cloud
        Of n points, platform frame.
    rig : CalibratedRig
    planes : list of Feature
    of_point : ndarray of int, shape (n,)
        The number of the plane that a point lies on, -1 for none.
    edges : list of SceneEdge
    """

    cloud: Cloud
    rig: CalibratedRig
    planes: list[Feature]
    of_point: np.ndarray
    edges: list[SceneEdge]

    def at(self, kind: str, place: np.ndarray) -> Feature:
        """The feature of a kind at a picked place.

        Parameters
        ----------
        kind : {'point', 'edge', 'plane'}
        place : ndarray, shape (3,)
            Platform frame, metres.

        Returns
        -------
        Feature

        Raises
        ------
        DegenerateGeometry
            If there is none within `REACH`, of an edge `ON_EDGE`.
        """
        if kind == Kind.EDGE:
            number, away = nearest_edge(self.edges, place)
            _refuse_far(kind, away, ON_EDGE)
            return self.edges[number].feature
        away = np.linalg.norm(self.cloud.points - place, axis=1)
        if kind == Kind.PLANE:
            away[self.of_point < 0] = np.inf
        _refuse_far(kind, away.min(initial=np.inf), REACH)
        nearest = int(np.argmin(away))
        if kind == Kind.PLANE:
            return self.planes[self.of_point[nearest]]
        about = np.argsort(away)[:ABOUT]
        return fit_feature(self.cloud, about, self.rig, plane=False)


def _refuse_far(kind, away, reach):
    """DegenerateGeometry where the feature is too far from what was picked."""
    if away > reach:
        raise DegenerateGeometry(
            f"no {kind} within {1000 * reach:.0f} mm of it: pick another place, or a point"
        )


def features_of(
    cloud: Cloud, rig: CalibratedRig, views: Sequence[View], pitches: Sequence[float]
) -> SceneFeatures:
    """All planes and edges of the cloud of a station.

    Parameters
    ----------
    cloud : Cloud
        Coloured from these views.
    rig : CalibratedRig
    views : sequence of View
    pitches : sequence of float
        Of the head at each view, radians.

    Returns
    -------
    SceneFeatures
    """
    planes, of_point = planes_of(cloud, rig)
    edges = edges_of(cloud, (planes, of_point), views, pitches)
    return SceneFeatures(cloud, rig, planes, of_point, edges)


@cached
def features_of_station(
    session: Session, rig: CalibratedRig, number: int, cloud: Cloud | None = None
) -> SceneFeatures:
    """All planes and edges that a station of a session shows.

    Parameters
    ----------
    session : Session
    rig : CalibratedRig
    number : int
        Placement.
    cloud : Cloud, optional
        Of it, platform frame, if it is there already.

    Returns
    -------
    SceneFeatures
    """
    views = views_of(session, rig, number)
    recorded = [session.image_records[view.number].pitch for view in views]
    pitches = [float(rig.corrections.pitch(number, pitch)) for pitch in recorded]
    if cloud is None:
        sweep, _ = without_closing(session.sweep(number))
        cloud = join(
            reconstruct(
                sweep,
                views,
                rig.T_head_lrf,
                rig.corrections,
                lrf=session.lrf,
                continuous=session.continuous,
            )
        )
    return features_of(cloud, rig, views, pitches)


def measure(scene: SceneFeatures, picks: pd.DataFrame) -> pd.DataFrame:
    """Lengths between pairs of picked places.

    Parameters
    ----------
    scene : SceneFeatures
    picks : DataFrame
        A row a length: name, and kind, x_m, y_m, z_m of both places, as :func:`read_picks` gives.

    Returns
    -------
    DataFrame
        The same, with length_m, sigma_m and the ends of the 90 % interval, low_m and high_m.

    Raises
    ------
    ValueError
        For a place without such a feature, or two that are not parallel; it names the row.
    """
    return pd.DataFrame([_measured(scene, row) for row in picks.to_dict("records")])


def measure_all(scene: SceneFeatures, picks: pd.DataFrame) -> pd.DataFrame:
    """The same as :func:`measure` without the rows of which it would complain.

    Parameters
    ----------
    scene : SceneFeatures
    picks : DataFrame

    Returns
    -------
    DataFrame
    """
    rows = []
    for row in picks.to_dict("records"):
        with suppress(ValueError):
            rows.append(_measured(scene, row))
    return pd.DataFrame(rows)


def _measured(scene, row):
    """A row of picks with its length."""
    ends = []
    for number in (1, 2):
        place = np.array([row[f"{axis}_m_{number}"] for axis in PLACE], float)
        try:
            ends.append(scene.at(row[f"kind_{number}"], place))
        except DegenerateGeometry as problem:
            raise ValueError(f"'{row['name']}', place {number}: {problem}") from None
    try:
        length, sigma = length_between(*ends)
    except DegenerateGeometry as problem:
        raise ValueError(f"'{row['name']}': {problem}") from None
    return row | {
        "length_m": length,
        "sigma_m": sigma,
        "low_m": max(length - NINETY * sigma, 0.0),
        "high_m": length + NINETY * sigma,
    }


def read_picks(path: str | PathLike) -> pd.DataFrame:
    """Read the list that ``scene.html`` saves.

    Parameters
    ----------
    path

    Returns
    -------
    DataFrame
        A row a length: name, kind_1, x_m_1, y_m_1, z_m_1, kind_2, ...

    Raises
    ------
    ValueError
        If the file is no such list; it names file, row and remedy.
    """
    remedy = "save it from scene.html again"
    try:
        table = pd.read_csv(path)
    except (OSError, ValueError) as problem:
        raise ValueError(f"{path}: {problem}: {remedy}") from None
    missing = [name for name in ("name", *PICKED) if name not in table]
    if missing or table.empty:
        lack = f"no column {', '.join(missing)}" if missing else "no length in it"
        raise ValueError(f"{path}: {lack}: {remedy}")
    table = table[["name", *PICKED]]
    for row in table.to_dict("records"):
        for column in PICKED:
            value = row[column]
            known = [str(kind) for kind in Kind]
            if column.startswith("kind"):
                good = value in known
                allowed = "one of " + ", ".join(known)
            else:
                good = isinstance(value, int | float) and np.isfinite(value)
                allowed = "a number"
            if not good:
                raise ValueError(
                    f"{path}, '{row['name']}': {column} is '{value}', not {allowed}: {remedy}"
                )
    return table


def for_page(scene: SceneFeatures) -> dict:
    """What a page needs to measure by clicks, see :func:`lrfcal_lib.plots.interactive.scene_page`.

    Every plane and edge with its derivatives by the unknowns that all share, and the covariances of
    these once; for points the page has the formulas. That is exact, and 0.3 MB for 300 edges.

    Parameters
    ----------
    scene : SceneFeatures

    Returns
    -------
    dict
        Of what JSON holds, and arrays.
    """
    rig = scene.rig
    cameras = [None, *rig.cameras]
    features = [*scene.planes, *(edge.feature for edge in scene.edges)]
    rows = [
        np.concatenate([f.centre, f.axis, f.noise.ravel(), f.jacobian.ravel()])
        for f in features
    ]
    chain = chain_of(rig)
    known = uncertainty_of(rig)
    stations = np.unique(scene.cloud.placement).tolist()
    still = {"R": np.eye(3).tolist(), "t": [0.0, 0.0, 0.0]}
    return {
        "kinds": [str(feature.kind) for feature in features],
        "cameras": [cameras.index(feature.camera) for feature in features],
        "placements": [feature.placement for feature in features],
        "features": np.array(rows),
        "ends": np.array([edge.ends for edge in scene.edges]).reshape(-1, 6),
        "plane_of_point": scene.of_point,
        "station_of_point": scene.cloud.placement,
        "poses": dict.fromkeys(stations, still),
        "unknowns": len(known.names),
        "columns": columns_of(known.names).tolist(),
        "covariances": shared_covariances(rig),
        "unseen": [unseen_motions(rig, camera).tolist() for camera in cameras],
        "sweep_sigma": known.sweep_sigma,
        "range_noise": known.range_noise,
        "head": chain.head.tolist(),
        "alike": ALIKE,
        "least": SEEN,
        "reach": REACH,
        "about": ABOUT,
        "ninety": NINETY,
    }
