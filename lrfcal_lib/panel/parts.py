"""The widgets of the panel and how they are laid out; they do nothing by themselves."""

from __future__ import annotations

import ipywidgets as w

from lrfcal_lib.panel import words
from lrfcal_lib.panel.collector import PRACTICE_RIGS

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
        self.box = card(w.HTML(words.title(heading)), self.image, self.remark, basis="270px")

    def show(self, data, remark):
        """Show the bytes of an image; what did not change is not sent again."""
        if data != self.image.value:
            self.image.value = data
        if (text := words.soft(remark)) != self.remark.value:
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
        self.state, self.error, self.notes = w.HTML(words.state("off")), w.HTML(), w.HTML()
        self.slider = w.FloatSlider(min=-60, max=60, step=0.5, readout_format="+.1f", description="target",
                                    style=wide, layout=w.Layout(width="100%"))  # fmt: skip
        self.go, self.pitch = button("Go", "go", "move the head to the target", icon="arrows-v"), w.HTML()
        self.task, self.lights = w.HTML(), w.HTML(words.lights("Quality", ()))
        self.capture = button("Capture", "capture", "record this placement", "success", "camera", "140px")
        self.again = button("Again", "again", "take the last placement back, to record it again", icon="undo")
        self.progress = w.FloatProgress(min=0, max=1, layout=w.Layout(width="100%"))
        self.doing = w.HTML()
        self.calibrate = button("Save & calibrate", "calibrate", "calibrate what is recorded so far", "info", "check")
        self.result = w.HTML(words.soft("three placements and more; the recording can go on afterwards"))
        self.pictures, self.views = {}, row()
        named = {"state": self.state, "rig": self.rig, "session": self.session}
        for name, made in named.items():
            made.add_class(f"lrfcal-{name}")
        self.root = self._laid_out()

    def _laid_out(self):
        head = row(w.HTML("<b style='font-size:16px'>Data collection</b>"), self.state, self.stop,
                   justify_content="space-between", align_items="center")  # fmt: skip
        head_card = card(w.HTML(words.title("Head")), self.pitch, self.slider, row(self.go))
        next_card = card(self.task, row(self.capture, self.again), self.progress, self.doing)
        root = w.VBox(
            [w.HTML(words.STYLE), head, row(self.rig, self.session, self.connect, self.close), self.error, self.views,
             row(head_card, next_card, card(self.lights, grow=2, basis="420px")),
             card(w.HTML(words.title("Result")), row(self.calibrate), self.result, basis="auto"), self.notes],
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
