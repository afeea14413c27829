"""Figures of what a calibration knows: maps of standard deviations, observability, misfit and residuals."""

from __future__ import annotations

import textwrap

import numpy as np
from matplotlib.ticker import FormatStrFormatter

from lrfcal_lib.plots.colors import COLORS, SERIES, color_of

BINS = 8
LEVELS = 5


def projection_map(ax, found, index=0, name="", largest=None):
    """Standard deviation over an image of where points of the LRF project.

    Parameters
    ----------
    ax : Axes
    found : SigmaMap
        Of :func:`lrfcal_lib.uncertainty.projection_sigma`; inf and NaN stay white.
    index : int
        Of the distance.
    name : str
        Of the camera.
    largest : float, optional
        End of the colours, pixels, for maps side by side; they begin at 0.
    """
    _filled(ax, found.columns, found.rows, found.sigma[index], "px", largest)
    ax.set_aspect("equal")
    ax.invert_yaxis()
    ax.set(xlabel="u [px]", ylabel="v [px]")
    ax.set_title(_title(f"{name} at {found.distances[index]:g} m".strip(), found.rms()[index], "px"))


def point_map(ax, found, index=0, largest=None):
    """Standard deviation of reconstructed points over the field of view.

    Parameters
    ----------
    ax : Axes
    found : SigmaMap
        Of :func:`lrfcal_lib.uncertainty.point_sigma`.
    index : int
        Of the distance.
    largest : float, optional
        End of the colours, millimetres, for maps side by side; they begin at 0.
    """
    _filled(ax, np.degrees(found.columns), np.degrees(found.rows), 1000 * found.sigma[index], "mm", largest)
    ax.invert_xaxis()
    ax.set_aspect("equal")
    ax.set(xlabel="bearing [deg]", ylabel="pitch [deg]")
    ax.set_title(_title(f"cloud at {found.distances[index]:g} m", 1000 * found.rms()[index], "mm"))


def _title(what, rms, unit):
    return f"{what}: {rms:.2g} {unit} rms" if np.isfinite(rms) else f"{what}: no bound"


def _filled(ax, columns, rows, sigma, unit, largest):
    """Colours and labelled lines of equal standard deviation."""
    good = np.ma.masked_invalid(sigma)
    shading = "nearest" if np.ma.getmaskarray(good).any() else "gouraud"
    top = largest or (good.max() if good.count() else 1.0)
    mesh = ax.pcolormesh(columns, rows, good, cmap="viridis", shading=shading, vmin=0.0, vmax=top)
    ax.grid(False)
    if good.count() and good.max() > 1.05 * good.min():
        lines = ax.contour(columns, rows, good, LEVELS, colors="white", linewidths=0.8)
        ax.clabel(lines, fontsize="x-small", fmt="%.3g")
    bar = ax.figure.colorbar(mesh, ax=ax, label=f"standard deviation [{unit}]", shrink=0.8)
    bar.ax.yaxis.set_major_formatter(FormatStrFormatter("%.3g"))


def point_parts(ax, found):
    """What axis, range offset and pitch contribute to the error of a point, by distance.

    Parameters
    ----------
    ax : Axes
    found : SigmaMap
        Of :func:`lrfcal_lib.uncertainty.point_sigma`, at several distances.
    """
    rows = {k: np.sqrt(np.mean(v**2, axis=(1, 2))) for k, v in found.parts.items()} | {"calibration": found.rms()}
    rows = {name: value for name, value in rows.items() if np.any(value > 0)}
    for index, (name, value) in enumerate(rows.items()):
        style = {"range noise": ":", "calibration": "-"}.get(name, "--")
        color = COLORS["truth"] if name == "calibration" else SERIES[index % len(SERIES)]
        ax.plot(found.distances, 1000 * value, style, marker="o", markersize=3.5, color=color, label=name)
    ax.set(xlabel="distance [m]", ylabel="standard deviation [mm]", ylim=(0, None))
    ax.legend()


def observability_bars(ax, directions, count=6):
    """The least known combinations of unknowns, in words.

    Parameters
    ----------
    ax : Axes
    directions : list of Direction
        Of :func:`lrfcal_lib.advice.observability`, the least known first.
    count : int
        How many are drawn.
    """
    shown = directions[:count]
    sigma = 1000 * np.array([d.sigma for d in shown])
    finite = sigma[np.isfinite(sigma)]
    longest = 1.15 * finite.max() if len(finite) else 1.0
    colors = [COLORS["fit"] if np.isfinite(s) else COLORS["outlier"] for s in sigma]
    ax.barh(np.arange(len(shown)), np.where(np.isfinite(sigma), sigma, longest), color=colors, height=0.6)
    for row, s in enumerate(sigma):
        text, at = (f" {s:.2g} mm", s) if np.isfinite(s) else (" not determined", 0.0)
        ax.text(at, row, text, va="center", ha="left", color="black" if np.isfinite(s) else "white")
    words = [textwrap.fill(d.words, 46) for d in shown]
    ax.set(yticks=np.arange(len(shown)), ylim=(len(shown) - 0.5, -0.5), xlim=(0, 1.12 * longest))
    ax.set_yticklabels(words, fontsize="small")
    ax.set_xlabel("standard deviation at 2 m [mm]")
    lost = int(np.isinf(sigma).sum())
    ax.set_title(f"{lost} motions are not determined" if lost else f"least known: {sigma[0]:.2g} mm at 2 m")
    ax.grid(False, axis="y")


