"""Surfaces that two images show: what hides them in one, and outlines of what stands before them, is not compared."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from holds_draws import ROOM, true_rig
from scipy.spatial.transform import Rotation

from lrfcal_lib.calibrate.cloud import COLUMNS, Cloud
from lrfcal_lib.calibrate.painting import View
from lrfcal_lib.measure import image_pairs
from lrfcal_lib.measure.image_pairs import clear_places, pairs_pull
from lrfcal_lib.measure.suspects import suspects
from lrfcal_lib.model.camera import project, undistort
from lrfcal_lib.session.read import open_session

WALL = 3.0  # metres before the rig
COLUMN = 1.2  # the same of a dark board before the wall, as wide as:
ASIDE = (-0.15, 0.05)
FACE = 200  # pixels of the wall's texture a metre


@pytest.fixture(scope="module")
def rig():
    return true_rig(open_session(ROOM))


@cache
def texture():
    """Of the wall, 6 m square, about its middle."""
    noise = np.random.default_rng(5).normal(0, 1, (6 * FACE, 6 * FACE)).astype(np.float32)
    coarse = cv2.GaussianBlur(noise, (0, 0), 0.03 * FACE)
    return 128 + 45 * coarse / coarse.std()


def picture(rig, camera, columns):
    """What a camera sees of the wall and of dark boards before it."""
    T_platform_camera = rig.camera_at(camera, 0.0).inv()
    model = rig.cameras[camera].model
    v, u = np.indices((model.height, model.width))
    pixels = undistort(np.stack([u.ravel(), v.ravel()], axis=1).astype(float), model)
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(model.matrix).T
    rays = T_platform_camera.rotation.apply(rays)
    eye = T_platform_camera.translation

    def at(distance):
        """Where rays reach a plane so far before the rig: x and z."""
        return (eye + (distance - eye[1]) / rays[:, 1:2] * rays)[:, [0, 2]]

    x, z = (at(WALL) * FACE + 3 * FACE).astype(np.float32).reshape(*v.shape, 2).T
    grey = cv2.remap(texture(), x.T, z.T, cv2.INTER_LINEAR, borderValue=128)
    for low, high in columns:
        x = at(COLUMN)[:, 0].reshape(v.shape)
        grey[(x > low) & (x < high)] = 15
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def scanned(columns):
    """The cloud of it."""
    bearing, pitch = np.meshgrid(
        np.radians(np.arange(-30, 30, 0.5)), np.radians(np.arange(-20, 20, 0.5))
    )
    ray = np.stack([np.tan(bearing), np.ones_like(pitch), np.tan(pitch)], axis=-1).reshape(
        -1, 3
    )
    distance = np.full(len(ray), WALL)
    for low, high in columns:
        x = COLUMN * ray[:, 0]
        distance[(x > low) & (x < high)] = COLUMN
    values = dict.fromkeys(COLUMNS, np.zeros(len(ray)))
    values["points"] = ray * distance[:, None]
    values["normals"] = np.tile([0.0, -1.0, 0.0], (len(ray), 1))
    return Cloud(**values | {"bearing": bearing.ravel(), "pitch": pitch.ravel()})


def view_of(rig, camera, image, number=0):
    """The image of a camera at pitch 0."""
    return View(
        number, camera, rig.camera_at(camera, 0.0), rig.cameras[camera].model, image
    )


def evidence_of(rig, columns):
    """That a camera has moved, by what pairs of images say."""
    views = [
        view_of(rig, camera, picture(rig, camera, columns), number)
        for number, camera in enumerate(rig.cameras)
    ]
    cloud = scanned(columns)
    (pull,) = pairs_pull(
        cloud,
        np.zeros(len(cloud.points), int),
        views,
        rig,
        np.zeros(len(rig.uncertainty.names) + 1),
    )
    return max(shift.evidence for shift in suspects([pull], rig)), pull


def test_what_stands_before_a_wall_is_not_taken_for_the_wall(rig, monkeypatch):
    """Its outline, and what it hides from one image, look otherwise: as if a camera had moved."""
    evidence, pull = evidence_of(rig, [])
    assert evidence < 0 and pull.alike == 1
    evidence, pull = evidence_of(rig, [ASIDE])
    assert evidence < 0 and pull.alike > 0.95
    monkeypatch.setattr(image_pairs, "BEFORE", 1e9)  # whatever is nearer or farther
    assert evidence_of(rig, [ASIDE])[1].alike < 0.85


@pytest.mark.parametrize("degrees", [0, 30, 60])
def test_a_wall_seen_at_an_angle_does_not_hide_itself(rig, degrees):
    """Of a plane the inverse of the depth is linear in the pixels."""
    model = rig.cameras["left"].model
    view = view_of(rig, "left", np.zeros((model.height, model.width, 3), np.uint8))
    normal = Rotation.from_euler("z", degrees, degrees=True).apply([0.0, -1.0, 0.0])
    cloud = scanned([])
    ray = cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
    distance = normal @ [0.0, WALL, 0.0] / (ray @ normal)
    distance += np.random.default_rng(7).normal(0, rig.lrf.sigma_range, len(ray))
    points = ray * distance[:, None]
    cloud = replace(cloud, points=points, normals=np.tile(normal, (len(ray), 1)))
    shown = view.model.shows(project(view.T_camera_platform.apply(points), view.model))
    assert shown.sum() > 300
    assert clear_places(cloud, view, rig)[shown].mean() > 0.98
    assert not clear_places(cloud, view, rig)[~shown].any()
