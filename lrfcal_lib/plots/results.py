"""Figures of results: bars, strips, maps, uncertainty."""

import textwrap

import numpy as np

from lrfcal_lib.plots.recording import COLORS, SERIES, color_of

BINS = 8
LEVELS = 5
LEAST_HEIGHT = 20.0  # degrees of a map: that of a head which hardly moves would be a line
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


def projection_map(ax, found, index=0, name=""):
    """Standard deviation over an image of where points of the LRF project, at a map's distance.

    `found` is a SigmaMap of :func:`lrfcal_lib.judge.uncertainty.projection_sigma`; inf and NaN
    stay white.
    """
    _sigma_map(ax, found, index, "px", name)
    ax.invert_yaxis()
    ax.set(xlabel="u [px]", ylabel="v [px]")


def point_map(ax, found, index=0):
    """Standard deviation of points over the field of view, of ``uncertainty.point_sigma``."""
    _sigma_map(ax, found, index, "mm", "cloud", np.degrees(1.0), 1000.0)
    middle = np.mean(ax.get_ylim())
    height = max(np.ptp(ax.get_ylim()), LEAST_HEIGHT)
    ax.set_ylim(middle - height / 2, middle + height / 2)
    ax.invert_xaxis()
    ax.set(xlabel="bearing [deg]", ylabel="pitch [deg]")


def _sigma_map(ax, found, index, unit, name, angle=1.0, scale=1.0):
    """Colours and labelled lines of equal standard deviation.

    `angle` and `scale` are factors to the units shown.
    """
    at = (angle * found.columns, angle * found.rows)
    good = np.ma.masked_invalid(scale * found.sigma[index])
    shading = "nearest" if good.count() < good.size else "gouraud"
    top = good.max() if good.count() else 1.0
    mesh = ax.pcolormesh(*at, good, cmap="viridis", shading=shading, vmin=0.0, vmax=top)
    ax.grid(False)
    if good.count() and good.max() > 1.05 * good.min():
        lines = ax.contour(*at, good, LEVELS, colors="white", linewidths=0.8)
        ax.clabel(lines, fontsize=8, fmt="%.3g")
    label = f"standard deviation [{unit}]"
    ax.figure.colorbar(mesh, ax=ax, label=label, shrink=0.8, format="%.3g")
    ax.set_aspect("equal")
    rms = scale * found.rms()[index]
    size = f"{rms:.2g} {unit} rms" if np.isfinite(rms) else "no bound"
    ax.set_title(f"{name} at {found.distances[index]:g} m: {size}")


def point_parts(ax, found):
    """What axis, range offset and pitch add to the error of a point, by distance.

    SigmaMap of ``point_sigma``.
    """
    rms = {name: np.sqrt(np.mean(part**2, axis=(1, 2))) for name, part in found.parts.items()}
    shown = {name: value for name, value in rms.items() if np.any(value > 0)}
    dots = {"marker": "o", "markersize": 3.5}
    for index, (name, value) in enumerate(shown.items()):
        style = ":" if name == "range noise" else "--"
        color = SERIES[index % len(SERIES)]
        ax.plot(found.distances, 1000 * value, style, color=color, label=name, **dots)
    whole = 1000 * found.rms()
    if np.any(whole > 0):
        ax.plot(found.distances, whole, "-", color=COLORS["truth"], label="calibration", **dots)
    ax.set(xlabel="distance [m]", ylabel="standard deviation [mm]")
    ax.set_ylim(0, 1.35 * ax.get_ylim()[1])
    ax.set_title(f"calibration: {whole[-1]:.2g} mm at {found.distances[-1]:g} m")
    ax.legend(ncols=2, loc="upper left")


def observability_bars(ax, directions):
    """The six least known combinations of unknowns, in words (``next_placement.observability``)."""
    shown = directions[:6]
    sigma = 1000 * np.array([direction.sigma for direction in shown])
    known = np.isfinite(sigma)
    longest = 1.15 * sigma[known].max(initial=0.0) or 1.0
    colors = np.where(known, COLORS["fit"], COLORS["outlier"])
    ax.barh(np.arange(len(shown)), np.where(known, sigma, longest), color=colors, height=0.6)
    for row, value in enumerate(sigma):
        if known[row]:
            ax.text(value, row, f" {value:.2g} mm", va="center", ha="left", color="black")
        else:
            ax.text(0.0, row, " not determined", va="center", ha="left", color="white")
    title = f"{(~known).sum()} motions are not determined"
    if known.all():
        title = f"least known: {sigma[0]:.2g} mm at 2 m"
    ax.set_title(title)
    ax.set(xlim=(0, 1.12 * longest), xlabel="standard deviation at 2 m [mm]")
    rows_of(ax, [textwrap.fill(direction.words, 64) for direction in shown])
    ax.tick_params(axis="y", labelsize=8)
    ax.grid(False, axis="y")


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
