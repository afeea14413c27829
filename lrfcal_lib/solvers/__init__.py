"""Calibration methods on one least-squares core: the same observations in, a `Solution` out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from lrfcal_lib.geometry import DegenerateGeometry
from lrfcal_lib.solvers.bauermann import solve_bauermann
from lrfcal_lib.solvers.camera import edge_residuals_px, plane_residuals_m, solve_lines, solve_paper_lines
from lrfcal_lib.solvers.line_ml import edge_bias, solve_line_ml
from lrfcal_lib.solvers.outliers import find_outlying_placements
from lrfcal_lib.solvers.pitch_errors import SweepPoints, estimate_pitch_errors
from lrfcal_lib.solvers.platform import PlatformObservations, PlatformPrior, PlatformSolution, solve_platform
from lrfcal_lib.solvers.projected import solve_projected
from lrfcal_lib.solvers.solution import Solution
from lrfcal_lib.solvers.start import starting_transform
from lrfcal_lib.solvers.wasielewski_strauss import solve_wasielewski_strauss
from lrfcal_lib.solvers.zhang_pless import solve_zhang_pless, solve_zhang_pless_joint


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

__all__ = [
    "METHODS",
    "DegenerateGeometry",
    "Method",
    "PlatformObservations",
    "PlatformPrior",
    "PlatformSolution",
    "Solution",
    "SweepPoints",
    "edge_bias",
    "edge_residuals_px",
    "estimate_pitch_errors",
    "find_outlying_placements",
    "plane_residuals_m",
    "solve_bauermann",
    "solve_line_ml",
    "solve_lines",
    "solve_paper_lines",
    "solve_platform",
    "solve_projected",
    "solve_wasielewski_strauss",
    "solve_zhang_pless",
    "solve_zhang_pless_joint",
    "starting_transform",
]
