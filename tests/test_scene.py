"""A recorded scene becomes a coloured cloud in four files that say the same."""

import gc
import sys
from dataclasses import replace

import cv2
import numpy as np
import open3d as o3d
import pye57
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.calibrate.cloud import COLUMNS, point_type
from lrfcal_lib.calibrate.clouds import color_cloud
from lrfcal_lib.measure.scene import station_cloud, stations_of, write_scene
from lrfcal_lib.measure.stations import Joined, alone
from lrfcal_lib.model.kinematics import SweepPitch

ABOUT = "session sim_quick, UNTRUSTED for a test"
POSE = RigidTransform.from_components(
    [3.0, -1.0, 0.5], Rotation.from_rotvec([0.1, -0.2, 0.8])
)
SHIFT = 0.05  # metres, sigma of the place of its station
SHIFTS = np.diag([0.0, 0, 0, 1, 1, 1])
NOT_SEEN = 0.02  # share of the points whose pixel lies on the very rim of its image


@pytest.fixture(scope="module")
def session(quick):
    return quick.prepared.session


@pytest.fixture(scope="module")
def rig(quick):
    return quick.rig("joint")


@pytest.fixture(scope="module")
def cloud(session, rig):
    return station_cloud(session, rig, session.scene_placements[0])


@pytest.fixture(scope="module")
def folder(session, rig, tmp_path_factory):
    """The files of the scene, whose station has a pose."""
    folder = tmp_path_factory.mktemp("scene")
    counts = []
    (number,) = stations_of(session)
    posed = Joined({number: POSE}, {number: SHIFT**2 * SHIFTS}, (), ())
    files = write_scene(folder, session, rig, posed, ABOUT, counts.append)
    assert sorted(files) == sorted(folder.iterdir())
    assert sum(counts) == len(ply_points(folder))
    return folder


def ply_points(folder):
    data = (folder / "scene.ply").read_bytes()
    _, _, points = data.partition(b"end_header\n")
    return np.frombuffer(points, point_type(COLUMNS))


@pytest.fixture(scope="module")
def e57(folder):
    with pye57.E57(str(folder / "scene.e57")) as file:
        yield file


def transform(node):
    """The pose of a node of an E57 file."""
    turn = [node["pose"]["rotation"][axis].value() for axis in "xyzw"]
    shift = [node["pose"]["translation"][axis].value() for axis in "xyz"]
    return RigidTransform.from_components(shift, Rotation.from_quat(turn))


