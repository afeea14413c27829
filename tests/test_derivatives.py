"""Derivatives that are worked out by hand are those of differences: one table of all residuals."""
# ruff: noqa: B007,B023 (each function is used before the next one is made)

import numpy as np
import pytest
from joint_draws import draw, rng
from rendered_boards import MODEL, PATTERN, pose_of, view_poses
from scipy.spatial.transform import RigidTransform, Rotation
from synthetic import camera_case, numeric
from test_platform import ROUGH, TRUTH, make, pairs, pitched
from test_uncertainty import CAMERA, moved_points, random_chain

from lrfcal_lib.fit import edge_likelihood, residuals
from lrfcal_lib.fit.axis_chart import move_head, prior_terms
from lrfcal_lib.fit.result import PlatformPrior
from lrfcal_lib.judge.uncertainty import carried
from lrfcal_lib.model import camera
from lrfcal_lib.model.geometry import move_pose, pose_array
from lrfcal_lib.preprocess.bundle import Bundle, waves
from lrfcal_lib.solvers import lines, pitch, planes, platform
from lrfcal_lib.solvers.joint_model import SENSOR, Levels, Unknowns, gather
from lrfcal_lib.solvers.joint_residuals import named_blocks

OFF = RigidTransform.from_components(
    [0.05, -0.04, 0.06], Rotation.from_rotvec([0.05, -0.04, 0.03])
)
MARGINS = np.array([-0.03, -0.011, -0.004, -0.001, 0.0, 0.002, 0.006, 0.02])
EVERY = Unknowns(2, 3, sensor=SENSOR, sweep="offset_stretch", sides=True)


def projection():
    points = rng(0).uniform([-1, -0.6, 1.5], [1, 0.6, 3], (5, 3))
    by_point, by_intrinsics = camera.project_jacobians(points, MODEL)
    yield by_point, lambda s: camera.project(points + s, MODEL), 3
    yield (
        camera.pinhole_jacobian(points, MODEL),
        lambda s: camera.pinhole(points + s, MODEL),
        3,
    )
    yield (
        by_intrinsics,
        lambda s: camera.project(points, MODEL.with_parameters(MODEL.parameters + s)),
        9,
    )


def camera_methods():
    rig, obs = camera_case(9, noise=1.0)
    pose = pose_array(rig.T_camera_lrf * OFF)
    for residual in (residuals.line_block, lines.distance_block, lines.point_block):

        def block(s):
            return residual(move_pose(pose, s), obs)

        yield block(np.zeros(6)).jacobian, lambda s: block(s).residuals, 6
        here = block(np.zeros(6))
        r = here.white
        J = here.white_jacobian  # with what the weights change
        if here.corrected is not None:
            yield J.T @ r, lambda s: 0.5 * np.sum(block(s).white ** 2), 6


def board_planes():
    rig, obs = camera_case(5, noise=1.0)
    sets = planes.plane_sets(obs)
    pose = pose_array(rig.T_camera_lrf * OFF)
    triangles = planes.compress(sets, 100.0)
    boards = sets.boards
    _, by_pose, by_board = planes.plane_terms(pose, triangles, boards)
    yield by_pose, lambda s: planes.plane_terms(move_pose(pose, s), triangles, boards)[0], 6
    yield (
        by_board,
        lambda s: planes.plane_terms(
            pose, triangles, move_pose(boards, np.tile(s, (12, 1)))
        )[0],
        6,
    )


def tilt_axis():
    obs = make(6, noise=1.0)
    head = pose_array(ROUGH)
    prior = PlatformPrior(TRUTH, 0.01, 0.02)
    yield (
        prior_terms(head, prior)[1],
        lambda s: prior_terms(move_head(head, s), prior)[0],
        4,
    )
    for printed in (False, True):

        def block(s):
            return platform.projected_block(
                move_head(head, s), obs, pairs(obs, range(1, 21)), printed=printed
            )

        yield block(np.zeros(4)).jacobian, lambda s: block(s).residuals, 4
    boards = platform.prepare_boards(make(8, count=4, noise=1.0), ROUGH)
    state = head, boards.poses, np.full((4, 2), 0.02)

    def blocks(s):
        moved = platform.move_platform(state, np.tile(s, (4, 1)))
        return platform.platform_blocks(moved, boards.points, 1e-3)

    for i, block in enumerate(blocks(np.zeros(12))):
        used = (
            np.repeat(np.any(block.whitener != 0, axis=(-1, -2)), block.size, axis=-1)
            if block.size > 1
            else ...
        )
        J = np.broadcast_to(block.jacobian, (*block.residuals.shape, 12))
        yield J[used], lambda s: blocks(s)[i].residuals[used], 12


