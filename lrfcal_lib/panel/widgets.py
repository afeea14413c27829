"""The data collection panel for JupyterLab. Every button calls a method that a program can call as well."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from lrfcal_lib.acquisition import RecordingError
from lrfcal_lib.drivers.errors import DeviceError
from lrfcal_lib.panel import words
from lrfcal_lib.panel.collector import Busy, Collector, Interrupted
from lrfcal_lib.panel.parts import PICTURE, Parts
from lrfcal_lib.panel.pictures import SweepPicture, TopView, jpeg, png

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
        self.part.value = words.notes(self.lines)


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
            self.parts.lights.value = words.lights(f"Quality of {task.title.lower()}", lights)
        return lights

    def again(self):
        """Take the placement recorded last back; returns its number."""
        with self._doing("taking it back"):
            number = self.collector.again()
            self.parts.lights.value = words.lights("Quality", ())
        return number

    def calibrate(self):
        """Calibrate what was recorded so far; returns the Result."""
        with self._doing("calibrating"):
            result = self.collector.calibrate()
            self.parts.result.value = words.result(result)
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
        self.parts.error.value, self.parts.state.value = "", words.state("busy", text)
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
        self.parts.error.value = words.error(heading, said)
        self._show_progress(0.0, heading)

    # ------------------------------------------------------------------------------------------------- showing

    def _refresh(self):
        """Show what can be done now."""
        collector, parts = self.collector, self.parts
        parts.state.value = words.state("ready" if collector.connected else "off")
        parts.task.value = (
            words.task(collector.task(), collector.emulated, collector.finished)
            if collector.connected
            else words.title("Next placement") + words.soft("connect a rig first")
        )
        parts.enable(collector.connected, False, bool(collector.finished))

    def _show_progress(self, share, text):
        self.parts.progress.value, self.parts.doing.value = share, words.soft(text)

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
        self.parts.pitch.value = words.pitch(view)
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
            self.parts.error.value = words.error("view", text)
