"""Figures of what is wrong with a recording: cameras that moved, boards that bend."""

from __future__ import annotations

import numpy as np

from lrfcal_lib.plots.colors import COLORS, color_of


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
