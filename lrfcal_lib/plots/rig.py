"""Drawings in space, and coloured clouds as a camera sees them."""

import numpy as np
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.plots.recording import AXES_RGB, COLORS, color_of

SURFACE = {
    "color": COLORS["left"],
    "alpha": 0.15,
    "linewidth": 0,
    "antialiased": True,
    "shade": True,
}


def frames(ax, transforms, length=0.1):
    """Coordinate frames in space: x red, y green, z blue.

    `transforms` lead from each frame, by name, to the one drawn in; `length` of the arrows in
    metres.
    """
    for name, transform in transforms.items():
        for axis, color in zip(np.eye(3), AXES_RGB, strict=True):
            ax.plot(*transform.apply(np.outer([0, length], axis)).T, color=color, linewidth=1.8)
        ax.text(
            *transform.apply([-0.35 * length] * 3),
            name,
            fontsize=8,
            color=color_of(name, 7),
            weight="bold",
        )


def polygon(ax, corners, color=COLORS["truth"]):
    """A flat polygon in space, for instance a board; corners (n, 3) in metres."""
    ax.add_collection3d(Poly3DCollection([corners], facecolors=color, edgecolors=color, alpha=0.15))
    ax.plot(*np.vstack([corners, corners[:1]]).T, color=color, linewidth=1.2)


def rays(ax, origin, points):
    """Beams in space, from an origin (3,) or (n, 3) to the points (n, 3) that they hit, metres."""
    beams = np.stack([np.broadcast_to(origin, np.shape(points)), points], axis=1)
    color = COLORS["lrf"]
    ax.add_collection3d(Line3DCollection(beams, colors=color, linewidths=0.4, alpha=0.35))
    ax.plot(*np.asarray(points).T, ".", color=color, markersize=2.5)


def lines(ax, drawn):
    """Lines in space by name: a colour and points (n, 3), with NaN rows where a line breaks."""
    for name, (color, points) in drawn.items():
        ax.plot(*np.transpose(points), color=color, linewidth=1.6, label=name)


def space(ax, points, elev=22.0, azim=-60.0, zoom=1.0, labels=True):
    """Equal scales and a view for axes in space, limits from the points (n, 3) to show, metres.

    One looks from `elev` and `azim` (degrees); `zoom`: Matplotlib leaves wide margins around flat
    scenes. Without `labels` the axes are not drawn at all.
    """
    low = np.min(points, axis=0)
    high = np.max(points, axis=0)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    ax.set_box_aspect(np.maximum(high - low, 1e-6), zoom=zoom)
    ax.view_init(elev=elev, azim=azim)
    ax.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    if not labels:
        ax.set_axis_off()


def sphere(ax, centre, radius):
    """The set a point allows, figure 3 (a): the surface of a sphere, metres."""
    u, v = np.mgrid[0 : 2 * np.pi : 36j, 0 : np.pi : 19j]
    ball = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
    ax.plot_surface(*(np.reshape(centre, (3, 1, 1)) + radius * ball), **SURFACE)


def cylinder(ax, point, direction, radius, half_length):
    """The set a line allows, figure 3 (b): a cylinder around it, metres.

    `direction` is a unit vector.
    """
    across = np.linalg.svd(np.asarray(direction, float)[None])[2][1:]
    u, s = np.mgrid[0 : 2 * np.pi : 36j, -half_length:half_length:9j]
    ring = radius * (np.cos(u)[..., None] * across[0] + np.sin(u)[..., None] * across[1])
    ax.plot_surface(
        *np.moveaxis(point + ring + s[..., None] * np.asarray(direction), -1, 0), **SURFACE
    )
    ax.plot(*(point + np.outer([-half_length, half_length], direction)).T, color=COLORS["truth"])


def slab(ax, point, normal, thickness, half_width):
    """The set a plane allows, figure 3 (c): from it to its parallel near the sensor, metres."""
    across = np.linalg.svd(np.asarray(normal, float)[None])[2][1:]
    square = half_width * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ across + point
    polygon(ax, square)
    polygon(ax, square + thickness * np.asarray(normal), COLORS["left"])


