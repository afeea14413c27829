"""A sweep that ends with a scan back in its first half tells whether the rig stood still."""

import numpy as np
import pytest

from lrfcal_lib.preprocess.closing_scan import closing_of, without_closing
from lrfcal_lib.session.read import Sweep

BEARINGS = np.radians(np.arange(40, 140.1, 0.5))


def ranges_at(pitch, yaw=0.0, shift=0.0):
    """Ranges (l, b) to the walls, floor and ceiling of a box of 4 x 6 x 2.4 m, from inside it."""
    bearing = BEARINGS + yaw
    across = np.cos(bearing) * np.ones_like(pitch)[:, None]
    ahead = np.sin(bearing) * np.cos(pitch)[:, None]
    up = np.sin(bearing) * np.sin(pitch)[:, None]
    ahead = np.maximum(ahead, 1e-9)
    with np.errstate(divide="ignore"):
        walls = [2.0 / np.abs(across), (3.0 - shift) / ahead, 1.2 / np.abs(up)]
    return np.minimum.reduce(walls)


def sweep(first=-25.0, last=15.0, play=0.0, noise=0.01, seed=0, step=0.5, **moved):
    """A sweep with its closing scan, degrees; the head comes back off by `play`."""
    pitch = np.arange(first, last, np.copysign(step, last - first))
    half = pitch[: len(pitch) // 2 + 1]
    told = np.radians([*pitch, half[np.argmin(np.abs(half))]])
    ranges = ranges_at(told[:-1])
    closing = ranges_at(told[-1:] + np.radians(play), **moved)
    ranges = np.concatenate([ranges, closing])
    ranges += np.random.default_rng(seed).normal(0, noise, ranges.shape)
    return Sweep(1, ranges, BEARINGS, told, np.arange(len(told), dtype=float))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
@pytest.mark.parametrize("play", [0.0, 0.1, 0.4, 0.9])
@pytest.mark.parametrize("step", [0.25, 0.5, 2.0])
def test_a_rig_that_stands_still_is_not_accused(seed, noise, play, step):
    options = {"noise": noise, "seed": seed, "step": step}
    assert not closing_of(sweep(play=play, **options)).moved
    assert not closing_of(sweep(15, -25, play=-play, **options)).moved


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("moved", [{"yaw": np.radians(3)}, {"shift": 0.1}], ids=str)
def test_one_that_moved_is(seed, moved):
    assert closing_of(sweep(15.0, -25.0, seed=seed, **moved)).moved


def test_the_closing_scan_is_no_part_of_the_sweep():
    whole = sweep()
    main, closing = without_closing(whole)
    assert len(main.pitch) == len(whole.pitch) - 1 and len(closing.pitch) == 1
    np.testing.assert_array_equal(main.ranges, whole.ranges[:-1])
    assert closing.pitch[0] == whole.pitch[-1]


def test_what_closes_nothing_stays_whole():
    up = without_closing(sweep())[0]
    both = np.r_[up.pitch, up.pitch[::-1]]
    twice = Sweep(
        1, np.tile(up.ranges, (2, 1)), BEARINGS, both, np.arange(len(both), dtype=float)
    )
    at_rest = Sweep(1, up.ranges, BEARINGS, 0 * up.pitch, up.time_s)
    for other in (up, twice, at_rest):
        assert without_closing(other) == (other, None) and closing_of(other) is None