def misfit_bars(ax, misfit, limit=4.0):
    """Normalised mean squared residuals by placement; 1 is what the noise explains.

    Parameters
    ----------
    ax : Axes
    misfit : dict of int to float
    limit : float
        Placements above this multiple of the median are drawn as outliers.
    """
    names, values = list(misfit), np.array(list(misfit.values()))
    bad = values > limit * max(np.median(values), 1.0)
    ax.bar(np.arange(len(names)), values, color=np.where(bad, COLORS["outlier"], COLORS["lrf"]), width=0.75)
    ax.axhline(1.0, color=COLORS["truth"], linewidth=1, linestyle="--")
    ax.set(xlabel="placement", ylabel="chi-square per degree of freedom", ylim=(0, 1.1 * max(values.max(), 1.2)))
    shown = np.arange(0, len(names), 1 if len(names) < 16 else 2)
    ax.set(xticks=shown, xticklabels=[names[i] for i in shown])
    ax.set_title(f"{bad.sum()} of {len(names)} placements fit much worse than the others" if bad.any() else
                 f"all placements fit alike, the worst {values.max():.1f}")  # fmt: skip
    ax.grid(False, axis="x")


def residuals_by_range(ax, distance, residual):
    """Range residuals over distance, with the mean and its standard error in bins: noise scatters, a model error bends.

    Parameters
    ----------
    ax : Axes
    distance, residual : ndarray, shape (n,)
        Metres; see :func:`lrfcal_lib.residuals.range_residuals`.
    """
    residual = 1000 * np.asarray(residual)
    ax.plot(distance, residual, ",", color=COLORS["raw"], zorder=0)
    limits = np.unique(np.quantile(distance, np.linspace(0, 1, BINS + 1)))
    which = np.clip(np.searchsorted(limits, distance, side="right") - 1, 0, max(len(limits) - 2, 0))
    bins = [which == i for i in range(max(len(limits) - 1, 1))]
    x, y = (np.array([np.mean(v[b]) for b in bins if b.any()]) for v in (np.asarray(distance), residual))
    error = np.array([np.std(residual[b]) / np.sqrt(b.sum()) for b in bins if b.any()])
    ax.errorbar(x, y, yerr=error, fmt="o-", color=COLORS["lrf"], capsize=2.5, label="mean and its standard error")
    ax.axhline(0, color=COLORS["truth"], linewidth=0.8)
    limit = 1.05 * max(np.quantile(np.abs(residual), 0.995), 1e-9)
    ax.set(xlabel="range [m]", ylabel="predicted - measured [mm]", ylim=(-limit, limit))
    ax.set_title(f"ranges: {np.sqrt(np.mean(residual**2)):.2g} mm rms")
    ax.legend()


def residuals_by_region(ax, uv, shift, model, name="", longest=None):
    """Residuals of the boards' middles over an image, as arrows.

    Parameters
    ----------
    ax : Axes
    uv, shift : ndarray, shape (n, 2)
        Pixels; see :func:`lrfcal_lib.residuals.view_residuals`.
    model : CameraModel
    name : str
        Of the camera: its colour.
    longest : float, optional
        Residual drawn over an eighth of the image's width, pixels; the largest when left out.
    """
    length = np.linalg.norm(shift, axis=1)
    longest = longest or max(length.max(initial=0.0), 1e-9)
    scale = longest / (model.width / 8)
    looks = {"angles": "xy", "scale_units": "xy", "width": 0.005, "color": color_of(name)}
    if len(uv):
        drawn = ax.quiver(*np.asarray(uv).T, *np.asarray(shift).T, scale=scale, **looks)
        unit = float(f"{longest / 2:.1g}")
        ax.quiverkey(drawn, 0.85, 0.94, unit, f"{unit:g} px", labelpos="S", coordinates="axes")
    ax.set(xlim=(0, model.width), ylim=(model.height, 0), xlabel="u [px]", ylabel="v [px]")
    ax.set_aspect("equal")
    rms = np.sqrt(np.mean(length**2)) if len(uv) else 0.0
    ax.set_title(f"{name}: {rms:.2g} px rms, predicted - seen" if len(uv) else f"{name}: no board in any image")


__all__ = [
    "misfit_bars", "observability_bars", "point_map", "point_parts", "projection_map", "residuals_by_range",
    "residuals_by_region",
]  # fmt: skip