def render(points, colors, T_view, size, focal=None, splat=1):
    """A coloured cloud as a pinhole camera sees it: the nearest point of each pixel, or white.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Metres; NaN rows and points behind the camera are left out.
    colors : ndarray of uint8, shape (n, 3)
        In the order wanted in the picture.
    T_view : RigidTransform
        From the frame of the points to the view (x right, y down, z ahead).
    size : (int, int)
        Height and width, pixels.
    focal : float, optional
        Pixels; the width (53 deg across) unless given.
    splat : int
        Each point covers (2 splat + 1)^2 pixels.
    """
    height, width = size
    seen = T_view.apply(np.asarray(points, float))
    keep = np.flatnonzero(np.isfinite(seen).all(axis=1) & (seen[:, 2] > 1e-6))
    # far to near: of equal pixels the last one written stays
    keep = keep[np.argsort(-seen[keep, 2], kind="stable")]
    seen = seen[keep]
    colors = np.asarray(colors, np.uint8)[keep]
    uv = np.rint(pixels(seen, (height, width), focal)).astype(int)
    winner = np.full((height, width), -1)
    for dv, du in np.ndindex(2 * splat + 1, 2 * splat + 1):
        u = uv[:, 0] + du - splat
        v = uv[:, 1] + dv - splat
        inside = np.flatnonzero((u >= 0) & (u < width) & (v >= 0) & (v < height))
        layer = np.full((height, width), -1)
        layer[v[inside], u[inside]] = inside
        winner = np.maximum(winner, layer)  # a larger index is nearer
    # the last row where no point is
    return np.vstack([colors, np.full((1, 3), 255, np.uint8)])[winner]


def pixels(seen, size, focal=None):
    """Where points of the view (n, 3) stand in a picture of :func:`render`, shape (n, 2)."""
    return (focal or size[1]) * seen[:, :2] / seen[:, 2:] + [(size[1] - 1) / 2, (size[0] - 1) / 2]


def look_at(eye, target, up=(0.0, 0.0, 1.0)):
    """The view from one point to another (metres) for :func:`render`, a transform of points.

    `up` is shown upwards. A ValueError if eye and target coincide, or `up` is the line of sight.
    """
    eye, ahead = np.asarray(eye, float), np.subtract(target, eye)
    right = np.cross(ahead, up)
    if np.linalg.norm(right) < 1e-9 * max(np.linalg.norm(ahead), 1e-300) or not ahead.any():
        raise ValueError(
            f"no view from {eye} to {target} with {up} upwards: choose another eye or another up"
        )
    right = right / np.linalg.norm(right)
    ahead = ahead / np.linalg.norm(ahead)
    rotation = Rotation.from_matrix(np.stack([right, np.cross(ahead, right), ahead]))
    return RigidTransform.from_components(-rotation.apply(eye), rotation)


def measured_edges(ax, measured, known, T_view, size, focal=None):
    """Edges of a MeasuredBoard over a picture of :func:`render`, with lengths and `known` ones."""
    names = list(known)
    middle = pixels(T_view.apply(measured.T_platform_plane[None, :3, 3]), size, focal)[0]
    for name, length in measured.lengths.items():
        ends = [
            measured.corner_point(n) for n in (name, names[(names.index(name) + 1) % len(names)])
        ]
        uv = pixels(T_view.apply(np.array(ends)), size, focal)
        ax.plot(*uv.T, "o-", color=COLORS["fit"])
        away = uv.mean(axis=0) - middle
        words = f"{1000 * length:.1f} mm\ntrue {1000 * known[name]:.1f} mm"
        at = uv.mean(axis=0) + 0.07 * size[1] * away / np.linalg.norm(away)
        looks = {"ha": "center", "va": "center"}
        ax.text(*at, f"{name.upper()} {words}", color=COLORS["fit"], **looks)
