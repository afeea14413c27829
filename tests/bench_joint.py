"""Speed and consistency of the joint estimate: alone, against scipy, and against its own bound.

Against scipy both solve the same residuals, ranges and views, from the same start value. Run with ``make bench``.
"""

import time

import numpy as np
import pandas as pd
from bench import seconds
from joint_draws import draw, none
from scipy.optimize import least_squares

from lrfcal_lib.evaluate.monte_carlo import consistency, monte_carlo
from lrfcal_lib.fit.least_squares import whiten
from lrfcal_lib.fit.residuals import LEAST_STEP, Unknowns, gather, joint_blocks, move_state
from lrfcal_lib.solvers.joint import converged, solve_joint
from lrfcal_lib.solvers.joint_start import start_states, thin

ROWS = {"face": 40, "beam": 30}


def problem(count):
    """A drawn session with so many rows of each group a placement, evenly picked."""
    obs, masks = draw(np.random.default_rng(0), count)[0], {}
    for name, most in ROWS.items():
        places = getattr(obs, f"{name}_placement")
        rows = np.concatenate([thin(np.flatnonzero(places == p), most) for p in range(count)])
        masks[name] = np.isin(np.arange(len(places)), rows)
    return obs.keep(**masks)


def whole(count=100):
    """The whole job."""
    obs = problem(count)
    what = f"joint estimate, start values included, {count} placements x 40 ranges, 30 beams, 6 views"
    yield what, 1000 * seconds(lambda: solve_joint(obs)), "ms", "", np.nan


def against_scipy(count=5):
    """The core against scipy's dense trust region with a numeric Jacobian, increments about the start value."""
    obs = none(problem(count), "beam")
    data, unknowns, start = gather(obs), Unknowns(2, 3, sensor=("range_offset",)), next(start_states(obs))[0]
    c = unknowns.shared

    def state_of(x):
        return move_state(start, (x[:c], x[c:].reshape(count, -1)), unknowns)

    def residuals(x):
        return np.concatenate([whiten(b, False)[0].ravel() for b in joint_blocks(state_of(x), data, unknowns)])

    core = seconds(lambda: converged(start, data, unknowns, 1e-4))
    begin = time.perf_counter()
    other = state_of(least_squares(residuals, np.zeros(c + count * unknowns.own), method="trf", x_scale="jac").x)
    theirs = time.perf_counter() - begin
    apart = np.abs(converged(start, data, unknowns, 1e-4).cameras - other.cameras).max()
    assert apart < 1e-5, "scipy and we end in different places"
    yield f"its core on ranges and views, {count} placements", 1000 * core, "ms", "scipy trf, numeric", theirs / core


def trials(count=100, placements=20, step_deg=0.5):
    """Errors against bound, coverage and normalised squared error at the paper's set-up, both mounts."""
    step = np.radians(step_deg)
    for mount in ("head", "platform"):
        result = monte_carlo(
            lambda rng, mount=mount: draw(rng, placements, mount=mount, pitch_step=step, floor=LEAST_STEP)[:2],
            lambda obs: solve_joint(obs, required=False),
            range(1000, 1000 + count),
        )
        print(f"\n{mount}, {placements} placements, {count} draws")
        shown = ["group", "unit", "rmse", "crb", "rmse_over_crb", "coverage", "nees", "nees_low", "nees_high", "failed"]
        print(consistency(result)[shown].round(3).to_string(index=False))


if __name__ == "__main__":
    rows = [row for part in (whole, against_scipy) for row in part()]
    columns = ["what", "value", "unit", "against", "times_faster"]
    print(pd.DataFrame(rows, columns=columns).round(2).to_string(index=False))
    trials()
