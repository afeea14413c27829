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
