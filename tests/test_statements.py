"""What the data contradict of what is stated."""

from types import SimpleNamespace

import numpy as np
import pytest

from lrfcal_lib.judge import statements
from lrfcal_lib.judge.findings import ANSWERS
from lrfcal_lib.model.board import triangle_board
from lrfcal_lib.session.stated import LrfInfo


@pytest.mark.parametrize(
    ("offset", "sigma", "answers"),
    [
        (-5.2, 2.2, []),
        (9, 2, []),
        (11, 2, ["with care"]),
        (-87, 3.9, ["no"]),
        (68, 14, ["no"]),
        (30, 14, []),
    ],
)
def test_a_range_offset_that_no_maker_admits(monkeypatch, offset, sigma, answers):
    """Millimetres; of as much of a joint calibration as tells it. By as much all ranges may be wrong."""
    monkeypatch.setattr(statements, "doubtful", lambda *arguments, **options: [])
    seen = SimpleNamespace(face_range=np.array([2.0]))
    sensor = {"range_offset": offset / 1000, "pitch_scale": 0.0}
    level = {
        "converged": True,
        "noise": {"face_scale": 1.0},
        "sigma": {"range_offset": sigma / 1000},
    }
    solution = SimpleNamespace(
        sensor=sensor, observations=seen, transforms={}, boards={}, edge_bias=0.0, **level
    )
    prepared = SimpleNamespace(
        session=SimpleNamespace(
            lrf=LrfInfo("SICK LMS400", (0.9, 2.2), 0.002, 0.005, systematic_error=0.004),
            T_head_lrf=None,
            cameras={},
            board=triangle_board(),
        ),
        board=triangle_board(),
    )
    found, doubt = statements.contradicts_stated(
        SimpleNamespace(solution=solution, prepared=prepared)
    )
    assert [ANSWERS[reason.severe] for reason in found] == answers
    assert doubt == (abs(offset) / 1000 if found else 0.0)
    assert all(
        "board" in r.words and "squares" in r.words and f"{offset} mm" in r.words
        for r in found
    )
