"""Planes, points and lengths of a scanned cloud."""

import numpy as np
import pytest

from lrfcal_lib.calibrate import clouds
from lrfcal_lib.measure.features import fit_feature, length_between
from lrfcal_lib.model.geometry import DegenerateGeometry


def test_lengths_between_features_know_how_good_they_are(quick):
    """Two halves of one face are no distance apart across it, and half a board along it."""
    cloud = clouds.color_cloud(quick, "joint")
    rig = quick.rig("joint")
    offs = []
    for placement in np.unique(cloud.placement):
        rows = np.flatnonzero(cloud.placement == placement)
        x = cloud.points[rows, 0]
        left = rows[x < np.median(x)]
        right = rows[x >= np.median(x)]
        planes = [fit_feature(cloud, half, rig) for half in (left, right)]
        between = length_between(fit_feature(cloud, rows, rig), planes[0])
        offs.append(between.metres / between.sigma)
        points = [fit_feature(cloud, half, rig, plane=False) for half in (left, right)]
        between = length_between(*points)
        straight = np.linalg.norm(points[1].centre - points[0].centre)
        assert between.metres == pytest.approx(straight) and 0 < between.sigma < 0.01
        between = length_between(points[0], planes[1])
        assert between.metres < 5 * between.sigma
    assert 0.1 < np.sqrt(np.mean(np.square(offs))) < 3
    with pytest.raises(DegenerateGeometry, match="no point"):
        fit_feature(cloud, [], rig)
