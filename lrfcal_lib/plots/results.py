"""Figures of results: bars, strips, maps, uncertainty."""

import numpy as np

from lrfcal_lib.plots.recording import COLORS, SERIES, color_of

BINS = 8
SPREAD = {"capsize": 2, "error_kw": {"linewidth": 0.9, "ecolor": COLORS["truth"]}}  # of bars


def by_placement(ax, names, label):
    """Ticks and labels of an axis of placements; the zero of what is drawn over them."""
    ax.set(xlabel="placement", ylabel=label, xticks=np.arange(len(names)), xticklabels=names)
    ax.grid(False, axis="x")
    ax.axhline(0, color=COLORS["truth"], linewidth=0.8)


def residual_strips(ax, residuals, placement, label, color):
    """Residuals (n,) by placement (n,), with their root mean square as a bar.

    `label` is the quantity with its unit.
    """
    names, column, count = np.unique(placement, return_inverse=True, return_counts=True)
    rank = np.argsort(np.argsort(column, kind="stable"))
    first = np.cumsum(count) - count
    within = rank - first[column]
    spread = (within + 0.5) / count[column] - 0.5
    rms = np.sqrt(np.bincount(column, np.square(residuals)) / count)
    looks = {"width": 0.8, "color": color, "alpha": 0.2, "linewidth": 0}
    ax.bar(np.arange(len(names)), 2 * rms, bottom=-rms, label="rms", **looks)
    ax.plot(column + 0.6 * spread, residuals, ".", color=color, markersize=2.5)
    by_placement(ax, names, label)
    limit = 1.08 * max(np.abs(residuals).max(), 1e-12)
    ax.set_ylim(-limit, limit)


def pitch_offsets(ax, placement, offset, sigma, direction):
    """Pitch offset of each sweep and its sigma (radians), coloured by direction: +1 (up), -1, 0."""
    offset = np.degrees(offset)
    sigma = np.degrees(sigma)
    kinds = {1: (SERIES[0], "upwards"), -1: (SERIES[1], "downwards"), 0: (COLORS["raw"], "unknown")}
    for sign, (color, label) in kinds.items():
        rows = np.flatnonzero(np.equal(direction, sign))
        if rows.size:
            looks = {"color": color, "width": 0.75} | SPREAD
            ax.bar(rows, offset[rows], yerr=sigma[rows], label=label, **looks)
            ax.axhline(np.median(offset[rows]), color=color, linestyle=":", linewidth=1)
    by_placement(ax, placement, "pitch offset [deg]")
    above = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.2}
    ax.legend(title="head moved", ncols=3, **above)


def parameter_comparison(ax, values, sigmas, label):
    """One parameter by method, values and sigmas, with one-sigma bars (none for NaN)."""
    for row, (method, value) in enumerate(values.items()):
        sigma = sigmas[method] if np.isfinite(sigmas[method]) else None
        looks = {"fmt": "o", "color": SERIES[row % len(SERIES)], "capsize": 2.5, "markersize": 4.5}
        ax.errorbar(value, row, xerr=sigma, **looks)
    rows_of(ax, values)
    ax.set_xlabel(label)


def rows_of(ax, names):
    """Ticks of rows from above to below."""
    count = len(names)
    ax.set(yticks=np.arange(count), yticklabels=list(names), ylim=(count - 0.5, -0.5))


def edge_errors(ax, errors):
    """Errors of edge lengths (measured minus true, mm) by rule: a dot an edge, the mean a bar."""
    for row, values in enumerate(errors.values()):
        spread = (np.arange(len(values)) + 0.5) / max(len(values), 1) - 0.5
        color = SERIES[row % len(SERIES)]
        ax.plot(values, row + 0.5 * spread, "o", color=color, markersize=3.5, alpha=0.8)
        ax.plot([np.mean(values)] * 2, [row - 0.36, row + 0.36], color=color, linewidth=2.5)
    ax.axvline(0, color=COLORS["truth"], linewidth=0.8)
    ax.grid(False, axis="y")
    rows_of(ax, errors)
    ax.set_xlabel("measured - true length [mm]")


def method_bars(ax, table, column, label):
    """One column of a ``method_comparison``, a bar for each method and camera."""
    methods = list(dict.fromkeys(table.method))
    cameras = list(dict.fromkeys(table.camera))
    height = 0.8 / len(cameras)
    rows = np.arange(len(methods))
    for i, camera in enumerate(cameras):
        part = table[table.camera == camera].set_index("method")[column].reindex(methods)
        looks = {"height": 0.95 * height, "color": color_of(camera, i)}
        ax.barh(rows + i * height, part, label=camera, **looks)
    middle = height * (len(cameras) - 1) / 2
    ax.set(yticks=rows + middle, yticklabels=methods, xlabel=label)
    ax.set_ylim(len(methods) - 0.5 * height, -height)
    mean = table.groupby("method", sort=False)[column].mean()
    title = "no method could be judged"
    if mean.notna().any():
        title = f"least: {mean.idxmin()}"
    ax.set_title(title)
    ax.legend()


