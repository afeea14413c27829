"""What every notebook needs around its subject: its looks, its session, and where figures, tables
and findings go.

Nothing is written outside a report run (:mod:`lrfcal_lib.report.report`), which sets
``LRFCAL_SESSION`` (folder of the session), ``LRFCAL_REPORT`` (takes ``figures/``, ``tables/`` and
``parts/``) and ``LRFCAL_NOTEBOOK`` (a name in these).
"""

import ast
import json
import math
import os
import re
from collections import defaultdict
from collections.abc import Sequence
from numbers import Number
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd
from IPython import get_ipython
from IPython.display import HTML, display
from matplotlib.figure import Figure

from lrfcal_lib.session.read import Session, open_session
from lrfcal_lib.session.shown import escape
from lrfcal_lib.solvers import METHODS

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = ROOT / "data" / "sim_lms221"
STYLE = Path(__file__).with_name("figures.mplstyle")
UNITS = {  # by the last word of a column's name, in its heading
    "deg": "[deg]",
    "mm": "[mm]",
    "px": "[px]",
    "m": "[m]",
    "m3": "[m³]",
    "percent": "[%]",
    "radii": "[spot radii]",
}
OTHER_LABELS = {  # of what is no row of METHODS
    "joint": "joint estimate",
    "three_planes": "three-plane start, robust search",
    "line_3d": "lines in space",
    "projected_last_beam": "projected lines, last beam",
    "projected_printed": "projected lines as the paper prints them",
}
# read by Open3D when it is imported, perhaps in the same cell as this module
os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
_found: dict[str, list] = defaultdict(list)  # figures, tables, findings and verdicts
NEEDS = "notebook.needs("
_lacking: set[str] = (
    set()
)  # 'section' or 'notebook': where nothing is done, for want of data


def set_up() -> None:
    """Style figures and tables and keep libraries quiet; for a notebook that needs no session."""
    # without it Mesa complains on stderr, in some runs only
    os.environ.setdefault("XDG_RUNTIME_DIR", "/tmp")
    plt.style.use(STYLE)
    pd.set_option("display.precision", 4, "display.max_rows", 40, "display.width", 120)
    # the same pixels must give the same bytes: no version of matplotlib in the PNG
    if get_ipython() is not None:
        kwargs = {"bbox_inches": None, "metadata": {"Software": None}}
        get_ipython().run_line_magic(
            "config", f"InlineBackend.print_figure_kwargs = {kwargs}"
        )
        get_ipython().ast_transformers[:] = [Sections()]
    _lacking.clear()
    _found.clear()


def start() -> Session:
    """First cell of a notebook: the session of the report run, else the shipped one."""
    set_up()
    return open_session(os.environ.get("LRFCAL_SESSION") or SHIPPED)


def report_file(name: str) -> Path | None:
    """Path of a file of the report, its folder made; None outside a report run.

    Parameters
    ----------
    name
        Within the report, such as ``"cloud.ply"``.
    """
    if not os.environ.get("LRFCAL_REPORT"):
        return None
    path = Path(os.environ["LRFCAL_REPORT"]) / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def save(fig: Figure, name: str, caption: str, *, main: bool = True) -> None:
    """Show a figure with its caption, and keep it as ``figures/<name>.png`` in a report run.

    Parameters
    ----------
    fig
        Closed afterwards.
    name
        Lower-case letters, digits and underscores; others raise a ValueError.
    caption
        One or two sentences; what to see, not what the axes say.
    main
        Whether the first page of the report shows it.
    """
    _record("figures", name, name=name, caption=caption, main=main)
    # drawing gives a figure without layout engine the default one, which would move what was placed
    # by hand
    with plt.rc_context({"figure.constrained_layout.use": False}):
        # equal scales and ticks move what is laid out: a second pass settles them
        fig.draw_without_rendering()
        if path := report_file(f"figures/{name}.png"):
            fig.savefig(path, metadata={"Software": None})
        if get_ipython() is not None:
            words = f'<p id="figure-{name}" style="color:#555;max-width:48em">{escape(caption)}</p>'
            display(fig, HTML(words))
    plt.close(fig)


def table(
    df: pd.DataFrame, name: str, digits: int | dict[str, int] = 3, caption: str = ""
) -> HTML:
    """A table to show, its columns and methods in words, kept as ``tables/<name>.csv`` in a report
    run.

    Parameters
    ----------
    df
        Tidy: one row an observation, units in the column names. Its index is not kept.
    name
        Lower-case letters, digits and underscores; others raise a ValueError.
    digits
        Decimals shown (all columns, or by column; 3 where a column is not named). The CSV keeps
        nine digits.
    caption

    Returns
    -------
    IPython.display.HTML
        The same bytes for the same table.
    """
    places = digits if isinstance(digits, dict) else dict.fromkeys(df.columns, digits)
    # none shows a minus before a zero
    shapes = {c: f"{{:z.{places.get(c, 3)}f}}" for c in df.select_dtypes("floating")}
    if "p_value" in shapes:
        shapes["p_value"] = "{:.2g}"  # a small chance is not none
    if path := report_file(f"tables/{name}.csv"):
        df.to_csv(path, index=False, float_format="%.9g")
    shown = df.reset_index(drop=True)
    for column in shown.select_dtypes(exclude=["number", "bool"]):
        words = str if column == "source" else in_words  # a session is called as it is
        shown[column] = [
            v if v is None or isinstance(v, Number) else escape(words(v))
            for v in shown[column]
        ]
    styler = shown.style.format(shapes, na_rep="–").format_index(
        lambda c: escape(in_words(c, True)), axis=1
    )
    caption = caption or in_words(name).capitalize()
    styler.hide(axis="index").set_caption(escape(caption))
    made = styler.to_html(table_uuid=name)
    _record("tables", name, name=name, caption=caption, html=made)
    return HTML(made)


