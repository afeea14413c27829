"""Lengths in a scene between picked places, with their 90 % intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike

import numpy as np
import pandas as pd
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.cloud import Cloud, join
from lrfcal_lib.calibrate.clouds import station_of, sweep_blocks
from lrfcal_lib.calibrate.painting import View
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.calibrate.rig_uncertainty import columns_of
from lrfcal_lib.measure.edges import edges_of
from lrfcal_lib.measure.features import (
    ALIKE,
    NINETY,
    SYSTEMATIC,
    Feature,
    Kind,
    Length,
    fit_feature,
    length_between,
    mean_length,
    shared_covariances,
)
from lrfcal_lib.measure.surfaces import planes_of
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    length_of,
    pose_array,
)
from lrfcal_lib.session.cache import cached
from lrfcal_lib.session.read import Session

REACH = (
    0.1  # metres from a picked place to points of its plane, and from a click to its edge
)
ON_IT = 0.01  # metres from a place on a feature of one station to the same one of another
ABOUT = 9  # points whose middle a picked point is, and that show which plane is picked
END = ("kind", "x_m", "y_m", "z_m")
PICKED = tuple(f"{what}_{number}" for number in (1, 2) for what in END)
IN_PLACE = RigidTransform.identity()


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
    edges : list of Feature
    """

    cloud: Cloud
    rig: CalibratedRig
    planes: list[Feature]
    of_point: np.ndarray
    edges: list[Feature]

    def at(
        self, kind: str, place: np.ndarray, axis: np.ndarray | None = None
    ) -> tuple[Feature | None, float]:
        """The feature of a kind that is nearest to a place (3,), platform frame, of those along an
        axis (3,), and how near its points or the edge are, metres; None where there is none.

        Of planes it is the one on which the nearest points lie as a whole, of those parallel to
        that of the nearest.
        """
        if kind == Kind.EDGE:
            return nearest_edge([e for e in self.edges if e.lies_along(axis)], place)
        away = length_of(self.cloud.points - place)
        if kind == Kind.PLANE:
            fits = np.array([*(plane.lies_along(axis) for plane in self.planes), False])
            away[~fits[self.of_point]] = np.inf
        about = np.argsort(away)[:ABOUT]
        nearest = away[about[0]]
        if kind == Kind.POINT:
            return fit_feature(self.cloud, about, self.rig, plane=False), nearest
        if nearest == np.inf:
            return None, nearest
        if axis is None:  # at a crease the nearest point tells which way the surface faces
            return self.at(kind, place, self.planes[self.of_point[about[0]]].axis)
        middle = self.cloud.points[about].mean(axis=0)
        # where a picture hangs, the nearest point may be one of the wall that noise put on it
        planes = [self.planes[number] for number in np.unique(self.of_point[about])]
        plane = min(planes, key=lambda each: length_of(each.foot(middle) - middle))
        return plane, nearest


def nearest_edge(
    edges: Sequence[Feature], place: np.ndarray
) -> tuple[Feature | None, float]:
    """The edge that passes closest to a place (3,), and how close, metres."""
    if not edges:
        return None, np.inf
    first, last = np.stack([edge.ends for edge in edges], axis=1)
    way = last - first
    along = np.vecdot(place - first, way) / np.vecdot(way, way)
    foot = first + np.clip(along, 0, 1)[:, None] * way
    away = length_of(foot - place)
    nearest = int(np.argmin(away))
    return edges[nearest], away[nearest]


def features_of(cloud: Cloud, rig: CalibratedRig, views: Sequence[View]) -> SceneFeatures:
    """All planes and edges of the cloud of a station.

    Parameters
    ----------
    cloud : Cloud
        Coloured from these views.
    rig : CalibratedRig
    views : sequence of View

    Returns
    -------
    SceneFeatures
    """
    surfaces = planes_of(cloud, rig)
    return SceneFeatures(cloud, rig, *surfaces, edges_of(cloud, surfaces, views))


@cached
def features_of_station(session: Session, rig: CalibratedRig, number: int) -> SceneFeatures:
    """All planes and edges that a station of a session shows.

    Parameters
    ----------
    session : Session
    rig : CalibratedRig
    number : int
        Placement.

    Returns
    -------
    SceneFeatures
    """
    rig = rig.for_scenes
    sweep, views = station_of(session, rig, number)
    return features_of(join(sweep_blocks(session, rig, sweep, views)), rig, views)


def measure(
    scenes: Mapping[int, SceneFeatures],
    picks: pd.DataFrame,
    poses: Mapping[int, RigidTransform] | None = None,
) -> pd.DataFrame:
    """Lengths between pairs of picked places.

    A length that several stations show is one: the mean of theirs, each weighted by how well it
    knows it. What the calibration has wrong is common to all of them, and does not become less.

    Parameters
    ----------
    scenes : dict of int to SceneFeatures
        By station.
    picks : DataFrame
        A row a length: name, and kind, x_m, y_m, z_m of both places, as :func:`read_picks` gives.
    poses : dict of int to RigidTransform, optional
        ``T_scene_platform`` of each station, in whose frame the places are; unless given they are
        in that of the only one.

    Returns
    -------
    DataFrame
        The same, with length_m, sigma_m, the ends of the 90 % interval, low_m and high_m, the
        stations, and problem: why there is no length, NaN then, or ''.
    """
    poses = poses or dict.fromkeys(scenes, IN_PLACE)
    rows = []
    for row in picks.to_dict("records"):
        length = sigma = np.nan
        lengths: dict[int, Length] = {}
        problem = ""
        try:
            lengths = _lengths(scenes, poses, row)
            mean = mean_length(list(lengths.values()))
            length, sigma = mean.metres, mean.sigma
        except DegenerateGeometry as error:
            problem = str(error)
        row |= {
            "length_m": length,
            "sigma_m": sigma,
            "low_m": max(length - NINETY * sigma, 0.0),
            "high_m": length + NINETY * sigma,
            "stations": " ".join(map(str, lengths)),
            "problem": problem,
        }
        rows.append(row)
    return pd.DataFrame(rows)


