"""The mounting of two cameras from the chessboard in both images."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from rendered_boards import (
    MODEL,
    PATTERN,
    SIZE,
    find_pattern,
    pixels_of,
    pose_of,
    score,
    view_poses,
)
from shared import campaign

from lrfcal_lib.evaluate.stereo import stereo_reference
from lrfcal_lib.model.board import Chessboard
from lrfcal_lib.preprocess.board_in_image import BoardView
from lrfcal_lib.preprocess.intrinsics import board_pose, estimate_intrinsics
from lrfcal_lib.preprocess.prepared import Prepared


def stereo(first, second, pattern=PATTERN, models=(MODEL, MODEL)):
    """The mounting of two cameras from the corners that they see at placements 0, 1, ..., and its covariance."""
    printed = pattern or PATTERN
    views = [
        {
            p: BoardView(pixels=own, T_camera_board=board_pose(own, printed, model)[0])
            for p, own in enumerate(seen)
        }
        for seen, model in zip((first, second), models, strict=True)
    ]
    views, models = (dict(enumerate(each)) for each in (views, models))
    board = SimpleNamespace(pattern=pattern)
    reference = stereo_reference(Prepared(None, board, {}, models, views))
    return reference.T_second_first, reference.covariance


def test_stereo_reference_recovers_the_mounting_and_its_covariance_tells_the_error():
    poses = view_poses(6, seed=8)
    mount = pose_of(0.02, (0.01, -0.02), (-0.12, 0.002, 0.004), (0, 0))
    chi2 = []
    for seed in range(16):
        first = pixels_of(poses, 0.2, 2 * seed)
        second = pixels_of([mount * p for p in poses], 0.2, 2 * seed + 1)
        chi2.append(score(*stereo(first, second), mount))
    assert 0.6 < np.mean(chi2) < 1.5
    with pytest.raises(ValueError, match="no placement shows the pattern to both cameras"):
        stereo(first, [])
    with pytest.raises(ValueError, match="needs two cameras and a pattern"):
        stereo(first, first, pattern=None)


def test_real_stereo(lms400):
    reference = stereo_reference(lms400.prepared)
    refined = reference.T_second_first
    covariance = reference.covariance
    # shape-free bundle of an independent analysis, with its own uncertainty
    off = np.r_[np.rad2deg(refined.rotation.as_rotvec()), 1000 * refined.translation]
    sigma = np.sqrt(np.diag(covariance)) * np.repeat([np.rad2deg(1), 1000], 3)
    off -= [0.457, 0.479, -0.025, -120.0, -0.3, -0.8]
    assert np.all(
        np.abs(off) < 3 * np.hypot(sigma, [0.017, 0.038, 0.007, 0.36, 0.14, 0.90])
    )


@campaign
def test_opencv_stereo_pairs(real_data):
    folder = real_data / "opencv_stereo13"
    pattern = Chessboard(9, 6, 0.025)
    corners = []
    models = []
    for camera, rms in (("left", 0.4087), ("right", 0.4586)):
        files = [folder / f"{camera}{i:02d}.jpg" for i in range(1, 15) if i != 10]
        corners.append([find_pattern(cv2.imread(str(file)), pattern) for file in files])
        result = estimate_intrinsics(corners[-1], pattern, SIZE)
        assert result.models[0].rms_px < rms
        models += result.models
    # turned by 180 deg a chessboard looks the same: counted from the same end in both images
    ways = [[seen[-1] - seen[0] for seen in of_camera] for of_camera in corners]
    same = np.vecdot(*ways) > 0
    corners[1] = [b if way else b[::-1] for b, way in zip(corners[1], same, strict=True)]
    assert models[0].fx == pytest.approx(535.9, abs=4)
    transform, _ = stereo(*corners, pattern, models)
    # along the axis the pairs tell little: the detectors of OpenCV alone move it by 1 mm
    assert np.all(
        np.abs(1000 * transform.translation - [-83.606, 1.043, 1.324]) < [0.8, 0.3, 2.2]
    )
