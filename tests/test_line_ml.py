"""The line method by likelihood: against half steps and planes in Monte-Carlo trials, bias, bad input."""

import numpy as np
import pandas as pd
import pytest
from notebook_runs import GOLDEN

from lrfcal_lib.simulate.draw import ShotSetup, draw_shots

BIASES = (-0.5, -0.25, 0.0, 0.25, 0.5)


@pytest.fixture(scope="module", params=[0.25, 0.5])
def errors(request):
    """Medians by bias and method at one beam spacing, of the draws of notebook 08."""
    table = pd.read_csv(GOLDEN / "sim_lms221" / "single_shots.csv").query(f"step_deg == {request.param}")
    assert tuple(sorted(set(table.bias))) == BIASES
    return table.pivot(index="bias", columns="method")


def test_better_than_any_rule_for_the_edge_point_when_the_bias_is_unknown(errors):
    rotation = errors.rotation_median_deg
    best = rotation[["line_last_beam", "line"]].min(axis=1)
    assert (rotation.line_ml < 1.1 * best).all() and 1.3 * rotation.line_ml.mean() < best.mean()


def test_better_than_planes(errors):
    for column, factor in (("rotation_median_deg", 3), ("translation_median_mm", 2)):
        assert errors[column].zhang_pless.mean() > factor * errors[column].line_ml.mean()


def test_the_bias_is_found_and_its_uncertainty_is_not_played_down(errors):
    assert (errors.bias_error.line_ml < 0.05).all() and errors.nees.line_ml.mean() < 1.2


def test_boards_that_cannot_be_drawn_are_refused():
    with pytest.raises(ValueError, match="hardly ever"):
        draw_shots(ShotSetup(distances=(40.0, 41.0), step=np.radians(1.0)), np.random.default_rng(0), 2, 2)
