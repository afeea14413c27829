"""Creases against edges of images: a slip of the head is begun with where it explains more than chance finds."""

import numpy as np
import pytest
from holds_draws import ROOM, on_base, true_rig

from lrfcal_lib.measure.creases import WIDTHS, Sights, creases_pulls
from lrfcal_lib.measure.holds import suspects
from lrfcal_lib.session.read import open_session

SLIP = np.radians(0.4)
PLACES = 8  # one of each crease


def sights_of(rig, offsets):
    """Places that move with pose and pitch as they like, whose images have edges so far off, (n, k)."""
    rng = np.random.default_rng(3)
    by_unknown = rng.normal(0, 10.0, (PLACES, len(rig.uncertainty.names) + 1))
    by_unknown[:, -1] = 40.0  # 1 deg is 0.7 of the reach
    clear = np.full(offsets.shape, 0.9)
    return Sights(by_unknown, offsets, clear, np.arange(PLACES))


def heard(rig, sights):
    """By how much the head slipped as creases say, radians; None where cameras on the base are not heard."""
    pulls = creases_pulls({"left": [sights], "right": [sights]}, rig)
    return suspects(pulls, rig)[-1].change[0] if pulls else None


@pytest.mark.parametrize(
    ("near", "slip"), [(0.0, 0.0), (0.5 * WIDTHS[-1], None), (5 * WIDTHS[-1], SLIP)]
)
def test_a_slip_must_explain_more_than_edges_beside_creases(near, slip):
    """Where edges lie beside creases by what an honest calibration errs, and better ones afar, nothing is said."""
    rig = on_base(true_rig(open_session(ROOM)), 0.0)
    sides = near * np.where(np.arange(PLACES) % 2, 1.0, -1.0)
    afar = 40.0 * SLIP + np.random.default_rng(4).normal(0, WIDTHS[-1] / 8, PLACES)
    said = heard(rig, sights_of(rig, np.stack([sides, afar], axis=1)))
    assert (said is None) == (slip is None)
    assert slip is None or abs(said - slip) < SLIP / 5


def test_cameras_on_the_head_are_heard_whatever_a_slip_explains():
    rig = true_rig(open_session(ROOM))
    sights = sights_of(rig, np.full((PLACES, 1), 40.0 * SLIP))
    assert len(creases_pulls({"left": [sights], "right": [sights]}, rig)) == 2
