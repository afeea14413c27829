"""Start values lead to the minimum that explains the data best, in parts of a recording and with scans exchanged."""

import numpy as np
import pytest
from joint_draws import rng
from near_scanner import as_rig, near_scanner, with_scans_exchanged
from shared import campaign

from lrfcal_lib.fit.residuals import plane_residuals_m
from lrfcal_lib.model.geometry import transform_difference
from lrfcal_lib.solvers import solve_camera
from lrfcal_lib.solvers.joint import solve_joint
from lrfcal_lib.solvers.plane_start import sizes_of_minima

LEAN = 0.35  # radians


def rms(obs, solution):
    return np.sqrt(np.mean(plane_residuals_m(obs, solution.transform) ** 2))


@pytest.mark.parametrize(
    ("seed", "placements", "parts"),
    [
        (12, 8, 23),
        *(pytest.param(seed, n, 40, marks=campaign) for seed in range(4) for n in (9, 10)),
    ],
)
def test_parts_of_a_recording_end_in_the_minimum_that_explains_them_best(
    seed, placements, parts
):
    T_camera_lrf, obs = near_scanner(rng(seed), LEAN)
    chance = rng(seed)
    for _ in range(parts):
        part = obs.select(chance.permutation(obs.placements)[:placements])
        known = solve_camera(part, "zhang_pless", T_camera_lrf, search=False)
        assert rms(part, solve_camera(part, "zhang_pless")) < 1.01 * rms(part, known)


@pytest.mark.parametrize(
    ("seed", "times"),
    [(4, 1), *(pytest.param(seed, 6, marks=campaign) for seed in (0, 1, 4))],
)
def test_four_of_nineteen_scans_exchanged_are_left_out(seed, times):
    T_camera_lrf, obs = near_scanner(rng(seed), LEAN)
    chance = rng(seed)
    for _ in range(times):
        mixed = as_rig(with_scans_exchanged(obs, chance))
        found = solve_joint(
            mixed,
            required=False,
            axis=False,
            sensor=("range_offset",),
            noise="estimate",
            lapse=0.01,
        )
        assert transform_difference(found.transforms["camera"], T_camera_lrf)[
            0
        ] < np.radians(2.0)
        assert 3 <= len(found.excluded) <= 4


def test_half_of_the_data_do_not_decide_alone():
    """The first minimum fits two of five placements perfectly, the second all but one; the median prefers the first."""
    misses = np.array(
        [[0.001, 0.001, 0.003, 0.03, 0.03], [0.004, 0.004, 0.004, 0.004, 0.03]]
    )
    assert np.median(misses, axis=1).argmin() == 0
    assert sizes_of_minima(misses**2).argmin() == 1
