"""What is predicted about errors is what perturbed calibrations do."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.judge import uncertainty
from lrfcal_lib.judge.uncertainty import Chain, point_sigma, projection_sigma
from lrfcal_lib.model import geometry
from lrfcal_lib.model.camera import project
from lrfcal_lib.model.kinematics import SourceFrame, beams_to
from lrfcal_lib.preprocess.prepared import PitchNoise
from lrfcal_lib.simulate.draw import Devices

HEAD = RigidTransform.from_components(
    [0.0, 0.03, -0.05], Rotation.from_rotvec([0.0, 0.02, -0.03])
)
TURN = Rotation.from_rotvec([0.02, -0.03, 0.01]) * Rotation.from_matrix(
    [[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]
)
CAMERA = RigidTransform.from_components([0.1, 0.1, -0.05], TURN)
MODEL = Devices().model


def random_chain(mount, rng, camera=CAMERA, size=1e-3):
    mix = size * rng.normal(size=(13, 13)) / 3
    return Chain(
        head=HEAD,
        camera=camera,
        on_head=mount == "head",
        covariances=(mix @ mix.T,),
        links=np.eye(13),
        unseen=np.zeros((0, 13)),
        sweep=PitchNoise(),
    )


def moved(transform, change):
    return geometry.pose_transform(
        geometry.move_pose(geometry.pose_array(transform), change)
    )


def moved_points(chain, bearing, pitch, distance, change, image_pitch):
    """The chain carried out with the library's transforms, all links changed by `change` (13,)."""
    head = moved(chain.head, np.insert(change[:4], [0, 2], 0.0))
    scale = lambda angle: angle * (1 + change[11]) + change[12]  # noqa: E731
    p = geometry.polar_to_points(distance - change[10], bearing)
    frame = SourceFrame(head, "head" if chain.on_head else "platform", scale(image_pitch))
    source = frame.points(p, scale(pitch))
    if chain.camera is None:
        return source
    return moved(chain.camera, change[4:10]).apply(source)


def test_beams_to_inverts_the_platform():
    """Points that no scan reaches have no beam."""
    rng = np.random.default_rng(1)
    bearing = rng.uniform(0.6, 2.5, 50)
    pitch = rng.uniform(-0.8, 0.8, 50)
    distance = rng.uniform(0.5, 5, 50)
    points = geometry.lrf_to_platform(
        geometry.polar_to_points(distance, bearing), pitch, HEAD
    )
    assert np.allclose(beams_to(points, HEAD), [bearing, pitch, distance], atol=1e-9)
    tilted = RigidTransform.from_rotation(Rotation.from_rotvec([0, 0.3, 0]))
    assert np.isnan(beams_to([3.0, 0.1, 0.0], tilted)[1])


def scatter(chain, ends):
    """Root mean square scatter of the ends of beams over calibrations drawn from the chain's covariance."""
    changes = np.random.default_rng(2).multivariate_normal(
        np.zeros(13), chain.covariances[0], 1500
    )
    return np.sqrt(np.sum(np.var([ends(change) for change in changes], axis=0), axis=-1))


@pytest.mark.parametrize(("mount", "image_pitch"), [("head", 0.05), ("platform", 0.0)])
def test_projection_sigma_is_what_perturbed_calibrations_show(mount, image_pitch):
    chain = random_chain(mount, np.random.default_rng(2))
    sigma = projection_sigma(
        chain, MODEL, 1.5, (3, 2), image_pitch=image_pitch, pitches=(-np.pi, np.pi)
    )
    uv = uncertainty.pixel_grid(MODEL, (3, 2)).reshape(-1, 2)
    bearing, pitch = uncertainty.beams_of_pixels(chain, MODEL, uv, 1.5, image_pitch)

    def pixels(change):
        return project(moved_points(chain, bearing, pitch, 1.5, change, image_pitch), MODEL)

    assert np.allclose(pixels(np.zeros(13)), uv, atol=1e-6)
    assert np.allclose(sigma.ravel(), scatter(chain, pixels), rtol=0.07)


def test_point_sigma_is_what_perturbed_calibrations_show():
    chain = random_chain("head", np.random.default_rng(4), None)
    bearings = np.array([1.2, 1.9])
    pitches = np.array([-0.2, 0.1, 0.3])
    sigma = point_sigma(chain, bearings, pitches, 2.0, reference=0.1)
    b, p = (a.ravel() for a in np.meshgrid(bearings, pitches))
    moved = scatter(chain, lambda change: moved_points(chain, b, p, 2.0, change, 0.1))
    assert np.allclose(sigma.ravel(), moved, rtol=0.07)
    of_axis = np.arange(13) < 4
    only_axis = replace(
        chain, covariances=(chain.covariances[0] * np.outer(of_axis, of_axis),)
    )
    sigma = point_sigma(only_axis, bearings, pitches, 2.0, reference=0.1)
    assert np.allclose(
        sigma[1], 0, atol=1e-12
    )  # measured at the reference: the axis cancels
    assert (sigma[[0, 2]] > 1e-5).all()
