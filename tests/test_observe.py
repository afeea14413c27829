"""Observations drawn from noise models: exact where noise is off, as noisy as they say where it is on."""

from dataclasses import replace

import numpy as np
import pytest
from joint_draws import MOUNTS, draw, rng

from lrfcal_lib.fit.least_squares import whiten
from lrfcal_lib.fit.residuals import Unknowns, gather, named_blocks


@MOUNTS
def test_noise_is_what_is_stated(mount):
    """Whitened residuals at the truth have unit variance: ranges within 3 %, views within 10 %."""
    obs, truth, _ = draw(rng(0), 40, mount=mount)
    data = gather(obs)
    blocks = named_blocks(truth, data, Unknowns(2, 3))
    face = whiten(blocks["face"], False)[0][data.face["used"]]
    view = whiten(blocks["view"], False)[0]
    assert np.mean(face**2) == pytest.approx(1, abs=0.1) and abs(np.mean(face)) < 0.1
    assert np.mean(view**2) == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize("bias", [-0.5, 0.0, 0.5])
def test_beams_flip_where_the_bias_says(bias):
    """Read beams lie inside the shifted edge, missed ones outside, but for the softness."""
    obs, truth, rig = draw(rng(0), 10, bias=bias, softness=0.05)
    data = gather(obs)
    chance = {
        hit: np.exp(-named_blocks(truth, replace(data, beam=data.beam | {"hit": np.full_like(data.beam["hit"], hit)}),
                                  Unknowns(2, 3))["beam"].cost)
        for hit in (True, False)
    }  # fmt: skip
    used, hit = data.beam["used"], data.beam["hit"]
    assert np.allclose((chance[True] + chance[False])[used], 1.0)
    expected, spread = chance[True][used].sum(), np.sqrt((chance[True] * chance[False])[used].sum())
    assert abs(hit[used].sum() - expected) < 4 * spread + 1
    certain = np.where(hit, chance[True], chance[False])[used]
    assert np.mean(certain > 0.5) > 0.95


def test_single_shots_and_images():
    obs, *_ = draw(rng(0), 4, see_span=0.0, see_images=1)
    assert set(obs.direction) == {0} and len(obs.view_pitch) == 8
    for p in range(4):
        mine = obs.face_placement == p
        assert len(np.unique(obs.face_pitch[mine])) == 1
        assert np.allclose(obs.view_pitch[obs.view_placement == p], obs.face_pitch[mine][0])
    assert draw(rng(0), 3, see_images=0)[0].view_pose.shape == (0, 4, 4)
    assert set(draw(rng(0), 3)[0].direction) == {-1, 1}


def test_one_seed_gives_one_draw():
    one, two, other = (draw(rng(seed), 3)[0] for seed in (1, 1, 2))
    assert np.array_equal(one.face_range, two.face_range) and np.array_equal(one.beam_hit, two.beam_hit)
    assert len(one.face_range) != len(other.face_range) or not np.array_equal(one.face_range, other.face_range)
