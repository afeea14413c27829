"""What every figure of a notebook must keep: a title, labels with units, legible text that neither overlaps nor is cut.

Hooked into ``notebook.save`` wherever tests run notebooks: a figure is looked at as it was drawn, not drawn once more.
"""

import itertools
import re
from unittest.mock import patch

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.text import Text
from mpl_toolkits.mplot3d.art3d import Text3D

from lrfcal_lib.report import notebook

REPORT_WIDTH = 10.8
# inches at which a report shows a wide figure: 68 rem less the margins; points
SMALLEST = 8.0
COUNTS = {"iteration", "placement", "placements", "scan line"}
COUNTS |= {"chi-square per degree of freedom", "probability density"}  # have no unit
SLACK = 1.0  # pixels
LAYOUT = "figure.constrained_layout.use"  # drawing gives a figure without engine this one


def complaints(fig, renderer):
    """What is wrong with a figure as a renderer has just drawn it, a list of words."""
    shown = [ax for ax in fig.axes if ax.get_visible() and ax.has_data()]
    ticks = {axis: tick_labels(axis) for ax in fig.axes for axis in axes_of(ax)}
    apart = {
        text
        for ax in fig.axes
        for axis in ax._axis_map.values()
        for text in every_text(axis)
    }
    texts = fig.findobj(
        lambda a: (
            isinstance(a, Text)
            and not isinstance(a, Text3D)
            and a not in apart
            and is_drawn(a)
        )
    )
    texts += [
        *itertools.chain(*ticks.values()),
        *(axis.label for axis in ticks if is_drawn(axis.label)),
    ]
    boxes = {text: text.get_window_extent(renderer) for text in texts}
    found = (
        []
        if any(titles(ax) for ax in shown) or fig.get_suptitle()
        else ["no title says what the figure claims"]
    )
    for number, ax in enumerate(shown):
        found += [f"axes {number}: {words}" for words in about_axes(ax, ticks)]
    return found + [*about_texts(fig, boxes)]


def axes_of(ax):
    """The axes x, y (and z) that are drawn."""
    return [
        axis
        for axis in ax._axis_map.values()
        if ax.get_visible() and ax.axison and axis.get_visible()
    ]


def titles(ax):
    return "".join(ax.get_title(loc) for loc in ("left", "center", "right"))


def is_drawn(text):
    return bool(
        text.get_visible()
        and text.get_text().strip()
        and (text.axes is None or text.axes.get_visible())
    )


def every_text(axis):
    """Labels of an axis and of all its ticks, also of those out of view."""
    ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
    return [
        axis.label,
        axis.offsetText,
        *itertools.chain(*((tick.label1, tick.label2) for tick in ticks)),
    ]


def tick_labels(axis):
    """The labels of ticks within view."""
    scaled = axis.get_transform().transform
    ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
    low, high = sorted(scaled(np.array(axis.get_view_interval(), float)))
    at = scaled(np.array([tick.get_loc() for tick in ticks], float))
    margin = 1e-6 * (high - low)
    ticks = [
        t
        for t, x in zip(ticks, at, strict=True)
        if t.get_visible() and low - margin <= x <= high + margin
    ]
    return [
        label
        for t in ticks
        for label in (t.label1, t.label2)
        if label.get_visible() and label.get_text().strip()
    ]


def about_axes(ax, ticks):
    units = []
    for axis in axes_of(ax):
        label = axis.label.get_text()
        names = [text.get_text() for text in ticks[axis]]
        numbers = all(re.fullmatch(r"[-−\d.,e]+|\$.*\$", name) for name in names)
        units += re.findall(r"\[(.+?)\]$", label)
        if names and numbers and not (re.search(r"\[.+\]$|/", label) or label in COUNTS):
            yield f"'{label}' of the {axis.axis_name} axis has no unit"
    if (
        len(units) == 2
        and units[0] == units[1]
        and units[0] in ("m", "px", "deg")
        and ax.get_aspect() == "auto"
    ):
        yield f"{ax.get_xlabel()} and {ax.get_ylabel()} are drawn at different scales"
    if ax.images and not titles(ax) and not ax.figure.get_suptitle():
        yield "an image without a title"


def about_texts(fig, boxes):
    """Text that is too small, outside the canvas, or over other text."""
    factor = min(1.0, REPORT_WIDTH / fig.get_figwidth())
    for text, box in boxes.items():
        if text.get_fontsize() * factor < SMALLEST - 0.01:
            yield f"'{text.get_text()}' is {text.get_fontsize() * factor:.1f} pt in the report"
        hidden = (
            text.get_clip_on() and text.get_clip_path() and not text.axes.bbox.overlaps(box)
        )
        if not hidden and not (
            (box.min >= fig.bbox.min - SLACK).all()
            and (box.max <= fig.bbox.max + SLACK).all()
        ):
            yield f"'{text.get_text()}' is cut off"
    level = [text for text in boxes if text.get_rotation() % 90 == 0]
    for a, b in itertools.combinations(level, 2):
        low = np.maximum(boxes[a].min, boxes[b].min)
        high = np.minimum(boxes[a].max, boxes[b].max)
        if (high - low > SLACK).all():
            yield f"'{a.get_text()}' lies over '{b.get_text()}'"


def checked(save, told=None):
    """A ``notebook.save`` that looks at what it drew: complaints are added to the list `told`, or raised.

    It writes no files. The figure is laid out a second time, which settles it as in a report.
    """

    def save_and_look(fig, name, caption, *, main=True):
        found = []
        with (
            patch.object(notebook, "report_file", lambda name: None),
            plt.rc_context({LAYOUT: False}),
        ):
            save(fig, name, caption, main=main)
            fig.canvas.mpl_connect(
                "draw_event", lambda drawn: found.extend(complaints(fig, drawn.renderer))
            )
            fig.draw_without_rendering()
        words = [f"{name}: {complaint}" for complaint in found]
        assert told is not None or not words, "\n".join(words)
        told is None or told.extend(words)

    return save_and_look
