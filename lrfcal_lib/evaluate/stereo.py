"""Two cameras, calibrated apart, beside the chessboard that both see."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.geometry import length_of, transform_difference
from lrfcal_lib.preprocess.bundle import LENS, adjust_robust
from lrfcal_lib.preprocess.intrinsics import K5
from lrfcal_lib.preprocess.prepared import Prepared
from lrfcal_lib.solvers import METHODS


@dataclass(frozen=True)
class StereoReference:
    """Relative pose of two cameras.

    Attributes
    ----------
    cameras : (str, str)
        First and second.
    T_second_first : RigidTransform
    covariance : ndarray, shape (6, 6)
        Of ``[w, v]``, radians and metres.
    """

    cameras: tuple[str, str]
    T_second_first: RigidTransform
    covariance: np.ndarray


def stereo_reference(prepared: Prepared) -> StereoReference:
    """Relative pose of the first two cameras from the chessboard in both images: the best knowledge
    of the mounting.

    The intrinsics of both are estimated along, and the shape of a wavy sheet.

    Parameters
    ----------
    prepared : Prepared

    Returns
    -------
    StereoReference

    Raises
    ------
    ValueError
        With fewer than two cameras, without a pattern, or when no placement is seen by both.
    """
    pattern = prepared.board.pattern
    if len(prepared.views) < 2 or pattern is None:
        raise ValueError(
            f"a stereo reference needs two cameras and a pattern, got {len(prepared.views)} cameras"
        )
    pair = tuple(prepared.views)[:2]
    shown = list(map(prepared.patterned, pair))
    common = sorted(shown[0].keys() & shown[1].keys())
    if not common:
        raise ValueError(
            "no placement shows the pattern to both cameras: the stereo check needs at least one"
        )
    models = [prepared.models[camera] for camera in pair]
    pixels = np.array([[of_camera[p].pixels for p in common] for of_camera in shown])
    poses = [
        RigidTransform.concatenate([of_camera[p].T_camera_board for p in common])
        for of_camera in shown
    ]
    rough = (poses[1] * poses[0].inv()).mean()
    lens = K5
    if any(model.distortion[4] for model in models):
        lens = LENS
    adjusted = adjust_robust(
        pixels,
        pattern.points(),
        models,
        poses[0],
        RigidTransform.concatenate([RigidTransform.identity(), rough]),
        lens=lens,
        wavy=np.any(prepared.relief),
    )
    return StereoReference(pair, adjusted.mounting[1], adjusted.mounting_covariance[0])


def stereo_check(solutions: dict, reference: StereoReference) -> pd.DataFrame:
    """What two cameras, calibrated apart, say about each other, against the chessboard in both.

    Parameters
    ----------
    solutions : dict of (str, str) to Solution
        By camera and method.
    reference : StereoReference

    Returns
    -------
    DataFrame
        Columns method, baseline_mm, baseline_error_mm, translation_error_mm, rotation_error_deg.
        Both calibrations use the same LRF points, so the check cannot see an error of the cloud.
    """
    rows = []
    baseline = length_of(reference.T_second_first.translation)
    for method in (*METHODS, "joint"):
        both = [
            solutions[camera, method].transform
            for camera in reference.cameras
            if (camera, method) in solutions
        ]
        if len(both) < 2:
            continue
        between = both[1] * both[0].inv()
        turn, shift = transform_difference(between, reference.T_second_first)
        length = length_of(between.translation)
        off = length - baseline
        rows.append((method, 1000 * length, 1000 * off, 1000 * shift, np.rad2deg(turn)))
    columns = [
        "method",
        "baseline_mm",
        "baseline_error_mm",
        "translation_error_mm",
        "rotation_error_deg",
    ]
    return pd.DataFrame(rows, columns=columns)
