"""Text of a session is text: it is refused, or nothing of it runs in a page and all of it can be read there."""

import json
import shutil
from types import SimpleNamespace

import pandas as pd
import pytest
from shared import QUICK, ROOT
from test_report import write_notebook

from lrfcal_lib.acquire import panel
from lrfcal_lib.acquire.checks import Light
from lrfcal_lib.report import report
from lrfcal_lib.session.read import validate

IMAGE = '"><img src=x onerror="window.pwned=1">'
HOSTILE = (
    f"{IMAGE}</title></script></pre></textarea><script>window.pwned=1</script>&lt;b&gt;"
)
# every text of session.json by its place; whether it is refused, or else what a report shows
TEXTS = {
    "schema": "refused", "name": "refused", "licence": "shown", "source": "shown", "board.name": "shown",
    "board.edges.0": "shown", "board.edges.1": "shown", "board.edges.2": "shown", "board.features.0": "shown",
    "board.features.1": "shown", "board.pattern.kind": "refused", "rig.lrf.model": "shown",
    "rig.cameras.left.mount": "refused", "rig.cameras.right.mount": "refused", "reference.recording": "shown",
}  # fmt: skip
SHOW = """
import matplotlib.pyplot as plt
import pandas as pd
from lrfcal_lib.report import notebook
session = notebook.start()
texts = [session.licence, session.source, session.board.name, *session.board.edges, session.lrf.model]
texts += [session.reference["recording"], session.images()[0].file.name]
everything = " ".join(texts)
df = pd.DataFrame({text: [text, (text,)] for text in texts})
notebook.verdict(everything, texts)
notebook.finding("all", everything, everything, everything)
notebook.save(plt.figure(), "empty", everything)
"""
ENDS = (
    'notebook.table(df, "texts", caption=everything)',
    "df",
    "texts",
    "raise ValueError(everything)",
)


def texts_of(value, place=()):
    """Every text in an object of JSON, by its place."""
    if isinstance(value, str):
        return {".".join(place): value}
    pairs = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    return {
        name: text
        for key, part in pairs
        for name, text in texts_of(part, (*place, str(key))).items()
    }


def replace(folder, old, new):
    """Replace a text in session.json and truth.json, wherever it stands."""
    for file in (folder / "session.json", folder / "truth.json"):
        file.write_text(file.read_text().replace(json.dumps(old), json.dumps(new)))


def rename_image(folder, name):
    table = pd.read_csv(folder / "images.csv", dtype=str)
    old, table.loc[0, "file"] = table.file[0], f"images/left/{name}"
    (folder / old).rename(folder / table.file[0])
    table.to_csv(folder / "images.csv", index=False, lineterminator="\n")


@pytest.fixture
def folder(tmp_path):
    return shutil.copytree(QUICK, tmp_path / "quick")


@pytest.mark.parametrize("place", TEXTS)
def test_a_text_is_refused_or_accepted_as_it_is(folder, place):
    text = texts_of(json.loads((folder / "session.json").read_text()))[place]
    replace(folder, text, text + HOSTILE)
    problems = validate(folder)
    assert (
        problems == []
        if TEXTS[place] == "shown"
        else problems[0].startswith(str(folder / "session.json"))
    )


def test_no_text_is_missing_above():
    assert list(texts_of(json.loads((QUICK / "session.json").read_text()))) == list(TEXTS)


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """A session with every text hostile that is not refused, and its texts as they must appear."""
    folder = shutil.copytree(QUICK, tmp_path_factory.mktemp("hostile") / "quick")
    found = texts_of(json.loads((folder / "session.json").read_text()))
    for text in {found[place] for place, what in TEXTS.items() if what == "shown"}:
        replace(folder, text, text + HOSTILE)
    rename_image(folder, f"{IMAGE}.jpg")
    return folder, [
        found[place] + HOSTILE for place, what in TEXTS.items() if what == "shown"
    ] + [f"{IMAGE}.jpg"]


@pytest.fixture(scope="module")
def page(browser):
    page = browser.new_page()
    page.set_default_timeout(120_000)  # a busy machine takes its time
    page.route("http*://**", lambda route: route.abort())  # nothing from the network
    yield page
    page.close()


def seen(page):
    """All text of a page, after its pictures were loaded or have failed; nothing else ran."""
    page.wait_for_load_state("load")
    assert page.evaluate("window.pwned") is None
    return page.text_content("html")


def test_nothing_runs_in_a_report_and_all_of_it_can_be_read(hostile, page, tmp_path):
    folder, texts = hostile
    shown = write_notebook(tmp_path / "00_show.ipynb", SHOW, *ENDS)
    runs = report.make_report(
        folder, tmp_path / "out", notebooks=[shown, *ROOT.glob("notebooks/01_*.ipynb")]
    )
    assert [bool(run.error) for run in runs] == [True, False], runs[1].error
    pages = sorted((tmp_path / "out").glob("*.html"))
    assert [file.name[:5] for file in pages] == ["00_sh", "01_in", "index"]
    for file in pages:
        page.goto(file.as_uri())
        said = seen(page)
        shown = [text for text in texts if text in said]
        assert shown if file.name.startswith("01_") else shown == texts, file.name


def test_nothing_runs_in_the_panel(page):
    light = Light(HOSTILE, "warn", HOSTILE)
    task = SimpleNamespace(title=HOSTILE, guidance=HOSTILE)
    collector = SimpleNamespace(connected=True, emulated=True, finished=(1,))
    vector = ((0.0,) * 3,) * 4
    result = SimpleNamespace(
        answer="no",
        sentences=(f"a: {HOSTILE}", HOSTILE),
        file=HOSTILE,
        poses={HOSTILE: vector},
    )
    said = [
        panel.HTML.title(HOSTILE),
        panel.HTML.soft(HOSTILE),
        panel.HTML.state("busy", HOSTILE),
    ]
    said += [
        panel.HTML.error(HOSTILE, HOSTILE),
        panel.HTML.notes([HOSTILE]),
        panel.HTML.lights(HOSTILE, [light]),
    ]
    said += [panel.HTML.task(collector, task), panel.HTML.result(result)]
    page.goto("about:blank")
    page.set_content("".join(f"<div>{part}</div>" for part in said))
    assert seen(page).count(HOSTILE) == 15