def test_all_files_hold_the_same_points(folder, e57, cloud):
    rows = ply_points(folder)
    np.testing.assert_allclose(rows["points"], POSE.apply(cloud.points), atol=1e-6)
    np.testing.assert_array_equal(rows["colors"], cloud.colors)
    assert np.all(rows["sigma"] > 0)

    read = e57.read_scan(0, colors=True, ignore_missing_fields=True)
    points = np.stack([read[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    colors = np.stack([read[f"color{name}"] for name in ("Red", "Green", "Blue")], axis=1)
    np.testing.assert_allclose(points, rows["points"], atol=1e-5)
    np.testing.assert_array_equal(colors, rows["colors"])

    pcd = o3d.io.read_point_cloud(str(folder / "scene.pcd"))
    np.testing.assert_allclose(np.asarray(pcd.points), rows["points"], atol=1e-6)


def test_points_are_as_uncertain_as_their_station(folder, cloud):
    sigma = ply_points(folder)["sigma"][:, 0]
    smooth = np.isfinite(cloud.normals).all(axis=1)
    expected = np.hypot(cloud.sigma, SHIFT * smooth)
    np.testing.assert_allclose(sigma, expected, rtol=1e-6)


def test_every_file_says_where_it_is_from(folder, e57):
    for name in ("scene.ply", "scene.pcd", "scene.html"):
        assert ABOUT in (folder / name).read_text(errors="ignore")
    nodes = [*e57.data3d, *e57.root["images2D"]]
    assert len(nodes) > 1 and all(ABOUT in node["description"].value() for node in nodes)


def test_the_images_of_the_file_show_the_points_of_the_file(e57, session, cloud):
    """A pinhole camera alone, by the words of the standard, finds a point's colour in its image."""
    scan = e57.read_scan(0, ignore_missing_fields=True)
    points = np.stack([scan[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    number = session.scene_placements[0]
    records = session.images(placement=number)
    assert len(e57.root["images2D"]) == len(records) > 2
    for node, record in zip(e57.root["images2D"], records, strict=True):
        assert node["associatedData3DGuid"].value() == e57.get_header(0).guid
        pinhole = node["pinholeRepresentation"]
        blob = pinhole["jpegImage"]
        data = np.zeros(blob.byteCount(), np.uint8)
        blob.read(data, 0, len(data))
        image = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert image.shape[:2] == (
            pinhole["imageHeight"].value(),
            pinhole["imageWidth"].value(),
        )

        own = cloud.image == session.image_records.index(record)
        x, y, z = transform(node).inv().apply(points[own]).T
        focal = pinhole["focalLength"].value()
        u = (
            pinhole["principalPointX"].value()
            - focal * x / z / pinhole["pixelWidth"].value()
        )
        v = (
            pinhole["principalPointY"].value()
            + focal * y / z / pinhole["pixelHeight"].value()
        )
        column = np.floor(u).astype(int)
        row = np.floor(v).astype(int)
        inside = (
            (row >= 0) & (row < image.shape[0]) & (column >= 0) & (column < image.shape[1])
        )
        assert np.mean(inside) > 1 - NOT_SEEN and np.all(z < 0)
        shown = image[row[inside], column[inside], ::-1].astype(float)
        kept = cloud.colors[own][inside].astype(float)
        gains = np.sum(shown * kept, axis=0) / np.sum(kept**2, axis=0)
        assert np.median(np.abs(shown - gains * kept)) < 6, (
            "up to exposure the colours are the same"
        )


def test_the_pose_of_an_image_is_that_of_its_camera(e57, session, rig):
    number = session.scene_placements[0]
    flip = RigidTransform.from_rotation(Rotation.from_euler("x", 180, degrees=True))
    for node, record in zip(
        e57.root["images2D"], session.images(placement=number), strict=True
    ):
        pitch = float(rig.corrections.pitch(number, record.pitch))
        expected = POSE * rig.camera_at(record.camera, pitch).inv() * flip
        np.testing.assert_allclose(
            transform(node).as_matrix(), expected.as_matrix(), atol=1e-9
        )


def test_what_a_board_s_sweep_was_off_by_is_not_taken_from_a_scene(session, rig, cloud):
    number = session.scene_placements[0]
    of_a_board = {number: SweepPitch(offset=np.radians(1.0), stretch=0.0, middle=0.0)}
    corrections = replace(rig.corrections, sweeps=of_a_board)
    live = station_cloud(session, replace(rig, corrections=corrections), number)
    np.testing.assert_array_equal(live.points, cloud.points)
    np.testing.assert_array_equal(live.colors, cloud.colors)


def test_points_without_a_color_are_as_grey_as_their_echoes(session, rig, cloud):
    number = session.scene_placements[0]
    echoes = np.random.default_rng(0).uniform(10, 200, session.scans["ranges"].shape)
    echoing = replace(session, scans=session.scans | {"intensities": echoes})
    shaded = station_cloud(echoing, rig, number)
    np.testing.assert_array_equal(shaded.colors[shaded.seen], cloud.colors[cloud.seen])
    grey = shaded.colors[~shaded.seen]
    assert np.ptp(grey, axis=1).max() == 0
    assert np.corrcoef(grey[:, 0], shaded.intensity[~shaded.seen])[0, 1] > 0.99


def test_a_file_that_breaks_off_is_not_there(
    session, rig, tmp_path, little_space, monkeypatch
):
    complaints = []
    monkeypatch.setattr(sys, "unraisablehook", complaints.append)
    number = session.scene_placements[0]
    with little_space(100_000), pytest.raises(ValueError, match="cannot be written"):
        write_scene(tmp_path, session, rig, alone(number), ABOUT)
    assert list(tmp_path.iterdir()) == []
    gc.collect()
    assert not complaints


def test_the_scan_that_closes_a_sweep_makes_no_points(quick, session, rig, cloud):
    number = session.scene_placements[0]
    first = np.flatnonzero(session.scans["placement"] == number)[0]
    scans = {
        key: values if key == "bearings" else np.concatenate([values, values[[first]]])
        for key, values in session.scans.items()
    }
    closed = replace(session, scans=scans)
    assert len(closed.sweep(number).pitch) == len(session.sweep(number).pitch) + 1
    np.testing.assert_array_equal(station_cloud(closed, rig, number).points, cloud.points)
    other = replace(quick, prepared=replace(quick.prepared, session=closed))
    painted = color_cloud(other, "joint", scene=True)
    np.testing.assert_array_equal(painted.points, cloud.points)
