"""The data collection panel: words, pictures, widgets, and what buttons do."""

import contextlib
import logging
import os
import threading
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import ipywidgets as w
import numpy as np
from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup

from lrfcal_lib.acquire.checks import Light
from lrfcal_lib.acquire.collector import PRACTICE_RIGS, Busy, Collector, Interrupted, Result
from lrfcal_lib.acquire.pictures import jpeg, scan_picture, sweep_picture, with_scan
from lrfcal_lib.acquire.record import PITCH, RecordingError
from lrfcal_lib.calibrate.calibration_file import load_calibration
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.drivers.port import Closed, DeviceError
from lrfcal_lib.measure.holds import Answer, holds
from lrfcal_lib.session.read import open_session
from lrfcal_lib.session.shown import escape
from lrfcal_lib.session.write import new_session_path

LOG = logging.getLogger(__name__)
DRIVERS = logging.getLogger("lrfcal_lib")
# errors whose messages say what to do
EXPECTED = (DeviceError, RecordingError, Busy, Interrupted, ValueError, OSError)
LOOK_S = 0.3  # between looks at the rig
RED = (0, 0, 255)  # frame of a camera that has moved
CHECKED = 2  # scenes, the newest, that a chosen calibration is checked with
NOTES = 4  # lines of what drivers report
FOLLOWS = "three placements and more; the recording can go on afterwards"
PLAIN = "The data collection panel: it appears here while this notebook runs in JupyterLab."
BUTTONS = {  # methods of Panel: label, what it does, style, icon
    "connect": ("Connect", "open all devices and the session", "primary", "plug"),
    "close": ("Close", "finish the session and close all devices", "", "power-off"),
    "stop": ("STOP", "stop the head at once, and what is under way", "danger", "stop"),
    "go": ("Go", "move the head to the target", "", "arrows-v"),
    "capture": ("Capture", "record this placement", "success", "camera"),
    "again": ("Again", "take the last placement back, to record it again", "", "undo"),
    "calibrate": (
        "Save & calibrate",
        "calibrate what is recorded so far",
        "info",
        "check",
    ),
}
SIGNS = {Answer.HOLDS: "ok", Answer.UNKNOWN: "warn", Answer.MOVED: "bad"}
HERE = Path(__file__).parent
STYLE = f"<style>\n{HERE.joinpath('panel.css').read_text()}</style>"


def _as_text(value):
    """What a macro made as it is, all else as text."""
    if hasattr(value, "__html__"):
        return value
    return Markup(escape(value))


HTML: Any = (  # macros that make parts of the panel
    Environment(
        loader=FileSystemLoader(HERE),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_as_text,
    )
    .get_template("panel.html.jinja")
    .module
)
TEXTS = (
    "state",
    "lights",
    "result",
    "places",
    "error",
    "overlay",
    "held",
    "trouble",
    "notes",
    "pitch",
    "task",
    "doing",
)


def named(name: str, widget: Any) -> Any:
    """A widget that the page and its style find by the class ``lrfcal-<name>``."""
    widget.add_class(f"lrfcal-{name}")
    return widget


def card(*children):
    """A framed part."""
    return named("card", w.VBox(children))


def titled(heading, *children):
    """A framed part with a heading."""
    return card(w.HTML(HTML.title(heading)), *children)


def row(*children):
    """Widgets side by side, wrapped where the window is narrow."""
    return named("row", w.HBox(children))


class Picture:
    """A picture with a heading and a remark under it."""

    def __init__(self, name, heading, kind="png"):
        self.image = named(f"picture-{name}", w.Image(format=kind))
        self.remark = w.HTML()
        self.box = titled(heading, self.image, self.remark)

    def show(self, data, remark):
        """Show the bytes of an image; what did not change is not sent again."""
        self.image.value = data
        self.remark.value = HTML.soft(remark)


