"""The data collection panel: words, pictures, widgets, and what buttons do."""

import contextlib
import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import ipywidgets as w
import numpy as np
from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup

from lrfcal_lib.acquire.collector import PRACTICE_RIGS, Busy, Collector, Interrupted
from lrfcal_lib.acquire.record import RecordingError
from lrfcal_lib.drivers.port import Closed, DeviceError
from lrfcal_lib.model.geometry import polar_to_points
from lrfcal_lib.plots.recording import COLORS
from lrfcal_lib.session.stated import escape
from lrfcal_lib.session.write import new_session_path

HERE = Path(__file__).parent
STYLE = f"<style>\n{HERE.joinpath('panel.css').read_text()}</style>"
# macros that make parts of the panel; all that is put into them is text
HTML = Environment(
    loader=FileSystemLoader(HERE), autoescape=True, trim_blocks=True, lstrip_blocks=True,
    finalize=lambda value: value if hasattr(value, "__html__") else Markup(escape(value)),
).get_template("panel.html.jinja").module  # fmt: skip


PICTURE = (400, 300)  # pixels
REACHES = (2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 20.0, 30.0, 50.0, 82.0)  # of the top view, metres
SHIFT = 4  # binary digits of a pixel's fraction
LEFT, TOP, RIGHT, BOTTOM = 44, 12, 388, 255  # of a sweep in its picture, pixels
SECTOR, CIRCLE, GREY, DARK, EMPTY = ((v,) * 3 for v in (246, 217, 138, 51, 238))  # EMPTY where there is no range
DOT = tuple(int(COLORS["lrf"][i : i + 2], 16) for i in (5, 3, 1))


def write(image, text, u, v):
    """Small grey text about a pixel."""
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.36
    (width, height), _ = cv2.getTextSize(text, font, scale, 1)
    cv2.putText(image, text, (round(u - width / 2), round(v + height / 2)), font, scale, GREY, 1, cv2.LINE_AA)


def scan_picture(ranges, bearings, field_of_view):
    """A scan (metres, NaN for none, and radians) from above, the laser range finder below; BGR."""
    points = polar_to_points(np.asarray(ranges, float), bearings)[:, :2]
    points = points[np.isfinite(points).all(axis=1)]
    far = np.percentile(np.linalg.norm(points, axis=1), 90) if len(points) else 0.0
    reach = next((reach for reach in REACHES if reach >= far), REACHES[-1])
    angle = np.linspace(*field_of_view, 91)
    edge = reach * np.column_stack([np.cos(angle), np.sin(angle)])
    low, high = min(0.0, edge[:, 1].min()), edge[:, 1].max()
    scale = min(PICTURE[1] / (high - low), PICTURE[0] / 2 / np.abs(edge[:, 0]).max()) / 1.1  # pixels a metre
    origin = np.array(PICTURE) / 2 - 0.5 + [0, scale * (low + high) / 2]

    def pixels(points):
        return np.rint((origin + [scale, -scale] * np.asarray(points)) * 2**SHIFT).astype(int)

    image = np.full((PICTURE[1], PICTURE[0], 3), 255, np.uint8)
    cv2.fillPoly(image, [pixels([(0, 0), *edge])], SECTOR, cv2.LINE_AA, SHIFT)
    step = 1.0 if reach <= 6 else 2.0 if reach <= 12 else 5.0 if reach <= 30 else 20.0
    for radius in np.arange(step, reach + 1e-6, step):
        cv2.polylines(image, [pixels(edge * radius / reach)], False, CIRCLE, 1, cv2.LINE_AA, SHIFT)
        if radius < reach:
            write(image, f"{radius:g} m", *(pixels(edge[0] * radius / reach) / 2**SHIFT + [14, 8]))
    cv2.fillPoly(image, [pixels(np.array([(-6, -5), (6, -5), (0, 7)]) / scale)], DARK, cv2.LINE_AA, SHIFT)
    for pixel in pixels(points).tolist():
        cv2.circle(image, pixel, 2 << SHIFT, DOT, -1, cv2.LINE_AA, SHIFT)
    return image


