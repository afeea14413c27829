"""Tables of the board's edges in the cloud: how far their points are off, how long they are."""

from contextlib import suppress
from itertools import product

import numpy as np
import pandas as pd
from scipy.spatial.transform import RigidTransform
from scipy.special import ndtri

from lrfcal_lib.calibrate.combined import combined_outlines
from lrfcal_lib.calibrate.observe import outline_of
from lrfcal_lib.calibrate.outline import MeasuredBoard
from lrfcal_lib.calibrate.pipeline import JointCalibration
from lrfcal_lib.evaluate.truth import Truth
from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.preprocess.edges_in_scan import VARIANTS
from lrfcal_lib.preprocess.prepared import Prepared

# Li et al. 2009, section V.A: stated and reconstructed edges of their board, millimetres
PAPER_EDGES_MM = {"ab": (315.0, 300.3633), "ca": (380.0, 373.4127), "bc": (491.0, 496.2991)}
UNMEASURED = MeasuredBoard(np.eye(4), lines=np.zeros((0, 3)), corners={}, lengths={})
# what decides the ends of edges (images, beams, the pitch): of most, and of those with a weak side
ENDS = {
    "last_beam": ("scan", "pitch"),
    "half_step": ("scan", "pitch"),
    "combined": ("image", "scan"),
}


def edge_point_table(prepared: Prepared, truth: Truth) -> pd.DataFrame:
    """Bias of each rule for the edge point against the true edge, across it within the plane.

    Parameters
    ----------
    prepared : Prepared
    truth : Truth

    Returns
    -------
    DataFrame
        Columns variant, edge, n, bias_mm (positive outside the board), sd_mm.
    """
    lines = dict(zip(truth.board.edges, truth.board.lines(), strict=True))
    misses = {key: [] for key in product(VARIANTS, lines)}
    for variant, (placement, scan) in product(VARIANTS, prepared.scans.items()):
        scanned = scan.edges[variant]
        scanned = scanned[~scanned.across]
        pitch = truth.pitch[placement][scanned.line]
        flat = truth.on_board(truth.boards[placement], scanned.points, pitch)
        for side, edge in scan.names.items():
            misses[variant, edge].extend(1000 * flat[scanned.side == side] @ lines[edge])
    each = pd.Series(misses).explode().astype(float).groupby(level=[0, 1], sort=False)
    table = each.agg(n="count", bias_mm="mean", sd_mm="std")
    return table.reset_index(names=["variant", "edge"])


def edge_lengths(
    prepared: Prepared,
    T_head_lrf: RigidTransform | None = None,
    joint: JointCalibration | None = None,
) -> pd.DataFrame:
    """Edges of the board measured in the cloud of every placement, beside the paper's own row.

    Parameters
    ----------
    prepared : Prepared
    T_head_lrf : RigidTransform, optional
        For the least-squares variants; the session's own platform when left out.
    joint : JointCalibration, optional
        With its estimates without each placement. Adds 'combined', the one answer: all that is
        known, each weighted by what it is worth. It does not know the board's size, and its
        calibration has not seen the placement.

    Returns
    -------
    DataFrame
        source, placement, edge, ends, variant, true_mm, measured_mm, sigma_mm, error_mm. One row
        for every edge that some camera sees at a placement; NaN where the cloud does not show both
        its ends. `ends` is 'scan' where beams decide both ends of the edge, 'pitch' where one hangs
        on the recorded pitch (the edge runs across the scan lines), 'image' where images show both
        ('combined'). `sigma_mm` holds all that is known to be uncertain for 'combined', and only
        the scatter of points about the sides for the others.
    """
    known = {}
    if prepared.board.corners is not None:
        known = prepared.board.lengths()
    measured = {variant: _outlines(prepared, variant, T_head_lrf) for variant in VARIANTS}
    if joint is not None and known:
        measured["combined"] = combined_outlines(joint)
    rows = []
    edges = prepared.board.edges
    for variant, placement in product(measured, prepared.session.board_placements):
        board, weak = measured[variant].get(placement, (UNMEASURED, frozenset()))
        seen = {
            edge.name
            for views in prepared.views.values()
            if placement in views
            for edge in views[placement].edges
        }
        for i, (name, true) in enumerate(known.items()):
            if name not in seen:
                continue
            ends = "not measured"
            if name in board.lengths:
                beside = {edges[i - 1], edges[(i + 1) % len(edges)]}
                ends = ENDS[variant][not weak.isdisjoint(beside)]
            sizes = [true, board.lengths.get(name, np.nan), board.sigma.get(name, np.nan)]
            where = (prepared.session.name, placement, name, ends, variant)
            rows.append((*where, *np.multiply(1000, sizes)))
    rows += [
        ("paper", np.nan, name, "scan", "last_beam", true, length, np.nan)
        for name, (true, length) in PAPER_EDGES_MM.items()
    ]
    columns = ["source", "placement", "edge", "ends", "variant"]
    columns += ["true_mm", "measured_mm", "sigma_mm"]
    table = pd.DataFrame(rows, columns=columns).astype({"placement": "Int64"})
    return table.assign(error_mm=table.measured_mm - table.true_mm)


def _outlines(prepared, variant, T_head_lrf):
    """Outlines and their weak sides (see :func:`outline_of`) by placement, as far as they exist."""
    out = {}
    for placement in prepared.scans:
        with suppress(DegenerateGeometry):
            out[placement] = outline_of(prepared, placement, variant, T_head_lrf)
    return out


def edge_summary(table: pd.DataFrame) -> pd.DataFrame:
    """Errors of measured edges.

    Parameters
    ----------
    table : DataFrame
        Of :func:`edge_lengths`.

    Returns
    -------
    DataFrame
        Columns source, ends, variant, n, mean_abs_error_mm, median_abs_error_mm, mean_error_mm,
        within_90_percent (share of the errors inside their 90 % intervals; NaN where nothing is
        said about them).
    """
    table = table[table.measured_mm.notna()]
    size = table.error_mm.abs()
    within = (size < ndtri(0.95) * table.sigma_mm).where(table.sigma_mm.notna())
    table = table.assign(size=size, within=100 * within.astype(float))
    return table.groupby(["source", "ends", "variant"], sort=False, as_index=False).agg(
        n=("size", "size"),
        mean_abs_error_mm=("size", "mean"),
        median_abs_error_mm=("size", "median"),
        mean_error_mm=("error_mm", "mean"),
        within_90_percent=("within", "mean"),
    )
