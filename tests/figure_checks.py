"""What every figure of a notebook must keep: a title, labels with units, legible text that neither overlaps nor is cut.

Hooked into ``notebook.save`` wherever tests run notebooks: a figure is looked at as it was drawn, not drawn once more.
"""

import itertools
import re

import numpy as np
from matplotlib.text import Text

from lrfcal_lib.report import notebook

REPORT_WIDTH, SMALLEST = 10.8, 8.0  # inches at which a report shows a wide figure: 68 rem less the margins; points
COUNTS = ("iteration", "placement", "placements", "scan line", "edge", "chi-square per degree of freedom")
SLACK = 1.0  # pixels


def complaints(fig, renderer):
    """What is wrong with a figure as a renderer has just drawn it, a list of words."""
    shown = [ax for ax in fig.axes if ax.get_visible() and ax.has_data()]
    ticks = {axis: tick_labels(axis) for ax in fig.axes for axis in axes_of(ax)}
    texts = [*fig.findobj(lambda a: isinstance(a, Text) and not of_axis(a) and is_drawn(a)), *itertools.chain(*ticks.values())]
    texts += [axis.label for axis in ticks if axis.label.get_text().strip() and is_drawn(axis.label)]
    boxes = {text: text.get_window_extent(renderer) for text in texts}
    found = [] if any(titles(ax) for ax in shown) or fig.get_suptitle() else ["no title says what the figure claims"]
    for number, ax in enumerate(shown):
        found += [f"axes {number}: {words}" for words in about_axes(ax, ticks)]
    return found + [*about_texts(fig, boxes, {label: axis for axis, labels in ticks.items() for label in labels})]


def axes_of(ax):
    """The axes x, y (and z) that are drawn."""
    return [axis for axis in ax._axis_map.values() if ax.get_visible() and ax.axison and axis.get_visible()]


def titles(ax):
    return "".join(ax.get_title(loc) for loc in ("left", "center", "right"))


def is_drawn(text):
    return bool(text.get_visible() and text.get_text().strip() and (text.axes is None or text.axes.get_visible()))


def of_axis(text):
    """Whether it is a label of an axis or of a tick."""
    axes = text.axes._axis_map.values() if text.axes else ()
    return any(text is axis.label or text is axis.offsetText or text in every_label(axis) for axis in axes)


def every_label(axis):
    return [label for tick in [*axis.majorTicks, *axis.minorTicks] for label in (tick.label1, tick.label2)]


def tick_labels(axis):
    """The labels of ticks within view, along the axis."""
    low, high = sorted(axis.get_view_interval())
    margin = 1e-6 * (high - low)
    ticks = [t for t in [*axis.majorTicks, *axis.minorTicks] if low - margin <= t.get_loc() <= high + margin]
    ticks = sorted((t for t in ticks if t.get_visible()), key=lambda tick: tick.get_loc())
    return [label for t in ticks for label in (t.label1, t.label2) if label.get_visible() and label.get_text().strip()]


def about_axes(ax, ticks):
    units = []
    for axis in axes_of(ax):
        label, names = axis.label.get_text(), [text.get_text() for text in ticks[axis]]
        numbers = all(re.fullmatch(r"[-−\d.,e]+|\$.*\$", name) for name in names)
        units += re.findall(r"\[(.+?)\]$", label)
        if names and numbers and not (re.search(r"\[.+\]$|/", label) or label in COUNTS):
            yield f"'{label}' of the {axis.axis_name} axis has no unit"
    if len(units) == 2 and units[0] == units[1] and units[0] in ("m", "px", "deg") and ax.get_aspect() == "auto":
        yield f"{ax.get_xlabel()} and {ax.get_ylabel()} are drawn at different scales"
    if ax.images and not titles(ax) and not ax.figure.get_suptitle():
        yield "an image without a title"


def about_texts(fig, boxes, axis_of):
    """Text that is too small, outside the canvas, or over other text."""
    factor = min(1.0, REPORT_WIDTH / fig.get_figwidth())
    for text, box in boxes.items():
        if text.get_fontsize() * factor < SMALLEST - 0.01:
            yield f"'{text.get_text()}' is {text.get_fontsize() * factor:.1f} pt in the report"
        hidden = text.get_clip_on() and text.axes and not text.axes.bbox.overlaps(box)
        if not hidden and not ((box.min >= fig.bbox.min - SLACK).all() and (box.max <= fig.bbox.max + SLACK).all()):
            yield f"'{text.get_text()}' is cut off"
    level = [text for text in boxes if text.get_rotation() % 90 == 0]
    for a, b in itertools.combinations(level, 2):
        low, high = np.maximum(boxes[a].min, boxes[b].min), np.minimum(boxes[a].max, boxes[b].max)
        if (high - low > SLACK).all():
            yield f"'{a.get_text()}' lies over '{b.get_text()}'"


def checked(save, told=None):
    """A ``notebook.save`` that looks at what it draws: complaints are added to the list `told`, or raised."""

    def save_and_look(fig, name, caption, *, main=True):
        found = []
        fig.canvas.mpl_connect("draw_event", lambda drawn: found.__setitem__(slice(None), complaints(fig, drawn.renderer)))
        save(fig, name, caption, main=main)
        words = [f"{name}: {complaint}" for complaint in found]
        assert told is not None or not words, "\n".join(words)
        told is None or told.extend(words)

    return save_and_look
