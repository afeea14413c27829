"""The panel in JupyterLab in a browser: press the buttons, see the scan, the images and the result."""

import json
import os
import secrets
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import suppress
from pathlib import Path

import nbformat
import pytest
from shared import campaign, until
from test_saving import option

NOTEBOOK = next((Path(__file__).resolve().parents[1] / "notebooks").glob("09_*.ipynb"))
# dash, which Open3D brings, has JupyterLab ask whether it should be built anew: no dialog in the way
QUIET = "--ServerApp.tornado_settings={'page_config_data': {'buildCheck': False, 'buildAvailable': False}}"
START_S = 180
ACTION_S = 240  # guards against hanging
SCREEN = {"width": 1280, "height": 900}  # of a small laptop


def panel_only(folder):
    """The notebook up to the cell that shows the panel."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    last = next(i for i, cell in enumerate(notebook.cells) if "panel.show()" in cell.source)
    notebook.cells = notebook.cells[: last + 1]
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    nbformat.write(notebook, folder / NOTEBOOK.name)


def free_port():
    """Of this machine; nobody else is likely to take it before JupyterLab does."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def started(folder, port, token, log):
    """The process of a JupyterLab that serves a folder; its settings stand beside the folder."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    places = {
        f"JUPYTER_{kind}_DIR": str(folder.parent / kind.lower())
        for kind in ("CONFIG", "RUNTIME")
    }
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root"]
    command += ["--ip=127.0.0.1", f"--port={port}", "--ServerApp.port_retries=0"]
    command += [f"--ServerApp.root_dir={folder}", QUIET, option()]
    environment = os.environ | threads | places | {"JUPYTER_TOKEN": token}
    return subprocess.Popen(command, env=environment, stdout=log, stderr=log)


@pytest.fixture
def lab(tmp_path):
    """Address of a JupyterLab with the panel's notebook, its token included."""
    work = tmp_path / "work"
    log = tmp_path / "log"
    token = secrets.token_hex(16)
    work.mkdir()
    panel_only(work)
    port = free_port()
    address = f"http://127.0.0.1:{port}"

    def call(path, **options):
        request = urllib.request.Request(
            address + path, headers={"Authorization": f"token {token}"}, **options
        )
        return urllib.request.urlopen(request, timeout=20).read()

    def responds():
        with suppress(OSError):
            return call("/api")

    with log.open("w") as stream:
        server = started(work, port, token, stream)
        try:
            until(lambda: server.poll() is not None or responds(), START_S)
            assert server.poll() is None, (
                f"JupyterLab does not start:\n{log.read_text()[-3000:]}"
            )
            yield f"{address}/doc/tree/{NOTEBOOK.name}?token={token}"
            for kernel in json.loads(
                call("/api/kernels")
            ):  # by itself: the panel's rig is closed, its head stopped
                call(f"/api/kernels/{kernel['id']}", method="DELETE")
        finally:
            server.terminate()
            server.wait(20)


@pytest.fixture
def page(browser, lab):
    page = browser.new_page(viewport=SCREEN)
    page.set_default_timeout(1000 * ACTION_S)
    page.goto(lab)
    yield page
    page.close()


def run_all(page):
    """Run all cells; the page takes the order before its kernel is there, and forgets it, so it is given again."""
    page.wait_for_selector(".jp-StatusBar-Widget :text('| Idle')")
    end = time.monotonic() + START_S
    while not page.locator(".jp-InputPrompt:text-matches('[*]|1')").count():
        assert time.monotonic() < end, "the kernel does not take the cells"
        page.click(".lm-MenuBar-itemLabel:text-is('Run')")
        page.click(".lm-Menu-itemLabel:text-is('Run All Cells')")
        page.wait_for_timeout(1000)
    page.wait_for_selector(".lrfcal-panel")


