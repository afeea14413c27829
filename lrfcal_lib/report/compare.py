"""The command ``compare``: calibrations of one rig, each beside the one before."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from lrfcal_lib.measure.compare import Comparison, history, rig_at
from lrfcal_lib.plots import comparison as plots
from lrfcal_lib.plots.colors import COLORS
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
    comparisons = history([rig_at(path) for path in paths])
    for before, after, compared in zip(paths[:-1], paths[1:], comparisons, strict=True):
        print(
            f"{before} ({_dated(compared.first)}) and {after} ({_dated(compared.second)}):"
        )
        print(*(f"  {part}" for part in (*compared.parts, compared.whole)), sep="\n")
        print(compared.sentence())
    if figure is not None:
        drawn = comparison_figure(comparisons)
        with whole(figure) as draft:
            drawn.savefig(draft, format="png", dpi=110)
        plt.close(drawn)
        print(f"written: {figure}")
    return 0 if all(compared.within for compared in comparisons) else DIFFER


def _dated(rig):
    """When a rig was calibrated, and its verdict."""
    verdict = f"trusted: {rig.answer}" if rig.answer else "not judged"
    return f"session '{rig.session}', {rig.date or 'just calibrated'}, {verdict}"


def comparison_figure(comparisons: Sequence[Comparison]) -> Figure:
    """Where the last two calibrations differ, and every difference beside what is claimed.

    Parameters
    ----------
    comparisons : sequence of Comparison
    """
    last = comparisons[-1]
    columns = len(last.images) + 2
    with plt.style.context(STYLE):
        figure, axes = plt.subplots(
            1, columns, figsize=(4.4 * columns, 3.8), layout="constrained"
        )
        for ax, (name, shifts) in zip(axes[:-2], last.images.items(), strict=True):
            model = last.first.cameras[name].model
            size = (model.width, model.height)
            longest = plots.pixel_shifts(ax, shifts.at, shifts.off, size)
            ax.set_title(f"'{name}' at 2 m, longest {longest:.2g} px")
        drawn = plots.field_shifts(axes[-2], last.cloud.at, last.cloud.off)
        figure.colorbar(drawn, ax=axes[-2], label="[mm]")
        axes[-2].set_title("points at 2 m")
        for compared in comparisons:
            ratios = {}
            for part in compared.parts:
                for amount in part.amounts:
                    ratios[f"{part.name}, {amount.what}"] = amount.value / amount.claimed
            names = f"{compared.first.session}, {compared.second.session}"
            axes[-1].plot(list(ratios.values()), list(ratios), "o", label=names)
        axes[-1].axvline(1.0, color=COLORS["raw"])
        axes[-1].set(
            xlabel="difference / standard deviation that both claim", xlim=(0, None)
        )
        axes[-1].legend(title="from, to")
        axes[-1].set_title("differences beside claims")
    return figure