def _lengths(scenes, poses, row) -> dict[int, Length]:
    """A row of picks as each station measures it that shows both places."""
    first, second = (_shown(scenes, poses, row, number) for number in (1, 2))
    both = [station for station in first if station in second]
    if not both:
        raise DegenerateGeometry(
            "no station shows both places: pick places that one of them shows"
        )
    # where noise is large, a picture and its wall are one plane from some stations
    apart = [station for station in both if not first[station].is_same(second[station])]
    return {s: length_between(first[s], second[s]) for s in apart or both}


def _shown(scenes, poses, row, number) -> dict[int, Feature]:
    """The features that stations show at one of the places of a row of picks; a point is of the
    station that is nearest.
    """
    kind, *place = (row[f"{what}_{number}"] for what in END)
    near = {n: s.at(kind, poses[n].inv().apply(place)) for n, s in scenes.items()}
    clicked = min(near, key=lambda station: near[station][1])
    feature, away = near[clicked]
    reach = ON_IT if kind == Kind.EDGE else REACH
    if away > reach:
        raise DegenerateGeometry(
            f"place {number}: no {kind} within {1000 * reach:.0f} mm of it: pick another place, "
            "or a point"
        )
    if kind == Kind.POINT:
        return {clicked: feature}
    foot = feature.foot(poses[clicked].inv().apply(place))
    shown = {clicked: feature}
    for station, scene in scenes.items():
        T = poses[station].inv() * poses[clicked]
        there = T.apply(foot)
        other, away = scene.at(kind, there, T.rotation.apply(feature.axis))
        if away < REACH and length_of(other.foot(there) - there) < ON_IT:
            shown.setdefault(station, other)
    return shown


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
        why = getattr(problem, "strerror", None) or problem
        raise ValueError(f"{path}: {why}: {remedy}") from None
    missing = [name for name in ("name", *PICKED) if name not in table]
    if missing or table.empty:
        lack = f"no column {', '.join(missing)}" if missing else "no length in it"
        raise ValueError(f"{path}: {lack}: {remedy}")
    for column in PICKED:
        values = table[column]
        allowed = "a number"
        good = np.isfinite(pd.to_numeric(values, errors="coerce"))
        if column.startswith("kind"):
            allowed = "one of " + ", ".join(Kind)
            good = values.isin(list(Kind))
        for row in table[~good].to_dict("records"):
            raise ValueError(
                f"{path}, '{row['name']}': {column} is '{row[column]}', not {allowed}: {remedy}"
            )
    return table[["name", *PICKED]]


def for_page(
    scenes: Mapping[int, SceneFeatures], poses: Mapping[int, RigidTransform]
) -> dict:
    """What a page needs to measure by clicks, see :func:`lrfcal_lib.plots.interactive.scene_page`.

    Every plane and edge with its derivatives by the unknowns that all share, and the covariances of
    these once; for points the page has the formulas. That is exact, and 0.3 MB for 300 edges.

    Parameters
    ----------
    scenes : dict of int to SceneFeatures
        Whose points, station by station, are those of the page.
    poses : dict of int to RigidTransform
        As in :func:`measure`.

    Returns
    -------
    dict
        Of what JSON holds, and arrays.
    """
    features: list[Feature] = []
    of_point = []
    lines = []
    for number, scene in scenes.items():
        of_point.append(np.where(scene.of_point < 0, -1, scene.of_point + len(features)))
        features += [*scene.planes, *scene.edges]
        lines += [poses[number].apply(edge.ends) for edge in scene.edges]
    rows = [
        np.concatenate((f.centre, f.axis, f.ends, f.noise, f.jacobian), axis=None)
        for f in features
    ]
    rig = next(iter(scenes.values())).rig
    known = rig.known
    return {
        "kinds": [feature.kind for feature in features],
        "placements": [feature.placement for feature in features],
        "features": np.array(rows),
        "lines": np.array(lines).reshape(-1, 2, 3),
        "plane_of_point": np.concatenate(of_point),
        "station_of_point": np.concatenate([s.cloud.placement for s in scenes.values()]),
        "poses": {
            number: {"R": T.rotation.as_matrix().tolist(), "t": T.translation.tolist()}
            for number, T in poses.items()
        },
        "unknowns": len(known.names),
        "columns": columns_of(known.names).tolist(),
        "covariances": shared_covariances(rig),
        "sweep_sigma": known.sweep_sigma,
        "range_noise": known.range_noise,
        "systematic": SYSTEMATIC,
        "head": pose_array(rig.T_head_lrf).tolist(),
        "alike": ALIKE,
        "reach": REACH,
        "on_it": ON_IT,
        "about": ABOUT,
        "ninety": NINETY,
    }
