"""The command ``compare``: calibrations of one rig, each beside the one before."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lrfcal_lib.measure.compare import Comparison, compare, rig_at
from lrfcal_lib.model.geometry import length_of
from lrfcal_lib.report.notebook import STYLE
from lrfcal_lib.session.write import whole

DIFFER = 3  # exit status where two differ by more than both claim


def compare_files(paths: Sequence[str | Path], figure: str | Path | None = None) -> int:
    """Compare calibrations from the command line: print how far each is from the one before it.

    Parameters
    ----------
    paths : sequence of path-like
        Of ``calibration.json``, or of sessions, which are calibrated; the earliest first.
    figure : path-like, optional
        Of a PNG.

    Returns
    -------
    int
        0, or 3 where two differ by more than both claim.

    Raises
    ------
    ValueError
        For a file that cannot be read or written, or of another rig.
    """
    if len(paths) < 2:
        raise ValueError(f"{len(paths)} calibration to compare: two or more are needed")
    comparisons = [compare(*pair) for pair in pairwise(map(rig_at, paths))]
    for (before, after), compared in zip(pairwise(paths), comparisons, strict=True):
        print(
            f"{before} ({_dated(compared.first)}) and {after} ({_dated(compared.second)}):"
        )
        print(*(f"  {part}" for part in (*compared.parts, compared.whole)), sep="\n")
        print(compared.sentence())
    if figure is not None:
        with whole(figure) as draft:
            comparison_figure(comparisons).savefig(draft, format="png", dpi=110)
        print(f"written: {figure}")
    return 0 if all(compared.within for compared in comparisons) else DIFFER


def _dated(rig):
    """When a rig was calibrated, and its verdict."""
    verdict = f"trusted: {rig.answer}" if rig.answer else "not judged"
    return f"session '{rig.session}', {rig.date or 'just calibrated'}, {verdict}"


def comparison_figure(comparisons: Sequence[Comparison]) -> Figure:
    """Where each calibration differs from the one before it, a row each.

    Parameters
    ----------
    comparisons : sequence of Comparison
    """
    columns = 1 + max(len(compared.images) for compared in comparisons)
    size = (4.4 * columns, 3.4 * len(comparisons))
    with plt.style.context(STYLE):
        figure = Figure(size, layout="constrained")
        grid = figure.subplots(len(comparisons), columns, squeeze=False)
        for axes, compared in zip(grid, comparisons, strict=True):
            field = compared.cloud
            names = f"{compared.first.session}, {compared.second.session}"
            _shift_map(
                axes[0],
                np.degrees(field.at),
                1000 * field.off,
                "mm",
                title=f"{names}: {field.amount('mm', 1000)}",
                xlabel="bearing [deg]",
                ylabel="pitch [deg]",
            )
            axes[0].invert_xaxis()  # as the rig sees it
            for ax, (name, shifts) in zip(axes[1:], compared.images.items(), strict=False):
                _shift_map(
                    ax,
                    shifts.at,
                    shifts.off,
                    "px",
                    title=f"'{name}' {shifts.amount('px')}",
                    xlabel="u [px]",
                    ylabel="v [px]",
                )
                ax.invert_yaxis()
    return figure


def _shift_map(ax: Axes, at: np.ndarray, off: np.ndarray, unit: str, **looks: str) -> None:
    """By how much things move over an image or a field of view, as colours with a bar.

    Shifts `off`, shape (r, c, k), NaN where there is none, stand where `at` (r, c, 2) says; `looks`
    are title and labels.
    """
    drawn = ax.pcolormesh(*np.moveaxis(at, -1, 0), length_of(off), vmin=0)
    ax.figure.colorbar(drawn, ax=ax, label=f"[{unit}]")
    ax.set(**looks)