def label_of(name: str) -> str:
    """What a method is called in tables and figures; any other text as it is.

    Parameters
    ----------
    name
    """
    return METHODS[name].label if name in METHODS else OTHER_LABELS.get(name, name)


def in_words(text: object, column: bool = False) -> Any:
    """An identifier in words: a method by its name; everything else as it is.

    Parameters
    ----------
    text
    column
        It is the name of a column, whose last word may be its unit.
    """
    if not isinstance(text, str):
        return text
    label = label_of(text)
    if label != text or not re.fullmatch(r"[a-z0-9]+(_[a-z0-9]+)+", text):
        return label
    *words, last = text.split("_")
    if column:
        last = UNITS.get(last, last)
    return " ".join((*words, last))


def finding(
    key: str,
    value: float | str,
    text: str,
    unit: str = "",
    digits: int = 3,
    *,
    main: bool = True,
) -> None:
    """Print a key result, and put it in ``findings.json`` and on the first page of the report.

    Parameters
    ----------
    key
        Lower-case letters, digits and underscores (others raise a ValueError); unique over all
        notebooks.
    value
        A verdict in words, or a number (NaN is said to be unknown).
    text
        What the value is of, a phrase that reads without the notebook.
    unit
    digits
        Decimals.
    main
        Whether the first page shows it.
    """
    if hasattr(value, "item"):
        value = value.item()
    shown = str(value)
    if isinstance(value, float):
        shown = f"{value:z.{digits}f}"
        if not math.isfinite(value):
            shown = "unknown"
            value = None
    shown = f"{shown} {unit}".strip()
    _record(
        "findings",
        key,
        key=key,
        value=value,
        unit=unit,
        text=text,
        shown=shown,
        main=main,
    )
    print(f"{text}: {shown}")


def verdict(title: str, sentences: Sequence[str], record: dict | None = None) -> None:
    """Print sentences, and put them on the first page of the report before all else.

    Parameters
    ----------
    title
    sentences
        The most important one first.
    record
        Of a :class:`lrfcal_lib.judge.verdict.Verdict`: its answer and expected errors stand in
        front.
    """
    sentences = [
        f"{words[:1].upper()}{words[1:].removesuffix('.')}." for words in sentences
    ]
    _record("verdicts", "verdict", title=title, sentences=sentences, record=record)
    print(title, *(f"  {sentence}" for sentence in sentences), sep="\n")


def asked(possible: object, why: str) -> bool:
    """Whether a question can be put to a session; prints why not.

    Parameters
    ----------
    possible
    why
        What the session does not have.
    """
    if not possible:
        print(f"not asked: {why}")
    return bool(possible)


def needs(possible: object = True, why: str = "", *, rest: bool = False) -> bool:
    """What follows needs something of the session; without it nothing is done, and that is printed.

    So it is up to the next call, also for the rest of the same cell.

    Parameters
    ----------
    possible
        Nothing more is needed, unless given.
    why
        What the session does not have.
    rest
        Nothing at all can be done without it, until :func:`start`.
    """
    _lacking.discard("section")
    if not asked(possible, why):
        _lacking.add("notebook" if rest else "section")
    return bool(possible)


class Sections(ast.NodeTransformer):
    """Takes out of cells what a call of :func:`needs` leaves undone."""

    def visit_Module(self, node: ast.Module) -> ast.Module:
        """The statements of a cell."""
        words = [ast.unparse(statement) for statement in node.body]
        needing = [row for row, text in enumerate(words) if text.startswith(NEEDS)]
        undone = "notebook" in _lacking or ("section" in _lacking and not needing)
        if undone and not any("notebook.start(" in text for text in words):
            return ast.Module([], [])
        for row in reversed(needing):
            call = ast.parse(words[row], mode="eval").body
            node.body[row:] = [ast.If(call, node.body[row + 1 :] or [ast.Pass()], [])]
        return ast.fix_missing_locations(node)


def _record(kind, name, /, **entry):
    """Keep an entry; the file is written each time, so that a notebook that fails later has told
    what it found.
    """
    if not re.fullmatch(r"[a-z0-9_]+", name):
        raise ValueError(
            f"'{name}' must consist of lower-case letters, digits and underscores: it becomes a "
            "file name"
        )
    _found[kind].append(entry)
    if path := report_file(f"parts/{os.environ.get('LRFCAL_NOTEBOOK', 'notebook')}.json"):
        path.write_text(json.dumps(_found, indent=1))
