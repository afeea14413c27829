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

NOTEBOOK = next((Path(__file__).resolve().parents[1] / "notebooks").glob("09_*.ipynb"))
# dash, which Open3D brings, has JupyterLab ask whether it should be built anew: no dialog in the way
QUIET = "--ServerApp.tornado_settings={'page_config_data': {'buildCheck': False, 'buildAvailable': False}}"
START_S, ACTION_S = 180, 240  # guards against hanging


def panel_only(folder):
    """The notebook up to the cell that shows the panel."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    last = next(i for i, cell in enumerate(notebook.cells) if "panel.show()" in cell.source)
    notebook.cells = notebook.cells[: last + 1]
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    nbformat.write(notebook, folder / "panel.ipynb")


@pytest.fixture
def lab(tmp_path):
    """Address of a JupyterLab with the panel's notebook, its token included."""
    work, log, token = tmp_path / "work", tmp_path / "log", secrets.token_hex(16)
    work.mkdir()
    panel_only(work)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{probe.getsockname()[1]}"
    environment = os.environ | {f"JUPYTER_{kind}_DIR": str(tmp_path / kind.lower()) for kind in ("CONFIG", "RUNTIME")}
    environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "JUPYTER_TOKEN": token}
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root", "--ip=127.0.0.1",
               f"--port={address.rpartition(':')[2]}", "--ServerApp.port_retries=0", f"--ServerApp.root_dir={work}",
               QUIET]  # fmt: skip

    def call(path, **options):
        request = urllib.request.Request(address + path, headers={"Authorization": f"token {token}"}, **options)
        return urllib.request.urlopen(request, timeout=20).read()

    def responds():
        with suppress(OSError):
            return call("/api")

    with log.open("w") as stream:
        server = subprocess.Popen(command, env=environment, stdout=stream, stderr=stream)
        try:
            until(lambda: server.poll() is not None or responds(), START_S)
            assert server.poll() is None, f"JupyterLab does not start:\n{log.read_text()[-3000:]}"
            yield f"{address}/doc/tree/panel.ipynb?token={token}"
            for kernel in json.loads(call("/api/kernels")):  # by itself: the panel's rig is closed, its head stopped
                call(f"/api/kernels/{kernel['id']}", method="DELETE")
        finally:
            server.terminate()
            server.wait(20)


@pytest.fixture
def page(browser, lab):
    page = browser.new_page(viewport={"width": 1400, "height": 1150})
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
    page.wait_for_selector(f".lrfcal-panel :text('{text}'), .lrfcal-error:has-text('failed')")
    failed = page.locator(".lrfcal-error:has-text('failed')")
    assert failed.count() == 0, failed.first.inner_text()


@campaign
@pytest.mark.parametrize("count", [1, 3])  # notebook 09 calibrates what it recorded
def test_buttons_record_and_calibrate(page, count):
    run_all(page)
    page.fill(".lrfcal-session input", "recordings/monday")
    press(page, "connect", "Placement 1 of")
    empty = page.get_attribute("img.lrfcal-picture-sweep", "src")
    for name in ("scan", "left", "right"):
        changed(page, name, "")
    for number in range(1, count + 1):
        press(page, "capture", f"Quality of placement {number}")
        page.wait_for_selector(f".lrfcal-panel :text('Placement {number + 1} of')")
        assert page.locator(".light:has-text('camera left')").count() == 1
        assert "board on" in page.inner_text(".light:has-text('scan')")
    changed(page, "sweep", empty)
    press(page, "calibrate", "rotation vector" if count >= 3 else "cannot be trusted")
    said = page.inner_text(".lrfcal-result")
    assert count < 3 or "right" in said and "recordings/monday_calibration" in said, said
    if os.environ.get("LRFCAL_SCREENSHOT"):
        page.add_style_tag(content=".Toastify {display: none}")
        page.locator(".lrfcal-panel").screenshot(path=os.environ["LRFCAL_SCREENSHOT"])
    press(page, "close", "not connected")
