"""Lengths in a scene: planes, edges, points, what a page computes, and lists of picks that are no good."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from drawn_rooms import simulate_room
from scipy.spatial import KDTree
from scipy.spatial.transform import RigidTransform, Rotation
from shared import DATA

from lrfcal_lib import __main__ as command_line
from lrfcal_lib.calibrate.calibration_file import load_calibration
from lrfcal_lib.calibrate.clouds import views_of
from lrfcal_lib.measure import features, lengths
from lrfcal_lib.measure.edges import edges_of
from lrfcal_lib.measure.lengths import nearest_edge
from lrfcal_lib.measure.scene import stations_of
from lrfcal_lib.measure.stations import join_stations
from lrfcal_lib.model.kinematics import SweepPitch
from lrfcal_lib.report.true_lengths import true_picks
from lrfcal_lib.session.read import open_session


@pytest.fixture(scope="module")
def scene(quick):
    session = quick.prepared.session
    return lengths.features_of_station(
        session, quick.rig("joint"), session.scene_placements[0]
    )


def pick(kind, place, number):
    axes = {f"{axis}_m_{number}": value for axis, value in zip("xyz", place, strict=True)}
    return {f"kind_{number}": kind} | axes


def length(scene, first, second):
    row = {"name": "it"} | pick(*first, 1) | pick(*second, 2)
    return lengths.measure({1: scene}, pd.DataFrame([row])).iloc[0]


def parallel(found):
    """Numbers of two of some features that are parallel and not the same."""
    for i, one in enumerate(found):
        for j, other in enumerate(found[:i]):
            if abs(one.axis @ other.axis) > 0.999:
                return i, j
    raise AssertionError("no two are parallel")


def test_a_scene_is_flat_surfaces_and_edges_on_them(scene):
    assert (scene.of_point >= 0).mean() > 0.7 and len(scene.edges) > 20
    for number, plane in enumerate(scene.planes):
        off = (scene.cloud.points[scene.of_point == number] - plane.centre) @ plane.axis
        assert np.median(np.abs(off)) < 0.02
    for edge in scene.edges:
        first, last = edge.ends
        assert edge.axis @ (last - first) == pytest.approx(np.linalg.norm(last - first))
        assert nearest_edge(scene.edges, (first + last) / 2)[1] < 1e-9


def test_a_length_is_the_same_from_either_end_and_between_places_of_the_same_features(
    scene,
):
    i, j = parallel(scene.planes)
    places = [scene.cloud.points[scene.of_point == k] for k in (i, j)]
    ends = [("plane", place[0]) for place in places]
    one = length(scene, *ends)
    back = length(scene, *ends[::-1])
    other = length(scene, ("plane", places[0][-1]), ends[1])
    assert one.length_m == pytest.approx(back.length_m, abs=1e-12)
    assert one.length_m == other.length_m and one.sigma_m == pytest.approx(back.sigma_m)
    assert one.low_m < one.length_m < one.high_m


def test_points_of_one_scan_err_together(scene):
    """A length in a scan is better known than its ends, and gains nothing from more points of it."""
    i, j = parallel(scene.planes)
    first, second = scene.planes[i], scene.planes[j]
    nothing = np.zeros((6, 6))
    whole = [replace(plane, noise=nothing) for plane in (first, second)]
    together = features.length_between(*whole).sigma
    free = replace(whole[1], jacobian=np.zeros_like(whole[1].jacobian))
    apart = features.length_between(whole[0], free).sigma
    assert 0 < together < 0.01 and 0 < apart < 0.1


def test_what_a_sweep_of_a_board_was_off_by_is_of_no_scene(quick, scene):
    """Though the placements of both have the same number."""
    session = quick.prepared.session
    rig = quick.rig("joint")
    number = session.scene_placements[0]
    off = {number: SweepPitch(offset=0.02, stretch=0.0, middle=0.0)}
    rig = replace(rig, corrections=replace(rig.corrections, sweeps=off))
    again = lengths.features_of_station(session, rig, number)
    np.testing.assert_array_equal(again.cloud.points, scene.cloud.points)


def test_derivatives_of_an_edge_are_those_of_the_edge_of_a_moved_camera(quick, scene):
    """A camera that is moved, and its edges with it, against the derivatives that an edge carries."""
    session = quick.prepared.session
    rig = scene.rig
    number = session.scene_placements[0]
    views = views_of(session, rig, number)
    step = 1e-4
    name = views[0].camera
    surfaces = (scene.planes, scene.of_point)
    shift = RigidTransform.from_translation([step, 0, 0])
    moved = [
        replace(v, T_camera_platform=shift * v.T_camera_platform) if v.camera == name else v
        for v in views
    ]
    after = edges_of(scene.cloud, surfaces, moved)
    column = list(rig.uncertainty.names).index(f"{name}_tx")
    changes = []
    of_camera = {view.number for view in views if view.camera == name}
    for edge in scene.edges:
        nearest, away = nearest_edge(after, edge.ends.mean(axis=0))
        same = nearest.image == edge.image and away < 3 * step
        if edge.image in of_camera and same:
            across = np.linalg.svd(edge.axis[None])[2][1:]
            told = across @ edge.jacobian[:3, column] * step
            changes.append([across @ (nearest.centre - edge.centre), told])
    change, told = np.moveaxis(np.array(changes), 1, 0)
    assert len(changes) > 5 and np.median(np.abs(told).max(axis=1)) > 0.5 * step
    assert np.median(np.abs(change - told)) < 0.01 * step


BAD = {
    "no column": ("name,kind_1\nx,plane\n", "no column x_m_1"),
    "a word": ("{head}\nx,plane,0,0,zero,plane,0,0,0\n", "z_m_1 is 'zero', not a number"),
    "a kind": ("{head}\nx,wall,0,0,0,plane,0,0,0\n", "kind_1 is 'wall', not one of point"),
    "nothing": ("{head}\n", "no length in it"),
    "empty": ("", "No columns"),
    "no place": ("{head}\nx,plane,,0,0,plane,0,0,0\n", "x_m_1 is 'nan', not a number"),
}


@pytest.mark.parametrize("what", BAD)
def test_a_list_that_is_none_is_refused_with_the_reason(tmp_path, what):
    text, words = BAD[what]
    file = tmp_path / "picks.csv"
    file.write_text(text.replace("{head}", ",".join(("name", *lengths.PICKED))))
    with pytest.raises(ValueError, match="save it from scene.html again") as refused:
        lengths.read_picks(file)
    assert words in str(refused.value) and str(file) in str(refused.value)


def test_a_list_that_is_not_there_is_named_once(tmp_path):
    with pytest.raises(
        ValueError, match=r"^\S+none.csv: No such file or directory: save it"
    ):
        lengths.read_picks(tmp_path / "none.csv")


def test_a_point_that_noise_put_on_another_plane_does_not_choose_it(scene):
    inner = scene.planes[0].foot(np.median(scene.cloud.points[scene.of_point == 0], axis=0))
    away = np.linalg.norm(scene.cloud.points - inner, axis=1)
    clicked = np.argmin(np.where(scene.of_point == 0, away, np.inf))
    of_point = scene.of_point.copy()
    of_point[clicked] = 1
    place = scene.cloud.points[clicked]
    plane, distance = replace(scene, of_point=of_point).at("plane", place)
    assert plane is scene.planes[0] and distance == 0


def test_at_a_crease_the_nearest_point_chooses_the_plane(scene):
    """Where floor and wall meet, points of both are about: the floor must not be taken for the wall."""
    tree = KDTree(scene.cloud.points)
    normals = np.array([plane.axis for plane in scene.planes])
    checked = 0
    for clicked in np.flatnonzero(scene.of_point >= 0)[::11]:
        about = scene.of_point[tree.query(scene.cloud.points[clicked], lengths.ABOUT)[1]]
        about = about[about >= 0]
        facing = np.abs(normals[about] @ normals[scene.of_point[clicked]])
        if facing.min() < 0.5:
            plane, _ = scene.at("plane", scene.cloud.points[clicked])
            checked += 1
            assert plane.lies_along(normals[scene.of_point[clicked]])
    assert checked > 5


def test_places_where_nothing_is_are_named(scene):
    inside = ("point", scene.cloud.points[0])
    for kind, reach in (("plane", 100), ("edge", 10), ("point", 100)):
        row = length(scene, inside, (kind, [0.0, -50.0, 0.0]))
        assert row.problem.startswith(f"place 2: no {kind} within {reach} mm")
        assert np.isnan(row.length_m) and row.stations == ""
    axes = np.array([plane.axis for plane in scene.planes])
    i, j = np.argwhere(np.abs(axes @ axes.T) < 0.5)[0]
    ends = [("plane", scene.cloud.points[scene.of_point == k][0]) for k in (i, j)]
    assert "deg from parallel" in length(scene, *ends).problem


def test_a_feature_taken_twice_is_named(scene):
    for kind in features.Kind:
        place = scene.cloud.points[scene.of_point == 0][0]
        if kind == "edge":
            place = scene.edges[0].centre
        row = length(scene, (kind, place), (kind, place + 1e-4))
        assert row.problem.startswith(f"both places are on the same {kind}: pick two")
        assert np.isnan(row.length_m)


def test_a_station_that_shows_both_ends_as_one_is_left_out(scene):
    """Where noise is large, a picture and its wall are one plane from some stations."""
    i, j = parallel(scene.planes)
    ends = [("plane", scene.cloud.points[scene.of_point == k][0]) for k in (i, j)]
    row = pd.DataFrame([{"name": "it"} | pick(*ends[0], 1) | pick(*ends[1], 2)])
    alone = lengths.measure({1: scene}, row).iloc[0]
    blind = replace(scene, planes=[scene.planes[i]] * len(scene.planes))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lengths, "ON_IT", np.inf)
        both = lengths.measure(
            {1: scene, 2: blind}, row, dict.fromkeys((1, 2), lengths.IN_PLACE)
        )
    assert both.stations[0] == "1"
    assert both.length_m[0] == alone.length_m


def seen_from(scene, T_station_scene, shift):
    """The same scene from another station, whose surfaces are off by a shift along their normals."""
    turn = T_station_scene.rotation

    def moved(feature):
        centre = T_station_scene.apply(feature.centre) + shift * turn.apply(feature.axis)
        both = np.kron(np.eye(2), turn.as_matrix())
        return replace(
            feature,
            centre=centre,
            axis=turn.apply(feature.axis),
            noise=both @ feature.noise @ both.T,
            jacobian=both @ feature.jacobian,
            ends=T_station_scene.apply(feature.ends),
            placement=9,
        )

    points = T_station_scene.apply(scene.cloud.points)
    return replace(
        scene,
        cloud=replace(scene.cloud, points=points),
        planes=[moved(plane) for plane in scene.planes],
        edges=[moved(edge) for edge in scene.edges],
    )


def test_a_length_of_two_stations_is_one_and_their_shared_errors_stay(scene):
    """The weighted mean; noise averages out, what the calibration has wrong does not."""
    i, j = parallel(scene.planes)
    ends = [("plane", scene.cloud.points[scene.of_point == k][0]) for k in (i, j)]
    turn = Rotation.from_rotvec([0.1, -0.2, 0.9])
    T_scene_station = RigidTransform.from_components([1.0, -2.0, 0.3], turn)
    other = seen_from(scene, T_scene_station.inv(), 0.002)
    row = {"name": "it"} | pick(*ends[0], 1) | pick(*ends[1], 2)
    poses = {1: RigidTransform.identity(), 9: T_scene_station}
    one = length(scene, *ends)
    both = lengths.measure({1: scene, 9: other}, pd.DataFrame([row]), poses)
    assert len(both) == 1 and both.stations[0] == "1 9"
    each = [features.length_between(s.planes[i], s.planes[j]) for s in (scene, other)]
    assert both.length_m[0] == pytest.approx(np.mean([each[0].metres, each[1].metres]))
    assert each[0].sigma == pytest.approx(each[1].sigma) == pytest.approx(one.sigma_m)
    shared = each[0].sigma ** 2 - each[0].noise
    assert both.sigma_m[0] ** 2 == pytest.approx(shared + each[0].noise / 2)
    # a surface that stands elsewhere by more than stations disagree is another one
    far = seen_from(scene, T_scene_station.inv(), 0.02)
    apart = lengths.measure({1: scene, 9: far}, pd.DataFrame([row]), poses)
    assert len(apart.stations[0].split()) == 1


def test_another_edge_that_crosses_there_is_not_taken_for_the_same(scene):
    i, j = parallel(scene.edges)
    ends = [("edge", scene.edges[k].centre) for k in (i, j)]
    row = {"name": "it"} | pick(*ends[0], 1) | pick(*ends[1], 2)
    other = seen_from(scene, RigidTransform.identity(), 0.0)
    edge = other.edges[i]
    off, across = np.linalg.svd(edge.axis[None])[2][1:]
    same = replace(edge, centre=edge.centre + 0.003 * off, ends=edge.ends + 0.003 * off)
    ends = edge.centre + 0.001 * off + np.outer([-0.1, 0.1], across)
    nearer = replace(edge, axis=across, ends=ends)
    other = replace(other, edges=[nearer, same, other.edges[j]])
    poses = dict.fromkeys((1, 9), RigidTransform.identity())
    both = lengths.measure({1: scene, 9: other}, pd.DataFrame([row]), poses)
    assert both.problem[0] == "" and both.stations[0] == "1 9"


def test_places_that_no_station_shows_together_are_named(scene):
    i, j = parallel(scene.planes)
    ends = [("plane", scene.cloud.points[scene.of_point == k][0]) for k in (i, j)]
    halves = {}
    for number, (gone, _) in zip((1, 9), ((i, 0), (j, 0)), strict=True):
        of_point = np.where(scene.of_point == gone, -1, scene.of_point)
        halves[number] = replace(scene, of_point=of_point)
    row = {"name": "it"} | pick(*ends[0], 1) | pick(*ends[1], 2)
    table = lengths.measure(halves, pd.DataFrame([row]))
    assert table.problem[0].startswith("no station shows both places")


@pytest.mark.campaign
def test_lengths_in_rooms_nobody_tuned_on(tmp_path):
    """60 lengths are stated, each is measured once, from four joined stations of its room."""
    rig = load_calibration(calibrated(tmp_path))
    tables = []
    for seed in (501, 502, 503):
        simulate_room(tmp_path / str(seed), seed)
        room = open_session(tmp_path / str(seed))
        scenes = {n: lengths.features_of_station(room, rig, n) for n in stations_of(room)}
        clouds = {n: features.with_sigma(each.cloud, rig) for n, each in scenes.items()}
        poses = join_stations(clouds, rig).T_world_station
        assert len(poses) == 4
        picks = true_picks(room, rig, scenes, poses)
        assert len(picks) == 20
        tables.append(lengths.measure(scenes, picks, poses))
    table = pd.concat(tables)
    found = table[table.problem == ""]
    error = (found.length_m - found.true_m).abs()
    assert len(found) >= 48
    left_out = table[table.problem != ""]
    reasons = "place [12]: no edge within 10 mm|no station shows both places"
    assert left_out.problem.str.contains(reasons).all()
    assert error[found.kind_1 == "plane"].mean() < 0.0015
    assert error[found.kind_1 == "edge"].mean() < 0.004
    assert 0.83 < np.mean(error < lengths.NINETY * found.sigma_m) <= 0.96


def calibrated(folder):
    """The calibration.json of the shipped session."""
    assert (
        command_line.main(["calibrate", str(DATA / "sim_lms221"), "--out", str(folder)])
        == 0
    )
    return folder / "calibration.json"
