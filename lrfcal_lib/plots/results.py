"""Figures of results: bars, strips, maps, uncertainty, diagnosis."""

from __future__ import annotations

import textwrap

import numpy as np
from matplotlib.ticker import FormatStrFormatter

from lrfcal_lib.plots.recording import COLORS, SERIES, color_of


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


BINS = 8
LEVELS = 5


def projection_map(ax, found, index=0, name="", largest=None):
    """Standard deviation over an image of where points of the LRF project.

    Parameters
    ----------
    ax : Axes
    found : SigmaMap
        Of :func:`lrfcal_lib.evaluate.uncertainty.projection_sigma`; inf and NaN stay white.
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
        Of :func:`lrfcal_lib.evaluate.uncertainty.point_sigma`.
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
        Of :func:`lrfcal_lib.evaluate.uncertainty.point_sigma`, at several distances.
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
        Of :func:`lrfcal_lib.evaluate.next_placement.observability`, the least known first.
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
        Metres; see :func:`lrfcal_lib.evaluate.jointly.range_residuals`.
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
        Pixels; see :func:`lrfcal_lib.evaluate.jointly.view_residuals`.
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


def background_motion(ax, steadiness):
    """How far the background moved in the images of cameras fixed to the base, by placement; steps are marked.

    Parameters
    ----------
    ax : Axes
    steadiness : dict of str to Steadiness
        By camera; those on the head are left out.

    Raises
    ------
    ValueError
        If none of the cameras could be judged.
    """
    judged = {camera: found for camera, found in steadiness.items() if not found.reason}
    if not judged:
        reasons = "; ".join(found.reason for found in steadiness.values()) or "there are no cameras"
        raise ValueError(f"no motion of the background to draw: {reasons}")
    names = sorted({int(p) for found in judged.values() for p in found.placements}, key=_order(judged))
    for index, (camera, found) in enumerate(judged.items()):
        at = [names.index(p) for p in found.placements]
        color = color_of(camera, index)
        sigma = _size_sigma(found)
        ax.errorbar(at, found.size_px, yerr=sigma, fmt="o-", color=color, markersize=4, linewidth=1, capsize=2,
                    label=f"turn, {camera}")  # fmt: skip
        ax.plot(at, found.corner_px, "--", color=color, linewidth=1, alpha=0.6,
                label=f"image scale, {camera} (outwards at a corner)")  # fmt: skip
    places = {(s.before, s.after) for found in judged.values() for s in found.steps}
    for before, after in places:
        ax.axvline((names.index(before) + names.index(after)) / 2, color=COLORS["outlier"], linewidth=1.2)
    ax.set(xlabel="placement", ylabel="motion of the background [px]", title=_motion_title(judged, places))
    ax.set(xticks=np.arange(len(names)), xticklabels=names)
    ax.axhline(0, color=COLORS["truth"], linewidth=0.8)
    ax.grid(False, axis="x")
    ax.legend(ncols=2, fontsize="small", loc="lower right")


def _order(judged):
    """Key that sorts placements as the longest list of them does."""
    longest = max(judged.values(), key=lambda found: len(found.placements)).placements
    rank = {int(p): i for i, p in enumerate(longest)}
    return lambda p: rank.get(p, len(rank) + p)


def _size_sigma(found):
    """Standard deviation of the turn in pixels: that of its largest component, scaled as the size is."""
    angle = np.linalg.norm(found.rotvec, axis=1)
    per_angle = np.median((found.size_px / np.maximum(angle, 1e-12))[angle > 0]) if (angle > 0).any() else 0.0
    return per_angle * np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)[:, :3].max(axis=1))


def _motion_title(judged, places):
    if not places:
        return "the background stood still" if len(judged) == 1 else "the background stood still in all cameras"
    steps = [f"{before} and {after}" for before, after in sorted(places)]
    turns = [np.rad2deg(s.angle) for found in judged.values() for s in found.steps]
    return f"moved by {np.mean(turns):.3f} deg between placements {', '.join(steps)}"


def board_bend(ax, bends):
    """How bent each board looks in the scan, beside the printed sheet in the images.

    Parameters
    ----------
    ax : Axes
    bends : BoardBends

    Raises
    ------
    ValueError
        If no placement has a bend.
    """
    found = [b for b in bends.placements.values() if np.isfinite(b.size)]
    if not found:
        raise ValueError(f"no bends to draw: none of {len(bends.placements)} placements shows enough of the board")
    at, size, sigma = (
        np.arange(len(found)),
        *(1000 * np.array([getattr(b, k) for b in found]) for k in ("size", "sigma")),
    )
    bent = np.array([b.bends for b in found])
    bars = {"width": 0.75, "capsize": 2, "error_kw": {"linewidth": 0.9, "ecolor": COLORS["truth"]}}
    for chosen, color, label in (
        (bent, COLORS["lrf"], "scan: bends"),
        (~bent, COLORS["raw"], "scan: too little to matter"),
    ):
        if chosen.any():
            ax.bar(at[chosen], size[chosen], yerr=sigma[chosen], color=color, label=label, **bars)
    sheet = 1000 * np.array([b.sheet for b in found])
    if np.isfinite(sheet).any():
        spread = 1000 * np.array([b.sheet_sigma for b in found])
        ax.errorbar(at, sheet, yerr=spread, fmt="D", color=COLORS["left"], markersize=4, capsize=2, linewidth=1,
                    label="images: change of the printed sheet")  # fmt: skip
    title = "no board bends"
    if bent.any():
        title = f"{bent.sum()} of {len(found)} boards bend in the scan, by up to {size[bent].max():.0f} mm"
    ax.set(xlabel="placement", ylabel="highest to lowest point [mm]", title=title, xticks=at)
    ax.set_xticklabels([b.placement for b in found])
    ax.set_ylim(0, 1.25 * np.nanmax(size + sigma))
    ax.grid(False, axis="x")
    ax.legend(ncols=3, fontsize="small", loc="upper left")