class Parts(SimpleNamespace):
    """All widgets by their names; `root` is shown."""

    def __init__(self, rig, session):
        parts = _fields(rig, session)
        for name in TEXTS:
            parts[name] = w.HTML()
        for name, (label, tip, style, icon) in BUTTONS.items():
            parts[name] = w.Button(
                description=label, tooltip=tip, button_style=style, icon=icon
            )
        for name, part in parts.items():
            named(name, part)
        super().__init__(**parts, pictures={}, views=named("views", row()))
        self.show_lights()
        self.result.value = HTML.soft(FOLLOWS)
        # what starts and what stops a recording stand side by side, on screen together at any size
        title = w.HTML("<b style='font-size:16px'>Data collection</b>")
        pressed = row(self.capture, self.again, self.stop)
        self.top = named("top", row(title, self.state, pressed))
        shown = [
            w.HTML(STYLE),
            self.top,
            row(self.rig, self.session, self.connect, self.close),
            self.calibration,
            self.places,
            self.overlay,
            self.held,
            self.error,
            self.trouble,
            self.views,
            row(
                titled("Head", self.pitch, self.slider, row(self.go)),
                card(self.task, self.progress, self.doing),
                named("checks", card(self.lights)),
            ),
            titled("Result", row(self.calibrate), self.result),
            self.notes,
        ]
        self.root = named("panel", w.VBox(shown))

    def show_pictures(self, cameras):
        """Make room for the pictures of a rig."""
        self.pictures = {
            "scan": Picture("scan", "Scan from above"),
            "sweep": Picture("sweep", "This sweep"),
        }
        for name in cameras:
            self.pictures[name] = Picture(name, f"Camera {name}", "jpeg")
        self.views.children = [picture.box for picture in self.pictures.values()]

    def show_lights(self, heading="Quality", lights=()):
        """Show what the checks of a placement say."""
        self.lights.value = HTML.lights(heading, lights)

    def enable(self, collector, busy):
        """Let be pressed what a Collector can do now; STOP always can."""
        for part in (self.rig, self.session, self.connect):
            part.disabled = busy or collector.connected
        for part in (self.close, self.capture, self.go, self.slider):
            part.disabled = busy or not collector.connected
        for part in (self.again, self.calibrate):
            part.disabled = busy or not collector.finished


def _fields(rig, session):
    """Widgets of what can be entered, by name."""
    return {
        "rig": w.Combobox(
            value=rig,
            options=PRACTICE_RIGS,
            placeholder="rig file or emulated rig",
            description="rig",
        ),
        "session": w.Text(value=session, description="session"),
        "calibration": w.Text(
            placeholder="calibration.json: shows the scan in the images",
            description="calibration",
            continuous_update=False,
        ),
        "slider": w.FloatSlider(
            min=-60, max=60, step=0.5, readout_format="+.1f", description="target"
        ),
        "progress": w.FloatProgress(max=1),
    }


class Notes(logging.Handler):
    """Keeps what the drivers report while a rig is connected."""

    def __init__(self, part):
        super().__init__(logging.WARNING)
        self.part = part
        self.lines = deque(maxlen=NOTES)

    def emit(self, record):
        """Show the newest lines."""
        self.lines.append(f"{time.strftime('%H:%M:%S')} {record.getMessage()}")
        self.part.value = HTML.notes(self.lines)


def absolute(text):
    """The absolute path of what stands in a field."""
    return Path(text.strip()).expanduser().absolute()


def rig_named(text):
    """What the field of the rig names: an emulated rig, or the absolute path of a rig file."""
    if text.strip() in PRACTICE_RIGS:
        return text.strip()
    return absolute(text)


