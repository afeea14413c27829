"""LMS400 and ZED: a calibration applied to sweeps left out of it, each in turn, puts the board where the images do."""

from dataclasses import replace

import numpy as np
import pytest
from shared import campaign

from lrfcal_lib.calibrate.pipeline import leave_out
from lrfcal_lib.calibrate.rig import joint_rig
from lrfcal_lib.judge.uncertainty import carried, chain_of
from lrfcal_lib.model.camera import pinhole, pinhole_jacobian
from lrfcal_lib.model.kinematics import beams_to

PLACEMENTS = 20


class Held:
    """One camera and one sweep under the calibration from all others: what is off, and by how much it may be."""

    def __init__(self, joint, solution, camera, placement):
        ready = joint.prepared
        scan = {placement: ready.scans[placement]}
        alone = replace(joint, prepared=replace(ready, scans=scan))
        # the sweep's own pitch error is not known: it was left out
        self.seen = alone.seen_by(camera, solution).along().select([placement])
        self.rig = joint_rig(solution, ready.models)
        self.chain = chain_of(self.rig, camera)
        self.sweep_sigma = solution.sweep_sigma

    def sigma(self, direction, jacobian, by_pitch, pitch):
        """Of the mean of offsets along directions (n, 3): by the links, and by the pitch of the sweep."""
        by_link = np.einsum("ni,nij->j", direction, jacobian) / len(direction)
        by_pitch = np.vecdot(direction, by_pitch)
        variance = max(by_link @ C @ by_link for C in self.chain.covariances)
        by_sweep = np.mean([by_pitch, by_pitch * pitch], axis=1) * self.sweep_sigma
        return np.sqrt(variance + by_sweep @ by_sweep)

    def carried(self, points):
        """Points in the camera frame, what moves them, and their pitch."""
        bearing, pitch, distance = beams_to(points, self.rig.T_head_lrf)
        return *carried(self.chain, bearing, pitch, distance), pitch

    def off_mm(self):
        """How far the scanned board is from that of the image along its normal, and sigma."""
        seen = self.seen
        points, *moved = self.carried(seen.plane_points)
        pose = seen.board_poses[list(seen.placements).index(seen.plane_placement[0])]
        normal = pose[:3, 2]
        away = points.mean(axis=0) - pose[:3, 3]
        sigma = self.sigma(np.tile(normal, (len(points), 1)), *moved)
        by_pose = np.r_[np.cross(away, normal), normal]
        (covariance,) = seen.board_covariance
        return 1000 * away @ normal, 1000 * np.sqrt(
            sigma**2 + by_pose @ covariance @ by_pose
        )

    def off_px(self):
        """The same for every side of the board that the scan lines cross, across its line in the image."""
        points, jacobian, by_pitch, pitch = self.carried(self.seen.crossing_points)
        lines = self.seen.crossing_lines
        miss = np.vecdot(pinhole(points, self.seen.model), lines[:, :2]) + lines[:, 2]
        by_point = pinhole_jacobian(points, self.seen.model)
        across = np.einsum("ni,nij->nj", lines[:, :2], by_point)
        _, side = np.unique(lines.round(6), axis=0, return_inverse=True)
        for number in np.unique(side):
            rows = side.ravel() == number
            sigma = self.sigma(across[rows], jacobian[rows], by_pitch[rows], pitch[rows])
            yield miss[rows].mean(), sigma


@pytest.fixture(scope="module")
def held(lms400):
    joint = leave_out(lms400.joint, groups=PLACEMENTS)
    assert len(joint.without) == PLACEMENTS
    return [
        Held(joint, solution, camera, placement)
        for placement, solution in joint.without.items()
        for camera in solution.transforms
    ]


@campaign
def test_boards_of_sweeps_left_out_are_where_the_images_put_them(held):
    """Within 2 sigma in 9 of 10; the recorded pitch of each sweep is off by 0.02 to 0.9 deg."""
    off, sigma = np.array([each.off_mm() for each in held]).T
    assert len(off) == 2 * PLACEMENTS
    assert np.mean(np.abs(off) <= 2 * sigma) >= 0.9
    assert np.sqrt(np.mean(off**2)) < 8 and np.median(np.abs(off)) < 5
    assert np.sqrt(np.mean(sigma**2)) < 12, "sigma is no excuse"


@campaign
def test_sides_of_boards_left_out_are_where_the_images_put_them(held):
    off, sigma = np.array([side for each in held for side in each.off_px()]).T
    assert len(off) > 70
    assert np.mean(np.abs(off) <= 2 * sigma) >= 0.9
    assert np.sqrt(np.mean(off**2)) < 6 and np.median(np.abs(off)) < 2
    assert np.sqrt(np.mean(sigma**2)) < 9, "sigma is no excuse"