def changed(page, name, before):
    """Wait until a picture is another one, and wide."""
    differs = """([name, before]) => {
        const image = document.querySelector(`img.lrfcal-picture-${name}`);
        return image.src !== before && image.naturalWidth > 100}"""
    page.wait_for_function(differs, arg=[name, before])


def press(page, name, text):
    """Press a button and wait until the panel says something, or that something failed."""
    page.click(f"button.lrfcal-{name}:enabled")
    page.wait_for_selector(
        f".lrfcal-panel :text('{text}'), .lrfcal-error:has-text('failed')"
    )
    failed = page.locator(".lrfcal-error:has-text('failed')")
    assert failed.count() == 0, failed.first.inner_text()


# a picture shows nobody's folders
ELSEWHERE = """folder => {
    const shown = text => text.replaceAll(folder, "/home/you");
    for (const field of document.querySelectorAll(".lrfcal-panel input")) field.value = shown(field.value);
    const texts = document.createTreeWalker(document.querySelector(".lrfcal-panel"), NodeFilter.SHOW_TEXT);
    while (texts.nextNode()) texts.currentNode.data = shown(texts.currentNode.data);
}"""


def on_screen(page, *names):
    """Whether buttons are on screen, all at once."""
    boxes = [page.locator(f"button.lrfcal-{name}").bounding_box() for name in names]
    inside = [
        box["y"] >= 0 and box["y"] + box["height"] <= SCREEN["height"] for box in boxes
    ]
    return all(inside) and all(box["x"] + box["width"] <= SCREEN["width"] for box in boxes)


@campaign
@pytest.mark.parametrize("count", [1, 3])  # notebook 09 calibrates what it recorded
def test_buttons_record_and_calibrate(page, count, tmp_path):
    run_all(page)
    page.fill(".lrfcal-session input", "recordings/monday")
    page.press(".lrfcal-session input", "Tab")
    folder = tmp_path / "work" / "recordings" / "monday"
    page.wait_for_selector(f".lrfcal-places:has-text('the recording goes to {folder}')")
    press(page, "connect", "Placement 1 of")
    assert page.input_value(".lrfcal-session input") == str(folder)
    empty = page.get_attribute("img.lrfcal-picture-sweep", "src")
    for name in ("scan", "left", "right"):
        changed(page, name, "")
    for number in range(1, count + 1):
        press(page, "capture", f"Quality of placement {number}")
        page.wait_for_selector(f".lrfcal-panel :text('Placement {number + 1} of')")
        assert page.locator(".light:has-text('camera left')").count() == 1
        assert "board on" in page.inner_text(".light:has-text('scan')")
    changed(page, "sweep", empty)
    page.locator("button.lrfcal-stop").scroll_into_view_if_needed()
    assert on_screen(page, "stop", "capture")
    press(page, "calibrate", "rotation vector" if count >= 3 else "cannot be trusted")
    said = page.inner_text(".lrfcal-result")
    assert count < 3 or "right" in said and "recordings/monday_calibration" in said, said
    if os.environ.get("LRFCAL_SCREENSHOT"):
        page.add_style_tag(content=".Toastify {display: none}")
        page.set_viewport_size({"width": 1280, "height": 1900})
        page.evaluate(ELSEWHERE, str(tmp_path / "work"))
        page.wait_for_timeout(1000)
        page.locator(".lrfcal-panel").screenshot(path=os.environ["LRFCAL_SCREENSHOT"])
    press(page, "close", "not connected")
    file = tmp_path / "work" / NOTEBOOK.name
    before = file.read_bytes()
    saved = file.stat().st_mtime_ns
    page.keyboard.press("Control+S")
    # it is emptied first, and written then
    until(lambda: file.stat().st_mtime_ns != saved and file.stat().st_size)
    assert file.read_bytes() == before, "the notebook was run, and is as it was"
    assert sorted(path.name for path in folder.parent.iterdir())[0] == "monday", (
        "the recording stays"
    )
