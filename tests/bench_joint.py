"""Consistency of the joint estimate: errors against their bound in a hundred drawn recordings; by ``make bench``."""

import numpy as np
from joint_draws import draw

from lrfcal_lib.evaluate.monte_carlo import consistency, monte_carlo
from lrfcal_lib.fit.residuals import LEAST_STEP
from lrfcal_lib.solvers.joint import solve_joint


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
    trials()
