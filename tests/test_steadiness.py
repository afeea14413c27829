"""A camera on the base stood still or did not: synthetic backgrounds that are turned, scaled, dimmed and covered."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shared import campaign

from lrfcal_lib.evaluate.diagnosis import motion_words
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.plots.results import background_motion
from lrfcal_lib.preprocess import steadiness
from lrfcal_lib.preprocess.steadiness import find_steps, fit_motion, pixel_root
from lrfcal_lib.session.read import open_session

MODEL = CameraModel(480, 320, 300.0, 302.0, 241.0, 158.0, np.array([-0.1, 0.02, 0.0, 0.0, 0.0]))
PLACEMENTS = range(1, 9)


@pytest.fixture(scope="module")
def texture():
    """A background of blobs of many sizes, larger than the image."""
    rng = np.random.default_rng(4)
    layers = [cv2.GaussianBlur(rng.standard_normal((520, 720)), (0, 0), s) * s for s in (1.5, 3, 8)]
    return 118 + 45 * np.clip(sum(layers) / np.std(sum(layers)), -2, 2)


def picture(texture, rng, turn=(0, 0, 0), scale=1.0, board=None, light=1.0, noise=1.5):
    """The background seen by a camera that has turned; a board covers a part of it."""
    u, v = np.meshgrid(np.arange(MODEL.width), np.arange(MODEL.height))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(float)
    bare = cv2.undistortPoints(pixels[:, None], MODEL.matrix, MODEL.distortion)[:, 0] / scale
    rays = Rotation.from_rotvec(turn).apply(np.column_stack([bare, np.ones(len(bare))]))
    at = (300 * rays[:, :2] / rays[:, 2:] + [360, 260]).reshape(MODEL.height, MODEL.width, 2).astype(np.float32)
    image = cv2.remap(texture.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_CUBIC)
    if board is not None:
        x, y = board
        squares = (np.add.outer(np.arange(110) // 14, np.arange(130) // 14) % 2) * 200.0 + 20
        image[y : y + 110, x : x + 130] = squares
    image = light * image + noise * rng.standard_normal(image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def series(texture, turns, seed=1, **more):
    """One image a placement, the board somewhere else in each."""
    rng = np.random.default_rng(seed)
    return [
        (p, picture(texture, rng, turn, board=(20 + 40 * p, 60 + 17 * p), **{k: v[i] for k, v in more.items()}))
        for i, (p, turn) in enumerate(zip(PLACEMENTS, turns, strict=True))
    ]


def judge(images, mount="platform"):
    records, pictures = [SimpleNamespace(placement=p) for p, _ in images], dict(images)
    session = SimpleNamespace(
        cameras={"left": SimpleNamespace(mount=mount)}, images=lambda camera, purpose: records,
        placements=list(pictures), read_image=lambda record: pictures[record.placement],
    )  # fmt: skip
    made = SimpleNamespace(session=session, views={"left": {}}, models={"left": MODEL})
    return steadiness.camera_steadiness(made, "left")


def motion(rotvec, sigma=1e-6, seed=0):
    """Made-up motions with noise, for the search for steps."""
    rng = np.random.default_rng(seed)
    rotvec = np.asarray(rotvec, float) + sigma * rng.standard_normal((len(rotvec), 3))
    covariance = np.tile(sigma**2 * np.eye(3), (len(rotvec), 1, 1))
    return np.arange(1, len(rotvec) + 1), rotvec, covariance, pixel_root(MODEL)


def step_at(k, n=20, size=(0.001, -0.0008, 0.0003)):
    return np.where(np.arange(n)[:, None] < k, 0.0, np.array(size))


def test_a_steady_camera_gives_no_finding_under_another_light(texture):
    found = judge(series(texture, np.zeros((8, 3)), light=[1.0, 0.6, 1.2, 0.9, 0.8, 1.1, 0.7, 1.0]))
    assert not found.steps and not found.problems and not found.scale_drifts
    assert (found.size_px < 0.06).all()
    assert motion_words({"left": found}) == []


def test_a_nudge_is_found_where_it_happened(texture):
    turn = np.array([0.0016, -0.0012, 0.0005])
    found = judge(series(texture, step_at(5, 8, turn)))
    (step,) = found.steps
    assert (step.before, step.after) == (5, 6)
    np.testing.assert_allclose(step.rotvec, turn, atol=1.5e-4)
    assert step.angle == pytest.approx(np.linalg.norm(turn), rel=0.05) and step.angle_sigma < 0.1 * step.angle
    assert step.size_px == pytest.approx(np.linalg.norm(pixel_root(MODEL) @ turn), rel=0.05)
    assert "camera left moved by 0.1" in motion_words({"left": found})[0]


def test_a_lens_that_warms_up_is_no_nudge(texture):
    found = judge(series(texture, np.zeros((8, 3)), scale=1 + 0.003 * np.exp(-np.arange(8) / 2.0)))
    assert found.scale_drifts and not found.steps
    assert np.ptp(found.scale) == pytest.approx(0.003 * (1 - np.exp(-3.5)), rel=0.1)
    (words,) = motion_words({"left": found})
    assert "image scale" in words and "between placements 1 and 8" in words.replace("8 and 1", "1 and 8")


def test_an_image_of_something_else_is_named(texture):
    images = series(texture, np.zeros((8, 3)))
    images[6] = (7, picture(np.flip(texture), np.random.default_rng(9)))
    found = judge(images)
    assert 7 not in found.placements and "mounted anew" in found.problems[7]
    assert any("placement 7" in words for words in motion_words({"left": found}))


def test_a_plain_wall_is_refused():
    with pytest.raises(steadiness.BackgroundLost, match="40 in 10 are needed"):
        fit_motion(np.full((5, 2), 100.0), np.full((5, 2), 100.0), MODEL)
    plain = [(p, np.full((50, 60), 90, np.uint8)) for p in PLACEMENTS]
    assert len(judge(plain).problems) == len(plain) - 1


@pytest.mark.parametrize("n", [6, 10, 20])
def test_noise_alone_is_no_step(n):
    sigma = 0.4 / MODEL.fx
    alarms = sum(bool(find_steps(*motion(np.zeros((n, 3)), sigma, seed))) for seed in range(300))
    assert alarms <= 2, "a level of 0.001"


SMALL = 0.1 / MODEL.fx
NO_STEP = {
    "one placement apart": (step_at(10, size=(0.003,) * 3) - step_at(11, size=(0.003,) * 3), 3e-5),
    "the first apart": (step_at(1, size=(0.003,) * 3), 3e-5),
    "the last apart": (step_at(19, size=(0.003,) * 3), 3e-5),
    "too small to matter": (step_at(10, size=(SMALL, 0, 0)), SMALL / 50),
    "five placements": (step_at(3, 5), 1e-6),
}


@pytest.mark.parametrize("what", NO_STEP)
def test_what_is_no_step(what):
    assert find_steps(*motion(*NO_STEP[what])) == ()


def test_a_camera_on_the_head_is_not_judged():
    found = judge([], mount="head")
    assert "rides on the head" in found.reason and len(found.placements) == 0 and not found.steps
    assert motion_words({"left": found}) == [] and "0 images" in judge([]).reason
    with pytest.raises(ValueError, match="rides on the head"):
        background_motion(None, {"left": found})


@pytest.fixture(scope="module")
def nudged(lms400_session):
    session, rough = open_session(lms400_session), np.array([-0.17, 0.02, 0.0, 0.0, 0.0])
    model = CameraModel(1280, 720, 700.0, 700.0, 640.0, 360.0, rough)
    views, models = (dict.fromkeys(session.cameras, each) for each in ({}, model))
    made = SimpleNamespace(session=session, views=views, models=models)
    return {camera: steadiness.camera_steadiness(made, camera) for camera in session.cameras}


@campaign
def test_the_nudge_of_a_real_rig_is_found(nudged):
    """Without being told where the board is: half of the features lie on it or behind it."""
    for found in nudged.values():
        (step,) = found.steps
        assert (step.before, step.after) == (10, 11)
        assert 0.05 < np.rad2deg(step.angle) < 0.09 and 0.6 < step.size_px < 1.0
        assert not found.problems and len(found.placements) == 20
    assert "the rig moved by 0.06" in motion_words(nudged)[0]