def recorded_pitch():
    cameras, *_ = pitched(25, 0.0, 0.02, count=5, noise=0.003, cameras=("left", "right"))[1]
    rows = pitch.gather(list(cameras.values()))
    pose = pose_array(
        RigidTransform.from_components(
            [0.1, 0.2, 0.3], Rotation.from_rotvec([1.5, 0.1, 0.2])
        )
    )
    each = np.eye(5)[rows.placement]
    for by_unknown in (
        each[:, :0],
        np.concatenate([each, each * rows.pitch[:, None]], axis=1),
    ):
        k = by_unknown.shape[1]

        def blocks(s):
            poses = move_pose(np.array([pose, pose]), s[:12].reshape(2, 6))
            return pitch.pitch_blocks((poses, np.full(k, 0.02) + s[12:]), rows, by_unknown)

        for i, block in enumerate(blocks(np.zeros(12 + k))):
            if block.residuals.size:
                yield block.jacobian, lambda s: blocks(s)[i].residuals, 12 + k


def single_beams():
    """Cost, score and information of beams, as the margin moves by its sigma."""
    for hit in (True, False):
        for lapse in (0.0, 0.01):

            def beam(s):
                return edge_likelihood.beam_terms(MARGINS + 0.004 * s, 0.004, hit, lapse)

            yield 0.004 * beam(0.0)[1][:, None], lambda s: beam(s[0])[0], 1
            assert (beam(0.0)[2] >= 0).all()
        sharp = edge_likelihood.beam_terms(MARGINS, 0.004, hit)[2]
        yield (
            0.004 * sharp[:, None],
            lambda s: edge_likelihood.beam_terms(MARGINS + 0.004 * s[0], 0.004, hit)[1],
            1,
        )


def joint_estimate():
    """The gradient of each placement's cost, and for least squares the Jacobian itself."""
    for mount in ("head", "platform"):
        own = rng(1)
        obs, truth, _ = draw(own, 3, mount=mount)
        places = {
            name: getattr(obs, f"{name}_placement") for name in ("face", "beam", "view")
        }
        obs = obs.keep(
            **{
                name: own.random(len(place)) < max(0.1, 9 / len(place))
                for name, place in places.items()
            }
        )
        off = own.normal(0, 0.03, (3, EVERY.size))
        state = EVERY.move(truth, off)
        for lapse in (0, 0.05):
            data = gather(obs, Levels(lapse=lapse))

            def block(s):
                return named_blocks(EVERY.move(state, np.tile(s, (3, 1))), data, EVERY)[
                    name
                ]

            def costs(s):
                found = block(s)
                return np.sum(
                    found.cost if found.cost is not None else 0.5 * found.white**2, axis=1
                )

            count = EVERY.size
            for name in ("beam",) if lapse else ("face", "beam", "view", "sweep", "side"):
                here = block(np.zeros(count))
                r = here.white
                J = here.white_jacobian
                yield np.sum(r[..., None] * J, axis=1), costs, count
                if here.cost is None:
                    yield J, lambda s: block(s).white, count


def chain_of_a_rig():
    for mount, pose in (("head", CAMERA), ("platform", CAMERA), ("head", None)):
        own = rng(0)
        chain = random_chain(mount, own, pose)
        beams = bearing, up, away = (
            own.uniform(1.0, 2.0, 5),
            own.uniform(-0.3, 0.3, 5),
            own.uniform(1, 4, 5),
        )
        _, by_links, by_pitch = carried(chain, *beams, 0.1)
        yield by_links, lambda s: moved_points(chain, *beams, s, 0.1), 13
        turned = by_pitch[..., None]
        yield (
            turned,
            lambda s: moved_points(chain, bearing, up + s[0], away, np.zeros(13), 0.1),
            1,
        )


def images():
    mounts = np.stack(
        [np.eye(4), pose_of(0.1, (0.02, 0.03), (-0.1, 0.01, 0.02), (0, 0)).as_matrix()]
    )[:, :3]
    poses = np.stack([p.as_matrix()[:3] for p in view_poses(2)])
    points = PATTERN.points()
    lenses = np.stack([MODEL.parameters, MODEL.parameters * 1.05])
    bundle = Bundle(lenses, mounts, poses, np.linspace(-1e-3, 2e-3, 21))
    pixels, jacobian = bundle.predict(points, basis := waves(points))
    count = jacobian[0].size // pixels[0].size
    jacobian = jacobian.reshape(*pixels.shape, count)
    yield jacobian, lambda s: bundle.moved(s).predict(points, basis)[0], count


@pytest.mark.parametrize("cases", [projection, camera_methods, board_planes, tilt_axis, recorded_pitch,
                                   single_beams, joint_estimate, chain_of_a_rig, images])  # fmt: skip
def test_derivatives_are_those_of_differences(cases):
    for number, (found, function, count) in enumerate(cases()):
        expected = numeric(function, count)
        assert found.any() or not expected.any()
        scale = np.abs(expected).max()
        np.testing.assert_allclose(
            found,
            expected,
            rtol=1e-4,
            atol=1e-5 * scale,
            err_msg=f"{cases.__name__} {number}",
        )
