"""What to record next comes true."""

from dataclasses import replace

import numpy as np
import pytest
from test_weaknesses import rig_of, solve

from lrfcal_lib.judge.next_placement import Suggestion, group_sigma, suggest_placement
from lrfcal_lib.judge.verdict import verdict
from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.simulate.draw import bench, board_poses

NOWHERE = (0.0, 0.01)  # bearings, radians


@pytest.fixture(scope="module")
def good():
    rng = np.random.default_rng(1)
    rig = bench(rng)
    poses = board_poses(rng, 8)
    return rig, poses, solve(rig, poses, rng)


@pytest.fixture(scope="module")
def suggested(good):
    rig, _, solution = good
    return suggest_placement(solution, rig_of(solution, rig))


def test_the_suggested_placement_brings_what_it_promises(good, suggested):
    rig, poses, solution = good

    def with_board(pose, seed):
        """By how much one more placement really shrinks the uncertainty."""
        found = solve(rig, [*poses, pose], np.random.default_rng(seed))
        before, after = (group_sigma(s.solution.covariance, s) for s in (solution, found))
        return 1 - np.linalg.norm([*after.values()]) / np.linalg.norm([*before.values()])

    gain = with_board(suggested.T_platform_board, 5)
    assert gain > 0.8 * suggested.gain and 1 - gain == pytest.approx(
        1 - suggested.gain, rel=0.2
    )
    blind = [with_board(pose, 6) for pose in board_poses(np.random.default_rng(7), 5)]
    assert (
        gain > 1.2 * np.median(blind) and suggested.gain > 1.5 * suggested.median_gain > 0
    )


def test_suggestions_refuse_bad_input(good):
    rig, _, solution = good
    known = rig_of(solution, rig)
    blind = replace(known, lrf=replace(known.lrf, field_of_view=NOWHERE))
    with pytest.raises(
        DegenerateGeometry, match="none of .* board poses lies wholly in the view"
    ):
        suggest_placement(solution, blind)
    last = verdict(solution, blind).sentences()[-1]
    assert last.startswith("No placement can be suggested: none of")


def test_a_pitch_is_named_once():
    place = (1.0, -10, 0, 180, 0)
    near = Suggestion(None, place, np.radians([-6.1, -6.0, -5.9]), 0.1, 0.0)
    assert "; images at pitch -6 deg. " in near.sentence()
    far = Suggestion(None, place, np.radians([-10.0, 0.0, 10.0]), 0.1, 0.0)
    assert "; images at pitch -10, +0, +10 deg. " in far.sentence()
