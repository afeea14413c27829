"""Gauss-Newton as notebook 03 derives it; solvers use :mod:`lrfcal_lib.fit.least_squares`."""

from collections.abc import Callable
from typing import Any

import numpy as np

SMALL = 1e-6  # of the differences that stand for derivatives: radians, metres
STEPS = 40


def gauss_newton(
    residuals: Callable[[Any], np.ndarray],
    move: Callable[[Any, np.ndarray], Any],
    x: Any,
    size: int,
    stop: float = 1e-6,
) -> tuple[Any, np.ndarray]:
    """Make the sum of squares of some residuals small.

    The derivatives come from differences. A step that makes the sum larger is halved.

    Parameters
    ----------
    residuals
        Of a state, shape (m,).
    move
        The state after a step, shape (size,).
    x
        The state to start from.
    size
        Number of unknowns.
    stop
        No entry of the last step is larger.

    Returns
    -------
    x
        The state at the end.
    path : shape (steps, 1 + size)
        Half the sum of squares before each step, and the step.
    """
    path = []
    for _ in range(STEPS):
        r = residuals(x)
        differences = [
            residuals(move(x, d)) - residuals(move(x, -d)) for d in SMALL * np.eye(size)
        ]
        J = np.stack(differences, axis=1) / (2 * SMALL)
        step = np.linalg.lstsq(J, -r)[0]
        cost = np.sum(r**2) / 2
        while (
            np.sum(residuals(move(x, step)) ** 2) / 2 > cost and np.abs(step).max() > stop
        ):
            step = step / 2
        path.append([cost, *step])
        x = move(x, step)
        if np.abs(step).max() < stop:
            break
    return x, np.array(path)
