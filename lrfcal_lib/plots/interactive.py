"""A scene to turn in a browser, one offline page: points, frames, boards and camera frusta."""

import base64
import json
from collections.abc import Mapping
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.board import UNIT_SQUARE
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.plots.colors import AXES_RGB, FIT, PLATFORM, closed, color_of

MOST_POINTS = 150_000  # that browsers turn smoothly
SCRIPT = Path(__file__).with_name("scene.js")
EYE = {
    "x": -0.3,
    "y": -1.5,
    "z": 0.55,
}  # where one looks from at first, in widths of the scene
GAP = np.full((1, 3), np.nan)  # where a line breaks


def scene_page(
    path: str | PathLike,
    points: np.ndarray,
    colors: np.ndarray,
    seen: np.ndarray,
    lines: Mapping[str, tuple[str, np.ndarray]],
    note: str = "",
    title: str = "",
    measuring: Mapping[str, Any] | None = None,
) -> None:
    """Write a page that needs no other file and no network.

    Parameters
    ----------
    path
    points
        Shape (n, 3), metres; every so many are left out beyond `MOST_POINTS`.
    colors
        Of uint8, shape (n, 3).
    seen
        Of bool, shape (n,): the others have a name of their own in the legend.
    lines
        What else to draw, by its name in the legend: a colour and points (m, 3), NaN rows where
        the line breaks. Boards are hidden until one clicks on them there.
    note
        A sentence at the bottom of the page.
    title
        At its top.
    measuring
        What :func:`lrfcal_lib.measure.lengths.for_page` gives for these points: two clicks give a
        length.
    """
    every = -(-len(points) // MOST_POINTS) or 1
    shown = {
        "points": np.flatnonzero(seen)[::every],
        "points that no image saw": np.flatnonzero(~seen)[::every],
    }
    traces = []
    for name, rows in shown.items():
        shades = [f"#{color.tobytes().hex()}" for color in colors[rows]]
        marker = {"size": 1.6, "color": shades}
        traces.append(
            _trace(name, points[rows], "markers", marker=marker, hoverinfo="none")
        )
    for name, (color, line) in lines.items():
        looks = {"color": color, "width": 4}
        visible = "legendonly" if name == "boards" else True
        traces.append(_trace(name, line, "lines", line=looks, visible=visible))
    data = None
    if measuring is not None:
        data = dict(measuring, edges_trace=len(traces), lengths_trace=len(traces) + 1)
        for name in ("plane_of_point", "station_of_point"):
            data[name] = [measuring[name][rows] for rows in shown.values()]
        traces += _measured_traces(data.pop("lines"))
    options = {"scrollZoom": False, "responsive": True}
    plot = _in_script([traces, _layout(title, note), options])
    page = (
        '<html><head><meta charset="utf-8"></head><body>\n'
        f"<script>{_plotly_js()}</script>\n"
        '<div id="scene" style="height:100vh"></div>\n'
        f"<script>Plotly.newPlot('scene', ...{plot}).then((scene) => {{\n"
        f"{SCRIPT.read_text()}\nslowWheel(scene);\n"
        f"panel(scene, {_in_script(data)});\n}});</script>\n"
        "</body></html>\n"
    )
    Path(path).write_text(page, encoding="utf-8")


def _in_script(data):
    """As JSON, arrays of numbers as text; no text in it ends the script that it stands in."""
    packed = json.dumps(data, separators=(",", ":"), default=_text)
    return packed.replace("<", "\\u003c")


def _plotly_js():
    """The script that draws; to import its package takes a fifth of a second."""
    package = Path(find_spec("plotly").origin).parent
    return (package / "package_data/plotly.min.js").read_text(encoding="utf-8")


def _layout(title, note):
    """Axes of one scale, an orbit that keeps the vertical, a title and a note."""
    axes = {
        f"{axis}axis": {"title": {"text": f"{axis} [m]"}, "showspikes": False}
        for axis in "xyz"
    }
    view = {"eye": EYE, "up": {"x": 0, "y": 0, "z": 1}}
    return {
        "scene": {**axes, "aspectmode": "data", "camera": view, "dragmode": "turntable"},
        "margin": {"l": 0, "r": 0, "t": 30 if title else 0, "b": 0},
        "title": {"text": title, "x": 0.5, "y": 0.99, "yanchor": "top"},
        "legend": {"itemsizing": "constant", "x": 0, "y": 1},
        "hovermode": "closest",
        "annotations": [
            {
                "text": note,
                "x": 0,
                "y": 0,
                "showarrow": False,
                "xref": "paper",
                "yref": "paper",
                "xanchor": "left",
                "yanchor": "bottom",
            }
        ],
    }


def _measured_traces(lines):
    """Edges (n, 2, 3) that can be picked, and the lengths that were."""
    red = "#d00"
    return [
        _trace(
            "edges",
            np.insert(lines, 2, np.nan, axis=1).reshape(-1, 3),
            "lines",
            line={"color": FIT, "width": 3},
            visible="legendonly",
            hoverinfo="skip",
        ),
        _trace(
            "lengths",
            np.zeros((0, 3)),
            "lines+markers",
            line={"color": red, "width": 6},
            marker={"color": red, "size": 4},
            hoverinfo="skip",
        ),
    ]


def _trace(name, points, mode, **style):
    """Points (n, 3) as plotly draws them; the coordinates packed."""
    trace = {"type": "scatter3d", "name": name, "mode": mode, **style}
    for axis, values in zip("xyz", points.T, strict=True):
        trace[axis] = {"dtype": "f4", "bdata": values}
    return trace


def _text(values):
    """An array of numbers as the text of single-precision bytes."""
    return base64.b64encode(values.astype("<f4", order="C")).decode()


def _broken(lines):
    """Lines, each of points (n, 3), as one line of breaks between them."""
    return np.vstack([part for line in lines for part in (line, GAP)])


def rig_lines(
    T_head_lrf: RigidTransform,
    cameras: Mapping[str, tuple[RigidTransform, CameraModel]],
    boards: Mapping[str, np.ndarray] | None = None,
    size: float = 0.15,
) -> dict[str, tuple[str, np.ndarray]]:
    """Lines of :func:`scene_page` that show a rig and boards in the platform frame.

    Parameters
    ----------
    T_head_lrf
    cameras
        ``T_camera_platform`` and intrinsics by name.
    boards
        Corners (n, 3) by name, metres.
    size
        Of a frame's axes, metres.
    """
    lines = {"tilt axis": (PLATFORM, np.outer([-4 * size, 4 * size], [1.0, 0.0, 0.0]))}
    frames = {"lrf": T_head_lrf}
    for name, (T, _) in cameras.items():
        frames[name] = T.inv()
    for letter, axis, color in zip("xyz", size * np.eye(3), AXES_RGB, strict=True):
        arrows = _broken(T.apply([0 * axis, axis]) for T in frames.values())
        lines[f"{letter} of {', '.join(frames)}"] = (color, arrows)
    for name, (_, model) in cameras.items():
        rim = 3 * size * model.sights(model.size * UNIT_SQUARE)
        legs = np.insert(rim[:, None], 0, 0.0, axis=1)
        frustum = _broken([closed(rim), *legs])
        lines[f"view of {name}"] = (color_of(name), frames[name].apply(frustum))
    if boards:
        lines["boards"] = (FIT, _broken(map(closed, boards.values())))
    return lines
