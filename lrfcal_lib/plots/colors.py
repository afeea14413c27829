"""A colour for each sensor, role and axis; without matplotlib, which takes a second to load."""

import numpy as np

LRF = "#d55e00"
LEFT = "#0072b2"
RIGHT = "#009e73"
FIT = "#b5378a"
TRUTH = "#222222"
RAW = "#a3a3a3"
FILTERED = "#e69f00"
OUTLIER = "#cc2222"
PLATFORM = "#666666"
COLORS = {
    "lrf": LRF,
    "left": LEFT,
    "right": RIGHT,
    "fit": FIT,
    "truth": TRUTH,
    "raw": RAW,
    "platform": PLATFORM,
}
SERIES = (LEFT, LRF, RIGHT, FIT, FILTERED, "#56b4e9", "#7a5c3e", TRUTH)
AXES_RGB = ("#d62728", "#2ca02c", "#1f5fd6")  # x, y, z of every frame


def series(index: int) -> str:
    """The colour of the `index`-th thing of a series."""
    return SERIES[index % len(SERIES)]


def color_of(name: str, index: int = 0) -> str:
    """The colour of a sensor or role.

    Parameters
    ----------
    name
        A key of `COLORS`, or any other name.
    index
        Of the colour in a series, for any other name.
    """
    return COLORS.get(name, series(index))


def closed(corners: np.ndarray) -> np.ndarray:
    """Corners (n, d) of a polygon with the first one at the end as well."""
    return np.vstack([corners, corners[:1]])
