"""What the panel says, as HTML; colours never stand alone."""

from __future__ import annotations

import numpy as np

from lrfcal_lib.notebook import escape

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


def mark(colour, sign, word):
    """A coloured label with a sign and a word."""
    return f'<span class="mark" style="background:{colour}">{sign} {escape(word)}</span>'


def title(text):
    """A heading of a part of the panel."""
    return f"<h4>{escape(text)}</h4>"


def soft(text):
    """A remark."""
    return f'<span class="soft">{escape(text)}</span>'


def state(name, text=""):
    """State of the panel: 'off', 'ready' or 'busy', and what it is busy with."""
    colour, sign, word = STATES[name]
    return f'{mark(colour, sign, word)}<span class="soft">{escape(text)}</span>'


def error(heading, text):
    """Something went wrong, and what to do; '' for no text."""
    if not text:
        return ""
    sign = mark(BAD, "✕", heading)
    return (f'<div class="lrfcal-error" style="border-left:4px solid {BAD};padding:6px 10px;margin:6px 0">'
            f"{sign}{escape(text)}</div>")  # fmt: skip


def notes(lines):
    """What the drivers reported."""
    return "".join(f"<p>{soft(line)}</p>" for line in lines)


def lights(heading, found):
    """Lights of a placement, or a remark where there are none yet."""
    rows = "".join(
        f'<div class="light">{_light(one)}<span><b>{escape(one.name)}</b> {escape(one.text)}</span></div>'
        for one in found
    )
    return title(heading) + (rows or soft("they are checked as soon as a placement is recorded"))


def _light(one):
    """What should be added next is no fault of what was recorded."""
    return mark(IDLE, "→", "next") if (one.name, one.state) == ("information", "warn") else mark(*LIGHTS[one.state])


def task(found, emulated, finished):
    """What to record next."""
    done = f"recorded: {', '.join(map(str, finished))}" if finished else "nothing is recorded yet"
    if found is None:
        return title("The plan is done") + f"<p>Calibrate, or close.</p>{soft(done)}"
    what = escape(found.guidance[:1].upper() + found.guidance[1:])
    if emulated:
        what = f"The emulated board moves by itself. {soft('A real one:')} {what}"
    return f"{title(found.title)}<p>{what}.</p>{soft(done)}"


def pitch(view):
    """Where the head points."""
    how = "told by the head" if view.measured else "dead reckoning: the head does not tell it"
    return f"<b>{np.degrees(view.pitch):+.2f}°</b> {soft(how)}"


def result(found):
    """A calibration: may it be trusted, what is expected, the poses."""
    colour, sign, _ = LIGHTS[ANSWERS[found.answer]]
    first = found.sentences[0].partition(": ")[2] or "Every check passed."
    text = "".join(f"<p>{escape(sentence)}</p>" for sentence in found.sentences[1:])
    where = f"<p>{soft(f'written: {found.file}')}</p>" if found.file else ""
    return (f'<div class="lrfcal-result"><p>{mark(colour, sign, TRUST[found.answer])}'
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
