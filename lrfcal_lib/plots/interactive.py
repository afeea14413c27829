"""A scene to turn in a browser, one offline page: points, frames, boards and camera frusta."""

import numpy as np

from lrfcal_lib.plots.recording import AXES_RGB, COLORS, color_of

MOST_POINTS = 150_000  # that browsers turn smoothly


def scene_page(path, points, colors, seen, lines, eye=(-0.3, -1.5, 0.55)):
    """Write a page that needs no other file and no network.

    Parameters
    ----------
    path : path
    points : ndarray, shape (n, 3)
        Metres; every so many are left out beyond `MOST_POINTS`.
    colors : ndarray of uint8, shape (n, 3)
    seen : ndarray of bool, shape (n,)
        The others are hidden until one clicks on them in the legend.
    lines : dict of str to (str, ndarray of shape (m, 3))
        What else to draw, by its name in the legend: a colour and a line, NaN rows where it breaks.
    eye : tuple of float
        Where one looks from at first, in widths of the scene from its middle.
    """
    import plotly.graph_objects as go

    every = -(-len(points) // MOST_POINTS) or 1
    clouds = []
    for name, which, shown in (
        ("points", seen, True),
        ("points that no image saw", ~seen, "legendonly"),
    ):
        x, y, z = np.asarray(points[which][::every], np.float32).T
        shades = [
            f"#{value:06x}"
            for value in (colors[which][::every].astype(int) @ [65536, 256, 1]).tolist()
        ]
        dots = {"mode": "markers", "marker": {"size": 1.6, "color": shades}}
        clouds.append(go.Scatter3d(x=x, y=y, z=z, name=name, visible=shown, **dots))
    for name, (color, line) in lines.items():
        x, y, z = np.asarray(line, np.float32).T
        clouds.append(
            go.Scatter3d(x=x, y=y, z=z, mode="lines", line={"color": color, "width": 4}, name=name)
        )
    axes = {f"{axis}axis": {"title": f"{axis} [m]"} for axis in "xyz"}
    figure = go.Figure(clouds)
    view = {"eye": dict(zip("xyz", eye, strict=True)), "up": {"x": 0, "y": 0, "z": 1}}
    figure.update_layout(
        scene={**axes, "aspectmode": "data", "camera": view},
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        legend={"itemsizing": "constant", "x": 0, "y": 1},
        hovermode=False,
    )
    figure.write_html(
        path, include_plotlyjs=True, full_html=True, div_id="scene", default_height="100vh"
    )


def rig_lines(T_head_lrf, cameras, boards=None, size=0.15):
    """Lines of :func:`scene_page` that show a rig and boards in the platform frame.

    `cameras` are (``T_camera_platform``, CameraModel) by name, `boards` corners (n, 3) by name;
    `size` in metres.
    """
    gap = np.full((1, 3), np.nan)
    lines = {}
    lines["tilt axis"] = COLORS["platform"], np.array([[-4 * size, 0.0, 0.0], [4 * size, 0.0, 0.0]])
    frames = {"lrf": T_head_lrf} | {name: T.inv() for name, (T, _) in cameras.items()}
    for axis, color in enumerate(AXES_RGB):
        ends = [
            np.vstack([T.apply(np.outer([0, size], np.eye(3)[axis])), gap]) for T in frames.values()
        ]
        lines[f"{'xyz'[axis]} of {', '.join(frames)}"] = color, np.vstack(ends)
    for name, (T, model) in cameras.items():
        u = np.array([0, model.width, model.width, 0, 0])
        v = np.array([0, 0, model.height, model.height, 0])
        rim = (
            np.stack([(u - model.cx) / model.fx, (v - model.cy) / model.fy, np.ones(5)], axis=1)
            * 3
            * size
        )
        legs = [np.vstack([np.zeros(3), corner, gap]) for corner in rim[:4]]
        lines[f"view of {name}"] = color_of(name), T.inv().apply(np.vstack([rim, gap, *legs]))
    if boards:
        lines["boards"] = (
            COLORS["fit"],
            np.vstack([np.vstack([c, c[:1], gap]) for c in boards.values()]),
        )
    return lines
