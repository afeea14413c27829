"""Straight edges in an image."""

import numpy as np
from rendered_boards import CORNERS, MODEL, on_board, pose_of, render, true_line

from lrfcal_lib.model.camera import line_distance
from lrfcal_lib.preprocess import edges_in_image
from lrfcal_lib.preprocess.edges_in_image import refine_edge


def test_line_covariance_tells_the_error_over_noise():
    pose = pose_of(0.2)
    scores = []
    clean = render(pose, noise=0.0).astype(float)
    exact = true_line("top", pose)
    start, end = (
        e - line_distance(e, exact) * exact[:2]
        for e in on_board(pose, CORNERS[[0, 1]] * 0.9)
    )
    for seed in range(40):
        noisy = np.clip(
            clean + np.random.default_rng(seed).normal(0, 18, clean.shape), 0, 255
        )
        edge = refine_edge(
            np.rint(noisy).astype(np.uint8), MODEL, "top", start, end, exact[:2], 6.0
        )
        # what the covariance says beyond the fixed systematic part
        length = np.linalg.norm(edge.ends[1] - edge.ends[0])
        variance = np.diag(edge.covariance) - edges_in_image.SYSTEMATIC_PX**2 * np.array(
            [1, 12 / length**2]
        )
        turn = np.arctan2(
            exact[0] * edge.line[1] - exact[1] * edge.line[0], exact[:2] @ edge.line[:2]
        )
        scores.append(np.array([line_distance(edge.centre, exact), turn]) ** 2 / variance)
    assert np.all(np.abs(np.sqrt(np.mean(scores, axis=0)) - 1) < 0.35)