class Panel(Closed):
    """Records a session with a rig, by buttons or by methods; a context manager that closes it.

    Methods raise what goes wrong, and the panel says it in words; buttons only say it.

    Parameters
    ----------
    rig
        Rig file, or an emulated rig: 'practice' (seconds a placement), 'sim_quick', 'sim_lms221'.
    session
        Folder of the session, which stays; by default a new one in the folder that the environment
        variable ``LRFCAL_RECORDINGS`` names, else in ``~/lrfcal_sessions``. The panel shows where.

    Examples
    --------
    >>> panel = Panel("rig.json")  # doctest: +SKIP
    >>> panel.show()  # doctest: +SKIP
    """

    def __init__(
        self, rig: str | os.PathLike = "practice", session: str | os.PathLike | None = None
    ):
        session = session or new_session_path()
        self.collector = Collector()
        self.parts = Parts(str(rig), str(session))
        self.notes = Notes(self.parts.notes)
        self.job: Future | None = None  # what a button began
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="panel")
        self._live: threading.Thread | None = None  # keeps looking
        self._quit = threading.Event()
        for name in BUTTONS:
            getattr(self.parts, name).on_click(partial(self._pressed, getattr(self, name)))
        for name in ("rig", "session"):
            getattr(self.parts, name).observe(self._show_places, "value")
        self.parts.calibration.observe(self._choose_calibration, "value")
        self._choose_calibration()
        self._show_places()
        self._refresh()

    @property
    def session(self) -> Path:
        """Folder of the session that the field names, an absolute Path."""
        return absolute(self.parts.session.value)

    def _show_places(self, _=None):
        """Show what the fields name: relative paths are taken from where this notebook lies."""
        self.parts.places.value = HTML.places(rig_named(self.parts.rig.value), self.session)

    def _choose_calibration(self, _=None):
        """Read the calibration that the field names, and say what is wrong with it."""
        self._calibrated: CalibratedRig | None = None  # shows the scan in the images
        name = self.parts.calibration.value.strip()
        words = ""
        if name:
            try:
                self._calibrated = load_calibration(absolute(name))
            except ValueError as error:
                words = str(error)
            else:
                if self._calibrated.answer == "no":
                    words = f"cannot be trusted: {'; '.join(self._calibrated.reasons)}"
        self.parts.overlay.value = HTML.error("calibration", words)
        self._check_calibration()

    def _check_calibration(self):
        """Say whether the chosen calibration still holds for the scenes recorded last."""
        self._moved = set()  # cameras that the calibration may have elsewhere
        self.parts.held.value = ""
        if self._calibrated is None or not self.collector.finished:
            return
        session = open_session(self.session)
        scenes = session.scene_placements[-CHECKED:]
        if not scenes:
            return
        try:
            held = holds(replace(session, placements=scenes), self._calibrated)
        except ValueError as error:
            sentences = [f"cannot be told here: {error}"]
            sign = "warn"
        else:
            sentences = held.sentences("the calibration")
            sign = SIGNS[held.answer]
            self._moved = {shift.camera for shift in held.culprits}
        self.parts.held.value = HTML.held(sign, sentences)

    def show(self) -> None:
        """Display the panel."""
        from IPython.display import display

        display({**self.parts.root._repr_mimebundle_(), "text/plain": PLAIN}, raw=True)

    # --------------------------------------------------------------------- the buttons

    def connect(self) -> None:
        """Open the rig and the session that the fields name; see :meth:`Collector.connect`."""
        with self._doing("connecting"):
            DRIVERS.addHandler(self.notes)
            parts = self.parts
            collector = self.collector
            parts.rig.value = str(rig_named(parts.rig.value))
            parts.session.value = str(self.session)
            rig = collector.connect(parts.rig.value, self.session)
            with parts.slider.hold_trait_notifications():
                parts.slider.min, parts.slider.max = collector.limits_deg
            parts.show_pictures(rig.cameras)
            self._quit.clear()
            self._live = threading.Thread(
                target=self._keep_looking, name="panel view", daemon=True
            )
            self._live.start()

    def close(self) -> None:
        """Stop the head, finish the session, close the devices."""
        with self._doing("closing"):
            self._quit.set()
            if self._live is not None:
                self._live.join()
            try:
                self.collector.close()
            finally:
                DRIVERS.removeHandler(self.notes)

    def go(self) -> float:
        """Move the head to the target of the slider; returns where it settled, radians."""
        with self._doing("moving the head"):
            return self.collector.move_to(np.radians(self.parts.slider.value))

    def capture(self) -> list[Light]:
        """Record the next placement; returns its lights."""
        task = self.collector.task()
        with self._doing("recording"):
            lights = self.collector.capture(self._show_progress)
            self.parts.show_lights(f"Quality of {task.title.lower()}", lights)
            self._check_calibration()
        return lights

    def again(self) -> int:
        """Take the placement recorded last back; returns its number."""
        with self._doing("taking it back"):
            number = self.collector.again()
            self.parts.show_lights()
        return number

    def calibrate(self) -> Result:
        """Calibrate what was recorded so far; returns the Result."""
        with self._doing("calibrating"):
            result = self.collector.calibrate()
            self.parts.result.value = HTML.result(result)
            if result.file is not None:
                self.parts.calibration.value = ""  # read again, if it is the same file
                self.parts.calibration.value = str(result.file)
        return result

    def stop(self) -> None:
        """Stop the head at once, and what is under way."""
        self.collector.stop()
        self._show_progress(0.0, "stopped")

    def _pressed(self, method, _):
        """Do what a button is for in the one thread that works, STOP at once.

        What goes wrong is shown, and raised to nobody: the job keeps it.
        """
        if method == self.stop:
            method()
        elif self.job is None or self.job.done():
            self.job = self._worker.submit(method)

    @contextlib.contextmanager
    def _doing(self, text):
        """Something is under way: nothing else can be pressed, and what goes wrong is said."""
        parts = self.parts
        heading = ""
        parts.error.value = ""
        parts.state.value = HTML.state("busy", text)
        self._show_progress(0.0, text)
        parts.enable(self.collector, busy=True)
        try:
            yield
        except Exception as error:
            words = str(error)
            heading = f"{text} failed"
            if isinstance(error, Interrupted):
                heading = "stopped"
            elif not isinstance(error, EXPECTED):
                words = f"{type(error).__name__}: {error}"
                LOG.exception("the panel failed while %s", text)
            parts.error.value = HTML.error(heading, words)
            raise
        finally:
            self._show_progress(0.0, heading)
            self._refresh()

    # ------------------------------------------------------------------------- showing

    def _refresh(self):
        """Show what can be done now."""
        collector = self.collector
        parts = self.parts
        parts.state.value = HTML.state("ready" if collector.connected else "off")
        parts.task.value = HTML.task(collector, collector.task())
        parts.enable(collector, busy=False)

    def _show_progress(self, share, text):
        self.parts.progress.value = share
        self.parts.doing.value = HTML.soft(text)

    def _keep_looking(self):
        while not self._quit.wait(LOOK_S):
            try:
                self._show_view(self.collector.look())
            except Exception:  # a view that fails must not end the view
                LOG.exception("the view of the rig failed")
                self._quit.wait(10 * LOOK_S)

    def _show_view(self, view):
        """Show a View of the rig."""
        pictures = self.parts.pictures
        how = HTML.soft(PITCH[view.measured])
        self.parts.pitch.value = f"<b>{np.degrees(view.pitch):+.2f}°</b> {how}"

        if view.reading is not None:
            known = np.isfinite(view.reading.ranges).sum()
            pictures["scan"].show(scan_picture(view.reading), f"{known} beams came back")
        rows = dict(view.rows)  # a copy: the recording goes on
        words = f"{len(rows)} scan lines; near is bright, white is no range"
        pictures["sweep"].show(sweep_picture(rows, view.sweep), words)
        for name, frame in dict(view.frames).items():
            image, words = self._overlaid(name, frame.image, view)
            pictures[name].show(jpeg(image), words)

        self.parts.trouble.value = HTML.error("view", view.trouble)

    def _overlaid(self, name, image, view):
        """An image with the current scan over it where a calibration tells, and a remark."""
        rig = self._calibrated
        height, width = image.shape[:2]
        words = f"{width} x {height} pixels"
        scan = view.reading
        if rig is None or scan is None:
            return image, words
        if name not in rig.cameras:
            return image, f"{words}; the calibration does not know this camera"
        model = rig.cameras[name].model
        if (model.width, model.height) != (width, height):
            return image, f"{words}; the calibration is of {model.width} x {model.height}"
        pixels = rig.project_scan(name, scan.ranges, scan.bearings, view.pitch)
        image = with_scan(image, pixels, scan.ranges)
        words += "; dots: the scan, near is bright"
        if name in self._moved:
            cv2.rectangle(image, (0, 0), (width - 1, height - 1), RED, round(width / 50))
            words += "; has moved since it was calibrated"
        return image, words