def sweep_picture(rows, bearings, field_of_view, pitch, step):
    """A sweep as it grows: ranges as colours, near is bright, grey where there is none; BGR.

    Bearing grows to the left as in the scene, pitch upwards; radians, of field of view and pitch their ends. `rows` has
    ranges (B,) by pitch, `step` is that between scan lines, of a continuous sweep the most between two.
    """
    half, width, height = np.degrees(step) / 2, RIGHT - LEFT, BOTTOM - TOP
    across = np.degrees([max(field_of_view), min(field_of_view)])
    down = np.degrees(max(pitch)) + half, np.degrees(min(pitch)) - half
    image = np.full((PICTURE[1], PICTURE[0], 3), 255, np.uint8)
    image[TOP:BOTTOM, LEFT:RIGHT] = EMPTY
    for share in (0, 0.5, 1):
        write(image, f"{np.interp(share, (0, 1), across):.0f}", LEFT + share * width, BOTTOM + 12)
        write(image, f"{np.interp(share, (0, 1), down):.0f}", LEFT - 18, TOP + share * height)
    write(image, "bearing [deg]", LEFT + width / 2, BOTTOM + 30)
    write(image, "pitch [deg]", 32, BOTTOM + 30)
    if not rows:
        return image
    ranges = np.array(list(rows.values()))
    known = np.isfinite(ranges)
    low, high = np.percentile(ranges[known], [2, 90]) if known.any() else (0, 1)
    scaled = (np.nan_to_num(ranges, nan=high) - low) / max(high - low, 0.1)
    shades = cv2.applyColorMap((255 * (1 - np.clip(scaled, 0, 1))).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    shades = np.where(known[..., None], shades.reshape(*ranges.shape, 3), np.uint8(EMPTY))
    u, v = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    beam = np.rint(np.interp(np.interp(u, (0, 1), across), np.degrees(bearings), np.arange(len(bearings)))).astype(int)
    away = np.abs(np.interp(v, (0, 1), down)[:, None] - np.degrees(list(rows)))
    seen = away.min(axis=1) <= half + np.ptp(down) / height
    image[TOP:BOTTOM, LEFT:RIGHT][seen] = shades[away.argmin(axis=1)[seen]][:, beam]
    return image


def png(image):
    """Bytes of a PNG file."""
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes()


def jpeg(image, width):
    """Bytes of a JPEG file of an image (BGR), not wider than so many pixels."""
    scale = width / image.shape[1]
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()


WIDE = {"width": "100%"}
BUTTONS = {  # text, what it does, style, icon, width
    "connect": ("Connect", "open all devices and the session", "primary", "plug", "auto"),
    "close": ("Close", "finish the session and close all devices", "", "power-off", "auto"),
    "stop": ("STOP", "stop the head at once, and what is under way", "danger", "stop", "130px"),
    "go": ("Go", "move the head to the target", "", "arrows-v", "auto"),
    "capture": ("Capture", "record this placement", "success", "camera", "140px"),
    "again": ("Again", "take the last placement back, to record it again", "", "undo", "auto"),
    "calibrate": ("Save & calibrate", "calibrate what is recorded so far", "info", "check", "auto"),
}
FIELDS = {  # kind, options, layout
    "rig": (w.Combobox, {"options": PRACTICE_RIGS, "placeholder": "rig file or emulated rig"}, {"flex": "1 1 260px"}),
    "session": (w.Text, {}, {"flex": "2 1 320px"}),
    "slider": (w.FloatSlider, {"min": -60, "max": 60, "step": 0.5, "readout_format": "+.1f",
                               "description": "target"}, WIDE),
    "progress": (w.FloatProgress, {"min": 0, "max": 1, "description": ""}, WIDE),
}  # fmt: skip
TEXTS = {"state": HTML.state("off"), "places": "", "error": "", "notes": "", "pitch": "", "task": "", "doing": "",
         "lights": HTML.lights("Quality", ()),
         "result": HTML.soft("three placements and more; the recording can go on afterwards")}  # fmt: skip


def card(*children, grow=1, basis="300px"):
    """A framed part."""
    made = w.VBox(children, layout=w.Layout(flex=f"{grow} 1 {basis}", min_width="0"))
    made.add_class("lrfcal-card")
    return made


def row(*children, **layout):
    """Widgets side by side, wrapped where the window is narrow."""
    return w.HBox(children, layout=w.Layout(**{"grid_gap": "10px", "flex_flow": "row wrap", **layout}))


class Picture:
    """A picture with a heading and a remark under it."""

    def __init__(self, name, heading, kind="png"):
        self.image = w.Image(format=kind, layout=w.Layout(width="100%", max_width=f"{PICTURE[0]}px"))
        self.image.add_class(f"lrfcal-picture-{name}")
        self.remark = w.HTML()
        self.box = card(w.HTML(HTML.title(heading)), self.image, self.remark, basis="220px")

    def show(self, data, remark):
        """Show the bytes of an image; what did not change is not sent again."""
        self.image.value, self.remark.value = data, HTML.soft(remark)


class Parts:
    """All widgets by their names, each found in the page by its class ``lrfcal-<name>``; `root` is shown."""

    def __init__(self, rig, session):
        made = {name: w.HTML(text) for name, text in TEXTS.items()}
        for name, (kind, options, layout) in FIELDS.items():
            options = {"description": name, "style": {"description_width": "62px"}, **options}
            made[name] = kind(**options, layout=w.Layout(**layout))
        for name, (text, tip, style, icon, width) in BUTTONS.items():
            made[name] = w.Button(description=text, tooltip=tip, button_style=style, icon=icon, layout={"width": width})
        for name, part in made.items():
            part.add_class(f"lrfcal-{name}")
        vars(self).update(made)
        self.rig.value, self.session.value = rig, session
        self.pictures, self.views = {}, row()
        title = w.HTML("<b style='font-size:16px'>Data collection</b>")
        # what starts and what stops a recording stand side by side, on screen together at any size
        self.top = row(title, self.state, row(self.capture, self.again, self.stop),
                       justify_content="space-between", align_items="center")  # fmt: skip
        self.top.add_class("lrfcal-top")
        head_card = card(w.HTML(HTML.title("Head")), self.pitch, self.slider, row(self.go))
        next_card = card(self.task, self.progress, self.doing)
        self.root = w.VBox(
            [w.HTML(STYLE), self.top, row(self.rig, self.session, self.connect, self.close), self.places, self.error,
             self.views, row(head_card, next_card, card(self.lights, grow=2, basis="420px")),
             card(w.HTML(HTML.title("Result")), row(self.calibrate), self.result, basis="auto"), self.notes],
            layout=w.Layout(grid_gap="10px"),
        )  # fmt: skip
        self.root.add_class("lrfcal-panel")

    def show_pictures(self, cameras):
        """Make room for the pictures of a rig."""
        self.pictures = {"scan": Picture("scan", "Scan from above"), "sweep": Picture("sweep", "This sweep")}
        self.pictures |= {name: Picture(name, f"Camera {name}", "jpeg") for name in cameras}
        self.views.children = [picture.box for picture in self.pictures.values()]

    def enable(self, connected, busy, recorded):
        """What can be pressed now; STOP always can."""
        free = {"rig session connect": not connected, "close capture go slider": connected,
                "again calibrate": connected and recorded}  # fmt: skip
        for names, possible in free.items():
            for name in names.split():
                getattr(self, name).disabled = busy or not possible


LOG = logging.getLogger(__name__)
DRIVERS = logging.getLogger("lrfcal_lib")
EXPECTED = (DeviceError, RecordingError, Busy, Interrupted, ValueError, OSError)  # their messages say what to do
LOOK_S = 0.3
NOTES = 4
PLAIN = "The data collection panel: it appears here while this notebook runs in JupyterLab."


class Notes(logging.Handler):
    """Keeps what the drivers report while a rig is connected."""

    def __init__(self, part):
        super().__init__(logging.WARNING)
        self.part, self.lines = part, []

    def emit(self, record):
        """Show the newest lines."""
        self.lines = [*self.lines, f"{time.strftime('%H:%M:%S')} {record.getMessage()}"][-NOTES:]
        self.part.value = HTML.notes(self.lines)


def absolute(text):
    """The absolute path of what stands in a field."""
    return Path(text.strip()).expanduser().absolute()


def rig_named(text):
    """What the field of the rig names: an emulated rig by its name, or the absolute path of a rig file."""
    text = text.strip()
    path = Path(text).expanduser()
    looks_like_a_file = bool(path.suffix) or path.exists() or len(path.parts) > 1
    if text in PRACTICE_RIGS or not looks_like_a_file:
        return text
    return path.absolute()


class Panel(Closed):
    """Records a session with a rig, by buttons or by methods; a context manager that closes the rig.

    Methods raise what goes wrong, and the panel says it in words; buttons only say it.

    Parameters
    ----------
    rig : path-like or str
        Rig file, or an emulated rig: 'practice' (seconds a placement), 'sim_quick', 'sim_lms221'.
    session : path-like, optional
        Folder of the session, which stays; by default a new one in the folder that the environment
        variable ``LRFCAL_RECORDINGS`` names, else in ``~/lrfcal_sessions``. The panel shows where it is.

    Examples
    --------
    >>> panel = Panel("rig.json")  # doctest: +SKIP
    >>> panel.show()  # doctest: +SKIP
    """

    def __init__(self, rig="practice", session=None):
        session = session or new_session_path()
        self.collector, self.parts = Collector(), Parts(str(rig), str(session))
        self.notes, self._worker = Notes(self.parts.notes), ThreadPoolExecutor(1, thread_name_prefix="panel")
        self.job, self._live, self._quit, self._sweep = None, None, threading.Event(), None
        for name in BUTTONS:
            getattr(self.parts, name).on_click(partial(self._pressed, getattr(self, name)))
        for name in ("rig", "session"):
            getattr(self.parts, name).observe(self._show_places, "value")
        self._show_places()
        self._refresh()

    @property
    def session(self):
        """Folder of the session that the field names, an absolute Path."""
        return absolute(self.parts.session.value)

    def _show_places(self, _=None):
        """Show what the fields name: relative paths are taken from where this notebook lies."""
        self.parts.places.value = HTML.places(rig_named(self.parts.rig.value), self.session)

    def show(self):
        """Display the panel."""
        from IPython.display import display

        bundle = self.parts.root._repr_mimebundle_()
        data = bundle[0] if isinstance(bundle, tuple) else bundle
        display({**data, "text/plain": PLAIN}, raw=True)

    # --------------------------------------------------------------------------------------------- the buttons

    def connect(self):
        """Open the rig and the session that the fields name; see :meth:`Collector.connect`."""
        with self._doing("connecting"):
            DRIVERS.addHandler(self.notes)
            parts, collector = self.parts, self.collector
            parts.rig.value = str(rig_named(parts.rig.value))
            parts.session.value = str(self.session)
            collector.connect(parts.rig.value, self.session)
            low, high = collector.limits_deg
            with parts.slider.hold_trait_notifications():
                parts.slider.min, parts.slider.max = low, high
            parts.show_pictures(collector.rig.cameras)
            self._begin_sweep(collector.task())
            self._quit.clear()
            self._live = threading.Thread(target=self._keep_looking, name="panel view", daemon=True)
            self._live.start()

    def close(self):
        """Stop the head, finish the session, close the devices."""
        with self._doing("closing"):
            self._quit.set()
            if self._live is not None:
                self._live.join()
            try:
                self.collector.close()
            finally:
                DRIVERS.removeHandler(self.notes)

    def go(self):
        """Move the head to the target of the slider; returns where it settled, radians."""
        with self._doing("moving the head"):
            return self.collector.move_to(np.radians(self.parts.slider.value))

    def capture(self):
        """Record the next placement; returns its lights."""
        task = self.collector.task()
        with self._doing("recording"):
            self._begin_sweep(task)
            lights = self.collector.capture(self._show_progress)
            self.parts.lights.value = HTML.lights(f"Quality of {task.title.lower()}", lights)
        return lights

    def again(self):
        """Take the placement recorded last back; returns its number."""
        with self._doing("taking it back"):
            number = self.collector.again()
            self.parts.lights.value = HTML.lights("Quality", ())
        return number

    def calibrate(self):
        """Calibrate what was recorded so far; returns the Result."""
        with self._doing("calibrating"):
            result = self.collector.calibrate()
            self.parts.result.value = HTML.result(result)
        return result

    def stop(self):
        """Stop the head at once, and what is under way."""
        self.collector.stop()
        self._show_progress(0.0, "stopped")

    def _pressed(self, method, _):
        """Do what a button is for in the one thread that works (STOP at once); what goes wrong is shown, not raised."""

        def work():
            with contextlib.suppress(*EXPECTED):
                method()

        if method == self.stop:
            method()
        elif self.job is None or self.job.done():
            self.job = self._worker.submit(work)

    @contextlib.contextmanager
    def _doing(self, text):
        """Something is under way: nothing else can be pressed, and what goes wrong is said."""
        parts, heading = self.parts, ""
        parts.error.value, parts.state.value = "", HTML.state("busy", text)
        self._show_progress(0.0, text)
        parts.enable(self.collector.connected, True, False)
        try:
            yield
        except Exception as error:
            said, heading = str(error), "stopped" if isinstance(error, Interrupted) else f"{text} failed"
            if not isinstance(error, EXPECTED):
                said = f"{type(error).__name__}: {error}"
                LOG.exception("the panel failed while %s", text)
            parts.error.value = HTML.error(heading, said)
            raise
        finally:
            self._show_progress(0.0, heading)
            self._refresh()

    # ------------------------------------------------------------------------------------------------- showing

    def _refresh(self):
        """Show what can be done now."""
        collector, parts = self.collector, self.parts
        parts.state.value = HTML.state("ready" if collector.connected else "off")
        parts.task.value = HTML.title("Next placement") + HTML.soft("connect a rig first")
        if collector.connected:
            parts.task.value = HTML.task(collector.task(), collector.emulated, collector.finished)
        parts.enable(collector.connected, False, bool(collector.finished))

    def _show_progress(self, share, text):
        self.parts.progress.value, self.parts.doing.value = share, HTML.soft(text)

    def _begin_sweep(self, task):
        """An empty picture of the sweep to come."""
        self._sweep = None
        if task is not None and task.placement is not None:
            rig, pitch = self.collector.rig, task.placement.pitch
            step = np.radians(rig.stated.plan.pitch_deg[2]) if len(pitch) < 3 else np.median(np.abs(np.diff(pitch)))
            self._sweep = rig.lrf_info.field_of_view, (pitch.min(), pitch.max()), step

    def _keep_looking(self):
        view_of = self.collector.rig.lrf_info.field_of_view
        while not self._quit.wait(LOOK_S):
            try:
                self._show_view(self.collector.look(), view_of)
            except Exception:  # a view that fails must not end the view
                LOG.exception("the view of the rig failed")
                self._quit.wait(10 * LOOK_S)

    def _show_view(self, view, view_of):
        parts, pictures, sweep = self.parts, self.parts.pictures, self._sweep
        how = "told by the head" if view.measured else "dead reckoning: the head does not tell it"
        parts.pitch.value = f"<b>{np.degrees(view.pitch):+.2f}°</b> {HTML.soft(how)}"
        if view.ranges is not None:
            known = np.isfinite(view.ranges)
            nearest = f"nearest {np.min(view.ranges[known]):.2f} m" if known.any() else "no range at all"
            picture = scan_picture(view.ranges, view.bearings, view_of)
            pictures["scan"].show(png(picture), f"{known.sum()} beams, {nearest}")
        if sweep is not None:
            rows = dict(view.rows)
            picture = sweep_picture(rows, view.bearings, *sweep)
            pictures["sweep"].show(png(picture), f"{len(rows)} scan lines; near is bright, white is no range")
        for name, frame in dict(view.frames).items():
            size = "{1} x {0} pixels".format(*frame.image.shape)
            pictures[name].show(jpeg(frame.image, PICTURE[0]), size)
        if view.trouble or "view" in parts.error.value.partition("</span>")[0]:  # it goes when it is over
            parts.error.value = HTML.error("view", view.trouble)
