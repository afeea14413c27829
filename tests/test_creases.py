"""Creases against edges of images: a slip of the head is begun with where it explains more at both widths."""

import numpy as np
import pytest
from holds_draws import ROOM, on_base, true_rig

from lrfcal_lib.measure.creases import SCANNED, WIDTHS, Sights, creases_pulls
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


@pytest.mark.parametrize(
    ("near", "slipped"), [(0.0, False), (0.4 * SCANNED, False), (3 * SCANNED, True)]
)
def test_a_slip_must_explain_more_in_reach_of_a_calibration_that_holds(near, slipped):
    """Edges that lie beside creases by what an honest calibration errs are not outdone by sharper ones afar."""
    rig = on_base(true_rig(open_session(ROOM)), 0.0)
    sides = near * np.where(np.arange(PLACES) % 2, 1.0, -1.0)
    afar = 40.0 * SLIP + np.random.default_rng(4).normal(0, WIDTHS[-1] / 8, PLACES)
    sights = sights_of(rig, np.stack([sides, afar], axis=1))
    pulls = creases_pulls({"left": [sights], "right": [sights]}, rig)
    head = suspects(pulls, rig)[-1]
    assert head.camera is None and (abs(head.change[0]) > SLIP / 2) == slipped
