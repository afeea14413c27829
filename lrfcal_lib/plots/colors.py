"""One colour a sensor or role in every figure."""

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
SERIES = ("#0072b2", "#d55e00", "#009e73", "#b5378a", "#e69f00", "#56b4e9", "#7a5c3e", "#222222")
AXES_RGB = ("#d62728", "#2ca02c", "#1f5fd6")  # x, y, z of every frame


def color_of(name, index=0):
    """The colour of a sensor or role, or the `index`-th colour of a series for any other name."""
    return COLORS.get(name, SERIES[index % len(SERIES)])
