"""Lengths in a scene: planes, edges, points, what a page computes, and lists of picks that are no good."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.measure import features, lengths
from lrfcal_lib.measure.edges import edges_of, nearest_edge


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
    return lengths.measure(scene, pd.DataFrame([row])).iloc[0]


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
        assert edge.feature.axis @ (last - first) == pytest.approx(
            np.linalg.norm(last - first)
        )
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
    _, together = features.length_between(*whole)
    free = replace(whole[1], jacobian=np.zeros_like(whole[1].jacobian))
    _, apart = features.length_between(whole[0], free)
    assert 0 < together < 0.01 and 0 < apart < 0.1


def test_derivatives_of_an_edge_are_those_of_the_edge_of_a_moved_camera(quick, scene):
    """A camera that is moved, and its edges with it, against the derivatives that an edge carries."""
    session = quick.prepared.session
    rig = scene.rig
    number = session.scene_placements[0]
    views = lengths.views_of(session, rig, number)
    pitches = [
        float(rig.corrections.pitch(number, session.image_records[v.number].pitch))
        for v in views
    ]
    step = 1e-4
    name = views[0].camera
    surfaces = (scene.planes, scene.of_point)
    shift = RigidTransform.from_translation([step, 0, 0])
    moved = [
        replace(v, T_camera_platform=shift * v.T_camera_platform) if v.camera == name else v
        for v in views
    ]
    after = edges_of(scene.cloud, surfaces, moved, pitches)
    column = list(rig.uncertainty.names).index(f"{name}_tx")
    changes = []
    for edge in scene.edges:
        nearest, away = nearest_edge(after, edge.ends.mean(axis=0))
        same = after[nearest].image == edge.image and away < 3 * step
        if edge.feature.camera == name and same:
            other = after[nearest].feature
            across = np.linalg.svd(edge.feature.axis[None])[2][1:]
            told = across @ edge.feature.jacobian[:3, column] * step
            changes.append([across @ (other.centre - edge.feature.centre), told])
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


def test_places_where_nothing_is_are_refused(scene):
    inside = ("point", scene.cloud.points[0])
    for kind, reach in (("plane", 100), ("edge", 10), ("point", 100)):
        with pytest.raises(ValueError, match=f"'it', place 2: no {kind} within {reach} mm"):
            length(scene, inside, (kind, [0.0, -50.0, 0.0]))
    axes = np.array([plane.axis for plane in scene.planes])
    i, j = np.argwhere(np.abs(axes @ axes.T) < 0.5)[0]
    ends = [("plane", scene.cloud.points[scene.of_point == k][0]) for k in (i, j)]
    with pytest.raises(ValueError, match="deg from parallel"):
        length(scene, *ends)
