"""Naming sides, placements left out: the parts of the chain that need no recording."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from lrfcal_lib.calibrate import pipeline
from lrfcal_lib.calibrate.naming import nearest_edges
from lrfcal_lib.model.board import triangle_board
from lrfcal_lib.model.problem import Problem, ProblemKind, Stage
from lrfcal_lib.preprocess.prepared import Prepared

BOARD = triangle_board()


def side(edge, n=20, shift=0.0, turn_deg=0.0):
    """Board-frame points on an edge, moved outwards and turned about its middle."""
    i = BOARD.edges.index(edge)
    a = BOARD.corners[i]
    b = BOARD.corners[(i + 1) % len(BOARD.edges)]
    turn = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()[:2, :2]
    points = (
        (a + b) / 2
        + np.linspace(-0.4, 0.4, n)[:, None] * (turn @ (b - a))
        + shift * BOARD.lines()[i, :2]
    )
    return np.column_stack([points, np.zeros(n)])


def test_sides_are_named_after_the_nearest_edge():
    sides = {4: side("bc", shift=0.01), 7: side("ab", shift=-0.01), 9: side("ca")}
    assert nearest_edges(BOARD, sides) == ({4: "bc", 7: "ab", 9: "ca"}, {})
    names, _ = nearest_edges(BOARD, {0: side("ab"), 1: side("ab", shift=0.02)})
    assert list(names.values()).count("ab") == 1, "two sides do not share an edge"


def test_far_and_crooked_sides_stay_unnamed_with_a_reason():
    names, dropped = nearest_edges(
        BOARD, {0: side("ab", turn_deg=5), 1: side("bc", shift=0.2)}
    )
    assert names == {} and [dropped[number].edge for number in (0, 1)] == ["ab", "bc"]
    assert (
        "turned by 5.0 deg" in dropped[0].words
        and "200 mm from the edge 'bc'" in dropped[1].words
    )


def test_placements_with_a_problem_are_left_out_of_everything_but_the_images():
    ready = Prepared(
        None,
        None,
        {1: "a", 2: "b"},
        views={"left": {1: "v", 2: "v"}},
    )
    whole = Problem(Stage.SIDES, ProblemKind.OTHER_PLANE, "off", placement=2)
    part = Problem(
        Stage.SIDES, ProblemKind.OTHER_SIDE, "a side, not a placement", placement=1
    )
    ready = replace(ready, problems=(whole, part))
    left = pipeline.without(ready)
    assert list(left.scans) == [1]
    assert list(left.views["left"]) == [1, 2]
