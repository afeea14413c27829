"""The data collection panel: words, pictures, widgets, and what buttons do."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import ipywidgets as w
import numpy as np

from lrfcal_lib.acquire.collector import PRACTICE_RIGS, Busy, Collector, Interrupted
from lrfcal_lib.acquire.record import RecordingError
from lrfcal_lib.drivers.port import DeviceError
from lrfcal_lib.model.geometry import polar_to_points
from lrfcal_lib.plots.recording import COLORS
from lrfcal_lib.session.stated import escape

GOOD, WARN, BAD, IDLE = "#1a7f37", "#9a6700", "#cf222e", "#57606a"
LIGHTS = {"ok": (GOOD, "✓", "good"), "warn": (WARN, "!", "check"), "bad": (BAD, "✕", "bad")}
ANSWERS = {"yes": "ok", "with care": "warn", "no": "bad"}
TRUST = {"yes": "can be trusted", "with care": "use with care", "no": "cannot be trusted"}
STATES = {"off": (IDLE, "○", "not connected"), "ready": (GOOD, "●", "ready"), "busy": (WARN, "◐", "busy")}
STYLE = """<style>
.lrfcal-panel {font-size: 13px; border: 1px solid var(--jp-border-color2, #d0d7de); border-radius: 8px;
  padding: 12px 14px; max-width: 1240px; background: var(--jp-layout-color1, #fff)}
.lrfcal-panel .lrfcal-card {border: 1px solid var(--jp-border-color2, #d0d7de); border-radius: 6px; padding: 8px 12px}
.lrfcal-panel .widget-html-content, .lrfcal-panel .jupyter-widgets {line-height: 1.4}
.lrfcal-panel img {border-radius: 3px}
.lrfcal-panel h4 {margin: 0 0 4px; font-size: 13px; font-weight: 600}
.lrfcal-panel p {margin: 2px 0}
.lrfcal-panel table {border-collapse: collapse; margin: 6px 0; font-size: 12px}
.lrfcal-panel td, .lrfcal-panel th {padding: 2px 14px 2px 0; text-align: left; white-space: nowrap}
.lrfcal-panel .mark {display: inline-block; min-width: 62px; margin-right: 8px; padding: 0 7px; border-radius: 9px;
  color: #fff; font-size: 11px; font-weight: 600; text-align: center}
.lrfcal-panel .soft {color: var(--jp-ui-font-color2, #57606a)}
.lrfcal-panel .light {display: flex; align-items: baseline; margin: 3px 0}
.lrfcal-panel .lrfcal-stop {font-weight: 700; letter-spacing: 0.5px}
</style>"""


def mark_html(colour, sign, word):
    """A coloured label with a sign and a word."""
    return f'<span class="mark" style="background:{colour}">{sign} {escape(word)}</span>'


def title_html(text):
    """A heading of a part of the panel."""
    return f"<h4>{escape(text)}</h4>"


def soft_html(text):
    """A remark."""
    return f'<span class="soft">{escape(text)}</span>'


def state_html(name, text=""):
    """State of the panel: 'off', 'ready' or 'busy', and what it is busy with."""
    colour, sign, word = STATES[name]
    return f'{mark_html(colour, sign, word)}<span class="soft">{escape(text)}</span>'


def error_html(heading, text):
    """Something went wrong, and what to do; '' for no text."""
    if not text:
        return ""
    sign = mark_html(BAD, "✕", heading)
    return (f'<div class="lrfcal-error" style="border-left:4px solid {BAD};padding:6px 10px;margin:6px 0">'
            f"{sign}{escape(text)}</div>")  # fmt: skip


def notes(lines):
    """What the drivers reported."""
    return "".join(f"<p>{soft_html(line)}</p>" for line in lines)


def lights_html(heading, found):
    """Lights of a placement, or a remark where there are none yet."""
    rows = "".join(
        f'<div class="light">{_light(one)}<span><b>{escape(one.name)}</b> {escape(one.text)}</span></div>'
        for one in found
    )
    return title_html(heading) + (rows or soft_html("they are checked as soon as a placement is recorded"))


def _light(one):
    """What should be added next is no fault of what was recorded."""
    return (
        mark_html(IDLE, "→", "next")
        if (one.name, one.state) == ("information", "warn")
        else mark_html(*LIGHTS[one.state])
    )


def task(found, emulated, finished):
    """What to record next."""
    done = f"recorded: {', '.join(map(str, finished))}" if finished else "nothing is recorded yet"
    if found is None:
        return title_html("The plan is done") + f"<p>Calibrate, or close.</p>{soft_html(done)}"
    what = escape(found.guidance[:1].upper() + found.guidance[1:])
    if emulated:
        what = f"The emulated board moves by itself. {soft_html('A real one:')} {what}"
    return f"{title_html(found.title)}<p>{what}.</p>{soft_html(done)}"


def pitch(view):
    """Where the head points."""
    how = "told by the head" if view.measured else "dead reckoning: the head does not tell it"
    return f"<b>{np.degrees(view.pitch):+.2f}°</b> {soft_html(how)}"


def result_html(found):
    """A calibration: may it be trusted, what is expected, the poses."""
    colour, sign, _ = LIGHTS[ANSWERS[found.answer]]
    first = found.sentences[0].partition(": ")[2] or "Every check passed."
    text = "".join(f"<p>{escape(sentence)}</p>" for sentence in found.sentences[1:])
    where = f"<p>{soft_html(f'written: {found.file}')}</p>" if found.file else ""
    return (f'<div class="lrfcal-result"><p>{mark_html(colour, sign, TRUST[found.answer])}'
            f"{escape(first[:1].upper() + first[1:])}</p>{_poses(found)}{text}{where}</div>")  # fmt: skip


def _poses(found):
    if not found.poses:
        return ""
    rows = [("camera", "rotation vector [deg]", "translation [mm]")]
    for camera, (turn, shift, turn_sigma, shift_sigma) in found.poses.items():
        rows.append((escape(camera), _vector(turn, turn_sigma, 2), _vector(shift, shift_sigma, 1)))
    return "<table>" + "".join(f"<tr><td>{'</td><td>'.join(cells)}</td></tr>" for cells in rows) + "</table>"


def _vector(values, sigmas, digits):
    return ", ".join(f"{v:.{digits}f} ± {s:.{digits}f}" for v, s in zip(values, sigmas, strict=True))


DPI = 100
REACHES = (2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 20.0, 30.0, 50.0, 82.0)  # of the top view, metres
SHIFT = 4  # binary digits of a pixel's fraction
GREY = "#8a8a8a"
EMPTY = (238, 238, 238)  # of a sweep's picture, where no range is


class Canvas:
    """Axes drawn once.

    Parameters
    ----------
    draw : callable
        ``draw(ax)``.
    size : (int, int)
        Width and height, pixels.
    place : tuple of float
        Of the axes in the figure: left, bottom, width, height as fractions.
    """

    def __init__(self, draw, size, place=(0, 0, 1, 1)):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(size[0] / DPI, size[1] / DPI), dpi=DPI, layout="none")
        canvas = FigureCanvasAgg(figure)
        ax = figure.add_axes(place)
        draw(ax)
        canvas.draw()
        self.background = np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., 2::-1])
        self._to_pixels = ax.transData.frozen()

    def pixels(self, points):
        """Pixels of points in the axes' own units, shape (n, 2); v goes down."""
        found = self._to_pixels.transform(np.asarray(points, float).reshape(-1, 2))
        return np.column_stack([found[:, 0], len(self.background) - found[:, 1]])


def png(image):
    """Bytes of a PNG file."""
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes()


def jpeg(image, width):
    """Bytes of a JPEG file of an image, not wider than `width` pixels.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w, 3)
        BGR.
    width : int
    """
    scale = width / image.shape[1]
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()


class TopView:
    """Scans in their own plane: the laser range finder below, the scene ahead; circles every metre or more.

    Parameters
    ----------
    field_of_view : (float, float)
        First and last bearing, radians.
    size : (int, int)
        Pixels.
    """

    def __init__(self, field_of_view, size=(420, 330)):
        self.field_of_view, self.size = field_of_view, size
        self._canvases = {}

    def draw(self, ranges, bearings):
        """A scan.

        Parameters
        ----------
        ranges, bearings : ndarray, shape (B,)
            Metres (NaN: none) and radians.

        Returns
        -------
        ndarray of uint8, shape (h, w, 3)
        """
        points = polar_to_points(np.asarray(ranges, float), bearings)[:, :2]
        points = points[np.isfinite(points).all(axis=1)]
        canvas = self._canvas(reach_of(points))
        image = canvas.background.copy()
        for pixel in np.rint(canvas.pixels(points) * 2**SHIFT).astype(int):
            cv2.circle(image, tuple(map(int, pixel)), 2 << SHIFT, _bgr(COLORS["lrf"]), -1, cv2.LINE_AA, SHIFT)
        return image

    def _canvas(self, reach):
        if reach not in self._canvases:
            self._canvases[reach] = Canvas(lambda ax: self._axes(ax, reach), self.size)
        return self._canvases[reach]

    def _axes(self, ax, reach):
        angle = np.linspace(*self.field_of_view, 91)
        edge = reach * np.column_stack([np.cos(angle), np.sin(angle)])
        shape = self.size[0] / self.size[1]
        low, high, side = min(0.0, edge[:, 1].min()), edge[:, 1].max(), np.abs(edge[:, 0]).max()
        middle, half = (low + high) / 2, 1.1 * max((high - low) / 2, side / shape)
        ax.set(xlim=(-half * shape, half * shape), ylim=(middle - half, middle + half), aspect="equal")
        ax.set_axis_off()
        ax.fill(*np.vstack([[0, 0], edge]).T, color="#f4f6f8", zorder=0)
        step = 1.0 if reach <= 6 else 2.0 if reach <= 12 else 5.0 if reach <= 30 else 20.0
        for radius in np.arange(step, reach + 1e-6, step):
            ax.plot(radius * np.cos(angle), radius * np.sin(angle), color="#d5d9dd", linewidth=0.8, zorder=1)
            if radius < reach:
                ax.text(*edge[0] * radius / reach, f" {radius:g} m", color=GREY, fontsize=8, va="top", ha="left")
        ax.plot(0, 0, marker="^", color="#333333", markersize=9)


def reach_of(points):
    """Radius of a top view that shows nearly all points, metres."""
    far = float(np.percentile(np.linalg.norm(points, axis=1), 90)) if len(points) else 0.0
    return next((reach for reach in REACHES if reach >= far), REACHES[-1])


class SweepPicture:
    """A sweep as it grows: ranges as colours, bearing to the left as in the scene, pitch upwards.

    Parameters
    ----------
    field_of_view : (float, float)
        Radians.
    pitch : (float, float)
        Lowest and highest of the sweep, radians.
    step : float
        Between scan lines, radians; of a continuous sweep the most between two.
    size : (int, int)
        Pixels.
    """

    def __init__(self, field_of_view, pitch, step, size=(420, 330)):
        self.bearing, self.step = np.degrees(field_of_view), np.degrees(step)
        self.pitch = np.degrees([min(pitch), max(pitch)]) + np.array([-0.5, 0.5]) * self.step
        self._canvas = Canvas(self._axes, size, (0.11, 0.15, 0.86, 0.81))

    def _axes(self, ax):
        ax.set(xlim=(max(self.bearing), min(self.bearing)), ylim=tuple(self.pitch))
        ax.set_facecolor("#eeeeee")
        ax.tick_params(labelsize=7, colors=GREY)
        ax.set_xlabel("bearing [deg]", fontsize=8, color=GREY)
        ax.set_ylabel("pitch [deg]", fontsize=8, color=GREY, labelpad=1)
        for side in ax.spines.values():
            side.set_color("#cccccc")

    def draw(self, rows, bearings):
        """The sweep so far.

        Parameters
        ----------
        rows : dict of float to ndarray, shape (B,)
            Ranges by pitch.
        bearings : ndarray, shape (B,)

        Returns
        -------
        ndarray of uint8, shape (h, w, 3)
        """
        image = self._canvas.background.copy()
        if not rows:
            return image
        shades = _shades(np.array(list(rows.values())))
        edges = np.degrees([bearings[-1], bearings[0]])
        for pitch, row in zip(np.degrees(list(rows)), shades, strict=True):
            ends = [(edges[0], pitch + self.step / 2), (edges[1], pitch - self.step / 2)]
            (left, top), (right, bottom) = np.rint(self._canvas.pixels(ends)).astype(int) + [[0, 0], [0, 1]]
            if right > left and bottom > top:
                line = cv2.resize(row[None, ::-1], (right - left, 1), interpolation=cv2.INTER_NEAREST)
                image[top:bottom, left:right] = line
        return image


def _shades(ranges):
    """Colours of ranges, shape (L, B, 3): near is bright; grey where there is none."""
    known = np.isfinite(ranges)
    low, high = np.percentile(ranges[known], [2, 90]) if known.any() else (0, 1)
    scaled = (np.nan_to_num(ranges, nan=high) - low) / max(high - low, 0.1)
    grey = (255 * (1 - np.clip(scaled, 0, 1))).astype(np.uint8)
    shades = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS).reshape(*ranges.shape, 3)
    shades[~known] = EMPTY
    return shades


def _bgr(text):
    return tuple(int(text[i : i + 2], 16) for i in (5, 3, 1))


PICTURE = (400, 300)  # pixels
NOTHING = b""


def button(text, name, tip, style="", icon="", width="auto"):
    """A button that a test finds by the class ``lrfcal-<name>``."""
    made = w.Button(description=text, tooltip=tip, button_style=style, icon=icon, layout=w.Layout(width=width))
    made.add_class(f"lrfcal-{name}")
    return made


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
        self.box = card(w.HTML(title_html(heading)), self.image, self.remark, basis="270px")

    def show(self, data, remark):
        """Show the bytes of an image; what did not change is not sent again."""
        if data != self.image.value:
            self.image.value = data
        if (text := soft_html(remark)) != self.remark.value:
            self.remark.value = text


class Parts:
    """All widgets; `root` is shown.

    Parameters
    ----------
    rig, session : str
        What the fields say at first.
    """

    def __init__(self, rig, session):
        wide = {"description_width": "62px"}
        self.rig = w.Combobox(value=rig, options=PRACTICE_RIGS, description="rig", style=wide,
                              placeholder="rig file or emulated rig", layout=w.Layout(flex="1 1 260px"))  # fmt: skip
        self.session = w.Text(value=session, description="session", style=wide, layout=w.Layout(flex="2 1 320px"))
        self.connect = button("Connect", "connect", "open all devices and the session", "primary", "plug")
        self.close = button("Close", "close", "finish the session and close all devices", icon="power-off")
        self.stop = button("STOP", "stop", "stop the head at once, and what is under way", "danger", "stop", "130px")
        self.state, self.error, self.notes = w.HTML(state_html("off")), w.HTML(), w.HTML()
        self.slider = w.FloatSlider(min=-60, max=60, step=0.5, readout_format="+.1f", description="target",
                                    style=wide, layout=w.Layout(width="100%"))  # fmt: skip
        self.go, self.pitch = button("Go", "go", "move the head to the target", icon="arrows-v"), w.HTML()
        self.task, self.lights = w.HTML(), w.HTML(lights_html("Quality", ()))
        self.capture = button("Capture", "capture", "record this placement", "success", "camera", "140px")
        self.again = button("Again", "again", "take the last placement back, to record it again", icon="undo")
        self.progress = w.FloatProgress(min=0, max=1, layout=w.Layout(width="100%"))
        self.doing = w.HTML()
        self.calibrate = button("Save & calibrate", "calibrate", "calibrate what is recorded so far", "info", "check")
        self.result = w.HTML(soft_html("three placements and more; the recording can go on afterwards"))
        self.pictures, self.views = {}, row()
        named = {"state": self.state, "rig": self.rig, "session": self.session}
        for name, made in named.items():
            made.add_class(f"lrfcal-{name}")
        self.root = self._laid_out()

    def _laid_out(self):
        head = row(w.HTML("<b style='font-size:16px'>Data collection</b>"), self.state, self.stop,
                   justify_content="space-between", align_items="center")  # fmt: skip
        head_card = card(w.HTML(title_html("Head")), self.pitch, self.slider, row(self.go))
        next_card = card(self.task, row(self.capture, self.again), self.progress, self.doing)
        root = w.VBox(
            [w.HTML(STYLE), head, row(self.rig, self.session, self.connect, self.close), self.error, self.views,
             row(head_card, next_card, card(self.lights, grow=2, basis="420px")),
             card(w.HTML(title_html("Result")), row(self.calibrate), self.result, basis="auto"), self.notes],
            layout=w.Layout(grid_gap="10px"),
        )  # fmt: skip
        root.add_class("lrfcal-panel")
        return root

    def show_pictures(self, cameras):
        """Make room for the pictures of a rig."""
        self.pictures = {"scan": Picture("scan", "Scan from above"), "sweep": Picture("sweep", "This sweep")}
        self.pictures |= {name: Picture(name, f"Camera {name}", "jpeg") for name in cameras}
        self.views.children = [picture.box for picture in self.pictures.values()]

    def enable(self, connected, busy, recorded):
        """What can be pressed now; STOP always can."""
        for part in (self.rig, self.session, self.connect):
            part.disabled = connected or busy
        for part in (self.close, self.capture, self.go, self.slider):
            part.disabled = not connected or busy
        for part in (self.again, self.calibrate):
            part.disabled = not connected or busy or not recorded


LOG = logging.getLogger(__name__)
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
        self.part.value = notes(self.lines)


class Panel:
    """Records a session with a rig, by buttons or by methods; a context manager that closes the rig.

    Methods raise what goes wrong, and the panel says it in words; buttons only say it.

    Parameters
    ----------
    rig : path-like or str
        Rig file, or an emulated rig: 'practice' (seconds a placement), 'sim_quick', 'sim_lms221'.
    session : path-like, optional
        Folder of the session; a new one in ``~/lrfcal_sessions`` by default.
    advice : bool
        Look after every placement what the next one should add.

    Examples
    --------
    >>> panel = Panel("rig.json")  # doctest: +SKIP
    >>> panel.show()  # doctest: +SKIP
    """

    def __init__(self, rig="practice", session=None, *, advice=True):
        session = session or Path.home() / "lrfcal_sessions" / time.strftime("%Y-%m-%d_%H%M%S")
        self.collector, self.parts = Collector(advice=advice), Parts(str(rig), str(session))
        self._notes, self._worker = Notes(self.parts.notes), ThreadPoolExecutor(1, thread_name_prefix="panel")
        self._job, self._live, self._quit = None, None, threading.Event()
        for name in ("connect", "close", "go", "capture", "again", "calibrate"):
            getattr(self.parts, name).on_click(self._pressed(getattr(self, name)))
        self.parts.stop.on_click(lambda _: self.stop())
        self._refresh()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

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
            logging.getLogger("lrfcal_lib").addHandler(self._notes)
            self.collector.connect(self.parts.rig.value.strip(), Path(self.parts.session.value.strip()).expanduser())
            low, high = self.collector.limits_deg
            self.parts.slider.min, self.parts.slider.max = min(low, self.parts.slider.max), high
            self.parts.slider.min = low
            self._prepare_pictures()
            self._look_from_now_on()

    def close(self):
        """Stop the head, finish the session, close the devices."""
        with self._doing("closing"):
            self._quit.set()
            if self._live is not None:
                self._live.join()
            try:
                self.collector.close()
            finally:
                logging.getLogger("lrfcal_lib").removeHandler(self._notes)

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
            self.parts.lights.value = lights_html(f"Quality of {task.title.lower()}", lights)
        return lights

    def again(self):
        """Take the placement recorded last back; returns its number."""
        with self._doing("taking it back"):
            number = self.collector.again()
            self.parts.lights.value = lights_html("Quality", ())
        return number

    def calibrate(self):
        """Calibrate what was recorded so far; returns the Result."""
        with self._doing("calibrating"):
            result = self.collector.calibrate()
            self.parts.result.value = result_html(result)
        return result

    def stop(self):
        """Stop the head at once, and what is under way."""
        self.collector.stop()
        self._show_progress(0.0, "stopped")

    def _pressed(self, method):
        """What a click does: the method, in the one thread that works; what goes wrong was shown already."""

        def work():
            with contextlib.suppress(*EXPECTED):
                method()

        def pressed(_):
            if self._job is None or self._job.done():
                self._job = self._worker.submit(work)

        return pressed

    @contextlib.contextmanager
    def _doing(self, text):
        """Something is under way: nothing else can be pressed, and what goes wrong is said."""
        self.parts.error.value, self.parts.state.value = "", state_html("busy", text)
        self._show_progress(0.0, text)
        self.parts.enable(self.collector.connected, True, False)
        try:
            yield
            self._show_progress(0.0, "")
        except Exception as error:
            self._show_error(text, error)
            raise
        finally:
            self._refresh()

    def _show_error(self, doing, error):
        said = str(error) if isinstance(error, EXPECTED) else f"{type(error).__name__}: {error}"
        if not isinstance(error, EXPECTED):
            LOG.exception("the panel failed while %s", doing)
        heading = "stopped" if isinstance(error, Interrupted) else f"{doing} failed"
        self.parts.error.value = error_html(heading, said)
        self._show_progress(0.0, heading)

    # ------------------------------------------------------------------------------------------------- showing

    def _refresh(self):
        """Show what can be done now."""
        collector, parts = self.collector, self.parts
        parts.state.value = state_html("ready" if collector.connected else "off")
        parts.task.value = (
            task(collector.task(), collector.emulated, collector.finished)
            if collector.connected
            else title_html("Next placement") + soft_html("connect a rig first")
        )
        parts.enable(collector.connected, False, bool(collector.finished))

    def _show_progress(self, share, text):
        self.parts.progress.value, self.parts.doing.value = share, soft_html(text)

    def _prepare_pictures(self):
        rig = self.collector.rig
        self._top = TopView(rig.lrf_info.field_of_view, PICTURE)
        self.parts.show_pictures(rig.cameras)
        self._begin_sweep(self.collector.task())

    def _begin_sweep(self, task):
        """An empty picture of the sweep to come."""
        if task is None or task.placement is None:
            self._sweep = None
            return
        rig, pitch = self.collector.rig, task.placement.pitch
        step = np.radians(rig.stated.plan.pitch_deg[2]) if len(pitch) < 3 else np.median(np.abs(np.diff(pitch)))
        self._sweep = SweepPicture(rig.lrf_info.field_of_view, (pitch.min(), pitch.max()), step, PICTURE)

    def _look_from_now_on(self):
        self._quit.clear()
        self._live = threading.Thread(target=self._keep_looking, name="panel view", daemon=True)
        self._live.start()

    def _keep_looking(self):
        while not self._quit.wait(LOOK_S):
            try:
                self._show_view(self.collector.look())
            except Exception:  # a view that fails must not end the view
                LOG.exception("the view of the rig failed")
                self._quit.wait(10 * LOOK_S)

    def _show_view(self, view):
        self.parts.pitch.value = pitch(view)
        pictures = self.parts.pictures
        if view.ranges is not None:
            known = np.isfinite(view.ranges)
            nearest = f"nearest {np.min(view.ranges[known]):.2f} m" if known.any() else "no range at all"
            pictures["scan"].show(png(self._top.draw(view.ranges, view.bearings)), f"{known.sum()} beams, {nearest}")
        if self._sweep is not None:
            rows = dict(view.rows)
            picture = png(self._sweep.draw(rows, view.bearings))
            pictures["sweep"].show(picture, f"{len(rows)} scan lines; near is bright, white is no range")
        for name, frame in dict(view.frames).items():
            size = "{1} x {0} pixels".format(*frame.image.shape)
            pictures[name].show(jpeg(frame.image, PICTURE[0]), size)
        self._show_trouble(view.trouble)

    def _show_trouble(self, text):
        """What cannot be seen, unless an error is shown; it goes when it is over."""
        if text or "view" in self.parts.error.value.partition("</span>")[0]:
            self.parts.error.value = error_html("view", text)
