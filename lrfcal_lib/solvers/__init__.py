"""Calibration methods on one least-squares core: the same observations in, a `Solution` out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from lrfcal_lib.fit.result import Solution
from lrfcal_lib.solvers.lines import (
    solve_bauermann,
    solve_line_ml,
    solve_lines,
    solve_paper_lines,
    solve_wasielewski_strauss,
)
from lrfcal_lib.solvers.planes import solve_zhang_pless, solve_zhang_pless_joint


@dataclass(frozen=True)
class Method:
    """A camera calibration method.

    Attributes
    ----------
    variant : str
        The edge-point rule its observations are made with ('half_step' or 'last_beam').
    solve : callable
        ``solve(obs, T0=None, **options) -> Solution``.
    uses : str
        What it needs of the observations: 'crossing', 'plane' or 'scene'.
    label : str
        For tables and figures.
    """

    variant: str
    solve: Callable[..., Solution]
    uses: str
    label: str


METHODS = {
    "line_last_beam": Method("last_beam", solve_paper_lines, "crossing", "lines, last beam (the paper)"),
    "line": Method("half_step", solve_lines, "crossing", "lines, half step"),
    "line_ml": Method("half_step", solve_line_ml, "crossing", "lines, likelihood"),
    "zhang_pless": Method("half_step", solve_zhang_pless, "plane", "Zhang-Pless"),
    "zhang_pless_joint": Method("half_step", solve_zhang_pless_joint, "plane", "Zhang-Pless with intrinsics"),
    "wasielewski_strauss": Method("half_step", solve_wasielewski_strauss, "crossing", "Wasielewski-Strauss"),
    "bauermann": Method("half_step", solve_bauermann, "scene", "Bauermann"),
}
