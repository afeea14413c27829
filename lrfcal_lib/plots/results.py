"""Figures of results: bars, strips and points."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from numpy.typing import ArrayLike

from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.geometry import (
    length_of,
    rms,
)
from lrfcal_lib.plots.colors import LRF, OUTLIER, RAW, TRUTH, color_of, series

BINS = 8  # of distances, with as many residuals each
ROOM = 1.4  # of an axis of bars, times the longest: the legend stands beside them
WORST = 4.0  # times the median: a placement that fits so badly is an outlier


def by_placement(ax: Axes, names: Sequence | np.ndarray, label: str) -> None:
    """Ticks and labels of an axis of placements; the zero of what is drawn over them."""
    ax.set(xlabel="placement", ylabel=label, xticks=range(len(names)), xticklabels=names)
    ax.grid(False, axis="x")
    ax.axhline(0, color=TRUTH, linewidth=0.8)


def rows_of(ax: Axes, names: Sequence | Mapping, label: str) -> None:
    """Ticks of rows from above to below, and what they are drawn over."""
    rows = len(names)
    ax.set(xlabel=label, yticks=range(rows), yticklabels=names, ylim=(rows - 0.5, -0.5))


def _side_by_side(values):
    """Places of the dots of values in a strip from -0.5 to 0.5."""
    count = len(values)
    return (np.arange(count) + 0.5) / count - 0.5


def residual_strips(
    ax: Axes, residuals: np.ndarray, placement: np.ndarray, label: str, color: str
) -> None:
    """Residuals by placement, with their root mean square as a bar.

    Parameters
    ----------
    ax
    residuals, placement
        Shape (n,).
    label
        The quantity with its unit.
    color
    """
    groups = pd.Series(residuals).groupby(placement)
    for column, (_, values) in enumerate(groups):
        size = rms(values)
        ax.bar(column, 2 * size, 0.8, -size, color=color, alpha=0.2, linewidth=0)
        ax.plot(
            column + 0.6 * _side_by_side(values), values, ".", color=color, markersize=2.5
        )
    by_placement(ax, list(groups.groups), label)


def pitch_offsets(
    ax: Axes,
    placement: Sequence[int],
    offset: ArrayLike,
    sigma: ArrayLike,
    direction: np.ndarray,
) -> None:
    """Pitch offset of each sweep, coloured by direction.

    Parameters
    ----------
    ax
    placement
        Numbers of the sweeps, n of them.
    offset, sigma
        And its standard deviation, radians, shape (n,).
    direction
        +1 (up), -1 or 0, shape (n,).
    """
    offset = np.degrees(offset)
    sigma = np.degrees(sigma)
    kinds = {1: "upwards", -1: "downwards", 0: "unknown"}
    for index, (sign, label) in enumerate(kinds.items()):
        rows = np.flatnonzero(direction == sign)
        ax.bar(
            rows,
            offset[rows],
            0.75,
            yerr=sigma[rows],
            color=series(index),
            label=label,
            capsize=2,
            error_kw={"linewidth": 0.9, "ecolor": TRUTH},
        )
    by_placement(ax, placement, "pitch offset [deg]")
    ax.legend(title="head moved", ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0))


def parameter_comparison(
    ax: Axes,
    values: Mapping[str, float],
    sigmas: Mapping[str, float],
    label: str,
    true: float | None = None,
) -> None:
    """One parameter by method.

    Parameters
    ----------
    ax
    values, sigmas
        By method, and their standard deviations (NaN: no bar), both in the unit of the label.
    label
    true
        The true value where it is known: a vertical line.
    """
    if true is not None:
        ax.axvline(true, color=TRUTH, linestyle="--", linewidth=1, zorder=0)
    for row, (method, value) in enumerate(values.items()):
        ax.errorbar(
            value,
            row,
            xerr=sigmas[method],
            fmt="o",
            color=series(row),
            capsize=2.5,
            markersize=4.5,
        )
    rows_of(ax, values, label)
    ax.locator_params(axis="x", nbins=4)  # of four digits and a sign, too


def edge_errors(ax: Axes, errors: Mapping[str, Sequence[float]]) -> None:
    """Errors of edge lengths: a dot an edge, the mean a bar.

    Parameters
    ----------
    ax
    errors
        Measured minus true, mm, by rule.
    """
    for row, values in enumerate(errors.values()):
        color = series(row)
        height = row + 0.5 * _side_by_side(values)
        ax.plot(values, height, "o", color=color, markersize=3.5, alpha=0.8)
        ax.vlines(
            np.mean(values),
            row - 0.36,
            row + 0.36,
            color,
            linewidth=2.5,
            capstyle="projecting",
        )
    ax.axvline(0, color=TRUTH, linewidth=0.8)
    ax.grid(False, axis="y")
    rows_of(ax, errors, "measured - true length [mm]")


def method_bars(ax: Axes, table: pd.DataFrame, column: str, label: str) -> None:
    """One column of a ``method_comparison``, a bar for each method and camera.

    Parameters
    ----------
    ax
    table
        With the columns method and camera.
    column
        Another one of it.
    label
        Of its values, with their unit.
    """
    values = table.pivot_table(column, "method", "camera", dropna=False, sort=False)
    colors = [color_of(camera, i) for i, camera in enumerate(values)]
    values.plot.barh(ax=ax, width=0.8, color=colors, xlabel=label, ylabel="")
    ax.invert_yaxis()
    mean = values.mean(axis=1)
    title = "no method could be judged"
    if mean.notna().any():
        title = f"smallest: {mean.idxmin()}"
        ax.set_xlim(0, ROOM * values.max(axis=None))
    ax.set_title(title)
    ax.legend(loc="center right")


def misfit_bars(ax: Axes, misfit: Mapping[int, float]) -> None:
    """Normalised mean squared residuals by placement; 1 is what the noise explains.

    Parameters
    ----------
    ax
    misfit
        By placement; those above `WORST` times the median are drawn as outliers.
    """
    values = pd.Series(misfit)
    bad = values > WORST * max(values.median(), 1.0)
    values.plot.bar(ax=ax, width=0.75, color=np.where(bad, OUTLIER, LRF), rot=0)
    ax.axhline(1.0, color=TRUTH, linewidth=1, linestyle="--")
    ax.grid(False, axis="x")
    if len(misfit) > 15:
        ax.set_xticks(ax.get_xticks()[::2])
    title = f"All placements fit alike, the worst {values.max():.1f}"
    if bad.any():
        title = f"{bad.sum()} of {len(values)} placements fit much worse than the others"
    ax.set(xlabel="placement", ylabel="chi-square per degree of freedom", title=title)


def residuals_by_range(ax: Axes, distance: np.ndarray, residual: np.ndarray) -> None:
    """Range residuals over distance, with means and their standard errors in bins.

    Noise scatters, a model error bends; see ``joint_tables.range_residuals``.

    Parameters
    ----------
    ax
    distance, residual
        Metres, shape (n,).
    """
    points = pd.DataFrame({"distance": distance, "residual": 1000 * residual})
    ax.plot(points.distance, points.residual, ",", color=RAW, zorder=0)
    bins = points.groupby(pd.qcut(points.distance, BINS, duplicates="drop"), observed=True)
    means = bins.mean()
    ax.errorbar(
        means.distance,
        means.residual,
        bins.residual.sem(),
        fmt="o-",
        color=LRF,
        capsize=2.5,
        label="mean and its standard error",
    )
    ax.axhline(0, color=TRUTH, linewidth=0.8)
    limit = 1.05 * points.residual.abs().quantile(0.995)
    ax.set(
        xlabel="range [m]",
        ylabel="predicted - measured [mm]",
        ylim=(-limit, limit),
        title=f"Ranges: {rms(points.residual):.2g} mm rms",
    )
    ax.legend()


def residuals_by_region(
    ax: Axes, uv: np.ndarray, shift: np.ndarray, model: CameraModel, name: str
) -> None:
    """Residuals of the boards' middles over an image, as arrows.

    The longest is an eighth of the image's width; see ``joint_tables.view_residuals``.

    Parameters
    ----------
    ax
    uv, shift
        Pixels, shape (n, 2).
    model
        Of the camera.
    name
        Of the camera, which tells the colour.
    """
    title = f"{name}: no board in any image"
    if len(uv):
        length = length_of(shift)
        longest = length.max()
        unit = float(f"{longest / 2:.1g}")
        drawn = ax.quiver(
            *uv.T,
            *shift.T,
            scale=longest / (model.width / 8),
            color=color_of(name),
            angles="xy",
            scale_units="xy",
            width=0.005,
        )
        ax.quiverkey(drawn, 0.85, 0.94, unit, f"{unit:g} px", labelpos="S")
        title = f"{name}: {rms(length):.2g} px rms, predicted - seen"
    ax.set(
        xlim=(0, model.width),
        ylim=(model.height, 0),
        aspect="equal",
        xlabel="u [px]",
        ylabel="v [px]",
        title=title,
    )


def over_view(ax: Axes, cloud, values: np.ndarray, limit: float) -> PathCollection:
    """Values of points over bearing (to the left as in the scene) and pitch, degrees.

    Parameters
    ----------
    ax
    cloud : Cloud
        Of n points.
    values
        Shape (n,).
    limit
        Where colours end, and at its negative where there are negative values.
    """
    shades = "magma"
    low = 0.0
    if np.nanmin(values, initial=0.0) < 0:
        shades = "RdBu_r"
        low = -limit
    drawn = ax.scatter(
        np.degrees(cloud.bearing),
        np.degrees(cloud.pitch),
        2.5,
        values,
        marker="s",
        linewidths=0,
        rasterized=True,
        cmap=shades,
        vmin=low,
        vmax=limit,
        plotnonfinite=True,  # unseen, they count for the limits
    )
    ax.set(xlabel="bearing [deg]", ylabel="pitch [deg]", aspect="equal")
    ax.margins(0)
    ax.invert_xaxis()
    return drawn
