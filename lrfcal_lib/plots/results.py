"""Figures of results: residuals, parameters, errors."""

from __future__ import annotations

import numpy as np

from lrfcal_lib.plots.colors import COLORS, SERIES, color_of


def residual_strips(ax, residuals, placement, label, color=None):
    """Residuals by placement, with their root mean square as a bar.

    Parameters
    ----------
    ax : Axes
    residuals : ndarray, shape (n,)
    placement : ndarray of int, shape (n,)
    label : str
        Quantity and unit.
    color : str, optional
        Of the LRF unless given.
    """
    color = color or COLORS["lrf"]
    names = np.unique(placement)
    column = np.searchsorted(names, placement)
    count = np.bincount(column)
    order = np.argsort(column, kind="stable")
    rank = np.arange(len(column)) - np.repeat(np.cumsum(count) - count, count)
    spread = np.empty(len(column))
    spread[order] = (rank + 0.5) / np.repeat(count, count) - 0.5
    rms = np.sqrt(np.bincount(column, np.square(residuals)) / count)
    ax.bar(np.arange(len(names)), 2 * rms, bottom=-rms, width=0.8, color=color, alpha=0.2, linewidth=0, label="rms")
    ax.plot(column + 0.6 * spread, residuals, ".", color=color, markersize=2.5)
    ax.axhline(0, color=COLORS["truth"], linewidth=0.8)
    limit = 1.08 * max(np.abs(residuals).max(), 1e-12)
    ax.set(xlabel="placement", ylabel=label, ylim=(-limit, limit), xticks=np.arange(len(names)), xticklabels=names)
    ax.grid(False, axis="x")


def pitch_offsets(ax, placement, offset, sigma, direction):
    """Pitch offset of each sweep, coloured by the direction in which the head moved.

    Parameters
    ----------
    ax : Axes
    placement, direction : ndarray of int, shape (n,)
        Direction is +1 (upwards), -1 or 0 (unknown).
    offset, sigma : ndarray, shape (n,)
        Radians.
    """
    placement, direction, offset = np.asarray(placement), np.asarray(direction), np.degrees(offset)
    bars = {"capsize": 2, "error_kw": {"linewidth": 0.9, "ecolor": COLORS["truth"]}}
    for sign, color, label in ((1, SERIES[0], "upwards"), (-1, SERIES[1], "downwards"), (0, COLORS["raw"], "unknown")):
        rows = np.flatnonzero(direction == sign)
        if rows.size:
            ax.bar(rows, offset[rows], yerr=np.degrees(sigma)[rows], color=color, width=0.75, label=label, **bars)
            ax.axhline(np.median(offset[rows]), color=color, linestyle=":", linewidth=1)
    ax.axhline(0, color=COLORS["truth"], linewidth=0.8)
    ax.set(xlabel="placement", ylabel="pitch offset [deg]", xticks=np.arange(len(placement)), xticklabels=placement)
    ax.grid(False, axis="x")
    ax.legend(title="head moved", ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2)


def parameter_comparison(ax, values, sigmas, label, reference=None):
    """One parameter as each method finds it, with one-sigma bars.

    Parameters
    ----------
    ax : Axes
    values, sigmas : dict of str to float
        By method; a sigma that is NaN or absent draws no bar.
    label : str
        Parameter and unit.
    reference : float, optional
        A published or true value.
    """
    methods = list(values)
    for row, method in enumerate(methods):
        sigma = sigmas.get(method, np.nan)
        looks = {"fmt": "o", "color": SERIES[row % len(SERIES)], "capsize": 2.5, "markersize": 4.5}
        ax.errorbar(values[method], row, xerr=sigma if np.isfinite(sigma) else None, **looks)
    if reference is not None:
        ax.axvline(reference, color=COLORS["truth"], linestyle="--", linewidth=1, label="reference")
        ax.legend()
    ax.set(yticks=np.arange(len(methods)), yticklabels=[m.replace("_", " ") for m in methods], xlabel=label)
    ax.set_ylim(len(methods) - 0.5, -0.5)


def edge_errors(ax, errors):
    """Errors of edge lengths by rule for the edge point (or method), one dot an edge, the mean as a bar.

    Parameters
    ----------
    ax : Axes
    errors : dict of str to ndarray, shape (n,)
        Measured minus true, millimetres.
    """
    for column, values in enumerate(np.asarray(v, float) for v in errors.values()):
        spread = (np.arange(len(values)) + 0.5) / max(len(values), 1) - 0.5
        color = SERIES[column % len(SERIES)]
        ax.plot(column + 0.5 * spread, values, "o", color=color, markersize=3.5, alpha=0.8)
        ax.plot([column - 0.36, column + 0.36], [values.mean()] * 2, color=color, linewidth=2.5)
    ax.axhline(0, color=COLORS["truth"], linewidth=0.8)
    ax.set(ylabel="measured - true [mm]", xticks=np.arange(len(errors)))
    ax.set_xticklabels([name.replace("_", " ") for name in errors])
    ax.grid(False, axis="x")


def cost_history(ax, histories):
    """How the cost of each method fell, on a logarithmic axis.

    Parameters
    ----------
    ax : Axes
    histories : dict of str to sequence of float
    """
    for index, (name, costs) in enumerate(histories.items()):
        ax.semilogy(np.arange(len(costs)), costs, "o-", color=SERIES[index % len(SERIES)], label=name)
    ax.set(xlabel="iteration", ylabel="cost")
    ax.legend()


def method_bars(ax, table, column, label):
    """One column of a method comparison, a bar for each method and camera.

    Parameters
    ----------
    ax : Axes
    table : DataFrame
        With the columns ``camera``, ``method`` and `column`.
    column, label : str
        What is drawn, and its name with the unit.
    """
    methods = list(dict.fromkeys(table.method))
    cameras = list(dict.fromkeys(table.camera))
    height = 0.8 / len(cameras)
    for i, camera in enumerate(cameras):
        part = table[table.camera == camera].set_index("method")[column].reindex(methods)
        at = np.arange(len(methods)) + i * height
        ax.barh(at, part, height=0.95 * height, color=color_of(camera, i), label=camera)
    ticks = np.arange(len(methods)) + height * (len(cameras) - 1) / 2
    ax.set(yticks=ticks, yticklabels=methods, xlabel=label, ylim=(len(methods) - 0.5 * height, -height))
    ax.legend()
