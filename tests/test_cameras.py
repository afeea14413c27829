"""Platform and cameras from arrays: combining axes, an axis that nothing tells."""

from dataclasses import fields

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.calibrate.cameras import (
    KnownAxis,
    calibrate_platform,
    combine,
    stated_covariance,
)
from lrfcal_lib.fit.axis_chart import chart_parameters
from lrfcal_lib.fit.result import Solution
from lrfcal_lib.model.geometry import axis_difference, axis_of, pose_array
from lrfcal_lib.model.observations import PlatformObservations

SIGMA = (np.radians(0.5), 0.010)
STATED = stated_covariance(SIGMA)


def head(seed):
    rng = np.random.default_rng(seed)
    return RigidTransform.from_components(
        rng.normal(0, 0.1, 3), Rotation.from_rotvec(rng.normal(0, 0.05, 3))
    )


def apart(one, other):
    """Angle and offset between two axes, the larger one; radians, metres."""
    return max(axis_difference(axis_of(one), axis_of(other)))


UNKNOWN = np.full((4, 4), np.nan)


def estimate(T_head_lrf, covariance, scatter=UNKNOWN):
    inner = dict.fromkeys(field.name for field in fields(Solution))
    inner |= {
        "parameters": chart_parameters(pose_array(T_head_lrf)),
        "covariance": covariance,
        "n_placements": 20,
    }
    return KnownAxis(
        T_head_lrf, Solution(**inner | {"covariance_placements": scatter}).trusted
    )


@pytest.mark.parametrize(("scale", "scatter", "wins"), [
    (1e-8, UNKNOWN, head(2)),
    (1e8, UNKNOWN, head(1)),
    (1e8, 1e-8 * STATED, head(1)),  # placements that agree by chance do not outweigh the stated axis
])  # fmt: skip
def test_the_better_known_axis_wins(scale, scatter, wins):
    combined = combine(
        estimate(head(2), scale * STATED, scatter), KnownAxis(head(1), STATED)
    )
    assert apart(combined.T_head_lrf, wins) < 1e-6
    assert (np.diag(combined.covariance) <= np.diag(STATED) * (1 + 1e-9)).all()


def test_an_axis_that_nothing_tells_is_assumed_and_named_so():
    nothing = dict.fromkeys(("last_beam", "half_step"), PlatformObservations())
    platform = calibrate_platform(nothing)
    assert not platform.solutions and list(platform.axes) == ["combined"]
    assert np.allclose(platform.transform("combined").as_matrix(), np.eye(4))
    assert "neither stated nor determined" in platform.why_not("combined")
    stated = calibrate_platform(nothing, head(1), SIGMA)
    assert (
        stated.why_not("combined") == ""
        and stated.axes["combined"] is stated.axes["stated"]
    )
