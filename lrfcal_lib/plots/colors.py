"""A colour for each sensor, role and axis; without matplotlib, which takes a second to load."""

import numpy as np

COLORS = {
    "lrf": "#d55e00",
    "left": "#0072b2",
    "right": "#009e73",
    "fit": "#b5378a",
    "truth": "#222222",
    "raw": "#a3a3a3",
    "filtered": "#e69f00",
    "outlier": "#cc2222",
    "platform": "#666666",
}
SERIES = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#b5378a",
    "#e69f00",
    "#56b4e9",
    "#7a5c3e",
    "#222222",
)
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