def misfit_bars(ax, misfit, limit=4.0):
    """Normalised mean squared residuals by placement; 1 is what the noise explains.

    Placements above `limit` times the median are drawn as outliers.
    """
    values = np.array(list(misfit.values()))
    every = 1 if len(misfit) < 16 else 2
    bad = values > limit * max(np.median(values), 1.0)
    color = np.where(bad, COLORS["outlier"], COLORS["lrf"])
    ax.bar(np.arange(len(values)), values, color=color, width=0.75)
    ax.axhline(1.0, color=COLORS["truth"], linewidth=1, linestyle="--")
    by_placement(ax, list(misfit), "chi-square per degree of freedom")
    ax.set_xticks(np.arange(len(values))[::every], list(misfit)[::every])
    title = f"all placements fit alike, the worst {values.max():.1f}"
    if bad.any():
        title = f"{bad.sum()} of {len(values)} placements fit much worse than the others"
    ax.set(ylim=(0, 1.1 * max(values.max(), 1.2)), title=title)


def residuals_by_range(ax, distance, residual):
    """Range residuals over distance (metres, shapes (n,)), with means and their errors in bins.

    Noise scatters, a model error bends; see ``joint_tables.range_residuals``.
    """
    residual = 1000 * np.asarray(residual)
    ax.plot(distance, residual, ",", color=COLORS["raw"], zorder=0)
    limits = np.unique(np.quantile(distance, np.linspace(0, 1, BINS + 1)))
    number = np.searchsorted(limits, distance, side="right") - 1
    number = np.clip(number, 0, max(len(limits) - 2, 0))
    means = []
    for i in np.unique(number):
        here = residual[number == i]
        error = here.std() / np.sqrt(len(here))
        means.append((distance[number == i].mean(), here.mean(), error))
    x, y, error = np.transpose(means)
    looks = {"fmt": "o-", "color": COLORS["lrf"], "capsize": 2.5}
    ax.errorbar(x, y, yerr=error, label="mean and its standard error", **looks)
    ax.axhline(0, color=COLORS["truth"], linewidth=0.8)
    limit = 1.05 * max(np.quantile(np.abs(residual), 0.995), 1e-9)
    rms = np.sqrt(np.mean(residual**2))
    ax.set(xlabel="range [m]", ylabel="predicted - measured [mm]", ylim=(-limit, limit))
    ax.set_title(f"ranges: {rms:.2g} mm rms")
    ax.legend()


def residuals_by_region(ax, uv, shift, model, name):
    """Residuals of the boards' middles over an image, as arrows.

    The longest is an eighth of the image's width. `uv` and `shift` (n, 2), pixels: see
    ``joint_tables.view_residuals``. The camera's name is its colour.
    """
    length = np.linalg.norm(shift, axis=1)
    title = f"{name}: no board in any image"
    if len(uv):
        longest = max(length.max(), 1e-9)
        looks = {"angles": "xy", "scale_units": "xy", "width": 0.005, "color": color_of(name)}
        drawn = ax.quiver(*uv.T, *shift.T, scale=longest / (model.width / 8), **looks)
        unit = float(f"{longest / 2:.1g}")
        ax.quiverkey(drawn, 0.85, 0.94, unit, f"{unit:g} px", labelpos="S", coordinates="axes")
        title = f"{name}: {np.sqrt(np.mean(length**2)):.2g} px rms, predicted - seen"
    ax.set(xlim=(0, model.width), ylim=(model.height, 0), aspect="equal")
    ax.set(xlabel="u [px]", ylabel="v [px]", title=title)


def over_view(ax, cloud, values, limit):
    """Values of a Cloud's points over bearing (to the left as in the scene) and pitch, degrees.

    Colours end at `limit`, and at its negative where there are negative values. Returns what was
    drawn.
    """
    shades = {"cmap": "magma", "vmin": 0.0, "vmax": limit}
    if np.nanmin(values, initial=0.0) < 0:
        shades = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
    bearing = np.degrees(cloud.bearing)
    pitch = np.degrees(cloud.pitch)
    looks = {"s": 2.5, "marker": "s", "linewidths": 0, "rasterized": True}
    drawn = ax.scatter(bearing, pitch, c=values, **looks, **shades)
    ax.set(xlabel="bearing [deg]", ylabel="pitch [deg]", aspect="equal")
    ax.set(xlim=(bearing.max(), bearing.min()), ylim=(pitch.min(), pitch.max()))
    return drawn
