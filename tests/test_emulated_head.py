"""How the emulated head moves."""

import numpy as np

from lrfcal_lib.emulators.head import REACT_S, Head
from lrfcal_lib.simulate.rig import Platform


def test_play_of_the_gear_and_stretch():
    head = Head(Platform(backlash=0.01, stretch=0.02, settle=0.0))
    head.move(1.0, 0.5, 0.1)
    t = np.linspace(1.0, 4.0, 200)
    motor = np.clip(0.1 * (t - 1.0 - REACT_S), 0.0, 0.5)
    assert np.allclose(head.pitch(t), np.maximum(1.02 * motor - 0.005, 0.0), atol=1e-12)
    head.move(4.0, 0.0, 0.1)
    turning = head.pitch(np.linspace(4.0 + REACT_S, 5.0, 300))
    assert np.count_nonzero(np.abs(np.diff(turning)) < 1e-12) > 20  # the play, then down
    assert np.all(np.diff(turning) <= 0) and np.ptp(turning) > 0.05
