"""Section II: what a distance to a point, a line or a plane leaves of space."""

import numpy as np
import pytest

from lrfcal_lib.model import geometry


def test_the_papers_board_is_not_quite_right_angled():
    assert np.degrees(geometry.triangle_angle(3.0, 4.0, 5.0)) == pytest.approx(90.0)
    assert np.degrees(geometry.triangle_angle(0.315, 0.380, 0.491)) == pytest.approx(89.4, abs=0.05)
    with pytest.raises(ValueError, match="1.0, 1.0 and 3.0 make no triangle"):
        geometry.triangle_angle(1.0, 1.0, 3.0)
