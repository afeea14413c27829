"""Pages out of executed notebooks: formulas that any browser draws, code folded, figures and tables
numbered.
"""

import base64
import html
import re
from pathlib import Path
from typing import Any

import nbformat
import pandas as pd
from bs4 import BeautifulSoup
from jinja2 import Environment, FileSystemLoader
from latex2mathml.converter import convert
from nbconvert.filters import Highlight2HTML, strip_ansi
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath

from lrfcal_lib.report.notebook import in_words, label_of

SHORT = 15  # rows of a table that is shown unfolded
PIXELS_PER_INCH = 96 / 150  # of a page, by those of a figure's file
# columns from which a table is turned on screens as narrow
WIDTHS = ((9, "wide"), (3, "medium"), (0, "narrow"))
METHOD = re.compile(r"(?<=')\w+(?=')")  # named in a sentence
TEMPLATES = Environment(
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
    loader=FileSystemLoader(Path(__file__).parent),
)
# methods are called by their labels
TEMPLATES.filters["words"] = lambda text: METHOD.sub(
    lambda name: label_of(name[0]), label_of(text)
)
PIECES: Any = TEMPLATES.get_template("pieces.html.jinja").module
FITTING = 42  # characters of a row that a screen of 400 pixels shows beside each other


class Renderer(IPythonRenderer):
    """Markdown of a notebook as HTML, its formulas as MathML."""

    def inline_math(self, body: str) -> str:
        """A formula within a line."""
        return convert(body)

    def block_math(self, body: str) -> str:
        """A displayed formula, the number of its tag beside it."""
        number = re.search(r"\\tag\{(.*?)\}", body)
        drawn = convert(re.sub(r"\\tag\{.*?\}", "", body), display="block")
        beside = f"<span>({number[1]})</span>" if number else ""
        return f'<div class="formula"><div>{drawn}</div>{beside}</div>'


def render(
    notebook: nbformat.NotebookNode, figures: dict[str, str], tables: dict[str, str]
) -> str:
    """The body of a notebook's page.

    Parameters
    ----------
    notebook
        Executed.
    figures, tables
        Of the report by name, as HTML: see :func:`figure_of` and :func:`table_of`.
    """
    body = []
    color = Highlight2HTML(pygments_lexer="ipython3")
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            renderer = Renderer(
                escape=False,
                attachments=cell.get("attachments", {}),
                exclude_anchor_links=True,
            )
            text = turned(MarkdownWithMath(renderer=renderer).render(cell.source))
            body.append(re.sub(r'(href="\d\d_\w+)\.ipynb(#\w+)?"', r'\1.html\2"', text))
        elif cell.cell_type == "code":
            body.append(
                f'<details class="code"><summary>Code</summary>{color(cell.source)}</details>'
            )
            for output in cell.outputs:
                shown = _output(output)
                caption = re.match(r'<p id="figure-(\w+)"', shown)
                styled = re.search(r'<table id="T_(\w+)"', shown)
                if caption and figures.get(caption[1]):
                    body[-1] = figures[caption[1]]  # the picture stands before its caption
                elif styled and styled[1] in tables:
                    body.append(tables[styled[1]])
                else:
                    body.append(turned(shown))
    return "\n".join(body)


def _output(output):
    """One output of a cell: HTML, picture or text."""
    if output.output_type == "error":
        plain = strip_ansi("\n".join(output.traceback))
        return f'<pre class="error">{html.escape(plain)}</pre>'
    data = output.get("data", {})
    if "text/html" in data:
        return data["text/html"]
    if "image/png" in data:
        return f'<img alt="" src="data:image/png;base64,{data["image/png"].strip()}">'
    return f"<pre>{html.escape(output.get('text') or data.get('text/plain', ''))}</pre>"


def figure_of(folder, entry, label):
    """A figure of the report in a folder that holds its picture, as large as it was drawn; '' where
    its notebook failed before drawing it.
    """
    if not (file := folder / "figures" / f"{entry['name']}.png").is_file():
        return ""
    data = file.read_bytes()
    width = round(int.from_bytes(data[16:20]) * PIXELS_PER_INCH)
    return str(PIECES.figure(entry, label, base64.b64encode(data).decode(), width))


def table_of(entry, label):
    """A table, folded where it is long."""
    made = turned(entry["html"])
    return str(PIECES.table(entry, label, made, made.count("<tr>") - 1, SHORT))


def turned(text):
    """HTML whose tables a narrow screen can show turned: every cell knows the heading of its
    column.
    """
    soup = BeautifulSoup(text, "html.parser")
    for part in soup(["style", "caption"]):
        part.decompose()
    for table in soup("table"):
        heads = table.select("thead th")
        for head in heads:
            head.string = in_words(head.get_text(), column=True)
        columns = 0 if _fits(table) else len(heads)
        table.attrs = {"class": next(name for least, name in WIDTHS if columns >= least)}
        for part in table(["th", "td", "tr"]):
            part.attrs = {}
        for row in table.select("tbody tr"):
            for head, cell in zip(heads, row(["th", "td"]), strict=False):
                cell["data-label"] = head.string
                if re.fullmatch(r"[-+]?[\d.]+(e[-+]\d+)?|–|nan", cell.get_text().strip()):
                    head["class"] = cell["class"] = "number"
    return str(soup)


def _fits(table):
    """Whether a narrow screen shows a whole row of a table, its headings broken into words."""
    rows = [[cell.get_text().strip() for cell in row(["th", "td"])] for row in table("tr")]
    words = [max(head.split(), key=len, default="") for head in rows[0]]
    longest = pd.DataFrame([words, *rows[1:]]).fillna("").map(len).max()
    return longest.sum() + 1.5 * len(longest) <= FITTING
